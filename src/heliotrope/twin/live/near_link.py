"""A link between plant and cluster within one process, without delay or loss.

For whole fields: with hundreds of clusters, the heartbeats of real links would cost more than all
other work. `links.in_process` simulates the effects of a real line on messages.
"""

import asyncio
from collections import deque

from heliotrope.links.clock import Clock
from heliotrope.links.link import LinkClosedError, SendOutcome, Statistics

#: Largest number of messages waiting at an end; beyond it the oldest is dropped, as at any link.
_CAPACITY = 256


class NearLink:
    """One end of the link; a `links.link.Link`.

    Attributes
    ----------
    name
        Name of the other end.
    plugged
        Whether this end is plugged in; unplug it to cut the line.
    other
        The other end.
    """

    def __init__(self, name: str, clock: Clock) -> None:
        self.name, self.statistics, self.plugged = name, Statistics(), True
        self._clock = clock
        self.other: NearLink | None = None
        self._waiting: deque[tuple[bytes, float | None]] = deque(maxlen=_CAPACITY)
        self._news, self._closing = asyncio.Event(), asyncio.Event()
        self._was = False

    @property
    def connected(self) -> bool:
        """Whether both ends are present."""
        other = self.other
        present = not self.closed and other is not None and not other.closed
        now = present and self.plugged and other is not None and other.plugged
        if now and not self._was:
            self.statistics.opened += 1
        self._was = now
        return now

    @property
    def closed(self) -> bool:
        """Whether the link is closed permanently."""
        return self._closing.is_set()

    @property
    def silent_for(self) -> float:
        """Return how long the other end has been silent, s: always 0 while connected."""
        return 0.0 if self.connected else float("inf")

    @property
    def problem(self) -> str:
        """Reason why the link is not connected."""
        return "" if self.connected else "the line is cut"

    async def run(self) -> None:
        """Wait until the link is closed."""
        await self._closing.wait()

    async def send(
        self, data: bytes, *, expires: float | None = None, hold: bool = False
    ) -> SendOutcome:
        """Deliver a message to the other end."""
        del hold
        if self.closed:
            raise LinkClosedError(f"link to {self.name}: it is closed")
        if expires is not None and self._clock.monotonic() >= expires:
            self.statistics.expired += 1
            return SendOutcome.EXPIRED
        if not self.connected or self.other is None:
            self.statistics.dropped += 1
            return SendOutcome.DISCONNECTED
        self.other.take(data, expires)
        self.statistics.sent += 1
        return SendOutcome.SENT

    def take(self, data: bytes, expires: float | None) -> None:
        """Receive a message from the other end."""
        self._waiting.append((data, expires))
        self._news.set()

    async def receive(self) -> bytes:
        """Wait for the next unexpired message and return it."""
        while True:
            while self._waiting:
                data, expires = self._waiting.popleft()
                if expires is None or self._clock.monotonic() < expires:
                    self.statistics.received += 1
                    self.statistics.last_received = self._clock.monotonic()
                    return data
                self.statistics.late += 1
            if self.closed:
                raise LinkClosedError(f"link to {self.name}: it is closed")
            self._news.clear()
            await self._news.wait()

    async def close(self) -> None:
        """Close the link permanently."""
        self._closing.set()
        self._news.set()


def near_pair(clock: Clock, names: tuple[str, str]) -> tuple[NearLink, NearLink]:
    """Return the two ends of a link.

    The first end bears the second name, because each end is named after the other side.
    """
    first, second = NearLink(names[1], clock), NearLink(names[0], clock)
    first.other, second.other = second, first
    return first, second
