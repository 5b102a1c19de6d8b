"""Taking heliostats out of service and giving them back."""

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.lcu import states
from heliotrope.plant import refusals
from heliotrope.plant.authority import Person, Role
from heliotrope.plant.controller import PlantController
from heliotrope.plant.lockouts import Lockout
from heliotrope.plant.operations.keeping import Keeping

#: States from which a heliostat out of service is sent to stow.
_AWAY = (
    states.APPROACHING,
    states.IDLE,
    states.TRACKING,
    states.SEARCHING,
    states.DEFOCUSED,
)
#: Pause between two orders to stow, s.
_AGAIN = 10.0


class Service:
    """The heliostats out of service.

    Parameters
    ----------
    plant
        The controller, which refuses their motion.
    keeping
        Keeps them over a restart.
    """

    def __init__(self, plant: PlantController, keeping: Keeping) -> None:
        self._plant, self._keeping = plant, keeping
        plant.out_of_service.update(keeping.lockouts())
        #: Since when each has been out of service and not been seen in stow, monotonic s.
        self._unparked = dict.fromkeys(plant.out_of_service, -math.inf)
        self._sent_at = -math.inf

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
        self._plant.stow(person.name, heliostats)
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
        there = field.among((states.STOWED,), now)
        # A status from before the order says nothing: it may have been on its way from stow.
        self._unparked = {
            name: since
            for name, since in self._unparked.items()
            if not (there[row := field.place(name)] and field.heard[row] > since)
        }
        away = field.among(_AWAY, now)
        left = sorted(name for name in self._unparked if away[field.place(name)])
        if left and now - self._sent_at >= _AGAIN:
            self._sent_at = now
            self._plant.stow("out of service", left)

    def _utc(self) -> float:
        return self._plant.clock.utc().timestamp()
