"""What time it is, how far that may be off, and who says so.

The sun moves 73 µrad in a second, and a mirror that follows the sun of a wrong time misses with its
beam by as much. So a cluster never has a mere time, but a `Time`: with a bound of its error, and
its source.

A time is only told here. Leases, deadlines and expiries rest on `Clock.monotonic` alone, so a
jump, forward or back, extends nothing; it is detected against the monotonic clock (`Steadiness`)
and reported.
"""

import asyncio
import ctypes
import math
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal, Protocol

from heliotrope.errors import InputError, TimeError
from heliotrope.links.clock import GPS_EPOCH, Clock, gps_seconds, sleep_until

Quality = Literal["gps", "system", "holdover", "none"]

#: No time before this is believed: a computer without a battery for its clock starts in the past.
NOT_BEFORE = datetime(2026, 1, 1, tzinfo=UTC)
#: What adjtimex(2) returns for a clock that is not synchronised.
_TIME_ERROR = 5
#: Where timex has the bound of the clock's error, in longs; in µs.
_MAXERROR = 3
_LONG_AGO_US = 2_000_000
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


def kernel_synchronised() -> bool:
    """Return whether the kernel knows of somebody who keeps its clock right.

    chronyd (with ``rtcsync``, as packaged), ntpd and systemd-timesyncd tell it, at least every
    34 minutes, how far the clock may be off. The kernel adds 0.5 ms to that in each second; above
    2 s, an hour after they have lost their servers, the answer is no.

    Raises
    ------
    InputError
        On a system that cannot be asked.
    """
    ask = getattr(ctypes.CDLL(None, use_errno=True), "adjtimex", None)
    timex = (ctypes.c_long * 128)()  # of zeros it asks and changes nothing; larger than any is
    state = -1 if ask is None else int(ask(timex))
    if state < 0:
        raise InputError("time: this system does not say whether its clock is synchronised")
    return state != _TIME_ERROR and timex[_MAXERROR] < _LONG_AGO_US


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
    synchronised
        Says whether somebody keeps the clock right now: `kernel_synchronised`, where NTP runs.
        While nobody does, the time is of quality "holdover" and its error grows. None: it is not
        asked, and the operator vouches for the clock always.
    drift_ppm
        Of the clock that nobody keeps, at most, in 1e-6.
    largest_error
        Above this error bound, in s, a clock that nobody keeps tells no time.

    Raises
    ------
    InputError
        A bound that is none.
    """

    def __init__(
        self,
        clock: Clock,
        error: float = 0.5,
        settle: float = 10.0,
        tolerance: float = 0.1,
        *,
        synchronised: Callable[[], bool] | None = None,
        drift_ppm: float = 100.0,
        largest_error: float = 1.0,
    ) -> None:
        if not 0.0 < error < math.inf:
            raise InputError(f"time: an error bound of {error} s; it must be above 0")
        if not (0.0 < drift_ppm < math.inf and error <= largest_error < math.inf):
            raise InputError(
                f"time: a drift of {drift_ppm} ppm, a largest error of {largest_error} s; they "
                f"must be above 0, and the largest error not below the error of {error} s"
            )
        self._clock = clock
        self._error = error
        self._synchronised = synchronised
        self._drift = drift_ppm * 1e-6
        self._largest = largest_error
        self._kept_at = -math.inf
        self._steadiness = Steadiness(clock, tolerance, settle)
        self._closing = asyncio.Event()

    @property
    def jumps(self) -> int:
        """How often the clock was set since this was made."""
        return self._steadiness.jumps

    def time(self) -> Time:
        """Return the time; of quality "none" before `NOT_BEFORE`, or if it was alone too long."""
        utc = self._clock.utc()
        jumped = self._steadiness.see(utc.timestamp())
        now = self._clock.monotonic()
        quality: Quality = "system"
        if self._synchronised is None or self._synchronised():
            self._kept_at = now
        else:
            quality = "holdover"
        error = self._error + self._drift * (now - self._kept_at)
        if utc < NOT_BEFORE or (quality == "holdover" and error > self._largest):
            error, quality = math.inf, "none"
        return Time(utc.timestamp(), _gps(utc), error, quality, jumped)

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
