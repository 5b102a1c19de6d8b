"""Fit beams to the pictures that their movements produce."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray
from heliotrope.imaging.coded._bells import moved, slope_derivatives
from heliotrope.imaging.coded._tops import Top
from heliotrope.imaging.coded.beams import ExpectedBeam
from heliotrope.imaging.coded.stack import Light, Stack, light_of

#: Minimum significance of a movement.
SIGNIFICANT = 8.0
#: If photographs are missing, the codes must keep at least this fraction of their independence.
_INDEPENDENT = 0.02
#: Half-width of the fit window, in standard deviations of the beam.
_WINDOW = 3.5
#: Standard deviation of the difference between the centroid of a beam and that of its Gaussian, as
#: a fraction of the beam radius, for canted facets of 6 m² at 80 to 200 m.
_LOPSIDED = 0.04
#: The second moments of a beam change by at most the first factor per step, and by the second
#: overall.
_CHANGE, _WIDEST = 1.5, 4.0
_STEPS = 6


@dataclass(frozen=True)
class Fit:
    """A fitted beam that moves according to its code.

    Attributes
    ----------
    power
        Brightness m².
    place
        m, (2,).
    moments
        Second moments, m², (2, 2).
    covariance
        Covariance of the position, m², (2, 2).
    power_sigma
        Standard deviation of ``power``.
    shown
        Whether the surface shows the beam's position; False if the beam lies off the surface by
        more than its radius, so that only a tail was fitted.
    """

    power: float
    place: FloatArray
    moments: FloatArray
    covariance: FloatArray
    power_sigma: float = float("nan")
    shown: bool = True

    @property
    def radius(self) -> float:
        """Radius of the beam, m: the standard deviation of its light over both axes."""
        return float(np.sqrt(0.5 * np.trace(self.moments)))


@dataclass(frozen=True)
class Fitted:
    """All beams of a stack.

    Attributes
    ----------
    fits
        One fit for each of M heliostats; None if no light follows the code.
    light
        Light of the photographs.
    mean
        Mean picture, as it would be if no beam moved, (N,).
    """

    fits: tuple[Fit | None, ...]
    light: Light
    mean: FloatArray


def axes_of(moves: FloatArray) -> npt.NDArray[np.intp]:
    """Return the A axes (one or two) along which heliostats move, for moves (K, M, 2)."""
    return np.flatnonzero(np.any(moves != 0.0, axis=(0, 1)))


def code_of(moves: FloatArray) -> npt.NDArray[np.intp]:
    """Return, for each heliostat, the first heliostat with the same code, (M,).

    Heliostats share a code if their movements are proportional, with one positive factor per axis.
    """
    moves = moves[..., axes_of(moves)]
    size = np.sqrt((moves**2).sum(axis=0))
    unit = moves / np.where(size > 0.0, size, 1.0)
    same = np.einsum("kia,kja->ija", unit, unit).min(axis=-1) > 1.0 - 1e-9
    return np.asarray(np.argmax(same, axis=1))


def regression(moves: FloatArray, weights: FloatArray) -> FloatArray | None:
    """Return the rows (A M, K) that convert pixel series to changes per metre of movement.

    A is the number of axes along which heliostats move. Heliostats that share a code change in the
    same way, apart from the size of their movements. The result is None if different codes are
    linearly dependent over the photographs used.
    """
    if not moves.any():
        return None
    code, moves = code_of(moves), moves[..., axes_of(moves)]
    first, group = np.unique(code, return_inverse=True)
    shape = len(first), moves.shape[-1]
    codes = moves[:, first].reshape(len(moves), -1)
    codes = codes - weights @ codes / weights.sum()
    normal = codes.T @ (weights[:, None] * codes)
    size = np.sqrt(np.diag(normal))
    if not (size > 0.0).all():
        return None
    if np.linalg.eigvalsh(normal / np.outer(size, size))[0] < _INDEPENDENT:
        return None
    # Movements are relative to the weighted mean, which the regression also subtracts from the
    # series.
    rows = np.linalg.solve(normal, codes.T * weights)
    rows = rows - rows.sum(axis=1, keepdims=True) * weights / weights.sum()
    lengths = np.sqrt((moves**2).sum(axis=0))
    smaller = (lengths[code] / np.where(lengths > 0.0, lengths, np.inf))[..., None]
    return np.asarray((rows.reshape(*shape, -1)[group] * smaller).reshape(-1, len(moves)))


def fitted(
    stack: Stack,
    values: FloatArray,
    empty: FloatArray | None,
    moves: FloatArray,
    expected: Sequence[ExpectedBeam],
    tops: Sequence[Top],
) -> Fitted:
    """Fit the beams of a stack by Gauss-Newton iteration.

    The residual is the exact difference between the photographs and beams that moved as commanded.
    Each beam is improved from its own pictures of that residual, one per axis of movement.
    """
    points = np.stack(np.meshgrid(*stack.axes), axis=-1)[stack.seen]
    fits: list[Fit | None] = [
        Fit(top.power, top.place, np.array(beam.second_moments, dtype=np.float64), np.eye(2))
        if top.significance >= SIGNIFICANT
        else None
        for top, beam in zip(tops, expected, strict=True)
    ]
    start, axes = list(fits), axes_of(moves)
    for step in range(_STEPS + 1):
        change = np.zeros_like(values)
        for i, fit in enumerate(fits):
            if fit is not None:
                change += fit.power * moved(points, fit.place, fit.moments, moves[:, i])
        light = light_of(values, empty, change)
        rows = regression(moves, light.weights)
        if rows is None:
            # If the light of a photograph near the limit has changed, the result cannot be trusted.
            return Fitted((None,) * len(fits), light, light.mean)
        rest = light.pictures - change
        mean = light.weights @ rest / light.weights.sum()
        rest -= mean
        pictures = (rows @ rest).reshape(len(fits), len(axes), -1)
        last = step == _STEPS
        for i, fit in enumerate(fits):
            first = start[i]
            if fit is None or first is None:
                continue
            window = _window(points, fit)
            if last and (_beside(points, fit.place) > first.radius).any():
                fits[i] = replace(fit, shown=False)
            elif last:
                used = light.weights > 0.0
                own = rows.reshape(len(fits), len(axes), -1)[i][:, used]
                remaining = rest[used][:, window]
                fits[i] = _measured(points[window], remaining, own, fit, stack, axes)
            else:
                fits[i] = _improved(points[window], pictures[i][:, window], fit, first, axes)
    return Fitted(tuple(fits), light, mean)


def _beside(points: FloatArray, place: FloatArray) -> FloatArray:
    """Return how far a position is outside points (N, 2) on each axis, m, (2,); ≤ 0 if inside."""
    return np.asarray(np.maximum(points.min(axis=0) - place, place - points.max(axis=0)))


def _window(points: FloatArray, fit: Fit) -> npt.NDArray[np.bool_]:
    d = points - fit.place
    return np.asarray(np.einsum("ni,ni->n", d @ np.linalg.inv(fit.moments), d) < _WINDOW**2)


def _improved(
    points: FloatArray, picture: FloatArray, fit: Fit, first: Fit, axes: npt.NDArray[np.intp]
) -> Fit:
    """Return the fit after one bounded improvement step."""
    if len(points) < 12:
        return fit
    terms = slope_derivatives(points, fit.place, fit.moments, fit.power)[:, axes].reshape(6, -1)
    scale = np.sqrt((terms**2).sum(axis=1))
    scale[scale == 0.0] = 1.0
    step = np.linalg.lstsq((terms / scale[:, None]).T, picture.ravel(), rcond=1e-6)[0] / scale
    length = float(np.hypot(*step[1:3]))
    place = fit.place + step[1:3] * min(1.0, 0.5 * fit.radius / max(length, 1e-12))
    moments = fit.moments + np.array([[step[3], step[4]], [step[4], step[5]]])
    power = float(np.clip(fit.power + step[0], fit.power / 1.5, fit.power * 1.5))
    return replace(fit, power=power, place=place, moments=_bounded(moments, fit, first))


def _bounded(moments: FloatArray, fit: Fit, first: Fit) -> FloatArray:
    """Limit second moments to within a factor of their previous and their initial values."""
    for base, factor in ((fit.moments, _CHANGE**2), (first.moments, _WIDEST**2)):
        root = np.linalg.cholesky(base)
        inverse = np.linalg.inv(root)
        values, vectors = np.linalg.eigh(inverse @ moments @ inverse.T)
        values = np.clip(values, 1.0 / factor, factor)
        moments = root @ (vectors * values) @ vectors.T @ root.T
    return np.asarray(0.5 * (moments + moments.T))


def _measured(
    points: FloatArray,
    rest: FloatArray,
    rows: FloatArray,
    fit: Fit,
    stack: Stack,
    axes: npt.NDArray[np.intp],
) -> Fit:
    """Return a fit with its covariance, and its position corrected by the residual.

    With x measured from the fitted position, ∫ x² Gₓ = ∫ 2 x y G_y = 2 p x̄ for any beam shape;
    weights of 4 : 3 are best for the two integrals in a round window with uniform noise. A single
    picture yields only one of the two integrals. The correction is weighted according to its own
    noise, which is computed from the effect of each photograph's residual on the position. Errors
    may therefore be correlated between neighbouring pixels, but not between photographs.

    Parameters
    ----------
    points
        Pixels of the beam, m, (N, 2).
    rest
        Residuals of the photographs used, (K, N).
    rows
        Regression on the mirror's codes, (A, K).
    axes
        The A axes of the mirror's movement.
    """
    x, y = (points - fit.place).T
    square, cross = (2.0 / 7.0, 3.0 / 7.0) if len(axes) == 2 else (0.5, 1.0)
    area = stack.step**2 / fit.power
    both = area * np.array([[square * x**2, cross * x * y], [cross * x * y, square * y**2]])
    moments = both[:, axes]
    terms = slope_derivatives(points, fit.place, fit.moments, fit.power)[:, axes]
    flat = terms.reshape(6, -1)
    scale = np.maximum(np.sqrt((flat**2).sum(axis=1)), 1e-300)
    gauss = (np.linalg.pinv((flat / scale[:, None]).T) / scale[:, None]).reshape(terms.shape)
    # The fit already accounts for its part of the moments.
    beyond = moments - np.einsum("ip,pan->ian", np.einsum("ian,pan->ip", moments, terms), gauss)
    picture = rows @ rest
    lopsided = (_LOPSIDED * fit.radius) ** 2
    noise = 0.5 * float(np.trace(_covariance(beyond, rest, rows)))
    share = lopsided / (lopsided + noise)
    levers = gauss[1:3] + share * beyond
    covariance = _covariance(levers, rest, rows) + (1.0 - share) ** 2 * lopsided * np.eye(2)
    return replace(
        fit,
        place=fit.place + np.einsum("ian,an->i", levers, picture),
        covariance=covariance,
        power_sigma=float(np.sqrt(_covariance(gauss[:1], rest, rows)[0, 0])),
    )


def _covariance(levers: FloatArray, rest: FloatArray, rows: FloatArray) -> FloatArray:
    """Return the covariance, (I, I), of ∑ levers (I, A, N) times the pictures ``rows @ rest``."""
    total = np.zeros((len(levers), len(levers)))
    for axis in range(len(rows)):
        effect = rest @ levers[:, axis].T
        spread = effect.T @ effect / (len(rest) - 1)
        total += spread * float((rows[axis] ** 2).sum())
    return total
