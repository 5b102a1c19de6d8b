r"""Evaluate a flight on a moonless night, when only the lamp is visible in the mirrors.

A reflection on a flat mirror is seen along the mirror normal, wherever on the mirror it lies. The
spots in all photographs therefore determine the rotations of mirrors and photographs relative to
each other, but not the common rotation of all of them, for which corners would be needed. The
common rotation is chosen such that, on average, the mirrors have their commanded orientations. With
N mirrors that deviate by σ from their commands, the covariance of the common rotation is

$$ C_ω = σ^2 \Big( \sum_i (I - n_i n_i^T) \Big)^{-1} $$

that is, about σ/√N per axis, which is included in the standard deviation of every orientation.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.evaluate.identification import BESIDE, FEWEST, nearest_rotation
from heliotrope.airborne.evaluate.orientation import differences, turned
from heliotrope.airborne.evaluate.rays import ShapeOf, spot_reflections
from heliotrope.airborne.evaluate.reading import PhotoReading
from heliotrope.airborne.evaluate.reflections import Reflections
from heliotrope.airborne.mirror import measured_normal
from heliotrope.airborne.photo import LedCamera, Photo
from heliotrope.airborne.standing import MirrorPoses
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, rotation

_ROUNDS = 12
#: Smaller rotations than this no longer matter, rad.
_STILL = 5e-5

Rows = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Turned:
    """The result of a dark flight, derived from its lights.

    Attributes
    ----------
    photos
        Photographs with their attitudes.
    stand
        The mirrors.
    reflections
        Reflections of all spots.
    common
        Covariance of the rotation common to all photographs and mirrors, rad², (3, 3).
    """

    photos: tuple[Photo, ...]
    stand: MirrorPoses
    reflections: Reflections
    common: FloatArray

    def place_covariance(self, place: float) -> FloatArray:
        """Return the covariance of each mirror's position shared by its reflections, m², (N, 3, 3).

        Parameters
        ----------
        place
            Standard deviation of the mirrors' positions relative to the drone, m, which the
            photographs do not improve.

        Notes
        -----
        A rotation ω of the photographs displaces a mirror at d by ω × d.
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
    photos: Sequence[Photo],
    readings: Sequence[PhotoReading],
    camera: LedCamera,
    stand: MirrorPoses,
    shape: ShapeOf,
) -> Turned:
    """Return attitudes and mirrors that agree with all lights of a flight.

    Parameters
    ----------
    photos, readings
        Photographs with attitudes accurate to a few mrad, and their readings.
    camera
        The camera with its lamp.
    stand
        Mirrors as commanded.
    shape
        Function that returns the surface of a mirror by index; slopes do not matter here.

    Raises
    ------
    InputError
        If fewer than four mirrors show the lamp.
    """

    def found_by(photos: Sequence[Photo], mirrors: MirrorPoses) -> Reflections:
        # The common rotation can move lights off the mirrors they belong to.
        return spot_reflections(photos, readings, camera, mirrors, shape, beside=BESIDE)

    now, mirrors = list(photos), stand
    for _ in range(_ROUNDS):
        reflections = found_by(now, mirrors)
        rows = np.unique(reflections.heliostat)
        if len(rows) < FEWEST:
            raise InputError(
                f"the photographs are dark, and {len(rows)} mirrors show the lamp; {FEWEST} are "
                "needed to find the attitude of the camera"
            )
        now = _attitudes(now, reflections, mirrors, shape)
        reflections = found_by(now, mirrors)
        before = mirrors
        mirrors = _orientations(mirrors, reflections, shape)
        now, mirrors = _as_commanded(now, mirrors, stand, rows)
        if np.abs(mirrors.rotation - before.rotation).max() < _STILL:
            break
    off = np.cross(stand.rotation[rows, :, 2], mirrors.rotation[rows, :, 2])
    # Each mirror provides two components; the common rotation uses three of the total.
    variance = float(np.sum(off**2)) / max(2 * len(rows) - 3, 1)
    common = as_float(variance * np.linalg.inv(_lever(stand, rows)))
    return Turned(tuple(now), mirrors, found_by(now, mirrors), common)


def _lever(stand: MirrorPoses, rows: Rows) -> FloatArray:
    normal = stand.rotation[rows, :, 2]
    return as_float(len(rows) * np.eye(3) - normal.T @ normal)


def _attitudes(
    photos: Sequence[Photo], reflections: Reflections, stand: MirrorPoses, shape: ShapeOf
) -> list[Photo]:
    """Rotate each photograph so that its lights are seen along the mirror normals."""
    rays, targets = np.empty((len(reflections), 3)), np.empty((len(reflections), 3))
    for row in np.unique(reflections.heliostat).tolist():
        mine = np.flatnonzero(reflections.heliostat == row)
        own, R = reflections.take(mine), stand.rotation[row]
        surface = shape(int(row))
        point = stand.vertex[row] + surface.point_at(own.facet, own.xy) @ R.T
        measured = measured_normal(point, own.camera, own.led)
        normal = surface.normal_at(own.facet, own.xy, slopes=False) @ R.T
        ray = point - own.camera
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        axis = np.cross(measured, normal)
        turn = rotation(axis, np.linalg.norm(axis, axis=-1))
        rays[mine], targets[mine] = ray, np.einsum("nij,nj->ni", turn, ray)
    turns = []
    for k, photo in enumerate(photos):
        mine = reflections.photo == k
        if int(mine.sum()) < 3:
            turns.append(photo)
            continue
        turn = nearest_rotation(targets[mine], rays[mine])
        turns.append(photo.moved(photo.position, turn @ photo.rotation))
    return turns


def _orientations(stand: MirrorPoses, reflections: Reflections, shape: ShapeOf) -> MirrorPoses:
    """Rotate each mirror by the median difference of its lights."""
    turns = stand.rotation.copy()
    for row in np.unique(reflections.heliostat).tolist():
        own = reflections.of(row)
        off = differences(own, shape(int(row)), turns[row], stand.vertex[row], slopes=False)
        turns[row] = turned(turns[row], np.median(off, axis=0))
    return replace(stand, rotation=turns)


def _as_commanded(
    photos: Sequence[Photo], mirrors: MirrorPoses, stand: MirrorPoses, rows: Rows
) -> tuple[list[Photo], MirrorPoses]:
    """Rotate everything together so that, on average, the mirrors are oriented as commanded."""
    off = np.cross(stand.rotation[rows, :, 2], mirrors.rotation[rows, :, 2])
    common = np.linalg.solve(_lever(stand, rows), off.sum(axis=0))
    back = rotation(-common, float(np.linalg.norm(common)))
    turns = mirrors.rotation.copy()
    turns[rows] = back @ turns[rows]
    return [p.moved(p.position, back @ p.rotation) for p in photos], replace(
        mirrors, rotation=turns
    )
