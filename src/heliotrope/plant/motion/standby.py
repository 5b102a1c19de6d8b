"""Standby points spread beside the receiver, so that no place in the air gets too much light.

At a single standby point all beams cross. Spread points bring them apart. A pattern that keeps
neighbours together (columns by azimuth, rows by distance) moves the crossing, but does not remove
it: the beams then cross in front of the points or behind them. Here, neighbours go to points far
apart. Each heliostat rests beside its own line of sight to the receiver, on the side from which the
path from stow arrives, in the sector of a ring from 30° below to 60° above the horizontal. Within
the sector the points follow a sequence without clusters, in the order of the distances from the
receiver, because the near heliostats have the narrowest and brightest beams.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray, as_float
from heliotrope.optics.beam import NOMINAL_DNI, Beams
from heliotrope.optics.glare import Hazard, glare_at
from heliotrope.optics.standing import Hottest, hottest, stays_below
from heliotrope.plant.field.aims import BeamCheck, default_aims, point_text
from heliotrope.plant.motion.paths import Paths
from heliotrope.plant.settings import JOIN_RATE

Rows = npt.NDArray[np.intp]

#: Edges of the sector, rad above the horizontal.
_LOW, _HIGH = float(np.radians(-30.0)), float(np.radians(60.0))
#: Root of x³ = x + 1: multiples of its powers fill a square evenly (Roberts' sequence R2).
_R2 = 1.324717957244746
#: Number of points tried for a heliostat, and maximum distance of points from the receiver as a
#: fraction of the receiver's height above the mirrors.
_TRIES, _FARTHEST = 40, 1.5
#: Precision of the size of the spread, relative; its smallest size, m; number of heliostats whose
#: paths decide the side.
_PRECISION, _SMALLEST, _SOME = 0.05, 1.0, 1000
#: Longest return to the receiver, relative to that from today's points.
LONGEST_RETURN = 1.1


@dataclass(frozen=True)
class Rest:
    """A field at standby.

    Attributes
    ----------
    points
        Standby points, ENU, m, (N, 3).
    light
        The strongest light in the air, for each of S sun positions.
    moves
        Time that each heliostat takes to its aim, s, (S, N).
    returns
        Time until the last heliostat is back, s, (S,): heliostats join one after another at the
        rate that the plant allows, without a flux ramp.
    blocked
        Number of heliostats without a clear path from stow, (S,).
    """

    points: FloatArray
    light: tuple[Hottest, ...]
    moves: FloatArray
    returns: FloatArray
    blocked: tuple[int, ...]


@dataclass(frozen=True)
class EyeYear:
    """A year of glare at a place, with the whole field at standby under a clear sky.

    Attributes
    ----------
    hours
        Daylight hours per year of each `Hazard`, (3,).
    suns
        Irradiance at the worst sun position, as a multiple of the direct sun.
    hazard
        Worst hazard in the year.
    sun
        Sun position with the strongest light, unit vector, (3,).
    """

    hours: FloatArray
    suns: float
    hazard: Hazard
    sun: FloatArray


class StandbyField:
    """Standby of a plant with one receiver.

    Parameters
    ----------
    design
        The plant; each heliostat has a machine table with a standby point.
    suns
        Unit vectors to the sun, (S, 3).

    Attributes
    ----------
    check
        Mechanisms, volumes and eyes.
    today
        The standby points of the plant file, ENU, m, (N, 3).

    Raises
    ------
    InputError
        If there is not one receiver, or a heliostat has no standby point.
    """

    def __init__(self, design: Plant, suns: FloatArray) -> None:
        if len(design.receivers) != 1 or not len(design):
            raise InputError(
                f"standby: {design.name} has {len(design.receivers)} receivers and {len(design)} "
                "heliostats; spread points need one receiver and at least one heliostat"
            )
        self.check, self.suns = BeamCheck(design, design.names), np.atleast_2d(suns)
        self.center = design.receivers[0].center
        machines = [self.check.machines.get(name) for name in design.names]
        points = []
        for name, machine in zip(design.names, machines, strict=True):
            if machine is None or machine.standby is None:
                raise InputError(
                    f"standby: heliostat {name} has no standby point; set standby_m in the machine "
                    "table of its group"
                )
            points.append(machine.standby)
        self.today = as_float(points)
        self._vertex = self.check.armature.origin_1
        self._rows, self._paths = np.arange(len(design)), Paths(self.check)
        aims = default_aims(design, design.names, self._vertex, None)
        self._aims = np.stack(list(aims.values()))
        self._around = float(np.linalg.norm(self._vertex - self.center, axis=-1).max())

    def rest(self, points: FloatArray, limit: float = np.inf) -> Rest:
        """Return the light, the return and the paths of the field at standby points (N, 3).

        ``limit``: largest light with which `spread` found these points, suns. It is an upper bound
        as well, often closer than that of the strongest light.
        """
        moves = self._moves(points)
        lights = [hottest(self._beams(points, s), self.center, self._around) for s in self.suns]
        return Rest(
            points,
            tuple(replace(light, bound=min(light.bound, limit)) for light in lights),
            moves,
            self._returns(moves),
            tuple(len(self._blocked(self._rows, points, sun)) for sun in self.suns),
        )

    def spread(
        self, limit: float, progress: Callable[[int, int], None] | None = None
    ) -> FloatArray:
        """Return the closest standby points, (N, 3), whose light certainly nowhere exceeds a limit.

        Parameters
        ----------
        limit
            Largest light in the air at the sun positions, suns.
        progress
            Called with the number of spreads tried.

        Raises
        ------
        InputError
            If no spread keeps the limit and the return, or a heliostat has no clear point.
        """
        side = self._side()
        largest = self._largest(side)
        if not self._keeps(self._points(side, largest), limit):
            raise self._too_low(self._points(side, largest), limit, largest)
        # The beams pass the same points at every sun, so one sun is enough to find the size.
        low, size, tried = 0.0, largest, 0
        while size - low > _PRECISION * size and size > _SMALLEST:
            middle = 0.5 * (low + size) if low else 0.6 * size
            if self._keeps(self._points(side, middle), limit, suns=1):
                size = middle
            else:
                low = middle
            tried += 1
            if progress is not None:
                progress(tried, 0)
        while not self._keeps(points := self._points(side, size), limit):
            size = min(size * (1.0 + _PRECISION), largest)
        self._check_eyes(points)
        return points

    def glare(
        self,
        points: FloatArray,
        eyes: FloatArray,
        hours: FloatArray,
        progress: Callable[[int, int], None] | None = None,
    ) -> list[EyeYear]:
        """Return the glare at eyes (P, 3) over sun positions, each weighted by hours (S,).

        The eyes look at the heliostats. The direct sun is 1000 W/m² at all hours, which errs on
        the safe side.
        """
        shape = (len(self.suns), len(eyes))
        hazard, light = np.zeros(shape, dtype=np.int8), np.zeros(shape)
        for k, sun in enumerate(self.suns):
            glare = glare_at(self._beams(points, sun), eyes)
            hazard[k], light[k] = glare.hazard, glare.corneal / NOMINAL_DNI
            if progress is not None:
                progress(k + 1, len(self.suns))
        years = []
        for p in range(len(eyes)):
            spent = np.bincount(hazard[:, p], hours, minlength=len(Hazard))
            worst = int(light[:, p].argmax())
            most = Hazard(int(hazard[:, p].max()))
            years.append(EyeYear(as_float(spent), float(light[worst, p]), most, self.suns[worst]))
        return years

    def _back_in_time(self, points: FloatArray) -> bool:
        today, back = (self._returns(self._moves(some)) for some in (self.today, points))
        return bool((back <= LONGEST_RETURN * today).all())

    @staticmethod
    def _returns(moves: FloatArray) -> FloatArray:
        return np.array([_returned(row) for row in moves])

    def _keeps(self, points: FloatArray, limit: float, suns: int | None = None) -> bool:
        return self._back_in_time(points) and all(
            stays_below(self._beams(points, sun), self.center, self._around, limit)
            for sun in self.suns[:suns]
        )

    def _beams(self, points: FloatArray, sun: FloatArray) -> Beams:
        return self.check.together(self.check.poses(self._rows, points, sun).best_angles, sun)

    def _points(self, side: float, size: float) -> FloatArray:
        """Return points in a sector ``size`` m wide, whose beams enter no receiver or target."""
        slant = np.linalg.norm(self._vertex - self.center, axis=-1)
        place = np.empty(len(slant), dtype=np.intp)
        place[np.argsort(slant, kind="stable")] = np.arange(len(slant))
        points, remaining = np.empty_like(self.today), self._rows
        following = len(slant)
        for trial in range(_TRIES):
            # Something may stand in the whole sector; the other side is free then.
            tried = side if trial < _TRIES // 2 else -side
            points[remaining] = self._sector(remaining, place[remaining], tried, size)
            clear = [self.check.at_rest(remaining, points[remaining], sun) for sun in self.suns]
            remaining = remaining[~np.all(clear, axis=0)]
            if not len(remaining):
                return points
            place[remaining] = following + np.arange(len(remaining))
            following += len(remaining)
        raise InputError(
            f"standby: {len(remaining)} heliostats, the first {self.check.names[remaining[0]]}, "
            f"find no point within {self._inner + size:.0f} m of the receiver from which no beam "
            "enters a receiver, a target or a keep-out volume; move their standby_m, or these "
            "volumes"
        )

    @property
    def _inner(self) -> float:
        """Distance of today's standby points from the receiver, m."""
        return float(np.median(np.linalg.norm(self.today - self.center, axis=-1)))

    def _sector(self, rows: Rows, place: Rows, side: float, size: float) -> FloatArray:
        """Return points (K, 3), ENU, m, of heliostats (K,) with numbers in the sequence (K,)."""
        sight = (self.center - self._vertex[rows]) * (1.0, 1.0, 0.0)
        level = np.linalg.norm(sight, axis=-1, keepdims=True)
        sight = np.where(level > 1e-3, sight / np.maximum(level, 1e-3), (0.0, 1.0, 0.0))
        aside = side * np.stack([sight[:, 1], -sight[:, 0], 0.0 * sight[:, 0]], axis=-1)
        turn = _LOW + (_HIGH - _LOW) * np.mod(0.5 + place / _R2, 1.0)
        inner, outer = self._inner, self._inner + size
        away = np.sqrt(inner**2 + (outer**2 - inner**2) * np.mod(0.5 + place / _R2**2, 1.0))
        up = (away * np.sin(turn))[:, None] * np.array([0.0, 0.0, 1.0])
        return as_float(self.center + (away * np.cos(turn))[:, None] * aside + up)

    def _side(self) -> float:
        """Return the side of the lines of sight, −1 left or 1 right, that blocks fewer paths."""
        rows = self._rows[:: 1 + len(self._rows) // _SOME]
        blocked = {}
        for side in (-1.0, 1.0):
            points = self._sector(rows, np.arange(len(rows)), side, self._inner)
            blocked[side] = sum(len(self._blocked(rows, points, sun)) for sun in self.suns)
        return min(blocked, key=lambda side: blocked[side])

    def _blocked(self, rows: Rows, points: FloatArray, sun: FloatArray) -> dict[str, str]:
        stow = self._paths.stow[rows]
        return self._paths.approach(rows, stow, points, lambda _: sun)

    def _moves(self, points: FloatArray) -> FloatArray:
        """Return the time from standby points (N, 3) to the aims, s, (S, N)."""
        times = []
        for sun in self.suns:
            begin = self.check.poses(self._rows, points, sun).best_counts
            end = self.check.poses(self._rows, self._aims, sun, begin).best_counts
            times.append(self._paths.lasts(self._rows, begin, end, turns=False))
        return np.stack(times)

    def _largest(self, side: float) -> float:
        """Return the largest spread that keeps the height and the return, m."""
        height = float(self.center[2] - self._vertex[:, 2].max())
        size = max(_FARTHEST * height - self._inner, _SMALLEST)
        while size > _SMALLEST and not self._back_in_time(self._points(side, size)):
            size *= 0.9
        return size

    def _too_low(self, points: FloatArray, limit: float, size: float) -> InputError:
        lights = [hottest(self._beams(points, sun), self.center, self._around) for sun in self.suns]
        worst = max(lights, key=lambda light: light.bound)
        return InputError(
            f"standby: no spread stays below {limit:g} suns: with points up to "
            f"{self._inner + size:.0f} m from the receiver there are {worst.suns:.1f} suns at "
            f"{point_text(worst.point)} m, and a wider spread would be too low or return later "
            f"than {LONGEST_RETURN:g} times today's return; a limit of "
            f"{np.ceil(worst.bound):.0f} suns can be met"
        )

    def _check_eyes(self, points: FloatArray) -> None:
        for sun in self.suns:
            if dazzled := self.check.glare(self._rows, points, [], sun):
                name, text = next(iter(dazzled.items()))
                raise InputError(
                    f"standby: {len(dazzled)} heliostats, the first {name}: {text}, or another "
                    "limit"
                )


def _returned(moves: FloatArray) -> float:
    """Return when the last of N heliostats is back, s, if their moves last (N,) s.

    They join in order, at the rate of a plant without a flux ramp.
    """
    turn = np.maximum(np.arange(1, len(moves) + 1) - JOIN_RATE, 0.0) / JOIN_RATE
    return float((turn + moves).max())
