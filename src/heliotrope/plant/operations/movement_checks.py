"""The daily motion diagnosis, before a heliostat is first raised.

A heliostat with a tilt sensor is released at stow (IDLE, where it holds), moves each axis a little
and back (DIAGNOSE), and is stowed again. A drive blocked by ice is thus found before its step
counts leave stow. `plant.field.drive_checks` takes the results.
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from heliotrope.lcu import states
from heliotrope.links.messages import Stage
from heliotrope.plant import refusals
from heliotrope.plant.attempts import Attempts, RetryLaw
from heliotrope.plant.controller import PlantController
from heliotrope.plant.motion.proofs import BeamError
from heliotrope.plant.orders.authority import Person
from heliotrope.plant.orders.guards import Asked
from heliotrope.safety import Alarm, alarms

#: Maximum number of heliostats diagnosed at once; they load the drive supply, but move no beam.
MOST = 200
#: Time limits for a heliostat to hold at stow, and for a diagnosis to end, s.
_HOLDS, _ENDS = 10.0, 180.0
#: Time limit for the result of a diagnosis, s.
_TELLS = 10.0
#: Diagnoses that are not completed, such as those interrupted by an operator.
CHECKING = RetryLaw(
    "diagnosis of movement",
    5,
    60.0,
    "it stays at stow; order Diagnose by hand, or correct tilt_sensor in the plant file",
    rest=3600.0,
    memory=3600.0,
    alarm=alarms.DIAGNOSIS_FAILS,
)

Mask = npt.NDArray[np.bool_]


class MovementChecks:
    """The diagnoses that automatic control orders.

    Parameters
    ----------
    plant
        The controller.
    person
        The person under whose name it commands.
    tell
        Called with each alarm.

    Attributes
    ----------
    attempts
        Heliostats whose diagnosis was not completed.
    """

    def __init__(
        self, plant: PlantController, person: Person, tell: Callable[[Alarm], None]
    ) -> None:
        self._plant, self._person = plant, person
        self.attempts = Attempts(CHECKING, tell)
        self._running: frozenset[str] = frozenset()

    @property
    def resting(self) -> Mask:
        """Mask of the heliostats that must not be raised: not diagnosed today, or stalled, (N,)."""
        plant = self._plant
        resting = np.zeros(len(plant.field), dtype=np.bool_)
        waiting = plant.drive_checks.due | plant.drive_checks.stalled.keys()
        resting[[plant.field.place(name) for name in waiting]] = True
        return (resting & plant.field.among((states.STOWED,), plant.now())) | self.moved

    @property
    def moved(self) -> Mask:
        """Mask of the heliostats under diagnosis, (N,)."""
        moved = np.zeros(len(self._plant.field), dtype=np.bool_)
        moved[[self._plant.field.place(name) for name in self._running]] = True
        return moved

    async def step(self, token: int, free: Mask) -> None:
        """Diagnose the free heliostats at stow that are due, at most `MOST` at once.

        Parameters
        ----------
        token
            Token of the command authority.
        free
            Heliostats that may be moved, (N,).
        """
        plant, now = self._plant, self._plant.now()
        free = free & plant.field.among((states.STOWED,), now)
        held = plant.guards.reasons(Asked("APPROACH", plant.field.names), refusals.NOT_NOW)
        names = tuple(
            name
            for name in sorted(plant.drive_checks.due - held.keys())
            if free[plant.field.place(name)] and self.attempts.due(name, now)
        )[:MOST]
        if not names:
            return
        self._running = frozenset(names)
        try:
            released = await self._given(token, "IDLE", names, _HOLDS)
            ended = await self._given(token, "DIAGNOSE", released, _ENDS)
            await plant.drive_checks.checked(ended, _TELLS)
        finally:
            plant.stow(self._person.name, names)
            self._running = frozenset()
            for name in names:
                if name in plant.drive_checks.due:
                    self.attempts.failed(name, "its diagnosis did not finish", plant.now())
                else:
                    self.attempts.done(name)

    async def _given(
        self, token: int, command: str, names: tuple[str, ...], limit: float
    ) -> tuple[str, ...]:
        """Issue a command, and return the heliostats that have carried it out."""
        if not names:
            return ()
        try:
            ticket = self._plant.command(self._person, token, command, names)
        except BeamError as error:
            rest = tuple(name for name in names if name not in error.refusals)
            return await self._given(token, command, rest, limit) if rest != names else ()
        await ticket.end(limit)
        return tuple(name for name in names if ticket.stage(name) is Stage.DONE)
