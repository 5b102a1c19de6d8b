"""Compiled: tracking of many rows, with stops, counts and the choice of the branch."""

import math

import numpy as np
from numba import njit

from heliotrope.mechanism._drive_kernels import drive_angle, drive_counts
from heliotrope.mechanism._slots import (
    MAX_ANGLE,
    MAX_COUNT,
    MIN_ANGLE,
    MIN_COUNT,
    SPEED,
)
from heliotrope.mechanism._track_kernels import (
    DEGENERATE,
    OK,
    STOPPED,
    _about,
    _turn_between,
    place,
    solve_aim,
    solve_local,
    wanted_normal,
)

_OPTIONS = {"nogil": True, "cache": True, "error_model": "numpy"}

#: Angles this far (rad) beyond a stop count as on it.
STOP_SLACK = 1e-9


@njit(**_OPTIONS)
def stop_angles(d):
    """Lowest and highest joint angle that both kinds of stops of drive row ``d`` allow."""
    low, high = d[MIN_ANGLE], d[MAX_ANGLE]
    if math.isfinite(d[MIN_COUNT]) or math.isfinite(d[MAX_COUNT]):
        ends = (-np.inf, np.inf)
        first, last = ends
        if math.isfinite(d[MIN_COUNT]):
            first = drive_angle(d, d[MIN_COUNT])
        if math.isfinite(d[MAX_COUNT]):
            last = drive_angle(d, d[MAX_COUNT])
        # Counts may run against the angle.
        probe = d[MIN_COUNT] if math.isfinite(d[MIN_COUNT]) else d[MAX_COUNT] - 1.0
        if drive_angle(d, probe + 1.0) < drive_angle(d, probe):
            first, last = last, first
            if not math.isfinite(d[MIN_COUNT]):
                last = np.inf
            if not math.isfinite(d[MAX_COUNT]):
                first = -np.inf
        low, high = max(low, first), min(high, last)
    return low, high


@njit(**_OPTIONS)
def into_stops(theta, low, high, near):
    """Return (angle, inside): theta + 2πk within the stops nearest to ``near``, or a stop."""
    turn = 2.0 * math.pi
    theta += turn * math.floor((near - theta) / turn + 0.5)
    if theta < low - STOP_SLACK:
        theta += turn * math.ceil((low - STOP_SLACK - theta) / turn)
    elif theta > high + STOP_SLACK:
        theta -= turn * math.ceil((theta - high - STOP_SLACK) / turn)
    if low - STOP_SLACK <= theta <= high + STOP_SLACK:
        return min(max(theta, low), high), True
    # Neither a turn more nor a turn less lies within: the nearer stop.
    above = theta - turn * math.floor((theta - high) / turn)
    below = above - turn
    if above - high < low - below:
        return high, False
    return low, False


@njit(**_OPTIONS)
def _set_turn(theta_1, theta_2, t):
    t[0], t[1] = math.sin(theta_1), math.cos(theta_1)
    t[2], t[3] = math.sin(theta_2), math.cos(theta_2)


@njit(**_OPTIONS)
def turned(g, t, u):
    """Vector ``u`` of the mirror (given at zero angles) at pose t."""
    x, y, z = u[0], u[1], u[2]
    if not (g[6] == 0.0 and g[7] == 0.0 and g[8] == 0.0):
        x, y, z = _about(g[6], g[7], g[8], t[2], t[3], x, y, z)
    return _about(g[0], g[1], g[2], t[0], t[1], x, y, z)


@njit(**_OPTIONS)
def difference_angle(g, t, u, v):
    """Angle between the turned ``u`` and v; within the plane across the axis if single."""
    x, y, z = turned(g, t, u)
    if g[6] == 0.0 and g[7] == 0.0 and g[8] == 0.0:
        along = x * g[0] + y * g[1] + z * g[2]
        x, y, z = x - along * g[0], y - along * g[1], z - along * g[2]
        size = math.sqrt(x * x + y * y + z * z)
        x, y, z = x / size, y / size, z / size
    minus = math.sqrt((x - v[0]) ** 2 + (y - v[1]) ** 2 + (z - v[2]) ** 2)
    plus = math.sqrt((x + v[0]) ** 2 + (y + v[1]) ** 2 + (z + v[2]) ** 2)
    return 2.0 * math.atan2(minus, plus)


@njit(**_OPTIONS)
def _free_angle(g, axis, held, u, v, low, high, near):
    """Best angle of the other joint while joint ``axis`` is held, within its stops."""
    if axis == 0:
        x, y, z = _about(g[0], g[1], g[2], -math.sin(held), math.cos(held), v[0], v[1], v[2])
        sine, cosine = _turn_between(g[6], g[7], g[8], u[0], u[1], u[2], x, y, z)
    else:
        x, y, z = _about(g[6], g[7], g[8], math.sin(held), math.cos(held), u[0], u[1], u[2])
        sine, cosine = _turn_between(g[0], g[1], g[2], x, y, z, v[0], v[1], v[2])
    angle, _ = into_stops(math.atan2(sine, cosine), low, high, near)
    return angle


@njit(**_OPTIONS)
def _nearest_at_stops(g, s, p, u, local, stops, near, angles, t, n, m, v):
    """Nearest pose on the border of the stops' rectangle; returns its residual."""
    best = np.inf
    best_1, best_2 = angles[0], angles[1]
    single = g[6] == 0.0 and g[7] == 0.0 and g[8] == 0.0
    for axis in range(1 if single else 2):
        for side in range(2):
            held = stops[axis, side]
            if not math.isfinite(held):
                continue
            other = 1 - axis
            free = 0.0
            for _ in range(20):
                before = free
                if not single:
                    free = _free_angle(
                        g, axis, held, u, v, stops[other, 0], stops[other, 1], near[other]
                    )
                one, two = (held, free) if axis == 0 else (free, held)
                _set_turn(one, two, t)
                place(g, t, n, m)
                if local or wanted_normal(g, s, p, m, v) == 0.0:
                    break
                if abs(free - before) < 1e-13:
                    break
            residual = difference_angle(g, t, u, v)
            if residual < best:
                best, best_1, best_2 = residual, one, two
    angles[0], angles[1] = best_1, best_2
    _set_turn(best_1, best_2, t)
    place(g, t, n, m)
    if not local:
        wanted_normal(g, s, p, m, v)
    return difference_angle(g, t, u, v)


@njit(**_OPTIONS)
def _one_branch(
    g, s, p, sign, local, tolerance, limit, newton, stops, near, start, angles, t, n, m, v
):
    """Solve one branch within the stops; returns (status, iterations, residual)."""
    if local:
        status, iterations = solve_local(g, s, p, sign, t, n, m, v)
    else:
        m[:] = start
        status, iterations = solve_aim(g, s, p, sign, tolerance, limit, newton, t, n, m, v)
    if status == DEGENERATE:
        angles[0], angles[1] = np.nan, np.nan
        n[:] = np.nan
        m[:] = np.nan
        return status, iterations, np.nan
    u = g[15:18]
    if local:
        u = v.copy()
        v = s
    elif wanted_normal(g, s, p, m, v) == 0.0:
        return DEGENERATE, iterations, np.nan
    angles[0], inside_1 = into_stops(math.atan2(t[0], t[1]), stops[0, 0], stops[0, 1], near[0])
    angles[1], inside_2 = into_stops(math.atan2(t[2], t[3]), stops[1, 0], stops[1, 1], near[1])
    if inside_1 and inside_2:
        return status, iterations, difference_angle(g, t, u, v)
    residual = _nearest_at_stops(g, s, p, u, local, stops, near, angles, t, n, m, v)
    return STOPPED, iterations, residual


@njit(**_OPTIONS)
def _travel(drives, counts, current, angles, near):
    """(seconds, radians) from the current position; no speed means no time."""
    seconds, radians = 0.0, 0.0
    for k in range(drives.shape[0]):
        radians = max(radians, abs(angles[k] - near[k]))
        if math.isfinite(drives[k, SPEED]):
            seconds = max(seconds, abs(counts[k] - current[k]) / drives[k, SPEED])
    return seconds, radians


@njit(**_OPTIONS)
def track_block(
    armatures, drives, suns, aims, current, index, local, branch, tolerance, limit, newton,
    angles, counts, normals, vertices, status, iterations, residual, best, start, stop,
):  # fmt: skip
    """Track rows ``start`` to ``stop``.

    ``index`` (M, 5): rows of armatures, drives, suns, aims and current counts
    (−1: none). ``branch`` 0 or 1 solves that one into the only place, 2 both.
    """
    axes = drives.shape[1]
    t, n, m, v = np.empty(4), np.empty(3), np.empty(3), np.empty(3)
    stops, near, theta = np.empty((2, 2)), np.zeros(2), np.empty(2)
    for i in range(start, stop):
        g, d = armatures[index[i, 0]], drives[index[i, 1]]
        s, p = suns[index[i, 2]], aims[index[i, 3]]
        stops[1, 0], stops[1, 1], near[1] = -np.inf, np.inf, 0.0
        for k in range(axes):
            stops[k, 0], stops[k, 1] = stop_angles(d[k])
            if index[i, 4] >= 0:
                near[k] = drive_angle(d[k], current[index[i, 4], k])
            elif math.isfinite(stops[k, 0]) and math.isfinite(stops[k, 1]):
                near[k] = 0.5 * (stops[k, 0] + stops[k, 1])
            else:
                near[k] = 0.0
        chosen, seconds, radians = 0, np.inf, np.inf
        for b in range(angles.shape[1]):
            sign = 2.0 * (b if branch == 2 else branch) - 1.0
            state, steps, rest = _one_branch(
                g, s, p, sign, local, tolerance, limit, newton, stops, near, g[12:15],
                theta, t, n, m, v,
            )  # fmt: skip
            status[i, b], iterations[i, b], residual[i, b] = state, steps, rest
            normals[i, b], vertices[i, b] = n, m
            for k in range(axes):
                angles[i, b, k] = theta[k]
                counts[i, b, k] = drive_counts(d[k], theta[k])
            if b == 0:
                if branch == 2:
                    here = current[index[i, 4]] if index[i, 4] >= 0 else counts[i, 0]
                    seconds, radians = _travel(d, counts[i, 0], here, theta, near)
            else:
                here = current[index[i, 4]] if index[i, 4] >= 0 else counts[i, 1]
                time, way = _travel(d, counts[i, 1], here, theta, near)
                if state == OK and status[i, 0] == OK:
                    better = time < seconds or (time == seconds and way < radians)
                elif state == OK or status[i, 0] == OK:
                    better = state == OK
                else:
                    better = rest < residual[i, 0]
                if better:
                    chosen = 1
        best[i] = chosen
