"""Shading and blocking by neighbours, and how far they shift the centroid of a beam.

A neighbour shades an element of a mirror if it stands between the element and the sun, and blocks
it if it stands in the path of the reflected ray. The unobstructed part of the mirror has a
different centre. The beam of a flat mirror shifts by the same amount. The beam of a mirror focused
on the target hardly shifts while light arrives along the axis; at oblique incidence, where the
mirror is astigmatic, the beam shifts by a fraction of that amount.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from heliotrope.field.heliostats import Facets
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, reflect, tangent_axes
from heliotrope.optics.mirror_surface import elements_of, mirror_axes

#: Neighbours that can shade or block a mirror.
NEAREST = 12
#: Room about a mirror for its curvature and for rays that are not parallel, as a share of its size.
_ROOM = 0.1


def nearest(places: FloatArray, count: int = NEAREST) -> npt.NDArray[np.intp]:
    """Return the indices of the J nearest neighbours of each position (N, 3), (N, J)."""
    most = min(count + 1, len(places))
    neighbours = np.asarray(cKDTree(places).query(places, k=most)[1]).reshape(len(places), most)
    return np.asarray(neighbours[:, 1:], dtype=np.intp)


@dataclass(frozen=True)
class Neighbours:
    """J flat mirrors beside another mirror; their upper edges are level.

    Attributes
    ----------
    center, normal
        ENU metres, and unit vectors, (J, 3).
    width, height
        m, (J,).
    """

    center: FloatArray
    normal: FloatArray
    width: FloatArray
    height: FloatArray

    def hide(self, points: FloatArray, way: FloatArray) -> npt.NDArray[np.bool_]:
        """Return a mask of the points whose ray the neighbours obstruct, (E,).

        Parameters
        ----------
        points
            ENU metres, (E, 3).
        way
            Unit vector, (3,) or (E, 3): to the sun for shading, along the ray for blocking.
        """
        if not len(self.center):
            return np.zeros(len(points), dtype=np.bool_)
        ray = np.broadcast_to(way, points.shape)
        steep = ray @ self.normal.T
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (np.sum(self.center * self.normal, axis=1) - points @ self.normal.T) / steep
        met = points[:, None, :] + along[..., None] * ray[:, None, :] - self.center
        across = np.abs(np.einsum("ejc,jac->eja", met, tangent_axes(self.normal)))
        half = 0.5 * np.stack([self.width, self.height], axis=-1)
        # Parallel rays result in infinities or NaN, which lie within no bounds.
        within = (across <= half).all(axis=-1) & (along > 0.0)
        return np.asarray(within.any(axis=1))

    def of(self, chosen: npt.NDArray[np.bool_]) -> "Neighbours":
        """Return the selected neighbours, (J,)."""
        return Neighbours(
            self.center[chosen], self.normal[chosen], self.width[chosen], self.height[chosen]
        )

    def before(
        self, center: FloatArray, normal: FloatArray, size: tuple[float, float], *ways: FloatArray
    ) -> npt.NDArray[np.bool_]:
        """Return a mask of the neighbours that may hide part of a mirror, (J,), by a quick check.

        The neighbours' corners are projected into the mirror plane, where their bounding boxes must
        overlap the mirror's.

        Parameters
        ----------
        center, normal
            Centre of the mirror, ENU metres, and its unit normal, (3,).
        size
            Width and height of the mirror, m.
        ways
            Unit vectors to the sun and to the target, (3,) each.
        """
        axes = tangent_axes(self.normal)
        half = 0.5 * np.stack([self.width, self.height], axis=-1)
        signs = np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)], dtype=np.float64)
        corners = self.center[:, None] + np.einsum("ka,ja,jac->jkc", signs, half, axes) - center
        height = corners @ normal
        room = (0.5 + _ROOM) * np.array(size)
        hides = np.zeros(len(self.center), dtype=np.bool_)
        for direction in ways:
            along = height / max(float(direction @ normal), 1e-6)
            plane = (corners - along[..., None] * direction) @ tangent_axes(normal).T
            low, high = plane.min(axis=1), plane.max(axis=1)
            touches = (low <= room).all(axis=-1) & (high >= -room).all(axis=-1)
            hides |= touches & (height > 0.0).any(axis=-1)
        return hides


@dataclass(frozen=True)
class CentroidShift:
    """The effect of neighbours on one beam.

    Attributes
    ----------
    shift
        Centroid with neighbours minus centroid without, right and up on the target plane, m, (2,);
        NaN if they hide the whole mirror.
    shaded, blocked, hidden
        Fractions of the mirror area that are shaded, blocked on the way to the target, and either
        of the two.
    """

    shift: FloatArray
    shaded: float
    blocked: float
    hidden: float


def centroid_shift(
    target: Target,
    center: FloatArray,
    sun: FloatArray,
    normal: FloatArray,
    facets: Facets,
    neighbours: Neighbours,
    *,
    facet_focal: float = np.inf,
    elements: int = 12,
) -> CentroidShift:
    """Return how far neighbours shift the centroid of a beam.

    Parameters
    ----------
    target
        The target; the beam falls on its plane.
    center, normal
        Centre of the mirror, ENU metres, and its unit normal, (3,).
    sun
        Unit vector to the sun, (3,).
    facets
        Facets of one heliostat, with their actual tilts.
    neighbours
        Mirrors that may shade or block this mirror.
    facet_focal
        Focal length of each facet's own curvature, m.
    elements
        Each facet is divided into the square of this number of elements.

    Notes
    -----
    The shift is that of the central rays, because sun shape and slope errors widen the beam without
    shifting it. The centroid includes all light, on the target or beside it.
    """
    R = mirror_axes(normal)
    points, normals, areas = elements_of(facets, facet_focal, elements)
    points, normals = center + points @ R.T, normals @ R.T
    rays = reflect(sun, normals)
    plane = target.plane_coordinates(target.intersect(points, rays))
    power = areas * np.maximum(normals @ sun, 0.0)
    shaded, blocked = neighbours.hide(points, sun), neighbours.hide(points, rays)
    remaining = power * ~(shaded | blocked)
    shift = np.full(2, np.nan)
    if remaining.any():
        shift = remaining @ plane / remaining.sum() - power @ plane / power.sum()
    shares = [float(areas @ mask / areas.sum()) for mask in (shaded, blocked, shaded | blocked)]
    return CentroidShift(shift, *shares)
