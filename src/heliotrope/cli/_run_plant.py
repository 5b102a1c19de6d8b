"""Puts a live plant, its store and its console together, and runs them in one event loop."""

import asyncio
import contextlib
import shutil
import signal
import sys
import tempfile
import webbrowser
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from heliotrope.control.clock import SystemClock, VirtualClock
from heliotrope.control.kept_audit import KeptAudit, KeptPoints
from heliotrope.control.operations import WorkSettings
from heliotrope.errors import InputError
from heliotrope.field.plant import Plant
from heliotrope.geometry import as_float
from heliotrope.lcu import states
from heliotrope.store.keeper import Keeper
from heliotrope.store.telemetry import Look, Telemetry
from heliotrope.twin._live_loop import PacedLoop
from heliotrope.twin.live import LiveOptions, LivePlant

#: A console prints lines more seldom: people look at it.
_SELDOM = 6.0


@dataclass(frozen=True)
class Choice:
    """What was asked for on the command line; see `cli.run`."""

    speed: float
    start: datetime
    seed: int
    exact: bool
    idle: bool
    gain: bool
    boards: bool
    port: int
    console: bool
    browser: bool
    minutes: float | None
    data: Path | None
    every: float


def run_plant(design: Plant, choice: Choice) -> None:
    """Run until Ctrl-C, or until the time is over; the field is stowed at the end."""
    with asyncio.Runner(loop_factory=lambda: PacedLoop(choice.speed)) as runner:
        runner.run(_run(design, choice))


async def _run(design: Plant, choice: Choice) -> None:
    loop = asyncio.get_running_loop()
    assert isinstance(loop, PacedLoop)
    ending = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ending.set)
    print(f"{design.name}: {len(design):,} heliostats", flush=True)
    clock = VirtualClock(loop.time, choice.start)
    with _store(choice) as keeper:
        live = LivePlant(
            design, clock, _options(choice), records=keeper,
            audit=KeptAudit(keeper, SystemClock(), clock.utc()), assigned=KeptPoints(keeper),
            extra=lambda: {"lag": loop.lag, "speed": loop.speed},
        )  # fmt: skip
        async with live.running(), _archive(live, choice), _console(live, keeper, choice) as shown:
            await _watch(live, choice, ending, shown=shown)
            print("stowing; Ctrl-C again ends at once", flush=True)
            ending.clear()
            await _stow(live, ending)
            await live.end()
    print("ended", flush=True)


def _options(choice: Choice) -> LiveOptions:
    return LiveOptions(
        seed=choice.seed, rendered=not choice.exact,
        boards=choice.boards, plain=not choice.gain,
        work=WorkSettings(wanted=not choice.idle, calibrate=not choice.idle),
    )  # fmt: skip


@contextlib.contextmanager
def _store(choice: Choice) -> Iterator[Keeper]:
    """Open the store: in its folder, or in one that is gone afterwards."""
    kept = choice.data is not None
    folder = Path(tempfile.mkdtemp(prefix="heliotrope-")) if choice.data is None else choice.data
    try:
        keeper = Keeper(folder)
        try:
            yield keeper
        finally:
            keeper.close()
    finally:
        if not kept:
            shutil.rmtree(folder, ignore_errors=True)


@contextlib.asynccontextmanager
async def _archive(live: LivePlant, choice: Choice) -> AsyncIterator[None]:
    """Archive the field's telemetry beside a block, if anything is kept."""
    if choice.data is None:
        yield
        return
    archive = Telemetry(choice.data / "telemetry", live.operations.names, states.STATES)

    async def look() -> None:
        while True:
            frame = live.operations.frame()
            flags = frame.flags.astype(np.uint16)
            archive.take(
                frame.at, Look(frame.state, frame.fault, flags, frame.counts, as_float(frame.age))
            )  # fmt: skip
            await asyncio.sleep(5.0)

    async with asyncio.TaskGroup() as group:
        looking = group.create_task(look())
        yield
        looking.cancel()
    archive.close()


@contextlib.asynccontextmanager
async def _console(live: LivePlant, keeper: Keeper, choice: Choice) -> AsyncIterator[bool]:
    """Serve the console beside a block; say where it is."""
    if not choice.console:
        yield False
        return
    try:
        from heliotrope.console.people import FIRST, first_start
        from heliotrope.console.serve import ConsoleServer
        from heliotrope.console.settings import ConsoleSettings
    except ImportError as error:
        raise InputError(
            f"run: {error.name} is not installed; say pip install 'heliotrope[console]', or give "
            "--no-console"
        ) from None
    password = first_start(keeper.people, live.clock.utc().timestamp())
    server = ConsoleServer(live.operations, keeper.people, ConsoleSettings(port=choice.port))
    async with asyncio.TaskGroup() as group:
        serving = group.create_task(server.run())
        address = await server.address(60.0 * choice.speed)
        print(f"console: {address}", flush=True)
        if password is not None:
            print(f"first account: {FIRST}, password {password} (shown only now)", flush=True)
        if choice.browser and sys.stdout.isatty():
            webbrowser.open(address)
        yield True
        await server.close()
        await serving


async def _watch(live: LivePlant, choice: Choice, ending: asyncio.Event, *, shown: bool) -> None:
    """Print a line now and then until the end."""
    loop = asyncio.get_running_loop()
    pause = choice.speed * choice.every * (_SELDOM if shown and choice.every == 10.0 else 1.0)
    until = None if choice.minutes is None else loop.time() + 60.0 * choice.minutes
    while not ending.is_set() and (until is None or loop.time() < until):
        left = pause if until is None else min(pause, until - loop.time())
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(max(left, 0.01)):
                await ending.wait()
        print(line(live), flush=True)


async def _stow(live: LivePlant, ending: asyncio.Event) -> None:
    stowing = asyncio.ensure_future(live.stowed())
    waiting = asyncio.ensure_future(ending.wait())
    await asyncio.wait({stowing, waiting}, return_when=asyncio.FIRST_COMPLETED)
    waiting.cancel()
    stowing.cancel()
    done = await asyncio.gather(stowing, return_exceptions=True)
    for error in done:
        if isinstance(error, Exception):
            raise error
    print("the field is stowed" if list(done) == [True] else "not all is stowed", flush=True)


def line(live: LivePlant) -> str:
    """Return one line on a live plant."""
    summary, work = live.operations.summary(), live.operations.calibration()
    states = ", ".join(f"{count:,} {name.lower()}" for name, count in summary.states.items())
    parts = [f"{summary.at:%H:%M:%S} UTC", states, f"{work.done} calibrated"]
    if work.quality:
        last: Any = work.quality[-1]
        parts.append(f"median error {1e3 * last.truth_median:.2f} mrad")
    if work.running:
        parts.append("; ".join(f"{r.heliostat} at {r.target}: {r.stage}" for r in work.running))
    elif work.reason:
        parts.append(work.reason)
    if summary.alarms:
        parts.append(f"{summary.alarms} alarms")
    if summary.lag > 1.0:
        parts.append(f"{summary.lag:.0f} s behind")
    return " | ".join(parts)
