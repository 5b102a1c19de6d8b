# mypy: disable-error-code="no-untyped-call, untyped-decorator"
# mypy: allow-untyped-defs
"""Compiled: distances to keep-out volumes, and beams marched towards them.

A volume is stored as SIZE numbers: kind; centre and radius of an enclosing sphere; then, by kind,
the values listed at `SIZE`. The corners of all prisms are in one array of (x, y); a prism stores
the index of its first corner and the number of its corners.

A beam is a solid of revolution about a ray: at distance t along the ray its radius is r(t) = R ·
max(1, t / b) + q t, where R is the mirror radius, b the focal distance and q the spread.
|cos θ − t / b| and |1 − t cos θ / b| are the half-widths of the beam of an ideal mirror, in and
across the plane of incidence θ, in units of R. They never exceed max(1, t / b), so the solid
contains the beam at every incidence, including its astigmatism.

A distance function never changes by more than the distance travelled, and r never grows faster than
R / b + q. Therefore, with clearance g = distance − r, the beam is clear for at least another g / (1
+ R / b + q), and marching in such steps misses nothing.
"""

import math

from numba import njit

from heliotrope.jit import INLINED, INNER, OPTIONS
from heliotrope.mechanism.kernels.vectors import about, across, add, cross, dot, minus, norm, times

SPHERE, BOX, CYLINDER, PRISM = range(4)
#: Kind, bounding centre (3) and radius, and then:
#: box: half sizes (3), cosine and sine of its turn; cylinder: unit axis (3), half length,
#: radius; prism: half height, first corner, number of corners.
SIZE = 10
#: A beam closer to a volume than this (m) counts as inside it.
TOUCH = 1e-3
#: Maximum number of steps of one march; if they run out, the beam counts as in the volume.
STEPS = 2000


@njit(**INLINED)
def distance_to(row, corners, p):
    """Signed distance of the point p from the volume's surface, m; negative inside."""
    u = (p[0] - row[1], p[1] - row[2], p[2] - row[3])
    kind = int(row[0])
    if kind == SPHERE:
        return norm(u) - row[4]
    if kind == BOX:
        x = abs(u[0] * row[8] + u[1] * row[9]) - row[5]
        y = abs(u[1] * row[8] - u[0] * row[9]) - row[6]
        z = abs(u[2]) - row[7]
        outside = norm((max(x, 0.0), max(y, 0.0), max(z, 0.0)))
        return outside + min(max(x, y, z), 0.0)
    if kind == CYLINDER:
        axis = (row[5], row[6], row[7])
        return _extruded(norm(across(u, axis)) - row[9], abs(dot(u, axis)) - row[8])
    first = int(row[6])
    flat = _polygon(corners, first, first + int(row[7]), p[0], p[1])
    return _extruded(flat, abs(u[2]) - row[5])


@njit(**INLINED)
def _extruded(flat, along):
    """Distance from a solid whose cross-section is ``flat`` away and whose ends ``along`` away."""
    outside = math.sqrt(max(flat, 0.0) ** 2 + max(along, 0.0) ** 2)
    return outside + min(max(flat, along), 0.0)


@njit(**INNER)
def _polygon(corners, first, last, x, y):
    """Signed distance of (x, y) from a polygon; negative inside (odd number of crossings)."""
    best, inside = math.inf, False
    for i in range(first, last):
        j = i - 1 if i > first else last - 1
        ax, ay, bx, by = corners[i, 0], corners[i, 1], corners[j, 0], corners[j, 1]
        ex, ey, wx, wy = bx - ax, by - ay, x - ax, y - ay
        share = min(1.0, max(0.0, (wx * ex + wy * ey) / (ex * ex + ey * ey)))
        best = min(best, (wx - share * ex) ** 2 + (wy - share * ey) ** 2)
        if (ay > y) != (by > y) and x < ax + (y - ay) / (by - ay) * (bx - ax):
            inside = not inside
    return -math.sqrt(best) if inside else math.sqrt(best)


@njit(**OPTIONS)
def distances(table, corners, points, out):
    """Write the signed distances of points (P, 3) from volumes (V, SIZE) into ``out`` (P, V)."""
    for i in range(len(points)):
        p = (points[i, 0], points[i, 1], points[i, 2])
        for v in range(len(table)):
            out[i, v] = distance_to(table[v], corners, p)


@njit(**INLINED)
def _radius(t, radius, near, spread):
    return radius * max(1.0, t * near) + spread * t


@njit(**INLINED)
def apart(row, o, d, reach, radius, near, spread):
    """Whether the beam certainly misses the sphere that encloses the volume.

    At u from its nearest point the ray is √(h² + u²) from the centre and the beam's radius
    has grown by at most k u; √(h² + u²) − k u is at least h √(1 − k²).
    """
    u = (row[1] - o[0], row[2] - o[1], row[3] - o[2])
    t = min(max(dot(u, d), 0.0), reach)
    h = norm(minus(u, times(t, d)))
    growth = radius * near + spread
    if growth >= 1.0:
        return False
    wide = row[4] + _radius(t, radius, near, spread) + TOUCH
    return h * math.sqrt(1.0 - growth * growth) > wide


@njit(**INLINED)
def contact(row, corners, o, d, reach, radius, near, spread):
    """Distance along the ray at which the beam first touches the volume, m; −1 if it never does."""
    if apart(row, o, d, reach, radius, near, spread):
        return -1.0
    gain = 1.0 / (1.0 + radius * near + spread)
    t = 0.0
    for _ in range(STEPS):
        gap = distance_to(row, corners, add(o, times(t, d))) - _radius(t, radius, near, spread)
        if gap <= TOUCH:
            return t
        t += gap * gain
        if t > reach:
            return -1.0
    return t


@njit(**INLINED)
def last_contact(row, corners, o, d, first, reach, radius, near, spread):
    """Distance along the ray, m, from ``first`` on, at which the beam last touches the volume."""
    gain = 1.0 / (1.0 + radius * near + spread)
    t = reach
    for _ in range(STEPS):
        gap = distance_to(row, corners, add(o, times(t, d))) - _radius(t, radius, near, spread)
        if gap <= TOUCH:
            return t
        t -= gap * gain
        if t <= first:
            return first
    return t


@njit(**OPTIONS)
def enter(table, corners, origin, direction, reach, radius, near, spread, first, last):
    """Compute the first and the last contact of N beams with V volumes, m, (N, V); NaN if none."""
    for i in range(len(origin)):
        o = (origin[i, 0], origin[i, 1], origin[i, 2])
        d = (direction[i, 0], direction[i, 1], direction[i, 2])
        for v in range(len(table)):
            t = contact(table[v], corners, o, d, reach[i], radius[i], near[i], spread[i])
            if t < 0.0:
                first[i, v] = last[i, v] = math.nan
            else:
                first[i, v] = t
                last[i, v] = last_contact(
                    table[v], corners, o, d, t, reach[i], radius[i], near[i], spread[i]
                )


@njit(**INLINED)
def _pose(a, angle_1, angle_2):
    """Compute the normal and the vertex of an armature (18) at its joint angles."""
    axis_1, axis_2 = (a[0], a[1], a[2]), (a[6], a[7], a[8])
    o1, o2 = (a[3], a[4], a[5]), (a[9], a[10], a[11])
    m, n = (a[12], a[13], a[14]), (a[15], a[16], a[17])
    s1, c1, s2, c2 = math.sin(angle_1), math.cos(angle_1), math.sin(angle_2), math.cos(angle_2)
    normal = about(axis_1, s1, c1, about(axis_2, s2, c2, n))
    arm = add(minus(o2, o1), about(axis_2, s2, c2, minus(m, o2)))
    return normal, add(o1, about(axis_1, s1, c1, arm))


@njit(**INLINED)
def _levers(a):
    """Compute the largest displacement of the vertex per radian of each joint, m."""
    axis_1, axis_2 = (a[0], a[1], a[2]), (a[6], a[7], a[8])
    o1, o2, m = (a[3], a[4], a[5]), (a[9], a[10], a[11]), (a[12], a[13], a[14])
    elbow, arm = minus(o2, o1), minus(m, o2)
    return norm(across(elbow, axis_1)) + norm(arm), norm(cross(axis_2, arm))


@njit(**INNER)
def _move(row, corners, a, path, sun, reach, radius, near, spread, resolution, entry):
    """Find where, along a path (K, 2) of joint angles, a beam first enters the volume.

    Over a span of the path whose joints rotate by at most δ₁ and δ₂ from its middle, the normal
    rotates by at most δ₁ + δ₂, the beam by at most twice that, and the vertex moves by at most the
    levers times δ. If a beam widened by these amounts is clear at the middle, the beam is clear
    over the whole span. Otherwise the span is halved, down to a beam rotation of ``resolution``; a
    span that still cannot be proven clear counts as an entry.

    Writes into ``entry``: the index of the path's corner plus the fraction of the leg up to which
    the path is clear; the distance along the beam, m; and the beam's origin and direction in the
    pose just after. Returns the number of poses that were tried, negative if the beam enters.
    """
    lever_1, lever_2 = _levers(a)
    tried = 0
    for k in range(max(1, len(path) - 1)):
        after = min(k + 1, len(path) - 1)
        turn_1, turn_2 = path[after, 0] - path[k, 0], path[after, 1] - path[k, 1]
        total = abs(turn_1) + abs(turn_2)
        smallest = 1.0 if total == 0.0 else min(1.0, 0.5 * resolution / total)
        begin, span = 0.0, min(1.0, max(smallest, 0.1 / max(total, 1e-12)))
        while begin < 1.0:
            span = min(span, 1.0 - begin)
            middle, half = begin + 0.5 * span, 0.5 * span
            n, o = _pose(a, path[k, 0] + middle * turn_1, path[k, 1] + middle * turn_2)
            cosine = dot(n, sun)
            turned = half * total
            tried += 1
            clear = cosine <= -turned
            if not clear:
                d = minus(times(2.0 * cosine, n), sun)
                moved = half * (abs(turn_1) * lever_1 + abs(turn_2) * lever_2)
                t = contact(row, corners, o, d, reach, radius + moved, near, spread + 2.0 * turned)
                clear = t < 0.0
                if not clear and span <= smallest * 1.0000001:
                    entry[0], entry[1] = k + begin, t
                    for i in range(3):
                        entry[2 + i], entry[5 + i] = o[i], d[i]
                    return -tried
            if clear:
                begin += span
                span *= 2.0
            else:
                span = max(0.5 * span, smallest)
    return tried


@njit(**OPTIONS)
def move(table, corners, armatures, path, sun, reach, radius, near, spread, resolution, entries):
    """Do as `_move`, for N heliostats and V volumes, into ``entries`` (N, V, 8); NaN if clear.

    Returns the number of poses that were tried.
    """
    tried = 0
    for i in range(len(armatures)):
        s = (sun[i, 0], sun[i, 1], sun[i, 2])
        for v in range(len(table)):
            for c in range(entries.shape[2]):
                entries[i, v, c] = math.nan
            poses = _move(
                table[v],
                corners,
                armatures[i],
                path[i],
                s,
                reach[i],
                radius[i],
                near[i],
                spread[i],
                resolution,
                entries[i, v],
            )
            tried += abs(poses)
    return tried
