"""The HTTP API, version 1: a route for each call in the plant's table, and the live stream.

Every order is given in the caller's name, with the caller's current role according to the store,
through the single command authority; an accepted command is recorded in the audit before it is
sent.
"""

import asyncio
import contextlib
import gzip
import time
from collections.abc import Callable, Iterator
from inspect import Parameter, Signature
from typing import Annotated, Any, get_type_hints

from fastapi import APIRouter, HTTPException, Path, Query, Request, Response, WebSocket
from fastapi.responses import JSONResponse
from starlette.websockets import WebSocketDisconnect

from heliotrope import __version__
from heliotrope.console import models
from heliotrope.console._files import SMALL, takes_gzip
from heliotrope.console.auth import (
    DUES,
    Anyone,
    AppConsole,
    Caller,
    Console,
    Engineer,
    Operator,
    console_of,
    find_caller,
    refused,
    same_origin,
    settle,
)
from heliotrope.console.models import json_type
from heliotrope.console.roster import TRUSTED
from heliotrope.errors import HeliotropeError
from heliotrope.local.frames import REQUEST_BLOB
from heliotrope.plant.interface import CALLS, BusyError, Call, WithBlob, orders
from heliotrope.plant.operations.security import SecurityEvent
from heliotrope.plant.orders.authority import OPERATOR_COMMANDS, Role
from heliotrope.store.people import LONGEST_NAME

#: Responses that any route behind the sign-in may return.
REFUSALS: dict[int | str, dict[str, Any]] = {
    401: {"model": models.Problem, "description": "Not signed in"},
    403: {"model": models.Problem, "description": "The role is too low"},
    404: {"model": models.Problem, "description": "Unknown name"},
    409: {"model": models.Problem, "description": "Not accepted now; nothing was sent"},
    422: {"model": models.Problem, "description": "The request cannot be used"},
    423: {"model": models.Problem, "description": "Send your password again, see session/presence"},
    429: {"model": models.Problem, "description": "Too many requests; nothing was sent"},
    503: {"model": models.Problem, "description": "It cannot be recorded now; nothing was sent"},
}
MOST_SHARED = 100
router = APIRouter(prefix="/api/v1", responses=REFUSALS)

Named = Annotated[str, Path(max_length=64)]
#: Name of an account, whatever it contains; the path of its route accepts a slash too.
AccountNamed = Annotated[str, Path(max_length=LONGEST_NAME)]


def answer(value: Any) -> JSONResponse:
    """Return a view, whose model the route describes."""
    return JSONResponse(value, headers={"Cache-Control": "no-store"})


async def shared(
    console: Console, request: Request, call: str, fresh: float, **arguments: Any
) -> Response:
    """Return a response that is the same for everyone, encoded once for all simultaneous callers.

    The response contains nothing about the caller, so its compressed length reveals no secret.
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
async def health(console: AppConsole) -> dict[str, Any]:
    """Return whether the console responds.

    The route is open to all callers, and reveals nothing about the plant.
    """
    del console
    return {"ok": True, "version": __version__}


async def photograph(console: AppConsole, request: Request, who: Anyone, name: Named) -> Response:
    """Send a photograph, but only if the page does not show it already; no browser stores it."""
    known = request.headers.get("if-none-match", "").strip('"')
    version = int(known) if known.isdecimal() and len(known) < 16 else -1
    view, jpeg = await console.plant.fetch("photograph", who.person, name=name, known=version)
    headers = {"ETag": f'"{view["version"]}"'}
    if not jpeg:
        unchanged = view["version"] == version
        return Response(status_code=304 if unchanged and version else 204, headers=headers)
    return Response(jpeg, media_type="image/jpeg", headers=headers)


async def command(
    console: AppConsole, who: Operator, request: Request, order: orders.CommandOrder
) -> Response:
    """Issue a command; STOW and DEFOCUS are issued as such, and some commands need an engineer."""
    name = order.command
    if name in ("STOW", "DEFOCUS"):
        return answer(
            await console.plant.ask(name.lower(), who.person, heliostats=order.heliostats)
        )
    settle(who, request)
    if name not in OPERATOR_COMMANDS and who.person.role < Role.ENGINEER:
        await refused(console, request, who)
        raise HTTPException(
            403, f"{name}: {who.person.name} has the role operator; this needs engineer"
        )
    return answer(await console.plant.ask("command", who.person, **order.model_dump()))


def _endpoint(name: str, call: Call) -> Callable[..., Any]:
    """Return the function of a route that makes a call with the arguments of the request."""

    async def endpoint(
        console: Console, request: Request, who: Caller, order: Any = None, **parameters: Any
    ) -> Response:
        arguments, blob = {} if order is None else order.model_dump(), b""
        if call.pack is not None:
            arguments, blob = call.pack(order)
            if len(blob) > REQUEST_BLOB:
                raise HTTPException(413, f"it is longer than {REQUEST_BLOB >> 20} MiB; split it")
        if call.fresh and call.answer is not WithBlob:
            return await shared(console, request, name, call.fresh, **parameters)
        value, data = await console.plant.fetch(name, who.person, blob, **arguments, **parameters)
        if call.answer is None:
            return Response(status_code=204)
        if call.answer is not WithBlob:
            return answer(value)
        return Response(data, media_type="image/jpeg")

    fixed = {"console": AppConsole, "request": Request, "who": _AT_LEAST[call.role]}
    own = [_argument(key, hint) for key, hint in fixed.items()]
    vars(endpoint)["__signature__"] = Signature([*own, *_arguments(call)])
    return endpoint


def _arguments(call: Call) -> Iterator[Parameter]:
    """Yield the arguments of a request from its path, its query and its body."""
    method, path = call.request.split()
    hints = get_type_hints(call.arguments, include_extras=True)
    for key, field in call.arguments.model_fields.items():
        if f"{{{key}}}" in path:
            yield _argument(key, hints[key], Path())
        elif method == "GET":
            yield _argument(key, hints[key], Query(field.default))
    body: Any = call.arguments if method != "GET" and "{" not in path else orders.Nothing
    body = call.body or body
    if call.bare:
        yield _argument("order", body | None, None)
    elif body is not orders.Nothing:
        yield _argument("order", body)


def _argument(name: str, hint: Any, default: Any = Parameter.empty) -> Parameter:
    return Parameter(name, Parameter.KEYWORD_ONLY, annotation=hint, default=default)


#: Routes that do more than make a call.
_OWN: dict[str, Callable[..., Any]] = {"photograph": photograph, "command": command}
_AT_LEAST = {Role.VIEWER: Anyone, Role.OPERATOR: Operator, Role.ENGINEER: Engineer}
_JPEG: dict[int | str, dict[str, Any]] = {
    200: {"content": {"image/jpeg": {}}},
    204: {"description": "No photograph yet"},
}


def _add(name: str, call: Call) -> None:
    """Add the route of a call."""
    method, path = call.request.split()
    picture = call.answer is WithBlob
    router.add_api_route(
        f"/{path}",
        _OWN.get(name) or _endpoint(name, call),
        methods=[method],
        name=name,
        tags=[call.group],
        description=call.plain_text,
        status_code=204 if call.answer is None else 200,
        response_class=Response if picture else JSONResponse,
        response_model=None if picture or call.answer is None else json_type(call.answer),
        responses=_JPEG if picture else None,
    )


for _name, _each in CALLS.items():
    if _each.request:
        _add(_name, _each)


@router.websocket("/live")
async def live(socket: WebSocket) -> None:
    """Send the live stream; for its format see docs/reference/api-http.md."""
    console: Console = console_of(socket)
    who = await find_caller(console, socket)
    if who is None or not same_origin(console, socket):
        if who is not None:
            await console.note(SecurityEvent.ORIGIN_REFUSED, socket, who.person.name)
        await socket.accept()
        await socket.close(4401, "sign in, or send a valid token")
        return
    await socket.accept()
    if who.owes:
        await socket.close(4403, DUES[who.owes][0])
        return
    try:
        with console.stream.place(who.person):
            await _show(console, socket)
    except BusyError as error:
        await socket.close(4429, str(error))


async def _show(console: Console, socket: WebSocket) -> None:
    """Send the live stream until its viewer leaves or loses access, or the console ends."""

    async def follow() -> None:
        # A viewer that has left is detected below, because a closed socket cannot be written to.
        with contextlib.suppress(WebSocketDisconnect, RuntimeError, OSError):
            await console.stream.follow(socket.send_bytes)

    async def end() -> None:
        """Close the socket once its session or token has ended, even if no data is being sent."""
        while await _still_known(console, socket):
            await asyncio.sleep(TRUSTED)
        with contextlib.suppress(WebSocketDisconnect, RuntimeError, OSError):
            await socket.close(4401, "the session has ended")

    async with asyncio.TaskGroup() as group:
        works = [group.create_task(work()) for work in (follow, end)]
        while (await socket.receive())["type"] != "websocket.disconnect":
            pass
        for work in works:
            work.cancel()


async def _still_known(console: Console, socket: WebSocket) -> bool:
    """Return whether a viewer may continue.

    If the store does not respond, admitted viewers may continue.
    """
    try:
        return await find_caller(console, socket) is not None
    except HeliotropeError:
        return True
