"""The timetable of a running plant: what is due is asked for, kept, and refused with a reason."""

import asyncio
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.layouts import lay_out
from heliotrope.field.plant import Plant
from heliotrope.field.timetable import TimetableEntry
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.plant.orders.authority import Person, RefusedError, Role
from heliotrope.store.keeper import Keeper
from heliotrope.store.records import TimetableRecord
from support.live import LiveOptions, LivePlant

VIEWER, OPERATOR = Person("vera", Role.VIEWER), Person("olga", Role.OPERATOR)
START = datetime(2026, 10, 21, 9, tzinfo=UTC)


def design(*entries: TimetableEntry) -> Plant:
    return replace(lay_out("radial", 4), timetable=entries)


def said(plant: LivePlant) -> list[str]:
    return [e.text for e in plant.operations.logbook.events(500) if e.text.startswith("timetable")]


async def until(plant: LivePlant, hour: int, minute: int) -> None:
    while plant.clock.utc() < START.replace(hour=hour, minute=minute):
        await asyncio.sleep(1.0)


def test_heliostats_are_calibrated_at_their_time() -> None:
    last = design().names[-1]

    async def main(clock: VirtualClock) -> None:
        entry = TimetableEntry("ten", (last,), "right", ("11:05+02:00",))
        plant = LivePlant(design(entry), clock, LiveOptions(threads=0))
        async with plant.running():
            operations = plant.operations
            (row,) = operations.automatic.timetable.rows()
            assert row.next == START.replace(minute=5).timestamp()
            assert row.text == ""
            await until(plant, 9, 4)
            assert last not in operations.automatic.view().asked
            assert not said(plant)
            await until(plant, 9, 6)
            assert said(plant) == ["timetable: requested 1 of 1 heliostats"]
            begun = START.replace(minute=5).timestamp()

            def results() -> list[str]:
                found = operations.automatic.view().results
                return [r.target for r in found if r.heliostat == last and r.at > begun]

            while not results():
                await asyncio.sleep(1.0)
            # It stood on the target of the entry, whatever the schedule would have chosen.
            assert results() == ["right"]
            (row,) = operations.automatic.timetable.rows()
            assert row.next == begun + 86_400.0
            assert begun <= row.last < begun + 10.0
            await plant.end()

    run_virtual(main, start=START)


def test_what_cannot_be_calibrated_is_named_once() -> None:
    names = design().names

    async def main(clock: VirtualClock) -> None:
        entry = TimetableEntry("often", names[:2], every=60.0)
        plant = LivePlant(design(entry), clock, LiveOptions(threads=0))
        async with plant.running():
            plant.operations.switch_calibration(OPERATOR, on=False)
            await until(plant, 9, 5)
            (row,) = plant.operations.automatic.timetable.rows()
            assert row.text.startswith("requested 0 of 2 heliostats; not ")
            assert "it is switched off" in row.text
            assert len(said(plant)) == 1
            await plant.end()

    run_virtual(main, start=START)


def test_a_person_replaces_the_timetable_and_it_outlasts_a_restart(tmp_path: Path) -> None:
    names = design().names
    filed = TimetableEntry("file", names[:1], "", ("11:00Z",))
    mine = TimetableEntry("mine", names[1:3], "left", (), 7200.0)

    def run(expected: list[str], entries: tuple[TimetableEntry, ...] | None, *, put: bool) -> None:
        keeper = Keeper(tmp_path)

        async def main(clock: VirtualClock) -> None:
            plant = LivePlant(design(filed), clock, LiveOptions(threads=0), records=keeper)
            async with plant.running():
                operations = plant.operations
                assert [row.name for row in operations.automatic.timetable.rows()] == expected
                if put:
                    operations.automatic.timetable.put(OPERATOR, entries)
                await plant.end()

        run_virtual(main, start=START)
        keeper.close()

    run(["file"], (filed, mine), put=True)
    run(["file", "mine"], (), put=True)
    run([], None, put=True)
    run(["file"], None, put=False)


def test_a_kept_timetable_of_other_heliostats_gives_way_to_the_file(tmp_path: Path) -> None:
    filed = TimetableEntry("file", design().names[:1], "", ("11:00Z",))
    keeper = Keeper(tmp_path)
    document = '[{"name": "old", "heliostats": ["gone"], "every_s": 3600.0}]'
    keeper.record(TimetableRecord(1.0, "olga", document))
    keeper.writer.confirmed().result(10.0)

    async def main(clock: VirtualClock) -> None:
        plant = LivePlant(design(filed), clock, LiveOptions(threads=0), records=keeper)
        async with plant.running():
            assert [row.name for row in plant.operations.automatic.timetable.rows()] == ["file"]
            (text,) = said(plant)
            assert "timetable of olga: there is no heliostat 'gone'" in text
            await plant.end()

    run_virtual(main, start=START)
    keeper.close()


def test_only_people_who_may_command_change_it_and_only_to_what_can_be() -> None:
    entry = TimetableEntry("mine", ("gone",), "", ("11:00Z",))

    async def main(clock: VirtualClock) -> None:
        plant = LivePlant(design(), clock, LiveOptions(threads=0))
        async with plant.running():
            with pytest.raises(RefusedError, match="vera is viewer"):
                plant.operations.automatic.timetable.put(VIEWER, ())
            with pytest.raises(UnknownNameError, match="gone"):
                plant.operations.automatic.timetable.put(OPERATOR, (entry,))
            good = replace(entry, heliostats=design().names[:1])
            with pytest.raises(InputError, match="timetable entry"):
                plant.operations.automatic.timetable.put(OPERATOR, (good, good))
            assert plant.operations.automatic.timetable.rows() == ()
            await plant.end()

    run_virtual(main, start=START)


def test_some_come_first_and_some_never_unless_a_person_asks() -> None:
    names = design().names

    async def main(clock: VirtualClock) -> None:
        first = TimetableEntry("first", (names[3],), rule="first")
        never = TimetableEntry("never", (names[0],), rule="never")
        plant = LivePlant(design(first, never), clock, LiveOptions(threads=0))
        async with plant.running():
            automatic = plant.operations.automatic

            def visited() -> list[str]:
                begun = [*automatic.view().results[::-1], *automatic.view().running]
                return [one.heliostat for one in begun]

            while not set(names[1:]) <= set(visited()):
                await asyncio.sleep(2.0)
            assert names[0] not in {visit.heliostat for visit in automatic.plan(4)}
            assert names[3] in visited()[:2]
            assert names[0] not in visited()
            plant.operations.calibrate(OPERATOR, names[0])
            while names[0] not in visited():
                await asyncio.sleep(1.0)

    run_virtual(main, start=START)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"rule": "often"}, "rule 'often'; use first or never"),
        ({"rule": "never", "at": ("12:00Z",)}, "remove times and target"),
        ({"rule": "first", "target": "left"}, "remove times and target"),
    ],
)
def test_a_rule_stands_alone(given: dict[str, object], text: str) -> None:
    with pytest.raises(InputError, match=text):
        TimetableEntry("a", ("A1",), **given)
    made = TimetableEntry("a", ("A1",), rule="never")
    assert TimetableEntry.of(made.document) == made
    assert not made.due(0.0, 1e9)
