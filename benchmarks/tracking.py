"""Tracking of 1 to 1,000,000 heliostats beside NumPy and SciPy's Rotation.

The contenders run the same method to the same limit (the beam within 1e-9 m of its aim):
the closed-form pair of angles inside a fixed point on the vertex. They are compared
before they are timed.
"""

import math
import os
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks._run import best
from heliotrope.mechanism import kinds
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.tracking import track

SUN = np.array([0.3, -0.6, 0.7]) / np.linalg.norm([0.3, -0.6, 0.7])
AIM = np.array([0.0, 0.0, 120.0])
BUDGET_NS = 250.0
Turn = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def field(rows: int, arbitrary: bool = False) -> Any:
    """Imperfect mechanisms 50 to 900 m from the tower."""
    rng = np.random.default_rng(0)
    place = np.c_[rng.uniform(-600, 600, rows), rng.uniform(50, 900, rows), np.zeros(rows)]
    if arbitrary:
        skew = rng.normal(0, 0.1, (rows, 3))
        return kinds.two_axis(
            place, skew + [0, 0, 1], skew[:, ::-1] + [1, 0, 0], [0.05, 1, 0.02],
            origin_1=(0, 0, 3), origin_2=(0.1, 0, 0.1), vertex=(0.02, 0.3, 0.0),
        )  # fmt: skip
    perfect = kinds.azimuth_elevation(place, pivot_height=3.0, pivot_offset=0.3)
    sizes = {"tilt_north": 5e-3, "tilt_east": 5e-3, "canting": 3e-3, "non_orthogonality": 3e-3}
    return perfect.with_parameters({n: rng.normal(0, s, rows) for n, s in sizes.items()})


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", a, b)


def _rodrigues(axis: np.ndarray, angle: np.ndarray, u: np.ndarray) -> np.ndarray:
    sine, cosine = np.sin(angle)[:, None], np.cos(angle)[:, None]
    along = _dot(axis, u)[:, None]
    return cosine * u + sine * np.cross(axis, u) + (1.0 - cosine) * along * axis


def _rotation(axis: np.ndarray, angle: np.ndarray, u: np.ndarray) -> np.ndarray:
    turned: np.ndarray = Rotation.from_rotvec(axis * angle[:, None]).apply(u)
    return turned


def by_arrays(g: Armature, turn: Turn, limit: int = 50) -> np.ndarray:
    """Angles (N, 2) of branch 0, all heliostats in step until the last one is there."""
    a, b, n = g.axis_1, g.axis_2, g.normal
    arm, between = g.vertex - g.origin_2, g.origin_2 - g.origin_1
    cross = np.cross(a, b)
    size, ab, nb = _dot(cross, cross), _dot(a, b), _dot(n, b)
    vertex = g.vertex
    theta = np.zeros((len(vertex), 2))
    for _ in range(limit):
        way = AIM - vertex
        way = way / np.linalg.norm(way, axis=1)[:, None]
        v = SUN + way
        v = v / np.linalg.norm(v, axis=1)[:, None]
        va = _dot(v, a)
        alpha, beta = (va - ab * nb) / size, (nb - ab * va) / size
        rest = 1.0 - alpha**2 - beta**2 - 2.0 * alpha * beta * ab
        gamma = -np.sqrt(np.maximum(rest, 0.0) / size)
        z = alpha[:, None] * a + beta[:, None] * b + gamma[:, None] * cross
        theta[:, 1] = np.arctan2(_dot(b, np.cross(n, z)), _dot(n, z) - nb * nb)
        theta[:, 0] = np.arctan2(_dot(a, np.cross(z, v)), _dot(z, v) - va * va)
        old = vertex
        vertex = g.origin_1 + turn(a, theta[:, 0], between + turn(b, theta[:, 1], arm))
        if np.linalg.norm(np.cross(vertex - old, way), axis=1).max() <= 1e-9:
            break
    return theta


def _agree(mechanism: Any) -> float:
    ours = track(mechanism, SUN, AIM, branch=0).angles[:, 0]
    apart = 0.0
    for turn in (_rodrigues, _rotation):
        theirs = by_arrays(mechanism.armature, turn)
        gap = np.abs(np.remainder(ours - theirs + np.pi, 2 * np.pi) - np.pi).max()
        apart = max(apart, float(gap))
    if apart > 1e-9:
        raise RuntimeError(f"the contenders differ by {apart:.2g} rad; the times mean nothing")
    return apart


def _with_threads(count: int, call: Callable[[], Any]) -> Callable[[], Any]:
    def run() -> Any:
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


def run(quick: bool) -> dict[str, Any]:
    """Return the figures."""
    sizes = (1, 1000) if quick else (1, 1000, 100_000, 1_000_000)
    cores = len(os.sched_getaffinity(0))
    rows = []
    for size in sizes:
        mechanism = field(size)
        mechanism.armature  # noqa: B018 - reduced once, as a plant does
        apart = _agree(mechanism) if size <= 100_000 else None

        def one(m: Any = mechanism) -> Any:
            return track(m, SUN, AIM, branch=0)

        def both(m: Any = mechanism) -> Any:
            return track(m, SUN, AIM)

        contenders: dict[str, Callable[[], Any]] = {
            "heliotrope, one branch": _with_threads(cores, one),
            "heliotrope, one branch, 1 thread": _with_threads(1, one),
            "heliotrope, both branches": _with_threads(cores, both),
            "NumPy": lambda m=mechanism: by_arrays(m.armature, _rodrigues),  # type: ignore[misc]
            "SciPy Rotation": lambda m=mechanism: by_arrays(m.armature, _rotation),  # type: ignore[misc]
        }
        times = best(contenders, 3 if quick else {1_000_000: 3, 100_000: 9}.get(size, 50))
        reference = times["heliotrope, one branch"]["best_s"]
        for name, time in times.items():
            rows.append(
                {
                    "heliostats": size,
                    "contender": name,
                    "ns_per_heliostat": 1e9 * time["best_s"] / size,
                    "median_ns_per_heliostat": 1e9 * time["median_s"] / size,
                    "processor_ns_per_heliostat": 1e9 * time["processor_s"] / size,
                    "ratio_to_heliotrope": time["best_s"] / reference,
                    "differs_rad": apart,
                }
            )
    ours = [r for r in rows if r["contender"] == "heliotrope, one branch"]
    large = [r for r in ours if r["heliostats"] >= 1000]
    growth = None
    if len(large) > 1:
        first, last = large[0], large[-1]
        growth = 1.0 + math.log(last["ns_per_heliostat"] / first["ns_per_heliostat"]) / math.log(
            last["heliostats"] / first["heliostats"]
        )
    skewed = field(sizes[-2], arbitrary=True)
    skewed.armature  # noqa: B018
    time = best({"arbitrary": lambda: track(skewed, SUN, AIM, branch=0)}, 5)["arbitrary"]
    found = {r["heliostats"]: r["ns_per_heliostat"] for r in ours}
    return {
        "rows": rows,
        "arbitrary_axes_ns_per_heliostat": 1e9 * time["best_s"] / sizes[-2],
        "exponent_of_growth": growth,
        "tolerance_m": 1e-9,
        "budget_ns_at_100000": BUDGET_NS,
        "within_budget": None if quick else bool(found[100_000] <= BUDGET_NS),
    }
