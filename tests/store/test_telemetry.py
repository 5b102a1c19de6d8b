"""The telemetry archive: small, whole after a crash, and asked in SQL."""

import errno
import os
import tempfile
import threading
from collections.abc import Iterator
from datetime import UTC, date, datetime
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from heliotrope.errors import InputError
from heliotrope.store import telemetry as archive
from heliotrope.store.records import StoreError
from heliotrope.store.telemetry import STALE, Look, Telemetry, TelemetrySettings, retain
from heliotrope.store.telemetry_query import query

NOON = datetime(2026, 6, 21, 12, tzinfo=UTC).timestamp()
STATES = ("STOWED", "IDLE", "TRACKING")
NAMES = ("A", "B'1", "C")


def look(state: object = 2, counts: object = 0, fault: object = 0, age: object = 0.5) -> Look:
    count = len(NAMES)
    both = np.asarray(counts)
    return Look(
        np.broadcast_to(np.asarray(state, np.uint8), count).copy(),
        np.broadcast_to(np.asarray(fault, np.uint8), count).copy(),
        np.zeros(count, np.uint16),
        np.stack([np.broadcast_to(both, count)] * 2, axis=-1).astype(np.int32),
        np.broadcast_to(np.asarray(age, np.float64), count).copy(),
    )


_OPEN: list[Telemetry] = []


@pytest.fixture(autouse=True)
def _close_all() -> Iterator[None]:
    yield
    while _OPEN:
        _OPEN.pop().close()


def open_archive(folder: Path, **options: float) -> Telemetry:
    """Open an archive; it is closed after the test."""
    given = TelemetrySettings(**{"period": 10.0, "keyframe": 600.0, **options})  # type: ignore[arg-type]
    made = Telemetry(folder, NAMES, STATES, given, inline=True)
    _OPEN.append(made)
    return made


def rows(folder: Path, sql: str = "SELECT * FROM telemetry ORDER BY time, heliostat") -> list[dict]:
    return query(folder, sql).to_pylist()


class TestWriting:
    def test_what_was_is_found(self, tmp_path: Path) -> None:
        made = open_archive(tmp_path)
        assert made.take(NOON, look([0, 2, STALE], [5, -6, 7], 1, 1.26)) == 3
        first, second, third = rows(tmp_path)
        assert first == {
            "time": datetime(2026, 6, 21, 12),  # noqa: DTZ001
            "heliostat": "A",
            "state": "STOWED",
            "fault": 1,
            "flags": 0,
            "primary": 5,
            "secondary": 5,
            "age": pytest.approx(1.3),
        }
        assert (second["heliostat"], second["state"], second["primary"]) == ("B'1", "TRACKING", -6)
        assert third["state"] == "STALE"

    def test_only_what_changed_is_written(self, tmp_path: Path) -> None:
        made = open_archive(tmp_path)
        assert made.take(NOON, look([0, 0, STALE])) == 3
        assert made.take(NOON + 10.0, look([0, 0, STALE], age=9.0)) == 0
        assert made.take(NOON + 20.0, look([0, 1, STALE])) == 1
        assert made.take(NOON + 30.0, look([0, 1, STALE], [0, 0, 5])) == 0  # nobody knows
        assert made.take(NOON + 40.0, look([0, 1, 1], [3, 0, 0])) == 2
        assert made.take(NOON + 600.0, look([0, 1, 1], [3, 0, 0])) == 3

    def test_not_more_often_than_the_period(self, tmp_path: Path) -> None:
        made = open_archive(tmp_path)
        taken = [k for k in range(31) if made.take(NOON + k, look(counts=k))]
        assert taken == [0, 10, 20, 30]
        # The clock was put back.
        assert made.take(NOON - 3600.0, look()) == 3

    def test_a_drive_that_hardly_moves(self, tmp_path: Path) -> None:
        made = open_archive(tmp_path, deadband=10)
        counts = range(0, 40, 4)
        written = [bool(made.take(NOON + 10.0 * k, look(counts=c))) for k, c in enumerate(counts)]
        # Counted from what was written last, so that a slow drive is not lost.
        assert written == [True, False, False, True, False, False, True, False, False, True]

    def test_a_day_is_a_folder_and_long_parts_become_segments(self, tmp_path: Path) -> None:
        made = open_archive(tmp_path, rows=9)
        for k in range(7):
            made.take(NOON + 10.0 * k, look(counts=k))
        day = tmp_path / "2026-06-21"
        assert sorted(p.name for p in day.iterdir()) == [
            "0001.parquet",
            "0002.parquet",
            "0003.part",
        ]
        assert len(rows(tmp_path)) == 21
        made.take(NOON + 86400.0, look())
        assert sorted(p.name for p in day.iterdir()) == [f"000{k}.parquet" for k in (1, 2, 3)]
        assert len(rows(tmp_path)) == 24
        table = pq.read_table(day / "0001.parquet")
        assert table["heliostat"].to_pylist() == [n for n in NAMES for _ in range(3)]
        assert table.schema.field("time").type == archive.SCHEMA.field("time").type

    @settings(max_examples=30)
    @given(
        looks=st.lists(
            st.tuples(
                st.lists(st.sampled_from([0, 1, 2, STALE]), min_size=3, max_size=3),
                st.lists(st.integers(-4, 4), min_size=3, max_size=3),
                st.integers(1, 1000),
            ),
            min_size=1,
            max_size=15,
        )
    )
    def test_every_instant_can_be_told(self, looks: list[tuple[list[int], list[int], int]]) -> None:
        names = (*STATES, *([""] * 252), "STALE")
        with tempfile.TemporaryDirectory() as folder:
            made = open_archive(Path(folder))
            at, known = NOON, {}
            for state, counts, gone in looks:
                at += max(10, gone)
                made.take(at, look(state, counts))
                for batch in _batches(Path(folder)):
                    known.update({r["heliostat"]: r for r in batch.to_pylist()})
                for i, name in enumerate(NAMES):
                    assert known[name]["state"] == names[state[i]]
                    if state[i] != STALE:
                        assert known[name]["primary"] == counts[i]
            made.close()


def _batches(folder: Path) -> list:
    parts = sorted(folder.glob("*/*.part"))
    return [batch for part in parts for batch in archive.read_part(part)]


class TestCrashes:
    def test_a_part_is_readable_wherever_it_is_torn(self, tmp_path: Path) -> None:
        made = open_archive(tmp_path)
        sizes = []
        part = tmp_path / "2026-06-21" / "0001.part"
        for k in range(4):
            made.take(NOON + 10.0 * k, look(counts=k))
            sizes.append(part.stat().st_size)
        whole = part.read_bytes()
        for size in range(0, len(whole), 37):
            part.write_bytes(whole[:size])
            readable = sum(size >= s for s in sizes)
            assert len(archive.read_part(part)) == readable, size

    def test_the_next_start_makes_parquet_of_what_is_there(self, tmp_path: Path) -> None:
        made = open_archive(tmp_path)
        for k in range(3):
            made.take(NOON + 10.0 * k, look(counts=k))
        part = tmp_path / "2026-06-21" / "0001.part"
        part.write_bytes(part.read_bytes()[:-5])  # and nobody closed it
        again = open_archive(tmp_path)
        assert again.problem == ""
        assert [p.name for p in part.parent.iterdir()] == ["0001.parquet"]
        again.take(NOON + 40.0, look(counts=9))
        assert [r["primary"] for r in rows(tmp_path)[::3]] == [0, 1, 9]

    def test_a_crash_between_renaming_and_removing_doubles_nothing(self, tmp_path: Path) -> None:
        made = open_archive(tmp_path)
        made.take(NOON, look())
        part = tmp_path / "2026-06-21" / "0001.part"
        copy = part.read_bytes()
        made.close()
        open_archive(tmp_path)
        part.write_bytes(copy)
        (part.parent / "0002.part").write_bytes(b"")  # not even a header
        assert len(rows(tmp_path)) == 3
        open_archive(tmp_path)
        assert [p.name for p in part.parent.iterdir()] == ["0001.parquet"]
        assert len(rows(tmp_path)) == 3

    def test_a_full_disk_is_told_and_outlived(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        made = open_archive(tmp_path)
        made.take(NOON, look(counts=1))

        def full(_: int) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(archive.os, "fsync", full)
        made.take(NOON + 10.0, look(counts=2))
        assert "No space left on device" in made.problem
        monkeypatch.undo()
        # What was lost is made up for by a keyframe, in a new part.
        assert made.take(NOON + 20.0, look([2, 2, 2], [2, 2, 3])) == 3
        assert made.problem == ""
        assert len(list(tmp_path.glob("*/*.part"))) == 2
        last = rows(tmp_path, "SELECT * FROM telemetry ORDER BY time DESC, heliostat LIMIT 3")
        assert [r["primary"] for r in last] == [2, 2, 3]

    def test_a_folder_that_cannot_be(self, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        with pytest.raises(StoreError, match=r"telemetry .*: Not a directory"):
            open_archive(tmp_path / "file" / "x")


def test_the_caller_never_waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gate, sync = threading.Event(), archive.os.fsync
    monkeypatch.setattr(archive.os, "fsync", lambda file: (gate.wait(10.0), sync(file)))
    made = Telemetry(tmp_path, NAMES, STATES, TelemetrySettings(period=1.0))
    for k in range(100):
        made.take(NOON + k, look(counts=k))
    assert "its disk is too slow" in made.problem
    gate.set()
    made.close()
    monkeypatch.undo()
    written = [r["primary"] for r in rows(tmp_path)]
    assert written[:9] == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert len(written) < 300


def test_old_days_are_removed(tmp_path: Path) -> None:
    made = open_archive(tmp_path, days=2)
    (tmp_path / "notes.txt").write_text("stays")
    (tmp_path / "2026-xx-99").mkdir()
    for day in range(5):
        made.take(NOON + 86400.0 * day, look())
    made.close()
    left = sorted(p.name for p in tmp_path.iterdir())
    assert left == ["2026-06-23", "2026-06-24", "2026-06-25", "2026-xx-99", "notes.txt"]
    assert retain(tmp_path, 0, date(2026, 6, 25)) == ["2026-06-23", "2026-06-24"]


class TestQueries:
    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        folder = tmp_path / "it's"
        made = open_archive(folder, rows=6)
        for k in range(5):
            made.take(NOON + 10.0 * k, look([2, 0, 2 if k < 3 else 1], k))
        return folder

    def test_find_what_was_when(self, folder: Path) -> None:
        found = query(
            folder,
            "SELECT heliostat, max(time) AS last FROM telemetry WHERE state = ? GROUP BY ALL "
            "ORDER BY heliostat",
            ["TRACKING"],
        )
        assert found.to_pylist() == [
            {"heliostat": "A", "last": datetime(2026, 6, 21, 12, 0, 40)},  # noqa: DTZ001
            {"heliostat": "C", "last": datetime(2026, 6, 21, 12, 0, 20)},  # noqa: DTZ001
        ]

    @pytest.mark.parametrize(
        "sql",
        [
            "DROP VIEW telemetry",
            "COPY telemetry TO 'x.csv'",
            "SELECT 1; SELECT 2",
            "",
            "CREATE TABLE t AS SELECT 1",
            "SET threads = 1",
            "ATTACH 'x.db'",
            "INSTALL httpfs",
        ],
    )
    def test_only_read(self, folder: Path, sql: str) -> None:
        with pytest.raises(InputError, match="write a single SELECT"):
            query(folder, sql)

    @pytest.mark.parametrize(
        "sql",
        [
            "SELECT * FROM read_csv('/etc/hostname')",
            "SELECT * FROM '/etc/hostname'",
            "SELECT * FROM secret",
            "SELECT nothing FROM telemetry",
            "SELEC 1",
        ],
    )
    def test_see_nothing_else(self, folder: Path, sql: str) -> None:
        secret = query(folder, "SELECT 1 AS password")
        assert secret.num_rows == 1
        with pytest.raises(InputError, match=r"^query: [^\n]*$"):
            query(folder, sql)

    def test_need_an_archive(self, tmp_path: Path) -> None:
        with pytest.raises(StoreError, match="no such folder"):
            query(tmp_path / "none", "SELECT 1")
        (tmp_path / "empty").mkdir()
        assert rows(tmp_path / "empty") == []

    def test_a_damaged_file_is_told(self, folder: Path) -> None:
        next(iter(sorted(folder.glob("*/*.parquet")))).write_bytes(b"x" * 100)
        with pytest.raises(StoreError, match=r"0001\.parquet"):
            query(folder, "SELECT count(*) FROM telemetry")


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"period": 0.0}, r"the period \(0\.0 s\) must be above 0"),
        ({"period": 20.0, "keyframe": 10.0}, "at most the keyframe interval"),
        ({"deadband": -1}, "deadband .* not -1"),
        ({"rows": 0}, "rows 1 or more, .* 0$"),
    ],
)
def test_settings_that_cannot_be(wrong: dict[str, float], text: str) -> None:
    with pytest.raises(InputError, match=text):
        TelemetrySettings(**wrong)  # type: ignore[arg-type]


def test_only_its_user_may_read_the_archive(tmp_path: Path) -> None:
    before = os.umask(0o022)
    try:
        folder = tmp_path / "plant" / "telemetry"
        made = open_archive(folder, rows=2)
        made.take(NOON, look())
        made.take(NOON + 10.0, look(counts=9))
        open_archive(folder).take(NOON + 20.0, look())
    finally:
        os.umask(before)
    found = [tmp_path / "plant", *(tmp_path / "plant").rglob("*")]
    assert {p.suffix for p in found} >= {".parquet", ".part"}
    for place in found:
        assert place.stat().st_mode & 0o777 == (0o700 if place.is_dir() else 0o600), place
