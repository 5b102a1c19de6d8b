"""Links within one process, with seeded faults; the default link, also used by the twin.

The two ends exchange the same envelopes as over a network, so heartbeats, expiry and reconnection
behave as in reality. Messages in transit are kept in a heap ordered by arrival time, so the order
of the event loop's callbacks does not affect the order of messages.
"""

import asyncio
import heapq
import itertools
import random
from dataclasses import dataclass

from heliotrope.errors import InputError
from heliotrope.links.clock import Clock
from heliotrope.links.connection import CarriedLink
from heliotrope.links.envelope import SealKeys
from heliotrope.links.link import LinkError, LinkLostError, LinkSettings


@dataclass(frozen=True)
class Faults:
    """Faults that a line applies to envelopes.

    Parameters
    ----------
    loss, duplication, reordering, corruption
        Probabilities, 0 to 1, that an envelope is lost, arrives twice, arrives after a later
        envelope, or has one bit inverted.
    delay
        Shortest and longest time in transit, in s.

    Raises
    ------
    InputError
        If a probability is outside 0 to 1, or a delay is negative or reversed.
    """

    loss: float = 0.0
    duplication: float = 0.0
    reordering: float = 0.0
    corruption: float = 0.0
    delay: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("loss", "duplication", "reordering", "corruption"):
            value = getattr(self, name)
            if not 0.0 <= value <= 1.0:
                raise InputError(
                    f"faults: the probability of {name} must be between 0 and 1, not {value}"
                )
        low, high = self.delay
        if not 0.0 <= low <= high < float("inf"):
            raise InputError(
                f"faults: a delay of {low} to {high} s; pass the shortest and the longest delay, "
                "neither negative"
            )


class _Lane:
    """One direction of a line."""

    def __init__(self, clock: Clock, chance: random.Random) -> None:
        self.clock = clock
        self.cut = False
        self.news = asyncio.Event()
        self._chance = chance
        self._under_way: list[tuple[float, int, bytes]] = []
        self._number = itertools.count()
        self._last = 0.0

    def put(self, envelope: bytes, faults: Faults) -> None:
        if self.cut or self._happens(faults.loss):
            return
        for _ in range(2 if self._happens(faults.duplication) else 1):
            due = self.clock.monotonic() + self._chance.uniform(*faults.delay)
            if not self._happens(faults.reordering):
                due = self._last = max(due, self._last)
            item = self._damaged(envelope) if self._happens(faults.corruption) else envelope
            heapq.heappush(self._under_way, (due, next(self._number), item))
        self.news.set()

    def _happens(self, chance: float) -> bool:
        return chance > 0.0 and self._chance.random() < chance

    def _damaged(self, envelope: bytes) -> bytes:
        bit = self._chance.randrange(8 * len(envelope))
        damaged = bytearray(envelope)
        damaged[bit // 8] ^= 1 << bit % 8
        return bytes(damaged)

    def take(self) -> bytes | float | None:
        """Return the next envelope, or the time at which it is due; None if there is none."""
        if not self._under_way:
            return None
        due = self._under_way[0][0]
        if due > self.clock.monotonic():
            return due
        return heapq.heappop(self._under_way)[2]

    def clear(self) -> None:
        self._under_way.clear()
        self._last = 0.0


class MemoryLine:
    """A line between two ends, with faults that may be changed while it is in use.

    Parameters
    ----------
    clock
        Clock of the line; the ends may have other clocks.
    faults
        Faults applied to each envelope.
    seed
        Seed of the faults.

    Attributes
    ----------
    faults
        See `Faults`.
    reachable
        Whether a connection can be made; if False, each attempt is refused.
    """

    def __init__(self, clock: Clock, faults: Faults | None = None, seed: int = 0) -> None:
        self.faults = faults or Faults()
        self.reachable = True
        self.generation = 0
        #: The owner of each end; a new one takes it over, as at a broker.
        self.holders: list[object] = [None, None]
        chance = random.Random(seed)
        self.lanes = (
            _Lane(clock, random.Random(chance.random())),
            _Lane(clock, random.Random(chance.random())),
        )

    def cut(self, *, first_to_second: bool = True, second_to_first: bool = True) -> None:
        """Lose all envelopes sent from now on, in one or both directions, without notice."""
        self.lanes[0].cut = first_to_second
        self.lanes[1].cut = second_to_first

    def heal(self) -> None:
        """End a partition; envelopes in transit continue, but lost envelopes stay lost."""
        self.cut(first_to_second=False, second_to_first=False)

    def drop(self) -> None:
        """Break the connection like a reset: both ends notice, and data in transit is lost."""
        self.generation += 1
        for lane in self.lanes:
            lane.clear()
            lane.news.set()

    def end(
        self,
        place: int,
        name: str,
        clock: Clock,
        *,
        settings: LinkSettings | None = None,
        seed: int = 0,
    ) -> CarriedLink:
        """Return a new link at one end, as for a program that restarts there.

        Parameters
        ----------
        place
            The end, 0 or 1. Of several links at one end, the last one to connect owns the line, as
            with a shared client identifier at a broker; the previous owner loses the line and
            reconnects.
        name
            Name of the other end.
        clock
            Clock of this end.
        settings, seed
            As in `memory_pair`.
        """
        return CarriedLink(name, _MemoryCarrier(self, place), clock, settings, seed=seed)


class _MemoryCarrier:
    """One end of a line."""

    def __init__(self, line: MemoryLine, end: int) -> None:
        self._line, self._end = line, end
        self._out, self._in = line.lanes[end], line.lanes[1 - end]
        self._generation = -1

    async def open(self) -> SealKeys:
        """Connect, unless the line refuses the connection."""
        if not self._line.reachable:
            raise LinkError("the line is not reachable")
        self._generation = self._line.generation
        self._line.holders[self._end] = self
        self._in.news.set()  # the previous owner notices
        return lambda: (b"",)

    def _check(self) -> None:
        if self._generation != self._line.generation:
            raise LinkLostError("the line was dropped")
        if self._line.holders[self._end] is not self:
            raise LinkLostError("another program has taken the line over")

    async def ready(self) -> None:
        """Return at once, because there is nothing to wait for."""
        self._check()

    async def write(self, envelope: bytes, lifetime: float | None) -> None:
        """Put an envelope on the line, which ignores the lifetime."""
        del lifetime
        self._check()
        self._out.put(envelope, self._line.faults)

    async def read(self) -> bytes:
        """Wait for the next envelope."""
        while True:
            self._check()
            self._in.news.clear()
            item = self._in.take()
            if isinstance(item, bytes):
                return item
            # At least 1 µs, because a remainder left by rounding would not advance a virtual clock.
            remaining = None if item is None else max(1e-6, item - self._in.clock.monotonic())
            try:
                async with asyncio.timeout(remaining):
                    await self._in.news.wait()
            except TimeoutError:
                continue

    async def close(self) -> None:
        """Disconnect; the other end only notices that nothing arrives."""
        self._generation = -1


def memory_pair(
    clock: Clock,
    *,
    names: tuple[str, str] = ("plant", "cluster"),
    faults: Faults | None = None,
    seed: int = 0,
    settings: LinkSettings | None = None,
    clocks: tuple[Clock, Clock] | None = None,
) -> tuple[CarriedLink, CarriedLink, MemoryLine]:
    """Return both ends of a link within this process, and the line between the ends.

    Parameters
    ----------
    clock
        Clock of the line and, unless ``clocks`` is specified, of both ends.
    names
        Names of the first and the second end; each link bears the name of the end to which it
        leads.
    faults
        Faults of the line; None for a perfect line.
    seed
        Seed of faults, pauses and sessions: the same seed yields the same run.
    settings
        Settings of both ends.
    clocks
        Clocks of the first and the second end, if they differ.
    """
    line = MemoryLine(clock, faults, seed)
    first, second = clocks or (clock, clock)
    return (
        line.end(0, names[1], first, settings=settings, seed=2 * seed + 1),
        line.end(1, names[0], second, settings=settings, seed=2 * seed + 2),
        line,
    )
