"""Clocks that drift and jump, and times that come and go: what a cluster is told in simulation."""

import asyncio
from collections.abc import Callable
from datetime import datetime

from heliotrope.cluster.timekeeping import Quality, Time
from heliotrope.errors import InputError
from heliotrope.lcu import ticks
from heliotrope.links.clock import Clock, VirtualClock, gps_seconds, utc_of_gps

#: How long a jump is told, s.
SETTLE = 5.0


class SimulatedTime:
    """A `TimeKeeper` that tells a true time, with faults that may be set at any moment.

    Parameters
    ----------
    clock
        Its ``monotonic`` says how much time has passed; its ``utc`` at the start is the truth.
    error
        Bound that it tells while nothing is wrong, in s.

    Attributes
    ----------
    offset
        By how much the told time is wrong, in s; set by `jump`.
    detects
        Whether a jump is told as one; a keeper that hides jumps is the worse fault.
    quality
        What it tells of its source; "none" comes with no bound.
    """

    def __init__(self, clock: Clock, error: float = 0.05) -> None:
        if not error >= 0.0:
            raise InputError(f"simulated time: a bound of {error} s; it must not be negative")
        self._clock = clock
        self._begin = clock.monotonic()
        self._gps = gps_seconds(clock.utc())
        self._error = error
        self._jumped_at = -1e9
        self._closing = asyncio.Event()
        self.offset = 0.0
        self.detects = True
        self.quality: Quality = "gps"

    def jump(self, seconds: float) -> None:
        """Set the told time forward, or back."""
        self.offset += seconds
        self._jumped_at = self._clock.monotonic()

    @property
    def true_gps(self) -> float:
        """GPS seconds as they are."""
        return self._gps + self._clock.monotonic() - self._begin

    def time(self) -> Time:
        """Return the time as it is told."""
        now = self._clock.monotonic()
        gps = self.true_gps + self.offset
        error = self._error if self.quality != "none" else float("inf")
        jumped = self.detects and now - self._jumped_at < SETTLE
        return Time(utc_of_gps(gps).timestamp(), gps, error, self.quality, jumped)

    async def run(self) -> None:
        """Wait until it is closed: it has nothing to do."""
        await self._closing.wait()

    async def close(self) -> None:
        """End ``run``."""
        self._closing.set()


class DriftingClock:
    """A computer's clocks: an oscillator that is off, and a calendar that may be set.

    Parameters
    ----------
    source
        Gives true monotonic seconds.
    start
        UTC at the moment of making.
    drift
        By how much it runs fast, ratio: 50e-6 is a poor quartz.
    """

    def __init__(self, source: Callable[[], float], start: datetime, drift: float = 0.0) -> None:
        if not abs(drift) < 0.5:
            raise InputError(f"drifting clock: a drift of {drift}; give less than 0.5, as 50e-6")
        self._inner = VirtualClock(source, start, rate=1.0 + drift)

    def monotonic(self) -> float:
        """Return its own seconds: they never go back, and know no jumps."""
        return self._inner.monotonic()

    def utc(self) -> datetime:
        """Return what it takes for UTC."""
        return self._inner.utc()

    def jump(self, seconds: float) -> None:
        """Set the calendar forward, or back."""
        self._inner.jump(seconds)


class TickCounter:
    """The millisecond counter of a board: it drifts, wraps, and may jump.

    Parameters
    ----------
    start
        Count at the true time 0; near ``ticks.PERIOD`` it soon wraps.
    drift
        Ratio.
    """

    def __init__(self, start: int = 0, drift: float = 0.0) -> None:
        self._start = start
        self._rate = 1.0 + drift
        self._jumped = 0

    def at(self, seconds: float) -> int:
        """Return the count at a true time in s."""
        return ticks.add(self._start, int(1000.0 * self._rate * seconds) + self._jumped)

    def jump(self, milliseconds: int) -> None:
        """Set the counter forward or back, as a glitch of its oscillator would."""
        self._jumped += milliseconds
