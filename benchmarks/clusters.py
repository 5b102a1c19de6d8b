"""Cluster controllers: processor time per second of one with 32 heliostats, alone or among many.

The bus answers at once with prepared frames and the link carries nothing, so that only the cluster
is measured, without bus, heliostats, network and plant. Processor time is measured in virtual time.
The delay of a cluster's status is measured in real time, with the seconds of all clusters in phase
and spread: in phase, the last waits for all others.
"""

import asyncio
import time
from collections.abc import Callable
from typing import ClassVar

import numpy as np

from benchmarks._run import Result, Row
from heliotrope.cluster._nodes import SEQUENCES, STATUS, STEPS
from heliotrope.cluster.config import ClusterConfig, Member, spread_phase
from heliotrope.cluster.controller import Cluster
from heliotrope.cluster.timekeeping import SystemTime
from heliotrope.lcu import messages, wire
from heliotrope.links.clock import Clock, SystemClock, VirtualClock, run_virtual
from heliotrope.links.link import LinkClosedError, SendOutcome, Statistics, running
from heliotrope.links.messages import ClusterStatus, Lease, decode, encode
from heliotrope.sun import Site

HELIOSTATS = 32
BUDGET_MS = 1.5
SITE = Site(37.09, -2.36, 500.0)
ANSWERS: dict[str, tuple[str, tuple[int, ...]]] = {
    "QUERY_STATUS": ("STATUS", (5, 0x1F, 0, 12345, 600, 24000, 25, 0xDEADBEEF, 3)),
    "QUERY_STEPS": ("STEPS", (123456, 234567, 123500, 234600)),
    # For a machine so busy that leases lapse.
    **{name: ("ACK", (0, messages.NUMBER_OF[name], 0)) for name in ("DEFOCUS", "STOW")},
}


class ReadyBus:
    """A bus with prepared answers, shared by all buses."""

    connected, closed = True, False
    _answers: ClassVar[dict[bytes, bytes]] = {}

    def __init__(self) -> None:
        self.frames = 0

    async def run(self) -> None:
        """Do nothing: there is nothing to open."""

    async def close(self) -> None:
        """Do nothing: there is nothing to close."""

    async def transmit(
        self, frame: bytes, *, expires: float | None = None, urgent: bool = False
    ) -> SendOutcome:
        """Count a frame."""
        del frame, expires, urgent
        self.frames += 1
        return SendOutcome.SENT

    async def transact(
        self,
        frame: bytes,
        timeout: float,
        *,
        expires: float | None = None,
        urgent: bool = False,
        complete: object = None,
    ) -> bytes:
        """Answer a question."""
        del timeout, expires, urgent, complete
        self.frames += 1
        return self._answers.get(frame) or self.ready(frame)

    @classmethod
    def ready(cls, frame: bytes) -> bytes:
        """Return the answer to a question."""
        (asked,) = wire.Reader().feed(frame)
        name, values = ANSWERS[asked.name]
        number = messages.NUMBER_OF[name]
        payload = wire.pack(name, *values)
        answer = wire.encode(wire.Frame(0, asked.to, asked.sequence, number, payload))
        cls._answers[frame] = answer
        return answer


class LeasingLink:
    """A link that brings a lease every second and keeps the last message sent."""

    name, connected, silent_for, problem = "plant", True, 0.0, ""

    def __init__(self) -> None:
        self.statistics = Statistics(opened=1)
        self._closing = asyncio.Event()
        self._lease = encode(Lease(7))
        self.last = b""
        self.told: Callable[[], None] | None = None

    @property
    def closed(self) -> bool:
        """Whether the link was closed for good."""
        return self._closing.is_set()

    async def run(self) -> None:
        """Wait until the link is closed."""
        await self._closing.wait()

    async def close(self) -> None:
        """Close the link, which ends `run`."""
        self._closing.set()

    async def send(
        self, data: bytes, *, expires: float | None = None, hold: bool = False
    ) -> SendOutcome:
        """Keep a message."""
        del expires, hold
        self.last = data
        if self.told is not None:
            self.told()
        return SendOutcome.SENT

    async def receive(self) -> bytes:
        """Return a lease after a second."""
        try:
            async with asyncio.timeout(1.0):
                await self._closing.wait()
        except TimeoutError:
            return self._lease
        raise LinkClosedError("closed")


def _cluster(
    number: int, clock: Clock, keeper: SystemTime, phase: float
) -> tuple[Cluster, ReadyBus, LeasingLink]:
    members = tuple(Member(f"H{number}.{n}", n) for n in range(1, HELIOSTATS + 1))
    bus, link = ReadyBus(), LeasingLink()
    config = ClusterConfig(f"C{number}", SITE, members, phase=phase)
    return Cluster(config, bus, link, clock, keeper), bus, link


def _prepare() -> None:
    """Make all questions and their answers, once in a process."""
    for address in range(1, HELIOSTATS + 1):
        for sequence in range(1, SEQUENCES + 1):
            for question in (STATUS, STEPS):
                ReadyBus.ready(question.frame(address, sequence))


def _measure(count: int, seconds: int) -> Row:
    async def main(clock: VirtualClock) -> Row:
        keeper = SystemTime(clock)
        parts = [_cluster(n, clock, keeper, spread_phase(n, count)) for n in range(count)]
        clusters = [part[0] for part in parts]
        async with running(*(part[2] for part in parts)), running(*clusters):
            await asyncio.sleep(5.0)
            frames = sum(bus.frames for _, bus, _ in parts)
            begin = time.process_time()
            await asyncio.sleep(float(seconds))
            took = time.process_time() - begin
            frames = sum(bus.frames for _, bus, _ in parts) - frames
            heard = [_heard(link) for _, _, link in parts]
        return {
            "clusters": count,
            "heliostats": count * HELIOSTATS,
            "seconds": seconds,
            "frames_per_cluster_second": frames / count / seconds,
            "heard": sum(heard),
            "processor_ms_per_cluster_second": 1e3 * took / count / seconds,
            "cores_for_all": took / seconds,
        }

    return run_virtual(main, seed=None)


def _lateness(count: int, seconds: int, *, spread: bool) -> tuple[float, float]:
    """Return the delay of the clusters' status after a second, s: median and last."""
    late: list[float] = []

    async def main() -> None:
        clock = SystemClock()
        keeper = SystemTime(clock)
        parts = []
        for number in range(count):
            phase = spread_phase(number, count) if spread else 0.0
            part = _cluster(number, clock, keeper, phase)
            part[2].told = lambda phase=phase: late.append((keeper.time().gps_s - phase) % 1.0)
            parts.append(part)
        async with running(*(part[2] for part in parts)), running(*(part[0] for part in parts)):
            # Clusters approach their phase by a tenth of a second at a time.
            await asyncio.sleep(6.0)
            late.clear()
            await asyncio.sleep(float(seconds))

    asyncio.run(main())
    return float(np.median(late)), max(late)


def _heard(link: LeasingLink) -> int:
    """Return the number of heliostats heard within a second, by the last status."""
    status = decode(link.last)
    assert isinstance(status, ClusterStatus)
    return int(np.sum(status.nodes()["heard_ms"] < 1000))


def run(quick: bool) -> Result:
    """Return the figures."""
    sizes = ((1, 20), (4, 5)) if quick else ((1, 240), (32, 20), (313, 10))
    _prepare()
    rows = [_measure(count, seconds) for count, seconds in sizes]
    last = rows[-1]
    figures: dict[str, float | int | str] = {"budget_ms": BUDGET_MS}
    if not quick:
        for name, spread in (("in_phase", False), ("spread", True)):
            half, worst = _lateness(sizes[-1][0], 6, spread=spread)
            figures |= {f"told_after_s_{name}": half, f"told_last_after_s_{name}": worst}
    each = float(last["processor_ms_per_cluster_second"] or 0.0)
    return Result(
        rows,
        f"{each:.2f} ms of a core for a second of one cluster; {last['heliostats']:,} heliostats "
        f"take {float(last['cores_for_all'] or 0.0):.2f} cores",
        figures,
        None if quick else each <= BUDGET_MS,
    )
