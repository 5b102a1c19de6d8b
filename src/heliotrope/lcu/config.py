"""Settings of a local controller, which are validated before they are accepted."""

import struct
from binascii import crc32

from .drives import Drive
from .journal import CODES_OF, STRIDE
from .pointing import Pointing
from .stepper import Axis

TYPE_CHECKING = False
if TYPE_CHECKING:  # for the type checker only; a microcontroller has no such module
    from typing import Any

#: Largest coordinate (m) or step count.
FAR, MOST_STEPS = 1e5, 1 << 29
#: Limits of the larger of the two defocus angles, rad. A smaller turn than the first limit would
#: leave the beam on the receiver.
LEAST_DEFOCUS, MOST_DEFOCUS = 0.02, 1.6
#: Points that fit in the item "way".
MOST_POINTS = 4
#: Largest number of microsteps per full step that drivers have.
MOST_MICROSTEPS = 256


def is_place(point: "tuple[float, ...]") -> bool:
    """Return whether these are coordinates (m) that a plant can have."""
    for value in point:  # noqa: SIM110 - a generator would allocate
        if not -FAR <= value <= FAR:
            return False
    return True


class Config:
    """Settings of one local controller.

    Attributes
    ----------
    pointing, drives, axes, stow
        Values from SET_ARMATURE, SET_DRIVES with SET_BIAS, SET_LIMITS, SET_STOW; None while
        missing.
    armature_crc
        CRC-32 of the armature's bytes as received.
    defocus, location, standby
        Defocus angles (rad), and ENU points (m), which are None while missing.
    path
        ENU points (m) of the safe path from the ground to below the standby point, from SET_WAY; if
        empty, see ``Motion``.
    azimuth_axis
        The axis (0, 1) that moves first when leaving stow and last when returning, from SET_WAY.
    microsteps, rests
        Microsteps of a full step by axis, and whether the drivers are off between motions, from
        SET_STEPPING.
    serial, firmware, address
        Values reported in HERE.
    lease_ms, stow_wait_ms, silence_ms
        Maximum age of the sun vector; time without a sun vector until a defocused heliostat goes to
        stow; time without any valid message until a heliostat that holds a position is defocused.
    slot_ms, ahead_ms, stride
        Settings of the ``Stepper`` and of the ``Journal``: at no rate may an axis make more steps
        than the stride in the time for which segments are emitted ahead.
    """

    def __init__(self) -> None:
        self.pointing: Pointing | None = None
        self.armature_crc = 0
        self.drives: list[Drive | None] = [None, None]
        self.axes: list[Axis | None] = [None, None]
        self.biases: tuple[float, ...] = (0.0, 0.0)
        self.stow: tuple[int, ...] | None = None
        self.defocus: tuple[float, ...] = (0.1, 0.1)
        self.location: tuple[float, ...] | None = None
        self.standby: tuple[float, float, float] | None = None
        self.path: list[tuple[float, float, float]] = []
        self.azimuth_axis = 0
        self.microsteps: tuple[int, ...] = (1, 1)
        self.rests = False
        self.serial, self.firmware, self.address = 0, 0, 0
        self.lease_ms, self.stow_wait_ms, self.silence_ms = 6000, 30_000, 6000
        self.slot_ms, self.ahead_ms, self.stride = 50, 100, STRIDE
        self._numbers: list[tuple[Any, ...] | None] = [None, None]

    def complete(self) -> bool:
        """Return whether all settings that tracking needs are present and consistent."""
        return self.pointing is not None and None not in self.drives and self.fits()

    def fits(self) -> bool:
        """Return whether the limits are present and the stow position lies within them."""
        if self.stow is None:
            return False
        for axis, steps in zip(self.axes, self.stow):  # noqa: B905 - not in MicroPython
            if axis is None or not axis.low <= steps <= axis.high:
                return False
        return True

    def load(self, items: "dict[str, bytes]") -> bool:
        """Load the journal's items; return False if one is invalid."""
        good = True
        for name in items:
            good = self.take(name, items[name]) and good
        return good

    def take(self, name: str, data: bytes) -> bool:
        """Accept an item of ``journal.ITEMS``; return False, without a change, if it is invalid."""
        was_complete = self.complete()
        before = self.pointing, self.drives[:], self.axes[:], self.biases, self.stow
        numbers = self._numbers[:]
        try:
            good = self._take(name, struct.unpack(CODES_OF[name], data))
        except (ValueError, OverflowError, ZeroDivisionError):
            good = False
        if good and (self.complete() or not was_complete):
            if name == "armature":
                self.armature_crc = crc32(data)
            return True
        self.pointing, self.drives, self.axes, self.biases, self.stow = before
        self._numbers = numbers
        return False

    def _take(self, name: str, values: "tuple[Any, ...]") -> bool:
        if name == "armature":
            self.pointing = Pointing(values)
            return is_place(values)
        if name in ("drive_primary", "drive_secondary"):
            self._numbers[name == "drive_secondary"] = values
            self._make_drives()
        elif name in ("limits_primary", "limits_secondary"):
            low, high, rate, acceleration, backlash = values
            if max(abs(low), abs(high), rate, acceleration) > MOST_STEPS:
                return False
            ahead_ms = -(-self.ahead_ms // self.slot_ms) * self.slot_ms
            if rate * ahead_ms > 1000 * self.stride:
                return False
            axis = Axis(low, high, rate, acceleration, backlash, self.slot_ms)
            self.axes[name == "limits_secondary"] = axis
        elif name == "biases":
            self.biases = values
            self._make_drives()
            return bool(max(abs(values[0]), abs(values[1])) < 7.0)
        elif name == "stow":
            self.stow = values
        elif name == "defocus":
            size = max(abs(values[0]), abs(values[1]))
            if not LEAST_DEFOCUS <= size <= MOST_DEFOCUS:
                return False
            self.defocus = values
        elif name in ("location", "standby"):
            if not is_place(values):
                return False
            setattr(self, name, values)
        elif name == "way":
            axis, count = values[0], values[1]
            if axis > 1 or count > MOST_POINTS or not is_place(values[2:]):
                return False
            self.azimuth_axis = axis
            points = [values[2 + 3 * i : 5 + 3 * i] for i in range(count)]
            self.path = [(east, north, up) for east, north, up in points]
        elif name == "stepping":
            if not 1 <= min(values[:2]) <= max(values[:2]) <= MOST_MICROSTEPS or values[2] > 1:
                return False
            self.microsteps, self.rests = values[:2], values[2] == 1
        elif name == "address":
            if not 1 <= values[0] < 0xFFFF:
                return False
            self.address = values[0]
        return True

    def _make_drives(self) -> None:
        for i in (0, 1):
            numbers = self._numbers[i]
            if numbers is not None:
                self.drives[i] = Drive(numbers[0], numbers[1:], self.biases[i])
