"""Steps: converts the goals of two axes to segments for a hardware timer.

Time runs in slots of some tens of milliseconds. In each slot, an axis makes steps at its present
speed, which changes by no more than the acceleration allows and never exceeds the speed from which
the axis can still stop before the goal. All numbers are integers; speeds and phases are in steps
per slot times ``SCALE``. A segment is (axis, direction, count, interval in µs): the hardware makes
``count`` pulses and waits for the interval after each pulse. It executes the segments of an axis
one after another; no Python code runs per step.

Counts refer to emitted segments. An emitted segment is executed, except at an emergency stop. The
hardware then reports how many steps it did not make, and `Stepper.undone` subtracts them.
"""

SCALE = 1024

#: Order of the two axes of a motion.
BOTH, PRIMARY_FIRST, SECONDARY_FIRST = range(3)


def root(square: int) -> int:
    """Return the integer square root, rounded down."""
    if square < 2:
        return square
    guess = 1
    size = square
    while size:
        size >>= 2
        guess <<= 1
    while True:
        better = (guess + square // guess) >> 1
        if better >= guess:
            return guess
        guess = better


def stopping(speed: int, change: int) -> int:
    """Return the steps made in one slot at ``speed`` and while slowing down afterwards."""
    m = speed // change
    return (m + 1) * speed - change * m * (m + 1) // 2


def fastest(distance: int, change: int) -> int:
    """Return the highest speed whose `stopping` distance is at most ``distance``."""
    m = (root(8 * distance // change + 1) - 1) >> 1
    while change * m * (m + 1) // 2 > distance:
        m -= 1
    while change * (m + 1) * (m + 2) // 2 <= distance:
        m += 1
    return (distance + change * m * (m + 1) // 2) // (m + 1)


class Axis:
    """One axis: position, speed and goal.

    Parameters
    ----------
    low, high
        Range of the counts, steps; goals beyond the range are not accepted.
    rate, acceleration
        Maximum rate, steps/s, and acceleration, steps/s².
    backlash
        Steps past a goal that is approached from above, so that the goal is always reached from
        below.
    slot_ms
        Length of a slot, ms.

    Raises
    ------
    ValueError
        If the range is empty or a limit is not above 0.
    """

    def __init__(
        self, low: int, high: int, rate: int, acceleration: int, backlash: int, slot_ms: int
    ) -> None:
        if low >= high or backlash < 0 or backlash >= high - low:
            raise ValueError("axis: the range is empty, or the backlash as large as the range")
        if not (rate > 0 and acceleration > 0):
            raise ValueError("axis: rate and acceleration must be above 0")
        self.low, self.high, self.backlash = low, high, backlash
        self.rate, self.acceleration = rate, acceleration
        self.slot_us = 1000 * slot_ms
        self.shortest_us = -(-1_000_000 // rate)
        # Intervals are whole microseconds, so a slot may hold no more steps than fit in it;
        # otherwise the hardware would fall behind.
        room = self.slot_us * SCALE // self.shortest_us
        self.top = max(1, min(rate * slot_ms * SCALE // 1000, room))
        self.change = max(1, acceleration * slot_ms * slot_ms * SCALE // 1_000_000)
        self.count = self.goal = self.leg = 0
        self.speed = self.phase = 0
        self.direction = 1
        #: Set ahead of a goal that moves down; see Stepper.follow.
        self.led = False
        self.braking = False

    def still(self) -> bool:
        """Return whether the axis is at rest at its goal."""
        return self.speed == 0 and self.count == self.leg == self.goal

    def aim(self, goal: int) -> bool:
        """Set a goal to be reached from below; return False if the goal was cut to the range."""
        cut = min(max(goal, self.low), self.high)
        self.goal = self.leg = cut
        self.braking = self.led = False
        if cut < self.count + (self.stop_distance() if self.direction > 0 else 0):
            self.leg = max(self.low, cut - self.backlash)
        return cut == goal

    def stop_distance(self) -> int:
        """Return the largest number of steps needed to slow down from the present speed."""
        if self.speed <= self.change:
            return 0
        return stopping(self.speed - self.change, self.change) // SCALE + 1

    def brake(self) -> None:
        """Slow down and stop, abandoning the goal."""
        self.braking = True
        if self.speed == 0:
            self.stand()

    def stand(self) -> None:
        """Make the present count the goal, because a stopped axis has no other goal."""
        self.goal = self.leg = self.count
        self.braking = False

    def slot(self, held: bool) -> int:
        """Advance by one slot, or slow down if held; return the number of steps made.

        ``direction`` is the sign of the steps.
        """
        if self.speed == 0:
            self.phase = 0
            if self.count == self.leg:
                self.leg = self.goal
            if held or self.count == self.leg:
                return 0
            self.direction = 1 if self.leg > self.count else -1
        slower = max(0, self.speed - self.change)
        distance = self.direction * (self.leg - self.count) * SCALE - self.phase
        if held or self.braking or distance < stopping(slower, self.change):
            self.speed = slower
        else:
            faster = min(self.speed + self.change, self.top, fastest(distance, self.change))
            self.speed = max(slower, faster)
        moved = self.phase + self.speed
        steps = moved // SCALE
        self.phase = moved % SCALE
        self.count += self.direction * steps
        if self.braking and self.speed == 0:
            self.stand()
        return steps

    def interval_us(self, steps: int) -> int:
        """Return the time between the steps of the last slot, µs, rounded up."""
        return max(self.shortest_us, self.slot_us // steps)


class Stepper:
    """Two axes and the hardware's queue of segments.

    Parameters
    ----------
    axes
        Primary and secondary axis.
    slot_ms, ahead_ms
        Length of a slot, ms; time by which segments are emitted ahead of the hardware, ms, which
        must exceed the longest pause of the main loop.
    """

    def __init__(self, axes: list[Axis], slot_ms: int, ahead_ms: int) -> None:
        self.axes = axes
        self.slot_ms, self.ahead_ms = slot_ms, max(slot_ms, ahead_ms)
        self.order = BOTH
        self.rough = 0
        #: Microsteps per full step by axis; rough stepping then ends on full steps.
        self.full: tuple[int, ...] = (1, 1)
        self.queued_ms = 0

    def go(self, primary: int, secondary: int, order: int) -> bool:
        """Go to step counts, one axis at a time or both together.

        Return False if a goal was cut to its range.
        """
        self.order = order
        first = self.axes[0].aim(primary)
        return self.axes[1].aim(secondary) and first

    def follow(self, primary: int, secondary: int) -> bool:
        """Follow slowly moving goals without overshooting each goal by the backlash.

        An axis that must go down is set ahead by an eighth of its backlash and waits until the goal
        has moved by as much. In rough stepping an axis goes to the nearest full step; if the full
        step is unknown, it waits until ``rough`` steps have accumulated.
        """
        self.order = BOTH
        inside = True
        goals = primary, secondary
        for i in (0, 1):
            axis, goal = self.axes[i], goals[i]
            inside = axis.low <= goal <= axis.high and inside
            full, wait = (self.full[i] if self.rough else 1), max(1, self.rough)
            if full > 1:
                goal, wait = (goal + full // 2) // full * full, 1
            lead = -(-axis.backlash // (8 * full)) * full
            error = goal - axis.goal
            if error >= max(wait, lead + 1 if axis.led else 0):
                axis.aim(goal)
            elif error <= -max(wait, lead):
                axis.aim(goal - lead)
                axis.led = True
        return inside

    def stop(self) -> None:
        """Slow both axes down within their acceleration and stop."""
        for axis in self.axes:
            axis.brake()

    def undone(self, primary: int, secondary: int) -> None:
        """Subtract signed steps that were emitted but not made, after an emergency stop.

        Both axes are then at rest.
        """
        for axis, steps in zip(self.axes, (primary, secondary)):  # noqa: B905
            axis.count -= steps
            axis.speed = axis.phase = 0
            axis.stand()
        self.queued_ms = 0

    def still(self) -> bool:
        """Return whether both axes are at their goals and the hardware has sent all steps."""
        return self.queued_ms <= 0 and self.axes[0].still() and self.axes[1].still()

    def advance(self, elapsed_ms: int, out: list[tuple[int, ...]], kind: int) -> None:
        """Emit segments for ``elapsed_ms``, each (kind, axis, direction, count, µs)."""
        self.queued_ms -= elapsed_ms
        if self.queued_ms < 0:
            for axis in self.axes:
                # The hardware queue ran empty, so the motors stand still and start from rest.
                axis.speed = axis.phase = 0
                if axis.braking:
                    axis.stand()
            self.queued_ms = 0
        while self.queued_ms < self.ahead_ms:
            if self.axes[0].still() and self.axes[1].still():
                return
            for number in (0, 1):
                axis, other = self.axes[number], self.axes[1 - number]
                waits = self.order == (SECONDARY_FIRST if number == 0 else PRIMARY_FIRST)
                steps = axis.slot(waits and not other.still())
                if steps:
                    out.append((kind, number, axis.direction, steps, axis.interval_us(steps)))
            self.queued_ms += self.slot_ms
