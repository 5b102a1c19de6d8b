"""The world "tour": nothing fails, and an engineer leads each heliostat through all commands.

An observer of faults finds nothing in a field that does nothing. Here each command must be carried
out: it is accepted, ends as done in time, the board is in the state that it asks for, and the plant
shows it; no alarm is raised. At the end the whole field is defocused by an emergency, which is
proven, and comes back.
"""

import asyncio
import random
from collections.abc import Sequence

from heliotrope.lcu import states
from heliotrope.links.clock import Clock
from heliotrope.mechanism.board_items import packed
from heliotrope.plant.controller import PlantController
from heliotrope.plant.tickets import Ticket
from heliotrope.safety import Act
from heliotrope.twin.boards.board import Board
from heliotrope.twin.invariants.plant_observer import PlantObserver
from heliotrope.twin.world.operator import ENGINEER, VIEWER, Operator

#: Name of the world, and how long it takes, s.
TOUR, TOUR_LENGTH = "tour", 240.0
#: Commands in turn, and the state that each ends in.
STEPS = (
    ("AIM", "STOWED"), ("PARAMETERS", "STOWED"), ("APPROACH", "IDLE"), ("TRACK", "TRACKING"),
    ("AIM", "TRACKING"), ("ROUGH", "TRACKING"), ("DEFOCUS", "DEFOCUSED"), ("REFOCUS", "TRACKING"),
    ("SEARCH", "IDLE"), ("JOG", "IDLE"), ("IDLE", "IDLE"), ("STANDBY", "IDLE"), ("LOCK", "LOCKED"),
    ("UNLOCK", "IDLE"), ("IDLE", "IDLE"), ("DIAGNOSE", "IDLE"), ("TRACK", "TRACKING"),
)  # fmt: skip
#: Alarms of every run: its safety table lacks the rows on the share of failed nodes.
EXPECTED = ("unknown_reading",)
#: A command is done in this time; those that go far, or rest on each point, in the other, s.
SOON, LATER = 20.0, 120.0
FAR = ("APPROACH", "STOW")
#: Pitch and radius of a search, rad, and the time that it takes, s.
SPIRAL, SPIRAL_TAKES = (4e-3, 8e-3), 30.0
#: Rest after a command, for the plant to be told, s.
REST = 2.5
#: An emergency takes every beam off the receiver within this, s.
OFF_WITHIN = 30.0


class Tour:
    """Leads each heliostat through `STEPS`, then the field through an emergency.

    Parameters
    ----------
    operator
        Gives the commands.
    observer
        Told of what fails.
    boards
        The heliostats.
    clock
        True time.
    seed
        Seed of the pauses.

    Attributes
    ----------
    over
        Whether it has been led to its end.
    """

    def __init__(
        self,
        operator: Operator,
        observer: PlantObserver,
        boards: Sequence[Board],
        clock: Clock,
        seed: int,
    ) -> None:
        self._operator, self._observer, self._clock = operator, observer, clock
        self._boards = {board.outfit.name: board for board in boards}
        self._chance = random.Random(f"tour {seed}")
        self.over = False

    async def work(self) -> None:
        """Lead all through the tour, then raise an emergency; return at the end of it.

        Raises
        ------
        InvariantError
            If a command is refused or not done.
        """
        await asyncio.sleep(5.0)  # until all have been heard
        self._operator.seize(self._plant, ENGINEER)
        await asyncio.sleep(REST)  # until the clusters have the new token
        async with asyncio.TaskGroup() as group:
            for name in self._boards:
                group.create_task(self._lead(name))
        await self._emergency()

    @property
    def _plant(self) -> PlantController:
        plant = self._operator.plant
        assert plant is not None, "the plant runs to the end of a tour"
        return plant

    def _check(self, good: bool, saw: str) -> None:
        self._observer.check(11, good, self._clock.monotonic(), saw)

    async def _lead(self, name: str) -> None:
        for what, state in STEPS:
            await asyncio.sleep(self._chance.expovariate(1.0))
            await self._done(what, name, state)
            alarms = [
                (alarm.condition, alarm.text)
                for alarm in self._plant.alarms
                if alarm.active and alarm.condition not in EXPECTED
            ]
            self._check(not alarms, f"an alarm where nothing fails: {alarms[:1]}")
        await self._done("STOW", name, "STOWED")
        await self._done("APPROACH", name, "IDLE")
        await self._done("TRACK", name, "TRACKING")

    async def _done(self, what: str, name: str, state: str) -> None:
        """Give a command, and check that it is carried out and shown."""
        if what in ("DEFOCUS", "STOW"):
            ticket: Ticket | None = self._operator.safe(self._plant, what, name)
        elif what == "PARAMETERS":
            biases = packed("biases", (self._chance.gauss(0.0, 1e-4), 0.0))
            ticket = self._operator.push(self._plant, name, {"biases": biases})
        else:
            values = SPIRAL if what == "SEARCH" else None
            ticket = self._operator.give(self._plant, what, (name,), values=values)
        self._check(ticket is not None, f"{what} {name} was refused: {self._operator.refusal}")
        assert ticket is not None
        good = await ticket.end(LATER if what in FAR else SOON)
        self._check(good, f"{what} {name} is not done: {ticket.text}")
        if what == "SEARCH":
            await asyncio.sleep(SPIRAL_TAKES)
        await asyncio.sleep(REST)
        self._shown(what, name, state)

    def _shown(self, what: str, name: str, state: str) -> None:
        board = self._boards[name]
        true = states.STATES[board.state]
        self._check(true == state, f"{what} {name}: the board is {true}, not {state}")
        row = self._plant.field.of(name, self._clock.monotonic())
        self._check(row.state == state, f"{what} {name}: {state}, and the plant shows {row.state}")

    async def _emergency(self) -> None:
        """Take the whole field off, and bring it back."""
        order = self._operator.raises(self._plant, VIEWER, Act.DEFOCUS)
        good = await order.ticket.end(OFF_WITHIN)
        self._check(good, f"an emergency is not carried out: {order.ticket.text}")
        await asyncio.sleep(REST)
        report = order.report(self._clock.monotonic())
        self._check(report.complete, f"an emergency is not proven: {report.text}")
        self._operator.clear(self._plant)
        await asyncio.sleep(REST)
        self._operator.clear(self._plant)
        await asyncio.sleep(REST)
        for name in self._boards:
            self._shown("an emergency", name, "DEFOCUSED")
        for name in self._boards:
            await self._done("REFOCUS", name, "TRACKING")
        self.over = True
