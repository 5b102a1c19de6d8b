"""The calibration schedule: which heliostat is photographed next, on which target.

A decision has two steps. All heliostats are screened by angles and by an upper bound on the gain of
a visit: the whole of their expected squared beam error, divided by the duration of a visit. The
heliostats are then judged exactly in the order of this bound, a chunk at a time. This considers
stops, the travel of the drives, shading, blocking, and by how much the error would fall. The
decision is made when no bound exceeds the best value found. Heliostats that have waited too long
for a calibration come first.

This module reads no clock and moves no heliostat: time, sun vector and states are arguments.
"""

from collections import deque
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import groupby, islice
from typing import Protocol

import numpy as np
import numpy.typing as npt

from heliotrope import sun as solar
from heliotrope.calibration.learn.drift import DAY
from heliotrope.calibration.plan.receiver_terms import ReceiverTerms
from heliotrope.calibration.record import HeliostatCalibration
from heliotrope.errors import InputError, TimeError, UnknownNameError
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray, as_vectors
from heliotrope.lcu import states as lcu_states
from heliotrope.plant.attempts import Attempts, RetryLaw
from heliotrope.plant.schedule.choice import Assignment, Judge, Mask
from heliotrope.plant.schedule.knowledge import FieldKnowledge
from heliotrope.plant.schedule.prospect import (
    FieldProspect,
    JointVisitTime,
    ReceiverVisitTime,
    terms_of,
)
from heliotrope.plant.schedule.settings import Settings, Weather
from heliotrope.safety import alarms

#: If a beam error is this many times the expected error, the heliostat is assumed to have changed.
SURPRISE = 3.0
#: Number of visits from which their actual pace is used in a prediction.
ENOUGH = 10
#: Failed visits to targets, by heliostat; the wait is that of the settings. The rest lasts until
#: the next day.
VISITS = RetryLaw(
    "visit to a target",
    5,
    900.0,
    "someone must inspect the mirror; until then it gets one visit a day",
    longest=DAY,
    rest=16.0 * 3600.0,
    alarm=alarms.CALIBRATION_GIVEN_UP,
)
#: Number of receiver visits to remember, enough for some days.
_RECEIVER_VISITS = 100
#: Number of finished visits to remember.
REMEMBERED = 20_000
#: Step of a plan while there is nothing to do, s.
_STEP = 600.0


@dataclass(frozen=True)
class Visited:
    """The result of an assignment.

    Attributes
    ----------
    heliostat, target
        Names.
    ended
        POSIX s.
    calibrated
        Whether the heliostat has a new calibration.
    measured
        Beam error in the photographs of this visit under the previous calibration, rad RMS (2-D);
        NaN if none could be used.
    text
        The result in words, for display.
    together
        Whether it was on the target together with other heliostats.
    """

    heliostat: str
    target: str
    ended: float
    calibrated: bool
    measured: float = float("nan")
    text: str = ""
    together: bool = False


@dataclass(frozen=True)
class Finished:
    """An assignment and its result."""

    planned: Assignment
    visited: Visited

    @property
    def surprise(self) -> bool:
        """Whether the beam was much further off than expected."""
        return bool(self.visited.measured > SURPRISE * self.planned.predicted)


@dataclass(frozen=True)
class Comparison:
    """Finished visits compared with their prediction.

    Attributes
    ----------
    visits, calibrated
        Number of visits, and number of visits that produced a new calibration.
    measured, predicted
        Beam error measured in the photographs, and the beam error expected there, rad RMS (2-D),
        over visits with both values; NaN if there are no such visits.
    longer
        Mean duration of a single visit, as a fraction of the expected duration; NaN without visits.
    surprises
        Heliostats whose error was more than `SURPRISE` times the expected error.
    alone
        Number of single visits, and number of single visits that produced a new calibration.
    joint_visits
        Joint visits.
    """

    visits: int
    calibrated: int
    measured: float
    predicted: float
    longer: float
    surprises: tuple[str, ...]
    alone: tuple[int, int]
    joint_visits: tuple[JointVisitTime, ...] = ()

    @property
    def ratio(self) -> float:
        """Measured error divided by predicted error; near 1 if the prediction is correct."""
        return self.measured / self.predicted

    @property
    def pace(self) -> float:
        """Mean time per single calibration, as a fraction of the expected visit duration.

        The value is NaN until there are `ENOUGH` visits.
        """
        visits, calibrated = self.alone
        return self.longer * visits / max(calibrated, 1) if visits >= ENOUGH else float("nan")

    @property
    def text(self) -> str:
        """The comparison in one line."""
        if not self.visits:
            return "no visits"
        head = f"{self.visits} visits, {self.calibrated} calibrated"
        if not np.isfinite(self.ratio):
            return f"{head}; no error could be compared"
        return (
            f"{head}; beam error found {1e3 * self.measured:.2f} mrad, expected "
            f"{1e3 * self.predicted:.2f} mrad, ratio {self.ratio:.2f}; "
            f"{len(self.surprises)} surprises"
        )


def compare(finished: Iterable[Finished]) -> Comparison:
    """Compare finished visits with their expected results."""
    made = list(finished)
    both = [f for f in made if np.isfinite(f.visited.measured)]
    nan = float("nan")

    def rms(values: list[float]) -> float:
        return float(np.sqrt(np.mean(np.square(values)))) if values else nan

    alone = [f for f in made if not f.visited.together]
    spans = [
        (f.visited.ended - f.planned.at) / (f.planned.until - f.planned.at)
        for f in alone
        if f.planned.until > f.planned.at
    ]
    return Comparison(
        visits=len(made),
        calibrated=sum(f.visited.calibrated for f in made),
        measured=rms([f.visited.measured for f in both]),
        predicted=rms([f.planned.predicted for f in both]),
        longer=float(np.mean(spans)) if spans else nan,
        surprises=tuple(f.planned.heliostat for f in both if f.surprise),
        alone=(len(alone), sum(f.visited.calibrated for f in alone)),
        joint_visits=tuple(_joint_visits(f for f in made if f.visited.together)),
    )


def _joint_visits(made: Iterable[Finished]) -> Iterator[JointVisitTime]:
    """Yield the joint visits: groups of visits to one target that end at the same time."""
    for _, group in groupby(made, key=lambda f: (f.visited.target, round(f.visited.ended))):
        visits = list(group)
        begin = min(f.planned.at for f in visits)
        worst = max(f.planned.predicted for f in visits)
        yield JointVisitTime(len(visits), worst, visits[0].visited.ended - begin)


class States(Protocol):
    """The present state of the field, in the order of the scheduler's names."""

    @property
    def state(self) -> npt.NDArray[np.uint8]:
        """States from `lcu.states`, (N,); any other number if a state is unknown."""
        ...

    @property
    def counts(self) -> npt.NDArray[np.int32]:
        """Step counts of the drives, (N, 2)."""
        ...


class Scheduler:
    """The schedule: chooses the next heliostat to photograph, and the target.

    Parameters
    ----------
    design
        The plant, with all its targets.
    settings
        See `Settings`.
    now
        Start time: the age of uncalibrated heliostats counts from here, and its year determines the
        sun positions.
    names
        Order of the heliostats in `States`; by default the order in the design.

    Attributes
    ----------
    names
        The heliostats.
    reason
        Why the last visit was chosen, or why none was.
    running
        Assignments in progress, by heliostat.
    finished
        The latest visits, each with its assignment.
    receiver_visits
        The latest receiver visits, which are not chosen here.
    attempts
        Failed visits, by heliostat; times in POSIX s.

    Raises
    ------
    InputError
        If there is no target, the names differ from the names in the design, or a time has no time
        zone.
    UnknownNameError
        If the mechanisms do not have the parameters of the model.
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
                "can be calibrated with a camera, so add at least one of each"
            )
        self.reason = ""
        self.running: dict[str, Assignment] = {}
        self.finished: deque[Finished] = deque(maxlen=REMEMBERED)
        self.receiver_visits: deque[ReceiverVisitTime] = deque(maxlen=_RECEIVER_VISITS)
        begin, year = _unix(now), now.astimezone(UTC).year
        self._known = FieldKnowledge(design, self.settings, self.names, begin, year)
        self._judge = Judge(design, self.settings, self._known, self.names)
        # The expected information from assignments in progress, by heliostat.
        self._slopes: dict[str, FloatArray] = {}
        self._learnt = np.zeros(len(self.names), dtype=np.int64)
        self.attempts = Attempts(replace(VISITS, wait=self.settings.retry))

    # -- knowledge -------------------------------------------------------------------------

    def expected(self, now_utc: datetime) -> FloatArray:
        """Return the expected beam error over the year, rad RMS (2-D), (N,)."""
        return np.asarray(np.sqrt(self._known.squares(_unix(now_utc))))

    def age(self, now_utc: datetime) -> FloatArray:
        """Return the time since the last calibration, or since the start, s, (N,)."""
        return self._known.ages(_unix(now_utc))

    def learn(self, record: HeliostatCalibration) -> None:
        """Accept a new calibration.

        Raises
        ------
        UnknownNameError
            If there is no such heliostat.
        """
        row = self._find(record.heliostat)
        self._known.learn(row, record)
        self._learnt[row] += 1
        self.attempts.done(record.heliostat)

    def drift(self, record: HeliostatCalibration) -> None:
        """Set a heliostat's drift from the record of its last calibration.

        Raises
        ------
        UnknownNameError
            If there is no such heliostat.
        """
        self._known.grow_as(self._find(record.heliostat), record.growth)

    def observe(self, heliostat: str, error: float, now_utc: datetime) -> bool:
        """Accept a beam error observed in operation, rad; return whether it is a surprise.

        An error above `SURPRISE` times the expected error means that the heliostat has changed; its
        expected error is then set to the observed one.

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

    def weigh(self, worth: FloatArray) -> None:
        """Set how much a smaller squared error of each heliostat counts beside the others, (N,)."""
        self._known.worth = worth

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
        """Return the next assignment, noted as in progress; None if none is due (see `reason`).

        Call `done` or `cancel` when the visit has ended; if it produced a new calibration, call
        `learn` first.

        Parameters
        ----------
        now_utc, sun
            Time, and sun vector, ENU, (3,).
        states
            States of the field.
        free_targets
            Targets without a beam, each with a camera that is ready.
        holds
            Heliostats to leave out.
        weather
            Weather, as far as it is measured.

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
        assignment = choice.assignment
        self.running[assignment.heliostat], self._slopes[assignment.heliostat] = (
            assignment,
            choice.slope,
        )
        return assignment

    def _ready(self, now: float, states: States | None, away: Collection[str]) -> Mask:
        ready = np.ones(len(self.names), dtype=np.bool_)
        if states is not None:
            if np.shape(states.state) != ready.shape:
                raise InputError(
                    f"schedule: states have the shape {np.shape(states.state)}; pass one for each "
                    f"of {len(ready)} heliostats"
                )
            ready &= np.isin(states.state, lcu_states.AVAILABLE)
        return self._without(ready, (*away, *self.attempts.waiting(now)))

    def _without(self, ready: Mask, names: Collection[str]) -> Mask:
        left = np.array(ready)
        left[[self._known.row[name] for name in names if name in self._known.row]] = False
        return left

    # -- results ---------------------------------------------------------------------------

    def done(self, visited: Visited) -> Finished | None:
        """Accept the result of a visit; return it with its assignment.

        Returns None if the visit was not planned.

        Raises
        ------
        UnknownNameError
            If there is no such heliostat.
        """
        row = self._find(visited.heliostat)
        planned = self.running.pop(visited.heliostat, None)
        self._slopes.pop(visited.heliostat, None)
        finished = None if planned is None else Finished(planned, visited)
        if visited.calibrated:
            self.attempts.done(visited.heliostat)
            if finished is not None and finished.surprise and self._learnt[row] > 1:
                # Sightings from before the change are worth less than the covariance assumes.
                self._known.doubt(row, (visited.measured / finished.planned.predicted) ** 2)
        else:
            self.attempts.failed(visited.heliostat, visited.text, visited.ended)
        if finished is not None:
            self.finished.append(finished)
        return finished

    def cancel(self, heliostat: str) -> None:
        """Discard an assignment that did not begin, or failed through no fault of the heliostat."""
        self.running.pop(heliostat, None)
        self._slopes.pop(heliostat, None)

    def compared(self, since: datetime | None = None) -> Comparison:
        """Compare the visits finished since a time with their prediction."""
        begin = -np.inf if since is None else _unix(since)
        return compare(f for f in self.finished if f.visited.ended >= begin)

    # -- plan ------------------------------------------------------------------------------

    def prospect(
        self, now_utc: datetime, able: Mask, targets: Sequence[str]
    ) -> FieldProspect | None:
        """Return the present knowledge, for predicting the day; None if there are no targets.

        Parameters
        ----------
        now_utc
            Time.
        able
            Heliostats that may be measured on this day, (N,).
        targets
            Targets that may be used.
        """
        used = tuple(target for target in self.design.targets if target.name in targets)
        if not used:
            return None
        now = _unix(now_utc)
        fleets, rows = self._known.fleets(now)
        made = self.compared()
        return FieldProspect(
            now,
            self.design.site,
            used,
            fleets,
            self._known.size[rows].max(axis=1),
            self._learnt[rows] > 0,
            ~np.asarray(able, dtype=np.bool_)[rows],
            terms_of(
                self.settings,
                self.design.joint_visits,
                made.pace,
                made.joint_visits,
                ReceiverTerms.of(self.design, self.settings.sigma),
                tuple(self.receiver_visits),
            ),
        )

    def plan(
        self,
        now_utc: datetime,
        horizon: timedelta,
        states: States | None = None,
        holds: Collection[str] = (),
        most: int = 20,
    ) -> list[Assignment]:
        """Return the next visits, assuming a clear sky and the expected result of each visit.

        Parameters
        ----------
        now_utc, horizon
            Start and length of the plan.
        states, holds
            As for `next`; None: all heliostats are ready.
        most
            Maximum number of visits in the plan; each takes as long as a decision.
        """
        coming = self.upcoming(now_utc, horizon, states, holds)
        return list(islice((assignment for assignment in coming if assignment is not None), most))

    def upcoming(
        self,
        now_utc: datetime,
        horizon: timedelta,
        states: States | None = None,
        holds: Collection[str] = (),
    ) -> Iterator[Assignment | None]:
        """Yield the visits of `plan`, with None in between; a step makes at most one decision."""
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
            away = {name: assignment for name, assignment in away.items() if assignment.until > now}
            empty = [name for name, at in free.items() if at <= now]
            sun = solar.vector(datetime.fromtimestamp(now, UTC), self.design.site)
            ready = self._ready(now, states, (*holds, *away))
            choice, _ = judge.decide(now, sun, ready, empty, counts)
            if choice is not None:
                assignment = choice.assignment
                away[assignment.heliostat], free[assignment.target] = assignment, assignment.until
                known.assume(choice.row, choice.slope, assignment.until)
                yield assignment
            elif judge.more:
                yield None
            else:
                now = min([self._later(now), *(at for at in free.values() if at > now)])
                yield None

    def _later(self, now: float) -> float:
        """Return when to decide again: after a pause, or when the sun is up."""
        times = now + _STEP * np.arange(1, 145)
        up = solar.position(times, self.design.site).elevation >= self.settings.limits.min_elevation
        return float(times[np.argmax(up)]) if up.any() else float(times[-1])


def _unix(time: datetime) -> float:
    if time.tzinfo is None:
        raise TimeError(f"schedule: time {time} has no time zone; pass UTC")
    return time.timestamp()
