"""Baseline of the schedule: the least known heliostat first, whatever a visit would bring.

It shares the schedule's knowledge, limits and times of visits, so that only the choice differs.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from datetime import datetime

import numpy as np

from benchmarks.days import Standing
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray
from heliotrope.plant.schedule import Assignment, Scheduler, Settings, Weather
from heliotrope.plant.schedule.choice import AGAIN, Sight

#: A heliostat seen on a target is not sent there again within this time, s.
PAUSE = 1200.0
#: State of a heliostat that may not be chosen.
_AWAY = 255


class LeastKnown:
    """Chooses the heliostat with the greatest expected beam error that a target can take.

    Parameters
    ----------
    plant
        The plant, with heliostats of one group.
    settings
        Settings of the schedule; `worth` does not count.
    now
        Beginning.
    pairs
        The former default of automatic control: a heliostat seen on other targets only comes first,
        then those never seen, the nearest first, then the rest by their expected error.

    Attributes
    ----------
    scheduler
        Gives expected errors, limits and times; learns as in the plant.
    """

    def __init__(
        self, plant: Plant, settings: Settings, now: datetime, *, pairs: bool = False
    ) -> None:
        self.scheduler = Scheduler(plant, replace(settings, worth=0.0), now=now)
        self._plant, self._settings, self._pairs = plant, settings, pairs
        (group,) = plant.groups.values()
        size = np.stack([group.width, group.height], axis=1)
        self._sights = {t.name: Sight(t, group.position, size, ()) for t in plant.targets}
        self._seen = {t.name: np.full(len(plant), -np.inf) for t in plant.targets}
        self._tried = {t.name: np.full(len(plant), -np.inf) for t in plant.targets}

    def next(
        self,
        now_utc: datetime,
        sun: FloatArray,
        states: Standing,
        free_targets: Sequence[str],
        holds: Collection[str] = (),
        weather: Weather | None = None,
    ) -> Assignment | None:
        """Return the next visit, None if there is none; arguments as of `Scheduler.next`."""
        if self._settings.closed(sun, weather or Weather()):
            return None
        now, state = now_utc.timestamp(), np.full(len(self._plant), _AWAY, dtype=np.uint8)
        for target in free_targets:
            for row in self._order(target, now_utc, sun):
                state[row] = states.state[row]
                only = Standing(state, states.counts)
                told = self.scheduler.next(now_utc, sun, only, (target,), holds, weather)
                state[row] = _AWAY
                if told is not None:
                    self._seen[target][row] = now
                    return told
                self._tried[target][row] = now
        return None

    def _order(self, target: str, now_utc: datetime, sun: FloatArray) -> list[int]:
        now, error = now_utc.timestamp(), self.scheduler.expected(now_utc)
        sight, here = self._sights[target], self._seen[target]
        able = sight.able(sun, self._settings.limits) & (error > self._settings.goal)
        able &= (now - here >= PAUSE) & (now - self._tried[target] >= AGAIN)
        rows = np.flatnonzero(able)
        if not self._pairs:
            return list(map(int, rows[np.argsort(-error[rows], kind="stable")]))
        never = np.all([np.isinf(seen) for seen in self._seen.values()], axis=0)[rows]
        rank = np.where(never, 1, np.where(np.isinf(here[rows]), 0, 2))
        worst = np.where(never, 0.0, -error[rows])
        far = np.linalg.norm(sight.target.center - self._plant.position[rows], axis=1)
        return list(map(int, rows[np.lexsort((far, worst, rank))]))
