"""Predictions of the field errors for the rest of the day, compared with the outcome.

A prediction takes seconds for a large field, so it is computed outside the event loop, from a copy
of the schedule's knowledge. The first prediction of a day is kept for comparison; the latest one
covers the remaining time.
"""

from collections import deque
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt

from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.keeping import Keeping
from heliotrope.plant.operations.solar_day import day_of
from heliotrope.plant.workers import Worker
from heliotrope.store.records import FieldPoint, Outlook

#: Time between points of the actual curve, s, and number of points that are kept.
POINT_EVERY, _POINTS = 60.0, 1500
#: Smallest fraction of the measurable heliostats that must be ready for a prediction. With fewer,
#: the field is still being raised.
_UP = 0.5
_DAY = 86_400.0


class Prospect(Protocol):
    """The knowledge of the field at one moment; its methods may be called in any process."""

    def now(self) -> FieldPoint:
        """Return the errors of the field."""
        ...

    def outlook(self) -> Outlook | None:
        """Return the prediction; None if nothing more can be measured on this day."""
        ...


class Foreseeing(Protocol):
    """The part of the schedule that a prediction needs."""

    def foresee(self, able: npt.NDArray[np.bool_], targets: Sequence[str]) -> Prospect | None:
        """Return the present knowledge; None if no prediction can be made from it.

        Parameters
        ----------
        able
            Heliostats that may be measured on this day, (N,).
        targets
            Targets that may be used.
        """
        ...


class Foresight:
    """Makes and stores predictions, and records the actual errors.

    Parameters
    ----------
    plant, keeping
        The controller, and the store of results.
    schedule
        Schedule from whose knowledge predictions are made.
    every
        Time between predictions, s; 0: no predictions are made.
    worker
        Runs the computation.

    Attributes
    ----------
    points
        Actual errors, oldest first.
    outlooks
        The first prediction of the day, and the latest if it is a different one.
    """

    def __init__(
        self,
        plant: PlantController,
        keeping: Keeping,
        schedule: Foreseeing,
        every: float,
        worker: Worker,
    ) -> None:
        self._plant, self._keeping, self._schedule = plant, keeping, schedule
        self._worker = worker
        self.every = every
        self.points: deque[FieldPoint] = deque(maxlen=_POINTS)
        self.outlooks: tuple[Outlook, ...] = ()
        self._targets = tuple(target.name for target in plant.design.targets)

    def recall(self) -> None:
        """Load the stored predictions of this day."""
        now = self._utc()
        kept = self._keeping.outlooks(now - _DAY)
        mine = [o for o in kept if self._day(o.made) == self._day(now) and o.made <= now]
        # The first point of each prediction holds the actual errors at that time.
        self.points.extend(outlook.points[0] for outlook in mine)
        self.outlooks = tuple(dict.fromkeys(mine[:1] + mine[-1:]))

    async def look(
        self, able: npt.NDArray[np.bool_], ready: npt.NDArray[np.bool_], *, running: bool
    ) -> None:
        """Record the present errors; make a prediction if one is due.

        Parameters
        ----------
        able, ready
            Heliostats that may be measured on this day, and heliostats that are ready now, (N,).
        running
            Whether calibration is running; otherwise no prediction is made.
        """
        prospect = self._schedule.foresee(able, self._targets)
        if prospect is None:
            return
        self.points.append(await self._worker(prospect.now))
        up = able.any() and ready.sum() >= _UP * able.sum()
        if not (running and up and self._due()):
            return
        made = await self._worker(prospect.outlook)
        if made is not None:
            today = [o for o in self.outlooks if self._day(o.made) == self._day(made.made)]
            self.outlooks = (*today[:1], made)
            self._keeping.record(made)

    def _due(self) -> bool:
        now = self._utc()
        if not self.outlooks or self._day(self.outlooks[-1].made) != self._day(now):
            return True
        return now - self.outlooks[-1].made >= self.every

    def _utc(self) -> float:
        return self._plant.clock.utc().timestamp()

    def _day(self, at: float) -> int:
        """Number of the day of local mean solar time."""
        return day_of(at, self._plant.design.site)
