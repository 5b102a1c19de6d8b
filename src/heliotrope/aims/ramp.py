"""Start-up along a ramp: when each heliostat joins, so that no cell is heated too fast."""

import numpy as np

from heliotrope.aims.candidates import turns
from heliotrope.aims.scene_aims import SceneAims
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float

#: Greatest number of steps of a ramp.
MOST = 2_000


def ramp_up(aims: SceneAims, rate: float, step: float = 60.0) -> FloatArray:
    """Return when each mirror joins the receiver, s after the start, (H,); NaN if it has no aim.

    At the start of each step, mirrors join as long as no cell gets more than the rise that one step
    allows above its flux before the step. For a shut-down, mirrors leave along the same ramp in
    reverse order: a start-up time t becomes the last time minus t.

    Parameters
    ----------
    aims
        Aims of the mirrors at the end of the ramp.
    rate
        Greatest rise of the flux in a cell, W/m² per s.
    step
        Time between two steps, s.

    Raises
    ------
    InputError
        If rate or step are not above 0, the ramp has more than 2,000 steps, or a single beam heats
        a cell by more than one step allows.
    """
    if not (np.isfinite(rate) and rate > 0.0 and np.isfinite(step) and step > 0.0):
        raise InputError(f"ramp: {rate:g} W/m² per s in steps of {step:g} s; both must be above 0")
    count = len(aims.aims)
    images = aims.engine.images(aims.aims[:, None, :], np.zeros(count, dtype=np.int64))
    joins = np.full(count, np.nan)
    joining = ~aims.defocused & (aims.engine.leaving > 0.0)
    # If neighbours joined one after the other, they would fill the same cells first.
    waiting = [int(row) for row in np.argsort(turns(count), kind="stable") if joining[row]]
    peak = float(aims.engine.maps[0].max())
    if peak > MOST * rate * step:
        raise InputError(
            f"ramp: {1e-3 * peak:.4g} kW/m² take {peak / rate:.3g} s, more than {MOST} steps of "
            f"{step:g} s; raise the rate or the step"
        )
    hottest = max((float(images.of(row).max()) for row in waiting), default=0.0)
    if hottest > rate * step:
        raise InputError(
            f"ramp: one beam alone heats a cell by {1e-3 * hottest:.4g} kW/m², more than the "
            f"{1e-3 * rate * step:.4g} kW/m² that a step of {step:g} s allows; raise the rate to "
            f"{1.01e-3 * 60.0 * hottest / step:.4g} kW/m² per minute"
        )
    flux, k = np.zeros(images.shape[::-1]), 0
    while waiting:
        allowed, later = flux + rate * step, []
        for row in waiting:
            image = images.of(row)
            if (flux + image > allowed)[image > 0.0].any():
                later.append(row)
                continue
            flux += image
            joins[row] = k * step
        waiting, k = later, k + 1
    return as_float(joins)
