"""Static light: the mean picture at each beam's position, and beams without a code."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.imaging.coded._bells import bell
from heliotrope.imaging.coded.stack import Stack

#: Light that no known beam explains counts as another beam if it has this fraction of the usual
#: power.
_OTHER = 0.35
_MOST = 5
#: A beam is on the surface if the RMS of its light there is at least this fraction of the largest.
_SHOWN = 1e-3


@dataclass(frozen=True)
class StillLight:
    """The mean picture as a sum of beams.

    Attributes
    ----------
    powers, sigmas
        Power of the light at each beam's position, and its standard deviation, brightness m², (M,).
    usual
        Median power of the beams that move, brightness m².
    uncoded
        Positions of beams that belong to no heliostat, m, (U, 2).
    """

    powers: FloatArray
    sigmas: FloatArray
    usual: float
    uncoded: FloatArray


def still_light(
    stack: Stack,
    mean: FloatArray,
    places: Sequence[tuple[FloatArray, FloatArray]],
    moving: Sequence[float],
) -> StillLight:
    """Decompose the mean picture (N,) into beams at known positions and other beams.

    Parameters
    ----------
    stack
        The prepared stack, with N seen pixels.
    mean
        Mean light of all beams, (N,).
    places
        Position and second moments of each heliostat's beam.
    moving
        Powers of the beams that move.
    """
    points = np.stack(np.meshgrid(*stack.axes), axis=-1)[stack.seen]
    terms = [bell(points, place, moments) for place, moments in places]
    typical = np.median([moments for _, moments in places], axis=0)
    usual = float(np.median(moving)) if moving else _strongest(stack, mean, typical)[1]
    others: list[FloatArray] = []
    powers, rest = _powers(terms, mean)
    while len(others) < _MOST:
        place, power = _strongest(stack, rest, typical)
        if not power > _OTHER * usual:
            break
        others.append(place)
        terms.append(bell(points, place, typical))
        powers, rest = _powers(terms, mean)
    design = np.stack(terms, axis=-1)
    # What remains is the error of the beam shapes, which is smooth over a beam.
    normal = np.linalg.pinv(design.T @ design)
    beam = 2.0 * np.pi * float(np.sqrt(np.linalg.det(typical))) / stack.step**2
    sigmas = np.sqrt(np.maximum(np.diag(normal), 0.0) * float(rest @ rest) / len(rest) * beam)
    count = len(places)
    return StillLight(
        powers[:count], sigmas[:count], usual, np.array(others).reshape(len(others), 2)
    )


def _powers(terms: list[FloatArray], mean: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return non-negative powers by least squares, and the residual.

    A beam that is almost entirely off the surface is assigned no power, because any power would
    explain it.
    """
    from scipy.optimize import nnls

    design = np.stack(terms, axis=-1)
    size = np.linalg.norm(design, axis=0)
    shown = size > _SHOWN * size.max(initial=0.0)
    powers = np.zeros(len(terms))
    powers[shown] = nnls(design[:, shown] / size[shown], mean)[0] / size[shown]
    return powers, np.asarray(mean - design @ powers)


def _strongest(stack: Stack, picture: FloatArray, moments: FloatArray) -> tuple[FloatArray, float]:
    """Return the position and power of the beam that a matched filter finds in a picture (N,)."""
    from scipy.signal import fftconvolve

    reach = int(np.ceil(3.0 * np.sqrt(np.trace(moments)) / stack.step))
    line = stack.step * np.arange(-reach, reach + 1)
    grid = np.stack(np.meshgrid(line, -line), axis=-1)
    template = bell(grid.reshape(-1, 2), np.zeros(2), moments).reshape(grid.shape[:2])
    full = np.zeros(stack.seen.shape)
    full[stack.seen] = picture
    power = fftconvolve(full, template, mode="same") / (template**2).sum()
    best = np.unravel_index(int(np.argmax(power)), power.shape)
    x, y = stack.axes
    return np.array([x[best[1]], y[best[0]]]), float(power[best])
