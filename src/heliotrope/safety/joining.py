"""A limit on how many heliostats join the receiver: a token bucket without a clock."""

import math
from dataclasses import dataclass, replace

from heliotrope.errors import InputError


@dataclass(frozen=True)
class JoinLimiter:
    """A limit on the rate at which heliostats join the receiver.

    In any period of T seconds, at most ``burst + rate · T`` heliostats join.

    Attributes
    ----------
    rate
        Heliostats per second, 0 or more.
    burst
        Number of heliostats that may join at once after a pause, an integer of at least 1.
    tokens, at
        Number of heliostats that may join at the monotonic time ``at``, s. A new limiter admits
        none yet.
    """

    rate: float
    burst: int
    tokens: float = 0.0
    at: float | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rate) and self.rate >= 0.0):
            raise InputError(
                f"joining rate must be finite and 0 or more, not {self.rate} heliostats/s"
            )
        if self.burst < 1:
            raise InputError(
                f"joining burst must be a whole number of at least 1, not {self.burst}"
            )

    def admit(self, wanted: int, now: float) -> tuple["JoinLimiter", int]:
        """Return the updated limiter, and how many of ``wanted`` heliostats may join now.

        If the clock stops, runs backwards or returns NaN, no heliostat is admitted. If it jumps
        ahead, at most ``burst`` heliostats are admitted.
        """
        at = self.at
        tokens = self.tokens
        if math.isfinite(now):
            if at is not None and now > at:
                tokens = min(float(self.burst), tokens + self.rate * (now - at))
            at = now if at is None else max(at, now)
        # Rounding must not withhold a token that is due.
        granted = max(0, min(wanted, math.floor(tokens + 1e-9)))
        return replace(self, tokens=max(0.0, tokens - granted), at=at), granted
