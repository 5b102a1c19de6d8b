"""Every command of the page on the sources runs, and every test that it names exists."""

import contextlib
import io
import re
import runpy
import shlex
import sys
from pathlib import Path

import pytest

from heliotrope.cli import main

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "explanation" / "sources.md"
_COMMAND = re.compile(r"`([^`]+)`( \(slow\))?")
COLUMNS = 5


def _tables() -> dict[str, list[list[str]]]:
    """Return the rows of each paper's table, by the heading above it."""
    found: dict[str, list[list[str]]] = {}
    paper = ""
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        if line.startswith("## "):
            paper = line[3:]
        elif line.startswith("|"):
            found.setdefault(paper, []).append([c.strip() for c in line.strip("|").split("|")])
    return {paper: rows[2:] for paper, rows in found.items()}


def _commands(paper: str) -> dict[str, bool]:
    """Return the distinct commands of a table's third column: whether each is slow."""
    return {line: bool(slow) for row in _tables()[paper] for line, slow in _COMMAND.findall(row[2])}


def _run(line: str) -> str:
    words = shlex.split(line)
    out = io.StringIO()
    before = sys.argv
    try:
        with contextlib.redirect_stdout(out):
            if words[0] == "python":
                sys.argv = words[1:]
                runpy.run_path(words[1], run_name="__main__")
            else:
                assert words[0] == "heliotrope", f"{line}: neither heliotrope nor python"
                sys.argv = words
                with pytest.raises(SystemExit) as leaving:
                    main()
                assert leaving.value.code in (0, None), f"{line} ended with {leaving.value.code}"
    finally:
        sys.argv = before
    return out.getvalue()


def _named_test_exists(line: str) -> bool:
    path, _, name = shlex.split(line)[1].partition("::")
    file = ROOT / path
    return file.is_file() and (not name or f"def {name}(" in file.read_text(encoding="utf-8"))


@pytest.mark.parametrize("paper", _tables())
def test_every_command_runs(paper: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for folder in ("examples", "scripts", "benchmarks"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    for line, slow in _commands(paper).items():
        if line.startswith("pytest "):
            # The suite itself runs it.
            assert _named_test_exists(line), f"{line}: there is no such test"
        elif slow:
            assert Path(shlex.split(line)[1]).is_file(), f"{line}: there is no such script"
        else:
            assert _run(line).strip(), f"{line} prints nothing"


@pytest.mark.parametrize("paper", _tables())
def test_every_row_is_whole(paper: str) -> None:
    for row in _tables()[paper]:
        assert len(row) == COLUMNS, row
        assert all(row), row
        assert _COMMAND.search(row[2]) or row[1] == "not here", f"{row[0]}: no command"


def test_guos_equations_are_all_there() -> None:
    text = " ".join(row[0] for row in _tables()["Guo"])
    spans = [
        range(int(a), int(b or a) + 1) for a, b in re.findall(r"\((\d+)\)(?:-\((\d+)\))?", text)
    ]
    assert {n for span in spans for n in span} == set(range(1, 48))
    assert {int(n) for n in re.findall(r"figure (\d)", text)} == {1, 2, 3, 4, 5}


def test_the_check_can_fail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(AssertionError, match="ended with 2"):
        _run("heliotrope field check nowhere.xml")
    assert not _named_test_exists("pytest tests/test_sources.py::test_nothing_of_the_kind")
