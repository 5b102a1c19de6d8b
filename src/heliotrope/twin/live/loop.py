"""An event loop whose time runs at a chosen speed and waits for late timers.

Loop time is wall time times the speed, but it never passes a timer that has not fired. If the
computer is too slow for the speed, or stops for a while, simulated time slows down instead of
jumping over leases and deadlines; `PacedLoop.lag` states by how much. Loop time does not pass
`PacedLoop.until` either, which lets one program wait for another.
"""

import asyncio
import math
import selectors
import time
from collections.abc import Callable

from heliotrope.errors import InputError

#: Loop time by which timers may be late before the loop's time is held back, s.
LATE = 0.25
#: Wall time between checks whether the speed has changed, s.
_STILL = 0.05
#: Loop time that passes per iteration while callbacks are always ready, s.
_BUSY = 0.005


class _Pace(selectors.DefaultSelector):
    """Waits for files and for wall time, and advances the loop's time."""

    def __init__(self, speed: float, start: float, wall: Callable[[], float]) -> None:
        super().__init__()
        self.speed, self.now, self.lag, self.until = speed, start, 0.0, math.inf
        self.wall, self._begin, self._start = wall, wall(), start

    def _target(self) -> float:
        return self._start + self.speed * (self.wall() - self._begin) - self.lag

    def change(self, speed: float) -> None:
        """Continue at another speed from now on.

        At speed 0, loop time stands still but files are still served.
        """
        self.speed, self._begin, self._start = speed, self.wall(), self.now + self.lag

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout is None:
            events = super().select(None)
            self._advance(math.inf)
            return events
        due = self.now + max(timeout, 0.0)
        if timeout <= 0.0:
            wait = 0.0
        elif self.speed > 0.0 and due <= self.until:
            wait = max(0.0, due - self._target()) / self.speed
        else:
            wait = _STILL
        events = super().select(wait)
        self._advance(due if timeout > 0.0 else self.now + _BUSY)
        return list(events)

    def _advance(self, most: float) -> None:
        """Advance the loop time, but not beyond the next timer (``most``) nor beyond `until`."""
        target = self._target()
        self.lag += max(0.0, target - most - LATE, target - max(self.until, self.now))
        self.now = max(self.now, min(target, most, self.until))


class PacedLoop(asyncio.SelectorEventLoop):
    """An event loop at a chosen speed; sockets and threads work as in any event loop.

    Parameters
    ----------
    speed
        Loop seconds per second of wall time, above 0 and up to 1000.
    start
        First value of `time`, s.
    wall
        Function that returns wall time, s.

    Raises
    ------
    InputError
        If the speed is out of range.
    """

    def __init__(
        self,
        speed: float = 1.0,
        start: float = 1000.0,
        wall: Callable[[], float] = time.monotonic,
    ) -> None:
        if not 0.0 < speed <= 1000.0:
            self._closed = True  # BaseEventLoop.__del__ reads it
            raise InputError(
                f"speed must be above 0 and at most 1000 simulated seconds per second, not {speed}"
            )
        self._pace = _Pace(speed, start, wall)
        super().__init__(self._pace)

    def time(self) -> float:
        """Return the loop's time, s."""
        return self._pace.now

    @property
    def speed(self) -> float:
        """Loop seconds per second of wall time if the computer keeps up; 0 stops the loop time."""
        return self._pace.speed

    @speed.setter
    def speed(self, speed: float) -> None:
        self._pace.change(speed)

    @property
    def until(self) -> float:
        """Loop time that must not be passed, s; infinite if there is no limit."""
        return self._pace.until

    @until.setter
    def until(self, until: float) -> None:
        self._pace.until = until

    @property
    def lag(self) -> float:
        """Delay of the loop relative to its speed, s of loop time."""
        return self._pace.lag
