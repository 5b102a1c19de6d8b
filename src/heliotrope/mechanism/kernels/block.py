"""Compiled: tracking of many heliostats or times, with stops, counts and branch selection."""

import math

import numpy as np
from numba import njit

from heliotrope.jit import INLINED, INNER, OPTIONS, plain
from heliotrope.mechanism.kernels.drives import (
    count_range,
    drive_angle,
    drive_counts,
    load_drive,
)
from heliotrope.mechanism.kernels.slots import (
    BIAS,
    KIND,
    LINEAR,
    MAX_ANGLE,
    MAX_COUNT,
    MIN_ANGLE,
    MIN_COUNT,
    RATE,
    ROTARY,
    SAG,
    SCALE,
    SPEED,
    WORM_COS,
    WORM_SIN,
    ZERO,
)
from heliotrope.mechanism.kernels.track import (
    DEGENERATE,
    OK,
    STOPPED,
    UNREACHABLE,
    axis_1,
    axis_2,
    constants,
    is_single,
    load_armature,
    local_direction,
    place_vertex,
    residual_angle,
    served,
    solve_aim,
    solve_direction,
    turned,
    wanted_normal,
)
from heliotrope.mechanism.kernels.vectors import about, turn_between
from heliotrope.mechanism.kernels.warm import LANES, STEPS, warm_start

#: Angles this far (rad) beyond a stop count as on it.
STOP_SLACK = 1e-9


@njit(**INLINED)
def stop_angles(d):
    """Return the lowest and highest joint angle that all stops of drive ``d`` allow."""
    if d[KIND] == LINEAR or math.isfinite(d[MIN_COUNT]) or math.isfinite(d[MAX_COUNT]):
        return _count_stops(d)
    return d[MIN_ANGLE], d[MAX_ANGLE]


@njit(**INLINED)
def _counts(d, theta):
    """Return the counts at a joint angle, without a function call for a plain rotary drive."""
    if d[KIND] == ROTARY and d[WORM_COS] == 0.0 and d[WORM_SIN] == 0.0 and d[SAG] == 0.0:
        return ((theta - d[BIAS]) / (1.0 + d[SCALE]) - d[ZERO]) / d[RATE]
    return drive_counts(d, theta)


@njit(**INNER)
def _count_stops(d):
    low, high = d[MIN_ANGLE], d[MAX_ANGLE]
    lower, upper = count_range(d)
    probe = lower if math.isfinite(lower) else upper - 1.0
    rising = drive_angle(d, probe + 1.0) > drive_angle(d, probe)
    if math.isfinite(lower):
        end = drive_angle(d, lower)
        if rising:
            low = max(low, end)
        else:
            high = min(high, end)
    if math.isfinite(upper):
        end = drive_angle(d, upper)
        if rising:
            high = min(high, end)
        else:
            low = max(low, end)
    return low, high


@njit(**INLINED)
def into_stops(theta, stops, near):
    """Return theta + 2πk within the stops and nearest to ``near``, and whether it is inside.

    If no such angle lies within the stops, the nearer stop is returned.
    """
    turn = 2.0 * math.pi
    low, high = stops
    theta += turn * math.floor((near - theta) / turn + 0.5)
    if theta < low - STOP_SLACK:
        theta += turn * math.ceil((low - STOP_SLACK - theta) / turn)
    elif theta > high + STOP_SLACK:
        theta -= turn * math.ceil((theta - high - STOP_SLACK) / turn)
    if low - STOP_SLACK <= theta <= high + STOP_SLACK:
        return min(max(theta, low), high), True
    # Neither one turn more nor one turn less lies within the stops, so take the nearer stop.
    above = theta - turn * math.floor((theta - high) / turn)
    below = above - turn
    if above - high < low - below:
        return high, False
    return low, False


@njit(**INNER)
def _turn(theta_1, theta_2):
    return math.sin(theta_1), math.cos(theta_1), math.sin(theta_2), math.cos(theta_2)


@njit(**INNER)
def _free_angle(g, axis, held, u, v, stops, near):
    """Return the best angle of the other joint within its stops, with joint ``axis`` held."""
    if axis == 0:
        x = about(axis_1(g), -math.sin(held), math.cos(held), v)
        sine, cosine = turn_between(axis_2(g), u, x)
    else:
        x = about(axis_2(g), math.sin(held), math.cos(held), u)
        sine, cosine = turn_between(axis_1(g), x, v)
    return into_stops(math.atan2(sine, cosine), stops, near)[0]


@njit(**INNER)
def _along_stop(g, s, p, u, v, local, axis, held, stops, near):
    """Find the nearest pose with joint ``axis`` held at a stop: (residual, θ₁, θ₂)."""
    other = 1 - axis
    free, v_here = 0.0, v
    theta_1, theta_2, t = held, 0.0, _turn(held, 0.0)
    for _ in range(20):
        before = free
        if not is_single(g):
            free = _free_angle(g, axis, held, u, v_here, stops[other], near[other])
        theta_1, theta_2 = (held, free) if axis == 0 else (free, held)
        t = _turn(theta_1, theta_2)
        if not local:
            v_new, _, distance = wanted_normal(g, s, p, place_vertex(g, t))
            if distance > 0.0:
                v_here = v_new
        if abs(free - before) < 1e-13:
            break
    return residual_angle(g, t, u, v_here), theta_1, theta_2


@njit(**INNER)
def _nearest_at_stops(g, s, p, u, v, local, stops, near):
    """Find the nearest pose on the border of the range between the stops: (residual, θ₁, θ₂)."""
    best, theta_1, theta_2 = np.inf, 0.0, 0.0
    for axis in range(1 if is_single(g) else 2):
        for side in range(2):
            held = stops[axis][side]
            if math.isfinite(held):
                rest, first, second = _along_stop(g, s, p, u, v, local, axis, held, stops, near)
                if rest < best:
                    best, theta_1, theta_2 = rest, first, second
    return best, theta_1, theta_2


@njit(**INLINED)
def solve_branch(g, s, p, m, sign, local, tolerance, limit, newton, stops, near):
    """Solve one branch within the stops: (status, iterations, residual, θ₁, θ₂, n, m)."""
    nothing = (np.nan, np.nan, np.nan)
    s = served(g, s)
    n = (g[15], g[16], g[17])
    u, v, rest = n, s, np.nan
    if local:
        status, u = local_direction(g, p)
        if s == (0.0, 0.0, 0.0):
            status = DEGENERATE
        if status != OK:
            return status, 0, np.nan, np.nan, np.nan, nothing, nothing
        reached, t = solve_direction(g, constants(g, u), u, v, sign)
        status, iterations, m = OK if reached else UNREACHABLE, 1, place_vertex(g, t)
    else:
        status, iterations, t, m, v, rest = solve_aim(g, s, p, m, sign, tolerance, limit, newton)
        if status == DEGENERATE or s == (0.0, 0.0, 0.0):
            return DEGENERATE, iterations, np.nan, np.nan, np.nan, nothing, nothing
    theta_1, inside_1 = into_stops(math.atan2(t[0], t[1]), stops[0], near[0])
    theta_2, inside_2 = into_stops(math.atan2(t[2], t[3]), stops[1], near[1])
    if inside_1 and inside_2:
        if status == OK and not local and not is_single(g):
            return status, iterations, rest, theta_1, theta_2, v, m
        if not local:
            v, _, _ = wanted_normal(g, s, p, m)
        return status, iterations, residual_angle(g, t, u, v), theta_1, theta_2, turned(g, t, n), m
    rest, theta_1, theta_2 = _nearest_at_stops(g, s, p, u, v, local, stops, near)
    t = _turn(theta_1, theta_2)
    return STOPPED, iterations, rest, theta_1, theta_2, turned(g, t, n), place_vertex(g, t)


@njit(**INLINED)
def _home(stops):
    if math.isfinite(stops[0]) and math.isfinite(stops[1]):
        return 0.5 * (stops[0] + stops[1])
    return 0.0


@njit(**INNER)
def _better(status, residual, seconds, radians):
    """Return whether the second branch is preferable to the first."""
    if status[0] == OK and status[1] == OK:
        return (seconds[1], radians[1]) < (seconds[0], radians[0])
    if status[0] == OK or status[1] == OK:
        return status[1] == OK
    return residual[1] < residual[0]


@njit(**OPTIONS)
def track_block(
    armatures,
    drives,
    suns,
    aims,
    current,
    index,
    local,
    branch,
    tolerance,
    limit,
    newton,
    angles,
    counts,
    normals,
    vertices,
    status,
    iterations,
    residual,
    best,
    start,
    stop,
):
    """Track rows ``start`` to ``stop``.

    ``index`` (M, 5) contains row indices of armatures, drives, sun vectors, aims and current counts
    (−1: none). With ``branch`` 0 or 1 only that branch is solved, and the outputs have one place;
    with 2 both branches are solved.
    """
    axes = drives.shape[1]
    seconds, radians = np.zeros(2), np.zeros(2)
    warm = newton and not local and limit > STEPS
    begin = np.empty((2, LANES, 3))
    for i in range(start, stop):
        lane = (i - start) % LANES
        if warm and lane == 0:
            for b in range(angles.shape[1]):
                sign = 2.0 * (b if branch == 2 else branch) - 1.0
                warm_start(armatures, suns, aims, index, i, stop, sign, begin[b])
        row, now = index[i, 1], index[i, 4]
        g = load_armature(armatures, index[i, 0])
        d1 = load_drive(drives, row, plain(0))
        d2 = load_drive(drives, row, axes - 1)
        s = (suns[index[i, 2], 0], suns[index[i, 2], 1], suns[index[i, 2], 2])
        p = (aims[index[i, 3], 0], aims[index[i, 3], 1], aims[index[i, 3], 2])
        stops = (stop_angles(d1), stop_angles(d2))
        if axes == 1:
            stops = (stops[0], (-np.inf, np.inf))
        near = (_home(stops[0]), _home(stops[1]))
        if now >= 0:
            here_1, here_2 = current[now, 0], current[now, axes - 1]
            near = (drive_angle(d1, here_1), drive_angle(d2, here_2) if axes == 2 else 0.0)
        for b in range(angles.shape[1]):
            sign = 2.0 * (b if branch == 2 else branch) - 1.0
            m, done = (g[12], g[13], g[14]), 0
            if warm:
                m, done = (begin[b, lane, 0], begin[b, lane, 1], begin[b, lane, 2]), STEPS
            state, steps, rest, theta_1, theta_2, n, m = solve_branch(
                g, s, p, m, sign, local, tolerance, limit - done, newton, stops, near
            )
            steps += done
            status[i, b], iterations[i, b], residual[i, b] = state, steps, rest
            for k in range(3):
                normals[i, b, k], vertices[i, b, k] = n[k], m[k]
            angles[i, b, 0], counts[i, b, 0] = theta_1, _counts(d1, theta_1)
            seconds[b], radians[b] = 0.0, abs(theta_1 - near[0])
            if now >= 0 and math.isfinite(d1[SPEED]):
                seconds[b] = abs(counts[i, b, 0] - here_1) / d1[SPEED]
            if axes == 2:
                angles[i, b, 1], counts[i, b, 1] = theta_2, _counts(d2, theta_2)
                radians[b] = max(radians[b], abs(theta_2 - near[1]))
                if now >= 0 and math.isfinite(d2[SPEED]):
                    seconds[b] = max(seconds[b], abs(counts[i, b, 1] - here_2) / d2[SPEED])
        best[i] = 0
        if branch == 2 and _better(status[i], residual[i], seconds, radians):
            best[i] = 1
