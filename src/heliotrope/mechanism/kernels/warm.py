"""Compiled: the first fixed-point steps of many heliostats at once, in vector registers.

One step is a chain of four square roots and four divisions, each of which waits for the previous
one, so that solving one heliostat at a time leaves the processor idle. Here the lanes of a small
table contain several heliostats, and the same step runs on all lanes in parallel. The result is
only a starting vertex; `track.solve_aim` continues from it and makes all decisions.
"""

import math

import numpy as np
from numba import njit

from heliotrope.jit import INLINED, INNER, plain
from heliotrope.mechanism.kernels.track import axis_1, axis_2, constants, load_armature
from heliotrope.mechanism.kernels.vectors import across, add, cross, dot, minus, times

#: Number of heliostats computed in parallel, and number of steps.
LANES = 8
STEPS = 3
# Rows of the table: vectors take three.
(_A, _B, _C, _AIM, _K0, _K1, _K2, _SUN, _Y) = range(0, 27, 3)
(_AB, _UB, _INV, _SA, _SC, _CA, _CC, _SUN_A, _SUN_B, _SUN_C) = range(27, 37)
ROWS = 37


@njit(**INLINED)
def _put(table, row, lane, vector):
    table[row, lane] = vector[0]
    table[row + 1, lane] = vector[1]
    table[row + 2, lane] = vector[2]


@njit(**INLINED)
def _gather(table, lane, g, s, p):
    """Fill one lane with the inputs of the step; the vertex starts at zero angles."""
    a, b = axis_1(g), axis_2(g)
    c = cross(a, b)
    o = (g[3], g[4], g[5])
    arm = (g[12] - g[9], g[13] - g[10], g[14] - g[11])
    along = dot(arm, b)
    _put(table, plain(_A), lane, a)
    _put(table, plain(_B), lane, b)
    _put(table, plain(_C), lane, c)
    _put(table, plain(_AIM), lane, minus(p, o))
    # Turned about b by θ₂, the vertex is K0 + cos θ₂ K1 + sin θ₂ K2 from the first origin.
    _put(table, plain(_K0), lane, add((g[9] - o[0], g[10] - o[1], g[11] - o[2]), times(along, b)))
    _put(table, plain(_K1), lane, across(arm, b))
    _put(table, plain(_K2), lane, cross(b, arm))
    _put(table, plain(_SUN), lane, s)
    _put(table, plain(_Y), lane, minus((g[12], g[13], g[14]), o))
    k = constants(g, (g[15], g[16], g[17]))
    table[_AB, lane], table[_UB, lane], table[_INV, lane] = k[0], k[1], k[2]
    table[_SA, lane], table[_SC, lane] = k[3], k[4]
    table[_CA, lane], table[_CC, lane] = k[5], k[6]
    table[_SUN_A, lane], table[_SUN_B, lane] = dot(s, a), dot(s, b)
    table[_SUN_C, lane] = dot(s, c)


@njit(**INLINED)
def _step(w, sign):
    """Compute one fixed-point step of every lane; see ``solve_direction`` for the formulae."""
    for i in range(LANES):
        x = w[_AIM, i] - w[_Y, i]
        y = w[_AIM + 1, i] - w[_Y + 1, i]
        z = w[_AIM + 2, i] - w[_Y + 2, i]
        q = 1.0 / math.sqrt(x * x + y * y + z * z)
        a0, a1, a2 = w[_A, i], w[_A + 1, i], w[_A + 2, i]
        # |s + t|² = 2 + 2 s·t
        cosine = q * (x * w[_SUN, i] + y * w[_SUN + 1, i] + z * w[_SUN + 2, i])
        r = 1.0 / math.sqrt(2.0 + 2.0 * cosine)
        va = r * (w[_SUN_A, i] + q * (x * a0 + y * a1 + z * a2))
        vb = r * (w[_SUN_B, i] + q * (x * w[_B, i] + y * w[_B + 1, i] + z * w[_B + 2, i]))
        vc = r * (w[_SUN_C, i] + q * (x * w[_C, i] + y * w[_C + 1, i] + z * w[_C + 2, i]))
        ab, ub, inverse = w[_AB, i], w[_UB, i], w[_INV, i]
        along_a, along_b = (va - ab * ub) * inverse, (ub - ab * va) * inverse
        square = 1.0 - along_a * along_a - along_b * along_b - 2.0 * along_a * along_b * ab
        away = sign * math.sqrt(max(0.0, square) * inverse)
        sine_2 = along_a * w[_SA, i] + away * w[_SC, i]
        cosine_2 = along_a * w[_CA, i] + away * w[_CC, i]
        sine_1 = along_b * vc + away * (ab * va - vb)
        cosine_1 = along_a * va + along_b * vb + away * vc - va * va
        size = 1.0 / math.sqrt(sine_1 * sine_1 + cosine_1 * cosine_1)
        sine_1 *= size
        cosine_1 *= size
        x = w[_K0, i] + cosine_2 * w[_K1, i] + sine_2 * w[_K2, i]
        y = w[_K0 + 1, i] + cosine_2 * w[_K1 + 1, i] + sine_2 * w[_K2 + 1, i]
        z = w[_K0 + 2, i] + cosine_2 * w[_K1 + 2, i] + sine_2 * w[_K2 + 2, i]
        along = (1.0 - cosine_1) * (x * a0 + y * a1 + z * a2)
        w[_Y, i] = cosine_1 * x + sine_1 * (a1 * z - a2 * y) + along * a0
        w[_Y + 1, i] = cosine_1 * y + sine_1 * (a2 * x - a0 * z) + along * a1
        w[_Y + 2, i] = cosine_1 * z + sine_1 * (a0 * y - a1 * x) + along * a2


@njit(**INNER)
def warm_start(armatures, suns, aims, index, first, stop, sign, vertices):
    """Return starting vertices (LANES, 3) of the rows from ``first`` on, after STEPS steps.

    Lanes past ``stop`` repeat the last row, so that the result for a row does not depend on where
    the blocks of rows are cut. A row whose result is not finite (no second axis, aim in the vertex)
    starts at zero angles.
    """
    # Created here, so that its shape is a constant for the compiler and the step becomes
    # vector instructions: 16 ns a step and heliostat instead of 90.
    table = np.empty((ROWS, LANES))
    for lane in range(LANES):
        i = min(first + lane, stop - 1)
        g = load_armature(armatures, index[i, 0])
        s = (suns[index[i, 2], 0], suns[index[i, 2], 1], suns[index[i, 2], 2])
        p = (aims[index[i, 3], 0], aims[index[i, 3], 1], aims[index[i, 3], 2])
        _gather(table, lane, g, s, p)
    for _ in range(STEPS):
        _step(table, sign)
    for lane in range(LANES):
        row = index[min(first + lane, stop - 1), 0]
        for k in range(3):
            vertices[lane, k] = armatures[row, 3 + k] + table[_Y + k, lane]
        if not math.isfinite(vertices[lane, 0] + vertices[lane, 1] + vertices[lane, 2]):
            for k in range(3):
                vertices[lane, k] = armatures[row, 12 + k]
