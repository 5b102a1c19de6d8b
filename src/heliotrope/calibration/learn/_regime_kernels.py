"""Compiled kernels: the best partition of a heliostat's history into regimes; see regimes.py."""

import math

import numpy as np
from numba import njit

from heliotrope.calibration.median import median
from heliotrope.jit import INNER, OPTIONS

#: Larger squared residuals, in units of the noise, are limited to this value, so that one bad
#: sighting does not make a regime.
TRUNCATION = 16.0
#: Gain that new zeros must bring (twice the BIC of 2 parameters), and the cost of a cut.
PRICE, CUT = 16.0, 8.0
#: Minimum number of sightings in a regime; two sightings could both be mistaken.
FEWEST = 3


@njit(**INNER)
def _segment(residual, jacobian, start, stop, shift):
    """Return the cost of one segment with its own zeros, by reweighted least squares.

    The search starts from the median over the sightings.
    """
    n = stop - start
    values = np.empty((2, n))
    for i in range(n):
        # The zeros that each sighting alone would yield; the search starts from their median.
        a, b = jacobian[start + i, 0, 0], jacobian[start + i, 0, 1]
        c, d = jacobian[start + i, 1, 0], jacobian[start + i, 1, 1]
        determinant = a * d - b * c
        x, y = residual[start + i, 0], residual[start + i, 1]
        if abs(determinant) < 1e-9 * (abs(a * d) + abs(b * c) + 1e-300):
            determinant = np.inf
        values[0, i] = -(d * x - b * y) / determinant
        values[1, i] = -(a * y - c * x) / determinant
    shift[0], shift[1] = median(values[0]), median(values[1])
    cost = np.inf
    for turn in range(4):
        h00, h01, h11, g0, g1, total = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(start, stop):
            x = residual[i, 0] + jacobian[i, 0, 0] * shift[0] + jacobian[i, 0, 1] * shift[1]
            y = residual[i, 1] + jacobian[i, 1, 0] * shift[0] + jacobian[i, 1, 1] * shift[1]
            square = x * x + y * y
            total += min(square, TRUNCATION)
            if square < TRUNCATION:
                h00 += jacobian[i, 0, 0] ** 2 + jacobian[i, 1, 0] ** 2
                h11 += jacobian[i, 0, 1] ** 2 + jacobian[i, 1, 1] ** 2
                h01 += jacobian[i, 0, 0] * jacobian[i, 0, 1] + jacobian[i, 1, 0] * jacobian[i, 1, 1]
                g0 += jacobian[i, 0, 0] * x + jacobian[i, 1, 0] * y
                g1 += jacobian[i, 0, 1] * x + jacobian[i, 1, 1] * y
        cost = min(cost, total)
        determinant = h00 * h11 - h01 * h01
        if turn == 3 or not determinant > 1e-12 * h00 * h11:
            break
        shift[0] -= (h11 * g0 - h01 * g1) / determinant
        shift[1] -= (h00 * g1 - h01 * g0) / determinant
    return cost


@njit(**OPTIONS)
def partition(residual, jacobian, places, smallest):
    """Return labels (n,) of the best partition of sightings (n, 2), with cuts at ``places``.

    Label 0 marks all sightings with the common zeros; the other labels count from 1.
    """
    n, count = len(residual), len(places)
    plain = np.zeros(n + 1)
    for i in range(n):
        plain[i + 1] = plain[i] + min(residual[i, 0] ** 2 + residual[i, 1] ** 2, TRUNCATION)
    best, come = np.full(count, np.inf), np.zeros(count, dtype=np.int64)
    own = np.zeros(count, dtype=np.bool_)
    best[0] = 0.0
    shift = np.empty(2)
    for k in range(1, count):
        for j in range(k):
            start, stop = places[j], places[k]
            before = best[j] + (CUT if j > 0 else 0.0)
            cost = before + plain[stop] - plain[start]
            if cost < best[k]:
                best[k], come[k], own[k] = cost, j, False
            # Skip a segment whose own zeros would not pay even if they explained everything.
            if stop - start < FEWEST or before + PRICE >= best[k]:
                continue
            if plain[stop] - plain[start] < PRICE:
                continue
            cost = before + PRICE + _segment(residual, jacobian, start, stop, shift)
            if cost < best[k]:
                size = 0.0
                for i in range(start, stop):
                    x = jacobian[i, 0, 0] * shift[0] + jacobian[i, 0, 1] * shift[1]
                    y = jacobian[i, 1, 0] * shift[0] + jacobian[i, 1, 1] * shift[1]
                    size += math.sqrt(x * x + y * y)
                if size >= smallest * (stop - start):
                    best[k], come[k], own[k] = cost, j, True
    label = np.zeros(n, dtype=np.int64)
    k, number = count - 1, 0
    while k > 0:
        if own[k]:
            number += 1
            for i in range(places[come[k]], places[k]):
                label[i] = number
        k = come[k]
    # Number the regimes in order of time.
    for i in range(n):
        if label[i] > 0:
            label[i] = number + 1 - label[i]
    return label
