"""Persons beside automatic control: they give it the field, and interrupt it now and then.

They are rarely on duty. They give heliostats back, clear emergencies, and let automatic control go
on after a loss; and now and then they take the command authority for a while, send a mirror to
stow, take one out of service, or raise an emergency in the middle of a visit.
"""

import asyncio
import contextlib
import random
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from heliotrope.geometry import FloatArray
from heliotrope.links.clock import Clock
from heliotrope.plant.authority import Person, RefusedError
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations import Operations
from heliotrope.plant.operations.automatic import AUTOMATIC
from heliotrope.safety import Act
from heliotrope.twin.invariants.beams import BeamObserver
from heliotrope.twin.invariants.day import DayObserver
from heliotrope.twin.invariants.plant_observer import PlantObserver
from heliotrope.twin.invariants.progress import ProgressObserver
from heliotrope.twin.invariants.results import ResultObserver
from heliotrope.twin.invariants.shown import ShownObserver
from heliotrope.twin.invariants.visits import VisitObserver
from heliotrope.twin.world.operator import ENGINEER, VIEWER, Operator
from heliotrope.twin.world.work import Work

#: Pause between two looks of a person, s.
_LOOK = 2.0
#: Longest time on duty, s.
_DUTY = 15.0
#: Longest emergency, s: until it is over, nothing goes on.
_EMERGENCY = 12.0


@dataclass(frozen=True)
class Watch:
    """The observers of automatic control, and of what the plant shows of it."""

    visits: VisitObserver
    day: DayObserver
    results: ResultObserver
    progress: ProgressObserver
    shown: ShownObserver

    @property
    def checks(self) -> Counter[int]:
        """Number of checks of each invariant, of all of them."""
        some = (self.visits, self.day, self.results, self.progress, self.shown)
        return sum((each.checks for each in some), Counter())

    # -- what persons tell -------------------------------------------------------------------

    def acted(self, operations: Operations | None, person: Person, word: str, now: float) -> None:
        """Note an act in a program; its event there has this word in it."""
        self.shown.acted(operations, person.name, word, now)

    def given(self, heliostats: Sequence[str], now: float) -> None:
        """Note that heliostats were given to automatic control."""
        self.day.given(heliostats, now)
        self.progress.given(heliostats)

    def taken(self, heliostats: Sequence[str]) -> None:
        """Note that a person moves heliostats."""
        self.day.taken(heliostats)
        self.progress.taken(heliostats)

    def held(self, heliostats: Sequence[str], now: float, *, out: bool) -> None:
        """Note that heliostats go out of service, or come back."""
        self.progress.held(heliostats, now, out=out)
        self.shown.held(heliostats, now, out=out)


@dataclass(frozen=True)
class Working:
    """Automatic control of a run, the persons beside it, and the observers of its work."""

    control: Work
    shift: "Shift"
    watch: Watch

    def look(
        self,
        plant: PlantController | None,
        quiet: frozenset[str] | None,
        sun: FloatArray,
        now: float,
        *,
        waits: bool,
        governs: bool,
    ) -> None:
        """Judge the work; see the observers.

        ``quiet`` is None where a cluster is wrong from the start: its mirrors may do nothing, and
        what is reported is true of others. ``waits``: the plant's program is frozen.
        """
        watch, operations = self.watch, None if waits else self.control.operations
        watch.visits.look(plant, sun, now)
        if quiet is None:
            return
        watch.day.look(plant, quiet, sun, now)
        watch.results.look(operations, now)
        watch.progress.look(operations, quiet, sun, now, governs=governs)
        watch.shown.look(operations, quiet, sun, now)


class Shift:
    """The persons of a run with automatic control.

    Parameters
    ----------
    work
        Automatic control.
    operator
        Its persons' means: clears what latches, raises emergencies.
    observer, beams, watch
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
        watch: Watch,
        names: Sequence[str],
        clock: Clock,
        seed: int,
        pause: float,
    ) -> None:
        self._work, self._operator = work, operator
        self._observer, self._beams, self._watch = observer, beams, watch
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
            self._acted("resumed")
        names = tuple(name for name in self._names if name not in self._left)
        out = {lockout.heliostat for lockout in operations.holds()}
        if back := sorted(out - self._left):
            operations.unhold(ENGINEER, back)
            self._acted("back in service")
            self._watch.held(back, self._clock.monotonic(), out=False)
        operations.give_back(ENGINEER, names)
        self._acted(f"{len(names)} heliostats given")
        self._beams.given(names, self._clock.monotonic())
        self._watch.given(names, self._clock.monotonic())
        self._left.clear()

    def _acted(self, word: str, person: Person = ENGINEER) -> None:
        self._watch.acted(self._work.operations, person, word, self._clock.monotonic())

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
        self._watch.day.on_duty(self._clock.monotonic())
        token = operations.take_authority(ENGINEER).token
        self._acted("has the command authority")
        self._observer.granted(ENGINEER, token, self._clock.monotonic(), seized=False)
        until = self._clock.monotonic() + self._chance.uniform(2.0, _DUTY)
        with contextlib.suppress(RefusedError):
            while self._clock.monotonic() < until and self._present() is operations:
                operations.keep_authority(ENGINEER, token)
                self._observer.kept(self._clock.monotonic())
                self._watch.day.on_duty(self._clock.monotonic())
                if self._chance.random() < 0.2:
                    self._commands(operations, token)
                await asyncio.sleep(1.0)
        if self._work.operations is operations and not self._operator.waits:
            with contextlib.suppress(RefusedError):
                operations.release_authority(ENGINEER, token)
                self._acted("command authority back")
                self._observer.released(ENGINEER, self._clock.monotonic())

    def _commands(self, operations: Operations, token: int) -> None:
        name = self._chance.choice(self._names)
        what = self._chance.choice(["IDLE", "TRACK", "APPROACH", "REFOCUS"])
        self._watch.taken((name,))
        ticket = operations.command(ENGINEER, token, what, (name,))
        self._acted(f"{what} {name}")
        now = self._clock.monotonic()
        self._observer.accepted(ENGINEER, token, ticket, what, now)
        self._beams.resumed(ticket.heliostats, what, now)

    async def _takes_off(self, operations: Operations) -> None:
        """Take a mirror off, in a visit or not."""
        name = self._chance.choice(self._names)
        self._watch.taken((name,))
        what = self._chance.choice(["DEFOCUS", "STOW"])
        self._beams.taken((name,))
        ticket = (operations.defocus if what == "DEFOCUS" else operations.stow)(VIEWER, (name,))
        self._acted(f"{what} {name}", VIEWER)
        self._observer.obeyed(VIEWER.name, what, self._clock.monotonic(), ticket.identity)
        self._left.add(name)

    async def _holds(self, operations: Operations) -> None:
        """Take a mirror out of service: it goes to stow."""
        name = self._chance.choice(self._names)
        self._watch.taken((name,))
        self._beams.taken((name,))
        operations.hold(ENGINEER, (name,), "washing")
        self._acted(f"{name} out of service")
        self._watch.held((name,), self._clock.monotonic(), out=True)
        self._observer.obeyed(ENGINEER.name, "STOW", self._clock.monotonic())
        self._left.add(name)

    async def _emergency(self, operations: Operations) -> None:
        self._watch.taken(self._names)
        self._operator.raises(operations.plant, VIEWER, Act.DEFOCUS)
        operations.automatic.want(self._names, wanted=False)
        await asyncio.sleep(self._chance.uniform(2.0, _EMERGENCY))
