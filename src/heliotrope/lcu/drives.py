"""Drives: conversion from motor steps to a joint angle, and back.

The law is the same as in ``heliotrope.mechanism.drives``: θ = bias + (1 + scale) φ + worm_cos cos u
+ worm_sin sin u + sag cos φ, where φ is linear in the steps (rotary) or follows the law of cosines
(jack, with the constants of PAINT). `reduced` folds a phase of the sag into the other numbers, so
ten numbers and the bias are enough.
"""

import math

from .pointing import epsilon
from .vectors import finite

ROTARY, JACK_RISING, JACK_FALLING = 0, 1, 2

#: Indices of the ten parameters of a drive.
ZERO, RATE, STROKE, OFFSET, RADIUS, SCALE, WORM_COS, WORM_SIN, WORM_RATIO, SAG = range(10)


class Drive:
    """One drive.

    Parameters
    ----------
    kind
        ``ROTARY``, ``JACK_RISING`` (φ grows as the triangle's angle falls: σ = 1) or
        ``JACK_FALLING``.
    numbers
        Ten numbers: angle at 0 steps (rad); rad (jack: m of stroke) per step, signed; for a jack,
        length at 0 steps and distances from the joint to the fixed and the moving end (m); scale;
        worm (rad, rad, periods per rad of φ or per m of stroke); sag (rad).
    bias
        Bias of the joint angle, rad.

    Raises
    ------
    ValueError
        If a number is not finite, or the drive could not move in both directions.
    """

    def __init__(self, kind: int, numbers: tuple[float, ...], bias: float) -> None:
        if kind not in (ROTARY, JACK_RISING, JACK_FALLING):
            raise ValueError("drive: unknown kind")
        if len(numbers) != 10 or not finite(numbers) or not math.isfinite(bias):
            raise ValueError("drive: it needs 10 finite numbers and a finite bias")
        self.kind, self.numbers, self.bias = kind, numbers, bias
        if numbers[RATE] == 0.0 or abs(1.0 + numbers[SCALE]) < 1e-3:
            raise ValueError("drive: it cannot move because the rate is 0 or the scale is −1")
        worm = abs(numbers[WORM_COS]) + abs(numbers[WORM_SIN])
        self.span = (worm + abs(numbers[SAG])) / abs(1.0 + numbers[SCALE])
        self.eps = epsilon(numbers[RATE] * 0.0 + 1.0)
        self.sense = 0.0
        if kind == ROTARY:
            swing = worm * abs(numbers[WORM_RATIO]) + abs(numbers[SAG])
            if swing >= abs(1.0 + numbers[SCALE]):
                raise ValueError("drive: the worm and sag terms would reverse its direction")
            return
        k, c, r = numbers[STROKE], numbers[OFFSET], numbers[RADIUS]
        if not (c > 0.0 and r > 0.0 and abs(c - r) < k < c + r):
            raise ValueError("drive: the jack's three sides do not form a triangle")
        self.sense = 1.0 if kind == JACK_RISING else -1.0
        self.folded = self._triangle(k)

    def _triangle(self, length: float) -> float:
        """Return the triangle's angle at the joint, in a form that is exact for any jack pose.

        The half-angle formula stays exact for folded and stretched jacks.
        """
        c, r = self.numbers[OFFSET], self.numbers[RADIUS]
        above = (length - (c - r)) * (length + (c - r))
        below = ((c + r) - length) * ((c + r) + length)
        return 2.0 * math.atan2(math.sqrt(max(0.0, above)), math.sqrt(max(0.0, below)))

    def _ideal(self, steps: float) -> float:
        n = self.numbers
        if self.kind == ROTARY:
            return n[ZERO] + n[RATE] * steps
        turned = self.folded - self._triangle(n[STROKE] + n[RATE] * steps)
        return n[ZERO] + self.sense * turned

    def angle(self, steps: float) -> float:
        """Return the joint angle (rad) at a number of steps."""
        n = self.numbers
        phi = self._ideal(steps)
        theta = self.bias + (1.0 + n[SCALE]) * phi
        if n[WORM_COS] != 0.0 or n[WORM_SIN] != 0.0:
            u = n[WORM_RATIO] * (phi if self.kind == ROTARY else n[RATE] * steps)
            theta += n[WORM_COS] * math.cos(u) + n[WORM_SIN] * math.sin(u)
        if n[SAG] != 0.0:
            theta += n[SAG] * math.cos(phi)
        return theta

    def _of_ideal(self, phi: float) -> float:
        n = self.numbers
        if self.kind == ROTARY:
            return (phi - n[ZERO]) / n[RATE]
        c, r = n[OFFSET], n[RADIUS]
        angle = self.folded - self.sense * (phi - n[ZERO])
        half = math.sin(0.5 * min(math.pi, max(0.0, angle)))
        # (c − r)² + 4 c r sin²(Φ/2) keeps its precision when the jack is folded.
        length = math.sqrt((c - r) * (c - r) + 4.0 * c * r * half * half)
        return (length - n[STROKE]) / n[RATE]

    def steps(self, theta: float) -> float:
        """Return the steps (a real number) at a joint angle (rad).

        Beyond a jack's reach, the result is the end of the jack. With periodic terms, a bracketed
        secant (regula falsi with bisection) finds the steps to a thousandth of a step.
        """
        phi = (theta - self.bias) / (1.0 + self.numbers[SCALE])
        count = self._of_ideal(phi)
        if self.span == 0.0:
            return count
        low, high = self._of_ideal(phi - self.span), self._of_ideal(phi + self.span)
        f_low, f_high = self.angle(low) - theta, self.angle(high) - theta
        for i in range(60):
            error = self.angle(count) - theta
            if (error > 0.0) == (f_low > 0.0):
                low, f_low = count, error
            else:
                high, f_high = count, error
            before, count = count, 0.5 * (low + high)
            if i % 3 != 2 and f_high != f_low:
                count = low - f_low * (high - low) / (f_high - f_low)
            if error == 0.0:
                return before
            if abs(count - before) <= 1e-3 + 2.0 * self.eps * abs(before):
                return count
        return count

    def nearest(self, theta: float) -> int:
        """Return the whole number of steps nearest to a joint angle (rad)."""
        return math.floor(self.steps(theta) + 0.5)


def reduced(
    kind: int, numbers: tuple[float, ...], bias: float, phase: float
) -> tuple[tuple[float, ...], float]:
    """Return numbers and bias without a phase for a drive with the sag sag · cos(φ + phase).

    With φ' = φ + phase, the bias is increased by −(1 + scale) · phase, and the worm of a rotary
    drive, whose argument is a multiple of φ, is rotated by that multiple of the phase.
    """
    n = list(numbers)
    n[ZERO] += phase
    if kind == ROTARY:
        sine, cosine = math.sin(n[WORM_RATIO] * phase), math.cos(n[WORM_RATIO] * phase)
        n[WORM_COS], n[WORM_SIN] = (
            n[WORM_COS] * cosine - n[WORM_SIN] * sine,
            n[WORM_COS] * sine + n[WORM_SIN] * cosine,
        )
    return tuple(n), bias - (1.0 + n[SCALE]) * phase
