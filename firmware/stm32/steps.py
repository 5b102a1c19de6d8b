"""Steps by the advanced timers of the STM32 (TIM1, TIM8): one for each axis.

A timer's repetition counter makes a burst of up to 256 pulses and then takes period and count of
the next burst from its preload registers: no pause, and one interrupt for each burst. In the last
burst its one-pulse mode is set, which stops the timer at the end. The pulse comes at the end of the
interval, so the direction, set at the beginning, is there in time.

Bursts last 10 ms at most, except a single slow step. A stop lets the current burst end, so that
no step is lost or counted twice.
"""

import machine
import stm
from pyb import Pin
from pyb import Timer as PybTimer

#: Registers of a timer.
CR1, SR, EGR, ARR, RCR, CCR1 = 0x00, 0x10, 0x14, 0x2C, 0x30, 0x34
ENABLE, URS, ONE_PULSE, ARR_PRELOAD = 1, 4, 8, 0x80
#: Length of a pulse, longest burst, µs; most pulses of a burst, longest interval.
HIGH, LONGEST_US, MOST, SLOWEST = 4, 10_000, 256, 65_536


class Axis:
    """One timer and its bursts: (signed steps, interval)."""

    def __init__(self, number, step, direction):
        self.bursts = []
        self.running = self.ready = None
        self.way = Pin(direction, Pin.OUT_PP)
        self.base = stm.TIM1 if number == 1 else stm.TIM8
        # A tick is 1 µs. PWM_INVERTED: low until the compare value, then high to the end.
        timer = PybTimer(number)
        timer.init(prescaler=timer.source_freq() // 1_000_000 - 1, period=999)
        self._set(CR1, self._get(CR1) & ~ENABLE | URS | ARR_PRELOAD)
        timer.channel(1, PybTimer.PWM_INVERTED, pin=Pin(step), pulse_width=999)
        self._set(CR1, self._get(CR1) & ~ENABLE | URS | ARR_PRELOAD)
        timer.callback(self.ended)
        self.timer = timer

    def _get(self, register):
        return machine.mem32[self.base + register]

    def _set(self, register, value):
        machine.mem32[self.base + register] = value

    def play(self, direction, count, interval_us):
        interval = min(interval_us, SLOWEST)
        while count > 0:
            part = max(1, min(count, LONGEST_US // interval, MOST))
            self.bursts.append((direction * part, interval))
            count -= part
        self.pump()

    def pump(self):
        """Continue, if the timer stands or its last burst is no longer the last."""
        state = machine.disable_irq()
        if self._get(CR1) & ENABLE == 0:
            self.running = self.ready = None
            if self.bursts:
                self._begin(self._load())
        elif self.ready is None and self.bursts:
            self._prepare()
            if self._get(SR) & 1 and self.ready is not None:
                # The timer ended between two of these lines, perhaps with half of the new
                # values. None of their pulses has come yet: a pulse comes at the interval's end.
                self._begin(self.ready)
        machine.enable_irq(state)

    def _begin(self, burst):
        """Start the burst in the preload registers."""
        self._set(CR1, self._get(CR1) & ~ENABLE)
        self.running, self.ready = burst, None
        # Load the values now: with URS set this does not count as the end of a burst.
        self._set(EGR, 1)
        self._set(SR, 0)
        self.way(burst[0] > 0)
        self._prepare()
        self._set(CR1, self._get(CR1) | ENABLE)

    def _load(self):
        """Put the next burst into the preload registers."""
        burst = self.bursts.pop(0)
        steps, interval = burst
        self._set(ARR, interval - 1)
        self._set(CCR1, interval - HIGH)
        self._set(RCR, abs(steps) - 1)
        return burst

    def _prepare(self):
        """Prepare the next burst, or let the timer stop after this one.

        A burst of the other direction waits until the timer stands: see ``pump``.
        """
        control = self._get(CR1)
        if self.bursts and (self.bursts[0][0] > 0) == (self.running[0] > 0):
            self.ready = self._load()
            self._set(CR1, control & ~ONE_PULSE)
        else:
            self.ready = None
            self._set(CR1, control | ONE_PULSE)

    def ended(self, timer):
        """Handle the interrupt: a burst has ended; the next one, if ready, has begun."""
        self.running = self.ready
        if self.running is None:
            self.pump()
        else:
            self._prepare()

    def stop(self):
        state = machine.disable_irq()
        if self._get(SR) & 1 and self.ready is not None:
            # It has ended just now, and the ready one has begun: that is now the current one.
            self.running, self.ready = self.ready, None
        undone = sum([steps for steps, _ in self.bursts])
        self.bursts = []
        if self.ready is not None:
            undone += self.ready[0]
            self.ready = None
        self._set(CR1, self._get(CR1) | ONE_PULSE)
        machine.enable_irq(state)
        return undone


class Timer:
    """The step timer for ``lcu.node``."""

    def __init__(self, pins):
        """``pins``: step and direction of the primary axis, then of the secondary one."""
        self.axes = Axis(1, pins[0], pins[1]), Axis(8, pins[2], pins[3])

    def play(self, axis, direction, count, interval_us):
        self.axes[axis].play(direction, count, interval_us)

    def pump(self):
        self.axes[0].pump()
        self.axes[1].pump()

    def stop(self):
        return self.axes[0].stop(), self.axes[1].stop()
