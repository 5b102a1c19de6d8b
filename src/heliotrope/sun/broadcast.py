"""The sun of a site second by second: SPA every 10 s, a cubic between.

The cubic through four knots 10 s apart is off by (ωh)⁴·3/128, less than 1e-13 (ω = 7.3e-5 rad/s);
refraction near the horizon, which changes faster, adds less than a nanoradian. Clusters of one site
in one process share the knots.
"""

import functools
import math

import numpy as np

from heliotrope import sun
from heliotrope.geometry import FloatArray
from heliotrope.sun import Site

STEP = 10.0
_BLOCK = 60
#: Components of SUN come in 2^-30, rates in 2^-28 a second.
_UNIT, _RATE = float(1 << 30), float(1 << 28)
_LARGEST_RATE = 32767

#: Below this height of the sun (its upward component) no vector is sent. The apparent sun of SPA
#: jumps by 10 mrad at -0.0045, and a local controller takes none below -0.02.
HORIZON = -0.003

Vector = tuple[float, float, float]


@functools.lru_cache(maxsize=64)
def _knots(site: Site, block: int) -> tuple[Vector, ...]:
    """Directions to the apparent sun from one step before a block to two after it."""
    steps = np.arange(-1.0, _BLOCK + 2.0) + block * _BLOCK
    return tuple((float(e), float(n), float(u)) for e, n, u in sun.vector(steps * STEP, site))


def sun_at(utc_s: float, site: Site) -> tuple[Vector, Vector]:
    """Return the direction to the apparent sun (ENU, unit) and its rate in 1/s.

    Parameters
    ----------
    utc_s
        POSIX seconds.
    site
        Place and air.
    """
    place = utc_s / STEP
    step = math.floor(place)
    u = place - step
    block = step // _BLOCK
    first = step - block * _BLOCK
    a, b, c, d = _knots(site, block)[first : first + 4]
    # Lagrange's weights at -1, 0, 1, 2, and their derivatives.
    v, w, x = u + 1.0, u - 1.0, u - 2.0
    p, q, r, s = -u * w * x / 6.0, v * w * x / 2.0, -v * u * x / 2.0, v * u * w / 6.0
    dp = -(w * x + u * x + u * w) / 6.0
    dq = (w * x + v * x + v * w) / 2.0
    dr = -(u * x + v * x + v * u) / 2.0
    ds = (u * w + v * w + v * u) / 6.0
    return (
        (
            p * a[0] + q * b[0] + r * c[0] + s * d[0],
            p * a[1] + q * b[1] + r * c[1] + s * d[1],
            p * a[2] + q * b[2] + r * c[2] + s * d[2],
        ),
        (
            (dp * a[0] + dq * b[0] + dr * c[0] + ds * d[0]) / STEP,
            (dp * a[1] + dq * b[1] + dr * c[1] + ds * d[1]) / STEP,
            (dp * a[2] + dq * b[2] + dr * c[2] + ds * d[2]) / STEP,
        ),
    )


def sun_now(utc_s: float, site: Site) -> FloatArray:
    """Return the unit vector to the apparent sun, ENU, (3,); see `sun_at`."""
    here, _ = sun_at(utc_s, site)
    # Across the jump below the horizon no cubic is good.
    return sun.vector(utc_s, site) if here[2] < 0.0 else np.array(here)


def sun_values(second: int, utc_s: float, site: Site) -> tuple[int, ...] | None:
    """Return the numbers of SUN for a GPS second, None while the sun is below `HORIZON`.

    Parameters
    ----------
    second
        Modulo 2^32.
    utc_s
        The same instant in POSIX seconds.
    site
        Place and air.
    """
    here, rate = sun_at(utc_s, site)
    if here[2] < HORIZON:
        return None
    numbers = [round(value * _UNIT) for value in here]
    rates = [max(-_LARGEST_RATE, min(_LARGEST_RATE, round(value * _RATE))) for value in rate]
    return (second & 0xFFFFFFFF, *numbers, *rates)
