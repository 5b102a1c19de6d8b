"""The sun vector at one site, second by second, as cluster controllers broadcast it.

SPA is evaluated every 10 s and interpolated with a cubic polynomial. With four knots 10 s apart the
interpolation error is (ωh)⁴·3/128, less than 1e-13 (ω = 7.3e-5 rad/s); refraction near the horizon
changes faster and adds less than a nanoradian. All clusters of one site within a process share the
knots.
"""

import functools
import math

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.sun.ephemeris import Site, vector

STEP = 10.0
_BLOCK = 60
#: Units of the SUN message: components in 2^-30, rates in 2^-28 per second.
_UNIT, _RATE = float(1 << 30), float(1 << 28)
_LARGEST_RATE = 32767

#: No sun vector is broadcast if its upward component is below this. SPA's apparent sun jumps by 10
#: mrad at -0.0045, and a local controller rejects any vector below -0.02.
LOWEST_BROADCAST = -0.003

Vector = tuple[float, float, float]


@functools.lru_cache(maxsize=64)
def _knots(site: Site, block: int) -> tuple[Vector, ...]:
    """Return directions to the apparent sun from one step before a block to two after it."""
    steps = np.arange(-1.0, _BLOCK + 2.0) + block * _BLOCK
    return tuple((float(e), float(n), float(u)) for e, n, u in vector(steps * STEP, site))


def vector_and_rate(utc_s: float, site: Site) -> tuple[Vector, Vector]:
    """Return the direction to the apparent sun (ENU, unit vector) and its rate in 1/s.

    Parameters
    ----------
    utc_s
        POSIX seconds.
    site
        Location and atmosphere.
    """
    place = utc_s / STEP
    step = math.floor(place)
    u = place - step
    block = step // _BLOCK
    first = step - block * _BLOCK
    knots = _knots(site, block)[first : first + 4]
    # Lagrange interpolation weights for the knots -1, 0, 1, 2, and their derivatives.
    v, w, x = u + 1.0, u - 1.0, u - 2.0
    weights = (-u * w * x / 6.0, v * w * x / 2.0, -v * u * x / 2.0, v * u * w / 6.0)
    slopes = (
        -(w * x + u * x + u * w) / 6.0,
        (w * x + v * x + v * w) / 2.0,
        -(u * x + v * x + v * u) / 2.0,
        (u * w + v * w + v * u) / 6.0,
    )
    return _combined(weights, knots, 1.0), _combined(slopes, knots, STEP)


def _combined(weights: tuple[float, ...], knots: tuple[Vector, ...], divisor: float) -> Vector:
    (p, q, r, s), (a, b, c, d) = weights, knots
    return (
        (p * a[0] + q * b[0] + r * c[0] + s * d[0]) / divisor,
        (p * a[1] + q * b[1] + r * c[1] + s * d[1]) / divisor,
        (p * a[2] + q * b[2] + r * c[2] + s * d[2]) / divisor,
    )


def fast_vector(utc_s: float, site: Site) -> FloatArray:
    """Return the unit vector to the apparent sun, ENU, (3,), from `vector_and_rate`."""
    direction, _ = vector_and_rate(utc_s, site)
    # A cubic polynomial cannot follow the jump below the horizon.
    return vector(utc_s, site) if direction[2] < 0.0 else np.array(direction)


def broadcast_values(second: int, utc_s: float, site: Site) -> tuple[int, ...] | None:
    """Return the fields of a SUN message; None while the sun is below `LOWEST_BROADCAST`.

    Parameters
    ----------
    second
        GPS second, modulo 2^32.
    utc_s
        The same instant in POSIX seconds.
    site
        Location and atmosphere.
    """
    direction, rate = vector_and_rate(utc_s, site)
    if direction[2] < LOWEST_BROADCAST:
        return None
    numbers = [round(value * _UNIT) for value in direction]
    rates = [max(-_LARGEST_RATE, min(_LARGEST_RATE, round(value * _RATE))) for value in rate]
    return (second & 0xFFFFFFFF, *numbers, *rates)
