"""The environment "tour": nothing fails, and an engineer takes each heliostat through all commands.

Observers of faults cannot find errors in a field that does nothing. Here each command must be
carried out: it is accepted and done in time, the board reaches the requested state, the plant
displays that state, and no alarm is raised. A state is only a name, so the true heliostat is
checked too: its beam is on the specified point (invariant 12), and its motors have moved as
commanded. At the end an emergency defocuses the field and is confirmed, and the field returns to
work.
"""

import asyncio
import random
from collections.abc import Callable, Sequence

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.links.clock import Clock
from heliotrope.mechanism.board_items import packed
from heliotrope.plant.controller import PlantController
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.safety import Act
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.outfit import LIMITS, RECEIVER, STANDBY
from heliotrope.twin.invariants.invariants import OFF
from heliotrope.twin.world.operator import ENGINEER, VIEWER, Operator, Point

#: Name of the world, and how long it takes, s.
TOUR, TOUR_LENGTH = "tour", 300.0
#: Commands in turn, and the state that each ends in.
STEPS = (
    ("AIM", "STOWED"), ("PARAMETERS", "STOWED"), ("APPROACH", "IDLE"), ("TRACK", "TRACKING"),
    ("AIM", "TRACKING"), ("ROUGH", "TRACKING"), ("DEFOCUS", "DEFOCUSED"), ("REFOCUS", "TRACKING"),
    ("SEARCH", "IDLE"), ("JOG", "IDLE"), ("IDLE", "IDLE"), ("STANDBY", "IDLE"), ("LOCK", "LOCKED"),
    ("UNLOCK", "IDLE"), ("IDLE", "IDLE"), ("DIAGNOSE", "IDLE"), ("TRACK", "TRACKING"),
)  # fmt: skip
#: Alarms of every run, because its safety table lacks the rows on the fraction of failed nodes.
EXPECTED = ("unknown_reading",)
#: Time limits for a command, and for commands that move far or stop at each point, s.
SOON, LATER = 20.0, 120.0
FAR = ("APPROACH", "STOW")
#: Pitch and radius of a search, rad, and the time that it takes, s.
SPIRAL, SPIRAL_TAKES = (4e-3, 8e-3), 30.0
#: Pauses after a command, so that the plant is informed, and after LOCK, in which the sun moves by
#: more steps than the dead band of coarse stepping, s.
REST, LOCKED_FOR = 2.5, 10.0
#: Interval between checks of a moving heliostat, s.
LOOK = 0.2
#: Steps of a JOG, steps that the sun adds until the JOG is carried out, and least motion of each
#: axis in a diagnosis, which rotates the axes by 0.02 rad, steps.
JOGGED, DRIFT, NUDGED = 200, 60, 1000
#: Largest distance of the true beam from its point: as an angle, rad, plus a length, m. Backlash is
#: 0.5 mrad of the mirror, coarse stepping 0.25 mrad; beams rotate by twice these angles.
NEAR, NEAR_M = 4e-3, 0.1
#: A search must reach the last turn of its spiral: at least this fraction of its radius.
OUTWARD = 0.7
#: Commands that end with the beam at standby.
TO_STANDBY = ("APPROACH", "IDLE", "STANDBY", "SEARCH")
#: Time within which an emergency must move every beam off the receiver, s.
OFF_WITHIN = 30.0


class Tour:
    """Leads each heliostat through `STEPS`, then the field through an emergency.

    Parameters
    ----------
    operator
        Operator who issues the commands.
    boards
        The heliostats.
    clock
        Clock that shows true time.
    sun
        Function that returns the true direction to the sun, (3,), at a time in s.
    seed
        Seed of the pauses and of the jogs.

    Attributes
    ----------
    over
        Whether the tour is complete.
    """

    def __init__(
        self,
        operator: Operator,
        boards: Sequence[Board],
        clock: Clock,
        sun: Callable[[float], FloatArray],
        seed: int,
    ) -> None:
        self._operator, self._observer = operator, operator.panel.plant
        self._clock, self._sun = clock, sun
        self._boards = {board.outfit.name: board for board in boards}
        self._chance = random.Random(f"tour {seed}")
        self.over = False

    async def work(self) -> None:
        """Take all heliostats through the tour, then through an emergency; return at the end.

        Raises
        ------
        InvariantError
            If a command is refused or not done.
        """
        await asyncio.sleep(5.0)  # until all have reported
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

    def _check(self, good: bool, saw: str, number: int = 11) -> None:
        self._observer.check(number, good, self._clock.monotonic(), "plant", saw)

    async def _lead(self, name: str) -> None:
        for what, state in STEPS:
            await asyncio.sleep(self._chance.expovariate(1.0))
            await self._done(what, name, state)
            alarms = [
                (alarm.condition, alarm.text)
                for alarm in self._plant.alarms
                if alarm.active and alarm.condition not in EXPECTED
            ]
            self._check(not alarms, f"an alarm although nothing fails: {alarms[:1]}")
        await self._done("STOW", name, "STOWED")
        await self._done("APPROACH", name, "IDLE")
        await self._done("TRACK", name, "TRACKING")

    async def _done(self, what: str, name: str, state: str) -> None:
        """Issue a command, and check that it is carried out and displayed."""
        board, jog = self._boards[name], [0, 0]
        jog[self._chance.randrange(2)] = self._chance.choice([-JOGGED, JOGGED])
        before = _turned(board)
        ticket = self._ordered(what, name, jog)
        self._check(ticket is not None, f"{what} {name} was refused: {self._operator.refusal}")
        assert ticket is not None
        async with asyncio.TaskGroup() as group:
            end = group.create_task(ticket.end(LATER if what in FAR else SOON))
            swung = np.zeros(2)
            while not end.done():
                swung = np.maximum(swung, np.abs(_turned(board) - before))
                await asyncio.sleep(LOOK)
        self._check(end.result(), f"{what} {name} is not done: {ticket.text}")
        if what == "SEARCH":
            await self._searched(name)
        await asyncio.sleep(REST)
        self._shown(what, name, state)
        self._beam(what, name)
        moved = _turned(board) - before
        if what == "JOG":
            good = float(np.abs(moved - jog).max()) <= DRIFT
            self._check(good, f"JOG {name} by {jog} steps: its motors have turned by {moved}")
        elif what == "DIAGNOSE":
            good = float(swung.min()) >= NUDGED
            self._check(good, f"DIAGNOSE {name}: its motors have turned by {swung} steps at most")
        elif what == "LOCK":
            await self._stands(name)

    def _ordered(self, what: str, name: str, jog: Sequence[int]) -> Ticket | None:
        """Issue a command and return its ticket; return None if the command is refused."""
        if what in ("DEFOCUS", "STOW"):
            return self._operator.safe(self._plant, what, name)
        if what == "PARAMETERS":
            biases = packed("biases", (self._chance.gauss(0.0, 1e-4), 0.0))
            return self._operator.push(self._plant, name, {"biases": biases})
        axis = 0 if jog[0] else 1
        values = {"SEARCH": SPIRAL, "JOG": (float(axis), float(jog[axis]))}.get(what)
        return self._operator.give(self._plant, what, (name,), values=values)

    async def _searched(self, name: str) -> None:
        """Check that the beam follows the spiral to its last turn, and no further."""
        board, point = self._boards[name], self._operator.points["AIM", name]
        far, most = _far(board, point), 0.0
        until = self._clock.monotonic() + SPIRAL_TAKES
        while self._clock.monotonic() < until:
            if board.state == states.SEARCHING:
                most = max(most, self._miss(board, point))
            await asyncio.sleep(LOOK)
        low, high = OUTWARD * SPIRAL[1] * far, (SPIRAL[1] + NEAR) * far
        saw = f"SEARCH {name}: its beam came {most:.2f} m from its aim, not {low:.2f} to {high:.2f}"
        self._check(low <= most <= high, saw, 12)

    async def _stands(self, name: str) -> None:
        """Check that a locked heliostat stays at rest."""
        before = _turned(self._boards[name])
        await asyncio.sleep(LOCKED_FOR)
        moved = _turned(self._boards[name]) - before
        self._check(not moved.any(), f"LOCK {name}: its motors have turned by {moved} steps since")

    def _shown(self, what: str, name: str, state: str) -> None:
        board = self._boards[name]
        true = states.STATES[board.state]
        self._check(true == state, f"{what} {name}: the board is {true}, not {state}")
        row = self._plant.field.of(name, self._clock.monotonic())
        self._check(row.state == state, f"{what} {name}: {state}, and the plant shows {row.state}")

    def _beam(self, what: str, name: str) -> None:
        """Check that the true beam is at its point, or that the true heliostat is at stow."""
        board, points = self._boards[name], self._operator.points
        if board.state == states.STOWED:
            off = int(np.abs(_turned(board) - board.outfit.stow).max())
            self._check(off <= LIMITS[2], f"{what} {name}: STOWED {off} steps from stow")
        elif board.state == states.DEFOCUSED:
            miss = self._miss(board, RECEIVER)
            saw = f"{what} {name}: its beam is {miss:.1f} m from the middle of the receiver"
            self._check(miss > OFF, saw, 12)
        elif board.state == states.TRACKING or what in TO_STANDBY:
            tracks = board.state == states.TRACKING
            point = points["AIM", name] if tracks else points.get(("STANDBY", name), STANDBY)
            miss, limit = self._miss(board, point), NEAR * _far(board, point) + NEAR_M
            saw = f"{what} {name}: its beam is {miss:.2f} m from its point, limit {limit:.2f} m"
            self._check(miss <= limit, saw, 12)

    def _miss(self, board: Board, point: Point) -> float:
        return board.miss(self._sun(self._clock.monotonic()), (point[0], point[1], point[2]))

    async def _emergency(self) -> None:
        """Defocus the whole field with an emergency, and bring it back."""
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


def _turned(board: Board) -> FloatArray:
    """Return the true positions of the motors, steps, (2,)."""
    return np.array([axis.turned for axis in board.axes], dtype=np.float64)


def _far(board: Board, point: Point) -> float:
    return float(np.linalg.norm(np.subtract(point, board.outfit.mechanism.position)))
