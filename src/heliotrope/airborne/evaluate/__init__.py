"""Evaluate a drone's photographs: mirror orientations, report and sightings.

Begin with `evaluate_flight`, which turns a folder of photographs into the result; its docstring
lists the steps. `write_result` writes the result to files. Each step can also be called separately:
`read_many`, `evaluate`, `measure_field`, `to_sightings`.
"""

from heliotrope.airborne.evaluate.budget import Budget
from heliotrope.airborne.evaluate.bundle import Priors
from heliotrope.airborne.evaluate.campaign import Campaign, evaluate_campaign
from heliotrope.airborne.evaluate.evaluation import FlightEvaluation, evaluate
from heliotrope.airborne.evaluate.flight import CampaignResult, FlightResult, evaluate_flight
from heliotrope.airborne.evaluate.folder import FlightData, open_flights
from heliotrope.airborne.evaluate.orientation import (
    Orientation,
    Orientations,
    measure,
    measure_field,
    rotation_between,
)
from heliotrope.airborne.evaluate.reading import PhotoReading, read_many, read_photo
from heliotrope.airborne.evaluate.reflections import (
    Reflections,
    read_reflections,
    write_reflections,
)
from heliotrope.airborne.evaluate.report import (
    write_campaign_report,
    write_flight_report,
    write_result,
)
from heliotrope.airborne.evaluate.rtk import RtkCheck, check_rtk
from heliotrope.airborne.evaluate.sightings import Together, fit_together, to_sightings
from heliotrope.airborne.evaluate.tables import MeasuredFlight

__all__ = [
    "Budget",
    "Campaign",
    "CampaignResult",
    "FlightData",
    "FlightEvaluation",
    "FlightResult",
    "MeasuredFlight",
    "Orientation",
    "Orientations",
    "PhotoReading",
    "Priors",
    "Reflections",
    "RtkCheck",
    "Together",
    "check_rtk",
    "evaluate",
    "evaluate_campaign",
    "evaluate_flight",
    "fit_together",
    "measure",
    "measure_field",
    "open_flights",
    "read_many",
    "read_photo",
    "read_reflections",
    "rotation_between",
    "to_sightings",
    "write_campaign_report",
    "write_flight_report",
    "write_reflections",
    "write_result",
]
