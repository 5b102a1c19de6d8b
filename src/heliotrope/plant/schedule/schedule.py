"""The schedule of calibration: which heliostat is photographed next, on which target.

A decision has two steps. All heliostats are screened by angles and by the most that a visit could
bring: the whole of their expected squared beam error, over the time that a visit takes. In the
order of this bound some at a time are judged exactly: stops, the way of the drives, who is shaded
or blocked, and by how much the error would fall. It ends when no bound is above the best that
was found. Heliostats that were not calibrated for longer than they may wait come first.

Nothing here reads a clock or moves a mirror: time, sun and states are arguments.
"""

from collections import deque
from collections.abc import Collection, Iterator, Sequence
from datetime import UTC, datetime, timedelta
from itertools import islice
from typing import Protocol

import numpy as np
import numpy.typing as npt

from heliotrope import sun as solar
from heliotrope.calibration.learn.drift import DAY
from heliotrope.calibration.sightings import Sightings
from heliotrope.errors import InputError, TimeError, UnknownNameError
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray, as_vectors
from heliotrope.lcu import states as lcu_states
from heliotrope.plant.schedule.account import (
    SURPRISE,
    Assignment,
    Comparison,
    Finished,
    Visited,
    compare,
)
from heliotrope.plant.schedule.choice import Judge, Mask
from heliotrope.plant.schedule.field import FieldKnowledge
from heliotrope.plant.schedule.settings import Settings, Weather

__all__ = [
    "Assignment",
    "Comparison",
    "Finished",
    "Scheduler",
    "Settings",
    "States",
    "Visited",
    "Weather",
    "compare",
]

#: States from which a heliostat can be sent to a target.
READY = (lcu_states.IDLE, lcu_states.TRACKING)
#: Finished visits that are remembered.
REMEMBERED = 20_000
#: Steps of a plan while there is nothing to do, s.
_STEP = 600.0


class States(Protocol):
    """What is known of the field now, in the order of the scheduler's names."""

    @property
    def state(self) -> npt.NDArray[np.uint8]:
        """Of `lcu.states`, or any other number where it is not known, (N,)."""
        ...

    @property
    def counts(self) -> npt.NDArray[np.int32]:
        """Of the drives, (N, 2)."""
        ...


class Scheduler:
    """Says what to measure next.

    Parameters
    ----------
    design
        The plant; each of its targets counts.
    settings
        See `Settings`.
    now
        Its year's suns count; and the age of those that were never calibrated begins then.
    names
        Order of the heliostats in `States`; default that of the design.

    Attributes
    ----------
    names
        Of the heliostats.
    reason
        Why the last decision was as it was, or why there was none.
    running
        Assignments under way, by heliostat.
    finished
        The last visits with what was expected of them.

    Raises
    ------
    InputError
        No target, names that are not those of the design, or a time without zone.
    UnknownNameError
        A model that the mechanisms do not have.
    """

    def __init__(
        self,
        design: Plant,
        settings: Settings | None = None,
        *,
        now: datetime,
        names: Sequence[str] | None = None,
    ) -> None:
        self.design, self.settings = design, settings or Settings()
        self.names = tuple(names) if names is not None else design.names
        if not design.targets or not len(design):
            raise InputError(
                f"schedule: {len(design.targets)} targets and {len(design)} heliostats; nothing "
                "can be calibrated with a camera: give at least one of each"
            )
        self.reason = ""
        self.running: dict[str, Assignment] = {}
        self.finished: deque[Finished] = deque(maxlen=REMEMBERED)
        begin, year = _unix(now), now.astimezone(UTC).year
        self._known = FieldKnowledge(design, self.settings, self.names, begin, year)
        self._judge = Judge(design, self.settings, self._known, self.names)
        # What is expected of those under way, by heliostat.
        self._slopes: dict[str, FloatArray] = {}
        self._failures = np.zeros(len(self.names), dtype=np.int64)
        self._retry = np.full(len(self.names), -np.inf)

    # -- what is known ---------------------------------------------------------------------

    def expected(self, now_utc: datetime) -> FloatArray:
        """Return the expected beam error over the year, rad RMS (2-D), (N,)."""
        return np.asarray(np.sqrt(self._known.squares(_unix(now_utc))))

    def age(self, now_utc: datetime) -> FloatArray:
        """Return the time since the last calibration, or since the beginning, s, (N,)."""
        return self._known.ages(_unix(now_utc))

    def learn(self, heliostat: str, seen: Sightings, at: datetime) -> None:
        """Take all the sightings (heliostat row 0) that a heliostat's parameters rest on.

        Raises
        ------
        UnknownNameError
            If there is no such heliostat.
        """
        self._known.learn(self._find(heliostat), seen, _unix(at))

    def observe(self, heliostat: str, error: float, now_utc: datetime) -> bool:
        """Take the beam error that somebody saw in operation, rad; return whether it surprises.

        If it is more than `SURPRISE` times what was expected the heliostat has changed, and is
        taken to be as little known as the error says.

        Raises
        ------
        UnknownNameError
            If there is no such heliostat.
        """
        row, now = self._find(heliostat), _unix(now_utc)
        expected = float(self._known.squares(now)[row])
        if not error**2 > SURPRISE**2 * expected:
            return False
        self._known.doubt(row, error**2 / expected)
        return True

    def _find(self, heliostat: str) -> int:
        if heliostat not in self._known.row:
            raise UnknownNameError("heliostat", heliostat, self.names)
        return self._known.row[heliostat]

    # -- deciding --------------------------------------------------------------------------

    def next(
        self,
        now_utc: datetime,
        sun: npt.ArrayLike,
        states: States,
        free_targets: Sequence[str],
        holds: Collection[str] = (),
        weather: Weather | None = None,
    ) -> Assignment | None:
        """Return what to measure now, and note that it is under way; None: nothing, see `reason`.

        Call `done` or `cancel` when it has ended.

        Parameters
        ----------
        now_utc, sun
            Time, and the unit vector to the sun, ENU, (3,).
        states
            Of the field.
        free_targets
            Names of the targets that no beam is on, each with a camera that is ready.
        holds
            Heliostats that are left alone.
        weather
            As far as it is measured.

        Raises
        ------
        UnknownNameError
            If there is no such target.
        """
        for name in free_targets:
            if name not in self._judge.sights:
                raise UnknownNameError("target", name, self._judge.sights)
        now = _unix(now_utc)
        counts = np.asarray(states.counts, dtype=np.float64)
        choice, self.reason = self._judge.decide(
            now,
            as_vectors(sun, "sun"),
            self._ready(now, states, (*holds, *self.running)),
            free_targets,
            counts,
            weather,
        )
        if choice is None:
            return None
        told = choice.assignment
        self.running[told.heliostat], self._slopes[told.heliostat] = told, choice.slope
        return told

    def _ready(self, now: float, states: States | None, away: Collection[str]) -> Mask:
        ready = now >= self._retry
        if states is not None:
            if np.shape(states.state) != ready.shape:
                raise InputError(
                    f"schedule: states of shape {np.shape(states.state)}; give one for each of "
                    f"{len(ready)} heliostats"
                )
            ready &= np.isin(states.state, READY)
        return self._without(ready, away)

    def _without(self, ready: Mask, names: Collection[str]) -> Mask:
        left = np.array(ready)
        left[[self._known.row[name] for name in names if name in self._known.row]] = False
        return left

    # -- what became of it -----------------------------------------------------------------

    def done(self, visited: Visited) -> Finished | None:
        """Take what became of a visit; return it beside what was expected, if it was planned.

        Raises
        ------
        UnknownNameError
            If there is no such heliostat.
        """
        row = self._find(visited.heliostat)
        planned = self.running.pop(visited.heliostat, None)
        self._slopes.pop(visited.heliostat, None)
        finished = None if planned is None else Finished(planned, visited)
        if visited.calibrated and visited.sightings is not None:
            again = self._known.calibrated(row)
            self._known.learn(row, visited.sightings, visited.ended)
            self._failures[row], self._retry[row] = 0, -np.inf
            if finished is not None and finished.surprise and again:
                # What was seen before it changed says less than the information believes.
                self._known.doubt(row, (visited.measured / finished.planned.predicted) ** 2)
        else:
            self._failures[row] += 1
            wait = self.settings.retry * 2.0 ** (min(int(self._failures[row]), 30) - 1)
            self._retry[row] = visited.ended + min(wait, DAY)
        if finished is not None:
            self.finished.append(finished)
        return finished

    def cancel(self, heliostat: str) -> None:
        """Forget an assignment that was not begun, or that ended for no fault of the heliostat."""
        self.running.pop(heliostat, None)
        self._slopes.pop(heliostat, None)

    def compared(self, since: datetime | None = None) -> Comparison:
        """Return the finished visits, from a time on, beside their prediction."""
        begin = -np.inf if since is None else _unix(since)
        return compare(f for f in self.finished if f.visited.ended >= begin)

    # -- what is to come -------------------------------------------------------------------

    def plan(
        self,
        now_utc: datetime,
        horizon: timedelta,
        states: States | None = None,
        holds: Collection[str] = (),
        most: int = 20,
    ) -> list[Assignment]:
        """Return the next measurements, if the sky stays clear and each brings what is expected.

        Parameters
        ----------
        now_utc, horizon
            From when, and how long.
        states, holds
            As for `next`; None: all stand ready.
        most
            So many at most: each takes as long as a decision.
        """
        coming = self.upcoming(now_utc, horizon, states, holds)
        return list(islice((told for told in coming if told is not None), most))

    def upcoming(
        self,
        now_utc: datetime,
        horizon: timedelta,
        states: States | None = None,
        holds: Collection[str] = (),
    ) -> Iterator[Assignment | None]:
        """Yield what `plan` returns one by one, None between: each step is one decision at most."""
        now = _unix(now_utc)
        end, known = now + horizon.total_seconds(), self._known.copy()
        judge = self._judge.of(known)
        counts = None if states is None else np.asarray(states.counts, dtype=np.float64)
        free = {t.name: now for t in self.design.targets}
        for name, held in self.running.items():
            free[held.target] = max(free[held.target], held.until)
            if name in self._slopes:
                known.assume(known.row[name], self._slopes[name], held.until)
        away = dict(self.running)
        while now < end:
            away = {name: told for name, told in away.items() if told.until > now}
            empty = [name for name, at in free.items() if at <= now]
            sun = solar.vector(datetime.fromtimestamp(now, UTC), self.design.site)
            ready = self._ready(now, states, (*holds, *away))
            choice, _ = judge.decide(now, sun, ready, empty, counts)
            if choice is not None:
                told = choice.assignment
                away[told.heliostat], free[told.target] = told, told.until
                known.assume(choice.row, choice.slope, told.until)
                yield told
            elif judge.more:
                yield None
            else:
                now = min([self._later(now), *(at for at in free.values() if at > now)])
                yield None

    def _later(self, now: float) -> float:
        """When to look again if there is nothing to do: after a while, or when the sun is up."""
        times = now + _STEP * np.arange(1, 145)
        up = solar.position(times, self.design.site).elevation >= self.settings.limits.min_elevation
        return float(times[np.argmax(up)]) if up.any() else float(times[-1])


def _unix(time: datetime) -> float:
    if time.tzinfo is None:
        raise TimeError(f"schedule: time {time} has no time zone; give UTC")
    return time.timestamp()
