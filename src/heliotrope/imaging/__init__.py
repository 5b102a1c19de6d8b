"""Photographs of targets: from a frame to spots, in metres with covariance, and to sightings.

- `frame`, `files`, `sources`: frames, image files, and frame sources.
- `targets`: find targets by their marks; set up reference views of targets for a camera.
- `spots`: background, spots and their quality.
- `photograph`: evaluate one photograph; `campaign`: turn many photographs into sightings; `memory`:
  models of empty targets; `log`: facts about photographs; `annotate`: draw the result.
- `lens`: calibrate lenses; `pose`: locate cameras. The camera model is `heliotrope.field.camera`.
- `coded`: several beams on one target at once, identified by coded movements.
- `motion`: detect whether a beam moved between two frames.
- `synthetic`: render frames with exact ground truth; only simulations import this package.

Begin with `read_image` and `read_photograph`.
"""

from heliotrope.imaging.annotate import annotate
from heliotrope.imaging.campaign import Job, Outcome, process_many, sighting_of, to_sightings
from heliotrope.imaging.files import find_images, read_image, write_image
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.lens import Lens, calibrate_chessboard
from heliotrope.imaging.log import Entry, Log, read_log
from heliotrope.imaging.memory import Memory
from heliotrope.imaging.motion import (
    FrameMotion,
    MotionDetector,
    MotionSettings,
    detect_motion,
    find_shift,
)
from heliotrope.imaging.photograph import (
    Photograph,
    PhotographSettings,
    TargetReading,
    read_crop,
    read_photograph,
)
from heliotrope.imaging.pose import CameraFit, calibrate_marks, resection
from heliotrope.imaging.sources import Source, average, keep, open_source
from heliotrope.imaging.spots.background import EmptyTarget
from heliotrope.imaging.spots.centroid import BeamPicture
from heliotrope.imaging.spots.placed import PlacedSpot
from heliotrope.imaging.spots.quality import Expectation, Limits, Reason
from heliotrope.imaging.targets.finding import find_targets

__all__ = [
    "BeamPicture",
    "CameraFit",
    "EmptyTarget",
    "Entry",
    "Expectation",
    "Frame",
    "FrameMotion",
    "Job",
    "Lens",
    "Limits",
    "Log",
    "Memory",
    "MotionDetector",
    "MotionSettings",
    "Outcome",
    "Photograph",
    "PhotographSettings",
    "PlacedSpot",
    "Reason",
    "Source",
    "TargetReading",
    "annotate",
    "average",
    "calibrate_chessboard",
    "calibrate_marks",
    "detect_motion",
    "find_images",
    "find_shift",
    "find_targets",
    "keep",
    "open_source",
    "process_many",
    "read_crop",
    "read_image",
    "read_log",
    "read_photograph",
    "resection",
    "sighting_of",
    "to_sightings",
    "write_image",
]
