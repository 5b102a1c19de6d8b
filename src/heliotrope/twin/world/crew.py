"""The people of a working day: two operators, a script, and a field attendant.

The operators and the script act at critical moments: when heliostats travel to a visit, between its
photographs, while a heliostat is locked to write its parameters, or while beams are being
separated. Two people may act at the same time. Some time later the attendant withdraws emergencies,
presses Resume, and gives the field back to automatic control. On every other day, on average,
everyone leaves at lunchtime, and automatic control has the rest of the day. A run may plan their
actions instead (`CrewAct`).
"""

import asyncio
import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf

from heliotrope.lcu import states
from heliotrope.plant.operations import Operations
from heliotrope.plant.orders.authority import Person, RefusedError, Role
from heliotrope.safety import Act
from heliotrope.twin.boards.board import Board
from heliotrope.twin.world.acts import Acts
from heliotrope.twin.world.operator import ENGINEER, OPERATOR, VIEWER

#: The script, which has an operator's token.
SCRIPT = Person("script", Role.OPERATOR)
#: All operators of a crew whose actions are reported.
CREW = (OPERATOR, ENGINEER, VIEWER, SCRIPT)
#: Mean time between two actions of one operator, and longest wait for a moment, s.
_PAUSE, _PATIENCE = 110.0, 60.0
#: Longest time from a moment until an operator acts, s.
_AFTER = 3.0
#: Interval between checks of the plant, s.
_LOOK = 0.5
#: Maximum durations on duty, of an emergency, until someone attends to the field, and of lunch, s.
_DUTY, _EMERGENCY, _CARE, _LUNCH = 40.0, 40.0, 40.0, 60.0
#: Fraction of days on which all leave, and fraction of the day at which they do.
_LEAVE, _LEFT = 0.5, 0.45
#: Words in the stages of visits for which operators wait; locking of a heliostat; and any time.
LOCKED, ANY_TIME = "locked", "any time"
MOMENTS = (
    "on the way", "empty target", "photograph", "on the way back", "taking the beams apart",
    "learning", "verification", LOCKED, ANY_TIME,
)  # fmt: skip
#: Actions with their weights; see `Crew.acts`.
WEIGHTS = {
    "duty": 5, "rough": 1, "seizes": 1, "leaves": 1, "off": 3, "hold": 2, "emergency": 2,
    "calibrate": 3, "together": 1, "receiver": 1, "switch": 1, "parameters": 2, "points": 2,
    "lunch": 1,
}  # fmt: skip


@dataclass(frozen=True)
class CrewAct:
    """A planned action of one person.

    Attributes
    ----------
    what
        A key of `WEIGHTS`.
    moment
        The moment for which the person waits, one of `MOMENTS`.
    after
        Time from the moment to the action, s.
    person
        The person who acts.
    """

    what: str
    moment: str = ANY_TIME
    after: float = 0.0
    person: Person = ENGINEER


class Crew:
    """The operators of a working day.

    Parameters
    ----------
    acts
        The actions available to the operators.
    boards
        All heliostats, which the operators see.
    seconds
        Length of the day, s.
    rough
        Whether the engineer sets all heliostats to coarse steps in the morning.
    planned
        Planned actions, one after another; None if actions are drawn at random. The attendant is
        always there.
    """

    def __init__(
        self,
        acts: Acts,
        boards: Sequence[Board],
        seconds: float,
        *,
        rough: bool,
        planned: Sequence[CrewAct] | None = None,
    ) -> None:
        self._rough, self._planned = rough, planned
        self._acts, self._boards, self._chance = acts, tuple(boards), acts.chance
        self._begin = acts.now()
        share = _LEFT if self._chance.random() < _LEAVE else 1.0
        self._until = self._begin + share * seconds
        self._ends_at = 0.0  # the emergency is kept until then
        self._care_at: float | None = None

    async def work(self) -> None:
        """Work until cancelled."""
        await asyncio.sleep(4.0)
        if self._rough and (operations := self._acts.present()) is not None:
            with contextlib.suppress(RefusedError):
                await self._acts.once(operations, ENGINEER, "ROUGH", (1.0,))
        async with asyncio.TaskGroup() as group:
            group.create_task(self._cares())
            if self._planned is not None:
                group.create_task(self._follows(self._planned))
                return
            for person in (OPERATOR, ENGINEER, SCRIPT):
                group.create_task(self._acts_as(person))

    # -- looking after the field ---------------------------------------------------------------

    async def _cares(self) -> None:
        """Withdraw emergencies, press Resume and give the field back, each after a short delay."""
        while True:
            await asyncio.sleep(_LOOK)
            operations, now = self._acts.present(), self._acts.now()
            if operations is None or now < self._ends_at:
                continue
            if self._care_at is None:
                soon = 2.0 if now - self._begin < _CARE else _CARE
                self._care_at = now + self._chance.uniform(1.0, soon)
            if now >= self._care_at:
                self._care_at = None
                with contextlib.suppress(RefusedError):
                    self._acts.tidies(operations)

    # -- acting --------------------------------------------------------------------------------

    async def _acts_as(self, person: Person) -> None:
        """Act from time to time, at a critical moment."""
        while True:
            await asyncio.sleep(self._chance.expovariate(1.0 / _PAUSE))
            await self._moment(self._chance.choice(MOMENTS))
            await asyncio.sleep(self._chance.uniform(0.0, _AFTER))
            what = self._chance.choices(list(WEIGHTS), list(WEIGHTS.values()))[0]
            operations = self._acts.present()
            if operations is None or self._acts.now() > self._until:
                continue
            with contextlib.suppress(RefusedError):
                await self._does(what, operations, person)

    async def _follows(self, planned: Sequence[CrewAct]) -> None:
        """Act as planned, each time as soon as the planned moment comes."""
        for act in planned:
            await self._moment(act.moment, inf)
            await asyncio.sleep(act.after)
            while (operations := self._acts.present()) is None:
                await asyncio.sleep(_LOOK)
            with contextlib.suppress(RefusedError):
                await self._does(act.what, operations, act.person)

    async def _moment(self, moment: str, patience: float = _PATIENCE) -> None:
        """Wait until a visit reaches a stage, for at most ``patience`` s."""
        until = self._acts.now() + patience
        while self._acts.now() < until and moment not in self._moments():
            await asyncio.sleep(_LOOK)

    def _moments(self) -> set[str]:
        operations = self._acts.present()
        running = () if operations is None else operations.automatic.view().running
        moments = {word for word in MOMENTS for run in running if word in run.stage}
        if any(board.state == states.LOCKED for board in self._boards):
            moments.add(LOCKED)
        return moments | {ANY_TIME}

    async def _does(self, what: str, operations: Operations, person: Person) -> None:
        acts, chance = self._acts, self._chance
        if what == "off":
            await acts.takes_off(operations)
        elif what == "hold":
            await acts.holds(operations, person)
        elif what == "emergency":
            self._ends_at = acts.now() + chance.uniform(2.0, _EMERGENCY)
            act = chance.choice([Act.DEFOCUS, Act.DEFOCUS, Act.STOW])
            acts.emergency(operations, chance.choice([VIEWER, person]), act)
        elif what in ("calibrate", "together", "receiver"):
            on_receiver = what == "receiver"
            acts.calibrate(operations, person, together=what == "together", receiver=on_receiver)
        elif what == "switch":
            acts.switches(operations, person, on=False)
            await asyncio.sleep(chance.uniform(5.0, _CARE))
            if (later := acts.present()) is not None:
                acts.switches(later, person, on=True)
        elif what == "lunch":
            await self._duty("leaves", operations, person)
            await asyncio.sleep(chance.uniform(0.0, _LUNCH))
            if (later := acts.present()) is not None:
                await self._duty("duty", later, person)
        else:
            await self._duty(what, operations, person)

    async def _duty(self, what: str, operations: Operations, person: Person) -> None:
        """Take the command authority and command some or all heliostats."""
        everybody = what == "rough" and person is ENGINEER
        commands = self._roughens if everybody else self._some
        if what == "points":
            commands = self._points
        elif what == "parameters" and person is ENGINEER:
            commands = self._acts.parameters
        if person is SCRIPT:
            commands = self._all
        await self._acts.duty(
            operations,
            person,
            most=_DUTY,
            commands=commands,
            reason="it is my shift" if what == "seizes" else "",
            leaves=what == "leaves",
        )

    def _roughens(self, operations: Operations, person: Person, token: int) -> None:
        """Switch all heliostats to coarse or fine steps."""
        rough = float(self._chance.random() < 0.7)
        self._acts.command(operations, person, token, "ROUGH", (), (rough,))

    def _all(self, operations: Operations, person: Person, token: int) -> None:
        what = self._chance.choice(["TRACK", "IDLE", "REFOCUS", "APPROACH"])
        self._acts.command(operations, person, token, what, ())

    def _points(self, operations: Operations, person: Person, token: int) -> None:
        names = self._chance.sample(self._acts.names, self._chance.randint(1, 3))
        self._acts.points(operations, person, token, names)

    def _some(self, operations: Operations, person: Person, token: int) -> None:
        """Issue commands to one heliostat or a few, or (most often) to none."""
        chance, acts = self._chance, self._acts
        names = chance.sample(acts.names, chance.randint(1, 3))
        does: list[Callable[[], None]] = [
            lambda: acts.command(operations, person, token, "TRACK", names),
            lambda: acts.command(operations, person, token, "IDLE", names),
            lambda: acts.command(operations, person, token, "REFOCUS", names),
            lambda: acts.command(operations, person, token, "LOCK", names[:1]),
            lambda: acts.command(operations, person, token, "UNLOCK", names[:1]),
            lambda: acts.aims(operations, person, token, names),
        ]
        chance.choice(does)()
