r"""Intercept ratio: the share of a heliostat's beam that falls into the receiver's aperture.

The beam is taken as Gaussian. Its angular variance is that of the sun's disk plus that of
the mirror's slope and of the tracking, both of which a mirror doubles:

.. math:: σ_{beam}^2 = σ_{sun}^2 + (2 σ_{slope})^2 + (2 σ_{tracking})^2

On a plane at distance d it is :math:`d \, σ_{beam}` wide, and a centred circle of radius R
takes up

.. math:: 1 - \exp\left(-\frac{R^2}{2 d^2 σ_{beam}^2}\right).

Source: Malan (3.2)-(3.3), reconstructed: his text was not at hand, and these are the two
relations that the matter itself demands. All σ are standard deviations *per axis*; the
two-dimensional RMS is √2 times as large.
"""

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float

#: Per-axis standard deviation (rad) of a uniform solar disk of 4.65 mrad radius: half of it.
SUN_SHAPE = 0.5 * 4.65e-3

# Nodes of the integral over a circle, and how many σ of the beam it covers: what it leaves
# out is 2e-17.
_NODES = 128
_REACH = 8.5


def beam_sigma(
    slant: npt.ArrayLike,
    *,
    tracking: npt.ArrayLike = 0.0,
    slope: npt.ArrayLike = 0.0,
    sun_shape: npt.ArrayLike = SUN_SHAPE,
) -> FloatArray:
    """Return the standard deviation per axis of a beam on a plane across it, m, (...).

    Parameters
    ----------
    slant
        Distance from mirror to aperture, m, (...).
    tracking, slope
        Standard deviations per axis of the *normal*, of the whole mirror and over its
        surface, rad, (...). Each counts twice in the beam.
    sun_shape
        Standard deviation per axis of the sun's disk, rad, (...).

    Raises
    ------
    InputError
        If a value is negative or not finite, the slant is 0, or shapes do not broadcast.

    Notes
    -----
    The mirror is taken as focused on the aperture, so its size adds nothing, and its
    astigmatism away from normal incidence is left out. Malan (3.2), reconstructed.
    """
    d = _checked("slant", slant, "m", positive=True)
    t = _checked("tracking", tracking, "rad")
    s = _checked("slope", slope, "rad")
    sun = _checked("sun_shape", sun_shape, "rad")
    _together(slant=d, tracking=t, slope=s, sun_shape=sun)
    return as_float(d * np.sqrt(sun**2 + (2.0 * s) ** 2 + (2.0 * t) ** 2))


def intercept_circle(
    radius: npt.ArrayLike,
    sigma: npt.ArrayLike,
    *,
    sigma_up: npt.ArrayLike | None = None,
    right: npt.ArrayLike = 0.0,
    up: npt.ArrayLike = 0.0,
) -> FloatArray:
    """Return the share of a Gaussian beam that falls into a circle, 0 to 1, (...).

    Parameters
    ----------
    radius
        Of the aperture, m, (...).
    sigma
        Standard deviation per axis of the beam on the aperture's plane, m, (...), as
        :func:`beam_sigma` gives it; with ``sigma_up`` that of the horizontal axis.
    sigma_up
        That of the other axis if the beam is elliptical, m, (...).
    right, up
        Centre of the beam from the centre of the aperture, m, (...), such as
        ``image_offsets(...).right``. NaN gives NaN.

    Raises
    ------
    InputError
        If a radius or a σ is not above 0, an offset is infinite, or shapes do not broadcast.

    Notes
    -----
    A centred circular beam gives 1 − exp(−R²/2σ²), Malan (3.3), reconstructed; an offset one
    the distribution of Rice, which is the non-central χ² with two degrees of freedom. All
    are computed by one Gauss-Legendre integral: within 1e-10 up to R = 200 σ for elliptical
    beams, and for circular ones within 1e-11 of SciPy's ``chndtr``, which ends at R = 10⁵ σ.
    """
    r = _checked("radius", radius, "m", positive=True)
    s = _checked("sigma", sigma, "m", positive=True)
    x, y = _offset("right", right), _offset("up", up)
    if sigma_up is None:
        _together(radius=r, sigma=s, right=x, up=y)
        # A circular beam may be turned until its offset lies across the chords, where the
        # integral converges fastest.
        return _chords(r, s, s, np.zeros(()), as_float(np.hypot(x, y)))
    s_up = _checked("sigma_up", sigma_up, "m", positive=True)
    _together(radius=r, sigma=s, sigma_up=s_up, right=x, up=y)
    return _chords(r, s, s_up, x, y)


def intercept_rectangle(
    width: npt.ArrayLike,
    height: npt.ArrayLike,
    sigma: npt.ArrayLike,
    *,
    sigma_up: npt.ArrayLike | None = None,
    right: npt.ArrayLike = 0.0,
    up: npt.ArrayLike = 0.0,
) -> FloatArray:
    """Return the share of a Gaussian beam that falls into a rectangle, 0 to 1, (...).

    Parameters
    ----------
    width, height
        Of the aperture, m, (...).
    sigma, sigma_up, right, up
        As for :func:`intercept_circle`.

    Raises
    ------
    InputError
        If a side or a σ is not above 0, an offset is infinite, or shapes do not broadcast.

    Notes
    -----
    The product of two one-dimensional shares, each a difference of error functions; exact.
    """
    w = _checked("width", width, "m", positive=True)
    h = _checked("height", height, "m", positive=True)
    s = _checked("sigma", sigma, "m", positive=True)
    s_up = s if sigma_up is None else _checked("sigma_up", sigma_up, "m", positive=True)
    x, y = _offset("right", right), _offset("up", up)
    _together(width=w, height=h, sigma=s, sigma_up=s_up, right=x, up=y)
    return as_float(_within(0.5 * w, s, x) * _within(0.5 * h, s_up, y))


def _within(half: FloatArray, sigma: FloatArray, center: FloatArray) -> FloatArray:
    """Return the share of a normal distribution between −half and half."""
    from scipy import special

    # Mirrored to the lower tail, where the two values are small and their difference exact.
    c = np.abs(center)
    return as_float(special.ndtr((half - c) / sigma) - special.ndtr((-half - c) / sigma))


def _chords(
    radius: FloatArray, sigma: FloatArray, sigma_up: FloatArray, x: FloatArray, y: FloatArray
) -> FloatArray:
    """Return the integral over chords of the circle, u across them and the share along them.

    The chords lie along the beam's longer axis, so that the share along a chord varies
    slowly over the few σ of u that matter; u = R sin φ takes away the root at the rim.
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


def _checked(name: str, value: npt.ArrayLike, unit: str, *, positive: bool = False) -> FloatArray:
    given = as_float(value)
    wrong = ~(np.isfinite(given) & ((given > 0.0) if positive else (given >= 0.0)))
    if wrong.any():
        limit = "above 0" if positive else "0 or more"
        raise InputError(f"{name}: {given[wrong].flat[0]:g} {unit} must be {limit} and finite")
    return given


def _offset(name: str, value: npt.ArrayLike) -> FloatArray:
    given = as_float(value)
    if np.isinf(given).any():
        raise InputError(f"{name}: an offset is infinite; give metres, or NaN for no beam")
    return given


def _together(**arrays: FloatArray) -> None:
    try:
        np.broadcast_shapes(*(a.shape for a in arrays.values()))
    except ValueError:
        shapes = ", ".join(f"{name} {a.shape}" for name, a in arrays.items() if a.ndim)
        raise InputError(f"shapes do not broadcast together: {shapes}") from None
