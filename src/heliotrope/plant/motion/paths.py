"""The path of a beam between two axis positions, and from stow to standby.

The path is the same as in `lcu.motion`, with the same points, axis order and speeds. When leaving
or reaching stow, the axes move one after the other; in every other motion both start at once, each
at its own rate, so that the axis with the shorter motion arrives first.
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray, as_float, normalize
from heliotrope.lcu.config import Config
from heliotrope.mechanism.board_motion import Corners, safe_paths
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.tracking import TrackingStatus
from heliotrope.plant.field.aims import BeamCheck, point_text

Rows = npt.NDArray[np.intp]

#: Number of sections of a ramp, at whose ends the positions of both axes are computed. The error is
#: at most 1/36 of the length of a ramp.
_PARTS = 3
#: Time that a local controller needs between two points of the path, s.
_PAUSE = 0.15
#: Time over which the sun is assumed to move uniformly, s.
_LONG = 60.0
_WHEN = "on its way from stow to standby"


class Paths:
    """The paths of N heliostats.

    Parameters
    ----------
    check
        Heliostats with their mechanisms, keep-out volumes and receivers.

    Attributes
    ----------
    check
        As given.
    stow
        Step counts of stow, (N, 2); NaN if unknown.
    azimuth
        The axis that leaves stow first, (N,).
    defocus
        Angles of the defocus, rad, (N, 2).
    """

    def __init__(self, check: BeamCheck) -> None:
        self.check, count = check, len(check.names)
        self.stow = np.full((count, 2), np.nan)
        self.azimuth = np.zeros(count, dtype=np.intp)
        self.defocus = np.tile(as_float(Config().defocus), (count, 1))
        # For an unknown mechanism, both axes rotate at the same rate, without stops.
        self._rate = np.full((count, 2), 1e4)
        self._ramp = np.full((count, 2), 0.5)
        self._backlash = np.zeros((count, 2))
        self._low, self._high = np.full((count, 2), -np.inf), np.full((count, 2), np.inf)
        self._corners: list[Corners] = [()] * count
        for row, name in enumerate(check.names):
            machine = check.machines.get(name)
            if machine is None:
                continue
            self.stow[row], self.azimuth[row] = machine.stow, machine.azimuth_axis
            self.defocus[row], self._corners[row] = machine.defocus, machine.way
            for i, axis in enumerate(machine.axes):
                self._rate[row, i], self._ramp[row, i] = axis.rate, axis.rate / axis.acceleration
                self._backlash[row, i] = axis.backlash
                self._low[row, i], self._high[row, i] = axis.low, axis.high

    def points(self, rows: Rows, standbys: FloatArray) -> tuple[FloatArray, Rows]:
        """Return the points along the paths to standby points (K, 3), ENU, m.

        Returns
        -------
        Points (K, P, 3), and the number of points of each path, (K,).
        """
        origin = self.check.armature.origin_1[rows]
        corners = [self._corners[row] for row in rows.tolist()]
        return safe_paths(corners, self.check.position[rows], origin, standbys)

    def stops(self, rows: Rows) -> tuple[FloatArray, FloatArray]:
        """Return the lowest and the highest angles that the limits allow, rad, (K, 2)."""
        ends = np.stack([self._low[rows], self._high[rows]])
        known = np.isfinite(ends)
        drives = Drive(self.check.drives.table[rows])
        angles = np.sort(drives.angles(np.where(known, ends, 0.0)), axis=0)
        low, high = np.where(known, angles, ends)
        return low, high

    def turns(self, rows: Rows, begin: FloatArray, end: FloatArray) -> FloatArray:
        """Return the angles (K, 3, 2) between two sets of counts (K, 2), one axis after the other.

        The azimuth axis moves first, as when leaving stow.
        """
        corner = begin.copy()
        every = np.arange(len(rows))
        corner[every, self.azimuth[rows]] = end[every, self.azimuth[rows]]
        return self.angles(rows, np.stack([begin, corner, end], axis=1))

    def motion(
        self, rows: Rows, begin: FloatArray, end: FloatArray, *, ramps: bool = True
    ) -> FloatArray:
        """Return the angles (K, W, 2) between two sets of counts (K, 2), both axes at once.

        Parameters
        ----------
        rows, begin, end
            Indices of the heliostats, (K,); steps, (K, 2).
        ramps
            Whether the path covers both curves of a motion from rest to rest: forward at the full
            rate, and back along the curve with ramps; otherwise only the forward curve is covered.
        """
        turned = self._turned(rows, begin, end)
        steps, sign, rate = np.abs(turned - begin), np.sign(turned - begin), self._rate[rows]
        bend = rate * (steps / rate).min(axis=-1, keepdims=True)
        path = [begin, begin + sign * np.minimum(bend, steps), turned, end]
        if ramps:
            ramp = self._ramp[rows]
            path += [*(begin + sign * _gone(_bends(steps, rate, ramp), steps, rate, ramp))]
        return self.angles(rows, np.stack(path, axis=1))

    def _turned(self, rows: Rows, begin: FloatArray, end: FloatArray) -> FloatArray:
        """Return the counts (K, 2) at which motions reverse to reach goals from below."""
        below = np.maximum(end - self._backlash[rows], self._low[rows])
        return as_float(np.where(end < begin, np.minimum(below, end), end))

    def lasts(self, rows: Rows, begin: FloatArray, end: FloatArray, *, turns: bool) -> FloatArray:
        """Return how long a motion takes, s, (K,)."""
        steps = np.abs(self._turned(rows, begin, end) - begin)
        spans = _time(steps, self._rate[rows], self._ramp[rows])
        return np.asarray((spans.sum(axis=-1) if turns else spans.max(axis=-1)) + _PAUSE)

    def angles(self, rows: Rows, counts: FloatArray) -> FloatArray:
        """Return the axis angles at step counts, rad; angles and counts are (K, 2) or (K, W, 2)."""
        table = self.check.drives.table[rows]
        return as_float(Drive(table[:, None] if counts.ndim > 2 else table).angles(counts))

    def approach(
        self,
        rows: Rows,
        begin: FloatArray,
        standbys: FloatArray,
        sun: Callable[[float], FloatArray],
    ) -> dict[str, str]:
        """Return the heliostats whose path from stow to standby is blocked, and the reasons.

        Parameters
        ----------
        rows
            Indices of the heliostats, (K,).
        begin
            Step counts before the approach, (K, 2).
        standbys
            Standby points, ENU, m, (K, 3).
        sun
            Function that returns the unit vector to the sun, (3,), some seconds from now.
        """
        check, reasons = self.check, dict[str, str]()
        now, later = sun(0.0), sun(_LONG)
        if now[2] <= 0.0 or not len(rows):
            return reasons
        points, length = self.points(rows, standbys)
        at, time, going = begin.copy(), np.zeros(len(rows)), np.arange(len(rows))
        for place in range(int(length.max())):
            going = going[place < length[going]]
            share = (time[going] / _LONG)[:, None]
            light = normalize(now + share * (later - now), "sun")
            solved = check.poses(rows[going], points[going, place], light, at[going])
            good = solved.chosen(solved.status) == TrackingStatus.OK
            for i, status in zip(going[~good], solved.chosen(solved.status)[~good], strict=True):
                why = TrackingStatus(int(status)).text
                if status == TrackingStatus.STOPPED:
                    why = check.stop(rows[i], points[i, place], light[going == i][0], at[i])
                reasons[check.names[rows[i]]] = (
                    f"point {place + 1} of {length[i]} of the safe path, "
                    f"{point_text(points[i, place])} m: {why}"
                )
            going, light = going[good], light[good]
            first, last = at[going], np.round(solved.best_counts[good])
            moves = self.turns if place == 0 else self.motion
            path = moves(rows[going], first, last)
            blocked = check.crossing(rows[going], path, light, _WHEN)
            blocked |= check.moving(rows[going], path, light, _WHEN)
            time[going] += self.lasts(rows[going], first, last, turns=place == 0)
            at[going] = last
            if blocked:
                going = going[[check.names[row] not in blocked for row in rows[going]]]
                reasons |= blocked
        return reasons


def _time(steps: FloatArray, rate: FloatArray, ramp: FloatArray) -> FloatArray:
    """Return the time that (K, 2) steps take at given rates, s.

    Rates are in steps/s; a ramp, s, is added at each end.
    """
    whole = steps >= rate * ramp
    return np.asarray(np.where(whole, steps / rate + ramp, 2.0 * np.sqrt(steps * ramp / rate)))


def _bends(steps: FloatArray, rate: FloatArray, ramp: FloatArray) -> FloatArray:
    """Return instants, s, (M, K, 1), last first, between which motions are nearly straight."""
    last = _time(steps, rate, ramp)
    part = np.minimum(ramp, 0.5 * last) * (np.arange(_PARTS + 1) / _PARTS)[:, None, None]
    times = np.concatenate([part[1:], last - part])
    return -np.sort(-np.concatenate([times[..., :1], times[..., 1:]]), axis=0)


def _gone(time: FloatArray, steps: FloatArray, rate: FloatArray, ramp: FloatArray) -> FloatArray:
    """Return the steps (..., K, 2) that have been made at times (..., K, 1), s; see `_time`."""
    last, faster = _time(steps, rate, ramp), rate / ramp
    t, part = np.minimum(time, last), np.minimum(ramp, 0.5 * last)
    even = faster * part * (t - 0.5 * part)
    begun = np.where(t < part, 0.5 * faster * t**2, even)
    return as_float(np.where(t > last - part, steps - 0.5 * faster * (last - t) ** 2, begun))
