"""Settings of a heliostat's motors and resting places: what no calibration changes.

They come from the plant file (`[groups.NAME.machine]`); `board_items` turns them into the bytes
that a local controller stores.
"""

import math
from dataclasses import dataclass

from heliotrope.errors import InputError
from heliotrope.lcu.config import (
    LEAST_DEFOCUS,
    MOST_DEFOCUS,
    MOST_MICROSTEPS,
    MOST_POINTS,
    Config,
)

#: Points of the safe way that a local controller can store.
WAY_POINTS = MOST_POINTS
#: Highest rate that a local controller emits, steps/s.
MOST_RATE = 1000 * Config().stride // Config().ahead_ms
_NAMES = ("primary", "secondary")


@dataclass(frozen=True)
class AxisLimits:
    """Limits of one axis.

    Attributes
    ----------
    low, high
        End positions, steps.
    rate, acceleration
        Steps/s and steps/s².
    backlash
        Length of the final approach from below, steps.

    Raises
    ------
    InputError
        An empty range, or a rate, an acceleration or a backlash out of range.
    """

    low: int
    high: int
    rate: int
    acceleration: int
    backlash: int

    @property
    def lead(self) -> int:
        """Steps by which a goal that goes down with the sun is set ahead, as in `lcu.stepper`."""
        return math.ceil(self.backlash / 8)

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise InputError(f"axis: from {self.low} to {self.high} steps; the low end comes first")
        for name, unit in (("rate", "steps/s"), ("acceleration", "steps/s²")):
            value = getattr(self, name)
            if not value > 0:
                raise InputError(f"axis: {name} {value} {unit} must be above 0")
        if self.rate > MOST_RATE:
            raise InputError(
                f"axis: rate {self.rate} steps/s; a local controller emits {MOST_RATE} at most"
            )
        if not 0 <= self.backlash < 1 << 16:
            raise InputError(f"axis: backlash {self.backlash} steps; give 0 to 65535")


@dataclass(frozen=True)
class Stepping:
    """How the motors' drivers step.

    Attributes
    ----------
    microsteps
        Microsteps of a full step of each motor.
    rests
        Whether the drivers are off between motions, which then end on full steps.

    Raises
    ------
    InputError
        Microsteps out of range.
    """

    microsteps: tuple[int, int]
    rests: bool = False

    def __post_init__(self) -> None:
        if not 1 <= min(self.microsteps) <= max(self.microsteps) <= MOST_MICROSTEPS:
            raise InputError(
                f"stepping: {self.microsteps} microsteps of a full step; give 1 to "
                f"{MOST_MICROSTEPS} for each axis"
            )


@dataclass(frozen=True)
class Machine:
    """Motor limits and resting places of one heliostat.

    Attributes
    ----------
    axes
        Tables of the primary and the secondary drive.
    stow
        Position of both axes at stow, steps.
    defocus
        Angles by which both axes turn away, rad.
    standby
        Standby point, ENU, m; None: the local controller keeps the one it has.
    azimuth_axis
        Index (0, 1) of the axis that leaves stow first.
    way
        Points that the beam passes from the ground to the standby point, ENU, m, at most
        `WAY_POINTS`; (): the local controller finds its own.
    stepping
        How the drivers step; None: the local controller keeps what it has, at first no rest.

    Raises
    ------
    InputError
        A stow position outside the limits or, for drivers that rest, between full steps, a
        defocus that would leave the beam on the receiver, or too many points.
    """

    axes: tuple[AxisLimits, AxisLimits]
    stow: tuple[int, int]
    defocus: tuple[float, float]
    standby: tuple[float, float, float] | None = None
    azimuth_axis: int = 0
    way: tuple[tuple[float, float, float], ...] = ()
    stepping: Stepping | None = None

    @property
    def rests(self) -> bool:
        """Whether the drivers are off between motions."""
        return self.stepping is not None and self.stepping.rests

    def __post_init__(self) -> None:
        for name, axis, steps in zip(_NAMES, self.axes, self.stow, strict=True):
            if not axis.low <= steps <= axis.high:
                raise InputError(
                    f"machine: stow at {steps} steps of the {name} axis is outside its limits "
                    f"{axis.low} to {axis.high}"
                )
        if self.stepping is not None and self.rests:
            for name, steps, full in zip(_NAMES, self.stow, self.stepping.microsteps, strict=True):
                if steps % full:
                    raise InputError(
                        f"machine: stow at {steps} steps of the {name} axis is between full steps "
                        f"of {full}, where a driver that rests cannot hold it; choose "
                        f"{round(steps / full) * full}"
                    )
        size = max(map(abs, self.defocus))
        if not LEAST_DEFOCUS <= size <= MOST_DEFOCUS:
            raise InputError(
                f"machine: defocus by {math.degrees(size):.3g}°; one axis must turn by "
                f"{math.degrees(LEAST_DEFOCUS):.3g}° to {math.degrees(MOST_DEFOCUS):.3g}°"
            )
        if len(self.way) > WAY_POINTS:
            raise InputError(
                f"way: {len(self.way)} points; a local controller stores {WAY_POINTS} at most"
            )
