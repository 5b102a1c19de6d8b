"""Clusters: heliostats that are measured from one hover pattern.

Clusters have equal ground areas and are as compact as that allows, as HelioPoint requires. They are
the cells of a power diagram, which among all partitions into given areas have the smallest sum of
squared distances from their centres (Aurenhammer, Hoffmann & Aronov 1998).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, as_vectors

#: Areas are counted in squares; the ground of an average heliostat has this many. (GEOS's Voronoi
#: cells fail with a TopologyException on radial fields of 10,000 heliostats.)
_SQUARES = 16
#: Ground farther than this from every heliostat, in typical spacings, is not part of the field.
_EDGE = 0.8
#: Minimum number of iterations, after which the cells are round, and maximum number.
_SETTLED, _ROUNDS = 60, 200
#: Areas count as equal if none differs from the mean by more than this fraction.
_EVEN = 0.02


@dataclass(frozen=True)
class HeliostatClusters:
    """A partition of N heliostats into K clusters.

    Attributes
    ----------
    of
        Cluster index of each heliostat, 0 … K − 1, (N,).
    center
        Mean position, ENU metres, (K, 3).
    area
        Ground area occupied by the heliostats, m², (K,).
    radius
        Largest horizontal distance of a heliostat from the centre, m, (K,).
    roundness
        Mean squared distance from the centre of a disc with the same area, divided by that of the
        heliostats, (K,). It is 1 for a disc, 0.95 for a square and 0.6 for a 1:3 rectangle.
    """

    of: npt.NDArray[np.intp]
    center: FloatArray
    area: FloatArray
    radius: FloatArray
    roundness: FloatArray

    def __len__(self) -> int:
        return len(self.center)

    def rows(self, cluster: int) -> npt.NDArray[np.intp]:
        """Return the indices of the heliostats in one cluster."""
        return np.flatnonzero(self.of == cluster)


def ground_areas(position: npt.ArrayLike) -> FloatArray:
    """Return the area of ground nearest to each heliostat, m², (N,).

    Parameters
    ----------
    position
        ENU metres, (N, 3).

    Notes
    -----
    The area is that of the Voronoi cell, without ground that is farther than 0.8 typical spacings
    from every heliostat. It is counted in squares, and accurate to a few per cent.
    """
    flat = _flat(position)
    if len(flat) == 1:
        return np.ones(1)
    tree = cKDTree(flat)
    near = np.asarray(tree.query(flat, k=min(5, len(flat)))[0])[:, 1:]
    spacing = float(np.median(near.mean(axis=1)))
    if spacing <= 0.0:
        raise InputError("clusters: most heliostats have the same position")
    side = spacing / np.sqrt(_SQUARES)
    low, high = flat.min(axis=0) - spacing, flat.max(axis=0) + spacing
    counts = np.ceil((high - low) / side).astype(np.int64)
    while counts.prod() > max(100_000, 4 * _SQUARES * len(flat)):
        # Distant outlying heliostats would make the grid too large, so the squares are enlarged.
        side *= 2.0
        counts = np.ceil((high - low) / side).astype(np.int64)
    east, north = (low[k] + side * (np.arange(counts[k]) + 0.5) for k in (0, 1))
    squares = np.stack(np.meshgrid(east, north), axis=-1).reshape(-1, 2)
    nearest = tree.query(squares, distance_upper_bound=_EDGE * spacing)
    distance, owner = (np.asarray(part) for part in nearest)
    cells = np.bincount(owner[np.isfinite(distance)], minlength=len(flat))
    # Heliostats at the same position share a cell, but each needs a weight above 0.
    return np.asarray(np.maximum(cells, 1) * side**2)


def clusters(
    position: npt.ArrayLike, *, size: float = 100.0, max_radius: float = np.inf
) -> HeliostatClusters:
    """Return round clusters of equal area.

    Parameters
    ----------
    position
        Positions of the heliostats, ENU metres, (N, 3).
    size
        Diameter of a disc with the area of a cluster, m.
    max_radius
        Largest distance of a heliostat from the centre of its cluster, m. If necessary, clusters
        are made smaller than ``size`` to respect it.

    Raises
    ------
    InputError
        If there is no heliostat, or a size or radius is not above 0.
    """
    place = as_vectors(position, "position").reshape(-1, 3)
    if not len(place):
        raise InputError("clusters: there is no heliostat")
    for name, value in (("size", size), ("largest radius", max_radius)):
        if not value > 0.0:
            raise InputError(f"cluster {name} must be a length above 0, not {value:g} m")
    area = ground_areas(place)
    count = max(1, int(np.ceil(area.sum() / (0.25 * np.pi * size**2))))
    while True:
        described = _described(_partition(place[:, :2], area, min(count, len(place))), place, area)
        if count >= len(place) or described.radius.max() <= max_radius:
            return described
        count = max(count + 1, int(count * min(1.5, (described.radius.max() / max_radius) ** 2)))


def tour(center: npt.ArrayLike, start: npt.ArrayLike) -> npt.NDArray[np.intp]:
    """Return a short tour of places from ``start`` (nearest first, then 2-opt).

    Parameters
    ----------
    center
        Coordinates of the places, (K, M).
    start
        Start of the tour, (M,), which need not be its end.
    """
    points = np.asarray(center, dtype=np.float64)
    gap = np.linalg.norm(points[:, None] - points[None], axis=-1)
    first = np.linalg.norm(points - np.asarray(start, dtype=np.float64), axis=-1)
    order, remaining = [int(np.argmin(first))], set(range(len(points)))
    remaining.discard(order[0])
    while remaining:
        rest = sorted(remaining)
        order.append(rest[int(np.argmin(gap[order[-1], rest]))])
        remaining.discard(order[-1])
    path = np.array(order, dtype=np.intp)
    improved = len(path) > 2
    while improved:
        improved = False
        for i in range(len(path) - 1):
            ahead = path[i + 1 :]
            before = first[path[0]] if i == 0 else gap[path[i - 1], path[i]]
            enter = first[ahead] if i == 0 else gap[path[i - 1], ahead]
            after = np.append(gap[ahead[:-1], ahead[1:]], 0.0)
            leave = np.append(gap[path[i], ahead[1:]], 0.0)
            gain = before + after - enter - leave
            j = int(np.argmax(gain))
            if gain[j] > 1e-9:
                path[i : i + j + 2] = path[i : i + j + 2][::-1].copy()
                improved = True
    return path


def _flat(position: npt.ArrayLike) -> FloatArray:
    return np.ascontiguousarray(as_vectors(position, "position").reshape(-1, 3)[:, :2])


def _partition(flat: FloatArray, area: FloatArray, count: int) -> npt.NDArray[np.intp]:
    """Return the cell of each heliostat in a power diagram with ``count`` equal areas."""
    if count == 1:
        return np.zeros(len(flat), dtype=np.intp)
    order = _along_curve(flat)
    share = np.cumsum(area[order]) - 0.5 * area[order]
    of = np.empty(len(flat), dtype=np.intp)
    of[order] = np.minimum((share / area.sum() * count).astype(np.intp), count - 1)
    target, weight = area.sum() / count, np.zeros(count)
    flat = flat - flat.mean(axis=0)
    best, worst = of, np.inf
    for k in range(_ROUNDS):
        inside = np.bincount(of, weights=area, minlength=count)
        unequal = float(np.abs(inside / target - 1.0).max())
        # The pieces of the curve have equal areas from the start, but are long, so let them become
        # round.
        if k >= _SETTLED and unequal < worst and inside.min() > 0.0:
            best, worst = of, unequal
            if worst < _EVEN:
                break
        held = np.maximum(inside, 1e-9)
        center = np.stack(
            [np.bincount(of, weights=area * flat[:, d], minlength=count) / held for d in (0, 1)],
            axis=-1,
        )
        # A cell without heliostats restarts beside the fullest cell.
        center[inside <= 0.0] = center[int(np.argmax(inside))] + 1e-3
        # A weight is a squared radius, which grows with the missing area.
        weight += 0.5 * (target - inside) / np.pi
        weight -= weight.mean()
        # This is the squared distance minus the weight, without the terms that all cells share.
        power = (center**2).sum(axis=-1) - weight - 2.0 * flat @ center.T
        of = np.argmin(power, axis=1).astype(np.intp)
    return best


def _along_curve(flat: FloatArray) -> npt.NDArray[np.intp]:
    """Return the order along the Hilbert curve, which keeps neighbours together."""
    low = flat.min(axis=0)
    extent = max(float((flat.max(axis=0) - low).max()), 1e-9)
    bits = 16
    x, y = ((flat - low) / extent * (2**bits - 1)).astype(np.int64).T
    place = np.zeros(len(flat), dtype=np.int64)
    for step in (1 << b for b in range(bits - 1, -1, -1)):
        right, upper = ((x & step) > 0).astype(np.int64), ((y & step) > 0).astype(np.int64)
        place += step * step * ((3 * right) ^ upper)
        turn = upper == 0
        flip = turn & (right == 1)
        x, y = np.where(flip, step - 1 - x, x), np.where(flip, step - 1 - y, y)
        x, y = np.where(turn, y, x), np.where(turn, x, y)
    return np.argsort(place, kind="stable")


def _described(of: npt.NDArray[np.intp], place: FloatArray, area: FloatArray) -> HeliostatClusters:
    # Number the cells without gaps, in case a cell stayed empty.
    of = np.unique(of, return_inverse=True)[1].astype(np.intp)
    number = np.bincount(of)
    center = np.stack([np.bincount(of, weights=place[:, d]) / number for d in range(3)], axis=-1)
    away = np.linalg.norm(place[:, :2] - center[of, :2], axis=-1)
    whole = as_float(np.bincount(of, weights=area))
    radius = np.zeros(len(number))
    np.maximum.at(radius, of, away)
    spread = np.bincount(of, weights=area * away**2) / whole
    # Include the spread of each heliostat's own ground, so that the spread of a lone heliostat is
    # not 0.
    spread += np.bincount(of, weights=area**2) / whole / (2.0 * np.pi)
    return HeliostatClusters(of, center, whole, radius, whole / (2.0 * np.pi) / spread)
