"""EMERGENCY by a way of its own: a second listener that serves nothing else.

The page sends its order by the ordinary way and by this one at the same time. Both carry the same
word, so the plant gets one order.
"""

from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

from fastapi import HTTPException
from pydantic import Field, ValidationError
from starlette.datastructures import Headers
from starlette.requests import HTTPConnection
from starlette.responses import JSONResponse
from starlette.types import Receive, Scope, Send

from heliotrope.console import _secrets, bodies
from heliotrope.console.auth import FOUND, Caller, Console, host_known
from heliotrope.console.connections import Limits
from heliotrope.console.edge import Edge
from heliotrope.errors import HeliotropeError
from heliotrope.plant.interface import orders

PATH = "/api/v1/emergency"
#: Few connections with short deadlines: nothing but an order comes here.
LIMITS = Limits(
    most=64, strangers=48, address=32, handshake=2.0, header=2.0, body=2.0, idle=2.0, answer=12.0,
    idle_known=30.0, answer_known=12.0,
)  # fmt: skip
#: Largest body, bytes.
_LARGEST = 2048


class UrgentCall(orders.EmergencyCall):
    """The order of a page: with the session's word, so that the browser asks nothing before it."""

    csrf: str = Field("", max_length=128)


class EmergencyWay:
    """The application of the second listener: ``POST /api/v1/emergency`` and nothing else.

    Parameters
    ----------
    console
        State of the console.
    page_port
        Returns the port of the page, the only one from which a browser may send an order.
    """

    def __init__(self, console: Console, page_port: Callable[[], int]) -> None:
        self._console, self._page_port = console, page_port
        self._edge = Edge()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            await receive()
            await send({"type": "websocket.close", "code": 4403})
            return
        headers = {"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}
        try:
            status, text = 200, await self._take(scope, receive, headers)
        except HTTPException as refusal:
            status, text = refusal.status_code, {"detail": refusal.detail}
            headers |= {"Connection": "close", **(refusal.headers or {})}
        except HeliotropeError as error:
            status, text = 503, {"detail": str(error)}
        await JSONResponse(text, status, headers)(scope, receive, send)

    async def _take(self, scope: Scope, receive: Receive, answer: dict[str, str]) -> Any:
        """Give the order; return its view, and what the answer needs for the page's origin."""
        connection, headers = HTTPConnection(scope), Headers(scope=scope)
        if not host_known(self._console, headers.get("host", "")):
            raise HTTPException(421, "this machine is not known here by that name; see --name")
        if (scope["method"], scope["path"]) != ("POST", PATH):
            raise HTTPException(404, f"only POST {PATH} is served here")
        origin = headers.get("origin")
        allowed = origin is None or self._from_page(origin, headers["host"])
        if origin is not None and allowed:
            answer["Access-Control-Allow-Origin"] = origin
            answer["Access-Control-Allow-Credentials"] = "true"
            answer["Vary"] = "Origin"
        who = scope[FOUND] = await self._edge.find(self._console, connection)
        if who is None:
            raise HTTPException(401, "sign in, or send a valid token")
        call = await _read(headers, receive)
        if not allowed or not _meant(who, call, headers):
            raise HTTPException(403, "this is not an order of this session's page")
        given = orders.EmergencyCall(act=call.act, reason=call.reason, call=call.call)
        return await self._console.emergencies.give(self._console.plant, who.person, given)

    def _from_page(self, origin: str, host: str) -> bool:
        """Whether an origin is the page of this console, at the name that the request names."""
        there, here = urlsplit(origin), urlsplit(f"//{host}")
        try:
            port, name = there.port, there.hostname
        except ValueError:
            return False
        # Behind a proxy the page has the proxy's port.
        behind = self._console.settings.plain and port is None
        return name is not None and name == here.hostname and (behind or port == self._page_port())


async def _read(headers: Headers, receive: Receive) -> UrgentCall:
    """Return the order in a body; raises `HTTPException` if there is none."""
    body = await bodies.read_body(receive, bodies.length_of(headers, _LARGEST))
    if body is None:
        raise HTTPException(400, "the order is incomplete")
    try:
        bodies.check_json(body)
        return UrgentCall.model_validate_json(body or b"{}")
    except (HeliotropeError, ValidationError):
        raise HTTPException(422, "the order cannot be read") from None


def _meant(who: Caller, call: UrgentCall, headers: Headers) -> bool:
    """Whether a session's order carries its word; a token needs none."""
    word = headers.get("x-csrf-token") or call.csrf
    return who.by == "token" or _secrets.same(word, who.csrf)
