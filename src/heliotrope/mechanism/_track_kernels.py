"""Compiled: joint angles at which an armature sends light from a source to an aim point.

Directions are solved in closed form (second Paden-Kahan subproblem): R(a, θ₁) R(b, θ₂) n₀ = v
is met where z = R(b, θ₂) n₀ = R(−a, θ₁) v has the components z·a = v·a and z·b = n₀·b;
of the two such z one is branch 0 (− a × b) and the other branch 1 (+ a × b). The vertex
moves with the angles, so v depends on them: fixed point first, and Newton with the screw
derivative, safeguarded by Levenberg's damping, where that converges slowly.
"""

import math

import numpy as np
from numba import njit

_OPTIONS = {"nogil": True, "cache": True, "error_model": "numpy"}

OK = 0
UNREACHABLE = 1  # inside the dead cone around the primary axis
STOPPED = 2  # beyond a stop
NOT_CONVERGED = 3
DEGENERATE = 4  # source opposite to aim, aim in the vertex, or a value not finite

#: The fixed point is left for Newton when a step gains less than this factor.
SLOW = 0.3


@njit(inline="always")
def _dot(a0, a1, a2, b0, b1, b2):
    return a0 * b0 + a1 * b1 + a2 * b2


@njit(**_OPTIONS)
def _about(x, y, z, sine, cosine, u, v, w):
    """Turn (u, v, w) about the unit axis (x, y, z) by an angle of known sine and cosine."""
    along = (1.0 - cosine) * (x * u + y * v + z * w)
    return (
        cosine * u + sine * (y * w - z * v) + along * x,
        cosine * v + sine * (z * u - x * w) + along * y,
        cosine * w + sine * (x * v - y * u) + along * z,
    )


@njit(**_OPTIONS)
def _turn_between(x, y, z, u0, u1, u2, v0, v1, v2):
    """Sine and cosine of the turn about (x, y, z) that brings u as near to v as can be."""
    sine = x * (u1 * v2 - u2 * v1) + y * (u2 * v0 - u0 * v2) + z * (u0 * v1 - u1 * v0)
    cosine = _dot(u0, u1, u2, v0, v1, v2) - _dot(x, y, z, u0, u1, u2) * _dot(x, y, z, v0, v1, v2)
    size = math.sqrt(sine * sine + cosine * cosine)
    if size < 1e-15:
        return 0.0, 1.0
    return sine / size, cosine / size


@njit(**_OPTIONS)
def solve_direction(g, n0, v0, v1, v2, sign, out):
    """Turn both joints of armature ``g`` so that ``n0`` comes to lie along v.

    Writes (sin θ₁, cos θ₁, sin θ₂, cos θ₂) to ``out`` and returns whether v was
    reached. Inside the dead cone the pose is the nearest one.
    """
    a0, a1, a2 = g[0], g[1], g[2]
    b0, b1, b2 = g[6], g[7], g[8]
    if b0 == 0.0 and b1 == 0.0 and b2 == 0.0:
        out[0], out[1] = _turn_between(a0, a1, a2, n0[0], n0[1], n0[2], v0, v1, v2)
        out[2], out[3] = 0.0, 1.0
        return True
    ab = _dot(a0, a1, a2, b0, b1, b2)
    nb = _dot(n0[0], n0[1], n0[2], b0, b1, b2)
    va = _dot(v0, v1, v2, a0, a1, a2)
    c0, c1, c2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    size = _dot(c0, c1, c2, c0, c1, c2)
    along_a = (va - ab * nb) / size
    along_b = (nb - ab * va) / size
    square = 1.0 - along_a * along_a - along_b * along_b - 2.0 * along_a * along_b * ab
    reached = square >= -4e-16
    if square < 0.0:
        # The nearest direction on the reachable band's edge has |z·a| as large as the
        # circle z·b = n₀·b allows; rounding below zero is the edge itself.
        if not reached:
            edge = math.sqrt(max(0.0, 1.0 - nb * nb) * size)
            if va > ab * nb:
                va = ab * nb + edge
            else:
                va = ab * nb - edge
            along_a = (va - ab * nb) / size
            along_b = (nb - ab * va) / size
        square = 0.0
    across = sign * math.sqrt(square / size)
    z0 = along_a * a0 + along_b * b0 + across * c0
    z1 = along_a * a1 + along_b * b1 + across * c1
    z2 = along_a * a2 + along_b * b2 + across * c2
    out[2], out[3] = _turn_between(b0, b1, b2, n0[0], n0[1], n0[2], z0, z1, z2)
    out[0], out[1] = _turn_between(a0, a1, a2, z0, z1, z2, v0, v1, v2)
    return reached


@njit(**_OPTIONS)
def place(g, t, n, m):
    """Normal n and vertex m of armature ``g`` at t = (sin θ₁, cos θ₁, sin θ₂, cos θ₂)."""
    r0, r1, r2 = _about(
        g[6], g[7], g[8], t[2], t[3], g[12] - g[9], g[13] - g[10], g[14] - g[11]
    )
    if g[6] == 0.0 and g[7] == 0.0 and g[8] == 0.0:
        r0, r1, r2 = g[12] - g[9], g[13] - g[10], g[14] - g[11]
    r0 += g[9] - g[3]
    r1 += g[10] - g[4]
    r2 += g[11] - g[5]
    r0, r1, r2 = _about(g[0], g[1], g[2], t[0], t[1], r0, r1, r2)
    m[0], m[1], m[2] = g[3] + r0, g[4] + r1, g[5] + r2
    u0, u1, u2 = g[15], g[16], g[17]
    if not (g[6] == 0.0 and g[7] == 0.0 and g[8] == 0.0):
        u0, u1, u2 = _about(g[6], g[7], g[8], t[2], t[3], u0, u1, u2)
    n[0], n[1], n[2] = _about(g[0], g[1], g[2], t[0], t[1], u0, u1, u2)


@njit(**_OPTIONS)
def wanted_normal(g, s, p, m, v):
    """Bisector v of source s and the direction from m to p; returns |p − m|, 0 if none.

    For a single axis both are projected on the plane across it.
    """
    t0, t1, t2 = p[0] - m[0], p[1] - m[1], p[2] - m[2]
    s0, s1, s2 = s[0], s[1], s[2]
    if g[6] == 0.0 and g[7] == 0.0 and g[8] == 0.0:
        along = _dot(g[0], g[1], g[2], t0, t1, t2)
        t0, t1, t2 = t0 - along * g[0], t1 - along * g[1], t2 - along * g[2]
        along = _dot(g[0], g[1], g[2], s0, s1, s2)
        s0, s1, s2 = s0 - along * g[0], s1 - along * g[1], s2 - along * g[2]
        size = math.sqrt(_dot(s0, s1, s2, s0, s1, s2))
        if size < 1e-9:
            return 0.0
        s0, s1, s2 = s0 / size, s1 / size, s2 / size
    distance = math.sqrt(_dot(t0, t1, t2, t0, t1, t2))
    if not distance > 1e-9:
        return 0.0
    scale = 1.0 / distance
    v0, v1, v2 = s0 + t0 * scale, s1 + t1 * scale, s2 + t2 * scale
    size = math.sqrt(_dot(v0, v1, v2, v0, v1, v2))
    if not size > 1e-9:
        return 0.0
    scale = 1.0 / size
    v[0], v[1], v[2] = v0 * scale, v1 * scale, v2 * scale
    return distance


@njit(**_OPTIONS)
def beam_miss(g, s, p, n, m):
    """Distance (m) by which the ray reflected at m with normal n passes p."""
    s0, s1, s2 = s[0], s[1], s[2]
    t0, t1, t2 = p[0] - m[0], p[1] - m[1], p[2] - m[2]
    if g[6] == 0.0 and g[7] == 0.0 and g[8] == 0.0:
        along = _dot(g[0], g[1], g[2], t0, t1, t2)
        t0, t1, t2 = t0 - along * g[0], t1 - along * g[1], t2 - along * g[2]
        along = _dot(g[0], g[1], g[2], s0, s1, s2)
        s0, s1, s2 = s0 - along * g[0], s1 - along * g[1], s2 - along * g[2]
        size = math.sqrt(_dot(s0, s1, s2, s0, s1, s2))
        s0, s1, s2 = s0 / size, s1 / size, s2 / size
        along = _dot(g[0], g[1], g[2], n[0], n[1], n[2])
        n0, n1, n2 = n[0] - along * g[0], n[1] - along * g[1], n[2] - along * g[2]
        size = math.sqrt(_dot(n0, n1, n2, n0, n1, n2))
        n0, n1, n2 = n0 / size, n1 / size, n2 / size
    else:
        n0, n1, n2 = n[0], n[1], n[2]
    twice = 2.0 * _dot(n0, n1, n2, s0, s1, s2)
    r0, r1, r2 = twice * n0 - s0, twice * n1 - s1, twice * n2 - s2
    x, y, z = t1 * r2 - t2 * r1, t2 * r0 - t0 * r2, t0 * r1 - t1 * r0
    return math.sqrt(x * x + y * y + z * z)


@njit(**_OPTIONS)
def _screw_columns(g, t, n, m, columns):
    """dn and dm by θ₁ and θ₂ in columns (2, 6)."""
    a0, a1, a2 = g[0], g[1], g[2]
    x, y, z = m[0] - g[3], m[1] - g[4], m[2] - g[5]
    columns[0, 0] = a1 * n[2] - a2 * n[1]
    columns[0, 1] = a2 * n[0] - a0 * n[2]
    columns[0, 2] = a0 * n[1] - a1 * n[0]
    columns[0, 3] = a1 * z - a2 * y
    columns[0, 4] = a2 * x - a0 * z
    columns[0, 5] = a0 * y - a1 * x
    b0, b1, b2 = _about(a0, a1, a2, t[0], t[1], g[6], g[7], g[8])
    o0, o1, o2 = _about(a0, a1, a2, t[0], t[1], g[9] - g[3], g[10] - g[4], g[11] - g[5])
    x, y, z = x - o0, y - o1, z - o2
    columns[1, 0] = b1 * n[2] - b2 * n[1]
    columns[1, 1] = b2 * n[0] - b0 * n[2]
    columns[1, 2] = b0 * n[1] - b1 * n[0]
    columns[1, 3] = b1 * z - b2 * y
    columns[1, 4] = b2 * x - b0 * z
    columns[1, 5] = b0 * y - b1 * x


@njit(**_OPTIONS)
def _newton_matrix(g, s, p, t, n, m, v, columns, gradient):
    """Normal equations of |n − v|² by both angles: (h00, h01, h11); fills gradient (2,)."""
    _screw_columns(g, t, n, m, columns)
    d0, d1, d2 = p[0] - m[0], p[1] - m[1], p[2] - m[2]
    single = g[6] == 0.0 and g[7] == 0.0 and g[8] == 0.0
    if single:
        along = _dot(g[0], g[1], g[2], d0, d1, d2)
        d0, d1, d2 = d0 - along * g[0], d1 - along * g[1], d2 - along * g[2]
    distance = math.sqrt(_dot(d0, d1, d2, d0, d1, d2))
    t0, t1, t2 = d0 / distance, d1 / distance, d2 / distance
    # |s + t| = 2 v·t for unit vectors.
    size = 2.0 * _dot(v[0], v[1], v[2], t0, t1, t2)
    h00, h01, h11 = 0.0, 0.0, 0.0
    for k in range(2):
        c = columns[k]
        e0, e1, e2 = -c[3], -c[4], -c[5]
        if single:
            along = _dot(g[0], g[1], g[2], e0, e1, e2)
            e0, e1, e2 = e0 - along * g[0], e1 - along * g[1], e2 - along * g[2]
        along = _dot(t0, t1, t2, e0, e1, e2)
        e0, e1, e2 = (
            (e0 - along * t0) / distance,
            (e1 - along * t1) / distance,
            (e2 - along * t2) / distance,
        )
        along = _dot(v[0], v[1], v[2], e0, e1, e2)
        c[0] -= (e0 - along * v[0]) / size
        c[1] -= (e1 - along * v[1]) / size
        c[2] -= (e2 - along * v[2]) / size
        gradient[k] = _dot(c[0], c[1], c[2], n[0] - v[0], n[1] - v[1], n[2] - v[2])
    h00 = _dot(columns[0, 0], columns[0, 1], columns[0, 2],
               columns[0, 0], columns[0, 1], columns[0, 2])  # fmt: skip
    h01 = _dot(columns[0, 0], columns[0, 1], columns[0, 2],
               columns[1, 0], columns[1, 1], columns[1, 2])  # fmt: skip
    h11 = _dot(columns[1, 0], columns[1, 1], columns[1, 2],
               columns[1, 0], columns[1, 1], columns[1, 2])  # fmt: skip
    return h00, h01, h11


@njit(**_OPTIONS)
def _newton(g, s, p, t, n, m, v, tolerance, limit):
    """Levenberg-damped Newton from pose t; returns (status, iterations)."""
    columns, gradient = np.empty((2, 6)), np.empty(2)
    trial, n_new, m_new, v_new = np.empty(4), np.empty(3), np.empty(3), np.empty(3)
    damping = 1e-12
    wanted_normal(g, s, p, m, v)
    cost = _square_difference(n, v)
    theta_1, theta_2 = math.atan2(t[0], t[1]), math.atan2(t[2], t[3])
    for iteration in range(limit):
        if beam_miss(g, s, p, n, m) <= tolerance:
            return OK, iteration
        h00, h01, h11 = _newton_matrix(g, s, p, t, n, m, v, columns, gradient)
        improved = False
        for _ in range(30):
            d00 = h00 + damping * (h00 + h11)
            d11 = h11 + damping * (h00 + h11)
            determinant = d00 * d11 - h01 * h01
            if determinant > 0.0:
                step_1 = -(d11 * gradient[0] - h01 * gradient[1]) / determinant
                step_2 = -(d00 * gradient[1] - h01 * gradient[0]) / determinant
                trial[0], trial[1] = math.sin(theta_1 + step_1), math.cos(theta_1 + step_1)
                trial[2], trial[3] = math.sin(theta_2 + step_2), math.cos(theta_2 + step_2)
                place(g, trial, n_new, m_new)
                if wanted_normal(g, s, p, m_new, v_new) > 0.0:
                    new = _square_difference(n_new, v_new)
                    if new < cost:
                        improved = True
                        break
            damping = max(10.0 * damping, 1e-12)
        if not improved:
            # A minimum with a remainder: no pose near here sends the beam to p.
            return UNREACHABLE, iteration
        gained = cost - new
        cost = new
        theta_1 += step_1
        theta_2 += step_2
        for k in range(4):
            t[k] = trial[k]
        for k in range(3):
            n[k], m[k], v[k] = n_new[k], m_new[k], v_new[k]
        damping = 0.1 * damping
        if cost > 1e-24 and gained < 1e-13 * cost:
            return UNREACHABLE, iteration + 1
    if beam_miss(g, s, p, n, m) <= tolerance:
        return OK, limit
    return NOT_CONVERGED, limit


@njit(**_OPTIONS)
def _square_difference(a, b):
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return x * x + y * y + z * z


@njit(**_OPTIONS)
def solve_aim(g, s, p, sign, tolerance, limit, newton, t, n, m, v):
    """Bring the beam of armature ``g`` from direction s to point p on one branch.

    ``m`` holds the vertex to start from. Leaves the pose in t, n, m and the bisector
    there in v; returns (status, iterations).
    """
    n0 = g[15:18]
    before = np.inf
    for iteration in range(1, limit + 1):
        if wanted_normal(g, s, p, m, v) == 0.0:
            return DEGENERATE, iteration
        x, y, z = m[0], m[1], m[2]
        reached = solve_direction(g, n0, v[0], v[1], v[2], sign, t)
        place(g, t, n, m)
        if reached:
            miss = beam_miss(g, s, p, n, m)
            if miss <= tolerance:
                return OK, iteration
        else:
            x, y, z = m[0] - x, m[1] - y, m[2] - z
            miss = math.sqrt(x * x + y * y + z * z)
            if miss <= tolerance:
                return UNREACHABLE, iteration
        if newton and iteration >= 2 and not miss < SLOW * before:
            status, more = _newton(g, s, p, t, n, m, v, tolerance, 60)
            return status, iteration + more
        before = miss
    return NOT_CONVERGED, limit


@njit(**_OPTIONS)
def solve_local(g, s, aim, sign, t, n, m, v):
    """Turn armature ``g`` so that light from s leaves towards a point fixed to the mirror.

    ``aim`` is the point at zero angles. In the mirror's frame the source must then
    stand at the reflection of the aim's direction in the normal.
    """
    d0, d1, d2 = aim[0] - g[12], aim[1] - g[13], aim[2] - g[14]
    size = math.sqrt(_dot(d0, d1, d2, d0, d1, d2))
    if not size > 1e-9:
        return DEGENERATE, 0
    d0, d1, d2 = d0 / size, d1 / size, d2 / size
    twice = 2.0 * _dot(d0, d1, d2, g[15], g[16], g[17])
    v[0], v[1], v[2] = twice * g[15] - d0, twice * g[16] - d1, twice * g[17] - d2
    reached = solve_direction(g, v, s[0], s[1], s[2], sign, t)
    place(g, t, n, m)
    if reached:
        return OK, 1
    return UNREACHABLE, 1
