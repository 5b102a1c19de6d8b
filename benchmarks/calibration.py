"""The estimator beside SciPy's least squares, one heliostat after another.

The full comparison at field scale belongs to the field-scale estimator; this one keeps
an eye on the kernel.
"""

from typing import Any

import numpy as np
from scipy.optimize import least_squares

from benchmarks._run import Result, Row, agree, timed
from heliotrope.calibration.estimator import fit
from heliotrope.calibration.sightings import ray_directions, sightings
from heliotrope.geometry import direction, reflect, tangent_axes
from heliotrope.mechanism import kinds, parameters

SIGHTINGS = 30
NOISE = 3e-4
MODEL = "malan8"
#: For 10,000 heliostats.
BUDGET_S = 3.0


def _case(rows: int) -> tuple[Any, Any]:
    rng = np.random.default_rng(0)
    place = np.c_[rng.uniform(-300, 300, rows), rng.uniform(50, 600, rows), np.zeros(rows)]
    nominal = kinds.azimuth_elevation(place, pivot_height=2.0, pivot_offset=0.2)
    truth = nominal.with_parameters(
        {n: rng.normal(0, 5e-3, rows) for n in parameters.MODELS[MODEL]}
    )
    index = np.repeat(np.arange(rows), SIGHTINGS)
    counts = rng.uniform((-0.7, 0.3), (0.7, 1.3), (len(index), 2)) + [np.pi, 0.0]
    pose = truth[index].pose(counts)
    sun = pose.normal + 0.4 * direction(rng.uniform(0, 6, len(index)), 0.3)
    sun /= np.linalg.norm(sun, axis=-1, keepdims=True)
    ray = reflect(sun, pose.normal) + rng.normal(0, NOISE, sun.shape)
    return nominal, sightings(index, counts, sun, pose.vertex + 300.0 * ray, sigma=NOISE)


def _scipy(nominal: Any, seen: Any, sample: int) -> np.ndarray:
    names = parameters.MODELS[MODEL]
    sigma = np.array([nominal.parameter(n).prior for n in names])
    found = []
    for i in range(sample):
        mine = seen.of(i)
        one = nominal[i : i + 1]
        vertex = one[mine.heliostat].pose(mine.counts).vertex
        source, way = ray_directions(mine, vertex)
        total = source + way
        size = np.linalg.norm(total, axis=-1, keepdims=True)
        axes = tangent_axes(total / size)
        across = axes / size[:, :, None]
        spread = np.eye(3) - way[:, :, None] * way[:, None, :]
        covariance = across @ spread @ np.swapaxes(across, -1, -2) * NOISE**2
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))

        def residual(
            y: np.ndarray, one: Any = one, mine: Any = mine, axes: Any = axes, w: Any = whiten
        ) -> np.ndarray:
            moved = one.with_parameters(dict(zip(names, y * sigma, strict=True)))
            pose = moved[mine.heliostat].pose(mine.counts)
            s, t = ray_directions(mine, pose.vertex)
            b = (s + t) / np.linalg.norm(s + t, axis=-1, keepdims=True)
            plain = np.einsum("nij,njk,nk->ni", w, axes, pose.normal - b)
            return np.concatenate([plain.ravel(), y])

        start = np.zeros(len(names))
        solved = least_squares(residual, start, method="lm", xtol=1e-10, ftol=1e-10)
        found.append(solved.x * sigma)
    return np.array(found)


def run(quick: bool) -> Result:
    """Return the figures."""
    sample = 3 if quick else 20
    rows: list[Row] = []
    for size in (30,) if quick else (100, 1000, 10_000):
        nominal, seen = _case(size)

        def ours(n: Any = nominal, s: Any = seen) -> Any:
            return fit(n, s, MODEL, loss="square", adapt_scale=False)

        times = timed(
            {"heliotrope": ours, "SciPy": lambda n=nominal, s=seen: _scipy(n, s, sample)},  # type: ignore[misc]
            1 if quick else 3,
        )
        found = ours()
        gap = np.abs(found.values[:sample] - _scipy(nominal, seen, sample))
        # SciPy's differences leave about 1e-4 of a standard deviation.
        apart = agree("parameters", float((gap / found.sigma[:sample]).max()), 1e-3, "σ")
        seconds = times["heliotrope"].best
        each = seconds / size
        theirs = times["SciPy"].best / sample
        rows.append(
            {"heliostats": size, "ms_per_heliostat": 1e3 * each, "seconds": seconds,
             "median_seconds": times["heliotrope"].median,
             "scipy_ms_per_heliostat": 1e3 * theirs, "scipy_ratio": theirs / each,
             "differs_sigma": apart}
        )  # fmt: skip
    last = rows[-1]
    return Result(
        rows,
        f"{last['heliostats']:,} heliostats × {SIGHTINGS} sightings in {last['seconds']:.2f} s, "
        f"covariance included; SciPy takes {last['scipy_ratio']:.0f} × as long",
        {
            "sightings": SIGHTINGS,
            "parameters": len(parameters.MODELS[MODEL]),
            "budget_median_s": BUDGET_S,
        },
        None if quick else times["heliotrope"].median <= BUDGET_S,
    )
