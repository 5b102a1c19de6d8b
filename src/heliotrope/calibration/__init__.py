"""Estimate the parameters of each heliostat, and their covariance, from sightings.

A sighting is one measurement of where a mirror points; `camera_target`, `drone`, `sun_sensor` and
`field_camera` create `Sightings`, each from one kind of measurement, and `read_sightings` reads
them from a table. The subpackages:

- `calibration.fit`: the parameters of each heliostat (`fit`);
- `calibration.learn`: a whole field, with drift, steps and outliers (`learn`, `predict`);
- `calibration.plan`: the most informative measurements (`plan_sightings`, `plan_campaign`);
- `calibration.report`: a report page, and files for other programs (`write_report`).

`calibrate` and `evaluate` run all steps from files to results. Functions that share the name of
their subpackage or module must be imported from there: ``from heliotrope.calibration.fit import
fit``, ``from heliotrope.calibration.learn import learn``, ``from heliotrope.calibration.sightings
import sightings``.
"""

from heliotrope.calibration.clock import ClockCheck, check_clock
from heliotrope.calibration.evaluation import (
    BeamErrors,
    ErrorSummary,
    Split,
    beam_errors,
    split,
    summarise,
)
from heliotrope.calibration.fit import FieldFit, FitOutcome
from heliotrope.calibration.learn import Assessment, Learned, Prediction, assess, predict
from heliotrope.calibration.plan import (
    Fleet,
    SightingLimits,
    candidate_sightings,
    plan_campaign,
    plan_sightings,
)
from heliotrope.calibration.plausibility import Judgement, judge
from heliotrope.calibration.report import CalibrationReport, FieldParameters, write_report
from heliotrope.calibration.sighting_table import read_malan, read_sightings, write_sightings
from heliotrope.calibration.sightings import (
    Sightings,
    camera_target,
    drone,
    field_camera,
    join,
    of_measurements,
    sun_sensor,
)
from heliotrope.calibration.uncertainty import (
    BlindSpot,
    YearMap,
    error_form,
    expected_error,
    precision,
    suns_of_year,
    unobservable,
    year_map,
)
from heliotrope.calibration.workflow import (
    FieldSightings,
    HeldOutEvaluation,
    calibrate,
    evaluate,
    read_field_sightings,
)

__all__ = [
    "Assessment",
    "BeamErrors",
    "BlindSpot",
    "CalibrationReport",
    "ClockCheck",
    "ErrorSummary",
    "FieldFit",
    "FieldParameters",
    "FieldSightings",
    "FitOutcome",
    "Fleet",
    "HeldOutEvaluation",
    "Judgement",
    "Learned",
    "Prediction",
    "SightingLimits",
    "Sightings",
    "Split",
    "YearMap",
    "assess",
    "beam_errors",
    "calibrate",
    "camera_target",
    "candidate_sightings",
    "check_clock",
    "drone",
    "error_form",
    "evaluate",
    "expected_error",
    "field_camera",
    "join",
    "judge",
    "of_measurements",
    "plan_campaign",
    "plan_sightings",
    "precision",
    "predict",
    "read_field_sightings",
    "read_malan",
    "read_sightings",
    "split",
    "summarise",
    "sun_sensor",
    "suns_of_year",
    "unobservable",
    "write_report",
    "write_sightings",
    "year_map",
]
