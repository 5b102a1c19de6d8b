"""The observer of operators: what an operator has ordered or locked lasts until it is ended (17).

It keeps its own ledger, from the calls that operators make and not from the plant: the emergencies
that each operator ordered, with their actions, and withdrew; the heliostats that each operator
locked, and the locks removed. While an order is active, the plant shows it under its owner's name,
an emergency of at least that action is active, and no heliostat is up once it has had the time to
turn away. A heliostat that an operator has locked remains at rest at stow until its last lock is
removed, whatever is ordered, and nothing is written to it.

A board that restarts is exempt until it is at rest again, because no lock can prevent what it does
at start-up; that is why anyone who works at a heliostat uses its switch.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

from heliotrope.lcu import states
from heliotrope.lcu.node import Node
from heliotrope.plant.controller import PlantController
from heliotrope.safety import Act
from heliotrope.twin.boards.board import Board
from heliotrope.twin.invariants.invariants import WORDS, Judge

#: A new program goes on with what holds within this, and an order shows within this, s.
RECALLED_WITHIN, SHOWN_WITHIN = 2.0, 1.0
#: No mirror is up this long after an order, s: 30 s, and the time between two judgements.
DOWN_WITHIN = 31.0
#: A command that left before a lock is over by then, s: its life, and late on the bus.
UNDER_WAY = 15.0
#: A locked mirror moves if its motors turn by more than this, steps: drivers that rest let a
#: coarse motor turn to its nearest full step.
STANDS = 32
#: States in which a mirror follows or seeks the sun.
_UP = (states.APPROACHING, states.TRACKING, states.SEARCHING)


@dataclass
class _Lock:
    """The locks on a heliostat: owners, since when; its place, and the program that counts it."""

    owners: dict[str, float] = field(default_factory=dict)
    node: Node | None = None
    place: tuple[int, int] | None = None


@dataclass(frozen=True)
class Words:
    """What operators had ordered and locked at some time: orders by owner, owners of locks."""

    orders: dict[str, tuple[Act, float]]
    locks: dict[str, tuple[str, ...]]


class PersonsObserver(Judge):
    """Observes what becomes of operators' orders and locks; see the module.

    Parameters
    ----------
    start
        Zero of the times that it reports, s.
    boards
        All heliostats.
    alone
        Whether no other plant commands the heliostats at times.

    Attributes
    ----------
    orders
        Emergency orders that stand: act and time, s, by owner.
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
        """Note an emergency order; an operator has one, of the stronger act."""
        before, at = self.orders.get(owner, (act, now))
        self.orders[owner] = max(act, before), at

    def withdrew(self, owner: str) -> None:
        """Note that an operator's order is withdrawn, by that operator or by an engineer."""
        self.orders.pop(owner, None)

    def withdrawal_refused(self, owner: str, reason: str, now: float) -> None:
        """Check a refused withdrawal: a plant must accept the withdrawal of an order in force."""
        self.check(
            WORDS, False, now, "plant", f"the withdrawal of {owner}'s order is refused: {reason}"
        )

    def locked(self, owner: str, heliostats: Sequence[str], now: float) -> None:
        """Note that an operator has locked heliostats."""
        for name in heliostats:
            self._locks.setdefault(name, _Lock()).owners[owner] = now

    def on_write(self, heliostat: str, what: str, now: float) -> None:
        """Check that nothing is written to a locked heliostat: its next STOW would move it."""
        lock = self._locks.get(heliostat)
        since = now - min(lock.owners.values()) if lock is not None else 0.0
        saw = f"{what} is sent to it {since:.1f} s after it was locked"
        self.check(WORDS, since <= UNDER_WAY, now, heliostat, saw)

    def returned(self, owner: str, heliostats: Sequence[str]) -> None:
        """Note that an operator's locks are returned, by that operator or by an engineer."""
        for name in heliostats:
            lock = self._locks.get(name, _Lock())
            lock.owners.pop(owner, None)
            if not lock.owners:
                self._locks.pop(name, None)

    @property
    def sure(self) -> bool:
        """Whether the plant's store has the locks of now."""
        return self._confirmed

    @property
    def locks(self) -> dict[str, tuple[str, ...]]:
        """Owners of the locks on each heliostat."""
        return {name: tuple(lock.owners) for name, lock in self._locks.items()}

    @property
    def parked(self) -> tuple[str, ...]:
        """Heliostats that are locked and stand still at stow, so that somebody may be at them."""
        return tuple(name for name, lock in self._locks.items() if lock.place is not None)

    # -- the plant's store ---------------------------------------------------------------------

    def words(self) -> Words:
        """Return the orders and locks in force, as a backup of the plant's store holds them now."""
        return Words(dict(self.orders), self.locks)

    def restored(self, words: Words, now: float) -> None:
        """Note that the plant's store is a backup: it has the orders of that time.

        The locks of now go on, until operators have confirmed what the store has (`confirmed`).
        """
        self.orders = {owner: (act, now) for owner, (act, _) in words.orders.items()}
        self._confirmed = False

    def confirmed(self) -> None:
        """Note that operators have put their locks again, and returned old ones."""
        self._confirmed = True

    def forget(self) -> None:
        """Forget all: the plant had no store, and has ended."""
        self.orders, self._locks = {}, {}

    # -- judgement -----------------------------------------------------------------------------

    def look(self, plant: PlantController | None, now: float) -> None:
        """Judge orders and locks; None: the plant's program does not run."""
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
        """Check that each order stands under its owner's name, and that no other does."""
        shown = {call.who for call in plant.sentinel.calls}
        for owner, (act, at) in self.orders.items():
            if now - at <= SHOWN_WITHIN:
                continue
            saw = f"{owner} ordered {act.name} {now - at:.1f} s ago and has not withdrawn it, and "
            self.check(WORDS, owner in shown, now, "plant", f"{saw}the plant names no such order")
            order = plant.sentinel.order
            holds = plant.sentinel.on and order is not None and order.act >= act
            does = f"{order.act.name} holds" if order and plant.sentinel.on else "none holds"
            self.check(WORDS, holds, now, "plant", f"{saw}{does}")
        for owner in shown:
            saw = f"an emergency order of {owner} stands, which is withdrawn"
            self.check(WORDS, owner in self.orders, now, "plant", saw)

    def _shown(self, plant: PlantController, now: float) -> None:
        """Check that the plant has the locks of each operator, and no others."""
        present = {(lock.name, lock.who) for lock in plant.lockouts}
        required = {(name, owner) for name, lock in self._locks.items() for owner in lock.owners}
        for name, owner in sorted(required ^ present):
            what = "is not there" if (name, owner) in required else "is there, and was returned"
            self.check(WORDS, False, now, name, f"the lock of {owner} {what}")
        self.check(WORDS, True, now, "plant", "")

    def _down(self, now: float) -> None:
        """Check that no mirror is up while somebody's order stands."""
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
        saw = f"{states.STATES[board.state]}, {moved} steps from where it stood when it was locked "
        saw += f"by {', '.join(lock.owners)}"
        self.check(WORDS, moved <= STANDS, now, name, saw)
