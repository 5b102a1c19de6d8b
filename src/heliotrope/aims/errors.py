r"""Uncertainty of the flux: each mirror's own error, and errors that mirrors share.

To first order a cell's flux is $F_c + \sum_i g_{ic} · δ_i$, where $δ_i$ is the displacement of
mirror i's beam and $g_{ic}$ the derivative of its image. If the mirrors' own errors have covariance
$Σ_i$, and shared errors $z_m$ (normal, variance 1) displace beam i by $d_{im}$, then

$$σ_c^2 = \sum_i g_{ic}^\mathsf{T} Σ_i g_{ic} + \sum_m (\sum_i g_{ic} · d_{im})^2.$$

All errors blur the expected flux: own errors that of the engine, shared errors by `Risk.shift`.
"""

from dataclasses import dataclass

import numpy as np

from heliotrope.aims.candidates import widths
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, normalize, reflect
from heliotrope.optics.receiver_flux import FieldFlux
from heliotrope.optics.scene import Mirrors
from heliotrope.optics.shading import IntArray

#: Number of draws from which the quantile of the hottest cell is taken, and maximum number of cells
#: that they cover.
DRAWS, LOOKED = 2_000, 500
#: Number of waves that make up each random map of the mirrors' own errors.
WAVES = 64
#: Cells that lie further below the limit than this many standard deviations are ignored.
NEAR = 6.0
#: Speed of the sun across the sky, rad/s.
_SKY = 2.0 * np.pi / 86164.1


@dataclass(frozen=True)
class SharedErrors:
    """Errors that many mirrors have in common, as standard deviations.

    Attributes
    ----------
    drift
        Rotation of all mirrors' normals about east and about north, rad, such as refraction or wind
        causes.
    clock
        Error of the time for which the sun position is computed, s.
    cluster
        Rotation of the normals of one cluster about east and about north, rad, such as tilted
        ground causes.
    """

    drift: float = 0.0
    clock: float = 0.0
    cluster: float = 0.0

    def __post_init__(self) -> None:
        limits = {"drift": (0.05, "rad"), "clock": (600.0, "s"), "cluster": (0.05, "rad")}
        for name, (most, unit) in limits.items():
            value = getattr(self, name)
            if not 0.0 <= value <= most:
                raise InputError(
                    f"shared errors: {name} {value:g} {unit} must be from 0 to {most:g} {unit}"
                )

    @property
    def any(self) -> bool:
        """Whether any error is above 0."""
        return max(self.drift, self.clock, self.cluster) > 0.0

    def modes(self, mirrors: Mirrors, sun: FloatArray, pole: FloatArray) -> FloatArray:
        """Return the beam displacement by one standard deviation of each error, rad, (H, 5, 2).

        The displacements are to the right and up, as seen from the mirror. The first three modes
        affect the whole field, the last two affect each cluster.

        Parameters
        ----------
        mirrors
            Mirrors in their poses, (H,).
        sun
            Unit vector, (3,).
        pole
            Unit vector along the Earth's axis, northwards, (3,).
        """
        normal = mirrors.normal
        light = np.broadcast_to(sun, normal.shape)
        ray = reflect(light, normal)
        right = normalize(np.stack([ray[:, 1], -ray[:, 0], 0.0 * ray[:, 0]], axis=-1))
        up = np.cross(right, ray)

        def beam(turn: FloatArray) -> FloatArray:
            """Return the beam displacement that a small change of the normals causes, (H, 2)."""
            along = np.sum(turn * light, axis=-1, keepdims=True)
            change = 2.0 * (along * normal + (normal @ sun)[:, None] * turn)
            return np.stack([np.sum(change * right, -1), np.sum(change * up, -1)], axis=-1)

        tilts = [beam(np.cross(axis, normal)) for axis in np.eye(3)[:2]]
        # The mirrors point for the sun's later position, so the true light is displaced.
        moved = -np.cross(pole, light) * _SKY
        late = normalize(ray + light + moved) - normal
        columns = [self.drift * tilts[0], self.drift * tilts[1], self.clock * beam(late)]
        return np.stack([*columns, *(self.cluster * tilt for tilt in tilts)], axis=1)


#: Number of field-wide modes in `SharedErrors.modes`.
FIELD_MODES = 3


@dataclass(frozen=True, eq=False)
class Risk:
    """Uncertainty of the flux on a receiver.

    Attributes
    ----------
    shift
        Change of the expected flux, W/m², (rows, columns), since shared errors blur it.
    sigma
        Standard deviation of each cell's flux, W/m², (rows, columns).
    factor
        If the tightest cell is this many standard deviations below its limit, all cells keep
        their limits with the chosen probability.
    own
        Standard deviation due to the mirrors' own errors alone, W/m², (rows, columns).
    """

    shift: FloatArray
    sigma: FloatArray
    factor: float
    own: FloatArray

    @property
    def above(self) -> FloatArray:
        """Margin by which the flux may exceed its expectation, W/m², (rows, columns).

        It is at least 0: near a peak, shared errors can only lower the flux, but may be 0.
        """
        return as_float(np.maximum(self.shift + self.factor * self.sigma, 0.0))


def assess(
    engine: FieldFlux,
    modes: FloatArray,
    groups: IntArray,
    probability: float,
    limit: FloatArray,
) -> Risk:
    """Return the uncertainty of the flux in a scene.

    Parameters
    ----------
    engine
        The expected flux; the mirrors' ``pointing`` is the covariance of their own errors.
    modes
        Displacements from `SharedErrors.modes`, (H, 5, 2).
    groups
        Cluster of each mirror, 0 to G − 1, (H,).
    probability
        Probability that the limit holds in all cells at once, 0.5 to 0.9999.
    limit
        W/m², (rows, columns).
    """
    flux = engine.maps[0]
    if modes.any():
        flux = engine.scattered(as_float(np.einsum("hmi,hmj->hij", modes, modes)))
    scatter = _scatter(engine.scene.mirrors)
    own, shared, _ = engine.spread(scatter, modes, groups, np.zeros(flux.shape))
    parts = np.concatenate(
        [shared[:, :FIELD_MODES].sum(axis=0), shared[:, FIELD_MODES:].reshape(-1, *flux.shape)]
    )
    parts = parts[np.abs(parts).max(axis=(1, 2)) > 0.0]
    sigma = np.sqrt(own + np.sum(parts**2, axis=0))
    near = np.flatnonzero((sigma > 0.0) & (flux + NEAR * sigma > limit))
    if not len(near):
        near = np.flatnonzero(sigma >= 0.5 * sigma.max())
    near = near[:: -(-len(near) // LOOKED)]
    rng, cells = np.random.default_rng(0), np.stack(np.unravel_index(near, flux.shape), axis=-1)
    off = rng.standard_normal((DRAWS, len(parts))) @ parts.reshape(len(parts), flux.size)[:, near]
    off += np.sqrt(own).ravel()[near] * _alike(rng, as_float(cells), _reach(engine))
    scale = np.maximum(sigma, 1e-300).ravel()[near]
    # Cells that have more room than the tightest one may exceed their expectation by more.
    room = (limit - flux).ravel()[near] / scale
    factor = max(
        float(np.quantile((off / scale - room).max(axis=1), probability) + room.min()), 0.0
    )
    return Risk(as_float(flux - engine.maps[0]), sigma, factor, as_float(np.sqrt(own)))


def gains(engine: FieldFlux, risk: Risk, prices: FloatArray) -> FloatArray:
    r"""Return the power that a perfect calibration of each mirror would add, W, (H,).

    The gain is computed to first order, from the part of the margin under the limit that the
    mirror's own error takes up: $k \sum_c λ_c \, g_{ic}^\mathsf{T} Σ_i g_{ic} / 2 σ_c$.

    Parameters
    ----------
    engine, risk
        Flux, and its uncertainty.
    prices
        Prices of the cells, $λ_c$, W per W/m², (rows, columns).
    """
    count, sigma = len(engine.scene.mirrors), risk.sigma
    worth = np.where(sigma > 0.0, 0.5 * risk.factor * prices / np.maximum(sigma, 1e-300), 0.0)
    if not worth.any():
        return np.zeros(count)
    groups = np.arange(count) * 64 // count
    scatter = _scatter(engine.scene.mirrors)
    return engine.spread(scatter, np.zeros((count, 0, 2)), groups, worth)[2]


def _scatter(mirrors: Mirrors) -> FloatArray:
    r"""Return covariances of the mirrors' own errors with which the variance is right, (H, 2, 2).

    The flux is that of images which own errors of variance $s^2$ per axis blur from the width w to
    $\sqrt{w^2 + s^2}$. Summed over the receiver, the first-order variance of such an image is too
    small by the factor $w^2 / (w^2 + s^2)$ if the image is a Gaussian.
    """
    blur = 0.5 * np.trace(mirrors.pointing, axis1=1, axis2=2)
    blurred = (widths(mirrors) / mirrors.slant) ** 2
    return as_float(mirrors.pointing * (blurred / (blurred - blur))[:, None, None])


def _reach(engine: FieldFlux) -> float:
    r"""Return how far apart cells with correlated own errors are, in cells.

    A mirror with the beam power P, whose error displaces its image of width w by s, has a share
    proportional to $P^2 s^2 / w^6$ in the variance of a cell, and neighbouring cells have the mean
    square slope that belongs to the mean of $1 / w^2$ with these shares.
    """
    mirrors = engine.scene.mirrors
    wide = widths(mirrors)
    moved = mirrors.slant**2 * np.trace(mirrors.pointing, axis1=1, axis2=2)
    share = engine.power**2 * moved / wide**6
    if not share.any():
        share = np.ones_like(wide)
    area = float(np.mean(engine.scene.surfaces[0].cells.area))
    return float(np.sqrt(share.sum() / (share / wide**2).sum() / area))


def _alike(rng: np.random.Generator, cells: FloatArray, width: float) -> FloatArray:
    """Return DRAWS maps of normal random numbers, correlated within a width, (D, C).

    ``cells`` (C, 2) contains rows and columns. Each map is a sum of waves whose lengths have the
    spectrum of a Gaussian.
    """
    phase = cells @ (rng.standard_normal((2, WAVES)) / width)
    waves = np.concatenate([np.cos(phase), np.sin(phase)], axis=1) / np.sqrt(WAVES)
    return as_float(rng.standard_normal((DRAWS, 2 * WAVES)) @ waves.T)
