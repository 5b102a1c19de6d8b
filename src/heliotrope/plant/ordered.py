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
OFF = frozenset({"DEFOCUS", "STOW"})
#: States in which a new point moves a heliostat.
_POINTS = {"AIM": (states.TRACKING, states.SEARCHING), "STANDBY": (states.IDLE,)}
#: Orders that move.
MOVING = MOTIONS | OFF | frozenset(_POINTS)
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
        #: Times from which a report shows the last order of each kind, (N,).
        self._shown = {kind: np.full(len(field), -np.inf) for kind in (MOVING, OFF, JOINING)}

    def sent(self, name: str, heliostats: Sequence[str], now: float) -> None:
        """Note an order that has been sent."""
        self._note(name, heliostats, now + _TAKEN_WITHIN)

    def taken(self, name: str, heliostats: Sequence[str], now: float) -> None:
        """Note that an order has been acknowledged: it may have been long under way."""
        self._note(name, heliostats, now)

    def _note(self, name: str, heliostats: Sequence[str], shown: float) -> None:
        if name not in MOVING:
            return
        rows = np.array([self._field.index[each] for each in heliostats], dtype=np.intp)
        if name in _POINTS:
            rows = rows[np.isin(self._field.rows["state"][rows], _POINTS[name])]
        for kind, times in self._shown.items():
            if name in kind:
                times[rows] = np.maximum(times[rows], shown)

    def unshown(self, rows: Rows, kind: frozenset[str] = MOVING) -> dict[str, str]:
        """Return which heliostats (K,) have told nothing since an order, and why others wait.

        ``kind`` is what counts: MOVING, OFF or JOINING.
        """
        late = self._field.heard[rows] < self._shown[kind][rows]
        return {self._field.names[row]: refusals.PLACE_UNKNOWN.text for row in rows[late]}

    def silent(self, rows: Rows, now: float) -> dict[str, str]:
        """Return which heliostats (K,) are not live, and why others wait."""
        late = ~self._field.live(now)[rows]
        return {self._field.names[row]: refusals.PLACE_UNKNOWN.text for row in rows[late]}
