"""Steps by the remote-control peripheral (RMT) of the ESP32: one channel for each axis.

Queued steps go to the peripheral as one sequence; the next follows when the loop finds the
channel idle, some milliseconds later: MicroPython gives the peripheral no queue. A motor must
therefore run no faster than it can start from rest. Within a sequence the steps come closer
together by an eighth, which makes up for the pauses: set the rate of SET_LIMITS to 7/8 of the
motor's rate. A stop lets the current sequence end, at most ``LONGEST_US`` later, so that no
step is lost or counted twice.
"""

from esp32 import RMT
from machine import Pin

#: Length of a pulse, longest part of a sequence (15 bits), and longest sequence, µs.
HIGH, PART, LONGEST_US = 4, 32_000, 50_000
#: Steps of a sequence at most: two numbers for each.
MOST = 500


class Axis:
    def __init__(self, number, step, direction):
        self.waiting = []
        self.way = Pin(direction, Pin.OUT, value=0)
        self.rmt = RMT(number, pin=Pin(step), resolution_hz=1_000_000, idle_level=False)

    def play(self, direction, count, interval_us):
        self.waiting.append((direction, count, interval_us * 7 // 8))
        self.pump()

    def pump(self):
        """Give the peripheral the next sequence, if it is idle."""
        if not self.waiting or not self.rmt.wait_done():
            return
        direction = self.waiting[0][0]
        times, levels, made, spent = [], [], 0, 0
        while self.waiting and self.waiting[0][0] == direction and made < MOST:
            _, count, interval = self.waiting[0]
            part = min(count, (LONGEST_US - spent) // interval, MOST - made)
            if made == 0:
                part = max(part, 1)  # one step at least, however slow
            if part == 0:
                break
            one = sequence(interval)
            times += one * part
            levels += ([1] + [0] * (len(one) - 1)) * part
            made += part
            spent += interval * part
            if part == count:
                self.waiting.pop(0)
            else:
                self.waiting[0] = direction, count - part, interval
        self.way(direction > 0)
        self.rmt.write_pulses(times, levels)

    def stop(self):
        undone = sum([direction * count for direction, count, _ in self.waiting])
        self.waiting = []
        return undone


def sequence(interval):
    """Return durations of one step: high, then low, in parts where it is too long for one."""
    times, rest = [HIGH], interval - HIGH
    while rest > PART:
        times.append(PART)
        rest -= PART
    times.append(rest)
    return times


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
