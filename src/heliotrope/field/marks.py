"""Marks on a target that let a camera locate the target."""

from dataclasses import dataclass

import numpy as np

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_vectors

#: Kinds of marks, with the point that their coordinates refer to and the drawing at turn 0.
KINDS: dict[str, str] = {
    "corner": "an L; its outer vertex, arms to the right and down",
    "tee": "a T; the middle of the outer edge of its bar, stem down",
    "square": "a filled square; its centre",
    "disc": "a filled disc; its centre",
    "tag": "an ArUco or AprilTag square; its centre, upright",
    "picture": "the content of a taught picture; the picture's centre",
}


@dataclass(frozen=True)
class Mark:
    """A dark mark on a light target.

    Attributes
    ----------
    name
        Name, unique on its target, such as "upper_left".
    kind
        One of `KINDS`.
    point
        Position of the reference point of the drawing defined in `KINDS`, ENU, m, (3,).
    size
        Arm length of an L, bar and stem length of a T, side or diameter, m.
    stroke
        Stroke width of a corner or a tee, m.
    turn
        Rotation of the drawing, counterclockwise as seen from the front, rad.
    code
        For a tag, OpenCV dictionary and number, "4X4_50:7" or "APRILTAG_36h11:7"; for a picture,
        the name of its file beside the plant file.
    """

    name: str
    kind: str
    point: FloatArray
    size: float
    stroke: float = 0.0
    turn: float = 0.0
    code: str = ""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(
                f"mark {self.name}: unknown kind {self.kind!r}; known: {', '.join(KINDS)}"
            )
        point = as_vectors(self.point, f"mark {self.name}: point")
        if point.shape != (3,):
            raise InputError(f"mark {self.name}: point must have the shape (3,), not {point.shape}")
        object.__setattr__(self, "point", point)
        if not (np.isfinite(self.size) and self.size > 0.0):
            raise InputError(f"mark {self.name}: size must be above 0, not {self.size} m")
        if not np.isfinite(self.turn):
            raise InputError(f"mark {self.name}: turn must be finite, not {self.turn} rad")
        if self.kind in ("corner", "tee") and not 0.0 < self.stroke < self.size:
            raise InputError(
                f"mark {self.name}: stroke must be above 0 and below its size of {self.size} m, "
                f"not {self.stroke} m"
            )
        if self.kind in ("tag", "picture") and not self.code:
            what = 'a dictionary and number, such as "4X4_50:7"' if self.kind == "tag" else "a file"
            raise InputError(f"mark {self.name}: a {self.kind} needs its code, {what}")
