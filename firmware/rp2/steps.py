"""Steps by the state machines of the rp2: one for each axis, exact to 0.2 µs.

A word in a state machine's queue is a segment: direction (1 bit), steps less one (10), wait in
cycles (21). The step pin rises in the same instruction that counts the step, so the remainder
after a stop is exact to the step.
"""

import rp2
from machine import Pin

#: Cycles a second; cycles for which a step pin is high: 3.2 µs.
CLOCK, HIGH = 5_000_000, 16
#: Cycles of a step in addition to its wait, and of a segment in addition to its steps.
STEP, SEGMENT = 2 + HIGH, 4
MOST = 1024
QUEUE = 4
IDLE = 0xFFFFFFFF


@rp2.asm_pio(
    sideset_init=rp2.PIO.OUT_LOW, out_init=rp2.PIO.OUT_LOW, out_shiftdir=rp2.PIO.SHIFT_RIGHT
)
def steps():
    # fmt: off
    wrap_target()
    pull()                   .side(0)
    out(x, 10)               .side(0)
    out(pins, 1)             .side(0)
    out(isr, 21)             .side(0)
    label("step")
    mov(y, isr)              .side(0)
    label("wait")
    jmp(y_dec, "wait")       .side(0)
    jmp(x_dec, "step")       .side(1)  [15]
    wrap()
    # fmt: on


def word(direction, count, interval_us):
    """Return a segment for the state machine. It never lasts longer than it should."""
    cycles = (interval_us * (CLOCK // 1_000_000) * count - SEGMENT) // count - STEP
    return (count - 1) | (direction > 0) << 10 | min(cycles, (1 << 21) - 1) << 11


class Axis:
    """One state machine and the segments that it has not taken yet."""

    def __init__(self, number, step, direction):
        self.waiting, self.given = [], []
        self.machine = rp2.StateMachine(
            number, steps, freq=CLOCK, sideset_base=Pin(step), out_base=Pin(direction)
        )
        self._begin()

    def _begin(self):
        self.machine.exec("mov(x, invert(null))")
        self.machine.exec("mov(osr, null)")
        self.machine.active(1)

    def _read(self, register):
        self.machine.exec(f"mov(isr, {register})")
        self.machine.exec("push(noblock)")
        return self.machine.get()

    def play(self, direction, count, interval_us):
        while count > 0:
            part = min(count, MOST)
            self.waiting.append((direction * part, word(direction, part, interval_us)))
            count -= part
        self.pump()

    def pump(self):
        machine = self.machine
        while self.waiting and machine.tx_fifo() < QUEUE:
            steps, data = self.waiting.pop(0)
            machine.put(data)
            self.given.append(steps)
            if len(self.given) > QUEUE + 1:
                self.given.pop(0)

    def stop(self):
        machine = self.machine
        machine.active(0)
        queued = machine.tx_fifo()
        left, taken = self._read("x"), self._read("osr")
        undone = sum([steps for steps, _ in self.waiting])
        for steps in self.given[len(self.given) - queued :]:
            undone += steps
        if left != IDLE:
            undone += left + 1 if self.given[-1 - queued] > 0 else -left - 1
        elif taken:
            # A word taken but not yet unpacked; otherwise all its bits are shifted out.
            undone += self.given[-1 - queued]
        for _ in range(queued):
            machine.exec("pull(noblock)")
        self.waiting, self.given = [], []
        machine.restart()
        self._begin()
        return undone


class Timer:
    """The step timer for ``lcu.node``."""

    def __init__(self, pins):
        """``pins``: step and direction of the primary axis, then of the secondary one."""
        self.axes = Axis(0, pins[0], pins[1]), Axis(1, pins[2], pins[3])

    def play(self, axis, direction, count, interval_us):
        self.axes[axis].play(direction, count, interval_us)

    def pump(self):
        self.axes[0].pump()
        self.axes[1].pump()

    def stop(self):
        return self.axes[0].stop(), self.axes[1].stop()
