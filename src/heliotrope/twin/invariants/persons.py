"""The observer of operators: their orders and locks last until they are ended (invariant 17).

The observer keeps its own ledger of the operators' calls, not of what the plant reports: the
emergencies that each operator ordered, with their actions, and withdrew; the heliostats that each
operator locked, and the locks removed. While an order is active, the plant shows it under its
owner's name, an emergency of at least that action is active, and no heliostat is up once it has had
the time to turn away. A heliostat that an operator has locked remains at rest at stow until its
last lock is removed, whatever is ordered, and nothing is written to it.

A board that restarts is exempt until it is at rest again, because no lock can prevent a motion at
start-up. For that reason, anyone who works at a heliostat switches its drives off at the mirror.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

from heliotrope.lcu import states
from heliotrope.lcu.node import Node
from heliotrope.plant.controller import PlantController
from heliotrope.safety import Act
from heliotrope.twin.boards.board import Board
from heliotrope.twin.invariants.invariants import WORDS, Judge

#: Time within which a new program continues orders in force, and within which an order is shown, s.
RECALLED_WITHIN, SHOWN_WITHIN = 2.0, 1.0
#: No heliostat is up this long after an order, s: 30 s plus the time between two judgements.
DOWN_WITHIN = 31.0
#: Time after which a command sent before a lock has ended, s: its lifetime plus delay on the bus.
UNDER_WAY = 15.0
#: A locked heliostat counts as moving if its motors turn by more than this, steps: idle drivers let
#: a coarse motor turn to its nearest full step.
STANDS = 32
#: States in which a heliostat tracks, or is on its way to tracking.
_UP = (states.APPROACHING, states.TRACKING, states.SEARCHING)


@dataclass
class _Lock:
    """The locks on a heliostat.

    The owners with the times of their locks, the motor positions at which the heliostat must stand
    still, and the program (node) that was running then.
    """

    owners: dict[str, float] = field(default_factory=dict)
    node: Node | None = None
    place: tuple[int, int] | None = None


@dataclass(frozen=True)
class Words:
    """The operators' orders and locks at some time: orders by owner, and owners of locks."""

    orders: dict[str, tuple[Act, float]]
    locks: dict[str, tuple[str, ...]]


class PersonsObserver(Judge):
    """Observes whether operators' orders and locks are kept; see the module.

    Parameters
    ----------
    start
        Origin of the times that it reports, s.
    boards
        All heliostats.
    alone
        Whether this plant is the only one that ever commands the heliostats.

    Attributes
    ----------
    orders
        Emergency orders in force: action and time, s, by owner.
    """

    def __init__(self, start: float, boards: Sequence[Board], *, alone: bool = True) -> None:
        super().__init__(start)
        self.orders: dict[str, tuple[Act, float]] = {}
        self._alone = alone
        self._boards = {board.outfit.name: board for board in boards}
        self._locks: dict[str, _Lock] = {}
        self._plant: PlantController | None = None
        self._since, self._confirmed = float("inf"), True

    # -- what operators do -----------------------------------------------------------------------

    def on_call(self, owner: str, act: Act, now: float) -> None:
        """Record an emergency order; an operator's stronger order replaces the weaker one."""
        before, at = self.orders.get(owner, (act, now))
        self.orders[owner] = max(act, before), at

    def withdrew(self, owner: str) -> None:
        """Record that an operator's order was withdrawn, by that operator or by an engineer."""
        self.orders.pop(owner, None)

    def withdrawal_refused(self, owner: str, reason: str, now: float) -> None:
        """Check a refused withdrawal: a plant must accept the withdrawal of an order in force."""
        self.check(
            WORDS, False, now, "plant", f"the withdrawal of {owner}'s order is refused: {reason}"
        )

    def locked(self, owner: str, heliostats: Sequence[str], now: float) -> None:
        """Record that an operator has locked heliostats."""
        for name in heliostats:
            self._locks.setdefault(name, _Lock()).owners[owner] = now

    def on_write(self, heliostat: str, what: str, now: float) -> None:
        """Check that nothing is written to a locked heliostat, as its next STOW would move it."""
        lock = self._locks.get(heliostat)
        since = now - min(lock.owners.values()) if lock is not None else 0.0
        saw = f"{what} is sent to it {since:.1f} s after it was locked"
        self.check(WORDS, since <= UNDER_WAY, now, heliostat, saw)

    def returned(self, owner: str, heliostats: Sequence[str]) -> None:
        """Record that an operator's locks were removed, by that operator or by an engineer."""
        for name in heliostats:
            lock = self._locks.get(name, _Lock())
            lock.owners.pop(owner, None)
            if not lock.owners:
                self._locks.pop(name, None)

    @property
    def sure(self) -> bool:
        """Whether the plant's store is certain to contain the present locks."""
        return self._confirmed

    @property
    def locks(self) -> dict[str, tuple[str, ...]]:
        """Owners of the locks on each heliostat."""
        return {name: tuple(lock.owners) for name, lock in self._locks.items()}

    @property
    def parked(self) -> tuple[str, ...]:
        """Heliostats that are locked and at rest at stow, where someone may be working on them."""
        return tuple(name for name, lock in self._locks.items() if lock.place is not None)

    # -- the plant's store ---------------------------------------------------------------------

    def words(self) -> Words:
        """Return the orders and locks that a backup of the plant's store would now contain."""
        return Words(dict(self.orders), self.locks)

    def restored(self, words: Words, now: float) -> None:
        """Record that the plant's store was restored from a backup, with the orders of that time.

        The present locks stay in force. Until operators have confirmed the contents of the store
        (`confirmed`), the store is not compared with them.
        """
        self.orders = {owner: (act, now) for owner, (act, _) in words.orders.items()}
        self._confirmed = False

    def confirmed(self) -> None:
        """Record that operators have applied their locks again and removed old ones."""
        self._confirmed = True

    def forget(self) -> None:
        """Forget all orders and locks, because the plant had no store and has ended."""
        self.orders, self._locks = {}, {}

    # -- judgement -----------------------------------------------------------------------------

    def look(self, plant: PlantController | None, now: float) -> None:
        """Judge orders and locks; ``plant`` is None if the plant program is not running."""
        if plant is not self._plant:
            self._plant, self._since = plant, now
        if plant is not None and now - self._since > RECALLED_WITHIN:
            self._stands(plant, now)
            if self._confirmed:
                self._shown(plant, now)
        if self._alone:
            self._down(now)
        for name, lock in self._locks.items():
            self._still(name, lock, now)

    def _stands(self, plant: PlantController, now: float) -> None:
        """Check that each order is in force under its owner's name, and that no other order is."""
        shown = {call.who for call in plant.sentinel.calls}
        for owner, (act, at) in self.orders.items():
            if now - at <= SHOWN_WITHIN:
                continue
            saw = f"{owner} ordered {act.name} {now - at:.1f} s ago and has not withdrawn it, but "
            self.check(WORDS, owner in shown, now, "plant", f"{saw}the plant names no such order")
            order = plant.sentinel.order
            holds = plant.sentinel.on and order is not None and order.act >= act
            does = f"{order.act.name} holds" if order and plant.sentinel.on else "none holds"
            self.check(WORDS, holds, now, "plant", f"{saw}{does}")
        for owner in shown:
            saw = f"an emergency order of {owner} is still active, although it was withdrawn"
            self.check(WORDS, owner in self.orders, now, "plant", saw)

    def _shown(self, plant: PlantController, now: float) -> None:
        """Check that the plant has exactly the locks that operators have applied."""
        present = {(lock.name, lock.who) for lock in plant.lockouts}
        required = {(name, owner) for name, lock in self._locks.items() for owner in lock.owners}
        for name, owner in sorted(required ^ present):
            what = "is not there" if (name, owner) in required else "is there, and was returned"
            self.check(WORDS, False, now, name, f"the lock of {owner} {what}")
        self.check(WORDS, True, now, "plant", "")

    def _down(self, now: float) -> None:
        """Check that no heliostat is up while an operator's emergency order is in force."""
        if not self.orders:
            return
        owner, (act, at) = min(self.orders.items(), key=lambda order: order[1][1])
        for name, board in self._boards.items():
            saw = f"{states.STATES[board.state]} {now - at:.1f} s after {owner} ordered {act.name}"
            self.check(WORDS, now - at <= DOWN_WITHIN or board.state not in _UP, now, name, saw)

    def _still(self, name: str, lock: _Lock, now: float) -> None:
        """Check that a locked heliostat stays still once it has come to stow."""
        board = self._boards[name]
        if board.node is None:
            return
        azimuth, elevation = (axis.turned for axis in board.axes)
        rests = all(axis.idle for axis in board.axes)
        if board.node is not lock.node or lock.place is None:
            lock.node, lock.place = board.node, None
            since = min(lock.owners.values())
            if rests and board.state == states.STOWED and now - since > UNDER_WAY:
                lock.place = azimuth, elevation
            return
        moved = max(abs(azimuth - lock.place[0]), abs(elevation - lock.place[1]))
        saw = f"{states.STATES[board.state]}, {moved} steps from its position when it was locked "
        saw += f"by {', '.join(lock.owners)}"
        self.check(WORDS, moved <= STANDS, now, name, saw)
