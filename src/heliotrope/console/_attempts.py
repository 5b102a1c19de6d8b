"""Recent failed sign-ins, by address and by name."""

from collections import deque
from collections.abc import Callable


class Attempts:
    """The failures by key within a time span.

    Parameters
    ----------
    most, span
        Failures allowed within ``span`` s.
    monotonic
        Returns the time, s.
    largest
        Number of keys that are kept; the oldest are dropped first.
    """

    def __init__(
        self, most: int, span: float, monotonic: Callable[[], float], largest: int = 10_000
    ) -> None:
        self._most, self._span, self._now, self._largest = most, span, monotonic, largest
        self._failures: dict[str, deque[float]] = {}

    def wait(self, *keys: str) -> float:
        """Return the time to wait before the next attempt, s; 0 if it may be made now."""
        now, longest = self._now(), 0.0
        for key in keys:
            times = self._failures.get(key)
            while times and now - times[0] >= self._span:
                times.popleft()
            if times is not None and not times:
                del self._failures[key]
            elif times and len(times) >= self._most:
                longest = max(longest, times[-self._most] + self._span - now)
        return longest

    def begin(self, *keys: str) -> None:
        """Count an attempt as failed until `good` says otherwise.

        Counting only after the slow password check would let many attempts through at once.
        """
        for key in keys:
            self._failures.setdefault(key, deque(maxlen=self._most)).append(self._now())
            if len(self._failures) > self._largest:
                del self._failures[next(iter(self._failures))]

    def good(self, *keys: str) -> None:
        """Forget the failures of keys that have signed in."""
        for key in keys:
            self._failures.pop(key, None)
