"""A whole field under real cluster controllers: its processor time, and how soon it is safe.

Clusters of 32 heliostats, each on a bus whose heliostats are rows of the vectorised twin, which
advances in ticks of 50 ms with the integer arithmetic of the boards. Time is virtual and the bus
takes none: add the three calls on the wire (4 ms at 115,200 baud) to the time from an order to the
last heliostat. The limit of processor time, half a core, is the design's; ``clusters`` measures the
clusters alone.
"""

import asyncio
import math
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from benchmarks._run import BenchmarkError, Result, Row
from heliotrope.cluster.config import ClusterConfig, Member, spread_phase
from heliotrope.cluster.controller import Cluster
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, gps_seconds, run_virtual
from heliotrope.links.link import LinkClosedError, SendOutcome, Statistics, running
from heliotrope.links.messages import Acknowledge, Command, Emergency, Lease, Message, encode
from heliotrope.mechanism import kinds
from heliotrope.mechanism.drives import rotary
from heliotrope.sun import Site, broadcast_values, vector
from heliotrope.twin.boards.clocks import SimulatedTime
from heliotrope.twin.boards.outfit import MACHINE, STEPS_PER_TURN
from heliotrope.twin.field.field import Field
from heliotrope.twin.field.field_bus import FieldBus

EACH = 32
SITE = Site(37.4, -6.0, 100.0)
RECEIVER, STANDBY, RADIUS = (0.0, 0.0, 120.0), (15.0, 0.0, 110.0), 6.0
TOKEN, LEASE = 9, 3.0
CORES, ORDER_S, DEFOCUS_S, STOW_S, DARK = 0.5, 1.0, 30.0, 300.0, 0.1


class Line:
    """Both ends of a link, the plant's and the cluster's: a message arrives at once."""

    name, connected, silent_for, problem = "plant", True, 0.0, ""

    def __init__(self) -> None:
        self.statistics = Statistics(opened=1)
        self._waiting: asyncio.Queue[bytes | None] = asyncio.Queue()
        self.closed = False

    async def run(self) -> None:
        """Do nothing: there is nothing to open."""

    async def close(self) -> None:
        """Close the link, which ends all waits."""
        self.closed = True
        self._waiting.put_nowait(None)

    async def send(
        self, data: bytes, *, expires: float | None = None, hold: bool = False
    ) -> SendOutcome:
        """Take a message for the plant."""
        del data, expires, hold
        return SendOutcome.SENT

    def put(self, data: bytes) -> None:
        """Deliver a message of the plant."""
        self._waiting.put_nowait(data)

    async def receive(self) -> bytes:
        """Wait for a message of the plant."""
        data = await self._waiting.get()
        if data is None:
            raise LinkClosedError("closed")
        return data


class Heard:
    """Heliostats that have heard DEFOCUS since `begin`, and the time of the last."""

    def __init__(self, count: int) -> None:
        self._who = np.zeros(count, dtype=np.bool_)
        self.left = count
        self.at = math.nan  # `time.perf_counter` of the last, s

    def begin(self) -> None:
        """Forget all times."""
        self._who[:] = False
        self.left = len(self._who)

    def took(self, name: str, rows: range) -> None:
        """Note which heliostats took a command."""
        if name == "DEFOCUS" and self.left:
            part = self._who[rows.start : rows.stop]
            self.left -= len(part) - int(part.sum())
            part[:] = True
            if not self.left:
                self.at = time.perf_counter()


@dataclass
class Bench:
    """A field and its clusters while they run."""

    clock: VirtualClock
    field: Field
    lines: list[Line]
    times: SimulatedTime
    leases: bool = True
    longest: float = 0.0  # wall time of a second, s

    def tell(self, message: Message) -> None:
        """Send a message to all clusters."""
        data = encode(message)
        for line in self.lines:
            line.put(data)

    def flux(self) -> float:
        """Return the share of the light that is on the receiver."""
        utc = self.clock.utc().timestamp()
        return self.field.flux(vector(utc, SITE), RECEIVER, RADIUS)

    async def live(self, seconds: float, until: Callable[[], bool] | None = None) -> float:
        """Let time pass until a condition holds or the time is over; return the time taken, s."""
        begin, wall = self.clock.monotonic(), time.perf_counter()
        for tick in range(round(20 * seconds)):
            if tick % 20 == 0:
                self.longest, wall = (
                    max(self.longest, time.perf_counter() - wall),
                    (time.perf_counter()),
                )
                if self.leases:
                    self.tell(Lease(TOKEN))
            await asyncio.sleep(0.05)
            self.field.advance(50)
            if until is not None and tick % 5 == 4 and until():
                break
        return self.clock.monotonic() - begin


def _field(count: int) -> Field:
    rng = np.random.default_rng(0)
    away = np.sqrt(rng.uniform(100.0**2, 700.0**2, count))
    bearing = rng.uniform(-1.2, 1.2, count)
    place = np.c_[away * np.sin(bearing), away * np.cos(bearing), np.zeros(count)]
    gear = {"steps_per_turn": 200, "gear_ratio": STEPS_PER_TURN / 800, "microsteps": 4}
    machine = kinds.azimuth_elevation(
        place, pivot_height=3.0, pivot_offset=0.3, drives=(rotary(**gear), rotary(**gear))
    )
    return Field(machine, replace(MACHINE, standby=STANDBY))


def _on_receiver(field: Field, clock: VirtualClock) -> None:
    """Bring the field to the receiver without clusters; this is not measured."""
    field.order("AIM", aim=RECEIVER)
    for second in range(130):
        utc = clock.utc().timestamp() - 130 + second
        values = broadcast_values(int(gps_seconds(clock.utc())) - 130 + second, utc, SITE)
        assert values is not None
        field.take_sun(values)
        if second == 0:
            field.order("APPROACH")
        if second == 110:
            field.order("TRACK")
        field.advance(1000)
    if not (field.state == states.TRACKING).all():
        raise BenchmarkError(f"{(field.state != states.TRACKING).sum()} heliostats do not track")


def _measure(count: int) -> Row:
    heard = Heard(count)

    async def main(clock: VirtualClock) -> Row:
        field, keeper = _field(count), SimulatedTime(clock)
        _on_receiver(field, clock)
        lines, buses, clusters = [], [], []
        for first in range(0, count, EACH):
            rows = range(first, min(count, first + EACH))
            line = Line()
            bus = FieldBus(field, rows, heard.took)
            members = tuple(Member(f"H{row}", row - first + 1) for row in rows)
            phase = spread_phase(first // EACH, -(-count // EACH))
            config = ClusterConfig(f"C{first}", SITE, members, steps_every=5, phase=phase)
            clusters.append(Cluster(config, bus, line, clock, keeper))
            lines.append(line)
            buses.append(bus)
        bench = Bench(clock, field, lines, keeper)
        async with running(*lines, *buses):
            async with running(*clusters):
                row = await _through(bench, heard, count, len(clusters))
            bench.leases = False
            # The clusters have ended; the field is on its own.
            row["stow_after_cluster_loss_s"] = await bench.live(
                STOW_S, lambda: bool((field.state == states.STOWED).all())
            )
        return row

    return run_virtual(main, seed=None)


async def _through(bench: Bench, heard: Heard, count: int, clusters: int) -> Row:
    """Measure tracking, an order, the loss of the plant and a jump of the clock; return figures."""

    def dark() -> bool:
        return bench.flux() < DARK

    # A cluster that starts defocuses its heliostats.
    await _back(bench)
    bench.longest, begin = 0.0, time.process_time()
    await bench.live(10)
    cores = (time.process_time() - begin) / 10.0
    longest, flux = bench.longest, bench.flux()
    heard.begin()
    wall, cpu = time.perf_counter(), time.process_time()
    bench.tell(Emergency("e", "DEFOCUS"))
    at = bench.clock.monotonic()
    while heard.left and bench.clock.monotonic() - at < ORDER_S:
        await asyncio.sleep(0.001)
    # The loop sleeps only when no task has anything to do: all have acknowledged by now.
    order, order_wall = bench.clock.monotonic() - at, heard.at - wall
    order_cpu = time.process_time() - cpu
    row: Row = {
        "heliostats": count, "clusters": clusters, "cores": cores,
        "memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "longest_second_s": longest, "flux_before": flux, "order_s": order,
        "order_processing_s": order_wall, "order_acknowledged_cpu_s": order_cpu,
        "dark_after_order_s": await bench.live(DEFOCUS_S, dark),
    }  # fmt: skip
    await _back(bench)
    bench.leases = False
    row["dark_after_plant_loss_s"] = await bench.live(DEFOCUS_S, dark)
    bench.leases = True
    await bench.live(6)
    await _back(bench)
    bench.times.jump(5.0)
    row["dark_after_clock_jump_s"] = await bench.live(DEFOCUS_S, dark)
    return row


async def _back(bench: Bench) -> None:
    """Bring the field back to the receiver."""
    await bench.live(3)
    bench.tell(Acknowledge("k", "clock_jump", "operator", "operator"))
    bench.tell(Command("r", "REFOCUS", token=TOKEN))
    await bench.live(12)
    if bench.flux() < 0.9:
        raise BenchmarkError(f"only {bench.flux():.2f} of the light is back on the receiver")


def run(quick: bool) -> Result:
    """Return the figures."""
    rows = [_measure(64)] if quick else [_measure(10_000)]
    last = rows[-1]
    limits = {
        "cores": CORES, "order_s": ORDER_S, "order_processing_s": ORDER_S,
        "dark_after_order_s": DEFOCUS_S, "dark_after_plant_loss_s": DEFOCUS_S,
        "dark_after_clock_jump_s": DEFOCUS_S, "stow_after_cluster_loss_s": STOW_S,
    }  # fmt: skip
    kept = {name: float(last[name] or 0.0) < limit for name, limit in limits.items()}
    return Result(
        rows,
        f"{last['heliostats']:,} heliostats under {last['clusters']} clusters: "
        f"{float(last['cores'] or 0.0):.2f} cores, dark "
        f"{float(last['dark_after_order_s'] or 0.0):.1f} s after an order",
        {f"limit_{name}": limit for name, limit in limits.items()},
        None if quick else all(kept.values()),
    )
