"""Convert spots to reflections by intersecting the ray of each spot with its mirror surface."""

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.evaluate.reading import PhotoReading
from heliotrope.airborne.evaluate.reflections import Reflections, join, reflections
from heliotrope.airborne.mirror import MirrorShape
from heliotrope.airborne.photo import LedCamera, Photo
from heliotrope.airborne.standing import MirrorPoses
from heliotrope.geometry import FloatArray, as_float

ShapeOf = Callable[[int], MirrorShape]

#: The position of a spot on a mirror is known to no better than this fraction of a pixel.
SPOT_FLOOR = 0.15
#: A spot between facets belongs to the mirror if it has at least this fraction of the typical
#: light.
_WEAK = 0.6


def spot_reflections(
    photos: Sequence[Photo],
    readings: Sequence[PhotoReading],
    camera: LedCamera,
    stand: MirrorPoses,
    shape: ShapeOf,
    *,
    shifts: FloatArray | None = None,
    beside: float = 0.0,
) -> Reflections:
    """Return the reflections of all spots of P photographs on N mirrors.

    Parameters
    ----------
    photos, readings
        Photographs with estimated positions, and their readings.
    camera
        The camera with its lamp.
    stand
        The mirrors.
    shape
        Function that returns the surface of a mirror, given its index; slopes do not matter here.
    shifts
        Displacement of each mirror's image in each photograph, in undistorted coordinates, (P, N,
        2); default: none.
    beside
        Rays that miss all facets by more than this (and a few per cent of a facet) are left
        out, m.
    """
    number = np.concatenate([np.full(len(s.spot_mirror), k) for k, s in enumerate(readings)])
    mirror = np.concatenate([s.spot_mirror for s in readings])
    place = np.concatenate([s.spot for s in readings])
    if shifts is not None:
        place = place - shifts[number, mirror]
    spread = np.hypot(np.concatenate([s.spot_sigma for s in readings]), SPOT_FLOOR / camera.focal)
    flux = np.concatenate([s.flux for s in readings])
    typical = float(np.median(flux)) if len(flux) else 0.0
    turns = as_float([p.rotation for p in photos])
    position = as_float([p.position for p in photos])
    lamp = as_float([p.led_position(camera) for p in photos])
    directions = np.concatenate([place, np.ones((len(place), 1))], axis=-1)
    directions = np.einsum("kij,kj->ki", turns[number], directions)
    parts = []
    for row in np.unique(mirror).tolist():
        mine = np.flatnonzero(mirror == row)
        turned = stand.rotation[row]
        start = (position[number[mine]] - stand.vertex[row]) @ turned
        facet, xy = _intersect(shape(int(row)), start, directions[mine] @ turned, beside)
        kept = facet >= 0
        if beside == 0.0:
            # The spot on a mirror behind this one is weakly visible through a gap between facets.
            kept &= (shape(int(row)).facet_at(xy) >= 0) | (flux[mine] > _WEAK * typical)
        distance = np.linalg.norm(start, axis=-1)
        # Foreshortening blurs the position of a spot along an oblique mirror.
        slant = np.maximum(np.abs(start[:, 2]) / distance, 0.2)
        sigma = np.maximum(spread[mine] * distance / slant, 1e-4)
        at = number[mine[kept]]
        parts.append(
            reflections(at, row, facet[kept], xy[kept], position[at], lamp[at], sigma[kept])
        )
    joined = join([p for p in parts if len(p)])
    return joined.take(np.lexsort((joined.heliostat, joined.photo)))


def _intersect(
    shape: MirrorShape, start: FloatArray, directions: FloatArray, beside: float
) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """Return where rays meet the surface: facet (-1 beside the mirror) and position (S, 2)."""
    height = np.zeros(len(directions))
    facet = np.full(len(directions), -1, dtype=np.intp)
    xy = np.zeros((len(directions), 2))
    for _ in range(3):
        length = (height - start[:, 2]) / directions[:, 2]
        xy = start[:, :2] + length[:, None] * directions[:, :2]
        facet = _nearest_facet(shape, xy, beside)
        kept = facet >= 0
        height[kept] = shape.point_at(facet[kept], xy[kept])[:, 2]
    return facet, xy


def _nearest_facet(shape: MirrorShape, xy: FloatArray, beside: float) -> npt.NDArray[np.intp]:
    """Return the facet at or nearest to each position; -1 for a position beside the mirror."""
    facet = shape.facet_at(xy)
    outside = np.flatnonzero(facet < 0)
    if len(outside):
        every = np.tile(np.arange(len(shape)), len(outside))
        uv = shape.along_facet(every, np.repeat(xy[outside], len(shape), axis=0))
        beyond = np.maximum(np.abs(uv) - shape.half_size[every], 0.0)
        off = np.hypot(beyond[:, 0], beyond[:, 1]).reshape(len(outside), len(shape))
        nearest = np.argmin(off, axis=1)
        limit = 0.05 * shape.half_size.max(axis=1) + 0.02 + beside
        near = off[np.arange(len(outside)), nearest] < limit[nearest]
        facet[outside[near]] = nearest[near]
    return facet
