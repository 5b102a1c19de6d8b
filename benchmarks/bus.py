"""The serial bus: time of a transaction and of a poll cycle of 32, beside the wire's own time.

Master and local controllers run as separate programs. Between them is either one pseudo-terminal,
which carries bytes at once and so shows the time that the programs take, or the tests' bus of
pseudo-terminals, on which bytes take the time of a UART.
"""

import asyncio
import contextlib
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator

from benchmarks._run import ROOT, BenchmarkError, Result, Row
from heliotrope.cluster.serial_bus import BusSettings, SerialBus
from heliotrope.lcu import wire
from heliotrope.lcu.sender import Sender
from heliotrope.links.clock import SystemClock
from heliotrope.links.link import running

sys.path.append(str(ROOT / "tests"))

from support.paced_pty import PacedBus

HELIOSTATS = 32
BAUD_RATES = (19_200, 115_200, 921_600)
BUDGET_S = 1.0
QUESTIONS = {"QUERY_STEPS": "STEPS", "QUERY_STATUS": "STATUS"}
_ANSWER = 1.0


@contextlib.contextmanager
def _nodes(port: str, given: tuple[int, ...] = ()) -> Iterator[None]:
    """Run the local controllers at a port."""
    with subprocess.Popen(
        [sys.executable, "-m", "benchmarks._bus_nodes", port],
        cwd=ROOT,
        pass_fds=given,
        stdout=subprocess.PIPE,
        text=True,
    ) as nodes:
        assert nodes.stdout is not None
        try:
            if nodes.stdout.readline() != "ready\n":
                raise BenchmarkError("the local controllers' process does not start")
            yield
        finally:
            nodes.terminate()


@contextlib.contextmanager
def _line(baud_rate: int | None) -> Iterator[str]:
    """Yield the master's port, with local controllers at its other end; None: unpaced."""
    if baud_rate is not None:
        with PacedBus(2, baud_rate) as bus, _nodes(bus.paths[1]):
            yield bus.paths[0]
        return
    near, far = os.openpty()
    try:
        with _nodes(str(near), (near,)):
            yield os.ttyname(far)
    finally:
        os.close(near)
        os.close(far)


async def _poll(
    port: str, settings: BusSettings, cycles: int
) -> dict[str, list[tuple[float, int]]]:
    """Return time (s) and bytes of each transaction, by question."""
    clock, sender = SystemClock(), Sender(0, 1)
    bus = SerialBus(port, clock, settings)
    found: dict[str, list[tuple[float, int]]] = {question: [] for question in QUESTIONS}
    async with running(bus):
        await bus.opened()
        for cycle in range(cycles + 1):
            for question, wanted in QUESTIONS.items():
                for address in range(1, HELIOSTATS + 1):
                    frame = sender.frame(address, question)
                    begin = time.perf_counter()
                    heard = await bus.transact(frame, _ANSWER)
                    took = time.perf_counter() - begin
                    answers = wire.Reader().feed(heard)
                    if [answer.name for answer in answers] != [wanted]:
                        raise BenchmarkError(f"{question} to {address}: {heard!r} was answered")
                    if cycle > 0:  # the first warms up
                        found[question].append((took, len(frame) + len(heard)))
    return found


def _row(line: str, question: str, found: list[tuple[float, int]], settings: BusSettings) -> Row:
    times = sorted(took for took, _ in found)
    size = statistics.mean(size for _, size in found)
    paced = line != "unpaced"
    wire_s = settings.duration(round(size)) if paced else 0.0
    return {
        "line": line,
        "question": question,
        "transactions": len(times),
        "bytes": size,
        "wire_ms": 1e3 * wire_s,
        "gap_ms": 1e3 * settings.quiet,
        "median_ms": 1e3 * statistics.median(times),
        "p99_ms": 1e3 * times[int(0.99 * len(times))],
        "others_ms": 1e3 * (statistics.median(times) - wire_s - settings.quiet),
        "cycle_of_32_s": HELIOSTATS * statistics.mean(times),
        "bytes_per_second": size / statistics.mean(times),
    }


def run(quick: bool) -> Result:
    """Return the figures."""
    rows: list[Row] = []
    for baud_rate in (None, 115_200) if quick else (None, *BAUD_RATES):
        settings = BusSettings(baud_rate=baud_rate or 115_200)
        with _line(baud_rate) as port:
            found = asyncio.run(_poll(port, settings, 1 if quick else 5))
        line = "unpaced" if baud_rate is None else f"{baud_rate:,} baud"
        rows += [_row(line, question, times, settings) for question, times in found.items()]
    usual = [row for row in rows if row["line"] == "115,200 baud"]
    cycle = sum(float(row["cycle_of_32_s"] or 0.0) for row in usual)
    median = statistics.mean(float(row["median_ms"] or 0.0) for row in usual)
    return Result(
        rows,
        f"at 115,200 baud {median:.1f} ms a transaction; steps and status of 32 heliostats "
        f"in {cycle:.2f} s",
        {"budget_cycle_s": BUDGET_S},
        None if quick else cycle <= BUDGET_S,
    )
