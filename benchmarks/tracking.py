"""Tracking of 1 to 1,000,000 heliostats beside NumPy and SciPy's Rotation.

All run the same method to the same limit: the closed-form pair of angles inside a fixed-point
iteration on the vertex, until the beam is within 1e-9 m of its aim. Heliotrope also returns drive
counts within the stops, pose, residual and status; its peers return angles only.
"""

import math
import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks._array_tracking import Turn, by_formula, by_rotation, track_arrays
from benchmarks._run import Call, Result, Row, agree, peak_bytes, timed
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.tracking import Branch, Tracking, track

SUN = np.array([0.3, -0.6, 0.7]) / np.linalg.norm([0.3, -0.6, 0.7])
AIM = np.array([0.0, 0.0, 120.0])
TOLERANCE = 1e-9
#: Budget on two threads, at 100,000 heliostats.
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
        """Return the name in the table."""
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
            place,
            skew + [0, 0, 1],
            skew[:, ::-1] + [1, 0, 0],
            [0.05, 1, 0.02],
            origin_1=(0, 0, 3),
            origin_2=(0.1, 0, 0.1),
            vertex=(0.02, 0.3, 0.0),
        )
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
    """Return the contenders, and the largest difference of their angles, rad."""
    table = mechanism.armature.table
    found = []
    for branches in (1, 2):
        branch: Branch = 0 if branches == 1 else "both"

        def ours(b: Branch = branch) -> Tracking:
            return track(mechanism, SUN, AIM, branch=b, tolerance=TOLERANCE)

        steps = int(ours().iterations.max())
        found += [Contender("Heliotrope", branches, n, steps, _on_threads(n, ours)) for n in (2, 1)]
    angles = track(mechanism, SUN, AIM, branch=0, tolerance=TOLERANCE).angles[:, 0]
    apart = 0.0
    for name, turn in (("NumPy", by_formula), ("SciPy Rotation", by_rotation)):

        def peer(t: Turn = turn) -> tuple[np.ndarray, int]:
            return track_arrays(table, SUN, AIM, t, TOLERANCE)

        theirs, steps = peer()
        gap = np.remainder(angles - theirs + np.pi, 2.0 * np.pi) - np.pi
        apart = max(apart, agree(f"{name}, angles", float(np.abs(gap).max()), 1e-9, "rad"))
        found.append(Contender(name, 1, 1, steps, peer))
    return found, apart


def _rows(kind: str, size: int) -> list[dict[str, Any]]:
    contenders, apart = _contenders(field(size, kind == ARBITRARY))
    times = timed({c.key: c.call for c in contenders}, REPEATS[size])
    reference = times[contenders[0].key].best
    return [
        {
            "mechanism": kind,
            "heliostats": size,
            "contender": c.name,
            "branches": c.branches,
            "threads": c.threads,
            "iterations": c.iterations,
            "best_ns_per_heliostat": 1e9 * times[c.key].best / size,
            "median_ns_per_heliostat": 1e9 * times[c.key].median / size,
            "processor_ns_per_heliostat": 1e9 * times[c.key].processor / size,
            "ratio_to_first": times[c.key].best / reference,
            "growth_exponent": None,
            "peak_bytes_per_heliostat": peak_bytes(c.call) / size,
            "apart_rad": apart,
        }
        for c in contenders
    ]


def _add_growth(before: list[dict[str, Any]], rows: list[dict[str, Any]]) -> None:
    """Fill in the exponent of the growth of time from one size to the next."""
    for small, large in zip(before, rows, strict=True):
        ratio = large["heliostats"] / small["heliostats"]
        cost = large["best_ns_per_heliostat"] / small["best_ns_per_heliostat"]
        large["growth_exponent"] = 1.0 + math.log(cost) / math.log(ratio)


def run(quick: bool) -> Result:
    """Return the figures."""
    sizes = (1, 1000) if quick else tuple(REPEATS)
    shown = sizes[-1] if quick else BUDGET_SIZE
    rows: list[Row] = []
    judged = []
    for kind in (AZEL, ARBITRARY):
        before: list[dict[str, Any]] = []
        for size in sizes:
            found = _rows(kind, size)
            if before:
                _add_growth(before, found)
            if size == shown:
                judged.append(found)
            rows += found
            before = found
    two, one, _, _, array, rotation = (row["best_ns_per_heliostat"] for row in judged[0])
    headline = (
        f"{shown:,} heliostats: {two:.0f} ns each on two threads, {one:.0f} on one; "
        f"NumPy {array:.0f}, SciPy's Rotation {rotation:.0f}"
    )
    within = None
    if not quick:
        within = max(f[0]["median_ns_per_heliostat"] for f in judged) <= BUDGET_NS
    return Result(
        rows,
        headline,
        {"tolerance_m": TOLERANCE, "budget_median_ns_per_heliostat": BUDGET_NS},
        within,
    )
