"""Compiled: motor counts to a joint angle, its derivatives, and the inverse."""

import math

from numba import njit

from heliotrope.jit import INLINED, INNER, OPTIONS
from heliotrope.mechanism.kernels.slots import (
    BIAS,
    KIND,
    LINEAR,
    MAX_COUNT,
    MIN_COUNT,
    OFFSET,
    RADIUS,
    RATE,
    SAG,
    SAG_PHASE,
    SCALE,
    SENSE,
    STROKE,
    WORM_COS,
    WORM_RATIO,
    WORM_SIN,
    ZERO,
)


@njit(**INLINED)
def load_drive(table, i, k):
    """Return drive ``k`` of row ``i`` as a tuple, which stays in registers."""
    r = (table[i, k, 0], table[i, k, 1], table[i, k, 2], table[i, k, 3], table[i, k, 4])
    s = (table[i, k, 5], table[i, k, 6], table[i, k, 7], table[i, k, 8], table[i, k, 9])
    t = (table[i, k, 10], table[i, k, 11], table[i, k, 12], table[i, k, 13], table[i, k, 14])
    return r + s + t + (table[i, k, 15], table[i, k, 16], table[i, k, 17], table[i, k, 18])


@njit(**INNER)
def count_range(d):
    """Return the lowest and highest counts of drive row ``d``.

    They follow from its stops and from the ends of a jack's triangle.
    """
    low, high = d[MIN_COUNT], d[MAX_COUNT]
    if d[KIND] == LINEAR:
        folded = (abs(d[OFFSET] - d[RADIUS]) - d[STROKE]) / d[RATE]
        stretched = (d[OFFSET] + d[RADIUS] - d[STROKE]) / d[RATE]
        least, most = min(folded, stretched), max(folded, stretched)
        low, high = min(max(low, least), most), max(min(high, most), least)
    return low, high


@njit(**INNER)
def triangle_angle(length, offset, radius):
    """Return the triangle's angle at the joint, from (offset, radius, length), within [0, π]."""
    cosine = (offset * offset + radius * radius - length * length) / (2.0 * offset * radius)
    return math.acos(min(1.0, max(-1.0, cosine)))


@njit(**INNER)
def _triangle_slope(length, offset, radius):
    """Return dΦ/dL of the triangle; infinite where the triangle is stretched flat."""
    return length / (offset * radius * math.sin(triangle_angle(length, offset, radius)))


@njit(**INNER)
def ideal_angle(d, counts):
    """Return the angle φ of drive row ``d`` before bias, scale, worm and sag."""
    if d[KIND] == LINEAR:
        length = d[STROKE] + d[RATE] * counts
        return d[ZERO] + d[SENSE] * (
            triangle_angle(d[STROKE], d[OFFSET], d[RADIUS])
            - triangle_angle(length, d[OFFSET], d[RADIUS])
        )
    return d[ZERO] + d[RATE] * counts


@njit(**INNER)
def _worm_argument(d, counts, phi):
    if d[KIND] == LINEAR:
        return d[WORM_RATIO] * d[RATE] * counts
    return d[WORM_RATIO] * phi


@njit(**INNER)
def drive_angle(d, counts):
    """Return the joint angle θ = bias + (1 + scale) φ + worm + sag of drive row ``d``."""
    phi = ideal_angle(d, counts)
    theta = d[BIAS] + (1.0 + d[SCALE]) * phi
    if d[WORM_COS] != 0.0 or d[WORM_SIN] != 0.0:
        u = _worm_argument(d, counts, phi)
        theta += d[WORM_COS] * math.cos(u) + d[WORM_SIN] * math.sin(u)
    if d[SAG] != 0.0:
        theta += d[SAG] * math.cos(phi + d[SAG_PHASE])
    return theta


@njit(**INNER)
def angle_per_ideal(d, counts, phi):
    """Return dθ/dφ at a constant worm argument, and dθ/du of the worm."""
    slope = 1.0 + d[SCALE] - d[SAG] * math.sin(phi + d[SAG_PHASE])
    worm = 0.0
    if d[WORM_COS] != 0.0 or d[WORM_SIN] != 0.0:
        u = _worm_argument(d, counts, phi)
        worm = -d[WORM_COS] * math.sin(u) + d[WORM_SIN] * math.cos(u)
    return slope, worm


@njit(**INNER)
def angle_per_count(d, counts):
    """Return dθ/dcounts of drive row ``d``."""
    phi = ideal_angle(d, counts)
    slope, worm = angle_per_ideal(d, counts, phi)
    if d[KIND] == LINEAR:
        length = d[STROKE] + d[RATE] * counts
        phi_rate = -d[SENSE] * d[RATE] * _triangle_slope(length, d[OFFSET], d[RADIUS])
        return slope * phi_rate + worm * d[WORM_RATIO] * d[RATE]
    return (slope + worm * d[WORM_RATIO]) * d[RATE]


@njit(**INNER)
def angle_per_slot(d, counts, slot):
    """Return dθ/d(slot) of drive row ``d`` at constant counts."""
    phi = ideal_angle(d, counts)
    if slot == BIAS:
        return 1.0
    if slot == SCALE:
        return phi
    if slot == WORM_COS:
        return math.cos(_worm_argument(d, counts, phi))
    if slot == WORM_SIN:
        return math.sin(_worm_argument(d, counts, phi))
    if slot == SAG:
        return math.cos(phi + d[SAG_PHASE])
    slope, worm = angle_per_ideal(d, counts, phi)
    if d[KIND] != LINEAR:
        slope += worm * d[WORM_RATIO]
        if slot == ZERO:
            return slope
        if slot == RATE:
            return slope * counts
        return 0.0
    if slot == ZERO:
        return slope
    c, r, k = d[OFFSET], d[RADIUS], d[STROKE]
    length = k + d[RATE] * counts
    if slot == STROKE:
        return slope * d[SENSE] * (_triangle_slope(k, c, r) - _triangle_slope(length, c, r))
    if slot == RATE:
        stretch = -d[SENSE] * counts * _triangle_slope(length, c, r)
        return slope * stretch + worm * d[WORM_RATIO] * counts
    # ∂cosΦ/∂c = (c² − r² + L²)/(2 c² r), and the same with c and r exchanged.
    if slot == RADIUS:
        c, r = r, c
    elif slot != OFFSET:
        return 0.0
    first = (c * c - r * r + k * k) / (2.0 * c * c * r) / math.sin(triangle_angle(k, c, r))
    second = (c * c - r * r + length * length) / (2.0 * c * c * r)
    second /= math.sin(triangle_angle(length, c, r))
    return slope * d[SENSE] * (second - first)


@njit(**INNER)
def _counts_of_ideal(d, phi):
    """Return the counts at which the ideal angle is ``phi``, clamped to a jack's triangle."""
    if d[KIND] == LINEAR:
        c, r = d[OFFSET], d[RADIUS]
        angle = triangle_angle(d[STROKE], c, r) - d[SENSE] * (phi - d[ZERO])
        angle = min(math.pi, max(0.0, angle))
        # (c − r)² + 4 c r sin²(Φ/2) keeps its precision when the jack is folded.
        half = math.sin(0.5 * angle)
        length = math.sqrt((c - r) * (c - r) + 4.0 * c * r * half * half)
        return (length - d[STROKE]) / d[RATE]
    return (phi - d[ZERO]) / d[RATE]


@njit(**INNER)
def drive_counts(d, theta):
    """Return the counts of drive row ``d`` at joint angle ``theta``.

    Without periodic terms this is a closed form. With periodic terms it is a bracketed Newton
    iteration in counts, which cannot leave the bracket that follows from the size of these terms.
    """
    phi = (theta - d[BIAS]) / (1.0 + d[SCALE])
    counts = _counts_of_ideal(d, phi)
    span = (abs(d[WORM_COS]) + abs(d[WORM_SIN]) + abs(d[SAG])) / abs(1.0 + d[SCALE])
    if span == 0.0:
        return counts
    low = _counts_of_ideal(d, phi - span)
    high = _counts_of_ideal(d, phi + span)
    f_low = drive_angle(d, low) - theta
    for _ in range(100):
        error = drive_angle(d, counts) - theta
        step = error / angle_per_count(d, counts)
        if abs(step) <= 4e-16 * max(abs(counts), 1.0) or abs(error) < 1e-15:
            return counts - step
        if (error > 0.0) == (f_low > 0.0):
            low = counts
        else:
            high = counts
        counts -= step
        if not min(low, high) < counts < max(low, high):
            counts = 0.5 * (low + high)
    return counts


@njit(**OPTIONS)
def angles_block(drives, counts, rows, out, start, stop):
    """Return θ of every drive for ``drives`` (N, D, S), ``counts`` (M, D) and ``rows`` (M,)."""
    for i in range(start, stop):
        for k in range(counts.shape[1]):
            out[i, k] = drive_angle(load_drive(drives, rows[i], k), counts[i, k])


@njit(**OPTIONS)
def counts_block(drives, angles, rows, out, start, stop):
    """Return the counts of every drive, the inverse of `angles_block`."""
    for i in range(start, stop):
        for k in range(angles.shape[1]):
            out[i, k] = drive_counts(load_drive(drives, rows[i], k), angles[i, k])


@njit(**OPTIONS)
def slopes_block(drives, counts, rows, out, start, stop):
    """Return dθ/dcounts of every drive."""
    for i in range(start, stop):
        for k in range(counts.shape[1]):
            out[i, k] = angle_per_count(load_drive(drives, rows[i], k), counts[i, k])
