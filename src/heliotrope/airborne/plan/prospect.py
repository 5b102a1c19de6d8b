"""Predict what photographs from a direction will show: visible mirrors, sizes, reflections.

The visibility model is the one used in the evaluation (`heliotrope.airborne.visibility`).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.plan.hover import Facing, HoverMirrors, Sampling, spacing
from heliotrope.airborne.standing import MirrorPoses
from heliotrope.airborne.visibility import seen_from
from heliotrope.geometry import FloatArray, as_float, tangent_axes


@dataclass(frozen=True)
class Prospect:
    """The expected views of n mirrors in the photographs of K patterns.

    Attributes
    ----------
    reflections
        Expected number of reflections on the visible part of each mirror, (K, n).
    side
        Square root of each mirror's area in a photograph, px, (K, n).
    """

    reflections: FloatArray
    side: FloatArray

    def take(self, rows: npt.ArrayLike) -> "Prospect":
        """Return the views of some patterns."""
        index = np.asarray(rows)
        return Prospect(self.reflections[index], self.side[index])


def prospect(
    mirrors: HoverMirrors,
    rows: npt.NDArray[np.intp],
    facing: Facing,
    points: FloatArray,
    sampling: Sampling,
) -> Prospect:
    """Return the expected views of mirrors ``rows`` (n,) from patterns around ``points`` (K, 3).

    ``facing`` are the poses of the mirrors, batch shape (K, n). Mirrors of other clusters are not
    considered, because they are in other poses, or moving.
    """
    corners = mirrors.corners[rows]
    facets = np.isfinite(corners[:, :, 0, 0]).sum(axis=1)
    low, high = np.nanmin(corners, axis=(1, 2)), np.nanmax(corners, axis=(1, 2))
    pick = np.array([(0, 1), (1, 1), (1, 0), (0, 0)])
    both = np.stack([low, high], axis=1)
    outline = np.stack([both[:, pick[:, 0], 0], both[:, pick[:, 1], 1]], axis=-1)
    outline = np.pad(outline, ((0, 0), (0, 0), (0, 1)))
    names = tuple(mirrors.names[i] for i in rows.tolist())
    reflections, sides = np.zeros((2, len(points), len(rows)))
    for k, point in enumerate(as_float(points)):
        normal, vertex = facing.normal[k], facing.vertex[k]
        axes = tangent_axes(normal)
        turned = np.stack([-axes[:, 0], axes[:, 1], normal], axis=-1)
        visibility = seen_from(MirrorPoses(names, vertex, turned, outline), point, sampling.camera)
        slant = np.linalg.norm(point - vertex, axis=-1)
        _, samples = spacing(mirrors.facet_area[rows], slant, sampling)
        reflections[k], sides[k] = samples * facets * visibility.share, visibility.side
    return Prospect(np.where(facing.able, reflections, 0.0), sides)
