r"""How far the flux may be off: each mirror's own error, and errors that mirrors share.

To first order a cell's flux is $F_c + \sum_i g_{ic} · δ_i$, where $δ_i$ is the displacement of
mirror i's beam and $g_{ic}$ the derivative of its image. With own errors of covariance $Σ_i$ and
shared ones $z_m$, normal of variance 1, that displace beam i by $d_{im}$,

$$σ_c^2 = \sum_i g_{ic}^\mathsf{T} Σ_i g_{ic} + \sum_m (\sum_i g_{ic} · d_{im})^2.$$
"""

from dataclasses import dataclass

import numpy as np

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, normalize, reflect
from heliotrope.optics.receiver_flux import FieldFlux
from heliotrope.optics.scene import Mirrors
from heliotrope.optics.shading import IntArray

#: Draws from which the quantile of the hottest cell is taken, and cells that they look at at most.
DRAWS, LOOKED = 2_000, 500
#: Waves that such maps of own errors are made of.
WAVES = 64
#: Cells that lie more standard deviations below the limit are not looked at.
NEAR = 6.0
#: Speed of the sun across the sky, rad/s.
_SKY = 2.0 * np.pi / 86164.1


@dataclass(frozen=True)
class SharedErrors:
    """Errors that many mirrors have in common, as standard deviations.

    Attributes
    ----------
    drift
        Turn of all mirrors' normals about the east and about the north, rad, as by refraction or
        wind.
    clock
        Of the time for which the sun is computed, s.
    cluster
        Turn of the normals of one cluster, as by its tilted ground, about the east and about the
        north, rad.
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
        """Whether there is any."""
        return max(self.drift, self.clock, self.cluster) > 0.0

    def modes(self, mirrors: Mirrors, sun: FloatArray, pole: FloatArray) -> FloatArray:
        """Return how one standard deviation of each displaces the beams, rad, (H, 5, 2).

        Right and up as seen from the mirror; the first three are the field's, the others each
        cluster's.

        Parameters
        ----------
        mirrors
            In their poses, (H,).
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
            """Return the displacement by a small change of the normals, (H, 2)."""
            along = np.sum(turn * light, axis=-1, keepdims=True)
            change = 2.0 * (along * normal + (normal @ sun)[:, None] * turn)
            return np.stack([np.sum(change * right, -1), np.sum(change * up, -1)], axis=-1)

        tilts = [beam(np.cross(axis, normal)) for axis in np.eye(3)[:2]]
        # The mirrors take the sun for where it will be; its true light goes elsewhere.
        moved = -np.cross(pole, light) * _SKY
        late = normalize(ray + light + moved) - normal
        columns = [self.drift * tilts[0], self.drift * tilts[1], self.clock * beam(late)]
        return np.stack([*columns, *(self.cluster * tilt for tilt in tilts)], axis=1)


#: Modes of the field among those of `SharedErrors.modes`.
FIELD_MODES = 3


@dataclass(frozen=True, eq=False)
class Risk:
    """How far the flux on a receiver may be off.

    Attributes
    ----------
    sigma
        Standard deviation of each cell's flux, W/m², (rows, columns).
    factor
        With the chosen probability no cell is further above its expected flux than this many
        standard deviations.
    own
        Standard deviation by the mirrors' own errors alone, W/m², (rows, columns).
    """

    sigma: FloatArray
    factor: float
    own: FloatArray

    @property
    def above(self) -> FloatArray:
        """What the flux may be above the expected, W/m², (rows, columns)."""
        return as_float(self.factor * self.sigma)


def assess(
    engine: FieldFlux,
    modes: FloatArray,
    groups: IntArray,
    probability: float,
    limit: FloatArray,
    width: float,
) -> Risk:
    """Return how far the flux of a scene may be off.

    Parameters
    ----------
    engine
        The expected flux; the mirrors' ``pointing`` is the covariance of their own errors.
    modes
        Of `SharedErrors.modes`, (H, 5, 2).
    groups
        Cluster of each mirror, 0 to G − 1, (H,).
    probability
        That the limit holds in all cells at once, 0.5 to 0.9999.
    limit
        W/m², (rows, columns).
    width
        Standard deviation of a usual beam, in cells: neighbours within it are off together.
    """
    flux = engine.maps[0]
    pointing = engine.scene.mirrors.pointing
    own, shared, _ = engine.spread(pointing, modes, groups, np.zeros(flux.shape))
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
    off += np.sqrt(own).ravel()[near] * _alike(rng, as_float(cells), width)
    scale = np.maximum(sigma, 1e-300)
    factor = max(float(np.quantile((off / scale.ravel()[near]).max(axis=1), probability)), 0.0)
    return Risk(sigma, factor, as_float(np.sqrt(own)))


def gains(engine: FieldFlux, risk: Risk, prices: FloatArray) -> FloatArray:
    r"""Return the power that a perfect calibration of each mirror would add, W, (H,).

    To first order, for the room that its own error takes under the limit:
    $k \sum_c λ_c \, g_{ic}^\mathsf{T} Σ_i g_{ic} / 2 σ_c$.

    Parameters
    ----------
    engine, risk
        Flux, and how far it may be off.
    prices
        Of the cells, $λ_c$, W per W/m², (rows, columns).
    """
    count, sigma = len(engine.scene.mirrors), risk.sigma
    worth = np.where(sigma > 0.0, 0.5 * risk.factor * prices / np.maximum(sigma, 1e-300), 0.0)
    if not worth.any():
        return np.zeros(count)
    groups = np.arange(count) * 64 // count
    return engine.spread(engine.scene.mirrors.pointing, np.zeros((count, 0, 2)), groups, worth)[2]


def _alike(rng: np.random.Generator, cells: FloatArray, width: float) -> FloatArray:
    """Return DRAWS maps of normal numbers that are alike within a width, (D, C).

    Cells (C, 2): row and column. A sum of waves whose lengths have the spectrum of a Gaussian.
    """
    phase = cells @ (rng.standard_normal((2, WAVES)) / width)
    waves = np.concatenate([np.cos(phase), np.sin(phase)], axis=1) / np.sqrt(WAVES)
    return as_float(rng.standard_normal((DRAWS, 2 * WAVES)) @ waves.T)
