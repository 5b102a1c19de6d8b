"""The only link implementation: it connects, sends heartbeats, supervises and reconnects."""

import asyncio
import contextlib
import math
import random
import secrets
from collections.abc import Coroutine
from typing import Protocol

from heliotrope.errors import InputError
from heliotrope.links.clock import Clock, sleep_until
from heliotrope.links.envelope import Conversation, SealKeys
from heliotrope.links.link import (
    Backoff,
    Heartbeat,
    Inbox,
    LinkClosedError,
    LinkError,
    LinkLostError,
    LinkSettings,
    SendOutcome,
    Statistics,
    until_closed,
)


class Carrier(Protocol):
    """A transport for envelopes, which a `CarriedLink` opens and closes repeatedly.

    A carrier raises only `LinkLostError` and OSError (and LinkError while opening).
    """

    async def open(self) -> SealKeys:
        """Connect and return the keys of this connection.

        The call is cancelled if it takes too long.
        """
        ...

    async def ready(self) -> None:
        """Wait until the next write would be sent at once."""
        ...

    async def write(self, envelope: bytes, lifetime: float | None) -> None:
        """Hand an envelope to the transport, which may discard it after ``lifetime`` s."""
        ...

    async def read(self) -> bytes:
        """Wait for the next envelope."""
        ...

    async def close(self) -> None:
        """Disconnect at once; data not yet sent is discarded."""
        ...


class CarriedLink:
    """A `Link` over a carrier.

    Parameters
    ----------
    name
        Name of the other end, for display.
    carrier
        Carrier, used by this link only.
    clock
        Clock whose monotonic time is used for all decisions and for expiries.
    settings
        See `LinkSettings`.
    statistics
        Counters to use if the carrier counts too.
    seed
        Seed of the pauses and of the session numbers, for simulation; None to use the system's
        random numbers.
    patient
        Whether the carrier waits for the other end to connect, without a time limit and pauses.
    """

    def __init__(
        self,
        name: str,
        carrier: Carrier,
        clock: Clock,
        settings: LinkSettings | None = None,
        statistics: Statistics | None = None,
        seed: int | None = None,
        *,
        patient: bool = False,
    ) -> None:
        self._name = name
        self._carrier = carrier
        self._clock = clock
        self._settings = settings or LinkSettings()
        self._statistics = statistics or Statistics()
        chance = random.Random(seed)
        entropy = secrets.token_bytes if seed is None else chance.randbytes
        self._talk = Conversation(clock, self._settings, self._statistics, entropy)
        self._heart = Heartbeat(clock, self._settings.period, self._settings.deadline)
        self._inbox = Inbox(clock, self._settings.capacity, self._statistics)
        self._backoff = Backoff(self._settings.first_pause, self._settings.longest_pause, chance)
        self._sending = asyncio.Lock()
        self._up = asyncio.Event()
        self._closing = asyncio.Event()
        self._patient = patient
        self._open = False
        self._running = False
        self._problem = "not connected yet"

    @property
    def name(self) -> str:
        """Name of the other end."""
        return self._name

    @property
    def connected(self) -> bool:
        """Whether, within the deadline, the other end was alive and had received from this end."""
        return self.lasts > 0.0

    @property
    def lasts(self) -> float:
        """Time until the connection ends unless something is received, s; 0 if not connected."""
        if not self._open:
            return 0.0
        return max(0.0, self._until(-math.inf) - self._clock.monotonic())

    def _until(self, opened: float) -> float:
        """Return the time at which the connection ends unless something is received."""
        # The other end reports what it has received with its own heartbeat, up to a period later.
        heard = max(opened, self._talk.heard_at) + self._settings.period
        return min(max(opened, self._talk.alive_at), heard) + self._settings.deadline

    @property
    def behind(self) -> bool:
        """Whether the link is connected but the other end has not yet used the new key."""
        return self.connected and self._talk.behind

    @property
    def closed(self) -> bool:
        """Whether the link is closed permanently."""
        return self._closing.is_set()

    @property
    def silent_for(self) -> float:
        """Time since the other end was last known to be alive, s; infinite if it never was."""
        return self._heart.silent_for

    @property
    def problem(self) -> str:
        """Reason why the link is not connected; empty while it is connected."""
        return "" if self.connected else self._problem

    @property
    def statistics(self) -> Statistics:
        """Counts since the link was created."""
        return self._statistics

    async def close(self) -> None:
        """Close the link permanently: waiting messages are dropped, and ``run`` returns."""
        self._closing.set()
        self._inbox.close()
        self._up.set()
        self._problem = "closed"

    async def receive(self) -> bytes:
        """Wait for the next message.

        Raises
        ------
        LinkClosedError
            If the link is closed.
        """
        return await self._inbox.get()

    async def established(self) -> None:
        """Wait until the link is connected.

        Raises
        ------
        LinkClosedError
            If the link is closed.
        """
        while not self.connected:
            if self.closed:
                raise LinkClosedError(f"link to {self._name}: it is closed")
            self._up.clear()
            await self._up.wait()

    async def send(
        self, data: bytes, *, expires: float | None = None, hold: bool = False
    ) -> SendOutcome:
        """Send a message.

        Parameters
        ----------
        data
            At most `LinkSettings.largest` bytes.
        expires
            Time on the monotonic clock by which the message must be delivered; otherwise it is
            discarded. Every motion command has an expiry. If None, the message does not expire, but
            is not held either.
        hold
            Whether to wait for a connection until the message expires. A message is held only if
            the caller requests this, and only while the caller waits; there is no queue.

        Raises
        ------
        InputError
            If a message is too large, is held without an expiry, or expires too far ahead.
        LinkClosedError
            If the link is closed.
        """
        self._check(data, expires, hold)
        # After the deadline the connection is lost, so waiting longer is useless.
        patience = self._settings.deadline
        if expires is not None:
            patience = max(0.0, expires - self._clock.monotonic())
        try:
            async with asyncio.timeout(patience):
                if hold:
                    await self.established()
                async with self._sending:
                    return await self._send_now(data, expires)
        except TimeoutError:
            self._statistics.expired += 1
            return SendOutcome.EXPIRED
        except (LinkLostError, OSError):
            self._statistics.dropped += 1
            return SendOutcome.DISCONNECTED

    def _check(self, data: bytes, expires: float | None, hold: bool) -> None:
        if self.closed:
            raise LinkClosedError(f"link to {self._name}: it is closed")
        if len(data) > self._settings.largest:
            raise InputError(
                f"link to {self._name}: a message of {len(data)} bytes; at most "
                f"{self._settings.largest} are sent"
            )
        if expires is None:
            if hold:
                raise InputError(f"link to {self._name}: only a message with an expiry can be held")
            return
        ahead = expires - self._clock.monotonic()
        if not ahead <= self._settings.horizon:
            raise InputError(
                f"link to {self._name}: an expiry {ahead:.0f} s ahead is above the horizon of "
                f"{self._settings.horizon:.0f} s; expiries are in s of the monotonic clock"
            )

    async def _send_now(self, data: bytes, expires: float | None) -> SendOutcome:
        if not self.connected:
            raise LinkLostError(self._problem)
        await self._carrier.ready()
        envelope = self._talk.data(data, expires)
        lifetime = None if expires is None else expires - self._clock.monotonic()
        await self._carrier.write(envelope, lifetime)
        self._statistics.sent += 1
        return SendOutcome.SENT

    async def run(self) -> None:
        """Keep the link connected until it is closed.

        Raises
        ------
        LinkError
            If the link is already running.
        """
        if self._running:
            raise LinkError(f"link to {self._name}: it is already running")
        self._running = True
        try:
            await until_closed(self._closing, self._keep())
        finally:
            self._running = False

    async def _keep(self) -> None:
        while True:
            try:
                async with asyncio.timeout(None if self._patient else self._settings.open_limit):
                    keys = await self._carrier.open()
            except TimeoutError:
                self._failed(f"no connection within {self._settings.open_limit:g} s")
            except (LinkError, OSError) as error:
                self._failed(str(error) or type(error).__name__)
            else:
                await self._converse(keys)
            await asyncio.sleep(0.0 if self._patient else self._backoff.next())

    def _failed(self, problem: str) -> None:
        self._statistics.failures += 1
        self._problem = problem

    async def _converse(self, keys: SealKeys) -> None:
        self._statistics.opened += 1
        self._statistics.reconnects = self._statistics.opened - 1
        self._talk.restart(keys)
        lost = asyncio.Event()
        parts = (self._read(), self._heart.run(self._beat), self._watch(self._clock.monotonic()))
        self._open = True
        try:
            async with asyncio.TaskGroup() as group:
                tasks = [group.create_task(self._until_lost(part, lost)) for part in parts]
                await lost.wait()
                for task in tasks:
                    task.cancel()
        finally:
            self._open = False
            await self._carrier.close()

    async def _until_lost(self, part: Coroutine[None, None, None], lost: asyncio.Event) -> None:
        # It raises nothing, because a TaskGroup that fails at the instant of its cancellation loses
        # the cancellation (before Python 3.13), and the link would not close.
        try:
            await part
        except (LinkLostError, OSError) as error:
            if not lost.is_set():
                self._problem = str(error) or type(error).__name__
            lost.set()

    async def _read(self) -> None:
        while True:
            arrival, prompt = self._talk.feed(await self._carrier.read())
            if self._talk.alive_at > -math.inf:
                self._heart.heard(self._talk.alive_at)
            if arrival is not None:
                self._inbox.put(*arrival)
            if prompt:
                self._heart.prompt()
            if self.connected:
                self._backoff.reset()
                self._up.set()

    async def _beat(self) -> None:
        # A heartbeat that cannot be sent within a period is skipped; supervision ends such a
        # connection.
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self._settings.period), self._sending:
                await self._carrier.ready()
                for envelope in self._talk.beats():
                    await self._carrier.write(envelope, self._settings.deadline)

    async def _watch(self, opened: float) -> None:
        while (until := self._until(opened)) > self._clock.monotonic():
            await sleep_until(self._clock, until)
        limit = f"for {self._settings.deadline:g} s"
        if self._talk.alive_at + self._settings.deadline > self._clock.monotonic():
            raise LinkLostError(f"the other end has not heard us {limit}")
        raise LinkLostError(f"no heartbeat from the other end {limit}")
