"""Days of calibration without controllers: the real schedule and the real fit on simulated mirrors.

A visit begins when the schedule chooses it and takes the time that the schedule expects. Sightings
come from the true mechanisms, with noise. A day of 10,000 heliostats takes minutes; the plant with
all its controllers (`twin.live`) takes the day.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Protocol

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.evaluation import beam_errors
from heliotrope.calibration.fit.estimator import FieldFit, fit
from heliotrope.calibration.plan.planning import SightingLimits, aim_at
from heliotrope.calibration.record import HeliostatCalibration
from heliotrope.calibration.sightings import Sightings, camera_target, join, sightings
from heliotrope.calibration.uncertainty import expected_error
from heliotrope.field.example import roughly_installed
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray, reflect
from heliotrope.lcu import states
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.tracking import track
from heliotrope.optics.beam import CHI_SQUARE_90
from heliotrope.plant.schedule import Assignment, Scheduler, Visited, Weather
from heliotrope.sun import vector

#: Time between the photographs at the end of a visit, s.
_APART = 20.0


class Chooser(Protocol):
    """Chooses the next visit; `Scheduler.next` is one."""

    def __call__(
        self,
        now_utc: datetime,
        sun: FloatArray,
        states: "Standing",
        free_targets: Sequence[str],
        holds: Collection[str],
        weather: Weather | None,
    ) -> Assignment | None:
        """Return the next visit, None if there is none."""
        ...


@dataclass
class Standing:
    """States of heliostats at their standby points, as `Scheduler.next` takes them."""

    state: npt.NDArray[np.uint8]
    counts: npt.NDArray[np.int32]

    @classmethod
    def ready(cls, count: int) -> "Standing":
        """Return the states of heliostats that can all be sent to a target."""
        stand = np.full((count, 2), [0, 50_000], dtype=np.int32)
        return cls(np.full(count, states.IDLE, dtype=np.uint8), stand)


@dataclass(frozen=True)
class Truth:
    """True pointing errors of N heliostats; NaN where they cannot point.

    Attributes
    ----------
    names
        The heliostats.
    error
        True error of the mirror's normal, RMS over the suns, rad, (N,).
    predicted
        Error that the calibration predicts, rad, (N,).
    within
        Share of all pairs of heliostat and sun whose beam lies in the predicted 90 % ellipse.
    """

    names: tuple[str, ...]
    error: FloatArray
    predicted: FloatArray
    within: float


@dataclass
class Days:
    """A simulated plant whose mirrors stand as a quick installation leaves them.

    Attributes
    ----------
    plant
        The plant as it knows itself; all heliostats belong to one group.
    scheduler, choose
        The schedule, and a rule that chooses in its place; None: the schedule's own.
    now
        Present time; `live` moves it.
    noise
        Standard deviation of a photograph's beam in each direction, rad.
    seed
        Seed of the true mirrors and of the noise.
    weather, holds
        Weather, and heliostats to leave alone, as given to the schedule.
    blind
        Heliostats whose beams no photograph shows.
    truth
        The true mechanisms.
    known, values, records
        Sightings, calibrated mechanism (1,) and calibration, by heliostat.
    made
        Assignments in the order of their beginnings.
    reasons
        Why the schedule had nothing to do.
    """

    plant: Plant
    scheduler: Scheduler
    now: datetime
    choose: Chooser | None = None
    noise: float = 5e-4
    seed: int = 0
    weather: Weather = field(default_factory=Weather)
    holds: tuple[str, ...] = ()
    blind: frozenset[str] = frozenset()
    known: dict[str, Sightings] = field(default_factory=dict)
    values: dict[str, Mechanism] = field(default_factory=dict)
    records: dict[str, HeliostatCalibration] = field(default_factory=dict)
    made: list[Assignment] = field(default_factory=list)
    reasons: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        (self.group,) = self.plant.groups.values()
        self.truth = roughly_installed(self.group.mechanism, self.seed)
        self.field = Standing.ready(len(self.plant))
        self.chance = np.random.default_rng(self.seed)
        self._ends: list[tuple[datetime, Assignment]] = []

    def live(
        self,
        span: timedelta,
        look: timedelta = timedelta(seconds=60),
        progress: Callable[[datetime], None] | None = None,
    ) -> None:
        """Let time pass.

        Parameters
        ----------
        span
            Time that passes.
        look
            Time until the schedule is asked again when it had nothing to do.
        progress
            Called with the time before each decision.
        """
        until = self.now + span
        while self.now < until:
            for end, told in [e for e in self._ends if e[0] <= self.now]:
                self._ends.remove((end, told))
                self.scheduler.done(self._visit(told))
            if progress is not None:
                progress(self.now)
            told_next = self._next()
            if told_next is not None:
                self.made.append(told_next)
                self._ends.append((datetime.fromtimestamp(told_next.until, UTC), told_next))
                continue
            self.reasons.add(self.scheduler.reason.split(":")[0])
            self.now = min([self.now + look, *(end for end, _ in self._ends)])

    def _next(self) -> Assignment | None:
        busy = {told.target for _, told in self._ends}
        free = [t.name for t in self.plant.targets if t.name not in busy]
        if not free:
            return None
        choose: Chooser = self.choose or self.scheduler.next
        return choose(
            self.now,
            vector(self.now, self.plant.site),
            self.field,
            free,
            self.holds,
            self.weather,
        )

    def mechanism(self, name: str) -> Mechanism:
        """Return the mechanism of a heliostat by its last calibration, (1,)."""
        row = np.array([self.group.index(name)])
        return self.values.get(name, self.group.mechanism[row])

    def photographs(self, name: str, target: str, times: FloatArray) -> Sightings:
        """Return sightings of a heliostat that tracks a target by its last calibration.

        Parameters
        ----------
        name, target
            Names of the heliostat and the target.
        times
            POSIX s, (M,).
        """
        row, believed = self.group.index(name), self.mechanism(name)
        surface = self.plant.target(target)
        suns = vector(times, self.plant.site)
        many = believed[np.zeros(len(times), dtype=np.intp)]
        counts = aim_at(many, suns, surface, SightingLimits()).counts
        pose = self.truth[np.full(len(times), row)].pose(counts)
        # The plane extends beyond the target: a search would have found the beam.
        seen = surface.intersect(pose.vertex, reflect(suns, pose.normal))
        away = np.linalg.norm(seen - pose.vertex, axis=1)[:, None]
        shift = self.noise * away * self.chance.standard_normal((len(times), 2))
        return camera_target(
            np.zeros(len(times), dtype=np.intp),
            counts,
            suns,
            seen + shift @ surface.axes,
            time=times,
            sigma=self.noise,
        )

    def _visit(self, told: Assignment) -> Visited:
        name, settings = told.heliostat, self.scheduler.settings
        if name in self.blind:
            return Visited(name, told.target, told.until, False, text="no beam")
        times = told.until - _APART * np.arange(settings.shots, 0.0, -1.0)
        seen = self.photographs(name, told.target, times)
        measured = float(np.sqrt(np.mean(beam_errors(self.mechanism(name), seen).beam ** 2)))
        before = [self.known[name]] if name in self.known else []
        self.known[name] = join([*before, seen])
        row = np.array([self.group.index(name)])
        nominal = self.group.mechanism[row]
        record = HeliostatCalibration.from_fit(
            name,
            told.until,
            self.learnt(nominal, self.known[name]),
            nominal,
            self.known[name],
            np.zeros(len(self.known[name]), np.int64),
            model=settings.model if isinstance(settings.model, str) else "",
        )
        self.records[name], self.values[name] = record, record.mechanism(nominal)
        self.scheduler.learn(record)
        return Visited(name, told.target, told.until, True, measured)

    def learnt(self, nominal: Mechanism, seen: Sightings) -> FieldFit:
        """Return what a visit learns of one heliostat (1,) from all of its sightings: constants."""
        return fit(nominal, seen, self.scheduler.settings.model)

    def look(self, times: FloatArray, names: tuple[str, ...] | None = None) -> Truth:
        """Return the true errors of heliostats that aim at the receiver.

        Parameters
        ----------
        times
            POSIX s, (K,), with the sun up.
        names
            Heliostats; default: all that were calibrated. Without a calibration nothing is
            predicted.
        """
        chosen = tuple(self.values) if names is None else names
        suns = vector(times, self.plant.site)
        aim = self.plant.receivers[0].center
        off, wide = [], []
        for name in chosen:
            error, uncertain = self._compare(name, suns, aim)
            off.append(error)
            wide.append(uncertain)
        beam, covariance = np.stack(off), np.stack(wide)
        sure = np.isfinite(beam).all(axis=-1) & np.isfinite(covariance).all(axis=(-1, -2))
        whitened = np.linalg.solve(covariance[sure], beam[sure][:, :, None])[..., 0]
        near = np.sum(beam[sure] * whitened, axis=-1)
        within = float(np.mean(near <= CHI_SQUARE_90)) if sure.any() else float("nan")
        spread = np.trace(covariance, axis1=-2, axis2=-1)
        return Truth(chosen, _half(np.sum(beam**2, axis=-1)), _half(spread), within)

    def _compare(self, name: str, suns: FloatArray, aim: FloatArray) -> tuple[FloatArray, ...]:
        """Return beam errors (K, 2) and their predicted covariance (K, 2, 2), rad and rad²."""
        believed, count = self.mechanism(name), len(suns)
        solved = track(believed[np.zeros(count, dtype=np.intp)], suns, aim)
        counts = solved.best_counts
        row = np.full(count, self.group.index(name))
        seen = sightings(np.arange(count), counts, suns, np.broadcast_to(aim, (count, 3)))
        off = beam_errors(self.truth[row], seen).offset
        if name not in self.records:
            return off, np.full((count, 2, 2), np.nan)
        record = self.records[name]
        covariance = record.covariance_at(self.now.timestamp())
        return off, expected_error(believed, record.names, covariance, suns, aim).covariance


def _half(squares: FloatArray) -> FloatArray:
    """Return half of the RMS of the finite values: a normal turns half as much as its beam."""
    good = np.isfinite(squares)
    total = np.where(good, squares, 0.0).sum(axis=1)
    mean = total / np.where(good.any(axis=1), good.sum(axis=1), np.nan)
    return np.asarray(0.5 * np.sqrt(mean))
