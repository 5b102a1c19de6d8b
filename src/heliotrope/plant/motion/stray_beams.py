"""Stray beams: beams on a receiver that no order has sent there.

They come, for example, from a locked, jogged or defocused heliostat. Every heliostat that is
neither tracking nor searching is checked, from its step counts and the mechanism that the plant
believes, because the state alone does not reveal where the beam is. A heliostat that approaches its
goal still counts as moving. A heliostat at stow is checked like all others, because the stow
position may be wrong.
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.mechanism.drives import Drive
from heliotrope.plant.field.assigned import Points
from heliotrope.plant.field.state import FieldState, Mask
from heliotrope.plant.motion.defocusing import defocused
from heliotrope.plant.motion.paths import Paths
from heliotrope.safety import Act

#: A heliostat at rest is checked only once in this many checks.
TURNS = 3
#: A heliostat moves if its counts and goals differ by more steps than the first number, and
#: approaches its goal if it has made more steps than the second since the last check.
_MOVES, _GAINS = 200, 20


class StrayBeams:
    """Monitors stray beams on a receiver.

    Parameters
    ----------
    paths
        Paths of the heliostats, with their mechanisms and receivers.
    field
        State of the field, with the positions of the axes.
    points
        Assigned aims and standby points.
    sun
        Function that returns the unit vector to the sun, (3,), some seconds from now.

    Attributes
    ----------
    shining
        Heliostats whose beams were on a receiver in their last check.
    """

    def __init__(
        self, paths: Paths, field: FieldState, points: Points, sun: Callable[[float], FloatArray]
    ) -> None:
        self._paths, self._check = paths, paths.check
        self._field, self._points, self._sun = field, points, sun
        self.shining: frozenset[str] = frozenset()
        self._remaining = np.full(len(field), np.inf)
        self._turn = 0

    @property
    def watches(self) -> bool:
        """Whether there are receivers to monitor."""
        return bool(self._check.solids)

    def on_receiver(self, rows: npt.NDArray[np.intp]) -> Mask:
        """Return a mask of the heliostats whose last counts put the beam on a receiver, (K,)."""
        drives = Drive(self._check.drives.table[rows])
        return self._check.lights(rows, drives.angles(self._field.counts(rows)), self._sun(0.0))

    def check(self, now: float) -> None:
        """Check the moving heliostats, and some of the heliostats at rest."""
        field = self._field
        self._turn = (self._turn + 1) % TURNS
        every = np.arange(len(field))
        watched = field.sure(now) & ~np.isin(field.rows["state"], states.ON_AIM)
        remaining = np.abs(field.goals(every) - field.counts(every)).max(axis=-1)
        moves = remaining > _MOVES
        chosen = watched & (moves | (every % TURNS == self._turn))
        comes = moves & (remaining < self._remaining - _GAINS)
        self._remaining[~watched | chosen] = np.where(watched, remaining, np.inf)[~watched | chosen]
        rows = np.flatnonzero(chosen & ~comes)
        shining = {field.names[row] for row in rows[self.on_receiver(rows)]}
        stay = watched & ~chosen
        self.shining = frozenset(
            shining | {name for name in self.shining if stay[field.index[name]]}
        )

    def order_out(self, name: str, *, again: bool) -> Act:
        """Return DEFOCUS, or STOW if DEFOCUS has not helped or would end on a receiver as well."""
        row = self._field.place(name)
        if again or self._field.rows["state"][row] in states.LEAVING or self._field.turned[row]:
            return Act.STOW
        rows, sun = np.array([row]), self._sun(0.0)
        state, counts = self._field.rows["state"][rows], self._field.counts(rows)
        aims, standbys = self._points.aims[rows], self._points.standbys[rows]
        end = defocused(self._paths, rows, counts, sun, state, aims, standbys)
        return Act.STOW if self._check.lights(rows, end, sun)[0] else Act.DEFOCUS
