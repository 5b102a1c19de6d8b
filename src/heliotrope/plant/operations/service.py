"""Taking heliostats out of service and giving them back."""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.lcu import names as meanings
from heliotrope.lcu import states
from heliotrope.links.messages import Stage
from heliotrope.plant import refusals
from heliotrope.plant.attempts import Attempts, RetryLaw
from heliotrope.plant.authority import Person, Role
from heliotrope.plant.controller import PlantController
from heliotrope.plant.lockouts import Lockout
from heliotrope.plant.operations.errands import Step
from heliotrope.plant.operations.keeping import Keeping
from heliotrope.safety import Alarm, alarms

#: States from which a heliostat out of service is sent to stow.
_AWAY = (
    states.APPROACHING,
    states.IDLE,
    states.TRACKING,
    states.SEARCHING,
    states.DEFOCUSED,
)
#: Orders to stow, until a heliostat out of service is seen there.
PARKING = RetryLaw(
    "stow of a heliostat out of service",
    30,
    10.0,
    "STOW is repeated once a minute; a person inspects it",
    growth=1.0,
    rest=60.0,
    alarm=alarms.NOT_PARKED,
)
_SWITCHED_OFF = 1 << meanings.FLAGS.index("LOCAL_SWITCH")


class Service:
    """The heliostats out of service.

    Parameters
    ----------
    plant
        The controller, which refuses their motion.
    keeping
        Keeps them over a restart.
    tell
        Called with each alarm.

    Attributes
    ----------
    attempts
        Orders to stow, by heliostat.
    """

    def __init__(
        self, plant: PlantController, keeping: Keeping, tell: Callable[[Alarm], None]
    ) -> None:
        self._plant, self._keeping, self.attempts = plant, keeping, Attempts(PARKING, tell)
        plant.out_of_service.update(keeping.lockouts())
        #: Since when each has been out of service and not been seen in stow, monotonic s.
        self._unparked = dict.fromkeys(plant.out_of_service, -math.inf)

    @property
    def out(self) -> tuple[Lockout, ...]:
        """The heliostats out of service."""
        return tuple(self._plant.out_of_service.values())

    def rows(self) -> npt.NDArray[np.bool_]:
        """Return which heliostats are out of service, (N,)."""
        found = np.zeros(len(self._plant.field), dtype=np.bool_)
        found[[self._plant.field.place(name) for name in self._plant.out_of_service]] = True
        return found

    def take(self, person: Person, heliostats: Sequence[str], reason: str, hours: float) -> None:
        """Take heliostats out of service, and send them to stow; see `Operations.hold`."""
        for name in heliostats:
            self._plant.field.place(name)
        self._check_owner(person, heliostats, "out of service")
        since = self._utc()
        until = since + 3600.0 * hours
        for name in heliostats:
            lockout = Lockout(name, person.name, reason, since, until)
            self._plant.out_of_service[name] = lockout
        self._unparked.update(dict.fromkeys(heliostats, self._plant.now()))
        self._stow(person.name, heliostats)
        self._keeping.lock_out(heliostats, reason, person.name, since, until)

    def give_back(self, person: Person, heliostats: Sequence[str]) -> None:
        """Give heliostats back to service; nothing moves. See `Operations.unhold`."""
        for name in heliostats:
            self._plant.field.place(name)
        self._check_owner(person, heliostats, "give back")
        for name in heliostats:
            self._plant.out_of_service.pop(name, None)
        for name in heliostats:
            self._unparked.pop(name, None)
            self.attempts.done(name)
        self._keeping.put_back(heliostats, person.name, self._utc())

    def _check_owner(self, person: Person, heliostats: Sequence[str], what: str) -> None:
        out = self._plant.out_of_service
        others = [name for name in heliostats if name in out and out[name].who != person.name]
        if others and person.role < Role.ENGINEER:
            raise refusals.NOT_OWNER.error(what=what, heliostat=others[0], text=out[others[0]].text)

    def park(self) -> None:
        """Send heliostats to stow that were taken out and have not been seen there yet.

        Once a heliostat was seen in stow, nothing is sent to it again: somebody may be at it.
        """
        field, now = self._plant.field, self._plant.now()
        if not self._unparked:
            return
        there, away = field.among((states.STOWED,), now), field.among(_AWAY, now)
        for name, since in list(self._unparked.items()):
            row = field.place(name)
            # A status from before the order says nothing: it may have been on its way from stow.
            if there[row] and field.heard[row] > since:
                del self._unparked[name]
                self.attempts.done(name)
        due = sorted(name for name in self._unparked if self.attempts.due(name, now))
        if left := [name for name in due if away[field.place(name)]]:
            self._stow("out of service", left)
        for name in set(due).difference(left):
            self.attempts.failed(name, field.of(name, now).condition, now)

    def _stow(self, who: str, heliostats: Sequence[str]) -> None:
        """Send heliostats to stow; each is checked again after a while."""
        now = self._plant.now()
        self._plant.stow(who, heliostats)
        for name in heliostats:
            self.attempts.failed(name, self._plant.field.of(name, now).condition, now)

    def progress(self, heliostats: Sequence[str]) -> Mapping[str, Step]:
        """Return how far heliostats are on their way out of service."""
        return {name: self._step(name) for name in heliostats}

    def _step(self, name: str) -> Step:
        field, now = self._plant.field, self._plant.now()
        if name not in self._plant.out_of_service:
            return Step("it was given back to service", Stage.REFUSED)
        if name not in self._unparked:
            off = int(field.rows["flags"][field.place(name)]) & _SWITCHED_OFF
            more = "its drives are off at the mirror" if off else "switch its drives off there"
            return Step(f"parked in stow and locked out; {more}", Stage.DONE)
        if self._plant.waits_to_stow(name):
            return Step("it waits for its turn to go to stow")
        return Step(f"on its way to stow: {field.of(name, now).condition}", Stage.ACKNOWLEDGED)

    def _utc(self) -> float:
        return self._plant.clock.utc().timestamp()
