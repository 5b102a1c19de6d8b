"""Keep-out volumes: where no beam may be."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.control import _beam_kernels as kernels
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, as_vectors


@dataclass(frozen=True)
class Sphere:
    """A ball: name, centre (ENU, m, (3,)) and radius (m)."""

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
        What an operator calls it.
    center
        ENU, m, (3,).
    size
        To its right, forwards and up, m, (3,).
    azimuth
        Of its forward direction, clockwise from north, rad.
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
    """A cylinder between two points of its axis, such as a tower or an approach corridor.

    Attributes
    ----------
    name
        What an operator calls it.
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
        way = _point(self.name, "end", self.end) - _point(self.name, "start", self.start)
        if not np.linalg.norm(way) > 0.0:
            raise InputError(f"volume {self.name}: its ends are one point; give two")
        _positive(self.name, "radius", self.radius)


@dataclass(frozen=True)
class Prism:
    """A polygon extruded upwards, such as a walkway, a site or a sector of the sky.

    Attributes
    ----------
    name
        What an operator calls it.
    corners
        Of the polygon in order, either way round, east and north, m, (K, 2), K ≥ 3.
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
                f"volume {self.name}: corners of shape {corners.shape}; give at least 3 points "
                "of 2 numbers, (K, 2)"
            )
        if not (np.isfinite(corners).all() and np.isfinite([self.bottom, self.top]).all()):
            raise InputError(f"volume {self.name}: a corner or height is not finite")
        if not self.top > self.bottom:
            raise InputError(
                f"volume {self.name}: top {self.top:g} m must be above bottom {self.bottom:g} m"
            )
        if (np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1) == 0.0).any():
            raise InputError(f"volume {self.name}: two neighbouring corners are one point")


Volume = Sphere | Box | Cylinder | Prism


def packed(volumes: Sequence[Volume]) -> tuple[FloatArray, FloatArray]:
    """Return the rows (V, SIZE) and corners (C, 2) that the kernels read."""
    table = np.zeros((len(volumes), kernels.SIZE))
    corners: list[FloatArray] = []
    count = 0
    for row, volume in zip(table, volumes, strict=True):
        match volume:
            case Sphere():
                _head(row, kernels.SPHERE, as_float(volume.center), volume.radius)
            case Box():
                half = 0.5 * as_float(volume.size)
                _head(row, kernels.BOX, as_float(volume.center), float(np.linalg.norm(half)))
                row[5:8] = half
                # To the right is (cos, −sin) of the azimuth, forwards (sin, cos).
                row[8:10] = np.cos(volume.azimuth), -np.sin(volume.azimuth)
            case Cylinder():
                start, end = as_float(volume.start), as_float(volume.end)
                length = float(np.linalg.norm(end - start))
                bound = float(np.hypot(0.5 * length, volume.radius))
                _head(row, kernels.CYLINDER, 0.5 * (start + end), bound)
                row[5:8] = (end - start) / length
                row[8:10] = 0.5 * length, volume.radius
            case Prism():
                given = as_float(volume.corners)
                middle = 0.5 * (given.min(axis=0) + given.max(axis=0))
                half_height = 0.5 * (volume.top - volume.bottom)
                wide = float(np.linalg.norm(given - middle, axis=1).max())
                center = np.array([*middle, 0.5 * (volume.top + volume.bottom)])
                _head(row, kernels.PRISM, center, float(np.hypot(wide, half_height)))
                row[5:8] = half_height, count, len(given)
                corners.append(given)
                count += len(given)
    return table, np.concatenate(corners) if corners else np.empty((0, 2))


def _head(row: FloatArray, kind: int, center: FloatArray, bound: float) -> None:
    row[0], row[1:4], row[4] = kind, center, bound


def _point(name: str, what: str, value: npt.ArrayLike) -> FloatArray:
    point = as_vectors(value, f"volume {name}: {what}")
    if point.shape != (3,):
        raise InputError(f"volume {name}: {what} of shape {point.shape}; give 3 numbers")
    return point


def _positive(name: str, what: str, value: float) -> None:
    if not (np.isfinite(value) and value > 0.0):
        raise InputError(f"volume {name}: {what} {value} m must be above 0 and finite")
