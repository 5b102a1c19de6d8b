"""What stands between a sun, a mirror and a target: screened for a field, judged for some.

For all heliostats at once only angles are looked at, as if each turned about its foot; for those
that come into question also who shades and who blocks them.
"""

import numpy as np
import numpy.typing as npt
from scipy.special import erf

from heliotrope.calibration.plan.planning import SightingLimits
from heliotrope.field.camera import Camera
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, angle_between, tangent_axes
from heliotrope.optics import SUN_RADIUS

#: The screening forgives so much: a pivot is not at the foot, rad.
SLACK = float(np.radians(4.0))
#: Neighbours that can shade or block a mirror.
NEIGHBOURS = 32

Mask = npt.NDArray[np.bool_]


class Sight:
    """Lines of sight of N heliostats to one target.

    Parameters
    ----------
    target
        Where beams go.
    position
        Of the heliostats, (N, 3).
    size
        Width and height of the mirrors, m, (N, 2).
    cameras
        That look at the target.
    """

    def __init__(
        self, target: Target, position: FloatArray, size: FloatArray, cameras: tuple[Camera, ...]
    ) -> None:
        self.target = target
        way = target.center - position
        self.distance = np.linalg.norm(way, axis=1)
        self.way = way / self.distance[:, None]
        self.obliquity = angle_between(-self.way, np.broadcast_to(target.normal, way.shape))
        # The beam's own radius: half a mirror, and the sun's disc.
        radius = 0.5 * size.max(axis=1) + SUN_RADIUS * self.distance
        half = 0.5 * np.array([target.width, target.height])
        self._room = np.maximum(half[None, :] - radius[:, None], 0.1 * half)
        self._eyes = [c.position for c in cameras if c.position is not None]

    def able(self, sun: FloatArray, limits: SightingLimits) -> Mask:
        """Return who may be within the limits, (N,); some that are not are let through."""
        half_way = 0.5 * angle_between(np.broadcast_to(sun, self.way.shape), self.way)
        return np.asarray(
            (half_way <= limits.max_incidence + SLACK)
            & (self.obliquity <= limits.max_obliquity + SLACK)
        )

    def seen(self, square: FloatArray, rows: npt.NDArray[np.intp] | slice) -> FloatArray:
        """Return the chance that a beam is wholly on the target at first, (K,).

        Parameters
        ----------
        square
            Expected squared beam error, rad², (K,).
        rows
            Whose.
        """
        sigma = np.sqrt(0.5 * square) * self.distance[rows]
        across = sigma / np.maximum(np.cos(self.obliquity[rows]), 0.1)
        room, root = self._room[rows], np.sqrt(2.0)
        return np.asarray(erf(room[:, 0] / (root * across)) * erf(room[:, 1] / (root * sigma)))

    def glare(self, sun: FloatArray) -> float:
        """Return the least angle between the sun and the line of a camera to the target, rad."""
        ways = [self.target.center - eye for eye in self._eyes]
        return min(
            (float(angle_between(way / np.linalg.norm(way), sun)) for way in ways), default=np.pi
        )


def neighbours(position: FloatArray) -> npt.NDArray[np.intp]:
    """Return the nearest neighbours of each heliostat, (N, K)."""
    from scipy.spatial import cKDTree

    count = len(position)
    if count < 2:
        return np.empty((count, 0), dtype=np.intp)
    _, found = cKDTree(position).query(position, k=min(NEIGHBOURS + 1, count))
    return np.asarray(found, dtype=np.intp)[:, 1:]


def hidden(
    offsets: FloatArray, normal: FloatArray, size: FloatArray, way: FloatArray
) -> FloatArray:
    """Return the share of mirrors that neighbours hide towards a direction, (K,).

    Parameters
    ----------
    offsets
        From each mirror to its neighbours, m, (K, J, 3).
    normal
        Of the mirrors; the neighbours are taken to stand alike, (K, 3).
    size
        Width and height, m, (K, 2).
    way
        Unit vector to the sun or the target, (3,) or (K, 3).

    Notes
    -----
    Parallel mirrors of one size are pushed along the ray into the mirror's plane, where the
    overlap of two rectangles is exact; overlaps of several neighbours are added, which is an upper
    bound.
    """
    ray = np.broadcast_to(way, normal.shape)
    steep = np.maximum(np.einsum("kc,kc->k", normal, ray), 0.05)
    height = np.einsum("kjc,kc->kj", offsets, normal)
    moved = offsets - (height / steep[:, None])[..., None] * ray[:, None, :]
    axes = tangent_axes(normal)
    plane = np.abs(np.einsum("kjc,kac->kja", moved, axes))
    overlap = np.clip(1.0 - plane / size[:, None, :], 0.0, 1.0).prod(axis=-1)
    # Only who stands in front of the mirror, towards the light, can hide it.
    return np.asarray(np.minimum(np.where(height > 0.0, overlap, 0.0).sum(axis=1), 1.0))
