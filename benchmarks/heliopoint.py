"""The table of docs/explanation/airborne.md: figures under HelioPoint's conditions, and table 2.

``python scripts/heliopoint_table.py [COUNT]`` prints it, from COUNT mirrors a row (default 16), and
before it table 2 of the paper for five simulated mirrors: σ_mean as σ/√n and p of Shapiro and Wilk,
with the ideal and with the measured surface.
"""

import sys

import numpy as np

from heliotrope.airborne.evaluate.orientation import Mean, measure
from heliotrope.airborne.simulate.trial import (
    TrialConditions,
    four_facets,
    trial_mirror,
    trials,
)


def table(count: int) -> str:
    """Return the figures under HelioPoint's conditions as a table of text, mrad.

    Three patterns of hover positions, with the ideal surface (both means) and the measured one;
    ``count`` mirrors each. Errors are RMS over the mirrors and both components. Facets, patterns
    and the positions' errors on the mirror are ours; distance, slope deviations, RTK, position and
    kinematics are the paper's.
    """
    lines = ["surface   mean   points  σ/√n   σ_mean  error  systematic  σ_tot  error  in 90 %"]
    kinds: list[tuple[str, Mean]] = [("ideal", "plain"), ("ideal", "area"), ("measured", "area")]
    for name, mean in kinds:
        for columns, rows, reflection in ((7, 6, 0.010), (10, 8, 0.015), (13, 10, 0.020)):
            c = TrialConditions(columns=columns, rows=rows, reflection=reflection)
            t = trials(c, count, map_known=name == "measured", mean=mean)
            total = np.hypot(t.sigma_mean, t.systematic)
            figures = [
                1e3 * float(np.sqrt(np.mean(np.square(v))))
                for v in (t.sigma_plain, t.sigma_mean, t.error, t.systematic, total, t.total_error)
            ]
            lines.append(
                f"{name:9} {mean:6} {t.count.mean():6.0f}  {figures[0]:.3f}  {figures[1]:.3f}   "
                f"{figures[2]:.3f}  {figures[3]:.3f}       {figures[4]:.3f}  {figures[5]:.3f}  "
                f"{100 * t.coverage:.0f} %"
            )
    return "\n".join(lines)


def table_2(count: int = 5) -> str:
    """Return HelioPoint's table 2 for simulated mirrors, σ_mean in mrad."""
    mirror, conditions = four_facets(), TrialConditions(columns=10, rows=8)
    lines = ["mirror        ideal σ_mean  p     measured σ_mean  p"]
    for seed in range(1, count + 1):
        flown = trial_mirror(mirror, conditions, seed=seed)
        pose = flown.expected_rotation, flown.expected_vertex
        # The paper's own procedure takes the plain mean.
        both = [measure(flown.reflections, s, *pose, mean="plain") for s in (mirror, flown.shape)]
        for axis, name in enumerate(("rotX", "rotY")):
            ideal, measured = (
                f"{1e3 * o.sigma_plain[axis]:.2f}          {o.normality[axis]:.2f}" for o in both
            )
            lines.append(f"{seed if axis == 0 else '':6} {name}   {ideal}  {measured}")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table_2(), end="\n\n")
    print(table(int(sys.argv[1]) if len(sys.argv) > 1 else 16))
