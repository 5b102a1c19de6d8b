r"""Shading and blocking: which part of each mirror sees the sun, and its aim.

The outlines of the mirrors (and towers) in front are projected along the rays into the mirror
plane, and subtracted from the mirror as convex polygons (Sutherland and Hodgman 1974,
Communications of the ACM 17, 32). Overlapping areas are therefore counted exactly once, and the
number of occluders is unlimited. For shading the rays are parallel; for blocking, the rays of a
curved or canted mirror converge:

$$d(x, y) = d_0 + 2 (δn·s) n + 2 (n·s) δn, \qquad δn = -(x, y) / 2f.$$

Neglected: the size of the sun and the slope errors, which blur the edges of a shadow but preserve
its area (checked by ray tracing on 11,915 mirrors: 0.0003 of the field's light), and the sagitta of
the mirrors.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from heliotrope.geometry import FloatArray, as_float, reflect
from heliotrope.jit import as_input
from heliotrope.optics import _clip_kernels as kernels
from heliotrope.optics.scene import Mirrors, Scene
from heliotrope.parallel import run_blocks

#: Neighbours that can shade or block a mirror.
NEAREST = 12
IntArray = npt.NDArray[np.int64]
#: Allowance for the displacement of a vertex when its mirror moves, m; beyond it the grid is
#: rebuilt.
SLACK = 0.5
#: The aim itself and objects that touch it hide nothing, so this fraction of the path is ignored.
_BEFORE = 1e-3


@dataclass(frozen=True, eq=False)
class Lit:
    """The unobstructed part of each mirror.

    Attributes
    ----------
    shading, blocking, both
        Fractions of the mirror's area that are not shaded, not blocked, and neither, (H,).
    moments
        Moments of the lit area of each part of a mirror: area, centroid (x, y) and covariance (xx,
        xy, yy) in the mirror's axes, m² and m, (P, 6).
    begin
        Index in ``moments`` at which each mirror's parts begin, (H + 1,).
    """

    shading: FloatArray
    blocking: FloatArray
    both: FloatArray
    moments: FloatArray
    begin: IntArray


class Shading:
    """Shading and blocking of a scene, kept up to date while mirrors move.

    Parameters
    ----------
    scene
        Mirrors, towers and sun.
    split
        Columns and rows of equal parts whose moments are to be computed, (H, 2). If a mirror has
        facets, these are its parts. None: each mirror is one part.
    """

    def __init__(self, scene: Scene, split: IntArray | None = None) -> None:
        mirrors, count = scene.mirrors, len(scene.mirrors)
        self._sun = as_input(scene.sun)
        towers = [(t.east, t.north, t.radius, t.bottom, t.top) for t in scene.towers]
        self._towers = as_input(np.array(towers).reshape(-1, kernels.TOWER))
        self.table, self._ways, self._reaches = _rows(mirrors, scene.sun)
        self._split = np.ones((count, 2), dtype=np.int64) if split is None else split
        self.parts = _parts(mirrors, self._split)
        self._shares = np.ones((count, 3))
        self._moments = np.zeros((int(self.parts[3][-1]), 6))
        self._look()
        self._clip(np.arange(count))

    @property
    def lit(self) -> Lit:
        """The present state; `move` changes its arrays."""
        shading, blocking, both = self._shares.T
        return Lit(shading, blocking, both, self._moments, self.parts[3])

    def _look(self) -> None:
        """Build the grid, and find the candidates of every mirror."""
        table = self.table
        self._places = table[:, :3].copy()
        radius = float(table[:, 15].max(initial=1.0))
        step, low = 2.0 * (radius + SLACK), table[:, :2].min(axis=0)
        shape = ((table[:, :2].max(axis=0) - low) // step).astype(np.int64) + 1
        heads = np.empty(int(shape.prod()), dtype=np.int64)
        links, tops = np.empty(len(table), dtype=np.int64), np.empty(len(heads))
        sides = (int(shape[1]), int(shape[0]))
        kernels.gridded(table, low, step, sides, heads, links, tops)
        self._grid = (low, step, sides, heads, links, tops, float(tops.max()) + SLACK)
        self._spans, self._near = self._candidates(np.arange(len(table)))

    def _candidates(self, rows: IntArray) -> tuple[IntArray, IntArray]:
        """Return where the candidates of the mirrors in ``rows`` lie in the list, (R, 3)."""
        found: dict[int, tuple[IntArray, IntArray]] = {}

        def block(first: int, last: int) -> None:
            spans = np.empty((last - first + 1, 2), dtype=np.int64)
            near = kernels.candidates(
                rows[first:last], self.table, self._sun, as_input(self._ways), self._reaches, SLACK,
                self._grid, spans,
            )  # fmt: skip
            found[first] = np.column_stack([spans[:-1], spans[1:, 0]]), near

        run_blocks(block, len(rows))
        parts, start = [], 0
        for first in sorted(found):
            parts.append(found[first][0] + start)
            start += len(found[first][1])
        lists = [found[first][1] for first in sorted(found)]
        return np.concatenate(parts), np.concatenate(lists)

    def _clip(self, rows: IntArray) -> None:
        def block(first: int, last: int) -> None:
            kernels.clip(
                first, last, rows, self.table, self._towers, self._sun, as_input(self._ways),
                self._reaches, self._near, self._spans, self.parts,
                (self._shares, self._moments),
            )  # fmt: skip

        run_blocks(block, len(rows))

    def move(self, rows: IntArray, mirrors: Mirrors) -> IntArray:
        """Move mirrors; return the indices of all mirrors whose light has changed.

        Parameters
        ----------
        rows
            Indices of the moved mirrors, (M,).
        mirrors
            All mirrors, (H,), in their new poses.
        """
        table, ways, reaches = _rows(mirrors, self._sun, rows)
        touched = self._touched(rows)
        self.table[rows], self._ways[rows], self._reaches[rows] = table, ways, reaches
        if np.abs(table[:, :3] - self._places[rows]).max(initial=0.0) > SLACK:
            self._look()
            touched |= self._touched(rows)
        else:
            self._replace(rows)
        looked = np.flatnonzero(touched)
        parts = parts_of(self.parts[3], looked)
        before = self._moments[parts]
        self._clip(looked)
        # Most candidates are not actually hidden, and their light is unchanged.
        changed = np.zeros(len(touched), dtype=np.bool_)
        changed[rows] = True
        altered = (self._moments[parts] != before).any(axis=1)
        counts = np.diff(self.parts[3])[looked]
        changed[np.repeat(looked, counts)[altered]] = True
        return np.flatnonzero(changed)

    def _replace(self, rows: IntArray) -> None:
        """Find the candidates of some mirrors anew."""
        spans, near = self._candidates(rows)
        self._spans[rows] = spans + len(self._near)
        self._near = np.concatenate([self._near, near])
        if len(self._near) > 2 * int((self._spans[:, 2] - self._spans[:, 0]).sum()) + 1024:
            # Remove the remainders of replaced lists.
            self._spans, self._near = self._candidates(np.arange(len(self.table)))

    def _touched(self, rows: IntArray) -> npt.NDArray[np.bool_]:
        """Return a mask of the mirrors that are in ``rows`` or have one of these as a candidate."""
        moved = np.zeros(len(self.table), dtype=np.bool_)
        moved[rows] = True
        touched = np.empty_like(moved)
        kernels.touched(self._spans, self._near, moved, touched)
        return touched

    def pieces(self, row: int) -> list[FloatArray]:
        """Return the convex polygons that make up the lit part of one mirror, m, each (k, 2)."""
        corners, begins = kernels.pieces_of(
            row, self.table, self._towers, self._sun, as_input(self._ways), self._reaches,
            self._near, self._spans,
        )  # fmt: skip
        return [corners[a:b] for a, b in pairwise(begins)]

    def hiding(self, row: int) -> IntArray:
        """Return the mirrors that may shade or block a part of one mirror, (J,)."""
        hides = np.zeros(len(self.table), dtype=np.bool_)
        kernels.hiding(
            row, self.table, self._sun, as_input(self._ways), self._reaches, self._near,
            self._spans, hides,
        )  # fmt: skip
        return np.flatnonzero(hides)


def nearest(places: FloatArray, count: int = NEAREST) -> npt.NDArray[np.intp]:
    """Return the indices of the J nearest neighbours of each position (N, 3), (N, J)."""
    most = min(count + 1, len(places))
    neighbours = np.asarray(cKDTree(places).query(places, k=most)[1]).reshape(len(places), most)
    return np.asarray(neighbours[:, 1:], dtype=np.intp)


def parts_of(begin: IntArray, rows: IntArray) -> IntArray:
    """Return the indices of the parts of some mirrors; ``begin`` (H + 1,) is as in `Lit`."""
    counts = begin[rows + 1] - begin[rows]
    ends = np.cumsum(counts)
    first = np.repeat(begin[rows] - ends + counts, counts)
    return np.asarray(first + np.arange(len(first)), dtype=np.int64)


def _rows(
    mirrors: Mirrors, sun: FloatArray, rows: IntArray | slice = slice(None)
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the table for the kernels, the central rays, and how far these are followed."""
    center, normal = mirrors.center[rows], mirrors.normal[rows]
    table = table_of(mirrors, rows)
    ways = reflect(np.broadcast_to(sun, normal.shape), normal)
    reaches = (1.0 - _BEFORE) * np.linalg.norm(mirrors.aim[rows] - center, axis=-1)
    return table, np.ascontiguousarray(ways), as_float(reaches)


def table_of(mirrors: Mirrors, rows: IntArray | slice = slice(None)) -> FloatArray:
    """Return the mirror table for the kernels: poses, half sizes, curvatures and radii."""
    half = 0.5 * np.stack([mirrors.width[rows], mirrors.height[rows]], axis=-1)
    curve, radius = 0.5 / mirrors.focal[rows], np.linalg.norm(half, axis=-1)
    axes = (mirrors.right[rows], mirrors.up[rows], mirrors.normal[rows])
    return np.column_stack([mirrors.center[rows], *axes, half, curve, radius])


def _parts(mirrors: Mirrors, split: IntArray) -> Any:
    """Return the facets, their kinds, the divisions, and where each mirror's parts begin."""
    facets = mirrors.facets
    if facets is None:
        counts = split.prod(axis=1)
        table, kind = np.empty((0, 0, 4)), np.zeros(1, dtype=np.int64)
    else:
        table = np.concatenate([facets.center, facets.half], axis=-1)
        kind = mirrors.kind
        # A mirror's last facets may be empty.
        last = table.shape[1] - np.argmax(facets.half[:, ::-1].min(axis=-1) > 0.0, axis=1)
        counts = last[kind]
    begin = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return as_input(table), as_input(kind), as_input(split), as_input(begin)
