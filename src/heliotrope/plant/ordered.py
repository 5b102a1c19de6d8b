"""When heliostats were last ordered to move, and whether a report of theirs is from after that.

A way is proven from where a heliostat was last reported. If another order has been sent since, it
may have left that place, and is somewhere on a way that nobody has proven.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.lcu import states
from heliotrope.plant import refusals
from heliotrope.plant.field_state import FieldState

#: Commands that bring beams to the receiver or move them across it.
JOINING = frozenset({"TRACK", "REFOCUS", "SEARCH"})
#: Commands that move heliostats by their parameters.
MOTIONS = JOINING | {"APPROACH", "IDLE", "JOG", "GOTO", "DIAGNOSE"}
#: Orders that send heliostats off.
_OFF = frozenset({"DEFOCUS", "STOW"})
#: States in which a new point moves a heliostat.
_POINTS = {"AIM": (states.TRACKING, states.SEARCHING), "STANDBY": (states.IDLE,)}
#: From an order to a report that the board may have made before it took the order, s.
_TAKEN_WITHIN = 1.0

Rows = npt.NDArray[np.intp]


class Ordered:
    """The last orders that moved N heliostats.

    Parameters
    ----------
    field
        State of the field.
    """

    def __init__(self, field: FieldState) -> None:
        self._field = field
        #: Times from which a report shows the last motion, and the last DEFOCUS or STOW, (N,).
        self._moved, self._off = np.full((2, len(field)), -np.inf)

    def sent(self, name: str, heliostats: Sequence[str], now: float) -> None:
        """Note an order that has been sent."""
        self._note(name, heliostats, now + _TAKEN_WITHIN)

    def taken(self, name: str, heliostats: Sequence[str], now: float) -> None:
        """Note that an order has been acknowledged: it may have been long under way."""
        self._note(name, heliostats, now)

    def _note(self, name: str, heliostats: Sequence[str], shown: float) -> None:
        off = name in _OFF
        if not (off or name in MOTIONS or name in _POINTS):
            return
        rows = np.array([self._field.index[each] for each in heliostats], dtype=np.intp)
        if name in _POINTS:
            rows = rows[np.isin(self._field.rows["state"][rows], _POINTS[name])]
        for times in (self._moved, self._off)[: 1 + off]:
            times[rows] = np.maximum(times[rows], shown)

    def unshown(self, rows: Rows, now: float, *, off: bool = False) -> dict[str, str]:
        """Return which heliostats (K,) have not told where they are now, and why they wait.

        They are silent, or have told nothing since the last order that moved them; with ``off``
        since their last DEFOCUS or STOW.
        """
        shown = np.maximum((self._off if off else self._moved)[rows], now - self._field.limit)
        return {
            self._field.names[row]: refusals.PLACE_UNKNOWN.text
            for row in rows[self._field.heard[rows] < shown]
        }
