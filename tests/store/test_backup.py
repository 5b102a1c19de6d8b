"""Backup, restore and migration, of SQLite and PostgreSQL, and from one to the other."""

import hashlib
import json
import sqlite3
import threading
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from pyotp import TOTP
from sqlalchemy import select, text

from heliotrope.calibration.record import CalibrationOutcome, HeliostatCalibration
from heliotrope.calibration.sightings import Sightings
from heliotrope.errors import FormatError
from heliotrope.safety import Alarm, Severity
from heliotrope.store import backup as backups
from heliotrope.store import chain, tables
from heliotrope.store.audit import begin, change_points, points
from heliotrope.store.database import HEAD, Database
from heliotrope.store.factors import KEY_FILE
from heliotrope.store.keeper import Keeper
from heliotrope.store.records import (
    AuditEntry,
    CampaignEntry,
    Event,
    FieldPoint,
    FlightEntry,
    Kind,
    LearningEntry,
    Lockout,
    Outlook,
    PlantFigures,
    StoreError,
    TimetableRecord,
    VisitEntry,
)
from heliotrope.store.telemetry import Look, Telemetry
from heliotrope.store.telemetry_query import query

NOW = datetime(2026, 6, 21, 12, tzinfo=UTC)
NAMES = ("A", "B", "C")


def fill(keeper: Keeper, seen: Sightings, key_file: Path) -> None:
    """Put something into every table that a plant writes."""
    numbers = keeper.record_sightings(NAMES, seen, target="west")
    keeper.record_calibration(
        HeliostatCalibration(
            "A",
            1.0,
            ("tilt_north",),
            np.array([1 / 3]),
            np.eye(1),
            np.ones(1),
            sightings=numbers[:2],
            residual_before=np.ones((2, 2)),
            residual_after=np.zeros((2, 2)),
            version=1,
        )
    )
    keeper.record(VisitEntry("A", "west", 1.0, 2.0, CalibrationOutcome.CALIBRATED))
    keeper.record(CampaignEntry("spring", 1.0))
    keeper.record(FlightEntry("C1-1", 1.0, "anna", "{}"))
    keeper.record(LearningEntry("field", 1, 1.0, "anna", 3, 10, 0.5, "{}"))
    keeper.record(Outlook(1.0, 2, 3e-4, None, (FieldPoint(1.0, 1e-3, 2e-3),), "not today"))
    keeper.record(TimetableRecord(1.0, "anna", "[]"))
    keeper.record(PlantFigures(1.0, {"power.R": 2e6}))
    keeper.record_event(Event(1.0, "test", "hello", values={"x": float("nan")}))
    keeper.record_alarm(Alarm("wind", "", Severity.ALARM, "too much"), 1.0)
    keeper.hold([Lockout(Kind.HELIOSTAT, "B", "anna", "broken", 5.0)])
    keeper.writer.do(lambda c: begin(c, AuditEntry("p-1", "anna", "operator", "AIM", "t", (1.0,))))
    keeper.writer.do(lambda c: change_points(c, {"AIM": {"A": (1.0, 2.0, 3.0)}}, {}))
    keeper.writer.do(lambda c: c.execute(tables.about.insert().values(name="plant", value="x")))
    keeper.people.add("anna", "hash", "engineer", 1.0)
    keeper.people.add("ben", "hash", "operator", 1.0, due=True)
    keeper.people.open_session("anna", 1.0, 1e12)
    keeper.people.add_token("anna", "report", "viewer", 1.0)
    factors = keeper.people.factors(key_file)
    secret = factors.begin("anna", 1e9)
    factors.confirm("anna", TOTP(secret).at(10**9), 1e9)
    keeper.writer.confirmed().result(10.0)


def content(database: Database) -> dict[str, list[tuple]]:
    with database.reading() as connection:
        return {
            table.name: [
                tuple(row) for row in connection.execute(select(table).order_by(*table.primary_key))
            ]
            for table in tables.metadata.sorted_tables
        }


def write_telemetry(folder: Path) -> None:
    made = Telemetry(folder, NAMES, ("STOWED",), inline=True)
    zeros = np.zeros(3, np.uint8)
    made.take(1.8e9, Look(zeros, zeros, zeros.astype(np.uint16), np.zeros((3, 2), np.int32), zeros))
    made.close()


@pytest.fixture(params=["sqlite", "postgresql"])
def other(request: pytest.FixtureRequest, tmp_path: Path) -> str | Path:
    """Where a backup is restored to."""
    if request.param == "sqlite":
        return tmp_path / "restored"
    return f"{request.getfixturevalue('server')}&options=-csearch_path%3D{_schema(request)}"


def _schema(request: pytest.FixtureRequest) -> str:
    import psycopg

    name = f"other{abs(hash(request.node.name))}"
    with psycopg.connect(request.getfixturevalue("server"), autocommit=True) as connection:
        connection.execute(f"CREATE SCHEMA {name}")
    return name


def test_everything_comes_back_wherever_it_goes(
    keeper: Keeper, seen: Sightings, other: str | Path, tmp_path: Path
) -> None:
    fill(keeper, seen, tmp_path / KEY_FILE)
    write_telemetry(tmp_path / "live")
    made = backups.backup(keeper.database, tmp_path / "backup", NOW, tmp_path / "live")
    assert made.made == "2026-06-21T12:00:00+00:00"
    found = backups.restore(tmp_path / "backup", other, NOW, tmp_path / "archive")
    assert (found.revision, found.size) == (HEAD, made.size)
    # The secrets of second factors cannot be had from a backup.
    key = (tmp_path / KEY_FILE).read_bytes().strip()
    files = [file for file in (tmp_path / "backup").rglob("*") if file.is_file()]
    assert not any(file.name == KEY_FILE or key in file.read_bytes() for file in files)
    restored = Database(other)
    empty = [name for name, rows in content(keeper.database).items() if not rows]
    assert empty == ["plan"], "the one table that nothing writes"
    before, after = content(keeper.database), content(restored)
    for changed in ("hold", "assigned_point"):
        assert set(before.pop(changed)) < set(after.pop(changed))
    for changed in ("event", "event_link", "account_link"):
        assert after.pop(changed)[:-1] == before.pop(changed)
    # Nobody is signed in there.
    for changed in ("session", "api_token"):
        assert before.pop(changed)
        assert not after.pop(changed)
    (name, *_, used), (same, *_, later) = (
        *before.pop("second_factor"),
        *after.pop("second_factor"),
    )
    assert (name, used < later) == (same, True)
    assert after == before
    restored.close()
    assert query(tmp_path / "archive", "SELECT * FROM telemetry").num_rows == 3
    again = Keeper(other)
    assert again.people.account("anna") is not None
    assert again.record_sightings(NAMES, seen).min() == len(seen) + 1
    again.close()


def test_a_backup_knows_that_it_is_one(
    keeper: Keeper, seen: Sightings, other: str | Path, tmp_path: Path
) -> None:
    fill(keeper, seen, tmp_path / KEY_FILE)
    backups.backup(keeper.database, tmp_path / "backup", NOW)
    assert [hold.kind for hold in keeper.holds()] == ["heliostat"]
    backups.restore(tmp_path / "backup", other, NOW)
    again = Keeper(other)
    own, lock = sorted(again.holds(), key=lambda hold: hold.kind)
    assert own.who == "anna"
    assert (lock.kind, lock.name, lock.who) == ("tower", "tower", backups.OWNER)
    assert "a backup of 21 Jun 2026 12:00 UTC" in lock.reason
    with again.database.reading() as connection:
        assert points(connection) == {kind: {"A": (1.0, 2.0, 3.0)} for kind in ("AIM", "AIM-1")}
    # A backup of it, made before anybody has confirmed it, holds one such lock, the newer.
    later = NOW.replace(hour=13)
    backups.backup(again.database, tmp_path / "second", later)
    again.close()
    backups.restore(tmp_path / "second", tmp_path / "third", NOW)
    third = Keeper(tmp_path / "third")
    assert [hold.since for hold in third.holds() if hold.who == backups.OWNER] == [
        later.timestamp()
    ]
    third.close()


def test_a_restore_lets_nobody_in_and_is_recorded(
    keeper: Keeper, other: str | Path, tmp_path: Path
) -> None:
    people, at = keeper.people, NOW.timestamp()
    people.add("anna", "hash", "engineer", at)
    people.add("ben", "hash", "operator", at)
    token = people.add_token("anna", "report", "viewer", at)[1]
    people.open_session("ben", at, 36_000.0)
    factors = people.factors(tmp_path / KEY_FILE)
    secret = TOTP(factors.begin("anna", at - 600.0))
    factors.confirm("anna", secret.at(int(at) - 600), at - 600.0)
    backups.backup(keeper.database, tmp_path / "backup", NOW)
    with Database(tmp_path / "backup" / "store.sqlite") as copied, copied.reading() as connection:
        assert not connection.execute(select(tables.session)).all()
        assert not connection.execute(select(tables.api_token)).all()
    # After the backup the account is disabled, and a code used.
    people.change("ben", at + 10.0, disabled=True)
    hour = NOW.replace(hour=13)
    code = secret.at(int(hour.timestamp()))
    assert factors.check("anna", code, hour.timestamp()) is not None
    backups.restore(tmp_path / "backup", other, hour, who="carl on this machine")
    again = Keeper(other)
    assert again.people.token(token, at + 20.0) is None
    assert again.people.valid(at + 20.0).sessions == ()
    later = again.people.factors(tmp_path / KEY_FILE)
    for seconds in (0.0, 30.0):
        assert later.check("anna", code, hour.timestamp() + seconds) is None
    new = hour.timestamp() + 90.0
    assert later.check("anna", secret.at(int(new)), new) is not None
    (event,) = [event for event in again.events() if event.source == "security"]
    assert event.severity == "warning"
    assert event.text == (
        "carl on this machine: restored the backup of 2026-06-21T12:00:00+00:00: all sessions and "
        "tokens ended, accounts and roles are as they were then; enabled: anna, ben"
    )
    with again.database.reading() as connection:
        chain.verify(connection)
    again.close()


def test_a_backup_of_an_earlier_program_is_migrated(tmp_path: Path) -> None:
    keeper = Keeper(tmp_path / "data", inline=True)
    keeper.people.add("anna", "hash", "engineer", 1.0)
    token = keeper.people.add_token("anna", "report", "viewer", 1.0)[1]
    backups.backup(keeper.database, tmp_path / "backup", NOW)
    keeper.close()
    file = tmp_path / "backup" / "store.sqlite"
    with closing(sqlite3.connect(file)) as raw:
        raw.execute("DROP TABLE account_link")
        raw.execute("DROP TABLE figures")
        raw.execute("UPDATE alembic_version SET version_num = '0011'")
        row = (
            hashlib.sha256(token.encode()).hexdigest(),
            "anna",
            "report",
            "viewer",
            1.0,
            None,
            None,
        )
        raw.execute("INSERT INTO api_token VALUES (?, ?, ?, ?, ?, ?, ?)", row)
        raw.commit()
    manifest = json.loads((tmp_path / "backup" / "manifest.json").read_text())
    manifest |= {"revision": "0011", "files": {"store.sqlite": backups.checksum(file)}}
    (tmp_path / "backup" / "manifest.json").write_text(json.dumps(manifest))
    backups.restore(tmp_path / "backup", tmp_path / "new", NOW)
    again = Keeper(tmp_path / "new", inline=True)
    assert again.people.token(token, 2.0) is None
    with again.database.reading() as connection:
        chain.verify(connection)
    again.close()
    manifest["revision"] = "9999"
    (tmp_path / "backup" / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(StoreError, match=f"revision 9999, this program knows {HEAD}; update"):
        backups.restore(tmp_path / "backup", tmp_path / "third", NOW)
    assert not (tmp_path / "third").exists()


def test_a_link_in_the_archive_is_not_followed(
    tmp_path: Path, opened: Callable[..., Keeper]
) -> None:
    keeper = opened(tmp_path / "data")
    write_telemetry(tmp_path / "data" / "telemetry")
    (tmp_path / "secret.parquet").write_text("secret")
    day = tmp_path / "data" / "telemetry" / "2026-06-21"
    day.mkdir()
    (day / "1.parquet").symlink_to(tmp_path / "secret.parquet")
    (tmp_path / "data" / "telemetry" / "2026-06-22").symlink_to(tmp_path)
    backups.backup(keeper.database, tmp_path / "backup", NOW, tmp_path / "data" / "telemetry")
    copied = [
        p.read_bytes() for p in (tmp_path / "backup" / "telemetry").rglob("*.*") if p.is_file()
    ]
    assert copied
    assert b"secret" not in copied


def test_one_state_while_the_plant_writes(keeper: Keeper, tmp_path: Path) -> None:
    """Two records that belong together are both in a backup, or neither is."""
    stop = threading.Event()

    def pair(k: int) -> None:
        def work(connection: object) -> None:
            for name in ("left", "right"):
                row = {"name": f"{name} {k}", "value": ""}
                connection.execute(tables.about.insert().values(row))  # type: ignore[attr-defined]

        keeper.writer.do(work)

    def write() -> None:
        k = 0
        while not stop.is_set():
            pair(k := k + 1)

    writing = threading.Thread(target=write)
    writing.start()
    try:
        for i in range(3):
            backups.backup(keeper.database, tmp_path / f"b{i}", NOW)
    finally:
        stop.set()
        writing.join()
    counts = []
    for i in range(3):
        with closing(sqlite3.connect(tmp_path / f"b{i}" / "store.sqlite")) as raw:
            names = [name for (name,) in raw.execute("SELECT name FROM about")]
        lefts = {n.split()[1] for n in names if n.startswith("left")}
        assert lefts == {n.split()[1] for n in names if n.startswith("right")}
        counts.append(len(lefts))
    assert counts == sorted(counts)
    assert counts[-1] > 0


class TestRefusals:
    @pytest.fixture
    def made(self, tmp_path: Path, opened: Callable[..., Keeper], seen: Sightings) -> Path:
        keeper = opened(tmp_path / "data")
        fill(keeper, seen, tmp_path / KEY_FILE)
        backups.backup(keeper.database, tmp_path / "backup", NOW)
        return tmp_path / "backup"

    def test_nothing_is_overwritten(self, made: Path, tmp_path: Path) -> None:
        with pytest.raises(StoreError, match=r"backup .*: this folder already exists"):
            backups.backup(Database(tmp_path / "data"), made, NOW)
        backups.restore(made, tmp_path / "new", NOW)
        with pytest.raises(StoreError, match="it already exists"):
            backups.restore(made, tmp_path / "new", NOW)

    def test_not_under_a_plant_that_runs(self, made: Path, tmp_path: Path) -> None:
        with pytest.raises(StoreError, match="another process writes to it"):
            backups.restore(made, tmp_path / "data", NOW)

    def test_a_damaged_backup(self, made: Path, tmp_path: Path) -> None:
        data = bytearray((made / "store.sqlite").read_bytes())
        data[len(data) // 2] ^= 1
        (made / "store.sqlite").write_bytes(data)
        with pytest.raises(FormatError, match=r"store\.sqlite: its checksum differs"):
            backups.restore(made, tmp_path / "new", NOW)
        assert not (tmp_path / "new").exists()

    @pytest.mark.parametrize(
        ("change", "wanted"),
        [
            (lambda m: None, "this is not the manifest"),
            (lambda m: m["files"].clear(), r"store\.sqlite is not in it"),
            (lambda m: m["files"].update({"../x": "0"}), "lies outside the backup"),
            (lambda m: m["files"].update({"gone": "0"}), "the file is missing"),
        ],
        ids=["no manifest", "no store", "outside", "missing"],
    )
    def test_a_manifest_that_is_none(
        self, made: Path, tmp_path: Path, change: Callable[[dict], object], wanted: str
    ) -> None:
        path = made / "manifest.json"
        manifest = json.loads(path.read_text())
        change(manifest)
        path.write_text("[]" if wanted.startswith("this") else json.dumps(manifest))
        with pytest.raises(FormatError, match=wanted):
            backups.restore(made, tmp_path / "new", NOW)

    @pytest.mark.parametrize("what", ["file", "folder", "store"])
    def test_a_link_in_a_backup(self, made: Path, tmp_path: Path, what: str) -> None:
        """Restored by root, it would carry any file of the machine into the plant's folder."""
        other = tmp_path / "other"
        other.mkdir()
        (other / "secret.parquet").write_text("secret")
        if what == "store":
            (made / "store.sqlite").rename(other / "store.sqlite")
            (made / "store.sqlite").symlink_to(other / "store.sqlite")
        else:
            (made / "telemetry").mkdir()
            to = other if what == "folder" else other / "secret.parquet"
            (made / "telemetry" / "2026-06-21").symlink_to(to)
        with pytest.raises(FormatError, match="this is a link, and backups contain no links"):
            backups.restore(made, tmp_path / "new", NOW, tmp_path / "archive")
        assert not (tmp_path / "archive").exists()

    def test_no_backup_and_no_store(self, tmp_path: Path) -> None:
        with pytest.raises(FormatError, match="specify the folder of a backup"):
            backups.restore(tmp_path, tmp_path / "new", NOW)
        with pytest.raises(StoreError, match="no store here"):
            backups.backup(Database(tmp_path / "none"), tmp_path / "backup", NOW)
        assert not (tmp_path / "none").exists()

    def test_a_disk_that_fails_leaves_no_half_backup(
        self, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def full(path: Path) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(backups, "_sync", full)
        with pytest.raises(StoreError, match=r"it cannot be made \(No space left on device"):
            backups.backup(Database(tmp_path / "data"), tmp_path / "second", NOW)
        assert sorted(p.name for p in tmp_path.iterdir()) == ["backup", "data", KEY_FILE]


def test_hashes_are_not_for_everybody(
    tmp_path: Path, opened: Callable[..., Keeper], seen: Sightings
) -> None:
    keeper = opened(tmp_path / "data")
    fill(keeper, seen, tmp_path / KEY_FILE)
    backups.backup(keeper.database, tmp_path / "backup", NOW)
    backups.restore(tmp_path / "backup", tmp_path / "new", NOW)
    files = [p for p in tmp_path.rglob("store.sqlite*") if p.is_file()]
    assert len(files) >= 5  # with the log of the open one, and locks
    assert [p for p in files if p.stat().st_mode & 0o007] == []


def test_the_summary_counts(keeper: Keeper, seen: Sightings, tmp_path: Path) -> None:
    fill(keeper, seen, tmp_path / KEY_FILE)
    found = backups.summary(keeper.database)
    assert found["revision"] == HEAD
    assert found["rows"]["sighting"] == 10
    assert found["audit_without_result"] == 1
    assert found["first_sighting"] == seen.time.min()
    assert found["last_sighting"] == seen.time.max()


class TestMigrations:
    def test_the_tables_are_those_of_the_program(self, keeper: Keeper) -> None:
        from alembic.autogenerate import compare_metadata
        from alembic.migration import MigrationContext

        with keeper.database._writer.connect() as connection:
            differences = compare_metadata(MigrationContext.configure(connection), tables.metadata)
        assert differences == []

    def test_the_newest_step_is_the_one_that_is_asked_for(self) -> None:
        from alembic.config import Config
        from alembic.script import ScriptDirectory

        config = Config()
        folder = Path(backups.__file__).with_name("migrations")
        config.set_main_option("script_location", str(folder))
        assert ScriptDirectory.from_config(config).get_current_head() == HEAD

    def test_a_store_of_another_revision_is_told(self, keeper: Keeper) -> None:
        for revision, advice in (("0000", "run `heliotrope store migrate`"), ("9999", "update")):
            keeper.writer.do(
                lambda c, r=revision: c.execute(
                    text("UPDATE alembic_version SET version_num = :r"), {"r": r}
                )
            )
            with pytest.raises(StoreError, match=f"have revision {revision}.*{advice}"):
                keeper.database.require()

    def test_nothing_to_do(self, keeper: Keeper, place: str | Path) -> None:
        assert backups.migrate(place) == (HEAD, None)

    def test_an_old_store_is_copied_first(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        Keeper(tmp_path).close()
        steps = []
        monkeypatch.setattr(backups, "HEAD", "9999")
        monkeypatch.setattr(Database, "migrate", lambda self: steps.append(self.locked))
        before, copy = backups.migrate(tmp_path)
        assert (before, steps) == (HEAD, [True])
        assert copy == tmp_path / f"store.before-{HEAD}.sqlite"
        assert content(Database(copy)) == content(Database(tmp_path))
