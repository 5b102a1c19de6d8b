"""The server side of the local interface, which limits all resources and admits new callers.

Connections are accepted at a limited rate. A connection that does not identify itself in time is
closed; if all places are taken, the oldest connection is closed to make room. A connection has a
limited number of pending requests; while these are pending, nothing more is read from the
connection. A request counts until its reply is written, and a client that does not read its replies
is disconnected. A blob is accepted only if the call allows one from this caller. The identity of
the caller is checked again every few seconds: a connection ends when its key or token is no longer
valid, and its requests never have more than the current role.
"""

import asyncio
import contextlib
import functools
import logging
import socket
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from heliotrope.errors import HeliotropeError
from heliotrope.local.frames import (
    HELLO_HEAD,
    INTERNAL,
    REQUEST_BLOB,
    REQUEST_HEAD,
    Frame,
    FrameError,
    pack,
    read_frame,
)
from heliotrope.local.sockets import listen, user_of

_LOG = logging.getLogger(__name__)
#: Number of reply bytes that wait in a connection before its requests wait.
_BUFFER = 1 << 16


class Caller(Protocol):
    """The caller at the other end of a connection."""

    @property
    def reserved(self) -> bool:
        """Whether a place is reserved for this caller, whatever other callers do."""
        ...


C = TypeVar("C", bound=Caller)
#: Kind and text of an error.
Problem = tuple[str, str]


@dataclass(frozen=True)
class LocalLimits:
    """Limits of one listener.

    Attributes
    ----------
    strangers, callers, reserved
        Maximum numbers of connections without identification, with identification, and from
        consoles; a new connection may overlap one that is ending.
    under_way, console_under_way
        Pending requests per connection, and per console connection, which many operators share.
    hello_s, answer_s
        Timeouts for identifying the caller and for accepting a reply, s.
    pace_s
        Minimum time between two new connections, s.
    trusted_s
        Time after which the identity of the caller is checked again, s.
    """

    strangers: int = 32
    callers: int = 16
    reserved: int = 2
    under_way: int = 4
    console_under_way: int = 32
    hello_s: float = 2.0
    answer_s: float = 5.0
    pace_s: float = 0.005
    trusted_s: float = 5.0


class _Peer:
    """One connection."""

    def __init__(self, writer: asyncio.StreamWriter) -> None:
        self._writer, self._turn = writer, asyncio.Lock()
        writer.transport.set_write_buffer_limits(_BUFFER)

    def cut(self) -> None:
        self._writer.transport.abort()

    async def write(self, data: bytes, limit: float) -> None:
        """Write a frame; a peer that does not accept it within ``limit`` s is disconnected."""
        try:
            async with asyncio.timeout(limit), self._turn:
                if self._writer.transport.is_closing():
                    return  # asyncio would write a log line for each reply
                self._writer.write(data)
                await self._writer.drain()
        except (TimeoutError, OSError):
            self.cut()


class _Identity(Generic[C]):
    """The caller of a connection, who is determined again when the last result is old."""

    def __init__(self, ask: Callable[[], Awaitable[C | None]], trusted: float) -> None:
        self._ask, self._trusted, self._turn = ask, trusted, asyncio.Lock()
        self._caller: C | None = None
        self._until = 0.0

    async def caller(self) -> C | None:
        """Return the caller; None if the caller is no longer valid."""
        async with self._turn:
            if time.monotonic() >= self._until:
                asked = time.monotonic()
                self._caller = await self._ask()
                self._until = asked + self._trusted
            return self._caller


class LocalServer(Generic[C]):
    """One listener.

    Parameters
    ----------
    path
        Socket, in a folder made by `sockets.make_folder`.
    caller
        Function that returns the sender of a connection's first frame, given that frame and the
        user of the sending process, which is the plant's user or root. If it returns None, the
        connection is rejected. The function is called again while the connection lasts, see
        `LocalLimits.trusted_s`.
    answer
        Function that returns the value and the blob of the reply to a request.
    kinds
        Function that returns the kind and the text of an error for the client.
    blob
        Function that returns whether the call in a head may carry a blob from this caller.
    limits
        See `LocalLimits`.
    """

    def __init__(
        self,
        path: Path,
        caller: Callable[[dict[str, Any], int], Awaitable[C | None]],
        answer: Callable[[C, Frame], Awaitable[tuple[Any, bytes]]],
        kinds: Callable[[HeliotropeError], Problem],
        blob: Callable[[C, dict[str, Any]], bool],
        limits: LocalLimits | None = None,
    ) -> None:
        self._path, self._caller, self._answer, self._kinds = path, caller, answer, kinds
        self._blob = blob
        self._limits = limits or LocalLimits()
        self._listener: socket.socket | None = None
        #: Accepted, but not served yet.
        self._taken = set[socket.socket]()
        self._strangers: list[_Peer] = []
        self._callers: list[_Peer] = []
        self._reserved: list[_Peer] = []

    def open(self) -> None:
        """Start listening.

        Raises
        ------
        InputError
            If the server cannot listen at the path.
        """
        self._listener = listen(self._path)

    async def run(self) -> None:
        """Accept connections until cancelled."""
        assert self._listener is not None
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.TaskGroup() as group:
                while True:
                    await asyncio.sleep(self._limits.pace_s)
                    with contextlib.suppress(OSError):  # too many open files, so it waits
                        peer, _ = await loop.sock_accept(self._listener)
                        user = user_of(peer)
                        if user is None:
                            peer.close()
                        else:
                            self._taken.add(peer)
                            group.create_task(self._serve(peer, user))
        finally:
            self.close()

    def close(self) -> None:
        """Stop listening; a second call has no effect."""
        if self._listener is not None:
            self._listener.close()
            self._path.unlink(missing_ok=True)
            self._listener = None
        while self._taken:
            self._taken.pop().close()

    async def _serve(self, connection: socket.socket, user: int) -> None:
        self._taken.discard(connection)
        reader, writer = await asyncio.open_unix_connection(sock=connection, limit=_BUFFER)
        peer = _Peer(writer)
        _place(self._strangers, peer, self._limits.strangers)
        try:
            identity = await self._identified(reader, peer, user)
            if identity is not None:
                await self._talk(reader, peer, *identity)
        except (HeliotropeError, EOFError, OSError, TimeoutError):
            return  # the connection has ended, or must end
        except Exception:  # noqa: BLE001 - it is logged
            # One connection must not end the others.
            _LOG.exception("local interface")
        finally:
            for pool in (self._strangers, self._callers, self._reserved):
                if peer in pool:
                    pool.remove(peer)
            peer.cut()

    async def _identified(
        self, reader: asyncio.StreamReader, peer: _Peer, user: int
    ) -> tuple[_Identity[C], C] | None:
        """Return a function that determines the caller again, and the caller; None if rejected."""
        async with asyncio.timeout(self._limits.hello_s):
            hello = await read_frame(reader, HELLO_HEAD, 0)
            ask = functools.partial(self._caller, hello.head, user)
            identity = _Identity(ask, self._limits.trusted_s)
            caller = await identity.caller()
        if caller is None:
            await self._refuse(peer)
            return None
        if peer in self._strangers:
            self._strangers.remove(peer)
        if caller.reserved:
            _place(self._reserved, peer, self._limits.reserved)
        else:
            _place(self._callers, peer, self._limits.callers)
        await peer.write(pack({"id": 0, "value": None}), self._limits.answer_s)
        return identity, caller

    async def _refuse(self, peer: _Peer, number: int = 0) -> None:
        refusal = {"id": number, "error": "refused", "text": "the key or token is not valid"}
        await peer.write(pack(refusal), self._limits.answer_s)

    async def _talk(
        self, reader: asyncio.StreamReader, peer: _Peer, identity: _Identity[C], caller: C
    ) -> None:
        limits = self._limits
        most = limits.console_under_way if caller.reserved else limits.under_way
        room, accepts = asyncio.Semaphore(most), functools.partial(self._blob, caller)
        works = set[asyncio.Task[None]]()
        async with asyncio.TaskGroup() as group:
            works.add(group.create_task(self._end_with(identity, peer)))
            try:
                while True:
                    await room.acquire()
                    frame = await read_frame(reader, REQUEST_HEAD, REQUEST_BLOB, accepts)
                    if type(frame.head.get("id")) is not int:
                        raise FrameError("local interface: a request without a number")
                    work = group.create_task(self._answer_one(frame, peer, identity, room))
                    works.add(work)
                    work.add_done_callback(works.discard)
            except (FrameError, EOFError, OSError):
                for work in works:
                    work.cancel()

    async def _end_with(self, identity: _Identity[C], peer: _Peer) -> None:
        """Disconnect a caller who is no longer valid, even if the connection is idle."""
        while await identity.caller() is not None:
            await asyncio.sleep(self._limits.trusted_s)
        peer.cut()

    async def _answer_one(
        self, frame: Frame, peer: _Peer, identity: _Identity[C], room: asyncio.Semaphore
    ) -> None:
        """Answer one request from a caller who is currently valid."""
        number, blob = frame.head["id"], b""
        if (caller := await identity.caller()) is None:
            await self._refuse(peer, number)
            peer.cut()
            return
        try:
            value, blob = await self._answer(caller, frame)
            data = pack({"id": number, "value": value}, blob)
        except HeliotropeError as error:
            kind, text = self._kinds(error)
            data = pack({"id": number, "error": kind, "text": text})
        except Exception:  # noqa: BLE001 - it is logged
            # The plant continues whatever a call does.
            _LOG.exception("local interface: %s", str(frame.head.get("call"))[:64])
            data = pack({"id": number, "error": INTERNAL, "text": "the call has failed"})
        await peer.write(data, self._limits.answer_s)
        room.release()


def _place(pool: list[_Peer], peer: _Peer, most: int) -> None:
    """Add a connection to a pool; if the pool is full, close the oldest connection."""
    while len(pool) >= most:
        pool.pop(0).cut()
    pool.append(peer)
