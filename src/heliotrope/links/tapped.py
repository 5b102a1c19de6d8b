"""A link with a listener that sees all messages of the link's owner and may delay them."""

from typing import Protocol

from heliotrope.links.clock import Clock
from heliotrope.links.link import Link, SendOutcome, Statistics


class LinkListener(Protocol):
    """A listener at one end of a link."""

    async def posted(self, data: bytes, now: float) -> None:
        """Record a message that the owner passes to the link.

        The message is sent once this method returns.
        """
        ...

    def sent(self, data: bytes, now: float) -> None:
        """Record a message that has been sent, and when it was passed to the transport."""
        ...

    async def waits(self) -> None:
        """Record that the owner waits for a message.

        The link is read once this method returns.
        """
        ...

    def received(self, data: bytes, now: float) -> None:
        """Record a message that the owner receives."""
        ...


class TappedLink:
    """A `links.link.Link` with a listener.

    Parameters
    ----------
    inner
        The link itself.
    clock
        Clock whose monotonic time is passed to the listener.
    listener
        Called for every message.

    Attributes
    ----------
    inner
        Wrapped link; messages sent through it directly bypass the listener.
    """

    def __init__(self, inner: Link, clock: Clock, listener: LinkListener) -> None:
        self.inner = inner
        self._clock, self._listener = clock, listener

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
        """Whether the link is closed permanently."""
        return self.inner.closed

    @property
    def silent_for(self) -> float:
        """Time since the other end was last known to be alive, s; infinite if it never was."""
        return self.inner.silent_for

    @property
    def problem(self) -> str:
        """Reason why the link is not connected; empty while it is connected."""
        return self.inner.problem

    @property
    def statistics(self) -> Statistics:
        """Counts since the link's creation."""
        return self.inner.statistics

    async def run(self) -> None:
        """Keep the link connected until it is closed."""
        await self.inner.run()

    async def send(
        self, data: bytes, *, expires: float | None = None, hold: bool = False
    ) -> SendOutcome:
        """Send a message; see `links.link.Link`."""
        await self._listener.posted(data, self._clock.monotonic())
        begin = self._clock.monotonic()
        outcome = await self.inner.send(data, expires=expires, hold=hold)
        if outcome is SendOutcome.SENT and (expires is None or begin < expires):
            self._listener.sent(data, begin)
        return outcome

    async def receive(self) -> bytes:
        """Wait for the next message."""
        await self._listener.waits()
        data = await self.inner.receive()
        self._listener.received(data, self._clock.monotonic())
        return data

    async def close(self) -> None:
        """Close the link permanently."""
        await self.inner.close()
