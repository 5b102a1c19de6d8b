"""Links between the plant and its clusters: byte messages that arrive in time or not at all.

A `Link` carries datagrams between two ends. It guarantees:

- A message arrives complete, unaltered, in order and at most once, or not at all.
- A message with an expiry is never delivered after it, neither from a queue nor from a broker that
  was frozen nor from a socket buffer. Nothing is kept for an absent end.
- `connected` means that the other end was alive within the deadline, and received from this end
  within the deadline plus one period. This depends on our own heartbeats alone, whatever state the
  transport reports.

`CarriedLink` (connection.py) is the only implementation; memory, TCP and MQTT differ only in their
`Carrier`. envelope.py explains how a receiver bounds the age of a message without a common clock. A
bus is not a link: it has one master, and a node that replies does so at once (`Bus`,
`cluster.serial_bus`).

::

    HeliotropeError
    └── LinkError             a link cannot be made, or no longer exists
        ├── LinkLostError     a connection is lost; the link reconnects automatically
        └── LinkClosedError   the link was closed permanently
"""

import asyncio
import contextlib
import enum
import math
import random
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from dataclasses import dataclass
from typing import Any, Protocol

from heliotrope.errors import HeliotropeError, InputError
from heliotrope.links.clock import Clock


class LinkError(HeliotropeError):
    """A link cannot be created, or no longer exists."""


class LinkLostError(LinkError):
    """A connection is lost; the link reconnects automatically."""


class LinkClosedError(LinkError):
    """The link was closed permanently."""


class SendOutcome(enum.Enum):
    """Outcome of sending a message, which the receiver may still reject.

    SENT: the transport accepted the message in time (with MQTT: the broker confirmed it). After any
    other outcome the caller may send the message again; the first copy will not arrive late.
    """

    SENT = "sent"
    DISCONNECTED = "dropped: not connected"
    EXPIRED = "dropped: it could not go out before it expired"


@dataclass(slots=True)
class Statistics:
    """Counts of a link since its creation.

    Attributes
    ----------
    sent, received
        Messages passed to the transport; messages passed to the caller.
    dropped, expired
        Messages not sent because the link was not connected; messages not sent because there was no
        time left.
    late, overflowed
        Messages not delivered: after their expiry; dropped as the oldest in a full queue.
    repeated, refused, retained
        Messages not delivered: duplicates and messages that arrived after a later one; damaged or
        forged messages, or messages of another conversation; messages retained by a broker.
    opened, failures, reconnects
        Connections made; failed attempts; connections made after the first connection.
    last_received
        When the last envelope of any kind arrived, in s of the monotonic clock.
    """

    sent: int = 0
    received: int = 0
    dropped: int = 0
    expired: int = 0
    late: int = 0
    overflowed: int = 0
    repeated: int = 0
    refused: int = 0
    retained: int = 0
    opened: int = 0
    failures: int = 0
    reconnects: int = 0
    last_received: float | None = None


@dataclass(frozen=True)
class LinkSettings:
    """Times and sizes of a link; both ends should use the same values.

    Parameters
    ----------
    period
        Time between heartbeats, in s.
    deadline
        Silence after which the other end counts as lost, in s; at least twice the period. The
        plant's lease to a cluster is 3 s, so the default leaves half of the lease.
    capacity
        Maximum number of received messages waiting for the caller; beyond this number the oldest
        message is dropped.
    largest
        Maximum size of a message, in bytes.
    horizon
        Maximum accepted time until an expiry, in s.
    open_limit
        Timeout for making a connection, in s.
    first_pause, longest_pause
        Shortest and longest pause between connection attempts, in s. The pause doubles each time
        and is drawn between half and all of its value, so that the clusters of a field do not
        reconnect simultaneously.

    Raises
    ------
    InputError
        If values contradict each other.
    """

    period: float = 0.5
    deadline: float = 1.5
    capacity: int = 256
    largest: int = 65536
    horizon: float = 3600.0
    open_limit: float = 3.0
    first_pause: float = 0.1
    longest_pause: float = 2.0

    def __post_init__(self) -> None:
        if not 0.0 < 2.0 * self.period <= self.deadline < math.inf:
            raise InputError(
                f"link: the deadline ({self.deadline} s) must be at least twice the period of "
                f"heartbeats ({self.period} s), so that one heartbeat may be lost"
            )
        if not 0.0 < self.first_pause <= self.longest_pause < math.inf:
            raise InputError(
                f"link: the first pause between attempts ({self.first_pause} s) must be above 0 "
                f"and at most the longest ({self.longest_pause} s)"
            )
        if self.capacity < 1 or self.largest < 1 or not 0.0 < self.horizon <= 4000.0:
            raise InputError(
                "link: capacity must be at least 1, the largest message at least 1 byte and the "
                f"horizon 0 to 4000 s, not {self.capacity}, {self.largest} bytes and "
                f"{self.horizon} s"
            )


class Link(Protocol):
    """One end of a link; see the docstring of this module for its guarantees.

    Run ``run`` in a TaskGroup of the owner (or use `running`); it returns when the link is closed.
    ``receive`` may have only one caller at a time.
    """

    @property
    def name(self) -> str:
        """Name of the other end."""
        ...

    @property
    def connected(self) -> bool:
        """Whether, within the deadline, the other end was alive and had received from this end."""
        ...

    @property
    def closed(self) -> bool:
        """Whether the link is closed permanently."""
        ...

    @property
    def silent_for(self) -> float:
        """Time since the other end was last known to be alive, s; infinite if it never was."""
        ...

    @property
    def problem(self) -> str:
        """Reason why the link is not connected; empty while it is connected."""
        ...

    @property
    def statistics(self) -> Statistics:
        """Counts since the link's creation."""
        ...

    async def run(self) -> None:
        """Keep the link connected until it is closed."""
        ...

    async def send(
        self, data: bytes, *, expires: float | None = None, hold: bool = False
    ) -> SendOutcome:
        """Send a message by ``expires`` on the monotonic clock, or not at all."""
        ...

    async def receive(self) -> bytes:
        """Wait for the next message."""
        ...

    async def close(self) -> None:
        """Close the link permanently."""
        ...


class Bus(Protocol):
    """A bus whose only master is this side, which sends a frame and reads the reply."""

    @property
    def connected(self) -> bool:
        """Whether the port is open; only replies show which nodes are alive."""
        ...

    @property
    def closed(self) -> bool:
        """Whether the bus is closed permanently."""
        ...

    async def run(self) -> None:
        """Keep the port open until the bus is closed."""
        ...

    async def transact(
        self,
        frame: bytes,
        timeout: float,
        *,
        expires: float | None = None,
        urgent: bool = False,
        complete: Callable[[bytes], bool] | None = None,
    ) -> bytes:
        """Send a frame and return the reply, which is empty if none arrives."""
        ...

    async def transmit(
        self, frame: bytes, *, expires: float | None = None, urgent: bool = False
    ) -> SendOutcome:
        """Send a frame that expects no reply."""
        ...

    async def close(self) -> None:
        """Close the bus permanently."""
        ...


# -- parts -----------------------------------------------------------------------------


class Backoff:
    """Random pauses between attempts, doubled each time up to a limit.

    Parameters
    ----------
    first, longest
        First and longest pause, in s.
    chance
        Generator of random numbers, which draws each pause between half its value and its full
        value.
    """

    def __init__(self, first: float, longest: float, chance: random.Random) -> None:
        self._first = first
        self._longest = longest
        self._chance = chance
        self._pause = first

    def reset(self) -> None:
        """Restart with the first pause after a success."""
        self._pause = self._first

    def next(self) -> float:
        """Return the next pause in s."""
        pause = self._pause
        self._pause = min(self._longest, 2.0 * pause)
        return pause * self._chance.uniform(0.5, 1.0)


class Heartbeat:
    """Sends heartbeats periodically, and records how long the other side has been silent.

    Parameters
    ----------
    clock
        Clock whose monotonic time is used.
    period, deadline
        Time between heartbeats, and maximum silence, in s.
    """

    def __init__(self, clock: Clock, period: float, deadline: float) -> None:
        self._clock = clock
        self._period = period
        self._deadline = deadline
        self._heard = -math.inf
        self._now = asyncio.Event()

    def heard(self, at: float | None = None) -> None:
        """Record that the other side was alive, now or at a given time of the clock.

        Times before the latest known time are ignored.
        """
        now = self._clock.monotonic()
        self._heard = max(self._heard, now if at is None else min(at, now))

    @property
    def silent_for(self) -> float:
        """Time since the other side was alive, s; infinite if it never was."""
        return self._clock.monotonic() - self._heard

    @property
    def alive(self) -> bool:
        """Whether the other side was alive within the deadline."""
        return self.silent_for <= self._deadline

    def prompt(self) -> None:
        """Send a heartbeat at once, and continue periodically from there."""
        self._now.set()

    async def run(self, beat: Callable[[], Awaitable[object]]) -> None:
        """Call ``beat`` every period until cancelled; missed beats are not made up."""
        while True:
            self._now.clear()
            due = self._clock.monotonic() + self._period
            await beat()
            # No timeout is used here, because it would cancel the task twice a second, and a field
            # has hundreds of links.
            remaining = max(1e-6, due - self._clock.monotonic())
            alarm = asyncio.get_running_loop().call_later(remaining, self._now.set)
            try:
                await self._now.wait()
            finally:
                alarm.cancel()


class Inbox:
    """Received messages not yet taken: a bounded queue that drops messages at their expiry."""

    def __init__(self, clock: Clock, capacity: int, statistics: Statistics) -> None:
        self._clock = clock
        self._capacity = capacity
        self._statistics = statistics
        self._items: deque[tuple[bytes, float]] = deque()
        self._news = asyncio.Event()
        self._closed = False

    def put(self, data: bytes, expires: float) -> None:
        """Add a message; if the queue is full, its oldest message is dropped and counted."""
        if len(self._items) >= self._capacity:
            self._items.popleft()
            self._statistics.overflowed += 1
        self._items.append((data, expires))
        self._news.set()

    def close(self) -> None:
        """Wake the waiting task."""
        self._closed = True
        self._news.set()

    async def get(self) -> bytes:
        """Wait for a message.

        Raises
        ------
        LinkClosedError
            If the inbox is closed; remaining messages are not delivered.
        """
        while not self._closed:
            while self._items:
                data, expires = self._items.popleft()
                if self._clock.monotonic() < expires:
                    self._statistics.received += 1
                    return data
                self._statistics.late += 1
            self._news.clear()
            await self._news.wait()
        raise LinkClosedError("the link is closed: nothing more will come")


# -- running ---------------------------------------------------------------------------


async def received(link: Link) -> AsyncIterator[bytes]:
    """Yield a link's messages one after another, until the link is closed."""
    with contextlib.suppress(LinkClosedError):
        while True:
            yield await link.receive()


async def until_closed(closing: asyncio.Event, *parts: Coroutine[Any, Any, None]) -> None:
    """Run parts concurrently until an event is set, then cancel them; if one fails, cancel all."""
    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(part) for part in parts]
        await closing.wait()
        for task in tasks:
            task.cancel()


async def first_of(*parts: Coroutine[Any, Any, object]) -> None:
    """Run parts concurrently until one ends, then cancel the others; re-raise its exception."""
    tasks = [asyncio.ensure_future(part) for part in parts]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    for task in done:
        task.result()


class Runnable(Protocol):
    """An object that can be run and closed: a `Link`, a `Bus`, a server."""

    async def run(self) -> None:
        """Run until closed."""
        ...

    async def close(self) -> None:
        """Make ``run`` return."""
        ...


@contextlib.asynccontextmanager
async def running(*parts: Runnable) -> AsyncIterator[None]:
    """Run links, buses and servers during a block, and close all of them at its end."""
    failure: Exception | None = None
    async with asyncio.TaskGroup() as group:
        for part in parts:
            group.create_task(part.run())
        try:
            yield
        except Exception as error:  # noqa: BLE001 (it goes on as it came, not in a group)
            failure = error
        finally:
            await asyncio.gather(*(part.close() for part in parts))
    if failure is not None:
        raise failure
