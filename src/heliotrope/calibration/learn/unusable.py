"""Sightings that a mechanism cannot produce.

Counts beyond the reach of a jack (its triangle is fully extended) do not move the joint further.
The derivative is infinite there, and one such sighting would corrupt the whole field, so it is left
out.
"""

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.fit.estimator import FieldFit, FitOutcome
from heliotrope.calibration.fit.residuals import Linearised, linearise
from heliotrope.calibration.sightings import Sightings
from heliotrope.mechanism.chain import Mechanism

#: Largest derivative of a whitened residual. A jack at a hundredth of a radian from its flat
#: triangle reaches 1e5 with a centroid of 0.5 mrad; beyond the triangle it is 1e16 or infinite.
STEEPEST = 1e7


def is_usable(line: Linearised) -> npt.NDArray[np.bool_]:
    """Return whether residuals and derivatives are those of a mechanism within its reach, (M,)."""
    with np.errstate(invalid="ignore"):
        flat = (np.abs(line.jacobian) < STEEPEST).all(axis=(1, 2))
    return np.asarray(flat & np.isfinite(line.residual).all(axis=1))


def find_unusable(
    mechanism: Mechanism, sightings: Sightings, fitted: FieldFit
) -> npt.NDArray[np.bool_]:
    """Return the mask of sightings beyond the reach at the start of a fit or at its end, (M,).

    If a fit found no possible parameters, none of its sightings is usable.

    Parameters
    ----------
    mechanism
        Nominal, (N,).
    sightings
        M sightings of these heliostats.
    fitted
        Fit of these sightings.
    """
    lost = np.isin(fitted.outcome, (FitOutcome.FAILED, FitOutcome.MISFIT))
    bad = lost[sightings.heliostat]
    ended = np.where(np.isfinite(fitted.values), fitted.values, fitted.centre)
    for values in (fitted.centre, ended):
        moved = mechanism.with_parameters({n: values[:, p] for p, n in enumerate(fitted.names)})
        line = linearise(moved[sightings.heliostat], sightings, fitted.names)
        bad |= ~is_usable(line)
    return bad
