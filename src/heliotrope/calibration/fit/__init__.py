"""Fits the parameters of mechanisms to sightings.

`fit` gives the maximum a posteriori parameters of every heliostat with their covariance (a
`FieldFit`), `fit_common` does so where sightings share errors, and `fit_terms` with own error terms
of the drives; `linearise` gives the whitened residuals of sightings and their derivatives, from
which fitting, uncertainty and planning all start.
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
