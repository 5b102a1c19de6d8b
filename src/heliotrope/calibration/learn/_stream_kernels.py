"""Compiled kernels: one sighting updates a heliostat's weighted hypotheses; see stream.py.

A state holds the P constants, the offsets of the Z zeros in the present regime, and the C
Ornstein-Uhlenbeck processes. Each hypothesis is a Gaussian over this state: mean (S,), covariance
(S, S).
"""

import math

import numpy as np
from numba import njit

from heliotrope.jit import INNER, OPTIONS

# What happened before a sighting; UNKNOWN weighs all the possibilities.
UNKNOWN, NOTHING, STEP, REGIME, RETURN, BLUNDER = -1, 0, 1, 2, 3, 4
#: Maximum number of hypotheses after a sighting, and the minimum weight of a hypothesis.
MOST, LEAST = 8, 1e-4
#: Hypotheses whose means and standard deviations differ by less than this are merged.
ALIKE = 0.3


@njit(**INNER)
def propagate(mean, covariance, first, amplitude, tau, days):
    """Advance the processes of one hypothesis by ``days``, in place."""
    for c in range(amplitude.shape[0]):
        k = first + c
        decay = math.exp(-days / tau[c])
        mean[k] *= decay
        for j in range(mean.shape[0]):
            covariance[k, j] *= decay
            covariance[j, k] *= decay
        covariance[k, k] += amplitude[c] * amplitude[c] * (1.0 - decay * decay)


@njit(**OPTIONS)
def moments(weight, mean, covariance, first, amplitude, tau, days):
    """Return the mean (S,) and covariance (S, S) of all hypotheses combined, after ``days``."""
    count, size = mean.shape
    middle, spread = np.zeros(size), np.zeros((size, size))
    later, spreads = mean.copy(), covariance.copy()
    for k in range(count):
        propagate(later[k], spreads[k], first, amplitude, tau, days)
        middle += weight[k] * later[k]
    for k in range(count):
        for p in range(size):
            for q in range(size):
                away = (later[k, p] - middle[p]) * (later[k, q] - middle[q])
                spread[p, q] += weight[k] * (spreads[k, p, q] + away)
    return middle, spread


@njit(**INNER)
def reset(mean, covariance, k, variance):
    """Reset component k of one hypothesis to its prior ``variance``, in place."""
    mean[k] = 0.0
    for j in range(mean.shape[0]):
        covariance[k, j] = 0.0
        covariance[j, k] = 0.0
    covariance[k, k] = variance


@njit(**INNER)
def _log_density(x, y, a, b, c):
    determinant = a * c - b * b
    square = (c * x * x - 2.0 * b * x * y + a * y * y) / determinant
    return -0.5 * square - 0.5 * math.log(determinant) - math.log(2.0 * math.pi)


@njit(**INNER)
def _compare(mean, covariance, rows, value, noise, far):
    """Compare one hypothesis with a sighting.

    The gap is the sighting minus its prediction. Returns the covariance of the state with the gap,
    (S, 2), the gap, its covariance, and two log densities of the gap: for a good sighting, and for
    a blunder with the variance ``far``.
    """
    size = mean.shape[0]
    gain = np.zeros((size, 2))
    x, y = value[0], value[1]
    for j in range(size):
        x -= rows[0, j] * mean[j]
        y -= rows[1, j] * mean[j]
        for k in range(size):
            gain[j, 0] += covariance[j, k] * rows[0, k]
            gain[j, 1] += covariance[j, k] * rows[1, k]
    a, b, c = noise[0, 0], noise[0, 1], noise[1, 1]
    for j in range(size):
        a += rows[0, j] * gain[j, 0]
        b += rows[0, j] * gain[j, 1]
        c += rows[1, j] * gain[j, 1]
    return gain, x, y, a, b, c, _log_density(x, y, a, b, c), _log_density(x, y, a + far, b, c + far)


@njit(**INNER)
def _condition(mean, covariance, gap):
    """Update one hypothesis with the sighting that it was compared with, in place."""
    gain, x, y, a, b, c = (
        gap[0],
        gap[1],
        gap[2],
        gap[3],
        gap[4],
        gap[5],
    )
    determinant = a * c - b * b
    p, q, r = c / determinant, -b / determinant, a / determinant
    size = mean.shape[0]
    for j in range(size):
        first = gain[j, 0] * p + gain[j, 1] * q
        second = gain[j, 0] * q + gain[j, 1] * r
        mean[j] += first * x + second * y
        for k in range(j + 1):
            covariance[j, k] -= first * gain[k, 0] + second * gain[k, 1]
            covariance[k, j] = covariance[j, k]


@njit(**INNER)
def _same(mean, covariance, i, j):
    for k in range(mean.shape[1]):
        a, b = covariance[i, k, k], covariance[j, k, k]
        if a <= 0.0 and b <= 0.0:
            if mean[i, k] != mean[j, k]:
                return False
            continue
        if abs(mean[i, k] - mean[j, k]) > ALIKE * math.sqrt(min(a, b)):
            return False
        if abs(math.sqrt(a) - math.sqrt(b)) > ALIKE * math.sqrt(min(a, b)):
            return False
    return True


@njit(**INNER)
def _merge(mean, covariance, weight, i, j):
    """Merge hypotheses i and j into i, preserving their combined moments."""
    total = weight[i] + weight[j]
    a, b = weight[i] / total, weight[j] / total
    size = mean.shape[1]
    for p in range(size):
        for q in range(size):
            covariance[i, p, q] = (
                a * covariance[i, p, q]
                + b * covariance[j, p, q]
                + a * b * (mean[j, p] - mean[i, p]) * (mean[j, q] - mean[i, q])
            )
    for p in range(size):
        mean[i, p] += b * (mean[j, p] - mean[i, p])
    weight[i] = total


@njit(**INNER)
def _copy(mean, covariance, mean_to, covariance_to):
    """Copy one hypothesis."""
    for j in range(mean.shape[0]):
        mean_to[j] = mean[j]
        for k in range(mean.shape[0]):
            covariance_to[j, k] = covariance[j, k]


@njit(**INNER)
def _total(values, count):
    total = 0.0
    for k in range(count):
        total += values[k]
    return total


@njit(**INNER)
def _heaviest_first(weight, count):
    """Return indices that sort weights in descending order; equal weights keep their order."""
    order = np.empty(count, dtype=np.int64)
    for k in range(count):
        j = k
        while j > 0 and weight[order[j - 1]] < weight[k]:
            order[j] = order[j - 1]
            j -= 1
        order[j] = k
    return order


@njit(**INNER)
def _reduce(mean, covariance, weight, regime, count):
    """Sort hypotheses by weight, merge similar ones, drop improbable ones; return their number.

    The indices of the remaining hypotheses are returned in ``keep``.
    """
    order = _heaviest_first(weight, count)
    keep = np.empty(MOST, dtype=np.int64)
    kept = 0
    total = _total(weight, count)
    for n in range(count):
        i = order[n]
        if weight[i] < LEAST * total and kept > 0:
            break
        merged = False
        for m in range(kept):
            j = keep[m]
            if regime[i] == regime[j] and _same(mean, covariance, j, i):
                _merge(mean, covariance, weight, j, i)
                merged = True
                break
        if not merged and kept < MOST:
            keep[kept] = i
            kept += 1
    return keep[:kept]


@njit(**OPTIONS)
def update(
    weight, mean, covariance, regime, rows, value, noise, days, event,
    zeros, offsets, first, step, lost, amplitude, tau, chance, far
):  # fmt: skip
    """Return a heliostat's hypotheses after one more sighting, and the sighting's log density.

    A hypothesis is a weight, a mean, a covariance and a regime.

    ``rows`` (2, S) are the derivatives of the whitened values ``value`` (2,) with respect to the
    state; ``noise`` is (2, 2). ``zeros`` and ``offsets`` (Z,) are the positions of the zeros'
    constants and of their offsets in the state, and ``first`` is the position of the first process.
    ``step`` and ``lost`` (Z,) are the variances of a step and of a regime offset; ``chance`` (5,)
    are the probabilities of the possible events; ``far`` is the variance of a blunder. The last
    result is the probability that the sighting is a blunder.
    """
    count, size = mean.shape
    most = 5 * count
    new_mean, new_cov = np.empty((most, size)), np.empty((most, size, size))
    log_weight, new_weight = np.empty(most), np.empty(most)
    new_regime, blunder = np.zeros(most, dtype=np.bool_), np.zeros(most, dtype=np.bool_)
    used = 0
    for k in range(count):
        m, p = mean[k].copy(), covariance[k].copy()
        if days > 0.0:
            propagate(m, p, first, amplitude, tau, days)
        base = math.log(weight[k])
        for what in range(4):
            if event not in (UNKNOWN, what):
                continue
            if what == RETURN and not regime[k]:
                continue
            prior = 0.0 if event != UNKNOWN else math.log(max(chance[what], 1e-300))
            if event == UNKNOWN and chance[what] <= 0.0:
                continue
            _copy(m, p, new_mean[used], new_cov[used])
            new_regime[used] = regime[k]
            for z in range(zeros.shape[0]):
                if what == STEP:
                    new_cov[used, zeros[z], zeros[z]] += step[z]
                elif what == REGIME:
                    reset(new_mean[used], new_cov[used], offsets[z], lost[z])
                    new_regime[used] = True
                elif what == RETURN:
                    reset(new_mean[used], new_cov[used], offsets[z], 0.0)
                    new_regime[used] = False
            gap = _compare(new_mean[used], new_cov[used], rows, value, noise, far)
            _condition(new_mean[used], new_cov[used], gap)
            log_weight[used] = base + prior + gap[6]
            used += 1
            if what == NOTHING and event == UNKNOWN and chance[BLUNDER] > 0.0:
                _copy(m, p, new_mean[used], new_cov[used])
                new_regime[used], blunder[used] = regime[k], True
                log_weight[used] = base + math.log(chance[BLUNDER]) + gap[7]
                used += 1
    top, mistaken = -np.inf, 0.0
    for k in range(used):
        top = max(top, log_weight[k])
    for k in range(used):
        new_weight[k] = math.exp(log_weight[k] - top)
        if blunder[k]:
            mistaken += new_weight[k]
    total = _total(new_weight, used)
    keep = _reduce(new_mean, new_cov, new_weight, new_regime, used)
    kept = len(keep)
    kept_weight, kept_regime = np.empty(kept), np.empty(kept, dtype=np.bool_)
    kept_mean, kept_cov = np.empty((kept, size)), np.empty((kept, size, size))
    for k in range(kept):
        kept_weight[k], kept_regime[k] = new_weight[keep[k]], new_regime[keep[k]]
        _copy(new_mean[keep[k]], new_cov[keep[k]], kept_mean[k], kept_cov[k])
    total_kept = _total(kept_weight, kept)
    for k in range(kept):
        kept_weight[k] /= total_kept
    return kept_weight, kept_mean, kept_cov, kept_regime, top + math.log(total), mistaken / total
