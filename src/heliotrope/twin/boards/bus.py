"""A bus within this process: the cluster at one end, boards or a vectorised field at the other.

The bus implements `links.link.Bus`: it carries one transaction at a time, sends urgent frames next,
and sends no frame after its expiry. Bytes take their transmission time at the baud rate. Faults are
drawn from a seed and may be changed at any time (`BusFaults`). Everything connected to the bus is a
`Station`.
"""

import asyncio
import random
from collections.abc import Callable
from contextvars import Context
from dataclasses import dataclass
from typing import Protocol

from heliotrope.cluster.turns import Turns
from heliotrope.errors import InputError
from heliotrope.links.clock import PROGRAM, Clock
from heliotrope.links.link import LinkClosedError, SendOutcome

#: Start, eight data bits, stop.
_BITS = 10


class Station(Protocol):
    """A device connected to a bus."""

    def hear(self, data: bytes, now: float) -> bytes:
        """Receive bytes at a time in s; return the immediate reply, empty if there is none."""
        ...


class Tap(Protocol):
    """A listener to all traffic that does not affect it."""

    def sent(self, frame: bytes, now: float) -> None:
        """Record bytes that the master sent."""
        ...

    def heard(self, place: int, data: bytes, how: str, now: float) -> None:
        """Record bytes that a station is about to receive.

        ``how`` is "whole", or the name of the fault that affects the bytes.
        """
        ...

    def answered(self, data: bytes, how: str, now: float) -> None:
        """Record bytes that the master receives."""
        ...


@dataclass(frozen=True)
class BusFaults:
    """Faults that the bus applies to frames, separately per direction and per station.

    Parameters
    ----------
    loss, corruption, burst, duplication, late, delay
        Probabilities, 0 to 1: nothing arrives; one bit is inverted; a run of bytes is noise; the
        frame arrives twice; it arrives only when the next frame is sent (out of order, or between
        other frames); a reply is delayed, up to the timeout.
    stuck
        Whether a transmitter blocks the line, so that no device receives anything.

    Raises
    ------
    InputError
        If a probability is outside 0 to 1.
    """

    loss: float = 0.0
    corruption: float = 0.0
    burst: float = 0.0
    duplication: float = 0.0
    late: float = 0.0
    delay: float = 0.0
    stuck: bool = False

    def __post_init__(self) -> None:
        for name in ("loss", "corruption", "burst", "duplication", "late", "delay"):
            value = getattr(self, name)
            if not 0.0 <= value <= 1.0:
                raise InputError(
                    f"bus faults: the probability of {name} must be between 0 and 1, not {value}"
                )

    @property
    def any(self) -> bool:
        """Whether any fault is set."""
        return self.stuck or any(
            (self.loss, self.corruption, self.burst, self.duplication, self.late, self.delay)
        )


def damaged(data: bytes, chance: random.Random, *, burst: bool) -> bytes:
    """Return the bytes with one bit inverted, or with a run of up to eight bytes replaced."""
    out = bytearray(data)
    place = chance.randrange(len(out))
    if not burst:
        out[place] ^= 1 << chance.randrange(8)
        return bytes(out)
    for i in range(place, min(len(out), place + chance.randint(2, 8))):
        out[i] = chance.randrange(256)
    return bytes(out)


class TwinBus:
    """A bus with stations on it.

    Parameters
    ----------
    clock
        Clock of the bus; its monotonic time is also the stations' time.
    stations
        Devices that receive every frame.
    seed
        Seed of the faults.
    baud_rate
        Bits per second; at 0, bytes take no time.
    turn_around
        Time from the end of a frame to the start of the reply, in s.
    tap
        Listens to all traffic.

    Attributes
    ----------
    faults
        See `BusFaults`; may be set at any time.
    plugged
        Whether the port is present; False simulates an unplugged adapter.
    """

    def __init__(
        self,
        clock: Clock,
        stations: "list[Station]",
        *,
        seed: int = 0,
        baud_rate: int = 115200,
        turn_around: float = 0.002,
        tap: Tap | None = None,
    ) -> None:
        self.faults = BusFaults()
        self.plugged = True
        self.stations = stations
        self._clock = clock
        self._chance = random.Random(seed)
        self._per_byte = _BITS / baud_rate if baud_rate else 0.0
        self._turn_around = turn_around if baud_rate else 0.0
        self._tap = tap
        self._turns = Turns()
        self._closing = asyncio.Event()
        self._late: list[tuple[int, bytes]] = []
        self._late_answers: list[bytes] = []

    @property
    def connected(self) -> bool:
        """Whether the port is open."""
        return self.plugged and not self.closed

    @property
    def closed(self) -> bool:
        """Whether the bus is closed permanently."""
        return self._closing.is_set()

    async def run(self) -> None:
        """Keep the port open until the bus is closed."""
        await self._closing.wait()

    async def close(self) -> None:
        """Close the bus permanently."""
        self._closing.set()

    async def transmit(
        self, frame: bytes, *, expires: float | None = None, urgent: bool = False
    ) -> SendOutcome:
        """Send a frame that expects no reply, and wait until it is sent.

        Raises
        ------
        LinkClosedError
            If the bus is closed.
        """
        async with self._turns.turn(urgent=urgent):
            outcome = self._may(expires)
            if outcome is SendOutcome.SENT:
                await self._carried(frame)
            return outcome

    async def transact(
        self,
        frame: bytes,
        timeout: float,
        *,
        expires: float | None = None,
        urgent: bool = False,
        complete: Callable[[bytes], bool] | None = None,
    ) -> bytes:
        """Send a frame and return the reply; empty if none arrives in time.

        Raises
        ------
        InputError
            If the timeout is not above 0.
        LinkClosedError
            If the bus is closed.
        """
        if not timeout > 0.0:
            raise InputError(f"bus: the timeout must be above 0, not {timeout} s")
        async with self._turns.turn(urgent=urgent):
            if self._may(expires) is not SendOutcome.SENT:
                return b""
            answer = await self._carried(frame)
            took = self._turn_around + self._per_byte * len(answer)
            if self._happens(self.faults.delay):
                took = max(took, self._chance.uniform(took, timeout))
            whole = complete(answer) if complete and answer else answer.endswith(b"\0")
            if not answer or took > timeout or not whole:
                # Wait to the end, because a damaged or truncated reply has no terminator.
                await asyncio.sleep(timeout)
                return answer if took <= timeout else b""
            await asyncio.sleep(took)
            return answer

    async def _carried(self, frame: bytes) -> bytes:
        """Carry a frame once its last byte has been sent, and return the stations' replies."""
        if not PROGRAM.get():
            if self._per_byte:
                await asyncio.sleep(self._per_byte * len(frame))
            return self.carry(frame)
        # The port continues to send even if the program that wrote to it is frozen.
        loop = asyncio.get_running_loop()
        done: asyncio.Future[bytes] = loop.create_future()

        def out() -> None:
            if not done.done():
                try:
                    done.set_result(self.carry(frame))
                except Exception as error:  # noqa: BLE001 - it is the sender's
                    done.set_exception(error)

        loop.call_later(self._per_byte * len(frame), out, context=Context())
        return await done

    def _may(self, expires: float | None) -> SendOutcome:
        if self.closed:
            raise LinkClosedError("bus: it is closed")
        if not self.plugged:
            return SendOutcome.DISCONNECTED
        if expires is not None and self._clock.monotonic() >= expires:
            return SendOutcome.EXPIRED
        return SendOutcome.SENT

    # -- the wire --------------------------------------------------------------------------

    def carry(self, frame: bytes) -> bytes:
        """Deliver a frame from the master to all stations now and return their replies."""
        if self._tap is not None:
            self._tap.sent(frame, self._clock.monotonic())
        return self._back(self.inject(frame, late=True))

    def inject(self, frame: bytes, *, how: str = "whole", late: bool = False) -> bytes:
        """Deliver bytes to all stations, from the master or from an intruder; return all replies.

        Parameters
        ----------
        frame
            Bytes to deliver.
        how
            How the tap is told that bytes arrive, if no bus fault affects them.
        late
            Whether delayed bytes arrive now, after ``frame``.
        """
        if self.faults.stuck:
            return b""
        answer = bytearray()
        kept, self._late = (self._late, []) if late else ([], self._late)
        for place in range(len(self.stations)):
            answer += self._bring(place, frame, how)
        for place, old in kept:
            # A reply that arrives between other replies is lost.
            self._hear(place, old, "late")
        return bytes(answer)

    def _bring(self, place: int, frame: bytes, how: str) -> bytes:
        faults = self.faults
        if not faults.any:
            return self._hear(place, frame, how)
        if self._happens(faults.loss):
            return b""
        if self._happens(faults.late):
            self._late.append((place, frame))
            return b""
        if self._happens(faults.corruption):
            return self._hear(place, damaged(frame, self._chance, burst=False), "damaged")
        if self._happens(faults.burst):
            return self._hear(place, damaged(frame, self._chance, burst=True), "damaged")
        answer = self._hear(place, frame, how)
        if self._happens(faults.duplication):
            self._hear(place, frame, "twice")
        return answer

    def _hear(self, place: int, data: bytes, how: str) -> bytes:
        now = self._clock.monotonic()
        if self._tap is not None:
            self._tap.heard(place, data, how, now)
        return self.stations[place].hear(data, now)

    def _back(self, answer: bytes) -> bytes:
        faults, how = self.faults, "whole"
        if faults.any and answer:
            if faults.stuck or self._happens(faults.loss):
                answer = b""
            elif self._happens(faults.late):
                self._late_answers.append(answer)
                answer, how = b"", "late"
            elif self._happens(faults.corruption):
                answer, how = damaged(answer, self._chance, burst=False), "damaged"
            elif self._happens(faults.burst):
                answer, how = damaged(answer, self._chance, burst=True), "damaged"
        elif self._late_answers and answer:
            # A late reply arrives first, as if a node had taken too long.
            answer, how = self._late_answers.pop(0) + answer, "late"
        if self._tap is not None and answer:
            self._tap.answered(answer, how, self._clock.monotonic())
        return answer

    def _happens(self, chance: float) -> bool:
        return chance > 0.0 and self._chance.random() < chance
