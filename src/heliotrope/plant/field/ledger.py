"""The ledger: the orders that each heliostat was sent and has acknowledged, by kind of order.

A report does not reflect an order that the board had not received when it made the report. A path
is checked from the last reported position of a heliostat. If another order has been sent since, the
heliostat may have left that position, and be on an unchecked path. The ledger decides whether a
report counts, and which of two orders came later.

A heliostat that leaves the receiver counts as lost unless it was ordered off; `losses` looks this
up in the ledger.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray
from heliotrope.lcu import messages, states
from heliotrope.links.messages import Stage
from heliotrope.plant.field.part import Part
from heliotrope.plant.field.state import FieldState, Mask
from heliotrope.plant.orders.tickets import Ticket

#: A kind of order: the names of its commands.
Kind = frozenset[str]
#: Orders after which a heliostat's beam may be out again.
_OUT = messages.MOTIONS | messages.RELEASES
#: Orders that move a heliostat. A new point moves it only in some states; see `_POINTS`.
MOVING = messages.MOTIONS | messages.SAFE | messages.POINTS
#: Kinds with a single order.
STOWING, LOCKING, TO_REST, STEPPING = (frozenset({n}) for n in ("STOW", "LOCK", "IDLE", "ROUGH"))
#: The kinds that the ledger keeps.
KINDS = (
    MOVING, messages.SAFE, messages.JOINING, messages.STANDS, _OUT, STOWING, LOCKING, TO_REST,
    STEPPING,
)  # fmt: skip
#: States in which a new point moves a heliostat.
_POINTS = {"AIM": states.ON_AIM, "STANDBY": (states.IDLE,)}
#: Time after an order in which a report may still date from before the board received the order, s.
_TAKEN_WITHIN = 1.0
#: States in which a heliostat is already off, so that an order does not take it off.
_GONE = (*states.LEAVING, states.STOWED)

Rows = npt.NDArray[np.intp]


class _Column:
    """The last order of one kind to N heliostats.

    Attributes
    ----------
    number
        Sequence number of the order, 0 before the first, (N,); a repetition keeps the number.
    sent
        When it was first sent, monotonic s, (N,).
    acknowledged, accepted
        When the last acknowledged order was acknowledged, and when the plant had accepted it, (N,).
    shown
        Time from which reports show the effect of the order, (N,).
    """

    def __init__(self, count: int) -> None:
        self.number = np.zeros(count, dtype=np.int64)
        self.sent, self.acknowledged, self.accepted, self.shown = np.full((4, count), -np.inf)


class Ledger(Part):
    """The last orders of each kind that N heliostats were sent and have acknowledged.

    Parameters
    ----------
    field
        State of the field, with the time of each report.
    """

    def __init__(self, field: FieldState) -> None:
        self._field, self._number = field, 0
        self._kinds = {kind: _Column(len(field)) for kind in KINDS}
        #: When heliostats whose beams were out were ordered off, monotonic s, (N,).
        self._off_at = np.full(len(field), -np.inf)
        #: When they last refused a command, monotonic s, (N,).
        self._refused_at = np.full(len(field), -np.inf)
        #: Whether the order off was acknowledged, (N,).
        self._obeyed = np.zeros(len(field), dtype=np.bool_)

    # -- events ----------------------------------------------------------------------------

    def on_sent(
        self,
        name: str,
        values: Sequence[float],
        heliostats: Sequence[str],
        now: float,
        again: bool,
    ) -> None:
        """Note an order that has been sent; see `sent`."""
        del values
        self.sent(name, heliostats, now, again=again)

    def on_stage(
        self, ticket: Ticket, heliostats: tuple[str, ...], stage: Stage, now: float
    ) -> None:
        """Note that some heliostats of a ticket acknowledged or refused its order."""
        if stage is Stage.ACKNOWLEDGED:
            self.acknowledged(ticket.name, ticket.accepted_at, heliostats, now)
        elif stage is Stage.REFUSED:
            self.refused(ticket.name, heliostats, now)

    def sent(
        self, name: str, heliostats: Sequence[str], now: float, *, again: bool = False
    ) -> None:
        """Note an order that has been sent, or repeated (``again``)."""
        rows = self._rows(heliostats)
        if name in messages.SAFE:
            # A heliostat that is silent, already off, or has refused a command since its last
            # report may have left before; then the order is not the cause.
            out_at = self._kinds[_OUT].sent
            excused = np.isin(self._field.rows["state"][rows], _GONE)
            excused &= out_at[rows] + _TAKEN_WITHIN <= self._field.heard[rows]
            excused |= self._refused_at[rows] > self._field.heard[rows]
            excused |= ~self._field.live(now)[rows] | (self._off_at[rows] > out_at[rows])
            self._off_at[rows[~excused]], self._obeyed[rows[~excused]] = now, False
        self._number += 1
        for kind, column in self._of(name):
            mine = self._moved(kind, name, rows)
            column.shown[mine] = np.maximum(column.shown[mine], now + _TAKEN_WITHIN)
            if not again:
                column.sent[mine], column.number[mine] = now, self._number

    def acknowledged(
        self, name: str, accepted_at: float, heliostats: Sequence[str], now: float
    ) -> None:
        """Note that an order has been acknowledged, perhaps long after it was sent.

        The plant accepted it at ``accepted_at``, monotonic s.
        """
        rows = self._rows(heliostats)
        if name in messages.SAFE:
            heard = rows[self._field.live(now)[rows]]
            last = heard[self._off_at[heard] > self._kinds[_OUT].sent[heard]]
            self._off_at[last], self._obeyed[last] = now, True
        for kind, column in self._of(name):
            mine = self._moved(kind, name, rows)
            column.shown[mine] = np.maximum(column.shown[mine], now)
            column.acknowledged[mine], column.accepted[mine] = now, accepted_at

    def refused(self, name: str, heliostats: Sequence[str], now: float) -> None:
        """Note that heliostats refused a command, so they may not be where they last reported.

        A refusal that the reported state explains, such as a refusal of APPROACH in TRACKING, is
        ignored.
        """
        state = self._field.rows["state"]
        leads_on = f" {name} " in states.TABLE
        rows = self._rows(heliostats)
        odd = [r for r in rows if not leads_on or states.transition(int(state[r]), name)]
        self._refused_at[odd] = now

    def follows_loss(self, heliostats: Sequence[str]) -> None:
        """Note that heliostats were ordered off because something was lost; see `off`."""
        self._off_at[self._rows(heliostats)] = -np.inf

    def _rows(self, heliostats: Sequence[str]) -> Rows:
        return np.array([self._field.index[name] for name in heliostats], dtype=np.intp)

    def _of(self, name: str) -> list[tuple[Kind, _Column]]:
        return [(kind, column) for kind, column in self._kinds.items() if name in kind]

    def _moved(self, kind: Kind, name: str, rows: Rows) -> Rows:
        """Return the indices (K,) of the heliostats for which an order is of a kind.

        An order with a point moves a heliostat only in some states.
        """
        if kind is not MOVING or name not in _POINTS:
            return rows
        return rows[np.isin(self._field.rows["state"][rows], _POINTS[name])]

    # -- queries ---------------------------------------------------------------------------

    def reported(self, kind: Kind = MOVING) -> Mask:
        """Return a mask of the heliostats that reported after their last order of a kind, (N,)."""
        return np.asarray(self._field.heard >= self._kinds[kind].shown)

    def sent_since(self, kind: Kind, at: float) -> Mask:
        """Return a mask of the heliostats whose last order of a kind was new since ``at``, (N,).

        ``at`` is in monotonic s. An order is new when it is first sent; a repetition is not new.
        """
        return np.asarray(self._kinds[kind].sent >= at)

    def later(self, kind: Kind, other: Kind) -> Mask:
        """Return a mask of the heliostats whose last ``kind`` order followed the last ``other``."""
        return np.asarray(self._kinds[kind].number > self._kinds[other].number)

    def obeyed_since(self, kind: Kind, at: float, after: Kind) -> Mask:
        """Return a mask of the heliostats that acknowledged an order of a kind since ``at``, (N,).

        The order counts only if it was accepted after the last order of the kind ``after`` was
        sent.
        """
        column = self._kinds[kind]
        in_order = column.accepted > self._kinds[after].sent
        return np.asarray(in_order & (column.acknowledged >= at))

    def off(self, out_at: FloatArray, now: float) -> Mask:
        """Return a mask of the heliostats that were ordered off by anyone, (N,).

        Call this method at each check.

        The order off was the last one, or was sent after the beam was last out (``out_at``,
        monotonic s, (N,)). An order does not count if the heliostat may have left by itself: it was
        silent, fell silent before it acknowledged the order, was already off, or had refused a
        command since its last report. An order of the safety table to a whole cluster does not
        count either if the cluster is silent or has lost the time.
        """
        self._off_at[~self._field.live(now) & ~self._obeyed] = -np.inf
        ordered = np.isfinite(self._off_at)
        later = self._off_at + _TAKEN_WITHIN > out_at
        return np.asarray(ordered & (later | (self._off_at > self._kinds[_OUT].sent)))
