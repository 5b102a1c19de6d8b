"""The schedule of a running plant: time, sun and states from the controller, results back.

It has the shape that the automatic work asks for (`_operations_work.Scheduling`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import islice

import numpy as np
import numpy.typing as npt

from heliotrope.lcu import states
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.book import CalibrationBook
from heliotrope.plant.operations.views import CalibrationEntry, Planned
from heliotrope.plant.schedule.schedule import Assignment, Scheduler, Settings, Visited, Weather
from heliotrope.plant.visits.calibration_cycle import CalibrationCycle, CycleSettings

#: A plan is made anew when it is so old, s; it looks so far ahead.
REPLAN, HORIZON = 120.0, timedelta(hours=16)
#: Steps of a plan that is being made, at each time it is asked for.
STEPS = 2
#: What should have begun so long ago is not shown as coming any more, s.
_LATE = 60.0


@dataclass(frozen=True)
class _Ready:
    """States of those that may be measured."""

    state: npt.NDArray[np.uint8]
    counts: npt.NDArray[np.int32]


def settings_for(cycle: CycleSettings, settings: Settings | None = None) -> Settings:
    """Return settings of a schedule whose visits are those of a calibration cycle."""
    from dataclasses import replace

    return replace(
        settings or Settings(),
        model=cycle.model,
        shots=cycle.shots,
        interval=cycle.interval,
        sigma=cycle.sigma,
    )


class PlantSchedule:
    """Chooses by expected gain.

    Parameters
    ----------
    plant
        Whose clock, sun and rows count.
    cycle
        That makes the visits; the sightings it knows are taken over at the first decision.
    scheduler
        With ``names`` of ``plant.field``.

    Attributes
    ----------
    weather
        As far as it is measured; set it when it changes.
    """

    def __init__(
        self, plant: PlantController, cycle: CalibrationCycle, scheduler: Scheduler
    ) -> None:
        self._plant, self._cycle, self.scheduler = plant, cycle, scheduler
        self.weather = Weather()
        self._book: CalibrationBook | None = None
        self._recalled = False
        self._plan: tuple[Planned, ...] = ()
        self._draft: list[Planned] = []
        self._coming: Iterator[Assignment | None] | None = None
        self._made = -np.inf

    def next(
        self, target: str, ready: npt.NDArray[np.bool_], book: CalibrationBook
    ) -> Planned | None:
        """Return the next of the ready heliostats (N,) for a free target, None if none is due."""
        self._book = book
        if not self._recalled:
            self._recall()
        for gone in list(self.scheduler.running.values()):
            # The target is free: what was on its way there has ended without a result.
            if gone.target == target:
                self.scheduler.cancel(gone.heliostat)
        told = self.scheduler.next(
            self._plant.clock.utc(),
            self._plant.sun_vector(),
            self._states(ready),
            (target,),
            weather=self.weather,
        )
        return None if told is None else _planned(told)

    def plan(
        self, ready: npt.NDArray[np.bool_], book: CalibrationBook, limit: int
    ) -> Sequence[Planned]:
        """Return what is to come; a new plan is made a little at each call, the old one shown."""
        del book
        now = self._plant.now()
        if self._coming is None and now - self._made >= REPLAN:
            self._draft = []
            self._coming = self.scheduler.upcoming(
                self._plant.clock.utc(), HORIZON, self._states(ready)
            )
        if self._coming is not None:
            steps = list(islice(self._coming, STEPS))
            self._draft += [_planned(told) for told in steps if told is not None]
            if len(steps) < STEPS or len(self._draft) >= limit:
                self._plan, self._coming, self._made = tuple(self._draft), None, now
        shown = self._plan or tuple(self._draft)
        away, since = self.scheduler.running, self._plant.clock.utc().timestamp() - _LATE
        return [p for p in shown if p.heliostat not in away and p.at >= since][:limit]

    def done(self, entry: CalibrationEntry) -> None:
        """Take what became of a measurement."""
        row = self._plant.field.place(entry.heliostat)
        measured = float("nan")
        if entry.good and self._book is not None:
            # The beam is off by twice what the normal is.
            measured = 2.0 * float(self._book.measured[row])
        self.scheduler.done(
            Visited(
                entry.heliostat,
                entry.target,
                entry.at,
                entry.good,
                self._cycle.known.get(entry.heliostat),
                measured,
                entry.text,
            )
        )

    def _recall(self) -> None:
        """Take over what was known before the start."""
        self._recalled = True
        for name in self._cycle.values:
            seen = self._cycle.known.get(name)
            if seen is not None and len(seen):
                at = datetime.fromtimestamp(float(seen.time.max()), UTC)
                self.scheduler.learn(name, seen, at)

    def _states(self, ready: npt.NDArray[np.bool_]) -> _Ready:
        rows = self._plant.field.rows
        state = np.where(ready, states.IDLE, 255).astype(np.uint8)
        counts = np.stack([rows["primary"], rows["secondary"]], axis=1).astype(np.int32)
        return _Ready(state, counts)


def _planned(told: Assignment) -> Planned:
    # People are shown errors of the normal.
    return Planned(told.heliostat, told.target, told.at, 0.5 * told.gain, told.reason)
