"""Calibration from the air: a drone with a lamp beside its camera (HelioPoint).

A mirror in which the camera sees the lamp is normal to the line of sight from the drone. The
package plans such flights, evaluates their photographs, and simulates both.

- `heliotrope.airborne.plan`: clusters, calibration points, hover patterns, airspace, sorties and
  waypoint files. Begin with ``plan_flight``.
- `heliotrope.airborne.evaluate`: from photographs to orientations, report and sightings. Begin with
  ``evaluate_flight``.
- `heliotrope.airborne.simulate`: flights with ground truth, with or without images.

The package itself contains what all three share: mirrors and their poses, photographs and cameras.
"""

from heliotrope.airborne.mirror import MirrorShape, ideal, measured_normal, rectangle, tiled
from heliotrope.airborne.photo import LedCamera, Photo, read_camera, read_photos, write_camera
from heliotrope.airborne.standing import MirrorPoses, read_commands, write_commands
from heliotrope.field.formats.slopes import read_slopes, write_slopes

__all__ = [
    "LedCamera",
    "MirrorPoses",
    "MirrorShape",
    "Photo",
    "ideal",
    "measured_normal",
    "read_camera",
    "read_commands",
    "read_photos",
    "read_slopes",
    "rectangle",
    "tiled",
    "write_camera",
    "write_commands",
    "write_slopes",
]
