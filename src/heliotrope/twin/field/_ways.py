"""Paths of beams for a whole field: corners with points between, as `lcu.motion` makes them."""

from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray
from heliotrope.lcu.motion import PIECE


def pieces(corners: FloatArray, origin: FloatArray) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Return paths with points added between corners; see `lcu.motion.PIECE`.

    Parameters
    ----------
    corners
        (N, C, 3), m.
    origin
        Origins of the beams, (N, 3), m.

    Returns
    -------
    Points (N, P, 3), and the number of points of each path, (N,).
    """
    rays = corners - origin[:, None]
    cross = np.linalg.norm(np.cross(rays[:, :-1], rays[:, 1:]), axis=-1)
    turn = np.arctan2(cross, np.einsum("nci,nci->nc", rays[:, :-1], rays[:, 1:]))
    parts = 1 + (turn / PIECE).astype(np.int64)
    length = 1 + parts.sum(axis=1)
    out = np.zeros((len(corners), int(length.max()), 3))
    out[:, 0] = corners[:, 0]
    place = np.ones(len(corners), dtype=np.int64)
    for c in range(parts.shape[1]):
        first, leg = corners[:, c], corners[:, c + 1] - corners[:, c]
        for k in range(1, int(parts[:, c].max()) + 1):
            rows = np.flatnonzero(k <= parts[:, c])
            n = parts[rows, c, None]
            inner: Any = first[rows] + leg[rows] * k / n
            out[rows, place[rows]] = np.where(k == n, corners[rows, c + 1], inner)
            place[rows] += 1
    return out, length
