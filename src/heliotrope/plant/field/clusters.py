"""The plant's ends of the links to clusters: messages sent, leases, queries and replies."""

import asyncio
import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from heliotrope.links.clock import Clock, sleep_until
from heliotrope.links.link import Link, LinkClosedError, SendOutcome, received
from heliotrope.links.messages import (
    Answer,
    Ask,
    Lease,
    Message,
    ProtocolError,
    decode,
    encode,
)
from heliotrope.plant.settings import Counters

#: A query is sent within this time or not at all, and its reply is awaited for this long, s.
QUESTION_LIFE, ANSWER_PATIENCE = 5.0, 60.0


@dataclass(frozen=True)
class _Post:
    message: Message | Callable[[], Message | None]
    expires: float | None
    report: Callable[[SendOutcome], None] | None


class ClusterEnd:
    """The plant's end of the link to one cluster.

    A posted message does not wait for a connection. If it cannot be sent now, its outcome says so
    at once. Urgent messages are sent before all other waiting messages.

    Attributes
    ----------
    name, members
        Name of the cluster; names of its heliostats.
    link
        Link to the cluster.
    """

    def __init__(self, name: str, members: tuple[str, ...], link: Link, clock: Clock) -> None:
        self.name, self.members, self.link = name, members, link
        self._clock = clock
        self._greeted = -1
        self._urgent: deque[_Post] = deque()
        self._normal: deque[_Post] = deque()
        self._news = (asyncio.Event(), asyncio.Event())

    def post(
        self,
        message: Message | Callable[[], Message | None],
        lifetime: float | None,
        report: Callable[[SendOutcome], None] | None = None,
        *,
        urgent: bool = False,
    ) -> None:
        """Send a message as soon as possible, within ``lifetime`` s.

        If ``lifetime`` is None, the message is sent at once or not at all.

        If ``message`` is a function, it creates the message when its turn comes; if it returns
        None, nothing is sent.
        """
        expires = None if lifetime is None else self._clock.monotonic() + lifetime
        box = self._urgent if urgent else self._normal
        box.append(_Post(message, expires, report))
        self._news[not urgent].set()

    async def deliver(self, *, urgent: bool) -> None:
        """Send the posted messages, until the link is closed."""
        box, news = (self._urgent if urgent else self._normal), self._news[not urgent]
        while not self.link.closed:
            while box:
                post = box.popleft()
                message = post.message() if callable(post.message) else post.message
                try:
                    outcome = (
                        SendOutcome.EXPIRED
                        if message is None
                        else await self.link.send(encode(message), expires=post.expires)
                    )
                except LinkClosedError:
                    outcome = SendOutcome.DISCONNECTED
                if post.report is not None:
                    post.report(outcome)
            news.clear()
            await news.wait()

    async def keep(
        self, lease: Callable[[], Lease], period: float, greet: Callable[["ClusterEnd"], None]
    ) -> None:
        """Renew the plant's lease every ``period`` s; greet the cluster on each new connection."""
        while True:
            due = self._clock.monotonic() + period
            opened = self.link.statistics.opened
            if self.link.connected:
                if self._greeted != opened:
                    self._greeted = opened
                    greet(self)
                # A lease counts from its arrival, so a late lease must not arrive at all.
                self.post(lease(), period, urgent=True)
            await sleep_until(self._clock, due)


class Clusters:
    """All clusters of a plant.

    Parameters
    ----------
    members
        Names of the heliostats, by name of the cluster.
    links
        Links, by name of the cluster.
    clock
        Clock of the plant.
    counters
        Counters of refused messages.

    Attributes
    ----------
    ends
        Ends of the links, by name of the cluster.
    """

    def __init__(
        self,
        members: Mapping[str, Sequence[str]],
        links: Mapping[str, Link],
        clock: Clock,
        counters: Counters,
    ) -> None:
        self.ends = {
            name: ClusterEnd(name, tuple(members[name]), links[name], clock) for name in members
        }
        self._clock, self._counters = clock, counters
        self._home = {name: end for end in self.ends.values() for name in end.members}
        self._numbers = 0
        self._awaited: dict[str, tuple[float, Callable[[Answer], None]]] = {}

    def __len__(self) -> int:
        return len(self._home)

    def home(self, heliostat: str) -> ClusterEnd:
        """Return the cluster of a heliostat."""
        return self._home[heliostat]

    def connection(self, cluster: str) -> int:
        """Return the number of times the link to a cluster has been opened."""
        return self.ends[cluster].link.statistics.opened

    def parts(self, heliostats: Iterable[str]) -> list[tuple[ClusterEnd, tuple[str, ...]]]:
        """Return heliostats grouped by cluster."""
        members: dict[str, list[str]] = {}
        for name in heliostats:
            members.setdefault(self._home[name].name, []).append(name)
        return [(self.ends[cluster], tuple(names)) for cluster, names in members.items()]

    def connected(self, heliostats: Iterable[str]) -> list[str]:
        """Return the heliostats whose clusters are connected."""
        return [name for name in heliostats if self._home[name].link.connected]

    async def hear(
        self, end: ClusterEnd, take: Callable[[ClusterEnd, Message, float], None]
    ) -> None:
        """Pass on each message of a cluster, until its link is closed."""
        async for data in received(end.link):
            now = self._clock.monotonic()
            try:
                take(end, decode(data), now)
            except ProtocolError as error:
                self._counters.refused += 1
                self._counters.problems.append(f"cluster {end.name}: {error}")

    def number(self, what: str) -> str:
        """Return a new identity for a query or an acknowledgement."""
        self._numbers += 1
        return f"{what}-{self._numbers}"

    def ask(
        self,
        end: ClusterEnd,
        what: str,
        take: Callable[[Answer], None],
        heliostat: str = "",
        patience: float = ANSWER_PATIENCE,
    ) -> None:
        """Send a query to a cluster.

        ``take`` is called with the reply, if one arrives within ``patience`` s.
        """
        now = self._clock.monotonic()
        self._awaited = {i: a for i, a in self._awaited.items() if now < a[0]}
        identity = self.number(what)
        self._awaited[identity] = now + patience, take
        end.post(Ask(identity, what, heliostat), QUESTION_LIFE)

    async def answer(
        self, cluster: str, what: str, timeout: float, heliostat: str = ""
    ) -> Answer | None:
        """Query a cluster and return its reply; None if none arrives within ``timeout`` s."""
        future: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()

        def take(answer: Answer) -> None:
            if not future.done():
                future.set_result(answer)

        self.ask(self.ends[cluster], what, take, heliostat)
        try:
            async with asyncio.timeout(timeout):
                return await future
        except TimeoutError:
            return None

    def take_answer(self, answer: Answer) -> None:
        """Pass a reply to the part that sent the query.

        Raises
        ------
        ProtocolError
            If the reply cannot be parsed.
        """
        _, take = self._awaited.pop(answer.identity, (math.nan, None))
        if take is not None:
            take(answer)
