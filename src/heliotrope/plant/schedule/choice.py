"""The best of many heliostats: screened by bounds, judged exactly in the order of these."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.learn.drift import DAY
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray
from heliotrope.plant.schedule.account import Assignment
from heliotrope.plant.schedule.field import FieldKnowledge
from heliotrope.plant.schedule.knowledge import Look
from heliotrope.plant.schedule.settings import Settings, Weather
from heliotrope.plant.schedule.sight import Sight, hidden

#: Heliostats that are judged exactly at a time; how often at most in a decision once one was found,
#: and while none was.
CHUNK, CHUNKS, MOST_CHUNKS = 64, 2, 6
#: Who cannot be seen now, or to no gain, is not looked at again for so long, s: the sun moves
#: by a degree in four minutes.
AGAIN = 300.0
#: A search for a beam looks at most at so many places.
LOOKS = 25

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Choice:
    """The best that was found: who, its information, and what is told of it."""

    value: float
    row: int
    slope: FloatArray
    assignment: Assignment


@dataclass(frozen=True)
class Moment:
    """What a decision rests on."""

    now: float
    sun: FloatArray
    square: FloatArray
    age: FloatArray
    counts: FloatArray | None


class Judge:
    """Finds the best visit of a moment.

    Parameters
    ----------
    design, settings
        Of the schedule.
    known
        How well each heliostat is known.
    names
        Of the heliostats.

    Attributes
    ----------
    sights
        By target.
    more
        Whether the last decision found none but did not look at all: ask again.
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
        """Return one that judges by other knowledge."""
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
        """Return the best visit, and why it, or why there is none.

        Parameters
        ----------
        now, sun
            Unix s, and the unit vector to the sun, (3,).
        ready
            Who may be sent, (N,).
        targets
            That are free.
        counts
            Of the drives, (N, 2), if known.
        weather
            As far as it is measured.
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
            return None, f"none found yet; {wanting} want it, and not all were looked at"
        if wanting:
            return None, f"{wanting} want it, but none of them can be seen now to any gain"
        if not ready.any():
            return None, "nobody stands ready"
        return None, f"{int(ready.sum())} stand ready, and all are known well enough"

    def _best(
        self, moment: Moment, chosen: Mask, targets: Sequence[str], overdue: bool
    ) -> Choice | None:
        """Return the best of the chosen heliostats on any of the targets.

        Those that are overdue are ranked by age, the others by what a visit takes away from
        their expected squared error in each second.
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
        """Who may come into question: row, place of the target, and the most it can be worth."""
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
            bounds.append(late if overdue else self._worth(square, 0.0, seen))
        return np.concatenate(rows), np.concatenate(places), np.concatenate(bounds)

    def _worth(self, gain: FloatArray, drive: npt.ArrayLike, seen: FloatArray) -> FloatArray:
        """Gain for each second, rad²/s."""
        return np.asarray(gain * self._chance(seen) / self._time(drive, seen))

    def _chance(self, seen: FloatArray) -> FloatArray:
        """Chance that a visit sees the beam."""
        return seen if self._settings.look is None else np.ones_like(seen)

    def _time(self, drive: npt.ArrayLike, seen: FloatArray) -> FloatArray:
        """Expected time of a visit, there and back, s."""
        settings = self._settings
        # The first look is one of the photographs.
        looks = np.minimum(1.0 / np.maximum(seen, 1e-9), LOOKS) - 1.0
        search = 0.0 if settings.look is None else settings.look * looks
        return np.asarray(settings.visit + 2.0 * np.asarray(drive) + search)

    def _judge(
        self, moment: Moment, rows: npt.NDArray[np.intp], target: str, overdue: bool
    ) -> Choice | None:
        """The best of some heliostats on one target."""
        sight, settings = self.sights[target], self._settings
        best: Choice | None = None
        field = self._known
        for g in np.unique(field.group[rows]):
            mine = rows[field.group[rows] == g]
            counts = None if moment.counts is None else moment.counts[mine]
            look = field.look(mine, moment.now, moment.sun, sight.target, counts)
            offsets = field.position[field.near[mine]] - field.position[mine][:, None, :]
            free = look.able
            for way in (moment.sun, sight.way[mine]):
                share = hidden(offsets, look.normal, field.size[mine], way)
                free &= share <= settings.most_hidden
            square = moment.square[mine]
            seen = sight.seen(square, mine)
            value = self._worth(look.gain, look.drive, seen)
            if overdue:
                # Of two targets the one that tells more.
                value = moment.age[mine] + look.gain / np.maximum(square, 1e-30)
            else:
                free &= look.gain > settings.worth * square
            self._again[target][mine[~free]] = moment.now + AGAIN
            if not free.any():
                continue
            k = int(np.argmax(np.where(free, value, -np.inf)))
            if best is None or value[k] > best.value:
                told = self._told(moment, int(mine[k]), target, look, k, float(seen[k]), overdue)
                best = Choice(float(value[k]), int(mine[k]), look.slope[k], told)
        return best

    def _told(
        self, moment: Moment, row: int, target: str, look: Look, k: int, seen: float, overdue: bool
    ) -> Assignment:
        span = float(self._time(look.drive[k], np.array(seen)))
        before = float(np.sqrt(moment.square[row]))
        after = float(np.sqrt(max(moment.square[row] - look.gain[k], 0.0)))
        reason = f"expected beam error {1e3 * before:.2f} to {1e3 * after:.2f} mrad"
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
