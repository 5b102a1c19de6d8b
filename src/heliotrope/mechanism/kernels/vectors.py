"""Compiled: three-vectors as tuples of floats, which stay in registers."""

import math

from numba import njit

from heliotrope.jit import INLINED


@njit(**INLINED)
def dot(a, b):
    """Return the dot product a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(**INLINED)
def cross(a, b):
    """Return the cross product a × b."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@njit(**INLINED)
def add(a, b):
    """Return the sum a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@njit(**INLINED)
def minus(a, b):
    """Return the difference a − b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(**INLINED)
def times(factor, a):
    """Return the product factor · a."""
    return factor * a[0], factor * a[1], factor * a[2]


@njit(**INLINED)
def norm(a):
    """Return the length |a|."""
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


@njit(**INLINED)
def across(a, axis):
    """Return the part of a perpendicular to the unit axis."""
    along = dot(a, axis)
    return a[0] - along * axis[0], a[1] - along * axis[1], a[2] - along * axis[2]


@njit(**INLINED)
def about(axis, sine, cosine, u):
    """Rotate u about the unit axis by an angle with known sine and cosine (Rodrigues)."""
    along = (1.0 - cosine) * dot(axis, u)
    return (
        cosine * u[0] + sine * (axis[1] * u[2] - axis[2] * u[1]) + along * axis[0],
        cosine * u[1] + sine * (axis[2] * u[0] - axis[0] * u[2]) + along * axis[1],
        cosine * u[2] + sine * (axis[0] * u[1] - axis[1] * u[0]) + along * axis[2],
    )


@njit(**INLINED)
def turn_between(axis, u, v):
    """Return the sine and cosine of the rotation about the axis that brings u nearest to v."""
    sine = dot(axis, cross(u, v))
    cosine = dot(u, v) - dot(axis, u) * dot(axis, v)
    size = math.sqrt(sine * sine + cosine * cosine)
    if size < 1e-15:
        return 0.0, 1.0
    return sine / size, cosine / size


@njit(**INLINED)
def angle(u, v):
    """Return the angle between unit vectors, which is exact near 0 and π."""
    apart = norm(minus(u, v))
    if apart < 1e-5:
        return apart * (1.0 + apart * apart / 24.0)
    return 2.0 * math.atan2(apart, norm(add(u, v)))
