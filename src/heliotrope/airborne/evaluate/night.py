r"""A night without moon: nothing is seen of the mirrors but the lamp on them.

*Which is which.* From the told position a mirror that stands as it was commanded shows the lamp
at the foot of the perpendicular from the drone. These feet stand for the mirrors' middles, and
:func:`heliotrope.airborne.evaluate.identification.identify` lays them over the spots.

*How the camera was turned.* A reflection on a flat mirror is seen along the mirror's normal,
wherever it stands on it. So the spots of all photographs tell how mirrors and photographs stand
turned from each other, but not how all of them are turned together: no corner fixes it. That
common turn is taken as the one that the commands have on the mean over the mirrors. With N
mirrors that deviate by σ from their commands it is known to

.. math:: C_ω = σ^2 \Big( \sum_i (I - n_i n_i^T) \Big)^{-1}

and so to about σ/√N, which goes into the standard deviation of every orientation.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.evaluate.detection import Picture, Spots, find_spots
from heliotrope.airborne.evaluate.identification import FEWEST, Identified, identify
from heliotrope.airborne.evaluate.orientation import differences, turned
from heliotrope.airborne.evaluate.reflections import Reflections
from heliotrope.airborne.mirror import MirrorShape, measured_normal
from heliotrope.airborne.photo import LedCamera, Photo
from heliotrope.airborne.standing import Standing
from heliotrope.errors import InputError
from heliotrope.field.camera import undistort
from heliotrope.geometry import FloatArray, as_float, rotation

#: A photograph whose readings are below this for half of its pixels is dark.
DARK_READING = 25
#: More lights than this are no mirrors'.
_MOST = 5000
#: How far beside its mirror a light may seem to be before the camera's turn is known, m.
BESIDE = 0.5
_ROUNDS = 12
#: Turns below this change nothing that matters, rad.
_STILL = 5e-5

Rows = npt.NDArray[np.intp]
#: Reflections of all spots with photographs and mirrors as they are believed to stand.
Cut = Callable[[Sequence[Photo], Standing], Reflections]


def is_dark(picture: Picture) -> bool:
    """Return whether nothing but lights can be seen in a picture."""
    return bool(np.median(picture[::8, ::8]) < DARK_READING)


def expected_feet(photo: Photo, camera: LedCamera, stand: Standing) -> tuple[FloatArray, Rows]:
    """Return where mirrors show the lamp if they stand as believed, (K, 3), and which, (K,)."""
    between = photo.position + 0.5 * (photo.led_position(camera) - photo.position)
    local = np.einsum("nji,nj->ni", stand.rotation, between - stand.vertex)
    half = 0.5 * np.ptp(stand.outline[..., :2], axis=1)
    on = (np.abs(local[:, :2]) < half + BESIDE).all(axis=1) & (local[:, 2] > 0.0)
    rows = np.flatnonzero(on)
    flat = np.pad(local[rows, :2], ((0, 0), (0, 1)))
    return stand.vertex[rows] + np.einsum("nij,nj->ni", stand.rotation[rows], flat), rows


def find_lights(
    picture: Picture, photo: Photo, camera: LedCamera, stand: Standing
) -> tuple[Identified, Spots]:
    """Return how the camera was turned, and the spots with their mirrors (rows of ``stand``).

    Spots that lie on no mirror are left out.
    """
    width, height = camera.size
    frame = np.array([(3, 3), (width - 4, 3), (width - 4, height - 4), (3, height - 4)], np.float64)
    spots, _ = find_spots(picture, frame[None], most=_MOST)
    feet, rows = expected_feet(photo, camera, stand)
    none = np.empty(0, dtype=np.intp)
    if len(spots) < FEWEST:
        text = f"nothing: it is dark, and {len(spots)} lights are seen, {FEWEST} are needed"
        return Identified(photo.rotation, none, none, text), spots
    found = identify(camera, photo, replace(stand.take(rows), vertex=feet), spots.pixel)
    if found.reason:
        text = (
            f"ambiguous: it is dark, and {len(spots)} lights do not tell which mirrors they are "
            "on; is it this field, and were these commands given?"
        )
        return replace(found, reason=text), spots
    mirror = _mirrors_of(undistort(camera, spots.pixel), photo, found.rotation, stand)
    kept = mirror >= 0
    named = Spots(
        mirror[kept], spots.pixel[kept], spots.sigma[kept], spots.flux[kept], spots.clipped[kept]
    )
    return replace(found, mirror=rows[found.mirror]), named


def _mirrors_of(plane: FloatArray, photo: Photo, turn: FloatArray, stand: Standing) -> Rows:
    """Return the mirror on which each light lies, -1 for none."""
    ways = np.concatenate([plane, np.ones((len(plane), 1))], axis=-1) @ turn.T
    start = np.einsum("nji,nj->ni", stand.rotation, photo.position - stand.vertex)
    local = np.einsum("nji,sj->sni", stand.rotation, ways)
    with np.errstate(divide="ignore", invalid="ignore"):
        length = -start[:, 2] / local[..., 2]
        at = start[:, :2] + length[..., None] * local[..., :2]
    # The camera's turn is known to some milliradians only.
    half = 0.5 * np.ptp(stand.outline[..., :2], axis=1)
    off = np.where(length > 0.0, np.max(np.abs(at) - half, axis=-1), np.inf)
    nearest = np.argmin(np.where(np.isfinite(off), off, np.inf), axis=1)
    inside = off[np.arange(len(plane)), nearest] < BESIDE
    return np.where(inside, nearest, -1).astype(np.intp)


# -- a whole flight --------------------------------------------------------------------


@dataclass(frozen=True)
class Turned:
    """A dark flight as its lights show it.

    Attributes
    ----------
    photos
        With their attitudes.
    stand
        The mirrors, as their lights show them.
    common
        Covariance of the turn that all share, rad², (3, 3).
    """

    photos: tuple[Photo, ...]
    stand: Standing
    common: FloatArray

    def place_covariance(self, place: float) -> FloatArray:
        """Return what all reflections of each mirror share as its place, m², (N, 3, 3).

        Parameters
        ----------
        place
            Standard deviation of the mirrors' places as seen from the drone, m: nothing in the
            photographs tells more of them.

        Notes
        -----
        A turn ω of the photographs moves a mirror at d by ω × d.
        """
        middle = as_float([p.position for p in self.photos]).mean(axis=0)
        away = self.stand.vertex - middle
        cross = np.zeros((len(away), 3, 3))
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            cross[:, i, j], cross[:, j, i] = -away[:, k], away[:, k]
        return as_float(
            place**2 * np.eye(3) + np.einsum("nij,jk,nlk->nil", cross, self.common, cross)
        )


def turn_together(
    photos: Sequence[Photo], stand: Standing, shape: Callable[[int], MirrorShape], cut: Cut
) -> Turned:
    """Return attitudes and mirrors that agree with all lights of a flight.

    Parameters
    ----------
    photos
        With attitudes to a few mrad.
    stand
        Mirrors as commanded.
    shape
        Gives the surface of a mirror's row; slopes do not matter here.
    cut
        Gives the reflections.

    Raises
    ------
    InputError
        If fewer than four mirrors show the lamp.
    """
    now, mirrors = list(photos), stand
    for _ in range(_ROUNDS):
        found = cut(now, mirrors)
        rows = np.unique(found.heliostat)
        if len(rows) < FEWEST:
            raise InputError(
                f"it is dark, and {len(rows)} mirrors show the lamp: {FEWEST} are needed to tell "
                "how the camera was turned"
            )
        now = _attitudes(now, found, mirrors, shape)
        found = cut(now, mirrors)
        before = mirrors
        mirrors = _orientations(mirrors, found, shape)
        now, mirrors = _as_commanded(now, mirrors, stand, rows)
        if np.abs(mirrors.rotation - before.rotation).max() < _STILL:
            break
    off = np.cross(stand.rotation[rows, :, 2], mirrors.rotation[rows, :, 2])
    # Three numbers were taken from two for each mirror.
    variance = float(np.sum(off**2)) / max(2 * len(rows) - 3, 1)
    common = as_float(variance * np.linalg.inv(_lever(stand, rows)))
    return Turned(tuple(now), mirrors, common)


def _lever(stand: Standing, rows: Rows) -> FloatArray:
    normal = stand.rotation[rows, :, 2]
    return as_float(len(rows) * np.eye(3) - normal.T @ normal)


def _attitudes(
    photos: Sequence[Photo],
    found: Reflections,
    stand: Standing,
    shape: Callable[[int], MirrorShape],
) -> list[Photo]:
    """Turn each photograph so that its lights are seen along the normals of the mirrors."""
    seen, wanted = np.empty((len(found), 3)), np.empty((len(found), 3))
    for row in np.unique(found.heliostat).tolist():
        mine = np.flatnonzero(found.heliostat == row)
        own, R = found.take(mine), stand.rotation[row]
        surface = shape(int(row))
        point = stand.vertex[row] + surface.point_at(own.facet, own.xy) @ R.T
        measured = measured_normal(point, own.camera, own.led)
        normal = surface.normal_at(own.facet, own.xy, slopes=False) @ R.T
        way = point - own.camera
        way /= np.linalg.norm(way, axis=-1, keepdims=True)
        axis = np.cross(measured, normal)
        turn = rotation(axis, np.linalg.norm(axis, axis=-1))
        seen[mine], wanted[mine] = way, np.einsum("nij,nj->ni", turn, way)
    turns = []
    for k, photo in enumerate(photos):
        mine = found.photo == k
        if int(mine.sum()) < 3:
            turns.append(photo)
            continue
        u, _, vt = np.linalg.svd(wanted[mine].T @ seen[mine])
        turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        turns.append(photo.moved(photo.position, turn @ photo.rotation))
    return turns


def _orientations(
    stand: Standing, found: Reflections, shape: Callable[[int], MirrorShape]
) -> Standing:
    """Turn each mirror by the median difference of its lights."""
    turns = stand.rotation.copy()
    for row in np.unique(found.heliostat).tolist():
        own = found.of(row)
        off = differences(own, shape(int(row)), turns[row], stand.vertex[row], slopes=False)
        turns[row] = turned(turns[row], np.median(off, axis=0))
    return replace(stand, rotation=turns)


def _as_commanded(
    photos: Sequence[Photo], mirrors: Standing, stand: Standing, rows: Rows
) -> tuple[list[Photo], Standing]:
    """Turn all together so that the mirrors stand as commanded on the mean."""
    off = np.cross(stand.rotation[rows, :, 2], mirrors.rotation[rows, :, 2])
    common = np.linalg.solve(_lever(stand, rows), off.sum(axis=0))
    back = rotation(-common, float(np.linalg.norm(common)))
    turns = mirrors.rotation.copy()
    turns[rows] = back @ turns[rows]
    return [p.moved(p.position, back @ p.rotation) for p in photos], replace(
        mirrors, rotation=turns
    )
