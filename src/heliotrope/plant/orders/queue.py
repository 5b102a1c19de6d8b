"""Accepted commands in progress: their records, messages and results."""

import struct
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import islice

from heliotrope.errors import InputError
from heliotrope.files.disk import Disk, DiskBusyError, Work
from heliotrope.lcu import messages
from heliotrope.links.clock import Clock, sleep_until
from heliotrope.links.link import SendOutcome
from heliotrope.links.messages import (
    ClusterStatus,
    Command,
    Emergency,
    Parameters,
    Progress,
    Stage,
)
from heliotrope.plant.field.assigned import AssignedError
from heliotrope.plant.field.clusters import ClusterEnd, Clusters
from heliotrope.plant.field.part import Part
from heliotrope.plant.orders.audit import Audit, AuditError, Record
from heliotrope.plant.orders.authority import Authority, RefusedError
from heliotrope.plant.orders.stowing import StowQueue
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.plant.settings import PlantSettings
from heliotrope.safety import Act

#: Reports on a message are ignored this long after it was sent, if its ticket has ended, s.
FORGOTTEN = 60.0
#: Pause between repetitions of DEFOCUS and STOW to heliostats that have not acknowledged, s.
REPEAT = 1.0
#: Time after the end of a command's life within which a cluster may still report that the command
#: failed, s.
GRACE = 3.0
#: A command whose record is not on the disk within this time is not sent, s.
RECORDING = 2.0
#: Number of overdue records that are written together, and the time after which the remainder must
#: wait, s, because new commands wait behind them.
_BATCH, _TURN = 256, 0.5
#: Clusters receive a new token within this time, s.
_HEARD = 3.0
#: Commands that move nothing by themselves: an emergency does not overtake them.
_STILL = messages.POINTS | {"PARAMETERS"}
#: Reason for a command of which the cluster knows no more.
_LOST = "acknowledged, but the report of its end was lost, or the cluster restarted"
#: Time allowed at the end of the plant's run for the overdue records, s.
_LAST = 10.0


@dataclass
class _Under:
    """One message in transit.

    The message was issued with the token ``given`` and sent with the token ``token``; ``again``
    sends it again. ``acknowledged`` are the heliostats that have acknowledged this message.
    """

    ticket: Ticket
    cluster: str
    heliostats: tuple[str, ...]
    at: float
    given: int = 0
    token: int = 0
    again: Callable[[tuple[str, ...]], None] | None = None
    acknowledged: list[str] = field(default_factory=list)


@dataclass
class _Recording:
    """Records that must be on disk before the heliostats of a ticket are sent their command."""

    ticket: Ticket
    heliostats: tuple[str, ...]
    #: Writes the record of the ticket; None: it is already on disk.
    begin: Work | None
    #: Stores what the command assigns, after its record; the second reverts that.
    store: tuple[Work, Work] | None
    until: float
    send: Callable[[bool], None] | None = None
    begun: bool = False
    waited: bool = False
    error: Exception | None = None

    def write(self) -> None:
        """Write the record, then store what the command assigns."""
        if self.begin is not None:
            self.begin()
        self.begun = True
        if self.store is not None:
            self.store[0]()


class PlantOrders(Part):
    """Handles accepted commands: their records, their messages and their tickets.

    This part never waits for a disk. A command waits in the plant until its record is on disk
    (`when_recorded`); DEFOCUS and STOW do not wait, and overtake waiting commands.

    Parameters
    ----------
    clock
        Clock of the plant.
    authority
        Tokens of the commands; any accepted command removes heliostats from visits.
    audit
        Store of the records.
    disk
        Runs the work of the audit.
    clusters
        The clusters, whose links carry the messages.
    prefix
        Prefix of identities, unique to each run of a plant.
    settings
        The plant's ``lifetime``, ``patience`` and ``stow_rate``.
    sent
        Called with name, values and heliostats of each command that is sent, including DEFOCUS and
        STOW, with the time, and with whether it is a repetition.

    Attributes
    ----------
    clock, authority
        As given.
    confirmed_at
        Last time that the audit log confirmed that it can write, monotonic s.
    problem
        Why the audit log cannot write; empty if it can.
    latest
        Ticket of the last command; None before the first.
    last
        Record and ticket of the last command to each heliostat since start-up, by name.
    """

    def __init__(
        self,
        clock: Clock,
        authority: Authority,
        audit: Audit,
        disk: Disk,
        clusters: Clusters,
        prefix: str,
        settings: PlantSettings,
        sent: Callable[[str, tuple[float, ...], tuple[str, ...], float, bool], None],
    ) -> None:
        self._sent, self.authority = sent, authority
        self.clock, self._audit, self._disk, self._clusters = clock, audit, disk, clusters
        self._lifetime, self._patience = settings.lifetime, settings.patience
        self._prefix = prefix
        self._number = self._messages = 0
        self._open: dict[str, Ticket] = {}
        self.latest: Ticket | None = None
        self.last: dict[str, tuple[Record, Ticket]] = {}
        self._under: dict[str, _Under] = {}
        #: Messages that clusters refused because the token was outdated.
        self._again: list[tuple[_Under, tuple[str, ...]]] = []
        #: Identities of commands that are queued for the link to their cluster.
        self._unsent: set[str] = set()
        self._recording: dict[str, _Recording] = {}
        self._owed: deque[Work] = deque()
        self._paying = False
        self._sent_at: dict[str, float] = {}
        self._stowing = StowQueue(settings.stow_rate)
        self._purged_at = clock.monotonic()
        self.confirmed_at = clock.monotonic()
        self.problem = ""

    @property
    def open(self) -> tuple[Ticket, ...]:
        """Tickets that have not ended."""
        return tuple(self._open.values())

    @property
    def owing(self) -> bool:
        """Whether records wait to be written, and the audit accepted the last record."""
        return bool(self._owed) and not self.problem

    def accept(
        self,
        record: tuple[str, str, str],
        values: Sequence[float],
        heliostats: Sequence[str],
        note: str = "",
        *,
        late: bool = False,
        fault: bool = False,
        store: tuple[Work, Work] | None = None,
    ) -> Ticket:
        """Accept a command and hand its record to the disk; see `when_recorded`.

        Parameters
        ----------
        record
            Name and role of whoever issues it, and the command's name.
        values, heliostats, note
            For the record and the ticket.
        late
            Whether the record may be written later, as for DEFOCUS and STOW, which wait for
            nothing.
        fault
            Whether the heliostats caused the order; see `Mandate.take_out`.
        store
            Disk work that stores what the command assigns, in the same write as its record, and
            disk work that reverts it if the command is not sent in the end.

        Raises
        ------
        AuditError
            If it is already known that the record cannot be written, and it may not be ``late``.
        """
        self._number += 1
        who, role, what = record
        identity = f"{self._prefix}-{self._number}"
        named = () if len(heliostats) == len(self._clusters) else tuple(heliostats)
        entry = Record(identity, who, role, what, self._utc(), tuple(values), named, note)
        ticket = Ticket(identity, what, heliostats, self.clock, self._patience)
        if late:
            self._overtake(frozenset(heliostats), what)
            why = f"{who} ordered {what}{note and f' ({note})'}"
            self.authority.prevail(heliostats, why, fault=fault)
            self._owed.append(lambda: self._audit.begin(entry))
        else:
            self._record(ticket, entry, store)
        self._open[identity] = self.latest = ticket
        self.last.update(dict.fromkeys(heliostats, (entry, ticket)))
        return ticket

    def _record(self, ticket: Ticket, entry: Record, store: tuple[Work, Work] | None) -> None:
        """Hand the record of a ticket to the disk."""
        begin, until = partial(self._audit.begin, entry), self.clock.monotonic() + RECORDING
        recording = _Recording(ticket, ticket.heliostats, begin, store, until)
        try:
            self._write(ticket.identity, recording)
        except DiskBusyError as error:
            raise AuditError(f"audit: {error}") from None
        if recording.error is not None and not recording.begun:
            raise recording.error

    def when_stored(
        self,
        ticket: Ticket,
        heliostats: tuple[str, ...],
        store: tuple[Work, Work],
        send: Callable[[bool], None],
    ) -> None:
        """Call ``send`` once the points that a recorded command assigns are on disk.

        See `when_recorded`; ``store`` is as in `accept`.
        """
        until, self._messages = self.clock.monotonic() + RECORDING, self._messages + 1
        recording = _Recording(ticket, heliostats, None, store, until, send)
        try:
            self._write(f"{ticket.identity}.{self._messages}", recording)
        except DiskBusyError as error:
            ticket.advance(heliostats, Stage.REFUSED, f"not sent: {error}")

    def _write(self, key: str, recording: _Recording) -> None:
        """Write the records that must be on disk before a command is sent."""
        self._recording[key] = recording
        try:
            self._disk.do(recording.write, partial(self._recorded, key, recording))
        except DiskBusyError:
            del self._recording[key]
            raise
        recording.waited = True

    def _recorded(self, key: str, recording: _Recording, error: Exception | None) -> None:
        """Send a command whose record is on disk; end the command if recording failed."""
        ticket, heliostats = recording.ticket, recording.heliostats
        self._give_up_late(recording, self.clock.monotonic())
        del self._recording[key]
        recording.error = error
        if recording.begun:
            self.confirmed_at = self.clock.monotonic()
        if error is None:
            if ticket.waiting(heliostats):
                ticket.record()
                if recording.send is not None:
                    self._send_recorded(recording, recording.send)
            elif recording.store is not None:
                self._owed.append(recording.store[1])
        elif recording.begun:
            text = f"not sent, because it cannot be stored: {error}"
            ticket.advance(heliostats, Stage.REFUSED, text)
        elif ticket.identity in self._open and recording.begin is not None:
            text = f"not sent, because its record could not be written: {error}"
            ticket.advance(heliostats, Stage.REFUSED, text)
            # It was accepted, so its record is written as soon as the disk allows.
            self._owed.append(recording.begin)

    def _send_recorded(self, recording: _Recording, send: Callable[[bool], None]) -> None:
        """Send a command that waited for its record, unless it may no longer be sent."""
        try:
            send(recording.waited)
        except Exception as error:
            stage = Stage.REFUSED if isinstance(error, RefusedError) else Stage.FAILED
            recording.ticket.advance(recording.heliostats, stage, f"not sent: {error}")
            if recording.store is not None:
                self._owed.append(recording.store[1])
            if not isinstance(error, RefusedError):
                raise

    @staticmethod
    def _give_up_late(recording: _Recording, now: float) -> None:
        if now > recording.until:
            text = f"not sent, because its record was not written to disk within {RECORDING:g} s"
            recording.ticket.advance(recording.heliostats, Stage.REFUSED, text)

    def when_recorded(self, ticket: Ticket, send: Callable[[bool], None]) -> None:
        """Call ``send`` once the ticket's record is on disk; do not call it if that takes too long.

        The argument of ``send`` is whether the command had to wait. If so, all checks made when it
        was accepted must be repeated, and heliostats that have ended in the meantime
        (`Ticket.waiting`) are left out. It may raise `RefusedError`, which ends the ticket.
        """
        recording = self._recording.get(ticket.identity)
        if recording is not None:
            recording.send = send
        elif ticket.recorded:
            send(False)

    def unstored(self, name: str) -> frozenset[str]:
        """Return the heliostats whose command of a given name waits for the disk."""
        waiting = (r for r in self._recording.values() if r.ticket.name == name)
        return frozenset(each for r in waiting for each in r.heliostats)

    def _overtake(self, heliostats: frozenset[str], what: str) -> None:
        """Abandon commands that wait for their records or for the link to their cluster.

        No such command may follow DEFOCUS, STOW or LOCK.
        """
        for recording in self._recording.values():
            ticket = recording.ticket
            if ticket.name not in _STILL:
                names = [name for name in recording.heliostats if name in heliostats]
                ticket.advance(names, Stage.REFUSED, f"not sent, because {what} came first")
        for identity in self._unsent:
            under = self._under.get(identity)
            if under is not None and under.ticket.name not in _STILL:
                names = [name for name in under.heliostats if name in heliostats]
                under.ticket.advance(names, Stage.FAILED, f"not sent, because {what} came first")

    def note(self, who: str, role: str, what: str, note: str) -> None:
        """Record an action that is complete at once, such as a change of the command authority."""
        ticket = self.accept((who, role, what), (), (), note, late=True)
        del self._open[ticket.identity]
        self._owe_result(ticket.identity, "done")

    def owe(self, work: Work) -> None:
        """Hand work to the disk, to be done after the overdue records. The work may be repeated."""
        self._owed.append(work)

    def pay(self) -> None:
        """Hand the oldest overdue records to the disk, unless a batch is still being written."""
        if self._paying:
            return
        batch, done = tuple(islice(self._owed, _BATCH)), [0]

        def write() -> None:
            until = self.clock.monotonic() + _TURN
            for each in batch:
                done[0] += 1
                try:
                    each()
                except (AuditError, AssignedError):
                    done[0] -= 1  # it is retried, but not if it was refused because of its content
                    raise
                if self.clock.monotonic() >= until:
                    break
            self._audit.confirm()

        self._paying = True
        try:
            self._disk.do(write, lambda error: self._paid(done[0], error))
        except DiskBusyError as error:
            self._paying, self.problem = False, str(error)

    def _paid(self, count: int, error: Exception | None) -> None:
        self._paying = False
        for _ in range(count):
            self._owed.popleft()
        if error is None:
            self.confirmed_at, self.problem = self.clock.monotonic(), ""
            return
        self.problem = str(error)
        if not isinstance(error, AuditError | AssignedError):
            raise error

    # Sending.

    def command(
        self,
        ticket: Ticket,
        name: str,
        values: tuple[float, ...],
        heliostats: Iterable[str],
        token: int,
        lifetime: float | None = None,
        again: Callable[[tuple[str, ...]], None] | None = None,
    ) -> None:
        """Send a command to some heliostats of a ticket.

        It is sent again if a cluster refuses it because the command authority has just changed.

        Parameters
        ----------
        ticket, name, values, heliostats
            The ticket, and the command.
        token
            Token of the authority holder or of a mandate.
        lifetime
            Replaces the default lifetime, s.
        again
            Function that sends the command to some heliostats again; None: it is sent again at
            once, unchanged.
        """
        heliostats = tuple(heliostats)

        def repeat(names: tuple[str, ...]) -> None:
            self.command(ticket, name, values, names, token, lifetime)

        if name == "LOCK":
            for other, names in self._stowing.take(heliostats).items():
                other.advance(names, Stage.FAILED, "superseded by LOCK")
        self._sent(name, values, heliostats, self.clock.monotonic(), False)
        life = self._lifetime if lifetime is None else lifetime
        for end, part in self._clusters.parts(heliostats):
            identity = self._begin(ticket, end, part)
            self._repeated(identity, token, again or repeat)
            self._unsent.add(identity)

            def message(
                identity: str = identity, end: ClusterEnd = end, part: tuple[str, ...] = part
            ) -> Command | None:
                self._unsent.discard(identity)
                left = ticket.waiting(part)  # without those overtaken by DEFOCUS or STOW
                named = () if len(left) == len(end.members) else left
                own = self._own(identity, token) if left else 0
                return Command(identity, name, values, named, own, life) if own else None

            end.post(message, life, self._told(identity))

    def emergency(
        self, ticket: Ticket, act: Act, heliostats: Sequence[str], *, again: bool = False
    ) -> None:
        """Send DEFOCUS or STOW before everything that has not been sent yet.

        A repetition (``again``) does not extend the deadline for acknowledgement.
        """
        if not again:
            for other, names in self._stowing.take(heliostats).items():
                if other is not ticket:
                    other.advance(names, Stage.FAILED, f"superseded by {ticket.name}")
            self._supersede(ticket, frozenset(heliostats))
        # Further portions of a STOW must not delay the repetition of the first.
        self._sent_at.setdefault(ticket.identity, self.clock.monotonic())
        self._sent(act.name, (), tuple(heliostats), self.clock.monotonic(), again)
        for end, part in self._clusters.parts(heliostats):
            identity = self._begin(ticket, end, part, again=again)
            named = () if len(part) == len(end.members) else part
            end.post(Emergency(identity, act.name, named), None, self._told(identity), urgent=True)

    def stow_in_turn(self, ticket: Ticket, heliostats: Sequence[str]) -> None:
        """Send STOW to heliostats in portions.

        Their earlier orders are repeated until it is their turn. If `emergency` sends an order in
        the meantime, that order goes at once and replaces this one.
        """
        if not self._stowing.staggers(heliostats):
            self.emergency(ticket, Act.STOW, heliostats)
            return
        now = self.clock.monotonic()
        self._sent_at[ticket.identity] = now
        for other, names in self._stowing.put(ticket, heliostats).items():
            other.advance(names, Stage.FAILED, f"superseded by {ticket.name}")
        self._stow(self._stowing.due(now))

    def to_stow(self, heliostat: str) -> bool:
        """Whether a heliostat waits for its turn to go to stow, and must not move elsewhere."""
        return heliostat in self._stowing

    def _stow(self, parts: Mapping[Ticket, Sequence[str]]) -> None:
        for ticket, names in parts.items():
            self.emergency(ticket, Act.STOW, ticket.waiting(names))

    def repeat(self, ticket: Ticket, act: Act, heliostats: Sequence[str]) -> None:
        """Send DEFOCUS or STOW again to the heliostats whose clusters are connected."""
        left = self._clusters.connected(heliostats)
        if left:
            self.emergency(ticket, act, left, again=True)

    def _supersede(self, ticket: Ticket, heliostats: frozenset[str]) -> None:
        """End older repeated orders to the same heliostats.

        A DEFOCUS does not end a STOW.
        """
        for identity in self._sent_at:
            other = self._open.get(identity)
            if other is not None and other is not ticket and Act[other.name] <= Act[ticket.name]:
                left = [name for name in other.unacknowledged() if name in heliostats]
                other.advance(left, Stage.FAILED, f"superseded by {ticket.name}")

    def parameters(
        self, ticket: Ticket, heliostat: str, items: Mapping[str, bytes], token: int
    ) -> None:
        """Send items of one heliostat."""

        def repeat(names: tuple[str, ...]) -> None:
            if names:
                self.parameters(ticket, heliostat, items, token)

        for end, part in self._clusters.parts([heliostat]):
            identity = self._begin(ticket, end, part)
            self._repeated(identity, token, repeat)
            life = Parameters.lifetime
            ticket.expect(part, self.clock.monotonic() + life + GRACE)

            def message(identity: str = identity) -> Parameters | None:
                own = self._own(identity, token)
                return Parameters.of(identity, heliostat, items, own) if own else None

            end.post(message, life, self._told(identity))

    def _begin(
        self, ticket: Ticket, end: ClusterEnd, part: tuple[str, ...], *, again: bool = False
    ) -> str:
        now = self.clock.monotonic()
        self._messages += 1
        identity = f"{ticket.identity}.{self._messages}"
        self._under[identity] = _Under(ticket, end.name, part, now)
        if not again:
            ticket.expect(part, now + self._lifetime + GRACE)
        return identity

    def _repeated(
        self, identity: str, token: int, again: Callable[[tuple[str, ...]], None]
    ) -> None:
        """Note how a message is sent again."""
        self._under[identity].given, self._under[identity].again = token, again

    def _own(self, identity: str, token: int) -> int:
        """Return the token with which a message is sent now; 0 if it may no longer be sent."""
        own = self.authority.present(token)
        if own and identity in self._under:
            self._under[identity].token, self._under[identity].ticket.sent = own, True
        return own

    def _told(self, identity: str) -> Callable[[SendOutcome], None]:
        def told(outcome: SendOutcome) -> None:
            under = self._under.get(identity)
            # DEFOCUS and STOW are repeated until they are acknowledged.
            if under is None or outcome is SendOutcome.SENT or under.ticket.name in messages.SAFE:
                return
            text = f"cluster {under.cluster}: {outcome.value}"
            under.ticket.advance(under.heliostats, Stage.FAILED, text)

        return told

    # Reports of clusters.

    def take(self, cluster: str, progress: Progress) -> tuple[Ticket, tuple[str, ...]] | None:
        """Handle a cluster's report; return its ticket and heliostats; None if it is unknown."""
        under = self._under.get(progress.identity)
        if under is None or under.cluster != cluster:
            return None
        mine = set(under.heliostats)
        part = tuple(name for name in progress.heliostats if name in mine)
        # A report without heliostats is about all of them.
        part = part if progress.heliostats else under.heliostats
        if self._crossed(under, progress.stage):
            waiting = set(under.ticket.unacknowledged())
            early = tuple(name for name in part if name in waiting)
            self._again.append((under, early))
            part = tuple(name for name in part if name not in early)
        if progress.stage is Stage.ACKNOWLEDGED:
            under.acknowledged.extend(part)
        under.ticket.advance(part, progress.stage, progress.text)
        return under.ticket, part

    def _crossed(self, under: _Under, stage: Stage) -> bool:
        """Whether a message and a change of the command authority may have crossed in transit.

        The cluster may then have refused the message's token although the message is valid
        otherwise. A command that failed may have been carried out, so an operator's command is sent
        again only if it was refused. A command of an earlier authority holder is never sent again.
        """
        mandated = self.authority.mandate_of(under.given) is not None
        if stage is not Stage.REFUSED and not (mandated and stage is Stage.FAILED):
            return False
        own = self.authority.present(under.given)
        if under.again is None or own == 0 or own != self.authority.token:
            return False
        young = self.clock.monotonic() - self.authority.changed_at < _HEARD
        return young or under.token != own

    def on_status(self, cluster: str, status: ClusterStatus, now: float) -> None:
        """End acknowledged commands that a cluster no longer lists.

        The cluster has restarted, or its report of the end was lost.
        """
        del now
        if not status.commands_listed:
            return
        listed = set(status.commands)
        for identity, under in self._under.items():
            if under.cluster == cluster and identity not in listed:
                under.ticket.advance(under.acknowledged, Stage.FAILED, _LOST)

    def on_beat(self, now: float) -> None:
        """End commands without a reply in time; record the results of ended tickets."""
        for recording in self._recording.values():
            self._give_up_late(recording, now)
        self._stow(self._stowing.due(now))
        crossed, self._again = self._again, []
        for under, names in crossed:
            if under.again is not None and (left := under.ticket.waiting(names)):
                under.again(left)
        ended = []
        for identity, ticket in self._open.items():
            ticket.expire(now)
            if ticket.finished and identity not in self._recording:
                ended.append(identity)
                unsent = "" if ticket.sent or ticket.name in messages.SAFE else "not sent: "
                self._owe_result(identity, f"{unsent}{ticket.text}")
        for identity in ended:
            del self._open[identity]
        self._repeat(now)
        if now - self._purged_at >= FORGOTTEN:
            self._purged_at = now
            self._under = {
                key: u
                for key, u in self._under.items()
                if u.ticket.identity in self._open or now - u.at < FORGOTTEN
            }

    def _repeat(self, now: float) -> None:
        """Send DEFOCUS and STOW again to heliostats that have not acknowledged them."""
        for identity, at in list(self._sent_at.items()):
            ticket = self._open.get(identity)
            if ticket is None:
                del self._sent_at[identity]
            elif now - at >= REPEAT:
                self._sent_at[identity] = now
                left = [name for name in ticket.unacknowledged() if name not in self._stowing]
                self.repeat(ticket, Act[ticket.name], left)

    async def end(self, now: float) -> None:
        """Record the state of every open ticket at the end of the plant's run."""
        until = now + _LAST
        for recording in self._recording.values():
            text = "not sent, because the plant was shut down"
            recording.ticket.advance(recording.heliostats, Stage.REFUSED, text)
        self.on_beat(now)
        await self._until(lambda: not self._recording, until)
        for identity, ticket in self._open.items():
            if identity not in self._recording:
                self._owe_result(identity, f"{ticket.text}; then the plant was shut down")
        self._open.clear()
        self.problem = ""
        self.pay()
        await self._until(self._settled, until)

    def _settled(self) -> bool:
        """Return whether no overdue record can be written now; start the next batch.

        That is so if all are written, or if the last attempt failed.
        """
        if self.owing:
            self.pay()
        return not (self._paying or self.owing)

    async def _until(self, what: Callable[[], bool], until: float) -> None:
        while not what() and self.clock.monotonic() < until:
            await sleep_until(self.clock, self.clock.monotonic() + 0.05)

    def _owe_result(self, identity: str, result: str) -> None:
        at = self._utc()
        self._owed.append(lambda: self._audit.finish(identity, result, at))

    def _utc(self) -> str:
        return self.clock.utc().isoformat(timespec="milliseconds")


def whole(values: Sequence[float], codes: str, command: str) -> tuple[float, ...]:
    """Return a command's numbers in the form in which the wire carries them.

    Raises
    ------
    InputError
        If there are too many or too few numbers, or a number is out of range.
    """
    if len(values) != len(codes):
        raise InputError(
            f"{command}: got {len(values)} numbers, but the command takes {len(codes)}"
        )
    checked: list[float] = [
        int(v) if code not in "fd" and float(v).is_integer() else v
        for v, code in zip(values, codes, strict=True)
    ]
    try:
        data = struct.pack("<" + codes, *checked)
    except (struct.error, OverflowError) as error:
        raise InputError(f"{command}: {tuple(values)} cannot be sent: {error}") from None
    if not all(abs(v) < float("inf") for v in struct.unpack("<" + codes, data)):
        raise InputError(f"{command}: {tuple(values)} cannot be sent; specify finite numbers")
    return tuple(float(v) for v in values)
