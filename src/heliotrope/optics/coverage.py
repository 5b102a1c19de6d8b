# mypy: disable-error-code="no-untyped-call, untyped-decorator"
# mypy: allow-untyped-defs
"""The fraction of each grid cell that polygons cover, computed exactly.

Cell ``[i, j]`` extends from ``j - 1/2`` to ``j + 1/2`` horizontally and from ``i - 1/2`` to ``i +
1/2`` downwards, so cell centres have integer coordinates.
"""

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from heliotrope.geometry import FloatArray
from heliotrope.jit import INLINED, OPTIONS


@njit(**OPTIONS)
def cover_edges(edges, area):
    """Add the contributions of the edges (E, 4) of closed polygons to ``area`` (H, W + 1).

    By Green's theorem an edge bounds everything to its right. The part of an edge in a row is split
    at the cell borders. A piece of height d, whose mean position is at the fraction m across its
    cell, covers d (1 − m) of that cell and d of every cell to the right, so d m is added to the
    next cell. The cumulative sum along each row is then the covered area, exactly.
    """
    rows, columns = area.shape[0], area.shape[1] - 1
    for e in range(len(edges)):
        x0, y0, x1, y1 = edges[e, 0] + 0.5, edges[e, 1] + 0.5, edges[e, 2] + 0.5, edges[e, 3] + 0.5
        if y0 == y1:
            continue
        sign = 1.0
        if y0 > y1:
            x0, y0, x1, y1, sign = x1, y1, x0, y0, -1.0
        slope = (x1 - x0) / (y1 - y0)
        first, last = max(0, math.floor(y0)), min(rows - 1, math.floor(y1))
        for row in range(first, last + 1):
            low, high = max(y0, float(row)), min(y1, row + 1.0)
            if high <= low:
                continue
            a, b = x0 + (low - y0) * slope, x0 + (high - y0) * slope
            _cover_row(area[row], min(a, b), max(a, b), sign * (high - low), columns)


@njit(**INLINED)
def _cover_row(line, left, right, height, columns):
    """Distribute one row's part of an edge over the cells from ``left`` to ``right``."""
    if right <= 0.0:
        line[0] += height
        return
    if left >= columns:
        return
    width = right - left
    if left < 0.0:
        line[0] += height * (-left / width)
    start, stop = max(0, math.floor(left)), min(columns - 1, math.floor(right))
    for cell in range(start, stop + 1):
        a, b = max(left, float(cell)), min(right, cell + 1.0)
        part = height if width == 0.0 else height * (b - a) / width
        mean = 0.5 * (a + b) - cell
        line[cell] += part * (1.0 - mean)
        line[cell + 1] += part * mean


def coverage(polygons: Sequence[FloatArray], shape: tuple[int, ...]) -> FloatArray:
    """Return the fraction of each cell that polygons cover, (H, W).

    Parameters
    ----------
    polygons
        Polygons, each (K, 2): positions across and down, in cells, in either sense of rotation.
        Where polygons overlap, their fractions add up to at most 1.
    shape
        Rows and columns.
    """
    area = np.zeros((shape[0], shape[1] + 1))
    for polygon in polygons:
        edges = np.concatenate([polygon, np.roll(polygon, -1, axis=0)], axis=1)
        signed = np.sum(edges[:, 0] * edges[:, 3] - edges[:, 2] * edges[:, 1])
        # The left edge must run downwards.
        cover_edges(edges if signed < 0.0 else edges[:, [2, 3, 0, 1]], area)
    return np.asarray(np.clip(np.cumsum(area, axis=1)[:, :-1], 0.0, 1.0))
