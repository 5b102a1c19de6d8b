"""What the calls share in the plant's process: operations, tickets, and who is present.

The command authority is renewed for a holder whose page or program has been present recently. It
expires by the plant's time, which may run faster than that of people.
"""

import asyncio
import math
import time
from collections.abc import Callable
from typing import Any, TypeVar

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.volumes import outline
from heliotrope.lcu import names as meanings
from heliotrope.lcu import states
from heliotrope.plant import refusals
from heliotrope.plant.authority import Person
from heliotrope.plant.interface import orders
from heliotrope.plant.interface.tickets import Tickets, state_of
from heliotrope.plant.operations import bus_frames
from heliotrope.plant.operations.given_readings import GivenReadings
from heliotrope.plant.operations.marking import Marking, MarksView
from heliotrope.plant.operations.operations import Operations
from heliotrope.plant.operations.typed_parameters import ParametersView
from heliotrope.plant.operations.views import BusFrame, CameraView, FlightView, PictureRow
from heliotrope.plant.orders import RECORDING
from heliotrope.plant.tickets import Ticket

#: An emergency order with the word of an earlier one is that one for this long, s.
SAME, _MOST_CALLED = 30.0, 100
#: A holder of the authority counts as present for this long after renewing it, s.
PRESENT = 8.0
T = TypeVar("T")


class Desk:
    """The plant at work, as the calls see it; used in the plant's loop only.

    Parameters
    ----------
    operations
        The plant at work.

    Attributes
    ----------
    tickets
        The last commands.
    readings
        Readings that programs give.
    """

    def __init__(self, operations: Operations) -> None:
        self.operations, self.tickets = operations, Tickets()
        self.readings = GivenReadings(operations.plant, operations.logbook)
        #: When each holder of the authority was last present, monotonic time of the machine, s.
        self._present: dict[str, float] = {}
        #: When emergencies were ordered, by person and word, monotonic time of the machine, s.
        self._called: dict[tuple[str, str], float] = {}

    async def keep_authority(self) -> None:
        """Renew the authority for a holder who is present, until cancelled."""
        authority = self.operations.plant.authority
        while True:
            await asyncio.sleep(0.2 * authority.lifetime)
            grant = authority.grant
            if grant is None:
                continue
            if time.monotonic() - self._present.get(grant.holder.name, -math.inf) < PRESENT:
                self.operations.keep_authority(grant.holder, grant.token)

    # -- the authority ---------------------------------------------------------------------

    def authority_of(self, person: Person) -> dict[str, Any]:
        """Return the holder of the command authority."""
        authority = self.operations.plant.authority
        grant = authority.grant
        holder = None if grant is None else grant.holder
        return {
            "holder": "" if holder is None else holder.name,
            "role": "" if holder is None else holder.role.title,
            "mine": holder == person,
            "lifetime": authority.lifetime,
        }

    def token_of(self, person: Person) -> int:
        """Return a person's token of the command authority.

        Raises
        ------
        RefusedError
            If the person does not hold it.
        """
        grant = self.operations.plant.authority.grant
        if grant is None:
            raise refusals.NO_AUTHORITY.error(person=person.name)
        if grant.holder != person:
            raise refusals.OTHER_AUTHORITY.error(holder=grant.holder.name, person=person.name)
        return grant.token

    def take(self, person: Person) -> bool:
        """Take the command authority, or renew it; return whether its token is new."""
        grant = self.operations.plant.authority.grant
        if grant is not None and grant.holder == person:
            self.operations.keep_authority(person, grant.token)
            return False
        self.operations.take_authority(person)
        return True

    def seize(self, person: Person, reason: str) -> bool:
        """Break another person's command authority and take it; return that its token is new."""
        self.operations.seize_authority(person, reason)
        return True

    async def told(self, person: Person, new: bool) -> dict[str, Any]:
        """Return the holder once a new token is known.

        Clusters get it with a lease, their nodes a second later; until then the field would refuse
        commands.
        """
        if new:
            await asyncio.sleep(1.5 * self.operations.plant.settings.period + 1.0)
        return self._is_present(person)

    def keep(self, person: Person) -> dict[str, Any]:
        """Renew the command authority."""
        self.operations.keep_authority(person, self.token_of(person))
        return self._is_present(person)

    def release(self, person: Person) -> dict[str, Any]:
        """Release the command authority; automatic control goes on."""
        self._present.pop(person.name, None)
        self.operations.release_authority(person, self.token_of(person))
        return self.authority_of(person)

    def _is_present(self, person: Person) -> dict[str, Any]:
        self._present[person.name] = time.monotonic()
        return self.authority_of(person)

    # -- commands --------------------------------------------------------------------------

    def order_emergency(self, who: Person, given: orders.EmergencyCall) -> Any:
        """Order an emergency, once for each word: the page sends its order by two ways."""
        key, now = (who.name, given.call), time.monotonic()
        if not given.call or now - self._called.get(key, -math.inf) >= SAME:
            self.operations.emergency(who, given.act, given.reason)
            if given.call:
                while len(self._called) >= _MOST_CALLED:
                    self._called.pop(next(iter(self._called)))
                self._called[key] = now
        return self.operations.emergency_view()

    async def recorded(self, _: Person, ticket: Ticket) -> dict[str, Any]:
        """Keep a ticket; return its progress once it is recorded, or once that has failed.

        The next command of the same client then finds the points that this one has assigned.
        """
        self.tickets.put(ticket)
        await ticket.written(RECORDING + 1.0)
        return state_of(ticket)

    async def parameters(self, _: Person, heliostat: str) -> ParametersView:
        """Return the error parameters of a heliostat, with what its local controller stores."""
        return await self.operations.parameters.view(heliostat)

    async def set_parameters(self, who: Person, given: orders.ParameterOrder) -> dict[str, Any]:
        """Set error parameters of a heliostat, or bring back an earlier version."""
        here, token = self.operations.parameters, self.token_of(who)
        if bool(given.values) == bool(given.version):
            raise InputError("parameters: give either values or a version")
        if given.version:
            ticket = await here.restore(who, token, given.heliostat, given.version, given.reason)
        else:
            ticket = here.change(who, token, given.heliostat, given.values, given.reason)
        return await self.recorded(who, ticket)

    async def bus_frames(self, person: Person, cluster: str) -> tuple[BusFrame, ...]:
        """Record the frames of a cluster's bus for five seconds."""
        found = await bus_frames.record(self.operations.plant, cluster)
        text = f"recorded {len(found)} frames of its bus"
        self.operations.logbook.event("command", person.name, f"{cluster}: {text}")
        return found

    # -- photographs -----------------------------------------------------------------------

    async def photographed(self, person: Person, target: str) -> dict[str, Any]:
        """Photograph a target now; return what is seen."""
        return reading_of(await self.operations.photograph(person, target))

    async def kept(self, _: Person, given: orders.KeptOf) -> list[PictureRow]:
        """Return the newest kept photographs of a heliostat."""
        pictures = self.operations.pictures
        if pictures is None:
            return []
        return await _answer(lambda then: pictures.find(given.heliostat, given.limit, then))

    async def kept_picture(self, identity: int) -> bytes:
        """Return a kept photograph as JPEG.

        Raises
        ------
        UnknownNameError
            If there is none of that number.
        """
        pictures = self.operations.pictures
        if pictures is None:
            raise UnknownNameError("kept photograph", str(identity), ())
        return await _answer(lambda then: pictures.read(identity, then))

    # -- corner markers ---------------------------------------------------------------------

    @property
    def marking(self) -> Marking:
        """Takes views that persons mark.

        Raises
        ------
        InputError
            If no camera of the plant takes pictures.
        """
        if self.operations.marking is None:
            raise InputError("mark corners: this plant has no camera of its targets")
        return self.operations.marking

    async def mark_corners(self, who: Person, given: orders.Marks) -> MarksView:
        """Try the points that an engineer clicked, or take their view."""
        token = self.token_of(who) if given.save else None
        points = {name: (x, y) for name, (x, y) in given.points.items()}
        return await self.marking.mark(who, given.name, given.number, points, token)

    # -- flights --------------------------------------------------------------------------

    async def take_flight(self, person: Person, text: bytes) -> FlightView:
        """Take a flight of a drone, the text of its file."""
        return await self.operations.take_flight(person, text)

    # -- views -----------------------------------------------------------------------------

    def field(self) -> dict[str, Any]:
        """Return everything about the field that does not change."""
        here = self.operations
        design, plant = here.design, here.plant.field
        middle = [0.0, 0.0, 0.0]
        if design.receivers:
            middle = [
                float(sum(r.center[k] for r in design.receivers) / len(design.receivers))
                for k in range(3)
            ]
        sizes = sorted(here.sizes.max(axis=1).tolist())
        volumes = here.plant.beams.volumes
        keep_outs = [{"name": v.name, "outline": outline(v).round(2).tolist()} for v in volumes]
        return {
            "plant": design.name,
            "names": here.names,
            "positions": here.positions.round(3),
            "clusters": here.clusters,
            "cluster": plant.cluster,
            "size": sizes[len(sizes) // 2],
            "tower": middle,
            "receivers": here.receivers,
            "targets": here.targets,
            "keep_outs": keep_outs,
            "surfaces": here.aim_names,
            "states": states.STATES,
            "faults": meanings.FAULTS,
        }


def reading_of(view: CameraView) -> dict[str, Any]:
    """Return the findings in a photograph, without the picture."""
    return {
        "target": view.target,
        "version": view.version,
        "at": view.at,
        "reading": view.reading,
        "centroid": view.centroid,
    }


async def _answer(ask: Callable[[Callable[[T | Exception], None]], None]) -> T:
    """Wait for the answer of a disk."""
    told: asyncio.Future[T] = asyncio.get_running_loop().create_future()

    def then(found: T | Exception) -> None:
        if told.done():
            return  # who asked has gone
        if isinstance(found, Exception):
            told.set_exception(found)
        else:
            told.set_result(found)

    ask(then)
    return await told
