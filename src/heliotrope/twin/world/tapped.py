"""A link that somebody listens to: what its owner sends and hears, and what hangs with him."""

import asyncio
from typing import Protocol

from heliotrope.links.clock import Clock
from heliotrope.links.link import Link, Outcome, Statistics


class Listener(Protocol):
    """Who listens at one end of a link."""

    def posted(self, data: bytes, now: float) -> None:
        """Note what the owner hands to the link, whatever becomes of it."""
        ...

    def sent(self, data: bytes, now: float) -> None:
        """Note what has gone out, and when it was handed to the transport."""
        ...

    def received(self, data: bytes, now: float) -> None:
        """Note what the owner is told."""
        ...


class TappedLink:
    """A `control.link.Link` with a listener.

    Parameters
    ----------
    inner
        The link itself.
    clock
        True time.
    listener
        Is told of every message.

    Attributes
    ----------
    inner
        As given: what is sent by it goes past the listener.
    """

    def __init__(self, inner: Link, clock: Clock, listener: Listener) -> None:
        self.inner = inner
        self._clock, self._listener = clock, listener
        self._goes = asyncio.Event()
        self._goes.set()

    def hang(self, *, on: bool) -> None:
        """Let the owner's program stand still, while the connection lives on."""
        if on:
            self._goes.clear()
        else:
            self._goes.set()

    @property
    def name(self) -> str:
        """Whom it leads to."""
        return self.inner.name

    @property
    def connected(self) -> bool:
        """Whether the other end is there."""
        return self.inner.connected

    @property
    def closed(self) -> bool:
        """Whether it was closed for good."""
        return self.inner.closed

    @property
    def silent_for(self) -> float:
        """How long ago the other end was surely alive, s."""
        return self.inner.silent_for

    @property
    def problem(self) -> str:
        """Why it is not connected, "" if it is."""
        return self.inner.problem

    @property
    def statistics(self) -> Statistics:
        """Counts since it was made."""
        return self.inner.statistics

    async def run(self) -> None:
        """Keep the link connected until it is closed."""
        await self.inner.run()

    async def send(
        self, data: bytes, *, expires: float | None = None, hold: bool = False
    ) -> Outcome:
        """Send a message; see `control.link.Link`."""
        self._listener.posted(data, self._clock.monotonic())
        await self._goes.wait()
        begin = self._clock.monotonic()
        outcome = await self.inner.send(data, expires=expires, hold=hold)
        if outcome is Outcome.SENT and (expires is None or begin < expires):
            self._listener.sent(data, begin)
        return outcome

    async def receive(self) -> bytes:
        """Wait for the next message."""
        await self._goes.wait()
        data = await self.inner.receive()
        self._listener.received(data, self._clock.monotonic())
        return data

    async def close(self) -> None:
        """Close it for good."""
        await self.inner.close()
