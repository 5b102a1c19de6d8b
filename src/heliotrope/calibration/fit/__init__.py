"""Fits the parameters of mechanisms to sightings.

`fit` gives the maximum a posteriori parameters of every heliostat with their covariance (a
`FieldFit`); `linearise` gives the whitened residuals of sightings and their derivatives, from which
fitting, uncertainty and planning all start.
"""

from heliotrope.calibration.fit.estimator import FieldFit, FitOutcome, Loss, fit
from heliotrope.calibration.fit.residuals import Linearised, linearise

__all__ = ["FieldFit", "FitOutcome", "Linearised", "Loss", "fit", "linearise"]
