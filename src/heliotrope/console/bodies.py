"""Request bodies: maximum size, and a check of the JSON structure before parsing."""

import asyncio
import contextlib
import re

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import Message, Receive

from heliotrope.errors import InputError

#: Deepest nesting of JSON; requests of the API need three levels.
DEEPEST = 16
#: Maximum number of values in a body: points of 200,000 heliostats, with a name and three numbers
#: each.
MOST_VALUES = 1_000_000
#: Maximum number of escaped characters in a body.
_MOST_ESCAPES = 500_000
#: A larger body is checked in a thread, bytes.
_SMALL = 1 << 16
#: A refused request is answered when its sender pauses for this long, s.
_PAUSE = 1.0
_ESCAPED = re.compile(rb"\\.", re.DOTALL)
_OTHER = bytes(sorted(set(range(256)) - set(b"[]{}")))


class Incoming:
    """A `receive` function that knows whether the body of its request has ended.

    Parameters
    ----------
    receive
        The server's ``receive`` function.
    headers
        Headers of the request.
    """

    def __init__(self, receive: Receive, headers: Headers) -> None:
        self._receive, self._headers = receive, headers
        self._over = "transfer-encoding" not in headers and _length(headers) == 0

    async def __call__(self) -> Message:
        """Return the next message."""
        message = await self._receive()
        self._over = not message.get("more_body", False)
        return message

    async def discard(self, most: int) -> None:
        """Read and discard the rest of the body, unless its announced length exceeds ``most``.

        If a server responds and closes while its client is still sending, the client's system
        discards the response, and the client sees a reset connection instead of the reason for the
        refusal. A sender that pauses for longer than a second is abandoned, and a sender that waits
        for permission to send its body (Expect) does not get permission.
        """
        length = _length(self._headers)
        if length is None or length > most or "expect" in self._headers:
            return
        with contextlib.suppress(TimeoutError):
            while not self._over and most >= 0:
                async with asyncio.timeout(_PAUSE):
                    most -= len((await self()).get("body", b""))


async def read_body(receive: Receive, most: int) -> bytes | None:
    """Return the complete body of a request; None if its sender left or sends too much.

    ``most`` is the maximum length, bytes. The time limit is the connection's limit; the connection
    is closed when it expires.
    """
    body = bytearray()
    while True:
        message = await receive()
        if message["type"] != "http.request":
            return None
        body += message.get("body", b"")
        if len(body) > most:
            return None
        if not message.get("more_body", False):
            return bytes(body)


def length_of(headers: Headers, most: int) -> int:
    """Return the length of a body, bytes; raise `HTTPException` if it is not allowed."""
    if "transfer-encoding" in headers:
        raise HTTPException(411, "send the length of the body (Content-Length)")
    length = _length(headers)
    if length is None or length > most:
        raise HTTPException(413, f"the body is longer than {most} bytes")
    return length


def _length(headers: Headers) -> int | None:
    """Return the announced length of a body, bytes; 0 if none, None if it is not a number."""
    length = headers.get("content-length", "0")
    return int(length) if length.isascii() and length.isdigit() and len(length) < 20 else None


def replayed(body: bytes, receive: Receive) -> Receive:
    """Return a `receive` function that delivers a body which has already been read."""
    delivered = False

    async def again() -> Message:
        nonlocal delivered
        if delivered:
            return await receive()
        delivered = True
        return {"type": "http.request", "body": body, "more_body": False}

    return again


async def check(body: bytes) -> None:
    """Check the structure of a JSON body; see `check_json`."""
    if len(body) > _SMALL:
        await asyncio.to_thread(check_json, body)
    else:
        check_json(body)


def check_json(body: bytes) -> None:
    """Check the depth and the number of values of JSON, in time proportional to its length.

    Raises
    ------
    InputError
        If the JSON is nested too deeply, or has too many values.
    """
    if body.count(b"\\") > 2 * _MOST_ESCAPES or body.count(b'"') > 2 * MOST_VALUES:
        raise InputError(f"the body has more than {MOST_VALUES} values")
    if b"\\" in body:
        body = _ESCAPED.sub(b"", body)
    outside = b"".join(body.split(b'"')[::2])
    if sum(map(outside.count, (b",", b"[", b"{"))) > MOST_VALUES:
        raise InputError(f"the body has more than {MOST_VALUES} values")
    brackets = outside.translate(None, _OTHER)
    for _ in range(DEEPEST):
        brackets = brackets.replace(b"[]", b"").replace(b"{}", b"")
    if brackets:
        raise InputError(f"the body is not JSON, or is nested more than {DEEPEST} deep")
