"""Motor settings and rest positions of a heliostat, which calibration does not change.

The settings come from the plant file (`[groups.NAME.machine]`); `board_items` converts them to the
bytes that a local controller stores.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from zlib import crc32

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float
from heliotrope.lcu.config import (
    LEAST_DEFOCUS,
    MOST_DEFOCUS,
    MOST_MICROSTEPS,
    MOST_POINTS,
    Config,
)

#: Maximum number of points of the safe path that a local controller can store.
WAY_POINTS = MOST_POINTS
#: Highest rate that a local controller emits, steps/s.
MOST_RATE = 1000 * Config().stride // Config().ahead_ms
_NAMES = ("primary", "secondary")
#: Longest duration of a DEFOCUS, s: a beam must be off 30 s after the loss of its controlling
#: program, which is noticed at the end of a lease, 6 s, and the first order may be lost.
LONGEST_DEFOCUS = 20.0
#: Steps in which `spread_defocus` spreads each axis: their product is the number of machines.
_SPREADS = 8


@dataclass(frozen=True)
class AxisLimits:
    """Limits of one axis.

    Attributes
    ----------
    low, high
        End positions, steps.
    rate, acceleration
        Maximum rate, steps/s, and acceleration, steps/s².
    backlash
        Length of the final approach from below, steps.

    Raises
    ------
    InputError
        If a range is empty, or a rate, an acceleration or a backlash is out of range.
    """

    low: int
    high: int
    rate: int
    acceleration: int
    backlash: int

    @property
    def lead(self) -> int:
        """Lead of a goal that moves down with the sun, in steps; see `lcu.stepper`."""
        return math.ceil(self.backlash / 8)

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise InputError(
                f"axis: the low end ({self.low} steps) must be below the high end ({self.high} "
                "steps)"
            )
        for name, unit in (("rate", "steps/s"), ("acceleration", "steps/s²")):
            value = getattr(self, name)
            if not value > 0:
                raise InputError(f"axis: {name} must be above 0, not {value} {unit}")
        if self.rate > MOST_RATE:
            raise InputError(
                f"axis: rate {self.rate} steps/s is too high; a local controller emits at most "
                f"{MOST_RATE}"
            )
        if not 0 <= self.backlash < 1 << 16:
            raise InputError(
                f"axis: backlash must be between 0 and 65535 steps, not {self.backlash}"
            )


@dataclass(frozen=True)
class Stepping:
    """How the motor drivers step.

    Attributes
    ----------
    microsteps
        Microsteps per full step of each motor.
    rests
        Whether the drivers are off between motions, which then end on full steps.

    Raises
    ------
    InputError
        If a number of microsteps is out of range.
    """

    microsteps: tuple[int, int]
    rests: bool = False

    def __post_init__(self) -> None:
        if not 1 <= min(self.microsteps) <= max(self.microsteps) <= MOST_MICROSTEPS:
            raise InputError(
                f"stepping: {self.microsteps} microsteps of a full step; use 1 to "
                f"{MOST_MICROSTEPS} for each axis"
            )


@dataclass(frozen=True)
class Machine:
    """Motor limits and rest positions of one heliostat.

    Attributes
    ----------
    axes
        Limits of the primary and the secondary axis.
    stow
        Position of both axes at stow, steps.
    defocus
        Angles of both axes for turning away from the receiver, rad.
    standby
        Standby point, ENU, m; None if the local controller keeps its stored point.
    azimuth_axis
        Index (0, 1) of the axis that leaves stow first.
    way
        Points through which the beam passes on its way from the ground to the standby point, ENU,
        m, at most `WAY_POINTS`; () if the local controller finds its own path.
    stepping
        How the motor drivers step; None if the local controller keeps its stored setting, which
        initially keeps the drivers powered.
    stow_lights
        Whether the beam of the stowed heliostat may cross a receiver or a target at some hours of
        the year; this is the light of a single heliostat. The beam never crosses a keep-out volume.
    tilt_sensor
        Whether the heliostat carries a tilt sensor, with which the plant can confirm that the
        mirror moves.

    Raises
    ------
    InputError
        If a stow position is outside the limits or, for drivers that switch off, between full
        steps; if a defocus would leave the beam on the receiver; or if there are too many points.
    """

    axes: tuple[AxisLimits, AxisLimits]
    stow: tuple[int, int]
    defocus: tuple[float, float]
    standby: tuple[float, float, float] | None = None
    azimuth_axis: int = 0
    way: tuple[tuple[float, float, float], ...] = ()
    stepping: Stepping | None = None
    stow_lights: bool = False
    tilt_sensor: bool = False

    @property
    def rests(self) -> bool:
        """Whether the drivers are switched off between motions."""
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
                f"way: {len(self.way)} points; a local controller stores at most {WAY_POINTS}"
            )


def spread_defocus(defocus: npt.ArrayLike, names: Sequence[str], spread: float) -> FloatArray:
    """Return defocus angles that differ from heliostat to heliostat, rad, (N, 2).

    If all heliostats turned by the same angles, their beams would stay together beside the
    receiver. Each axis therefore turns by its angle plus up to ``spread`` times that angle. The
    addition depends only on the name, so that a heliostat keeps its angles when other heliostats
    are added. `optics.standing.hottest` shows the benefit.

    Parameters
    ----------
    defocus
        Smallest angles of both axes, rad, (N, 2) or (2,).
    names
        Names of the N heliostats.
    spread
        Largest relative increase of an angle; 0 for no spread.
    """
    if spread == 0.0:
        return as_float(np.broadcast_to(as_float(defocus), (len(names), 2)))
    drawn = np.array([crc32(name.encode()) for name in names], dtype=np.int64)
    shares = np.stack([drawn // 256 % _SPREADS, drawn // 65536 % _SPREADS], axis=-1)
    # To 0.1 mrad, which keeps tables of heliostats short.
    return as_float(np.round(as_float(defocus) * (1.0 + spread * shares / (_SPREADS - 1)), 4))


def spread_machines(
    machine: Machine, names: Sequence[str], spread: float = 1.0
) -> tuple[Machine, ...]:
    """Return machines of N heliostats that differ only in the defocus angles.

    See `spread_defocus`. Heliostats with the same angles share one object.
    """
    made: dict[tuple[float, float], Machine] = {}
    machines = []
    for primary, secondary in spread_defocus(machine.defocus, names, spread).tolist():
        if (primary, secondary) not in made:
            made[primary, secondary] = replace(machine, defocus=(primary, secondary))
        machines.append(made[primary, secondary])
    return tuple(machines)
