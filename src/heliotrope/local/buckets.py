"""Token buckets, which limit how often something may happen, per key."""

from collections import OrderedDict
from collections.abc import Callable


class Buckets:
    """One token bucket per key.

    Parameters
    ----------
    rate
        Tokens that a bucket gains, 1/s.
    burst
        Tokens in a full bucket.
    monotonic
        Function that returns the time, s.
    largest
        Maximum number of keys that are kept; the least recently used keys are dropped first.
    """

    def __init__(
        self, rate: float, burst: float, monotonic: Callable[[], float], largest: int = 10_000
    ) -> None:
        self._rate, self._burst, self._now, self._largest = rate, burst, monotonic, largest
        self._kept: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, key: str) -> float:
        """Take a token; return 0 if one was taken, otherwise the time until one is available, s."""
        now = self._now()
        tokens, at = self._kept.pop(key, (self._burst, now))
        tokens = min(self._burst, tokens + self._rate * (now - at))
        wait = 0.0 if tokens >= 1.0 else (1.0 - tokens) / self._rate
        self._kept[key] = (tokens - 1.0 if wait == 0.0 else tokens, now)
        if len(self._kept) > self._largest:
            self._kept.popitem(last=False)
        return wait
