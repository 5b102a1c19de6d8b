"""Spots on a face: the background without beams, the spots above it, and their defects.

- `background`: what a target looks like without beams, estimated from one frame, from an empty
  frame or from a learnt model.
- `spot`: centroid, covariance and shape of each spot.
- `placed`: the position of a spot on its target; `centroid`: a user-defined centroid function.
- `quality`: named reasons against a spot, with measured values and limits.
"""

from heliotrope.imaging.spots.background import (
    Background,
    EmptyTarget,
    from_difference,
    from_frame,
    from_model,
)
from heliotrope.imaging.spots.centroid import BeamPicture, Centroid
from heliotrope.imaging.spots.placed import PlacedSpot, place
from heliotrope.imaging.spots.quality import REASONS, Expectation, Limits, Reason, judge
from heliotrope.imaging.spots.spot import Spot, find_spots

__all__ = [
    "REASONS",
    "Background",
    "BeamPicture",
    "Centroid",
    "EmptyTarget",
    "Expectation",
    "Limits",
    "PlacedSpot",
    "Reason",
    "Spot",
    "find_spots",
    "from_difference",
    "from_frame",
    "from_model",
    "judge",
    "place",
]
