"""Points that were sent to local controllers, and whether they were accepted.

The plant checks and records a point before it is sent, and relies on it once it is sent. A busy
local controller refuses the point, and continues with the previous point.
"""

from collections.abc import Sequence

import numpy as np

from heliotrope.links.messages import Stage
from heliotrope.plant.field.assigned import KINDS, Points
from heliotrope.plant.field.part import Part
from heliotrope.plant.field.state import FieldState
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.plant.refusals import AIM_NOT_TAKEN, STANDBY_NOT_TAKEN

#: Why a point of an earlier program may not have been accepted.
_BEFORE_START = (
    "the plant's program ended before it was acknowledged, or the plant's store was "
    "restored from a backup"
)


#: The refusal of a command that needs a point that was not accepted.
_NOT_TAKEN = {"AIM": AIM_NOT_TAKEN, "STANDBY": STANDBY_NOT_TAKEN}


class Unacknowledged(Part):
    """For each heliostat, the last ticket for a point that may not have been accepted.

    Parameters
    ----------
    field, points
        Parts of the plant.
    """

    def __init__(self, field: FieldState, points: Points) -> None:
        self._field, self._points = field, points
        #: By kind and heliostat; None if the ticket ended with an earlier program.
        self._tickets: dict[str, dict[str, Ticket | None]] = {}
        #: The last ticket that was accepted, by kind and heliostat.
        self._took: dict[str, dict[str, Ticket]] = {kind: {} for kind in KINDS}
        for kind in KINDS:
            open_ = np.isfinite(points.earlier[kind]).any(axis=(0, 2))
            self._tickets[kind] = {field.names[row]: None for row in np.flatnonzero(open_)}

    def sent(self, ticket: Ticket, heliostats: Sequence[str]) -> None:
        """Note new points that are being sent."""
        self._tickets[ticket.name].update(dict.fromkeys(heliostats, ticket))

    def on_stage(
        self, ticket: Ticket, heliostats: tuple[str, ...], stage: Stage, now: float
    ) -> None:
        """Note accepted points, unless newer points have been sent since."""
        del now
        if stage is not Stage.DONE or ticket.name not in KINDS:
            return
        last, took = self._tickets[ticket.name], self._took[ticket.name]
        for name in heliostats:
            if name not in last and took.get(name, ticket) is not ticket:
                last[name] = None  # the earlier point arrived after the later one
        names = [n for n in dict.fromkeys(heliostats) if last.get(n) is ticket]
        names = [n for n in names if ticket.stage(n) is not Stage.REFUSED]
        for name in names:
            del last[name]
            took[name] = ticket
        if names:
            rows = np.array([self._field.place(name) for name in names], dtype=np.intp)
            self._points.taken(ticket.name, rows)

    def untaken(self, kind: str, heliostat: str) -> str | None:
        """Return why a heliostat has not taken its assigned point; None if it may have."""
        last = self._tickets[kind]
        if heliostat not in last:
            return None
        ticket = last[heliostat]
        if ticket is None:
            return _NOT_TAKEN[kind].text.format(reason=_BEFORE_START)
        if ticket.stage(heliostat) in (Stage.REFUSED, Stage.FAILED):
            return _NOT_TAKEN[kind].text.format(reason=ticket.refusals[heliostat])
        return None

    def unknown(self, kind: str, heliostat: str) -> str | None:
        """Return why the point of a heliostat is unknown; None if it is known. See `Points`."""
        reason = self.untaken(kind, heliostat)
        row = self._field.place(heliostat)
        return reason if reason and self._points.unknown(kind, slice(row, row + 1)).all() else None
