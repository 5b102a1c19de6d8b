"""Aim files, for people and for control systems."""

import csv
import io
from pathlib import Path

import numpy as np

from heliotrope.aims.plan import AimPlan
from heliotrope.files import write_text
from heliotrope.geometry import FloatArray
from heliotrope.optics.flux_files import write_map


def write_aims(path: str | Path, plan: AimPlan, joins: FloatArray | None = None) -> None:
    """Write a CSV table of aims, one line per heliostat; only those in the state aim have one.

    ``joins``, s, (N,), is when each heliostat joins along a ramp; it becomes an additional column.
    """
    text = io.StringIO(newline="")
    rows = csv.writer(text, lineterminator="\n")
    head = ("heliostat", "east_m", "north_m", "up_m", "state", "power_kw", "calibration_gain_kw")
    rows.writerow(head if joins is None else (*head, "joins_s"))
    power, gain = 1e-3 * plan.light.heliostat_power, 1e-3 * plan.gain
    for k, (name, state) in enumerate(zip(plan.names, plan.states, strict=True)):
        aim = ["" if np.isnan(x) else f"{x:.4f}" for x in plan.aim[k]]
        more = () if joins is None else ("" if np.isnan(joins[k]) else f"{joins[k]:.0f}",)
        rows.writerow((name, *aim, state, f"{power[k]:.4f}", f"{gain[k]:.6f}", *more))
    write_text(path, text.getvalue())


def write_aim_map(path: str | Path, plan: AimPlan) -> None:
    """Write the cells of the receiver (CSV), as for `heliotrope.optics.flux_files.write_map`.

    Further columns are the flux that no cell exceeds with the chosen probability, the limit minus
    the margin, and whether the limit binds the cell.
    """
    more = {
        "quantile_kw_m2": 1e-3 * plan.quantile,
        "limit_kw_m2": 1e-3 * plan.limit,
        "binds": plan.binding,
    }
    write_map(path, plan.light, more)
