"""Motion of local controllers: the safe path to standby, and the end position of a DEFOCUS.

The rules are those of `lcu.motion`, written for arrays for use by the plant and the simulation; the
boards run the scalar code.
"""

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray, as_float
from heliotrope.lcu.motion import FAR, PIECE

Rows = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]
#: Points of a safe path, ENU, m.
Corners = tuple[tuple[float, float, float], ...]
#: Function of indices (M,) into K heliostats and of points (M, 3). It returns the axis angles
#: (M, 2) at which the beams reach the points, and whether they can reach them, (M,).
Pose = Callable[[Rows, FloatArray], tuple[FloatArray, Mask]]


def safe_paths(
    corners: Sequence[Corners], position: FloatArray, origin: FloatArray, standby: FloatArray
) -> tuple[FloatArray, Rows]:
    """Return the points of beams from the ground to standby, as `Motion.way` does.

    Parameters
    ----------
    corners
        Points that the plant file specifies for each of N heliostats; () if each heliostat finds
        its own path.
    position, origin, standby
        Positions of the heliostats, origins of their beams, and standby points, ENU, m, (N, 3).

    Returns
    -------
    Points (N, P, 3), and the number of points of each path, (N,).
    """
    members: dict[Corners, list[int]] = {}
    for row, own in enumerate(corners):
        members.setdefault(own, []).append(row)
    made = []
    for own, rows in members.items():
        foot, end = position[rows], standby[rows]
        if own:
            before = np.broadcast_to(np.array(own), (len(rows), len(own), 3))
        else:  # beside the tower on the ground, half-way to its foot, then the foot
            east, north = 0.5 * (end - foot)[:, :2].T
            sine, cosine = 0.5, 0.866
            sideways = [cosine * east - sine * north, sine * east + cosine * north, 0.0 * east]
            under = np.concatenate([end[:, :2], foot[:, 2:]], axis=1)
            before = np.stack([foot + np.stack(sideways, axis=1), under], axis=1)
        made.append((rows, *pieces(np.concatenate([before, end[:, None]], axis=1), origin[rows])))
    points = np.zeros((len(corners), max((p.shape[1] for _, p, _ in made), default=0), 3))
    length = np.zeros(len(corners), dtype=np.intp)
    for rows, some, count in made:
        points[rows, : some.shape[1]], length[rows] = some, count
    return points, length


def pieces(corners: FloatArray, origin: FloatArray) -> tuple[FloatArray, Rows]:
    """Return paths with points added between corners; see `lcu.motion.PIECE`.

    Parameters
    ----------
    corners
        Corners of the paths, (N, C, 3), m.
    origin
        Origins of the beams, (N, 3), m.

    Returns
    -------
    Points (N, P, 3), and the number of points of each path, (N,).
    """
    rays = corners - origin[:, None]
    cross = np.linalg.norm(np.cross(rays[:, :-1], rays[:, 1:]), axis=-1)
    turn = np.arctan2(cross, np.einsum("nci,nci->nc", rays[:, :-1], rays[:, 1:]))
    parts = 1 + (turn / PIECE).astype(np.intp)
    length = 1 + parts.sum(axis=1)
    out = np.zeros((len(corners), int(length.max(initial=0)), 3))
    out[:, :1] = corners[:, :1]
    place = np.ones(len(corners), dtype=np.intp)
    for c in range(parts.shape[1]):
        first, leg = corners[:, c], corners[:, c + 1] - corners[:, c]
        for k in range(1, int(parts[:, c].max(initial=0)) + 1):
            rows = np.flatnonzero(k <= parts[:, c])
            n = parts[rows, c, None]
            inner = first[rows] + leg[rows] * k / n
            out[rows, place[rows]] = np.where(k == n, corners[rows, c + 1], inner)
            place[rows] += 1
    return out, length


def end_down_the_path(
    pose: Pose, path: FloatArray, place: Rows, begin: FloatArray, defocus: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the points at which DEFOCUS ends on the safe paths of heliostats.

    The rule is the same as in `lcu.motion.Motion._turn`. A heliostat moves back down its path until
    an axis has turned through its defocus angle or the beam reaches the ground.

    Parameters
    ----------
    pose
        Poses of the K heliostats; see `Pose`.
    path
        Safe paths, (K, P, 3), m.
    place
        Number of path points below each heliostat's beam, (K,); at 0 the beam does not move back.
    begin, defocus
        Present angles, and defocus angles of the axes, rad, (K, 2).

    Returns
    -------
    Points (K, 3) and angles (K, 2); NaN where no point is found, so that the heliostat turns by
    its defocus angles instead.
    """
    points, angles = np.full((len(place), 3), np.nan), np.full((len(place), 2), np.nan)
    place, left = place.copy(), np.arange(len(place))
    while len(left := left[place[left] > 0]):
        place[left] -= 1
        tried = path[left, place[left]]
        found, good = pose(left, tried)
        turn = np.abs(found - begin[left])
        good &= turn.max(axis=-1) <= FAR
        points[left[good]], angles[left[good]] = tried[good], found[good]
        goes_on = (turn < defocus[left]).all(axis=-1) & (tried[:, 2] > path[left, 0, 2])
        left = left[good & goes_on]
    return points, angles


def offsets(pose: Pose, points: FloatArray, begin: FloatArray, defocus: FloatArray) -> FloatArray:
    """Return the rotations of the axes where DEFOCUS does not follow the path.

    The rule is the same as in `lcu.motion.Motion._turn`. From an aim, the axes turn away from
    standby. A heliostat that is held turns away from its aim.

    Parameters
    ----------
    pose, begin, defocus
        As for `end_down_the_path`.
    points
        Standby point of a heliostat that tracks or searches, otherwise its aim, m, (K, 3); NaN if
        there is none.
    """
    off, known = np.full_like(begin, np.nan), np.flatnonzero(np.isfinite(points).all(axis=-1))
    if known.size:
        angles, good = pose(known, points[known])
        off[known[good]] = (begin[known] - angles)[good]
    return as_float(np.where(np.isnan(off), defocus, np.copysign(defocus, off)))


def turned(begin: FloatArray, offset: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Return angles turned by an offset, in reverse if a stop is near, as in `Motion._away`.

    Parameters
    ----------
    begin, offset, low, high
        Angles, offsets, and the stops, rad, (K, 2).
    """
    there, other = begin + offset, begin - offset
    stop = np.where(begin - low > high - begin, low, high)
    back = np.where((low <= other) & (other <= high), other, stop)
    return as_float(np.where((low <= there) & (there <= high), there, back))
