"""The surface of a mirror, learnt from photographs of its beam on a target.

Each facet's deviation from its designed surface is a polynomial of low degree (products of Legendre
polynomials). The beams of all photographs are computed as in `mirror_image`: the central rays of
small elements, blurred by the sun and by a slope error that is learnt as well. The sum of squared
differences to the photographs, plus a prior on the coefficients, is minimised with its exact
gradient: the derivative with respect to an element's slope is that of the blurred residual at the
end of its ray. Every photograph has its own brightness and place, because exposure and pointing
errors say nothing about the surface.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import legendre

from heliotrope.errors import InputError
from heliotrope.field.heliostats import Facets
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, as_float, normalize, reflect
from heliotrope.optics.mirror_image import (
    Beam,
    blur_response,
    deposit,
    ray_spread,
    slope_exponent,
)
from heliotrope.optics.mirror_surface import grid_of, surface_at
from heliotrope.optics.sun_shape import SunShape

#: Highest degree of a facet's polynomial, and elements along a side of a facet.
DEGREE, ELEMENTS = 6, 16
#: Prior standard deviation of the slopes: of the canting, of the curvature, and of degree 3; rad.
#: From there it falls with the inverse of the degree.
PRIOR = (2e-3, 1.5e-3, 1e-3)
#: Part of a photograph's squares that the model is not expected to explain, for the prior's weight.
NOISE = 0.02
#: Slope error at first, and its limits, rad.
_ROUGH, _ROUGHS = 0.5e-3, (0.05e-3, 3e-3)
#: Samples along the longer side of a beam's grid at most.
_SAMPLES = 96
_ROUNDS = 300


@dataclass(frozen=True)
class BeamPhotograph:
    """One measured beam of a mirror, and how the mirror stood.

    Attributes
    ----------
    target
        The target.
    beam
        The beam's light on it, without the background; its brightness is in any unit.
    center
        Centre of the mirror, ENU m, (3,).
    R_enu_mirror
        Columns x (right), y (up) and z (normal) of the mirror, (3, 3).
    sun
        Unit vector to the sun, (3,).
    """

    target: Target
    beam: Beam
    center: FloatArray
    R_enu_mirror: FloatArray
    sun: FloatArray


@dataclass(frozen=True)
class LearntSurface:
    """Deviations of a mirror from its designed surface.

    Attributes
    ----------
    facets, focal
        Designed facets of one heliostat, and the focal length of their own curvature, m.
    coefficients
        Of each facet's polynomial, (F, P), as slopes, rad.
    slope_error
        Remaining slope error, which also contains the blur of the camera, rad.
    accuracy
        `beam_accuracy` of the photographs that were used, (K,).
    """

    facets: Facets
    focal: float
    coefficients: FloatArray
    slope_error: float
    accuracy: FloatArray

    @property
    def degree(self) -> int:
        """Highest degree of the polynomials."""
        return round(float(np.sqrt(2.0 * self.coefficients.shape[1] + 2.25)) - 1.5)

    def slopes(self, cells: int = 32) -> FloatArray:
        """Return the map of slope deviations in cells of each facet, rad, (F, cells, cells, 2).

        As `heliotrope.field.formats.slopes.write_slopes` writes it for a plant file.
        """
        base = _basis(grid_of(cells)[:, 0], self.facets.half_size[0], self.degree)
        slopes = np.einsum("fepk,fp->fek", base, self.coefficients)
        return as_float(slopes.reshape(-1, cells, cells, 2))

    def predict(self, photograph: BeamPhotograph, sun_shape: str | SunShape = "limb") -> Beam:
        """Return the beam on the grid of a photograph, with its power and its centroid."""
        light = SunShape.of(sun_shape)
        view = _View(photograph, self.facets, self.focal, light, self.degree)
        image, _ = view.image(self.coefficients, self.slope_error**2, np.zeros(2))
        grid = photograph.beam
        result = Beam(np.maximum(image, 0.0), view.step, view.origin)
        return result.shifted(grid.centroid - result.centroid).of_power(grid.power)


def beam_accuracy(measured: Beam, predicted: Beam) -> float:
    """Return 1 − ½ Σ|difference| / power of two beams of equal power: 1 if they are equal.

    Beams of unequal power are scaled to the same power on the grid of the first.
    """
    rows, columns = np.indices(measured.flux.shape)
    places = measured.origin + measured.step * np.stack([columns, rows], axis=-1)
    result = predicted.at(places)
    shares = measured.flux / measured.flux.sum() - result / result.sum()
    return float(1.0 - 0.5 * np.abs(shares).sum())


def learn_surface(
    photographs: Sequence[BeamPhotograph],
    facets: Facets,
    focal: float = np.inf,
    *,
    sun_shape: str | SunShape = "limb",
    degree: int = DEGREE,
) -> LearntSurface:
    """Return the surface that explains photographs of a mirror's beam.

    Parameters
    ----------
    photographs
        Some, at different sun positions; 4 to 8 are usual.
    facets
        Designed facets of one heliostat.
    focal
        Focal length of the facets' own curvature, m; infinity: flat.
    sun_shape
        Shape of the sun, or its name; see `SunShape`.
    degree
        Highest degree of a facet's polynomial, 1 (only canting) to 12.

    Raises
    ------
    InputError
        If there is no photograph, or in one of them the mirror does not send the sun to the target.
    """
    from scipy.optimize import minimize

    if not photographs:
        raise InputError("surface: no photograph of the mirror's beam; at least 1 is needed")
    if not 1 <= degree <= 12:
        raise InputError(f"surface: degree {degree} must be from 1 to 12")
    if len(facets.center) != 1:
        raise InputError(f"surface: facets of {len(facets.center)} heliostats; pass those of one")
    shape = SunShape.of(sun_shape)
    views = [_View(p, facets, focal, shape, degree) for p in photographs]
    prior = _prior(degree)
    count, size = len(facets.center[0]), len(prior)
    weight = NOISE / size / count

    def cost(x: FloatArray) -> tuple[float, FloatArray]:
        own = x[: count * size].reshape(count, size)
        rough, shifts = _ROUGH**2 * np.exp(x[count * size]), x[count * size + 1 :].reshape(-1, 2)
        total, grown = weight * float((own**2).sum()), np.zeros_like(x)
        grown[: count * size] = 2.0 * weight * own.ravel()
        for k, view in enumerate(views):
            value, by_own, by_rough, by_shift = view.misfit(own * prior, rough, shifts[k])
            total += value / len(views)
            grown[: count * size] += (by_own * prior).ravel() / len(views)
            grown[count * size] += rough * by_rough / len(views)
            at = count * size + 1 + 2 * k
            grown[at : at + 2] += by_shift / len(views)
        return total, grown

    start = np.zeros(count * size + 1 + 2 * len(views))
    limits: list[Any] = [(None, None)] * len(start)
    limits[count * size] = tuple(2.0 * np.log(r / _ROUGH) for r in _ROUGHS)
    result = minimize(
        cost, start, jac=True, method="L-BFGS-B", bounds=limits, options={"maxiter": _ROUNDS}
    )
    own = result.x[: count * size].reshape(count, size) * prior
    rough = float(_ROUGH * np.exp(0.5 * result.x[count * size]))
    learnt = LearntSurface(facets, focal, own, rough, np.zeros(0))
    right = [beam_accuracy(p.beam, learnt.predict(p, shape)) for p in photographs]
    return LearntSurface(facets, focal, own, rough, np.array(right))


def spread_over_suns(photographs: Sequence[BeamPhotograph], count: int) -> list[int]:
    """Return the places of up to ``count`` photographs whose suns are far apart, in order.

    The first is nearest to the mean sun; each next is the farthest from those before it.
    """
    suns = np.array([p.sun for p in photographs])
    chosen = [int(np.argmax(suns @ suns.mean(axis=0)))]
    while len(chosen) < min(count, len(suns)):
        nearest = (suns @ suns[chosen].T).max(axis=1)
        nearest[chosen] = np.inf
        chosen.append(int(np.argmin(nearest)))
    return sorted(chosen)


def _degrees(degree: int) -> list[tuple[int, int]]:
    return [(i, n - i) for n in range(1, degree + 1) for i in range(n + 1)]


def _prior(degree: int) -> FloatArray:
    """Return the prior standard deviation of each coefficient, rad, (P,)."""
    orders = [i + j for i, j in _degrees(degree)]
    return np.array([PRIOR[n - 1] if n < 3 else PRIOR[2] * 3.0 / n for n in orders])


def _basis(places: FloatArray, half: FloatArray, degree: int) -> FloatArray:
    """Return slopes at places (E, 2) of each facet's polynomials, (F, E, P, 2), of RMS 1.

    The places are from −1 to 1; half sizes (F, 2), m.
    """
    values = [legendre.legval(places.T, np.eye(degree + 1)[k]) for k in range(degree + 1)]
    steps = [
        legendre.legval(places.T, legendre.legder(np.eye(degree + 1)[k])) for k in range(degree + 1)
    ]
    base = np.stack(
        [
            np.stack([steps[i][0] * values[j][1], values[i][0] * steps[j][1]], axis=-1)
            for i, j in _degrees(degree)
        ],
        axis=1,
    )
    shaped = base / half[:, None, None]
    size = np.sqrt((shaped**2).sum(axis=-1, keepdims=True).mean(axis=1, keepdims=True))
    return as_float(shaped / size)


class _View:
    """What one photograph shows of a surface: the model's image and its derivatives."""

    def __init__(
        self,
        photograph: BeamPhotograph,
        facets: Facets,
        focal: float,
        light: SunShape,
        degree: int,
    ) -> None:
        target, R, sun = photograph.target, photograph.R_enu_mirror, photograph.sun
        half, grid = facets.half_size[0], grid_of(ELEMENTS)
        places = np.broadcast_to(grid, (len(grid), len(half), 2))
        points, normals = surface_at(facets, focal, places)
        points, normals = photograph.center + points @ R.T, normals @ R.T
        axes = facets.axes[0, :, :2] @ R.T
        hits = target.intersect(points, reflect(sun, normals))
        if not np.isfinite(hits).all() or (normals @ sun).min() <= 0.0:
            raise InputError(
                f"surface: the mirror does not send the sun to target {target.name}; check the "
                "sun and the drive positions of the photograph"
            )
        plane = target.plane_coordinates(hits)
        # A slope ∂z/∂u tilts the normal against u.
        tiny = 1e-5
        turned = [self._land(target, points, normals - tiny * axes[:, k], sun) for k in range(2)]
        self._by_slope = np.stack([(t - plane) / tiny for t in turned], axis=-1)
        self._weight = half.prod(axis=-1) * (normals @ sun)
        self._weight /= self._weight.sum()
        self._base = _basis(grid[:, 0], half, degree)
        measured = photograph.beam
        factor = max(1, -(-max(measured.flux.shape) // _SAMPLES))
        coarse = measured.coarser(factor)
        self.step, self.origin, self._shape = coarse.step, coarse.origin, coarse.flux.shape
        self._seen = coarse.flux / coarse.flux.sum()
        self._squares = float((self._seen**2).sum())
        middle = np.einsum("ef,efk->k", self._weight, plane)
        self._plane = plane - middle + measured.centroid
        ray = normalize(np.einsum("ef,efk->k", self._weight, reflect(sun, normals)))
        away = float(np.linalg.norm(target.center - photograph.center))
        spread = ray_spread(target, sun, R[:, 2], ray, away)
        # Room beside the grid, so that what leaves it on one side does not return on the other.
        self._size = (2 * self._shape[0], 2 * self._shape[1])
        self._sun = blur_response(spread, light, self._size, self.step)
        self._rough = slope_exponent(spread, self._size, self.step)

    @staticmethod
    def _land(
        target: Target, points: FloatArray, normals: FloatArray, sun: FloatArray
    ) -> FloatArray:
        return target.plane_coordinates(target.intersect(points, reflect(sun, normalize(normals))))

    def image(
        self, own: FloatArray, variance: float, shift: FloatArray
    ) -> tuple[FloatArray, tuple[Any, ...]]:
        """Return the image with a sum near 1, and what its derivatives need."""
        from scipy.fft import irfft2, rfft2

        slopes = np.einsum("fepk,fp->efk", self._base, own)
        plane = self._plane + np.einsum("efij,efj->efi", self._by_slope, slopes) + shift
        places = ((plane - self.origin) / self.step).reshape(-1, 2)
        # Rays beyond the grid are kept at its border.
        rows, columns = self._size
        room = np.array([self._shape[1], self._shape[0]]) // 2
        places = np.clip(places + room, 0.0, np.array([columns, rows]) - 1.001)
        response = self._sun * np.exp(variance * self._rough)
        cloud = rfft2(deposit(places, self._weight.ravel(), self._size))
        whole = irfft2(cloud * response, s=self._size)
        image = whole[room[1] : room[1] + self._shape[0], room[0] : room[0] + self._shape[1]]
        return image, (places, room, cloud, response)

    def misfit(
        self, own: FloatArray, variance: float, shift: FloatArray
    ) -> tuple[float, FloatArray, float, FloatArray]:
        """Return the share of unexplained squares, and its derivatives.

        Derivatives with respect to the coefficients (F, P), the slope variance and the shift (2,).
        """
        from scipy.fft import irfft2, rfft2

        image, (places, room, cloud, response) = self.image(own, variance, shift)
        # The best brightness for this image.
        square = float((image**2).sum())
        scale = float((image * self._seen).sum()) / square
        rest = np.zeros(self._size)
        part = (
            slice(room[1], room[1] + self._shape[0]), slice(room[0], room[0] + self._shape[1])
        )  # fmt: skip
        left = scale * image - self._seen
        rest[part] = 2.0 * scale * left / self._squares
        grown = irfft2(cloud * response * self._rough, s=self._size)
        by_variance = float((rest * grown).sum())
        back = irfft2(rfft2(rest) * np.conj(response), s=self._size)
        whole = np.floor(places).astype(np.intp)
        a, b = (places - whole).T
        x, y = whole.T
        q00, q10, q01, q11 = back[y, x], back[y, x + 1], back[y + 1, x], back[y + 1, x + 1]
        by_place = np.stack(
            [(1 - b) * (q10 - q00) + b * (q11 - q01), (1 - a) * (q01 - q00) + a * (q11 - q10)],
            axis=-1,
        )
        by_plane = (self._weight.ravel()[:, None] * by_place / self.step).reshape(
            *self._weight.shape, 2
        )
        by_slope = np.einsum("efij,efi->efj", self._by_slope, by_plane)
        by_own = np.einsum("fepk,efk->fp", self._base, by_slope)
        value = float((left**2).sum()) / self._squares
        return value, by_own, by_variance, by_plane.sum(axis=(0, 1))
