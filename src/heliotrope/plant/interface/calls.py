"""The table of calls: API request, minimum role, arguments, reply and implementation of each.

A function together with its table entry is the only definition of an operation: the console derives
the routes of the HTTP API from it, `heliotrope ctl` at the plant makes the same requests, and the
API reference lists it. The model of its ``order``, the type of its reply and its docstring are used
unchanged.
"""

import asyncio
import functools
import inspect
import re
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any, Generic, TypeVar, get_args, get_origin, get_type_hints
from urllib.parse import parse_qsl, unquote

from pydantic import BaseModel

from heliotrope.calibration.flights import FlightDocument, parse_flight
from heliotrope.errors import InputError
from heliotrope.field.formats.plant_help import HelpTable, plant_help
from heliotrope.field.timetable import TimetableEntry
from heliotrope.plant.attempts import Retry
from heliotrope.plant.interface import orders
from heliotrope.plant.interface.desk import AuthorityState, CameraReading, Desk, FieldDesign
from heliotrope.plant.interface.encoding import frame_parts
from heliotrope.plant.interface.overview import overview
from heliotrope.plant.interface.tickets import TicketState
from heliotrope.plant.operations import bus_frames as bus
from heliotrope.plant.operations import views
from heliotrope.plant.operations.aiming import AimsView
from heliotrope.plant.operations.approvals import WaitingChange
from heliotrope.plant.operations.marking import MarksView, PictureToMark
from heliotrope.plant.operations.plant_file import (
    PlantFileCheck,
    PlantFileStored,
    PlantFileView,
)
from heliotrope.plant.operations.report import ShiftReport
from heliotrope.plant.operations.security import SecurityEvent
from heliotrope.plant.operations.trends import Quantity, Trend
from heliotrope.plant.operations.typed_parameters import ParametersView
from heliotrope.plant.operations.versions import ParameterComparison
from heliotrope.plant.operations.zero import lock_position, zero
from heliotrope.plant.orders.authority import Person, Role
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.store.records import JournalEntry, JournalQuery, Lockout, PlannedVisit

T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])
VIEWER, OPERATOR, ENGINEER = Role
#: Time for which all viewers share a view, s.
FRESH = 0.5
#: The same for a view that never changes.
ALWAYS = float("inf")
_LINK = re.compile(r"\[([^\]]+)\]\([^)]+\)")


@dataclass(frozen=True)
class WithBlob:
    """A value, and the bytes that accompany it; in the API, the bytes are a JPEG."""

    value: Any
    blob: bytes


@dataclass(frozen=True)
class Later(Generic[T]):
    """A reply that must be awaited in the plant's event loop, after the work itself."""

    wait: Callable[[], Coroutine[Any, Any, T]]


Pack = Callable[[Any], tuple[dict[str, Any], bytes]]


@dataclass(frozen=True)
class Call:
    """One call.

    Attributes
    ----------
    function
        Function that does the work in the plant's event loop; its arguments are whichever of
        ``desk``, ``who``, ``order`` and ``blob`` it needs.
    request
        Method and path in the HTTP API, with arguments in braces; "": available only on the local
        interface.
    group
        Section heading in the API reference.
    role
        Minimum role of the person on whose behalf the call is made.
    arguments
        Model of the arguments.
    answer
        Type of the value; None: there is no value.
    body
        Model of the request body, if it does not contain all arguments.
    pack
        Function that derives arguments and blob from a body; None: the call takes no blob.
    bare
        Whether a request may have no body.
    fresh
        Time for which all callers share a reply, s; 0: replies are not shared.
    urgent
        Whether the call belongs to the socket for EMERGENCY, DEFOCUS and STOW.
    console
        Whether only a console may make the call.
    unlimited
        Whether the call does not count as an order; see `counted`.
    """

    function: Callable[..., Any]
    request: str
    group: str
    role: Role
    arguments: type[orders.Strict]
    answer: Any
    body: type[BaseModel] | None = None
    pack: Pack | None = None
    bare: bool = False
    fresh: float = 0.0
    urgent: bool = False
    console: bool = False
    unlimited: bool = False

    @property
    def counted(self) -> bool:
        """Whether the call is an order; the rate of orders is limited."""
        return self.role >= Role.OPERATOR and not (self.urgent or self.unlimited)

    @property
    def text(self) -> str:
        """What the call does or returns, in Markdown."""
        return " ".join((inspect.getdoc(self.function) or "").split())

    @property
    def plain_text(self) -> str:
        """The same text without links."""
        return _LINK.sub(r"\1", self.text)

    def work(self, desk: Desk, who: Person, order: Any, blob: bytes) -> Any:
        """Do the work; the value is converted elsewhere, and a `Later` must be awaited."""
        given = {"desk": desk, "who": who, "order": order, "blob": blob}
        named = inspect.signature(self.function).parameters
        ready = functools.partial(self.function, **{name: given[name] for name in named})
        return Later(ready) if inspect.iscoroutinefunction(self.function) else ready()


#: All calls that run in the plant's event loop, by name.
CALLS: dict[str, Call] = {}


def _call(request: str = "", group: str = "", role: Role = VIEWER, **more: Any) -> Callable[[F], F]:
    """Return a decorator that adds a function to the table under its name; see `Call`."""

    def add(function: F) -> F:
        hints = get_type_hints(function)
        answer = hints["return"]
        if get_origin(answer) is Later:
            (answer,) = get_args(answer)
        CALLS[function.__name__] = Call(
            function,
            request,
            group,
            role,
            hints.get("order", orders.Nothing),
            None if answer is type(None) else answer,
            **more,
        )
        return function

    return add


# -- the plant and its field ---------------------------------------------------------------------


@_call("GET summary", "plant", fresh=FRESH)
def summary(desk: Desk) -> views.Summary:
    """Return a summary of the plant."""
    return desk.operations.summary()


@_call("GET sun", "plant", fresh=FRESH)
def sun(desk: Desk) -> views.SunView:
    """Return the position of the sun."""
    return desk.operations.sun()


@_call("GET receivers/{name}/flux", "plant", fresh=FRESH)
async def flux(desk: Desk, order: orders.Named) -> views.PredictedView:
    """Return the predicted flux on a receiver, with its uncertainty."""
    return await desk.operations.receiver_flux(order.name)


@_call("GET aims", "plant", fresh=FRESH)
def aims(desk: Desk) -> AimsView:
    """Return how aims are chosen, and how far the flux is from its limit.

    `reserve`: the smallest fraction of the limit that is unused in any cell; `gap`: the largest
    fraction of power that better aims could still add; `moved`: the number of heliostats in the
    last move.
    """
    return desk.operations.aims()


@_call("GET field", "field", fresh=ALWAYS)
def field(desk: Desk) -> FieldDesign:
    """Return everything about the field that does not change."""
    return desk.field()


@_call()
def size(desk: Desk) -> int:
    """Return the number of heliostats."""
    return len(desk.operations.names)


@_call("GET heliostats/{name}", "field")
def heliostat(desk: Desk, order: orders.Named) -> views.HeliostatView:
    """Return one heliostat in detail.

    `locked`: if the heliostat is LOCKED, by whose order or by which visit, since when, and until
    when.
    """
    return desk.operations.viewer.heliostat(order.name)


@_call("GET heliostats/{name}/why", "field")
def why(desk: Desk, order: orders.Named) -> views.Explanation:
    """Explain why a heliostat tracks or not, what happens next, and what an operator can do.

    `order`: the last command to the heliostat, by whom and when; `button`: the command that
    `remedy` refers to.
    """
    return desk.operations.why(order.name)


@_call("GET clusters", "field", fresh=FRESH)
def clusters(desk: Desk) -> tuple[views.ClusterRow, ...]:
    """Return the health of each cluster."""
    return desk.operations.logbook.cluster_rows(desk.operations.plant)


@_call(console=True)
def live(desk: Desk) -> WithBlob:
    """Return the state of the field and the plant at one moment."""
    head, blob = frame_parts(desk.operations.viewer.frame())
    return WithBlob({"frame": head, "overview": overview(desk.operations)}, blob)


# -- safety, alarms and logs ---------------------------------------------------------------------


@_call("GET emergency", "safety")
def emergency(desk: Desk) -> views.EmergencyView:
    """Return the last emergency order with its proof, and the names of all its heliostats."""
    return desk.operations.viewer.emergency(len(desk.operations.names))


@_call("POST emergency", "safety", bare=True, urgent=True)
def order_emergency(desk: Desk, who: Person, order: orders.EmergencyCall) -> views.EmergencyView:
    """Order a field-wide DEFOCUS (or STOW).

    Every signed-in user may call it. The reply states how far the order has been carried out.
    """
    return desk.order_emergency(who, order)


@_call("DELETE emergency", "safety", OPERATOR, bare=True)
def withdraw_emergency(desk: Desk, who: Person, order: orders.Withdrawal) -> views.EmergencyView:
    """Withdraw your own emergency order; nothing moves.

    An engineer may also withdraw the order of another `owner`.

    The emergency continues while another person's order is active (`calls`).
    """
    desk.operations.withdraw(who, order.owner)
    return desk.operations.viewer.emergency()


@_call("PUT readings/{name}", "safety", ENGINEER, body=orders.Reading)
def give_reading(desk: Desk, who: Person, order: orders.NamedReading) -> None:
    """Submit a reading for the safety table.

    `value` is the reading, and `at` the time when it was measured.

    The reading is accepted only if the links file says [`"api"`](../how-to/integrate.md#sensors).
    """
    desk.readings.take(who, order.name, order.value, order.at)


@_call("GET alarms", "alarms", fresh=FRESH)
def alarms(desk: Desk) -> tuple[views.AlarmRow, ...]:
    """Return the alarms; alarms that need attention come first."""
    return desk.operations.logbook.alarms()


@_call("POST alarms/acknowledge", "alarms", OPERATOR)
def acknowledge(desk: Desk, who: Person, order: orders.Acknowledged) -> None:
    """Acknowledge an alarm."""
    desk.operations.acknowledge(who, order.condition, order.subject)


@_call("GET events", "logs", fresh=FRESH)
def events(desk: Desk, order: orders.Some) -> tuple[views.EventRow, ...]:
    """Return the latest events, newest first.

    `heliostats`: the number of heliostats concerned, if `text` does not name all of them.
    """
    return desk.operations.logbook.events(order.limit)


@_call("GET events/{number}/heliostats", "logs")
def event_heliostats(desk: Desk, order: orders.OneEvent) -> tuple[str, ...]:
    """Return all heliostats concerned by an event whose text names only some of them."""
    return desk.operations.logbook.named(order.number)


@_call("GET journal", "logs")
async def journal(desk: Desk, order: orders.Journal) -> tuple[JournalEntry, ...]:
    """Return events, alarms, commands and notes from the store, for all days, newest first.

    `since` and `until` are POSIX seconds; `kind` is `event`, `alarm`, `command` or `note`.
    """
    return tuple(await desk.operations.journal(JournalQuery(**order.model_dump())))


@_call("GET report", "logs")
async def report(desk: Desk, order: orders.Period) -> ShiftReport:
    """Return the report for a period: production, availability, calibrations, alarms, notes.

    `since` and `until` are POSIX seconds, at most 31 days apart; 0 or omitted: the last eight
    hours. Energy and power are predictions.
    """
    return await desk.operations.report(order.since, order.until)


@_call("GET trends", "logs")
async def trends(desk: Desk) -> tuple[Quantity, ...]:
    """Return the quantities that have trends, for the plant and for each heliostat."""
    return await desk.operations.quantities()


@_call("GET trend", "logs")
async def trend(desk: Desk, order: orders.TrendOrder) -> Trend:
    """Return how a quantity changed over time: its minimum, mean and maximum per interval.

    `?quantity=power.receiver&since=…&until=…` with times in POSIX seconds; if `heliostat` is
    specified, the quantity belongs to that heliostat.
    """
    return await desk.operations.trend(
        order.quantity, order.heliostat, order.since, order.until, order.points
    )


@_call("POST notes", "logs", OPERATOR)
def note_for_people(desk: Desk, who: Person, order: orders.NoteOrder) -> None:
    """Store a note for the next shift; the journal and the report show it."""
    desk.operations.note(who, order.text)


@_call("GET packets", "logs", fresh=FRESH)
def packets(desk: Desk, order: orders.SomePackets) -> tuple[views.PacketRow, ...]:
    """Return the latest messages between plant and clusters, newest first."""
    return desk.operations.logbook.packets(order.limit, order.cluster)


@_call("POST clusters/{name}/frames", "logs", ENGINEER)
async def bus_frames(desk: Desk, who: Person, order: orders.Named) -> tuple[views.BusFrame, ...]:
    """Record the frames on a cluster's bus for five seconds and decode them; nothing moves."""
    found = await bus.record(desk.operations.plant, order.name)
    text = f"{order.name}: recorded {len(found)} frames of its bus"
    desk.operations.logbook.event("command", who.name, text)
    return found


@_call(console=True)
def note(desk: Desk, order: orders.Note) -> None:
    """Record a security event."""
    kind = SecurityEvent[order.kind]
    desk.operations.security.note(kind, order.who, order.address, order.detail, order.more)


@_call()
def note_use(desk: Desk, who: Person, order: orders.Use) -> None:
    """Record how a user of this computer used the records; see `cli._noted`."""
    kind = SecurityEvent[order.kind]
    desk.operations.security.note(kind, who.name, detail=order.detail)


# -- the command authority -----------------------------------------------------------------------


@_call("GET authority", "authority")
def authority(desk: Desk, who: Person) -> AuthorityState:
    """Return the holder of the command authority."""
    return desk.authority_of(who)


@_call("POST authority", "authority", OPERATOR)
def take_authority(desk: Desk, who: Person) -> Later[AuthorityState]:
    """Take the command authority, or renew it; automatic control yields."""
    new = desk.take(who)
    return Later(lambda: desk.told(who, new))


@_call("POST authority/seize", "authority", OPERATOR)
def seize_authority(desk: Desk, who: Person, order: orders.GivenReason) -> Later[AuthorityState]:
    """Take the command authority away from another person."""
    desk.operations.seize_authority(who, order.reason)
    return Later(lambda: desk.told(who, True))


@_call("PUT authority", "authority", OPERATOR, unlimited=True)
def keep_authority(desk: Desk, who: Person) -> AuthorityState:
    """Renew the command authority; to be called every few seconds while its holder is present."""
    return desk.keep(who)


@_call("DELETE authority", "authority", OPERATOR, unlimited=True)
def release_authority(desk: Desk, who: Person) -> AuthorityState:
    """Release the command authority; automatic control continues."""
    return desk.release(who)


# -- commands ------------------------------------------------------------------------------------


@_call("POST stow", "commands", OPERATOR, urgent=True)
def stow(desk: Desk, who: Person, order: orders.SomeHeliostats) -> TicketState:
    """Send heliostats to stow; this needs no command authority."""
    return desk.tickets.put(desk.operations.stow(who, order.heliostats))


@_call("POST defocus", "commands", OPERATOR, urgent=True)
def defocus(desk: Desk, who: Person, order: orders.SomeHeliostats) -> TicketState:
    """Move beams off the receiver; this needs no command authority."""
    return desk.tickets.put(desk.operations.defocus(who, order.heliostats))


@_call("POST commands", "commands", OPERATOR)
def command(desk: Desk, who: Person, order: orders.CommandOrder) -> Later[TicketState]:
    """Give a bus command.

    The commands are APPROACH, TRACK, IDLE, REFOCUS, LOCK, UNLOCK, SEARCH, JOG, ZERO and more.
    """
    here, token = desk.operations, desk.token_of(who)
    ticket: Ticket
    if order.command == "LOCK_POSITION":
        if order.values:
            raise InputError(
                "LOCK_POSITION: it takes no values, because it uses the step counts "
                "of the aim; remove the values"
            )
        ticket, text = lock_position(here.plant, who, token, order.heliostats)
        here.logbook.event("command", who.name, text)
    elif order.command == "ZERO":
        ticket = zero(here.plant, who, token, order.heliostats, order.values)
        here.logbook.event("command", who.name, f"ZERO {order.heliostats[0]}")
    else:
        ticket = here.command(who, token, order.command, order.heliostats, order.values)
    return Later(lambda: desk.recorded(ticket))


@_call("GET commands", "commands")
def commands(desk: Desk) -> tuple[TicketState, ...]:
    """Return the latest commands given through the console, newest first."""
    return desk.tickets.last()


@_call("GET commands/{identity}", "commands")
def one_command(desk: Desk, order: orders.OneCommand) -> TicketState:
    """Return the progress of a command."""
    return desk.tickets.get(order.identity)


@_call("POST aim", "commands", OPERATOR, body=orders.AimOrder, pack=orders.pack_points)
def aim(desk: Desk, who: Person, order: orders.PointsOrder, blob: bytes) -> Later[TicketState]:
    """Aim heliostats at a receiver or a target, selected by name, or at points.

    `right` and `up`: a point on the unrolled receiver, in metres from its middle, as seen from
    outside.
    """
    if bool(order.where) == bool(order.points):
        raise InputError("aim: specify either where (a receiver or target) or points, not both")
    here, token = desk.operations, desk.token_of(who)
    placed = order.right is not None or order.up is not None
    place = (order.right or 0.0, order.up or 0.0) if placed else None
    if order.where:
        ticket = here.aim_at(who, token, order.heliostats, order.where, place)
    else:
        ticket = here.aim(who, token, orders.points_of(order, blob))
    return Later(lambda: desk.recorded(ticket))


@_call("POST standby", "commands", OPERATOR, body=orders.StandbyOrder, pack=orders.pack_points)
def standby(desk: Desk, who: Person, order: orders.PointsOrder, blob: bytes) -> Later[TicketState]:
    """Set standby points."""
    points = orders.points_of(order, blob)
    ticket = desk.operations.standby(who, desk.token_of(who), points)
    return Later(lambda: desk.recorded(ticket))


@_call("POST automatic", "commands", OPERATOR)
def automatic(desk: Desk, who: Person, order: orders.SomeHeliostats) -> TicketState:
    """Give heliostats to automatic control, which raises and calibrates them.

    Returns a ticket. It is done for a heliostat once the heliostat follows automatic control;
    otherwise it states the reason.
    """
    return desk.tickets.put(desk.operations.give_back(who, order.heliostats))


@_call("POST automatic/resume", "commands", OPERATOR)
async def resume(desk: Desk, who: Person) -> None:
    """Let automatic control resume with its heliostats, after a large loss or an emergency.

    This also acknowledges an emergency whose orders are all withdrawn.
    """
    await desk.resume(who)


@_call("GET holds", "calibration")
def holds(desk: Desk) -> tuple[Lockout, ...]:
    """Return the personal locks on heliostats, targets, receivers and the tower.

    A locked heliostat is out of service.
    """
    return desk.operations.automatic.service.out


@_call("POST holds", "commands", OPERATOR)
def hold(desk: Desk, who: Person, order: orders.HoldOrder) -> TicketState:
    """Apply your lock to `heliostats`, `targets`, `receivers` or the `tower`.

    The heliostats concerned go to stow, and nobody can move them. Returns a ticket, which is done
    for a heliostat once that heliostat is parked at stow. Each person applies their own lock.
    """
    return desk.tickets.put(desk.operations.hold(who, **order.model_dump(exclude_none=True)))


@_call("POST holds/release", "commands", OPERATOR)
def unhold(desk: Desk, who: Person, order: orders.GivenBack) -> tuple[Lockout, ...]:
    """Remove your locks; nothing moves.

    An engineer may remove another person's locks by specifying `owner` and `reason`. An object
    returns to service when the last lock on it is removed.
    """
    desk.operations.unhold(who, **order.model_dump())
    return desk.operations.automatic.service.out


# -- calibration ---------------------------------------------------------------------------------


@_call("GET calibration", "calibration", fresh=FRESH)
def calibration(desk: Desk) -> views.CalibrationView:
    """Return the progress of calibration.

    `outlooks`: the first and the latest [prediction](../how-to/planning.md#in-the-running-plant) of
    the field errors for this day; `field`: the actual errors up to now; `choice`: why automatic
    control chose the last visit, or starts none.
    """
    return desk.operations.automatic.view()


@_call("PUT calibration", "calibration", OPERATOR)
def switch_calibration(desk: Desk, who: Person, order: orders.Switch) -> views.CalibrationView:
    """Switch automatic calibration on or off."""
    desk.operations.switch_calibration(who, order.on)
    return desk.operations.automatic.view()


@_call("POST calibration/next", "calibration", OPERATOR)
def calibrate(desk: Desk, who: Person, order: orders.OneCalibration) -> TicketState:
    """Calibrate a heliostat as soon as a target is free, before all others.

    Returns a ticket that ends with the result. With `search`, the beam is only searched for.
    `together` names other heliostats that go to the target in the same [joint
    visit](../explanation/plant.md#many-mirrors-on-one-target), as soon as all are ready. With
    `receiver`, all heliostats stay in production and are [measured on the
    receiver](../explanation/plant.md#many-mirrors-on-a-receiver), as soon as all track it.
    """
    return desk.tickets.put(desk.operations.calibrate(who, **order.model_dump()))


@_call("GET schedule", "calibration", fresh=FRESH)
def schedule(desk: Desk, order: orders.SomeVisits) -> tuple[PlannedVisit, ...]:
    """Return the planned visits."""
    return desk.operations.automatic.plan(order.limit)


@_call("GET timetable", "calibration")
def timetable(desk: Desk) -> tuple[views.TimetableRow, ...]:
    """Return the [timetable](../explanation/schedule.md#the-timetable) of calibrations.

    Each entry is returned with its next time, its last time, and its last result.
    """
    return desk.operations.automatic.timetable.rows()


@_call("PUT timetable", "calibration", OPERATOR)
def put_timetable(
    desk: Desk, who: Person, order: orders.TimetableOrder
) -> tuple[views.TimetableRow, ...]:
    """Activate a timetable with all its `entries`; `null`: the timetable of the plant file.

    An entry has the keys of the [plant file](plant-format.md#timetable).
    """
    entries = order.model_dump()["entries"]
    made = None if entries is None else [TimetableEntry.of(entry) for entry in entries]
    desk.operations.automatic.timetable.put(who, made)
    return desk.operations.automatic.timetable.rows()


@_call("GET retries", "calibration")
def retries(desk: Desk) -> tuple[Retry, ...]:
    """Return the tasks that automatic control retries or has given up.

    Each record states the work, its subject, the number of failures, the last reason, seconds until
    the next attempt (null: no automatic attempt), and what follows.
    """
    return desk.operations.automatic.retries()


@_call("GET heliostats/{name}/parameters", "calibration")
async def parameters(desk: Desk, who: Person, order: orders.Named) -> ParametersView:
    """Return the error parameters of a heliostat.

    Returns the parameters from the plant file, the parameters in use with σ, whether the local
    controller stores them (queried now for an operator, otherwise as last compared), and earlier
    versions.
    """
    return await desk.operations.parameters.view(order.name, who)


@_call("GET heliostats/{name}/versions", "calibration")
async def versions(desk: Desk, order: orders.TwoVersions) -> ParameterComparison:
    """Return two versions of a heliostat's parameters for comparison, with σ.

    `?first=3&second=5`; 0 is the plant file. `beam_rms` and `beam_most`: change of the beam at its
    aim over the sun positions of this day, m.
    """
    return await desk.operations.parameters.compare(order.name, order.first, order.second)


@_call("POST parameters", "calibration", ENGINEER)
async def set_parameters(desk: Desk, who: Person, order: orders.ParameterOrder) -> TicketState:
    """Set error parameters of a heliostat at rest to `values`, or restore an earlier `version`.

    The `reason` is recorded. If the plant file requires a
    [second approval](plant-format.md#second-approval), nothing is written and no command authority
    is needed: the change waits, and the ticket ends with the outcome.
    """
    typed, approvals = desk.operations.parameters, desk.operations.approvals
    if bool(order.values) == bool(order.version):
        raise InputError("parameters: specify either values or a version, not both")
    if approvals.needed:
        return desk.tickets.put(await approvals.ask(who, **order.model_dump()))
    token = desk.token_of(who)
    if order.version:
        ticket = await typed.restore(who, token, order.heliostat, order.version, order.reason)
    else:
        ticket = typed.change(who, token, order.heliostat, order.values, order.reason)
    return await desk.recorded(ticket)


@_call("GET parameters/waiting", "calibration")
def waiting_changes(desk: Desk) -> tuple[WaitingChange, ...]:
    """Return the parameter changes that wait for the approval of a second engineer."""
    return desk.operations.approvals.waiting


@_call("POST parameters/waiting/{number}/approve", "calibration", ENGINEER)
async def approve_change(desk: Desk, who: Person, order: orders.OneChange) -> TicketState:
    """Approve another engineer's change, which is then written at once.

    You or the author of the change must have the command authority. A change that cannot be written
    now continues to wait.
    """
    return await desk.recorded(await desk.operations.approvals.approve(who, order.number))


@_call("POST parameters/waiting/{number}/refuse", "calibration", ENGINEER, body=orders.ReasonGiven)
def refuse_change(desk: Desk, who: Person, order: orders.RefusedChange) -> None:
    """Refuse another engineer's change, with a `reason`."""
    desk.operations.approvals.refuse(who, order.number, order.reason)


@_call("DELETE parameters/waiting/{number}", "calibration", ENGINEER)
def withdraw_change(desk: Desk, who: Person, order: orders.OneChange) -> None:
    """Withdraw your own change."""
    desk.operations.approvals.withdraw(who, order.number)


# -- the plant file ------------------------------------------------------------------------------


@_call("GET plant-file", "plant file", ENGINEER)
async def plant_file(desk: Desk, who: Person) -> PlantFileView:
    """Return the [plant file](plant-format.md), its stored versions, and the text that waits.

    `differs`: the tables that differ from the text in use, which take effect when the plant
    restarts; `waiting`: a text that waits for the approval of a second engineer.
    """
    return await desk.operations.plant_file.view(who)


@_call("GET plant-file/help", "plant file", fresh=ALWAYS)
def plant_file_help(desk: Desk) -> tuple[HelpTable, ...]:
    """Return the keys of each table of a plant file, with their kind, limits and meaning."""
    del desk
    return plant_help()


@_call("GET plant-file/versions/{name}", "plant file", ENGINEER)
async def plant_file_version(desk: Desk, who: Person, order: orders.Named) -> str:
    """Return the text of a stored version of the plant file."""
    return await desk.operations.plant_file.stored(who, order.name)


@_call("POST plant-file/check", "plant file", ENGINEER)
async def check_plant_file(desk: Desk, who: Person, order: orders.PlantFileText) -> PlantFileCheck:
    """Check a text as `heliotrope field check` would check the plant file; nothing is written.

    Returns errors and warnings with their lines, and the differences from the present file.
    `at_once`: the plant would use the text at once, because it differs only in views of cameras and
    marks on targets; otherwise it takes effect when the plant restarts.
    """
    return await desk.operations.plant_file.check(who, order.text)


@_call("PUT plant-file", "plant file", ENGINEER)
async def put_plant_file(desk: Desk, who: Person, order: orders.PlantFileOrder) -> PlantFileStored:
    """Replace the plant file by a text without errors, and keep the old one; nothing moves.

    `version` is the version of the text that you changed, as returned by `GET plant-file`; if the
    file has changed since, nothing is stored. The `reason` is recorded. If the plant uses the new
    text at once, the request needs the command authority. If the plant file requires a
    [second approval](plant-format.md#second-approval), nothing is written until then.
    """
    return await desk.operations.plant_file.store(who, order.text, order.version, order.reason)


@_call("POST plant-file/waiting/{number}/approve", "plant file", ENGINEER)
async def approve_plant_file(desk: Desk, who: Person, order: orders.OneChange) -> PlantFileStored:
    """Approve another engineer's text, which is then stored; if that fails, it waits again."""
    return await desk.operations.plant_file.approve(who, order.number)


@_call("POST plant-file/waiting/{number}/refuse", "plant file", ENGINEER, body=orders.ReasonGiven)
def refuse_plant_file(desk: Desk, who: Person, order: orders.RefusedChange) -> None:
    """Refuse another engineer's text, with a `reason`."""
    desk.operations.plant_file.refuse(who, order.number, order.reason)


@_call("DELETE plant-file/waiting/{number}", "plant file", ENGINEER)
def withdraw_plant_file(desk: Desk, who: Person, order: orders.OneChange) -> None:
    """Withdraw your own text of the plant file."""
    desk.operations.plant_file.withdraw(who, order.number)


# -- photographs ---------------------------------------------------------------------------------


@_call("GET targets/{name}", "calibration")
def target(desk: Desk, order: orders.Named) -> CameraReading:
    """Return the software's findings in the latest photograph of a target."""
    return CameraReading.of(desk.operations.camera(order.name))


@_call("GET targets/{name}/photograph", "calibration")
def photograph(desk: Desk, order: orders.Picture) -> WithBlob:
    """Return the latest photograph of a target, annotated with what the software found."""
    view = desk.operations.camera(order.name)
    return WithBlob({"version": view.version}, b"" if view.version == order.known else view.jpeg)


@_call("POST targets/{name}/photograph", "calibration", OPERATOR)
async def take_photograph(desk: Desk, who: Person, order: orders.Named) -> CameraReading:
    """Photograph a target now, with or without a beam on it."""
    return CameraReading.of(await desk.operations.photograph(who, order.name))


@_call("GET photographs", "calibration")
async def kept_photographs(desk: Desk, order: orders.KeptOf) -> tuple[views.PictureRow, ...]:
    """Return the newest stored photographs of a heliostat (`?heliostat=`).

    Each photograph is returned with the result of its visit. Without a heliostat, the photographs
    that operators requested are returned.
    """
    return tuple(await desk.kept(order.heliostat, order.limit))


@_call("GET photographs/{identity}", "calibration")
async def kept_photograph(desk: Desk, order: orders.KeptOne) -> WithBlob:
    """Return a stored photograph, annotated with what the software found."""
    return WithBlob({"identity": order.identity}, await desk.kept_picture(order.identity))


@_call("POST targets/{name}/marks/picture", "calibration", ENGINEER)
def begin_marks(desk: Desk, who: Person, order: orders.Named) -> PictureToMark:
    """Hold the newest picture from a target's camera, so that you can mark the target's corners.

    Returns the `number` and the size of the picture, the points with the pixels where they are
    expected, and where marks are stored.
    """
    return desk.marking.begin(who, order.name)


@_call("GET pictures-to-mark/{identity}", "calibration", ENGINEER)
async def picture_to_mark(desk: Desk, order: orders.KeptOne) -> WithBlob:
    """Return a picture that is held for marking, as JPEG, as taken by the camera.

    The last four pictures are held.
    """
    return WithBlob({"number": order.identity}, await desk.marking.picture(order.identity))


@_call("POST targets/{name}/marks", "calibration", ENGINEER, body=orders.Clicks)
async def mark_corners(desk: Desk, who: Person, order: orders.Marks) -> MarksView:
    """Test the points that a user has clicked in a held picture.

    `number` is the number of the picture, and `points` contains the pixel coordinates of each
    point by its name. Returns residuals, notes, and the target as seen from the front. With `save`,
    which needs the command authority, the camera uses the points from now on.
    """
    token = desk.token_of(who) if order.save else None
    points = {name: (x, y) for name, (x, y) in order.points.items()}
    return await desk.marking.mark(who, order.name, order.number, points, token)


# -- flights and learning ------------------------------------------------------------------------


def _flight_text(document: FlightDocument) -> tuple[dict[str, Any], bytes]:
    return {}, document.model_dump_json().encode()


@_call("GET flights", "calibration", fresh=FRESH)
def flights(desk: Desk) -> tuple[views.FlightView, ...]:
    """Return the drone flights imported into the plant, the latest first.

    Each entry states what was done with the heliostats of the flight, and the errors that its
    records share.
    """
    return desk.operations.automatic.flights.views()


@_call("POST flights", "calibration", ENGINEER, body=FlightDocument, pack=_flight_text)
async def take_flight(desk: Desk, who: Person, blob: bytes) -> views.FlightView:
    """Import a drone flight; nothing moves, and the reply comes once all heliostats are fitted.

    The body is the [`flight.json`](formats.md#flightjson) from `heliotrope drone evaluate`, at most
    8 MiB and 20,000 records.
    """
    document = await asyncio.to_thread(parse_flight, blob)
    return await desk.operations.automatic.flights.take(who, document, blob.decode())


@_call("GET learning", "calibration", fresh=FRESH)
def learning(desk: Desk) -> tuple[views.LearningView, ...]:
    """Return what was learnt about each heliostat group, when, from what, and what is in use."""
    return desk.operations.automatic.learning.views()


@_call("POST learning", "calibration", ENGINEER)
def learn(desk: Desk, who: Person, order: orders.OneGroup) -> tuple[views.LearningView, ...]:
    """Learn the drift, noise and installation errors of a `group` ("": all groups) now.

    The plant also does this every night. No heliostat moves; learning runs in a separate process,
    and `GET learning` reports the result.
    """
    desk.operations.learn(who, order.group)
    return desk.operations.automatic.learning.views()


_REQUESTS = [
    (re.compile(re.sub(r"\{(\w+)\}", r"(?P<\1>[^/]+)", call.request)), name)
    for name, call in CALLS.items()
    if call.request
]


def asked(request: str) -> tuple[str, dict[str, Any]]:
    """Return the call for a request (method, path and query), and the arguments in it.

    Raises
    ------
    InputError
        If no call has this request; the console answers some requests by itself.
    """
    place, _, query = request.partition("?")
    for pattern, name in _REQUESTS:
        if (found := pattern.fullmatch(place)) is not None:
            named = {key: unquote(value) for key, value in found.groupdict().items()}
            return name, {**named, **dict(parse_qsl(query))}
    raise InputError(f"{place[:100]} is known only to the console; omit --data")
