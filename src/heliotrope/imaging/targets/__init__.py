"""Find targets in frames by their marks, and define marks that a camera can recognise.

- `marks` and `detection`: drawings of marks, and candidates for them in a frame.
- `constellation` and `refinement`: assign candidates to marks, and locate the marks exactly.
- `finding`: targets in a frame, or why they were not found, through successive `attempt`s. `view`
  maps a target plane to a frame, and `rectify` shows the plane from the front.
- `teaching` and `click_page`: marks and a camera from points that a user clicks. `sights`: how well
  a camera sees its targets.

Begin with `find_targets`.
"""

from heliotrope.imaging.targets.finding import FoundMark, FoundTarget, find_targets
from heliotrope.imaging.targets.marks import polygons
from heliotrope.imaging.targets.rectify import Rectified, from_crop, rectify
from heliotrope.imaging.targets.sights import TargetView, sights
from heliotrope.imaging.targets.teaching import (
    Taught,
    TaughtPoint,
    Wish,
    known_points,
    read_pictures,
    teach,
    write_taught,
)
from heliotrope.imaging.targets.view import Face, FaceView, faces, fit_view

__all__ = [
    "Face",
    "FaceView",
    "FoundMark",
    "FoundTarget",
    "Rectified",
    "TargetView",
    "Taught",
    "TaughtPoint",
    "Wish",
    "faces",
    "find_targets",
    "fit_view",
    "from_crop",
    "known_points",
    "polygons",
    "read_pictures",
    "rectify",
    "sights",
    "teach",
    "write_taught",
]
