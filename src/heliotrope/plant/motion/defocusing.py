"""Where DEFOCUS and STOW move a beam, and which of the two takes it out of a keep-out volume.

Anyone may issue both orders, and a local controller accepts them in every state, so no command
authority is needed. The paths are the paths of a heliostat without a sun vector: a rotation by the
defocus angles, or straight to stow, azimuth last.
"""

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray, as_float
from heliotrope.lcu import states
from heliotrope.mechanism.board_motion import end_down_the_path, offsets, turned
from heliotrope.mechanism.tracking import TrackingStatus
from heliotrope.plant.field.aims import BeamCheck
from heliotrope.plant.motion.paths import Paths
from heliotrope.safety import Act

Rows = npt.NDArray[np.intp]

#: Rotation of the axes between two poses that are checked, rad.
_PIECE = 0.02
#: A heliostat in IDLE or LOCKED is at standby if its axes are this close to the standby angles,
#: rad.
_STANDS_BY = 0.02


def order_out(
    paths: Paths,
    row: int,
    counts: FloatArray,
    sun: FloatArray,
    state: int = states.FAULT,
    aim: FloatArray | None = None,
    standby: FloatArray | None = None,
) -> Act:
    """Return DEFOCUS or STOW, whichever ends outside the volumes with less rotation inside them.

    If the stow position is unknown, DEFOCUS is returned.

    Parameters
    ----------
    paths
        Paths of the heliostats past the keep-out volumes.
    row, counts
        Index of the heliostat, and the positions of its axes, steps, (2,).
    sun
        Unit vector to the sun, (3,).
    state
        State of the heliostat; see `lcu.states`.
    aim, standby
        Its points, m, (3,); None: unknown.
    """
    stow = paths.stow[row]
    if not np.isfinite(stow).all():
        return Act.DEFOCUS
    rows = np.array([row])
    points = [np.full((1, 3), np.nan) if p is None else p[None] for p in (aim, standby)]
    (begin,), (end,) = (paths.angles(rows, at[None]) for at in (counts, stow))
    (off,) = defocused(paths, rows, counts[None], sun, np.array([state]), *points)
    corner = end.copy()
    corner[paths.azimuth[row]] = begin[paths.azimuth[row]]
    ends = {Act.DEFOCUS: np.stack([begin, off]), Act.STOW: np.stack([begin, corner, end])}
    costs = {act: _cost(paths.check, row, path, sun) for act, path in ends.items()}
    return min(costs, key=lambda act: (costs[act], act))


def defocused(
    paths: Paths,
    rows: Rows,
    counts: FloatArray,
    sun: FloatArray,
    state: npt.NDArray[np.integer],
    aims: FloatArray,
    standbys: FloatArray,
    *,
    alike: bool = False,
) -> FloatArray:
    """Return the angles (K, 2) at which DEFOCUS ends.

    Parameters
    ----------
    paths
        Paths of the heliostats.
    rows, counts, state
        Indices of the heliostats, (K,), positions of their axes, steps, (K, 2), and states, (K,).
    sun
        Unit vector to the sun, (3,).
    aims, standbys
        Their points, m, (K, 3); NaN: unknown.
    alike
        Whether all heliostats turn by the smallest defocus angles among them, as if the angles were
        not spread.
    """
    check, turn = paths.check, paths.defocus[rows]
    begin = paths.angles(rows, counts)
    if alike:
        turn = np.broadcast_to(turn.min(axis=0), turn.shape)

    def pose(some: Rows, points: FloatArray) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        solved = check.poses(rows[some], points, sun, counts[some])
        good = np.asarray(solved.chosen(solved.status) == TrackingStatus.OK)
        return as_float(solved.best_angles), good

    tracks = np.isin(state, states.ON_AIM)
    other = np.where(tracks[:, None], standbys, aims)
    end = turned(begin, offsets(pose, other, begin, turn), *paths.stops(rows))

    # From standby and from an approach, the beam moves down the safe path, if the path is known.
    goes = np.isin(state, (states.IDLE, states.LOCKED, states.APPROACHING))
    goes &= np.isfinite(standbys).all(axis=-1) & np.isfinite(paths.stow[rows]).all(axis=-1)
    down = np.flatnonzero(goes)
    points, length = paths.points(rows[down], standbys[down])
    angles, good = pose(np.repeat(down, points.shape[1]), points.reshape(-1, 3))
    apart = np.abs(angles.reshape(*points.shape[:2], 2) - begin[down, None]).max(axis=-1)
    exists = np.arange(points.shape[1]) < length[:, None]
    apart = np.where(good.reshape(apart.shape) & exists, apart, np.inf)
    place = apart.argmin(axis=-1) if apart.size else length
    # A heliostat at rest elsewhere has been moved there by an operator.
    at_standby = (place == length - 1) & (apart.min(axis=-1, initial=np.inf) <= _STANDS_BY)
    on_path = (state[down] == states.APPROACHING) | at_standby
    _, lower = end_down_the_path(
        lambda some, tried: pose(down[some], tried),
        points,
        np.where(on_path, place, 0),
        begin[down],
        turn[down],
    )
    end[down] = np.where(np.isfinite(lower), lower, end[down])
    return end


def defocused_field(
    check: BeamCheck, aims: FloatArray, sun: FloatArray, *, alike: bool = False
) -> FloatArray:
    """Return the angles (N, 2) at which DEFOCUS ends for a field that tracks its aims.

    Parameters
    ----------
    check
        The field.
    aims, sun
        ENU, m, (N, 3), and the unit vector to the sun, (3,).
    alike
        Whether all heliostats turn by the smallest defocus angles of the field, as if the angles
        were not spread.
    """
    rows = np.arange(len(check.names))
    counts = check.poses(rows, aims, sun).best_counts
    machines = [check.machines.get(name) for name in check.names]
    points = [None if machine is None else machine.standby for machine in machines]
    standbys = as_float([(np.nan,) * 3 if point is None else point for point in points])
    state = np.full(len(rows), states.TRACKING)
    return defocused(Paths(check), rows, counts, sun, state, aims, standbys, alike=alike)


def _cost(check: BeamCheck, row: int, path: FloatArray, sun: FloatArray) -> tuple[bool, float]:
    """Return whether a path (K, 2) ends inside a volume, and how far it turns inside, rad."""
    turns = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(path, axis=0)).max(axis=-1))])
    at = np.linspace(0.0, turns[-1], 2 + int(turns[-1] / _PIECE))
    poses = np.stack([np.interp(at, turns, path[:, i]) for i in (0, 1)], axis=-1)
    inside = check.inside(row, poses, sun)
    return bool(inside[-1]), float(np.mean(inside) * turns[-1])
