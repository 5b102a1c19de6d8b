"""The observer of replies: checks what boards report and what clusters report about boards.

A board replies to queries at one instant of virtual time, so its reply is compared with the true
board at that instant: where its motors are and whether they turn, how long ago it booted and when
the last sun vector left the cluster, how often it has booted, and what its journal contains. The
records and numbers in a cluster's status are compared with the replies that have reached the
cluster and with the true time (invariant 11). The meaning of each bit, and all limits, are the
observer's own.
"""

import zlib
from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Any

from heliotrope.lcu import states, wire
from heliotrope.links.messages import NEVER, ClusterStatus
from heliotrope.twin.boards.outfit import RANGES
from heliotrope.twin.invariants._account import HeliostatAccount
from heliotrope.twin.invariants.invariants import Judge

#: Bits of the flags in STATUS.
_MOVING, _SUN_FRESH, _CLOCK_SET, _CONFIGURED, _READY, _AT_STOW = (1 << i for i in range(6))
_DOUBTFUL, _UNKNOWN = 1 << 8, 1 << 9
#: Bits that nothing in the simulation can set: a present fault, the switch at the heliostat, a bus
#: key.
_NEVER_SET = 1 << 14 | 1 << 17 | 1 << 18
#: Motors that received steps within the first time are turning; those that received none for the
#: second are at rest, s.
TURNS, RESTS = 0.02, 1.0
#: The lease of a sun vector, including the allowed clock difference, s.
FRESH, OLD = 5.0, 6.3
#: Largest error of the time since boot, s, and of the age of a sun vector, s, which counts from its
#: whole second.
UPTIME_NEAR, AGE_NEAR = 1.3, 0.5
#: Maximum transit time of a reply, s.
BEGUN = 0.1
#: Maximum age of a status on arrival, s: its wait for a connection plus the transit.
UNDER_WAY = 2.3
#: Leases arrive every second and last for three: remaining time of the last one, s.
LEASE_LEAST, LEASE_MOST = 0.3, 3.1
#: How late and how early the cluster's time may be when a status arrives on a working line, s; the
#: longest second of work, s.
LATE, EARLY, CYCLE_MOST = 1.0, 0.3, 1.5


@dataclass
class _Board:
    """One board: the observer's record of its heliostat, and the board's replies.

    Attributes
    ----------
    account
        The observer's record of the heliostat.
    moves_since, off_since
        Time since which it has reported that it is moving; time since which it has reported goals
        that differ from its position, s.
    told_at, goals
        When it last reported its flags, s; its last reported goals.
    boots, booted
        The last reported boot count, and the account's boots and power cuts at that time.
    steps
        Times (s) and values of the STEPS messages that the cluster received.
    """

    account: HeliostatAccount
    moves_since: float = inf
    told_at: float = -inf
    goals: tuple[int, ...] = ()
    off_since: float = inf
    boots: int | None = None
    booted: tuple[int, int] = (0, 0)
    steps: deque[tuple[float, tuple[int, ...]]] = field(default_factory=lambda: deque(maxlen=64))


class AnswerObserver(Judge):
    """Observes the replies on one bus and the statuses of its cluster.

    Parameters
    ----------
    cluster
        Name of the cluster.
    accounts
        Accounts of its heliostats.
    start
        Origin of the times that it reports, s.

    Attributes
    ----------
    quiet
        Function that returns the heliostats in an undisturbed period; see `QuietObserver`.
    utc
        Function that returns the true POSIX time, s.
    """

    def __init__(self, cluster: str, accounts: Sequence[HeliostatAccount], start: float) -> None:
        super().__init__(start)
        self.quiet: Callable[[], Collection[str]] = frozenset
        self.utc: Callable[[], float] = lambda: 0.0
        self._cluster = cluster
        self._boards = {account.address: _Board(account) for account in accounts}
        self._late_at = -inf
        self._later: list[tuple[bool, str, str]] = []

    def _calmly(self, good: bool, subject: str, saw: str) -> None:
        """Queue a check that need not hold after a failure.

        The next look, which knows of all failures, decides whether to judge it.
        """
        if subject == self._cluster:
            calm = all(board.account.name in self.quiet() for board in self._boards.values())
        else:
            calm = subject in self.quiet()
        if calm:
            self._later.append((good, subject, saw))

    def look(self, now: float) -> None:
        """Judge the checks queued since the last look, unless something has failed."""
        later, self._later = self._later, []
        calm = self.quiet()
        whole = all(board.account.name in calm for board in self._boards.values())
        for good, subject, saw in later:
            if subject in calm or (subject == self._cluster and whole):
                self.check(11, good, now, subject, saw)

    # -- the bus ---------------------------------------------------------------------------

    def heard(self, how: str, now: float) -> None:
        """Record whether bytes reach a board whole, since a late frame may follow a reply."""
        if how != "whole":
            self._late_at = now

    def answered(self, data: bytes, how: str, now: float) -> None:
        """Judge a reply as it leaves its board; only a complete reply describes this instant."""
        frames = wire.Reader().feed(data)
        # If a late reply came first, only the last frame is current.
        for frame in frames[-1:] if how == "late" else frames:
            board = self._boards.get(frame.sender)
            values = frame.values()
            if board is None or values is None:
                continue
            if frame.name == "STEPS":
                board.steps.append((now, tuple(int(value) for value in values)))
            if how != "whole" or now == self._late_at or board.account.board.node is None:
                continue
            if frame.name == "STATUS":
                self._status(board, values, now)
            elif frame.name == "STEPS":
                self._steps(board, values, now)

    def _status(self, board: _Board, values: Sequence[Any], now: float) -> None:
        account = board.account
        state, flags, fault, uptime, age_ms, supply, warmth, crc, boots = values
        prefix = f"STATUS says {states.STATES[account.state]}: "
        name = account.name

        def check(good: bool, saw: str) -> None:
            self.check(11, good, now, name, prefix + saw)

        check(state == account.state, f"state {state}, but it is {account.state}")
        check((supply, warmth) == (0, 0), f"{supply} mV, {warmth} °C, but it measures neither")
        faulty = account.state in (states.FAULT, states.LOCKED)
        check(faulty or fault == 0, f"fault {fault}")
        check(account.state != states.FAULT or fault != 0, "no fault")
        held = account.board.node.journal.items if account.board.node is not None else {}
        right = zlib.crc32(held.get("armature", b"")) if "armature" in held else 0
        check(crc == right, f"armature {crc:08x}, but it stores {right:08x}")
        self._booted(board, int(boots), now)
        self._flags(board, int(flags), now)
        if not account.ticks_jumped:
            since = now - account.booted_at
            near = abs(uptime + 0.5 - since) <= UPTIME_NEAR
            check(near, f"{uptime} s of uptime, but it booted {since:.1f} s ago")
            if flags & _SUN_FRESH:
                age = now - account.sun_at
                saw = f"{prefix}a sun vector {age_ms} ms old, but it was sent {age:.2f} s ago"
                # A reply may have begun before the latest sun vector arrived.
                near = age < BEGUN or abs(age_ms / 1000.0 - age) <= AGE_NEAR
                self._calmly(near, name, saw)
        if not flags & _SUN_FRESH:
            check(age_ms == NEVER, f"a sun vector {age_ms} ms old that is not marked as fresh")

    def _booted(self, board: _Board, boots: int, now: float) -> None:
        account = board.account
        before, (boots_then, cuts_then) = board.boots, board.booted
        board.boots, board.booted = boots, (account.boots, account.cuts)
        if before is not None:
            least, most = account.boots - boots_then, account.cuts - cuts_then
            saw = f"{boots} boots, after {before} before, but it has booted {least} times since"
            # A boot that a power cut interrupted may have been counted.
            good = account.unsure or least <= boots - before <= most
            self.check(11, good, now, account.name, saw)

    def _flags(self, board: _Board, flags: int, now: float) -> None:
        account = board.account
        name, state = account.name, account.state

        def check(good: bool, saw: str) -> None:
            self.check(
                11, good, now, name, f"flags {flags:#x} in state {states.STATES[state]}: {saw}"
            )

        check(not flags & _NEVER_SET, "a fault, a switch or a key that it does not have")
        turns = now - account.stepped_at < TURNS
        check(bool(flags & _MOVING) or not turns, "it reports no motion, but its motors turn")
        # A motion that has just begun is about to make its first step. Between two replies that are
        # far apart, one motion may have ended and another begun.
        lapsed, board.told_at = now - board.told_at > RESTS, now
        before = inf if lapsed else board.moves_since
        board.moves_since = min(before, now) if flags & _MOVING else inf
        rests = now - max(account.stepped_at, account.changed_at, board.moves_since)
        saw = f"it reports motion, but its motors have been at rest for {rests:.1f} s"
        check(account.ticks_jumped or rests <= RESTS, saw)
        age = now - account.sun_at
        saw = f"the sun vector was sent {age:.1f} s ago"
        check(not flags & _SUN_FRESH or age <= OLD, f"fresh, but {saw}")
        # On a bus without keys, a stranger's frame can use up the frame counts, including that of
        # SUN.
        fresh = bool(flags & _SUN_FRESH) or account.ticks_jumped or account.misled
        self._calmly(
            bool(fresh) or age < BEGUN or age >= FRESH,
            name,
            f"STATUS says that no sun vector is fresh, but {saw}",
        )
        check(not flags & _SUN_FRESH or bool(flags & _CLOCK_SET), "a sun vector without a time")
        complete = state != states.UNCONFIGURED
        check(bool(flags & _CONFIGURED) == complete, "whether it is configured")
        check(not flags & _READY or account.by_way, "ready, but it has not reached standby")
        up = state in (states.TRACKING, states.SEARCHING)
        check(bool(flags & _READY) or not up, "not ready")
        stows = account.place() == account.stow()
        known = not flags & _UNKNOWN
        check(
            not flags & _AT_STOW or not known or stows, f"at stow, but it is at {account.place()}"
        )
        check(bool(flags & _AT_STOW) or state != states.STOWED, "not at stow")
        slips = any(account.board.slip) and not account.unsure
        saw = f"its step counts are reported as certain, but are wrong by {account.board.slip}"
        check(bool(flags & (_DOUBTFUL | _UNKNOWN)) or not slips, saw)
        check(
            not flags & (_DOUBTFUL | _UNKNOWN) or account.boots > 0,
            "step counts are reported as doubtful, but it has not booted",
        )

    def _steps(self, board: _Board, values: Sequence[int], now: float) -> None:
        account = board.account
        node = account.board.node
        if node is None or not node.controller.motion.known:
            return
        counts, goals = tuple(values[:2]), tuple(values[2:])
        place = account.place()
        saw = f"STEPS says {counts}, but it is at {place}"
        self.check(11, counts == place, now, account.name, saw)
        inside = all(low <= goal <= high for goal, (low, high) in zip(goals, RANGES, strict=True))
        self.check(
            11,
            inside,
            now,
            account.name,
            f"STEPS gives the goals {goals}, which are beyond its range",
        )
        held = account.state in (states.STOWED, states.LOCKED, states.FAULT) and goals != place
        # A boot ends the motion; a later motion with the same goals is a new one.
        goes_on = goals == board.goals and board.off_since > account.booted_at
        before = board.off_since if goes_on else inf
        board.goals, board.off_since = goals, min(before, now) if held else inf
        rests = now - max(account.stepped_at, account.changed_at, board.off_since)
        saw = f"it is at rest at {place}, but STEPS gives the goals {goals}"
        self.check(11, account.ticks_jumped or rests <= RESTS, now, account.name, saw)

    # -- the line --------------------------------------------------------------------------

    def on_status(self, status: ClusterStatus, names: Sequence[str], now: float) -> None:
        """Judge a cluster status as it reaches the plant."""
        by_name = {known.account.name: known for known in self._boards.values()}
        for name, row in zip(names, status.nodes(), strict=True):
            board = by_name.get(name)
            if board is None:
                continue
            reported = tuple(int(row[column]) for column in _STEPS)
            if int(row["steps_ms"]) == NEVER:
                self.check(
                    11,
                    not any(reported),
                    now,
                    name,
                    f"steps {reported} are reported, but were never requested",
                )
                continue
            at = now - int(row["steps_ms"]) / 1000.0
            near = [v for t, v in board.steps if at - UNDER_WAY <= t <= at + 0.2]
            saw = (
                f"steps {reported} are reported, of {now - at:.2f} s ago, but its reply was "
                "different"
            )
            self.check(11, reported in near, now, name, saw)
            asked, answered = int(row["asked"]), int(row["answered"])
            self.check(11, answered <= asked, now, name, f"{answered} replies to {asked} queries")
        self._numbers(status)

    def _numbers(self, message: ClusterStatus) -> None:
        """Check the values in a cluster's status, unless something near the cluster has failed."""
        remaining = message.lease_left
        saw = f"{remaining:.2f} s of the plant's lease remain"
        self._calmly(LEASE_LEAST <= remaining <= LEASE_MOST, self._cluster, saw)
        off = message.utc_s - self.utc()
        self._calmly(-LATE <= off <= EARLY, self._cluster, f"its time is {off:+.2f} s off")
        cycle = message.cycle_s
        saw = f"its one-second cycle took {cycle:.2f} s"
        self._calmly(0.0 < cycle <= CYCLE_MOST, self._cluster, saw)
        saw = f"its safety table demands {', '.join(message.acts)}, but nothing has failed"
        self._calmly(not message.acts, self._cluster, saw)
        saw = (
            f"its time error is {message.time_error_s} s, with time quality {message.time_quality}"
        )
        self._calmly(0.0 <= message.time_error_s < 1.0, self._cluster, saw)


#: Columns of a record that STEPS fills.
_STEPS = ("primary", "secondary", "primary_goal", "secondary_goal")
