"""Everything that the calls share in the plant's process: operations, tickets, who is present.

The command authority is renewed for a holder whose page or program has been active recently. It
expires by the plant's time, which may run faster than real time.
"""

import asyncio
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.volumes import outline
from heliotrope.geometry import FloatArray
from heliotrope.lcu import names as meanings
from heliotrope.lcu import states
from heliotrope.links.clock import sleep_until
from heliotrope.plant import refusals
from heliotrope.plant.emergency import ORDERED
from heliotrope.plant.interface import orders
from heliotrope.plant.interface.tickets import Tickets, TicketState
from heliotrope.plant.operations.given_readings import GivenReadings
from heliotrope.plant.operations.marking import Marking
from heliotrope.plant.operations.operations import Operations
from heliotrope.plant.operations.views import CameraView, EmergencyView, PictureRow
from heliotrope.plant.orders.authority import Person, RefusedError
from heliotrope.plant.orders.queue import RECORDING
from heliotrope.plant.orders.tickets import Ticket

#: Time for which an emergency order with the identifier of an earlier one is treated as the same
#: order, s; and maximum number of identifiers that are remembered.
SAME, _MOST_CALLED = 30.0, 100
#: A holder of the authority counts as present for this long after renewing it, s.
PRESENT = 8.0
#: Longest wait for an order that was just withdrawn to be released, s.
_RELEASED = 5.0
T = TypeVar("T")


@dataclass(frozen=True)
class AuthorityState:
    """Holder of the command authority ("": nobody), and its lifetime without renewal, s."""

    holder: str
    role: str
    mine: bool
    lifetime: float


@dataclass(frozen=True)
class KeepOutOutline:
    """A keep-out volume, as seen on a map: east and north of its corners, m, (K, 2)."""

    name: str
    outline: FloatArray


@dataclass(frozen=True)
class FieldDesign:
    """Everything about the field that does not change, in the order of all its rows.

    Attributes
    ----------
    plant, names
        Name of the plant, and of its N heliostats.
    positions
        ENU, m, (N, 3).
    clusters, cluster
        Names of the clusters, and the index of each heliostat's cluster, (N,).
    size
        Median of the mirrors' longer sides, m.
    tower
        Centre of the receivers, ENU, m, (3,).
    receivers, targets, keep_outs
        Names and outlines.
    surfaces
        Places that a row's `on` refers to.
    states, faults
        Names of the codes in a row.
    """

    plant: str
    names: tuple[str, ...]
    positions: FloatArray
    clusters: tuple[str, ...]
    cluster: npt.NDArray[np.intp]
    size: float
    tower: FloatArray
    receivers: tuple[str, ...]
    targets: tuple[str, ...]
    keep_outs: tuple[KeepOutOutline, ...]
    surfaces: tuple[str, ...]
    states: tuple[str, ...]
    faults: tuple[str, ...]


@dataclass(frozen=True)
class CameraReading:
    """Findings of the software in the last photograph of a target, as `CameraView` has them."""

    target: str
    version: int
    at: float
    reading: tuple[str, ...]
    centroid: tuple[float, float] | None

    @classmethod
    def of(cls, view: CameraView) -> "CameraReading":
        """Return the findings in a photograph, without the picture."""
        return cls(view.target, view.version, view.at, view.reading, view.centroid)


class Desk:
    """The running plant, as the calls use it; only for the plant's event loop.

    Parameters
    ----------
    operations
        Operations of the running plant.

    Attributes
    ----------
    tickets
        Tickets of the last commands.
    readings
        Readings that programs supply.
    """

    def __init__(self, operations: Operations) -> None:
        self.operations, self.tickets = operations, Tickets()
        self.readings = GivenReadings(operations.plant, operations.logbook)
        #: When each holder of the authority was last present, monotonic time of the computer, s.
        self._present: dict[str, float] = {}
        #: When emergencies were ordered, by person and identifier, monotonic time of the computer,
        #: s.
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
                self.operations.plant.authority.keep(grant.holder, grant.token)

    # -- the authority ---------------------------------------------------------------------

    def authority_of(self, person: Person) -> AuthorityState:
        """Return the holder of the command authority."""
        authority = self.operations.plant.authority
        if authority.grant is None:
            return AuthorityState("", "", False, authority.lifetime)
        holder = authority.grant.holder
        return AuthorityState(holder.name, holder.role.title, holder == person, authority.lifetime)

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
            self.operations.plant.authority.keep(person, grant.token)
            return False
        self.operations.take_authority(person)
        return True

    async def told(self, person: Person, new: bool) -> AuthorityState:
        """Return the holder once a new token is known.

        Clusters receive the token with a lease, and their local controllers a second later; until
        then the field would refuse commands.
        """
        if new:
            await asyncio.sleep(1.5 * self.operations.plant.settings.period + 1.0)
        return self._is_present(person)

    def keep(self, person: Person) -> AuthorityState:
        """Renew the command authority."""
        self.operations.plant.authority.keep(person, self.token_of(person))
        return self._is_present(person)

    def release(self, person: Person) -> AuthorityState:
        """Release the command authority; automatic control continues."""
        self._present.pop(person.name, None)
        self.operations.release_authority(person, self.token_of(person))
        return self.authority_of(person)

    def _is_present(self, person: Person) -> AuthorityState:
        self._present[person.name] = time.monotonic()
        return self.authority_of(person)

    # -- commands --------------------------------------------------------------------------

    def order_emergency(self, who: Person, given: orders.EmergencyCall) -> EmergencyView:
        """Declare an emergency, once per identifier, because the page sends each order twice."""
        key, now = (who.name, given.call), time.monotonic()
        if not given.call or now - self._called.get(key, -math.inf) >= SAME:
            self.operations.emergency(who, given.act, given.reason)
            if given.call:
                while len(self._called) >= _MOST_CALLED:
                    self._called.pop(next(iter(self._called)))
                self._called[key] = now
        return self.operations.viewer.emergency()

    async def recorded(self, ticket: Ticket) -> TicketState:
        """Store a ticket; return its progress once it is recorded or recording has failed.

        Waiting ensures that the next command from the same client finds the points that this
        command has assigned.
        """
        self.tickets.put(ticket)
        await ticket.written(RECORDING + 1.0)
        return TicketState.of(ticket)

    async def resume(self, who: Person) -> None:
        """Let automatic control resume, after waiting for an order that was just withdrawn.

        Raises
        ------
        RefusedError
            See `Operations.resume`.
        """
        plant = self.operations.plant
        until = plant.now() + _RELEASED
        while True:
            try:
                self.operations.resume(who)
            except RefusedError:
                if plant.now() >= until or not plant.sentinel.ends_by(ORDERED):
                    raise
                await sleep_until(plant.clock, plant.now() + 0.25)
            else:
                return

    # -- photographs -----------------------------------------------------------------------

    async def kept(self, heliostat: str, limit: int) -> list[PictureRow]:
        """Return the newest stored photographs of a heliostat."""
        pictures = self.operations.pictures
        if pictures is None:
            return []
        return await _answer(lambda then: pictures.find(heliostat, limit, then))

    async def kept_picture(self, identity: int) -> bytes:
        """Return a stored photograph as JPEG.

        Raises
        ------
        UnknownNameError
            If there is no photograph with that number.
        """
        pictures = self.operations.pictures
        if pictures is None:
            raise UnknownNameError("kept photograph", str(identity), ())
        return await _answer(lambda then: pictures.read(identity, then))

    # -- corner markers ---------------------------------------------------------------------

    @property
    def marking(self) -> Marking:
        """The part that accepts target views marked by operators.

        Raises
        ------
        InputError
            If no camera of the plant takes pictures.
        """
        if self.operations.marking is None:
            raise InputError("mark corners: this plant has no target camera")
        return self.operations.marking

    # -- views -----------------------------------------------------------------------------

    def field(self) -> FieldDesign:
        """Return everything about the field that does not change."""
        here = self.operations
        design, plant = here.plant.design, here.plant.field
        centers = [receiver.center for receiver in design.receivers]
        sizes = np.sort(here.viewer.sizes.max(axis=1))
        volumes = here.plant.beams.volumes
        return FieldDesign(
            design.name,
            here.names,
            here.viewer.positions.round(3),
            plant.clusters,
            plant.cluster,
            float(sizes[len(sizes) // 2]),
            np.mean(centers, axis=0) if centers else np.zeros(3),
            here.receivers,
            here.targets,
            tuple(KeepOutOutline(each.name, outline(each).round(2)) for each in volumes),
            here.viewer.aim_names,
            states.STATES,
            meanings.FAULTS,
        )


async def _answer(ask: Callable[[Callable[[T | Exception], None]], None]) -> T:
    """Wait for the disk's reply."""
    told: asyncio.Future[T] = asyncio.get_running_loop().create_future()

    def then(found: T | Exception) -> None:
        if told.done():
            return  # the caller has gone
        if isinstance(found, Exception):
            told.set_exception(found)
        else:
            told.set_result(found)

    ask(then)
    return await told
