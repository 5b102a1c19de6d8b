# mypy: disable-error-code="no-untyped-call, untyped-decorator"
# mypy: allow-untyped-defs
"""Compiled kernels: light sampled from a plane, ambient light, and exposure of a sensor."""

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from heliotrope.geometry import FloatArray
from heliotrope.jit import INLINED, OPTIONS

Image = npt.NDArray[np.float32]

#: Finest subdivision of a pixel in each direction.
FINEST = 16


@njit(**INLINED)
def _bilinear(grid, x, y):
    """Return ``grid`` at column x and row y; the grid's border must be 0."""
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
    """Average a field on the plane over each pixel, and store the result in ``out``.

    Parameters
    ----------
    u, v
        Position on the plane seen by each pixel's centre, m, (H, W).
    share
        Fraction of each pixel that sees the plane, (H, W); pixels with 0 are skipped.
    grid, origin, step
        The field, bilinear between samples and 0 beyond them; the first sample is at ``origin``.
    out
        (H, W).
    """
    bordered = np.zeros((grid.shape[0] + 2, grid.shape[1] + 2))
    bordered[1:-1, 1:-1] = grid
    x, y = (float(o) - float(step) for o in origin)
    _sample(u, v, share, bordered, x, y, 1.0 / float(step), out)


@njit(**OPTIONS)
def _sample(u, v, share, grid, x0, y0, per, out):
    """Perform `sample_plane` for a grid with a border of 0; ``per`` is samples per metre."""
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
            # The points are half a sample apart, so that kinks of the field are not missed.
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
    """Compute the relative ambient light of each pixel, gradient times shadow, (H, W).

    ``terms`` starts with the gradient to the right and up (1/m). For the edge of the shadow follow
    a point (m), the unit normal into the shadow, the breadth of the ramp (m) and the fraction of
    the light left in the shadow (1 for no shadow).
    """
    gx, gy, px, py, nx, ny, soft, remaining = terms
    height, width = out.shape
    for i in range(height):
        for j in range(width):
            if share[i, j] <= 0.0:
                out[i, j] = 0.0
                continue
            x, y = float(u[i, j]), float(v[i, j])
            value = max(0.0, 1.0 + gx * x + gy * y)
            if remaining != 1.0:
                k = j + 1 if j + 1 < width else j - 1
                # Averaged over a pixel, a hard edge becomes a ramp one pixel wide.
                breadth = max(soft, math.hypot(u[i, k] - x, v[i, k] - y))
                depth = min(max(((x - px) * nx + (y - py) * ny) / breadth + 0.5, 0.0), 1.0)
                value *= 1.0 + (remaining - 1.0) * depth
            out[i, j] = value


@njit(**OPTIONS)
def expose(level, noise, read_noise, per_electron, offset, curve, steps, out):
    """Simulate the readings of a sensor, and return how many are clipped.

    Parameters
    ----------
    level
        Expected readings, as fractions of full scale, (N,).
    noise
        Standard normal numbers, (N,).
    read_noise
        Read noise, electrons.
    per_electron, offset
        Reading per electron and in darkness, as fractions of full scale.
    curve
        Encoding table for fractions of full scale from 0 to 1, in equal steps; empty for linear.
    steps
        Greatest reading: 255 or 4095.
    out
        uint8, or uint16 in which 12 bits are spread over 16, (N,).
    """
    clipped = 0
    for i in range(len(level)):
        mean = max((float(level[i]) - offset) / per_electron, 0.0)
        # The Poisson distribution is approximated by a normal distribution with the same variance.
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
