"""Beams of heliostats at rest: over all sun positions of the year, and their superposition."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.field.volumes import Volume
from heliotrope.geometry import FloatArray, as_float, normalize, reflect
from heliotrope.jit import as_input
from heliotrope.optics._air_kernels import light_at, reach, strongest
from heliotrope.optics.beam import SUN_RADIUS, Beams, MirrorOptics
from heliotrope.optics.keep_out import bounds, find_entries

#: Largest declination of the sun, rad, and allowance for refraction, which lifts the sun at the
#: horizon.
_TROPIC, _REFRACTION = float(np.radians(23.45)), float(np.radians(0.6))
#: Angle between neighbouring sun positions of the year, rad; no sun position is further than 0.71
#: of this angle from a computed one.
_STEP = float(np.radians(1.0))
#: Number of points at which `hottest` first computes the irradiance from all beams.
_POINTS = 1000
#: Number of points of each beam on both sides of the place, and steps of the search about the
#: hottest point, m.
_ALONG, _COARSE, _FINE = 25, 2.0, 0.05
#: Fraction by which the bound may exceed the strongest light found, half of the sides of the
#: smallest cubes, m, and bounds of beams that may be computed; then the bound is less close.
_SHARE, _LEAST, _WORK = 0.05, 0.02, 2_000_000_000
#: Half of the sides of the smallest cubes of `reach_of`, m.
_LEAST_REACH = 0.05


def suns_of_the_year(latitude: float) -> FloatArray:
    """Return unit vectors, ENU, (S, 3), to all sun positions of the year above the horizon.

    The sun positions are about 1° apart.

    Parameters
    ----------
    latitude
        Latitude, rad, north positive.
    """
    declination = np.arange(-_TROPIC, _TROPIC + _STEP, _STEP)
    suns = _suns_at(latitude, declination, np.arange(-np.pi, np.pi, _STEP))
    return as_float(suns[suns[:, 2] > -_REFRACTION])


def hours_of_the_year(
    latitude: float, days: int = 24, every: float = 0.5
) -> tuple[FloatArray, FloatArray]:
    """Return sun positions of the year, (S, 3), and the daylight hours that each represents, (S,).

    Parameters
    ----------
    latitude
        Latitude, rad, north positive.
    days
        Number of days, evenly spaced over the year.
    every
        Time between sun positions of a day, h.
    """
    turn = 2.0 * np.pi * (np.arange(days) + 0.5) / days
    hour = np.arange(-12.0 + 0.5 * every, 12.0, every) * np.pi / 12.0
    suns = _suns_at(latitude, np.arcsin(np.sin(_TROPIC) * np.sin(turn)), hour)
    suns = as_float(suns[suns[:, 2] > 0.0])
    return suns, np.full(len(suns), 365.25 / days * every)


def _suns_at(latitude: float, declination: FloatArray, hour: FloatArray) -> FloatArray:
    """Return unit vectors, ENU, (D · H, 3), at declinations (D,) and hour angles (H,), rad."""
    d, h = (angle.ravel() for angle in np.meshgrid(declination, hour))
    polar, equal = np.sin(d), np.cos(d) * np.cos(h)
    sine, cosine = np.sin(latitude), np.cos(latitude)
    north, up = cosine * polar - sine * equal, sine * polar + cosine * equal
    return as_float(np.stack([-np.cos(d) * np.sin(h), north, up], axis=-1))


def entered_over_the_year(
    vertex: FloatArray,
    normal: FloatArray,
    mirrors: MirrorOptics,
    volumes: Sequence[Volume],
    latitude: float,
    reach: float,
) -> npt.NDArray[np.bool_]:
    """Return whether the beam of each mirror at rest enters each volume in a year, (N, V).

    As in `keep_out`, a result of "clear" is certain, because each beam is widened to cover the sun
    positions between the computed ones.

    Parameters
    ----------
    vertex, normal
        ENU, m, and unit vectors, (N, 3).
    mirrors
        N mirrors.
    volumes
        V volumes.
    latitude
        Latitude, rad, north positive.
    reach
        Distance up to which the beams are followed, m.
    """
    entered = np.zeros((len(vertex), len(volumes)), dtype=np.bool_)
    suns = suns_of_the_year(latitude)
    wide = MirrorOptics(**{**vars(mirrors), "error": mirrors.error + 0.71 * _STEP})
    for v, (volume, center, radius) in enumerate(zip(volumes, *bounds(volumes), strict=True)):
        path = center - vertex
        distance = np.linalg.norm(path, axis=-1)
        share = (radius + mirrors.half_diagonal) / np.maximum(distance, 1e-9)
        # All sun positions whose beams may touch the sphere about the volume are in this cone.
        room = np.arcsin(np.minimum(share, 1.0)) + wide.spread
        room = np.where(share >= 1.0, np.pi, room)
        toward = reflect(normalize(path, "center - vertex"), normal)
        for i in range(len(vertex)):
            near = suns[suns @ toward[i] >= np.cos(min(room[i], np.pi))]
            near = near[near @ normal[i] > -SUN_RADIUS]
            if len(near):
                entered[i, v] = _enters(vertex[i], normal[i], wide, i, near, volume, reach)
    return entered


def _enters(
    vertex: FloatArray,
    normal: FloatArray,
    mirrors: MirrorOptics,
    row: int,
    suns: FloatArray,
    volume: Volume,
    reach: float,
) -> bool:
    """Return whether the beam of one mirror enters a volume at any of the sun vectors (S, 3)."""
    count = len(suns)
    mirror = MirrorOptics(
        **{k: np.repeat(v[row : row + 1], count) for k, v in vars(mirrors).items()}
    )
    beams = Beams(
        np.repeat(vertex[None], count, axis=0),
        np.ascontiguousarray(reflect(suns, normal)),
        mirror,
        np.full(count, reach),
    )
    return bool(find_entries(beams, [volume]).entered.any())


def standing_beams(
    vertex: FloatArray, normal: FloatArray, sun: FloatArray, mirrors: MirrorOptics, reach: float
) -> Beams:
    """Return the beams of mirrors at rest.

    Parameters
    ----------
    vertex, normal
        ENU, m, and unit vectors, (N, 3).
    sun
        Unit vector, (3,).
    mirrors
        N mirrors.
    reach
        Distance up to which the beams are followed, m.
    """
    rays = np.ascontiguousarray(reflect(np.broadcast_to(sun, normal.shape), normal))
    return Beams(np.ascontiguousarray(vertex), rays, mirrors, np.full(len(vertex), reach))


@dataclass(frozen=True)
class Hottest:
    """The place where the beams of a field, taken together, are strongest.

    Attributes
    ----------
    suns
        Sum of the beams' irradiances, each on a surface that faces the beam, as a multiple of the
        direct sun.
    point
        ENU, m, (3,).
    bound
        Irradiance that is exceeded nowhere, in suns.
    """

    suns: float
    point: FloatArray
    bound: float


def hottest(beams: Beams, center: FloatArray, around: float) -> Hottest:
    """Return where beams, taken together, are strongest near a place in the air.

    The cube about the place is divided until no part of it can have more light than `bound`, which
    is usually within a tenth of `suns`; no peak is missed. There is no air below the lowest mirror.

    Parameters
    ----------
    beams
        N beams.
    center
        The middle of the cube, such as a receiver's, ENU, m, (3,).
    around
        Half of the cube's side, m.
    """
    packed = _packed(beams)
    best = _climbed(packed, beams, center, around)
    middle, half, low = _cube(beams, center, around)
    bound = strongest(packed, low, middle, half, SUN_RADIUS, _SHARE, _LEAST, _WORK, np.inf, best)
    return Hottest(float(best[3]), best[:3].copy(), float(bound))


def stays_below(beams: Beams, center: FloatArray, around: float, limit: float) -> bool:
    """Return whether beams, taken together, certainly nowhere exceed a limit, in suns.

    For the cube of air see `hottest`. The result is False as well where the search could not
    decide, which happens only close to the limit.
    """
    packed = _packed(beams)
    best = _climbed(packed, beams, center, around)
    if best[3] > limit:
        return False
    best[3] = limit
    middle, half, low = _cube(beams, center, around)
    bound = strongest(packed, low, middle, half, SUN_RADIUS, 0.0, _LEAST, _WORK, limit, best)
    return bool(bound <= limit)


def reach_of(beams: Beams, center: FloatArray, around: float, limit: float) -> float:
    """Return the distance from a place beyond which beams nowhere exceed a limit, m.

    The result errs on the safe side; it is 0 if the limit is exceeded nowhere. For the cube of air
    see `hottest`; the limit is in suns.
    """
    _, half, low = _cube(beams, center, around)
    return float(reach(_packed(beams), low, center, half, SUN_RADIUS, limit, _LEAST_REACH))


def _packed(beams: Beams) -> FloatArray:
    """Return beams as rows for the kernels."""
    mirrors = beams.mirrors
    radius = np.sqrt(mirrors.area / np.pi)
    columns = (radius, 1.0 / mirrors.focus, beams.reach, mirrors.reflectivity)
    return as_input(np.column_stack([beams.origin, beams.direction, *columns]))


def _cube(beams: Beams, center: FloatArray, around: float) -> tuple[FloatArray, float, float]:
    """Return the middle and half of the side of a cube, and the height of its lowest air, m.

    The cube is a little off the place: the beams often cross right there, and a peak on the corner
    of eight cubes would have to be found eight times.
    """
    off = around * np.array([0.031, 0.017, 0.023])
    return center + off, 1.031 * around, float(beams.origin[:, 2].min(initial=np.inf))


def _climbed(packed: FloatArray, beams: Beams, center: FloatArray, around: float) -> FloatArray:
    """Return a place with much light, and its light, (4,): the best of some points, improved."""
    near = np.einsum("nk,nk->n", center - beams.origin, beams.direction)
    along = around * np.linspace(-1.0, 1.0, _ALONG) ** 3
    points = beams.point(near[:, None] + along).reshape(-1, 3)
    chosen = np.unique(np.linspace(0, len(points) - 1, min(len(points), _POINTS)).astype(np.intp))
    points = points[chosen]
    points = points[points[:, 2] > beams.origin[:, 2].min(initial=np.inf)]
    if not len(points):
        return np.append(center, 0.0)
    suns = _suns(packed, points)
    best, most, step = points[suns.argmax()], float(suns.max()), _COARSE
    while step > _FINE:
        grid = np.stack(np.meshgrid(*[np.arange(-1, 2) * step] * 3), axis=-1).reshape(-1, 3) + best
        suns = _suns(packed, grid)
        if suns.max() > most * (1.0 + 1e-6):
            best, most = grid[suns.argmax()], float(suns.max())
        else:
            step *= 0.5
    return np.append(best, most)


def _suns(packed: FloatArray, points: FloatArray) -> FloatArray:
    """Return the irradiance from all beams at points (P, 3), in suns, (P,)."""
    suns = np.zeros(len(points))
    light_at(packed, as_input(points), SUN_RADIUS, suns)
    return suns
