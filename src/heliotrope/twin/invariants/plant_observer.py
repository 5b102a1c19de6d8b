"""The observer of the plant: its command authority, its records, its displayed values, and joining.

It works alongside one `twin.invariants.Observer` per cluster and, like them, trusts no report: it
knows the holder of the command authority from the operators who took it, the records from the disk,
a value's age from when the bus carried it, and the joining heliostats from the messages and the
boards, all in true time. It checks the plant's part of three invariants: 4 (authority), 10
(joining) and 11 (records, values and confirmations).
"""

from collections import Counter, deque
from collections.abc import Sequence
from itertools import islice

from heliotrope.lcu import states
from heliotrope.links.messages import Command, Emergency, Lease, Message, Parameters
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.automatic import AUTOMATIC
from heliotrope.plant.orders.authority import Person, Role
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.plant.settings import PlantSettings
from heliotrope.twin.invariants.invariants import Judge, Observer
from heliotrope.twin.records import RecordsDisk

#: A value may be shown as this much younger than it is, s: a status waits up to a second, may be in
#: transit for another second, and ages are rounded.
YOUNGER = 2.2
#: A record that may follow its command is stored within the first time, s. The plant's own order
#: waits for its turn no longer than the second time, s: the field joins sooner, even at one
#: heliostat every two seconds.
RECORD_WITHIN, TURN_WITHIN = 2.0, 60.0
#: An order to turn away that is repeated within this time is the same order, s.
MOMENT = 0.3
#: Time for which a cluster may accept a void token: until the last lease with that token has
#: arrived and expired, s.
VOID_WITHIN = 4.2
#: Leases sent to different clusters within this time count as simultaneous, s.
_AT_ONCE = 0.5
#: Words that a refusal contains for one reason and for no other.
ROLE_REASON, NOBODY_REASON = "but the command needs ", "nobody has it"
OTHER_REASON = "was not sent; take command first"
#: Longest time from posting a command to join to its execution, beyond its lifetime: in transit and
#: late on the bus; and the interval between looks at the boards, s.
LATE, LOOKS = 1.8, 0.5
#: States in which a heliostat may be confirmed as done.
_OFF = (
    states.DEFOCUSED,
    states.STOWING,
    states.STOWED,
    states.LOCKED,
    states.FAULT,
    states.UNCONFIGURED,
)
_OWN = ("plant", "safety table")
#: Ends of the names under which automatic control commands.
_UNTOLD = (AUTOMATIC.name, "out of service")
#: Commands that an operator may give, and commands that bring beams to the receiver. These are the
#: observer's own tables, so that an error in the plant's tables is found.
_OPERATORS = (
    "APPROACH", "IDLE", "TRACK", "REFOCUS", "LOCK", "UNLOCK", "AIM", "STANDBY", "LOCK_AIM",
    "SEARCH",
)  # fmt: skip
_JOINING = ("TRACK", "REFOCUS", "SEARCH")
#: Commands that move or hold a heliostat, and commands after which its owner keeps it.
_MOTIONS = ("APPROACH", "IDLE", "LOCK", *_JOINING)
_SETTINGS = ("LOCK_AIM", "ROUGH")


class PlantObserver(Judge):
    """Observes the plant.

    Parameters
    ----------
    start
        Origin of the times that it reports, s.
    disk
        Store that contains the records.
    settings
        Settings of the plant.
    clusters
        Observers of its clusters.
    automatic
        Whether automatic control is active alongside the operators.

    Attributes
    ----------
    old
        Invalid tokens, each with the time since which it has been invalid, s.
    """

    def __init__(
        self,
        start: float,
        disk: RecordsDisk,
        settings: PlantSettings,
        clusters: Sequence[Observer],
        *,
        automatic: bool = False,
    ) -> None:
        super().__init__(start)
        self.old: dict[int, float] = {}
        self._disk, self._settings = disk, settings
        self._clusters, self._automatic = clusters, automatic
        self._accounts = {a.name: a for cluster in clusters for a in cluster.accounts}
        self._holder: tuple[Person, int, float] | None = None
        self._granted_at = self._visited_at = float("-inf")
        self._from_nobody = False  # nobody had the authority when the holder took it
        #: When a command that was refused for other reasons may have renewed the authority.
        self._perhaps = float("-inf")
        self._accepted: Counter[tuple[str, str]] = Counter()
        self._recorded: Counter[tuple[str, str]] = Counter()
        self._counted_records = 0  # records already counted
        self._obeyed: dict[str, float] = {}
        self._taken: dict[str, float] = {}  # what the holder has commanded, and since when
        self._aimed: dict[str, float] = {}
        self._noted_at: dict[tuple[str, str], float] = {}
        self._following: dict[str, float] = {}  # tickets whose record may follow
        self._awaited: dict[str, tuple[float, str, str]] = {}  # tickets accepted on a slow disk
        #: The plant's own records without a message yet: since when, and when they last waited.
        self._own: dict[str, tuple[float, float]] = {}
        self._sent: set[str] = set()
        self._posted: deque[tuple[float, int]] = deque(maxlen=400)
        self._joined: deque[tuple[float, int]] = deque(maxlen=400)
        self._on: set[str] = set()
        self._true_counts: dict[str, deque[tuple[float, tuple[int, int]]]] = {
            name: deque(maxlen=64) for name in self._accounts
        }
        self._heard: dict[str, deque[tuple[float, int]]] = {
            name: deque(maxlen=64) for name in self._accounts
        }
        self._proved: set[tuple[str, str]] = set()
        self._hangs, self._hung_at = False, float("-inf")
        self._stands, self._stood_at = False, float("-inf")

    # -- authority -------------------------------------------------------------------------

    def _live(self, now: float) -> tuple[Person, int, float] | None:
        """Return the holder of the command authority; authority that is not renewed ends."""
        holder = self._holder
        if holder is not None:
            over = max(holder[2], self._perhaps) + self._settings.authority
            if now >= over:
                self._end(over)
        return self._holder

    def _end(self, now: float) -> None:
        if self._holder is not None:
            self._void(self._holder[1], now)
        self._holder, self._perhaps = None, float("-inf")
        self._taken.clear()

    def _void(self, token: int, now: float) -> None:
        self.old[token] = now
        for cluster in self._clusters:
            cluster.orders.void(token, now + VOID_WITHIN)

    def granted(self, person: Person, token: int, now: float, *, seized: bool) -> None:
        """Check that the command authority was granted correctly."""
        before = self._live(now)
        saw = f"{person.name} ({person.role.name.lower()}) was given the command authority"
        good = person.role >= Role.OPERATOR
        if before is not None:
            saw += f", which {before[0].name} had"
            good &= person.role >= before[0].role if seized else person == before[0]
        if before is None or seized:
            good &= token != 0 and token not in self.old and (before is None or token != before[1])
            if person != AUTOMATIC:
                self._noted(person.name, "AUTHORITY", now)
            self._end(now)
        self.check(4, good, now, "plant", saw)
        self._holder, self._granted_at = (person, token, now), now
        self._from_nobody = before is None

    def kept(self, now: float) -> None:
        """Record that the holder has renewed the authority."""
        if self._holder is not None:
            self._holder = (*self._holder[:2], now)

    def released(self, person: Person, now: float) -> None:
        """Record that the holder has released the authority."""
        self._noted(person.name, "AUTHORITY", now)
        self._end(now)

    def gave_way(self, now: float, token: int = 0) -> None:
        """Record that automatic control yields its authority to an operator.

        ``token`` is automatic control's token, 0 if it had none. A first lease with that token may
        still leave the plant only after this call.
        """
        if self._by_itself():
            self._end(now)
        if token != 0:
            self._void(token, now)

    def _by_itself(self) -> bool:
        return self._holder is not None and self._holder[0] == AUTOMATIC

    def _leased(self, token: int, now: float) -> None:
        """Follow the authority of automatic control, which no operator reports.

        Automatic control may take the authority only if nobody holds it. Leases sent to several
        clusters at the same moment may stem from before or after a grant, and arrive here in any
        order.
        """
        holder = self._live(now)
        if holder is not None and holder[1] == token:
            if self._by_itself():
                self.kept(now)
        elif token == 0 and (holder is None or now - holder[2] > _AT_ONCE):
            self.gave_way(now)
        elif token not in self.old and token != 0:
            just, visited = now - self._granted_at, now - self._visited_at
            own = self._from_nobody and just <= _AT_ONCE and visited <= 2.0 * _AT_ONCE
            if holder is not None and own:
                self.old[token] = now  # a visit went on with it while nobody had it, just before
                return
            if self._by_itself():
                self._end(now)
            self.granted(AUTOMATIC, token, now, seized=False)

    @property
    def automatic(self) -> bool:
        """Whether automatic control holds the authority."""
        return self._by_itself()

    def holder(self, now: float) -> str | None:
        """Return the operator who certainly holds the command authority; None if that is uncertain.

        Automatic control releases it without notice.
        """
        holder = self._live(now)
        if holder is None or holder[0] == AUTOMATIC:
            return None
        sure = now - self._granted_at > _AT_ONCE and now - holder[2] < 2.0 * _AT_ONCE
        return holder[0].name if sure else None

    def until(self, token: int, until: float) -> float:
        """Return the time at which an order that carries a token becomes invalid."""
        void = self.old.get(token)
        return until if void is None else min(until, void + VOID_WITHIN)

    def known(self, token: int) -> bool:
        """Return whether a token was ever issued."""
        return token in self.old or (self._holder is not None and self._holder[1] == token)

    # -- accepted commands -----------------------------------------------------------------

    def on_accepted(
        self, person: Person, token: int, ticket: Ticket, what: str, now: float
    ) -> None:
        """Check a command that the plant has accepted."""
        holder = self._live(now)
        held = holder is not None and holder[:2] == (person, token)
        saw = f"{what} by {person.name} was accepted without the command authority"
        self.check(4, held, now, "plant", saw)
        enough = person.role >= (Role.OPERATOR if what in _OPERATORS else Role.ENGINEER)
        saw = f"{what} was accepted from {person.name}, role {person.role.name.lower()}"
        self.check(4, enough, now, "plant", saw)
        self.kept(now)
        if ticket.identity in self._disk.records or not self._disk.busy(now):
            self._kept_record(ticket.identity, person.name, what, now)
        else:
            self._awaited[ticket.identity] = now, person.name, what
        self._accepted[person.name, what] += 1
        if what not in _SETTINGS:
            for name in ticket.heliostats:
                if name not in ticket.refusals:
                    self._taken.setdefault(name, now)
        self._count(now)

    def on_refused(
        self, person: Person, token: int, asked: tuple[str, Sequence[str]], reason: str, now: float
    ) -> None:
        """Check the reason of a refusal, if it names the command authority or the role.

        If the holder's own command is refused for another reason, the command may or may not have
        renewed the authority.
        """
        holder, what = self._live(now), asked[0]
        # An authority that nobody has renewed for a while may be over a moment earlier or later.
        sure = holder is not None and now - holder[2] < self._settings.authority - _AT_ONCE
        saw = f"{what} was refused: {reason}; "
        if ROLE_REASON in reason:
            least = Role.OPERATOR if what in _OPERATORS else Role.ENGINEER
            self.check(16, person.role < least, now, "plant", f"{saw}{least.title} is enough")
        elif NOBODY_REASON in reason:
            self.check(
                16, not sure, now, "plant", f"{saw}{holder[0].name if holder else 'nobody'} has it"
            )
        elif OTHER_REASON in reason:
            if sure and holder is not None:
                right = holder[:2] != (person, token) and f"{holder[0].name} has it" in reason
                self.check(16, right, now, "plant", f"{saw}{holder[0].name} has it")
        elif holder is not None and holder[:2] == (person, token):
            self._perhaps = now

    def _kept_record(self, identity: str, who: str, what: str, now: float) -> None:
        record = self._disk.records.get(identity)
        right = record is not None and (record.who, record.what) == (who, what)
        self.check(11, right, now, "plant", f"{what} by {who} was accepted without its record")

    def on_safe(self, person: Person, ticket: Ticket, what: str, now: float) -> None:
        """Record a DEFOCUS or STOW, which the plant must accept from anyone."""
        self.obeyed(person.name, what, now, ticket.identity)

    def obeyed(self, who: str, what: str, now: float, identity: str = "") -> None:
        """Record a command that the plant must accept from anyone, and may record later.

        A repetition within a moment is the same command, with the same identity.
        """
        if identity and now - self._obeyed.get(identity, float("-inf")) < MOMENT:
            return
        self._obeyed = {identity: now}
        self._noted(who, what, now)

    def _noted(self, who: str, what: str, now: float) -> None:
        self._accepted[who, what] += 1
        self._noted_at[who, what] = now

    def on_end(self, now: float) -> None:
        """Record that the plant program has ended; records not yet written are lost."""
        self._end(now)
        self._count(now)
        self._accepted = Counter(self._recorded)
        self._following.clear()
        self._own.clear()
        self._awaited.clear()
        self._hangs = self._stands = False

    def hangs(self, now: float, *, on: bool, stands: bool) -> None:
        """Record whether the plant's messages are held up, and may later be sent together.

        If ``stands``, the whole program is frozen.
        """
        if on or self._hangs:
            self._hung_at = now
        if stands or self._stands:
            self._stood_at = now
        self._hangs, self._stands = on, stands

    # -- messages --------------------------------------------------------------------------

    def posted(self, members: Sequence[str], message: Message, now: float) -> None:
        """Check a message to some heliostats before it goes to a cluster."""
        if self._automatic and isinstance(message, Lease | Command | Parameters):
            self._leased(message.token, now)
        if not isinstance(message, Command | Parameters | Emergency):
            return
        identity = message.identity.rpartition(".")[0]
        self._sent.add(identity)
        self._own.pop(identity, None)
        if isinstance(message, Emergency):
            if identity not in self._disk.records:
                self._following.setdefault(identity, now)
            return
        what = message.name if isinstance(message, Command) else "PARAMETERS"
        record = self._disk.records.get(identity)
        good = record is not None and record.what == what
        self.check(
            11, good, now, "plant", f"{what} {message.identity} is sent before its record is stored"
        )
        if not isinstance(message, Command):
            return
        whom = message.heliostats or members
        if what == "AIM":
            self._aimed.update(dict.fromkeys(whom, now))
        if what in _MOTIONS and record is not None and record.who.endswith(AUTOMATIC.name):
            self._spares_taken(what, whom, now)
        if what in _JOINING:
            self._posted.append((now, len(whom)))
            self._bounded(self._posted, 0.0, now, f"are sent {what}")

    def _spares_taken(self, what: str, heliostats: Sequence[str], now: float) -> None:
        """Check that automatic control moves no heliostat that the holder has commanded.

        Calibration visits continue with the other heliostats while an operator commands. Messages
        that were already on their way when the operator gave the command may still leave.
        """
        holder = self._live(now)
        if holder is None or holder[0] == AUTOMATIC:
            return
        for name in heliostats:
            passed = now - self._taken.get(name, now)
            saw = f"automatic control sends {name} {what}; {holder[0].name} took it {passed:.1f} s"
            self.check(4, passed <= _AT_ONCE, now, "plant", f"{saw} ago")

    def aimed(self, name: str) -> float:
        """Return when an aim was last sent to a heliostat, s; -inf if none was ever sent."""
        return self._aimed.get(name, float("-inf"))

    def _bounded(
        self, joined: "deque[tuple[float, int]]", slack: float, now: float, how: str
    ) -> None:
        """Check that in every period ending now, no more heliostats join than are allowed.

        Commands that leave when the plant resumes after a freeze may have been admitted earlier, by
        up to a command's lifetime. This applies both to the beginning and to the end of a period.
        """
        # A simulation gives both numbers.
        rate, burst = self._settings.join_rate or 0.0, self._settings.join_burst or 0
        life = self._settings.join_life
        count = 0
        for at, some in reversed(joined):
            count += some
            span = now - at
            held = min(abs(now - self._hung_at), abs(at - self._hung_at)) < 2.0 * life
            most = burst + rate * (span + slack + life * held) + 1e-6
            saw = f"{count} mirrors {how} within {span:.2f} s, at most {most:.1f} may join"
            self.check(10, count <= most, now, "plant", saw)
            if span > 60.0:
                break

    # -- displayed values ------------------------------------------------------------------

    def heard(self, name: str, state: int, now: float) -> None:
        """Record a heliostat's report to its cluster."""
        self._heard[name].append((now, state))

    def reports(self, name: str, since: float) -> set[int]:
        """Return the states that a heliostat has reported to its cluster since a time in s."""
        return {state for at, state in self._heard[name] if at >= since}

    def counted(self, name: str, steps: tuple[int, int], now: float) -> None:
        """Record the true step counts of a heliostat when it replies to its cluster."""
        self._true_counts[name].append((now, steps))

    def true_counts(self, name: str, since: float) -> list[tuple[int, int]]:
        """Return the true step counts at a heliostat's replies since a time in s."""
        return [steps for at, steps in self._true_counts[name] if at >= since]

    def look(self, plant: PlantController | None, now: float) -> None:
        """Check all that must have happened by now; ``plant`` is None if it is not running."""
        self.hangs(now, on=self._hangs, stands=self._stands)
        if self._by_itself() and plant is not None:
            grant, held = plant.authority.grant, self._holder
            if grant is not None and held is not None and grant.token == held[1]:
                self.kept(now)
        self._live(now)
        self._count(now)
        self._boards(now)
        if plant is None:
            return
        if plant.authority.visited():
            self._visited_at = now
        # A heliostat that returns its beam to the receiver waits for its turn to join.
        waits = {ticket.identity for ticket in plant.orders if not ticket.sent}
        # The plant says that it waits, and is believed for as long as turns may take.
        for identity in self._own.keys() & waits:
            since = self._own[identity][0]
            saw = f"record {identity} has been waiting for {now - since:.0f} s"
            self.check(11, now - since <= TURN_WITHIN, now, "plant", saw)
            self._own[identity] = since, now
        well_since = max(self._disk.well_since, self._stood_at)
        if now - well_since > RECORD_WITHIN and not (self._disk.full or self._disk.busy(now)):
            self._complete(now)
        self._shown(plant, now)
        self._proofs(plant, now)

    def _count(self, now: float) -> None:
        """Check that each record belongs to a command, and that no command has two records."""
        records = self._disk.records
        for record in islice(records.values(), self._counted_records, None):
            if record.who.endswith(_UNTOLD):
                continue  # it tells nobody; `posted` wants a record of all that it sends
            if record.who in _OWN:
                if record.identity not in self._sent:
                    self._own[record.identity] = now, now
                continue
            key = (record.who, record.what)
            self._recorded[key] += 1
        for key in self._recorded if self._counted_records < len(records) else ():
            count, most = self._recorded[key], self._accepted[key]
            saw = f"{count} records of {key[1]} by {key[0]}, who ordered it {most} times"
            self.check(11, count <= most, now, "plant", saw)
        self._counted_records = len(records)

    def _complete(self, now: float) -> None:
        """Check that late records have been written by now."""
        for key, at in list(self._noted_at.items()):
            if now - at > RECORD_WITHIN:
                del self._noted_at[key]
                count, most = self._recorded[key], self._accepted[key]
                saw = f"{count} records of {key[1]} by {key[0]}, who ordered it {most} times"
                self.check(11, count == most, now, "plant", saw)
        for identity, (at, who, what) in list(self._awaited.items()):
            if now - at > RECORD_WITHIN:
                del self._awaited[identity]
                self._kept_record(identity, who, what, now)
        for identity, at in list(self._following.items()):
            if now - at > RECORD_WITHIN:
                del self._following[identity]
                good = identity in self._disk.records
                self.check(
                    11, good, now, "plant", f"order {identity} has no record {now - at:.1f} s later"
                )
        for identity, (_, at) in list(self._own.items()):
            if now - max(at, self._hung_at) > RECORD_WITHIN:
                del self._own[identity]
                # A command that waited too long for the disk is not sent; its record says so.
                given_up = "not sent" in self._disk.records[identity].result
                saw = f"record {identity} belongs to nothing that was sent, but does not say so"
                self.check(11, given_up, now, "plant", saw)

    def _boards(self, now: float) -> None:
        """Record the heliostats that join, according to the boards themselves."""
        on = {
            name
            for name, account in self._accounts.items()
            if account.state in (states.TRACKING, states.SEARCHING)
        }
        new, self._on = len(on - self._on), on
        if new:
            self._joined.append((now, new))
            slack = self._settings.join_life + LATE + LOOKS
            self._bounded(self._joined, slack, now, "have joined")

    def _shown(self, plant: PlantController, now: float) -> None:
        """Check that a value shown as live is fresh, and is what was reported."""
        live = plant.field.live(now)
        limit = self._settings.stale + YOUNGER
        for name, heard in self._heard.items():
            shown = plant.field.of(name, now)
            row = plant.field.index[name]
            saw = f"{name} is {'live' if shown.live else 'stale'} in one place, not in the other"
            self.check(11, shown.live == live[row], now, "plant", saw)
            if not shown.live:
                continue
            age = now - heard[-1][0] if heard else float("inf")
            saw = f"{name} is shown as live, last heard {age:.2f} s ago, limit {limit:.2f} s"
            self.check(11, age <= limit, now, "plant", saw)
            reported = {states.STATES[state] for at, state in heard if now - at <= limit}
            saw = f"{name} is shown as {shown.state}; it reported {', '.join(sorted(reported))}"
            self.check(11, shown.state in reported, now, "plant", saw)

    def _proofs(self, plant: PlantController, now: float) -> None:
        """Check that every heliostat confirmed as done has carried out its emergency order."""
        order = plant.sentinel.order
        if order is None:
            return
        for name, account in self._accounts.items():
            key = (order.ticket.identity, name)
            if key not in self._proved and order.is_done(name):
                self._proved.add(key)
                saw = f"{order.act.name} is reported as proven for {name}, whose beam has not moved"
                self.check(11, account.was_in(_OFF, order.at - YOUNGER), now, "plant", saw)
