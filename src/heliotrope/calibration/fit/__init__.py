"""Fits the parameters of mechanisms to sightings.

`fit` gives the maximum a posteriori parameters of every heliostat with their covariance (a
`FieldFit`), and `fit_common` does so where sightings share errors; `linearise` gives the whitened
residuals of sightings and their derivatives, from which fitting, uncertainty and planning all
start.
"""

from heliotrope.calibration.fit.common import CommonErrors, CommonFit, fit_common
from heliotrope.calibration.fit.estimator import FieldFit, FitOutcome, Loss, fit
from heliotrope.calibration.fit.residuals import Linearised, linearise

__all__ = [
    "CommonErrors",
    "CommonFit",
    "FieldFit",
    "FitOutcome",
    "Linearised",
    "Loss",
    "fit",
    "fit_common",
    "linearise",
]
