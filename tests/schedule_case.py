"""A small field whose mirrors are measured as a schedule says, without controllers."""

from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta

import numpy as np

from heliotrope.calibration.estimator import fit
from heliotrope.calibration.evaluation import errors
from heliotrope.calibration.planning import Limits, aim_at
from heliotrope.calibration.sightings import Sightings, camera_target, join
from heliotrope.control.schedule import Assignment, Scheduler, Visited, Weather
from heliotrope.field.example import roughly_installed
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray, reflect
from heliotrope.lcu import states
from heliotrope.mechanism.chain import Mechanism
from heliotrope.sun import vector


@dataclass
class Field:
    """States of heliostats that all stand at their standby points."""

    state: FloatArray
    counts: FloatArray

    @classmethod
    def ready(cls, count: int) -> "Field":
        """All of them can be sent."""
        return cls(np.full(count, states.IDLE), np.full((count, 2), [0.0, 50_000.0]))


@dataclass
class World:
    """A plant whose true mirrors stand as a quick installation leaves them.

    Attributes
    ----------
    truth
        Their true mechanisms.
    values
        Parameters that were learnt.
    made
        Assignments with their ends, in the order of their beginnings.
    """

    plant: Plant
    scheduler: Scheduler
    now: datetime
    noise: float = 5e-4
    seed: int = 0
    weather: Weather = field(default_factory=Weather)
    holds: tuple[str, ...] = ()
    blind: frozenset[str] = frozenset()
    known: dict[str, Sightings] = field(default_factory=dict)
    values: dict[str, Mechanism] = field(default_factory=dict)
    made: list[Assignment] = field(default_factory=list)
    reasons: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.group = self.plant.groups["azel"]
        self.truth = roughly_installed(self.group.mechanism, self.seed)
        self.field = Field.ready(len(self.plant))
        self.chance = np.random.default_rng(self.seed)
        self._ends: list[tuple[datetime, Assignment]] = []

    def live(self, span: timedelta, look: timedelta = timedelta(seconds=60)) -> None:
        """Let time pass: visits begin as the schedule says, and take as long as expected."""
        until = self.now + span
        while self.now < until:
            for end, told in [e for e in self._ends if e[0] <= self.now]:
                self._ends.remove((end, told))
                self.scheduler.done(self._visit(told))
            busy = {told.target for _, told in self._ends}
            free = [t.name for t in self.plant.targets if t.name not in busy]
            told = self.scheduler.next(
                self.now, vector(self.now, self.plant.site), self.field, free, self.holds,
                self.weather,
            ) if free else None  # fmt: skip
            if told is not None:
                self.made.append(told)
                self._ends.append((datetime.fromtimestamp(told.until, UTC), told))
                continue
            self.reasons.add(self.scheduler.reason.split(":")[0])
            self.now = min([self.now + look, *(end for end, _ in self._ends)])

    def mechanism(self, name: str) -> Mechanism:
        """As it is believed to be, (1,)."""
        row = np.array([self.group.index(name)])
        return self.values.get(name, self.group.mechanism[row])

    def photographs(self, name: str, target: str, times: FloatArray) -> Sightings:
        """Sightings of a heliostat that tracks a target as it is believed to be."""
        row, believed = self.group.index(name), self.mechanism(name)
        surface = self.plant.target(target)
        suns = vector(times, self.plant.site)
        many = believed[np.zeros(len(times), dtype=np.intp)]
        counts = aim_at(many, suns, surface, Limits()).counts
        pose = self.truth[np.full(len(times), row)].pose(counts)
        # The plane goes on beyond the target: a search would have found the beam.
        seen = surface.intersect(pose.vertex, reflect(suns, pose.normal))
        away = np.linalg.norm(seen - pose.vertex, axis=1)[:, None]
        shift = self.noise * away * self.chance.standard_normal((len(times), 2))
        return camera_target(
            np.zeros(len(times), dtype=np.intp), counts, suns, seen + shift @ surface.axes,
            time=times, sigma=self.noise,
        )  # fmt: skip

    def _visit(self, told: Assignment) -> Visited:
        name, shots = told.heliostat, self.scheduler.settings.shots
        if name in self.blind:
            return Visited(name, told.target, told.until, False, text="no beam")
        times = told.until - 20.0 * np.arange(shots, 0.0, -1.0)
        seen = self.photographs(name, told.target, times)
        measured = float(np.sqrt(np.mean(errors(self.mechanism(name), seen).beam ** 2)))
        before = [self.known[name]] if name in self.known else []
        self.known[name] = join([*before, seen])
        row = np.array([self.group.index(name)])
        found = fit(self.group.mechanism[row], self.known[name], "malan8")
        self.values[name] = self.group.mechanism[row].with_parameters(found.parameters)
        return Visited(name, told.target, told.until, True, self.known[name], measured)

    def beam_error(self, sun: FloatArray) -> FloatArray:
        """True beam errors at the receiver for a sun, rad, (N,)."""
        aim, found = self.plant.receivers[0], []
        goal = self.plant.targets[0]
        assert aim is not None
        for row, name in enumerate(self.plant.names):
            believed = self.mechanism(name)
            counts = aim_at(believed, sun, goal, Limits()).counts
            true = self.truth[np.array([row])].pose(counts).normal
            thought = believed.pose(counts).normal
            found.append(2.0 * float(np.arccos(min(1.0, float(np.sum(true * thought))))))
        return np.array(found)
