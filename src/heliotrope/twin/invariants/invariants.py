"""The nineteen safety invariants, and an independent observer of the first eleven.

The observer sees the frames on the bus, the actions of each board, and the messages to and from the
plant. It keeps its own accounts in true time and trusts no report: a sun vector's age counts from
when the cluster sent it, a heliostat is defocused when its beam misses the receiver, and a
duplicate is a frame that was received before.

========  ============================================================================
number    check
========  ============================================================================
1         In a state that needs the sun, the last sun vector is not older than the lease.
2         A heliostat that is cut off from plant or cluster, or ordered off, is off the
          receiver within 30 s and at stow within 5 min.
3         TRACKING and SEARCHING, and every transition out of STOWED and FAULT, begin with a
          genuine command at that instant.
4         DEFOCUS and STOW act at once, whoever sends them; nothing else acts without authority,
          and of two plants with the same keys, only one is obeyed at a time.
5         Duplicate, late, replayed and expired commands change nothing.
6         A damaged frame changes nothing.
7         After a boot the state is safe, the journal contains the old or the new record, and
          the step counts are right to within their stated uncertainty.
8         Steps stay within range, rate and acceleration; counted steps equal ordered steps.
9         As 1, and also for the plant's lease, after a jump of a clock or counter; no sun vector
          is sent for a time that has jumped until an operator has acknowledged the jump.
10        Azimuth moves first from stow and last to stow; the beam passes the foot of the safe
          path, and crosses the receiver only after it has reached its standby point.
11        Every command on the bus was accepted and reported once; boards, clusters and the plant
          report every value as it is, with its true age. If nothing fails (`world.tour`), each
          command is carried out in time.
12        A beam in a state in which it lights anything is where it was sent; otherwise an alarm
          names the heliostat within 10 s, and the beam is off within 30 s.
13        In no state does a beam stay on the receiver for 30 s without an order, or in a keep-out
          volume at all for 30 s; beams that turn away diverge.
14        After a loss of all heliostats, or of more than automatic control may raise again, only
          an operator brings them back.
15        A heliostat confirmed as done is off the receiver, or at stow.
16        In undisturbed periods, orders are carried out; a stored sighting shows the heliostat's
          own beam; while the sun is low, heliostats under automatic control are at stow. Alarms
          have causes, and causes have alarms; each command ends, and a failed one says why.
17        An operator's order or lock stands until its owner, or an engineer by name, has ended
          it: the emergency stays in force, and the locked heliostat stands still.
18        Under a flux limit, the true flux stays below the limit; after a disturbance it is below
          the limit again within 60 s. With a ramp, no cell is heated faster when a cloud leaves.
19        Under a flux limit, each aim comes from the optimiser, its fallback or a person.
========  ============================================================================

Besides being safe, the plant must keep working:

========  ============================================================================
L1        Every heliostat that a visit or an operator took is released: none stays LOCKED, or
          leaves its beam on a target, without an owner that the page shows.
L2        Each ticket ends, and DONE is true; retries end; no alarm is caused by the plant's own
          action.
L3        When the last cause is gone and an operator has resumed, every healthy heliostat under
          automatic control tracks the receiver again.
L4        Emergencies and locks survive a restart of the plant program.
========  ============================================================================

`twin.invariants.beams` checks 12 to 15, `twin.invariants.quiet`, `.visits`, `.day`, `.alarms` and
`.tickets` check 16, `twin.invariants.persons` checks 17, `twin.invariants.flux` checks 18 and 19,
and `twin.invariants.answers` checks 11.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from heliotrope.errors import HeliotropeError
from heliotrope.geometry import FloatArray
from heliotrope.lcu import messages, states, wire
from heliotrope.links.messages import NEVER, ClusterStatus, Command, Progress, Stage
from heliotrope.plant.orders.authority import Person
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.safety import Act, Alarm
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.outfit import LIMITS, RANGES, RECEIVER, STANDBY, Ball
from heliotrope.twin.invariants._account import UNLISTED, HeliostatAccount, fingerprint
from heliotrope.twin.invariants.ledger import FrameLedger, OrderLedger, PlantCommand, Sent
from heliotrope.twin.invariants.runs import RunAccount

#: Function that returns the true direction to the sun, (3,), at a time in s.
SunAt = Callable[[float], FloatArray]

#: Title of each invariant.
TITLES = {
    1: "no tracking with an outdated sun vector",
    2: "a heliostat that is cut off defocuses and stows",
    3: "no tracking without a command",
    4: "DEFOCUS and STOW always, everything else by authority",
    5: "an old command moves nothing",
    6: "a damaged frame changes nothing",
    7: "safe after a reset, journal whole",
    8: "steps within limits, and counted",
    9: "no jump of time extends a lease",
    10: "beams travel safely",
    11: "every command once, every value true",
    12: "a beam is where it was sent",
    13: "no state is exempt",
    14: "only a person resumes the field",
    15: "a proof counts only what is known",
    16: "work that is possible is done, and what is shown is true",
    17: "a person's orders and locks remain in force",
    18: "the true flux stays within the limit",
    19: "each aim has an origin",
    20: "whatever was taken is returned",
    21: "each ticket and each retry ends, truthfully",
    22: "every healthy mirror tracks again",
    23: "the state of safety survives a restart",
}
#: Numbers of the invariants about operators' orders and locks, the flux, and the origin of aims;
#: numbers of the liveness invariants, which are called by name.
WORDS, FLUX, ORIGIN = 17, 18, 19
L1, L2, L3, L4 = 20, 21, 22, 23


def named(number: int) -> str:
    """Return the short name of an invariant: 1 to 19, L1 to L4."""
    return str(number) if number < L1 else f"L{number - L1 + 1}"


#: Local lease, and how late a board may notice that it has ended, s.
LEASE, LOOK = 6.0, 0.15
#: The plant's lease to a cluster, and how late the cluster may send its last sun vector, s.
PLANT_LEASE, SUN_AFTER = 3.0, 1.2
#: Deadlines for being off the receiver and for being at stow, s.
DEFOCUS_WITHIN, STOW_WITHIN = 30.0, 300.0
#: After a heliostat has turned away, its beam may stay on the receiver no longer than this, s. This
#: is shorter than the time until anything stows it, because a beam leaves in less than a second.
TURNED_WITHIN = 15.0
#: A beam this far from the middle of the receiver counts as off the receiver, m.
OFF = 4.0
#: A heliostat that stows without a sun vector may carry its beam across the receiver for at most
#: this long, s.
CROSSING = 2.0
#: For this long after a jump, lease checks count as invariant 9, s.
JUMP_COUNTS = 60.0
#: Maximum time from an order to its first frame on a healthy bus, s.
ORDER_WITHIN = 1.0
#: A value may be reported as this much younger than it is, because its age is rounded, s.
AGE_ROUNDING = 0.1
#: Largest relative difference in rate between the cluster's clock and true time.
CLOCKS_APART = 1e-3
#: A status is made every second, and is delivered at most this long after it was sent, s.
STATUS_LIFE = 1.0

#: Transitions that a controller may make by itself, or on DEFOCUS and STOW: state before, after.
FREE = {
    *((before, states.DEFOCUSED) for before in (
        states.APPROACHING, states.IDLE, states.TRACKING, states.SEARCHING)),
    *((before, states.STOWING) for before in (
        states.APPROACHING, states.IDLE, states.TRACKING, states.SEARCHING, states.DEFOCUSED)),
    *((before, states.FAULT) for before in range(len(states.STATES)) if before not in (
        states.UNCONFIGURED, states.LOCKED)),
    (states.STOWING, states.STOWED), (states.APPROACHING, states.IDLE),
    (states.DEFOCUSED, states.STOWED),  # arrives at once, because it had hardly left
    (states.SEARCHING, states.IDLE), (states.UNCONFIGURED, states.LOCKED),
}  # fmt: skip
#: Commands that all other transitions need, by the state that is entered.
BY_COMMAND = {
    states.TRACKING: ("TRACK", "REFOCUS"), states.SEARCHING: ("SEARCH",),
    states.APPROACHING: ("APPROACH",), states.LOCKED: ("LOCK",),
    states.IDLE: ("IDLE", "UNLOCK", "CLEAR_FAULT"),
    states.STOWED: ("UNLOCK", "CLEAR_FAULT"), states.FAULT: ("UNLOCK",),
}  # fmt: skip
#: Foot of the safe path: below the standby point, at the height of the heliostats, m.
FOOT = (STANDBY[0], STANDBY[1], 0.0)
#: States that need a fresh sun vector.
NEED_SUN = (states.APPROACHING, states.TRACKING, states.SEARCHING)
#: An approach passes within this distance of the foot of the safe path, on the ground below the
#: standby point, m.
NEAR_FOOT = 6.0
#: A time that has jumped is no longer used after this, s.
JUMP_SEEN = 3.0
#: States in which a boot may end.
AFTER_BOOT = (
    states.UNCONFIGURED, states.STOWED, states.STOWING, states.DEFOCUSED, states.LOCKED,
    states.FAULT,
)  # fmt: skip
#: States that DEFOCUS and STOW always end, because the beam is out by command and its return path
#: may not lead through a keep-out volume.
ON_THE_WAY = (states.TRACKING, states.SEARCHING, states.APPROACHING, states.IDLE)
#: State that each command requests, and in which DONE must find the heliostat.
ASKED = {
    "APPROACH": (states.IDLE,), "IDLE": (states.IDLE,), "TRACK": (states.TRACKING,),
    "REFOCUS": (states.TRACKING,), "LOCK": (states.LOCKED,), "SEARCH": (states.SEARCHING,),
}  # fmt: skip


class InvariantError(HeliotropeError):
    """An invariant was violated.

    Attributes
    ----------
    violation
        The violation, with number, time, subject and observation.
    """

    def __init__(self, violation: "Violation") -> None:
        self.violation = violation
        super().__init__(str(violation))


@dataclass(frozen=True)
class Violation:
    """Violation of an invariant.

    Attributes
    ----------
    number
        Of `TITLES`: 1 to 19, or `L1` to `L4`.
    at
        Time since the start, s.
    subject
        Name of the heliostat, or "cluster".
    saw
        The observation, with values and limits.
    """

    number: int
    at: float
    subject: str
    saw: str

    def __str__(self) -> str:
        title = TITLES[self.number]
        what = f"invariant {named(self.number)} ({title})"
        return f"{what}: at {self.at:.3f} s, {self.subject}: {self.saw}"


class Judge:
    """Base of the observers: counts checks, and raises at the first broken invariant.

    Events at a plant arrive through the hooks ``on_…``, which do nothing here. An observer
    overrides the hooks that concern it; the part of the simulation that sees an event calls the
    hook of every observer in turn.

    Parameters
    ----------
    start
        Origin of the times that it reports, s.

    Attributes
    ----------
    checks
        Number of checks of each invariant.
    start
        Origin of the reported times, s.
    """

    def __init__(self, start: float) -> None:
        self.checks: Counter[int] = Counter()
        self.start = start

    def check(self, number: int, good: bool, now: float, subject: str, saw: str) -> None:
        """Count a check, and raise if it fails.

        Raises
        ------
        InvariantError
            If ``good`` is False.
        """
        self.checks[number] += 1
        if not good:
            raise InvariantError(Violation(number, now - self.start, subject, saw))

    # -- the plant's end of a line -----------------------------------------------------------

    def on_lease(self, token: int, now: float) -> None:
        """Record a lease that has left the plant."""

    def on_emergency(self, name: str, heliostats: Sequence[str], now: float) -> None:
        """Record a DEFOCUS or STOW from the plant."""

    def on_command(self, message: Command, heliostats: Sequence[str], now: float) -> None:
        """Record a command that has left the plant."""

    def on_write(self, heliostat: str, what: str, now: float) -> None:
        """Record a message from the plant whose contents a heliostat is to store."""

    def on_heard(self, cluster: str, now: float) -> None:
        """Record that a status, whatever its content, has reached the plant."""

    def on_status(self, status: ClusterStatus, names: Sequence[str], now: float) -> None:
        """Record a status of named heliostats that has reached the plant."""

    def on_progress(self, message: Progress, now: float) -> None:
        """Record a report to the plant about a command."""

    # -- the plant's program and its operators -------------------------------------------------

    def on_alarm(self, alarm: Alarm, now: float) -> None:
        """Record an alarm of the plant."""

    def on_end(self, now: float) -> None:
        """Record that the plant program has ended."""

    def on_accepted(
        self, person: Person, token: int, ticket: Ticket, what: str, now: float
    ) -> None:
        """Record an operator command that the plant has accepted."""

    def on_safe(self, person: Person, ticket: Ticket, what: str, now: float) -> None:
        """Record a DEFOCUS or STOW by an operator, which needs no authority."""

    def on_refused(
        self, person: Person, token: int, asked: tuple[str, Sequence[str]], reason: str, now: float
    ) -> None:
        """Record that a command (name and heliostats) was refused, and the reason."""

    def on_call(self, owner: str, act: Act, now: float) -> None:
        """Record an emergency that an operator has called."""


class Observer(Judge):
    """Observes the bus, the boards and the plant, and raises at the first violated invariant.

    It is a `twin.boards.bus.Tap` and a `twin.boards.board.Witness`; `look` is called every half
    second.

    Parameters
    ----------
    boards
        Boards in the order of their positions on the bus.
    start
        Origin of the times that it reports, s.
    sun
        Function that returns the true direction to the sun, (3,), at a time in s.
    keep_outs
        Spheres that no commanded beam may enter.

    Attributes
    ----------
    frames, orders, runs
        The ledgers of frames and orders, and the record of the plant's runs.
    leased_at
        When the plant last sent a lease on a healthy line, s.
    jumped_at, disturbed_at
        When a clock or counter last jumped; when line, bus or cluster last failed; s.
    autonomy
        Autonomy granted by the plant's leases, s.
    entered
        Number of times each state was entered.
    """

    def __init__(
        self, boards: Sequence[Board], start: float, sun: SunAt, keep_outs: Sequence[Ball] = ()
    ) -> None:
        super().__init__(start)
        self._keep_outs = tuple(keep_outs)
        self.frames = FrameLedger()
        self.orders = OrderLedger()
        self.runs = RunAccount()
        self.leased_at = start
        self._dark_since = float("inf")
        self.jumped_at = self.disturbed_at = float("-inf")
        self.autonomy = 0.0
        self.accounts = [HeliostatAccount(board, start) for board in boards]
        self._sun = sun
        self._by_address = {account.address: account for account in self.accounts}
        self._emergencies: list[tuple[str, float]] = []
        self._unreported: deque[tuple[float, str, list[int], list[PlantCommand]]] = deque()
        self.entered: Counter[int] = Counter()
        for account in self.accounts:
            account.board.witness = self

    def call(self, names: Mapping[int, str]) -> None:
        """Set the names that the cluster uses for its heliostats' addresses."""
        for account in self.accounts:
            account.name = account.written = names[account.address]

    def doubt(self, board: Board) -> None:
        """Record that a heliostat has another board, or that a drive has stalled.

        Another board stores other values, and in either case the position of the beam is unknown.
        """
        self._by_address[board.outfit.address].unsure = True

    def edited(self, file: Mapping[str, str], now: float) -> None:
        """Record the errors in the file with which the cluster now starts; see `Pod.file`.

        A heliostat that is missing from the file is no longer addressed, so it counts as cut off.
        """
        for account in self.accounts:
            account.written = file.get(account.name, account.name)
            account.unlisted_at = None if account.written else now

    def _lease_number(self, now: float, usual: int) -> int:
        return 9 if now - self.jumped_at < JUMP_COUNTS else usual

    # -- the bus (Tap) ---------------------------------------------------------------------

    def sent(self, frame: bytes, now: float) -> None:
        """Check a frame that the cluster sends."""
        sent = self.frames.note(frame, now)
        if sent is None:
            self.check(6, False, now, "cluster", f"it sent {len(frame)} bytes that are not a frame")
            return
        if sent.name == "SUN":
            age = now - self.leased_at
            limit = PLANT_LEASE + self.autonomy + SUN_AFTER
            saw = f"it sends SUN {age:.2f} s after the plant's last lease, limit {limit:.2f} s"
            self.check(self._lease_number(now, 2), age <= limit, now, "cluster", saw)
            dark = now - max(self._dark_since, self.disturbed_at)
            saw = f"it sends SUN {dark:.1f} s after a time jump that nobody has acknowledged"
            self.check(9, dark <= JUMP_SEEN or now < self._dark_since, now, "cluster", saw)
        elif sent.who in (messages.AUTHORITY, messages.KEY):
            self._authorised(sent, now)
        elif sent.who == messages.ANYONE:
            # A heliostat that is to stow need not defocus first.
            over = ("DEFOCUS", "STOW") if sent.name == "STOW" else (sent.name,)
            self._emergencies = [
                emergency for emergency in self._emergencies if emergency[0] not in over
            ]

    def _authorised(self, sent: Sent, now: float) -> None:
        """Check that a command on the bus was ordered with authority, in time, and reported."""
        pushed = sent.who == messages.KEY and sent.name != "ZERO"  # an operator declares the counts
        name = "PARAMETERS" if pushed else sent.name
        addresses = [a.address for a in self.accounts if sent.addresses(a.address)]
        orders = self.orders.covering(name, addresses, now)
        if name == "STANDBY":  # a standby point set as a parameter is sent like the command
            orders = [*orders, *self.orders.covering("PARAMETERS", addresses, now)]
        where = f"{sent.name} to {sent.to}"
        allowed = [order for order in orders if order.authorised]
        self.check(
            4,
            bool(allowed),
            now,
            "cluster",
            f"{where} without an order from the holder of the command authority",
        )
        fresh = [order for order in allowed if now <= order.until]
        latest = max((order.until for order in allowed), default=0.0)
        late = f"{where} {now - latest:.2f} s after its order expired"
        self.check(5, bool(fresh), now, "cluster", late)
        error = self.runs.obeyed((order.identity for order in fresh), now)
        self.check(4, not error, now, "cluster", f"{where}: {error}")
        if fresh:
            self._unreported.append((now, where, addresses, fresh))

    def heard(self, place: int, data: bytes, how: str, now: float) -> None:
        """Record the bytes that a board is about to receive, and its state before it does."""
        account = self.accounts[place]
        sent = self.frames.of(data)
        if how == "damaged" and sent is not None:
            how = "whole"  # the noise hit no frame
        account.in_hand, account.how = sent, how
        account.forged = None
        if account.board.node is None:
            return
        if how == "forged":
            account.forged, account.misled = _first(data), True
        account.quiet = self._expects_quiet(account, sent, how)
        if account.quiet:
            # Bring the board up to date first, so that only the frame can change anything.
            account.board.step(now)
            if account.board.state < 0:
                account.quiet = 0
                return
            account.before = self._fingerprint(account, how)
        account.good = account.board.node.reader.good

    def _expects_quiet(self, account: HeliostatAccount, sent: Sent | None, how: str) -> int:
        """Return the invariant under which a frame must change nothing; 0 if it may act."""
        if how == "damaged":
            return 6
        if how == "forged":
            forged = account.forged
            mine = forged is not None and forged.for_address(account.address)
            safe = forged is not None and forged.name in ("DEFOCUS", "STOW")
            return 0 if safe and mine else 4
        if sent is None or sent.who == messages.ANYONE or how == "whole":
            return 0
        if not sent.addresses(account.address):
            return 5
        node = account.board.node
        if sent.name == "SESSION" and node is not None and node.controller.gate is not None:
            # A late SESSION of a cluster that has restarted since is new to the board.
            return 5 if sent.values[0] < node.controller.gate.replay.epoch else 0
        return 5 if sent.index <= account.taken else 0

    def _fingerprint(self, account: HeliostatAccount, how: str) -> dict[str, object]:
        sent = account.in_hand
        by_cluster = sent is not None and sent.who == messages.CLUSTER
        return fingerprint(account.board, gate=how in ("damaged", "twice"), clock=not by_cluster)

    def answered(self, data: bytes, how: str, now: float) -> None:
        """Record a reply that the master has received."""
        frames = wire.Reader().feed(data)
        # If a late reply came first, only the last frame is current.
        for frame in frames[-1:] if how == "late" else frames:
            account = self._by_address.get(frame.sender)
            values = frame.values() if frame.name == "STATUS" else None
            if account is not None and values is not None:
                account.statuses.append((now, values))

    # -- the boards (Witness) --------------------------------------------------------------

    def acted(self, board: Board, what: str, now: float) -> None:
        """Check an action of a board."""
        account = self._by_address[board.outfit.address]
        node = board.node
        if what == "cut" or node is None:
            account.cut(now)
            return
        if what == "boot":
            self._booted(account, now)
            return
        heard = what == "bytes"
        if heard:
            self._took(account, now)
        if account.state == states.APPROACHING and account.foot > NEAR_FOOT:
            miss = 0.0 if account.unsure else board.miss(self._sun(now), FOOT, believed=True)
            account.foot = min(account.foot, miss)
        if account.board.state != account.state:
            self._changed(account, now, heard)
        self._leases(account, now)
        if account.keep():
            sent = account.in_hand if heard else None
            by = sent is not None and (sent.who == messages.KEY or sent.name == "STANDBY")
            saw = "its journal has changed without a message that changes settings"
            self.check(4, by, now, account.name, saw)
        if heard:
            account.in_hand = None
            account.how = ""

    def _took(self, account: HeliostatAccount, now: float) -> None:
        board, sent = account.board, account.in_hand
        node = board.node
        assert node is not None
        good = node.reader.good > account.good
        name = account.name
        if account.quiet:
            after = self._fingerprint(account, account.how)
            what = sent.name if sent else "noise"
            what = account.forged.name if account.forged else what
            saw = f"{what} ({account.how}) has changed {_difference(account.before, after)}"
            self.check(account.quiet, after == account.before, now, name, saw)
        elif account.how == "forged" and good:
            state = states.STATES[board.state]
            what = account.forged.name if account.forged else ""
            self.check(
                4,
                board.state not in ON_THE_WAY,
                now,
                name,
                f"it is {state} after {what}, which anyone may send",
            )
        elif sent is not None and sent.addresses(account.address) and good:
            if sent.who not in (messages.ANYONE, messages.ASK):
                account.taken = max(account.taken, sent.index)
            if sent.name == "ZERO":
                board.zeroed()
            if sent.name == "SUN":
                account.sun_at = max(account.sun_at, sent.at)
            elif sent.who == messages.ANYONE:
                state = states.STATES[board.state]
                saw = f"it is {state} after {sent.name}"
                self.check(4, board.state not in ON_THE_WAY, now, name, saw)
        account.quiet = 0

    def _changed(self, account: HeliostatAccount, now: float, heard: bool) -> None:
        """Check a state transition: commanded at this instant, or allowed by `FREE`."""
        before, after = account.state, account.board.state
        account.entered(after, now)
        self.entered[after] += 1
        if (before, after) not in FREE:
            self._commanded(account, before, after, now, heard)
        if after in (states.TRACKING, states.SEARCHING):
            saw = (
                f"from {states.STATES[before]} to {states.STATES[after]} without following the "
                "path from stow"
            )
            self.check(10, account.by_way, now, account.name, saw)
        elif (before, after) == (states.APPROACHING, states.IDLE):
            saw = f"its beam reached standby {account.foot:.1f} m from the first point of the path"
            self.check(10, account.foot <= NEAR_FOOT, now, account.name, saw)

    def _commanded(
        self, account: HeliostatAccount, before: int, after: int, now: float, heard: bool
    ) -> None:
        """Check that a transition was commanded at this instant."""
        sent = account.in_hand if heard else None
        name = sent.name if sent is not None else ""
        good = name in BY_COMMAND.get(after, ())
        cause = name or ("bytes" if heard else "nothing but the passage of time")
        saw = f"from {states.STATES[before]} to {states.STATES[after]} by {cause}"
        self.check(3, good, now, account.name, saw)

    def _leases(self, account: HeliostatAccount, now: float) -> None:
        """Check that a heliostat in a state that needs the sun has a fresh sun vector."""
        if account.board.state in NEED_SUN:
            age = now - account.sun_at
            state = states.STATES[account.board.state]
            saw = f"{state} with a sun vector {age:.3f} s old, lease {LEASE:g} s"
            number = self._lease_number(now, 1)
            self.check(number, age <= LEASE + LOOK, now, account.name, saw)

    def _booted(self, account: HeliostatAccount, now: float) -> None:
        board = account.board
        node = board.node
        assert node is not None
        state, name = states.STATES[board.state], account.name
        self.check(7, board.state in AFTER_BOOT, now, name, f"{state} after a boot")
        held = dict(node.journal.items)
        mixture = "" if account.unsure else account.mixture(held)
        self.check(7, not mixture, now, name, f"after a boot its journal holds {mixture}")
        doubt = node.journal.doubt
        slip = max(abs(s) for s in board.slip)
        saw = (
            f"step counts are {slip} steps wrong after a boot, with a stated uncertainty of {doubt}"
        )
        good = account.unsure or doubt < 0 or slip <= doubt
        self.check(7, good, now, name, saw)
        account.booted(now)

    def stepped(
        self, board: Board, axis: int, direction: int, count: int, interval_us: int
    ) -> None:
        """Check a segment of steps: its range, its rate, and the order of the axes."""
        account, now = self._by_address[board.outfit.address], board.now
        name, which = account.name, ("azimuth", "elevation")[axis]
        rate = 1e6 / max(1, interval_us)
        limit = LIMITS[0]
        saw = f"{count} steps of {which} at {rate:.0f} steps/s, limit {limit}"
        self.check(8, count > 0 and rate <= limit, now, name, saw)
        place = board.axes[axis].emitted - board.slip[axis] + direction * count
        low, high = RANGES[axis]
        saw = f"{which} ordered to step {place}, range {low} to {high}"
        self.check(8, low <= place <= high, now, name, saw)
        saw = account.rate(axis, count, now)
        self.check(8, not saw, now, name, saw)
        saw = account.ramp(axis, direction * count, now)
        self.check(8, not saw, now, name, saw)
        error = account.order(axis)
        if error is not None:
            self.check(10, not error, now, name, error)

    # -- the plant -------------------------------------------------------------------------

    def on_lease(self, token: int, now: float) -> None:
        """Record a lease that the plant has sent on a working line."""
        del token
        self.leased_at = now

    def ordered(self, order: PlantCommand) -> None:
        """Record an order of the plant."""
        self.orders.note(order)

    def given_stow(self, heliostat: str, stow: tuple[int, int]) -> None:
        """Record a stow position, in steps, that was sent to a heliostat."""
        for account in self.accounts:
            if account.name == heliostat:
                account.stows.add(stow)

    def emergency(
        self, name: str, now: float, *, carried: bool, heliostats: Iterable[str] = ()
    ) -> None:
        """Record a DEFOCUS or STOW of heliostats, or of all if ``addresses`` is ().

        ``carried`` means that the line and the cluster work.
        """
        if carried:
            self._emergencies.append((name, now))
        whom = set(heliostats)
        for account in self.accounts:
            if not whom or account.name in whom:
                account.must(name, now)

    def jumped(self, now: float, place: int | None = None) -> None:
        """Record a jump of a clock, or of a board's counter."""
        self.jumped_at = now
        if place is not None:
            self.accounts[place].jumped()

    def time_jumped(self, now: float) -> None:
        """Record a jump of the cluster's time that the cluster must notice."""
        self.jumped(now)
        self._dark_since = min(self._dark_since, now)

    def time_acknowledged(self) -> None:
        """Record that an operator has acknowledged the jump."""
        self._dark_since = float("inf")

    def disturbed(self, now: float, *, crashed: bool = False) -> None:
        """Record a failure of line, bus or cluster; it cancels what the cluster had still to do."""
        self.disturbed_at = now
        self._emergencies.clear()
        if crashed:
            self._dark_since = float("inf")
            for account in self.accounts:
                account.forget()

    def on_progress(self, message: Progress, now: float) -> None:
        """Check a progress report to the plant about a command."""
        order = self.orders.by_identity.get(message.identity)
        if order is None:
            return
        subject = f"command {message.identity}"
        if message.stage is Stage.ACCEPTED:
            order.accepted.update(message.heliostats)
            most = max(order.accepted.values(), default=0)
            saw = f"{order.name} was reported as accepted {most} times"
            self.check(11, most == 1, now, subject, saw)
            saw = f"{order.name} was accepted without authority"
            self.check(4, order.authorised, now, subject, saw)
        if message.stage is Stage.DONE and order.name in ASKED:
            for account in self.accounts:
                if account.name in message.heliostats:
                    reached = account.was_in(ASKED[order.name], order.at)
                    saw = f"{order.name} of {account.name} is reported as done, but never was"
                    self.check(11, reached, now, subject, saw)

    def on_status(self, status: ClusterStatus, names: Sequence[str], now: float) -> None:
        """Check a status report to the plant: each reported age and state must be true."""
        by_name = {account.name: account for account in self.accounts}
        for name, row in zip(names, status.nodes(), strict=True):
            account = by_name.get(name)
            if account is None or int(row["heard_ms"]) == NEVER:
                continue
            age = int(row["heard_ms"]) / 1000.0
            claimed = now - age
            last = account.statuses[-1][0] if account.statuses else float("-inf")
            # The age counts from when the status was written. A status waits for a connection until
            # the next status is made, and may then be in transit for its lifetime.
            slack = 2.0 * STATUS_LIFE + AGE_ROUNDING
            saw = f"its state is reported as {age:.2f} s old, but is {now - last:.2f} s old"
            self.check(11, claimed <= last + slack, now, name, saw)
            rounding = AGE_ROUNDING + CLOCKS_APART * age
            of_then = [
                values
                for at, values in account.statuses
                if claimed - slack - rounding <= at <= claimed + rounding
            ]
            state = states.STATES[int(row["state"])]
            saw = f"reported as {state} {age:.2f} s ago, but its reply then was different"
            good = any(_row_of(values) == tuple(int(row[n]) for n in _TOLD) for values in of_then)
            self.check(11, good, now, name, saw)

    # -- time ------------------------------------------------------------------------------

    def look(self, now: float) -> None:
        """Check everything that must have happened by now."""
        for name, at in self._emergencies:
            saw = f"{name} was ordered {now - at:.2f} s ago, but has not been sent on the bus"
            self.check(4, now - at <= ORDER_WITHIN, now, "cluster", saw)
        self.orders.drop(now)
        self._reported(now)
        leased = now - self.leased_at <= 1.6
        sun = self._sun(now)
        for account in self.accounts:
            if account.board.node is not None:
                self._counted(account, now)
                self._due(account, sun, now, leased)

    def _reported(self, now: float) -> None:
        """Check that all commands on the bus were reported, if the line and the cluster worked."""
        while self._unreported and now - self._unreported[0][0] > ORDER_WITHIN:
            at, where, addresses, orders = self._unreported.popleft()
            if min(order.at for order in orders) <= self.disturbed_at:
                continue
            names = {self._by_address[address].written for address in addresses} - {""}
            reported = any(names <= set(order.accepted) for order in orders)
            saw = f"{where} was sent {now - at:.1f} s ago, but was never reported as accepted"
            self.check(11, reported, now, "cluster", saw)

    def _counted(self, account: HeliostatAccount, now: float) -> None:
        """Check that each board's step counts agree with the steps handed to its timers."""
        board = account.board
        assert board.node is not None
        motion = board.node.controller.motion
        if not motion.known:
            return  # it turns away by steps counted from an arbitrary origin
        for i in (0, 1):
            ordered = board.axes[i].emitted - board.slip[i]
            counted = motion.place(i)
            saw = f"axis {i} counts {counted} steps, but {ordered} were ordered"
            self.check(8, ordered == counted, now, account.name, saw)

    def _due(self, account: HeliostatAccount, sun: FloatArray, now: float, leased: bool) -> None:
        """Check that heliostats that are cut off or ordered off leave, and reach stow, in time."""
        board, name = account.board, account.name
        account.served(now, leased)
        assert board.node is not None
        # Unknown counts say nothing about the pose, so the true beam is judged, with its error.
        known = board.node.controller.motion.known
        on_way = board.state in (states.APPROACHING, states.IDLE) and account.from_stow
        sure = not account.unsure
        if sure and known and board.state == states.DEFOCUSED:
            stays = account.stays(board.miss(sun, RECEIVER, believed=True) <= OFF, now)
            saw = f"DEFOCUSED, its beam within {OFF:g} m of the receiver's middle for {stays:.1f} s"
            self.check(2, stays <= TURNED_WITHIN, now, name, saw)
        for why, begin in account.deadlines(now):
            passed = now - begin
            state = states.STATES[board.state]
            if passed > DEFOCUS_WITHIN:
                saw = f"{state} {passed:.1f} s after {why}, limit {DEFOCUS_WITHIN:g} s"
                # A heliostat that no file names must not stay at standby either, as nobody can move
                # it away.
                up = ON_THE_WAY if why == UNLISTED else NEED_SUN
                self.check(2, board.state not in up, now, name, saw)
                miss = board.miss(sun, RECEIVER, believed=known)
                crossing = account.crosses(sure and miss <= OFF, now)
                saw = (
                    f"{state} {passed:.1f} s after {why}, its beam within {OFF:g} m of the "
                    f"receiver's middle for {crossing:.1f} s, limit {CROSSING:g} s"
                )
                self.check(2, crossing <= CROSSING, now, name, saw)
            if passed > STOW_WITHIN and account.must_stow(why) and known:
                stow = sorted(account.stows)
                saw = f"{state} at {account.place()} {passed:.1f} s after {why}, stow is {stow}"
                self.check(2, account.place() in account.stows, now, name, saw)
        if sure and board.state in ON_THE_WAY:
            for middle, radius in self._keep_outs:
                miss = board.miss(sun, middle, believed=True)
                saw = (
                    f"{states.STATES[board.state]}, its beam is {miss:.1f} m from the middle of a "
                    f"keep-out volume of {radius:.1f} m"
                )
                self.check(10, miss > radius, now, name, saw)
        if sure and on_way:
            miss = board.miss(sun, RECEIVER, believed=True)
            saw = f"{states.STATES[board.state]}, its beam passes the receiver at {miss:.1f} m"
            self.check(10, miss > OFF, now, name, saw)


#: Columns of a record that are reported exactly as in STATUS.
_TOLD = ("state", "flags", "fault", "armature_crc", "boots")


def _row_of(values: "tuple[Any, ...]") -> tuple[int, ...]:
    """Return the columns that a STATUS fills in a cluster's record; see `_TOLD`."""
    state, flags, fault, *_, armature_crc, boots = values
    return state, flags, fault, armature_crc, boots


def _first(data: bytes) -> wire.Frame | None:
    frames = wire.Reader().feed(data)
    return frames[0] if frames else None


def _difference(before: "dict[str, object]", after: "dict[str, object]") -> str:
    """Return the differences between two records in words."""
    return ", ".join(
        f"{key} from {before[key]!r} to {after[key]!r}"
        for key in before
        if before[key] != after[key]
    )
