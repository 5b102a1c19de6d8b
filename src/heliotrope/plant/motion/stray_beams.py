"""Beams on a receiver that nobody sent there: a mirror locked, jogged or turned away onto it.

Every heliostat is looked at that is not tracking or searching, by its step counts and the mechanism
that the plant believes: a beam is on the receiver by where it is, whatever the state is called. A
mirror that comes nearer to its goal is on its way. One at stow is checked as all others are: the
stow position may be the wrong one.
"""

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.machine import Machine
from heliotrope.plant.field.aims import BeamCheck
from heliotrope.plant.field.assigned import Points
from heliotrope.plant.field.state import FieldState, Mask
from heliotrope.plant.motion.defocusing import defocused
from heliotrope.safety import Act

#: A heliostat that stands still is looked at once in this many looks.
TURNS = 3
#: A heliostat moves if its counts and goals differ by more steps than this, and comes nearer to its
#: goal if it has made more steps than that since the last look.
_MOVES, _GAINS = 200, 20


class StrayBeams:
    """Watch over beams that light a receiver unsent.

    Parameters
    ----------
    check
        Mirrors and receivers.
    field
        State of the field, with the positions of the axes.
    points
        Assigned aims and standby points.
    sun
        Returns the unit vector to the sun, (3,), some seconds from now.
    machines
        Limits and resting places of heliostats, by name, as far as they are known.

    Attributes
    ----------
    seen
        Heliostats whose beams were on a receiver in their last look.
    """

    def __init__(
        self,
        check: BeamCheck,
        field: FieldState,
        points: Points,
        sun: Callable[[float], FloatArray],
        machines: Mapping[str, Machine],
    ) -> None:
        self._check, self._field, self._points = check, field, points
        self._sun, self._machines = sun, machines
        self.seen: frozenset[str] = frozenset()
        self._left = np.full(len(field), np.inf)
        self._turn = 0

    @property
    def watches(self) -> bool:
        """Whether there are receivers to watch."""
        return bool(self._check.solids)

    def lit(self, rows: npt.NDArray[np.intp]) -> Mask:
        """Return whose beams are on a receiver, (K,), by the step counts last heard of (K,)."""
        drives = Drive(self._check.drives.table[rows])
        return self._check.lights(rows, drives.angles(self._field.counts(rows)), self._sun(0.0))

    def look(self, now: float) -> None:
        """Look at the heliostats that move, and at a part of those that stand."""
        field = self._field
        self._turn = (self._turn + 1) % TURNS
        every = np.arange(len(field))
        watched = field.sure(now) & ~np.isin(field.rows["state"], states.ON_AIM)
        left = np.abs(field.goals(every) - field.counts(every)).max(axis=-1)
        moves = left > _MOVES
        chosen = watched & (moves | (every % TURNS == self._turn))
        comes = moves & (left < self._left - _GAINS)
        self._left[~watched | chosen] = np.where(watched, left, np.inf)[~watched | chosen]
        rows = np.flatnonzero(chosen & ~comes)
        lit = {field.names[row] for row in rows[self.lit(rows)]}
        stay = watched & ~chosen
        self.seen = frozenset(lit | {name for name in self.seen if stay[field.index[name]]})

    def way_out(self, name: str, *, again: bool) -> Act:
        """Return DEFOCUS, or STOW where DEFOCUS has not helped or would end on a receiver too."""
        row = self._field.place(name)
        if again or self._field.rows["state"][row] in states.LEAVING or self._field.turned[row]:
            return Act.STOW
        rows, sun, state = np.array([row]), self._sun(0.0), int(self._field.rows["state"][row])
        aim, standby = self._points.aims[row], self._points.standbys[row]
        machine, counts = self._machines.get(name), self._field.counts(rows)[0]
        end = defocused(self._check, machine, row, counts, sun, state, aim, standby)
        return Act.STOW if self._check.lights(rows, end[None], sun)[0] else Act.DEFOCUS
