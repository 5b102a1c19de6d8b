"""Console connections, which are counted, timed, and closed to make room for known callers.

`Listener` accepts the connections at one address; `Doors` is an application wrapper that notes the
progress of each connection's request. A connection that has never completed a request from a known
caller belongs to a stranger. Strangers have few places and short deadlines, and their longest-held
connection is closed to make room for the next stranger, so they cannot lock anyone out.
"""

import asyncio
import contextlib
import errno
import logging
import resource
import socket
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import partial
from pathlib import Path
from typing import Any

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from heliotrope.links.tls import TlsSource, context_of

logger = logging.getLogger("heliotrope.console")
#: Number of descriptors requested from the system, and number reserved for files, the plant and the
#: store.
WANTED, RESERVE = 16_384, 128
#: Number of connections accepted in one turn of the event loop.
_BURST = 32
#: Interval between checks of the deadlines, and pause after a failure to accept, s.
_LOOK, _PAUSE = 0.25, 0.25
#: Minimum interval between two searches for free places, s.
_SOON = 0.02
#: Minimum rate of a known caller's body, bytes/s.
_SLOWEST = 200_000.0
_FULL = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})
#: Key of the caller in the scope of a request, so that each caller is looked up once.
FOUND = "heliotrope.caller"
Key = tuple[Any, int]
Protocols = Callable[[], asyncio.Protocol]


class Stage(IntEnum):
    """Stage of a connection."""

    HANDSHAKE = 0
    HEADER = 1
    IDLE = 2
    BODY = 3
    ANSWER = 4


@dataclass(frozen=True)
class Limits:
    """Limits of a listener.

    Attributes
    ----------
    most
        Maximum number of connections.
    strangers, address
        Maximum number of connections of strangers, and of strangers from one address.
    handshake, header, body, idle, answer
        Time that a stranger's connection may spend in each stage, s. A known caller's body has the
        time that its length requires.
    idle_known, answer_known
        Times that a known caller's connection may be idle or wait for a response, s.
    """

    most: int = 1000
    strangers: int = 200
    address: int = 100
    handshake: float = 5.0
    header: float = 5.0
    body: float = 5.0
    idle: float = 5.0
    answer: float = 15.0
    idle_known: float = 75.0
    answer_known: float = 120.0

    def within(self, most: int) -> "Limits":
        """Return the same limits with at most this many connections."""
        if most >= self.most:
            return self
        share = max(8, most) / self.most
        few = {
            name: max(4, int(share * getattr(self, name)))
            for name in ("most", "strangers", "address")
        }
        return replace(self, **few)


class Connection:
    """One connection.

    Attributes
    ----------
    address
        Address of the other end.
    stage, since
        Stage, and the time at which it began, s.
    held
        Time since which it has held its place without progress, s; the end of a handshake is not
        progress.
    known
        When a request of a known caller was last completed, s; None for a stranger.
    transport
        Transport of the connection; None during the handshake.
    """

    def __init__(self, address: str, line: socket.socket, now: float) -> None:
        self.address, self.line = address, line
        self.opening: asyncio.Task[None] | None = None
        self.transport: asyncio.Transport | None = None
        self.stage, self.since, self.held = Stage.HANDSHAKE, now, now
        self.known: float | None = None
        self.scope: Scope | None = None
        self.length = 0

    @property
    def closed(self) -> bool:
        """Whether the connection's socket is closed."""
        return self.line.fileno() < 0

    @property
    def present(self) -> bool:
        """Whether a request of a known caller is in progress."""
        return self.scope is not None and self.scope.get(FOUND) is not None

    def enter(self, stage: Stage, now: float) -> None:
        """Begin a stage of the connection."""
        self.stage, self.since = stage, now
        if stage is not Stage.HEADER:
            self.held = now

    def abort(self) -> None:
        """Close the connection at once."""
        if self.transport is not None:
            self.transport.abort()
        elif self.opening is not None:
            self.opening.cancel()

    def late(self, limits: Limits, now: float) -> bool:
        """Return whether the connection's stage has taken too long."""
        socket_open = self.scope is not None and self.scope["type"] == "websocket"
        if socket_open and self.present:
            return False  # the server's pings monitor it
        if self.known is None and not self.present:
            most = getattr(limits, self.stage.name.lower())
        elif self.stage is Stage.BODY:
            most = limits.body + self.length / _SLOWEST
        else:
            most = limits.answer_known if self.stage is Stage.ANSWER else limits.idle_known
        return bool(now - self.since > most)


class Listener:
    """Accepts connections at one address.

    Parameters
    ----------
    line
        Listening socket.
    app
        Application that handles the listener's requests.
    limits
        Limits of the listener's connections.
    shared
        Addresses behind which there are many callers, such as this computer and proxies. They may
        use the places of all strangers.
    monotonic
        Function that returns the time, s.
    """

    def __init__(
        self,
        line: socket.socket,
        app: ASGIApp,
        limits: Limits,
        shared: Iterable[str] = (),
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        line.setblocking(False)
        self.app, self.limits, self.sockets = app, limits, (line,)
        self.port = int(line.getsockname()[1])
        self._shared, self._now = frozenset(shared), monotonic
        self._known: dict[Key, Connection] = {}
        self._strangers: dict[Key, Connection] = {}
        self._sorted = -1.0

    def __len__(self) -> int:
        return len(self._known) + len(self._strangers)

    async def run(self, protocol: Callable[[], asyncio.Protocol], tls: TlsSource) -> None:
        """Accept connections until cancelled."""
        loop, (line,) = asyncio.get_running_loop(), self.sockets
        async with asyncio.TaskGroup() as group:

            def accept() -> None:
                if not self._accept(loop, group, protocol, tls):
                    # Another attempt at once would fail again, thousands of times a second.
                    loop.remove_reader(line)
                    loop.call_later(_PAUSE, resume)

            def resume() -> None:
                if line.fileno() >= 0:
                    loop.add_reader(line, accept)

            resume()
            try:
                while True:
                    begun = self._now()
                    await asyncio.sleep(_LOOK)
                    self.look(max(0.0, self._now() - begun - 2.0 * _LOOK))
            finally:
                loop.remove_reader(line)

    def close(self) -> None:
        """Accept no more connections."""
        self.sockets[0].close()

    async def wait_closed(self) -> None:
        """Do nothing, because the server itself waits for its connections."""

    def _accept(
        self,
        loop: asyncio.AbstractEventLoop,
        group: asyncio.TaskGroup,
        protocol: Protocols,
        tls: TlsSource,
    ) -> bool:
        """Accept waiting connections; return whether the system had enough resources."""
        for _ in range(_BURST):
            try:
                line, peer = self.sockets[0].accept()
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                return True
            except OSError as error:
                if error.errno in _FULL:
                    logger.warning("console: no connection can be accepted (%s)", error.strerror)
                    self.look()
                    self._evict(self._strangers or self._known)
                return False
            line.setblocking(False)
            key = ((str(peer[0]), int(peer[1])), self.port)
            self._make_room(key[0][0])
            connection = self._strangers[key] = Connection(key[0][0], line, self._now())
            connection.opening = group.create_task(self._open(loop, connection, protocol, tls))
            # A task that is cancelled before its first turn cannot close the socket itself.
            connection.opening.add_done_callback(partial(_close_unopened, connection))
        return True

    async def _open(
        self,
        loop: asyncio.AbstractEventLoop,
        connection: Connection,
        protocol: Protocols,
        tls: TlsSource,
    ) -> None:
        """Perform the handshake of a new connection."""
        limit = 10.0 * self.limits.handshake if tls is not None else None  # `look` acts earlier
        try:
            made, _ = await loop.connect_accepted_socket(
                protocol, connection.line, ssl=context_of(tls), ssl_handshake_timeout=limit
            )
        except OSError:
            return
        connection.transport = made
        connection.enter(Stage.HEADER, self._now())

    def _make_room(self, address: str) -> None:
        """Close a connection, if the limits are reached, to make room for a new one."""
        fewest = min(self.limits.address, self.limits.strangers)
        if len(self._strangers) >= fewest or len(self) >= self.limits.most:
            self._sort()
        if len(self._strangers) >= self.limits.address and address not in self._shared:
            same_address = {
                key: connection
                for key, connection in self._strangers.items()
                if connection.address == address
            }
            if len(same_address) >= self.limits.address:
                self._evict(same_address)
        if len(self._strangers) >= self.limits.strangers:
            self._evict(self._strangers)
        elif len(self) >= self.limits.most:
            self._evict(self._strangers or self._known)

    def _evict(self, among: dict[Key, Connection]) -> None:
        """Close the connection that has gone longest without a known caller's complete request."""
        if not among:
            return
        key = min(among, key=lambda key: _rank(among[key]))
        connection = among[key]
        self._strangers.pop(key, None)
        self._known.pop(key, None)
        connection.abort()

    def look(self, stalled: float = 0.0) -> None:
        """Close overdue connections, and drop the connections that have gone.

        Parameters
        ----------
        stalled
            Time that the event loop has just lost, s. Nothing was read in that time, so it does not
            count against any caller.
        """
        self._sorted = -1.0
        self._sort()
        now = self._now()
        for kept in (self._known, self._strangers):
            for connection in kept.values():
                connection.since = min(now, connection.since + stalled)
            for key in [
                key for key, connection in kept.items() if connection.late(self.limits, now)
            ]:
                kept.pop(key).abort()

    def _sort(self) -> None:
        """Drop connections that have gone, and move connections that a known caller now uses."""
        now = self._now()
        if now - self._sorted < _SOON:
            return
        self._sorted = now
        for kept in (self._known, self._strangers):
            for key in [key for key, connection in kept.items() if connection.closed]:
                del kept[key]
        for key in [key for key, connection in self._strangers.items() if connection.present]:
            self._known[key] = self._strangers.pop(key)

    @contextlib.contextmanager
    def request(self, scope: Scope) -> Iterator[Callable[[], None]]:
        """Track a request during a block; yield the function to be called after its body."""
        key = (tuple(scope["client"] or ()), self.port)
        connection = self._known.get(key) or self._strangers.get(key)
        if connection is None:
            yield lambda: None
            return
        length = Headers(scope=scope).get("content-length", "0")
        connection.length = int(length) if length.isdigit() and len(length) < 12 else 0
        connection.enter(Stage.BODY if connection.length else Stage.ANSWER, self._now())
        connection.scope = scope
        try:
            yield lambda: connection.enter(Stage.ANSWER, self._now())
        finally:
            now = self._now()
            if connection.present:
                connection.known = now
                if self._strangers.pop(key, None) is not None:
                    self._known[key] = connection
            connection.scope = None
            connection.enter(Stage.IDLE, now)


def _close_unopened(connection: Connection, task: "asyncio.Task[None]") -> None:
    del task
    if connection.transport is None:
        connection.line.close()


def _rank(connection: Connection) -> tuple[bool, float, int, float]:
    """Return the rank by which connections are closed, first those that await a request."""
    return (
        connection.present,
        connection.known or 0.0,
        max(connection.stage, Stage.IDLE),
        connection.held,
    )


class Doors:
    """A wrapper around a listener's application that notes the progress of each request.

    Parameters
    ----------
    listener
        The listener.
    """

    def __init__(self, listener: Listener) -> None:
        self._listener = listener

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on to the application."""
        app = self._listener.app
        if scope["type"] == "lifespan":
            await app(scope, receive, send)
            return
        with self._listener.request(scope) as whole:

            async def take() -> Message:
                message = await receive()
                if not message.get("more_body", False):
                    whole()
                return message

            await app(scope, take if scope["type"] == "http" else receive, send)


def raise_descriptors() -> int:
    """Raise the number of descriptors that this process may open; return the available number."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    limit = WANTED if hard == resource.RLIM_INFINITY else min(WANTED, hard)
    if soft != resource.RLIM_INFINITY and soft < limit:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))
            soft = limit
    most = WANTED if soft == resource.RLIM_INFINITY else soft
    return most - _open_now()


def _open_now() -> int:
    try:
        return sum(1 for _ in Path("/proc/self/fd").iterdir())
    except OSError:
        return 64
