"""What a local controller keeps of its heliostat, as bytes of its journal.

A calibrated `Mechanism` becomes an armature, the numbers of two drives and two biases
(`items_of`); with limits, stow position and the like (`Machine`) that is all a controller needs.
Bytes are compared by their CRC-32: what is stored is what was sent, or it is sent again.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from zlib import crc32

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.lcu import drives
from heliotrope.lcu.config import MOST_POINTS, Config
from heliotrope.lcu.journal import CODES_OF, SIZE_OF
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.kernels import slots as slot

#: The ten numbers of a drive, in the order of the local controller.
_ORDER = (
    slot.ZERO, slot.RATE, slot.STROKE, slot.OFFSET, slot.RADIUS, slot.SCALE, slot.WORM_COS,
    slot.WORM_SIN, slot.WORM_RATIO, slot.SAG,
)  # fmt: skip
#: Points that a controller keeps of its safe way.
WAY_POINTS = MOST_POINTS
_ENDS = ("primary", "secondary")
#: What a controller has of its own, and no plant pushes or compares.
OWN = frozenset({"address", "key_id", "edition"})
#: Items that a controller takes at stow, at standby and defocused too; the others only locked,
#: at rest, in FAULT or before it is configured.
CALIBRATION_ITEMS = frozenset({"armature", "biases", "location", "defocus"})


def drive_numbers(drive: Drive) -> tuple[int, tuple[float, ...], float]:
    """Return kind, ten numbers and bias (rad) of one drive, as `lcu.drives.Drive` takes them.

    A phase of the sag is taken into the other numbers.

    Raises
    ------
    InputError
        An array of drives.
    """
    if drive.shape:
        raise InputError(f"drive_numbers: drives of shape {drive.shape}; give one")
    table = drive.table
    kind = drives.ROTARY
    if table[slot.KIND] == slot.LINEAR:
        kind = drives.JACK_RISING if table[slot.SENSE] > 0 else drives.JACK_FALLING
    numbers = tuple(float(table[i]) for i in _ORDER)
    bias, phase = float(table[slot.BIAS]), float(table[slot.SAG_PHASE])
    return (kind, *drives.reduced(kind, numbers, bias, phase))


@dataclass(frozen=True)
class Axis:
    """Limits of one axis.

    Attributes
    ----------
    low, high
        Step counts.
    rate, acceleration
        Steps/s and steps/s².
    backlash
        Steps of the final approach from below.
    """

    low: int
    high: int
    rate: int
    acceleration: int
    backlash: int = 0


@dataclass(frozen=True)
class Machine:
    """What no calibration changes.

    Attributes
    ----------
    axes
        Of the primary and the secondary drive.
    stow
        Step counts.
    standby
        ENU, m, or None.
    defocus
        rad.
    azimuth_axis, way
        Which axis (0, 1) leaves stow first; and the points (ENU, m) that the beam passes from the
        ground to the standby point, at most `WAY_POINTS`; (): the controller finds its own.
    """

    axes: tuple[Axis, Axis]
    stow: tuple[int, int]
    standby: tuple[float, float, float] | None = None
    defocus: tuple[float, float] = (0.1, 0.1)
    azimuth_axis: int = 0
    way: tuple[tuple[float, float, float], ...] = ()


def items_of(mechanism: Mechanism, machine: Machine | None = None) -> dict[str, bytes]:
    """Return the journal's items of one calibrated heliostat.

    Parameters
    ----------
    mechanism
        Calibrated, batch shape (), with two drives.
    machine
        None: only what follows from the mechanism.

    Raises
    ------
    InputError
        Not one mechanism with two drives, or items that a local controller would refuse.
    """
    if mechanism.shape or len(mechanism.driven) != 2:
        raise InputError(
            f"items_of: mechanisms of shape {mechanism.shape} with {len(mechanism.driven)} drives; "
            "give one heliostat with two"
        )
    made = [drive_numbers(mechanism.drives[i]) for i in (0, 1)]
    numbers: dict[str, tuple[object, ...]] = {
        "location": tuple(mechanism.position),
        "armature": tuple(mechanism.armature.table),
        "biases": (made[0][2], made[1][2]),
    }
    for i, end in enumerate(_ENDS):
        numbers[f"drive_{end}"] = (made[i][0], *made[i][1])
    if machine is not None:
        numbers |= {"stow": machine.stow, "defocus": machine.defocus}
        if machine.standby is not None:
            numbers["standby"] = machine.standby
        if len(machine.way) > WAY_POINTS:
            raise InputError(
                f"way: {len(machine.way)} points; a controller keeps {WAY_POINTS} at most"
            )
        rest = (0.0,) * (3 * (WAY_POINTS - len(machine.way)))
        points = (x for point in machine.way for x in point)
        numbers["way"] = (machine.azimuth_axis, len(machine.way), *points, *rest)
        for axis, end in zip(machine.axes, _ENDS, strict=True):
            numbers[f"limits_{end}"] = (
                axis.low, axis.high, axis.rate, axis.acceleration, axis.backlash
            )  # fmt: skip
    return {name: packed(name, values) for name, values in numbers.items()}


def packed(name: str, values: tuple[object, ...]) -> bytes:
    """Return one item's bytes.

    Raises
    ------
    UnknownNameError
        If the journal has no such item.
    InputError
        Numbers that it cannot hold, or that a local controller would refuse.
    """
    if name not in CODES_OF:
        raise UnknownNameError("item of the journal", name, CODES_OF)
    try:
        data = struct.pack(CODES_OF[name], *values)
    except struct.error as error:
        raise InputError(f"{name}: {values} cannot be stored: {error}") from None
    # Finite and in range, as the controller itself will judge it.
    if name not in OWN and not Config().take(name, data):
        raise InputError(f"{name}: a local controller refuses {values}; see lcu.config for ranges")
    return data


def checksums(items: Mapping[str, bytes]) -> dict[str, int]:
    """Return the CRC-32 of each item, as `lcu.journal.Journal.checksum` gives it."""
    return {name: crc32(data) for name, data in items.items()}


def differing(wanted: Mapping[str, bytes], stored: Mapping[str, int]) -> tuple[str, ...]:
    """Return the items whose stored checksum is not that of what is wanted, sorted."""
    return tuple(
        sorted(
            name
            for name, data in wanted.items()
            if name not in OWN and stored.get(name) != crc32(data)
        )
    )


@dataclass
class Wanted:
    """What each heliostat should hold, and what it is known not to hold.

    Attributes
    ----------
    items
        By heliostat and item.
    missing
        Items that differ, by heliostat, as of the last comparison.
    """

    items: dict[str, dict[str, bytes]] = field(default_factory=dict)
    missing: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def check(self, heliostat: str, items: Mapping[str, bytes]) -> None:
        """See that items can be pushed.

        Raises
        ------
        InputError
            None, an item that no plant sets, or one of a wrong length.
        """
        if not items:
            raise InputError(f"{heliostat}: no items; give at least one, as items_of makes them")
        for name, data in items.items():
            if name in OWN or len(data) != SIZE_OF.get(name, -1):
                raise InputError(
                    f"{heliostat}: item {name!r} of {len(data)} bytes cannot be pushed; give items "
                    "as items_of makes them"
                )

    def set(self, heliostat: str, items: Mapping[str, bytes]) -> None:
        """Want items of a heliostat, besides those that are wanted already; see `check`."""
        self.check(heliostat, items)
        self.items[heliostat] = {**self.items.get(heliostat, {}), **items}

    def compare(self, heliostat: str, stored: Mapping[str, int]) -> tuple[str, ...]:
        """Take the checksums that a heliostat holds; return which items differ."""
        found = differing(self.items.get(heliostat, {}), stored)
        if found:
            self.missing[heliostat] = found
        else:
            self.missing.pop(heliostat, None)
        return found
