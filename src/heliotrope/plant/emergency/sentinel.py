"""What the plant does by itself to keep the field safe: watch, order, repeat, prove."""

import math
from collections.abc import Iterable, Sequence

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.links.clock import Clock
from heliotrope.links.messages import Progress
from heliotrope.mechanism.drives import Drive
from heliotrope.plant._beam_watch import Lookout
from heliotrope.plant._cluster_end import ClusterEnd
from heliotrope.plant._joining import JoinQueue
from heliotrope.plant._watch import PlantWatch
from heliotrope.plant.authority import Authority
from heliotrope.plant.emergency import EmergencyOrder
from heliotrope.plant.field_state import FieldState
from heliotrope.plant.orders import PlantOrders
from heliotrope.plant.tickets import Ticket
from heliotrope.safety import Act, Alarm, Reading, proof_readings
from heliotrope.sun import Site, fast_vector

#: Who was sent off the receiver shows it after this time at the latest, s.
OFF_SHOWS = 10.0
#: The sun's elevation is computed so often, s.
SUN_PERIOD = 5.0


class Sentinel:
    """Obeys the safety table and carries emergencies through to their proof.

    Parameters
    ----------
    clock, site
        Time and place.
    field, ends, orders, joining, authority, watch
        Of the plant.
    drives
        Of the heliostats, (N, 2), for the proof.
    lookout
        Sees whose beams go into keep-out volumes.
    repeat
        Between repetitions of an order to those that have not acknowledged, s.

    Attributes
    ----------
    order
        The last one to the whole field, None before the first.
    on
        Whether an emergency of the whole field holds.
    called
        Whether somebody called it, and has not withdrawn that.
    """

    def __init__(
        self,
        clock: Clock,
        site: Site,
        field: FieldState,
        ends: dict[str, ClusterEnd],
        orders: PlantOrders,
        joining: JoinQueue,
        authority: Authority,
        watch: PlantWatch,
        drives: Drive,
        lookout: Lookout,
        repeat: float,
    ) -> None:
        self.order: EmergencyOrder | None = None
        self.on = self.called = False
        self._clock, self._site, self._field, self._ends = clock, site, field, ends
        self._orders, self._joining, self._authority = orders, joining, authority
        self._watch, self._drives, self._repeat = watch, drives, repeat
        self._lookout = lookout
        self._sent_off: dict[str, float] = {}
        self._repeated_at = self._sun_at = -math.inf
        self._sun: FloatArray = np.array([0.0, 0.0, -1.0])

    def beat(self, now: float) -> list[Alarm]:
        """Look at the table and do what it demands; return what is to be told."""
        news = self._watch.evaluate(self._readings(now), now)
        self._obey_field(now)
        self._obey_clusters()
        self._obey_heliostats()
        return news

    def _readings(self, now: float) -> dict[tuple[str, str], Reading]:
        """Return what the plant itself knows for its rows."""
        if now - self._sun_at >= SUN_PERIOD:
            self._sun_at = now
            self._sun = fast_vector(self._clock.utc().timestamp(), self._site)
        order = self.order if self.on else None
        own = {
            **proof_readings(None if order is None else order.proof, now),
            ("emergency_order", ""): Reading(float(self.called), now),
            ("authority_silence", ""): Reading(self._authority.silent_for, now),
            ("audit_silence", ""): Reading(now - self._orders.confirmed_at, now),
            ("sun_elevation", ""): Reading(math.asin(float(self._sun[2])), now),
            ("node_fault_share", ""): Reading(self._field.failed_share(now), now),
            **self._lookout.readings(now),
        }
        for name, at in self._field.status_at.items():
            if math.isfinite(at):
                own["cluster_silence", name] = Reading(0.0, at)
        return own

    def _obey_field(self, now: float) -> None:
        wanted = self._watch.demanded()
        order = self.order
        caused = self._watch.caused()
        # What only follows from an emergency may make it worse, but begins none: it would
        # never end.
        if wanted is not None and wanted >= Act.DEFOCUS and (caused or self.on):
            if not self.on or order is None or wanted > order.act:
                self.order_field(wanted, "safety table", self._watch.reasons(Act.DEFOCUS), now)
            elif now - self._repeated_at >= self._repeat:
                self.repeat(self._ends.values())
        if not caused:
            self.on = False
        if wanted is not None and wanted >= Act.HOLD:
            self._joining.drop(self._watch.reasons(Act.HOLD))

    def _obey_clusters(self) -> None:
        for end in self._ends.values():
            act = self._watch.demanded(end.name)
            if act is None or act < Act.DEFOCUS:
                end.act = -1
                continue
            field = self.order.act if self.on and self.order is not None else -1
            if act > max(end.act, field):
                end.act = int(act)
                text = self._watch.reasons(Act.DEFOCUS, end.name)
                self._joining.drop(text, frozenset(end.members))
                self.send_safe(("safety table", "plant"), act, end.members, text)

    def _obey_heliostats(self) -> None:
        """Hold mirrors where they are; without an authority they cannot be, and go off.

        Who is on its way off, which its state may not show yet, is not stopped there.
        """
        token, now = self._authority.token, self._clock.monotonic()
        self._sent_off = {n: at for n, at in self._sent_off.items() if now - at < OFF_SHOWS}
        for name, text in self._watch.held().items():
            if self.on or name in self._sent_off:
                continue
            who = ("safety table", "plant")
            self._joining.drop(text, frozenset([name]))
            if token:
                ticket = self._orders.accept((*who, "LOCK"), (), (name,), text, late=True)
                self._orders.command(ticket, "LOCK", (), (name,), token)
            else:
                self.send_safe(who, Act.DEFOCUS, (name,), text)

    def order_field(
        self, act: Act, who: str, reason: str, now: float, role: str = "plant"
    ) -> EmergencyOrder:
        """Order DEFOCUS or STOW of the whole field."""
        names = self._field.names
        record = (who, role, act.name)
        ticket = self._orders.accept(record, (), names, reason, late=True)
        self.order = EmergencyOrder(act, who, reason, now, ticket)
        self.on, self._repeated_at = True, now
        self._orders.emergency(ticket, act, names)
        self._joining.drop(f"{act.name} of the field: {reason}")
        return self.order

    def call(self, who: str, act: Act, reason: str) -> EmergencyOrder:
        """Order it on behalf of a person; it holds until it is withdrawn."""
        self.called = True
        if not self.on or self.order is None or act > self.order.act:
            return self.order_field(act, who, reason, self._clock.monotonic(), "anybody")
        self._orders.note(who, "anybody", act.name, f"{reason}; it holds already")
        return self.order

    def send_safe(
        self, who: tuple[str, str], act: Act, heliostats: Sequence[str], note: str
    ) -> Ticket:
        """Send DEFOCUS or STOW to some heliostats."""
        ticket = self._orders.accept((*who, act.name), (), heliostats, note, late=True)
        self._orders.emergency(ticket, act, heliostats)
        self._sent_off.update(dict.fromkeys(heliostats, self._clock.monotonic()))
        return ticket

    def repeat(self, ends: Iterable[ClusterEnd]) -> None:
        """Send the order again to those that have not acknowledged it, for as long as it holds.

        While its ticket is open that is done for it as for every other.
        """
        order = self.order
        if order is None or not self.on or not order.ticket.finished:
            return
        self._repeated_at = self._clock.monotonic()
        for end in ends:
            left = order.unacknowledged(end.members)
            if left and end.link.connected:
                self._orders.emergency(order.ticket, order.act, left, again=True)

    def take_progress(
        self, ticket: Ticket, heliostats: tuple[str, ...], progress: Progress
    ) -> None:
        """Take how far a cluster has come, if it is of the order."""
        if self.order is not None and ticket is self.order.ticket:
            self.order.take_stage(heliostats, progress.stage, self._clock.monotonic())

    def take_rows(self, end: ClusterEnd, now: float) -> None:
        """Take what a cluster's new status shows of the order."""
        order = self.order
        if order is None or not self.on:
            return
        rows = [self._field.index[n] for n in end.members if not order.is_done(n)]
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
        """Return why nothing new may move now in some clusters, "" if it may."""
        if self.on and self.order is not None:
            return f"an emergency holds ({self.order.act.name}: {self.order.reason})"
        texts = (self._watch.reasons(Act.REFUSE_NEW, name) for name in sorted(set(clusters)))
        return next((text for text in texts if text), "")
