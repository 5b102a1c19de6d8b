"""The bus of a cluster: RS485 through serialx, with this side as its only master.

The bus runs one transaction at a time: it waits until the line has been quiet for a gap, sends, and
reads the reply. The caller's codec decides what a complete reply is (`complete`); in this module a
reply is just bytes. Urgent frames (defocus, stow) are sent next, before all waiting frames. A frame
whose turn comes after its expiry is dropped.

The adapter switches its driver automatically. Some adapters receive their own frames: with ``echo``
the frame is removed from the received bytes, and an altered echo (two senders at once) invalidates
its transaction. Unrequested bytes are discarded before each frame.

Ports: a device ("/dev/ttyUSB0"), or a network serial server ("socket://10.0.0.7:4001").
"""

import asyncio
import contextlib
import random
from collections.abc import Callable
from dataclasses import dataclass

import serialx

from heliotrope.cluster.turns import Turns
from heliotrope.errors import InputError
from heliotrope.links.clock import Clock, sleep_until
from heliotrope.links.link import (
    Backoff,
    LinkClosedError,
    LinkError,
    SendOutcome,
    until_closed,
)

#: Bits per character: start, eight data bits, stop.
_BITS = 10
_BAUD_RATES = (1200, 4_000_000)
#: An echo may be delayed by this much, in s: USB adapters collect bytes for up to 16 ms.
_ECHO_LIMIT = 0.05


@dataclass(frozen=True)
class BusSettings:
    """Settings of a bus.

    Parameters
    ----------
    baud_rate
        Bits per second; a character has ten.
    gap
        Silence before a frame, in s; None for 3.5 characters, at least 1.75 ms, as on Modbus.
    echo
        Whether the adapter receives its own frames.
    first_pause, longest_pause
        Pauses between attempts to open the port, in s.
    open_limit
        Time limit for opening the port, in s.

    Raises
    ------
    InputError
        If a rate or gap is out of range.
    """

    baud_rate: int = 115200
    gap: float | None = None
    echo: bool = False
    first_pause: float = 0.2
    longest_pause: float = 2.0
    open_limit: float = 3.0

    def __post_init__(self) -> None:
        low, high = _BAUD_RATES
        if not low <= self.baud_rate <= high:
            raise InputError(f"bus: {self.baud_rate} baud; the range is {low} to {high}")
        if self.gap is not None and not 0.0 <= self.gap <= 1.0:
            raise InputError(f"bus: a gap of {self.gap} s; the range is 0 to 1 s, or none")
        if not 0.0 < self.first_pause <= self.longest_pause:
            raise InputError(
                f"bus: pauses of {self.first_pause} s to {self.longest_pause} s between attempts; "
                "the first must be above 0 and not above the longest"
            )

    def duration(self, size: int) -> float:
        """Return how long ``size`` bytes take on the line, in s."""
        return size * _BITS / self.baud_rate

    @property
    def quiet(self) -> float:
        """The gap before a frame, s."""
        return max(self.duration(1) * 3.5, 0.00175) if self.gap is None else self.gap


@dataclass(slots=True)
class BusStatistics:
    """Counts of a bus since its creation.

    Attributes
    ----------
    sent, answered, silent
        Frames sent; requests that received reply bytes; requests that received none.
    dropped, expired
        Frames not sent because there was no port; frames not sent because they had expired before
        their turn.
    stray
        Unrequested bytes.
    spoilt
        Frames whose echo was altered or missing.
    opened, failures, reconnects
        Ports opened; failed attempts; ports opened after the first port.
    last_received
        When the last byte arrived, in s of the monotonic clock.
    """

    sent: int = 0
    answered: int = 0
    silent: int = 0
    dropped: int = 0
    expired: int = 0
    stray: int = 0
    spoilt: int = 0
    opened: int = 0
    failures: int = 0
    reconnects: int = 0
    last_received: float | None = None


def ends_in_zero(data: bytes) -> bool:
    """Return whether bytes contain a complete frame: at least one other byte, then a zero."""
    return data.endswith(b"\0") and bool(data.strip(b"\0"))


class _Port(asyncio.Protocol):
    """The bytes received from a port with their times, without the adapter's own echo."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.data = bytearray()
        self.echo = b""  # the echo that is still expected
        self.spoilt = False
        self.last_at = clock.monotonic()
        self.news = asyncio.Event()
        self.lost = asyncio.Event()
        self.problem = ""

    def data_received(self, data: bytes) -> None:
        """Store received bytes."""
        self.last_at = self._clock.monotonic()
        mine = min(len(data), len(self.echo))
        if data[:mine] == self.echo[:mine]:
            self.echo = self.echo[mine:]
            self.data += data[mine:]
        else:
            self.spoilt = True
            self.echo = b""
        self.news.set()

    def connection_lost(self, exc: Exception | None) -> None:
        """Record that the port is gone."""
        self.problem = str(exc) if exc else "the port closed"
        self.lost.set()
        self.news.set()

    async def hear(self, until: float) -> None:
        """Wait for the next bytes, but no longer than until a monotonic time."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(until - self._clock.monotonic()):
                await self.news.wait()
        self.news.clear()


class SerialBus:
    """A `Bus` over a serial port.

    Parameters
    ----------
    url
        URL of the port; see the docstring of this module.
    clock
        Clock whose monotonic time measures gaps and expiries.
    settings
        See `BusSettings`.

    Attributes
    ----------
    statistics
        See `BusStatistics`.
    problem
        Reason why the port is not open; empty if it is open.
    """

    def __init__(self, url: str, clock: Clock, settings: BusSettings | None = None) -> None:
        self._url = url
        self._clock = clock
        self._settings = settings or BusSettings()
        self._turns = Turns()
        self._port: _Port | None = None
        self._transport: serialx.BaseSerialTransport | None = None
        self._free_at = 0.0
        self._running = False
        self._closing = asyncio.Event()
        self._opened = asyncio.Event()
        self.statistics = BusStatistics()
        self.problem = "not opened yet"

    @property
    def connected(self) -> bool:
        """Whether the port is open; only replies show which nodes are alive."""
        return self._port is not None

    @property
    def closed(self) -> bool:
        """Whether the bus is closed permanently."""
        return self._closing.is_set()

    async def opened(self) -> None:
        """Wait until the port is open."""
        while self._port is None:
            if self.closed:
                raise LinkClosedError(f"bus {self._url}: it is closed")
            self._opened.clear()
            await self._opened.wait()

    async def close(self) -> None:
        """Close the bus permanently."""
        self._closing.set()
        self._opened.set()

    # -- the port ----------------------------------------------------------------------

    async def run(self) -> None:
        """Keep the port open until the bus is closed.

        Raises
        ------
        LinkError
            If the bus is already running.
        """
        if self._running:
            raise LinkError(f"bus {self._url}: it is already running")
        self._running = True
        try:
            await until_closed(self._closing, self._keep())
        finally:
            self._running = False

    async def _keep(self) -> None:
        backoff = Backoff(self._settings.first_pause, self._settings.longest_pause, random.Random())
        while True:
            try:
                async with asyncio.timeout(self._settings.open_limit):
                    port, transport = await self._open_port()
            except (OSError, ValueError, serialx.SerialException) as error:
                self.statistics.failures += 1
                self.problem = f"{self._url} cannot be opened ({str(error) or 'timed out'})"
            else:
                backoff.reset()
                await self._hold(port, transport)
            await asyncio.sleep(backoff.next())

    async def _open_port(self) -> tuple[_Port, serialx.BaseSerialTransport]:
        port = _Port(self._clock)
        transport, _ = await serialx.create_serial_connection(
            asyncio.get_running_loop(), lambda: port, self._url, self._settings.baud_rate
        )
        return port, transport

    async def _hold(self, port: _Port, transport: serialx.BaseSerialTransport) -> None:
        self.statistics.opened += 1
        self.statistics.reconnects = self.statistics.opened - 1
        self._port, self._transport = port, transport
        self.problem = ""
        self._free_at = self._clock.monotonic() + self._settings.quiet
        self._opened.set()
        try:
            await port.lost.wait()
            self.problem = f"{self._url}: {port.problem}"
        finally:
            self._port = self._transport = None
            port.lost.set()
            port.news.set()
            transport.abort()  # data not yet sent must not be sent later
            await transport.wait_closed()

    # -- transactions ------------------------------------------------------------------

    async def transmit(
        self, frame: bytes, *, expires: float | None = None, urgent: bool = False
    ) -> SendOutcome:
        """Send a frame that expects no reply, and wait until it has been sent.

        Parameters
        ----------
        frame
            Frame with its terminator.
        expires
            Monotonic time after which the frame is dropped.
        urgent
            Whether the frame is sent next, before all waiting frames.

        Raises
        ------
        LinkClosedError
            If the bus is closed.
        """
        async with self._turns.turn(urgent=urgent):
            port, outcome = await self._put(frame, expires)
            if port is not None:
                end = self._clock.monotonic() + self._settings.duration(len(frame))
                await sleep_until(self._clock, end)
                while port.echo and self._clock.monotonic() < end + _ECHO_LIMIT:
                    await port.hear(end + _ECHO_LIMIT)
                self._judge_echo(port)
            return outcome

    async def transact(
        self,
        frame: bytes,
        timeout: float,
        *,
        expires: float | None = None,
        urgent: bool = False,
        complete: Callable[[bytes], bool] | None = None,
    ) -> bytes:
        """Send a frame and return the reply.

        Parameters
        ----------
        frame
            Frame with its terminator.
        timeout
            Time limit for the complete reply, from the end of the frame, in s.
        expires, urgent
            As in `transmit`.
        complete
            Function that returns whether the bytes received so far are the complete reply; None for
            `ends_in_zero`, the rule of the bus protocol.

        Returns
        -------
        bytes
            All bytes received, complete or not; empty if nothing was received or the frame was not
            sent (see ``statistics``). Only the codec can decide whether they are a reply.

        Raises
        ------
        InputError
            If the timeout is not above 0.
        LinkClosedError
            If the bus is closed.
        """
        if not timeout > 0.0:
            raise InputError(f"bus {self._url}: the timeout must be above 0, not {timeout} s")
        if complete is None:
            complete = ends_in_zero
        async with self._turns.turn(urgent=urgent):
            port, _ = await self._put(frame, expires)
            if port is None:
                return b""
            end = self._clock.monotonic() + self._settings.duration(len(frame)) + timeout
            answer = await self._hear(port, end, complete)
            self._free_at = max(self._free_at, port.last_at + self._settings.quiet)
            if self._judge_echo(port) and answer:
                self.statistics.answered += 1
                self.statistics.last_received = port.last_at
                return answer
            self.statistics.silent += 1
            return b""

    async def _put(self, frame: bytes, expires: float | None) -> tuple[_Port | None, SendOutcome]:
        if self.closed:
            raise LinkClosedError(f"bus {self._url}: it is closed")
        await sleep_until(self._clock, self._free_at)
        port, transport = self._port, self._transport
        if port is None or transport is None:
            self.statistics.dropped += 1
            return None, SendOutcome.DISCONNECTED
        now = self._clock.monotonic()
        if expires is not None and now >= expires:
            self.statistics.expired += 1
            return None, SendOutcome.EXPIRED
        self.statistics.stray += len(port.data)
        port.data.clear()
        port.spoilt = False
        port.echo = frame if self._settings.echo else b""
        try:
            transport.write(frame)
        except (OSError, serialx.SerialException) as error:
            port.connection_lost(error)
            self.statistics.dropped += 1
            return None, SendOutcome.DISCONNECTED
        self.statistics.sent += 1
        self._free_at = now + self._settings.duration(len(frame)) + self._settings.quiet
        return port, SendOutcome.SENT

    def _judge_echo(self, port: _Port) -> bool:
        if not port.spoilt and not port.echo:
            return True
        port.echo = b""
        self.statistics.spoilt += 1
        return False

    async def _hear(self, port: _Port, end: float, complete: Callable[[bytes], bool]) -> bytes:
        """Return the bytes received until they are complete, or until the time ``end``."""
        while True:
            answer = bytes(port.data)
            over = port.lost.is_set() or port.spoilt or self._clock.monotonic() >= end
            if over or (answer and complete(answer)):
                port.data.clear()
                return answer
            await port.hear(end)
