"""The centre of a generated field: targets with marks, the targets' cameras, and receivers."""

import numpy as np

from heliotrope.field.camera import Camera
from heliotrope.field.marks import Mark
from heliotrope.field.target import Receiver, Target
from heliotrope.geometry import FloatArray, as_float, direction, normalize

#: Size and stroke width of the marks, and their distance from the border, as fractions of the side.
_MARK, _STROKE, _INSET = 0.075, 0.015, 0.0375
#: Fraction of a frame's shorter side that a target fills.
_FILL = 0.7
#: Size of a camera's frames, pixels.
_SIZE = (1600, 1200)
#: Kind, position (right, up) and quarter turns of each mark.
_MARKS = {
    "upper_left": ("corner", -1, 1, 0), "upper_right": ("corner", 1, 1, -1),
    "lower_right": ("corner", 1, -1, 2), "lower_left": ("corner", -1, -1, 1),
    "top": ("tee", 0, 1, 0), "right": ("tee", 1, 0, -1),
    "bottom": ("tee", 0, -1, 2), "left": ("tee", -1, 0, 1),
}  # fmt: skip


def square_target(name: str, center: FloatArray, side: float, facing: float) -> Target:
    """Return an upright square with eight marks, whose front faces azimuth ``facing``, rad."""
    right = direction(facing - 0.5 * np.pi, 0.0)
    up = np.array([0.0, 0.0, 1.0])
    half, inset = 0.5 * side, (0.5 - _INSET) * side
    marks = tuple(
        Mark(
            mark,
            kind,
            center + inset * (x * right + y * up),
            _MARK * side,
            _STROKE * side,
            turns * 0.5 * np.pi,
        )
        for mark, (kind, x, y, turns) in _MARKS.items()
    )
    return Target(name, _corners(center, half * right, half * up), center, marks=marks)


def _corners(center: FloatArray, right: FloatArray, up: FloatArray) -> FloatArray:
    return np.stack(
        [center - right + up, center + right + up, center + right - up, center - right - up]
    )


def watching_camera(target: Target, name: str, away: float, height: float, aside: float) -> Camera:
    """Return a camera in front of a target.

    Parameters
    ----------
    target
        The target that the camera observes.
    name
        Name of the camera.
    away, aside
        Distances from the target's centre along its normal and to the right of it, m.
    height
        Height of the camera above the plant's reference, m.
    """
    position = target.center + away * target.normal + aside * target.axes[0]
    position[2] = height
    forward = normalize(target.center - position)
    right = normalize(np.cross(forward, [0.0, 0.0, 1.0]))
    distance = float(np.linalg.norm(target.center - position))
    focal = _FILL * min(_SIZE) * distance / max(target.width, target.height)
    matrix = np.array(
        [[focal, 0.0, 0.5 * (_SIZE[0] - 1)], [0.0, focal, 0.5 * (_SIZE[1] - 1)], [0.0, 0.0, 1.0]]
    )
    axes = np.stack([right, np.cross(forward, right), forward], axis=-1)
    return Camera(name, _SIZE, matrix, position=position, R_enu_camera=axes, targets=(target.name,))


def aperture(name: str, center: FloatArray, side: float, facing: float, down: float) -> Receiver:
    """Return the square aperture of a cavity that faces azimuth ``facing`` and down, rad."""
    normal = direction(facing, -down)
    right = direction(facing - 0.5 * np.pi, 0.0)
    corners = _corners(center, 0.5 * side * right, 0.5 * side * np.cross(normal, right))
    return Receiver(name, "planar", center, normal, side, side, corners)


def cylinder(name: str, center: FloatArray, diameter: float, height: float) -> Receiver:
    """Return a cylinder that receives light from all sides."""
    return Receiver(
        name,
        "external_cylinder",
        center,
        as_float([0.0, -1.0, 0.0]),
        diameter,
        height,
        radius=0.5 * diameter,
        opening_angle=2.0 * np.pi,
    )
