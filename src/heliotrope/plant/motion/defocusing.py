"""The shorter of the two ways on which a beam leaves a keep-out volume: DEFOCUS or STOW.

Both orders are open to anybody, and a local controller accepts them in every state, so no command
authority is needed. The ways are those of a mirror that has no sun: by the angles of the defocus,
or straight to stow, azimuth last.
"""

from dataclasses import replace

import numpy as np

from heliotrope.geometry import FloatArray, as_float
from heliotrope.lcu import states
from heliotrope.lcu.config import Config
from heliotrope.lcu.motion import FAR
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.machine import Machine
from heliotrope.plant.field.aims import BeamCheck
from heliotrope.plant.motion.paths import motion_of
from heliotrope.safety import Act

#: Turn of the axes between two poses that are looked at, rad.
_PIECE = 0.02
#: One in IDLE or LOCKED stands by if its axes are this near to the angles of standby, rad.
_STANDS_BY = 0.02


def way_out(
    check: BeamCheck,
    machine: Machine | None,
    row: int,
    counts: FloatArray,
    sun: FloatArray,
    state: int = states.FAULT,
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
    state
        Of the heliostat; see `lcu.states`.
    aim
        Its aim, m, (3,), from which it turns away where it neither tracks nor stands by.
    standby
        Its standby point, m, (3,): where it tracks, it does not turn nearer to that; from there and
        on the way there it goes back down the way.
    """
    if machine is None:
        return Act.DEFOCUS
    drives = Drive(check.drives.table[row])
    begin = as_float(drives.angles(counts))
    end = as_float(drives.angles(np.asarray(machine.stow, dtype=np.float64)))
    corner = end.copy()
    corner[machine.azimuth_axis] = begin[machine.azimuth_axis]
    ways = {
        Act.DEFOCUS: np.stack(
            [begin, defocused(check, machine, row, counts, sun, state, aim, standby)]
        ),
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
    state: int = states.FAULT,
    aim: FloatArray | None = None,
    standby: FloatArray | None = None,
) -> FloatArray:
    """Return the angles (2,) where DEFOCUS ends; parameters as of `way_out`."""
    drives = Drive(check.drives.table[row])
    begin = as_float(drives.angles(counts))
    stood = _angles(check, row, standby, counts, sun)
    if state in states.ON_AIM:  # it does not turn nearer to its standby point
        return turned_away(begin, machine, drives, None, stood)
    if machine is not None and standby is not None and stood is not None:
        end = _down(check, machine, row, counts, sun, state, standby)
        if end is not None:
            return end
    return turned_away(begin, machine, drives, _angles(check, row, aim, counts, sun))


def defocused_field(
    check: BeamCheck, aims: FloatArray, sun: FloatArray, *, alike: bool = False
) -> FloatArray:
    """Return the angles (N, 2) where DEFOCUS ends for a field that tracks its aims (N, 3).

    Parameters
    ----------
    check
        The field.
    aims, sun
        ENU, m, (N, 3), and the unit vector to the sun, (3,).
    alike
        Whether all turn by the smallest angles of the field, as if they were not spread.
    """
    rows = np.arange(len(check.names))
    tracking = check.poses(rows, aims, sun)
    machines = [check.machines.get(name) for name in check.names]
    known = [machine for machine in machines if machine is not None]
    if alike and known:
        one, two = np.min([machine.defocus for machine in known], axis=0).tolist()
        machines = [None if m is None else replace(m, defocus=(one, two)) for m in machines]
    points = [None if m is None or m.standby is None else m.standby for m in machines]
    standbys = as_float([(np.nan,) * 3 if point is None else point for point in points])
    stood = check.poses(rows, standbys, sun, tracking.best_counts).best_angles
    begin = as_float(tracking.best_angles)
    drives = check.drives.table
    return np.stack(
        [
            turned_away(begin[row], machines[row], Drive(drives[row]), None, stood[row])
            for row in rows
        ]
    )


def _down(
    check: BeamCheck,
    machine: Machine,
    row: int,
    counts: FloatArray,
    sun: FloatArray,
    state: int,
    standby: FloatArray,
) -> FloatArray | None:
    """Return the angles (2,) down the way in which DEFOCUS ends: `lcu.motion`; None elsewhere."""
    if state not in (states.IDLE, states.LOCKED, states.APPROACHING):
        return None
    points = np.array(motion_of(check, row, machine.way, standby).way())
    begin = as_float(Drive(check.drives.table[row]).angles(counts))
    rows = np.full(len(points), row)
    found = check.poses(rows, points, sun, np.tile(counts, (len(points), 1)))
    turns = np.abs(as_float(found.best_angles) - begin)
    near = np.nan_to_num(turns.max(axis=-1), nan=np.inf)
    place = int(near.argmin())
    if state != states.APPROACHING and (place < len(points) - 1 or near[place] > _STANDS_BY):
        return None  # a person has moved it elsewhere
    end = None
    for i in reversed(range(place)):
        if not near[i] <= FAR:
            break
        end = as_float(found.best_angles[i])
        if (turns[i] >= machine.defocus).any() or points[i, 2] <= points[0, 2]:
            break
    return end


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

    Where it is held, it turns away from the angles of the aim (``aimed``). From an aim, an axis
    that the usual sense would bring nearer to the angles of ``standby`` turns the other way. So
    does one that is near a stop, as in `lcu.motion`.
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
