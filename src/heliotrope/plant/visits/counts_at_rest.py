"""Step counts of a heliostat in a coded visit, while its beam is displaced for photographs."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.tracking import track
from heliotrope.plant.visits.visit import Visit

#: If step counts differ from the ordered movements by this fraction, the heliostat does not follow
#: the movements.
_FOLLOWS = 0.5
#: Number of step-count reports that a sighting needs.
_LEAST_ROWS = 3


@dataclass(frozen=True)
class CountsHeard:
    """Step counts that one heliostat reported while at rest for photographs.

    The counts reported at rest differ from the counts that the aim of the photograph requires by
    the lag of the tracking. The median of these differences applies to all of them.

    Attributes
    ----------
    name
        Name of the heliostat.
    armature, drives
        The heliostat's rows of the tables, (1, …).
    counts
        Reported step counts, (R, 2).
    aims
        Aim of the heliostat at each report, ENU, m, (R, 3).
    base
        Aim of the heliostat without movement, ENU, m, (3,).
    suns
        Unit vectors to the sun at the reports, and at the time for which counts are wanted, (R + 1,
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
            Visit of the heliostat.
        base
            Aim of the heliostat without movement, ENU, m, (3,).
        still
            Periods in which the heliostat was at rest at an aim, monotonic s, and that aim, (3,).
        middle
            Time for which counts are wanted.
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
        """Return the step counts at the aim without movement, (2,), or why these are unknown."""
        count = len(self.counts)
        if count < _LEAST_ROWS:
            return (
                f"its step counts were reported {count} times at its aims; {_LEAST_ROWS} "
                "reports are needed"
            )
        heard = np.concatenate([self.counts, self.counts[-1:]])
        ordered = self._counts(np.array([*self.aims, self.base]), heard)
        rest = self._counts(np.tile(self.base, (count + 1, 1)), heard)
        off = self.counts - ordered[:-1]
        # Medians, because a drive with backlash overshoots for a moment when it reverses.
        lag = np.median(off, axis=0)
        loose = float(np.median(np.abs(off - lag).max(axis=-1)))
        if not loose <= _FOLLOWS * float(np.median(np.abs((ordered - rest)[:-1]).max(axis=-1))):
            return "its step counts do not follow the movements of its aim"
        return np.asarray(rest[-1] + lag)

    def _counts(self, aims: FloatArray, heard: FloatArray) -> FloatArray:
        """Return the step counts for aims (R + 1, 3) that are nearest to counts (R + 1, 2)."""
        rows = np.zeros(len(aims), dtype=np.intp)
        drives = Drive(self.drives[rows])
        found = track(Armature(self.armature[rows]), self.suns, aims, drives=drives, current=heard)
        return found.best_counts


def counts_at_rest(heard: Iterable[CountsHeard]) -> dict[str, FloatArray | str]:
    """Return `CountsHeard.at_rest` of several heliostats, by name."""
    return {one.name: one.at_rest() for one in heard}
