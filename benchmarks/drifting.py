"""Mirrors whose zeros drift and step: constants at each visit, or the drift followed.

The third run also learns the hyperparameters of the group every third night, as a plant does every
night: how far the mirrors differ from their plant file, how they drift, and the noise.
Each mirror is visited once a day, in all runs alike; the truth drifts by the law that is the
default of the learner (1 mrad within 300 days, a step of 1 mrad in three years). The errors are
those of the normal against the twin's truth, on the receiver over the day after the visits.
"""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np

from benchmarks._run import Result, Row
from benchmarks.days import Days, Truth
from heliotrope.calibration.fit.estimator import FieldFit
from heliotrope.calibration.growth import Growth
from heliotrope.calibration.learn import drift, group
from heliotrope.calibration.learn.drift import Hyperparameters
from heliotrope.calibration.learn.present import fitting_present
from heliotrope.calibration.sightings import Sightings
from heliotrope.errors import InputError
from heliotrope.field.layouts import malan_plant
from heliotrope.geometry import FloatArray
from heliotrope.mechanism import parameters
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
    nights
        Nights from one learning of the hyperparameters to the next; 0: they are the defaults.
    hyper
        In force; None: the defaults.
    """

    follows: bool = False
    nights: int = 0
    hyper: Hyperparameters | None = None

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
        visited = super()._visit(told)
        if self.hyper is not None:
            growth = Growth.of(self.hyper, "learnt")
            self.records[told.heliostat] = self.records[told.heliostat].growing(growth)
        return visited

    def _learn(self) -> None:
        """Learn the group from all photographs, if there are enough."""
        mechanism, names = self.group.mechanism, self.group.names
        model = parameters.model(str(self.scheduler.settings.model), mechanism.parameters)
        before = self.hyper or group.defaults(mechanism, model)
        seen = tuple(self.known.get(name) for name in names)
        with contextlib.suppress(InputError):
            found = group.learn_group(
                group.gathered(group.GroupHistory(mechanism, seen, model, before))
            )
            if found.gain > 0.0:
                self.hyper = found.hyper

    def learnt(self, nominal: Mechanism, seen: Sightings) -> FieldFit:
        """Return what a visit learns of one heliostat (1,)."""
        constants = super().learnt(nominal, seen)
        if not self.follows:
            return constants
        return fitting_present(nominal, seen, constants, self.hyper)

    def evenings(self, days: int) -> Iterator[Truth]:
        """Yield the truth before each next day: what was learnt holds until it is over."""
        for day in range(days):
            if self.nights and day % self.nights == self.nights - 1:
                self._learn()
            self.live(timedelta(days=1), timedelta(minutes=15))
            self._move(self.now.timestamp())
            yield self.look(self.now.timestamp() + 3600.0 * HOURS)


def _row(learns: str, world: DriftingDays, days: int) -> Row:
    found = list(world.evenings(days))
    errors: FloatArray = np.concatenate([one.error for one in found[days // 3 :]])
    within = float(np.mean([one.within for one in found[days // 3 :]]))
    return {
        "learns": learns,
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
    """Compare them in the same days."""
    plant, days = malan_plant(4 if quick else 10), 4 if quick else 30
    # Whoever is due comes first, whatever is known: both runs make the same visits.
    settings = Settings(goal=1.0, most_age=9.0 * 3600.0)
    rows = []
    for learns, follows, nights in (
        ("constants", False, 0),
        ("drift followed", True, 0),
        ("drift followed, learnt at night", True, 3),
    ):
        schedule = Scheduler(plant, settings, now=BEGIN)
        world = DriftingDays(plant, schedule, BEGIN, follows=follows, nights=nights)
        rows.append(_row(learns, world, days))
    before, after, learnt = rows
    headline = (
        f"normals of mirrors that drift: median {before['median_mrad']:.2f} mrad with constants, "
        f"{after['median_mrad']:.2f} mrad with the drift followed, "
        f"{learnt['median_mrad']:.2f} mrad and {100 * learnt['within_90']:.0f} % within the 90 % "
        "ellipse with what is learnt at night"
    )
    return Result(rows, headline)
