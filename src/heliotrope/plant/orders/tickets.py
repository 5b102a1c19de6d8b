"""The progress of an accepted command, heliostat by heliostat; it can be awaited."""

import asyncio
import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from heliotrope.links.clock import Clock, sleep_until
from heliotrope.links.messages import Stage
from heliotrope.plant.refusals import by_reason

#: Waiting in the plant, then the stages in order; stages from FINAL on are final.
WAITING = 0
RANK = {
    Stage.ACCEPTED: 1,
    Stage.SENT: 2,
    Stage.ACKNOWLEDGED: 3,
    Stage.DONE: 4,
    Stage.REFUSED: 5,
    Stage.FAILED: 6,
}
FINAL = RANK[Stage.DONE]
_STAGES = {value: stage for stage, value in RANK.items()}


class Ticket:
    """One accepted command.

    Attributes
    ----------
    identity
        Identity of its audit record.
    name, heliostats
        The command and its heliostats.
    refusals
        Reasons why it was refused or failed, by heliostat.
    blocked
        The subset of these reasons for which the plant has not sent the command.
    steps
        What each heliostat of an operation is doing or waiting for now, or its result; empty for a
        command.
    accepted_at
        When the command was accepted, monotonic s.
    recorded
        Whether its record was on disk before it was sent; False for DEFOCUS and STOW.
    sent
        Whether a message with the command has left the plant.
    """

    def __init__(
        self, identity: str, name: str, heliostats: Sequence[str], clock: Clock, patience: float
    ) -> None:
        self.identity, self.name, self.heliostats = identity, name, tuple(heliostats)
        self.refusals: dict[str, str] = {}
        self.blocked: dict[str, str] = {}
        self.steps: dict[str, str] = {}
        self.accepted_at, self.recorded, self.sent = clock.monotonic(), False, False
        self._clock = clock
        self._row = {name: i for i, name in enumerate(self.heliostats)}
        self._stage = np.full(len(self.heliostats), WAITING, dtype=np.int8)
        #: Deadline of each heliostat at its present stage, monotonic s.
        self._until = np.full(len(self.heliostats), math.inf)
        self._patience = patience
        self._news = asyncio.Event()

    def record(self) -> None:
        """Note that the record of the command is on disk."""
        self.recorded = True
        self._news.set()

    def __repr__(self) -> str:
        return f"<Ticket {self.identity} {self.text}>"

    def advance(self, heliostats: Iterable[str], stage: Stage, text: str = "") -> None:
        """Note a stage that heliostats have reached.

        A stage never goes back, and a final stage never changes.
        """
        rank = RANK[stage]
        rows = [self._row[name] for name in heliostats if name in self._row]
        if not rows:
            return
        index = np.array(rows, dtype=np.intp)
        index = index[(self._stage[index] < FINAL) & (self._stage[index] < rank)]
        self._stage[index] = rank
        if stage is Stage.ACKNOWLEDGED:
            self._until[index] = self._clock.monotonic() + self._patience
        if text or rank > FINAL:
            for i in index:
                self.refusals[self.heliostats[i]] = text or stage.value
        if index.size:
            self._news.set()

    def step(self, texts: Mapping[str, str], stage: Stage | None) -> None:
        """Note what heliostats do or wait for, by name, and their stage.

        If the stage is None, it stays unchanged.
        """
        self.steps.update(texts)
        if stage is None:
            return
        self.advance(texts, stage)
        if RANK[stage] > FINAL:
            self.refusals.update(texts)

    def block(self, refusals: Mapping[str, str]) -> None:
        """End the ticket for heliostats that are not sent the command, each with its reason."""
        self.blocked.update(refusals)
        for name, text in refusals.items():
            self.advance((name,), Stage.REFUSED, text)

    def expect(self, heliostats: Iterable[str], until: float) -> None:
        """Set the deadline (monotonic s) for heliostats to acknowledge."""
        rows = [self._row[name] for name in heliostats if name in self._row]
        self._until[np.array(rows, dtype=np.intp)] = until

    def expire(self, now: float) -> None:
        """End the ticket for heliostats that have not replied in time."""
        late = np.flatnonzero((self._stage < FINAL) & (now >= self._until))
        for i in late:
            acknowledged = self._stage[i] == RANK[Stage.ACKNOWLEDGED]
            text = (
                f"acknowledged, but not completed within {self._patience:.0f} s"
                if acknowledged
                else "no reply before the command expired"
            )
            self.advance([self.heliostats[i]], Stage.FAILED, text)

    def waiting(self, heliostats: Iterable[str]) -> tuple[str, ...]:
        """Return which of some heliostats have not ended."""
        return tuple(name for name in heliostats if self._stage[self._row[name]] < FINAL)

    def unacknowledged(self) -> tuple[str, ...]:
        """Return the heliostats that have neither acknowledged nor ended."""
        rows = np.flatnonzero(self._stage < RANK[Stage.ACKNOWLEDGED])
        return tuple(self.heliostats[i] for i in rows)

    @property
    def finished(self) -> bool:
        """Whether the command has ended for every heliostat."""
        return bool((self._stage >= FINAL).all())

    @property
    def good(self) -> bool:
        """Whether every heliostat is done."""
        return bool((self._stage == FINAL).all())

    def stage(self, heliostat: str) -> Stage | None:
        """Return the stage of one heliostat; None while it waits in the plant."""
        return _STAGES.get(int(self._stage[self._row[heliostat]]))

    def counted(self) -> dict[str, int]:
        """Return the number of heliostats at each stage; "waiting" means queued in the plant."""
        found = np.bincount(self._stage, minlength=FINAL + 3)
        words = ("waiting", *(stage.value for stage in RANK))
        return {word: int(n) for word, n in zip(words, found, strict=True) if n}

    @property
    def text(self) -> str:
        """In one line: the number of heliostats at each stage, and the most frequent reasons."""
        parts = ", ".join(f"{n} {word}" for word, n in self.counted().items())
        left = self.waiting(self.steps)
        # Results of completed heliostats are listed only if there is nothing else to report.
        why = by_reason((self.refusals | {n: self.steps[n] for n in left}) or self.steps)
        return f"{self.name}: {parts}" + (f" ({why})" if why else "")

    async def reached(self, stage: Stage, timeout: float = math.inf) -> bool:
        """Wait until every heliostat is at a stage or has ended.

        Return False if a heliostat ended without reaching the stage.

        Parameters
        ----------
        stage
            ACCEPTED to DONE.
        timeout
            Longest wait, s, by the plant's clock; when it expires, False is returned.
        """
        until = self._clock.monotonic() + timeout
        while not (self._stage >= RANK[stage]).all():
            self._news.clear()
            if math.isinf(until):
                await self._news.wait()
            elif not await _within(self._clock, until, self._news):
                return False
        return bool((self._stage <= FINAL).all())

    async def written(self, timeout: float) -> bool:
        """Wait until the record is on disk, or the ticket has ended without a record.

        Return whether the record is on disk.

        ``timeout`` is in s, by the plant's clock; when it expires, False is returned.
        """
        until = self._clock.monotonic() + timeout
        while not (self.recorded or self.finished):
            self._news.clear()
            if not await _within(self._clock, until, self._news):
                break
        return self.recorded

    async def end(self, timeout: float = math.inf) -> bool:
        """Wait until every heliostat has ended; return whether all are done."""
        return await self.reached(Stage.DONE, timeout)


async def _within(clock: Clock, until: float, event: asyncio.Event) -> bool:
    """Wait for an event until a given time; return False if the time came first."""
    if clock.monotonic() >= until:
        return False
    try:
        async with asyncio.timeout(max(1e-6, until - clock.monotonic())):
            await event.wait()
    except TimeoutError:
        await sleep_until(clock, until)
        return event.is_set()
    return True
