# mypy: disable-error-code="no-untyped-call, untyped-decorator"
# mypy: allow-untyped-defs
"""Compiled: covered areas of polygons, light thrown on a plane, and exposure of a sensor.

Places are those of cells whose centres are whole numbers: cell ``[i, j]`` reaches from
``j - 1/2`` to ``j + 1/2`` across and from ``i - 1/2`` to ``i + 1/2`` down.
"""

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from numba import njit

from heliotrope.geometry import FloatArray
from heliotrope.jit import INLINED, OPTIONS

Image = npt.NDArray[np.float32]

#: Finest subdivision of a pixel, each way.
FINEST = 16


@njit(**OPTIONS)
def cover_edges(edges, area):
    """Add to ``area`` (H, W + 1) what the edges (E, 4) of closed polygons contribute.

    An edge from (x0, y0) to (x1, y1) bounds everything to its right. What it takes of a row
    is split at the borders of cells: of a part of height d whose mean place is the share m
    of the cell, the cell itself gets d (1 − m) and all to its right d, so d m is added to
    the next. The sum along each row, from the left, is the area, exactly.
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
    """Spread one row's part of an edge, from ``left`` to ``right``, over the cells it crosses."""
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
    """Return the share of each cell that lies in one of some polygons, float64 (H, W).

    Parameters
    ----------
    polygons
        Each (K, 2), places across and down in cells; of either sense of rotation. Where
        they overlap, shares are added and end at 1.
    shape
        Rows and columns.
    """
    area = np.zeros((shape[0], shape[1] + 1))
    for polygon in polygons:
        edges = np.concatenate([polygon, np.roll(polygon, -1, axis=0)], axis=1)
        signed = np.sum(edges[:, 0] * edges[:, 3] - edges[:, 2] * edges[:, 1])
        # Such that the edge on the left runs downwards in rows.
        cover_edges(edges if signed < 0.0 else edges[:, [2, 3, 0, 1]], area)
    return np.asarray(np.clip(np.cumsum(area, axis=1)[:, :-1], 0.0, 1.0))


@njit(**INLINED)
def _bilinear(grid, x, y):
    """Value of ``grid`` at column x and row y; its border must be 0, as all beyond it is."""
    x = min(max(x, 0.0), grid.shape[1] - 1.000001)
    y = min(max(y, 0.0), grid.shape[0] - 1.000001)
    j, i = int(x), int(y)
    a, b = x - j, y - i
    return (1.0 - b) * ((1.0 - a) * grid[i, j] + a * grid[i, j + 1]) + b * (
        (1.0 - a) * grid[i + 1, j] + a * grid[i + 1, j + 1]
    )


def sample_plane(
    u: Image,
    v: Image,
    share: Image,
    grid: FloatArray,
    origin: FloatArray,
    step: float,
    out: Image,
) -> None:
    """Write into ``out`` the means over pixels of a field on the plane.

    Parameters
    ----------
    u, v
        Place on the plane that each pixel's centre looks at, m, (H, W).
    share
        What is 0 where a pixel does not see the plane, (H, W).
    grid, origin, step
        The field, bilinear between samples and 0 beyond; its first sample is at ``origin``.
    out
        (H, W).
    """
    bordered = np.zeros((grid.shape[0] + 2, grid.shape[1] + 2))
    bordered[1:-1, 1:-1] = grid
    x, y = (float(o) - float(step) for o in origin)
    _sample(u, v, share, bordered, x, y, 1.0 / float(step), out)


@njit(**OPTIONS)
def _sample(u, v, share, grid, x0, y0, per, out):
    """:func:`sample_plane` of a grid with a border of 0; ``per`` is samples per metre."""
    height, width = out.shape
    for i in range(height):
        up, down = max(i - 1, 0), min(i + 1, height - 1)
        for j in range(width):
            out[i, j] = 0.0
            if share[i, j] <= 0.0:
                continue
            before, after = max(j - 1, 0), min(j + 1, width - 1)
            across, along = max(after - before, 1), max(down - up, 1)
            x, y = (float(u[i, j]) - x0) * per, (float(v[i, j]) - y0) * per
            xa = (u[i, after] - u[i, before]) * per / across
            ya = (v[i, after] - v[i, before]) * per / across
            xb = (u[down, j] - u[up, j]) * per / along
            yb = (v[down, j] - v[up, j]) * per / along
            reach = max(abs(xa) + abs(xb), abs(ya) + abs(yb))
            if not (
                -reach < x < grid.shape[1] - 1 + reach and -reach < y < grid.shape[0] - 1 + reach
            ):
                continue
            # Half of a sample's distance, so that the kinks of the field are seen.
            n = min(FINEST, max(2, math.ceil(2.0 * reach)))
            total = 0.0
            for k in range(n):
                q = (k + 0.5) / n - 0.5
                for m in range(n):
                    p = (m + 0.5) / n - 0.5
                    total += _bilinear(grid, x + p * xa + q * xb, y + p * ya + q * yb)
            out[i, j] = total / (n * n)


@njit(**OPTIONS)
def ambient_field(u, v, share, terms, out):
    """Write the relative ambient light of each pixel: gradient times shadow, (H, W).

    ``terms`` are the gradient right and up (1/m), then of the shadow's edge a point (m), its
    unit normal into the shadow, the breadth of its ramp (m) and what is left in it (1: none).
    """
    gx, gy, px, py, nx, ny, soft, left = terms
    height, width = out.shape
    for i in range(height):
        for j in range(width):
            if share[i, j] <= 0.0:
                out[i, j] = 0.0
                continue
            x, y = float(u[i, j]), float(v[i, j])
            value = max(0.0, 1.0 + gx * x + gy * y)
            if left != 1.0:
                k = j + 1 if j + 1 < width else j - 1
                # A hard edge is a ramp of one pixel's breadth once a pixel has averaged it.
                breadth = max(soft, math.hypot(u[i, k] - x, v[i, k] - y))
                depth = min(max(((x - px) * nx + (y - py) * ny) / breadth + 0.5, 0.0), 1.0)
                value *= 1.0 + (left - 1.0) * depth
            out[i, j] = value


@njit(**OPTIONS)
def expose(level, noise, read_noise, per_electron, offset, curve, steps, out):
    """Write what a sensor reads, and return how many readings are clipped.

    Parameters
    ----------
    level
        Expected readings, of the full scale, (N,).
    noise
        Standard normal numbers, (N,).
    read_noise
        Electrons.
    per_electron, offset
        Of the full scale.
    curve
        What the full scale's shares 0 to 1 are encoded as, in equal steps; empty: linear.
    steps
        Greatest reading: 255 or 4095.
    out
        uint8, or uint16 in which 12 bits are spread over 16, (N,).
    """
    clipped = 0
    for i in range(len(level)):
        mean = max((float(level[i]) - offset) / per_electron, 0.0)
        # Poisson's distribution as a normal one of the same variance.
        share = (
            offset + (mean + math.sqrt(mean + read_noise * read_noise) * noise[i]) * per_electron
        )
        if share >= 1.0:
            clipped += 1
        share = min(max(share, 0.0), 1.0)
        if len(curve) > 0:
            share = curve[int(share * (len(curve) - 1) + 0.5)]
        reading = int(share * steps + 0.5)
        out[i] = reading if steps < 256 else (reading << 4) | (reading >> 8)
    return clipped
