"""The hash chain of an audit in a file: whatever is altered, removed or added is named."""

import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from heliotrope.errors import FormatError
from heliotrope.plant.orders.audit import AuditError, JsonLines, Record, read, verify

AT = datetime(2026, 6, 21, 10, tzinfo=UTC)


def record(identity: str) -> Record:
    return Record(identity, "Olga", "operator", "TRACK", AT.isoformat(), (1.0,), ("Ü 1",), "note")


def _chained(path: Path, count: int = 3) -> list[str]:
    """Return the lines of a new audit."""
    audit = JsonLines(path, AT)
    for i in range(count):
        audit.begin(record(str(i)))
        audit.finish(str(i), "done", "later")
    audit.close()
    return path.read_text().splitlines(keepends=True)


def test_the_file_of_an_audit_is_a_hash_chain(tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    _chained(path)
    head = verify(path)
    assert head.number == 6
    audit = JsonLines(path, AT)
    audit.begin(record("after a restart"))
    audit.close()
    assert verify(path, [head]).number == 7
    assert len(read(path)[0]) == 4


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            lambda lines: [*lines[:2], lines[2].replace("TRACK", "AIM"), *lines[3:]],
            "line 3: record 1",
        ),
        (
            lambda lines: [*lines[:2], *lines[4:]],
            "line 3: record 2 does not match the hash chain; this record or an earlier one",
        ),
        (
            lambda lines: [*lines[1:]],
            "line 1: record 0 does not match the hash chain; this record or an earlier one",
        ),
        (
            lambda lines: [*lines, '{"event":"accepted","identity":"x"}\n'],
            "line 7: it has no digest",
        ),
        (lambda lines: lines[:4], "head audit:6:.* is missing, so"),
    ],
)
def test_a_changed_audit_is_named(change: Any, text: str, tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    lines = _chained(path)
    head = verify(path)
    path.write_text("".join(change(lines)))
    assert path.read_text() != "".join(lines)
    with pytest.raises(FormatError, match=text):
        verify(path, [head])


def test_lines_of_before_and_torn_ones_are_covered(tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    older = [re.sub(r',"digest":"[0-9a-f]+"', "", line) for line in _chained(path)]
    path.write_text("".join(older) + '{"event":"acc')
    audit = JsonLines(path, AT)
    assert audit.torn == 1
    audit.begin(record("new"))
    audit.finish("new", "done", "later")
    audit.close()
    assert verify(path).number == 2
    assert len(read(path)[0]) == 4
    path.write_text(path.read_text().replace('"done"', '"good"', 1))
    with pytest.raises(
        FormatError, match="record new does not match the hash chain; this record or an earlier one"
    ):
        verify(path)


def test_a_line_whose_sync_failed_is_in_the_chain(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.jsonl"
    audit = JsonLines(path, AT)
    with monkeypatch.context() as broken:

        def fail(_: int) -> None:
            raise OSError(5, "input/output error")

        broken.setattr("os.fsync", fail)
        with pytest.raises(AuditError):
            audit.begin(record("1"))
    audit.begin(record("1"))
    audit.finish("1", "done", "later")
    audit.close()
    assert verify(path).number == 3
