"""The chance that a beam is on a target, at the first look and where it is looked for next."""

import numpy as np
from scipy.special import erf

from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.optics.beam import SUN_RADIUS

#: Distance between neighbouring aims of a search, as a share of the target's shorter side.
PITCH = 0.5


def chance_on_target(
    target: Target, position: FloatArray, size: FloatArray, spread: FloatArray
) -> FloatArray:
    """Return the chance that a beam is wholly on a target at the first look, (N,).

    Parameters
    ----------
    target
        The target; the beam is sent to its centre.
    position, size
        Feet of the heliostats (N, 3) and the larger sides of their mirrors (N,), m.
    spread
        Expected squared beam error of both directions together, rad², (N,).
    """
    room, sigma = _room(target, position, size, spread)
    chance = erf(room / (np.sqrt(2.0) * sigma))
    return np.asarray(chance[:, 0] * chance[:, 1])


def chance_by_try(
    target: Target, position: FloatArray, size: FloatArray, spread: FloatArray, tries: int
) -> FloatArray:
    """Return the chance that a beam which earlier tries have missed is on a target, (K, N).

    The aim of each try is that of `search_places`; the other parameters are those of
    `chance_on_target`.
    """
    room, sigma = _room(target, position, size, spread)
    places = search_places(target, tries)
    # The edges of all windows cut the plane into cells, each of which one try is the first to see.
    middles, chances = zip(
        *(_cut(places[:, k], room[:, k], sigma[:, k]) for k in (0, 1)), strict=True
    )
    chance = chances[0][:, :, None] * chances[1][:, None]
    free = np.ones(chance.shape, dtype=np.bool_)
    found, left = np.empty((tries, len(position))), np.ones(len(position))
    for k, place in enumerate(places):
        right, above = (np.abs(middles[i] - place[i]) <= room[:, i, None] for i in (0, 1))
        here = free & right[:, :, None] & above[:, None]
        share = np.where(here, chance, 0.0).sum(axis=(1, 2))
        found[k] = share / np.maximum(left, 1e-12)
        left, free = left - share, free & ~here
    return np.clip(found, 0.0, 1.0)


def _cut(places: FloatArray, room: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the middles of an axis's pieces between windows' edges, and their chances, (N, C)."""
    lines = np.unique(places)
    edges = np.sort(np.concatenate([lines - room[:, None], lines + room[:, None]], axis=1), axis=1)
    chance = 0.5 * np.diff(erf(edges / (np.sqrt(2.0) * sigma[:, None])), axis=1)
    return 0.5 * (edges[:, 1:] + edges[:, :-1]), chance


def search_places(target: Target, count: int) -> FloatArray:
    """Return where a beam is sent that earlier looks have missed, right and up, m, (K, 2).

    The middle first, then around it, half a target apart.
    """
    reach = int(np.ceil(np.sqrt(count)))
    line = np.arange(-reach, reach + 1)
    grid = np.array([(x, y) for x in line for y in line])
    near = np.argsort((grid**2).sum(axis=1), kind="stable")[:count]
    return np.asarray(PITCH * min(target.width, target.height) * grid[near])


def _room(
    target: Target, position: FloatArray, size: FloatArray, spread: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return how far a beam may be off the middle, and the deviation of its place, m, (N, 2)."""
    way = target.center - position
    distance = np.linalg.norm(way, axis=1)
    facing = np.abs(way @ target.normal) / distance
    # The beam's own radius: half a mirror, and the sun's disc.
    radius = 0.5 * size + SUN_RADIUS * distance
    half = 0.5 * np.array([target.width, target.height])
    room = np.maximum(half - radius[:, None], 0.1 * half)
    sigma = np.sqrt(0.5 * np.maximum(spread, 1e-18)) * distance
    return room, np.stack([sigma / np.maximum(facing, 0.1), sigma], axis=1)
