"""A plant in operation, simulated or real: store, archive, console, printed lines, shutdown."""

import asyncio
import contextlib
import gc
import importlib.util
import math
import os
import shutil
import signal
import socket
import sys
import tempfile
import threading
import webbrowser
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from heliotrope import warm
from heliotrope.cli.run._evidence import Evidence, leaving
from heliotrope.errors import HeliotropeError, InputError
from heliotrope.field.plant import Plant
from heliotrope.files.disk import DiskBusyError, DiskThread
from heliotrope.files.text import read_text
from heliotrope.geometry import as_float
from heliotrope.lcu import states
from heliotrope.links.link import first_of
from heliotrope.plant.assembly import PlantAssembly
from heliotrope.plant.interface import PlantInterface
from heliotrope.plant.operations.pictures import Pictures, PictureSettings
from heliotrope.plant.operations.views import CalibrationView, Running
from heliotrope.plant.settings import PlantSettings
from heliotrope.plant.workers import WorkerProcesses
from heliotrope.store.database import make_private, tighten
from heliotrope.store.keeper import Keeper
from heliotrope.store.telemetry import Look, Telemetry
from heliotrope.sun import solar_day

#: Factor on the time between lines while a console is served, since users look at the console.
_SELDOM = 6.0
#: Packages that the console needs in addition to the base installation.
_OF_CONSOLE = ("argon2", "fastapi", "uvicorn", "websockets")
#: File with the password of the first account, where no terminal can show it.
FIRST_FILE = "first-password"
#: Default time between lines, and archiving interval, s.
EVERY, _ARCHIVED = 10.0, 5.0
#: Time between predictions of the field's errors, s.
FORESEE = 1800.0
#: Time limit for a program to end after a second Ctrl-C, s, and its exit code if it is killed.
AT_ONCE, _INTERRUPTED = 2.0, 130
#: Thresholds of the garbage collector. With 10,000 heliostats, each beat creates thousands of
#: objects: collecting young objects every 700 took most of the longest beats, and a full collection
#: blocks the loop for up to 0.08 s and frees almost nothing.
_COLLECTED = (50_000, 10, 1000)
#: Maximum length of a notice, bytes.
_NOTICE = 4096
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
#: Time over which the displayed pace is averaged, s, and the smallest displayed difference from
#: real time.
_SLOWER = 0.05
#: Number of visits in the plan, as requested by the console; a shorter plan would be truncated
#: there.
_PLANNED = 20
#: Description of what heliostats do in each state other than tracking.
_WORDS = {
    "UNCONFIGURED": "without parameters",
    "STOWED": "in stow",
    "STOWING": "going to stow",
    "APPROACHING": "moving to their aims",
    "IDLE": "at standby",
    "DEFOCUSED": "defocused",
    "LOCKED": "locked",
    "SEARCHING": "search",
    "FAULT": "with a fault",
    "stale": "silent",
}
#: Time between lines while the field goes to stow, s.
_SAID = 10.0


@dataclass(frozen=True)
class Shown:
    """Options of the console, the store and the printed lines; see `cli.run.command`."""

    host: str = "127.0.0.1"
    port: int = 8080
    names: tuple[str, ...] = ()
    certificate: Path | None = None
    key: Path | None = None
    plain: bool = False
    proxies: tuple[str, ...] = ()
    people_by_proxy: Path | None = None
    second_factor: str = ""
    emergency_port: int | None = None
    idle_s: float = 1800.0
    session_s: float = 36_000.0
    sign_ins: int = 12
    notice: Path | None = None
    console: bool = True
    browser: bool = True
    data: Path | None = None
    database: str | None = None
    minutes: float | None = None
    every: float = EVERY
    plant: PlantSettings = field(default_factory=PlantSettings)
    evidence: Evidence = field(default_factory=Evidence)
    photographs: PictureSettings = field(default_factory=PictureSettings)

    def __post_init__(self) -> None:
        if self.database is not None and not self.database.startswith("postgresql://"):
            raise InputError(
                "run: --database must be postgresql://user@host/name; for SQLite use --data alone"
            )
        if self.certificate is not None and self.key is not None:
            from heliotrope.links.tls import server_tls

            server_tls(self.certificate, self.key)
        if self.console:
            self.settings()

    @property
    def marks(self) -> Path | None:
        """Plant file that stores target views marked by users; None if they are not stored."""
        return None if self.data is None else self.data / "marks" / "plant.toml"

    def settings(self) -> Any:
        """Return the settings of the console.

        Raises
        ------
        InputError
            If settings contradict each other, or the console is not installed.
        """
        try:
            from heliotrope.console.settings import ConsoleSettings
        except ImportError as error:
            raise _missing(error) from None
        return ConsoleSettings(
            host=self.host,
            port=self.port,
            names=self.names,
            certificate=self.certificate,
            key=self.key,
            plain=self.plain,
            proxies=self.proxies,
            people_by_proxy=self.people_by_proxy,
            second_factor=self.second_factor,
            emergency_port=self.emergency_port,
            idle_s=self.idle_s,
            session_s=self.session_s,
            sign_ins=self.sign_ins,
            notice="" if self.notice is None else read_text(self.notice, "a notice", _NOTICE),
        )


def check_console(shown: Shown) -> None:
    """Check that the console can be started, before the plant starts.

    Raises
    ------
    InputError
        If the console is not installed, or its address is taken.
    """
    if not shown.console:
        return
    family = socket.AF_INET6 if ":" in shown.host else socket.AF_INET
    try:
        socket.create_server((shown.host, shown.port), family=family).close()
    except OSError as error:
        why = error.strerror or str(error)
        raise InputError(
            f"console: {shown.host} port {shown.port} cannot be opened ({why}); another program "
            "may be using it: choose another with --port"
        ) from None
    for module in _OF_CONSOLE:
        if importlib.util.find_spec(module) is None:
            raise _missing(ImportError(name=module))
    if shown.people_by_proxy is not None:
        from heliotrope.console.by_proxy import ByProxy

        ByProxy.read(shown.people_by_proxy)
    # The plant creates the first account; loading this takes longer than a lease lasts.
    import heliotrope.console.people  # noqa: F401 - only loaded


def _missing(error: ImportError) -> InputError:
    return InputError(
        f"run: {error.name} is not installed; run pip install 'heliotrope[console]', or use "
        "--no-console"
    )


@contextlib.contextmanager
def computing(*loads: Callable[[], None]) -> Iterator[WorkerProcesses]:
    """Start a plant's worker processes, and load the modules needed in the plant's loop.

    ``loads`` are functions that load further modules for the loop.
    """
    with contextlib.closing(WorkerProcesses()) as worker:
        worker.start(warm.computing, warm.lighting)
        for load in (warm.controlling, *loads):
            load()
        yield worker


@contextlib.contextmanager
def one_error() -> Iterator[None]:
    """Raise the first Heliotrope or system error instead of the exception group around it."""
    try:
        yield
    except BaseExceptionGroup as group:
        errors = _leaves(group)
        known = [error for error in errors if isinstance(error, HeliotropeError | OSError)]
        if not known:
            raise
        raise known[0] from None


def _leaves(error: BaseException) -> list[BaseException]:
    if isinstance(error, BaseExceptionGroup):
        return [leaf for inner in error.exceptions for leaf in _leaves(inner)]
    return [error]


class Ending:
    """The shutdown requested by Ctrl-C or SIGTERM; to be created in the plant's loop.

    Attributes
    ----------
    asked
        Set by the first signal: the plant shuts down in order.
    at_once
        Set by the second signal: the program ends without waiting. If the program is still running
        after `AT_ONCE`, it is killed; the store is then left as after a power failure.
    """

    def __init__(self) -> None:
        self.asked, self.at_once = asyncio.Event(), asyncio.Event()
        self._loop = asyncio.get_running_loop()
        for number in _SIGNALS:
            self._loop.add_signal_handler(number, self.ask)

    def ask(self) -> None:
        """Shut down in order; after this call, a signal requests an immediate end."""
        self.asked.set()
        for number in _SIGNALS:
            self._loop.remove_signal_handler(number)
            # Not in the loop, which may be hanging.
            signal.signal(number, self._hurry)

    def _hurry(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        last = threading.Timer(AT_ONCE, os._exit, [_INTERRUPTED])
        last.daemon = True
        last.start()
        with contextlib.suppress(RuntimeError):  # the loop has ended, and the program ends soon
            self._loop.call_soon_threadsafe(self.at_once.set)


@contextlib.contextmanager
def store(shown: Shown) -> Iterator[tuple[Keeper, Path]]:
    """Open the store, a database or a folder; yield the store and the plant's folder.

    Without ``--data`` the folder of the plant is deleted afterwards. Files created in the meantime,
    even by the console process, are accessible only to this user.
    """
    mask = os.umask(0o077)
    folder = shown.data or Path(tempfile.mkdtemp(prefix="heliotrope-"))
    try:
        keeper = Keeper(shown.database or folder)
        try:
            make_private(folder)
            tighten(folder)
            yield keeper, folder
        finally:
            keeper.close()
    finally:
        os.umask(mask)
        if shown.data is None:
            shutil.rmtree(folder, ignore_errors=True)


def pictures(shown: Shown, folder: Path, *, waits: bool = False) -> Pictures:
    """Return the store of photographs; with ``waits``, the loop waits for the disk."""
    disk = None if waits else DiskThread()
    return Pictures(folder / "photographs", shown.photographs, disk)


@contextlib.asynccontextmanager
async def archive(live: PlantAssembly, shown: Shown) -> AsyncIterator[None]:
    """Archive the field's telemetry during a block, if there is a folder."""
    if shown.data is None:
        yield
        return
    kept = Telemetry(shown.data / "telemetry", live.operations.names, states.STATES)
    live.operations.telemetry = kept.folder

    async def look() -> None:
        while True:
            frame = live.operations.viewer.frame()
            flags = frame.flags.astype(np.uint16)
            kept.take(
                frame.at, Look(frame.state, frame.fault, flags, frame.counts, as_float(frame.age))
            )
            await asyncio.sleep(_ARCHIVED)

    try:
        async with asyncio.TaskGroup() as group:
            looking = group.create_task(look())
            yield
            looking.cancel()
    finally:
        kept.close()


class Lines:
    """The printed lines of a plant in operation, which a thread prints.

    The reader of the lines may be slow (a full pipe, a busy disk) or may have gone. Lines are then
    lost, and the plant continues.
    """

    def __init__(self) -> None:
        self._thread = DiskThread(most=100)

    def print(self, text: str) -> None:
        """Queue a line for printing."""
        with contextlib.suppress(DiskBusyError):
            self._thread.do(lambda: print(text, flush=True), lambda _: None)

    def close(self) -> None:
        """Print the queued lines, and end the thread."""
        self._thread.close(2.0)


def first_password(password: str, folder: Path) -> str:
    """Return the text that tells a user how to find the first password.

    The password itself is shown only on a terminal. Other output ends up in a log or journal, so
    the password is then written to a file that only its owner may read.
    """
    if sys.stdout.isatty():
        return f"password {password} (shown only once)"
    path = folder / FIRST_FILE
    path.unlink(missing_ok=True)
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        file.write(f"{password}\n")
    return f"password in {path} (change it, and delete the file)"


@dataclass(frozen=True)
class Entry:
    """How a user signs in to the first account.

    Attributes
    ----------
    password
        Text that says how to find the account's new password; empty if there is none.
    by_link
        Whether the user signs in through a one-time link.
    """

    password: str = ""
    by_link: bool = False


@contextlib.asynccontextmanager
async def interface(
    live: PlantAssembly,
    keeper: Keeper,
    shown: Shown,
    folder: Path,
    entry: Entry,
    lines: Lines,
) -> AsyncIterator[None]:
    """Serve the plant's local interface during a block, and run the console in its own process."""
    served = PlantInterface(live.operations, keeper.people, folder)
    if not shown.console:
        async with served.running():
            yield
        return
    from heliotrope.console.beside import ConsoleProcesses
    from heliotrope.console.people import FIRST

    def tell(address: str) -> None:
        if entry.by_link:
            address = served.one_time_link(FIRST, address)
        lines.print(f"console: {address}")
        if entry.password:
            lines.print(f"first account: {FIRST}, {entry.password}")
        if shown.browser and sys.stdout.isatty():
            webbrowser.open(address)

    console = ConsoleProcesses(served, shown.settings(), live.logbook.take_alarm, tell)
    async with served.running(console.run):
        yield


def first_account(live: PlantAssembly, keeper: Keeper, shown: Shown, folder: Path) -> Entry:
    """Return how a user signs in to the first account, which may need a new password.

    There is no text if the account already has a password. At a simulated plant that only this
    computer can reach, the user signs in through a one-time link. The account is written to the
    store, which may be slow, so this is done before the plant starts.
    """
    if not shown.console:
        return Entry()
    from heliotrope.console.people import first_start, without_password

    now = live.clock.utc().timestamp()
    if live.operations.simulated and shown.settings().for_one:
        return Entry(by_link=without_password(keeper.people, now))
    password = first_start(keeper.people, now)
    return Entry() if password is None else Entry(first_password(password, folder))


async def watch(
    live: PlantAssembly, shown: Shown, asked: asyncio.Event, lines: Lines, *, speed: float = 1.0
) -> None:
    """Print a line at intervals until the plant is to end."""
    loop = asyncio.get_running_loop()
    pause = speed * shown.every * (_SELDOM if shown.console and shown.every == EVERY else 1.0)
    await first_of(live.operations.begun.wait(), asked.wait())
    until = None if shown.minutes is None else loop.time() + 60.0 * shown.minutes
    while not asked.is_set() and (until is None or loop.time() < until):
        wait = pause if until is None else min(pause, until - loop.time())
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(max(wait, 0.01)):
                await asked.wait()
        lines.print(line(live))


async def stow(live: PlantAssembly, at_once: asyncio.Event, lines: Lines) -> bool:
    """Stow the field, printing the expected time; return whether all heliostats are stowed.

    Stowing is abandoned when ``at_once`` is set.
    """
    stowing = asyncio.ensure_future(live.stowed())
    waiting = asyncio.ensure_future(at_once.wait())
    running: set[asyncio.Future[Any]] = {stowing, waiting}
    while running == {stowing, waiting}:
        if going := _on_the_way(live):
            lines.print(f"{going}; press Ctrl-C again to stop immediately")
        _, running = await asyncio.wait(running, timeout=_SAID, return_when=asyncio.FIRST_COMPLETED)
    waiting.cancel()
    stowing.cancel()
    done = await asyncio.gather(stowing, return_exceptions=True)
    for error in done:
        if isinstance(error, Exception):
            raise error
    good = list(done) == [True]
    lines.print("the field is stowed" if good else "not all heliostats are stowed")
    return good


def _on_the_way(live: PlantAssembly) -> str:
    """Return the number, states and remaining time of heliostats on their way to stow, or ""."""
    by_state, seconds = live.to_stow()
    if not by_state:
        return ""
    counts = ", ".join(f"{count:,} {state.lower()}" for state, count in by_state.items())
    # To ten seconds: the paths round volumes are longer than the axes' turns.
    known = math.isfinite(seconds)
    about = f"about {max(1, math.ceil(0.1 * seconds)) * 10} s" if known else "time unknown"
    return f"stowing {sum(by_state.values()):,} heliostats ({counts}), {about}"


def line(live: PlantAssembly) -> str:
    """Return one line about a plant: its activity, what comes next, and its pace."""
    summary, work = live.operations.summary(), live.operations.automatic.view()
    counts = dict(summary.states)
    tracking = counts.pop("TRACKING", 0)
    others = sorted(counts.items(), key=lambda one: -one[1])
    field = [f"{tracking:,} of {summary.heliostats:,} tracking"]
    field += [f"{count:,} {_WORDS[state]}" for state, count in others]
    parts = ["EMERGENCY"] if summary.emergency else []
    parts += [", ".join(field), f"{_calibrated_today(live):,} calibrated today{_error(work)}"]
    if summary.clusters_alive < summary.clusters:
        parts.append(_silent(live))
    parts += [f"{_mirrors(run)} on target {run.target}: {run.stage}" for run in work.running]
    if work.reason:
        parts.append(f"no calibration: {work.reason}")
    elif coming := live.operations.automatic.plan(_PLANNED):
        parts.append(f"next: {coming[0].heliostat} on target {coming[0].target}")
    if summary.alarms:
        parts.append(f"{summary.alarms:,} alarm{'s' * (summary.alarms > 1)}")
    if at := pace(summary.pace):
        parts.append(at)
    return f"{summary.at:%H:%M:%S} UTC: {'; '.join(parts)}"


def _calibrated_today(live: PlantAssembly) -> int:
    """Return the number of heliostats calibrated since local midnight, by the mean sun."""
    site, now = live.design.site, live.clock.utc()
    midnight = datetime.combine(solar_day(now, site), datetime.min.time(), UTC)
    begun = midnight - timedelta(hours=site.longitude_deg / 15.0)
    return int((live.operations.viewer.frame().calibrated_at >= begun.timestamp()).sum())


def _error(work: CalibrationView) -> str:
    """Return the median error of the calibrated heliostats; the true error, if it is known."""
    if not work.quality:
        return ""
    last = work.quality[-1]
    true = np.isfinite(last.truth_median)
    kind, value = ("true", last.truth_median) if true else ("predicted", last.median)
    return f" (median {kind} error {1e3 * value:.2f} mrad)" if np.isfinite(value) else ""


def _mirrors(run: Running) -> str:
    """Return the heliostats of a visit in words."""
    return f"{run.heliostat} and {len(run.others)} more" if run.others else run.heliostat


def pace(rate: float) -> str:
    """Return the pace of simulated time in words; empty if it is the pace of real time."""
    return "" if abs(rate - 1.0) < _SLOWER else f"simulated at {rate:.2g} × real time"


def _silent(live: PlantAssembly) -> str:
    """Return the silent clusters, and the reason for the first cluster's silence."""
    rows = live.operations.logbook.cluster_rows(live.operations.plant)
    away = [row for row in rows if not row.alive]
    names = ", ".join(row.name for row in away[:3]) + (", …" if len(away) > 3 else "")
    why = f" ({away[0].problem})" if away and away[0].problem else ""
    return f"{len(away)} of {len(rows)} clusters silent: {names}{why}"


def begin(design: Plant, shown: Shown) -> Ending:
    """Print the name and size of the plant, and check the console; return the `Ending`.

    Raises
    ------
    InputError
        See `check_console`.
    """
    ending = Ending()
    print(f"{design.name}: {len(design):,} heliostats", flush=True)
    check_console(shown)
    return ending


async def at_work(
    live: PlantAssembly,
    keeper: Keeper,
    shown: Shown,
    folder: Path,
    ending: Ending,
    *,
    stows: bool,
    speed: float = 1.0,
) -> None:
    """Run a plant with its local interface, console and archive until it is to end.

    The sockets of the interface are in ``folder``. With ``stows``, the field is stowed before the
    end, as every real field is.
    """
    entry = first_account(live, keeper, shown, folder)
    # Freeze the existing objects; otherwise the collector would visit the objects of 10,000
    # heliostats every ten seconds and block the loop for up to a second.
    gc.freeze()
    gc.set_threshold(*_COLLECTED)
    with contextlib.closing(Lines()) as lines:
        # The archive opens its folder before the plant starts, and is closed after it ends.
        async with (
            archive(live, shown),
            live.running(),
            leaving(live, keeper, shown.evidence),
            interface(live, keeper, shown, folder, entry, lines),
        ):
            await watch(live, shown, ending.asked, lines, speed=speed)
            ending.ask()  # or the time was over
            if stows and not await stow(live, ending.at_once, lines):
                lines.print(live.left())
            await live.end()
        lines.print("ended")
