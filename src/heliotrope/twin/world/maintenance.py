"""Maintenance staff in the environment "repairs": they lock, unlock, write and repair.

Two people lock heliostats, each with their own lock, and mostly choose heliostats that the other
person has already locked. They try to write to locked heliostats, declare the step counts of boards
that do not know them, and confirm the contents of a restored store.
"""

import math
import random
from collections.abc import Sequence

import numpy as np

from heliotrope.links.clock import Clock
from heliotrope.mechanism.board_items import packed
from heliotrope.plant.controller import PlantController
from heliotrope.plant.field.lockouts import TOWER
from heliotrope.plant.operations.service import Service
from heliotrope.plant.orders.authority import Person
from heliotrope.store.backup import OWNER
from heliotrope.store.records import Kind
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.outfit import MACHINE
from heliotrope.twin.invariants.plant_observer import MOMENT
from heliotrope.twin.world.operator import ENGINEER, OPERATOR, VIEWER, Operator

#: Fraction of the locks that are applied to a heliostat that is already locked.
_AGAIN = 0.6
#: Probability that the staff wait once more before confirming a restored store.
_LATER = 0.5
#: Fraction of the writes that set stow positions; a board at stow refuses other counts by itself.
_STOWS = 0.8
#: Change of the stow position or counts written to a locked heliostat, steps.
_OTHER = 2500


class Maintenance:
    """The maintenance staff in the field.

    Parameters
    ----------
    operator
        The plant's operators, one of whom writes parameters and declares counts.
    boards
        All heliostats.
    clock
        Clock that shows true time.
    seed
        Seed of their actions.

    Attributes
    ----------
    service
        Locks of the plant program, set by the owner; None while the program is not running.
    """

    def __init__(
        self,
        operator: Operator,
        boards: Sequence[Board],
        clock: Clock,
        seed: int,
    ) -> None:
        self.service: Service | None = None
        self._operator, panel = operator, operator.panel
        self._observer, self._beams, self._persons = panel.plant, panel.beams, panel.persons
        self._boards, self._clock = tuple(boards), clock
        self._names = tuple(board.outfit.name for board in boards)
        self._chance = random.Random(f"maintenance {seed}")
        self._put_at, self._written = -math.inf, ""

    def acts(self, plant: PlantController) -> None:
        """Perform one action."""
        if self.service is None:
            return
        if self._written:
            self._operator.safe(plant, "STOW", self._written)
            self._written = ""
            return
        does = self._chance.choice(["lock", "lock", "return", "write", "write", "mend", "two off"])
        if does == "lock":
            self._locks(self.service)
        elif does == "two off":
            self._takes_off(plant)
        elif does == "return":
            self._returns(self.service)
        elif does == "write" and self._persons.parked:
            self._writes(plant, self._chance.choice(self._persons.parked))
        elif does == "write":
            self._locks(self.service)
        else:
            self._mends(plant)

    def _locks(self, service: Service) -> None:
        """Take a heliostat out of service, mostly one that the other person has locked."""
        locked = sorted(self._persons.locks)
        again = locked and self._chance.random() < _AGAIN
        name = self._chance.choice(locked if again else self._names)
        self._puts(service, self._chance.choice([OPERATOR, ENGINEER]), name)

    def _puts(self, service: Service, person: Person, name: str) -> None:
        if self._clock.monotonic() - self._put_at < MOMENT:
            return  # the plant merges identical orders given at the same moment
        self._put_at = self._clock.monotonic()
        concerned = service.take(person, [(Kind.HELIOSTAT, name)], "washing", math.nan)
        now = self._clock.monotonic()
        self._persons.locked(person.name, (name,), now)
        self._beams.taken(concerned)
        self._observer.obeyed(person.name, "STOW", now)
        self._operator.counts["locks"] += 1

    def _returns(self, service: Service) -> None:
        """Remove a lock on behalf of its owner."""
        locks = self._persons.locks
        if locks and self._persons.sure:
            name = self._chance.choice(sorted(locks))
            owner = self._chance.choice(sorted(locks[name]))
            self._gives_back(service, Kind.HELIOSTAT, name, owner)
            self._persons.returned(owner, (name,))

    def _gives_back(self, service: Service, kind: Kind, name: str, owner: str) -> None:
        service.give_back(OPERATOR if owner == OPERATOR.name else ENGINEER, [(kind, name)], owner)
        self._operator.counts["locks returned"] += 1

    def confirms(self, plant: PlantController) -> None:
        """Confirm a restored store: apply the present locks, and remove the old ones.

        The tower's lock is removed last. Then the standby points are sent again.
        """
        service = self.service
        asks = service is not None and any(lock.who == OWNER for lock in service.out)
        if service is None or not asks or self._chance.random() < _LATER:
            return
        stored = {(lock.name, lock.who) for lock in service.out if lock.who != OWNER}
        held = {(name, owner) for name, some in self._persons.locks.items() for owner in some}
        if missing := sorted(held - stored):
            name, owner = missing[0]
            self._puts(service, ENGINEER if owner == ENGINEER.name else OPERATOR, name)
            return
        for name, owner in sorted(stored - held):
            self._gives_back(service, Kind.HELIOSTAT, name, owner)
        self._gives_back(service, Kind.TOWER, TOWER, OWNER)
        self._persons.confirmed()
        self._operator.give(plant, "STANDBY")

    def _writes(self, plant: PlantController, name: str) -> None:
        """Write a different stow position or counts to a locked heliostat, to be stowed later.

        The plant must refuse both, because the mirror could move while someone works on it.
        """
        steps = [self._chance.choice([-_OTHER, _OTHER]) for _ in range(2)]
        if self._chance.random() < _STOWS:
            stow = (MACHINE.stow[0] + steps[0], MACHINE.stow[1] + steps[1])
            self._operator.push(plant, name, {"stow": packed("stow", stow)})
        else:
            counts = plant.field.counts(np.array([plant.field.place(name)]))[0] + steps
            self._operator.zero(plant, name, [int(count) for count in counts])
        self._written = name

    def _takes_off(self, plant: PlantController) -> None:
        """Order two heliostats off with one command; a cluster may know only one of them."""
        names = self._chance.sample(self._names, min(2, len(self._names)))
        ticket = plant.defocus(VIEWER.name, names)
        self._observer.obeyed(VIEWER.name, "DEFOCUS", self._clock.monotonic(), ticket.identity)

    def _mends(self, plant: PlantController) -> None:
        """Declare the true step counts of a heliostat that has lost them."""
        board = self._chance.choice(self._boards)
        rests = all(axis.idle for axis in board.axes)
        if board.node is not None and not board.node.controller.motion.known and rests:
            place = [axis.turned for axis in board.axes]
            self._operator.zero(plant, board.outfit.name, place)
