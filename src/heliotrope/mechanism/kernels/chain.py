"""Compiled: forward kinematics of the joint chain, and the screw Jacobian.

A chain is (position (3,), orientation (3, 3), axes (J, 3), origins (J, 3), angles (J,), drives (D,
S), driven (D,), vertex (3,), normal (3,)). Rotating joint j by a small angle rotates everything
beyond the joint about the line through o_j along w_j. Hence for an angle parameter dn = w × n and
dm = w × (m − o); for an offset parameter dm is the offset direction rotated into the current pose;
a drive parameter enters through dθ/dp.
"""

import math

import numpy as np
from numba import njit

from heliotrope.jit import INNER, OPTIONS
from heliotrope.mechanism.kernels.drives import (
    angle_per_count,
    angle_per_slot,
    drive_angle,
    load_drive,
)
from heliotrope.mechanism.kernels.slots import (
    MOVES_ALONG_NORMAL,
    MOVES_DRIVE,
    MOVES_JOINT,
    MOVES_ORIGIN,
    MOVES_POSITION,
    MOVES_VERTEX,
)


@njit(**INNER)
def turn(matrix, axis, angle, out):
    """Set out = matrix · Rot(axis, angle), with the axis in the frame of ``matrix``."""
    x, y, z = axis[0], axis[1], axis[2]
    sine = math.sin(angle)
    half = math.sin(0.5 * angle)
    versine = 2.0 * half * half
    r00 = 1.0 - versine * (y * y + z * z)
    r01 = versine * x * y - sine * z
    r02 = versine * x * z + sine * y
    r10 = versine * x * y + sine * z
    r11 = 1.0 - versine * (x * x + z * z)
    r12 = versine * y * z - sine * x
    r20 = versine * x * z - sine * y
    r21 = versine * y * z + sine * x
    r22 = 1.0 - versine * (x * x + y * y)
    for i in range(3):
        a, b, c = matrix[i, 0], matrix[i, 1], matrix[i, 2]
        out[i, 0] = a * r00 + b * r10 + c * r20
        out[i, 1] = a * r01 + b * r11 + c * r21
        out[i, 2] = a * r02 + b * r12 + c * r22


@njit(**INNER)
def _place(matrix, vector, out):
    for i in range(3):
        out[i] = matrix[i, 0] * vector[0] + matrix[i, 1] * vector[1] + matrix[i, 2] * vector[2]


@njit(**INNER)
def chain_pose(
    position,
    orientation,
    axes,
    origins,
    angles,
    driven,
    joint_angles,
    vertex,
    normal,
    frames,
    screw_axes,
    screw_points,
    n,
    m,
):
    """Compute the pose of a chain whose driven joints are at ``joint_angles`` (D,).

    The outputs are frames (J + 1, 3, 3), which are the orientations before each joint and of the
    mirror, screw_axes (J, 3) and screw_points (J, 3) in ENU, normal n (3,) and vertex m (3,).
    """
    joints = axes.shape[0]
    for i in range(3):
        m[i] = position[i]
        for k in range(3):
            frames[0, i, k] = orientation[i, k]
    for j in range(joints):
        frame = frames[j]
        for i in range(3):
            m[i] += (
                frame[i, 0] * origins[j, 0]
                + frame[i, 1] * origins[j, 1]
                + frame[i, 2] * origins[j, 2]
            )
            screw_points[j, i] = m[i]
        _place(frame, axes[j], screw_axes[j])
        angle = angles[j]
        for k in range(driven.shape[0]):
            if driven[k] == j:
                angle += joint_angles[k]
        turn(frame, axes[j], angle, frames[j + 1])
    _place(frames[joints], normal, n)
    frame = frames[joints]
    for i in range(3):
        m[i] += frame[i, 0] * vertex[0] + frame[i, 1] * vertex[1] + frame[i, 2] * vertex[2]


@njit(**INNER)
def _screw(axis, point, n, m, factor, dn, dm):
    dn[0] = factor * (axis[1] * n[2] - axis[2] * n[1])
    dn[1] = factor * (axis[2] * n[0] - axis[0] * n[2])
    dn[2] = factor * (axis[0] * n[1] - axis[1] * n[0])
    x, y, z = m[0] - point[0], m[1] - point[1], m[2] - point[2]
    dm[0] = factor * (axis[1] * z - axis[2] * y)
    dm[1] = factor * (axis[2] * x - axis[0] * z)
    dm[2] = factor * (axis[0] * y - axis[1] * x)


@njit(**INNER)
def chain_derivative(
    what, index, sub, drives, driven, counts, frames, screw_axes, screw_points, n, m, dn, dm
):
    """Compute the derivatives of normal and vertex with respect to a parameter.

    The parameter is (what, index, sub).
    """
    if what == MOVES_JOINT:
        _screw(screw_axes[index], screw_points[index], n, m, 1.0, dn, dm)
    elif what == MOVES_DRIVE:
        j = driven[index]
        factor = angle_per_slot(drives[index], counts[index], sub)
        _screw(screw_axes[j], screw_points[j], n, m, factor, dn, dm)
    else:
        for i in range(3):
            dn[i] = 0.0
            if what == MOVES_POSITION:
                dm[i] = 1.0 * (i == sub)
            elif what == MOVES_ORIGIN:
                dm[i] = frames[index, i, sub]
            elif what == MOVES_VERTEX:
                dm[i] = frames[frames.shape[0] - 1, i, sub]
            elif what == MOVES_ALONG_NORMAL:
                dm[i] = n[i]


@njit(**OPTIONS)
def pose_block(
    position,
    orientation,
    axes,
    origins,
    angles,
    drives,
    driven,
    vertex,
    normal,
    counts,
    rows,
    n_out,
    m_out,
    start,
    stop,
):
    """Compute normals and vertices at counts (M, D) of the mechanisms ``rows`` (M,)."""
    joints = axes.shape[1]
    frames = np.empty((joints + 1, 3, 3))
    screw_axes, screw_points = np.empty((joints, 3)), np.empty((joints, 3))
    joint_angles = np.empty(driven.shape[0])
    for i in range(start, stop):
        r = rows[i]
        for k in range(driven.shape[0]):
            joint_angles[k] = drive_angle(load_drive(drives, r, k), counts[i, k])
        chain_pose(
            position[r],
            orientation[r],
            axes[r],
            origins[r],
            angles[r],
            driven,
            joint_angles,
            vertex[r],
            normal[r],
            frames,
            screw_axes,
            screw_points,
            n_out[i],
            m_out[i],
        )


@njit(**OPTIONS)
def jacobian_block(
    position,
    orientation,
    axes,
    origins,
    angles,
    drives,
    driven,
    vertex,
    normal,
    counts,
    rows,
    codes,
    n_out,
    m_out,
    dn_out,
    dm_out,
    dn_counts,
    dm_counts,
    start,
    stop,
):
    """Compute poses with derivatives with respect to parameters and counts.

    ``codes`` (P, 3) are the codes of the parameters.
    """
    joints = axes.shape[1]
    frames = np.empty((joints + 1, 3, 3))
    screw_axes, screw_points = np.empty((joints, 3)), np.empty((joints, 3))
    joint_angles = np.empty(driven.shape[0])
    for i in range(start, stop):
        r = rows[i]
        for k in range(driven.shape[0]):
            joint_angles[k] = drive_angle(drives[r, k], counts[i, k])
        n, m = n_out[i], m_out[i]
        chain_pose(
            position[r],
            orientation[r],
            axes[r],
            origins[r],
            angles[r],
            driven,
            joint_angles,
            vertex[r],
            normal[r],
            frames,
            screw_axes,
            screw_points,
            n,
            m,
        )
        for p in range(codes.shape[0]):
            chain_derivative(
                codes[p, 0],
                codes[p, 1],
                codes[p, 2],
                drives[r],
                driven,
                counts[i],
                frames,
                screw_axes,
                screw_points,
                n,
                m,
                dn_out[i, p],
                dm_out[i, p],
            )
        for k in range(driven.shape[0]):
            factor = angle_per_count(drives[r, k], counts[i, k])
            j = driven[k]
            _screw(screw_axes[j], screw_points[j], n, m, factor, dn_counts[i, k], dm_counts[i, k])


@njit(**OPTIONS)
def armature_block(
    position, orientation, axes, origins, angles, driven, vertex, normal, out, start, stop
):
    """Compute armatures (N, 18): axes, points, vertex and normal in ENU at zero joint angles."""
    joints = axes.shape[1]
    frames = np.empty((joints + 1, 3, 3))
    screw_axes, screw_points = np.empty((joints, 3)), np.empty((joints, 3))
    joint_angles = np.zeros(driven.shape[0])
    n, m = np.empty(3), np.empty(3)
    for i in range(start, stop):
        chain_pose(
            position[i],
            orientation[i],
            axes[i],
            origins[i],
            angles[i],
            driven,
            joint_angles,
            vertex[i],
            normal[i],
            frames,
            screw_axes,
            screw_points,
            n,
            m,
        )
        for c in range(3):
            for k in range(driven.shape[0]):
                out[i, 6 * k + c] = screw_axes[driven[k], c]
                out[i, 6 * k + 3 + c] = screw_points[driven[k], c]
            out[i, 12 + c], out[i, 15 + c] = m[c], n[c]
