"""The estimator beside SciPy's least squares and Nelder-Mead.

All minimise the same cost, square loss and prior, from the same start. SciPy fits one
heliostat after another, with Heliotrope's kinematics and its own finite differences. Heliotrope
also returns covariances.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import least_squares, minimize

from benchmarks._run import Result, Row, agree, peak_bytes, timed
from heliotrope.calibration.fit.estimator import fit
from heliotrope.calibration.sightings import ray_directions, sightings
from heliotrope.geometry import direction, reflect, tangent_axes
from heliotrope.mechanism import kinds, parameters

SIGHTINGS = 30
NOISE = 3e-4
NAMES = (*parameters.MODELS["malan8"], "canting", "azimuth_scale", "elevation_scale")
#: Budget of the design for 10,000 heliostats with square loss.
BUDGET_S, BUDGET_SIZE = 3.0, 10_000
#: Number of timings of each size.
REPEATS = {10: 20, 100: 20, 1000: 10, 10_000: 7, 100_000: 1}
SQUARE: dict[str, Any] = {"loss": "square", "adapt_scale": False}
#: Most evaluations of the cost by Nelder-Mead for one heliostat.
EVALUATIONS = 20_000


def _case(rows: int) -> tuple[Any, Any]:
    rng = np.random.default_rng(0)
    place = np.c_[rng.uniform(-300, 300, rows), rng.uniform(50, 600, rows), np.zeros(rows)]
    nominal = kinds.azimuth_elevation(place, pivot_height=2.0, pivot_offset=0.2)
    truth = nominal.with_parameters(
        {n: rng.normal(0, 0.5 * nominal.parameter(n).prior, rows) for n in NAMES}
    )
    index = np.repeat(np.arange(rows), SIGHTINGS)
    counts = rng.uniform((-0.7, 0.3), (0.7, 1.3), (len(index), 2)) + [np.pi, 0.0]
    pose = truth[index].pose(counts)
    sun = pose.normal + 0.4 * direction(rng.uniform(0, 6, len(index)), 0.3)
    sun /= np.linalg.norm(sun, axis=-1, keepdims=True)
    ray = reflect(sun, pose.normal) + rng.normal(0, NOISE, sun.shape)
    return nominal, sightings(index, counts, sun, pose.vertex + 300.0 * ray, sigma=NOISE)


def _residuals(nominal: Any, seen: Any, i: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return the residuals of heliostat i, and its prior's, by parameters over their priors."""
    sigma = np.array([nominal.parameter(n).prior for n in NAMES])
    mine, one = seen.of(i), nominal[i : i + 1]
    vertex = one[mine.heliostat].pose(mine.counts).vertex
    source, way = ray_directions(mine, vertex)
    total = source + way
    size = np.linalg.norm(total, axis=-1, keepdims=True)
    axes = tangent_axes(total / size)
    across = axes / size[:, :, None]
    spread = np.eye(3) - way[:, :, None] * way[:, None, :]
    covariance = across @ spread @ np.swapaxes(across, -1, -2) * NOISE**2
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))

    def residual(y: np.ndarray) -> np.ndarray:
        moved = one.with_parameters(dict(zip(NAMES, y * sigma, strict=True)))
        pose = moved[mine.heliostat].pose(mine.counts)
        s, t = ray_directions(mine, pose.vertex)
        b = (s + t) / np.linalg.norm(s + t, axis=-1, keepdims=True)
        plain = np.einsum("nij,njk,nk->ni", whiten, axes, pose.normal - b)
        return np.concatenate([plain.ravel(), y])

    return residual


def _least_squares(nominal: Any, seen: Any, sample: int) -> np.ndarray:
    """Return parameters over their priors, (sample, P)."""
    start = np.zeros(len(NAMES))
    found = [
        least_squares(_residuals(nominal, seen, i), start, method="lm", xtol=1e-10, ftol=1e-10)
        for i in range(sample)
    ]
    return np.array([solved.x for solved in found])


def _nelder_mead(nominal: Any, seen: Any, sample: int, evaluations: int) -> np.ndarray:
    """Return parameters over their priors, (sample, P), after at most ``evaluations``."""
    options = {
        "maxfev": evaluations,
        "maxiter": evaluations,
        "adaptive": True,
        "xatol": 1e-6,
        "fatol": 1e-9,
    }
    found = []
    for i in range(sample):
        residual = _residuals(nominal, seen, i)

        def cost(y: np.ndarray, residual: Any = residual) -> float:
            return float(np.sum(residual(y) ** 2))

        start = np.zeros(len(NAMES))
        found.append(minimize(cost, start, method="Nelder-Mead", options=options).x)
    return np.array(found)


def _row(contender: str, size: int, best: float, median: float) -> dict[str, Any]:
    return {
        "contender": contender,
        "heliostats": size,
        "seconds": best,
        "median_seconds": median,
        "ms_per_heliostat": 1e3 * best / size,
        "scipy_ratio": None,
        "nelder_mead_ratio": None,
        "growth_exponent": None,
        "peak_bytes_per_heliostat": None,
        "differs_sigma": None,
    }


def _peers(quick: bool, size: int) -> list[dict[str, Any]]:
    """Return rows of SciPy's solvers, timed on a sample of the field and checked against ours."""
    sample, few, evaluations = (3, 1, 500) if quick else (20, 2, EVALUATIONS)
    nominal, seen = _case(size)
    found = fit(nominal, seen, NAMES, **SQUARE)
    rows = []
    for name, count, solve in (
        ("SciPy least_squares", sample, lambda: _least_squares(nominal, seen, sample)),
        ("SciPy Nelder-Mead", few, lambda: _nelder_mead(nominal, seen, few, evaluations)),
    ):
        once = timed({name: solve}, 1 if quick or count == few else 3)[name]
        row = _row(name, count, once.best, once.median)
        gap = np.abs(found.values[:count] - solve() * found.prior[:count])
        row["differs_sigma"] = float((gap / found.sigma[:count]).max())
        rows.append(row)
    # SciPy's differences leave about 1e-4 of a standard deviation. Nelder-Mead stops where
    # it has got to; its row says how far off that is.
    agree("parameters", rows[0]["differs_sigma"], 1e-3, "σ")
    return rows


def _ours(quick: bool) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for size in (10, 30) if quick else tuple(REPEATS):
        nominal, seen = _case(size)
        cases = {"Heliotrope, square": SQUARE}
        if quick or size == BUDGET_SIZE:
            cases["Heliotrope, Cauchy, scale found"] = {}
        calls = {
            name: lambda n=nominal, s=seen, o=options: fit(n, s, NAMES, **o)
            for name, options in cases.items()
        }
        times = timed(calls, 1 if quick else REPEATS[size])  # type: ignore[arg-type]
        for name, call in calls.items():
            row = _row(name, size, times[name].best, times[name].median)
            row["peak_bytes_per_heliostat"] = peak_bytes(call) / size  # type: ignore[arg-type]
            before = [r for r in rows if r["contender"] == name]
            if before:
                ratio = row["seconds"] / before[-1]["seconds"]
                row["growth_exponent"] = math.log(ratio) / math.log(size / before[-1]["heliostats"])
            rows.append(row)
    return rows


def run(quick: bool) -> Result:
    """Return the figures."""
    rows = _ours(quick)
    size = 30 if quick else BUDGET_SIZE
    rows += _peers(quick, size)
    squares, simplex = (row["ms_per_heliostat"] for row in rows[-2:])
    for row in rows:
        row["scipy_ratio"] = squares / row["ms_per_heliostat"]
        row["nelder_mead_ratio"] = simplex / row["ms_per_heliostat"]
    shown, robust = (
        row for row in rows if row["heliostats"] == size and "Helio" in row["contender"]
    )
    kept: list[Row] = list(rows)
    return Result(
        kept,
        f"{size:,} heliostats × {SIGHTINGS} sightings × {len(NAMES)} parameters with covariance in "
        f"{shown['seconds']:.2f} s ({robust['seconds']:.2f} s with Cauchy loss and scale found); "
        f"SciPy's least squares takes {shown['scipy_ratio']:.0f} × as long, "
        f"Nelder-Mead {shown['nelder_mead_ratio']:,.0f} ×",
        {
            "sightings": SIGHTINGS,
            "parameters": len(NAMES),
            "budget_median_s": BUDGET_S,
            "budget_of": "Heliotrope, square",
            "nelder_mead_evaluations": 500 if quick else EVALUATIONS,
        },
        None if quick else shown["median_seconds"] <= BUDGET_S,
    )
