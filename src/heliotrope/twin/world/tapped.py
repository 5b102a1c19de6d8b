"""A link with a listener: it hears all traffic of the link's owner, and can freeze the owner."""

import asyncio
from typing import Protocol

from heliotrope.links.clock import Clock
from heliotrope.links.link import Link, SendOutcome, Statistics


class Listener(Protocol):
    """Listener at one end of a link."""

    def posted(self, data: bytes, now: float) -> None:
        """Note a message that the owner hands to the link, whether or not it is delivered."""
        ...

    def sent(self, data: bytes, now: float) -> None:
        """Note a message that has left, and when it was handed to the transport."""
        ...

    def received(self, data: bytes, now: float) -> None:
        """Note a message that the owner receives."""
        ...


class TappedLink:
    """A `links.link.Link` with a listener.

    Parameters
    ----------
    inner
        The link itself.
    clock
        True time.
    listener
        Told of every message.

    Attributes
    ----------
    inner
        Messages sent through it directly bypass the listener.
    """

    def __init__(self, inner: Link, clock: Clock, listener: Listener) -> None:
        self.inner = inner
        self._clock, self._listener = clock, listener
        self._goes = asyncio.Event()
        self._goes.set()

    def hang(self, *, on: bool) -> None:
        """Freeze the owner's program, or let it go on, while the connection stays up."""
        if on:
            self._goes.clear()
        else:
            self._goes.set()

    @property
    def name(self) -> str:
        """Name of the other end."""
        return self.inner.name

    @property
    def connected(self) -> bool:
        """Whether the link is connected."""
        return self.inner.connected

    @property
    def closed(self) -> bool:
        """Whether the link is closed for good."""
        return self.inner.closed

    @property
    def silent_for(self) -> float:
        """Time since the other end was last known to be alive, s."""
        return self.inner.silent_for

    @property
    def problem(self) -> str:
        """Why the link is not connected, "" if it is."""
        return self.inner.problem

    @property
    def statistics(self) -> Statistics:
        """Counts since the link was made."""
        return self.inner.statistics

    async def run(self) -> None:
        """Keep the link connected until it is closed."""
        await self.inner.run()

    async def send(
        self, data: bytes, *, expires: float | None = None, hold: bool = False
    ) -> SendOutcome:
        """Send a message; see `links.link.Link`."""
        self._listener.posted(data, self._clock.monotonic())
        await self._goes.wait()
        begin = self._clock.monotonic()
        outcome = await self.inner.send(data, expires=expires, hold=hold)
        if outcome is SendOutcome.SENT and (expires is None or begin < expires):
            self._listener.sent(data, begin)
        return outcome

    async def receive(self) -> bytes:
        """Wait for the next message."""
        await self._goes.wait()
        data = await self.inner.receive()
        self._listener.received(data, self._clock.monotonic())
        return data

    async def close(self) -> None:
        """Close the link for good."""
        await self.inner.close()
