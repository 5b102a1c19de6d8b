"""Several heliostats at one target or receiver: their travel there, their aims, and their return.

A heliostat that is refused, is lost or leaves its aim drops out: it is brought to standby, or its
beam is moved off the target, and the remaining heliostats continue. They also continue when an
operator's order removes a heliostat from the visit; the visit does not move that heliostat again.
The visit ends only for reasons that affect all heliostats: an emergency, the end of its mandate, a
cancelled task. All beams then leave the target.
"""

import asyncio
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import Self

import numpy as np

from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.links.clock import sleep_until
from heliotrope.plant.controller import PlantController
from heliotrope.plant.orders.authority import Mandate, Person, RefusedError
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.plant.visits.visit import BroughtHome, Order, Visit, carried_out

#: Function that sends heliostats to points, by name, for a person with a token.
Pointing = Callable[[Person, int, Mapping[str, FloatArray]], Ticket]

#: Time limits for an order, and for the path to standby, s.
_ORDER, _HOME = 60.0, 120.0
#: A goal that has just moved with the sun is at most this far from its axis, rad.
_STEP = 1e-3
#: When all but this fraction of heliostats are at their aims, the others are allowed as long again
#: plus this time, s.
_FEW, _LATE = 0.1, 10.0
#: Interval between checks of the field, s.
_LOOK = 0.25
#: States in which a beam may be on the target, and states caused by other orders, which a visit
#: does not undo.
_ON = (states.IDLE, *states.ON_AIM)
_OFF = (states.DEFOCUSED, states.STOWING, states.STOWED, states.LOCKED, states.APPROACHING)


class CodedVisit(BroughtHome):
    """Several heliostats on their way to, at, and from one target.

    Parameters
    ----------
    plant, mandate
        As in `Visit`.
    heliostats, target
        Names, and the target.

    Attributes
    ----------
    visits
        Visits of the participants, by name.
    lost
        Why the remaining heliostats do not take part, by name.
    """

    def __init__(
        self,
        plant: PlantController,
        mandate: Mandate,
        heliostats: Iterable[str],
        target: Target,
    ) -> None:
        self.plant, self.mandate, self.target = plant, mandate, target
        self.visits = {
            name: Visit(plant, mandate, name, target) for name in dict.fromkeys(heliostats)
        }
        self.lost: dict[str, str] = {}
        self._away: set[str] = set()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the participants."""
        return tuple(self.visits)

    @property
    def astray(self) -> bool:
        """Whether a former participant has yet to be brought home; see `leave`."""
        return not self._away <= set(self.visits)

    def drop(self, why: Mapping[str, str]) -> None:
        """Drop heliostats from the visit; `leave` brings them home."""
        for name, text in why.items():
            if self.visits.pop(name, None) is not None:
                self.lost[name] = text

    def missing(self, wanted: int) -> dict[str, str]:
        """Return the participants that are not live or not in a given state, and the reasons."""
        found = {}
        for name, visit in self.visits.items():
            try:
                if visit.state != wanted:
                    state, before = states.STATES[visit.state], states.STATES[wanted]
                    found[name] = f"{name} is {state}, no longer {before}"
            except RefusedError as error:
                found[name] = str(error)
        return found

    async def go(self, points: Mapping[str, FloatArray], limit: float) -> None:
        """Send all heliostats to their points on the target, ENU, m, and wait until they arrive.

        Raises
        ------
        RefusedError
            If the plant refuses every motion.
        """
        for name, visit in list(self.visits.items()):
            try:
                if visit.state not in states.AVAILABLE:
                    state = states.STATES[visit.state]
                    said = f"{name} is {state}; bring it to standby (APPROACH) first"
                    self.drop({name: said})
            except RefusedError as error:
                self.drop({name: str(error)})
        # A heliostat that tracks the receiver while its new aim waits for its turn points away from
        # its aim, and after some seconds is considered disobedient. All turns may be taken while
        # the field is raised, so all heliostats wait at standby.
        self._away |= set(self.visits)
        tracking = self.missing(states.IDLE)
        await self._obeyed("IDLE", self._command("IDLE"), tracking, limit)
        await self.aim(points, limit)
        await self.track(limit)
        await self._arrived(limit)

    async def track(self, limit: float = _ORDER) -> None:
        """Order the participants at standby to track their aims."""
        await self._obeyed("TRACK", self._command("TRACK"), self.missing(states.TRACKING), limit)

    async def aim(self, points: Mapping[str, FloatArray], limit: float = _ORDER) -> None:
        """Send aims to the participants; participants whose aims are refused drop out."""
        await self._pointed(self.plant.aim, points, limit)

    async def move(self, points: Mapping[str, FloatArray], limit: float) -> None:
        """Move beams slightly off their aims; heliostats that may not be moved drop out."""
        await self._pointed(self.plant.commands.move, points, limit)

    async def _pointed(
        self, give: Pointing, points: Mapping[str, FloatArray], limit: float
    ) -> None:
        person, token = self.mandate.person, self.mandate.token
        wanted = [name for name in self.names if name in points]
        await self._obeyed(
            "AIM", lambda some: give(person, token, {n: points[n] for n in some}), wanted, limit
        )

    def _command(self, name: str) -> Order:
        """Return a function that sends a command to some heliostats."""
        person, token, plant = self.mandate.person, self.mandate.token, self.plant
        return lambda some: plant.command(person, token, name, some)

    async def _obeyed(
        self, what: str, order: Order, heliostats: Iterable[str], limit: float
    ) -> None:
        """Issue an order; heliostats that do not carry it out drop out (see `carried_out`)."""
        failed = await carried_out(self.plant, order, heliostats, limit, self.look)
        self.drop({name: f"{what} {name}: {why}" for name, why in failed.items()})

    async def _arrived(self, limit: float) -> None:
        """Wait until all participants stay at their aims in two reports; the rest drop out.

        Once most participants have arrived, the remaining ones are allowed the same time again plus
        some seconds.
        """
        begin = self.plant.now()
        until, seen = begin + limit, dict.fromkeys(self.visits, (begin, 0))
        while any(seen[name][1] < 2 for name in self.visits):
            await self.look()
            self.drop(self.missing(states.TRACKING))
            for name, visit in self.visits.items():
                counted = float(self.plant.field.counted_at[visit.row])
                since, count = seen[name]
                if counted > since:
                    left = visit.left()
                    kept = count if left < _STEP else 0
                    seen[name] = counted, count + 1 if visit.there() else kept
            late = [name for name in self.visits if seen[name][1] < 2]
            if (now := self.plant.now()) >= until:
                gone = f"not at its aim in fine steps within {now - begin:.0f} s"
                self.drop({name: f"{name}: {gone}" for name in late})
            elif len(late) <= _FEW * len(self.visits):
                until = min(until, begin + 2.0 * (now - begin) + _LATE)

    async def look(self) -> None:
        """Wait a little, and note new step counts.

        Heliostats that another order has removed from the visit drop out.
        """
        await sleep_until(self.plant.clock, self.plant.now() + _LOOK)
        self.drop({n: f"{n}: {text}" for n, text in self.mandate.refused(self.visits).items()})
        for visit in self.visits.values():
            visit.note()

    async def leave(self) -> bool:
        """Bring former participants home; return whether there were any."""
        gone = tuple(name for name in sorted(self._away) if name not in self.visits)
        if gone:
            await self._standby(gone)
        return bool(gone)

    async def home(self) -> None:
        """Bring all participants to standby; any that do not go are moved off the target (DEFOCUS).

        Raises
        ------
        RefusedError
            If the plant refuses every motion; the beams are then moved off the target.
        """
        if self._away:
            await self._standby(tuple(sorted(self._away)))

    async def _standby(self, names: tuple[str, ...]) -> None:
        """Bring heliostats to standby, except any that an order has moved off the target.

        Heliostats that another order has removed from the visit are not moved.
        """
        taken = self.mandate.taken
        self._away -= taken.keys()
        names = tuple(name for name in names if name not in taken)
        field, now = self.plant.field, self.plant.now()
        heard = {name: int(field.rows["state"][field.place(name)]) for name in names}
        live = field.live(now)
        on = tuple(n for n in names if live[field.place(n)] and heard[n] in _ON)
        left = {n for n in names if n not in on and not (live[field.place(n)] and heard[n] in _OFF)}
        try:
            failed = await carried_out(self.plant, self._command("IDLE"), on, _HOME, self.look)
            left |= failed.keys()
        except (RefusedError, asyncio.CancelledError):
            left |= set(names)
            raise
        finally:
            self._away -= set(names)
            if left := left - taken.keys():
                self.mandate.give_up(left)
                self.plant.defocus(
                    f"joint visit of {self.mandate.person.name}", tuple(sorted(left))
                )


class Returned:
    """Heliostats that return to their previous aims at the end of an ``async with``.

    Heliostats that are not at standby at the end, and heliostats that another order has removed
    from the visit, stay where they are. A cancelled visit leaves all heliostats at standby.

    Parameters
    ----------
    plant, mandate, heliostats, target
        As in `CodedVisit`.
    """

    def __init__(
        self, plant: PlantController, mandate: Mandate, heliostats: Iterable[str], target: Target
    ) -> None:
        tracking = plant.field.among((states.TRACKING,), plant.now())
        self._plant, self._mandate, self._target = plant, mandate, target
        rows = {name: plant.field.place(name) for name in dict.fromkeys(heliostats)}
        self._aims = {
            name: plant.aims[row].copy()
            for name, row in rows.items()
            if tracking[row] and np.isfinite(plant.aims[row]).all()
        }

    async def __aenter__(self) -> Self:
        """Record the present aims of the heliostats."""
        return self

    async def __aexit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Send the heliostats back; an error that ended the visit takes precedence."""
        if kind is None:
            await self._back()
        elif issubclass(kind, Exception):
            with suppress(RefusedError):
                await self._back()

    async def _back(self) -> None:
        plant = self._plant
        idle = plant.field.among((states.IDLE,), plant.now())
        back = {
            name: aim
            for name, aim in self._aims.items()
            if name in self._mandate.heliostats and idle[plant.field.place(name)]
        }
        if back:
            joint = CodedVisit(plant, self._mandate, back, self._target)
            await joint.aim(back)
            await joint.track()
