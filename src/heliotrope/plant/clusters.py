"""The plant's end of one cluster: what is posted to it, in what order, and what became of it."""

import asyncio
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from heliotrope.links.clock import Clock
from heliotrope.links.link import Link, LinkClosedError, Outcome
from heliotrope.links.messages import Message, encode


@dataclass(frozen=True)
class _Post:
    data: bytes
    expires: float | None
    told: Callable[[Outcome], None] | None


class ClusterEnd:
    """One cluster, as the plant sees it.

    Nothing that is posted waits for a connection: what cannot go out now comes back at once.
    Urgent messages pass all others that have not begun.

    Attributes
    ----------
    name, members
        Of the cluster; its heliostats.
    link
        To it.
    act
        Strongest emergency act that it was told to carry out as a whole, and that still holds;
        -1 if none.
    greeted
        Number of the connection that it was greeted in last.
    asked_at
        When it was asked for the names of its rows last, monotonic s.
    """

    def __init__(self, name: str, members: tuple[str, ...], link: Link, clock: Clock) -> None:
        self.name, self.members, self.link = name, members, link
        self.act = -1
        self.greeted = -1
        self.asked_at = -math.inf
        self._clock = clock
        self._urgent: deque[_Post] = deque()
        self._normal: deque[_Post] = deque()
        self._news = (asyncio.Event(), asyncio.Event())

    def post(
        self,
        message: Message,
        lifetime: float | None,
        told: Callable[[Outcome], None] | None = None,
        *,
        urgent: bool = False,
    ) -> None:
        """Send a message as soon as may be, within ``lifetime`` s (None: at once or never)."""
        expires = None if lifetime is None else self._clock.monotonic() + lifetime
        box = self._urgent if urgent else self._normal
        box.append(_Post(encode(message), expires, told))
        self._news[not urgent].set()

    async def deliver(self, *, urgent: bool) -> None:
        """Send what is posted, until the link is closed."""
        box, news = (self._urgent if urgent else self._normal), self._news[not urgent]
        while not self.link.closed:
            while box:
                post = box.popleft()
                try:
                    outcome = await self.link.send(post.data, expires=post.expires)
                except LinkClosedError:
                    outcome = Outcome.DISCONNECTED
                if post.told is not None:
                    post.told(outcome)
            news.clear()
            await news.wait()
