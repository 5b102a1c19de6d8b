"""The HTTP API, version 1: reading the plant."""

import gzip
import math
import time
from collections.abc import Callable
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request, Response, WebSocket
from fastapi.responses import JSONResponse
from starlette.websockets import WebSocketDisconnect

from heliotrope import __version__
from heliotrope.console import models
from heliotrope.console._files import SMALL, takes_gzip
from heliotrope.console.auth import (
    FIXED,
    Anyone,
    Console,
    Here,
    console_of,
    find_caller,
    same_origin,
)
from heliotrope.console.models import plain
from heliotrope.field.volumes import outline
from heliotrope.lcu import names as meanings
from heliotrope.lcu import states
from heliotrope.plant.operations.operations import Operations

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


def answer(value: Any) -> JSONResponse:
    """Return a view; its model stands in the description of the route."""
    return JSONResponse(plain(value), headers={"Cache-Control": "no-store"})


def shared(
    console: Console, request: Request, key: str, make: Callable[[], Any], fresh: float = FRESH
) -> Response:
    """Return a view that is the same for everybody, encoded once for all callers of a moment.

    It holds nothing of the caller, so its compressed length reveals no secret.
    """
    now, kept = time.monotonic(), console.shared.get(key)
    if kept is None or now - kept[0] >= fresh:
        if len(console.shared) >= MOST_SHARED:
            console.shared.clear()
        data = bytes(answer(make()).body)
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
    return shared(console, request, FIXED, lambda: _field(console.operations), math.inf)


def _field(here: Operations) -> dict[str, Any]:
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


@router.get("/summary", response_model=models.Summary, tags=["plant"])
async def summary(console: Here, request: Request, who: Anyone) -> Response:
    """Return a summary of the plant."""
    del who
    return shared(console, request, "summary", console.operations.summary)


@router.get("/sun", response_model=models.SunView, tags=["plant"])
async def where_the_sun_is(console: Here, request: Request, who: Anyone) -> Response:
    """Return the position of the sun."""
    del who
    return shared(console, request, "sun", console.operations.sun)


@router.get("/heliostats/{name}", response_model=models.HeliostatView, tags=["field"])
async def heliostat(console: Here, who: Anyone, name: Named) -> JSONResponse:
    """Return one heliostat in detail."""
    del who
    return answer(console.operations.heliostat(name))


@router.get("/clusters", response_model=models.many(models.ClusterRow), tags=["field"])
async def clusters(console: Here, request: Request, who: Anyone) -> Response:
    """Return the health of each cluster."""
    del who
    return shared(console, request, "clusters", console.operations.cluster_rows)


@router.get("/receivers/{name}/flux", response_model=models.FluxView, tags=["plant"])
async def flux(console: Here, request: Request, who: Anyone, name: Named) -> Response:
    """Return the predicted flux on a receiver."""
    del who
    return shared(console, request, f"flux {name}", lambda: console.operations.receiver_flux(name))


@router.get(
    "/targets/{name}/photograph",
    tags=["calibration"],
    response_class=Response,
    responses={200: {"content": {"image/jpeg": {}}}, 204: {"description": "No photograph yet"}},
)
async def photograph(console: Here, request: Request, who: Anyone, name: Named) -> Response:
    """Return the last photograph of a target, annotated with the findings of the software."""
    del who
    view = console.operations.camera(name)
    if not view.jpeg:
        return Response(status_code=204)
    tag = f'"{view.version}"'
    headers = {"ETag": tag, "Cache-Control": "private, no-cache"}
    if request.headers.get("if-none-match") == tag:
        return Response(status_code=304, headers=headers)
    return Response(view.jpeg, media_type="image/jpeg", headers=headers)


@router.get("/targets/{name}", response_model=models.CameraReading, tags=["calibration"])
async def target(console: Here, who: Anyone, name: Named) -> JSONResponse:
    """Return the findings of the software in the last photograph of a target."""
    del who
    view = console.operations.camera(name)
    return answer(
        {
            "target": view.target,
            "version": view.version,
            "at": view.at,
            "reading": view.reading,
            "centroid": view.centroid,
        }
    )


@router.get("/alarms", response_model=models.many(models.AlarmRow), tags=["alarms"])
async def alarms(console: Here, request: Request, who: Anyone) -> Response:
    """Return the alarms, those that need attention first."""
    del who
    return shared(console, request, "alarms", console.operations.alarms)


@router.get("/events", response_model=models.many(models.EventRow), tags=["logs"])
async def events(console: Here, request: Request, who: Anyone, limit: Limit = 200) -> Response:
    """Return the last events, newest first."""
    del who
    return shared(console, request, f"events {limit}", lambda: console.operations.events(limit))


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
    return shared(
        console,
        request,
        f"packets {limit} {cluster}",
        lambda: console.operations.packets(limit, cluster),
    )


@router.get("/calibration", response_model=models.CalibrationView, tags=["calibration"])
async def calibration(console: Here, request: Request, who: Anyone) -> Response:
    """Return the progress of calibration."""
    del who
    return shared(console, request, "calibration", console.operations.calibration)


@router.get("/schedule", response_model=models.many(models.Planned), tags=["calibration"])
async def schedule(console: Here, request: Request, who: Anyone, limit: Limit = 20) -> Response:
    """Return the planned next measurements."""
    del who
    return shared(console, request, f"schedule {limit}", lambda: console.operations.schedule(limit))


@router.get("/holds", response_model=models.many(models.Lockout), tags=["calibration"])
async def holds(console: Here, who: Anyone) -> JSONResponse:
    """Return the heliostats that are out of service."""
    del who
    return answer(console.operations.holds())


@router.get("/emergency", response_model=models.EmergencyView, tags=["safety"])
async def emergency(console: Here, who: Anyone) -> JSONResponse:
    """Return the last emergency order with its proof."""
    del who
    return answer(console.operations.emergency_view())


@router.websocket("/live")
async def live(socket: WebSocket) -> None:
    """Send the live stream; see docs/reference/api-http.md."""
    console: Console = console_of(socket)
    found = await find_caller(console, socket)
    if found is None or not same_origin(console, socket):
        await socket.accept()
        await socket.close(4401, "sign in, or send a valid token")
        return
    await socket.accept()
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

    try:
        await console.stream.follow(socket.send_bytes, allowed)
        await socket.close(4401, "the session has ended")
    except (WebSocketDisconnect, RuntimeError, OSError):
        # The viewer has left: a closed socket cannot be written to.
        return
