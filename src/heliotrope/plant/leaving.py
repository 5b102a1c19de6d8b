"""The shorter of the two ways on which a beam leaves a keep-out volume: DEFOCUS or STOW.

Both orders are open to anybody and never refused by a local controller, so no command authority is
needed. The ways are those of a mirror that has no sun: by the angles of the defocus, or straight to
stow, azimuth last.
"""

import numpy as np

from heliotrope.geometry import FloatArray, as_float
from heliotrope.lcu import states
from heliotrope.lcu.config import Config
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.machine import Machine
from heliotrope.plant.aims import BeamCheck
from heliotrope.safety import Act

#: States from which a mirror does not turn nearer to its standby point, wherever it stands.
_AT_AIM = (states.TRACKING, states.SEARCHING)
#: Turn of the axes between two poses that are looked at, rad.
_PIECE = 0.02


def way_out(
    check: BeamCheck,
    machine: Machine | None,
    row: int,
    counts: FloatArray,
    sun: FloatArray,
    aim: FloatArray | None = None,
    standby: FloatArray | None = None,
) -> Act:
    """Return DEFOCUS or STOW: the one whose way ends outside, and is inside for the smaller turn.

    Parameters
    ----------
    check
        Mirrors and keep-out volumes.
    machine
        Limits and resting places; None: STOW is not known, and the defocus is the usual one.
    row, counts
        Row of the heliostat, and where its axes stand, steps, (2,).
    sun
        Unit vector to the sun, (3,).
    aim
        Aim of a heliostat that does not track, m, (3,), from which it turns away.
    standby
        Standby point of a heliostat that tracks, m, (3,), which it does not turn nearer to.
    """
    if machine is None:
        return Act.DEFOCUS
    drives = Drive(check.drives.table[row])
    begin = as_float(drives.angles(counts))
    end = as_float(drives.angles(np.asarray(machine.stow, dtype=np.float64)))
    corner = end.copy()
    corner[machine.azimuth_axis] = begin[machine.azimuth_axis]
    ways = {
        Act.DEFOCUS: np.stack([begin, defocused(check, machine, row, counts, sun, aim, standby)]),
        Act.STOW: np.stack([begin, corner, end]),
    }
    costs = {act: _cost(check, row, path, sun) for act, path in ways.items()}
    return min(ways, key=lambda act: (costs[act], act))


def defocused(
    check: BeamCheck,
    machine: Machine | None,
    row: int,
    counts: FloatArray,
    sun: FloatArray,
    aim: FloatArray | None = None,
    standby: FloatArray | None = None,
) -> FloatArray:
    """Return the angles (2,) where DEFOCUS ends; parameters as of `way_out`."""
    drives = Drive(check.drives.table[row])
    begin = as_float(drives.angles(counts))
    aimed, stood = (_angles(check, row, point, counts, sun) for point in (aim, standby))
    return turned_away(begin, machine, drives, aimed, stood)


def turns_from(state: int, aim: FloatArray, standby: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return aim and standby point as DEFOCUS goes by them in a state, NaN where it does not."""
    nowhere = np.full(3, np.nan)
    return (nowhere, standby) if state in _AT_AIM else (aim, nowhere)


def _angles(
    check: BeamCheck, row: int, point: FloatArray | None, counts: FloatArray, sun: FloatArray
) -> FloatArray | None:
    """Return the angles at which a beam reaches a point; None without one."""
    if point is None or not np.isfinite(point).all():
        return None
    found = check.poses(np.array([row]), point[None], sun, counts[None])
    return as_float(found.best_angles[0])


def turned_away(
    begin: FloatArray,
    machine: Machine | None,
    drives: Drive,
    aimed: FloatArray | None = None,
    standby: FloatArray | None = None,
) -> FloatArray:
    """Return the angles (2,) of the defocus from some angles, as a local controller chooses them.

    From standby, on the way there, and where it is held, it turns away from the angles of the aim
    (``aimed``). From an aim, an axis that the usual sense would bring nearer to the angles of
    ``standby`` turns the other way. So does one that is near a stop, as in `lcu.motion`.
    """
    offsets = as_float(Config().defocus if machine is None else machine.defocus)
    if aimed is not None and np.isfinite(aimed).all():
        offsets = np.copysign(offsets, begin - aimed)
    elif standby is not None and np.isfinite(standby).all():
        off = begin - standby
        offsets = np.where(np.abs(off + offsets) < np.abs(off), -offsets, offsets)
    found = begin + offsets
    if machine is None:
        return found
    limits = np.array([(axis.low, axis.high) for axis in machine.axes], dtype=np.float64)
    stops = np.sort(np.stack([drives.angles(limits[:, k]) for k in (0, 1)], axis=-1), axis=-1)
    for i, (low, high) in enumerate(stops):
        if not low <= found[i] <= high:
            found[i] = begin[i] - offsets[i]
        if not low <= found[i] <= high:
            found[i] = low if begin[i] - low > high - begin[i] else high
    return found


def _cost(check: BeamCheck, row: int, path: FloatArray, sun: FloatArray) -> tuple[bool, float]:
    """Return whether a path (K, 2) ends inside a volume, and the turn made inside, rad."""
    turns = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(path, axis=0)).max(axis=-1))])
    at = np.linspace(0.0, turns[-1], 2 + int(turns[-1] / _PIECE))
    poses = np.stack([np.interp(at, turns, path[:, i]) for i in (0, 1)], axis=-1)
    inside = check.inside(row, poses, sun)
    return bool(inside[-1]), float(np.mean(inside) * turns[-1])
