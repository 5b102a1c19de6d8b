"""The HTTP API, version 1: reading the plant."""

import asyncio
import contextlib
import gzip
import math
import time
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request, Response, WebSocket
from fastapi.responses import JSONResponse
from starlette.websockets import WebSocketDisconnect

from heliotrope import __version__
from heliotrope.console import models
from heliotrope.console._files import SMALL, takes_gzip
from heliotrope.console.auth import (
    DUES,
    FIXED,
    Anyone,
    Console,
    Here,
    console_of,
    find_caller,
    same_origin,
)
from heliotrope.plant.operations.security import SecurityEvent

#: Answers that any route behind the sign-in may give.
REFUSALS: dict[int | str, dict[str, Any]] = {
    401: {"model": models.Problem, "description": "Not signed in"},
    403: {"model": models.Problem, "description": "The role is too low"},
    404: {"model": models.Problem, "description": "Unknown name"},
    409: {"model": models.Problem, "description": "Not accepted now; nothing was sent"},
    422: {"model": models.Problem, "description": "The request cannot be used"},
    503: {"model": models.Problem, "description": "It cannot be recorded now; nothing was sent"},
}
#: Age of a view that all viewers share, s.
FRESH = 0.5
MOST_SHARED = 100
router = APIRouter(prefix="/api/v1", responses=REFUSALS)

Named = Annotated[str, Path(max_length=64)]
Limit = Annotated[int, Query(ge=1, le=2000)]
Identity = Annotated[int, Path(ge=1, le=2**53)]


def answer(value: Any) -> JSONResponse:
    """Return a view; its model stands in the description of the route."""
    return JSONResponse(value, headers={"Cache-Control": "no-store"})


async def shared(
    console: Console, request: Request, call: str, fresh: float = FRESH, **arguments: Any
) -> Response:
    """Return an answer that is the same for everybody, encoded once for all callers of a moment.

    It holds nothing of the caller, so its compressed length reveals no secret.
    """
    key = " ".join((call, *map(str, arguments.values())))
    now, kept = time.monotonic(), console.shared.get(key)
    if kept is None or now - kept[0] >= fresh:
        if len(console.shared) >= MOST_SHARED:
            console.shared.clear()
        data = bytes(answer(await console.plant.ask(call, **arguments)).body)
        packed = gzip.compress(data, 1, mtime=0) if len(data) > SMALL else None
        kept = console.shared[key] = (now, data, packed)
    _, data, packed = kept
    headers = {"Cache-Control": "no-store", "Vary": "Accept-Encoding"}
    if packed is not None and takes_gzip(request.headers):
        data, headers["Content-Encoding"] = packed, "gzip"
    return Response(data, media_type="application/json", headers=headers)


@router.get("/health", tags=["plant"], responses={})
async def health(console: Here) -> dict[str, Any]:
    """Return whether the console answers; open to all, reveals nothing of the plant."""
    del console
    return {"ok": True, "version": __version__}


@router.get("/field", response_model=models.FieldDesign, tags=["field"])
async def field(console: Here, request: Request, who: Anyone) -> Response:
    """Return everything about the field that does not change."""
    del who
    return await shared(console, request, FIXED, math.inf)


@router.get("/summary", response_model=models.Summary, tags=["plant"])
async def summary(console: Here, request: Request, who: Anyone) -> Response:
    """Return a summary of the plant."""
    del who
    return await shared(console, request, "summary")


@router.get("/sun", response_model=models.SunView, tags=["plant"])
async def where_the_sun_is(console: Here, request: Request, who: Anyone) -> Response:
    """Return the position of the sun."""
    del who
    return await shared(console, request, "sun")


@router.get("/heliostats/{name}", response_model=models.HeliostatView, tags=["field"])
async def heliostat(console: Here, who: Anyone, name: Named) -> JSONResponse:
    """Return one heliostat in detail."""
    del who
    return answer(await console.plant.ask("heliostat", name=name))


@router.get("/clusters", response_model=models.many(models.ClusterRow), tags=["field"])
async def clusters(console: Here, request: Request, who: Anyone) -> Response:
    """Return the health of each cluster."""
    del who
    return await shared(console, request, "clusters")


@router.get("/receivers/{name}/flux", response_model=models.FluxView, tags=["plant"])
async def flux(console: Here, request: Request, who: Anyone, name: Named) -> Response:
    """Return the predicted flux on a receiver."""
    del who
    return await shared(console, request, "flux", name=name)


@router.get(
    "/targets/{name}/photograph",
    tags=["calibration"],
    response_class=Response,
    responses={200: {"content": {"image/jpeg": {}}}, 204: {"description": "No photograph yet"}},
)
async def photograph(console: Here, request: Request, who: Anyone, name: Named) -> Response:
    """Return the last photograph of a target, annotated with the findings of the software."""
    del who
    known = request.headers.get("if-none-match", "").strip('"')
    version = int(known) if known.isdecimal() and len(known) < 16 else -1
    view, jpeg = await console.plant.fetch("photograph", name=name, known=version)
    headers = {"ETag": f'"{view["version"]}"', "Cache-Control": "private, no-cache"}
    if not jpeg:
        seen = view["version"] == version
        return Response(status_code=304 if seen and version else 204, headers=headers)
    return Response(jpeg, media_type="image/jpeg", headers=headers)


@router.get("/targets/{name}", response_model=models.CameraReading, tags=["calibration"])
async def target(console: Here, who: Anyone, name: Named) -> JSONResponse:
    """Return the findings of the software in the last photograph of a target."""
    del who
    return answer(await console.plant.ask("target", name=name))


@router.get(
    "/heliostats/{name}/parameters", response_model=models.ParametersView, tags=["calibration"]
)
async def parameters(console: Here, who: Anyone, name: Named) -> JSONResponse:
    """Return the error parameters of a heliostat: in use, stored by it, and earlier versions."""
    del who
    return answer(await console.plant.ask("parameters", name=name))


@router.get("/photographs", response_model=models.many(models.PictureRow), tags=["calibration"])
async def kept(
    console: Here,
    who: Anyone,
    heliostat: Annotated[str, Query(max_length=64)] = "",
    limit: Limit = 50,
) -> JSONResponse:
    """Return the newest kept photographs of a heliostat; without one, those asked for."""
    del who
    return answer(await console.plant.ask("kept_photographs", heliostat=heliostat, limit=limit))


@router.get(
    "/photographs/{identity}",
    tags=["calibration"],
    response_class=Response,
    responses={200: {"content": {"image/jpeg": {}}}},
)
async def kept_photograph(console: Here, who: Anyone, identity: Identity) -> Response:
    """Return a kept photograph, annotated with the findings of the software."""
    del who
    _, jpeg = await console.plant.fetch("kept_photograph", identity=identity)
    headers = {"Cache-Control": "private, max-age=86400, immutable"}
    return Response(jpeg, media_type="image/jpeg", headers=headers)


@router.get("/alarms", response_model=models.many(models.AlarmRow), tags=["alarms"])
async def alarms(console: Here, request: Request, who: Anyone) -> Response:
    """Return the alarms, those that need attention first."""
    del who
    return await shared(console, request, "alarms")


@router.get("/events", response_model=models.many(models.EventRow), tags=["logs"])
async def events(console: Here, request: Request, who: Anyone, limit: Limit = 200) -> Response:
    """Return the last events, newest first."""
    del who
    return await shared(console, request, "events", limit=limit)


@router.get("/packets", response_model=models.many(models.PacketRow), tags=["logs"])
async def packets(
    console: Here,
    request: Request,
    who: Anyone,
    limit: Limit = 200,
    cluster: Annotated[str, Query(max_length=64)] = "",
) -> Response:
    """Return the last messages between plant and clusters, newest first."""
    del who
    return await shared(console, request, "packets", limit=limit, cluster=cluster)


@router.get("/calibration", response_model=models.CalibrationView, tags=["calibration"])
async def calibration(console: Here, request: Request, who: Anyone) -> Response:
    """Return the progress of calibration."""
    del who
    return await shared(console, request, "calibration")


@router.get("/schedule", response_model=models.many(models.Planned), tags=["calibration"])
async def schedule(console: Here, request: Request, who: Anyone, limit: Limit = 20) -> Response:
    """Return the planned next measurements."""
    del who
    return await shared(console, request, "schedule", limit=limit)


@router.get("/flights", response_model=models.many(models.FlightView), tags=["calibration"])
async def flights(console: Here, request: Request, who: Anyone) -> Response:
    """Return the flights of a drone that the plant has taken, the last first."""
    del who
    return await shared(console, request, "flights")


@router.get("/learning", response_model=models.many(models.LearningView), tags=["calibration"])
async def learning(console: Here, request: Request, who: Anyone) -> Response:
    """Return what was learnt of each group of mirrors, and is in force."""
    del who
    return await shared(console, request, "learning")


@router.get("/timetable", response_model=models.many(models.TimetableRow), tags=["calibration"])
async def timetable(console: Here, who: Anyone) -> JSONResponse:
    """Return the calibrations at times of day and at intervals that people want."""
    del who
    return answer(await console.plant.ask("timetable"))


@router.get("/holds", response_model=models.many(models.Lockout), tags=["calibration"])
async def holds(console: Here, who: Anyone) -> JSONResponse:
    """Return the heliostats that are out of service."""
    del who
    return answer(await console.plant.ask("holds"))


@router.get("/retries", response_model=models.many(models.Retry), tags=["calibration"])
async def retries(console: Here, who: Anyone) -> JSONResponse:
    """Return what automatic control tries again or has given up, and why."""
    del who
    return answer(await console.plant.ask("retries"))


@router.get("/emergency", response_model=models.EmergencyView, tags=["safety"])
async def emergency(console: Here, who: Anyone) -> JSONResponse:
    """Return the last emergency order with its proof."""
    del who
    return answer(await console.plant.ask("emergency"))


@router.websocket("/live")
async def live(socket: WebSocket) -> None:
    """Send the live stream; see docs/reference/api-http.md."""
    console: Console = console_of(socket)
    found = await find_caller(console, socket)
    if found is None or not same_origin(console, socket):
        if found is not None:
            await console.note(SecurityEvent.ORIGIN_REFUSED, socket, found.person.name)
        await socket.accept()
        await socket.close(4401, "sign in, or send a valid token")
        return
    await socket.accept()
    if found.owes:
        await socket.close(4403, DUES[found.owes][0])
        return
    if console.stream.viewers >= console.settings.viewers:
        await socket.close(4429, f"{console.settings.viewers} viewers are connected already")
        return
    checked = console.now()

    async def allowed() -> bool:
        nonlocal checked
        if console.now() - checked < 10.0:
            return True
        checked = console.now()
        return await find_caller(console, socket) is not None

    async def follow() -> None:
        # A viewer that has left is noticed below: a closed socket cannot be written to.
        with contextlib.suppress(WebSocketDisconnect, RuntimeError, OSError):
            await console.stream.follow(socket.send_bytes, allowed)
            await socket.close(4401, "the session has ended")

    async with asyncio.TaskGroup() as group:
        following = group.create_task(follow())
        # The viewer leaves, the console ends, or `follow` has closed the socket.
        while (await socket.receive())["type"] != "websocket.disconnect":
            pass
        following.cancel()
