"""The peers of the tracking benchmark: the same method in whole-array NumPy.

As fast as NumPy allows: components first, so that every operation runs over contiguous memory
(vectors last take two to four times as long); blocks of rows that stay in the processor's cache; no
trigonometry inside the iteration except what SciPy's Rotation needs.
"""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks._run import BenchmarkError

Array = np.ndarray
#: Turn u (3, N) about unit axes (3, N) by angles of sine and cosine (N,).
Turn = Callable[[Array, Array, Array, Array], Array]

#: Rows of a block: the fastest of 2,000 to 64,000 for both peers.
BLOCK = 16_000
LIMIT = 50


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("in,in->n", a, b))


def _cross(a: Array, b: Array) -> Array:
    out = np.empty(a.shape)
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    return out


def by_formula(axis: Array, sine: Array, cosine: Array, u: Array) -> Array:
    """Turn vectors by Rodrigues' formula."""
    along = (1.0 - cosine) * _dot(axis, u)
    return np.asarray(cosine * u + sine * _cross(axis, u) + along * axis)


def by_rotation(axis: Array, sine: Array, cosine: Array, u: Array) -> Array:
    """Turn vectors by SciPy's Rotation, which takes the components as the last axis."""
    turn = Rotation.from_rotvec((axis * np.arctan2(sine, cosine)).T)
    return np.asarray(turn.apply(u.T).T)


def _block(g: Array, sun: Array, aim: Array, turn: Turn, tolerance: float) -> tuple[Array, int]:
    a, origin, b, origin_2, vertex, n = g.reshape(6, 3, -1)
    arm, between = vertex - origin_2, origin_2 - origin
    c = _cross(a, b)
    inverse, ab, nb = 1.0 / _dot(c, c), _dot(a, b), _dot(n, b)
    for step in range(1, LIMIT + 1):
        way = aim - vertex
        way /= np.sqrt(_dot(way, way))
        v = sun + way
        v /= np.sqrt(_dot(v, v))
        # z = α a + β b + γ c is the normal between the two turns; branch 0 has γ < 0.
        va = _dot(v, a)
        alpha, beta = (va - ab * nb) * inverse, (nb - ab * va) * inverse
        rest = 1.0 - alpha * alpha - beta * beta - 2.0 * alpha * beta * ab
        z = alpha * a + beta * b - np.sqrt(np.maximum(rest, 0.0) * inverse) * c
        sine_2, cosine_2 = _dot(b, _cross(n, z)), _dot(n, z) - nb * nb
        sine_1, cosine_1 = _dot(a, _cross(z, v)), _dot(z, v) - va * va
        size_1 = 1.0 / np.sqrt(sine_1 * sine_1 + cosine_1 * cosine_1)
        size_2 = 1.0 / np.sqrt(sine_2 * sine_2 + cosine_2 * cosine_2)
        old = vertex
        inner = between + turn(b, sine_2 * size_2, cosine_2 * size_2, arm)
        vertex = origin + turn(a, sine_1 * size_1, cosine_1 * size_1, inner)
        miss = _cross(vertex - old, way)
        if _dot(miss, miss).max() <= tolerance * tolerance:
            angles = np.arctan2(sine_1, cosine_1), np.arctan2(sine_2, cosine_2)
            return np.stack(angles, axis=-1), step
    raise BenchmarkError(f"arrays: a miss of {tolerance:g} m is not reached in {LIMIT} iterations")


def track_arrays(
    table: Array, sun: Array, aim: Array, turn: Turn, tolerance: float
) -> tuple[Array, int]:
    """Track armatures in whole arrays, each block in step until its last row has converged.

    Parameters
    ----------
    table
        Armatures, (N, 18).
    sun, aim
        Unit vector to the sun and aim point in metres, (3,).
    turn
        `by_formula` or `by_rotation`.
    tolerance
        Largest miss of the beam, m.

    Returns
    -------
    Joint angles of branch 0, (N, 2), and the largest number of iterations.

    Raises
    ------
    BenchmarkError
        If a row does not converge.
    """
    angles, most = np.empty((len(table), 2)), 0
    for first in range(0, len(table), BLOCK):
        rows = slice(first, first + BLOCK)
        g = np.ascontiguousarray(table[rows].T)
        angles[rows], steps = _block(g, sun[:, None], aim[:, None], turn, tolerance)
        most = max(most, steps)
    return angles, most
