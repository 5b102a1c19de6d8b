"""A simulated plant with its store, its local interface and its console."""

import asyncio
from dataclasses import dataclass, replace
from datetime import datetime

from heliotrope.cli.run._shared import (
    FORESEE,
    Shown,
    at_work,
    begin,
    computing,
    one_error,
    pictures,
    store,
)
from heliotrope.field.plant import Plant
from heliotrope.files.disk import DiskThread
from heliotrope.links.clock import SystemClock, VirtualClock
from heliotrope.plant.assembly import AssemblySettings, MachineTables, PlantAssembly
from heliotrope.plant.field.learner import LearnerProcess
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.orders.kept_audit import KeptAudit, KeptPoints
from heliotrope.twin import warm
from heliotrope.twin.live import CYCLE, PacedLoop, World, WorldOptions


@dataclass(frozen=True)
class SimulationOptions:
    """Options of a simulated plant on the command line; see `cli.run.command`."""

    speed: float
    start: datetime
    seed: int
    exact: bool
    idle: bool
    boards: bool


def run_plant(design: Plant, choice: SimulationOptions, shown: Shown) -> None:
    """Run until Ctrl-C, or until the time is over."""
    with one_error(), asyncio.Runner(loop_factory=lambda: PacedLoop(choice.speed)) as runner:
        runner.run(_run(design, choice, shown))


async def _run(design: Plant, choice: SimulationOptions, shown: Shown) -> None:
    loop = asyncio.get_running_loop()
    assert isinstance(loop, PacedLoop)
    clock = VirtualClock(loop.time, choice.start)
    settings = AssemblySettings(
        plant=shown.plant,
        work=AutomaticSettings(wanted=not choice.idle, calibrate=not choice.idle, foresee=FORESEE),
        cycle=CYCLE,
        machines=MachineTables.HELD,
    )
    ending = begin(design, shown)
    with computing(warm.moving) as worker, store(shown) as (keeper, folder):
        options = WorldOptions(
            choice.seed, rendered=not choice.exact, worker=worker, boards=choice.boards
        )
        ports = World(design, clock, options).ports(
            audit=KeptAudit(keeper, SystemClock(), clock.utc()),
            # A record takes long in a time that runs faster, so there the loop waits for it.
            disk=DiskThread() if choice.speed <= 1.0 else None,
            records=keeper,
            assigned=KeptPoints(keeper),
            facts=lambda: {"lag": loop.lag, "speed": loop.speed},
        )
        # A record takes long in a time that runs faster, so there the loop waits for it.
        kept = pictures(shown, folder, waits=choice.speed > 1.0)
        ports = replace(ports, pictures=kept, marks=shown.marks, learner=LearnerProcess())
        live = PlantAssembly(design, ports, settings)
        await at_work(live, keeper, shown, folder, ending, stows=False, speed=choice.speed)
