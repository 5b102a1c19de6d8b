"""An event loop whose time runs at a chosen speed, and waits for late timers.

Loop time is wall time times the speed, but it never passes a timer that has not fired. Where the
machine is too slow for the speed, or stands still for a while, simulated time slows down instead of
jumping over leases and deadlines; `PacedLoop.lag` tells by how much.
"""

import asyncio
import selectors
import time
from collections.abc import Callable

from heliotrope.errors import InputError

#: Loop time that timers may be late by before the loop's time is held back, s.
LATE = 0.25
#: Wall time until a loop looks again whether its speed has changed, s.
_STILL = 0.05
#: Loop time that passes in one turn while callbacks are always ready, s.
_BUSY = 0.005


class _Pace(selectors.DefaultSelector):
    """Waits for files and for wall time, and advances the loop's time."""

    def __init__(self, speed: float, start: float, wall: Callable[[], float]) -> None:
        super().__init__()
        self.speed, self.now, self.lag = speed, start, 0.0
        self.wall, self._begin, self._start = wall, wall(), start

    def _target(self) -> float:
        return self._start + self.speed * (self.wall() - self._begin) - self.lag

    def change(self, speed: float) -> None:
        """Go on from now at another speed; 0 stands still, and files are still served."""
        self.speed, self._begin, self._start = speed, self.wall(), self.now + self.lag

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout is None:
            events = super().select(None)
            self.now = max(self.now, self._target())
            return events
        due = self.now + max(timeout, 0.0)
        if timeout <= 0.0:
            wait = 0.0
        else:
            wait = max(0.0, due - self._target()) / self.speed if self.speed > 0.0 else _STILL
        events = super().select(wait)
        most = due if timeout > 0.0 else self.now + _BUSY
        target = self._target()
        if target - most > LATE:
            self.lag += target - most - LATE
        self.now = max(self.now, min(target, most))
        return list(events)


class PacedLoop(asyncio.SelectorEventLoop):
    """An event loop at a chosen speed; sockets and threads work as in any loop.

    Parameters
    ----------
    speed
        Loop seconds per second of wall time, above 0 to 1000.
    start
        First value of `time`, s.
    wall
        Gives wall time, s.

    Raises
    ------
    InputError
        A speed out of range.
    """

    def __init__(
        self,
        speed: float = 1.0,
        start: float = 1000.0,
        wall: Callable[[], float] = time.monotonic,
    ) -> None:
        if not 0.0 < speed <= 1000.0:
            self._closed = True  # BaseEventLoop.__del__ asks for it
            raise InputError(f"speed {speed}: give above 0 to 1000 simulated seconds per second")
        self._pace = _Pace(speed, start, wall)
        super().__init__(self._pace)

    def time(self) -> float:
        """Return the loop's time, s."""
        return self._pace.now

    @property
    def speed(self) -> float:
        """Loop seconds per second of wall time, if the machine keeps up; 0 stands still."""
        return self._pace.speed

    @speed.setter
    def speed(self, speed: float) -> None:
        self._pace.change(speed)

    @property
    def lag(self) -> float:
        """Delay of the loop behind its speed, s of loop time."""
        return self._pace.lag
