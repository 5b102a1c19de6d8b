"""Mirrors whose zeros drift and step: constants at each visit, or the drift followed.

Each mirror is visited once a day, in both runs alike; the truth drifts by the law that is the
default of the learner (1 mrad within 300 days, a step of 1 mrad in three years). The errors are
those of the normal against the twin's truth, on the receiver over the day after the visits.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np

from benchmarks._run import Result, Row
from benchmarks.days import Days, Truth
from heliotrope.calibration.fit.estimator import FieldFit
from heliotrope.calibration.learn import drift
from heliotrope.calibration.learn.present import fitting_present
from heliotrope.calibration.sightings import Sightings
from heliotrope.field.layouts import malan_plant
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.chain import Mechanism
from heliotrope.plant.schedule.scheduler import Assignment, Scheduler, Settings, Visited

BEGIN = datetime(2026, 5, 21, 3, 0, tzinfo=UTC)
DAY = 86400.0
#: Hours after `BEGIN` at which the truth is looked at.
HOURS = np.array([4.0, 6.0, 8.0, 10.0, 12.0])


@dataclass
class DriftingDays(Days):
    """Days on which the mirrors' zeros drift and step.

    Attributes
    ----------
    follows
        Whether a visit follows the drift, or fits constants.
    """

    follows: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        self._still, self._fate = self.truth, np.random.default_rng([self.seed, 1])
        size = (len(self.plant), len(drift.zeros(self._still)))
        self._wander = self._fate.normal(0.0, drift.START_RAD["slow"], size)
        self._stepped = np.zeros(size)
        self._until = self.now.timestamp()

    def _move(self, until: float) -> None:
        """Let the zeros drift to a time."""
        days, self._until = (until - self._until) / DAY, until
        keep, amplitude = np.exp(-days / drift.START_DAYS["slow"]), drift.START_RAD["slow"]
        new = self._fate.normal(0.0, amplitude * np.sqrt(1.0 - keep**2), self._wander.shape)
        self._wander = keep * self._wander + new
        steps = self._fate.normal(0.0, drift.STEP_RAD, self._wander.shape)
        hit = self._fate.random(len(self._wander)) < days * drift.step_rate(())
        self._stepped += np.where(hit[:, None], steps, 0.0)
        off = self._wander + self._stepped
        zeros = drift.zeros(self._still)
        self.truth = self._still.with_parameters({n: off[:, i] for i, n in enumerate(zeros)})

    def _visit(self, told: Assignment) -> Visited:
        self._move(max(told.until, self._until))
        return super()._visit(told)

    def learnt(self, nominal: Mechanism, seen: Sightings) -> FieldFit:
        """Return what a visit learns of one heliostat (1,)."""
        constants = super().learnt(nominal, seen)
        if not self.follows:
            return constants
        steps = fitting_present(nominal, seen, constants)
        while True:
            try:
                next(steps)
            except StopIteration as end:
                found: FieldFit = end.value
                return found

    def evenings(self, days: int) -> Iterator[Truth]:
        """Yield the truth before each next day: what was learnt holds until it is over."""
        for _ in range(days):
            self.live(timedelta(days=1), timedelta(minutes=15))
            self._move(self.now.timestamp())
            yield self.look(self.now.timestamp() + 3600.0 * HOURS)


def _row(follows: bool, world: DriftingDays, days: int) -> Row:
    found = list(world.evenings(days))
    errors: FloatArray = np.concatenate([one.error for one in found[days // 3 :]])
    within = float(np.mean([one.within for one in found[days // 3 :]]))
    return {
        "learns": "drift followed" if follows else "constants",
        "heliostats": len(world.plant),
        "days": days,
        "visits": len(world.made),
        "median_mrad": 1e3 * float(np.nanmedian(errors)),
        "p90_mrad": 1e3 * float(np.nanquantile(errors, 0.9)),
        "last_median_mrad": 1e3 * float(np.nanmedian(found[-1].error)),
        "last_p90_mrad": 1e3 * float(np.nanquantile(found[-1].error, 0.9)),
        "within_90": within,
    }


def run(quick: bool) -> Result:
    """Compare both in the same days."""
    plant, days = malan_plant(3 if quick else 10), 3 if quick else 30
    # Whoever is due comes first, whatever is known: both runs make the same visits.
    settings = Settings(goal=1.0, most_age=9.0 * 3600.0)
    rows = []
    for follows in (False, True):
        schedule = Scheduler(plant, settings, now=BEGIN)
        rows.append(_row(follows, DriftingDays(plant, schedule, BEGIN, follows=follows), days))
    before, after = rows
    headline = (
        f"normals of mirrors that drift: median {before['median_mrad']:.2f} mrad with constants, "
        f"{after['median_mrad']:.2f} mrad with the drift followed"
    )
    return Result(rows, headline)
