"""When heliostats were last ordered to move, and whether a report of theirs is from after that.

A way is proven from where a heliostat was last reported. If another order has been sent since, it
may have left that place, and is somewhere on a way that nobody has proven.

A heliostat that leaves the receiver was lost, unless it was ordered off, by anybody: this is where
`losses` asks for it.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray
from heliotrope.lcu import messages, states
from heliotrope.plant import refusals
from heliotrope.plant.field.state import FieldState

#: Orders after which a heliostat may be out again.
_OUT = messages.MOTIONS | messages.RELEASES
#: States in which a new point moves a heliostat.
_POINTS = {"AIM": states.ON_AIM, "STANDBY": (states.IDLE,)}
#: Orders that move.
MOVING = messages.MOTIONS | messages.SAFE | messages.POINTS
#: Orders that send heliostats to stow.
STOWING = frozenset({"STOW"})
#: From an order to a report that the board may have made before it took the order, s.
_TAKEN_WITHIN = 1.0

#: States in which a heliostat is off already: an order does not take it off.
_GONE = (*states.LEAVING, states.STOWED)

Rows = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]


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
        kinds = (MOVING, messages.SAFE, messages.JOINING, STOWING)
        self._shown = {kind: np.full(len(field), -np.inf) for kind in kinds}
        #: When heliostats that were out were ordered off, and when out, monotonic s, (N,).
        self._off_at, self._out_at = np.full(len(field), -np.inf), np.full(len(field), -np.inf)
        #: When they last refused a command, monotonic s, (N,).
        self._refused_at = np.full(len(field), -np.inf)
        #: Whether the order off was acknowledged, (N,).
        self._obeyed = np.zeros(len(field), dtype=np.bool_)

    def sent(self, name: str, heliostats: Sequence[str], now: float) -> None:
        """Note an order that has been sent."""
        rows = self._rows(name, heliostats)
        if name in messages.SAFE:
            # One that is silent, off already, or has refused a command since it was last heard, may
            # have left before: then the order is no cause.
            gone = np.isin(self._field.rows["state"][rows], _GONE)
            gone &= self._out_at[rows] + _TAKEN_WITHIN <= self._field.heard[rows]
            gone |= self._refused_at[rows] > self._field.heard[rows]
            gone |= ~self._field.live(now)[rows] | (self._off_at[rows] > self._out_at[rows])
            self._off_at[rows[~gone]], self._obeyed[rows[~gone]] = now, False
        elif name in _OUT:
            self._out_at[rows] = now
        self._note(name, rows, now + _TAKEN_WITHIN)

    def refused(self, name: str, heliostats: Sequence[str], now: float) -> None:
        """Note that heliostats have refused a command: they may no longer be where they seem.

        A refusal that the reported state explains, such as of APPROACH in TRACKING, says nothing.
        """
        rows = np.array([self._field.index[each] for each in heliostats], dtype=np.intp)
        state = self._field.rows["state"]
        leads_on = f" {name} " in states.TABLE
        odd = [r for r in rows if not leads_on or states.transition(int(state[r]), name)]
        self._refused_at[odd] = now

    def follows_loss(self, heliostats: Sequence[str]) -> None:
        """Note that heliostats were ordered off because something was lost: see `off`."""
        self._off_at[self._rows("STOW", heliostats)] = -np.inf

    def taken(self, name: str, heliostats: Sequence[str], now: float) -> None:
        """Note that an order has been acknowledged: it may have been long under way."""
        rows = self._rows(name, heliostats)
        if name in messages.SAFE:
            heard = rows[self._field.live(now)[rows]]
            last = heard[self._off_at[heard] > self._out_at[heard]]
            self._off_at[last], self._obeyed[last] = now, True
        self._note(name, rows, now)

    def _rows(self, name: str, heliostats: Sequence[str]) -> Rows:
        if name not in MOVING | _OUT:
            return np.array([], dtype=np.intp)
        return np.array([self._field.index[each] for each in heliostats], dtype=np.intp)

    def _note(self, name: str, rows: Rows, shown: float) -> None:
        if name in _POINTS:
            rows = rows[np.isin(self._field.rows["state"][rows], _POINTS[name])]
        for kind, times in self._shown.items():
            if name in kind:
                times[rows] = np.maximum(times[rows], shown)

    def since(self, heliostat: str, kind: frozenset[str], at: float) -> bool:
        """Return whether a heliostat was sent an order of a kind since a time, monotonic s.

        ``kind`` is `messages.SAFE` or `STOWING`.
        """
        return bool(self._shown[kind][self._field.index[heliostat]] > at)

    def off(self, seen: FloatArray, now: float) -> Mask:
        """Return which heliostats were ordered off, by anybody, (N,); to be asked at each check.

        It is the last order that they were sent, or it was sent after they were last ``seen`` out,
        monotonic s, (N,). An order to one that was silent, or fell silent before it acknowledged
        it, or was off already, or had refused a command since it was last heard, does not count: it
        may have left by itself. Nor does an order of the
        safety table to a whole cluster, which is silent, or has lost the time.
        """
        self._off_at[~self._field.live(now) & ~self._obeyed] = -np.inf
        ordered = np.isfinite(self._off_at)
        later = self._off_at + _TAKEN_WITHIN > seen
        return np.asarray(ordered & (later | (self._off_at > self._out_at)))

    def unshown(self, rows: Rows, kind: frozenset[str] = MOVING) -> dict[str, str]:
        """Return which heliostats (K,) have told nothing since an order, and why others wait.

        ``kind`` is what counts: MOVING, `messages.SAFE` or `messages.JOINING`.
        """
        late = self._field.heard[rows] < self._shown[kind][rows]
        return {self._field.names[row]: refusals.PLACE_UNKNOWN.text for row in rows[late]}

    def silent(self, rows: Rows, now: float) -> dict[str, str]:
        """Return which heliostats (K,) are not live, and why others wait."""
        late = ~self._field.live(now)[rows]
        return {self._field.names[row]: refusals.PLACE_UNKNOWN.text for row in rows[late]}
