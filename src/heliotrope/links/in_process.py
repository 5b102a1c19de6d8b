"""Links within one process, with faults drawn by a seed: the default, and the twin's.

The two ends speak the same envelopes as over a network, so heartbeats, expiry and reconnection
are the real ones. Messages that are under way lie in a heap ordered by the time at which they
are due, so the order of the event loop's callbacks does not alter theirs.
"""

import asyncio
import heapq
import itertools
import random
from dataclasses import dataclass

from heliotrope.errors import InputError
from heliotrope.links.clock import Clock
from heliotrope.links.connection import CarriedLink
from heliotrope.links.link import LinkError, LinkLostError, LinkSettings


@dataclass(frozen=True)
class Faults:
    """What a line does to the envelopes on it.

    Parameters
    ----------
    loss, duplication, reordering, corruption
        Chances, 0 to 1, for each envelope: to be lost; to come twice; to be overtaken; to have
        one bit inverted.
    delay
        Shortest and longest time under way, in s.

    Raises
    ------
    InputError
        A chance outside 0 to 1, or a negative or reversed delay.
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
                raise InputError(f"faults: a chance of {name} of {value}; give 0 to 1")
        low, high = self.delay
        if not 0.0 <= low <= high < float("inf"):
            raise InputError(
                f"faults: a delay of {low} to {high} s; give the shortest and the longest time, "
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
        """Return the next envelope, or when it is due, or None."""
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
    """A line between two ends, and its faults, which may be changed while it is used.

    Parameters
    ----------
    clock
        Of the line; the ends may have other ones.
    faults
        What happens to each envelope.
    seed
        Of the faults.

    Attributes
    ----------
    faults
        See `Faults`.
    reachable
        Whether a connection can be made; False refuses each attempt.
    """

    def __init__(self, clock: Clock, faults: Faults | None = None, seed: int = 0) -> None:
        self.faults = faults or Faults()
        self.reachable = True
        self.generation = 0
        chance = random.Random(seed)
        self.lanes = (
            _Lane(clock, random.Random(chance.random())),
            _Lane(clock, random.Random(chance.random())),
        )

    def cut(self, *, first_to_second: bool = True, second_to_first: bool = True) -> None:
        """Lose all that is sent from now on, in one direction or both; nobody is told."""
        self.lanes[0].cut = first_to_second
        self.lanes[1].cut = second_to_first

    def heal(self) -> None:
        """End a partition; what is under way goes on, what was lost stays lost."""
        self.cut(first_to_second=False, second_to_first=False)

    def drop(self) -> None:
        """Break the connection as a reset does: both ends notice, what is under way is lost."""
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
        """Return a new link at one end, as for a program that starts there anew.

        Parameters
        ----------
        place
            0 or 1. What was at that end before must have ended.
        name
            Whom it leads to.
        clock
            Of this end.
        settings, seed
            As of `memory_pair`.
        """
        return CarriedLink(name, _MemoryCarrier(self, place), clock, settings, seed=seed)


class _MemoryCarrier:
    """One end of a line."""

    def __init__(self, line: MemoryLine, end: int) -> None:
        self._line = line
        self._out, self._in = line.lanes[end], line.lanes[1 - end]
        self._generation = -1

    async def open(self) -> bytes:
        """Connect, unless the line refuses."""
        if not self._line.reachable:
            raise LinkError("the line is not reachable")
        self._generation = self._line.generation
        return b""

    def _check(self) -> None:
        if self._generation != self._line.generation:
            raise LinkLostError("the line was dropped")

    async def ready(self) -> None:
        """Nothing to wait for."""
        self._check()

    async def write(self, envelope: bytes, lifetime: float | None, *, confirmed: bool) -> None:
        """Put an envelope on its way; a line knows neither lifetimes nor confirmations."""
        del lifetime, confirmed
        self._check()
        self._out.put(envelope, self._line.faults)

    async def read(self) -> bytes:
        """Wait until an envelope has come through."""
        while True:
            self._check()
            self._in.news.clear()
            item = self._in.take()
            if isinstance(item, bytes):
                return item
            # At least a microsecond: what rounding leaves over would not move a virtual clock.
            left = None if item is None else max(1e-6, item - self._in.clock.monotonic())
            try:
                async with asyncio.timeout(left):
                    await self._in.news.wait()
            except TimeoutError:
                continue

    async def close(self) -> None:
        """Leave; the other end hears nothing of it but silence."""
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
    """Return both ends of a link within this process, and the line between them.

    Parameters
    ----------
    clock
        Of the line and, unless ``clocks`` are given, of both ends.
    names
        Of the first and of the second end; each link is called after where it leads.
    faults
        None: a perfect line.
    seed
        Of the faults, the pauses and the sessions: the same seed gives the same run.
    settings
        Of both ends.
    clocks
        Of the first and of the second end, if they differ.
    """
    line = MemoryLine(clock, faults, seed)
    first, second = clocks or (clock, clock)
    return (
        line.end(0, names[1], first, settings=settings, seed=2 * seed + 1),
        line.end(1, names[0], second, settings=settings, seed=2 * seed + 2),
        line,
    )
