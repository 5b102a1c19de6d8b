"""The sightings behind every version of a heliostat's parameters, on SQLite and on PostgreSQL."""

import asyncio
from collections.abc import Callable
from pathlib import Path

import numpy as np
from alembic import command
from alembic.config import Config
from sqlalchemy import func, insert, select, text

from heliotrope.calibration.record import HeliostatCalibration
from heliotrope.calibration.sightings import Sightings, sightings
from heliotrope.store import _rows as rows
from heliotrope.store import backup, tables
from heliotrope.store.database import Database
from heliotrope.store.keeper import Keeper

COUNT = 40
NAMES = ("A", "B")
#: Every field that rests on the sightings.
FIELDS = ("sightings", "left_out", "residual_before", "residual_after")


def seen() -> Sightings:
    """Sightings 1 to 40, all of the first heliostat."""
    one = np.ones((COUNT, 3))
    return sightings([0] * COUNT, np.ones((COUNT, 2)), one, one, time=np.arange(float(COUNT)))


def history(heliostat: str, seed: int) -> list[HeliostatCalibration]:
    """Versions of which each adds sightings; some are left out, come back, or are forgotten."""
    rng, made, behind = np.random.default_rng(seed), [], dict[int, bool]()
    number, versions = 0, np.cumsum(rng.integers(1, 3, 15))
    for version in versions.tolist():
        for _ in range(rng.integers(0, 4)):
            number += 1
            behind[number] = True
        for one in [n for n in behind if rng.random() < 0.1]:
            behind[one] = not behind[one]
        for one in [n for n in behind if rng.random() < 0.03]:
            del behind[one]
        used = np.array([n for n, good in behind.items() if good], np.int64)
        missed = np.outer(version + used / 1000.0, [1.0, -1.0])
        record = HeliostatCalibration(
            heliostat,
            float(version),
            ("tilt_north",),
            np.zeros(1),
            np.eye(1),
            np.ones(1),
            sightings=used,
            left_out=np.array([n for n, good in behind.items() if not good], np.int64),
            residual_before=missed,
            residual_after=2.0 * missed,
            version=version,
        )
        made.append(record)
    return made


def assert_recovered(found: list[HeliostatCalibration], made: list[HeliostatCalibration]) -> None:
    """Compare the sightings of all versions; what they missed by where they are new, else NaN."""
    assert [one.version for one in found] == [one.version for one in made]
    before: set[int] = set()
    for one, wanted in zip(found, made, strict=True):
        np.testing.assert_array_equal(one.sightings, wanted.sightings)
        np.testing.assert_array_equal(one.left_out, wanted.left_out)
        new = np.array([n not in before for n in wanted.sightings.tolist()], np.bool_)[:, None]
        for name in FIELDS[2:]:
            whole = getattr(wanted, name)
            np.testing.assert_array_equal(getattr(one, name), np.where(new, whole, np.nan))
        before = set(wanted.sightings.tolist())


def test_each_version_has_its_own(place: str | Path, opened: Callable[..., Keeper]) -> None:
    first, second = history("A", 1), history("B", 2)
    assert any(len(one.left_out) for one in first)
    keeper = opened(place)
    keeper.record_sightings(NAMES, seen())
    for one, other in zip(first[:9], second[:9], strict=True):
        keeper.record_calibration(one)
        keeper.record_calibration(other)
    keeper.close()
    keeper = opened(place)  # the plant was started again
    for one in (*first[9:], *second[9:]):
        keeper.record_calibration(one)
    asyncio.run(keeper.confirm())
    assert not keeper.refused
    assert_recovered(keeper.calibration_history("A"), first)
    assert_recovered(keeper.calibration_history("B"), second)


def test_versions_of_the_same_sightings_take_no_rows(keeper: Keeper) -> None:
    keeper.record_sightings(NAMES, seen())
    for version in range(1, COUNT + 1):
        record = HeliostatCalibration(
            "A",
            float(version),
            ("tilt_north",),
            np.zeros(1),
            np.eye(1),
            np.ones(1),
            sightings=np.arange(1, version + 1),
            residual_before=np.zeros((version, 2)),
            residual_after=np.zeros((version, 2)),
            version=version,
        )
        keeper.record_calibration(record)
    asyncio.run(keeper.confirm())
    with keeper.database.reading() as connection:
        count = connection.scalar(select(func.count()).select_from(tables.parameter_sighting))
    assert count == COUNT, "one for each sighting, not for each of each version"


def test_an_old_store_keeps_what_is_behind_its_versions(
    place: str | Path, opened: Callable[..., Keeper]
) -> None:
    """Before, each version had a row for each of its sightings."""
    made = {name: history(name, seed) for seed, name in enumerate(NAMES, 1)}
    if isinstance(place, Path):
        place.mkdir(mode=0o700)
    database, config = Database(place), Config()
    folder = Path(backup.__file__).with_name("migrations")
    config.set_main_option("script_location", str(folder))
    with database._writer.connect() as connection, connection.begin():
        config.attributes["connection"] = connection
        command.upgrade(config, "0008")
        numbers = np.arange(1, COUNT + 1)
        kept = rows.sighting_rows(numbers, NAMES, seen(), "camera_target", "", "")
        rows.insert(connection, tables.sighting, kept)
        for record in (*made["A"], *made["B"]):
            row = rows.row_of(tables.parameter_version, record)
            connection.execute(insert(tables.parameter_version), [row])
            _put_behind(connection, record)
    database.migrate()
    database.close()
    keeper = opened(place)
    for name, versions in made.items():
        assert_recovered(keeper.calibration_history(name), versions)
        record, t = versions[-1], tables.parameter_sighting.c
        with keeper.database.reading() as connection:
            query = select(func.count()).where(t.heliostat == name, t.until.is_(None))
            assert connection.scalar(query) == len(record.sightings) + len(record.left_out)


def _put_behind(connection: object, record: HeliostatCalibration) -> None:
    """Write the rows that a version had before."""
    nothing = np.full((len(record.left_out), 2), None)
    before = np.concatenate([record.residual_before, nothing])
    after = np.concatenate([record.residual_after, nothing])
    numbers = (*record.sightings.tolist(), *record.left_out.tolist())
    for spot, number in enumerate(numbers):
        values = {
            "heliostat": record.heliostat,
            "version": record.version,
            "place": spot,
            "sighting": number,
            "before_right": before[spot, 0],
            "before_above": before[spot, 1],
            "after_right": after[spot, 0],
            "after_above": after[spot, 1],
            "used": spot < len(record.sightings),
        }
        columns, marks = ", ".join(values), ", ".join(f":{name}" for name in values)
        connection.execute(  # type: ignore[attr-defined]
            text(f"INSERT INTO parameter_sighting ({columns}) VALUES ({marks})"), values
        )
