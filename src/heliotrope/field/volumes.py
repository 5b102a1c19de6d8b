"""Keep-out volumes, which no beam may enter."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError, once
from heliotrope.field.target import Receiver, Target
from heliotrope.geometry import FloatArray, as_float, as_vectors


@dataclass(frozen=True)
class Sphere:
    """A sphere: name, centre (ENU, m, (3,)) and radius (m)."""

    name: str
    center: npt.ArrayLike
    radius: float

    def __post_init__(self) -> None:
        _point(self.name, "center", self.center)
        _positive(self.name, "radius", self.radius)


@dataclass(frozen=True)
class Box:
    """An upright box, such as a building.

    Attributes
    ----------
    name
        Name shown to operators.
    center
        ENU, m, (3,).
    size
        Extent to the right, forwards and up, m, (3,).
    azimuth
        Azimuth of the forward direction, clockwise from north, rad.
    """

    name: str
    center: npt.ArrayLike
    size: npt.ArrayLike
    azimuth: float = 0.0

    def __post_init__(self) -> None:
        _point(self.name, "center", self.center)
        for value in _point(self.name, "size", self.size):
            _positive(self.name, "size", float(value))
        if not np.isfinite(self.azimuth):
            raise InputError(f"volume {self.name}: azimuth {self.azimuth} rad is not finite")


@dataclass(frozen=True)
class Cylinder:
    """A cylinder, such as a tower or an approach corridor, with a given axis.

    Attributes
    ----------
    name
        Name shown to operators.
    start, end
        Centres of its two ends, ENU, m, (3,).
    radius
        m.
    """

    name: str
    start: npt.ArrayLike
    end: npt.ArrayLike
    radius: float

    def __post_init__(self) -> None:
        axis = _point(self.name, "end", self.end) - _point(self.name, "start", self.start)
        if not np.linalg.norm(axis) > 0.0:
            raise InputError(
                f"volume {self.name}: its two ends coincide; specify two different points"
            )
        _positive(self.name, "radius", self.radius)


@dataclass(frozen=True)
class Prism:
    """A polygon extruded upwards, such as a walkway, a site or a sector of the sky.

    Attributes
    ----------
    name
        Name shown to operators.
    corners
        Polygon corners in order, clockwise or counterclockwise, east and north, m, (K, 2), K ≥ 3.
    bottom, top
        Heights, m.
    """

    name: str
    corners: npt.ArrayLike
    bottom: float
    top: float

    def __post_init__(self) -> None:
        corners = as_float(self.corners)
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
            raise InputError(
                f"volume {self.name}: corners have the shape {corners.shape}; specify at least 3 "
                "points, (K, 2)"
            )
        if not (np.isfinite(corners).all() and np.isfinite([self.bottom, self.top]).all()):
            raise InputError(f"volume {self.name}: a corner or height is not finite")
        if not self.top > self.bottom:
            raise InputError(
                f"volume {self.name}: top ({self.top:g} m) must be above bottom ({self.bottom:g} m)"
            )
        if (np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1) == 0.0).any():
            raise InputError(f"volume {self.name}: two neighbouring corners coincide")


Volume = Sphere | Box | Cylinder | Prism


def around(receiver: Receiver, room: float) -> Volume:
    """Return a volume that contains a receiver and a margin ``room``, m, on every side.

    An external cylinder is enclosed in a cylinder, every other aperture in a sphere about its
    centre.
    """
    name = once(f"receiver {receiver.name}")
    name = "the receiver" if name == "receiver" else name
    if receiver.kind == "external_cylinder":
        half = np.array([0.0, 0.0, 0.5 * receiver.height + room])
        ends = receiver.center - half, receiver.center + half
        return Cylinder(name, *ends, 0.5 * receiver.width + room)
    reach = 0.5 * float(np.hypot(receiver.width, receiver.height))
    if receiver.mesh is not None:
        reach = max(reach, float(np.linalg.norm(receiver.mesh.vertices, axis=-1).max()))
    return Sphere(name, receiver.center, reach + room)


def around_target(target: Target, room: float) -> Volume:
    """Return a sphere that contains a target and a margin ``room``, m, on every side."""
    name = once(f"target {target.name}")
    half = float(np.linalg.norm(target.corners - target.center, axis=1).max())
    return Sphere("the target" if name == "target" else name, target.center, half + room)


#: Number of points that draw a circle on a map.
_ROUND = 24


def outline(volume: Volume) -> FloatArray:
    """Return the outline of a volume on a map: polygon corners, east and north, m, (K, 2)."""
    turn = np.linspace(0.0, 2.0 * np.pi, _ROUND, endpoint=False)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    match volume:
        case Sphere():
            return np.asarray(as_float(volume.center)[:2] + volume.radius * circle)
        case Box():
            right = np.array([np.cos(volume.azimuth), -np.sin(volume.azimuth)])
            forward = np.array([np.sin(volume.azimuth), np.cos(volume.azimuth)])
            half = 0.5 * as_float(volume.size)
            signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
            corners = signs * half[:2] @ np.stack([right, forward])
            return np.asarray(as_float(volume.center)[:2] + corners)
        case Cylinder():
            return _shadow(as_float(volume.start), as_float(volume.end), volume.radius * circle)
        case Prism():
            return as_float(volume.corners)


def _shadow(start: FloatArray, end: FloatArray, circle: FloatArray) -> FloatArray:
    """Return the outline of a cylinder from above; its ends are seen as ellipses."""
    axis = (end - start) / np.linalg.norm(end - start)
    flat = float(np.hypot(axis[0], axis[1]))
    along = axis[:2] / flat if flat > 0.0 else np.array([1.0, 0.0])
    across = np.array([-along[1], along[0]])
    # An end is a disc: seen from above, it is a circle on an upright cylinder, and a line on a
    # horizontal one.
    disc = circle[:, :1] * abs(axis[2]) * along + circle[:, 1:] * across
    ahead = circle[:, :1] >= 0.0
    return np.asarray(np.where(ahead, end[:2], start[:2]) + disc)


def _point(name: str, what: str, value: npt.ArrayLike) -> FloatArray:
    point = as_vectors(value, f"volume {name}: {what}")
    if point.shape != (3,):
        raise InputError(
            f"volume {name}: {what} must be 3 numbers, but has the shape {point.shape}"
        )
    return point


def _positive(name: str, what: str, value: float) -> None:
    if not (np.isfinite(value) and value > 0.0):
        raise InputError(f"volume {name}: {what} must be above 0 and finite, not {value} m")
