"""The mirror frame within the last frame of a mechanism and in ENU, and Euler angles in files."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray, as_float, normalize
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.kinds import NORTH, UP


def mirror_frame(normal: npt.ArrayLike) -> FloatArray:
    """Return the mirror's axes (x right, y up, z along the normal) in the chain's last frame.

    Facets are specified in these axes. At zero joint angles y is as close to up as the mirror
    allows (to north for a mirror that lies face up), and x is to the right as seen from
    the front.

    Parameters
    ----------
    normal
        ``Mechanism.normal``, unit vectors (..., 3).

    Returns
    -------
    Rotations from the mirror's axes to the chain's last frame, (..., 3, 3).
    """
    n = normalize(normal, "normal")
    lies_flat = np.linalg.norm(n[..., :2], axis=-1, keepdims=True) < 1e-6
    towards = np.where(lies_flat, NORTH, UP)
    y = normalize(towards - np.sum(towards * n, axis=-1, keepdims=True) * n)
    return np.stack([np.cross(y, n), y, n], axis=-1)


def euler_matrix(angles: npt.ArrayLike) -> FloatArray:
    """Return R = Rz·Ry·Rx, (..., 3, 3), for rotations about x, y and z by angles (..., 3), rad."""
    a = as_float(angles)
    sx, sy, sz = np.moveaxis(np.sin(a), -1, 0)
    cx, cy, cz = np.moveaxis(np.cos(a), -1, 0)
    rows = (
        (cy * cz, sx * sy * cz - cx * sz, cx * sy * cz + sx * sz),
        (cy * sz, sx * sy * sz + cx * cz, cx * sy * sz - sx * cz),
        (-sy, sx * cy, cx * cy),
    )
    return as_float(np.moveaxis(np.array(rows), (0, 1), (-2, -1)))


def orientation(mechanism: Mechanism, counts: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return rotations from concentrator coordinates to ENU (..., 3, 3) and vertices (..., 3).

    Parameters
    ----------
    mechanism
        Batch shape (...).
    counts
        Counts of the drives, (..., D).
    """
    frame = mirror_frame(mechanism.normal)
    # A mechanism rotates any direction fixed to the mirror in the same way as the normal.
    right = replace(mechanism, normal=frame[..., 0]).pose(counts)
    pose = mechanism.pose(counts)
    up = np.cross(pose.normal, right.normal)
    return np.stack([right.normal, up, pose.normal], axis=-1), pose.vertex
