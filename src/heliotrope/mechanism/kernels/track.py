"""Compiled: joint angles at which an armature reflects light from a source to an aim point.

Directions are solved in closed form (second Paden-Kahan subproblem): R(a, θ₁) R(b, θ₂) u = v is
satisfied where z = R(b, θ₂) u = R(−a, θ₁) v has the components z·a = v·a and z·b = u·b. Of the two
solutions for z, one is branch 0 (− a × b) and the other is branch 1 (+ a × b). The vertex moves
with the angles, so v depends on the angles. The kernel therefore iterates: first a fixed-point
iteration, then, where that converges slowly, Newton's method with the screw derivative, safeguarded
by Levenberg damping.

Everything is a tuple of floats: an armature ``g`` of 18, a vector of 3, and a rotation ``t`` = (sin
θ₁, cos θ₁, sin θ₂, cos θ₂). Array slices would update a shared reference count at every call, so
that threads would wait for each other.
"""

import math

import numpy as np
from numba import njit

from heliotrope.jit import INLINED, INNER, plain
from heliotrope.mechanism.kernels.vectors import (
    about,
    across,
    add,
    angle,
    cross,
    dot,
    minus,
    norm,
    times,
    turn_between,
)

OK = 0
UNREACHABLE = 1  # inside the dead cone around the primary axis
STOPPED = 2  # beyond a stop
NOT_CONVERGED = 3
DEGENERATE = 4  # source opposite to aim, aim in the vertex, or a value not finite
BEHIND = 5  # an aim fixed to the mirror but not in front of it

#: Newton replaces the fixed-point iteration if a step reduces the error by less than this factor.
SLOW = 0.3
#: Maximum number of Newton iterations, and of damping trials in each iteration.
NEWTON_LIMIT, DAMPING_LIMIT = 60, 30
#: Number of Gauss-Newton steps before the curvature of n − v itself is included.
PATIENCE = 8
#: A pose is degenerate if source and aim are closer to opposite than this (rad), or if the aim is
#: nearer to the vertex than this (m).
DEGENERATE_LIMIT = 1e-9


@njit(**INLINED)
def load_armature(table, i):
    """Return row ``i`` of armatures (N, 18) as a tuple."""
    r = (table[i, 0], table[i, 1], table[i, 2], table[i, 3], table[i, 4], table[i, 5])
    s = (table[i, 6], table[i, 7], table[i, 8], table[i, 9], table[i, 10], table[i, 11])
    return (
        r
        + s
        + (
            table[i, 12],
            table[i, 13],
            table[i, 14],
            table[i, 15],
            table[i, 16],
            table[i, 17],
        )
    )


@njit(**INLINED)
def axis_1(g):
    """Return the primary axis."""
    return g[0], g[1], g[2]


@njit(**INLINED)
def axis_2(g):
    """Return the secondary axis at zero primary angle; it has zero length if there is none."""
    return g[6], g[7], g[8]


@njit(**INLINED)
def is_single(g):
    """Return whether there is no secondary axis."""
    return g[6] == 0.0 and g[7] == 0.0 and g[8] == 0.0


@njit(**INLINED)
def constants(g, u):
    """Return the constants of the solution for mirror vector ``u``, the same in all steps.

    With z = α a + β b + γ c and c = a × b, sine and cosine of θ₂ are linear in α and γ. The
    constants are (a·b, u·b, 1/|c|², coefficients of α and γ in the sine, and in the cosine).
    """
    a, b = axis_1(g), axis_2(g)
    if is_single(g):
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    c = cross(a, b)
    ab, ub = dot(a, b), dot(u, b)
    flat = across(u, b)
    inverse = 1.0 / dot(flat, flat)
    e, f = times(inverse, cross(b, u)), times(inverse, flat)
    return ab, ub, 1.0 / dot(c, c), dot(e, a), dot(e, c), dot(f, a), dot(f, c)


@njit(**INLINED)
def solve_direction(g, k, u, v, sign):
    """Rotate both joints so that ``u`` (specified at zero angles) is parallel to v.

    ``k`` are the `constants` of u. Returns (whether v was reached, t). Inside
    the dead cone the pose is the nearest.
    """
    a, b = axis_1(g), axis_2(g)
    if is_single(g):
        sine, cosine = turn_between(a, u, v)
        return True, (sine, cosine, 0.0, 1.0)
    ab, ub, inverse = k[0], k[1], k[2]
    va, vb, vc = dot(v, a), dot(v, b), dot(v, cross(a, b))
    component = va
    along_a, along_b = (va - ab * ub) * inverse, (ub - ab * va) * inverse
    square = 1.0 - along_a * along_a - along_b * along_b - 2.0 * along_a * along_b * ab
    # Rounding below zero is the edge of the reachable band itself.
    reached = square >= -4e-16
    if not reached:
        # The nearest direction on the edge has the largest |z·a| on the circle z·b = u·b.
        edge = math.sqrt(max(0.0, 1.0 - ub * ub) / inverse)
        component = ab * ub + math.copysign(edge, va - ab * ub)
        along_a, along_b = (component - ab * ub) * inverse, (ub - ab * component) * inverse
    away = sign * math.sqrt(max(0.0, square) * inverse)
    sine_2, cosine_2 = along_a * k[3] + away * k[4], along_a * k[5] + away * k[6]
    # a·(z × v) and z·v − (z·a)(v·a), written in the components of z.
    sine_1 = along_b * vc + away * (ab * va - vb)
    cosine_1 = along_a * va + along_b * vb + away * vc - component * va
    size = math.sqrt(sine_1 * sine_1 + cosine_1 * cosine_1)
    if size < 1e-15:
        return reached, (0.0, 1.0, sine_2, cosine_2)
    size = 1.0 / size
    return reached, (sine_1 * size, cosine_1 * size, sine_2, cosine_2)


@njit(**INLINED)
def turned(g, t, u):
    """Return the mirror vector ``u`` (specified at zero angles) at turn t."""
    if not is_single(g):
        u = about(axis_2(g), t[2], t[3], u)
    return about(axis_1(g), t[0], t[1], u)


@njit(**INLINED)
def place_vertex(g, t):
    """Return the vertex at turn t."""
    r = (g[12] - g[9], g[13] - g[10], g[14] - g[11])
    if not is_single(g):
        r = about(axis_2(g), t[2], t[3], r)
    r = about(axis_1(g), t[0], t[1], add(r, (g[9] - g[3], g[10] - g[4], g[11] - g[5])))
    return add(r, (g[3], g[4], g[5]))


@njit(**INLINED)
def served(g, s):
    """Return the part of source direction s that the mechanism can reflect.

    For two axes this is s itself, for a single axis the part perpendicular to the axis. It is a
    zero vector if a single axis points at the source.
    """
    if not is_single(g):
        return s
    flat = across(s, axis_1(g))
    size = norm(flat)
    if size < DEGENERATE_LIMIT:
        return 0.0, 0.0, 0.0
    return times(1.0 / size, flat)


@njit(**INLINED)
def wanted_normal(g, s, p, m):
    """Return the required normal, the direction from m to p, and the distance.

    The required normal is the bisector of s and that direction; the distance is 0 if there is none.
    For a single axis the path is projected onto the plane perpendicular to it; s must be the result
    of `served`.
    """
    path = minus(p, m)
    if is_single(g):
        path = across(path, axis_1(g))
    distance = norm(path)
    if not distance > DEGENERATE_LIMIT:
        return path, path, 0.0
    path = times(1.0 / distance, path)
    v = add(s, path)
    size = norm(v)
    if not size > DEGENERATE_LIMIT:
        return path, path, 0.0
    return times(1.0 / size, v), path, distance


@njit(**INLINED)
def mirror_normal(g, t):
    """Return the normal at turn t.

    For a single axis, this is its unit projection perpendicular to the axis.
    """
    n = turned(g, t, (g[15], g[16], g[17]))
    if is_single(g):
        n = across(n, axis_1(g))
        n = times(1.0 / norm(n), n)
    return n


@njit(**INLINED)
def beam_miss(s, path, distance, n):
    """Return the distance (m) between the aim and the ray reflected with normal n."""
    ray = minus(times(2.0 * dot(n, s), n), s)
    return distance * norm(cross(path, ray))


@njit(**INLINED)
def residual_angle(g, t, u, v):
    """Return the angle between the turned ``u`` and v.

    For a single axis it is measured in the plane perpendicular to the axis.
    """
    x = turned(g, t, u)
    if is_single(g):
        x = across(x, axis_1(g))
        x = times(1.0 / norm(x), x)
    return angle(x, v)


@njit(**INNER)
def _columns(g, t, n, m, k):
    """Return the derivatives (dn, dm) with respect to joint angle k: the screw formula."""
    if k == 0:
        w, o = axis_1(g), (g[3], g[4], g[5])
    else:
        w = about(axis_1(g), t[0], t[1], axis_2(g))
        o = (g[9] - g[3], g[10] - g[4], g[11] - g[5])
        o = add(about(axis_1(g), t[0], t[1], o), (g[3], g[4], g[5]))
    return cross(w, n), cross(w, minus(m, o))


@njit(**INNER)
def _difference_column(g, t, n, m, v, path, distance, k):
    """Return d(n − v) with respect to joint angle k; the bisector v moves with the vertex."""
    dn, dm = _columns(g, t, n, m, k)
    if is_single(g):
        dm = across(dm, axis_1(g))
    dpath = times(-1.0 / distance, across(dm, path))
    # |s + t| = 2 v·t for unit vectors.
    return minus(dn, times(0.5 / dot(v, path), across(dpath, v)))


@njit(**INNER)
def _gradient(g, s, p, theta_1, theta_2):
    """Return half the gradient of |n − v|² with respect to the two joint angles."""
    t = (math.sin(theta_1), math.cos(theta_1), math.sin(theta_2), math.cos(theta_2))
    m = place_vertex(g, t)
    v, path, distance = wanted_normal(g, s, p, m)
    if distance == 0.0:
        return np.nan, np.nan
    n = mirror_normal(g, t)
    gap = minus(n, v)
    first = _difference_column(g, t, n, m, v, path, distance, plain(0))
    second = _difference_column(g, t, n, m, v, path, distance, plain(1))
    return dot(first, gap), dot(second, gap)


@njit(**INNER)
def _curvature(g, s, p, theta_1, theta_2):
    """Return half the second derivatives of |n − v|², from differences of its gradient.

    Where n − v cannot become zero, its own curvature matters as much as the squared first
    derivatives, and Gauss-Newton would converge slowly.
    """
    h = 1e-5
    up_0, up_1 = _gradient(g, s, p, theta_1 + h, theta_2)
    down_0, down_1 = _gradient(g, s, p, theta_1 - h, theta_2)
    right_0, right_1 = _gradient(g, s, p, theta_1, theta_2 + h)
    left_0, left_1 = _gradient(g, s, p, theta_1, theta_2 - h)
    mixed = 0.25 * (up_1 - down_1 + right_0 - left_0) / h
    return 0.5 * (up_0 - down_0) / h, mixed, 0.5 * (right_1 - left_1) / h


@njit(**INNER)
def _newton(g, s, p, t, tolerance):
    """Minimise |n − v|² from turn t with Levenberg-damped Newton: (status, iterations, t)."""
    theta_1, theta_2 = math.atan2(t[0], t[1]), math.atan2(t[2], t[3])
    damping = 1e-12
    m = place_vertex(g, t)
    v, path, distance = wanted_normal(g, s, p, m)
    n = mirror_normal(g, t)
    gap = minus(n, v)
    cost = dot(gap, gap)
    for iteration in range(NEWTON_LIMIT):
        if beam_miss(s, path, distance, n) <= tolerance:
            return OK, iteration, t
        first = _difference_column(g, t, n, m, v, path, distance, plain(0))
        second = _difference_column(g, t, n, m, v, path, distance, plain(1))
        h00, h01, h11 = dot(first, first), dot(first, second), dot(second, second)
        e0, e1 = dot(first, gap), dot(second, gap)
        if iteration >= PATIENCE:
            c00, c01, c11 = _curvature(g, s, p, theta_1, theta_2)
            if math.isfinite(c00 + c01 + c11):
                # On a saddle the lowest curvature is made positive: downhill on both axes.
                lowest = 0.5 * (c00 + c11) - math.hypot(0.5 * (c00 - c11), c01)
                lift = max(0.0, -2.0 * lowest)
                h00, h01, h11 = c00 + lift, c01, c11 + lift
        improved = False
        for _ in range(DAMPING_LIMIT):
            d00, d11 = h00 + damping * (h00 + h11), h11 + damping * (h00 + h11)
            determinant = d00 * d11 - h01 * h01
            if determinant > 0.0:
                theta_1_new = theta_1 - (d11 * e0 - h01 * e1) / determinant
                theta_2_new = theta_2 - (d00 * e1 - h01 * e0) / determinant
                t_new = (
                    math.sin(theta_1_new),
                    math.cos(theta_1_new),
                    math.sin(theta_2_new),
                    math.cos(theta_2_new),
                )
                m_new = place_vertex(g, t_new)
                v_new, path_new, distance_new = wanted_normal(g, s, p, m_new)
                if distance_new > 0.0:
                    n_new = mirror_normal(g, t_new)
                    gap_new = minus(n_new, v_new)
                    cost_new = dot(gap_new, gap_new)
                    if cost_new < cost:
                        improved = True
                        break
            damping = max(10.0 * damping, 1e-12)
        if not improved:
            # A minimum with a remainder means that no pose near here sends the beam to p.
            return UNREACHABLE, iteration, t
        settled = cost_new > 1e-24 and cost - cost_new < 1e-13 * cost_new
        theta_1, theta_2, t, m, n, cost = theta_1_new, theta_2_new, t_new, m_new, n_new, cost_new
        v, path, distance, gap = v_new, path_new, distance_new, gap_new
        damping *= 0.1
        if settled:
            reached = beam_miss(s, path, distance, n) <= tolerance
            return (OK if reached else UNREACHABLE), iteration + 1, t
    if beam_miss(s, path, distance, n) <= tolerance:
        return OK, NEWTON_LIMIT, t
    return NOT_CONVERGED, NEWTON_LIMIT, t


@njit(**INLINED)
def solve_aim(g, s, p, m, sign, tolerance, limit, newton):
    """Bring the beam of armature ``g`` from direction s (served) to point p on one branch.

    ``m`` is the vertex to start from. Returns (status, iterations, t, vertex, normal, residual);
    the normal and the residual are valid only if the status is OK.
    """
    u = (g[15], g[16], g[17])
    k = constants(g, u)
    t = (0.0, 1.0, 0.0, 1.0)
    v = u
    before = np.inf
    for iteration in range(1, limit + 1):
        v, path, distance = wanted_normal(g, s, p, m)
        if distance == 0.0:
            return DEGENERATE, iteration, t, m, v, np.nan
        reached, t = solve_direction(g, k, u, v, sign)
        moved = m
        m = place_vertex(g, t)
        moved = minus(m, moved)
        # The normal is the bisector for the old vertex, so the ray leaves parallel to
        # the old path and misses by the vertex's motion across it.
        if reached:
            moved = cross(moved, path)
        square = dot(moved, moved)
        if square <= tolerance * tolerance:
            # A miss turns the path by miss / distance and the bisector by that over |s + t|.
            residual = math.sqrt(square) / (distance * 2.0 * dot(v, path))
            if not reached:
                # On the very edge rounding alone may decide this, so the beam is checked.
                v, path, distance = wanted_normal(g, s, p, m)
                reached = beam_miss(s, path, distance, mirror_normal(g, t)) <= tolerance
            return (OK if reached else UNREACHABLE), iteration, t, m, v, residual
        if newton and iteration >= 2 and not square < SLOW * SLOW * before:
            status, more, t = _newton(g, s, p, t, tolerance)
            m = place_vertex(g, t)
            v, path, distance = wanted_normal(g, s, p, m)
            return status, iteration + more, t, m, v, residual_angle(g, t, u, v)
        before = square
    return NOT_CONVERGED, limit, t, m, v, np.nan


@njit(**INLINED)
def local_direction(g, aim):
    """Return the direction of a source, at zero angles, that lights ``aim`` fixed to the mirror.

    It is the direction to the aim, reflected about the normal. Returns (status, direction); the
    status is DEGENERATE if the aim is in the vertex, BEHIND if the aim is not in front of the
    mirror.
    """
    n = mirror_normal(g, (0.0, 1.0, 0.0, 1.0))
    direction = served(g, minus(aim, (g[12], g[13], g[14])))
    size = norm(direction)
    if not size > DEGENERATE_LIMIT:
        return DEGENERATE, direction
    direction = times(1.0 / size, direction)
    if not dot(direction, n) > 0.0:
        return BEHIND, direction
    return OK, minus(times(2.0 * dot(direction, n), n), direction)
