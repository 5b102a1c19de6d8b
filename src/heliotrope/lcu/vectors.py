"""Three-vectors as tuples of floats."""

import math


def dot(a: tuple[float, float, float], b: tuple[float, float, float]) -> float:
    """Return the dot product a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(
    a: tuple[float, float, float], b: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Return the cross product a × b."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def add(a: tuple[float, float, float], b: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the sum a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def minus(
    a: tuple[float, float, float], b: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Return the difference a − b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def times(factor: float, a: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the product factor · a."""
    return factor * a[0], factor * a[1], factor * a[2]


def norm(a: tuple[float, float, float]) -> float:
    """Return the length |a|."""
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


def unit(a: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the unit vector a / |a|; a must not be zero."""
    return times(1.0 / norm(a), a)


def across(
    a: tuple[float, float, float], axis: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Return the component of a perpendicular to the unit axis."""
    along = dot(a, axis)
    return a[0] - along * axis[0], a[1] - along * axis[1], a[2] - along * axis[2]


def about(
    axis: tuple[float, float, float], sine: float, cosine: float, u: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Rotate u about the unit axis by an angle with known sine and cosine (Rodrigues)."""
    along = (1.0 - cosine) * dot(axis, u)
    return (
        cosine * u[0] + sine * (axis[1] * u[2] - axis[2] * u[1]) + along * axis[0],
        cosine * u[1] + sine * (axis[2] * u[0] - axis[0] * u[2]) + along * axis[1],
        cosine * u[2] + sine * (axis[0] * u[1] - axis[1] * u[0]) + along * axis[2],
    )


def turn_between(
    axis: tuple[float, float, float],
    u: tuple[float, float, float],
    v: tuple[float, float, float],
) -> float:
    """Return the angle (rad) about the unit axis that brings u as near to v as possible."""
    flat = across(u, axis)
    return math.atan2(dot(axis, cross(flat, v)), dot(flat, v))


def finite(values: tuple[float, ...]) -> bool:
    """Return whether every number is finite."""
    for value in values:  # noqa: SIM110 - a generator would allocate
        if not math.isfinite(value):
            return False
    return True
