"""The schedule of a running plant, which reads the controller and accepts the results of visits.

It takes time, sun vector and states from the controller, and implements `Scheduling` for automatic
control.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from itertools import islice

import numpy as np
import numpy.typing as npt

from heliotrope.lcu import states
from heliotrope.plant.controller import PlantController
from heliotrope.plant.emergency import DNI_READING
from heliotrope.plant.operations.views import CalibrationEntry
from heliotrope.plant.schedule.choice import Assignment
from heliotrope.plant.schedule.prospect import FieldProspect, ReceiverVisitTime
from heliotrope.plant.schedule.scheduler import Scheduler, Visited
from heliotrope.plant.schedule.settings import Settings, Weather
from heliotrope.plant.visits.settings import CycleSettings
from heliotrope.store.records import PlannedVisit

#: Age at which a plan is replaced, s, and length of the plan.
REPLAN, HORIZON = 120.0, timedelta(hours=16)
#: Steps added to a new plan at each request.
STEPS = 2
#: A planned visit this late is no longer displayed, s.
_LATE = 60.0


@dataclass(frozen=True)
class _Ready:
    """States of the field: IDLE for a heliostat that may be measured, otherwise unknown."""

    state: npt.NDArray[np.uint8]
    counts: npt.NDArray[np.int32]


def settings_for(cycle: CycleSettings, settings: Settings | None = None) -> Settings:
    """Return schedule settings whose visits match the visits of a calibration cycle."""
    return replace(
        settings or Settings(),
        model=cycle.first_model,
        shots=cycle.shots,
        interval=cycle.interval,
        sigma=cycle.sigma,
    )


class PlantSchedule:
    """Chooses heliostats by expected gain, in a running plant.

    Parameters
    ----------
    plant
        Source of time, sun vector and states; the schedule takes each calibration from its
        `beliefs`.
    scheduler
        Scheduler with the ``names`` of ``plant.field``.

    Attributes
    ----------
    attempts
        See `Scheduler`.
    """

    def __init__(self, plant: PlantController, scheduler: Scheduler) -> None:
        self._plant, self.scheduler = plant, scheduler
        self._plan: tuple[PlannedVisit, ...] = ()
        self._draft: list[PlannedVisit] = []
        self._coming: Iterator[Assignment | None] | None = None
        self._made = -np.inf
        #: Heliostats on their way to a target, by target.
        self._sent: dict[str, list[str]] = {}
        self.attempts = scheduler.attempts
        plant.beliefs.subscribe(scheduler.learn)
        plant.beliefs.subscribe_drift(scheduler.drift)

    def next(
        self, target: str, ready: npt.NDArray[np.bool_], beside: bool = False
    ) -> PlannedVisit | None:
        """Return the next of the ready heliostats (N,) for a free target; None if none is due.

        With ``beside``, the heliostat joins the heliostats of the earlier calls on the target.
        """
        for gone in list(self.scheduler.running.values()):
            # The target is free, so the previous visit there has ended without a result.
            if gone.target == target and not beside:
                self.scheduler.cancel(gone.heliostat)
        self.scheduler.weigh(self._plant.worth)
        assignment = self.scheduler.next(
            self._plant.clock.utc(),
            self._plant.sun_vector(),
            self._states(ready),
            (target,),
            weather=self.weather,
        )
        if not beside:
            self._sent[target] = []
        if assignment is None:
            return None
        self._sent[target].append(assignment.heliostat)
        return _planned(assignment)

    @property
    def weather(self) -> Weather:
        """Present weather, as far as sensors measure it."""
        seen = self._plant.sentinel.table.shown(self._plant.now())
        return Weather(seen.get(DNI_READING, np.nan), seen.get("wind_gust", np.nan))

    @property
    def reason(self) -> str:
        """Why the last visit was chosen, or why none was; "" before the first choice."""
        return self.scheduler.reason

    def plan(self, ready: npt.NDArray[np.bool_], limit: int) -> Sequence[PlannedVisit]:
        """Return the planned visits; each call extends a new plan while the old plan is shown."""
        now = self._plant.now()
        if self._coming is None and now - self._made >= REPLAN:
            self._draft = []
            self.scheduler.weigh(self._plant.worth)
            self._coming = self.scheduler.upcoming(
                self._plant.clock.utc(), HORIZON, self._states(ready)
            )
        if self._coming is not None:
            steps = list(islice(self._coming, STEPS))
            self._draft += [_planned(assignment) for assignment in steps if assignment is not None]
            if len(steps) < STEPS or len(self._draft) >= limit:
                self._plan, self._coming, self._made = tuple(self._draft), None, now
        shown = self._plan or tuple(self._draft)
        away, since = self.scheduler.running, self._plant.clock.utc().timestamp() - _LATE
        return [p for p in shown if p.heliostat not in away and p.at >= since][:limit]

    def foresee(self, able: npt.NDArray[np.bool_], targets: Sequence[str]) -> FieldProspect | None:
        """Return the present knowledge, for predicting the day; None if there are no targets."""
        return self.scheduler.prospect(self._plant.clock.utc(), able, targets)

    def done(self, entry: CalibrationEntry) -> None:
        """Accept the result of a visit."""
        good, missed, sent = entry.good, entry.measured, self._sent.get(entry.target, [])
        together = len(sent) > 1 and entry.heliostat in sent
        self.scheduler.done(
            Visited(
                entry.heliostat, entry.target, entry.at, good, missed, entry.text, together=together
            )
        )

    def shone(self, mirrors: int, lit: int, seconds: float) -> None:
        """Record the time of a receiver visit, in which some of the heliostats on it took part."""
        self.scheduler.receiver_visits.append(ReceiverVisitTime(mirrors, lit, seconds))

    def _states(self, ready: npt.NDArray[np.bool_]) -> _Ready:
        rows = self._plant.field.rows
        state = np.where(ready, states.IDLE, 255).astype(np.uint8)
        counts = np.stack([rows["primary"], rows["secondary"]], axis=1).astype(np.int32)
        return _Ready(state, counts)


def _planned(assignment: Assignment) -> PlannedVisit:
    # The pages show errors of the normal, which are half of the beam errors.
    return PlannedVisit(
        assignment.heliostat,
        assignment.target,
        assignment.at,
        0.5 * assignment.gain,
        assignment.reason,
    )
