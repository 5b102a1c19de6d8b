r"""Computes the intercept: the fraction of a heliostat's beam that enters the receiver aperture.

There are two models:

- `intercept_circle` and `intercept_rectangle` are our own model: the beam is Gaussian, with the
  standard deviation σ of `beam_sigma` on the aperture plane. A centred circle of radius R
  intercepts $1 - \exp(-R^2 / 2 σ^2)$. Every σ is a standard deviation *per axis*; the
  two-dimensional RMS is √2 times as large.
- `intercept_disks` is Malan's model, (3.2)-(3.3): the beam is a disk of uniform irradiance, and the
  aperture is the same disk about the aim.

Use the Gaussian model: a ray trace (`examples/malan_intercept.py`) agrees with it to 0.7 percentage
points. For the aperture in (3.2) as printed, an error of 1 mrad costs 0.4 points according to the
ray trace and 10.3 according to the disk model, because a displaced uniform beam immediately loses
power at its rim, where a real beam is weak.
"""

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, common_shape
from heliotrope.optics.beam import SUN_RADIUS, checked

# Number of nodes of the integral over a circle, and how many σ of the beam it covers; it omits
# 2e-17 of the beam.
_NODES = 128
_REACH = 8.5


def intercept_circle(
    radius: npt.ArrayLike,
    sigma: npt.ArrayLike,
    *,
    sigma_up: npt.ArrayLike | None = None,
    right: npt.ArrayLike = 0.0,
    up: npt.ArrayLike = 0.0,
) -> FloatArray:
    """Return the fraction of a Gaussian beam that falls into a circle, 0 to 1, (...).

    Parameters
    ----------
    radius
        Radius of the aperture, m, (...).
    sigma
        Standard deviation per axis of the beam on the aperture plane, m, (...), as returned by
        `beam_sigma`; if ``sigma_up`` is specified, for the horizontal axis only.
    sigma_up
        Standard deviation for the vertical axis if the beam is elliptical, m, (...).
    right, up
        Beam centre relative to the aperture centre, m, (...), such as ``image_offsets(...).right``.
        NaN yields NaN.

    Raises
    ------
    InputError
        If a radius or a σ is not above 0, an offset is infinite, or shapes do not broadcast.

    Notes
    -----
    A centred circular beam follows 1 − exp(−R²/2σ²); an offset beam follows the Rice distribution,
    which is the non-central χ² with two degrees of freedom. All cases are computed by one
    Gauss-Legendre integral. It is accurate to 1e-10 up to R = 200 σ for elliptical beams; for
    circular beams it agrees to 1e-11 with SciPy's ``chndtr``, which is limited to R = 10⁵ σ.
    """
    r = checked("radius", radius, "m", positive=True)
    s = checked("sigma", sigma, "m", positive=True)
    x, y = _offset("right", right), _offset("up", up)
    if sigma_up is None:
        common_shape(radius=r, sigma=s, right=x, up=y)
        # A circular beam may be turned until its offset lies across the chords, where the
        # integral converges fastest.
        return _chords(r, s, s, np.zeros(()), as_float(np.hypot(x, y)))
    s_up = checked("sigma_up", sigma_up, "m", positive=True)
    common_shape(radius=r, sigma=s, sigma_up=s_up, right=x, up=y)
    return _chords(r, s, s_up, x, y)


def intercept_disks(
    tracking: npt.ArrayLike,
    *,
    slope: npt.ArrayLike = 0.0,
    sun_angle: npt.ArrayLike = 2.0 * SUN_RADIUS,
) -> FloatArray:
    r"""Return Malan's intercept ratio, normalised for slant, 0 to 1, (...).

    Two equal disks of radius R = 2 d q, with q = θ_s / 2 + σ_slope, at a distance D = 2 d θ_t
    overlap by

    $$\frac{2}{\pi}\left(\arccos x - x \sqrt{1 - x^2}\right), \qquad
    x = \frac{D}{2 R} = \frac{θ_t}{2 q}.$$

    Parameters
    ----------
    tracking
        θ_t, tracking error of the normal as an offset, rad, (...).
    slope
        Mean slope error of the mirror surface, rad, (...).
    sun_angle
        θ_s, the angle that the solar disk subtends, rad, (...).

    Raises
    ------
    InputError
        If a value is negative or not finite, the disks have no size, or shapes do not broadcast.

    Notes
    -----
    Malan's (3.2)-(3.3) as printed yield 92.2 % at 0.75 mrad and 89.7 % at 1 mrad with his 9.3 mrad
    and 1.5 mrad. For a perfect mirror his R is d θ_s, which his text calls the diameter of the
    smallest image; the radius of that image is half as large.
    """
    t = checked("tracking", tracking, "rad")
    q = checked("sun_angle", sun_angle, "rad") / 2.0 + checked("slope", slope, "rad")
    common_shape(tracking=t, q=q)
    checked("sun_angle / 2 + slope", q, "rad", positive=True)
    x = np.minimum(t / (2.0 * q), 1.0)
    return as_float(2.0 / np.pi * (np.arccos(x) - x * np.sqrt(1.0 - x * x)))


def intercept_rectangle(
    width: npt.ArrayLike,
    height: npt.ArrayLike,
    sigma: npt.ArrayLike,
    *,
    sigma_up: npt.ArrayLike | None = None,
    right: npt.ArrayLike = 0.0,
    up: npt.ArrayLike = 0.0,
) -> FloatArray:
    """Return the fraction of a Gaussian beam that falls into a rectangle, 0 to 1, (...).

    Parameters
    ----------
    width, height
        Size of the aperture, m, (...).
    sigma, sigma_up, right, up
        As for `intercept_circle`.

    Raises
    ------
    InputError
        If a side or a σ is not above 0, an offset is infinite, or shapes do not broadcast.

    Notes
    -----
    The result is exact: the product of two one-dimensional fractions, each a difference of error
    functions.
    """
    w = checked("width", width, "m", positive=True)
    h = checked("height", height, "m", positive=True)
    s = checked("sigma", sigma, "m", positive=True)
    s_up = s if sigma_up is None else checked("sigma_up", sigma_up, "m", positive=True)
    x, y = _offset("right", right), _offset("up", up)
    common_shape(width=w, height=h, sigma=s, sigma_up=s_up, right=x, up=y)
    return as_float(_within(0.5 * w, s, x) * _within(0.5 * h, s_up, y))


def _within(half: FloatArray, sigma: FloatArray, center: FloatArray) -> FloatArray:
    """Return the fraction of a normal distribution between −half and half."""
    from scipy import special

    # Mirrored to the lower tail, where the two values are small and their difference exact.
    c = np.abs(center)
    return as_float(special.ndtr((half - c) / sigma) - special.ndtr((-half - c) / sigma))


def _chords(
    radius: FloatArray, sigma: FloatArray, sigma_up: FloatArray, x: FloatArray, y: FloatArray
) -> FloatArray:
    """Return the integral over chords of the circle, of the density across times the share along.

    The chords lie along the beam's longer axis, so that the share along a chord varies slowly over
    the few σ of u that matter, where u is the position across the chords. The substitution u = R
    sin φ removes the square root at the rim.
    """
    tall = sigma_up > sigma
    narrow, wide = np.where(tall, sigma, sigma_up), np.where(tall, sigma_up, sigma)
    across, along = np.abs(np.where(tall, x, y)), np.abs(np.where(tall, y, x))
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    first = np.arcsin(np.clip((across - _REACH * narrow) / radius, -1.0, 1.0))
    last = np.arcsin(np.clip((across + _REACH * narrow) / radius, -1.0, 1.0))
    phi = (0.5 * (first + last))[..., None] + (0.5 * (last - first))[..., None] * nodes
    R, s = radius[..., None], narrow[..., None]
    chord = R * np.cos(phi)
    u = (R * np.sin(phi) - across[..., None]) / s
    density = np.exp(-0.5 * u * u) / (np.sqrt(2.0 * np.pi) * s)
    share = density * chord * _within(chord, wide[..., None], along[..., None])
    return as_float(np.clip(0.5 * (last - first) * (share @ weights), 0.0, 1.0))


def _offset(name: str, value: npt.ArrayLike) -> FloatArray:
    offset = as_float(value)
    if np.isinf(offset).any():
        raise InputError(f"{name}: an offset is infinite; pass metres, or NaN for no beam")
    return offset
