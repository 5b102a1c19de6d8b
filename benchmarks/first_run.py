"""The first minutes of ``heliotrope run``, as a newcomer sees them.

It starts the program, signs in by the one-time link that it prints, and follows the page's own live
stream. The time of the simulated field comes from its server, the work of each process from /proc.
At the end it presses Ctrl-C and waits until every process has ended.
"""

import argparse
import contextlib
import os
import queue
import re
import signal
import subprocess
import sys
import threading
import time
import tomllib
from collections import defaultdict
from collections.abc import Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import numpy.typing as npt

from benchmarks._run import BenchmarkError, Neighbours, Result, Row
from heliotrope.console.headers import cookie_of
from heliotrope.console.settings import ConsoleSettings
from heliotrope.console.stream import LiveMessage, read_message
from heliotrope.plant.io.followed_clock import ClockReader

#: Limits of the design, for 10,000 heliostats on two cores; the field of Malan's boards is raised
#: from stow, so what tracks at first is not limited there.
PAGE_S, TRACKING, FIRST_S, BEHIND_S, END_S = 15.0, 0.9, 60.0, 1.0, 3.0
PLANT_CORES, TWIN_CORES = 0.4, 0.6
#: Minutes after the page, and the new calibrations by then, of at most the whole field.
CALIBRATED = {5.0: 50, 15.0: 300}
#: Longest wait for the page, for an answer, and for the end, s.
STARTING, PATIENCE, ENDING = 180.0, 60.0, 120.0
#: Time between messages of the live stream, s.
PERIOD = 1.0
COMMAND = (sys.executable, "-c", "from heliotrope.cli import main; main()", "run")
LINK = re.compile(r"^console: (\S+)$")


# -- processes -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Process:
    """A process of this machine: its parent, command, start (ticks) and work done (s)."""

    parent: int
    command: tuple[str, ...]
    start: int
    work: float


def process_of(stat: str, cmdline: bytes, tick: float) -> Process:
    """Return a process by its files ``stat`` and ``cmdline`` in /proc; ``tick``: ticks per second.

    The name of the program, in brackets, may hold spaces and brackets.
    """
    fields = stat[stat.rindex(")") + 2 :].split()
    words = tuple(word.decode(errors="replace") for word in cmdline.split(b"\0") if word)
    work = (int(fields[11]) + int(fields[12])) / tick
    return Process(int(fields[1]), words, int(fields[19]), work)


def processes() -> dict[int, Process]:
    """Return all processes of this machine by their number."""
    tick, found = float(os.sysconf("SC_CLK_TCK")), {}
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has just ended
            stat = (folder / "stat").read_text(encoding="utf-8", errors="replace")
            cmdline = (folder / "cmdline").read_bytes()
            if cmdline:  # not a process that has ended, nor one of the kernel
                found[int(folder.name)] = process_of(stat, cmdline, tick)
    return found


def roles(first: int, known: Mapping[int, Process]) -> dict[int, str]:
    """Return the part that each process of a plant plays, by its number.

    ``first`` is the plant. Its children are the simulated field (whose children draw), the console,
    and processes that compute for it.
    """
    found = {first: "plant"} if first in known else {}
    waiting = list(found)
    while waiting:
        parent = waiting.pop()
        for number, process in known.items():
            if process.parent == parent and number not in found:
                found[number] = _role(found[parent], process.command)
                waiting.append(number)
    return found


def _role(parent: str, command: tuple[str, ...]) -> str:
    if parent != "plant":
        return "drawing" if parent == "twin" else parent
    if "twin" in command:
        return "twin"
    console = any(word.startswith("heliotrope.console") for word in command)
    return "console" if console else "computing"


class Work:
    """The work of the processes of a plant."""

    def __init__(self, first: int) -> None:
        self._first = first
        self._seen: dict[int, tuple[str, Process]] = {}
        self._before: dict[int, float] = {}
        self._since = 0.0

    def look(self) -> None:
        """Note the work that each has done so far."""
        known = processes()
        for number, role in roles(self._first, known).items():
            self._seen[number] = role, known[number]

    def begin(self) -> None:
        """Count from now on."""
        self.look()
        self._since = time.monotonic()
        self._before = {number: process.work for number, (_, process) in self._seen.items()}

    def cores(self) -> dict[str, float]:
        """Return the cores that each part has taken since `begin`."""
        self.look()
        found, span = defaultdict[str, float](float), time.monotonic() - self._since
        for number, (role, process) in self._seen.items():
            found[role] += (process.work - self._before.get(number, 0.0)) / span
        return found

    def folder(self) -> Path:
        """Return the folder of the simulated field.

        Raises
        ------
        BenchmarkError
            If there is no simulated field.
        """
        for role, process in self._seen.values():
            if role == "twin" and "--folder" in process.command:
                return Path(process.command[process.command.index("--folder") + 1])
        raise BenchmarkError("the plant has no process of a simulated field")

    def left(self) -> set[int]:
        """Return the processes that have not ended."""
        known = processes()
        return {
            number
            for number, (_, process) in self._seen.items()
            if number in known and known[number].start == process.start
        }


# -- the page ------------------------------------------------------------------------------


@dataclass
class Followed:
    """What the messages of the live stream show.

    Attributes
    ----------
    heliostats
        Number of them.
    behind
        Largest lateness of what is shown against the time of the simulated field, s.
    calibrated
        Seconds after the first message at which each new calibration was shown.
    """

    heliostats: int
    behind: float = 0.0
    calibrated: list[float] = field(default_factory=list)
    _times: npt.NDArray[np.uint32] = field(init=False)
    _first: tuple[float, float] | None = None
    _last: float = 0.0

    def __post_init__(self) -> None:
        self._times = np.zeros(self.heliostats, np.uint32)

    def take(self, message: LiveMessage, wall: float, utc: float) -> None:
        """Take a message that came at a wall time, s, when it was ``utc`` at the field, POSIX s.

        A plant that stood still shows nothing meanwhile, and its next message is fresh again: a
        pause between two messages counts as far as it is longer than their period.
        """
        shown, rows = float(message.header["utc"]), message.rows
        if self._first is None:
            self._first, self._last = (wall, shown), shown
        pause = shown - self._last - PERIOD
        self.behind, self._last = max(self.behind, utc - shown, pause), shown
        times = rows["calibrated"]
        fresh = (times > self._times[rows["row"]]) & (times >= self._first[1])
        self.calibrated += [wall - self._first[0]] * int(fresh.sum())
        self._times[rows["row"]] = times

    def after(self, minutes: float) -> int:
        """Return the number of new calibrations in some minutes after the first message."""
        return sum(at <= 60.0 * minutes for at in self.calibrated)


class Page:
    """A signed-in page of a console.

    Parameters
    ----------
    link
        The one-time link.

    Raises
    ------
    BenchmarkError
        If the link does not sign in, or there is no page.
    """

    def __init__(self, link: str) -> None:
        self._url = link[: link.index("enter")]
        self._http = httpx.Client(base_url=self._url, timeout=PATIENCE, trust_env=False)
        answer = self._http.get(link, follow_redirects=True)
        # The console of a run of one's own is plain HTTP on this machine.
        self._cookie = cookie_of(ConsoleSettings())
        if answer.status_code != 200 or self._cookie not in self._http.cookies:
            raise BenchmarkError(f"the one-time link answers {answer.status_code}")

    def get(self, path: str) -> Any:
        """Return the answer of a path of the API."""
        answer = self._http.get(f"api/v1/{path}")
        if not answer.is_success:
            raise BenchmarkError(f"GET {path}: {answer.status_code} {answer.text[:200]}")
        return answer.json()

    def lit(self) -> Future[tuple[float, float]]:
        """Return when the flux map is there, wall time in s, and its largest flux, W/m²."""
        (name, *_), done = self.get("field")["receivers"] or [""], Future[tuple[float, float]]()

        def wait() -> None:
            while name and not done.cancelled():
                # It is refused until the first map is computed.
                answer = self._http.get(f"api/v1/receivers/{name}/flux")
                if answer.is_success:
                    peak = float(np.max(answer.json()["flux"]))
                    done.set_result((time.monotonic(), peak))
                    return
                time.sleep(0.2)

        threading.Thread(target=wait, daemon=True).start()
        return done

    def follow(self, seen: Followed, reader: ClockReader, until: float) -> None:
        """Follow the live stream until a wall time, s."""
        from websockets.sync.client import connect

        headers = {"Cookie": f"{self._cookie}={self._http.cookies[self._cookie]}"}
        url = f"ws{self._url.removeprefix('http')}api/v1/live"
        with connect(url, additional_headers=headers, proxy=None, max_size=None) as socket:
            while (left := until - time.monotonic()) > 0.0:
                try:
                    data = socket.recv(timeout=min(left, PATIENCE))
                except TimeoutError:
                    if left > PATIENCE:
                        raise BenchmarkError(f"no live message for {PATIENCE:g} s") from None
                    return
                assert isinstance(data, bytes)
                wall, state = time.monotonic(), reader.state
                seen.take(read_message(data), wall, state.utc + state.at(wall) - state.now)


# -- the program ---------------------------------------------------------------------------


class Program:
    """``heliotrope run`` in a process group of its own, as a terminal starts it."""

    def __init__(self, *options: str) -> None:
        self.begun = time.monotonic()
        self._process = subprocess.Popen(
            [*COMMAND, *options, "--port", "0", "--no-browser"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        self.work, self.text = Work(self._process.pid), ""
        self._lines = queue.Queue[str]()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.put(line.rstrip())
        self._lines.put("")

    def link(self) -> str:
        """Wait for the line with the one-time link, and return it.

        Raises
        ------
        BenchmarkError
            If it does not come.
        """
        while True:
            try:
                line = self._lines.get(timeout=self.begun + STARTING - time.monotonic())
            except (queue.Empty, ValueError):
                raise BenchmarkError(f"no page within {STARTING:g} s: {self.text}") from None
            if found := LINK.match(line):
                return found[1]
            if not line:
                raise BenchmarkError(f"the program has ended: {self.text}")
            self.text += f"{line}; "

    def interrupt(self) -> float:
        """Press Ctrl-C; return the time until every process has ended, s.

        Raises
        ------
        BenchmarkError
            If some have not ended.
        """
        self.work.look()
        pressed = time.monotonic()
        os.killpg(self._process.pid, signal.SIGINT)
        while self.work.left():
            self._process.poll()
            if time.monotonic() > pressed + ENDING:
                raise BenchmarkError(f"{len(self.work.left())} processes run {ENDING:g} s later")
            time.sleep(0.02)
        return time.monotonic() - pressed

    def close(self) -> None:
        """Kill it if it runs; its children end with it."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()


@contextlib.contextmanager
def _program(*options: str) -> Iterator[Program]:
    program = Program(*options)
    try:
        yield program
    finally:
        program.close()


# -- the figures ---------------------------------------------------------------------------


def limited(
    figure: str, value: float | None, least: float | None = None, most: float | None = None
) -> Row:
    """Return a figure beside its limit, of which there is at most one; None was not seen."""
    limit = f"≥ {least:g}" if least is not None else f"≤ {most:g}" if most is not None else ""
    if value is not None and not np.isfinite(value):
        value = None
    kept = (
        value is not None and (least is None or value >= least) and (most is None or value <= most)
    )
    return {"figure": figure, "value": value, "limit": limit, "kept": kept if limit else None}


@dataclass(frozen=True)
class Measured:
    """What was measured of one run; times in s, errors in mrad, flux in kW/m².

    ``raised``: the field tracks when the page opens, and has a receiver.
    """

    heliostats: int
    page: float
    tracking: int
    lit: float | None
    flux: float
    seen: Followed
    minutes: float
    pace: float
    predicted: float | None
    true: float | None
    cores: Mapping[str, float]
    others: float
    load: float
    ended: float
    raised: bool

    def rows(self) -> list[Row]:
        """Return the figures beside the limits of the design."""
        seen, cores, raised = self.seen, self.cores, self.raised
        first = min(seen.calibrated, default=None)
        rows = [
            limited("page answers after the command, s", self.page, most=PAGE_S),
            limited(
                "mirrors that track then, share",
                self.tracking / self.heliostats,
                least=TRACKING if raised else None,
            ),
            limited("flux map after the command, s", self.lit, most=PAGE_S if raised else None),
            limited("its largest flux, kW/m²", self.flux, least=1.0 if raised else None),
            limited("first new calibration after the page, s", first, most=FIRST_S),
        ]
        rows += [
            limited(
                f"new calibrations after {after:g} min",
                seen.after(after),
                least=min(least, self.heliostats),
            )
            for after, least in CALIBRATED.items()
            if after <= self.minutes
        ]
        return [
            *rows,
            limited("median predicted error at the end, mrad", self.predicted),
            limited("median true error at the end, mrad", self.true),
            limited("furthest behind the field's time, s", seen.behind, most=BEHIND_S),
            limited("simulated seconds per second", self.pace),
            limited("cores: plant", cores["plant"], most=PLANT_CORES),
            limited("cores: simulated field", cores["twin"], most=TWIN_CORES),
            limited("cores: drawing photographs", cores["drawing"]),
            limited("cores: computing for the plant", cores["computing"]),
            limited("cores: console", cores["console"]),
            limited("cores: other programs", self.others),
            limited("load average at the end", self.load),
            limited("Ctrl-C until all processes have ended, s", self.ended, most=END_S),
        ]


def measure(options: list[str], minutes: float, *, raised: bool) -> Measured:
    """Run the program with some options, and measure it for some minutes after its page."""
    with _program(*options) as program:
        page = Page(program.link())
        answered = time.monotonic()
        summary, lit = page.get("summary"), page.lit()
        program.work.begin()
        others = Neighbours()
        links = tomllib.loads((program.work.folder() / "links.toml").read_text(encoding="utf-8"))
        with contextlib.closing(ClockReader(links["twin"])) as reader:
            seen, first = Followed(int(summary["heliostats"])), reader.state
            page.follow(seen, reader, answered + 60.0 * minutes)
            pace = (reader.state.now - first.now) / (reader.state.wall - first.wall)
        cores, busy = program.work.cores(), others.cores()
        at, peak = lit.result(0.0) if lit.done() else (None, 0.0)
        load, quality = os.getloadavg()[0], page.get("calibration")["quality"]
        receivers = page.get("field")["receivers"]
        errors = [
            1e3 * quality[-1][name] if quality and quality[-1][name] is not None else None
            for name in ("median", "truth_median")
        ]
        return Measured(
            heliostats=seen.heliostats,
            page=answered - program.begun,
            tracking=summary["states"].get("TRACKING", 0),
            lit=None if at is None else at - program.begun,
            flux=1e-3 * peak,
            seen=seen,
            minutes=minutes,
            pace=pace,
            predicted=errors[0],
            true=errors[1],
            cores=cores,
            others=max(0.0, busy - sum(cores.values())),
            load=load,
            ended=program.interrupt(),
            raised=raised and bool(receivers),
        )


def options() -> argparse.ArgumentParser:
    """Return the options of this benchmark."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks first_run")
    plant = parser.add_mutually_exclusive_group()
    plant.add_argument("--heliostats", type=int, default=10_000, help="instead of 10,000")
    plant.add_argument("--prototype", action="store_true", help="Malan's 18 on boards")
    parser.add_argument("--minutes", type=float, default=5.0, help="after the page; 15 for all")
    return parser


def run(
    quick: bool, *, heliostats: int = 10_000, prototype: bool = False, minutes: float = 5.0
) -> Result:
    """Return the figures."""
    if quick:
        heliostats, minutes = 32, 0.1
    plant = ["--prototype"] if prototype else ["--heliostats", str(heliostats)]
    found = measure(plant, minutes, raised=not prototype)
    rows = found.rows()
    missed = [str(row["figure"]) for row in rows if row["kept"] is False]
    return Result(
        rows,
        f"{found.heliostats:,} heliostats: page after {found.page:.1f} s, "
        f"{found.tracking:,} track, {len(found.seen.calibrated)} new calibrations in "
        f"{minutes:g} min; "
        + (f"limits not kept: {', '.join(missed)}" if missed else "all limits kept"),
        {"heliostats": found.heliostats, "minutes": minutes},
        None if quick else not missed,
    )
