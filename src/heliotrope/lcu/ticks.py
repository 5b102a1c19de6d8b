"""Time as a wrapping counter, with the arithmetic of MicroPython's ``ticks_ms``.

Ticks are integers modulo 2^30. A difference is taken the shorter way round, so it lies in [-2^29,
2^29): half the period is 6.2 days in milliseconds, 8.9 minutes in microseconds. MicroPython's own
``ticks_diff`` returns the same numbers; CPython has no such function.
"""

PERIOD = 1 << 30
HALF = PERIOD >> 1


def add(tick: int, delta: int) -> int:
    """Return the tick that is ``delta`` after ``tick``, or before it if ``delta`` is negative."""
    return (tick + delta) & (PERIOD - 1)


def diff(later: int, earlier: int) -> int:
    """Return by how many ticks ``later`` follows ``earlier``; negative if it precedes it."""
    return ((later - earlier + HALF) & (PERIOD - 1)) - HALF


class Deadline:
    """A span of time that ends on time or too early, never too late (invariant 9).

    The deadline stores the time left, not the instant of the end, so it stays right when the
    counter wraps. Every step of the counter between two checks counts with its size, whatever its
    sign, so a jump forwards or backwards can only shorten the span. Once the span is over, it stays
    over until ``start`` is called. In a new object the span is over.

    The deadline must be checked at least once in 2^29 ticks, because a counter that wrapped unseen
    cannot be distinguished from one that stood still. The hardware watchdog must end a loop that
    hangs for longer, or a counter that stands still.

    Attributes
    ----------
    left
        Ticks left at the last check.
    """

    def __init__(self) -> None:
        self.left = 0
        self._seen = 0

    def start(self, now: int, span: int) -> None:
        """Begin a new span.

        Parameters
        ----------
        now
            The present tick.
        span
            Length of the span in ticks, 0 to 2^29 - 1.

        Raises
        ------
        ValueError
            If the counter cannot measure the span. The old span is then over.
        """
        self.left = 0
        if not 0 <= span < HALF:
            raise ValueError(f"span of {span} ticks: must be 0 to {HALF - 1}")
        self._seen = now
        self.left = span

    def look(self, now: int) -> int:
        """Charge the time since the last check and return the time left; 0 means over."""
        step = diff(now, self._seen)
        self._seen = now
        self.left = max(0, self.left - abs(step))
        return self.left

    def over(self, now: int) -> bool:
        """Return whether the span is over."""
        return self.look(now) == 0

    def end(self) -> None:
        """End the span at once."""
        self.left = 0
