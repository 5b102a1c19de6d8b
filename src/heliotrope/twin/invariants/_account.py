"""The observer's record of a single heliostat."""

from collections import deque
from struct import unpack
from typing import Any

from heliotrope.lcu import messages, motion, states, wire
from heliotrope.lcu.journal import items_of
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.outfit import LIMITS, STOW
from heliotrope.twin.invariants.ledger import Sent

#: Time by which the steps handed to a timer may run ahead of its rate, s.
AHEAD = 0.2
#: Steps are made in slots of this length, s. In each slot the speed may change by one step more
#: than the acceleration allows, because steps are whole. A longer pause than the second number is a
#: stop, s.
SLOT, PAUSE = 0.05, 0.5
#: The sun vector is sent every second; a heliostat counts as served for this long afterwards, s.
SERVED = 2.0
#: Braking takes at most half a second; after this time only the axis that is due may move, s.
BRAKING = 1.0
#: Reason why a heliostat that its cluster's file does not name must leave: it still receives SUN
#: and stays DEFOCUSED.
UNLISTED = "it is missing from the cluster's file"
#: Tolerance of the true stow position, steps.
NEAR_STOW = 5000


def fingerprint(board: Board, *, gate: bool, clock: bool) -> dict[str, object]:
    """Return all values of a board that a refused frame must leave unchanged.

    Parameters
    ----------
    board
        A board with power.
    gate
        Whether to include the gate's count of frames, which forged frames and frames replayed from
        before a restart of the cluster may use up.
    clock
        Whether to include clock and gate. A board that has received no later frame of the same
        epoch may accept an old time, which voids commands and ends the lease early but moves
        nothing.
    """
    node = board.node
    assert node is not None
    own, moves = node.controller, node.controller.motion
    values: dict[str, object] = {
        "state": own.state, "motion": moves.kind, "aim": moves.aim, "ready": moves.ready,
        "primary goal": moves.goal(0), "secondary goal": moves.goal(1), "fault": own.fault,
        "standby": own.config.standby, "journal": id(node.journal.items),
    }  # fmt: skip
    if clock:
        values |= {
            "second": own.clock.second,
            "millisecond": own.clock.ms,
            "flags": own.flags(),
            "sun age": own.sun.age_ms(),
        }
    if own.gate is not None:
        values |= {"token": own.gate.token, "edition": own.gate.edition}
        if gate and clock:
            values |= {"epoch": own.gate.replay.epoch, "count": own.gate.replay.count}
    return values


def steps_from_stow(board: Board) -> int:
    """Return how far a board's axes truly are from stow, in steps of the farther axis."""
    return max(abs(axis.turned - stow) for axis, stow in zip(board.axes, STOW, strict=True))


class HeliostatAccount:
    """One heliostat as the observer knows it.

    Attributes
    ----------
    state
        Last state seen; -1 without power.
    sun_at
        When the cluster sent the newest sun vector that the heliostat has received, s.
    taken
        Index of the last frame received whole, except queries and safe orders.
    in_hand, how, forged, quiet, before, good
        The frame being received: the cluster's frame, how it arrived, the forged frame, the
        invariant under which the frame must change nothing, and the fingerprint and the number of
        good frames before it arrived.
    statuses
        Times (s) and values of the last STATUS replies that the cluster received.
    from_stow
        Whether it has left stow and has not tracked since.
    stows
        All stow positions ever sent to the heliostat, steps.
    by_way
        Whether it has reached its standby point since it was last at stow or without power.
    booted_at, boots, cuts
        When it last booted, s; how often it has booted and lost power since the start.
    stepped_at
        When its timers last received steps, s.
    ticks_jumped, misled
        Whether its counter has jumped since it booted; whether it has received a frame from a
        stranger.
    unsure
        Whether another heliostat's board is or was installed, or a drive has stalled, so that the
        motors may not be where the step counts say.
    written, unlisted_at
        Its name in its cluster's file; when the name went missing there, s, or None if it is
        present.
    foot
        Closest approach of its beam to the foot of the safe path in this approach, m; 0 if unknown.
    """

    def __init__(self, board: Board, now: float) -> None:
        self.board = board
        self.address, self.name = board.outfit.address, board.outfit.name
        self.state = board.state
        self.sun_at = float("-inf")
        self.taken = -1
        self.in_hand: Sent | None = None
        self.how = ""
        self.forged: wire.Frame | None = None
        self.quiet = 0
        self.before: dict[str, object] = {}
        self.good = 0
        self.statuses: deque[tuple[float, tuple[Any, ...]]] = deque(maxlen=64)
        self.from_stow = False
        self.stows = {STOW}
        self.by_way = False
        self.foot = float("inf")
        self.booted_at, self.boots, self.cuts = now, 0, 0
        self.stepped_at = float("-inf")
        self._slot_ends, self._slot_steps = [float("-inf")] * 2, [0, 0]
        self.ticks_jumped = self.misled = self.unsure = False
        self.written = self.name
        self.unlisted_at: float | None = None
        self._history: deque[tuple[float, int]] = deque([(now, self.state)], maxlen=64)
        self._items = board.node.journal.items if board.node is not None else board.outfit.items
        self._pending: dict[str, bytes] = {}
        self._served_at = now
        self._ordered: dict[str, float] = {}
        self._level = [0.0, 0.0]
        self._filled_at = [now, now]
        self._leg = 0  # leaving stow: 0 no, 1 azimuth expected, 2 azimuth moved, 3 elevation moves
        self._stowing_since: float | None = None
        self._on_since: float | None = None
        self._stays_since: float | None = None

    # -- states ----------------------------------------------------------------------------

    def entered(self, state: int, now: float) -> None:
        """Record a new state."""
        if state == states.APPROACHING:
            self._leg = 1 if self.state == states.STOWED else 0
            self.from_stow, self.foot = True, float("inf")
        elif state in (states.TRACKING, states.SEARCHING, states.DEFOCUSED):
            self.from_stow = False
        if state in (states.STOWED, states.STOWING):
            self.by_way = False
        elif (self.state, state) == (states.APPROACHING, states.IDLE):
            self.by_way = True
        under_way = (states.APPROACHING, states.TRACKING, states.SEARCHING, states.LOCKED)
        by_itself = state == states.IDLE and self.state == states.APPROACHING
        if state in under_way or (state == states.IDLE and not by_itself):
            # A later command has replaced this order.
            self._ordered.clear()
        self.state = state
        self._history.append((now, state))

    @property
    def changed_at(self) -> float:
        """Time at which the heliostat entered its state or booted, s."""
        return self._history[-1][0]

    def was_in(self, choice: tuple[int, ...], since: float) -> bool:
        """Return whether the heliostat has been in one of the given states since a time."""
        begun = [state for at, state in self._history if at <= since][-1:]
        later = [state for at, state in self._history if at > since]
        return any(state in choice for state in begun + later)

    def cut(self, now: float) -> None:
        """Record a power failure."""
        sent = self.in_hand
        self._pending = {}
        if sent is not None and sent.who == messages.KEY:
            self._pending = items_of(sent.name, sent.payload)
        elif sent is not None and sent.name == "STANDBY":
            self._pending = {"standby": sent.payload[8:]}
        self.in_hand, self.how, self.quiet = None, "", 0
        self._ordered.clear()
        self.cuts += 1
        self._leg, self._stowing_since = 0, None
        self.from_stow = self.by_way = False
        self.state = -1
        self._history.append((now, -1))

    def booted(self, now: float) -> None:
        """Record a boot: the times restart, and earlier frames no longer count."""
        self.state = self.board.state
        self.booted_at, self.boots = now, self.boots + 1
        self.ticks_jumped = self.misled = False
        self._history.append((now, self.state))
        self._served_at = now
        self.taken = -1
        self.sun_at = float("-inf")
        self._level = [0.0, 0.0]
        self._slot_steps = [0, 0]
        self.keep()

    # -- the journal -----------------------------------------------------------------------

    def keep(self) -> bool:
        """Record the contents of the journal; return whether they have changed.

        Comparing references is enough, because each store creates a new dictionary and leaves the
        old one unchanged.
        """
        node = self.board.node
        assert node is not None
        changed = node.journal.items is not self._items
        self._items = node.journal.items
        if node.controller.motion.kind != motion.STOW:
            self._stowing_since = None
        elif self._stowing_since is None:
            self._stowing_since = self.board.now
        return changed

    def mixture(self, held: dict[str, bytes]) -> str:
        """Return in words which journal items match neither the old nor the new record, or ""."""
        old = dict(self._items)
        if held in (old, {**old, **self._pending}):
            return ""
        differing = [name for name in {**old, **held} if held.get(name) != old.get(name)]
        return "other values of " + ", ".join(sorted(differing))

    # -- steps -----------------------------------------------------------------------------

    def place(self) -> tuple[int, int]:
        """Return the step counts that result from all steps handed to the timers."""
        azimuth, elevation = (
            a.emitted - s for a, s in zip(self.board.axes, self.board.slip, strict=True)
        )
        return azimuth, elevation

    def stow(self) -> tuple[int, int]:
        """Return the stow position stored in the journal, steps."""
        azimuth, elevation = unpack("<ii", self._items["stow"])
        return azimuth, elevation

    def stands_at_stow(self) -> bool:
        """Return whether the axes are truly at stow, and not only according to the step counts."""
        return steps_from_stow(self.board) <= NEAR_STOW

    def rate(self, axis: int, count: int, now: float) -> str:
        """Record steps handed to a timer now; return an error in their rate, or ""."""
        self.stepped_at = now
        limit = float(LIMITS[0])
        drained = limit * (now - self._filled_at[axis])
        self._filled_at[axis] = now
        level = self._level[axis] = max(0.0, self._level[axis] - drained) + count
        if level <= AHEAD * limit:
            return ""
        return f"axis {axis} is {level:.0f} steps ahead of {limit:.0f} steps/s"

    def ramp(self, axis: int, steps: int, now: float) -> str:
        """Record the signed steps of a slot; return an error in their acceleration, or ""."""
        most = LIMITS[1] * SLOT * SLOT + 2.0
        begin = max(now, self._slot_ends[axis])
        before = self._slot_steps[axis]
        error = ""
        if begin - self._slot_ends[axis] > PAUSE or before * steps < 0:  # it has stopped since
            if abs(before) > most:
                error = f"axis {axis} stopped from {before} steps in a slot, limit {most:.0f}"
            before = 0
        if abs(steps - before) > most:
            error = f"axis {axis} went from {before} to {steps} steps in a slot, limit {most:.0f}"
        self._slot_ends[axis], self._slot_steps[axis] = begin + SLOT, steps
        return "" if self.ticks_jumped else error

    def order(self, axis: int) -> str | None:
        """Record a segment; return an error in the order of the axes, or "".

        Return None if the axes may move in any order now.
        """
        board = self.board
        if self._stowing_since is not None and board.now - self._stowing_since > BRAKING:
            if axis == 1:
                return ""
            raised = self.place()[1] not in {elevation for _, elevation in self.stows}
            return (
                f"azimuth moves to stow while elevation is still at {self.place()[1]}"
                if raised
                else ""
            )
        if self._leg == 0 or board.state != states.APPROACHING:
            return None
        if axis == 1:
            early = self._leg == 1
            self._leg = 3
            return "elevation leaves stow before azimuth" if early else ""
        if self._leg == 3:
            if board.axes[0].idle and board.axes[1].idle:
                self._leg = 0
                return ""
            return "azimuth keeps moving while elevation leaves stow"
        self._leg = 2
        return ""

    def jumped(self) -> None:
        """Record a counter jump, after which the board may take pending steps for completed."""
        self._leg, self.foot = 0, 0.0
        self.ticks_jumped = True

    # -- deadlines -------------------------------------------------------------------------

    def served(self, now: float, leased: bool) -> None:
        """Record whether the plant and the cluster serve the heliostat."""
        if leased and now - self.sun_at <= SERVED:
            self._served_at = now

    def crosses(self, on: bool, now: float) -> float:
        """Record whether the beam is on the receiver; return how long it has been there, s."""
        if not on:
            self._on_since = None
            return 0.0
        if self._on_since is None:
            self._on_since = now
        return now - self._on_since

    def stays(self, on: bool, now: float) -> float:
        """Record whether a DEFOCUSED heliostat's beam is on the receiver.

        Return how long it has been there, s.
        """
        if not on:
            self._stays_since = None
            return 0.0
        begun = max(self._stays_since or now, self.changed_at)
        self._stays_since = begun
        return now - begun

    def must(self, name: str, now: float) -> None:
        """Record an order to DEFOCUS or STOW."""
        if self.board.node is not None:
            self._ordered.setdefault(name, now)

    def forget(self) -> None:
        """Forget the orders, because the cluster that had to carry them out is gone."""
        self._ordered.clear()

    def deadlines(self, now: float) -> list[tuple[str, float]]:
        """Return the reasons why the heliostat must leave, each with its start time, s."""
        causes = list(self._ordered.items())
        if now - self._served_at > SERVED:
            causes.append(("it was cut off", self._served_at))
        if self.unlisted_at is not None:
            causes.append((UNLISTED, self.unlisted_at))
        return causes

    def must_stow(self, why: str) -> bool:
        """Return whether a reason requires stow, and not only defocus."""
        return why not in ("DEFOCUS", UNLISTED)
