"""Step counts of a heliostat in a coded visit, while its beam is displaced for photographs."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.tracking import track
from heliotrope.plant.visits.visit import Visit

#: Step counts that differ from those of the ordered movements by this share of them do not follow.
_FOLLOWS = 0.5
#: Rows of step counts that a sighting needs.
_LEAST_ROWS = 3


@dataclass(frozen=True)
class CountsHeard:
    """Step counts that one heliostat reported while it stood still for photographs.

    The local controller reports counts while it stands still for a photograph. They differ from
    those that the aim of the photograph asks for by what its tracking lags; the median of
    the differences belongs to all of them.

    Attributes
    ----------
    name
        Of the heliostat.
    armature, drives
        Its row of their tables, (1, …).
    counts
        As reported, (R, 2).
    aims
        Its aim at each report, ENU, m, (R, 3).
    base
        Its aim without movement, ENU, m, (3,).
    suns
        Unit vectors to the sun at the reports, and at the time of the counts in question, (R + 1,
        3).
    """

    name: str
    armature: FloatArray
    drives: FloatArray
    counts: FloatArray
    aims: FloatArray
    base: FloatArray
    suns: FloatArray

    @classmethod
    def of(
        cls,
        visit: Visit,
        base: FloatArray,
        still: Iterable[tuple[float, float, FloatArray]],
        middle: float,
    ) -> "CountsHeard":
        """Return the reports of a visit.

        Parameters
        ----------
        visit
            Of the heliostat.
        base
            Its aim without movement, ENU, m, (3,).
        still
            From when to when it stood at an aim, monotonic s, and that aim, (3,).
        middle
            Time of the counts in question.
        """
        plant, row = visit.plant, slice(visit.row, visit.row + 1)
        times, counts = visit.counted
        rows, aims = [], []
        for begin, end, aim in still:
            for r in np.flatnonzero((times >= begin) & (times <= end)):
                rows.append(int(r))
                aims.append(aim)
        now = plant.now()
        return cls(
            visit.heliostat,
            plant.beams.armature.table[row],
            plant.beams.drives.table[row],
            counts[rows],
            np.array(aims).reshape(-1, 3),
            base,
            np.stack([plant.sun_vector(float(at) - now) for at in (*times[rows], middle)]),
        )

    def at_rest(self) -> FloatArray | str:
        """Return the step counts at the aim without movement, (2,), or why they are not known."""
        count = len(self.counts)
        if count < _LEAST_ROWS:
            return f"its step counts were heard {count} times at its aims; {_LEAST_ROWS} needed"
        heard = np.concatenate([self.counts, self.counts[-1:]])
        ordered = self._counts(np.array([*self.aims, self.base]), heard)
        rest = self._counts(np.tile(self.base, (count + 1, 1)), heard)
        off = self.counts - ordered[:-1]
        # Medians: a drive with play overshoots for a moment when it turns back.
        lag = np.median(off, axis=0)
        loose = float(np.median(np.abs(off - lag).max(axis=-1)))
        if not loose <= _FOLLOWS * float(np.median(np.abs((ordered - rest)[:-1]).max(axis=-1))):
            return "its step counts do not follow the movements of its aim"
        return np.asarray(rest[-1] + lag)

    def _counts(self, aims: FloatArray, heard: FloatArray) -> FloatArray:
        """Return the step counts for aims (R + 1, 3), those nearest to counts (R + 1, 2)."""
        rows = np.zeros(len(aims), dtype=np.intp)
        drives = Drive(self.drives[rows])
        found = track(Armature(self.armature[rows]), self.suns, aims, drives=drives, current=heard)
        return found.best_counts


def counts_at_rest(heard: Iterable[CountsHeard]) -> dict[str, FloatArray | str]:
    """Return `CountsHeard.at_rest` of several heliostats, by name."""
    return {one.name: one.at_rest() for one in heard}
