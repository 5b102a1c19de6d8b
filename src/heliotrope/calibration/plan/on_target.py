"""The probability that a beam is on a target, at the first attempt and at later search points."""

import numpy as np
from scipy.special import erf

from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.optics.beam import SUN_RADIUS

#: Distance between neighbouring aims of a search, as a fraction of the target's shorter side.
PITCH = 0.8
#: Number of joint first visits that search for a beam, at the middle of the target and around it.
LOOKS = 9
#: A stack finds a beam whose centre is this far inside the target, m.
_INSIDE = 0.5


def chance_on_target(
    target: Target, position: FloatArray, size: FloatArray, spread: FloatArray
) -> FloatArray:
    """Return the probability that a beam is wholly on a target at the first attempt, (N,).

    Parameters
    ----------
    target
        The target; the beam is sent to its centre.
    position, size
        Feet of the heliostats (N, 3) and the larger sides of their mirrors (N,), m.
    spread
        Expected squared beam error, summed over both directions, rad², (N,).
    """
    sigma = _deviation(target, position, spread)
    distance = np.linalg.norm(target.center - position, axis=1)
    # The beam's own radius is that of half a mirror plus the sun's disc.
    radius = 0.5 * size + SUN_RADIUS * distance
    half = 0.5 * np.array([target.width, target.height])
    room = np.maximum(half - radius[:, None], 0.1 * half)
    chance = erf(room / (np.sqrt(2.0) * sigma))
    return np.asarray(chance[:, 0] * chance[:, 1])


def chance_by_try(
    target: Target, position: FloatArray, spread: FloatArray, tries: int
) -> FloatArray:
    """Return the probability that each try finds a beam that earlier tries missed, (K, N).

    A beam is found if its centre is on the target. The aims of the tries are those of
    `search_places`; the other parameters are those of `chance_on_target`.
    """
    sigma = _deviation(target, position, spread)
    room = np.broadcast_to(reach_of(target), sigma.shape)
    places = search_places(target, tries)
    # The edges of all windows cut the plane into cells; each cell is first seen by one of the
    # tries.
    middles, chances = zip(
        *(_cut(places[:, k], room[:, k], sigma[:, k]) for k in (0, 1)), strict=True
    )
    chance = chances[0][:, :, None] * chances[1][:, None]
    free = np.ones(chance.shape, dtype=np.bool_)
    by_try, remaining = np.empty((tries, len(position))), np.ones(len(position))
    for k, place in enumerate(places):
        right, above = (np.abs(middles[i] - place[i]) <= room[:, i, None] for i in (0, 1))
        inside = free & right[:, :, None] & above[:, None]
        share = np.where(inside, chance, 0.0).sum(axis=(1, 2))
        by_try[k] = share / np.maximum(remaining, 1e-12)
        remaining, free = remaining - share, free & ~inside
    return np.clip(by_try, 0.0, 1.0)


def _cut(places: FloatArray, room: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the midpoints of the cells along an axis, and the cell probabilities, (N, C)."""
    lines = np.unique(places)
    edges = np.sort(np.concatenate([lines - room[:, None], lines + room[:, None]], axis=1), axis=1)
    chance = 0.5 * np.diff(erf(edges / (np.sqrt(2.0) * sigma[:, None])), axis=1)
    return 0.5 * (edges[:, 1:] + edges[:, :-1]), chance


def search_places(target: Target, count: int) -> FloatArray:
    """Return the search points for a beam that earlier attempts missed, right and up, m, (K, 2).

    The search starts at the middle of the target and continues around it.
    """
    reach = int(np.ceil(np.sqrt(count)))
    line = np.arange(-reach, reach + 1)
    grid = np.array([(x, y) for x in line for y in line])
    near = np.argsort((grid**2).sum(axis=1), kind="stable")[:count]
    return np.asarray(PITCH * min(target.width, target.height) * grid[near])


def reach_of(target: Target) -> FloatArray:
    """Return how far from the middle a stack can find a beam, right and up, m, (2,)."""
    return np.asarray(0.5 * np.array([target.width, target.height]) - _INSIDE)


def _deviation(target: Target, position: FloatArray, spread: FloatArray) -> FloatArray:
    """Return the standard deviation of a beam's position, right and up, m, (N, 2)."""
    path = target.center - position
    distance = np.linalg.norm(path, axis=1)
    facing = np.abs(path @ target.normal) / distance
    sigma = np.sqrt(0.5 * np.maximum(spread, 1e-18)) * distance
    return np.stack([sigma / np.maximum(facing, 0.1), sigma], axis=1)
