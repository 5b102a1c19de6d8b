"""Visits of a heliostat to a calibration target.

Begin with `CalibrationCycle`: it sends a heliostat to a target, takes photographs (plainly, or with
a search for the beam: `Centring`), fits them, and lets the plant believe a better calibration.
`JointCycle` calibrates several on one target at once, told apart by their movements;
`ReceiverCycle` does so where they shine, on a receiver.
`Visit` is the way there and back; `TargetCamera` is the protocol of a camera.
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
