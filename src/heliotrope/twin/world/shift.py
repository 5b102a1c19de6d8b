"""Operators alongside automatic control: they give it the field, and interrupt it occasionally.

The operators are rarely on duty. They give heliostats back to automatic control, withdraw
emergencies, and let automatic control resume after a loss. Occasionally they take the command
authority for a while, send a heliostat to stow, take one out of service, or order an emergency in
the middle of a visit.
"""

import asyncio
import contextlib
import functools
from dataclasses import dataclass

from heliotrope.geometry import FloatArray
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations import Operations
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.safety import Act
from heliotrope.twin.invariants.watch import Watch
from heliotrope.twin.world.acts import Acts
from heliotrope.twin.world.crew import Crew
from heliotrope.twin.world.operator import ENGINEER, VIEWER
from heliotrope.twin.world.work import Work

#: Interval between checks by an operator, s.
LOOK = 2.0
#: Longest time on duty, s.
_DUTY = 15.0
#: Longest emergency, during which no other work continues, s.
_EMERGENCY = 12.0


@dataclass(frozen=True)
class Working:
    """Automatic control in a run, with its operators and the observers of its work."""

    control: Work
    shift: "Shift | Crew"
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

        ``quiet`` is None if a cluster is wrong from the start, because its heliostats may then do
        nothing, and its reports concern other heliostats. ``waits`` means that the plant program is
        frozen.
        """
        watch, operations = self.watch, None if waits else self.control.operations
        watch.visits.look(plant, sun, now)
        if quiet is None:
            return
        if watch.flux is not None:
            watch.flux.look(None if waits else plant, sun, now, governs=governs)
        watch.day.look(plant, quiet, sun, now)
        watch.results.look(operations, now)
        watch.progress.look(operations, quiet, sun, now, governs=governs)
        watch.shown.look(operations, quiet, sun, now)


class Shift:
    """The operators of a run with automatic control.

    Parameters
    ----------
    acts
        The actions available to the operators.
    pause
        Mean time between two interruptions, s.
    aims
        Whether operators on duty also choose aims on the receiver.
    """

    def __init__(self, acts: Acts, pause: float, *, aims: bool = False) -> None:
        self._acts, self._pause, self._aims = acts, pause, aims
        self._chance = acts.chance

    async def work(self) -> None:
        """Look after the field until cancelled."""
        acts = self._acts
        await asyncio.sleep(4.0)
        due = acts.now() + self._chance.expovariate(1.0 / self._pause)
        while True:
            await asyncio.sleep(LOOK)
            operations = acts.present()
            if operations is None:
                continue
            if acts.now() >= due:
                due = acts.now() + self._chance.expovariate(1.0 / self._pause)
                with contextlib.suppress(RefusedError):
                    await self._interrupts(operations)
            elif operations.plant.sentinel.on or self._chance.random() < 0.3:
                acts.tidies(operations)

    async def _interrupts(self, operations: Operations) -> None:
        acts = self._acts
        does = self._chance.choice(
            [self._duty, self._duty, acts.takes_off, acts.holds, self._emergency]
        )
        await does(operations)

    async def _duty(self, operations: Operations) -> None:
        acts, commands = self._acts, self._acts.commands
        if self._aims and self._chance.random() < 0.5:
            name = self._chance.choice(acts.names)
            commands = functools.partial(acts.points, names=(name,))
        await acts.duty(operations, ENGINEER, most=_DUTY, commands=commands)

    async def _emergency(self, operations: Operations) -> None:
        self._acts.emergency(operations, VIEWER, Act.DEFOCUS)
        await asyncio.sleep(self._chance.uniform(2.0, _EMERGENCY))
