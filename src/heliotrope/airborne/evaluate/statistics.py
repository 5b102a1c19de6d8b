r"""Outliers, normality, and the accuracy of a mean over points on a mirror.

The plain estimate, σ/√n, treats the differences at n points as independent samples. They are not
independent, because the slope deviations of a mirror are one fixed, smooth field, and points spread
over the mirror average this field better than random samples would. With the covariance C of the
field, the error of the mean over the points relative to the mean over the mirror V is

$$ σ_E^2 = \bar C(x, x) - 2 \bar C(x, V) + \bar C(V, V) + τ^2 / n $$

(the extension variance: Matheron 1963, Economic Geology 58, 1246; Chilès & Delfiner 2012,
*Geostatistics*, section 2.6), where τ is the noise of one point. The field is modelled as Gaussian
with a Matérn covariance of smoothness 3/2, the same on all facets and independent between facets,
so that canting errors are included. Variance, correlation length and noise are estimated from the
differences by restricted maximum likelihood, and the result is averaged over all lengths and noise
ratios, weighted by their likelihood, because one mirror contains little information on either of
them.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.mirror import MirrorShape
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

#: False-alarm probability of Rosner's test.
ALPHA = 0.05
#: Largest fraction of the points that may be outliers.
SHARE = 0.2
#: With fewer points than this, the field cannot be estimated.
FIELD = 8
#: Prior scatter of a mirror's differences, rad, with the designed surface and with a slope map, as
#: in HelioPoint (0.8 mrad expected, 0.2 mrad in its figure 6).
SCATTER, SCATTER_WITH_MAP = 0.8e-3, 0.2e-3
#: The prior counts as this many degrees of freedom.
PRIOR_FREEDOM = 8.0
# Trial correlation lengths, as fractions of a facet's diagonal, and trial ratios τ²/s².
_LENGTHS = np.geomspace(0.04, 1.2, 8)
_RATIOS = np.geomspace(1e-3, 1e2, 11)
# Numbers of grid points along an edge of a facet, which represent its area. The two grids have no
# common points, so that pairs of a point with itself do not raise the mean of C over pairs.
_AREA = (9, 8)


def rosner(values: npt.ArrayLike, *, alpha: float = ALPHA) -> npt.NDArray[np.bool_]:
    """Return a mask of outliers among n values by the generalised ESD test.

    Parameters
    ----------
    values
        Values, (n,), normally distributed except for the outliers.
    alpha
        Probability that any of n good values is called an outlier.

    Raises
    ------
    InputError
        If alpha is not between 0 and 1.

    Notes
    -----
    The test is that of Rosner 1983, Technometrics 25, 165-172. Mean and standard deviation are
    estimated from the values; for a known covariance use
    `heliotrope.calibration.learn.outliers.generalised_esd`.
    """
    if not 0.0 < alpha < 1.0:
        raise InputError(f"alpha must be between 0 and 1, not {alpha}")
    data = as_float(values)
    mask = np.zeros(len(data), dtype=np.bool_)
    # Rosner's critical values are accurate from n = 15, and require that two values remain.
    most = min(int(np.ceil(SHARE * len(data))), len(data) - 3)
    if most < 1:
        return mask
    which, extreme, critical = studentized_deviates(data, most, alpha)
    beyond = np.flatnonzero(extreme > critical)
    if len(beyond):
        mask[which[: beyond[-1] + 1]] = True
    return mask


def studentized_deviates(
    values: npt.ArrayLike, most: int, alpha: float = ALPHA
) -> tuple[npt.NDArray[np.intp], FloatArray, FloatArray]:
    """Return indices, extreme Studentized deviates R and critical values λ, each (most,).

    Rosner 1983, (2.1) and (2.5): the value farthest from the mean is removed ``most`` times.
    """
    from scipy.stats import t as student

    data = as_float(values)
    remaining = np.arange(len(data))
    which = np.empty(most, dtype=np.intp)
    extreme = np.zeros(most)
    for i in range(most):
        part = data[remaining]
        spread = float(part.std(ddof=1))
        away = np.abs(part - part.mean())
        k = int(np.argmax(away))
        # If all values are equal, none is extreme.
        extreme[i] = away[k] / spread if spread > 0.0 else 0.0
        which[i] = remaining[k]
        remaining = np.delete(remaining, k)
    rest = len(data) - np.arange(most)
    quantile = student.ppf(1.0 - alpha / (2.0 * rest), rest - 2)
    critical = (rest - 1) * quantile / np.sqrt((rest - 2 + quantile**2) * rest)
    return which, extreme, as_float(critical)


def normality(values: npt.ArrayLike) -> float:
    """Return the p-value of the Shapiro-Wilk test; NaN for fewer than 3 values or equal values."""
    from scipy.stats import shapiro

    data = as_float(values)
    if len(data) < 3 or float(np.ptp(data)) <= 0.0:
        return float("nan")
    return float(shapiro(data).pvalue)


def plain_sigma(values: npt.ArrayLike) -> FloatArray:
    """Return σ/√n of each column of values (n, c), (c,); NaN if n is less than 2."""
    data = as_float(values)
    if len(data) < 2:
        return np.full(data.shape[1:], np.nan)
    return as_float(data.std(axis=0, ddof=1) / np.sqrt(len(data)))


def few_sigma(values: npt.ArrayLike, prior: float) -> FloatArray:
    """Return the standard deviation of the mean of a few values (n, c), n ≥ 1, (c,).

    The variance of a few values is poorly known, so it is combined with a prior (scaled inverse χ²
    with `PRIOR_FREEDOM` degrees of freedom about ``prior``², Gelman et al. 2013, *Bayesian Data
    Analysis*, section 3.3). The mean then has Student's distribution. The returned value is the
    standard deviation of the normal distribution that has the same 90 % ellipse in two components.
    """
    from scipy.stats import f as fisher

    data = as_float(values)
    n = len(data)
    freedom = PRIOR_FREEDOM + n - 1
    squares = np.sum((data - data.mean(axis=0)) ** 2, axis=0)
    variance = (PRIOR_FREEDOM * prior**2 + squares) / freedom
    wider = 2.0 * fisher.ppf(0.9, 2, freedom) / (-2.0 * np.log(0.1))
    return as_float(np.sqrt(wider * variance / n))


@dataclass(frozen=True)
class SpreadMean:
    """Means of c components over a mirror, from n points on it.

    Attributes
    ----------
    sigma
        Standard deviation of the points' plain mean about the mean over the mirror, (c,).
    weights
        Weights of the points in the best estimate of the mean over the mirror (ordinary block
        kriging), adding up to 1, (n,).
    sigma_weighted
        Standard deviation of that weighted mean, (c,).
    length
        Correlation length, m, averaged with the likelihood as weight.
    noise
        Fraction of the variance that is noise rather than field, τ² / (s² + τ²).
    """

    sigma: FloatArray
    weights: FloatArray
    sigma_weighted: FloatArray
    length: float
    noise: float


def spread_mean(
    values: npt.ArrayLike,
    shape: MirrorShape,
    facet: npt.ArrayLike,
    uv: npt.ArrayLike,
    prior: float = SCATTER,
) -> SpreadMean:
    """Estimate the mean over the mirror from n points.

    Parameters
    ----------
    values
        Differences at the points, rad, (n, c).
    shape
        Shape of the mirror.
    facet, uv
        Facet of each point, (n,), and its position along the facet's axes, m, (n, 2).
    prior
        Prior scatter of the values, rad; see `few_sigma`.

    Returns
    -------
    The mean. With fewer than `FIELD` points the field cannot be estimated, so the result is the
    plain mean with the standard deviation of `few_sigma`.
    """
    data, k, place = as_float(values), np.asarray(facet, dtype=np.intp), as_float(uv)
    n = len(data)
    if n < FIELD:
        sigma = few_sigma(data, prior) if n else plain_sigma(data)
        return SpreadMean(sigma, np.full(n, 1.0 / max(n, 1)), sigma, float("nan"), 1.0)
    with _one_thread().limit(limits=1, user_api="blas"):
        return _spread_mean(data, shape, k, place)


@lru_cache(maxsize=1)
def _one_thread() -> "ThreadpoolController":
    """Return a limit of one thread, because a mirror's matrices are too small for several."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def _spread_mean(
    data: FloatArray, shape: MirrorShape, k: npt.NDArray[np.intp], place: FloatArray
) -> SpreadMean:
    n = len(data)
    scale = float(np.linalg.norm(2.0 * shape.half_size, axis=-1).mean())
    lengths = scale * _LENGTHS
    same = k[:, None] == k[None, :]
    apart = np.linalg.norm(place[:, None] - place[None, :], axis=-1)
    areas = _Areas.of(shape, k, place)
    uniform = np.full(n, 1.0 / n)
    fits = [
        _Fit.of(data, np.where(same, matern(apart / ell), 0.0), *areas.at(float(ell)), uniform)
        for ell in lengths
    ]
    score = np.array([fit.score for fit in fits])
    weight = np.exp(score - score.max())
    weight /= weight.sum()
    plain, kriged = (
        np.einsum("lr,lrc->c", weight, np.array([getattr(fit, name) for fit in fits]))
        for name in ("plain", "kriged")
    )
    weights = np.einsum("lr,lrn->n", weight, np.array([fit.weights for fit in fits]))
    share = _RATIOS / (1.0 + _RATIOS)
    return SpreadMean(
        np.sqrt(plain),
        weights,
        np.sqrt(kriged),
        float(weight.sum(axis=1) @ lengths),
        float(weight.sum(axis=0) @ share),
    )


def matern(distance: npt.ArrayLike) -> FloatArray:
    """Return the Matérn correlation of smoothness 3/2 at distances in correlation lengths."""
    h = np.sqrt(3.0) * as_float(distance)
    return as_float((1.0 + h) * np.exp(-h))


@dataclass(frozen=True)
class _Areas:
    """Distances from points to the area of their facet."""

    shape: MirrorShape
    facet: npt.NDArray[np.intp]
    to_area: FloatArray

    @classmethod
    def of(cls, shape: MirrorShape, facet: npt.NDArray[np.intp], uv: FloatArray) -> "_Areas":
        grid = _grid(_AREA[0])[None] * shape.half_size[facet][:, None]
        return cls(shape, facet, np.linalg.norm(uv[:, None] - grid, axis=-1))

    def at(self, length: float) -> tuple[FloatArray, float]:
        """Return the mean correlation of each point with the mirror, (n,), and within it."""
        area = np.prod(self.shape.half_size, axis=-1)
        share = area / area.sum()
        to_mirror = share[self.facet] * matern(self.to_area / length).mean(axis=-1)
        first, second = (_grid(n) for n in _AREA)
        within = 0.0
        for size, part in zip(self.shape.half_size, share, strict=True):
            apart = _apart(float(size[0]), float(size[1]))
            within += float(part**2 * matern(apart / length).mean())
        assert len(first) != len(second)
        return as_float(to_mirror), within


@lru_cache(maxsize=64)
def _apart(half_width: float, half_height: float) -> FloatArray:
    size = np.array([half_width, half_height])
    first, second = (_grid(n) * size for n in _AREA)
    return as_float(np.linalg.norm(first[:, None] - second[None, :], axis=-1))


def _grid(count: int) -> FloatArray:
    """Return the centres of count × count cells of the square from −1 to 1, (count², 2)."""
    line = (2.0 * np.arange(count) + 1.0) / count - 1.0
    return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class _Fit:
    """Results for all noise ratios at one correlation length.

    Attributes
    ----------
    score
        Restricted log likelihood, (R,).
    plain, kriged
        Variance of the plain and of the weighted mean, (R, c).
    weights
        (R, n).
    """

    score: FloatArray
    plain: FloatArray
    kriged: FloatArray
    weights: FloatArray

    @classmethod
    def of(
        cls,
        data: FloatArray,
        correlation: FloatArray,
        to_mirror: FloatArray,
        within: float,
        uniform: FloatArray,
    ) -> "_Fit":
        n = len(data)
        root, basis = np.linalg.eigh(correlation)
        root = np.maximum(root, 0.0)
        ones, values = basis.sum(axis=0), basis.T @ data
        towards, plain_weights = basis.T @ to_mirror, basis.T @ uniform
        diagonal = root[None, :] + _RATIOS[:, None]
        inverse = 1.0 / diagonal
        unit = inverse @ ones**2
        mean = (inverse * ones) @ values / unit[:, None]
        gap = values[None] - ones[None, :, None] * mean[:, None, :]
        # REML estimate of s² of each component at this length and ratio.
        variance = np.einsum("rn,rnc->rc", inverse, gap**2) / (n - 1)
        score = -0.5 * (
            (n - 1) * np.log(np.maximum(variance, 1e-300))
            + np.log(diagonal).sum(axis=1)[:, None]
            + np.log(unit)[:, None]
        ).sum(axis=1)
        best = inverse * (towards + ones * ((1.0 - inverse @ (ones * towards)) / unit)[:, None])
        spread = [
            np.sum(diagonal * w**2, axis=-1) - 2.0 * w @ towards + within
            for w in (np.broadcast_to(plain_weights, best.shape), best)
        ]
        low, high = (np.maximum(s, 1e-12)[:, None] * variance for s in spread)
        return cls(score, low, high, best @ basis.T)
