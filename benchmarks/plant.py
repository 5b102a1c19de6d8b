"""The plant with 10,016 heliostats in 313 clusters: CPU for a second of operation, an emergency.

Its links take and give messages at once, so that only the plant is measured: decoding and keeping
each cluster's status, leases, the safety table, the order, and all answers to it. The mirrors
track: their step counts follow the sun. The checks of what is reported against what the plant knows
are measured within it: pointing, time and site, identity, doubtful counts, and beams in volumes.
"""

import asyncio
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._run import BenchmarkError, Result, Row
from heliotrope.field.example import azimuth_elevation
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.layouts import malan_plant
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver
from heliotrope.field.volumes import Box, Cylinder, Volume
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.link import LinkClosedError, SendOutcome, Statistics
from heliotrope.links.messages import (
    NODE,
    ClusterStatus,
    Emergency,
    Progress,
    Stage,
    decode,
    encode,
)
from heliotrope.plant.controller import PlantController, Stores
from heliotrope.plant.field.agreement import Agreement
from heliotrope.plant.field.aims import BeamCheck
from heliotrope.plant.field.assigned import Points
from heliotrope.plant.field.doubtful_positions import DoubtfulPositions
from heliotrope.plant.field.identity import Identities
from heliotrope.plant.field.state import FieldState
from heliotrope.plant.motion.paths import Paths
from heliotrope.plant.motion.stray_beams import StrayBeams
from heliotrope.plant.motion.watch import BeamWatch
from heliotrope.plant.orders.audit import JsonLines
from heliotrope.sun import Site, vector

MEMBERS = 32
#: A place that no beam of the benchmark reaches.
VOLUMES = (
    Box("house", (0.0, -300.0, 5.0), (30.0, 20.0, 10.0)),
    Cylinder("mast", (900.0, 0.0, 0.0), (900.0, 0.0, 60.0), 2.0),
)
#: Budget: half a core for the plant and the twin together.
BUDGET_S = 0.5
ORDER_BUDGET_S = 1.0
#: Time at which mirrors at rest are looked at, POSIX s: 2026-06-21 10:00 UTC.
_MORNING = 1_782_036_000.0
#: Turns of the loop until an order is with all links.
_TURNS = 10_000
#: Angles by which both axes turn away on DEFOCUS, rad.
_AWAY = (0.1, 0.05)
#: Budget of the checks alone.
CHECKS_BUDGET_S = 0.1
#: The checks: classes and methods.
CHECKS: tuple[tuple[type[Any], str], ...] = (
    (Agreement, "on_status"),
    (Agreement, "readings"),
    (BeamWatch, "readings"),
    (Identities, "on_status"),
    (Identities, "off"),
    (DoubtfulPositions, "on_status"),
)


@contextmanager
def _measured() -> Iterator[list[float]]:
    """Measure the CPU time of the checks, s, in the only item of a list."""
    spent = [0.0]

    def timed(method: Any) -> Any:
        def timing(*given: Any, **more: Any) -> Any:
            begin = time.process_time()
            found = method(*given, **more)
            spent[0] += time.process_time() - begin
            return found

        return timing

    before = [(of, name, getattr(of, name)) for of, name in CHECKS]
    for of, name, method in before:
        setattr(of, name, timed(method))
    try:
        yield spent
    finally:
        for of, name, method in before:
            setattr(of, name, method)


class _Direct:
    """A link that is always connected."""

    silent_for, problem, connected = 0.0, "", True

    def __init__(self, name: str) -> None:
        self.name, self.closed, self.statistics = name, False, Statistics(opened=1)
        self.sent: list[bytes] = []
        self.arrived: asyncio.Queue[bytes] = asyncio.Queue()
        self._end = asyncio.Event()

    async def run(self) -> None:
        await self._end.wait()

    async def send(
        self, data: bytes, *, expires: float | None = None, hold: bool = False
    ) -> SendOutcome:
        del expires, hold
        self.sent.append(data)
        return SendOutcome.SENT

    async def receive(self) -> bytes:
        if self.closed:
            raise LinkClosedError("closed")
        return await self.arrived.get()

    async def close(self) -> None:
        self.closed = True
        self._end.set()


def _design(clusters: int) -> Plant:
    count = clusters * MEMBERS
    rng = np.random.default_rng(0)
    places = rng.uniform((-800.0, 100.0, 0.0), (800.0, 1200.0, 0.0), (count, 3))
    return Plant(
        "large",
        Site(37.09, -2.36, 500.0),
        {
            "all": Heliostats(
                tuple(f"H{i:05d}" for i in range(count)),
                azimuth_elevation(places),
                np.full(count, 3.0),
                np.full(count, 2.0),
                cluster=tuple(f"K{i // MEMBERS:03d}" for i in range(count)),
            )
        },
        receivers=(
            Receiver(
                "receiver",
                "planar",
                np.array([0.0, 0.0, 200.0]),
                np.array([0.0, 1.0, 0.0]),
                10.0,
                10.0,
            ),
        ),
    )


class _Run:
    """A plant, and the CPU time that its parts took, s."""

    def __init__(
        self,
        clock: VirtualClock,
        clusters: int,
        seconds: int,
        folder: Path,
        volumes: Sequence[Volume] = (),
    ) -> None:
        self.clock, self.seconds = clock, seconds
        design = _design(clusters)
        self.names = design.names
        self.links = [_Direct(f"K{k:03d}") for k in range(clusters)]
        audit = JsonLines(folder / "audit.jsonl", clock.utc())
        links = {x.name: x for x in self.links}
        self.plant = PlantController(
            replace(design, keep_outs=tuple(volumes)), links, clock, Stores(audit)
        )
        self.rows = np.zeros(len(design), NODE)
        self.rows["state"] = states.TRACKING
        self.plant.aims[:] = np.broadcast_to(design.receivers[0].center, (len(design), 3))

    def _track(self) -> None:
        """Put the axes of all mirrors where their beams meet the receiver now."""
        everybody = np.arange(len(self.names), dtype=np.intp)
        found = self.plant.beams.poses(everybody, self.plant.aims, self.plant.sun_vector())
        counts = found.best_counts
        for axis, name in enumerate(("primary", "secondary")):
            self.rows[name] = self.rows[f"{name}_goal"] = counts[:, axis]

    def _members(self, k: int) -> tuple[str, ...]:
        return self.names[k * MEMBERS : (k + 1) * MEMBERS]

    def _defocus(self) -> None:
        """Turn both axes of all mirrors away, as a local controller does on DEFOCUS."""
        everybody = np.arange(len(self.names), dtype=np.intp)
        found = self.plant.beams.poses(everybody, self.plant.aims, self.plant.sun_vector())
        table = self.plant.design.groups["all"].mechanism.drives
        counts = table.counts(found.best_angles + np.array(_AWAY))
        self.rows["state"] = states.DEFOCUSED
        for axis, name in enumerate(("primary", "secondary")):
            self.rows[name] = self.rows[f"{name}_goal"] = counts[:, axis]

    def _report(self, *, greet: bool = False, track: bool = True) -> None:
        if track:
            self._track()
        for k, link in enumerate(self.links):
            names = self._members(k) if greet else ()
            status = ClusterStatus(
                link.name,
                MEMBERS,
                self.clock.utc().timestamp(),
                "gps",
                1e-3,
                3.0,
                0.2,
                names=names,
                block=self.rows[k * MEMBERS : (k + 1) * MEMBERS].tobytes(),
            )
            link.arrived.put_nowait(encode(status))

    async def steady(self) -> tuple[float, float]:
        """Return the CPU for a second of operation, and of its checks.

        The clusters' encoding of the status is not counted.
        """
        await asyncio.sleep(0.1)
        self._report(greet=True)
        await asyncio.sleep(1.0)
        # The first look of the checks compiles, and takes more than all others.
        self._report()
        await asyncio.sleep(2.0)
        spent = 0.0
        with _measured() as checks:
            for _ in range(self.seconds):
                self._report()
                begin = time.process_time()
                await asyncio.sleep(1.0)
                spent += time.process_time() - begin
        for alarm in self.plant.alarms:
            if alarm.condition in ("keep_out_predicted", "pointing_disagrees"):
                raise BenchmarkError(f"a beam where none may be: {alarm.text}")
        live = int(self.plant.field.live(self.clock.monotonic()).sum())
        if live != len(self.names):
            raise BenchmarkError(f"{live} of {len(self.names)} heliostats are live")
        return spent / self.seconds, checks[0] / self.seconds

    async def emergency(self) -> tuple[float, float]:
        """Return the CPU until an order has reached all links, and for all answers to it."""
        for link in self.links:
            link.sent.clear()
        begin = time.process_time()
        order = self.plant.raise_emergency("benchmark")
        for _ in range(_TURNS):
            if all(link.sent for link in self.links):
                break
            await asyncio.sleep(0.0)
        else:
            quiet = sum(not link.sent for link in self.links)
            raise BenchmarkError(f"{quiet} links never got the order: {order.reason}")
        out = time.process_time() - begin
        for k, link in enumerate(self.links):
            orders = [m for m in map(decode, link.sent) if isinstance(m, Emergency)]
            if len(orders) != 1:
                raise BenchmarkError(f"cluster {link.name} got {len(orders)} orders")
            for stage in (Stage.ACCEPTED, Stage.SENT, Stage.ACKNOWLEDGED, Stage.DONE):
                progress = Progress(orders[0].identity, stage, self._members(k))
                link.arrived.put_nowait(encode(progress))
        # A cluster's word for a DEFOCUS is proven by the next status.
        self._defocus()
        self._report(track=False)
        begin = time.process_time()
        await asyncio.sleep(1.2)
        answers = time.process_time() - begin
        left = order.report(self.clock.monotonic()).not_done
        if left:
            raise BenchmarkError(f"{len(left)} heliostats are not done")
        return out, answers


def _at_rest(count: int) -> float:
    """Return the CPU for a second of the look at beams that nobody sent, all heliostats at rest.

    The mirrors stand still away from stow; a third of them is checked in each second.
    """
    design = malan_plant(count)
    check = BeamCheck(design, design.names)
    field = FieldState({"C1": design.names})
    field.heard[:] = field.counted_at[:] = 0.0
    field.rows["state"] = states.IDLE
    primary, secondary = design.machine(design.names[0]).stow
    for end, place in (("primary", primary - 3000), ("secondary", secondary - 9000)):
        field.rows[end] = field.rows[f"{end}_goal"] = place
    light = vector(_MORNING, design.site)
    points = Points(field.names, None)
    beams = StrayBeams(Paths(check), field, points, lambda _: light)
    beams.check(0.1)  # the first compiles
    spent = []
    for _ in range(9):
        begin = time.process_time()
        beams.check(0.1)
        spent.append(time.process_time() - begin)
    return min(sum(spent[i : i + 3]) / 3.0 for i in (0, 3, 6))


def run(quick: bool) -> Result:
    """Return the figures."""
    found: list[tuple[float, float, float, float]] = []
    looking: list[tuple[float, float]] = []
    clusters, seconds = (20, 2) if quick else (313, 20)

    async def main(clock: VirtualClock) -> None:
        for keep_out in (VOLUMES, ()):
            with tempfile.TemporaryDirectory() as folder:
                one = _Run(clock, clusters, seconds, Path(folder), keep_out)
                task = asyncio.create_task(one.plant.run())
                steady = await one.steady()
                if keep_out:
                    looking.append(steady)
                else:
                    found.append((*steady, *await one.emergency()))
                await one.plant.close()
                await task

    for _ in range(1 if quick else 3):
        run_virtual(main)
    steady, checks, out, answers = (min(column) for column in zip(*found, strict=True))
    volumes, watched = (min(column) for column in zip(*looking, strict=True))
    rows: list[Row] = [
        {"work": "a second of operation", "cpu_s": steady, "budget_s": BUDGET_S},
        {"work": "of it: the checks", "cpu_s": checks, "budget_s": CHECKS_BUDGET_S},
        {"work": "the same, two keep-out volumes", "cpu_s": volumes, "budget_s": BUDGET_S},
        {"work": "of it: the checks", "cpu_s": watched, "budget_s": CHECKS_BUDGET_S},
        *(
            {
                "work": f"beams that nobody sent, {count:,} at rest",
                "cpu_s": _at_rest(count),
                "budget_s": CHECKS_BUDGET_S,
            }
            for count in ((640,) if quick else (10_000, 100_000))
        ),
        {"work": "order to all links", "cpu_s": out, "budget_s": ORDER_BUDGET_S},
        {"work": "all answers to it", "cpu_s": answers, "budget_s": None},
    ]
    return Result(
        rows,
        f"{clusters * MEMBERS:,} heliostats: {steady:.3f} s of CPU a second, {checks:.3f} s of it "
        f"for checks ({watched:.3f} s with keep-out volumes); an emergency order is "
        f"with all {clusters} links after {out:.3f} s of CPU",
        {"heliostats": clusters * MEMBERS, "clusters": clusters},
        None
        if quick
        else max(steady, volumes) <= BUDGET_S
        and max(checks, watched) <= CHECKS_BUDGET_S
        and out <= ORDER_BUDGET_S,
    )
