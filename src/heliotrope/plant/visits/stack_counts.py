"""Step counts of a heliostat during a stack of photographs, each at a place beside one aim."""

from collections.abc import Callable, Iterable

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.plant.visits.visit import Visit

#: Step counts that differ from those of the ordered movements by this share of them do not follow.
_FOLLOWS = 0.5
#: Rows of step counts that a sighting needs.
_LEAST_ROWS = 3


def counts_at_rest(
    visit: Visit, base: FloatArray, still: Iterable[tuple[float, float, FloatArray]], middle: float
) -> Callable[[], FloatArray | str]:
    """Return what tells the step counts of a heliostat at its aim without movement.

    It returns them, (2,), or why they are not known. It computes for some milliseconds, from what
    is known now, and may be called in any thread.

    The local controller reports counts while it stands still for a photograph. They differ from
    those that the aim of the photograph asks for by what its tracking lags; the median of
    the differences belongs to all of them.

    Parameters
    ----------
    visit
        Of the heliostat.
    base
        Its aim without movement, ENU, m, (3,).
    still
        From when to when it stood at an aim, monotonic s, and that aim, (3,).
    middle
        Time of the counts that are returned.
    """
    plant = visit.plant
    times, counts = visit.counted
    rows, aims = [], []
    for begin, end, aim in still:
        for r in np.flatnonzero((times >= begin) & (times <= end)):
            rows.append(int(r))
            aims.append(aim)
    if len(rows) < _LEAST_ROWS:
        few = f"its step counts were heard {len(rows)} times at its aims; {_LEAST_ROWS} needed"
        return lambda: few
    when = [*times[rows], middle]
    heard = np.concatenate([counts[rows], counts[rows[-1:]]])
    which = np.full(len(when), visit.row, dtype=np.intp)

    def work() -> FloatArray | str:
        suns = np.stack([plant.sun_vector(float(at) - plant.now()) for at in when])
        ordered = plant.beams.poses(which, np.array([*aims, base]), suns, heard).best_counts
        rest = plant.beams.poses(which, np.tile(base, (len(when), 1)), suns, heard).best_counts
        off = heard[:-1] - ordered[:-1]
        # Medians: a drive with play overshoots for a moment when it turns back.
        lag = np.median(off, axis=0)
        loose = float(np.median(np.abs(off - lag).max(axis=-1)))
        if not loose <= _FOLLOWS * float(np.median(np.abs((ordered - rest)[:-1]).max(axis=-1))):
            return "its step counts do not follow the movements of its aim"
        return np.asarray(rest[-1] + lag)

    return work
