"""Airspace: where a drone may fly, and routes around obstacles.

Horizontal distances and containment are computed with shapely; heights are clipped in this module.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt
import shapely
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from shapely import Geometry, Point, Polygon

from heliotrope.errors import InputError
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver, Target
from heliotrope.geometry import FloatArray, as_float

Mask = npt.NDArray[np.bool_]

#: Segments of a quarter circle in a route around a corner.
_QUARTER = 3
#: Detours run this far outside a keep-out volume, and this far inside the fence, m.
_OUTSIDE, _INSIDE = 0.5, 1.0
#: Detours are tried at multiples of this height, m.
_LEVEL = 5.0
#: A detour is accepted at once if it is longer than the unobstructed route by less than this
#: factor.
_SHORT = 1.1
#: Number of points of a leg at which the height above ground is checked.
_CHECKS = 9
#: A leg closer to the fence than this counts as touching it, m.
_TOUCH = 1e-3


@dataclass(frozen=True)
class KeepOut:
    """A volume that no drone may enter: everything near a polygon, between two heights.

    Attributes
    ----------
    name
        Display name.
    corners
        Corners of the polygon, in order, ENU metres east and north, (V, 2); a single corner with a
        radius is a cylinder.
    radius
        Everything within this distance of the polygon belongs to the volume, m.
    bottom, top
        ENU heights, m.
    """

    name: str
    corners: FloatArray
    radius: float = 0.0
    bottom: float = -np.inf
    top: float = np.inf

    def __post_init__(self) -> None:
        corners = as_float(self.corners)
        what = f"keep-out {self.name}"
        if corners.ndim != 2 or corners.shape[1] != 2 or not np.isfinite(corners).all():
            raise InputError(
                f"{what}: corners have the shape {corners.shape}; specify finite corners, (V, 2)"
            )
        if len(corners) < 3 and not (len(corners) == 1 and self.radius > 0.0):
            raise InputError(
                f"{what}: {len(corners)} corners; specify three or more, or one position and a "
                "radius"
            )
        if not self.radius >= 0.0:
            raise InputError(f"{what}: radius must be 0 or more, not {self.radius} m")
        if not self.top > self.bottom:
            raise InputError(f"{what}: top ({self.top} m) must be above bottom ({self.bottom} m)")
        if len(corners) > 1:
            _polygon(corners, what)
        object.__setattr__(self, "corners", corners)

    @cached_property
    def shape(self) -> Geometry:
        """The point or filled polygon on the ground from which `radius` is measured."""
        shape = Point(self.corners[0]) if len(self.corners) == 1 else Polygon(self.corners)
        shapely.prepare(shape)
        return shape

    @cached_property
    def _box(self) -> FloatArray:
        """Lower and upper corner of the bounding box, (2, 3)."""
        low, high = self.corners.min(axis=0), self.corners.max(axis=0)
        r = self.radius
        return np.array([[*(low - r), self.bottom], [*(high + r), self.top]])

    def grown(self, margin: float) -> "KeepOut":
        """Return the volume with a margin on all sides."""
        return KeepOut(
            self.name, self.corners, self.radius + margin, self.bottom - margin, self.top + margin
        )

    def free(self, a: FloatArray, b: FloatArray) -> Mask:
        """Return a mask, (M,), of the legs from ``a`` to ``b``, (M, 3), that stay outside."""
        free = np.ones(len(a), dtype=np.bool_)
        low, high = np.minimum(a, b), np.maximum(a, b)
        near = np.flatnonzero(~((high < self._box[0]) | (low > self._box[1])).any(axis=1))
        if not len(near):
            return free
        a, b = a[near], b[near]
        # The part of each leg between bottom and top, as fractions of its length.
        rise = b[:, 2] - a[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(self.bottom - a[:, 2]) / rise, (self.top - a[:, 2]) / rise])
        level = np.abs(rise) < 1e-9
        inside = (a[:, 2] >= self.bottom) & (a[:, 2] <= self.top)
        first = np.where(level, np.where(inside, 0.0, 1.0), np.clip(ends.min(axis=0), 0.0, 1.0))
        last = np.where(level, np.where(inside, 1.0, 0.0), np.clip(ends.max(axis=0), 0.0, 1.0))
        path = b[:, :2] - a[:, :2]
        legs = _legs(a[:, :2] + first[:, None] * path, a[:, :2] + last[:, None] * path)
        free[near] = (first >= last) | (shapely.distance(self.shape, legs) > self.radius)
        return free


def tower(plant: Plant, clearance: float = 10.0) -> tuple[KeepOut, ...]:
    """Return a keep-out cylinder from the ground up for each receiver and target."""
    volumes = []
    surfaces: list[Receiver | Target] = [*plant.receivers, *plant.targets]
    for surface in surfaces:
        half = 0.5 * float(np.hypot(surface.width, surface.height))
        volumes.append(
            KeepOut(
                surface.name,
                surface.center[None, :2],
                half + clearance,
                top=float(surface.center[2]) + 0.5 * surface.height + clearance,
            )
        )
    return tuple(volumes)


@dataclass(frozen=True)
class Airspace:
    """Where drones may fly.

    Attributes
    ----------
    keep_outs
        Volumes that drones must avoid.
    fence
        Polygon in which drones must stay, ENU metres east and north, (V, 2); None for no fence.
    min_height, max_height
        Minimum and maximum height above ground while measuring and in transit, m. Aviation law
        limits the maximum, to 120 m in the European Union's open category.
    margin
        Margin around all keep-out volumes, m.
    ground
        Points of known ground height, ENU metres, (N, 3); the nearest point determines the height.
        Without points the ground is assumed to be level at 0.
    """

    keep_outs: tuple[KeepOut, ...] = ()
    fence: FloatArray | None = None
    min_height: float = 15.0
    max_height: float = 120.0
    margin: float = 5.0
    ground: FloatArray = field(default_factory=lambda: np.empty((0, 3)))

    def __post_init__(self) -> None:
        if not 0.0 <= self.min_height < self.max_height:
            raise InputError(
                f"heights {self.min_height:g} m to {self.max_height:g} m: the lower one must be 0 "
                "or more and below the upper one"
            )
        if not self.margin >= 0.0:
            raise InputError(f"margin must be 0 or more, not {self.margin} m")
        if self.fence is not None:
            fence = as_float(self.fence)
            if fence.ndim != 2 or fence.shape[-1] != 2 or len(fence) < 3:
                raise InputError(
                    f"fence of shape {fence.shape}: specify three corners or more, (V, 2)"
                )
            _polygon(fence, "fence")
            object.__setattr__(self, "fence", fence)

    @cached_property
    def _volumes(self) -> tuple[KeepOut, ...]:
        return tuple(k.grown(self.margin) for k in self.keep_outs)

    @cached_property
    def _fenced(self) -> Polygon | None:
        if self.fence is None:
            return None
        polygon = Polygon(self.fence)
        shapely.prepare(polygon)
        return polygon

    @cached_property
    def _tree(self) -> cKDTree | None:
        return cKDTree(self.ground[:, :2]) if len(self.ground) else None

    @cached_property
    def _level(self) -> float | None:
        """Height of level ground, which needs no search; None if the ground is not level."""
        if not len(self.ground):
            return 0.0
        return float(self.ground[0, 2]) if np.ptp(self.ground[:, 2]) == 0.0 else None

    def ground_below(self, points: FloatArray) -> FloatArray:
        """Return the height of the ground below points (M, 3), m, (M,)."""
        if self._level is not None:
            return np.full(len(points), self._level)
        assert self._tree is not None
        return as_float(self.ground[self._tree.query(points[:, :2])[1], 2])

    def free(self, points: npt.ArrayLike) -> Mask:
        """Return a mask, (M,), of the points (M, 3) where a drone may be."""
        p = as_float(points).reshape(-1, 3)
        height = p[:, 2] - self.ground_below(p)
        # Rounding must not refuse a point at the limit.
        free = (height >= self.min_height - 1e-6) & (height <= self.max_height + 1e-6)
        free &= self._within_fence(p, p)
        for volume in self._volumes:
            free &= volume.free(p, p + np.array([0.0, 0.0, 1e-6]))
        return np.asarray(free)

    def free_legs(self, a: npt.ArrayLike, b: npt.ArrayLike) -> Mask:
        """Return a mask, (M,), of the free straight legs from ``a`` (M, 3) to ``b`` (M, 3).

        Vertical climbs and descents may start or end below the lower height limit.
        """
        p, q = as_float(a).reshape(-1, 3), as_float(b).reshape(-1, 3)
        free = np.ones(len(p), dtype=np.bool_)
        if not len(p):
            return free
        steep = np.linalg.norm((q - p)[:, :2], axis=-1) < 1e-6
        share = np.linspace(0.0, 1.0, _CHECKS)[:, None, None]
        place = (p + (q - p) * share).reshape(-1, 3)
        height = (place[:, 2] - self.ground_below(place)).reshape(_CHECKS, -1)
        free &= height.max(axis=0) <= self.max_height + 1e-6
        free &= steep | (height.min(axis=0) >= self.min_height - 1e-6)
        free &= self._within_fence(p, q)
        for volume in self._volumes:
            free &= volume.free(p, q)
        return np.asarray(free)

    def _within_fence(self, a: FloatArray, b: FloatArray) -> Mask:
        fence = self._fenced
        if fence is None:
            return np.ones(len(a), dtype=np.bool_)
        legs = _legs(a[:, :2], b[:, :2])
        clear = shapely.distance(fence.exterior, legs) > _TOUCH
        return np.asarray(shapely.covers(fence, legs) & clear)

    def route(self, a: npt.ArrayLike, b: npt.ArrayLike) -> FloatArray | None:
        """Return the intermediate points on a short free route from ``a`` to ``b``, (M, 3).

        The result is None if there is no route. The route is straight if the straight leg is free.
        Otherwise it runs around the corners of keep-out volumes at a constant height, which is that
        of the higher end or a height above a keep-out volume.
        """
        start, stop = as_float(a), as_float(b)
        if self.free_legs(start[None], stop[None])[0]:
            return np.empty((0, 3))
        floor = float(self.ground_below(np.stack([start, stop])).max()) + self.min_height
        base = np.ceil(max(start[2], stop[2], floor) / _LEVEL) * _LEVEL
        levels = {max(start[2], stop[2], floor), base}
        levels |= {v.top + 1e-3 for v in self._volumes if v.top > base and np.isfinite(v.top)}
        # Length of an unobstructed route at the base height.
        climb = float(np.linalg.norm((stop - start)[:2])) + 2.0 * base - start[2] - stop[2]
        best, least = None, np.inf
        for level in sorted(levels):
            path = self._around(start, stop, float(level))
            if path is not None:
                length = path_length(np.vstack([start, path, stop]))
                if length < least:
                    best, least = path, length
                if length < _SHORT * climb:
                    break
        return best

    def _around(self, start: FloatArray, stop: FloatArray, level: float) -> FloatArray | None:
        """Return the route at one height, with the climbs at both ends."""
        up = np.array([[*start[:2], level], [*stop[:2], level]])
        if not self.free_legs(np.stack([start, up[1]]), np.stack([up[0], stop])).all():
            return None
        nodes, lengths = self._graph(level)
        points = np.vstack([up, nodes])
        count = len(points)
        i, j = np.repeat([0, 1], count), np.tile(np.arange(count), 2)
        free = self.free_legs(points[i], points[j]) & (i != j)
        table = np.zeros((count, count))
        table[2:, 2:] = lengths
        gap = np.linalg.norm(points[i] - points[j], axis=-1)
        table[i[free], j[free]] = table[j[free], i[free]] = np.maximum(gap[free], 1e-9)
        distance, before = dijkstra(
            csr_matrix(table), indices=np.zeros(1, np.int32), return_predecessors=True
        )
        if not np.isfinite(distance[0, 1]):
            return None
        order = [1]
        while order[-1] != 0:
            order.append(int(before[0, order[-1]]))
        route = points[order[::-1]]
        # Climbs of zero length add no point.
        keep = [
            k
            for k, p in enumerate(route)
            if (k > 0 or not np.allclose(p, start))
            and (k < len(route) - 1 or not np.allclose(p, stop))
        ]
        return as_float(route[keep].reshape(-1, 3))

    def _graph(self, level: float) -> tuple[FloatArray, FloatArray]:
        """Return detour corners at a height, (M, 3), and lengths of free legs, (M, M), else 0."""
        if level not in self._graphs:
            corners = self._corners
            nodes = np.column_stack([corners, np.full(len(corners), level)])
            nodes = nodes[self.free(nodes)]
            i, j = np.triu_indices(len(nodes), 1)
            free = self.free_legs(nodes[i], nodes[j])
            lengths = np.zeros((len(nodes), len(nodes)))
            gap = np.linalg.norm(nodes[i[free]] - nodes[j[free]], axis=-1)
            lengths[i[free], j[free]] = lengths[j[free], i[free]] = np.maximum(gap, 1e-9)
            self._graphs[level] = nodes, lengths
        return self._graphs[level]

    @cached_property
    def _graphs(self) -> dict[float, tuple[FloatArray, FloatArray]]:
        return {}

    @cached_property
    def _corners(self) -> FloatArray:
        """Return the corners at which detours turn, (C, 2)."""
        # The chords of the arc around a corner must clear the radius.
        wide = 1.0 / np.cos(0.25 * np.pi / _QUARTER)
        rings = [
            v.shape.buffer(v.radius * wide + _OUTSIDE, quad_segs=_QUARTER) for v in self._volumes
        ]
        if self._fenced is not None:
            rings.append(self._fenced.buffer(-_INSIDE, join_style="mitre"))
        return as_float(shapely.get_coordinates(rings))


def path_length(points: FloatArray) -> float:
    """Return the length of the path through points (M, 3), m."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=-1).sum())


def _polygon(corners: FloatArray, what: str) -> None:
    """Raise an error if a polygon encloses no area or its edges cross."""
    polygon = Polygon(corners)
    if not polygon.is_valid or polygon.area <= 0.0:
        raise InputError(
            f"{what}: its edges cross or enclose no area ({shapely.is_valid_reason(polygon)}); "
            "list the corners in order around the area"
        )


def _legs(a: FloatArray, b: FloatArray) -> npt.NDArray[np.object_]:
    """Return lines on the ground from ``a`` to ``b``, (M, 2); a point where the two coincide."""
    lines = np.atleast_1d(shapely.linestrings(np.stack([a, b], axis=1)))
    same = (a == b).all(axis=1)
    lines[same] = shapely.points(a[same])
    return lines
