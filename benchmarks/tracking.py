"""Tracking of 1 to 1,000,000 heliostats beside NumPy and SciPy's Rotation.

All run the same method to the same limit: the closed-form pair of angles inside a fixed
point on the vertex, until the beam is within 1e-9 m of its aim. Heliotrope gives drive
counts within the stops, pose, residual and status as well; its peers give angles alone.
"""

import math
import os
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from benchmarks._array_tracking import by_formula, by_rotation, track_arrays
from benchmarks._run import Call, Result, Row, Times, agree, peak_bytes, timed
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.tracking import Branch, track

SUN = np.array([0.3, -0.6, 0.7]) / np.linalg.norm([0.3, -0.6, 0.7])
AIM = np.array([0.0, 0.0, 120.0])
TOLERANCE = 1e-9
#: On two threads, at 100,000 heliostats.
BUDGET_NS, BUDGET_SIZE = 250.0, 100_000
REPEATS = {1: 200, 1000: 100, 100_000: 25, 1_000_000: 5}
AZEL, ARBITRARY = "azimuth-elevation", "arbitrary axes"


@dataclass(frozen=True)
class Contender:
    """One way of tracking a field."""

    name: str
    branches: int
    threads: int
    iterations: int
    call: Call

    @property
    def key(self) -> str:
        """Name it among the others."""
        return f"{self.name}/{self.branches}/{self.threads}"


def field(rows: int, arbitrary: bool = False) -> Mechanism:
    """Return imperfect mechanisms 100 to 900 m from the tower, in the half circle to the north."""
    rng = np.random.default_rng(0)
    distance = np.sqrt(rng.uniform(100.0**2, 900.0**2, rows))
    bearing = rng.uniform(-0.5 * np.pi, 0.5 * np.pi, rows)
    place = np.c_[distance * np.sin(bearing), distance * np.cos(bearing), np.zeros(rows)]
    if arbitrary:
        skew = rng.normal(0, 0.1, (rows, 3))
        return kinds.two_axis(
            place, skew + [0, 0, 1], skew[:, ::-1] + [1, 0, 0], [0.05, 1, 0.02],
            origin_1=(0, 0, 3), origin_2=(0.1, 0, 0.1), vertex=(0.02, 0.3, 0.0),
        )  # fmt: skip
    perfect = kinds.azimuth_elevation(place, pivot_height=3.0, pivot_offset=0.3)
    sizes = {"tilt_north": 5e-3, "tilt_east": 5e-3, "canting": 3e-3, "non_orthogonality": 3e-3}
    return perfect.with_parameters({n: rng.normal(0, s, rows) for n, s in sizes.items()})


def _on_threads(count: int, call: Call) -> Call:
    def run() -> object:
        before = os.environ.get("HELIOTROPE_THREADS")
        os.environ["HELIOTROPE_THREADS"] = str(count)
        try:
            return call()
        finally:
            if before is None:
                del os.environ["HELIOTROPE_THREADS"]
            else:
                os.environ["HELIOTROPE_THREADS"] = before

    return run


def _contenders(mechanism: Mechanism) -> tuple[list[Contender], float]:
    """Return the contenders, and by how much their angles differ, rad."""
    table = mechanism.armature.table
    found = []
    one: Branch = 0
    both: Branch = "both"
    for branch, branches in ((one, 1), (both, 2)):
        steps = int(track(mechanism, SUN, AIM, branch=branch).iterations.max())

        def ours(b: Branch = branch) -> object:
            return track(mechanism, SUN, AIM, branch=b, tolerance=TOLERANCE)

        found += [
            Contender("Heliotrope", branches, n, steps, _on_threads(n, ours)) for n in (2, 1)
        ]
    angles = track(mechanism, SUN, AIM, branch=0, tolerance=TOLERANCE).angles[:, 0]
    apart = 0.0
    for name, turn in (("NumPy", by_formula), ("SciPy Rotation", by_rotation)):
        theirs, steps = track_arrays(table, SUN, AIM, turn, TOLERANCE)
        gap = np.remainder(angles - theirs + np.pi, 2.0 * np.pi) - np.pi
        apart = max(apart, agree(f"{name}, angles", float(np.abs(gap).max()), 1e-9, "rad"))

        def peer(t: object = turn) -> object:
            return track_arrays(table, SUN, AIM, t, TOLERANCE)  # type: ignore[arg-type]

        found.append(Contender(name, 1, 1, steps, peer))
    return found, apart


def _rows(kind: str, size: int) -> Iterable[tuple[Row, Times]]:
    contenders, apart = _contenders(field(size, kind == ARBITRARY))
    times = timed({c.key: c.call for c in contenders}, REPEATS[size])
    reference = times[contenders[0].key].best
    for c in contenders:
        time = times[c.key]
        row: Row = {
            "mechanism": kind,
            "heliostats": size,
            "contender": c.name,
            "branches": c.branches,
            "threads": c.threads,
            "iterations": c.iterations,
            "best_ns_per_heliostat": 1e9 * time.best / size,
            "median_ns_per_heliostat": 1e9 * time.median / size,
            "processor_ns_per_heliostat": 1e9 * time.processor / size,
            "ratio_to_first": time.best / reference,
            "peak_bytes_per_heliostat": peak_bytes(c.call) / size,
            "growth_exponent": None,
            "apart_rad": apart,
        }
        yield row, time


def run(quick: bool) -> Result:
    """Return the figures."""
    sizes = (1, 1000) if quick else tuple(REPEATS)
    rows: list[Row] = []
    found: dict[tuple[str, int], list[Times]] = {}
    for kind in (AZEL, ARBITRARY):
        for size in sizes:
            pairs = list(_rows(kind, size))
            found[kind, size] = [time for _, time in pairs]
            rows += [row for row, _ in pairs]
    per_size = len(found[AZEL, 1])
    for k, row in enumerate(rows):
        # The rows of one size follow those of the size before, in the same order.
        if row["heliostats"] != sizes[0]:
            place = sizes.index(int(row["heliostats"] or 0))
            small, large = sizes[place - 1], sizes[place]
            times = [found[str(row["mechanism"]), s][k % per_size].best for s in (small, large)]
            row["growth_exponent"] = math.log(times[1] / times[0]) / math.log(large / small)
    shown = sizes[-1] if quick else BUDGET_SIZE
    two, one, _, _, array, rotation = (t.best for t in found[AZEL, shown])
    headline = (
        f"{shown:,} heliostats: {1e9 * two / shown:.0f} ns each on two threads, "
        f"{1e9 * one / shown:.0f} on one; NumPy on one {array / one:.1f} × that, "
        f"SciPy's Rotation {rotation / one:.1f} ×"
    )
    within = None
    if not quick:
        worst = max(found[kind, BUDGET_SIZE][0].median for kind in (AZEL, ARBITRARY))
        within = 1e9 * worst / BUDGET_SIZE <= BUDGET_NS
    return Result(
        rows,
        headline,
        {"tolerance_m": TOLERANCE, "budget_ns_per_heliostat": BUDGET_NS},
        within,
    )
