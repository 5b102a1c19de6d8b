"""Allocate a day's calibration beams to intervals and targets.

An option is a target during an interval, with room for a certain number of beams. The beam with the
greatest gain is allocated repeatedly (greedy choice under capacities, Fisher, Nemhauser & Wolsey
1978). Gains only decrease as heliostats become better known, so an outdated gain is recomputed only
when its heliostat reaches the top of the list (Minoux 1978). Because the greedy choice does not
look ahead, beams are then moved and exchanged between options as long as the sum of squared errors
decreases.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from heapq import heapify, heappop, heappush

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.plan import gain as _gain
from heliotrope.calibration.uncertainty import CHUNK
from heliotrope.geometry import FloatArray, as_float

#: Maximum number of beams to move and exchange; more would take more than some seconds.
TRIES = 4_000
#: Sweeps over all beams, options tried for each beam, and partners tried in each option.
SWEEPS, DEPTH, PARTNERS = 8, 4, 64


@dataclass(frozen=True)
class Option:
    """A target during an interval.

    Attributes
    ----------
    rows
        Indices of the heliostats whose beams can reach the target, (n,).
    slope
        Whitened derivatives with respect to the scaled parameters, (n, 2, P).
    room
        Number of beams that fit into the interval.
    most
        Maximum number of visits per heliostat, (n,).
    """

    rows: npt.NDArray[np.intp]
    slope: FloatArray
    room: int
    most: npt.NDArray[np.intp]


def gains(covariance: FloatArray, form: FloatArray, option: Option) -> FloatArray:
    """Return how much one sighting lowers each expected squared error, rad², (n,)."""
    falls = np.empty(len(option.rows))
    for a in range(0, len(falls), CHUNK):
        part = option.rows[a : a + CHUNK]
        slope = option.slope[a : a + CHUNK]
        falls[a : a + CHUNK] = _gain.variance_gain(covariance[part], slope, form[part])
    return falls


def allocate(
    covariance: FloatArray,
    form: FloatArray,
    options: Sequence[Option],
    worth: float,
    count: int | None,
) -> list[list[int]]:
    """Return the heliostats of each option, the greatest gain first.

    Parameters
    ----------
    covariance, form
        Covariance of the parameters, and quadratic form of the error, (N, P, P); not changed.
    options
        Options in any order.
    worth
        Minimum fraction by which a sighting must lower the heliostat's expected squared error.
    count
        Maximum number of sightings in total; default: no limit.
    """
    known = covariance.copy()
    square = np.einsum("npq,nqp->n", form, known)
    version = np.zeros(len(known), dtype=np.int64)
    heap: list[tuple[float, int, int, int]] = []
    for o, option in enumerate(options):
        falls = gains(known, form, option)
        able = (falls > worth * square[option.rows]) & (option.most > 0)
        heap += [(-float(falls[k]), 0, o, int(k)) for k in np.flatnonzero(able)]
    heapify(heap)
    chosen: list[list[int]] = [[] for _ in options]
    often: dict[tuple[int, int], int] = {}
    total = 0
    while heap and (count is None or total < count):
        _, age, o, k = heappop(heap)
        option = options[o]
        i = int(option.rows[k])
        if len(chosen[o]) >= option.room or often.get((o, k), 0) >= option.most[k]:
            continue
        if age == version[i]:
            chosen[o].append(i)
            total += 1
            often[o, k] = often.get((o, k), 0) + 1
            known[i] = _gain.updated(known[i], option.slope[k])
            square[i] = float(np.sum(form[i] * known[i]))
            version[i] += 1
        gain = float(_gain.variance_gain(known[i], option.slope[k], form[i]))
        if gain > worth * square[i]:
            heappush(heap, (-gain, int(version[i]), o, k))
    return chosen


class _Exchange:
    """The allocated beams and the information that each heliostat gains from them."""

    def __init__(
        self,
        covariance: FloatArray,
        form: FloatArray,
        options: Sequence[Option],
        chosen: Sequence[Sequence[int]],
    ) -> None:
        self.form, self.options = form, options
        self.chosen = [list(rows) for rows in chosen]
        self.information = np.linalg.inv(covariance)
        self.place = np.full((len(options), len(covariance)), -1, dtype=np.int64)
        for o, option in enumerate(options):
            self.place[o, option.rows] = np.arange(len(option.rows))
            for i in self.chosen[o]:
                self.information[i] += self.square(o, i)

    def slope(self, o: int, rows: int | list[int]) -> FloatArray:
        """Return the derivatives of heliostats in an option."""
        return np.asarray(self.options[o].slope[self.place[o, rows]])

    def square(self, o: int, i: int) -> FloatArray:
        """Return the information from one sighting, (P, P)."""
        slope = self.slope(o, i)
        return np.asarray(slope.T @ slope)

    def able(self, o: int, i: int) -> bool:
        """Whether option ``o`` can take heliostat ``i`` once more."""
        k = self.place[o, i]
        return bool(k >= 0 and self.chosen[o].count(i) < self.options[o].most[k])

    def better(self, o: int, i: int) -> bool:
        """Move or exchange a beam of ``i`` in option ``o`` if that lowers the error.

        Return whether it did.
        """
        rest = as_float(np.linalg.inv(self.information[i] - self.square(o, i)))
        others = np.array([p for p in range(len(self.options)) if p != o and self.able(p, i)])
        if not others.size:
            return self._replace(o, i, rest)
        slopes = np.stack([self.slope(p, i) for p in (o, *others)])
        gain = _gain.variance_gain(rest, slopes, self.form[i])
        gain = gain[1:] - gain[0]
        for n in np.argsort(-gain, kind="stable")[:DEPTH]:
            p = int(others[n])
            if gain[n] <= 0.0:
                break
            if len(self.chosen[p]) < self.options[p].room:
                self._move(o, p, i)
                return True
            partner = self._partner(o, p, i, float(gain[n]))
            if partner is not None:
                self._move(o, p, i)
                self._move(p, o, partner)
                return True
        return self._replace(o, i, rest)

    def _replace(self, o: int, i: int, rest: FloatArray) -> bool:
        """Replace a beam of ``i`` by the beam of a heliostat that gains more from the slot."""
        rows = self.options[o].rows
        rows = rows[:: max(1, -(-len(rows) // PARTNERS))]
        new = [int(b) for b in rows if b != i and self.able(o, int(b))]
        if not new:
            return False
        known = as_float(np.linalg.inv(self.information[new]))
        gain = _gain.variance_gain(known, self.slope(o, new), self.form[new])
        best = int(np.argmax(gain))
        if gain[best] <= float(_gain.variance_gain(rest, self.slope(o, i), self.form[i])):
            return False
        self.chosen[o][self.chosen[o].index(i)] = new[best]
        self.information[i] -= self.square(o, i)
        self.information[new[best]] += self.square(o, new[best])
        return True

    def _partner(self, o: int, p: int, i: int, gain: float) -> int | None:
        """Return the heliostat of option ``p`` that loses least by a move to option ``o``.

        Returns None if it would lose at least ``gain``.
        """
        rows = [b for b in dict.fromkeys(self.chosen[p]) if b != i and self.able(o, b)]
        rows = rows[:: max(1, -(-len(rows) // PARTNERS))]
        if not rows:
            return None
        slope_p, slope_o = self.slope(p, rows), self.slope(o, rows)
        rest = as_float(
            np.linalg.inv(self.information[rows] - np.swapaxes(slope_p, 1, 2) @ slope_p)
        )
        form = self.form[rows]
        change = _gain.variance_gain(rest, slope_o, form) - _gain.variance_gain(rest, slope_p, form)
        best = int(np.argmax(change))
        # The margin prevents rounding errors from exchanging two beams back and forth for ever.
        return rows[best] if change[best] > -gain * (1.0 - 1e-6) else None

    def _move(self, o: int, p: int, i: int) -> None:
        self.chosen[o].remove(i)
        self.chosen[p].append(i)
        self.information[i] += self.square(p, i) - self.square(o, i)


def exchanged(
    covariance: FloatArray,
    form: FloatArray,
    options: Sequence[Option],
    chosen: Sequence[Sequence[int]],
) -> list[list[int]]:
    """Return the result of `allocate` after moves and exchanges that lower the error."""
    work = _Exchange(covariance, form, options, chosen)
    tries = 0
    for _ in range(SWEEPS):
        changes = 0
        for o in range(len(options)):
            for i in list(work.chosen[o]):
                tries += 1
                if tries > TRIES:
                    return work.chosen
                changes += i in work.chosen[o] and work.better(o, i)
        if not changes:
            break
    return work.chosen
