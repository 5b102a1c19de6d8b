"""Compiled kernels: the whitened residual of each sighting, with its derivative.

With n the normal, b the bisector, f_k the whitened axes and r_k = f_k·(n − b),

    dr_k = f_k·dn − g_k·dm,   g_k = (∂b/∂m)ᵀ f_k.

A parameter either moves everything beyond its joint as a rigid body, dn = w × n and dm = w × m + d
with a twist (w, d), or only translates everything beyond it, w = 0. Hence dr_k = w·q_k − d·g_k with
q_k = n × f_k − m × g_k, the product of a twist, which depends on the heliostat, and a wrench (q_k,
g_k), which depends on the sighting. Twists are computed at zero joint angles. Beyond a driven joint
they would rotate with the joint; instead the wrench is rotated back, so that three wrenches serve
all parameters.
"""

import math

import numpy as np
from numba import njit

from heliotrope.jit import INLINED, INNER, OPTIONS
from heliotrope.mechanism.kernels.chain import chain_pose
from heliotrope.mechanism.kernels.drives import angle_per_slot, drive_angle, load_drive
from heliotrope.mechanism.kernels.slots import (
    MOVES_ALONG_NORMAL,
    MOVES_DRIVE,
    MOVES_JOINT,
    MOVES_ORIGIN,
    MOVES_POSITION,
    MOVES_VERTEX,
)
from heliotrope.mechanism.kernels.track import (
    axis_1,
    axis_2,
    is_single,
    place_vertex,
    turned,
)
from heliotrope.mechanism.kernels.vectors import about, across, add, cross, dot, minus, times


@njit(**INNER)
def apply_parameters(codes, x, position, origins, angles, drives, vertex, normal):
    """Shift the arrays of one mechanism by the parameters x (P,), in place."""
    for p in range(codes.shape[0]):
        what, index, sub = codes[p, 0], codes[p, 1], codes[p, 2]
        if what == MOVES_JOINT:
            angles[index] += x[p]
        elif what == MOVES_DRIVE:
            drives[0, index, sub] += x[p]
        elif what == MOVES_POSITION:
            position[sub] += x[p]
        elif what == MOVES_ORIGIN:
            origins[index, sub] += x[p]
        elif what == MOVES_VERTEX:
            vertex[sub] += x[p]
        elif what == MOVES_ALONG_NORMAL:
            for k in range(3):
                vertex[k] += x[p] * normal[k]


@njit(**OPTIONS)
def scratch_mechanism(joints, drives, slots, size):
    """Return arrays for one displaced mechanism, its pose at zero joint angles, and P twists.

    A twist is (w, d). Its entry in the layout holds the number of driven joints before it, the
    index of its drive (−1 if it has none) and its slot.
    """
    moved = (
        np.empty(3), np.empty((joints, 3)), np.empty(joints), np.empty((1, drives, slots)),
        np.empty(3), np.empty(size),
    )  # fmt: skip
    zero = np.empty(drives)
    for k in range(drives):
        zero[k] = 0.0
    pose = (
        zero, np.empty((joints + 1, 3, 3)), np.empty((joints, 3)),
        np.empty((joints, 3)), np.empty(3), np.empty(3),
    )  # fmt: skip
    twists, places = np.empty((size, 6)), np.empty((size, 3), dtype=np.int64)
    return moved, pose, twists, places


@njit(**INLINED)
def _copy(base, moved):
    position, _, _, origins, angles, drives, _, vertex, _ = base
    for k in range(3):
        moved[0][k], moved[4][k] = position[k], vertex[k]
    for j in range(origins.shape[0]):
        moved[2][j] = angles[j]
        for k in range(3):
            moved[1][j, k] = origins[j, k]
    for d in range(drives.shape[0]):
        for k in range(drives.shape[1]):
            moved[3][0, d, k] = drives[d, k]


@njit(**INLINED)
def _row(table, i):
    return table[i, 0], table[i, 1], table[i, 2]


@njit(**INNER)
def place_mechanism(base, codes, sigma, y, scratch):
    """Shift a mechanism by y σ, fill drives and twists, and return the axes, vertex and normal."""
    orientation, axes, driven, normal = base[1], base[2], base[6], base[8]
    moved, pose, twists, places = scratch
    position_, origins_, angles_, drives_, vertex_, x = moved
    _copy(base, moved)
    for p in range(codes.shape[0]):
        x[p] = y[p] * sigma[p]
    apply_parameters(codes, x, position_, origins_, angles_, drives_, vertex_, normal)
    zero, frames, screw_axes, screw_points, n, m = pose
    chain_pose(
        position_,
        orientation,
        axes,
        origins_,
        angles_,
        driven,
        zero,
        vertex_,
        normal,
        frames,
        screw_axes,
        screw_points,
        n,
        m,
    )
    for p in range(codes.shape[0]):
        _twist(codes, p, sigma[p], driven, pose, twists, places)
    primary = driven[0]
    first, second, third = _row(screw_axes, primary), _row(screw_points, primary), (0.0, 0.0, 0.0)
    fourth = third
    if driven.shape[0] > 1:
        third, fourth = _row(screw_axes, driven[1]), _row(screw_points, driven[1])
    return first + second + third + fourth + (m[0], m[1], m[2], n[0], n[1], n[2])


@njit(**INLINED)
def _twist(codes, p, factor, driven, pose, twists, places):
    """Compute the twist of parameter p at zero joint angles, times ``factor``."""
    _, frames, screw_axes, screw_points, n, _ = pose
    what, index, sub = codes[p, 0], codes[p, 1], codes[p, 2]
    joint, drive = index, -1
    w, d = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    if what == MOVES_DRIVE:
        joint, drive = driven[index], index
    elif what == MOVES_POSITION:
        joint = 0
    elif what in (MOVES_VERTEX, MOVES_ALONG_NORMAL):
        joint = frames.shape[0] - 1
    if what in (MOVES_JOINT, MOVES_DRIVE):
        w = _row(screw_axes, joint)
        d = cross(_row(screw_points, joint), w)
    elif what == MOVES_POSITION:
        d = (1.0 * (sub == 0), 1.0 * (sub == 1), 1.0 * (sub == 2))
    elif what == MOVES_ALONG_NORMAL:
        d = (n[0], n[1], n[2])
    else:
        d = (frames[joint, 0, sub], frames[joint, 1, sub], frames[joint, 2, sub])
    twists[p, 0], twists[p, 1], twists[p, 2] = times(factor, w)
    twists[p, 3], twists[p, 4], twists[p, 5] = times(factor, d)
    before = 0
    for k in range(driven.shape[0]):
        before += driven[k] < joint
    places[p, 0], places[p, 1], places[p, 2] = before, drive, sub


@njit(**INLINED)
def turns(drives, counts, i):
    """Return the sines and cosines of both joint angles at counts ``i``."""
    theta_1 = drive_angle(load_drive(drives, 0, 0), counts[i, 0])
    if drives.shape[1] == 1:
        return math.sin(theta_1), math.cos(theta_1), 0.0, 1.0
    theta_2 = drive_angle(load_drive(drives, 0, 1), counts[i, 1])
    return math.sin(theta_1), math.cos(theta_1), math.sin(theta_2), math.cos(theta_2)


@njit(**INLINED)
def _direction(ends, far, i, m):
    """Return the unit vector from m to an end, and 1 / distance (0 if the end is a direction)."""
    end = _row(ends, i)
    if far[i]:
        return end, 0.0
    end = minus(end, m)
    inverse = 1.0 / math.sqrt(dot(end, end))
    return times(inverse, end), inverse


@njit(**INLINED)
def _gap_axes(data, i, inverse):
    """Return the two whitened axes f_k of sighting i, divided by the scale of the residuals."""
    axes, whiten = data[5], data[6]
    a = (axes[i, 0, 0], axes[i, 0, 1], axes[i, 0, 2])
    b = (axes[i, 1, 0], axes[i, 1, 1], axes[i, 1, 2])
    f_0 = add(times(inverse * whiten[i, 0, 0], a), times(inverse * whiten[i, 0, 1], b))
    f_1 = add(times(inverse * whiten[i, 1, 0], a), times(inverse * whiten[i, 1, 1], b))
    return f_0, f_1


@njit(**INLINED)
def _pull(f, v, s, near_s, t, near_t, inverse):
    """Return g = (∂b/∂m)ᵀ f, with ``inverse`` = 1 / |s + t|; ends at infinity do not contribute."""
    h = across(f, v)
    h = add(times(near_s, across(h, s)), times(near_t, across(h, t)))
    return times(-inverse, h)


@njit(**INLINED)
def _store(wrenches, k, q_0, g_0, q_1, g_1):
    wrenches[k, 0, 0], wrenches[k, 0, 1], wrenches[k, 0, 2] = q_0
    wrenches[k, 0, 3], wrenches[k, 0, 4], wrenches[k, 0, 5] = -g_0[0], -g_0[1], -g_0[2]
    wrenches[k, 1, 0], wrenches[k, 1, 1], wrenches[k, 1, 2] = q_1
    wrenches[k, 1, 3], wrenches[k, 1, 4], wrenches[k, 1, 5] = -g_1[0], -g_1[1], -g_1[2]


@njit(**INLINED)
def _turn_back(axis, point, sine, cosine, q, g):
    """Rotate a wrench back about the line through ``point``."""
    q = about(axis, -sine, cosine, add(q, cross(point, g)))
    g = about(axis, -sine, cosine, g)
    return minus(q, cross(point, g)), g


@njit(**INLINED)
def sighting_residual(g, drives, data, i, inverse, wrenches):
    """Compute the residual of sighting i, divided by the scale; fill the wrenches (3, 2, 6)."""
    t = turns(drives, data[0], i)
    m = place_vertex(g, t)
    n = turned(g, t, (g[15], g[16], g[17]))
    source, near_source = _direction(data[1], data[2], i, m)
    destination, near_destination = _direction(data[3], data[4], i, m)
    v = add(source, destination)
    size = 1.0 / math.sqrt(dot(v, v))
    v = times(size, v)
    f_0, f_1 = _gap_axes(data, i, inverse)
    gap = minus(n, v)
    g_0 = _pull(f_0, v, source, near_source, destination, near_destination, size)
    g_1 = _pull(f_1, v, source, near_source, destination, near_destination, size)
    q_0 = minus(cross(n, f_0), cross(m, g_0))
    q_1 = minus(cross(n, f_1), cross(m, g_1))
    _store(wrenches, 0, q_0, g_0, q_1, g_1)
    o = (g[3], g[4], g[5])
    q_0, g_0 = _turn_back(axis_1(g), o, t[0], t[1], q_0, g_0)
    q_1, g_1 = _turn_back(axis_1(g), o, t[0], t[1], q_1, g_1)
    _store(wrenches, 1, q_0, g_0, q_1, g_1)
    if not is_single(g):
        o = (g[9], g[10], g[11])
        q_0, g_0 = _turn_back(axis_2(g), o, t[2], t[3], q_0, g_0)
        q_1, g_1 = _turn_back(axis_2(g), o, t[2], t[3], q_1, g_1)
        _store(wrenches, 2, q_0, g_0, q_1, g_1)
    return dot(f_0, gap), dot(f_1, gap)


@njit(**INLINED)
def residual_jacobian(drives, counts, i, scratch, wrenches, jacobian):
    """Compute the derivative (2, P) of sighting i's residual as twists times wrenches."""
    twists, places = scratch[2], scratch[3]
    for p in range(twists.shape[0]):
        k = places[p, 0]
        a, b = 0.0, 0.0
        for c in range(6):
            a += twists[p, c] * wrenches[k, 0, c]
            b += twists[p, c] * wrenches[k, 1, c]
        d = places[p, 1]
        if d >= 0:
            slope = angle_per_slot(load_drive(drives, 0, d), counts[i, d], places[p, 2])
            a *= slope
            b *= slope
        jacobian[0, p], jacobian[1, p] = a, b
