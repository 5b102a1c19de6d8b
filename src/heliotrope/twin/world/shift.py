"""Persons beside automatic control: they give it the field, and interrupt it now and then.

They are rarely on duty. They give heliostats back, clear emergencies, and let automatic control go
on after a loss; and now and then they take the command authority for a while, send a mirror to
stow, take one out of service, or raise an emergency in the middle of a visit.
"""

import asyncio
import contextlib
import random
from collections.abc import Sequence
from dataclasses import dataclass

from heliotrope.links.clock import Clock
from heliotrope.plant.authority import RefusedError
from heliotrope.plant.operations import Operations
from heliotrope.plant.operations.automatic import AUTOMATIC
from heliotrope.safety import Act
from heliotrope.twin.invariants.beams import BeamObserver
from heliotrope.twin.invariants.day import DayObserver
from heliotrope.twin.invariants.plant_observer import PlantObserver
from heliotrope.twin.invariants.visits import VisitObserver
from heliotrope.twin.world.operator import ENGINEER, VIEWER, Operator
from heliotrope.twin.world.work import Work

#: Pause between two looks of a person, s.
_LOOK = 2.0
#: Longest time on duty, s.
_DUTY = 15.0
#: Longest emergency, s: until it is over, nothing goes on.
_EMERGENCY = 12.0


class Shift:
    """The persons of a run with automatic control.

    Parameters
    ----------
    work
        Automatic control.
    operator
        Its persons' means: clears what latches, raises emergencies.
    observer, beams, day
        Told of each act.
    names
        The heliostats.
    clock
        True time.
    seed
        Seed of their acts.
    pause
        Mean time between two interruptions, s.
    """

    def __init__(
        self,
        work: Work,
        operator: Operator,
        observer: PlantObserver,
        beams: BeamObserver,
        day: DayObserver,
        names: Sequence[str],
        clock: Clock,
        seed: int,
        pause: float,
    ) -> None:
        self._work, self._operator = work, operator
        self._observer, self._beams, self._day = observer, beams, day
        self._names, self._clock, self._pause = tuple(names), clock, pause
        self._chance = random.Random(f"shift {seed}")
        self._left: set[str] = set()  # what a person keeps from automatic control
        operator.commands = False

    async def work(self) -> None:
        """Look after the field without end."""
        await asyncio.sleep(4.0)
        due = self._clock.monotonic() + self._chance.expovariate(1.0 / self._pause)
        while True:
            await asyncio.sleep(_LOOK)
            operations = self._present()
            if operations is None:
                continue
            if self._clock.monotonic() >= due:
                due = self._clock.monotonic() + self._chance.expovariate(1.0 / self._pause)
                with contextlib.suppress(RefusedError):
                    await self._interrupts(operations)
            elif operations.plant.emergency_on or self._chance.random() < 0.3:
                self._tidies(operations)

    def _present(self) -> Operations | None:
        away = self._operator.away or self._operator.waits
        return None if away else self._work.operations

    def _tidies(self, operations: Operations) -> None:
        """Clear what latches, let automatic control go on, and give it the field."""
        self._operator.clear(operations.plant)
        if operations.plant.emergency_on:
            return
        if operations.automatic.waits:
            self._beams.released(self._clock.monotonic())
            operations.resume(ENGINEER)
        names = tuple(name for name in self._names if name not in self._left)
        out = {lockout.heliostat for lockout in operations.holds()}
        if back := sorted(out - self._left):
            operations.unhold(ENGINEER, back)
        operations.give_back(ENGINEER, names)
        self._beams.given(names)
        self._day.given(names, self._clock.monotonic())
        self._left.clear()

    # -- interruptions -----------------------------------------------------------------------

    async def _interrupts(self, operations: Operations) -> None:
        does = self._chance.choice(
            [self._duty, self._duty, self._takes_off, self._holds, self._emergency]
        )
        await does(operations)

    async def _duty(self, operations: Operations) -> None:
        """Take the authority for a while, and command; automatic control gives way."""
        grant = operations.plant.authority.grant
        its = grant.token if grant is not None and grant.holder == AUTOMATIC else 0
        self._observer.gave_way(self._clock.monotonic(), its)
        self._day.on_duty(self._clock.monotonic())
        token = operations.take_authority(ENGINEER).token
        self._observer.granted(ENGINEER, token, self._clock.monotonic(), seized=False)
        until = self._clock.monotonic() + self._chance.uniform(2.0, _DUTY)
        with contextlib.suppress(RefusedError):
            while self._clock.monotonic() < until and self._present() is operations:
                operations.keep_authority(ENGINEER, token)
                self._observer.kept(self._clock.monotonic())
                self._day.on_duty(self._clock.monotonic())
                if self._chance.random() < 0.2:
                    self._commands(operations, token)
                await asyncio.sleep(1.0)
        if self._work.operations is operations and not self._operator.waits:
            with contextlib.suppress(RefusedError):
                operations.release_authority(ENGINEER, token)
                self._observer.released(ENGINEER, self._clock.monotonic())

    def _commands(self, operations: Operations, token: int) -> None:
        name = self._chance.choice(self._names)
        what = self._chance.choice(["IDLE", "TRACK", "APPROACH", "REFOCUS"])
        self._day.taken((name,))
        ticket = operations.command(ENGINEER, token, what, (name,))
        now = self._clock.monotonic()
        self._observer.accepted(ENGINEER, token, ticket, what, now)
        self._beams.resumed(ticket.heliostats, what, now)

    async def _takes_off(self, operations: Operations) -> None:
        """Take a mirror off, in a visit or not."""
        name = self._chance.choice(self._names)
        self._day.taken((name,))
        what = self._chance.choice(["DEFOCUS", "STOW"])
        self._beams.taken((name,))
        (operations.defocus if what == "DEFOCUS" else operations.stow)(VIEWER, (name,))
        self._observer.obeyed(VIEWER.name, what, self._clock.monotonic())
        self._left.add(name)

    async def _holds(self, operations: Operations) -> None:
        """Take a mirror out of service: it goes to stow."""
        name = self._chance.choice(self._names)
        self._day.taken((name,))
        self._beams.taken((name,))
        operations.hold(ENGINEER, (name,), "washing")
        self._observer.obeyed(ENGINEER.name, "STOW", self._clock.monotonic())
        self._left.add(name)

    async def _emergency(self, operations: Operations) -> None:
        self._day.taken(self._names)
        self._beams.taken(self._names)
        self._operator.raises(operations.plant, VIEWER, Act.DEFOCUS)
        operations.automatic.want(self._names, wanted=False)
        await asyncio.sleep(self._chance.uniform(2.0, _EMERGENCY))


@dataclass(frozen=True)
class Working:
    """Automatic control of a run, the persons beside it, and the observers of its work."""

    control: Work
    shift: Shift
    observer: VisitObserver
    day: DayObserver
