"""The table of calls: least role, arguments, and the work done in the plant's loop."""

from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any

from heliotrope.errors import InputError
from heliotrope.field.timetable import TimetableEntry
from heliotrope.plant.authority import Person, Role
from heliotrope.plant.interface import orders
from heliotrope.plant.interface.desk import Desk, reading_of
from heliotrope.plant.interface.encoding import frame_parts
from heliotrope.plant.interface.overview import overview
from heliotrope.plant.operations.security import SecurityEvent
from heliotrope.plant.operations.zero import lock_position, zero
from heliotrope.plant.tickets import Ticket


@dataclass(frozen=True)
class WithBlob:
    """A value, and the bytes that go with it."""

    value: Any
    blob: bytes


Work = Callable[[Desk, Person, Any, bytes], Any]
Then = Callable[[Desk, Person, Any], Coroutine[Any, Any, Any]]


@dataclass(frozen=True)
class Call:
    """One call.

    Attributes
    ----------
    role
        Least role of the person on whose behalf it is made.
    arguments
        Model of the arguments.
    work
        Does it in the plant's loop; the value is made plain elsewhere.
    then
        Turns the result of the work into the value where that has to wait in the plant's loop.
    urgent
        Whether it belongs to the socket for EMERGENCY, DEFOCUS and STOW.
    console
        Whether only a console may make it.
    blob
        Whether it takes a blob.
    """

    role: Role
    arguments: type[orders.Strict]
    work: Work
    then: Then | None = None
    urgent: bool = False
    console: bool = False
    blob: bool = False


def _see(look: Callable[[Desk], Any]) -> Call:
    return Call(Role.VIEWER, orders.Nothing, lambda desk, *_: look(desk))


def _live(desk: Desk, *_: Any) -> WithBlob:
    head, blob = frame_parts(desk.operations.frame())
    return WithBlob({"frame": head, "overview": overview(desk.operations)}, blob)


def _photograph(desk: Desk, _: Person, given: orders.Picture, __: bytes) -> WithBlob:
    view = desk.operations.camera(given.name)
    return WithBlob({"version": view.version}, b"" if view.version == given.known else view.jpeg)


def _target(desk: Desk, _: Person, given: orders.Named, __: bytes) -> dict[str, Any]:
    return reading_of(desk.operations.camera(given.name))


async def _kept_one(desk: Desk, _: Person, identity: int) -> WithBlob:
    return WithBlob({"identity": identity}, await desk.kept_picture(identity))


async def _to_mark(desk: Desk, _: Person, identity: int) -> WithBlob:
    return WithBlob({"number": identity}, await desk.marking.picture(identity))


def _withdraw(desk: Desk, who: Person, given: orders.Withdrawal, _: bytes) -> Any:
    desk.operations.withdraw(who, given.owner)
    return desk.operations.emergency_view()


def _command(desk: Desk, who: Person, given: orders.CommandOrder, _: bytes) -> Ticket:
    here, token = desk.operations, desk.token_of(who)
    if given.command not in ("ZERO", "LOCK_POSITION"):
        return here.command(who, token, given.command, given.heliostats, given.values)
    ticket: Ticket
    if given.command == "LOCK_POSITION":
        if given.values:
            raise InputError("LOCK_POSITION: it takes no values; they are those of the aim")
        ticket, text = lock_position(here.plant, who, token, given.heliostats)
        here.logbook.event("command", who.name, text)
        return ticket
    ticket = zero(here.plant, who, token, given.heliostats, given.values)
    here.logbook.event("command", who.name, f"ZERO {given.heliostats[0]}")
    return ticket


def _aim(desk: Desk, who: Person, given: orders.PointsOrder, blob: bytes) -> Ticket:
    if bool(given.where) == bool(given.points):
        raise InputError("aim: give either where (a receiver or target) or points")
    here, token = desk.operations, desk.token_of(who)
    if given.where:
        return here.aim_at(who, token, given.heliostats, given.where)
    return here.aim(who, token, orders.points_of(given, blob))


def _standby(desk: Desk, who: Person, given: orders.PointsOrder, blob: bytes) -> Ticket:
    points = orders.points_of(given, blob)
    return desk.operations.standby(who, desk.token_of(who), points)


def _switch(desk: Desk, who: Person, given: orders.Switch, _: bytes) -> Any:
    desk.operations.switch_calibration(who, given.on)
    return desk.operations.calibration()


def _calibrate(desk: Desk, who: Person, given: orders.OneCalibration, _: bytes) -> Any:
    return desk.tickets.put(
        desk.operations.calibrate(
            who,
            given.heliostat,
            given.target,
            search=given.search,
            together=given.together,
            receiver=given.receiver,
        )
    )


def _learn(desk: Desk, who: Person, given: orders.OneGroup, _: bytes) -> Any:
    desk.operations.learn(who, given.group)
    return desk.operations.learning()


def _hold(desk: Desk, who: Person, given: orders.HoldOrder, _: bytes) -> Any:
    order = given.model_dump(exclude_none=True)
    return desk.tickets.put(desk.operations.hold(who, **order))


def _unhold(desk: Desk, who: Person, given: orders.GivenBack, _: bytes) -> Any:
    desk.operations.unhold(who, **given.model_dump())
    return desk.operations.holds()


def _timetable(desk: Desk, who: Person, given: orders.TimetableOrder, _: bytes) -> Any:
    entries = given.model_dump()["entries"]
    made = None if entries is None else [TimetableEntry.of(entry) for entry in entries]
    desk.operations.put_timetable(who, made)
    return desk.operations.timetable()


_VIEWS = {
    "field": _see(lambda desk: desk.field()),
    "size": _see(lambda desk: len(desk.operations.names)),
    "summary": _see(lambda desk: desk.operations.summary()),
    "sun": _see(lambda desk: desk.operations.sun()),
    "clusters": _see(lambda desk: desk.operations.cluster_rows()),
    "alarms": _see(lambda desk: desk.operations.alarms()),
    "calibration": _see(lambda desk: desk.operations.calibration()),
    "flights": _see(lambda desk: desk.operations.flights()),
    "learning": _see(lambda desk: desk.operations.learning()),
    "retries": _see(lambda desk: desk.operations.retries()),
    "timetable": _see(lambda desk: desk.operations.timetable()),
    "holds": _see(lambda desk: desk.operations.holds()),
    "emergency": _see(lambda desk: desk.operations.emergency_view()),
    "commands": _see(lambda desk: desk.tickets.last()),
    "authority": Call(Role.VIEWER, orders.Nothing, lambda d, who, *_: d.authority_of(who)),
    "heliostat": Call(
        Role.VIEWER, orders.Named, lambda d, _, a, __: d.operations.heliostat(a.name)
    ),
    "flux": Call(Role.VIEWER, orders.Named, lambda d, _, a, __: d.operations.receiver_flux(a.name)),
    "one_command": Call(Role.VIEWER, orders.Named, lambda d, _, a, __: d.tickets.get(a.name)),
    "target": Call(Role.VIEWER, orders.Named, _target),
    "photograph": Call(Role.VIEWER, orders.Picture, _photograph),
    "parameters": Call(
        Role.VIEWER, orders.Named, lambda _d, _who, given, _b: given.name, Desk.parameters
    ),
    "kept_photographs": Call(
        Role.VIEWER, orders.KeptOf, lambda _d, _who, given, _b: given, Desk.kept
    ),
    "kept_photograph": Call(
        Role.VIEWER, orders.KeptOne, lambda _d, _who, given, _b: given.identity, _kept_one
    ),
    "events": Call(Role.VIEWER, orders.Some, lambda d, _, a, __: d.operations.events(a.limit)),
    "packets": Call(
        Role.VIEWER, orders.Some, lambda d, _, a, __: d.operations.packets(a.limit, a.cluster)
    ),
    "schedule": Call(Role.VIEWER, orders.Some, lambda d, _, a, __: d.operations.schedule(a.limit)),
}
_URGENT = {
    "order_emergency": Call(
        Role.VIEWER,
        orders.EmergencyCall,
        lambda d, who, a, _: d.order_emergency(who, a),
        urgent=True,
    ),
    "stow": Call(
        Role.OPERATOR,
        orders.SomeHeliostats,
        lambda d, who, a, _: d.tickets.put(d.operations.stow(who, a.heliostats)),
        urgent=True,
    ),
    "defocus": Call(
        Role.OPERATOR,
        orders.SomeHeliostats,
        lambda d, who, a, _: d.tickets.put(d.operations.defocus(who, a.heliostats)),
        urgent=True,
    ),
}
_ORDERS = {
    "withdraw_emergency": Call(Role.OPERATOR, orders.Withdrawal, _withdraw),
    "acknowledge": Call(
        Role.OPERATOR,
        orders.Acknowledged,
        lambda d, who, a, _: d.operations.acknowledge(who, a.condition, a.subject),
    ),
    "take_authority": Call(
        Role.OPERATOR, orders.Nothing, lambda d, who, *_: d.take(who), Desk.told
    ),
    "seize_authority": Call(
        Role.OPERATOR, orders.GivenReason, lambda d, who, a, _: d.seize(who, a.reason), Desk.told
    ),
    "keep_authority": Call(Role.OPERATOR, orders.Nothing, lambda d, who, *_: d.keep(who)),
    "release_authority": Call(Role.OPERATOR, orders.Nothing, lambda d, who, *_: d.release(who)),
    "command": Call(Role.OPERATOR, orders.CommandOrder, _command, Desk.recorded),
    "aim": Call(Role.OPERATOR, orders.PointsOrder, _aim, Desk.recorded, blob=True),
    "standby": Call(Role.OPERATOR, orders.PointsOrder, _standby, Desk.recorded, blob=True),
    "automatic": Call(
        Role.OPERATOR,
        orders.SomeHeliostats,
        lambda d, who, a, _: d.tickets.put(d.operations.give_back(who, a.heliostats)),
    ),
    "resume": Call(Role.OPERATOR, orders.Nothing, lambda d, who, *_: d.operations.resume(who)),
    "switch_calibration": Call(Role.OPERATOR, orders.Switch, _switch),
    "calibrate": Call(Role.OPERATOR, orders.OneCalibration, _calibrate),
    "set_parameters": Call(
        Role.ENGINEER, orders.ParameterOrder, lambda _d, _who, given, _b: given, Desk.set_parameters
    ),
    "take_photograph": Call(
        Role.OPERATOR, orders.Named, lambda _d, _who, given, _b: given.name, Desk.photographed
    ),
    "begin_marks": Call(
        Role.ENGINEER, orders.Named, lambda d, who, a, _: d.marking.begin(who, a.name)
    ),
    "picture_to_mark": Call(
        Role.ENGINEER, orders.KeptOne, lambda _d, _who, given, _b: given.identity, _to_mark
    ),
    "mark_corners": Call(
        Role.ENGINEER, orders.Marks, lambda _d, _who, given, _b: given, Desk.mark_corners
    ),
    "bus_frames": Call(
        Role.ENGINEER, orders.Named, lambda _d, _who, given, _b: given.name, Desk.bus_frames
    ),
    "take_flight": Call(
        Role.ENGINEER, orders.Nothing, lambda _, __, ___, blob: blob, Desk.take_flight, blob=True
    ),
    "learn": Call(Role.ENGINEER, orders.OneGroup, _learn),
    "give_reading": Call(
        Role.ENGINEER,
        orders.NamedReading,
        lambda d, who, a, _: d.readings.take(who, a.name, a.value, a.at),
    ),
    "hold": Call(Role.OPERATOR, orders.HoldOrder, _hold),
    "put_timetable": Call(Role.OPERATOR, orders.TimetableOrder, _timetable),
    "unhold": Call(Role.OPERATOR, orders.GivenBack, _unhold),
}
_CONSOLES = {
    "live": Call(Role.VIEWER, orders.Nothing, _live, console=True),
    "note": Call(
        Role.VIEWER,
        orders.Note,
        lambda d, _, a, __: d.operations.security.note(
            SecurityEvent[a.kind], a.who, a.address, a.detail
        ),
        console=True,
    ),
}
#: All calls that are done in the plant's loop, by name.
CALLS: dict[str, Call] = _VIEWS | _URGENT | _ORDERS | _CONSOLES
