"""Killed at any moment, disk full, disk read-only: nothing confirmed is lost."""

import os
import random
import shutil
import signal
import sqlite3
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import select, text

from heliotrope.plant.orders.audit import STOPPED
from heliotrope.store import audit, chain, tables
from heliotrope.store.database import Database
from heliotrope.store.keeper import Keeper
from heliotrope.store.records import Event, StoreError
from heliotrope.store.telemetry_query import query


class Loads:
    """A process that forks children, which may be killed."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("load.py"))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            # It uses the helpers of all tests, as pytest's own `pythonpath` lets this file do.
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        )
        assert self._read() == "ready"

    def start(self, line: str) -> int:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()
        return int(self._read())

    def ended(self) -> int:
        return int(self._read())

    def _read(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        assert line, "the loading process has ended"
        return line.strip()

    def close(self) -> None:
        self._process.communicate()


@pytest.fixture(scope="module")
def loads() -> Iterator[Loads]:
    made = Loads()
    yield made
    made.close()


def kill_at_random(
    loads: Loads, place: Path, seed: int, chance: random.Random, what: str = "write"
) -> list[str]:
    """Let a child write, kill it at a random moment; return what it told."""
    told = Path(f"{place}.told")
    told.unlink(missing_ok=True)
    child = loads.start(f"{what} {place} {seed}")
    if chance.random() < 0.8:
        # Most are killed while they write, some while they open the store.
        wanted, until = chance.randint(1, 40), time.monotonic() + 120.0
        while not told.exists() or told.read_bytes().count(b"\n") < wanted:
            assert time.monotonic() < until, "the child does nothing"
            time.sleep(0.005)
    time.sleep(chance.uniform(0.0, 0.05))
    os.kill(child, signal.SIGKILL)
    assert loads.ended() == -signal.SIGKILL
    lines = told.read_text().splitlines(keepends=True) if told.exists() else []
    return [line.strip() for line in lines if line.endswith("\n")]


class Promises:
    """What the children told, all together."""

    def __init__(self) -> None:
        self.events: set[str] = set()
        self.versions: dict[str, int] = {}
        self.begun: set[str] = set()
        self.finished: set[str] = set()
        self.points: tuple[float, float] | None = None
        self.most = self.points_count = 0

    def take(self, seed: int, lines: list[str]) -> None:
        for line in lines:
            what, *values = line.split()
            if what == "confirmed":
                k, number, name, version = values
                self.events |= {f"{seed}-{i}" for i in range(int(k) + 1)}
                self.most = max(self.most, int(number))
                self.versions[name] = int(version)
            elif what == "begun":
                self.begun.add(values[0])
            elif what == "finished":
                self.finished.add(values[0])
            elif what == "points":
                self.points = (float(values[0]), float(values[1]))
                self.points_count = int(values[2])

    def check(self, place: Path) -> None:
        with closing(sqlite3.connect(place / "store.sqlite")) as raw:
            assert raw.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
            assert raw.execute("PRAGMA foreign_key_check").fetchall() == []
        keeper = Keeper(place)
        try:
            found = {e.text for e in keeper.events(10**6)}
            assert self.events <= found
            sighted = keeper.sightings()
            numbers = sighted.identities
            # All up to the last confirmed, and nothing twice.
            assert len(set(numbers)) == len(numbers)
            assert set(range(1, self.most + 1)) <= set(numbers.tolist())
            latest = keeper.latest_calibrations()
            assert all(latest[name].version >= v for name, v in self.versions.items())
            with keeper.database.reading() as connection:
                records = {r.identity: r for r in audit.entries(connection, 10**6)}
                points = audit.points(connection).get("AIM", {})
                chain.verify(connection)
            assert self.begun <= set(records)
            assert all(records[i].result in ("done", STOPPED) for i in self.finished)
            if self.points is not None:
                assert max((p[0], p[1]) for p in points.values()) >= self.points
                assert len(points) >= self.points_count
        finally:
            keeper.close()


def kill_many(loads: Loads, place: Path, kills: int) -> Promises:
    chance, promises = random.Random(7), Promises()
    for seed in range(1, kills + 1):
        promises.take(seed, kill_at_random(loads, place, seed, chance))
        if seed % 10 == 0 or seed == kills:
            promises.check(place)
    return promises


def check_load(promises: Promises, place: Path, kills: int) -> None:
    # The kills must have met real work, or the test shows nothing.
    assert len(promises.events) > 5 * kills
    assert len(promises.begun) > kills
    assert promises.points is not None
    rows = query(
        place / "telemetry", "SELECT count(*) n, count(DISTINCT heliostat) h FROM telemetry"
    )
    assert rows.to_pylist()[0]["n"] > 5 * kills
    assert rows.to_pylist()[0]["h"] == 50


def test_kills_lose_nothing(loads: Loads, tmp_path: Path) -> None:
    check_load(kill_many(loads, tmp_path / "data", 6), tmp_path / "data", 6)


@pytest.mark.slow
def test_two_hundred_kills_lose_nothing(loads: Loads, tmp_path: Path) -> None:
    check_load(kill_many(loads, tmp_path / "data", 200), tmp_path / "data", 200)


def kill_plants(loads: Loads, place: Path, kills: int) -> dict[str, int]:
    """Kill a whole plant at random moments; return how much was promised of each kind."""
    chance, counts = random.Random(11), dict.fromkeys(("accepted", "event", "version", "point"), 0)
    accepted, events = set[str](), set[str]()
    versions, points = dict[str, int](), dict[str, float]()
    for seed in range(1, kills + 1):
        for line in kill_at_random(loads, place, seed, chance, "plant"):
            what, *values = line.split()
            counts[what] = counts.get(what, 0) + 1
            if what == "accepted":
                accepted.add(values[0])
            elif what == "event":
                events.add(values[0])
            elif what == "version":
                versions[values[0]] = int(values[1])
            elif what == "point":
                points[values[0]] = float(values[1])
        if seed % 10 and seed != kills:
            continue
        with closing(Keeper(place)) as keeper:
            with keeper.database.reading() as connection:
                records = {r.identity for r in audit.entries(connection, 10**6)}
                kept = audit.points(connection).get("STANDBY", {})
                chain.verify(connection)
            assert accepted <= records
            assert events <= {e.text for e in keeper.events(10**6)}
            latest = keeper.latest_calibrations()
            assert all(latest[name].version >= v for name, v in versions.items())
            # What was told last, or one that came after it and was not told any more.
            assert points.keys() <= kept.keys()
            assert all(25.0 <= kept[name][0] <= 26.0 for name in points)
    return counts


def test_a_plant_that_is_killed_starts_again(loads: Loads, tmp_path: Path) -> None:
    counts = kill_plants(loads, tmp_path / "data", 2)
    assert counts["accepted"] > 0
    assert counts["open"] > 0


@pytest.mark.slow
def test_two_hundred_kills_of_a_plant_lose_nothing(loads: Loads, tmp_path: Path) -> None:
    counts = kill_plants(loads, tmp_path / "data", 200)
    assert min(counts.values()) > 50, counts


def test_a_full_disk_is_told_and_outlived(loads: Loads, tmp_path: Path) -> None:
    place = tmp_path / "data"
    loads.start(f"limit {place}")
    assert loads.ended() == 0
    full, audited, after = Path(f"{place}.told").read_text().splitlines()
    assert "cannot be written" in full
    assert audited == "audit AuditError"
    assert "problem '' backlog 0" in after
    count = int(full.split()[2])
    with closing(Keeper(place)) as keeper:
        # Everything that was taken is there, what came while it was full too.
        assert len(keeper.events(10**6)) == count + 1


def test_a_disk_that_becomes_read_only(tmp_path: Path) -> None:
    class Remounted(Database):
        read_only = False

        def connect(self):  # type: ignore[no-untyped-def]
            connection = super().connect()
            if self.read_only:
                connection.execute(text("PRAGMA query_only=ON"))
                connection.commit()
            return connection

    keeper = Keeper(tmp_path)
    database = keeper.database
    database.__class__ = Remounted
    keeper.writer._drop_connection()
    database.read_only = True  # type: ignore[attr-defined]
    keeper.record_event(Event(1.0, "test", "later"))
    with pytest.raises(StoreError, match=r"attempt to write a readonly database.*check the disk"):
        keeper.writer.confirmed().result(10.0)
    assert keeper.events() == []
    database.read_only = False  # type: ignore[attr-defined]
    keeper.writer.confirmed().result(10.0)
    assert [e.text for e in keeper.events()] == ["later"]
    keeper.close()


def test_a_read_only_folder_is_refused_in_one_line() -> None:
    # Not in pytest's folder: that is closed to the other user that root has to become.
    folder = Path(tempfile.mkdtemp(prefix="store"))
    program = (
        "import os, pathlib, sys\n"
        "from heliotrope.errors import HeliotropeError\n"
        "from heliotrope.store.keeper import Keeper\n"
        "folder = pathlib.Path(sys.argv[1])\n"
        "Keeper(folder).close()\n"
        "for path in (*folder.iterdir(), folder):\n"
        "    path.chmod(0o555 if path.is_dir() else 0o444)\n"
        "if os.geteuid() == 0:\n    os.setuid(65534)\n"
        "try:\n    Keeper(folder)\n"
        "except HeliotropeError as error:\n    print(error)\n"
    )
    try:
        done = subprocess.run(
            [sys.executable, "-c", program, str(folder)], capture_output=True, text=True, check=True
        )
    finally:
        folder.chmod(stat.S_IRWXU)
        shutil.rmtree(folder)
    assert "Permission denied; choose a writable folder" in done.stdout
    assert done.stdout.count("\n") == 1


def test_a_migration_that_is_cut_leaves_nothing(tmp_path: Path) -> None:
    database = Database(tmp_path)
    with database.connect() as connection, connection.begin():
        # A table of the same name in the way, among the last that are made.
        connection.execute(text("CREATE TABLE visit (x INTEGER)"))
    with pytest.raises(StoreError, match="cannot be set up"):
        database.prepare()
    assert database.revision() == ""
    with database.reading() as connection:
        names = connection.scalars(text("SELECT name FROM sqlite_master WHERE type = 'table'"))
        assert set(names) == {"visit"}
    database.close()


def test_numbers_go_on_behind_what_is_there(tmp_path: Path) -> None:
    keeper = Keeper(tmp_path)
    keeper.record_event(Event(1.0, "test", "first"))
    keeper.close()
    keeper = Keeper(tmp_path)
    keeper.record_event(Event(1.0, "test", "second"))
    keeper.close()
    with Database(tmp_path).reading() as connection:
        numbers = connection.scalars(select(tables.event.c.number)).all()
    np.testing.assert_array_equal(sorted(numbers), [1, 2])
