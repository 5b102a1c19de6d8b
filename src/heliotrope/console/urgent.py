"""A separate path for EMERGENCY: a second listener in its own process that serves nothing else.

The page sends its order over the ordinary path and over this path at the same time. Both requests
carry the same identifier, so the plant issues the order only once. This process depends on little
else, keeps only the roster of permitted callers, and calls the plant through a socket reserved for
emergencies, so a blocked or ended console does not affect it.
"""

import json
import math
import time
from collections.abc import Awaitable, Callable
from typing import Any

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection
from starlette.responses import JSONResponse
from starlette.types import Receive, Scope, Send

from heliotrope.console import _words, bodies
from heliotrope.console.connections import FOUND, Limits
from heliotrope.console.headers import (
    STRANGER,
    address_of,
    host_known,
    network_of,
    parts_of,
    secret_of,
)
from heliotrope.console.roster import Key, Roster
from heliotrope.console.settings import ConsoleSettings
from heliotrope.errors import HeliotropeError
from heliotrope.local import Buckets, CallError

PATH = "/api/v1/emergency"
#: Few connections with short deadlines, because nothing but an order is expected here.
LIMITS = Limits(
    most=64, strangers=48, address=32, handshake=2.0, header=2.0, body=2.0, idle=2.0, answer=12.0,
    idle_known=30.0, answer_known=12.0,
)  # fmt: skip
#: Time allowed for the store to report who is valid, s.
_STORE = 1.0
#: Largest body, bytes.
_LARGEST = 2048
#: A refused request may announce up to this length and still receive the reason, bytes.
_DISCARDED = 1 << 14
#: Fields that an order may have; the plant checks each.
_SAID = frozenset({"act", "reason", "call", "csrf"})
#: Statuses of refusals by the plant.
_STATUS = {"input": 422, "refused": 409}
#: Function that makes a call in the plant and returns the value and the blob of the reply.
Ask = Callable[..., Awaitable[tuple[Any, bytes]]]


class EmergencyWay:
    """The application of the second listener, which serves only ``POST /api/v1/emergency``.

    Parameters
    ----------
    ask
        Function that makes a call over the plant's socket for emergencies, like
        `LocalConnection.ask`.
    settings
        Settings of the console; a browser may send an order only from the page at the console's
        port.

    Attributes
    ----------
    roster
        The valid sessions and tokens; the owner runs it.
    """

    def __init__(self, ask: Ask, settings: ConsoleSettings) -> None:
        self._ask, self._settings = ask, settings
        self._stranger = Buckets(*STRANGER, time.monotonic)
        self.roster = Roster(self._valid)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            await receive()
            await send({"type": "websocket.close", "code": 4403})
            return
        headers = {"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}
        incoming = bodies.Incoming(receive, Headers(scope=scope))
        try:
            status, text = 200, await self._take(scope, incoming, headers)
        except HTTPException as refusal:
            await incoming.discard(_DISCARDED)
            status, text = refusal.status_code, {"detail": refusal.detail}
            headers |= {"Connection": "close", **(refusal.headers or {})}
        except CallError as error:
            status, text = _STATUS.get(error.kind, 503), {"detail": str(error)}
        except HeliotropeError as error:
            status, text = 503, {"detail": str(error)}
        await JSONResponse(text, status, headers)(scope, incoming, send)

    async def _valid(self, used: list[str]) -> dict[Key, dict[str, Any]]:
        """Return all valid sessions and tokens."""
        given = {"now": time.time(), "used": used}
        found, _ = await self._ask("people.valid", given, within=_STORE)
        return {(by, one["key"]): one for by in ("session", "token") for one in found[f"{by}s"]}

    async def _take(self, scope: Scope, receive: Receive, answer: dict[str, str]) -> Any:
        """Issue the order; return its view, and set the reply headers for the page's origin."""
        connection, headers = HTTPConnection(scope), Headers(scope=scope)
        if not host_known(self._settings, headers.get("host", "")):
            raise HTTPException(421, "this machine is not known here by that name; see --name")
        if (scope["method"], scope["path"]) != ("POST", PATH):
            raise HTTPException(404, f"only POST {PATH} is served here")
        origin = headers.get("origin")
        allowed = origin is None or self._from_page(origin, headers["host"])
        if origin is not None and allowed:
            answer["Access-Control-Allow-Origin"] = origin
            answer["Access-Control-Allow-Credentials"] = "true"
            answer["Vary"] = "Origin"
        by, secret = secret_of(self._settings, connection) or ("", "")
        who = scope[FOUND] = await self._caller(connection, by, secret)
        if who is None:
            raise HTTPException(401, "sign in, or send a valid token")
        call = await _read(headers, receive)
        word = headers.get("x-csrf-token") or str(call.pop("csrf", ""))
        meant = by == "token" or _words.same(word, _words.csrf_of(secret))
        if not allowed or not meant:
            raise HTTPException(403, "this is not an order of this session's page")
        behalf = {"name": who["name"], "role": who["role"]}
        call.pop("csrf", None)
        return (await self._ask("order_emergency", call, on_behalf=behalf))[0]

    async def _caller(
        self, connection: HTTPConnection, by: str, secret: str
    ) -> dict[str, Any] | None:
        """Return the caller; None for a stranger.

        If the store does not respond, the caller as last known is returned.

        Raises
        ------
        HTTPException
            429 if a stranger sends too many requests.
        HeliotropeError
            If the store cannot identify an unknown caller.
        """
        found = await self.roster.find_for_emergency(by, secret) if secret else None
        if found is None:
            address = network_of(address_of(self._settings, connection))
            wait = self._stranger.take(address)
            if wait > 0.0:
                raise HTTPException(429, "too many requests", {"Retry-After": str(math.ceil(wait))})
        elif found["expires"] is not None and found["expires"] <= time.time():
            return None
        return found

    def _from_page(self, origin: str, host: str) -> bool:
        """Return whether an origin is the page of this console, under the name in the request."""
        page, own = parts_of(origin), parts_of(f"//{host}")
        try:
            port, name = page.port, page.hostname
        except ValueError:
            return False
        # Behind a proxy, the page has the proxy's port.
        behind = self._settings.plain and port is None
        return name is not None and name == own.hostname and (behind or port == self._settings.port)


async def _read(headers: Headers, receive: Receive) -> dict[str, Any]:
    """Return the order in a body; raise `HTTPException` if there is none."""
    body = await bodies.read_body(receive, bodies.length_of(headers, _LARGEST))
    if body is None:
        raise HTTPException(400, "the order is incomplete")
    try:
        bodies.check_json(body)
        call = json.loads(body or b"{}")
    except (HeliotropeError, ValueError):
        call = None
    if not isinstance(call, dict) or not _SAID.issuperset(call):
        raise HTTPException(422, "the order cannot be read")
    return call
