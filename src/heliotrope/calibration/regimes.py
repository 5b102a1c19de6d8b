"""Regimes: after a repair or a new reference a heliostat's zeros are elsewhere.

The times of a heliostat's sightings are cut into segments, each either on the common
zeros or on zeros of its own, so that the truncated squares of the residuals plus a
price for each cut and each new pair of zeros are least (optimal partitioning: Jackson et
al. 2005, IEEE Signal Processing Letters 12; truncated loss: Fearnhead & Rigaill 2019, J.
Am. Stat. Assoc. 114). Slow creep is not for here: it is a process of its own
(:mod:`heliotrope.calibration.drift`).
"""

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from heliotrope.geometry import FloatArray
from heliotrope.mechanism._jit import OPTIONS

#: A squared residual counts no more than this, in units of the noise: one bad sighting
#: does not make a regime.
TRUNCATION = 16.0
#: What new zeros must gain beyond the price of a cut (about 2 parameters in BIC, doubled).
PRICE, CUT = 16.0, 8.0
#: Fewest sightings of a regime: two could be two mistakes.
FEWEST = 3
#: Cuts are looked for at no more places than this: the longest gaps.
PLACES = 300


@njit(**OPTIONS)
def _segment(residual, jacobian, start, stop, shift):
    """Cost of one segment with zeros of its own, by re-weighted least squares from its median."""
    n = stop - start
    values = np.empty((2, n))
    for i in range(n):
        # A sighting's own zeros, to start from where most of them agree.
        a, b = jacobian[start + i, 0, 0], jacobian[start + i, 0, 1]
        c, d = jacobian[start + i, 1, 0], jacobian[start + i, 1, 1]
        determinant = a * d - b * c
        x, y = residual[start + i, 0], residual[start + i, 1]
        if abs(determinant) < 1e-9 * (abs(a * d) + abs(b * c) + 1e-300):
            determinant = np.inf
        values[0, i] = -(d * x - b * y) / determinant
        values[1, i] = -(a * y - c * x) / determinant
    shift[0], shift[1] = np.median(values[0]), np.median(values[1])
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
def _partition(residual, jacobian, places, smallest):
    """Best cut of sightings (n, 2) at ``places``; returns labels (n,), 0 for the common zeros."""
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
            # Zeros of its own must pay even if they explained everything.
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
            label[places[come[k]] : places[k]] = number
        k = come[k]
    # Numbered from the first to the last.
    for i in range(n):
        if label[i] > 0:
            label[i] = number + 1 - label[i]
    return label


def find_regimes(
    time: npt.ArrayLike, residual: npt.ArrayLike, jacobian: npt.ArrayLike, smallest: float = 6.0
) -> npt.NDArray[np.int64]:
    """Return the regime of each sighting of one heliostat: 0 on the common zeros, else 1, 2, ….

    Parameters
    ----------
    time
        Seconds, (n,); a NaN belongs to regime 0.
    residual
        Residuals under the common zeros, in units of the noise, (n, 2).
    jacobian
        Their derivative by the two zeros, (n, 2, 2).
    smallest
        Mean length of the shift (units of the noise) below which it is left to drift.
    """
    times = np.asarray(time, dtype=np.float64)
    rest, slope = np.asarray(residual, dtype=np.float64), np.asarray(jacobian, dtype=np.float64)
    label = np.zeros(len(times), dtype=np.int64)
    order = np.argsort(times, kind="stable")
    order = order[np.isfinite(times[order])]
    if len(order) < 2 * FEWEST:
        return label
    gaps = np.diff(times[order])
    inner = 1 + np.sort(np.argsort(-gaps, kind="stable")[:PLACES])
    places = np.concatenate([[0], inner, [len(order)]])
    label[order] = _partition(
        np.ascontiguousarray(rest[order]), np.ascontiguousarray(slope[order]), places, smallest
    )
    return label


def regime_at(
    time: FloatArray, label: npt.NDArray[np.int64], when: FloatArray
) -> npt.NDArray[np.int64]:
    """Return the regime at times ``when`` (m,), of the sighting nearest in time.

    After the last sighting it is the latest regime.
    """
    known = np.flatnonzero(np.isfinite(time))
    if not len(known):
        return np.zeros(len(when), dtype=np.int64)
    order = known[np.argsort(time[known], kind="stable")]
    places = np.searchsorted(time[order], when)
    before = order[np.clip(places - 1, 0, len(order) - 1)]
    after = order[np.clip(places, 0, len(order) - 1)]
    nearer = np.where(np.abs(when - time[before]) <= np.abs(time[after] - when), before, after)
    return np.where(np.isfinite(when), label[nearer], 0).astype(np.int64)
