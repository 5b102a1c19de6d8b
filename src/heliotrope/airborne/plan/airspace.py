"""Airspace: where a drone may fly, and the way around what it must not touch."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from heliotrope.errors import InputError
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver, Target
from heliotrope.geometry import FloatArray, as_float

#: Corners of the way around a corner of a keep-out.
_AROUND = 12
#: Ways around are looked for at multiples of this height, m.
_LEVEL = 5.0
#: A way that is longer than without keep-outs by less than this factor is good enough.
_SHORT = 1.1
#: Heights above ground are looked at in so many places of a leg.
_PLACES = 9
#: Nearer than this is on the fence, m.
_TOUCH = 1e-3


@dataclass(frozen=True)
class KeepOut:
    """A volume that no drone enters: all that is near a polygon, between two heights.

    Attributes
    ----------
    name
        For people.
    corners
        Of the polygon, in order, ENU metres east and north, (V, 2); one corner with a
        radius is a cylinder.
    radius
        All within this distance of the polygon belongs to it, m.
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
        who = f"keep-out {self.name}"
        if corners.ndim != 2 or corners.shape[1] != 2 or not np.isfinite(corners).all():
            raise InputError(f"{who}: corners of shape {corners.shape}; give finite (V, 2)")
        if len(corners) < 3 and not (len(corners) == 1 and self.radius > 0.0):
            raise InputError(
                f"{who}: {len(corners)} corners; give three or more, or one place and a radius"
            )
        if not self.radius >= 0.0:
            raise InputError(f"{who}: radius {self.radius} m must not be below 0")
        if not self.top > self.bottom:
            raise InputError(f"{who}: top {self.top} m must be above bottom {self.bottom} m")
        object.__setattr__(self, "corners", corners)

    @cached_property
    def _box(self) -> FloatArray:
        """Its lower and upper corner, (2, 3)."""
        low, high = self.corners.min(axis=0), self.corners.max(axis=0)
        r = self.radius
        return np.array([[*(low - r), self.bottom], [*(high + r), self.top]])

    def grown(self, margin: float) -> "KeepOut":
        """Return it with a margin on all sides."""
        return KeepOut(
            self.name, self.corners, self.radius + margin, self.bottom - margin, self.top + margin
        )

    def free(self, a: FloatArray, b: FloatArray) -> npt.NDArray[np.bool_]:
        """Return which straight legs from ``a`` to ``b``, (M, 3) each, stay outside."""
        low, high = np.minimum(a, b), np.maximum(a, b)
        apart = (high < self._box[0]) | (low > self._box[1])
        if apart.any(axis=1).all():
            return np.ones(len(a), dtype=np.bool_)
        rise = b[:, 2] - a[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(self.bottom - a[:, 2]) / rise, (self.top - a[:, 2]) / rise])
        level = np.abs(rise) < 1e-9
        inside = (a[:, 2] >= self.bottom) & (a[:, 2] <= self.top)
        first = np.where(level, np.where(inside, 0.0, 1.0), np.clip(ends.min(axis=0), 0.0, 1.0))
        last = np.where(level, np.where(inside, 1.0, 0.0), np.clip(ends.max(axis=0), 0.0, 1.0))
        touches = first < last
        way = b[:, :2] - a[:, :2]
        start, stop = a[:, :2] + first[:, None] * way, a[:, :2] + last[:, None] * way
        near = distance_to_polygon(start, stop, self.corners) <= self.radius
        return np.asarray(~(touches & near))


def tower(plant: Plant, clearance: float = 10.0) -> tuple[KeepOut, ...]:
    """Return one cylinder a receiver and target, from the ground to ``clearance`` m above it."""
    found = []
    surfaces: list[Receiver | Target] = [*plant.receivers, *plant.targets]
    for surface in surfaces:
        half = 0.5 * float(np.hypot(surface.width, surface.height))
        found.append(
            KeepOut(
                surface.name,
                surface.center[None, :2],
                half + clearance,
                top=float(surface.center[2]) + 0.5 * surface.height + clearance,
            )
        )
    return tuple(found)


@dataclass(frozen=True)
class Airspace:
    """Where drones may fly.

    Attributes
    ----------
    keep_outs
        Volumes to stay out of.
    fence
        Polygon to stay inside of, ENU metres east and north, (V, 2); None for none.
    min_height, max_height
        Above the ground while measuring and under way, m. Rules for drones limit the
        greater one, in the European Union's open category to 120 m.
    margin
        Distance to all keep-outs, m.
    ground
        Places whose height is known, ENU metres, (N, 3); the nearest one counts. Level
        at 0 where there are none.
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
                f"heights {self.min_height:g} m to {self.max_height:g} m: the least must be 0 or "
                "more, and the greatest above it"
            )
        if not self.margin >= 0.0:
            raise InputError(f"margin {self.margin} m must not be below 0")
        if self.fence is not None:
            fence = as_float(self.fence)
            if fence.ndim != 2 or fence.shape[-1] != 2 or len(fence) < 3:
                raise InputError(
                    f"fence of shape {fence.shape}: give three corners or more, (V, 2)"
                )
            object.__setattr__(self, "fence", fence)

    @cached_property
    def _volumes(self) -> tuple[KeepOut, ...]:
        return tuple(k.grown(self.margin) for k in self.keep_outs)

    @cached_property
    def _tree(self) -> cKDTree | None:
        return cKDTree(self.ground[:, :2]) if len(self.ground) else None

    @cached_property
    def _level(self) -> float | None:
        """The height of level ground, which needs no search."""
        if not len(self.ground):
            return 0.0
        return float(self.ground[0, 2]) if np.ptp(self.ground[:, 2]) == 0.0 else None

    def ground_below(self, points: FloatArray) -> FloatArray:
        """Return the height of the ground below points (M, 3), m, (M,)."""
        if self._level is not None:
            return np.full(len(points), self._level)
        assert self._tree is not None
        return as_float(self.ground[self._tree.query(points[:, :2])[1], 2])

    def free(self, points: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Return which points (M, 3) a drone may be at, (M,)."""
        p = as_float(points).reshape(-1, 3)
        height = p[:, 2] - self.ground_below(p)
        # Rounding must not refuse a point at the limit.
        found = (height >= self.min_height - 1e-6) & (height <= self.max_height + 1e-6)
        if self.fence is not None:
            found &= within(p[:, :2], p[:, :2], self.fence)
        for volume in self._volumes:
            found &= volume.free(p, p + np.array([0.0, 0.0, 1e-6]))
        return np.asarray(found)

    def free_legs(self, a: npt.ArrayLike, b: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Return which straight legs from ``a`` to ``b``, (M, 3) each, may be flown, (M,).

        Climbs from the ground and down to it are free below the least height.
        """
        p, q = as_float(a).reshape(-1, 3), as_float(b).reshape(-1, 3)
        found = np.ones(len(p), dtype=np.bool_)
        if not len(p):
            return found
        steep = np.linalg.norm((q - p)[:, :2], axis=-1) < 1e-6
        share = np.linspace(0.0, 1.0, _PLACES)[:, None, None]
        place = (p + (q - p) * share).reshape(-1, 3)
        height = (place[:, 2] - self.ground_below(place)).reshape(_PLACES, -1)
        found &= height.max(axis=0) <= self.max_height + 1e-6
        found &= steep | (height.min(axis=0) >= self.min_height - 1e-6)
        if self.fence is not None:
            found &= within(p[:, :2], q[:, :2], self.fence)
        for volume in self._volumes:
            found &= volume.free(p, q)
        return np.asarray(found)

    def route(self, a: npt.ArrayLike, b: npt.ArrayLike) -> FloatArray | None:
        """Return the points between ``a`` and ``b`` on a short free way, (M, 3).

        None if there is no way. It is straight where that is free, else at one height
        (that of the higher end or above all keep-outs) around their corners.
        """
        start, stop = as_float(a), as_float(b)
        if self.free_legs(start[None], stop[None])[0]:
            return np.empty((0, 3))
        floor = float(self.ground_below(np.stack([start, stop])).max()) + self.min_height
        base = np.ceil(max(start[2], stop[2], floor) / _LEVEL) * _LEVEL
        levels = {max(start[2], stop[2], floor), base}
        levels |= {v.top + 1e-3 for v in self._volumes if v.top > base and np.isfinite(v.top)}
        # What the way at one height would be without anything to avoid.
        climb = float(np.linalg.norm((stop - start)[:2])) + 2.0 * base - start[2] - stop[2]
        best, least = None, np.inf
        for level in sorted(levels):
            way = self._around(start, stop, float(level))
            if way is not None:
                length = path_length(np.vstack([start, way, stop]))
                if length < least:
                    best, least = way, length
                if length < _SHORT * climb:
                    break
        return best

    def _around(self, start: FloatArray, stop: FloatArray, level: float) -> FloatArray | None:
        """The way at one height, with the climbs at both ends."""
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
        way = [1]
        while way[-1] != 0:
            way.append(int(before[0, way[-1]]))
        found = points[way[::-1]]
        # Climbs of no length are no points of their own.
        keep = [
            k
            for k, p in enumerate(found)
            if (k > 0 or not np.allclose(p, start))
            and (k < len(found) - 1 or not np.allclose(p, stop))
        ]
        return as_float(found[keep].reshape(-1, 3))

    def _graph(self, level: float) -> tuple[FloatArray, FloatArray]:
        """Corners of ways around at a height (M, 3), and lengths of free legs (M, M), 0 if none."""
        if level not in self._graphs:
            nodes = np.array([(*c, level) for c in self._corners]).reshape(-1, 3)
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
    def _corners(self) -> list[FloatArray]:
        angle = 2.0 * np.pi * np.arange(_AROUND) / _AROUND
        ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        rings = [(v.corners, v.radius / np.cos(np.pi / _AROUND) + 0.5) for v in self._volumes]
        if self.fence is not None:
            rings.append((self.fence, 1.0))
        return [c + radius * r for corners, radius in rings for c in corners for r in ring]


def path_length(points: FloatArray) -> float:
    """Return the length of the way through points (M, 3), m."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=-1).sum())


def inside(points: npt.ArrayLike, corners: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """Return which points (M, 2) lie in a polygon (V, 2), by the even-odd rule, (M,)."""
    p, a = as_float(points).reshape(-1, 2), as_float(corners)
    b = np.roll(a, -1, axis=0)
    over = (a[:, 1] > p[:, 1, None]) != (b[:, 1] > p[:, 1, None])
    with np.errstate(divide="ignore", invalid="ignore"):
        east = a[:, 0] + (p[:, 1, None] - a[:, 1]) * (b[:, 0] - a[:, 0]) / (b[:, 1] - a[:, 1])
    return np.asarray(np.count_nonzero(over & (p[:, 0, None] < east), axis=1) % 2 == 1)


def within(start: FloatArray, stop: FloatArray, corners: FloatArray) -> npt.NDArray[np.bool_]:
    """Return which segments (M, 2) to (M, 2) lie in a polygon (V, 2) and touch no edge, (M,)."""
    clear = _to_edges(start, stop, corners) > _TOUCH
    return np.asarray(inside(start, corners) & clear & ~crosses(start, stop, corners))


def crosses(start: FloatArray, stop: FloatArray, corners: FloatArray) -> npt.NDArray[np.bool_]:
    """Return which segments (M, 2) to (M, 2) cross an edge of a polygon (V, 2), (M,)."""
    a, b = corners, np.roll(corners, -1, axis=0)

    def side(p: FloatArray, q: FloatArray, r: FloatArray) -> FloatArray:
        return np.asarray(
            (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1])
            - (q[..., 1] - p[..., 1]) * (r[..., 0] - p[..., 0])
        )

    s, t = start[:, None], stop[:, None]
    apart = (side(s, t, a) * side(s, t, b) < 0.0) & (side(a, b, s) * side(a, b, t) < 0.0)
    return np.asarray(apart.any(axis=1))


def distance_to_polygon(start: FloatArray, stop: FloatArray, corners: FloatArray) -> FloatArray:
    """Return the distance of segments (M, 2) to (M, 2) from a filled polygon (V, 2), m, (M,)."""
    near = _to_edges(start, stop, corners)
    if len(corners) >= 3:
        near[inside(start, corners) | crosses(start, stop, corners)] = 0.0
    return near


def _to_edges(start: FloatArray, stop: FloatArray, corners: FloatArray) -> FloatArray:
    """Distance of segments from the edges of a polygon that they do not cross, m, (M,)."""
    a, b = corners, np.roll(corners, -1, axis=0)
    parts = (
        _to_segment(start[:, None], a, b),
        _to_segment(stop[:, None], a, b),
        _to_segment(a, start[:, None], stop[:, None]),
    )
    return np.asarray(np.minimum.reduce([part.min(axis=1) for part in parts]))


def _to_segment(point: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """Distance of points from segments, all (..., 2)."""
    way = b - a
    square = np.maximum((way**2).sum(axis=-1), 1e-18)
    along = np.clip(((point - a) * way).sum(axis=-1) / square, 0.0, 1.0)
    return np.asarray(np.linalg.norm(point - a - along[..., None] * way, axis=-1))
