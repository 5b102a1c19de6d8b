# mypy: disable-error-code="no-untyped-call, untyped-decorator"
# mypy: allow-untyped-defs
"""Compiled: the strongest light in the air, by branch and bound.

A cube of air is split into eight, again and again. In each cube, the irradiance of a beam has a
bound: that at the smallest distance of the cube from the axis, for the distance along the axis that
gives most. The sum over the beams bounds the light in the cube, and a cube whose bound does not
exceed the light at the best known point need not be split. No peak is missed, however narrow.

The stack holds the cubes that are still to be split; the pool holds, for each of them, the numbers
of the beams that reach it.

A beam is a row of ten numbers: origin (3), unit direction (3), radius of the mirror's disk, m,
inverse focal distance, 1/m, reach, m, and reflectivity. Its irradiance is that of `beam.crossing`.
"""

import math

import numpy as np
from numba import njit

from heliotrope.jit import INNER, OPTIONS

#: Numbers of a beam.
BEAM = 10
#: Smallest |1 − x / b|, as in `beam.crossing`.
_LEAST_GAP = 1e-4
#: Numbers of a cube on the stack: centre (3), half of its side, key, first and last beam, and the
#: end of all lists of beams when it was put there.
_CUBE = 8
#: Children are split at most this often; a side of 1 km becomes 0.1 mm.
_DEPTH = 24


@njit(**INNER)
def _common(r, s, d):
    """Area common to two disks with radii r and s and centres d apart, over π."""
    if d >= r + s:
        return 0.0
    small = min(r, s)
    if d <= abs(r - s):
        return small * small
    a = min(1.0, max(-1.0, (d * d + r * r - s * s) / (2.0 * d * r)))
    b = min(1.0, max(-1.0, (d * d + s * s - r * r) / (2.0 * d * s)))
    kite = max((r + s - d) * (d + r - s) * (d - r + s) * (d + r + s), 0.0)
    lens = (r * r * math.acos(a) + s * s * math.acos(b) - 0.5 * math.sqrt(kite)) / math.pi
    return min(max(lens, 0.0), small * small)


@njit(**INNER)
def _light(beam, x, y, z, sun):
    """Irradiance of a beam at a point, in suns."""
    u, v, w = x - beam[0], y - beam[1], z - beam[2]
    along = u * beam[3] + v * beam[4] + w * beam[5]
    if along <= 0.0 or along > beam[8]:
        return 0.0
    off = math.sqrt(max(u * u + v * v + w * w - along * along, 0.0))
    gap = max(abs(1.0 - along * beam[7]), _LEAST_GAP)
    disk = along * sun
    return beam[9] * _common(beam[6], disk / gap, off / gap) / (disk * disk)


@njit(**INNER)
def _most(beam, x, y, z, half, sun):
    """Bound of the irradiance of a beam in a cube, in suns.

    With g = |1 − x / b|, the disk of the mirror as it is seen in the plane of the point has the
    radius R g, and the sun's has x β. Their common area grows with both radii.
    """
    u, v, w = x - beam[0], y - beam[1], z - beam[2]
    along = u * beam[3] + v * beam[4] + w * beam[5]
    room = half * (abs(beam[3]) + abs(beam[4]) + abs(beam[5]))
    near, far = along - room, min(along + room, beam[8])
    if far <= 0.0 or near > far:
        return 0.0
    square = u * u + v * v + w * w - along * along
    gap_near, gap_far = 1.0 - near * beam[7], 1.0 - far * beam[7]
    wide = max(abs(gap_near), abs(gap_far), _LEAST_GAP)
    reach = beam[6] * wide + far * sun + 1.7320509 * half
    if square >= reach * reach:
        return 0.0
    off = math.sqrt(max(square, 0.0))
    if off > 0.0:
        # The cube extends this far towards the axis.
        u, v, w = u - along * beam[3], v - along * beam[4], w - along * beam[5]
        off -= half * (abs(u) + abs(v) + abs(w)) / off
        if off >= beam[6] * wide + far * sun:
            return 0.0
    thin = _LEAST_GAP
    if gap_near * gap_far > 0.0:
        thin = max(min(abs(gap_near), abs(gap_far)), _LEAST_GAP)
    if near <= 0.0:
        return beam[9] / (thin * thin)
    disk = near * sun
    # No point sees the sun in more than the whole mirror, nor brighter than a mirror of any size.
    cap = min(beam[6] / disk, 1.0 / thin)
    cap *= cap
    if off <= 0.0 or off <= abs(beam[6] * wide - far * sun):
        return beam[9] * cap
    return beam[9] * min(cap, _common(beam[6] * wide, far * sun, off) / (disk * thin) ** 2)


@njit(**OPTIONS)
def light_at(beams, points, sun, light):
    """Write the light of all beams (N, BEAM) at points (P, 3), in suns, to light (P,)."""
    for k in range(len(points)):
        total = 0.0
        for i in range(len(beams)):
            total += _light(beams[i], points[k, 0], points[k, 1], points[k, 2], sun)
        light[k] = total


@njit(**INNER)
def _begin(beams, middle, half):
    """Return the pool and the stack with the first cube, which all beams reach."""
    pool = np.empty(len(beams) * (8 * _DEPTH + 1), dtype=np.int32)
    for i in range(len(beams)):
        pool[i] = i
    stack = np.empty((7 * _DEPTH + 9, _CUBE))
    for m in range(3):
        stack[0, m] = middle[m]
    stack[0, 3], stack[0, 4], stack[0, 5] = half, math.inf, 0.0
    stack[0, 6] = stack[0, 7] = len(beams)
    return pool, stack


@njit(**INNER)
def _octant(cube, corner, child):
    """Write centre and half side of one of the eight parts of a cube to ``child``."""
    side = 0.5 * cube[3]
    for m in range(3):
        child[m] = cube[m] + (side if corner >> m & 1 else -side)
    child[3] = side


@njit(**INNER)
def _reached(beams, pool, first, last, begin, child, sun):
    """List the beams that reach a cube from ``begin`` on; return the bound and the list's end."""
    bound, end = 0.0, begin
    for k in range(first, last):
        most = _most(beams[pool[k]], child[0], child[1], child[2], child[3], sun)
        if most > 0.0:
            bound += most
            pool[end] = pool[k]
            end += 1
    return bound, end


@njit(**INNER)
def _sum(beams, pool, first, last, x, y, z, sun):
    total = 0.0
    for k in range(first, last):
        total += _light(beams[pool[k]], x, y, z, sun)
    return total


@njit(**INNER)
def _put(stack, height, child, key, begin, end):
    for m in range(4):
        stack[height, m] = child[m]
    stack[height, 4], stack[height, 5], stack[height, 6] = key, begin, end


@njit(**INNER)
def _sort(stack, bottom, height, end):
    """Sort the cubes from ``bottom`` on by their keys, the highest last, and note ``end``."""
    for i in range(bottom, height):
        stack[i, 7] = end
        for j in range(i, bottom, -1):
            if stack[j, 4] >= stack[j - 1, 4]:
                break
            for m in range(_CUBE):
                stack[j, m], stack[j - 1, m] = stack[j - 1, m], stack[j, m]


@njit(**INNER)
def _farthest(child, middle):
    """Distance of the farthest corner of a cube from a point."""
    a = abs(child[0] - middle[0]) + child[3]
    b = abs(child[1] - middle[1]) + child[3]
    c = abs(child[2] - middle[2]) + child[3]
    return math.sqrt(a * a + b * b + c * c)


@njit(**OPTIONS)
def strongest(beams, low, middle, half, sun, share, least, work, enough, best):
    """Find the strongest light in a cube, and a bound that it nowhere exceeds.

    beams (N, BEAM); low: height below which there is no air; middle (3,) and half: the cube; sun:
    the sun's angular radius; share: cubes are not split if their bounds exceed the best point by
    less than this share; least: half side of the smallest cubes; work: bounds of beams that may be
    computed; enough: the search ends at a point with more light. best (4,): a point and its light,
    which are improved. Returns the bound.
    """
    pool, stack = _begin(beams, middle, half)
    cube, child = np.empty(_CUBE), np.empty(4)
    height, most = 1, best[3]
    while height > 0:
        height -= 1
        for m in range(_CUBE):
            cube[m] = stack[height, m]
        first, last, bottom, end = int(cube[5]), int(cube[6]), height, int(cube[7])
        ends = 0.5 * cube[3] < least or work <= 0 or best[3] > enough
        if ends or cube[4] <= best[3] * (1.0 + share):
            most = max(most, cube[4])
            continue
        for corner in range(8):
            _octant(cube, corner, child)
            if child[2] + child[3] <= low:
                continue
            begin = end
            bound, end = _reached(beams, pool, first, last, begin, child, sun)
            work -= last - first
            if bound > best[3] and child[2] > low:
                light = _sum(beams, pool, begin, end, child[0], child[1], child[2], sun)
                work -= end - begin
                if light > best[3]:
                    best[0], best[1], best[2], best[3] = child[0], child[1], child[2], light
            if bound <= best[3] * (1.0 + share):
                most, end = max(most, bound), begin
                continue
            _put(stack, height, child, bound, begin, end)
            height += 1
        _sort(stack, bottom, height, end)
    return most


@njit(**OPTIONS)
def reach(beams, low, middle, half, sun, limit, least):
    """Distance from the middle of a cube beyond which no light in the cube exceeds a limit.

    For the arguments see `strongest`. The distance is that of the farthest corner of a cube.
    """
    pool, stack = _begin(beams, middle, half)
    cube, child = np.empty(_CUBE), np.empty(4)
    height, distance = 1, 0.0
    while height > 0:
        height -= 1
        for m in range(_CUBE):
            cube[m] = stack[height, m]
        first, last, bottom, end = int(cube[5]), int(cube[6]), height, int(cube[7])
        if cube[4] <= distance:
            continue
        if 0.5 * cube[3] < least:
            distance = cube[4]
            continue
        for corner in range(8):
            _octant(cube, corner, child)
            away = _farthest(child, middle)
            if child[2] + child[3] <= low or away <= distance:
                continue
            begin = end
            bound, end = _reached(beams, pool, first, last, begin, child, sun)
            if bound <= limit:
                end = begin
                continue
            _put(stack, height, child, away, begin, end)
            height += 1
        _sort(stack, bottom, height, end)
    return distance
