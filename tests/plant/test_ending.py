"""The end of a plant: which heliostats it stows, waits for and names."""

import asyncio
from collections.abc import Awaitable, Callable

import numpy as np
import pytest

from heliotrope.cli.run._shared import Lines, stow
from heliotrope.field.layouts import malan_plant
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.orders.authority import Person, Role
from support.live import LiveOptions, LivePlant

PERSON = Person("engineer", Role.ENGINEER)
#: Longest path to stow, and time in which the end must notice that nothing is left to wait for, s.
PATH, NOTICED = 60.0, 20.0


class Printed(Lines):
    """The lines, kept."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []

    def print(self, text: str) -> None:
        self.texts.append(text)


def played(scene: Callable[[LivePlant], Awaitable[None]]) -> None:
    """Play a scene with four heliostats that track, in virtual time."""

    async def main(clock: VirtualClock) -> None:
        work = AutomaticSettings(wanted=True, calibrate=False)
        made = LivePlant(malan_plant(4), clock, LiveOptions(rendered=False, threads=0, work=work))
        async with made.running():
            await asyncio.sleep(80.0)
            assert made.operations.summary().states == {"TRACKING": 4}
            await scene(made)
            await made.end()

    run_virtual(main)


async def locked(plant: LivePlant, *names: str) -> None:
    """Lock heliostats off the receiver: one that is locked on it would be stowed."""
    token = plant.operations.take_authority(PERSON).token
    if set(plant.operations.summary().states) != {"STOWED"}:
        plant.operations.command(PERSON, token, "IDLE", names)
        for _ in range(20):
            await asyncio.sleep(1.0)
            plant.operations.plant.authority.keep(PERSON, token)
    plant.operations.command(PERSON, token, "LOCK", names)
    await asyncio.sleep(3.0)


async def ended(plant: LivePlant) -> tuple[bool, list[str], float]:
    """End a plant as Ctrl-C does; return whether all are stowed, the lines, and the time, s."""
    lines, begun = Printed(), plant.clock.monotonic()
    good = await stow(plant.assembly, asyncio.Event(), lines)
    lines.close()
    return good, lines.texts, plant.clock.monotonic() - begun


def test_a_locked_heliostat_is_stowed_with_the_others() -> None:
    async def scene(plant: LivePlant) -> None:
        last = plant.names[-1]
        plant.operations.stow(PERSON, plant.names[:-1])
        await locked(plant, last)
        await asyncio.sleep(PATH)
        assert plant.operations.summary().states == {"STOWED": 3, "LOCKED": 1}
        good, lines, took = await ended(plant)
        assert (good, plant.assembly.left()) == (True, "")
        assert plant.field.at_stow().all()
        assert any(line.startswith("stowing 1 heliostats (1 locked), about") for line in lines)
        assert lines[-1] == "the field is stowed"
        assert took < PATH

    played(scene)


def test_one_that_is_locked_at_stow_is_not_waited_for() -> None:
    async def scene(plant: LivePlant) -> None:
        plant.operations.stow(PERSON)
        await asyncio.sleep(PATH)
        await locked(plant, *plant.names)
        good, lines, took = await ended(plant)
        assert (good, lines) == (True, ["the field is stowed"])
        assert took < 1.0

    played(scene)


@pytest.mark.parametrize("others", [0, 3])
def test_one_that_does_not_move_is_named_and_not_waited_for(others: int) -> None:
    async def scene(plant: LivePlant) -> None:
        if not others:
            plant.operations.stow(PERSON, plant.names[:-1])
        await locked(plant, plant.names[-1])
        await asyncio.sleep(0.0 if others else PATH)
        # Its motors turn no more.
        for end in ("low", "high"):
            plant.field.axes[end][-1] = plant.field.axes["count"][-1]
        good, lines, took = await ended(plant)
        assert not good
        assert plant.assembly.left() == f"not in stow: {plant.names[-1]} LOCKED"
        assert np.flatnonzero(~plant.field.at_stow()).tolist() == [3]
        assert lines[-1] == "not all heliostats are stowed"
        assert took < (PATH if others else NOTICED)

    played(scene)
