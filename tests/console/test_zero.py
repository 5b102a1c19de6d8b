"""ZERO on firmware-true boards, and what keeps a plant under its console quick; virtual time."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from heliotrope.console.live import rows_of
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.layouts import lay_out
from heliotrope.field.stellenbosch import prototype
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.mechanism import track
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.operations.zero import lock_position, zero
from heliotrope.plant.orders.authority import Person, RefusedError, Role
from heliotrope.store.keeper import Keeper
from heliotrope.store.records import Event
from heliotrope.twin.field import Field, FieldBus
from support.live import LiveOptions, LivePlant

START = datetime(2026, 10, 21, 9, tzinfo=UTC)
ENGINEER, OPERATOR = Person("engineer", Role.ENGINEER), Person("operator", Role.OPERATOR)


def _live(work: Callable[[LivePlant], Awaitable[None]], records: Keeper | None = None) -> None:
    """Run two boards that nobody wants to move."""
    design = prototype()
    (group,) = design.groups.values()
    two = replace(design, groups={"azel": group.take([0, 1])})
    options = LiveOptions(
        rendered=False, threads=0, boards=True, work=AutomaticSettings(calibrate=False, events=30.0)
    )

    async def main(clock: VirtualClock) -> None:
        plant = LivePlant(two, clock, options, records=records)
        async with plant.running():
            await asyncio.sleep(4.0)
            await work(plant)
            await plant.end()

    run_virtual(main, start=START)


def test_zero_is_stored_by_the_one_that_is_locked() -> None:
    async def work(live: LivePlant) -> None:
        plant, (name, other) = live.plant, live.names
        token = plant.take_authority(ENGINEER).token
        await asyncio.sleep(3.0)
        early = zero(plant, ENGINEER, token, [name], [1234, -567])
        assert not await early.end(20.0)  # it is stowed, not locked
        assert "state" in early.refusals[name]
        assert await plant.command(ENGINEER, token, "LOCK", [name]).end(20.0)
        still = int(plant.field.rows[plant.field.place(other)]["primary"])
        ticket = zero(plant, ENGINEER, token, [name], [1234, -567])
        assert await ticket.end(20.0), ticket.text
        await asyncio.sleep(3.0)
        row = plant.field.rows[plant.field.place(name)]
        assert (int(row["primary"]), int(row["secondary"])) == (1234, -567)
        assert plant.field.rows[plant.field.place(other)]["primary"] == still

    _live(work)


def test_who_may_and_what_fits() -> None:
    async def work(live: LivePlant) -> None:
        plant, (name, _) = live.plant, live.names
        token = plant.take_authority(OPERATOR).token
        with pytest.raises(RefusedError, match="needs engineer"):
            zero(plant, OPERATOR, token, [name], [0, 0])
        plant.release_authority(OPERATOR, token)
        token = plant.take_authority(ENGINEER).token
        for names, values, error, text in (
            ([], [0, 0], RefusedError, "between heliostats; specify one heliostat"),
            (live.names, [0, 0], RefusedError, "2 heliostats"),
            ([name], [0], InputError, "got 1 numbers"),
            ([name], [0.5, 0], InputError, "cannot be sent"),
            (["nobody"], [0, 0], UnknownNameError, "nobody"),
        ):
            with pytest.raises(error, match=text):
                zero(plant, ENGINEER, token, names, values)

    _live(work)


def test_lock_position_restores_counts_that_were_lost() -> None:
    async def work(live: LivePlant) -> None:
        plant, (name, other) = live.plant, live.names
        token = plant.take_authority(ENGINEER).token
        await asyncio.sleep(3.0)
        with pytest.raises(RefusedError, match=f"LOCK POSITION: {name}: it is not locked"):
            lock_position(plant, ENGINEER, token, [name])
        with pytest.raises(RefusedError, match="2 heliostats"):
            lock_position(plant, ENGINEER, token, live.names)
        assert await plant.command(ENGINEER, token, "LOCK", live.names).end(20.0)
        with pytest.raises(RefusedError, match="it has no aim point"):
            lock_position(plant, ENGINEER, token, [name])
        target = plant.design.targets[0].center
        assert await plant.aim(ENGINEER, token, dict.fromkeys(live.names, target)).end(20.0)
        # The mirror stands where its beam is at the aim; its counts are 40 and -25 steps wrong.
        mechanism = plant.beliefs.present(name)[0]
        found = track(mechanism, plant.sun_vector(), target)
        right = np.round(found.best_counts)
        wrong = (right + [40.0, -25.0]).tolist()
        assert await zero(plant, ENGINEER, token, [name], wrong).end(20.0)
        await asyncio.sleep(3.0)
        ticket, text = lock_position(plant, ENGINEER, token, [name])
        assert await ticket.end(20.0), ticket.text
        await asyncio.sleep(3.0)
        row = plant.field.rows[plant.field.place(name)]
        # The sun went on by some tens of seconds, 2 mrad: 15 of 7,639 steps a radian at most.
        assert np.abs(right - (int(row["primary"]), int(row["secondary"]))).max() < 20
        assert f"counts {wrong[0]:.0f}, {wrong[1]:.0f} become" in text
        # The other one stands at stow, far from its aim: nothing is sent.
        still = int(plant.field.rows[plant.field.place(other)]["primary"])
        with pytest.raises(RefusedError, match="the limit is 100 mrad; check that the beam"):
            lock_position(plant, ENGINEER, token, [other])
        await asyncio.sleep(3.0)
        assert plant.field.rows[plant.field.place(other)]["primary"] == still

    _live(work)


def test_buses_take_turns_in_an_emergency() -> None:
    """So that neither the plant nor its console waits for 10,000 acknowledgements at once."""

    async def main() -> None:
        clock = VirtualClock(asyncio.get_running_loop().time, START)
        field = LivePlant(lay_out("radial", 3), clock, LiveOptions(rendered=False)).field
        assert isinstance(field, Field)
        buses = {"a": FieldBus(field, range(1)), "b": FieldBus(field, range(1, 3))}
        for urgent, expected in ((True, "ababab"), (False, "aaabbb")):
            order: list[str] = []

            async def ask(name: str, urgent: bool, order: list[str]) -> None:
                for _ in range(3):
                    await buses[name].transact(b"\0", 0.1, urgent=urgent)
                    order.append(name)

            await asyncio.gather(*(ask(name, urgent, order) for name in buses))
            assert "".join(order) == expected

    asyncio.run(main())


def test_old_events_are_let_go_once_a_day(tmp_path: Path) -> None:
    keeper, day = Keeper(tmp_path, inline=True), 86_400.0
    now = START.timestamp()
    keeper.record_event(Event(now - 31.0 * day, "plant", "long ago"))
    keeper.record_event(Event(now - 29.0 * day, "plant", "lately"))

    async def work(live: LivePlant) -> None:
        await asyncio.sleep(15.0)
        texts = [event.text for event in keeper.events(100)]
        assert "lately" in texts
        assert "long ago" not in texts
        # Not again on the same day.
        keeper.record_event(Event(now - 31.0 * day, "plant", "late news"))
        await asyncio.sleep(30.0)
        assert "late news" in [event.text for event in keeper.events(100)]

    try:
        _live(work, keeper)
    finally:
        keeper.close()


def test_events_are_kept_for_some_time() -> None:
    with pytest.raises(InputError, match="events must be kept for more than 0 days"):
        AutomaticSettings(events=0.0)


def test_out_of_service_is_confirmed_by_the_switch_at_the_mirror() -> None:
    async def work(live: LivePlant) -> None:
        plant, name, operations = live.plant, live.names[0], live.operations
        row = plant.field.place(name)
        board = live.field.boards[0]
        operations.hold(OPERATOR, [name], "washing")
        await asyncio.sleep(3.0)
        assert rows_of(operations.viewer.frame())["held"][row] == 1
        board.switch(plant.now(), off=True)
        await asyncio.sleep(3.0)
        assert rows_of(operations.viewer.frame())["held"][row] == 2
        seen = operations.viewer.heliostat(name)
        assert {"LOCAL_SWITCH", "AT_STOW"} <= set(seen.flags)
        assert (seen.state, seen.fault) == ("LOCKED", "none")
        # At stow, standing there is to obey.
        assert await plant.defocus("Vera", [name]).end(20.0)
        board.switch(plant.now(), off=False)
        await asyncio.sleep(3.0)
        assert rows_of(operations.viewer.frame())["held"][row] == 1
        assert operations.viewer.heliostat(name).state == "LOCKED"

    _live(work)
