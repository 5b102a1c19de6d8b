"""Clocks that drift and jump, and time sources that fail, for simulated clusters."""

import asyncio
from collections.abc import Callable
from datetime import datetime

from heliotrope.cluster.timekeeping import Quality, Time
from heliotrope.errors import InputError
from heliotrope.lcu import ticks
from heliotrope.links.clock import Clock, VirtualClock, gps_seconds, utc_of_gps

#: How long a jump is reported, s.
SETTLE = 5.0


class SimulatedTime:
    """A `TimeKeeper` with a true time, and faults that may be set at any time.

    Parameters
    ----------
    clock
        Clock whose ``monotonic`` measures the elapsed time, and whose ``utc`` at the start is the
        truth.
    error
        Error bound reported while there is no fault, in s.

    Attributes
    ----------
    offset
        Error of the reported time, in s; set by `jump`.
    detects
        Whether a jump is reported; a time keeper that hides jumps is the worse fault.
    quality
        Reported quality; "none" means that there is no error bound.
    """

    def __init__(self, clock: Clock, error: float = 0.05) -> None:
        if not error >= 0.0:
            raise InputError(f"simulated time: the error bound must be 0 or more, not {error} s")
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
        """Step the reported time forward or back."""
        self.offset += seconds
        self._jumped_at = self._clock.monotonic()

    @property
    def true_gps(self) -> float:
        """True GPS seconds."""
        return self._gps + self._clock.monotonic() - self._begin

    def time(self) -> Time:
        """Return the reported time."""
        now = self._clock.monotonic()
        gps = self.true_gps + self.offset
        error = self._error if self.quality != "none" else float("inf")
        jumped = self.detects and now - self._jumped_at < SETTLE
        return Time(utc_of_gps(gps).timestamp(), gps, error, self.quality, jumped)

    async def run(self) -> None:
        """Wait until closed; there is nothing to do."""
        await self._closing.wait()

    async def close(self) -> None:
        """End ``run``."""
        self._closing.set()


class DriftingClock:
    """A computer's clocks: an inaccurate oscillator, and a calendar clock that can be set.

    Parameters
    ----------
    source
        Function that returns true monotonic seconds.
    start
        UTC when the clock is created.
    drift
        Relative rate error; 50e-6 corresponds to a poor quartz oscillator.
    """

    def __init__(self, source: Callable[[], float], start: datetime, drift: float = 0.0) -> None:
        if not abs(drift) < 0.5:
            raise InputError(
                f"drifting clock: the drift must be below 0.5, such as 50e-6, not {drift}"
            )
        self._inner = VirtualClock(source, start, rate=1.0 + drift)

    def monotonic(self) -> float:
        """Return the seconds of the oscillator, which never runs backwards or jumps."""
        return self._inner.monotonic()

    def utc(self) -> datetime:
        """Return the calendar clock's UTC."""
        return self._inner.utc()

    def jump(self, seconds: float) -> None:
        """Step the calendar clock forward or back."""
        self._inner.jump(seconds)


class TickCounter:
    """The millisecond counter of a board: it drifts, wraps, and may jump.

    Parameters
    ----------
    start
        Count at true time 0; a count near ``ticks.PERIOD`` soon wraps.
    drift
        Relative rate error.
    """

    def __init__(self, start: int = 0, drift: float = 0.0) -> None:
        self._start = start
        self._rate = 1.0 + drift
        self._jumped = 0

    def at(self, seconds: float) -> int:
        """Return the count at a true time in s."""
        return ticks.add(self._start, int(1000.0 * self._rate * seconds) + self._jumped)

    def jump(self, milliseconds: int) -> None:
        """Step the counter forward or back, as a glitch of its oscillator would."""
        self._jumped += milliseconds
