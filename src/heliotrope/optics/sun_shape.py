r"""The brightness of the sun across its disk and around it, and its image as a few Gaussians.

`sun_profile` returns the radiance φ(θ) at an angle θ from the sun's centre, relative to the centre.
With x = θ / 4.65 mrad and μ = √(1 − x²), on the disk (x ≤ 1):

- `pillbox`: 1.
- `limb`: 0.3 + 0.93 μ − 0.23 μ², at 550 nm (Cox, Allen's Astrophysical Quantities, 2000).
- `quartic`: 1 − 0.5138 x⁴, SolarPILOT's "limb-darkened sun".
- `gaussian`: exp(−θ² / 2σ²), not limited to the disk.
- `buie`: cos 0.326θ / cos 0.308θ on the disk and e^κ θ^γ around it to 43.6 mrad, θ in mrad, with κ
  = 0.9 ln(13.5 χ) χ^−0.3 and γ = 2.2 ln(0.52 χ) χ^0.43 − 0.1 (Buie, Monger and Dey, Solar Energy 74
  (2003) 113-122). Buie's χ is only approximately the fraction of the light that comes from around
  the disk. `SunShape` is specified by this fraction, the circumsolar ratio, and solves for χ.

A mirror blurs the sun, so a short sum of Gaussians with the sun's exact variance is as good as the
profile itself (`SunShape.gaussians`). A disk has weaker tails than a Gaussian, so one of the
weights is negative.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float
from heliotrope.optics.beam import SUN_RADIUS, SUN_SIGMA

#: Outer radius of Buie's aureole, rad.
AUREOLE_RADIUS = 43.6e-3
#: Names of profiles that `sun_profile` knows, and of those that `SunShape` knows.
PROFILES = ("pillbox", "limb", "quartic", "buie")
SUN_SHAPES = (*PROFILES, "gaussian")
#: Circumsolar ratios for which Buie's profile can be solved.
CIRCUMSOLAR = (0.01, 0.7)
#: Usual blur of a beam by the mirror's slope errors, for which `SunShape.gaussians` fits, and the
#: smallest and largest blur, rad.
BLUR = 1.5e-3
_BLURS = (0.3e-3, 3e-3)
#: A Gaussian sun is truncated at this many σ, beyond which 1e-8 of its light lies.
_REACH = 6.0
#: Nodes of an integral over the disk and over the aureole, and of the table for sampling.
_NODES, _TABLE = 200, 8192


class Gaussians(NamedTuple):
    """A sum of circular Gaussians.

    Attributes
    ----------
    weight
        Weights with sum 1; some may be negative, (G,).
    variance
        Variances per axis, rad², (G,).
    """

    weight: FloatArray
    variance: FloatArray


@dataclass(frozen=True)
class SunShape:
    """A sun profile with its parameters.

    Attributes
    ----------
    name
        One of `SUN_SHAPES`.
    csr
        Circumsolar ratio for "buie": fraction of the light from beyond 4.65 mrad.
    sigma
        Standard deviation per axis for "gaussian", rad.
    """

    name: str = "limb"
    csr: float = 0.05
    sigma: float = SUN_SIGMA

    def __post_init__(self) -> None:
        if self.name not in SUN_SHAPES:
            raise InputError(f"unknown sun shape {self.name!r}; known: {', '.join(SUN_SHAPES)}")
        low, high = CIRCUMSOLAR
        if not low <= self.csr <= high:
            raise InputError(
                f"sun shape: circumsolar ratio must be between {low} and {high}, not {self.csr}"
            )
        if not 0.0 < self.sigma < 0.05:
            raise InputError(f"sun shape: σ must be above 0 and below 0.05, not {self.sigma} rad")

    @classmethod
    def of(cls, shape: "str | SunShape") -> Self:
        """Return a shape from its name, which may contain a number: "buie:0.1", "gaussian:0.0027".

        Raises
        ------
        InputError
            If there is no shape of that name, or the number is missing, wrong or not applicable.
        """
        if isinstance(shape, cls):
            return shape
        name, sign, number = str(shape).partition(":")
        field = {"buie": "csr", "gaussian": "sigma"}.get(name)
        if not sign or name not in SUN_SHAPES:
            return cls(name)
        if field is None:
            raise InputError(f"sun shape {shape!r}: {name} takes no number; write just {name}")
        try:
            value = float(number)
        except ValueError:
            raise InputError(
                f"sun shape {shape!r}: write a number after the colon, such as buie:0.05"
            ) from None
        return cls(name, **{field: value})

    @property
    def radius(self) -> float:
        """Angle beyond which the profile is dark, rad."""
        wide = {"gaussian": _REACH * self.sigma, "buie": AUREOLE_RADIUS}
        return wide.get(self.name, SUN_RADIUS)

    @cached_property
    def chi(self) -> float:
        """Buie's χ, for which the circumsolar ratio is ``csr``."""
        return _chi(self.csr)

    def radiance(self, theta: npt.ArrayLike) -> FloatArray:
        """Return the radiance at angles from the centre (rad), relative to the centre."""
        if self.name == "gaussian":
            angle = as_float(theta)
            value = np.exp(-0.5 * (angle / self.sigma) ** 2)
            return as_float(np.where(angle <= self.radius, value, 0.0))
        return sun_profile(theta, self.name, self.chi if self.name == "buie" else 0.05)

    @cached_property
    def _nodes(self) -> tuple[FloatArray, FloatArray]:
        """Angles, and the fraction of the light at each angle, (M,), for integrals."""
        theta, weight = _quadrature(self.radius)
        share = weight * theta * self.radiance(theta)
        return theta, as_float(share / share.sum())

    @cached_property
    def variance(self) -> float:
        """Variance per axis, rad²."""
        theta, share = self._nodes
        return float(0.5 * share @ theta**2)

    @cached_property
    def _table(self) -> tuple[FloatArray, FloatArray]:
        """Fractions of the light within some angles, and these angles."""
        edges = np.linspace(0.0, self.radius, _TABLE)
        edges = np.unique(np.append(edges, np.linspace(0.0, SUN_RADIUS, _TABLE)))
        middle = 0.5 * (edges[1:] + edges[:-1])
        ring = self.radiance(middle) * np.diff(edges**2)
        below = np.concatenate([[0.0], np.cumsum(ring)])
        lit = np.concatenate([[True], np.diff(below) > 0.0])
        return as_float(below[lit] / below[-1]), as_float(edges[lit])

    def within(self, theta: npt.ArrayLike) -> FloatArray:
        """Return the fraction of the light within given angles of the centre, rad."""
        below, edges = self._table
        return as_float(np.interp(as_float(theta), edges, below))

    def sample(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Return the directions of random rays: two small angles from the centre, rad, (N, 2)."""
        below, edges = self._table
        theta = np.interp(rng.random(count), below, edges)
        turn = 2.0 * np.pi * rng.random(count)
        return np.stack([theta * np.cos(turn), theta * np.sin(turn)], axis=-1)

    def gaussians(self, count: int = 2, blur: float = BLUR) -> Gaussians:
        """Return the closest sum of 1 to 4 Gaussians that has the exact variance of the profile.

        Parameters
        ----------
        count
            Number of Gaussians; a Gaussian sun needs only one.
        blur
            Standard deviation per axis of an additional Gaussian that blurs the images before they
            are compared, rad, for example from slope errors of half the size of ``blur``. It is
            rounded to 0.1 mrad and limited to 0.3 to 3 mrad. For wider blurs the sum fits even
            better.

        Raises
        ------
        InputError
            If the count is out of range.

        Notes
        -----
        Closest means the smallest integral of the squared difference. `gaussian_error` measures the
        remaining difference.
        """
        if not 1 <= count <= 4:
            raise InputError(
                f"sun shape: the number of Gaussians must be between 1 and 4, not {count}"
            )
        if self.name == "gaussian" or count == 1:
            return Gaussians(np.ones(1), np.array([self.variance]))
        return _fitted(self, count, round(float(np.clip(blur, *_BLURS)), 4))

    def spectrum(self, frequency: npt.ArrayLike) -> FloatArray:
        """Return the Fourier transform of the image at angular frequencies, 1/rad; it is 1 at 0."""
        from scipy.special import j0

        theta, share = self._nodes
        return as_float(j0(as_float(frequency)[..., None] * theta) @ share)

    def gaussian_error(self, count: int = 2, blur: float = BLUR) -> float:
        """Return the largest error of `gaussians`, as a fraction of the image peak.

        Parameters
        ----------
        count
            Number of Gaussians.
        blur
            As for `gaussians`, from 0.3 to 3 mrad.
        """
        from scipy.special import j0

        k, step = _frequencies(blur)
        parts = self.gaussians(count, blur)
        seen = np.exp(-0.5 * (k * blur) ** 2) * k * step
        r = np.linspace(0.0, 3.0 * np.hypot(SUN_RADIUS, blur), 400)
        back = j0(r[:, None] * k)
        true = back @ (self.spectrum(k) * seen)
        return float(np.abs(back @ (_sum(parts, k) * seen) - true).max() / true[0])


def sun_profile(theta: npt.ArrayLike, shape: str, circumsolar: float = 0.05) -> FloatArray:
    """Return the sun's radiance at angles from its centre (rad), relative to the centre.

    Parameters
    ----------
    theta
        Angles from the centre, (...).
    shape
        "pillbox", "limb", "quartic" or "buie"; see the module docstring for their formulae.
    circumsolar
        Buie's χ.

    Raises
    ------
    InputError
        If there is no such shape.
    """
    angle = as_float(theta)
    disk = angle <= SUN_RADIUS
    if shape == "pillbox":
        return as_float(np.where(disk, 1.0, 0.0))
    if shape == "limb":
        mu = np.sqrt(np.clip(1.0 - (angle / SUN_RADIUS) ** 2, 0.0, 1.0))
        return as_float(np.where(disk, 0.3 + 0.93 * mu - 0.23 * mu**2, 0.0))
    if shape == "quartic":
        return as_float(np.where(disk, 1.0 - 0.5138 * (angle / SUN_RADIUS) ** 4, 0.0))
    if shape != "buie":
        raise InputError(f"unknown sun shape {shape!r}; known: {', '.join(PROFILES)}")
    mrad, chi = angle * 1e3, circumsolar
    kappa = 0.9 * np.log(13.5 * chi) * chi**-0.3
    gamma = 2.2 * np.log(0.52 * chi) * chi**0.43 - 0.1
    ring = np.exp(kappa) * np.maximum(mrad, 1e3 * SUN_RADIUS) ** gamma
    inside = np.minimum(mrad, 1e3 * SUN_RADIUS)
    body = np.cos(0.326 * inside) / np.cos(0.308 * inside)
    return as_float(np.where(disk, body, np.where(angle <= AUREOLE_RADIUS, ring, 0.0)))


@lru_cache(maxsize=8)
def _quadrature(radius: float) -> tuple[FloatArray, FloatArray]:
    """Return integration nodes and weights from 0 to a radius, with a break at the disk's rim."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    ends = [0.0, min(radius, SUN_RADIUS), radius]
    parts = [(a, b) for a, b in pairwise(ends) if b > a]
    theta = [0.5 * (b + a) + 0.5 * (b - a) * nodes for a, b in parts]
    return np.concatenate(theta), np.concatenate([0.5 * (b - a) * weights for a, b in parts])


@lru_cache(maxsize=32)
def _chi(csr: float) -> float:
    from scipy.optimize import brentq

    theta, weight = _quadrature(AUREOLE_RADIUS)
    outside = theta > SUN_RADIUS

    def excess(chi: float) -> float:
        ring = weight * theta * sun_profile(theta, "buie", chi)
        return float(ring[outside].sum() / ring.sum()) - csr

    return float(brentq(excess, 1e-3, 0.9, xtol=1e-12))


def _frequencies(blur: float, count: int = 400) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights in angular frequency, 1/rad.

    They extend up to the frequency beyond which a blur leaves nothing.
    """
    nodes, weights = np.polynomial.legendre.leggauss(count)
    top = 6.0 / blur
    return as_float(0.5 * top * (nodes + 1.0)), as_float(0.5 * top * weights)


def _sum(parts: Gaussians, k: FloatArray) -> FloatArray:
    return as_float(np.exp(-0.5 * np.square(k)[..., None] * parts.variance) @ parts.weight)


@lru_cache(maxsize=64)
def _fitted(shape: SunShape, count: int, blur: float) -> Gaussians:
    """Return the fit, computed in the frequency domain.

    The integral of the squared difference is the same there.

    Two weights follow from the sum and the variance, and the remaining ones are linear; the
    variances are searched for from a few starting points.
    """
    from scipy.optimize import minimize

    k, step = _frequencies(blur, 160)
    root = np.exp(-0.5 * (k * blur) ** 2) * np.sqrt(k * step)
    true = shape.spectrum(k)
    total = shape.variance

    def weights(variance: FloatArray) -> FloatArray:
        held = np.stack([np.ones(count), variance / total])
        first = np.linalg.lstsq(held, np.ones(2), rcond=None)[0]
        free = np.linalg.svd(held)[2][2:].T
        if not free.size:
            return as_float(first)
        parts = np.exp(-0.5 * np.square(k)[:, None] * variance) * root[:, None]
        rest = true * root - parts @ first
        return as_float(first + free @ np.linalg.lstsq(parts @ free, rest, rcond=None)[0])

    def miss(logs: Any) -> float:
        variance = total * np.exp(np.clip(logs, -6.0, 6.0))
        w = weights(variance)
        rest = (_sum(Gaussians(w, variance), k) - true) * root
        # Nearly equal Gaussians with huge weights of opposite sign are of no benefit.
        return float(rest @ rest / (true * root @ (true * root)) + 3e-6 * w @ w)

    # Starting points: for the disk alone, near and far from each other; and with one or two for an
    # aureole.
    disk = np.log(SUN_SIGMA**2 / total)
    near, far = (disk + np.linspace(np.log(a), np.log(0.8), count) for a in (0.45, 0.2))
    begins = [near, far, np.append(far[1:], 2.0), np.append(near[:-1], 1.0)]
    # Four digits of the variances are sufficient.
    found = [
        minimize(miss, x, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-9})
        for x in begins
    ]
    logs = np.sort(min(found, key=lambda result: float(result.fun)).x)
    variance = total * np.exp(np.clip(logs, -6.0, 6.0))
    return Gaussians(weights(variance), as_float(variance))
