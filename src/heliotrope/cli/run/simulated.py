"""A plant of the twin with its store and its console, in one event loop."""

import asyncio
from dataclasses import dataclass
from datetime import datetime

from heliotrope.cli.run._shared import (
    Shown,
    archive,
    console,
    console_of,
    ending_at_signals,
    load_console,
    one_error,
    store,
    stow,
    watch,
)
from heliotrope.field.plant import Plant
from heliotrope.links.clock import SystemClock, VirtualClock
from heliotrope.plant.kept_audit import KeptAudit, KeptPoints
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.twin.live.live import LiveOptions, LivePlant
from heliotrope.twin.live.loop import PacedLoop


@dataclass(frozen=True)
class Choice:
    """What was asked for of the twin on the command line; see `cli.run`."""

    speed: float
    start: datetime
    seed: int
    exact: bool
    idle: bool
    boards: bool


def run_plant(design: Plant, choice: Choice, shown: Shown) -> None:
    """Run until Ctrl-C, or until the time is over; the field is stowed at the end."""
    with one_error(), asyncio.Runner(loop_factory=lambda: PacedLoop(choice.speed)) as runner:
        runner.run(_run(design, choice, shown))


async def _run(design: Plant, choice: Choice, shown: Shown) -> None:
    loop = asyncio.get_running_loop()
    assert isinstance(loop, PacedLoop)
    ending = ending_at_signals()
    print(f"{design.name}: {len(design):,} heliostats", flush=True)
    load_console(shown)
    clock = VirtualClock(loop.time, choice.start)
    with store(shown) as keeper:
        live = LivePlant(
            design,
            clock,
            _options(choice),
            records=keeper,
            audit=KeptAudit(keeper, SystemClock(), clock.utc()),
            assigned=KeptPoints(keeper),
            extra=lambda: {"lag": loop.lag, "speed": loop.speed},
        )
        server = console_of(live, keeper, shown)
        async with (
            live.running(),
            archive(live, shown),
            console(server, live, keeper, shown, choice.speed) as seen,
        ):
            await watch(live, shown, ending, seen=seen, speed=choice.speed)
            await stow(live, ending)
            await live.end()
    print("ended", flush=True)


def _options(choice: Choice) -> LiveOptions:
    return LiveOptions(
        seed=choice.seed,
        rendered=not choice.exact,
        boards=choice.boards,
        work=AutomaticSettings(wanted=not choice.idle, calibrate=not choice.idle),
    )
