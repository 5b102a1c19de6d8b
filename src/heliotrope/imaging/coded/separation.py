"""Find the beam of each heliostat from a stack of photographs and the heliostats' codes.

Regressing the time series of each pixel on the codes yields two pictures per heliostat, one for the
change caused by its movement along each axis. Orthogonal codes separate the pictures even where
beams overlap, and static light appears in none of them. A beam of power p and shape f at x₀ has the
pictures G = -p ∇f(x - x₀); their moments yield the power, ∫ x Gₓ = p, and the position, ½ ∫ x² Gₓ =
p x₀, without any assumption about the beam shape. If the heliostats move along one axis only, half
as many photographs are enough, because the single picture also yields the other coordinate, ∫ x y
Gₓ = p y₀. A Gaussian is fitted first, which accounts for the finite size of the movements and for
codes with missing photographs; the moments of the residual then correct the position.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray
from heliotrope.imaging.coded._bells import slopes
from heliotrope.imaging.coded._fitting import axes_of, code_of, fitted, regression
from heliotrope.imaging.coded._judging import judged, lost
from heliotrope.imaging.coded._still import still_light
from heliotrope.imaging.coded._tops import Top, find_top
from heliotrope.imaging.coded.beams import ExpectedBeam, SeparatedBeam, Verdict
from heliotrope.imaging.coded.codes import APART, distances
from heliotrope.imaging.coded.stack import Stack, light_of


@dataclass(frozen=True)
class Separation:
    """The result of separating a stack.

    Attributes
    ----------
    beams
        One beam per heliostat, in the order of ``expected``.
    factors
        Relative light level of each photograph, 1 at the median, (K,).
    used
        Mask of the photographs used, (K,).
    uncoded
        Positions of static beams on the surface that belong to no heliostat, m, (U, 2).
    """

    beams: tuple[SeparatedBeam, ...]
    factors: FloatArray
    used: npt.NDArray[np.bool_]
    uncoded: FloatArray

    @property
    def proven(self) -> tuple[SeparatedBeam, ...]:
        """Beams whose verdict allows them to become sightings."""
        return tuple(beam for beam in self.beams if beam.verdict is Verdict.PROVEN)


def separate(stack: Stack, moves: FloatArray, expected: Sequence[ExpectedBeam]) -> Separation:
    """Separate a stack of photographs into the beams of the heliostats.

    Parameters
    ----------
    stack
        K photographs.
    moves
        Commanded displacements on the surface, m, (K, M, 2). Either all heliostats move along both
        axes, or all move along the same axis.
    expected
        M mirrors.

    Raises
    ------
    InputError
        If shapes do not fit, or the codes of the heliostats are not orthogonal.

    Notes
    -----
    The covariance includes all effects that change between photographs, and the uncorrected effect
    of the beam shape. Add the error of the rectified pictures themselves (camera, survey), as for
    ordinary spots.
    """
    count = len(expected)
    _check(stack, moves, expected)
    work = stack.prepared()
    values = work.values[:, work.seen]
    empty = None if work.empty is None else work.empty[work.seen]
    light = light_of(values, empty, None)
    rows = regression(moves, light.weights)
    if rows is None:
        return Separation(
            tuple(lost(beam, Verdict.CLOUD) for beam in expected),
            light.factors,
            light.weights > 0.0,
            np.empty((0, 2)),
        )
    pictures = (rows @ light.pictures).reshape(count, len(axes_of(moves)), -1)
    tops = _tops(work, pictures, moves, expected)
    result = fitted(work, values, empty, moves, expected, tops)
    still = None
    if empty is not None:
        places = [
            (np.asarray(beam.place), np.asarray(beam.second_moments))
            if fit is None
            else (fit.place, fit.moments)
            for beam, fit in zip(expected, result.fits, strict=True)
        ]
        still = still_light(work, result.mean, places, [f.power for f in result.fits if f])
    return Separation(
        judged(expected, tops, result.fits, still),
        result.light.factors,
        result.light.weights > 0.0,
        np.empty((0, 2)) if still is None else still.uncoded,
    )


def _tops(
    stack: Stack, pictures: FloatArray, moves: FloatArray, expected: Sequence[ExpectedBeam]
) -> list[Top]:
    """Return the strongest beam that follows each heliostat's code.

    For n heliostats that share a code, the n strongest beams are found one after another; each
    found beam is subtracted before the next search. Beams are assigned to heliostats so that the
    sum of their distances from the expected positions is smallest.
    """
    from scipy.optimize import linear_sum_assignment

    code, axes = code_of(moves), axes_of(moves)
    size = np.sqrt((moves[..., axes] ** 2).sum(axis=0)).mean(axis=-1)
    points = np.stack(np.meshgrid(*stack.axes), axis=-1)[stack.seen]
    assigned: dict[int, Top] = {}
    for first in np.unique(code):
        members = [int(i) for i in np.flatnonzero(code == first)]
        shape = np.mean([expected[i].second_moments for i in members], axis=0)
        usual = float(size[members].mean())
        remaining = pictures[members[0]] * (size[members[0]] / usual)
        tops: list[Top] = []
        for _ in members:
            tops.append(find_top(stack, remaining, shape, axes))
            remaining = remaining - tops[-1].power * slopes(points, tops[-1].place, shape)[axes]
        found_at = [top.place for top in tops]
        rest = find_top(stack, remaining, shape, axes, found_at) if len(tops) > 1 else None
        places = np.array([expected[i].place for i in members])
        away = np.linalg.norm(places[:, None] - found_at, axis=-1)
        for i, k in zip(*linear_sum_assignment(away**2), strict=True):
            top = tops[k]
            if rest is not None:
                noise, share = rest.power / rest.significance, rest.power / max(top.power, 1e-300)
                top = replace(top, significance=top.power / noise, second=share)
            assigned[members[i]] = replace(top, power=top.power * usual / size[members[i]])
    return [assigned[i] for i in range(len(expected))]


def _check(stack: Stack, moves: FloatArray, expected: Sequence[ExpectedBeam]) -> None:
    count = len(expected)
    if moves.shape != (len(stack.values), count, 2) or not np.isfinite(moves).all():
        raise InputError(
            f"separation: moves of shape {moves.shape} for {len(stack.values)} photographs of "
            f"{count} mirrors; pass finite displacements (photographs, mirrors, 2)"
        )
    if regression(moves, np.ones(len(moves))) is None:
        raise InputError(
            f"separation: the codes of {count} mirrors over {len(moves)} photographs are linearly "
            "dependent; use codes from coded_movements"
        )
    code, places = code_of(moves), np.array([beam.place for beam in expected])
    away = distances(places, np.array([b.second_moments + b.covariance for b in expected]))
    near = np.argwhere((code[:, None] == code) & (away < 0.99 * APART) & ~np.eye(count, dtype=bool))
    if len(near):
        first, other = (expected[int(i)].heliostat for i in near[0])
        raise InputError(
            f"separation: {first} and {other} have the same code, {away[tuple(near[0])]:.1f} "
            f"standard deviations apart; move their beams at least {APART:g} standard deviations "
            "apart, or assign different codes"
        )
