"""The format of a store: rows written before read back the same, and are written the same."""

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.store import old_store

from heliotrope.store import audit
from heliotrope.store.keeper import Keeper
from heliotrope.store.records import AlarmEntry, Kind, Lockout


@pytest.fixture
def old(place: str | Path, opened: Callable[..., Keeper]) -> Keeper:
    """A store whose rows an earlier program wrote."""
    first = opened(place)
    first.close()
    old_store.put_raw_rows(first.database, old_store.written(first.database))
    return opened(place)


def assert_same(found: Any, wanted: Any) -> None:
    """Compare records field by field; NaN is like NaN."""
    assert len(found) == len(wanted)
    for a, b in zip(found, wanted, strict=True):
        assert type(a) is type(b)
        for field in fields(b):
            x, y = getattr(a, field.name), getattr(b, field.name)
            assert isinstance(x, type(y)), field.name
            np.testing.assert_equal(x, y, err_msg=field.name)


def test_rows_are_written_as_before(keeper: Keeper) -> None:
    old_store.fill(keeper)
    assert not keeper.refused
    found = old_store.raw_rows(keeper.database)
    assert found == old_store.written(keeper.database)


def test_sightings_and_calibrations_read_back(old: Keeper) -> None:
    seen = old.sightings()
    assert (set(seen.names), set(seen.campaigns)) == (set(old_store.NAMES), {"spring"})
    row = np.array([old_store.NAMES.index(name) for name in seen.names])[seen.sightings.heliostat]
    back = replace(seen.sightings, heliostat=row).take(np.argsort(seen.identities))
    assert_same([back], [old_store.SEEN])
    assert_same(old.calibration_history("A1"), old_store.CALIBRATIONS)
    assert_same(old.latest_calibrations().values(), old_store.CALIBRATIONS[1:])


def test_the_schedule_reads_back(old: Keeper) -> None:
    visits = (replace(old_store.VISITS[0], error_before=old_store.NAN), old_store.VISITS[1])
    assert_same(old.visits(), visits[::-1])
    assert_same(old.campaigns(), old_store.CAMPAIGNS)
    assert set(old.holds()) == {
        Lockout(Kind.HELIOSTAT, "Größe/2", "anna", "broken", 5.0, 50.0),
        Lockout(Kind.HELIOSTAT, "B", "ben", "for good", 7.0),
    }


def test_events_alarms_and_audit_read_back(old: Keeper) -> None:
    assert_same(old.events(), old_store.EVENTS[::-1])
    assert_same(old.events(severity="warning"), old_store.EVENTS[1:])
    wind = AlarmEntry("wind", "mast", "warning", "12 m/s", 1.0, 2.5, 3.0, "anna", 1)
    assert old.alarms() == [AlarmEntry("rain", "", "alarm", "rain", 4.0, number=3), wind]
    with old.database.reading() as connection:
        (entry,) = audit.entries(connection)
        assert audit.points(connection) == old_store.POINTS
    assert entry == replace(old_store.AUDIT, result="done", finished="t2")


def test_people_read_back(old: Keeper) -> None:
    (account,) = old.people.accounts()
    assert (account.name, account.role, account.disabled) == ("anna", "engineer", False)
    secret = bytes(32).hex()
    (session,), token = old.people.valid(2.0).sessions, old.people.token(secret, 2.0)
    assert token is not None
    assert (session.role, session.note) == ("engineer", "tablet")
    assert (token.role, token.label, token.expires) == ("viewer", "report", None)
