"""Calibration visits: a heliostat goes to a target, is photographed, and returns.

Begin with `CalibrationCycle`: it sends a heliostat to a target, takes photographs (directly, or
with a search for the beam: `Centring`), fits them, and updates the plant's belief if the
calibration is better. `JointCycle` calibrates several heliostats on one target at once, and
identifies them by their movements; `ReceiverCycle` does this on a receiver, while the heliostats
track it. `Visit` is the travel to the target and back; `TargetCamera` is the protocol of a camera.
"""

from heliotrope.plant.visits.calibration_cycle import CalibrationCycle, CycleResult
from heliotrope.plant.visits.joint_cycle import JointCycle
from heliotrope.plant.visits.neighbours import Unhidden
from heliotrope.plant.visits.photographs import Photographs, Shot, TargetCamera
from heliotrope.plant.visits.receiver_cycle import ReceiverCycle
from heliotrope.plant.visits.settings import Centring, CycleSettings
from heliotrope.plant.visits.visit import Visit

__all__ = [
    "CalibrationCycle",
    "Centring",
    "CycleResult",
    "CycleSettings",
    "JointCycle",
    "Photographs",
    "ReceiverCycle",
    "Shot",
    "TargetCamera",
    "Unhidden",
    "Visit",
]
