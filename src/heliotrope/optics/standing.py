"""Beams of heliostats at rest: over all sun positions of the year, and their superposition."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.field.volumes import Volume
from heliotrope.geometry import FloatArray, as_float, normalize, reflect
from heliotrope.optics.beam import SUN_RADIUS, Beams, MirrorOptics, crossing
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
_ALONG, _COARSE, _FINE = 25, 4.0, 0.2
#: Pairs of a point and a beam that are computed at once.
_PAIRS = 200_000


def suns_of_the_year(latitude: float) -> FloatArray:
    """Return unit vectors, ENU, (S, 3), to all sun positions of the year above the horizon.

    The sun positions are about 1° apart.

    Parameters
    ----------
    latitude
        Latitude, rad, north positive.
    """
    declination = np.arange(-_TROPIC, _TROPIC + _STEP, _STEP)
    hour = np.arange(-np.pi, np.pi, _STEP)
    d, h = (angle.ravel() for angle in np.meshgrid(declination, hour))
    polar, equal = np.sin(d), np.cos(d) * np.cos(h)
    sine, cosine = np.sin(latitude), np.cos(latitude)
    north, up = cosine * polar - sine * equal, sine * polar + cosine * equal
    suns = np.stack([-np.cos(d) * np.sin(h), north, up], axis=-1)
    return as_float(suns[up > -_REFRACTION])


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
    reach
        Largest distance from the centre at which more than the limit was found, m; 0 if it was
        found nowhere.
    """

    suns: float
    point: FloatArray
    reach: float


def hottest(beams: Beams, center: FloatArray, around: float, limit: float = 10.0) -> Hottest:
    """Return where beams, taken together, are strongest near a place in the air.

    First, evenly spaced points on the beams' axes are evaluated, then the neighbourhood of the best
    of these points. A narrow peak between the points may be missed.

    Parameters
    ----------
    beams
        N beams.
    center
        The middle of the search, such as a receiver's, ENU, m, (3,).
    around
        Distance from the centre up to which each beam is followed, m.
    limit
        Limit for `Hottest.reach`, in suns.
    """
    near = np.einsum("nk,nk->n", center - beams.origin, beams.direction)
    points = beams.point(near[:, None] + np.linspace(-around, around, _ALONG)).reshape(-1, 3)
    chosen = np.unique(np.linspace(0, len(points) - 1, min(len(points), _POINTS)).astype(np.intp))
    points = points[chosen]
    suns = _suns(beams, points)
    away = np.linalg.norm(points - center, axis=-1)
    reach = float(np.max(away, where=suns > limit, initial=0.0))
    best, most, step = points[suns.argmax()], float(suns.max()), _COARSE
    while step > _FINE:
        grid = np.stack(np.meshgrid(*[np.arange(-2, 3) * step] * 3), axis=-1).reshape(-1, 3) + best
        suns = _suns(beams, grid)
        if suns.max() > most * (1.0 + 1e-6):
            best, most = grid[suns.argmax()], float(suns.max())
        else:
            step *= 0.5
    return Hottest(
        most,
        as_float(best),
        max(reach, float(np.linalg.norm(best - center)) if most > limit else 0.0),
    )


def _suns(beams: Beams, points: FloatArray) -> FloatArray:
    """Return the irradiance from all beams at points (P, 3), in suns, (P,)."""
    parts = np.array_split(points, 1 + len(points) * len(beams) // _PAIRS)
    return np.concatenate([crossing(beams, part, dni=1.0).irradiance for part in parts])
