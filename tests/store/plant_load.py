"""A whole plant of the twin under load in a process that is killed: forked by load.py."""

import asyncio
import os
import random
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from heliotrope.field.layouts import malan_plant
from heliotrope.files.disk import DiskThread
from heliotrope.links.clock import SystemClock, VirtualClock
from heliotrope.links.messages import Stage
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.orders.authority import Person, RefusedError, Role
from heliotrope.plant.orders.kept_audit import KeptAudit, KeptPoints
from heliotrope.store.keeper import Keeper
from heliotrope.store.records import Event
from heliotrope.twin.live.loop import PacedLoop
from support.live import LiveOptions, LivePlant

START = datetime(2026, 6, 21, 8, tzinfo=UTC)
COUNT = 6


def plant(place: Path, seed: int, told: int) -> None:
    """Run a plant without end; every other time an operator commands it, else it calibrates."""
    with asyncio.Runner(loop_factory=lambda: PacedLoop(40.0)) as runner:
        runner.run(_run(place, seed, lambda line: os.write(told, f"{line}\n".encode())))


async def _run(place: Path, seed: int, tell: Callable[[str], object]) -> None:
    clock = VirtualClock(asyncio.get_running_loop().time, START)
    keeper, by_hand = Keeper(place), bool(seed % 2)  # the automatic work has the authority
    live = LivePlant(
        malan_plant(COUNT),
        clock,
        LiveOptions(
            seed=1,
            rendered=False,
            threads=0,
            work=AutomaticSettings(wanted=not by_hand, calibrate=not by_hand),
        ),
        audit=KeptAudit(keeper, SystemClock(), clock.utc()),
        disk=DiskThread(),
        assigned=KeptPoints(keeper),
        records=keeper,
    )
    async with live.running():
        tell("open")
        await (_command if by_hand else _learn)(live, keeper, seed, tell)


async def _learn(live: LivePlant, keeper: Keeper, seed: int, tell: Callable[[str], object]) -> None:
    """Tell of the calibrations that are safe."""
    k = 0
    while True:
        await asyncio.sleep(5.0)
        k += 1
        keeper.record_event(Event(live.clock.utc().timestamp(), "load", f"{seed}-{k}"))
        await keeper.confirm()
        tell(f"event {seed}-{k}")
        for name, version in keeper.latest_calibrations().items():
            tell(f"version {name} {version.version}")


async def _command(
    live: LivePlant, keeper: Keeper, seed: int, tell: Callable[[str], object]
) -> None:
    """Command at random, and tell what was accepted."""
    chance, one, person = random.Random(seed), live.plant, Person("operator", Role.OPERATOR)
    token = 0
    while True:
        await asyncio.sleep(chance.uniform(0.2, 4.0))
        try:
            token = token or one.take_authority(person).token
            await _one(one, person, token, chance, tell)
        except RefusedError:
            token = 0


async def _one(
    one: PlantController,
    person: Person,
    token: int,
    chance: random.Random,
    tell: Callable[[str], object],
) -> None:
    names = chance.sample(one.field.names, chance.randint(1, 3))
    what = chance.choice(("STOW", "DEFOCUS", "TRACK", "APPROACH", "STANDBY", "STANDBY"))
    if what == "STANDBY":
        # Beside the receiver, and never the same twice.
        places = {n: (25.0 + chance.random(), 0.0, 90.0) for n in names}
        ticket = one.standby(person, token, places)
        await ticket.reached(Stage.SENT, 20.0)
        if ticket.recorded:
            tell(f"accepted {ticket.identity}")
        for name, place in places.items():
            if "not sent" not in ticket.refusals.get(name, ""):
                tell(f"point {name} {place[0]!r}")
    elif what in ("STOW", "DEFOCUS"):
        ticket = (one.stow if what == "STOW" else one.defocus)(person.name, names)
        # Safety waits for no disk: its record is owed, and written within the next second.
    else:
        ticket = one.command(person, token, what, heliostats=names)
        while not (ticket.recorded or ticket.finished):
            await asyncio.sleep(0.05)
        if ticket.recorded:
            tell(f"accepted {ticket.identity}")
