"""Orientations from the air under HelioPoint's conditions: stated accuracy beside true errors.

The figures of docs/explanation/airborne.md: three patterns of hover positions, with the ideal
surface (both means) and the measured one, 16 mirrors each; and the paper's table 2 for five
simulated mirrors: σ_mean as σ/√n and p of Shapiro and Wilk. Errors are RMS over the mirrors and
both components. Facets, patterns and the positions' errors on the mirror are ours; distance, slope
deviations, RTK, position and kinematics are the paper's.
"""

from itertools import product

import numpy as np

from benchmarks._run import Result, Row
from heliotrope.airborne.evaluate.orientation import Mean, measure
from heliotrope.airborne.simulate.trial import (
    TrialConditions,
    four_facets,
    trial_mirror,
    trials,
)

#: Surface and mean; columns and rows of a pattern, and error of a reflection on the mirror, m.
KINDS: tuple[tuple[str, Mean], ...] = (("ideal", "plain"), ("ideal", "area"), ("measured", "area"))
PATTERNS = ((7, 6, 0.010), (10, 8, 0.015), (13, 10, 0.020))


def _conditions(count: int) -> list[Row]:
    """Return a row for each surface, mean and pattern, from ``count`` mirrors each."""
    found: list[Row] = []
    for (surface, mean), (columns, rows, reflection) in product(KINDS, PATTERNS):
        c = TrialConditions(columns=columns, rows=rows, reflection=reflection)
        t = trials(c, count, map_known=surface == "measured", mean=mean)
        total = np.hypot(t.sigma_mean, t.systematic)
        figures = (t.sigma_plain, t.sigma_mean, t.error, t.systematic, total, t.total_error)
        rms = [1e3 * float(np.sqrt(np.mean(np.square(v)))) for v in figures]
        named = zip(COLUMNS[3:9], rms, strict=True)
        found.append({
            "mirrors": f"{count} mirrors", "surface": f"{surface}, {mean}",
            "points": float(t.count.mean()), **dict(named),
            "within_90": float(t.coverage), "shapiro_p": None,
        })  # fmt: skip
    return found


def _table_2(count: int) -> list[Row]:
    """Return the rows of HelioPoint's table 2 for simulated mirrors."""
    mirror, conditions = four_facets(), TrialConditions(columns=10, rows=8)
    found: list[Row] = []
    for seed in range(1, count + 1):
        flown = trial_mirror(mirror, conditions, seed=seed)
        pose = flown.expected_rotation, flown.expected_vertex
        for surface, shape in (("ideal", mirror), ("measured", flown.shape)):
            # The paper's own procedure takes the plain mean.
            o = measure(flown.reflections, shape, *pose, mean="plain")
            for axis, name in enumerate(("rotX", "rotY")):
                found.append({
                    **dict.fromkeys(COLUMNS),
                    "mirrors": f"table 2, mirror {seed} {name}", "surface": f"{surface}, plain",
                    "sigma_plain_mrad": 1e3 * float(o.sigma_plain[axis]),
                    "shapiro_p": float(o.normality[axis]),
                })  # fmt: skip
    return found


COLUMNS = (
    "mirrors", "surface", "points", "sigma_plain_mrad", "sigma_mean_mrad", "error_mrad",
    "systematic_mrad", "sigma_total_mrad", "total_error_mrad", "within_90", "shapiro_p",
)  # fmt: skip


def run(quick: bool) -> Result:
    """Return the figures."""
    rows = _conditions(2 if quick else 16)
    worst = max(rows, key=lambda row: float(row["total_error_mrad"] or 0.0))
    return Result(
        [*rows, *_table_2(1 if quick else 5)],
        f"true errors of at most {worst['total_error_mrad']:.2f} mrad of the normal (RMS), "
        f"σ {worst['sigma_total_mrad']:.2f} mrad",
    )
