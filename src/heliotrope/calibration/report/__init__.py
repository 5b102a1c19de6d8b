"""Report a calibration: a page with plots, and files for other programs.

A `CalibrationReport` holds the content; `write_report` writes the page and all files beside it.
`FieldParameters` are the parameters at one moment, as stored in ``calibration.json``. `read_json`
reads them, and `Plant.with_calibration` applies them to a plant.
"""

from heliotrope.calibration.report.content import CalibrationReport, HeliostatRow
from heliotrope.calibration.report.page import write_parameters, write_report
from heliotrope.calibration.report.results import (
    FieldParameters,
    at_moment,
    read_json,
    write_artist,
    write_json,
    write_opencsp,
    write_paint,
    write_parquet,
    write_solarpilot,
)

__all__ = [
    "CalibrationReport",
    "FieldParameters",
    "HeliostatRow",
    "at_moment",
    "read_json",
    "write_artist",
    "write_json",
    "write_opencsp",
    "write_paint",
    "write_parameters",
    "write_parquet",
    "write_report",
    "write_solarpilot",
]
