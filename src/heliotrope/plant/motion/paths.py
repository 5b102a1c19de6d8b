"""The way of a beam between two positions of the axes, and from stow to standby.

It is the way of `lcu.motion`: its points, its order of the axes, and its speeds. One axis after the
other turns when stow is left, and when it is reached; in every other motion both start at once,
each at its own rate, so that the one with less to do arrives first.
"""

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray, as_float, normalize
from heliotrope.lcu.config import Config
from heliotrope.lcu.lease import SunLease
from heliotrope.lcu.motion import Motion
from heliotrope.lcu.pointing import Pointing
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.machine import Machine
from heliotrope.mechanism.tracking import TrackingStatus
from heliotrope.plant.field.aims import BeamCheck

Rows = npt.NDArray[np.intp]

#: Parts of a ramp at whose ends the positions of both axes are computed: they are then off by at
#: most 1/36 of the way that a ramp takes.
_PARTS = 3
#: Time that a local controller takes between two points of the way, s.
_PAUSE = 0.15
#: Time over which the sun is taken to move evenly, s.
_LONG = 60.0
_WHEN = "on its way from stow to standby"


class Paths:
    """The ways of N heliostats.

    Parameters
    ----------
    check
        Mirrors, keep-out volumes and receivers.
    machines
        Limits and resting places of heliostats, by name, as far as they are known.

    Attributes
    ----------
    stow
        Steps, (N, 2); NaN where it is not known.
    azimuth
        The axis that leaves stow first, (N,).
    """

    def __init__(self, check: BeamCheck, machines: Mapping[str, Machine]) -> None:
        self._check = check
        count = len(check.names)
        self.stow = np.full((count, 2), np.nan)
        self.azimuth = np.zeros(count, dtype=np.intp)
        # Of a machine that is not known, both axes turn at the same rate.
        self._rate = np.full((count, 2), 1e4)
        self._ramp = np.full((count, 2), 0.5)
        self._backlash = np.zeros((count, 2))
        self._low = np.full((count, 2), -np.inf)
        self._given: list[tuple[tuple[float, float, float], ...]] = [()] * count
        for row, name in enumerate(check.names):
            machine = machines.get(name)
            if machine is None:
                continue
            self.stow[row], self.azimuth[row] = machine.stow, machine.azimuth_axis
            self._given[row] = machine.way
            for i, axis in enumerate(machine.axes):
                self._rate[row, i], self._ramp[row, i] = axis.rate, axis.rate / axis.acceleration
                self._backlash[row, i], self._low[row, i] = axis.backlash, axis.low
        self._key = np.full((count, 6), np.nan)
        self._length = np.zeros(count, dtype=np.intp)
        self._way = np.zeros((count, 0, 3))

    def points(self, rows: Rows, standbys: FloatArray) -> tuple[FloatArray, npt.NDArray[np.intp]]:
        """Return the points of the ways to standby points (K, 3), ENU, m.

        Returns
        -------
        Points (K, P, 3), and how many of them each way has, (K,).
        """
        key = np.concatenate([self._check.armature.origin_1[rows], standbys], axis=1)
        for i in np.flatnonzero((self._key[rows] != key).any(axis=1)):
            row = int(rows[i])
            found = self._found(row, standbys[i])
            if len(found) > (room := self._way.shape[1]):
                self._way = np.pad(self._way, ((0, 0), (0, len(found) - room), (0, 0)))
            self._way[row, : len(found)] = found
            self._length[row], self._key[row] = len(found), key[i]
        return self._way[rows], self._length[rows]

    def _found(self, row: int, standby: FloatArray) -> list[tuple[float, float, float]]:
        """Return the points that a local controller with these settings finds."""
        return motion_of(self._check, row, self._given[row], standby).way()

    def turns(self, rows: Rows, begin: FloatArray, end: FloatArray) -> FloatArray:
        """Return the angles (K, 3, 2) from counts (K, 2) to others, one axis after the other.

        The azimuth turns first, as when stow is left.
        """
        corner = begin.copy()
        each = np.arange(len(rows))
        corner[each, self.azimuth[rows]] = end[each, self.azimuth[rows]]
        return self._angles(rows, np.stack([begin, corner, end], axis=1))

    def motion(
        self, rows: Rows, begin: FloatArray, end: FloatArray, *, ramps: bool = True
    ) -> FloatArray:
        """Return the angles (K, W, 2) from counts (K, 2) to others, both axes at once.

        Parameters
        ----------
        rows, begin, end
            Rows of the heliostats, (K,); steps, (K, 2).
        ramps
            Whether the path goes there at full rate and then back as the ramps round it, for a
            motion from rest to rest; if not, it only goes there.
        """
        turned = self._turned(rows, begin, end)
        way, sign, rate = np.abs(turned - begin), np.sign(turned - begin), self._rate[rows]
        bend = rate * (way / rate).min(axis=-1, keepdims=True)
        path = [begin, begin + sign * np.minimum(bend, way), turned, end]
        if ramps:
            ramp = self._ramp[rows]
            path += [*(begin + sign * _gone(_bends(way, rate, ramp), way, rate, ramp))]
        return self._angles(rows, np.stack(path, axis=1))

    def _turned(self, rows: Rows, begin: FloatArray, end: FloatArray) -> FloatArray:
        """Return the counts (K, 2) where motions turn back: a goal is reached from below."""
        below = np.maximum(end - self._backlash[rows], self._low[rows])
        return as_float(np.where(end < begin, np.minimum(below, end), end))

    def lasts(self, rows: Rows, begin: FloatArray, end: FloatArray, *, turns: bool) -> FloatArray:
        """Return how long a motion takes, s, (K,)."""
        way = np.abs(self._turned(rows, begin, end) - begin)
        each = _time(way, self._rate[rows], self._ramp[rows])
        return np.asarray((each.sum(axis=-1) if turns else each.max(axis=-1)) + _PAUSE)

    def _angles(self, rows: Rows, counts: FloatArray) -> FloatArray:
        table = self._check.drives.table[rows][:, None]
        angles: FloatArray = Drive(table).angles(counts)
        return angles

    def approach(
        self,
        rows: Rows,
        begin: FloatArray,
        standbys: FloatArray,
        sun: Callable[[float], FloatArray],
    ) -> dict[str, str]:
        """Return the heliostats whose way from stow to standby is not free, and why.

        Parameters
        ----------
        rows
            Rows of the heliostats, (K,).
        begin
            Step counts before the way, (K, 2).
        standbys
            Standby points, ENU, m, (K, 3).
        sun
            Returns the unit vector to the sun, (3,), some seconds from now.
        """
        check, found = self._check, dict[str, str]()
        now, later = sun(0.0), sun(_LONG)
        if now[2] <= 0.0 or not len(rows):
            return found
        way, length = self.points(rows, standbys)
        at, time, left = begin.copy(), np.zeros(len(rows)), np.arange(len(rows))
        for place in range(int(length.max())):
            left = left[place < length[left]]
            share = (time[left] / _LONG)[:, None]
            light = normalize(now + share * (later - now), "sun")
            solved = check.poses(rows[left], way[left, place], light, at[left])
            good = solved.chosen(solved.status) == TrackingStatus.OK
            for i in left[~good]:
                found[check.names[rows[i]]] = "its beam does not reach all points of the safe way"
            left, light = left[good], light[good]
            first, last = at[left], np.round(solved.best_counts[good])
            moves = self.turns if place == 0 else self.motion
            path = moves(rows[left], first, last)
            wrong = check.crossing(rows[left], path, light, _WHEN)
            wrong |= check.moving(rows[left], path, light, _WHEN)
            time[left] += self.lasts(rows[left], first, last, turns=place == 0)
            at[left] = last
            if wrong:
                left = left[[check.names[row] not in wrong for row in rows[left]]]
                found |= wrong
        return found


def motion_of(
    check: BeamCheck,
    row: int,
    given: tuple[tuple[float, float, float], ...],
    standby: FloatArray,
) -> Motion:
    """Return the motion of a local controller with a given way to a standby point (3,), m."""
    config, (east, north, up) = Config(), standby.tolist()
    config.pointing = Pointing(tuple(check.armature.table[row].tolist()))
    config.location = tuple(check.position[row].tolist())
    config.standby, config.path = (east, north, up), list(given)
    return Motion(config, SunLease(config.lease_ms), lambda: None)


def _time(way: FloatArray, rate: FloatArray, ramp: FloatArray) -> FloatArray:
    """Return how long steps (K, 2) take at rates (steps/s) that ramps (s) begin and end, s."""
    whole = way >= rate * ramp
    return np.asarray(np.where(whole, way / rate + ramp, 2.0 * np.sqrt(way * ramp / rate)))


def _bends(way: FloatArray, rate: FloatArray, ramp: FloatArray) -> FloatArray:
    """Return instants (M, K, 1), the last first, between which motions are straight enough, s."""
    last = _time(way, rate, ramp)
    part = np.minimum(ramp, 0.5 * last) * (np.arange(_PARTS + 1) / _PARTS)[:, None, None]
    times = np.concatenate([part[1:], last - part])
    return -np.sort(-np.concatenate([times[..., :1], times[..., 1:]]), axis=0)


def _gone(time: FloatArray, way: FloatArray, rate: FloatArray, ramp: FloatArray) -> FloatArray:
    """Return the steps (..., K, 2) that are made by times (..., K, 1), s; see `_time`."""
    last, faster = _time(way, rate, ramp), rate / ramp
    t, part = np.minimum(time, last), np.minimum(ramp, 0.5 * last)
    even = faster * part * (t - 0.5 * part)
    begun = np.where(t < part, 0.5 * faster * t**2, even)
    return as_float(np.where(t > last - part, way - 0.5 * faster * (last - t) ** 2, begun))
