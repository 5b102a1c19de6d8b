"""Recording of bus frames at the plant's request, for a limited time and number of frames.

`RecordedBus` sits between the cluster and its port. It adds no delay and writes no file: each frame
costs one list entry during a recording, and nothing otherwise.
"""

import struct
from collections.abc import Callable

from heliotrope.links.clock import Clock
from heliotrope.links.link import Bus, SendOutcome
from heliotrope.links.messages import BUS_ENTRY, BUS_RECEIVED, BUS_SENT

#: Limits of a recording: its duration, s, its number of entries, and its size, bytes, because a
#: message on a link has at most 64 KiB.
LONGEST, MOST, LARGEST = 5.0, 500, 48 * 1024


class RecordedBus:
    """A bus whose frames can be recorded.

    Parameters
    ----------
    bus
        The port; its owner runs it.
    clock
        Clock that supplies the times of the entries.
    """

    def __init__(self, bus: Bus, clock: Clock) -> None:
        self._bus, self._clock = bus, clock
        self._began: float | None = None
        self._utc_s = 0.0
        self._entries: list[bytes] = []
        self._size = 0
        self._full = ""

    # -- the record ------------------------------------------------------------------------

    @property
    def recording(self) -> bool:
        """Whether a recording has begun and has not yet been collected."""
        return self._began is not None

    @property
    def complete(self) -> bool:
        """Whether a recording has reached its limit of time, entries or size."""
        if self._began is None:
            return False
        return bool(self._full) or self._clock.monotonic() - self._began >= LONGEST

    def record(self) -> None:
        """Begin a recording."""
        self._began, self._utc_s = self._clock.monotonic(), self._clock.utc().timestamp()
        self._entries, self._size, self._full = [], 0, ""

    def taken(self) -> tuple[float, str, bytes]:
        """End the recording; return its start (POSIX s), its reason for ending, and its entries."""
        record = self._utc_s, self._full or f"{LONGEST:g} s are over", b"".join(self._entries)
        self._began, self._entries = None, []
        return record

    def _keep(self, direction: int, data: bytes, at: float) -> None:
        if self._began is None or self.complete or not data:
            return
        entry = struct.pack(BUS_ENTRY, at - self._began, direction, len(data)) + data
        if len(self._entries) == MOST or self._size + len(entry) > LARGEST:
            self._full = f"{MOST} entries or {LARGEST >> 10} KiB are full"
            return
        self._entries.append(entry)
        self._size += len(entry)

    # -- the bus ---------------------------------------------------------------------------

    @property
    def connected(self) -> bool:
        """Whether the port is open."""
        return self._bus.connected

    @property
    def closed(self) -> bool:
        """Whether the bus is closed permanently."""
        return self._bus.closed

    async def run(self) -> None:
        """Keep the port open until the bus is closed."""
        await self._bus.run()

    async def close(self) -> None:
        """Close the bus permanently."""
        await self._bus.close()

    async def transmit(
        self, frame: bytes, *, expires: float | None = None, urgent: bool = False
    ) -> SendOutcome:
        """Send a frame that expects no reply; see `SerialBus.transmit`."""
        begin = self._clock.monotonic()
        outcome = await self._bus.transmit(frame, expires=expires, urgent=urgent)
        if outcome is SendOutcome.SENT:
            self._keep(BUS_SENT, frame, begin)
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
        """Send a frame and return the reply; see `SerialBus.transact`."""
        self._keep(BUS_SENT, frame, self._clock.monotonic())
        answer = await self._bus.transact(
            frame, timeout, expires=expires, urgent=urgent, complete=complete
        )
        self._keep(BUS_RECEIVED, answer, self._clock.monotonic())
        return answer
