"""Plan drone campaigns: clusters, poses, hover patterns, sorties and waypoint files.

Begin with `plan_flight`, which takes a plant and `PlanSettings`; `write_plan` writes the resulting
plan to files. `heliotrope.airborne.plan.waypoints` writes waypoint files, and
`heliotrope.airborne.plan.flight_map` draws a map.
"""

from heliotrope.airborne.plan.airspace import Airspace, KeepOut, tower
from heliotrope.airborne.plan.calibration_points import PointSelection
from heliotrope.airborne.plan.clusters import HeliostatClusters
from heliotrope.airborne.plan.flight import CameraTarget, Craft, HoverStation, Sortie, camera_target
from heliotrope.airborne.plan.flight_files import FORMATS, read_airspace, write_plan
from heliotrope.airborne.plan.flight_plan import FlightPlan, PlanSettings, plan_flight
from heliotrope.airborne.plan.hover import Sampling
from heliotrope.airborne.plan.stations import PlannedStation, read_stations
from heliotrope.airborne.plan.waypoints import AIRCRAFT, Mission

__all__ = [
    "AIRCRAFT",
    "FORMATS",
    "Airspace",
    "CameraTarget",
    "Craft",
    "FlightPlan",
    "HeliostatClusters",
    "HoverStation",
    "KeepOut",
    "Mission",
    "PlanSettings",
    "PlannedStation",
    "PointSelection",
    "Sampling",
    "Sortie",
    "camera_target",
    "plan_flight",
    "read_airspace",
    "read_stations",
    "tower",
    "write_plan",
]
