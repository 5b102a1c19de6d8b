"""Vectors, rotations and frames.

The frame is ENU (x east, y north, z up), right-handed, in metres. Azimuth is clockwise from north
in [0, 2π), elevation is above the horizon. Arrays have their batch axes first and the vector axis
last, ``(..., 3)``.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError, shown

FloatArray = npt.NDArray[np.float64]

TAU = 2.0 * np.pi
#: Largest accepted angle, rad: four turns. A larger number is probably in degrees.
MOST_TURNS = 4.0 * TAU
#: One milliradian, so that tolerances can be written as ``0.01 * MRAD``.
MRAD = 1e-3


def as_float(value: npt.ArrayLike) -> FloatArray:
    """Return ``value`` as a float64 array without copying one that already is."""
    return np.asarray(value, dtype=np.float64)


def as_numbers(
    value: npt.ArrayLike,
    name: str,
    low: float = -np.inf,
    high: float = np.inf,
    unit: str = "",
    advice: str = "",
) -> FloatArray:
    """Return ``value`` as an array of numbers that lie within ``low`` and ``high``.

    Infinity is accepted only if the limit itself is infinite; NaN is never accepted.

    Parameters
    ----------
    value
        Numbers of any shape.
    name, unit
        Name and unit of the value for the error message.
    low, high
        Limits, in the unit.
    advice
        Advice for the error message.

    Raises
    ------
    InputError
        If the value is not an array of numbers, or a number is outside the limits.
    """
    try:
        array = as_float(value)
    except (TypeError, ValueError):
        raise InputError(f"{name}: {shown(value)} is not an array of numbers") from None
    wrong = ~((array >= low) & (array <= high))
    if wrong.any():
        where = tuple(int(i) for i in np.argwhere(wrong)[0])
        place = f"{name}{list(where)}" if where else name
        if np.isnan(array[where]):
            raise InputError(f"{place}: nan is not a number; pass a number")
        number = f"{array[where]:.6g} {unit}".strip()
        limits = f"{low:.6g} to {high:.6g} {unit}".strip()
        raise InputError(
            f"{place}: {number} is not within {limits}; {advice or 'correct the value'}"
        )
    return array


def as_angles(value: npt.ArrayLike, name: str, limit: float) -> FloatArray:
    """Return ``value`` as angles in rad of at most ``limit``, which most degree values exceed.

    Raises
    ------
    InputError
        If the value is not an array of numbers, or a number exceeds the limit or is not finite.
    """
    return as_numbers(value, name, -limit, limit, "rad", "degrees need numpy.radians")


def as_vectors(value: npt.ArrayLike, name: str) -> FloatArray:
    """Return ``value`` as finite vectors of shape (..., 3).

    Raises
    ------
    InputError
        If the last axis is not 3 or a number is not finite.
    """
    try:
        array = as_float(value)
    except (TypeError, ValueError):
        raise InputError(f"{name}: {shown(value)} is not an array of numbers") from None
    if array.ndim == 0 or array.shape[-1] != 3:
        raise InputError(f"{name}: shape {array.shape}; the last axis must have 3 numbers")
    if not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise InputError(f"{name}{list(where)}: {array[where]} is not a finite number")
    return array


def common_shape(**arrays: FloatArray) -> tuple[int, ...]:
    """Return the shape to which named arrays broadcast; the error message quotes the names.

    Raises
    ------
    InputError
        If the shapes do not broadcast together.
    """
    return common_batch({name: array.shape for name, array in arrays.items()})


def common_batch(shapes: Mapping[str, tuple[int, ...]]) -> tuple[int, ...]:
    """Return the shape to which these batch shapes broadcast.

    Raises
    ------
    InputError
        If the shapes do not broadcast together; the message names one array of each shape.
    """
    try:
        return np.broadcast_shapes(*shapes.values())
    except ValueError:
        first: dict[tuple[int, ...], str] = {}
        for name, shape in shapes.items():
            first.setdefault(shape, name)
        listed = ", ".join(f"{name} {shape}" for shape, name in first.items() if shape)
        raise InputError(
            f"shapes do not broadcast together: {listed}; pass one of each, or equal numbers of "
            "them"
        ) from None


def normalize(vectors: npt.ArrayLike, name: str = "vector") -> FloatArray:
    """Return unit vectors.

    Parameters
    ----------
    vectors
        Vectors of any non-zero length, (..., 3).
    name
        Name of the vectors for the error message.

    Raises
    ------
    InputError
        If a vector is zero or not finite.
    """
    array = as_vectors(vectors, name)
    # Scaling by the largest component preserves the precision of tiny and huge vectors.
    largest = np.abs(array).max(axis=-1, keepdims=True, initial=0.0)
    if (largest == 0.0).any():
        raise InputError(f"{name}: a vector of length 0 has no direction; pass a nonzero vector")
    scaled = array / largest
    return as_float(scaled / np.linalg.norm(scaled, axis=-1, keepdims=True))


def cross_matrix(vectors: npt.ArrayLike) -> FloatArray:
    """Return K with ``K @ x == cross(v, x)``; shapes (..., 3) to (..., 3, 3)."""
    v = as_float(vectors)
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2] = -v[..., 2], v[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 2] = v[..., 2], -v[..., 0]
    matrix[..., 2, 0], matrix[..., 2, 1] = -v[..., 1], v[..., 0]
    return matrix


def rotation(axis: npt.ArrayLike, angle: npt.ArrayLike) -> FloatArray:
    """Return the right-handed rotation about an axis (Rodrigues).

    Parameters
    ----------
    axis
        Axes, (..., 3), which need not be of unit length. A zero axis yields the identity, and
        therefore represents a missing second axis.
    angle
        Radians, shape (...).

    Returns
    -------
    Rotation matrices, shape (..., 3, 3).
    """
    a = as_float(axis)
    length = np.linalg.norm(a, axis=-1, keepdims=True)
    unit = np.divide(a, length, out=np.zeros_like(a), where=length > 0)
    theta = as_float(angle)[..., None, None]
    k = cross_matrix(unit)
    # 2 sin²(θ/2) preserves the precision of 1 − cos θ at small angles.
    return np.eye(3) + np.sin(theta) * k + 2.0 * np.sin(0.5 * theta) ** 2 * (k @ k)


def direction(azimuth: npt.ArrayLike, elevation: npt.ArrayLike) -> FloatArray:
    """Return unit vectors (..., 3) in ENU from azimuth and elevation in radians.

    Raises
    ------
    InputError
        If the azimuth is not within four turns, or the elevation not within −π/2 to π/2.
    """
    az = as_angles(azimuth, "azimuth", MOST_TURNS)
    # Rounding may push the elevation beyond the zenith; clip it there.
    el = as_angles(elevation, "elevation", 0.5 * np.pi + 1e-9)
    common_shape(azimuth=az, elevation=el)
    az, el = np.broadcast_arrays(az, el)
    cos_el = np.cos(el)
    return np.stack([cos_el * np.sin(az), cos_el * np.cos(az), np.sin(el)], axis=-1)


def azimuth_elevation(vectors: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return azimuth in [0, 2π) and elevation in [−π/2, π/2] of vectors (..., 3).

    The elevation is computed with atan2, which preserves its precision near the zenith. At the
    zenith itself the azimuth is 0.
    """
    v = as_float(vectors)
    azimuth = wrap_positive(np.arctan2(v[..., 0], v[..., 1]))
    elevation = np.arctan2(v[..., 2], np.hypot(v[..., 0], v[..., 1]))
    return azimuth, as_float(elevation)


def wrap_positive(angle: npt.ArrayLike) -> FloatArray:
    """Return the angle in [0, 2π)."""
    wrapped = np.mod(as_float(angle), TAU)
    # A tiny negative angle rounds up to 2π itself.
    return as_float(np.where(wrapped >= TAU, 0.0, wrapped))


def wrap_signed(angle: npt.ArrayLike) -> FloatArray:
    """Return the angle in [−π, π)."""
    wrapped = wrap_positive(as_float(angle) + np.pi) - np.pi
    return as_float(wrapped)


def angle_between(a: npt.ArrayLike, b: npt.ArrayLike) -> FloatArray:
    """Return the angle between unit vectors (..., 3) in radians, exact near 0 and π.

    The formula is Kahan's, 2·atan2(|a − b|, |a + b|); arccos of the scalar product loses half of
    the digits for small angles.
    """
    u, v = as_float(a), as_float(b)
    return as_float(
        2.0 * np.arctan2(np.linalg.norm(u - v, axis=-1), np.linalg.norm(u + v, axis=-1))
    )


def bisector(source: npt.ArrayLike, destination: npt.ArrayLike) -> FloatArray:
    """Return the unit normal that sends light from ``source`` towards ``destination``.

    The law of reflection is n ∥ s + t, where s and t are unit vectors (..., 3) that point away from
    the mirror.

    Raises
    ------
    InputError
        If source and destination are opposite, so that no normal exists.
    """
    total = as_float(source) + as_float(destination)
    length = np.linalg.norm(total, axis=-1, keepdims=True)
    if (length < 1e-12).any():
        raise InputError(
            "source and destination are opposite as seen from the mirror: no normal exists"
        )
    return as_float(total / length)


def reflect(direction_in: npt.ArrayLike, normal: npt.ArrayLike) -> FloatArray:
    """Return the direction of the reflected light, 2 (n·s) n − s, with s = ``direction_in``."""
    s, n = as_float(direction_in), as_float(normal)
    return as_float(2.0 * np.sum(s * n, axis=-1, keepdims=True) * n - s)


def tangent_axes(normals: npt.ArrayLike) -> FloatArray:
    """Return two unit axes perpendicular to each normal, shape (..., 2, 3).

    The first axis is horizontal, to the right as seen by an observer looking along the normal, and
    the second axis points up. For a vertical normal the two axes are east and north.
    """
    n = as_float(normals)
    horizontal = np.stack([n[..., 1], -n[..., 0], np.zeros(n.shape[:-1])], axis=-1)
    length = np.linalg.norm(horizontal, axis=-1, keepdims=True)
    east = np.zeros_like(n)
    east[..., 0] = 1.0
    first = np.where(length > 1e-9, horizontal / np.maximum(length, 1e-300), east)
    first = first - np.sum(first * n, axis=-1, keepdims=True) * n
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(first, n)], axis=-2)


def _check_origin(origin: tuple[float, float, float]) -> None:
    values = as_numbers(origin, "origin")
    if values.shape != (3,):
        raise InputError(
            f"origin: {shown(origin)} is not latitude, longitude and height; pass two angles in "
            "degrees and a height in metres"
        )
    as_numbers(values[0], "origin: latitude", -90.0, 90.0, "°")
    as_numbers(values[1], "origin: longitude", -360.0, 360.0, "°")


def geodetic_to_enu(
    latitude_deg: npt.ArrayLike,
    longitude_deg: npt.ArrayLike,
    height: npt.ArrayLike,
    origin: tuple[float, float, float],
) -> FloatArray:
    """Return WGS84 positions as ENU metres (..., 3) about ``origin``.

    The conversion is exact (geodetic to Earth-centred to local); a linearised conversion is 3 mm
    off at 210 m. ``origin`` is latitude and longitude in degrees, and height in metres.
    """
    import pymap3d

    _check_origin(origin)
    lat, lon, up = np.broadcast_arrays(
        as_float(latitude_deg), as_float(longitude_deg), as_float(height)
    )
    enu: tuple[Any, Any, Any] = pymap3d.geodetic2enu(lat, lon, up, *origin)
    return np.stack([as_float(c) for c in enu], axis=-1)


def enu_to_geodetic(
    points: npt.ArrayLike, origin: tuple[float, float, float]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return ENU points (..., 3) as latitude and longitude in degrees and height in metres."""
    import pymap3d

    _check_origin(origin)
    p = as_vectors(points, "points")
    lat, lon, height = pymap3d.enu2geodetic(p[..., 0], p[..., 1], p[..., 2], *origin)
    return as_float(lat), as_float(lon), as_float(height)
