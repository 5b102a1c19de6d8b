"""Personal locks: taking heliostats, targets, receivers and the tower out of service."""

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.lcu import names as meanings
from heliotrope.lcu import states
from heliotrope.links.messages import Stage
from heliotrope.plant import refusals
from heliotrope.plant.attempts import Attempts, RetryLaw
from heliotrope.plant.controller import PlantController
from heliotrope.plant.field.lockouts import TOWER, Lockouts
from heliotrope.plant.operations.errands import Step
from heliotrope.plant.operations.keeping import Keeping
from heliotrope.plant.orders.authority import Person
from heliotrope.safety import Alarm, alarms
from heliotrope.store.records import Kind, Lockout

#: What is locked: its kind and name.
Place = tuple[Kind, str]
#: Orders to stow, repeated until a heliostat out of service reports stow.
PARKING = RetryLaw(
    "stow of a heliostat out of service",
    30,
    10.0,
    "STOW is repeated once a minute; an operator must inspect the heliostat",
    growth=1.0,
    rest=60.0,
    alarm=alarms.NOT_PARKED,
)


class Service:
    """Personal locks, and the heliostats that are at stow because of them.

    Parameters
    ----------
    plant
        The controller, which refuses their motion.
    keeping
        Stores the locks, so that they survive a restart.
    tell
        Called with each alarm.

    Attributes
    ----------
    attempts
        Attempts to stow heliostats, by heliostat.
    """

    def __init__(
        self, plant: PlantController, keeping: Keeping, tell: Callable[[Alarm], None]
    ) -> None:
        self._plant, self._keeping, self.attempts = plant, keeping, Attempts(PARKING, tell)
        plant.lockouts.put(keeping.lockouts())
        #: Locked places, by the heliostat that the lock has sent to stow and that has not reported
        #: stow yet. Aims do not show this, because the end of a visit restores other aims.
        self._unparked: dict[str, frozenset[Place]] = {}
        self._send_off(plant.lockouts)

    @property
    def out(self) -> tuple[Lockout, ...]:
        """The personal locks."""
        return tuple(self._plant.lockouts)

    def rows(self) -> npt.NDArray[np.bool_]:
        """Return a mask of the heliostats that are out of service, (N,).

        Personal locks keep them at stow, or have sent them to stow.

        The heliostats are locked themselves, their beams are aimed at a locked object, or the tower
        is locked.
        """
        locks, field = self._plant.lockouts, self._plant.field
        found = np.full(len(field), bool(locks.on(Kind.TOWER, TOWER)))
        found[[field.place(name) for name in (*locks.heliostats, *self._unparked)]] = True
        for near in locks.closed(self._plant.aims).values():
            found |= near
        return found

    def closed(self, target: str) -> str | None:
        """Return the reason why no beam may be sent to a target; None if beams may be sent."""
        locks = self._plant.lockouts
        return locks.text(Kind.TARGET, target) or locks.text(Kind.TOWER, TOWER) or None

    def take(
        self, person: Person, places: Sequence[Place], reason: str, hours: float
    ) -> tuple[str, ...]:
        """Lock places for a person, and stow the affected heliostats; return their names.

        See `Operations.hold`.
        """
        since = self._utc()
        locks = [
            Lockout(kind, name, person.name, reason, since, since + 3600.0 * hours)
            for kind, name in places
        ]
        self._plant.lockouts.put(locks)
        concerned = self._send_off(locks)
        if concerned:
            self._stow(person.name, concerned)
        self._keeping.lock_out(locks)
        return concerned

    def _send_off(self, locks: Iterable[Lockout]) -> tuple[str, ...]:
        """Record the heliostats that must go to stow under some locks, and return them."""
        field, found = self._plant.field, np.zeros(len(self._plant.field), dtype=np.bool_)
        for lock in locks:
            rows = self._under(lock)
            for row in np.flatnonzero(rows):
                before = self._unparked.get(field.names[row], frozenset())
                self._unparked[field.names[row]] = before | {(lock.kind, lock.name)}
            found |= rows
        return tuple(field.names[row] for row in np.flatnonzero(found))

    def _under(self, lock: Lockout) -> npt.NDArray[np.bool_]:
        """Return a mask of the heliostats that must be at stow under one lock now, (N,)."""
        field, found = self._plant.field, np.zeros(len(self._plant.field), dtype=np.bool_)
        if lock.kind is Kind.HELIOSTAT:
            found[field.place(lock.name)] = True
        elif lock.kind is Kind.TOWER:
            found[:] = True
        else:
            alone = Lockouts(self._plant.design)
            alone.put((lock,))
            for near in alone.closed(self._plant.aims).values():
                found |= near & ~field.among((states.STOWED,), self._plant.now())
        return found

    def give_back(
        self, person: Person, places: Sequence[Place], owner: str = ""
    ) -> tuple[Lockout, ...]:
        """Remove a person's own locks, or the locks of another ``owner``; nothing moves.

        Returns the removed locks; see `Operations.unhold`.
        """
        locks, who = self._plant.lockouts, owner or person.name
        removed = []
        for kind, name in places:
            own = [lock for lock in locks.on(kind, name) if lock.who == who]
            if not own and locks.on(kind, name):
                text = locks.text(kind, name)
                raise refusals.NOT_OWNER.error(what="give back", name=name, who=who, text=text)
            removed += own
        for lock in removed:
            locks.remove(lock.kind, lock.name, lock.who)
        for name, by in list(self._unparked.items()):
            if not any(locks.on(*place) for place in by):
                self._done(name)
        self._keeping.put_back(removed, person.name, self._utc())
        return tuple(removed)

    def park(self) -> None:
        """Stow heliostats that were taken out of service and have not yet reported stow.

        Once a heliostat has reported stow, no order is sent to it again, because someone may be
        working on it.
        """
        field, now = self._plant.field, self._plant.now()
        if not self._unparked:
            return
        # A status from before the order does not count, because the heliostat may have been leaving
        # stow.
        there = field.among((states.STOWED,), now) & self._plant.ledger.reported()
        for name in [name for name in self._unparked if there[field.place(name)]]:
            self._done(name)
        away = field.among(states.UP, now)
        due = sorted(name for name in self._unparked if self.attempts.due(name, now))
        if left := [name for name in due if away[field.place(name)]]:
            self._stow("out of service", left)
        for name in [each for each in due if each not in left]:
            self.attempts.failed(name, field.of(name, now).condition, now)

    def _done(self, name: str) -> None:
        """Record that a heliostat no longer needs to go to stow."""
        del self._unparked[name]
        self.attempts.done(name)

    def _stow(self, who: str, heliostats: Sequence[str]) -> None:
        """Send heliostats to stow; each is checked again later."""
        now = self._plant.now()
        self._plant.stow(who, heliostats)
        for name in heliostats:
            self.attempts.failed(name, self._plant.field.of(name, now).condition, now)

    def progress(self, places: Sequence[Place], heliostats: Sequence[str]) -> Mapping[str, Step]:
        """Return the progress of heliostats that locks send to stow.

        Parameters
        ----------
        places
            What was locked.
        heliostats
            Names.
        """
        kept = self.rows()
        stands = any(self._plant.lockouts.on(*place) for place in places)
        return {name: self._step(name, kept, stands=stands) for name in heliostats}

    def _step(self, name: str, kept: npt.NDArray[np.bool_], *, stands: bool) -> Step:
        field, now = self._plant.field, self._plant.now()
        if name in self._unparked:
            if self._plant.waits_to_stow(name):
                return Step("it is waiting its turn to go to stow")
            return Step(f"on its way to stow: {field.of(name, now).condition}", Stage.ACKNOWLEDGED)
        if kept[field.place(name)]:
            off = int(field.rows["flags"][field.place(name)]) & meanings.LOCAL_SWITCH
            more = (
                "its drives are switched off at the heliostat"
                if off
                else ("switch its drives off there")
            )
            return Step(f"parked in stow and locked out; {more}", Stage.DONE)
        if stands:
            text = (
                "parked in stow; it may be raised again because its aim is not on a locked "
                "target or receiver"
            )
            return Step(text, Stage.DONE)
        return Step("it was returned to service", Stage.REFUSED)

    def _utc(self) -> float:
        return self._plant.clock.utc().timestamp()
