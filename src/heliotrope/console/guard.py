"""Checks before every request: known host names only, safe headers, sign-in for the page."""

from collections.abc import Callable
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from heliotrope.console.auth import Console, find_caller, host_known

#: Nothing from other origins, nothing inline.
STRICT = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; font-src 'self'; form-action 'self'; base-uri 'none'; "
    "frame-ancestors 'none'"
)
#: The page's frame is NiceGUI's, which has inline scripts and compiles templates.
FRAME = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; connect-src 'self'; "
    "font-src 'self' data:; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
#: Largest accepted body, bytes: points for every heliostat of a large field.
LARGEST = 16 << 20


class Guard:
    """An ASGI middleware.

    Parameters
    ----------
    app
        Application behind it.
    console
        Returns the console.
    """

    def __init__(self, app: ASGIApp, console: Callable[[], Console]) -> None:
        self._app, self._console = app, console

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, if it is allowed."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        console = self._console()
        scope["heliotrope"] = console
        headers = Headers(scope=scope)
        refusal = await self._refusal(console, scope, headers)

        async def reply(message: Message) -> None:
            if message["type"] == "http.response.start":
                self._dress(console, scope["path"], MutableHeaders(scope=message))
            await send(message)

        if refusal is None:
            await self._app(scope, receive, reply)
        elif scope["type"] == "http":
            status, text = refusal
            await JSONResponse({"detail": text}, status)(scope, receive, reply)
        else:
            await receive()
            await send({"type": "websocket.close", "code": 4403})

    async def _refusal(
        self, console: Console, scope: Scope, headers: Headers
    ) -> tuple[int, str] | None:
        """Return status and reason for a request that is not allowed."""
        if not host_known(console, headers.get("host", "")):
            return 421, "this machine is not known here by that name; see --name"
        if "transfer-encoding" in headers:
            return 411, "send the length of the body (Content-Length)"
        length = headers.get("content-length", "0")
        if not length.isdigit() or int(length) > LARGEST:
            return 413, f"the body is longer than {LARGEST} bytes"
        if scope["path"].startswith("/_nicegui_ws") and (
            await find_caller(console, HTTPConnection(scope)) is None
        ):
            return 401, "sign in"
        return None

    def _dress(self, console: Console, path: str, headers: Any) -> None:
        """Add the safe headers."""
        headers["Content-Security-Policy"] = FRAME if path == "/" else STRICT
        headers["X-Content-Type-Options"] = "nosniff"
        headers["X-Frame-Options"] = "DENY"
        headers["Referrer-Policy"] = "no-referrer"
        headers["Cross-Origin-Opener-Policy"] = "same-origin"
        headers["Cross-Origin-Resource-Policy"] = "same-origin"
        headers["Permissions-Policy"] = "camera=(), microphone=(), geolocation=()"
        if path.startswith("/api/") or path in ("/", "/login"):
            headers.setdefault("Cache-Control", "no-store")
        if console.settings.tls:
            headers["Strict-Transport-Security"] = "max-age=31536000"
