"""Fits mechanism parameters to sightings.

`fit` returns the maximum a posteriori parameters of every heliostat with their covariance (a
`FieldFit`), `fit_common` does so where sightings share errors, and `fit_terms` adds user-defined
error terms of the drives. `linearise` returns the whitened residuals of sightings and their
derivatives, on which fitting, uncertainty and planning are all built.
"""

from heliotrope.calibration.fit.common import CommonErrors, CommonFit, fit_common
from heliotrope.calibration.fit.estimator import FieldFit, FitOutcome, Loss, fit
from heliotrope.calibration.fit.residuals import Linearised, linearise
from heliotrope.calibration.fit.terms import DriveTerm, TermFit, fit_terms, table_terms

__all__ = [
    "CommonErrors",
    "CommonFit",
    "DriveTerm",
    "FieldFit",
    "FitOutcome",
    "Linearised",
    "Loss",
    "TermFit",
    "fit",
    "fit_common",
    "fit_terms",
    "linearise",
    "table_terms",
]
