"""The journal: events, alarms and commands of all days in one list, searched."""

from dataclasses import replace
from datetime import UTC, datetime

import pytest

from heliotrope.safety import Alarm, Severity
from heliotrope.store import audit
from heliotrope.store.keeper import Keeper
from heliotrope.store.records import AuditEntry, Event, JournalEntry, JournalQuery

DAY = 86_400.0
START = datetime(2026, 6, 21, tzinfo=UTC).timestamp()
ORDER = AuditEntry("p-1", "Olga", "operator", "STOW", "", heliostats=("H07", "H08"), note="wash 5%")


@pytest.fixture
def filled(keeper: Keeper) -> Keeper:
    """Two days: an event, an alarm and two commands on each."""
    for day in range(2):
        at = START + day * DAY + 3600.0
        keeper.record_event(Event(at, "command", f"Olga: day {day}, STOW 2 heliostats"))
        keeper.record_event(Event(at + 5.0, "calibration", "H07: calibrated", heliostat="H07"))
        keeper.record_alarm(
            Alarm("node_silent", "H08", Severity.ALARM, f"H08 silent {day}"), at + 9
        )
        keeper.record_acknowledgement("node_silent", "H08", "Olga", at + 20.0)
        keeper.record_alarm(Alarm("node_silent", "H08", Severity.ALARM, "", active=False), at + 30)
        for number, names in enumerate((("H07", "H08"), ())):
            moment = datetime.fromtimestamp(at + 40.0 + number, UTC).isoformat(
                timespec="milliseconds"
            )
            entry = replace(ORDER, identity=f"p-{day}-{number}", heliostats=names, at=moment)
            keeper.do(lambda c, entry=entry: audit.begin(c, entry))
    return keeper


def texts(keeper: Keeper, **query: object) -> list[str]:
    found: list[JournalEntry] = keeper.journal(JournalQuery(**query))  # type: ignore[arg-type]
    assert [one.at for one in found] == sorted((one.at for one in found), reverse=True)
    return [f"{one.kind} {one.what}: {one.text}" for one in found]


def test_all_kinds_stand_in_one_list_the_latest_first(filled: Keeper) -> None:
    found = texts(filled)
    assert len(found) == 10
    assert found[0] == "command STOW: Olga (operator): all (wash 5%)"
    assert found[1] == "command STOW: Olga (operator): H07, H08 (wash 5%)"
    assert found[2].startswith(
        "alarm node_silent: H08 silent 1; cleared at 22 Jun 01:00:30 UTC; ack"
    )
    assert len(texts(filled, limit=3)) == 3


#: Queries, and how many entries each finds.
NARROWED: tuple[tuple[dict[str, object], int], ...] = (
    ({"since": START + DAY}, 5),
    ({"until": START + DAY}, 5),
    ({"since": START + 2 * DAY}, 0),
    ({"kind": "alarm"}, 2),
    ({"kind": "command", "since": START + DAY}, 2),
    ({"person": "Olga"}, 8),
    ({"person": "olga"}, 2),
    ({"person": "O_ga"}, 0),
    ({"but": "Olga"}, 6),
    ({"but": "Olga", "person": "Olga"}, 8),
    ({"heliostat": "H07"}, 6),
    ({"heliostat": "H0"}, 6),
    ({"text": "SILENT"}, 2),
    ({"text": "5%"}, 4),
    ({"text": "%"}, 4),
    ({"text": "day 1", "person": "Olga"}, 1),
)


def test_each_condition_narrows_it(filled: Keeper) -> None:
    for query, count in NARROWED:
        found = texts(filled, **query)
        assert len(found) == count, (query, found)


def test_a_command_to_many_names_them_apart_from_its_line(keeper: Keeper) -> None:
    names = tuple(f"H{i:03d}" for i in range(300))
    for identity, whom in (("p-1", names), ("p-2", names[:5])):
        entry = replace(ORDER, identity=identity, heliostats=whom, at="2026-06-21T00:00:00.000")
        keeper.do(lambda c, entry=entry: audit.begin(c, entry))
    few, many = keeper.journal(JournalQuery(kind="command"))
    assert "300 heliostats (H000" in many.text
    assert many.heliostats == names[:200]
    assert few.heliostats == ()
