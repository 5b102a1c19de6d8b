"""Links between the plant and its clusters: messages of bytes, fresh or not at all.

A `Link` carries datagrams between two ends. It guarantees:

- A message arrives whole, unaltered, in order, at most once, or not at all.
- A message with an expiry is never delivered after it: not from a queue, not from a broker that
  was frozen, not from a socket's buffer. Nothing is kept for an end that is absent.
- `connected` means that the other end was alive within the deadline, and heard this one within the
  deadline and a period. It rests on our own heartbeats alone, whatever state the transport reports.

`CarriedLink` (connection.py) is the one implementation; memory, TCP and MQTT differ only in their
`Carrier`. envelope.py explains how a receiver knows a message's age without a common clock.
A bus is not a link: it has one master, and a node that answers does so at once (`Bus`,
`cluster.serial_bus`).

::

    HeliotropeError
    └── LinkError             a link cannot be made, or no longer exists
        ├── LinkLostError     a connection is gone; the link makes another by itself
        └── LinkClosedError   the link was closed for good
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
    """A link cannot be made, or no longer exists."""


class LinkLostError(LinkError):
    """A connection is gone; the link makes another by itself."""


class LinkClosedError(LinkError):
    """The link was closed for good."""


class SendOutcome(enum.Enum):
    """Fate of a message at its sender; the receiver may still refuse it.

    SENT: the transport took it in time (with MQTT: the broker confirmed it).
    After any other result the caller may send it again; the first message will not arrive late.
    """

    SENT = "sent"
    DISCONNECTED = "dropped: not connected"
    EXPIRED = "dropped: it could not go out before it expired"


@dataclass(slots=True)
class Statistics:
    """Counts of a link since it was made.

    Attributes
    ----------
    sent, received
        Messages handed to the transport; messages handed to the caller.
    dropped, expired
        Not sent: not connected; could not go out in time.
    late, overflowed
        Not delivered: older than their expiry; dropped as the oldest of a full queue.
    repeated, refused, retained
        Not delivered: duplicates and overtaken messages; damaged, forged or of another
        conversation; kept by a broker from before.
    opened, failures, reconnects
        Connections made; attempts that failed; connections made after the first.
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
    """Times and sizes of a link; both ends should have the same.

    Parameters
    ----------
    period
        Time between heartbeats, in s.
    deadline
        Silence after which the other end counts as gone, in s; at least twice the period.
        The plant's lease to a cluster is 3 s, so the default leaves half of it.
    capacity
        Received messages that may wait for the caller; beyond it the oldest is dropped.
    largest
        Size limit of a message, in bytes.
    horizon
        Longest time to an expiry that is accepted, in s.
    open_limit
        Time limit for making a connection, in s.
    first_pause, longest_pause
        Pauses between attempts to connect, in s: doubled each time, and drawn between half and all
        of that, so that the clusters of a field do not reconnect in step.

    Raises
    ------
    InputError
        Values that contradict each other.
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
                f"link: a deadline of {self.deadline} s with heartbeats every {self.period} s; it "
                "must be at least twice the period, so that one may be lost"
            )
        if not 0.0 < self.first_pause <= self.longest_pause < math.inf:
            raise InputError(
                f"link: pauses of {self.first_pause} s to {self.longest_pause} s between attempts; "
                "the first must be above 0 and not above the longest"
            )
        if self.capacity < 1 or self.largest < 1 or not 0.0 < self.horizon <= 4000.0:
            raise InputError(
                f"link: capacity {self.capacity}, largest message {self.largest} bytes, horizon "
                f"{self.horizon} s: give at least 1, 1, and 0 to 4000 s"
            )


class Link(Protocol):
    """One end of a link; see the docstring of this module for its guarantees.

    ``run`` belongs in a TaskGroup of the owner (or use `running`); it ends when the link is
    closed. ``receive`` has one caller at a time.
    """

    @property
    def name(self) -> str:
        """Name of the other end."""
        ...

    @property
    def connected(self) -> bool:
        """Whether the other end was alive, and heard this end, within the deadline."""
        ...

    @property
    def closed(self) -> bool:
        """Whether the link is closed for good."""
        ...

    @property
    def silent_for(self) -> float:
        """Time since the other end was certainly alive, in s; infinite if it never was."""
        ...

    @property
    def problem(self) -> str:
        """Why the link is not connected; empty while it is."""
        ...

    @property
    def statistics(self) -> Statistics:
        """Counts since the link was made."""
        ...

    async def run(self) -> None:
        """Keep the link connected until it is closed."""
        ...

    async def send(
        self, data: bytes, *, expires: float | None = None, hold: bool = False
    ) -> SendOutcome:
        """Send a message by ``expires`` of the monotonic clock, or not at all."""
        ...

    async def receive(self) -> bytes:
        """Wait for the next message."""
        ...

    async def close(self) -> None:
        """Close the link for good."""
        ...


class Bus(Protocol):
    """A bus whose only master is this side: it sends a frame and reads the answer."""

    @property
    def connected(self) -> bool:
        """Whether the port is open; only answers show which nodes are alive."""
        ...

    @property
    def closed(self) -> bool:
        """Whether the bus is closed for good."""
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
        """Send a frame and return the answer; empty without one."""
        ...

    async def transmit(
        self, frame: bytes, *, expires: float | None = None, urgent: bool = False
    ) -> SendOutcome:
        """Send a frame that is not answered."""
        ...

    async def close(self) -> None:
        """Close the bus for good."""
        ...


# -- parts -----------------------------------------------------------------------------


class Backoff:
    """Random pauses between attempts, doubled each time up to a limit.

    Parameters
    ----------
    first, longest
        In s.
    chance
        Draws between half of a pause and all of it.
    """

    def __init__(self, first: float, longest: float, chance: random.Random) -> None:
        self._first = first
        self._longest = longest
        self._chance = chance
        self._pause = first

    def reset(self) -> None:
        """Begin again with the first pause, after a success."""
        self._pause = self._first

    def next(self) -> float:
        """Return the next pause in s."""
        pause = self._pause
        self._pause = min(self._longest, 2.0 * pause)
        return pause * self._chance.uniform(0.5, 1.0)


class Heartbeat:
    """A steady rhythm of sending, and a record of the other side's silence.

    Parameters
    ----------
    clock
        Its monotonic time decides.
    period, deadline
        Time between beats, and limit of silence, in s.
    """

    def __init__(self, clock: Clock, period: float, deadline: float) -> None:
        self._clock = clock
        self._period = period
        self._deadline = deadline
        self._heard = -math.inf
        self._now = asyncio.Event()

    def heard(self, at: float | None = None) -> None:
        """Note that the other side was alive, now or at an instant of the clock.

        Time never goes back here: news older than the latest renews nothing.
        """
        now = self._clock.monotonic()
        self._heard = max(self._heard, now if at is None else min(at, now))

    @property
    def silent_for(self) -> float:
        """Time since the other side was alive, in s; infinite if it never was."""
        return self._clock.monotonic() - self._heard

    @property
    def alive(self) -> bool:
        """Whether the other side was alive within the deadline."""
        return self.silent_for <= self._deadline

    def prompt(self) -> None:
        """Beat at once, and continue the rhythm from there."""
        self._now.set()

    async def run(self, beat: Callable[[], Awaitable[object]]) -> None:
        """Call ``beat`` every period until cancelled; missed beats are not made up."""
        while True:
            self._now.clear()
            due = self._clock.monotonic() + self._period
            await beat()
            # Not a timeout, which cancels the task twice a second: a field has hundreds of links.
            remaining = max(1e-6, due - self._clock.monotonic())
            alarm = asyncio.get_running_loop().call_later(remaining, self._now.set)
            try:
                await self._now.wait()
            finally:
                alarm.cancel()


class Inbox:
    """Received messages not yet taken: a bounded queue in which nothing outlives its expiry."""

    def __init__(self, clock: Clock, capacity: int, statistics: Statistics) -> None:
        self._clock = clock
        self._capacity = capacity
        self._statistics = statistics
        self._items: deque[tuple[bytes, float]] = deque()
        self._news = asyncio.Event()
        self._closed = False

    def put(self, data: bytes, expires: float) -> None:
        """Add a message; if the box is full, its oldest is dropped and counted."""
        if len(self._items) >= self._capacity:
            self._items.popleft()
            self._statistics.overflowed += 1
        self._items.append((data, expires))
        self._news.set()

    def close(self) -> None:
        """Wake the task that waits."""
        self._closed = True
        self._news.set()

    async def get(self) -> bytes:
        """Wait for a message.

        Raises
        ------
        LinkClosedError
            When the box is closed; messages left in it are not delivered.
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
    """Yield a link's messages one after the other, until it is closed."""
    with contextlib.suppress(LinkClosedError):
        while True:
            yield await link.receive()


async def until_closed(closing: asyncio.Event, *parts: Coroutine[Any, Any, None]) -> None:
    """Run parts side by side until an event is set, then cancel them; if one fails, all end."""
    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(part) for part in parts]
        await closing.wait()
        for task in tasks:
            task.cancel()


async def first_of(*parts: Coroutine[Any, Any, object]) -> None:
    """Run parts side by side until one is done, then cancel the others; raise what it raises."""
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
    """Something that is run and closed: a `Link`, a `Bus`, a server."""

    async def run(self) -> None:
        """Run until closed."""
        ...

    async def close(self) -> None:
        """End ``run``."""
        ...


@contextlib.asynccontextmanager
async def running(*parts: Runnable) -> AsyncIterator[None]:
    """Run links, buses and servers during a block, and close them together at its end."""
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
