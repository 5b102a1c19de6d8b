"""Links over TCP: a server for the plant, a client for each cluster.

A frame is a length of 4 bytes (big-endian) and an envelope. COBS would let a reader find the next
frame after lost bytes, but TCP loses none. A length above the limit, or below the length of an
authentication tag, is rejected before any part of the frame is stored, and ends the connection.

The handshake has one frame per step: server, 32 random bytes; client, 32 random bytes, its
authentication tag and its name; server, its authentication tag. A tag is HMAC-SHA256 of a label,
both random numbers and the name under the shared key, so neither a replay nor a reflection is
accepted. The envelopes that follow are sealed with a key derived in the same way. This
authenticates both ends and detects any alteration, but does not encrypt; encryption is left to TLS.

Nothing may be delivered late, so no data waits in this process: an envelope is created only when
the transport has nothing left to write, and a closed connection discards its data. The receiver
judges the age of data that waited in the kernel (envelope.py).
"""

import asyncio
import contextlib
import hmac
import secrets
import socket
import ssl
from collections import Counter, deque
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass

from heliotrope.links.clock import Clock
from heliotrope.links.connection import CarriedLink
from heliotrope.links.envelope import OVERHEAD, SealKeys
from heliotrope.links.keys import KeyRing, ring_of
from heliotrope.links.link import LinkError, LinkLostError, LinkSettings
from heliotrope.links.tls import TlsSource, context_of

_NONCE, _PROOF = 32, 32
_LONGEST_NAME = 64
#: Longest frame accepted from a client that has not yet been authenticated.
_GREETING = _NONCE + _PROOF + _LONGEST_NAME
_LENGTH = 4
#: Frames that may wait in a connection before it stops reading its socket.
_WAITING = 64
#: Kernel's send buffer, bytes; it is small because data in it can no longer be withdrawn.
_SEND_BUFFER = 65536
#: Maximum number of connections in their handshake at the same time, in addition to one per
#: cluster: in total, and from one address.
_NEWCOMERS, _NEWCOMERS_EACH = 64, 16


class _Pipe(asyncio.Protocol):
    """A connection that carries frames."""

    def __init__(self, largest: int, arrived: "Callable[[_Pipe], None] | None" = None) -> None:
        self.largest = largest
        #: Whether it is a client that has not yet been authenticated; see `trust`.
        self._stranger = arrived is not None
        self.address = ""
        self._arrived = arrived
        self._transport: asyncio.Transport | None = None
        self._buffer = bytearray()
        self._frames: deque[bytes] = deque()
        self._lost = ""
        self._paused = False
        self._readable = asyncio.Event()
        self._writable = asyncio.Event()
        self._ended = asyncio.Event()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Configure the socket and report the connection to the server, if there is one."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        transport.set_write_buffer_limits(high=0)
        link = transport.get_extra_info("socket")
        if link is not None and link.family in (socket.AF_INET, socket.AF_INET6):
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
            self.address = str((transport.get_extra_info("peername") or ("",))[0])
        self._writable.set()
        if self._arrived is not None:
            # Read only once its task exists, which may begin with TLS.
            transport.pause_reading()
            self._arrived(self)

    async def begin(self, tls: ssl.SSLContext | None, limit: float) -> None:
        """Start reading as a server, after the TLS handshake if there is one."""
        transport = self._transport
        if transport is None:
            raise LinkLostError(self._lost)
        if tls is None:
            transport.resume_reading()
            return
        made = await asyncio.get_running_loop().start_tls(
            transport, self, tls, server_side=True, ssl_handshake_timeout=limit
        )
        if made is None or self._lost:
            raise LinkLostError(self._lost or "the connection ended in the TLS handshake")
        made.set_write_buffer_limits(high=0)
        self._transport = made

    def data_received(self, data: bytes) -> None:
        """Split received bytes into frames."""
        self._buffer += data
        while not self._lost and len(self._buffer) >= _LENGTH:
            size = int.from_bytes(self._buffer[:_LENGTH], "big")
            if not _PROOF <= size <= self.largest:
                limits = f"{_PROOF} to {self.largest}"
                self.lose(f"received a frame of {size} bytes; a frame has {limits}")
                return
            if len(self._buffer) < _LENGTH + size:
                break
            self._frames.append(bytes(self._buffer[_LENGTH : _LENGTH + size]))
            del self._buffer[: _LENGTH + size]
            if self._stranger and self._buffer:
                # Splitting 200 kB into empty frames blocked the plant's event loop for 0.1 s.
                self.lose("received more than one frame before its proof was answered")
                return
        if self._frames:
            self._readable.set()
        if len(self._frames) > _WAITING and not self._paused and self._transport is not None:
            self._paused = True
            self._transport.pause_reading()

    def trust(self, largest: int) -> None:
        """Accept any number of frames up to a given size from now on."""
        self._stranger, self.largest = False, largest

    def pause_writing(self) -> None:
        """Stop writing, because the transport's buffer is full."""
        self._writable.clear()

    def resume_writing(self) -> None:
        """Resume writing, because the transport's buffer is empty."""
        self._writable.set()

    def connection_lost(self, exc: Exception | None) -> None:
        """Record that the transport has ended."""
        self._lost = self._lost or (str(exc) if exc else "the other end closed the connection")
        self._transport = None
        self._ended.set()
        self._readable.set()
        self._writable.set()

    def lose(self, why: str) -> None:
        """End the connection at once."""
        self._lost = self._lost or why
        self._frames.clear()
        self._readable.set()
        self._writable.set()
        if self._transport is not None:
            self._transport.abort()

    async def close(self) -> None:
        """End the connection at once, and wait until it is gone."""
        self.lose("closed")
        if self._transport is not None:
            await self._ended.wait()

    async def read(self) -> bytes:
        while not self._frames:
            if self._lost:
                raise LinkLostError(self._lost)
            self._readable.clear()
            await self._readable.wait()
        frame = self._frames.popleft()
        if self._paused and not self._frames and self._transport is not None:
            self._paused = False
            self._transport.resume_reading()
        return frame

    async def ready(self) -> None:
        await self._writable.wait()
        if self._lost:
            raise LinkLostError(self._lost)

    def write(self, frame: bytes) -> None:
        if self._lost or self._transport is None:
            raise LinkLostError(self._lost)
        self._transport.write(len(frame).to_bytes(_LENGTH, "big") + frame)


# -- handshake -------------------------------------------------------------------------


def _proof(key: bytes, label: bytes, server: bytes, client: bytes, name: bytes) -> bytes:
    return hmac.digest(key, b"heliotrope link 1 " + label + server + client + name, "sha256")


def _derived(ring: KeyRing, server: bytes, client: bytes, name: bytes) -> SealKeys:
    """Return the connection's keys.

    There is one for each key of the ring; they are updated whenever the ring changes.
    """
    made: dict[bytes, bytes] = {}

    def keys() -> tuple[bytes, ...]:
        for key in ring.keys:
            if key not in made:
                made[key] = _proof(key, b"session", server, client, name)
        return tuple(made[key] for key in ring.keys)

    return keys


async def _introduce(pipe: _Pipe, name: str, key: bytes, ring: KeyRing) -> SealKeys:
    """Authenticate both ends as the client, and return the connection's keys."""
    server, client, title = await pipe.read(), secrets.token_bytes(_NONCE), name.encode()
    if len(server) != _NONCE:
        raise LinkError("the program that answers there does not speak this protocol")
    pipe.write(client + _proof(key, b"client", server, client, title) + title)
    try:
        answer = await pipe.read()
    except LinkLostError as lost:
        raise LinkError(
            f"the server refuses cluster {name} ({lost}); compare name and key on both sides"
        ) from None
    if not hmac.compare_digest(answer, _proof(key, b"server", server, client, title)):
        raise LinkError(
            f"the server could not prove that it knows the key of cluster {name}; check that "
            "the address is that of this plant"
        )
    return _derived(ring, server, client, title)


async def _greet(pipe: _Pipe, rings: Mapping[str, KeyRing], largest: int) -> tuple[str, SealKeys]:
    """Authenticate the client as the server; return its name and the connection's keys."""
    server = secrets.token_bytes(_NONCE)
    pipe.write(server)
    frame = await pipe.read()
    client, proof, title = frame[:_NONCE], frame[_NONCE : _NONCE + _PROOF], frame[_NONCE + _PROOF :]
    name = title.decode(errors="replace")
    ring = rings.get(name, KeyRing())
    # An unknown name takes the same computation as a known one, so that timing reveals nothing.
    for key in ring.keys or (bytes(_NONCE),):
        right = hmac.compare_digest(proof, _proof(key, b"client", server, client, title))
        if right and ring.keys:
            break
    else:
        raise LinkError(f"{name!r} could not prove that it is a cluster of this plant")
    pipe.trust(largest)
    pipe.write(_proof(key, b"server", server, client, title))
    return name, _derived(ring, server, client, title)


# -- both sides ------------------------------------------------------------------------


class _TcpCarrier:
    """A carrier over pipes that another object connects."""

    def __init__(self, connect: Callable[[], Awaitable[tuple[_Pipe, SealKeys]]]) -> None:
        self._connect = connect
        self._pipe: _Pipe | None = None

    async def open(self) -> SealKeys:
        """Connect a pipe whose other end is authenticated; return the connection's keys."""
        self._pipe, keys = await self._connect()
        return keys

    def _connected(self) -> _Pipe:
        if self._pipe is None:
            raise LinkLostError("closed")
        return self._pipe

    async def ready(self) -> None:
        """Wait until everything written has left this process."""
        await self._connected().ready()

    async def write(self, envelope: bytes, lifetime: float | None) -> None:
        """Write an envelope; TCP ignores the lifetime."""
        del lifetime
        self._connected().write(envelope)

    async def read(self) -> bytes:
        """Wait for the next envelope."""
        return await self._connected().read()

    async def close(self) -> None:
        """Disconnect at once."""
        pipe, self._pipe = self._pipe, None
        if pipe is not None:
            await pipe.close()


@dataclass
class _Client:
    """A carrier that connects to a server."""

    host: str
    port: int
    name: str
    ring: KeyRing
    largest: int
    tls: TlsSource
    _turn: int = 0

    async def connect(self) -> tuple[_Pipe, SealKeys]:
        pipe = _Pipe(self.largest)
        keys = self.ring.keys
        key = keys[self._turn % len(keys)]
        try:
            await asyncio.get_running_loop().create_connection(
                lambda: pipe, self.host, self.port, ssl=context_of(self.tls)
            )
            seal = await _introduce(pipe, self.name, key, self.ring)
        except BaseException as error:
            # The server may not have the new key yet, so the next attempt uses the old key.
            self._turn = self._turn + 1 if isinstance(error, LinkError) else 0
            await pipe.close()
            raise
        self._turn = 0
        return pipe, seal


class _Newcomers:
    """Connections during their handshake, limited in total and per address.

    Parameters
    ----------
    clusters
        Number of clusters, all of which may connect at once from one address.
    """

    def __init__(self, clusters: int) -> None:
        self._most, self._most_by_address = clusters + _NEWCOMERS, clusters + _NEWCOMERS_EACH
        self._pipes: dict[_Pipe, None] = {}

    def enter(self, pipe: _Pipe) -> None:
        """Admit a connection; beyond the limits, close the busiest address's oldest connection."""
        self._pipes[pipe] = None
        counts = Counter(other.address for other in self._pipes)
        busiest = pipe.address
        if counts[busiest] <= self._most_by_address:
            if len(self._pipes) <= self._most:
                return
            busiest = counts.most_common(1)[0][0]
        oldest = next(other for other in self._pipes if other.address == busiest)
        self.leave(oldest)
        oldest.lose(f"{busiest} has too many connections in their handshake; the oldest ends")

    def leave(self, pipe: _Pipe) -> None:
        """Forget a connection whose handshake has ended."""
        self._pipes.pop(pipe, None)


class _Slot:
    """A place where a cluster's connection waits for its link.

    A new connection ends the previous one.
    """

    def __init__(self) -> None:
        self._offer: tuple[_Pipe, SealKeys] | None = None
        self._last: _Pipe | None = None
        self._offered = asyncio.Event()

    def offer(self, pipe: _Pipe, keys: SealKeys) -> None:
        """Take over an authenticated connection of this cluster."""
        if self._last is not None:
            self._last.lose("the cluster connected again")
        self._last = pipe
        self._offer = (pipe, keys)
        self._offered.set()

    async def take(self) -> tuple[_Pipe, SealKeys]:
        """Wait for the cluster to connect and return the connection."""
        while self._offer is None:
            self._offered.clear()
            await self._offered.wait()
        offer, self._offer = self._offer, None
        return offer

    async def clear(self) -> None:
        """Close a connection that was not taken."""
        if self._offer is not None:
            await self._offer[0].close()
            self._offer = None


def tcp_link(
    host: str,
    port: int,
    name: str,
    key: bytes | KeyRing,
    clock: Clock,
    settings: LinkSettings | None = None,
    *,
    tls: TlsSource = None,
) -> CarriedLink:
    """Return a cluster's link to its plant.

    Parameters
    ----------
    host, port
        Address of the plant's server.
    name, key
        Name and key of this cluster, as known to the plant; the keys of a ring may change.
    clock, settings
        As in `CarriedLink`.
    tls
        See `client_tls`; None for a connection that is authenticated but not encrypted.

    Raises
    ------
    InputError
        If the name or key cannot be used.
    """
    ring = ring_of(name, key)
    settings = settings or LinkSettings()
    client = _Client(host, port, name, ring, settings.largest + OVERHEAD, tls)
    return CarriedLink(f"plant at {host}:{port}", _TcpCarrier(client.connect), clock, settings)


class TcpServer:
    """The plant's side: one link for each configured cluster.

    Parameters
    ----------
    host, port
        Address to listen on; with port 0, any free port, which the attribute ``port`` shows.
    keys
        Name and key of each cluster, at least 16 bytes each; the keys of a ring may change.
    clock, settings
        As in `CarriedLink`; `LinkSettings.open_limit` is the timeout of the handshake.
    tls
        See `server_tls`.

    Attributes
    ----------
    links
        The links, by cluster name; ``run`` runs them.
    port
        Port on which the server listens; 0 before it listens.
    refused
        Number of connections that failed the handshake.
    last_refusal
        Reason why the last of these connections was rejected.

    Raises
    ------
    InputError
        If a name or key cannot be used.
    """

    def __init__(
        self,
        host: str,
        port: int,
        keys: Mapping[str, bytes | KeyRing],
        clock: Clock,
        settings: LinkSettings | None = None,
        *,
        tls: TlsSource = None,
    ) -> None:
        self._host, self._requested = host, port
        self._rings = {name: ring_of(name, key) for name, key in keys.items()}
        self._settings = settings or LinkSettings()
        self._tls = tls
        self._slots = {name: _Slot() for name in keys}
        self.links: Mapping[str, CarriedLink] = {
            name: CarriedLink(
                f"cluster {name}", _TcpCarrier(slot.take), clock, self._settings, patient=True
            )
            for name, slot in self._slots.items()
        }
        self.port = 0
        self.refused = 0
        self.last_refusal = ""
        # No longer than the number of newcomers, because an evicted connection is removed at once.
        self._arrived: asyncio.Queue[_Pipe] = asyncio.Queue()
        self._newcomers = _Newcomers(len(keys))
        self._listening = asyncio.Event()
        self._closing = asyncio.Event()

    async def listening(self) -> None:
        """Wait until the server listens."""
        await self._listening.wait()

    async def close(self) -> None:
        """Close all links and stop listening."""
        self._closing.set()
        for link in self.links.values():
            await link.close()

    async def run(self) -> None:
        """Listen, and run the links, until closed.

        Raises
        ------
        LinkError
            If the server cannot listen at that address.
        """
        try:
            server = await asyncio.get_running_loop().create_server(
                lambda: _Pipe(_GREETING, self._arrive),
                self._host,
                self._requested,
                # All clusters may connect at the same instant, as after a restart.
                backlog=len(self.links) + 2 * _NEWCOMERS,
            )
        except OSError as error:
            raise LinkError(
                f"cannot listen on {self._host}:{self._requested} ({error.strerror or error}); "
                "check whether another plant is running there"
            ) from None
        self.port = server.sockets[0].getsockname()[1]
        self._listening.set()
        try:
            async with asyncio.TaskGroup() as group:
                for link in self.links.values():
                    group.create_task(link.run())
                welcoming = group.create_task(self._welcome())
                await self._closing.wait()
                welcoming.cancel()
        finally:
            server.close()
            while not self._arrived.empty():
                await self._arrived.get_nowait().close()
            for slot in self._slots.values():
                await slot.clear()

    def _arrive(self, pipe: _Pipe) -> None:
        self._newcomers.enter(pipe)
        self._arrived.put_nowait(pipe)

    async def _welcome(self) -> None:
        async with asyncio.TaskGroup() as group:
            while True:
                group.create_task(self._admit(await self._arrived.get()))

    async def _admit(self, pipe: _Pipe) -> None:
        admitted = False
        try:
            limit = self._settings.open_limit
            async with asyncio.timeout(limit):
                await pipe.begin(context_of(self._tls), limit)
                name, keys = await _greet(pipe, self._rings, self._settings.largest + OVERHEAD)
            self._slots[name].offer(pipe, keys)
            admitted = True
        except (LinkError, OSError) as error:
            self.refused += 1
            self.last_refusal = str(error) or "the handshake took too long"
        finally:
            self._newcomers.leave(pipe)
            if not admitted:
                with contextlib.suppress(OSError):
                    await pipe.close()
