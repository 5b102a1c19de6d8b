"""The plant's own safety actions: watch the table, order, repeat, prove.

An emergency of the whole field begins when the table demands DEFOCUS or STOW of the field, or when
a person orders it. It ends when nothing demands it any more: the causes have gone and are
acknowledged, and a person's order is withdrawn.
"""

import math
from collections.abc import Iterable, Sequence

import numpy as np

from heliotrope.links.clock import Clock
from heliotrope.links.messages import Progress
from heliotrope.mechanism.drives import Drive
from heliotrope.plant.authority import Authority
from heliotrope.plant.emergency.order import EmergencyOrder
from heliotrope.plant.emergency.table import TableWatch
from heliotrope.plant.field_state import FieldState
from heliotrope.plant.joining import JoinQueue
from heliotrope.plant.orders import PlantOrders
from heliotrope.plant.tickets import Ticket
from heliotrope.safety import Act, Alarm

#: A heliostat that was sent off the receiver shows it within this time, s.
OFF_SHOWS = 10.0
#: Name and role of the safety table in a record.
_TABLE = ("safety table", "plant")


class Sentinel:
    """Obedience to the safety table, and every emergency up to its proof.

    Parameters
    ----------
    clock
        Clock of the plant.
    table
        The plant's rows of the safety table.
    field, orders, joining, authority
        Of the plant.
    drives
        Of the heliostats, (N, 2), for the proof.
    repeat
        Pause between two repetitions of an order, s.

    Attributes
    ----------
    table
        As given.
    order
        The last order to the whole field, None before the first.
    on
        Whether an emergency of the whole field holds.
    """

    def __init__(
        self,
        clock: Clock,
        table: TableWatch,
        field: FieldState,
        orders: PlantOrders,
        joining: JoinQueue,
        authority: Authority,
        drives: Drive,
        repeat: float,
    ) -> None:
        self.order: EmergencyOrder | None = None
        self.on = False
        self._called = False
        self._clock, self.table, self._field = clock, table, field
        self._orders, self._joining, self._authority = orders, joining, authority
        self._drives, self._repeat = drives, repeat
        #: The strongest act that each cluster was sent as a whole, while it holds.
        self._acts: dict[str, Act] = {}
        self._sent_off: dict[str, float] = {}
        self._repeated_at = -math.inf

    # -- the table -------------------------------------------------------------------------

    def beat(self, now: float) -> list[Alarm]:
        """Evaluate the table and do what it demands; return the alarms raised and ended."""
        proof = self.order.proof if self.on and self.order is not None else None
        news = self.table.evaluate(proof, called=self._called, now=now)
        self._obey_field(now)
        self._obey_clusters()
        self._obey_heliostats(now)
        return news

    def _obey_field(self, now: float) -> None:
        wanted, caused = self.table.demanded(), self.table.caused()
        order = self.order
        # A consequence of an emergency may make it worse, but begins none: it would never end.
        if wanted is not None and wanted >= Act.DEFOCUS and (caused or self.on):
            if not self.on or order is None or wanted > order.act:
                self._begin(wanted, _TABLE, self.table.reasons(Act.DEFOCUS))
            elif now - self._repeated_at >= self._repeat:
                self._repeat_order(self._field.clusters)
        if not caused:
            self.on = False
        if wanted is not None and wanted >= Act.HOLD:
            self._joining.drop(self.table.reasons(Act.HOLD))

    def _obey_clusters(self) -> None:
        for name, members in self._field.members.items():
            act = self.table.demanded(name)
            if act is None or act < Act.DEFOCUS:
                self._acts.pop(name, None)
                continue
            sent = [self._acts[name]] if name in self._acts else []
            if self.on and self.order is not None:
                sent.append(self.order.act)
            if all(act > other for other in sent):
                self._acts[name] = act
                text = self.table.reasons(Act.DEFOCUS, name)
                self._joining.drop(text, frozenset(members))
                self.send_safe(_TABLE, act, members, text)

    def _obey_heliostats(self, now: float) -> None:
        """Hold heliostats where they are; without a command authority, defocus them instead.

        A heliostat that has been sent off the receiver is not stopped, even if its state does not
        show the order yet.
        """
        token = self._authority.token
        self._sent_off = {n: at for n, at in self._sent_off.items() if now - at < OFF_SHOWS}
        for name, text in self.table.held().items():
            if self.on or name in self._sent_off:
                continue
            self._joining.drop(text, frozenset([name]))
            if token:
                ticket = self._orders.accept((*_TABLE, "LOCK"), (), (name,), text, late=True)
                self._orders.command(ticket, "LOCK", (), (name,), token)
            else:
                self.send_safe(_TABLE, Act.DEFOCUS, (name,), text)

    # -- orders ----------------------------------------------------------------------------

    def _begin(self, act: Act, giver: tuple[str, str], reason: str) -> EmergencyOrder:
        """Order DEFOCUS or STOW of the whole field."""
        now, names = self._clock.monotonic(), self._field.names
        ticket = self._orders.accept((*giver, act.name), (), names, reason, late=True)
        self.order = EmergencyOrder(act, giver[0], reason, now, ticket)
        self.on, self._repeated_at = True, now
        self._orders.emergency(ticket, act, names)
        self._joining.drop(f"{act.name} of the field: {reason}")
        return self.order

    def call(self, who: str, act: Act, reason: str) -> EmergencyOrder:
        """Order an emergency for a person; it holds until it is withdrawn."""
        self._called = True
        if not self.on or self.order is None or act > self.order.act:
            return self._begin(act, (who, "anybody"), reason)
        self._orders.note(who, "anybody", act.name, f"{reason}; it holds already")
        return self.order

    def withdraw(self) -> None:
        """Withdraw a person's order; rows that it tripped still wait to be acknowledged."""
        self._called = False

    def send_safe(
        self, giver: tuple[str, str], act: Act, heliostats: Sequence[str], note: str
    ) -> Ticket:
        """Send DEFOCUS or STOW to some heliostats; ``giver`` is a name and a role."""
        ticket = self._orders.accept((*giver, act.name), (), heliostats, note, late=True)
        self._orders.emergency(ticket, act, heliostats)
        self._sent_off.update(dict.fromkeys(heliostats, self._clock.monotonic()))
        return ticket

    def greet(self, cluster: str) -> None:
        """Send a cluster that has connected the order that it missed."""
        self._acts.pop(cluster, None)
        self._repeat_order([cluster])

    def _repeat_order(self, clusters: Iterable[str]) -> None:
        """Send the order again to heliostats that have not acknowledged it, while it holds.

        While its ticket is open, `PlantOrders` repeats it as it repeats every other one.
        """
        order = self.order
        if order is None or not self.on or not order.ticket.finished:
            return
        self._repeated_at = self._clock.monotonic()
        members = [name for cluster in clusters for name in self._field.members[cluster]]
        self._orders.repeat(order.ticket, order.act, order.unacknowledged(tuple(members)))

    # -- proof -----------------------------------------------------------------------------

    def take_progress(
        self, ticket: Ticket, heliostats: tuple[str, ...], progress: Progress
    ) -> None:
        """Take a cluster's report on a ticket, if it is the order's ticket."""
        if self.order is not None and ticket is self.order.ticket:
            self.order.take_stage(heliostats, progress.stage, self._clock.monotonic())

    def take_rows(self, cluster: str, now: float) -> None:
        """Update the proof of the order from a cluster's new status."""
        order = self.order
        if order is None or not self.on:
            return
        names = self._field.members[cluster]
        rows = [self._field.index[n] for n in names if not order.is_done(n)]
        if rows:
            index = np.array(rows, dtype=np.intp)
            order.take_rows(
                tuple(self._field.names[r] for r in rows),
                self._field.rows[index],
                self._field.heard[index],
                Drive(self._drives.table[index]),
                now,
            )

    def refusal(self, clusters: Iterable[str]) -> str:
        """Return why no new motion may begin in some clusters, "" if it may."""
        if self.on and self.order is not None:
            return f"an emergency holds ({self.order.act.name}: {self.order.reason})"
        texts = (self.table.reasons(Act.REFUSE_NEW, name) for name in sorted(set(clusters)))
        return next((text for text in texts if text), "")
