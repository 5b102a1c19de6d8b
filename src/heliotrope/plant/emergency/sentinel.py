"""The plant's own safety actions: evaluate the table, order, repeat, confirm.

A field-wide emergency begins when the table requires DEFOCUS or STOW of the field, or when a person
orders it. It ends when the causes have gone and are acknowledged, and all orders are withdrawn.
"""

import contextlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from heliotrope.lcu import messages, states
from heliotrope.lcu import names as meanings
from heliotrope.links.clock import Clock
from heliotrope.links.messages import Stage
from heliotrope.mechanism.drives import Drive
from heliotrope.plant.emergency.callers import Callers
from heliotrope.plant.emergency.order import (
    EmergencyOrder,
    switched_off,
)
from heliotrope.plant.emergency.standing import Call, EmergencyRecord, Standing, read_standing
from heliotrope.plant.emergency.table import ORDERED, TableWatch
from heliotrope.plant.field.drive_checks import DriveChecks
from heliotrope.plant.field.identity import Identities
from heliotrope.plant.field.part import Part
from heliotrope.plant.motion.watch import BeamWatch
from heliotrope.plant.orders.joining import JoinQueue
from heliotrope.plant.orders.queue import PlantOrders
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.safety import FLUX_READING, AcknowledgeRole, Act, Alarm
from heliotrope.store.records import StoreError

#: Time within which the reports of a heliostat that was ordered off the receiver must show that it
#: has left, s.
OFF_SHOWS = 10.0
#: Longest pause between two orders to one heliostat whose reports do not show them, s.
LONGEST_PAUSE = 60.0
#: Row for heliostats that were not confirmed to have carried out an emergency order.
UNPROVEN = "unproven_after_emergency"
#: Time for which the safety table is told that a heliostat has been confirmed after its emergency,
#: s.
_PROVEN_SHOWS = 5.0
#: Interval between two records of a proof in progress, s.
_KEEP_PERIOD = 1.0
#: Name and role of the safety table in a record.
_TABLE = ("safety table", "plant")
#: Name and role in the record of an emergency that a new program continues, because nobody orders
#: it then.
_AGAIN = ("plant", "plant")
#: Name and role of the night in a record.
_NIGHT = ("the sun is down", "plant")


class Sentinel(Part):
    """Acts on the safety table, and follows every emergency until all heliostats have obeyed.

    Parameters
    ----------
    table
        The plant's rows of the safety table.
    orders, joining, watch
        Parts of the plant.
    repeat
        Pause between repetitions of an order, s.
    identities
        Heliostats that do not match their address: they must leave, and are never confirmed.
    drive_checks
        Heliostats whose drives stall, which are never confirmed; it also supplies today's evidence
        that mirrors follow their drives.
    record
        Store of the active emergency: if an emergency was active when the last program ended, the
        plant starts in it. None: it is lost when the program ends.

    Attributes
    ----------
    table
        As given.
    order
        The last field-wide order; None before the first.
    on
        Whether a field-wide emergency is active.
    night
        Why the field rests at stow although nothing is wrong; "" by day.
    """

    def __init__(
        self,
        table: TableWatch,
        orders: PlantOrders,
        joining: JoinQueue,
        watch: BeamWatch,
        repeat: float,
        identities: Identities,
        drive_checks: DriveChecks,
        record: EmergencyRecord | None = None,
    ) -> None:
        clock, field = orders.clock, watch.proofs.field
        self.order: EmergencyOrder | None = None
        self.on = False
        self.night: str | None = None
        self._record, self._kept_at = record, -math.inf
        self._kept = self._recalled = Standing() if record is None else _recall(record)
        self._callers = Callers(self._recalled.calls)
        #: Heliostats that an emergency left unconfirmed, and when each was confirmed, monotonic s.
        unproven = set() if self._recalled.act else set(self._recalled.unproven) & set(field.names)
        self._unproven = dict.fromkeys(sorted(unproven), math.inf)
        #: The previous program's order, which these heliostats were not shown to have carried out;
        #: reports from now on may show it.
        self._before = _left_order(self._recalled, tuple(self._unproven), clock)
        known = {"", *field.names, *field.clusters}
        table.recall(row for row in self._recalled.rows if row[1] in known)
        self._clock, self.table, self._field = clock, table, field
        self._orders, self._joining, self._watch = orders, joining, watch
        self._repeat, self._identities = repeat, identities
        self._drive_checks = drive_checks
        #: The strongest act that each cluster was sent as a whole, while the act is in force.
        self._acts: dict[str, Act] = {}
        #: Orders to single heliostats while their rows are tripped: number, and time of the next
        #: order.
        self._tries: dict[str, tuple[int, float]] = {}
        self._repeated_at = -math.inf
        #: Alarms about orders since the last beat.
        self._news: list[Alarm] = []

    # -- the table -------------------------------------------------------------------------

    def on_beat(self, now: float) -> None:
        """Evaluate the table, take the required actions, and report the alarms."""
        self._unproven = {n: at for n, at in self._unproven.items() if now - at < _PROVEN_SHOWS}
        news, self._news = self._news + self._evaluate(now), []
        self._obey_field(now)
        self._obey_night()
        self._obey_clusters()
        self._obey_heliostats(now)
        self._keep(now)
        for alarm in news:
            self.table.tell(alarm)

    def _evaluate(self, now: float) -> list[Alarm]:
        proof = self.order.proof if self.on and self.order is not None else None
        return self.table.evaluate(proof, self._unproven, called=bool(self.calls), now=now)

    def _obey_field(self, now: float) -> None:
        demanded, caused = self.table.demanded(), self.table.caused()
        order = self.order
        # A consequence of an emergency may make it worse but must not begin one, which would never
        # end.
        if demanded is not None and demanded >= Act.DEFOCUS and (caused or self.on):
            if not self.on or order is None or demanded > order.act:
                self._begin_again(demanded)
            elif now - self._repeated_at >= self._repeat:
                self._repeat_order(self._field.clusters)
        if not caused and self.on:
            self.on = False
            self._unproven = dict.fromkeys(self._not_done(), math.inf)
        if demanded is not None and demanded >= Act.HOLD:
            self._joining.drop(self.table.reasons(Act.HOLD))

    def _obey_night(self) -> None:
        """Send the field to stow at sunset, one heliostat after the other, by an ordinary STOW."""
        before, self.night = self.night, self.table.night()
        if self.night and not before:
            self._joining.drop(self.night)
            self.send_safe(_NIGHT, Act.STOW, self._field.names, self.night, in_turn=True)

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
                self._watch.proofs.ledger.follows_loss(members)

    def _obey_heliostats(self, now: float) -> None:
        """Order heliostats off, and repeat the order until no row of the table requires it.

        A heliostat that has just been ordered off is given time to report that it obeys. There is
        no such wait if DEFOCUS has already turned it away: its beam then stays where it may not be
        until the heliostat is stowed.
        """
        ordered_off = {**self.table.off(), **self._identities.off(now)}
        self._tries = {name: tried for name, tried in self._tries.items() if name in ordered_off}
        just_sent = self._watch.proofs.ledger.sent_since(messages.SAFE, now - OFF_SHOWS)
        sent: dict[Act, dict[str, str]] = {}
        for name, (act, text) in ordered_off.items():
            tries, due = self._tries.get(name, (0, -math.inf))
            waits = just_sent[self._field.index[name]] and not self._watch.turned(name)
            if now < due or waits:
                continue
            self._tries[name] = tries + 1, now + min(OFF_SHOWS * 2**tries, LONGEST_PAUSE)
            best = self._watch.order_out(name, again=tries > 0)
            if self._proving is not None and (self.on or name in self._unproven):
                best = max(best, self._proving.act)
            sent.setdefault(max(act, best), {})[name] = text
        for act, texts in sent.items():
            why = "; ".join([*texts.values()][:3])
            self._joining.drop(why, frozenset(texts))
            self.send_safe(_TABLE, act, tuple(texts), why)

    # -- orders ----------------------------------------------------------------------------

    def _begin_again(self, act: Act) -> None:
        """Order the action that the table requires, or continue an earlier program's emergency."""
        before, self._recalled = self._recalled, Standing()
        if before.act:
            self._begin(max(act, Act[before.act]), _AGAIN, before.continued, before.giver)
        else:
            self._begin(act, _TABLE, _said(self.causes()))

    def _begin(
        self, act: Act, giver: tuple[str, str], reason: str, who: str = ""
    ) -> EmergencyOrder:
        """Order DEFOCUS or STOW of the whole field; ``giver`` is a name and a role for the record.

        If this order continues an earlier order, ``who`` gave the earlier order.
        """
        now, names = self._clock.monotonic(), self._field.names
        ticket = self._orders.accept((*giver, act.name), (), names, reason, late=True)
        measured = self.table.flux_measured
        first = who or giver[0]
        self.order = EmergencyOrder(act, first, reason, now, ticket, flux_measured=measured)
        self.on, self._repeated_at = True, now
        self._unproven = {}
        self._orders.emergency(ticket, act, names)
        self._joining.drop(f"{act.name} of the field: {reason}")
        return self.order

    @property
    def _proving(self) -> EmergencyOrder | None:
        """The order that reports now confirm: the last order, or the previous program's order."""
        return self.order or self._before

    @property
    def calls(self) -> tuple[Call, ...]:
        """The orders that have not been withdrawn, one per person."""
        return self._callers.calls

    def causes(self) -> dict[str, str]:
        """Return the reasons for the emergency, by person with an active order, and by table row.

        The result is empty if no emergency is active.
        """
        causes = {call.who: call.reason for call in self.calls}
        withdrawn = "" if causes else self.table.withdrawn()
        rows = self.table.reasons(Act.DEFOCUS, but=ORDERED)
        if text := "; ".join(filter(None, (withdrawn, rows))):
            causes[_TABLE[0]] = text
        return causes

    def ends_by(self, condition: str) -> bool:
        """Return whether only one table row, whose cause has gone, keeps the emergency active."""
        return self.on and not self.calls and not self.table.caused(but=condition)

    def call(self, who: str, act: Act, reason: str, at: float) -> EmergencyOrder:
        """Order an emergency for a person; it stays active until it is withdrawn.

        A person has one order. A further order keeps the stronger action and adds a new reason; an
        identical order merges with the active one.

        Raises
        ------
        RefusedError
            See `Callers.take`.
        """
        first = who not in {call.who for call in self.calls}
        new = self._callers.take(who, act, reason, at, self._clock.monotonic())
        if not self.on or self.order is None or act > self.order.act:
            order = self._begin(act, (who, "anybody"), reason)
        else:
            order = self.order
            if new:
                self._orders.note(
                    who, "anybody", act.name, f"{reason}; this act is already in force"
                )
        if first:  # its row trips now, even if the order is withdrawn before the next beat
            self._news += self._evaluate(self._clock.monotonic())
        self._keep(order.at)
        return order

    def pause(self, who: str) -> float:
        """Return the time until a person's next order is accepted, s; 0 if it is accepted now."""
        return self._callers.pause(who, self._clock.monotonic())

    def withdraw(self, who: str, by: str) -> str:
        """Withdraw one person's order; the rows that it tripped still need acknowledgement.

        Returns
        -------
        What the operator should know about the withdrawal; see `Callers.withdraw`.
        """
        now = self._clock.monotonic()
        told = self._callers.withdraw(who, by, now)
        self._keep(now)
        return told

    def _keep(self, now: float) -> None:
        """Store the emergency for the next program.

        While only the set of unconfirmed heliostats changes, it is stored at intervals.
        """
        if self._record is None or (self._recalled.act and not self.on):
            return
        standing = self._standing()
        changed = replace(standing, unproven=()) != replace(self._kept, unproven=())
        if standing == self._kept or not (changed or now - self._kept_at >= _KEEP_PERIOD):
            return
        with contextlib.suppress(StoreError):  # it is retried, and the store's alarm says why
            self._record.keep_emergency(standing.document)
            self._kept, self._kept_at = standing, now

    def _not_done(self) -> tuple[str, ...]:
        """Return the heliostats not confirmed to have carried out the last order."""
        order = self.order
        return () if order is None else tuple(sorted(order.proof.nodes - order.proof.done.keys()))

    def acknowledge(
        self, condition: str, who: str, role: AcknowledgeRole, subject: str
    ) -> str | None:
        """Acknowledge a row of the table; return why this is refused, or None if it is accepted."""
        refusal = self.table.acknowledge(condition, who, role, subject)
        if not refusal and condition == UNPROVEN:
            self._unproven.pop(subject, None)
        return refusal

    def _standing(self) -> Standing:
        order = self.order if self.on else None
        rows = self.table.standing()
        if order is None:
            unproven = tuple(sorted(name for name, at in self._unproven.items() if math.isinf(at)))
            left_by = self._proving.act.name if unproven and self._proving is not None else ""
            return Standing(calls=self.calls, rows=rows, unproven=unproven, left_by=left_by)
        unproven = self._not_done()
        return Standing(order.act.name, order.who, order.reason, self.calls, rows, unproven)

    def send_safe(
        self,
        giver: tuple[str, str],
        act: Act,
        heliostats: Sequence[str],
        note: str,
        *,
        in_turn: bool = False,
    ) -> Ticket:
        """Send DEFOCUS or STOW to some heliostats; ``giver`` is a name and a role.

        An ordinary STOW of many heliostats goes ``in_turn``, but at once while an emergency is
        active.
        """
        # Short of an emergency, the table orders off heliostats with a problem.
        ticket = self._orders.accept(
            (*giver, act.name), (), heliostats, note, late=True, fault=giver is _TABLE
        )
        if in_turn and act is Act.STOW and not self.on:
            self._orders.stow_in_turn(ticket, heliostats)
        else:
            self._orders.emergency(ticket, act, heliostats)
        return ticket

    def on_connected(self, cluster: str, now: float) -> None:
        """Send the missed order to a cluster that has reconnected."""
        del now
        self._acts.pop(cluster, None)
        self._repeat_order([cluster])

    def _repeat_order(self, clusters: Iterable[str]) -> None:
        """Send the order again to heliostats that have not acknowledged it, while it is in force.

        While its ticket is open, `PlantOrders` repeats it like any other order.
        """
        order = self.order
        if order is None or not self.on or not order.ticket.finished:
            return
        self._repeated_at = self._clock.monotonic()
        members = [name for cluster in clusters for name in self._field.members[cluster]]
        self._orders.repeat(order.ticket, order.act, order.unacknowledged(tuple(members)))

    # -- proof -----------------------------------------------------------------------------

    def put(self, name: str, value: float, at: float, subject: str = "") -> None:
        """Accept a sensor reading for the table, or for the proof; see `TableWatch.put`."""
        self.table.put(name, value, at, subject)
        if name == FLUX_READING and self.order is not None:
            self.order.take_flux(value, at)

    def on_stage(
        self, ticket: Ticket, heliostats: tuple[str, ...], stage: Stage, now: float
    ) -> None:
        """Accept a cluster's report on a ticket, if the ticket belongs to the order.

        If the plant has receivers, a cluster's report that the order is done counts only as an
        acknowledgement; whether the beam is off follows from the step counts in the next status,
        which show where it went.
        """
        order = self.order
        if order is None or ticket is not order.ticket:
            return
        if stage is Stage.DONE:
            flags = self._field.rows["flags"]
            good = (flags & meanings.COUNTS_UNKNOWN == 0) & ~switched_off(flags)
            heliostats = tuple(
                n for n in heliostats if good[self._field.index[n]] and not self._doubted(n)
            )
            if self._watch.stray.watches:
                stage = Stage.ACKNOWLEDGED
        order.take_stage(heliostats, stage, now)

    def on_rows(self, cluster: str, now: float) -> None:
        """Update, from a cluster's new status, how far the order has been carried out."""
        order, names = self._proving, self._field.members[cluster]
        if not self.on:
            names = tuple(name for name in names if name in self._unproven)
        if order is None or not names:
            return
        if self.on:
            self._order_again(order, names)
        rows = [self._field.index[n] for n in names if not order.is_done(n)]
        if rows:
            index = np.array(rows, dtype=np.intp)
            shining = self._watch.stray.on_receiver(index)
            order.take_rows(
                tuple(self._field.names[r] for r in rows),
                self._field.rows[index],
                self._field.heard[index],
                self._field.counted_at[index],
                Drive(self._watch.proofs.paths.check.drives.table[index]),
                now,
                np.array([bool(self._doubted(self._field.names[r])) for r in rows]),
                shining,
            )
        for row, shines in zip(rows, shining if rows else (), strict=True):
            name = self._field.names[row]
            if int(self._field.rows["flags"][row]) & meanings.COUNTS_UNKNOWN:
                order.unknown[name] = self._last_of(row, now)
            elif switched_off(self._field.rows["flags"][row]):
                order.unknown[name] = (
                    f"{name}: its drives were switched off at the heliostat while it was not at "
                    f"stow, so its beam is not proven to be off the receiver"
                )
            elif not order.is_done(name) and (text := self._doubted(name)):
                order.unknown[name] = (
                    f"{name}: {text}, so its reports cannot prove that its beam is off the receiver"
                )
            elif shines:
                order.unknown[name] = (
                    f"{name}: it reports {states.STATES[self._field.rows['state'][row]]}, but by "
                    "its step counts its beam is on a receiver"
                )
            else:
                order.unknown.pop(name, None)

        for name in () if self.on else names:
            if order.is_done(name):
                self._unproven[name] = min(self._unproven[name], now)

    def _doubted(self, heliostat: str) -> str | None:
        """Return why a heliostat's reports do not reveal where its beam is; None if they do."""
        untrusted = self._identities.untrusted(heliostat)
        return untrusted or self._drive_checks.stalled.get(heliostat)

    def _order_again(self, order: EmergencyOrder, names: tuple[str, ...]) -> None:
        """Order off again the heliostats that have come back while the emergency is active."""
        index = np.array([self._field.index[name] for name in names], dtype=np.intp)
        back = order.take_back(names, self._field.rows[index], self._field.heard[index])
        if back:
            self.send_safe(
                _TABLE, order.act, back, "the heliostat came back online during an emergency"
            )

    def _last_of(self, row: int, now: float) -> str:
        """Return, in words, where a heliostat with unknown step counts was last reported."""
        field, points = self._field, self._watch.proofs.points
        text = (
            f"{field.names[row]}: its step counts are unknown, so its beam is not proven to be "
            f"off the receiver; "
        )
        if not math.isfinite(field.posed_at[row]):
            return text + "the position of its beam is unknown"
        state = int(field.posed_state[row])
        on_aim = state in states.ON_AIM
        place = (points.aims if on_aim else points.standbys)[row]
        out = state in states.BEAM_OUT and np.isfinite(place).all()
        beam = f" with its beam at ({', '.join(f'{x:.1f}' for x in place)}) m" if out else ""
        return text + f"{now - field.posed_at[row]:.0f} s ago it was {states.STATES[state]}{beam}"

    def refusal(self, clusters: Iterable[str]) -> str | None:
        """Return the reason that forbids new motion in some clusters; None if motion is allowed."""
        if self.on and self.order is not None:
            return f"an emergency is active ({self.order.act.name}; {_said(self.causes())})"
        texts = (self.table.reasons(Act.REFUSE_NEW, name) for name in sorted(set(clusters)))
        return next((text for text in texts if text), None)


def _said(causes: Mapping[str, str]) -> str:
    """Return the causes of an emergency in one line."""
    return "; ".join(f"{who}: {reason}" for who, reason in causes.items())


def _left_order(before: Standing, unproven: tuple[str, ...], clock: Clock) -> EmergencyOrder | None:
    """Return the order that heliostats have yet to confirm after a restart; None if none."""
    if not unproven:
        return None
    ticket = Ticket("", before.left_by, unproven, clock, math.inf)
    now = clock.monotonic()
    return EmergencyOrder(
        Act[before.left_by], before.who, before.reason, now, ticket, flux_measured=False
    )


def _recall(record: EmergencyRecord) -> Standing:
    """Return the emergency that was active when the previous program ended."""
    try:
        document = record.emergency()
    except StoreError as error:
        document = str(error)  # an invalid document is read as an emergency, which is the safe side
    return read_standing(document)
