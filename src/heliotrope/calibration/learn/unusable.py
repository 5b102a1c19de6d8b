"""Sightings that a mechanism cannot produce.

Once the triangle of a jack is fully extended, further counts do not move the joint. The derivative
there is infinite, so one sighting with such counts would corrupt the whole field. Such sightings
are left out.
"""

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.fit.estimator import FieldFit, FitOutcome
from heliotrope.calibration.fit.residuals import Linearised, linearise
from heliotrope.calibration.sightings import Sightings
from heliotrope.mechanism.chain import Mechanism

#: Largest derivative of a whitened residual in a usable sighting. A jack a hundredth of a radian
#: from full extension reaches 1e5 if the centroid has a sigma of 0.5 mrad; beyond full extension
#: the derivative is 1e16 or infinite.
STEEPEST = 1e7


def is_usable(line: Linearised) -> npt.NDArray[np.bool_]:
    """Return whether each sighting's residual and derivative are within the drives' reach, (M,)."""
    with np.errstate(invalid="ignore"):
        flat = (np.abs(line.jacobian) < STEEPEST).all(axis=(1, 2))
    return np.asarray(flat & np.isfinite(line.residual).all(axis=1))


def find_unusable(
    mechanism: Mechanism, sightings: Sightings, fitted: FieldFit
) -> npt.NDArray[np.bool_]:
    """Return a mask of the sightings beyond the drives' reach at the start or end of a fit, (M,).

    If a fit found no possible parameters, none of its sightings is usable.

    Parameters
    ----------
    mechanism
        Nominal mechanisms, (N,).
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
