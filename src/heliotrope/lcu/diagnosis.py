"""Motion diagnosis: checks whether the mirror's tilt changes when an axis moves a little."""

import math

from .config import Config

TYPE_CHECKING = False
if TYPE_CHECKING:  # for the type checker only; a microcontroller has no such modules
    from typing import Any

#: Angle by which an axis is moved, and smallest change of tilt that the sensor detects, rad.
NUDGE, NOTICED = 0.02, 0.002

#: Bits in the result of a diagnosis.
MOVED_PRIMARY, MOVED_SECONDARY, STUCK_PRIMARY, STUCK_SECONDARY, NO_SENSOR = 1, 2, 4, 8, 16


class Diagnosis:
    """One diagnosis: the tilt at home, after a move of each axis, and back at home.

    An accelerometer detects the rotation of an axis except for the component about the vertical. If
    a tilt change below ``NOTICED`` is expected, neither MOVED nor STUCK is reported.

    Parameters
    ----------
    config
        A complete configuration.
    home
        Step counts of the heliostat's position.

    Attributes
    ----------
    over
        Whether the last motion, back to home, has begun.
    result
        Tuple of bits, steps moved by the two axes, and last change of tilt x, y in rad.
    """

    def __init__(self, config: Config, home: "list[int]") -> None:
        self.config, self.home = config, home
        self.over = False
        self.result: tuple[Any, ...] = (0, 0, 0, 0.0, 0.0)
        self._tilts: list[tuple[float, float] | None] = []

    def advance(self, tilt: "tuple[float, float] | None") -> "list[int]":
        """Accept the tilt at rest; return the step counts of the next motion."""
        self._tilts.append(tilt)
        stage = len(self._tilts)
        steps = [self.home[0], self.home[1]]
        if stage <= 2:
            steps[stage - 1] = self._nudged(stage - 1)
        else:
            self.over = True
            self.result = self._judged()
        return steps

    def _nudged(self, i: int) -> int:
        """Return step counts with one axis moved a little, within its limits."""
        drive, axis = self.config.drives[i], self.config.axes[i]
        assert drive is not None
        assert axis is not None
        angle = drive.angle(self.home[i])
        for offset in (NUDGE, -NUDGE):
            steps = drive.nearest(angle + offset)
            if axis.low <= steps <= axis.high:
                return steps
        return self.home[i]

    def _judged(self) -> "tuple[Any, ...]":
        pointing, drives = self.config.pointing, self.config.drives
        assert pointing is not None
        bits, moved, tilt = 0, [0, 0], (0.0, 0.0)
        axis = pointing.axis_1
        for i in (0, 1):
            drive, before, after = drives[i], self._tilts[0], self._tilts[i + 1]
            assert drive is not None
            if before is None or after is None:
                bits |= NO_SENSOR
                continue
            moved[i] = self._nudged(i) - self.home[i]
            angle = drive.angle(self.home[i])
            turn = abs(drive.angle(self.home[i] + moved[i]) - angle)
            # In the frame of the mirror, gravity turns with the axis, except for its component
            # along it.
            expected = turn * math.sqrt(axis[0] * axis[0] + axis[1] * axis[1])
            tilt = after[0] - before[0], after[1] - before[1]
            if expected > NOTICED:
                good = math.sqrt(tilt[0] * tilt[0] + tilt[1] * tilt[1]) > 0.5 * expected
                bits |= (MOVED_PRIMARY if good else STUCK_PRIMARY) << i
            axis = pointing.turned((math.sin(angle), math.cos(angle), 0.0, 1.0), pointing.axis_2)
        return bits, moved[0], moved[1], tilt[0], tilt[1]
