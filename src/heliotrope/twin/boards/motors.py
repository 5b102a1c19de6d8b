"""Step timers and motors of one heliostat, which execute the segments that a board emits.

A segment is ``count`` pulses, with an interval after each. The timer executes the segments of an
axis one after the other; segments not yet executed when the supply fails are never made. Pulses
move the motor; the joint follows after the backlash of the gear, and an overloaded motor misses
some pulses.
"""

import random
from collections import deque


class MotorAxis:
    """One motor with its timer and its gear.

    Parameters
    ----------
    count
        Initial position, steps.
    play
        Backlash of the gear, steps: after a reversal the joint does not move for this many steps.
    miss
        Probability that a segment loses one of its steps.
    chance
        Source of random numbers.

    Attributes
    ----------
    emitted
        Sum of all signed steps ordered, relative to the initial count.
    turned
        Position of the motor, steps.
    joint
        Position of the joint, in motor steps: equal to the motor position after motion from below,
        up to ``play`` above it after a reversal.
    missed
        Steps missed so far.
    fastest
        Shortest segment interval since the start, µs.
    stalled
        Whether the motor is blocked, by ice or a broken coupling, whatever is ordered.
    """

    def __init__(
        self, count: int, play: float = 0.0, miss: float = 0.0, chance: random.Random | None = None
    ) -> None:
        self.emitted = self.turned = count
        self.joint = float(count)
        self.play, self.miss = play, miss
        self.missed = 0
        self.fastest, self.stalled = 1 << 30, False
        self._chance = chance or random.Random(0)
        self._queue: deque[tuple[int, int, int]] = deque()  # direction, count, interval
        self._free_at = 0.0  # when the timer takes the next segment, s
        self._done = 0  # pulses of the first segment already made

    def take(self, direction: int, count: int, interval_us: int, now: float) -> None:
        """Queue a segment at a time in s."""
        if not self._queue:
            self._free_at = max(self._free_at, now)
        self._queue.append((direction, count, interval_us))
        self.emitted += direction * count
        self.fastest = min(self.fastest, interval_us)

    def play_to(self, now: float) -> None:
        """Emit the pulses that are due by a time in s."""
        while self._queue:
            direction, count, interval_us = self._queue[0]
            # The interval follows each pulse: the first pulse comes at once.
            due = 1 + int((now - self._free_at) * 1e6 / interval_us) if now >= self._free_at else 0
            made = min(count, due)
            self._turn(direction, made - self._done)
            self._done = made
            end = self._free_at + count * interval_us * 1e-6
            if made < count or now < end:
                return
            self._queue.popleft()
            self._free_at, self._done = end, 0

    def _turn(self, direction: int, steps: int) -> None:
        if steps <= 0:
            return
        if self.stalled:
            self.missed += steps
            return
        if self.miss > 0.0 and self._chance.random() < self.miss:
            self.missed += 1
            steps -= 1
        self.turned += direction * steps
        # The pushing gear flank carries the joint along.
        self.joint = min(max(self.joint, float(self.turned)), self.turned + self.play)

    def release(self, full: int) -> None:
        """Switch the motor current off; the rotor settles at the nearest full step."""
        away = (self.turned + full // 2) % full - full // 2
        self._turn(-1 if away > 0 else 1, abs(away))

    def stop(self) -> int:
        """Stop at once and return the signed steps that were ordered but not made."""
        undone = sum(direction * count for direction, count, _ in self._queue)
        if self._queue:
            undone -= self._queue[0][0] * self._done
        self._queue.clear()
        self._done = 0
        self.emitted -= undone
        return undone

    @property
    def idle(self) -> bool:
        """Whether all pulses have been made."""
        return not self._queue
