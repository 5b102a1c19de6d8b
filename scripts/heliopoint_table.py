"""The table of docs/explanation/airborne.md: figures under HelioPoint's conditions.

``python scripts/heliopoint_table.py [COUNT]`` prints it, from COUNT mirrors a row (default 16).
"""

import sys

import numpy as np

from heliotrope.airborne.evaluate.orientation import Mean
from heliotrope.airborne.simulate.trial import TrialConditions, trials


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


if __name__ == "__main__":
    print(table(int(sys.argv[1]) if len(sys.argv) > 1 else 16))
