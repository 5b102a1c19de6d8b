"""The last sun vector, and the time for which it may be used."""

from . import ticks

#: Units: the sun's components 2^-30, its rate 2^-28 a second.
UNIT, RATE_FACTOR = 1 << 30, 4
#: A vector may be this far (ms) ahead of the clock, because the cluster sends it for a full second.
AHEAD_MS = 2000
#: Below this height (2^-30) the sun is too low to reflect.
NIGHT = -UNIT // 50
MODULO = 1 << 32
#: The sun never moves faster than this, rad/ms: 15.05 arcsec/s (one turn in 86,164 s), seen from
#: the earth's axis.
FASTEST = 7.3e-8
#: For this long after its second, a vector gives the sun's direction to within 4 mrad, ms.
RECENT_MS = 60_000
#: Time that distinguishes the vectors of a whole day, ms.
LONGEST_MS = 1 << 29


class Clock:
    """GPS time between two TIME messages, advanced by ticks.

    ``second`` is None until TIME has arrived, and again after the ticks have run backwards.
    """

    def __init__(self) -> None:
        self.second: int | None = None
        self.ms = 0

    def set(self, week: int, time_of_week_ms: int) -> int:
        """Accept TIME; return the jump of the clock in ms, 0 for the first TIME."""
        second, ms = week * 604_800 + time_of_week_ms // 1000, time_of_week_ms % 1000
        jump = 0 if self.second is None else 1000 * (second - self.second) + ms - self.ms
        self.second, self.ms = second % MODULO, ms
        return jump

    def elapse(self, ms: int) -> None:
        """Advance by the ticks that have passed."""
        if self.second is not None:
            self.ms += ms
            self.second = (self.second + self.ms // 1000) % MODULO
            self.ms %= 1000

    def lose(self) -> None:
        """Forget the time, which is unknown until the next TIME."""
        self.second = None

    def since(self, second: int) -> int:
        """Return the milliseconds since a GPS second, negative before it; the clock must be set."""
        now = self.second or 0
        seconds = (now - second + MODULO // 2) % MODULO - MODULO // 2
        return 1000 * max(-1_000_000, min(1_000_000, seconds)) + self.ms


class SunLease:
    """The sun's direction and the lease that it grants.

    Only a vector for a later second than all earlier vectors renews the lease; its time in transit
    is deducted. If ticks jump, the lease ends early, never late.

    While the lease runs, a vector must be consistent with the last one: the sun cannot have moved
    further than `FASTEST` allows in the ticks since, with a margin of one lease for the time in
    transit. After a lapse or a start there is no reference, and any vector is accepted.

    Attributes
    ----------
    since_ms
        Time since the second of the last vector, ms, at most 1,000,000, which is also the value
        before the first vector.
    bad
        Number of refused vectors.
    leaps
        Number of vectors inconsistent with the previous vector; they are refused or, after a lapse,
        accepted.
    """

    def __init__(self, span_ms: int) -> None:
        self.span_ms = span_ms
        self._left = ticks.Deadline()
        self._second = -1
        self._sun = [0, 0, 0]
        self._rate = [0, 0, 0]
        self.since_ms, self._passed_ms = 1_000_000, 0
        self.bad = self.leaps = 0

    def take(self, values: "tuple[int, ...]", clock: Clock, now: int) -> bool:
        """Accept SUN; return False, without renewal, if it is stale, repeated or no sun vector."""
        second = values[0]
        delay = 0 if clock.second is None else clock.since(second)
        lapsed = self._left.over(now)
        ahead = (second - self._second) % MODULO
        # After a lapse the cluster's clock may have been set back; the same second never counts.
        newer = self._second < 0 or 0 < ahead < MODULO // 2 or (lapsed and ahead != 0)
        size = 0.0
        for value in values[1:4]:
            size += (value / UNIT) * (value / UNIT)
        good = clock.second is not None and newer and -AHEAD_MS <= delay < self.span_ms
        if not (good and abs(size - 1.0) < 1e-3 and values[3] > NIGHT):
            self.bad += 1
            return False
        if self._second >= 0 and not self._follows(values):
            self.leaps += 1
            if not lapsed:
                self.bad += 1
                return False
        self._second = second
        for i in (0, 1, 2):
            self._sun[i], self._rate[i] = values[1 + i], values[4 + i] * RATE_FACTOR
        self.since_ms, self._passed_ms = delay, 0
        self._left.start(now, self.span_ms - max(0, delay))
        return True

    def _follows(self, values: "tuple[int, ...]") -> bool:
        """Return whether the sun can have moved from the last vector to this vector."""
        gap = 0.0
        for i in (0, 1, 2):
            part = (values[1 + i] - self._sun[i]) / UNIT
            gap += part * part
        reach = FASTEST * (self._passed_ms + self.span_ms)
        return gap <= reach * reach

    def look(self, now: int, elapsed: int) -> bool:
        """Charge the elapsed time, and return whether the lease is still running."""
        self.since_ms = min(self.since_ms + elapsed, 1_000_000)
        self._passed_ms = min(self._passed_ms + elapsed, LONGEST_MS)
        return not self._left.over(now)

    def fresh(self) -> bool:
        """Return whether the lease was running at the last check."""
        return self._left.left > 0

    def age_ms(self) -> int:
        """Return the age of the vector, ms; the largest number if there is no fresh vector."""
        return self.span_ms - self._left.left if self._left.left > 0 else 0xFFFFFFFF

    def end(self) -> None:
        """End the lease."""
        self._left.end()

    def vector(self, ahead_ms: int) -> tuple[float, float, float]:
        """Return the direction to the sun ``ahead_ms`` from now, a vector of length near 1."""
        ms = self.since_ms + ahead_ms
        east, north, up = [self._sun[i] + self._rate[i] * ms // 1000 for i in (0, 1, 2)]
        return east / UNIT, north / UNIT, up / UNIT
