"""What time it is, how far that may be off, and who says so.

The sun moves 73 µrad in a second, and a mirror that follows the sun of a wrong time misses with its
beam by as much. So a cluster never has a mere time, but a `Time`: with a bound of its error, and
its source.

A time is only told here. Leases, deadlines and expiries rest on `Clock.monotonic` alone, so a
jump, forward or back, extends nothing; it is detected against the monotonic clock (`Steadiness`)
and reported.
"""

import asyncio
import math
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal, Protocol

from heliotrope.control.clock import GPS_EPOCH, Clock, gps_seconds, sleep_until
from heliotrope.errors import InputError, TimeError

Quality = Literal["gps", "system", "holdover", "none"]

#: No time before this is believed: a computer without a battery for its clock starts in the past.
NOT_BEFORE = datetime(2026, 1, 1, tzinfo=UTC)
#: Two oscillators are believed to run alike within this: twice what NTP slews at most.
_SLEW = 1e-3


@dataclass(frozen=True)
class Time:
    """A time and what is known of it.

    Attributes
    ----------
    utc_s
        POSIX seconds.
    gps_s
        Seconds of the GPS scale since 6 January 1980, which no leap second bends.
    error
        Bound of both, in s; infinite if there is none.
    quality
        "gps": a receiver with a fix; "holdover": it had one, and the oscillator has carried its
        time on since; "system": this computer's clock; "none": nothing to rely on.
    jumped
        It was set, forward or back, within the last seconds: what was reckoned with the times
        before does not fit the times after.
    """

    utc_s: float
    gps_s: float
    error: float
    quality: Quality
    jumped: bool


class TimeKeeper(Protocol):
    """What a cluster has its time from.

    ``run`` belongs into a TaskGroup of the owner (or use `link.running`); it ends when the keeper
    is closed. ``time`` may be called at any instant, before ``run`` and after ``close`` too.
    """

    def time(self) -> Time:
        """Return the time now."""
        ...

    async def run(self) -> None:
        """Keep it until closed."""
        ...

    async def close(self) -> None:
        """End ``run``."""
        ...


class Steadiness:
    """Tells whether a time was set, by comparing it with the monotonic clock.

    Parameters
    ----------
    clock
        Its monotonic time is the measure.
    tolerance
        A step up to this, in s, is no jump. Slewing (up to 1 ms in a second) never is.
    settle
        How long a jump is told, in s.

    Raises
    ------
    InputError
        A tolerance or a duration that is not above 0.
    """

    def __init__(self, clock: Clock, tolerance: float, settle: float) -> None:
        for name, value in (("tolerance", tolerance), ("duration of a jump", settle)):
            if not 0.0 < value < math.inf:
                raise InputError(f"time: a {name} of {value} s; it must be above 0")
        self._clock = clock
        self._tolerance = tolerance
        self._settle = settle
        self._offset: float | None = None
        self._at = -math.inf
        self._jumped_at = -math.inf
        self.jumps = 0

    def see(self, seconds: float) -> bool:
        """Note a time in s that is now, and return whether it jumped within ``settle``."""
        now = self._clock.monotonic()
        offset = seconds - now
        if self._offset is None:
            self._offset = offset
        step = offset - self._offset
        if abs(step) > self._tolerance + _SLEW * (now - self._at):
            self._jumped_at = now
            self.jumps += 1
            self._offset = offset
        else:
            # The reference follows no faster than a clock is slewed, so that many small steps
            # add up to a jump.
            most = _SLEW * (now - self._at)
            self._offset += max(-most, min(most, step))
        self._at = now
        return now - self._jumped_at < self._settle


class SystemTime:
    """The time of this computer, for clusters without a receiver and for simulation.

    Parameters
    ----------
    clock
        Its ``utc`` is told, its ``monotonic`` is the measure of jumps.
    error
        What the operator vouches for, in s: with NTP in the plant's own network 0.1 s is wide.
    settle
        How long a jump is told, in s.
    tolerance
        A step up to this, in s, is no jump.

    Raises
    ------
    InputError
        A bound that is none.
    """

    def __init__(
        self, clock: Clock, error: float = 0.5, settle: float = 10.0, tolerance: float = 0.1
    ) -> None:
        if not 0.0 < error < math.inf:
            raise InputError(f"time: an error bound of {error} s; it must be above 0")
        self._clock = clock
        self._error = error
        self._steadiness = Steadiness(clock, tolerance, settle)
        self._closing = asyncio.Event()

    @property
    def jumps(self) -> int:
        """How often the clock was set since this was made."""
        return self._steadiness.jumps

    def time(self) -> Time:
        """Return the time; of quality "none" if the clock is before `NOT_BEFORE`."""
        utc = self._clock.utc()
        jumped = self._steadiness.see(utc.timestamp())
        if utc < NOT_BEFORE:
            return Time(utc.timestamp(), _gps(utc), math.inf, "none", jumped)
        return Time(utc.timestamp(), _gps(utc), self._error, "system", jumped)

    async def run(self) -> None:
        """Look at the clock each second, so that no jump there and back is missed for long."""
        while not self._closing.is_set():
            self.time()
            due = self._clock.monotonic() + 1.0
            try:
                async with asyncio.timeout(1.0):
                    await self._closing.wait()
            except TimeoutError:
                await sleep_until(self._clock, due)

    async def close(self) -> None:
        """End ``run``."""
        self._closing.set()


def _gps(utc: datetime) -> float:
    try:
        return gps_seconds(utc)
    except TimeError:  # before the scale began: a clock that was never set
        return (utc - GPS_EPOCH).total_seconds()
