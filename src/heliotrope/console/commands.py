"""The HTTP API, version 1: commands.

Every command is given as the caller, with the role that the store has for them now, through the one
command authority; an accepted command has its record in the audit before it is sent. EMERGENCY is
open to everybody who is signed in; everything else needs an operator.
"""

from fastapi import APIRouter, HTTPException, Request
from fastapi.responses import JSONResponse, Response

from heliotrope.calibration.flights import LARGEST, FlightDocument
from heliotrope.console import models
from heliotrope.console.api import REFUSALS, Identity, Named, answer
from heliotrope.console.auth import Anyone, Engineer, Here, Operator, refused, settle
from heliotrope.errors import InputError
from heliotrope.plant.authority import OPERATOR_COMMANDS, Role
from heliotrope.plant.interface import orders

router = APIRouter(prefix="/api/v1", responses=REFUSALS)


@router.post("/emergency", response_model=models.EmergencyView, tags=["safety"])
async def call_emergency(
    console: Here, who: Anyone, order: orders.EmergencyCall | None = None
) -> JSONResponse:
    """Order DEFOCUS (or STOW) of the whole field, with proof; open to everybody signed in."""
    call = order or orders.EmergencyCall()
    return answer(await console.plant.ask("order_emergency", who.person, **call.model_dump()))


@router.delete("/emergency", response_model=models.EmergencyView, tags=["safety"])
async def withdraw_emergency(
    console: Here, who: Operator, given: orders.Withdrawal | None = None
) -> JSONResponse:
    """Withdraw your emergency order, or an owner's as an engineer; nothing moves because of it.

    The emergency goes on while another person's order stands.
    """
    owner = "" if given is None else given.owner
    return answer(await console.plant.ask("withdraw_emergency", who.person, owner=owner))


@router.post("/alarms/acknowledge", status_code=204, tags=["alarms"])
async def acknowledge(console: Here, who: Operator, which: orders.Acknowledged) -> None:
    """Acknowledge an alarm."""
    await console.plant.ask("acknowledge", who.person, **which.model_dump())


@router.get("/authority", response_model=models.AuthorityState, tags=["authority"])
async def authority(console: Here, who: Anyone) -> models.AuthorityState:
    """Return the holder of the command authority."""
    return models.AuthorityState(**await console.plant.ask("authority", who.person))


@router.post("/authority", response_model=models.AuthorityState, tags=["authority"])
async def take(console: Here, who: Operator) -> models.AuthorityState:
    """Take the command authority, or renew it; automatic control gives way."""
    return models.AuthorityState(**await console.plant.ask("take_authority", who.person))


@router.post("/authority/seize", response_model=models.AuthorityState, tags=["authority"])
async def seize(console: Here, who: Operator, why: orders.GivenReason) -> models.AuthorityState:
    """Break another person's command authority and take it."""
    return models.AuthorityState(
        **await console.plant.ask("seize_authority", who.person, reason=why.reason)
    )


@router.put("/authority", response_model=models.AuthorityState, tags=["authority"])
async def keep(console: Here, who: Operator) -> models.AuthorityState:
    """Renew the command authority: every few seconds, while somebody is present."""
    return models.AuthorityState(**await console.plant.ask("keep_authority", who.person))


@router.delete("/authority", response_model=models.AuthorityState, tags=["authority"])
async def release(console: Here, who: Operator) -> models.AuthorityState:
    """Release the command authority; automatic control continues."""
    return models.AuthorityState(**await console.plant.ask("release_authority", who.person))


@router.post("/stow", response_model=models.TicketState, tags=["commands"])
async def stow(console: Here, who: Operator, order: orders.SomeHeliostats) -> models.TicketState:
    """Send heliostats to stow; needs no authority."""
    found = await console.plant.ask("stow", who.person, heliostats=order.heliostats)
    return models.TicketState(**found)


@router.post("/defocus", response_model=models.TicketState, tags=["commands"])
async def defocus(console: Here, who: Operator, order: orders.SomeHeliostats) -> models.TicketState:
    """Take beams off the receiver; needs no authority."""
    found = await console.plant.ask("defocus", who.person, heliostats=order.heliostats)
    return models.TicketState(**found)


@router.post("/commands", response_model=models.TicketState, tags=["commands"])
async def command(
    console: Here, who: Operator, request: Request, order: orders.CommandOrder
) -> models.TicketState:
    """Give a command of the wire: APPROACH, TRACK, IDLE, LOCK, SEARCH, JOG, ZERO, ..."""
    name = order.command
    if name in ("STOW", "DEFOCUS"):
        found = await console.plant.ask(name.lower(), who.person, heliostats=order.heliostats)
        return models.TicketState(**found)
    settle(who, request)
    if name not in OPERATOR_COMMANDS and who.person.role < Role.ENGINEER:
        await refused(console, request, who)
        raise HTTPException(403, f"{name}: {who.person.name} is operator; this needs engineer")
    return models.TicketState(
        **await console.plant.ask("command", who.person, **order.model_dump())
    )


@router.get("/commands", response_model=list[models.TicketState], tags=["commands"])
async def commands(console: Here, who: Anyone) -> list[models.TicketState]:
    """Return the last commands given through the console, newest first."""
    del who
    return [models.TicketState(**one) for one in await console.plant.ask("commands")]


@router.get("/commands/{identity}", response_model=models.TicketState, tags=["commands"])
async def one_command(console: Here, who: Anyone, identity: Named) -> models.TicketState:
    """Return the progress of a command."""
    del who
    return models.TicketState(**await console.plant.ask("one_command", name=identity))


@router.post("/aim", response_model=models.TicketState, tags=["commands"])
async def aim(console: Here, who: Operator, order: orders.AimOrder) -> models.TicketState:
    """Aim heliostats at a receiver or a target by name, or at points."""
    if bool(order.where) == bool(order.points):
        raise InputError("aim: give either where (a receiver or target) or points")
    to = {"heliostats": order.heliostats, "where": order.where}
    found = await console.plant.point("aim", who.person, order.points, **to)
    return models.TicketState(**found)


@router.post("/standby", response_model=models.TicketState, tags=["commands"])
async def standby(console: Here, who: Operator, order: orders.StandbyOrder) -> models.TicketState:
    """Set standby points."""
    return models.TicketState(**await console.plant.point("standby", who.person, order.points))


@router.post("/automatic", response_model=models.TicketState, tags=["commands"])
async def automatic(
    console: Here, who: Operator, order: orders.SomeHeliostats
) -> models.TicketState:
    """Give heliostats to automatic control, which raises and calibrates them.

    Done where a heliostat follows; else its step says why not.
    """
    found = await console.plant.ask("automatic", who.person, heliostats=order.heliostats)
    return models.TicketState(**found)


@router.post("/automatic/resume", status_code=204, tags=["commands"])
async def resume(console: Here, who: Operator) -> None:
    """Let automatic control go on after a loss of many heliostats."""
    await console.plant.ask("resume", who.person)


@router.put("/calibration", response_model=models.CalibrationView, tags=["calibration"])
async def switch(console: Here, who: Operator, to: orders.Switch) -> JSONResponse:
    """Switch automatic calibration on or off."""
    return answer(await console.plant.ask("switch_calibration", who.person, on=to.on))


@router.post("/calibration/next", response_model=models.TicketState, tags=["calibration"])
async def calibrate(
    console: Here, who: Operator, order: orders.OneCalibration
) -> models.TicketState:
    """Calibrate a heliostat before all others; it ends with the result of its visit."""
    found = await console.plant.ask("calibrate", who.person, **order.model_dump())
    return models.TicketState(**found)


@router.put("/timetable", response_model=models.many(models.TimetableRow), tags=["calibration"])
async def put_timetable(console: Here, who: Operator, order: orders.TimetableOrder) -> JSONResponse:
    """Put a timetable of calibrations in force, or with null that of the plant file."""
    return answer(await console.plant.ask("put_timetable", who.person, **order.model_dump()))


@router.post("/parameters", response_model=models.TicketState, tags=["calibration"])
async def set_parameters(
    console: Here, who: Engineer, order: orders.ParameterOrder
) -> models.TicketState:
    """Set error parameters of a heliostat at rest, or bring back an earlier version."""
    found = await console.plant.ask("set_parameters", who.person, **order.model_dump())
    return models.TicketState(**found)


@router.post(
    "/targets/{name}/photograph", response_model=models.CameraReading, tags=["calibration"]
)
async def take_photograph(console: Here, who: Operator, name: Named) -> JSONResponse:
    """Photograph a target now, with whatever beam is on it."""
    return answer(await console.plant.ask("take_photograph", who.person, name=name))


@router.post(
    "/targets/{name}/marks/picture", response_model=models.PictureToMark, tags=["calibration"]
)
async def begin_marks(console: Here, who: Engineer, name: Named) -> JSONResponse:
    """Hold the newest picture of a target's camera, so that its corners can be marked."""
    return answer(await console.plant.ask("begin_marks", who.person, name=name))


@router.get(
    "/pictures-to-mark/{identity}",
    tags=["calibration"],
    response_class=Response,
    responses={200: {"content": {"image/jpeg": {}}}},
)
async def picture_to_mark(console: Here, who: Engineer, identity: Identity) -> Response:
    """Return a picture that is held to be marked, as the camera took it."""
    _, jpeg = await console.plant.fetch("picture_to_mark", who.person, identity=identity)
    return Response(jpeg, media_type="image/jpeg", headers={"Cache-Control": "no-store"})


@router.post("/targets/{name}/marks", response_model=models.MarksView, tags=["calibration"])
async def mark_corners(
    console: Here, who: Engineer, name: Named, order: orders.Clicks
) -> JSONResponse:
    """Try corner markers clicked in a picture; with save the camera works by them from now on."""
    given = order.model_dump()
    return answer(await console.plant.ask("mark_corners", who.person, name=name, **given))


@router.post("/clusters/{name}/frames", response_model=models.many(models.BusFrame), tags=["logs"])
async def record_frames(console: Here, who: Engineer, name: Named) -> JSONResponse:
    """Record the frames of a cluster's bus for five seconds; nothing moves."""
    return answer(await console.plant.ask("bus_frames", who.person, name=name))


@router.post("/flights", response_model=models.FlightView, tags=["calibration"])
async def take_flight(console: Here, who: Engineer, document: FlightDocument) -> JSONResponse:
    """Take a flight of a drone: the flight.json of `heliotrope drone evaluate`; nothing moves."""
    text = document.model_dump_json().encode()
    if len(text) > LARGEST:
        raise HTTPException(413, f"the flight is longer than {LARGEST >> 20} MiB; divide it")
    value, _ = await console.plant.fetch("take_flight", who.person, text)
    return answer(value)


@router.post("/learning", response_model=models.many(models.LearningView), tags=["calibration"])
async def learn(console: Here, who: Engineer, order: orders.OneGroup) -> JSONResponse:
    """Learn drift, noise and installation of a group of mirrors now; nothing moves."""
    return answer(await console.plant.ask("learn", who.person, **order.model_dump()))


@router.put("/readings/{name}", status_code=204, tags=["safety"])
async def give_reading(console: Here, who: Engineer, name: Named, order: orders.Reading) -> None:
    """Give a reading of the safety table, for a sensor that the plant does not read itself."""
    await console.plant.ask("give_reading", who.person, name=name, **order.model_dump())


@router.post("/holds", response_model=models.TicketState, tags=["commands"])
async def hold(console: Here, who: Operator, order: orders.HoldOrder) -> models.TicketState:
    """Lock heliostats, targets, receivers or the tower: heliostats concerned stow, and stay there.

    Each person has a lock of their own. Done where a heliostat is parked in stow.
    """
    return models.TicketState(**await console.plant.ask("hold", who.person, **order.model_dump()))


@router.post("/holds/release", response_model=models.many(models.Lockout), tags=["commands"])
async def unhold(console: Here, who: Operator, order: orders.GivenBack) -> JSONResponse:
    """Return your locks, or remove an owner's as an engineer; nothing moves.

    What is locked is in service again when nobody's lock is left.
    """
    return answer(await console.plant.ask("unhold", who.person, **order.model_dump()))
