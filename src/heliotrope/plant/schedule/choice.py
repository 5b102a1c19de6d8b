"""Finds the best visit at a given moment: screens all heliostats, judges the best exactly.

Screening uses bounds. It considers only angles, as if each mirror rotated about its foot. The
candidates are then judged in the order of their bounds, including shading and blocking by
neighbours.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.learn.drift import DAY
from heliotrope.calibration.plan.on_target import chance_on_target
from heliotrope.calibration.plan.planning import SightingLimits
from heliotrope.field.camera import Camera
from heliotrope.field.plant import Plant
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, angle_between, tangent_axes
from heliotrope.plant.schedule.knowledge import FieldKnowledge, VisitYield
from heliotrope.plant.schedule.settings import Settings, Weather

#: Number of heliostats judged exactly at a time; maximum number of chunks in a decision once a
#: visit is found, and before.
CHUNK, CHUNKS, MOST_CHUNKS = 64, 2, 6
#: A heliostat that cannot be observed now, or whose visit would gain nothing, is judged again after
#: this time, s; the sun moves by a degree in four minutes.
AGAIN = 300.0
#: Maximum number of places in which a search looks for a beam.
LOOKS = 25
#: Allowance in the screening for the distance between a heliostat's pivot and its foot, rad.
SLACK = float(np.radians(4.0))

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Assignment:
    """A heliostat to be photographed on a target.

    Attributes
    ----------
    heliostat, target
        Names.
    at, until
        Start and expected end, POSIX s.
    before, after
        Expected beam error over the year before and after the visit, rad RMS (2-D).
    predicted
        Expected beam error at the photograph, including the camera's noise, rad RMS (2-D).
    seen
        Probability that the beam is completely on the target in the first photograph.
    overdue
        Whether it was chosen because of its age and not because of its gain.
    reason
        Why it was chosen, for display.
    """

    heliostat: str
    target: str
    at: float
    until: float
    before: float
    after: float
    predicted: float
    seen: float
    overdue: bool
    reason: str

    @property
    def gain(self) -> float:
        """Expected reduction of the beam error over the year, rad."""
        return self.before - self.after


class Sight:
    """Lines of sight from N heliostats to one target.

    Parameters
    ----------
    target
        The target.
    position
        Feet of the heliostats, ENU, m, (N, 3).
    size
        Width and height of the mirrors, m, (N, 2).
    cameras
        Cameras that observe the target.
    """

    def __init__(
        self, target: Target, position: FloatArray, size: FloatArray, cameras: tuple[Camera, ...]
    ) -> None:
        self.target = target
        path = target.center - position
        self.path = path / np.linalg.norm(path, axis=1)[:, None]
        self.obliquity = angle_between(-self.path, np.broadcast_to(target.normal, path.shape))
        self._position, self._size = position, size.max(axis=1)
        self._eyes = [c.position for c in cameras if c.position is not None]

    def able(self, sun: FloatArray, limits: SightingLimits) -> Mask:
        """Return a mask of the heliostats that may be within slightly relaxed limits, (N,)."""
        half_way = 0.5 * angle_between(np.broadcast_to(sun, self.path.shape), self.path)
        return np.asarray(
            (half_way <= limits.max_incidence + SLACK)
            & (self.obliquity <= limits.max_obliquity + SLACK)
        )

    def seen(self, square: FloatArray, rows: npt.NDArray[np.intp] | slice) -> FloatArray:
        """Return the probability that each beam is completely on the target at first, (K,).

        "At first" means in the first photograph of the visit.

        Parameters
        ----------
        square
            Expected squared beam error, rad², (K,).
        rows
            Heliostats, (K,).
        """
        return chance_on_target(self.target, self._position[rows], self._size[rows], square)

    def glare(self, sun: FloatArray) -> float:
        """Return the smallest angle between the sun and any camera's line of sight, rad."""
        lines = [self.target.center - eye for eye in self._eyes]
        return min(
            (float(angle_between(line / np.linalg.norm(line), sun)) for line in lines),
            default=np.pi,
        )


def hidden(
    offsets: FloatArray, normal: FloatArray, size: FloatArray, path: FloatArray
) -> FloatArray:
    """Return the fraction of each mirror that neighbours hide in a direction, (K,).

    Parameters
    ----------
    offsets
        From each mirror to its neighbours, m, (K, J, 3).
    normal
        Normals of the mirrors, and of their neighbours, which are assumed parallel, (K, 3).
    size
        Width and height of the mirrors, m, (K, 2).
    path
        Unit vector to the sun or the target, (3,) or (K, 3).

    Notes
    -----
    Parallel mirrors of one size are projected along the ray into the mirror's plane, where the
    overlap of two rectangles is exact; overlaps of several neighbours are added, which is an upper
    bound.
    """
    ray = np.broadcast_to(path, normal.shape)
    steep = np.maximum(np.einsum("kc,kc->k", normal, ray), 0.05)
    height = np.einsum("kjc,kc->kj", offsets, normal)
    moved = offsets - (height / steep[:, None])[..., None] * ray[:, None, :]
    axes = tangent_axes(normal)
    plane = np.abs(np.einsum("kjc,kac->kja", moved, axes))
    overlap = np.clip(1.0 - plane / size[:, None, :], 0.0, 1.0).prod(axis=-1)
    # Only a neighbour in front of the mirror, towards the light, can hide it.
    return np.asarray(np.minimum(np.where(height > 0.0, overlap, 0.0).sum(axis=1), 1.0))


@dataclass(frozen=True)
class Choice:
    """The best visit found: value, heliostat index, slope (2, P), and assignment."""

    value: float
    row: int
    slope: FloatArray
    assignment: Assignment


@dataclass(frozen=True)
class Moment:
    """The inputs of a decision at one moment.

    They are the time, POSIX s; the sun vector, (3,); the squared errors and the ages, (N,); and the
    step counts, (N, 2).
    """

    now: float
    sun: FloatArray
    square: FloatArray
    age: FloatArray
    counts: FloatArray | None


class Judge:
    """The search for the best visit at a given moment.

    Parameters
    ----------
    design, settings
        The plant, and the settings of the schedule.
    known
        Knowledge of the heliostats.
    names
        The heliostats.

    Attributes
    ----------
    sights
        Lines of sight, by target.
    more
        Whether the last decision found no visit without judging every candidate, so that another
        decision may find one.
    """

    def __init__(
        self, design: Plant, settings: Settings, known: FieldKnowledge, names: Sequence[str]
    ) -> None:
        self._settings, self._known, self._names = settings, known, names
        self.sights = {
            t.name: Sight(
                t,
                known.position,
                known.size,
                tuple(c for c in design.cameras if t.name in c.targets or not c.targets),
            )
            for t in design.targets
        }
        self.more = False
        self._again = {name: np.full(len(known), -np.inf) for name in self.sights}

    def of(self, known: FieldKnowledge) -> "Judge":
        """Return a copy that bases its decisions on other knowledge."""
        other = copy(self)
        other._known = known  # noqa: SLF001 - its own kind
        again = {name: until.copy() for name, until in self._again.items()}
        other._again = again  # noqa: SLF001
        return other

    def decide(
        self,
        now: float,
        sun: FloatArray,
        ready: Mask,
        targets: Sequence[str],
        counts: FloatArray | None = None,
        weather: Weather | None = None,
    ) -> tuple[Choice | None, str]:
        """Return the best visit, and why it is best or why there is none.

        Parameters
        ----------
        now, sun
            POSIX s, and the unit vector to the sun, (3,).
        ready
            Mask of the heliostats that may be sent, (N,).
        targets
            Free targets.
        counts
            Step counts of the drives, (N, 2), if known.
        weather
            Weather, as far as it is measured.
        """
        settings, self.more = self._settings, False
        closed = settings.closed(sun, weather or Weather())
        if closed or not targets:
            return None, closed or "no target is free"
        clear = [n for n in targets if self.sights[n].glare(sun) >= settings.glare]
        if not clear:
            return None, f"the sun dazzles the cameras of {', '.join(targets)}"
        moment = Moment(now, sun, self._known.squares(now), self._known.ages(now), counts)
        late = ready & (moment.age > settings.most_age)
        worthy = ready & ~late & (moment.square > settings.goal**2)
        for chosen, overdue in ((late, True), (worthy, False)):
            best = self._best(moment, chosen, clear, overdue)
            if best is not None:
                return best, best.assignment.reason
        wanting = int((late | worthy).sum())
        if self.more:
            return None, f"no useful visit found yet; heliostats due: {wanting}, not all assessed"
        if wanting:
            return None, f"heliostats due for a visit: {wanting}; none would benefit from one now"
        if not ready.any():
            return None, "no heliostat is ready"
        return None, f"heliostats ready: {int(ready.sum())}; all are calibrated well enough"

    def _best(
        self, moment: Moment, chosen: Mask, targets: Sequence[str], overdue: bool
    ) -> Choice | None:
        """Return the best visit of a chosen heliostat to any of the targets.

        Overdue heliostats are ranked by age, all others by the reduction of their expected squared
        error per second of the visit.
        """
        row, place, bound = self._screen(moment, chosen, targets, overdue)
        order = np.argsort(-bound, kind="stable")
        best: Choice | None = None
        for turn in range(MOST_CHUNKS):
            part = order[turn * CHUNK : (turn + 1) * CHUNK]
            if not part.size or (
                best is not None and (turn >= CHUNKS or best.value >= bound[part[0]])
            ):
                return best
            for t in np.unique(place[part]):
                found = self._judge(moment, row[part[place[part] == t]], targets[t], overdue)
                if found is not None and (best is None or found.value > best.value):
                    best = found
        self.more |= best is None and len(order) > MOST_CHUNKS * CHUNK
        return best

    def _screen(
        self, moment: Moment, chosen: Mask, targets: Sequence[str], overdue: bool
    ) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], FloatArray]:
        """Return the candidates: heliostat indices, targets, and upper bounds of their values."""
        rows, places, bounds = [], [], []
        for t, name in enumerate(targets):
            sight = self.sights[name]
            able = sight.able(moment.sun, self._settings.limits)
            mine = np.flatnonzero(chosen & able & (self._again[name] <= moment.now))
            square = moment.square[mine]
            seen = sight.seen(square, mine)
            rows.append(mine)
            places.append(np.full(len(mine), t, dtype=np.intp))
            late = moment.age[mine] + 1.0
            bounds.append(late if overdue else self._worth(square, 0.0, seen, mine))
        return np.concatenate(rows), np.concatenate(places), np.concatenate(bounds)

    def _worth(
        self,
        gain: FloatArray,
        drive: npt.ArrayLike,
        seen: FloatArray,
        rows: npt.NDArray[np.intp],
    ) -> FloatArray:
        """Return the gain of visits to heliostats per second, rad²/s times their worth, (K,)."""
        worth = self._known.worth[rows]
        return np.asarray(worth * gain * self._chance(seen) / self._time(drive, seen))

    def _chance(self, seen: FloatArray) -> FloatArray:
        """Return the probability that a visit sees the beam."""
        return seen if self._settings.look is None else np.ones_like(seen)

    def _time(self, drive: npt.ArrayLike, seen: FloatArray) -> FloatArray:
        """Return the expected time of a visit, including travel both ways, s."""
        settings = self._settings
        # The first search position is already one of the photographs.
        looks = np.minimum(1.0 / np.maximum(seen, 1e-9), LOOKS) - 1.0
        search = 0.0 if settings.look is None else settings.look * looks
        return np.asarray(settings.visit + 2.0 * np.asarray(drive) + search)

    def _judge(
        self, moment: Moment, rows: npt.NDArray[np.intp], target: str, overdue: bool
    ) -> Choice | None:
        """Return the best visit of some heliostats to one target."""
        sight, settings = self.sights[target], self._settings
        best: Choice | None = None
        field = self._known
        for g in np.unique(field.group[rows]):
            mine = rows[field.group[rows] == g]
            counts = None if moment.counts is None else moment.counts[mine]
            look = field.look(mine, moment.now, moment.sun, sight.target, counts)
            offsets = field.position[field.near[mine]] - field.position[mine][:, None, :]
            free = look.able
            for path in (moment.sun, sight.path[mine]):
                share = hidden(offsets, look.normal, field.size[mine], path)
                free &= share <= settings.most_hidden
            square = moment.square[mine]
            seen = sight.seen(square, mine)
            value = self._worth(look.gain, look.drive, seen, mine)
            if overdue:
                # Prefer the target that yields more information.
                value = moment.age[mine] + look.gain / np.maximum(square, 1e-30)
            else:
                free &= look.gain > settings.worth * square
            self._again[target][mine[~free]] = moment.now + AGAIN
            if not free.any():
                continue
            k = int(np.argmax(np.where(free, value, -np.inf)))
            if best is None or value[k] > best.value:
                assignment = self._assignment(
                    moment, int(mine[k]), target, look, k, float(seen[k]), overdue
                )
                best = Choice(float(value[k]), int(mine[k]), look.slope[k], assignment)
        return best

    def _assignment(
        self,
        moment: Moment,
        row: int,
        target: str,
        look: VisitYield,
        k: int,
        seen: float,
        overdue: bool,
    ) -> Assignment:
        span = float(self._time(look.drive[k], np.array(seen)))
        before = float(np.sqrt(moment.square[row]))
        after = float(np.sqrt(max(moment.square[row] - look.gain[k], 0.0)))
        reason = f"expected beam error {1e3 * before:.2f} to {1e3 * after:.2f} mrad"
        if (worth := self._known.worth[row]) > 1.0:
            reason += f", which counts {worth:.1f} times under the flux limit"
        if overdue:
            reason = f"due: {moment.age[row] / DAY:.1f} days old; {reason}"
        return Assignment(
            self._names[row],
            target,
            moment.now,
            moment.now + span,
            before,
            after,
            float(np.sqrt(look.square[k])),
            seen,
            overdue,
            reason,
        )
