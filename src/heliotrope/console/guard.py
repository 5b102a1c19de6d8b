"""Checks before every request, and before any of its body is read.

Only known host names, a known route, a caller with the required role, and a body of the accepted
size and structure pass; safe headers are added to every response.
"""

import contextlib
from collections.abc import Callable
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection
from starlette.responses import JSONResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from heliotrope.console import bodies
from heliotrope.console._files import PAGES
from heliotrope.console.auth import AtLeast, Caller, Console, caller, refused
from heliotrope.console.connections import FOUND
from heliotrope.console.edge import Edge
from heliotrope.console.headers import host_known, parts_of
from heliotrope.console.routes import FORM, LARGEST, TINY, RouteMatch, Routes
from heliotrope.errors import HeliotropeError, InputError
from heliotrope.plant.operations.security import SecurityEvent

#: Content security policy: nothing from other origins, and nothing inline.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; font-src 'self'; form-action 'self'; base-uri 'none'; "
    "frame-ancestors 'none'"
)
#: The live stream refuses strangers itself, because the page reads its close code.
LIVE = "/api/v1/live"


class Guard:
    """An ASGI middleware that checks every request.

    Parameters
    ----------
    app
        Application behind the guard.
    console
        Function that returns the console.
    routes
        Routes of the application.
    edge
        Limits on the requests.
    """

    def __init__(
        self, app: ASGIApp, console: Callable[[], Console], routes: Routes, edge: Edge
    ) -> None:
        self._app, self._console, self._routes, self._edge = app, console, routes, edge

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on if it is allowed."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        console = self._console()
        scope["heliotrope"] = console
        incoming = bodies.Incoming(receive, Headers(scope=scope))

        async def reply(message: Message) -> None:
            if message["type"] == "http.response.start":
                self._dress(console, scope, MutableHeaders(scope=message))
            await send(message)

        try:
            await self._admit(console, scope, incoming, reply)
        except HTTPException as refusal:
            await _refuse(refusal, scope, incoming, reply)
        except HeliotropeError as error:
            # The store cannot be read, so no caller can be identified.
            await _refuse(HTTPException(503, str(error)), scope, incoming, reply)

    async def _admit(self, console: Console, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass an allowed request on.

        Raises
        ------
        HTTPException
            If the request is not allowed.
        """
        connection, headers = HTTPConnection(scope), Headers(scope=scope)
        if not host_known(console.settings, headers.get("host", "")):
            host = headers.get("host", "")
            await console.note(SecurityEvent.HOST_REFUSED, connection, detail=host)
            raise HTTPException(421, "this machine is not known here by that name; see --name")
        who = scope[FOUND] = await self._edge.find(console, connection)
        if scope["type"] == "websocket":
            if scope["path"] != LIVE:
                raise HTTPException(404, "nothing is at this address")
            await self._app(scope, receive, send)
            return
        route = self._route(scope, who)
        if route.role is not None:
            who = await caller(connection, console)
            if who.person.role < route.role:
                await refused(console, connection, who)
            AtLeast(route.role).admitted(who)
        if who is not None and not _is_emergency(scope):
            self._edge.count(who)
        if (place := _elsewhere(scope["path"], who)) is not None:
            await RedirectResponse(place, 303)(scope, receive, send)
            return
        length = bodies.length_of(headers, route.largest)
        if length > route.form:
            # A body longer than the names and points of the whole field would only cost time.
            length = bodies.length_of(
                headers, route.form + route.per_heliostat * await console.heliostats()
            )
        with contextlib.ExitStack() as stack:
            if length > FORM and who is not None:
                stack.enter_context(self._edge.large(who))
            if length:
                body = await bodies.read_body(receive, length)
                if body is None:
                    return
                await _check_body(scope, body)
                receive = bodies.replayed(body, receive)
            await self._app(scope, receive, send)

    def _route(self, scope: Scope, who: Caller | None) -> RouteMatch:
        """Return the route of a request; raise `HTTPException` if there is none."""
        route = self._routes.find(scope)
        if route.status == 200:
            return route
        if who is None:
            # Strangers do not learn which addresses exist.
            if scope["path"].startswith("/api/"):
                raise HTTPException(401, "sign in, or send a valid token")
            raise HTTPException(404, "nothing is at this address")
        if route.status == 405:
            raise HTTPException(
                405, "this method is not allowed here", {"Allow": ", ".join(route.allow)}
            )
        raise HTTPException(404, "nothing is at this address")

    def _dress(self, console: Console, scope: Scope, headers: Any) -> None:
        """Add the safe headers to a response."""
        path, policy = scope["path"], POLICY
        if path in PAGES:
            urgent = _urgent(console, scope)
            policy = policy.replace("connect-src 'self'", f"connect-src 'self' {urgent}")
        headers["Content-Security-Policy"] = policy
        headers["X-Content-Type-Options"] = "nosniff"
        headers["X-Frame-Options"] = "DENY"
        headers["Referrer-Policy"] = "no-referrer"
        headers["Cross-Origin-Opener-Policy"] = "same-origin"
        headers["Cross-Origin-Resource-Policy"] = "same-origin"
        headers["Permissions-Policy"] = "camera=(), microphone=(), geolocation=()"
        if path.startswith("/api/") or path in (*PAGES, "/login", "/enter"):
            headers.setdefault("Cache-Control", "no-store")
        if console.settings.tls:
            headers["Strict-Transport-Security"] = "max-age=31536000"


def _urgent(console: Console, scope: Scope) -> str:
    """Return the origin of the EMERGENCY path, as a page sees it."""
    host = parts_of(f"//{Headers(scope=scope).get('host', '')}").hostname or ""
    if not console.emergency_port or not host_known(console.settings, host):
        return ""
    scheme = "https" if console.settings.tls or console.settings.plain else scope["scheme"]
    return f"{scheme}://{host}:{console.emergency_port}"


async def _check_body(scope: Scope, body: bytes) -> None:
    """Raise `HTTPException` for JSON that is too deep or has too many values."""
    if scope["path"].startswith("/api/"):
        try:
            await bodies.check(body)
        except InputError as error:
            raise HTTPException(422, str(error)) from None


def _elsewhere(path: str, who: Caller | None) -> str | None:
    """Return the page to which a caller must go before the requested page."""
    if path not in PAGES or path == "/emergency":
        return None
    if who is None or who.by != "session":
        return "/login"
    return "/account" if who.owes and path != "/account" else None


def _is_emergency(scope: Scope) -> bool:
    return (scope["method"], scope["path"]) == ("POST", "/api/v1/emergency")


async def _refuse(
    refusal: HTTPException, scope: Scope, incoming: bodies.Incoming, send: Send
) -> None:
    """Respond to a refused request; close the connection if its body is long."""
    if scope["type"] == "websocket":
        await incoming()
        await send({"type": "websocket.close", "code": 4403})
        return
    headers = dict(refusal.headers or {})
    length = Headers(scope=scope).get("content-length", "0")
    if not length.isdigit() or int(length[:20]) > TINY:
        headers["Connection"] = "close"
    await incoming.discard(FORM if scope.get(FOUND) is None else LARGEST)
    answer = JSONResponse({"detail": refusal.detail}, refusal.status_code, headers)
    await answer(scope, incoming, send)
