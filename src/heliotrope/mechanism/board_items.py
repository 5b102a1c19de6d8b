"""Conversion of a heliostat to the items that its local controller stores.

A calibrated `Mechanism` becomes an armature, the constants of two drives and two biases. Together
with its `Machine` (limits, stow, defocus and the like) these are all that a local controller needs.
There is no other converter. The plant sends these bytes, compares their CRC-32 with the CRC-32 of
the stored bytes, and resends any item that differs. Simulated boards are filled with the same
bytes.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from zlib import crc32

import numpy as np

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.geometry import FloatArray
from heliotrope.lcu import drives
from heliotrope.lcu.config import Config
from heliotrope.lcu.journal import CODES_OF, SIZE_OF
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.kernels import slots as slot
from heliotrope.mechanism.machine import WAY_POINTS, Machine

#: Slots of the ten numbers of a drive, in the order of the local controller.
DRIVE_NUMBERS = (
    slot.ZERO,
    slot.RATE,
    slot.STROKE,
    slot.OFFSET,
    slot.RADIUS,
    slot.SCALE,
    slot.WORM_COS,
    slot.WORM_SIN,
    slot.WORM_RATIO,
    slot.SAG,
)
_ENDS = ("primary", "secondary")
#: Items that belong to the local controller itself: the plant neither pushes nor compares them.
OWN = frozenset({"address", "key_id", "edition", "bus_keys"})
#: Items that a local controller also accepts at stow, at standby and when defocused; it accepts
#: other items only when locked, at rest, in FAULT, or before it is configured.
CALIBRATION_ITEMS = frozenset({"armature", "biases", "location", "defocus"})
#: Items with which a local controller converts an aim into step counts.
POSE_ITEMS = frozenset({"armature", "biases", "drive_primary", "drive_secondary"})


def drive_numbers(drive: Drive) -> tuple[int, tuple[float, ...], float]:
    """Return the kind, the ten numbers and the bias (rad) of a drive, for `lcu.drives.Drive`.

    A phase of the sag is absorbed in the other numbers.

    Raises
    ------
    InputError
        If it is an array of drives.
    """
    if drive.shape:
        raise InputError(f"drive_numbers: drives have the shape {drive.shape}; pass one drive")
    table = drive.table
    kind = drives.ROTARY
    if table[slot.KIND] == slot.LINEAR:
        kind = drives.JACK_RISING if table[slot.SENSE] > 0 else drives.JACK_FALLING
    numbers = tuple(float(table[i]) for i in DRIVE_NUMBERS)
    bias, phase = float(table[slot.BIAS]), float(table[slot.SAG_PHASE])
    return (kind, *drives.reduced(kind, numbers, bias, phase))


def items_of(mechanism: Mechanism, machine: Machine | None = None) -> dict[str, bytes]:
    """Return the items that the local controller of one heliostat should store.

    Parameters
    ----------
    mechanism
        Calibrated mechanism, batch shape (), with two drives.
    machine
        Limits and rest positions; None to return only the items that calibration changes.

    Raises
    ------
    InputError
        If ``mechanism`` is not one mechanism with two drives, or a local controller would refuse an
        item.
    """
    if mechanism.shape or len(mechanism.driven) != 2:
        raise InputError(
            f"items_of: mechanisms of shape {mechanism.shape} with {len(mechanism.driven)} drives; "
            "pass one heliostat with two drives"
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
        numbers |= _machine_numbers(machine)
    return {name: packed(name, values) for name, values in numbers.items()}


#: Armature (18,) and drives (2, 19) of one heliostat.
Tables = tuple[FloatArray, FloatArray]


def tables_with(items: Mapping[str, bytes], armature: FloatArray, table: FloatArray) -> Tables:
    """Return a mechanism's armature (18,) and drives (2, 19) after items have been stored.

    This is the inverse of `items_of`, as far as the pose is concerned.

    Parameters
    ----------
    items
        Bytes by name; items other than `POSE_ITEMS` have no effect here.
    armature, table
        The tables before the change, (18,) and (2, 19).
    """
    rows = table.copy()
    biases = None if "biases" not in items else struct.unpack(CODES_OF["biases"], items["biases"])
    for i, end in enumerate(_ENDS):
        kind, numbers, bias = drive_numbers(Drive(rows[i]))
        if data := items.get(f"drive_{end}"):
            kind, *stored = struct.unpack(CODES_OF[f"drive_{end}"], data)
            numbers = tuple(stored)
        rows[i, slot.KIND] = slot.ROTARY if kind == drives.ROTARY else slot.LINEAR
        rows[i, slot.SENSE] = -1.0 if kind == drives.JACK_FALLING else 1.0
        rows[i, list(DRIVE_NUMBERS)] = numbers
        rows[i, [slot.BIAS, slot.SAG_PHASE]] = bias if biases is None else biases[i], 0.0
    if data := items.get("armature"):
        armature = np.array(struct.unpack(CODES_OF["armature"], data))
    return armature.copy(), rows


def _machine_numbers(machine: Machine) -> dict[str, tuple[object, ...]]:
    numbers: dict[str, tuple[object, ...]] = {"stow": machine.stow, "defocus": machine.defocus}
    if machine.standby is not None:
        numbers["standby"] = machine.standby
    if machine.stepping is not None:
        numbers["stepping"] = (*machine.stepping.microsteps, machine.stepping.rests)
    rest = (0.0,) * (3 * (WAY_POINTS - len(machine.way)))
    points = (x for point in machine.way for x in point)
    numbers["way"] = (machine.azimuth_axis, len(machine.way), *points, *rest)
    for axis, end in zip(machine.axes, _ENDS, strict=True):
        limits = (axis.low, axis.high, axis.rate, axis.acceleration, axis.backlash)
        numbers[f"limits_{end}"] = limits
    return numbers


def packed(name: str, values: tuple[object, ...]) -> bytes:
    """Return the bytes of one item.

    Raises
    ------
    UnknownNameError
        If the journal has no such item.
    InputError
        If the numbers do not fit the item, or a local controller would refuse them.
    """
    if name not in CODES_OF:
        raise UnknownNameError("item of the journal", name, CODES_OF)
    try:
        data = struct.pack(CODES_OF[name], *values)
    except struct.error as error:
        raise InputError(f"{name}: {values} cannot be stored: {error}") from None
    # Check that values are finite and in range, as the local controller itself will.
    if name not in OWN and not Config().take(name, data):
        raise InputError(f"{name}: a local controller refuses {values}; see lcu.config for ranges")
    return data


def checksums(items: Mapping[str, bytes]) -> dict[str, int]:
    """Return the CRC-32 of each item, as `lcu.journal.Journal.checksum` computes it."""
    return {name: crc32(data) for name, data in items.items()}


def differing(required: Mapping[str, bytes], stored: Mapping[str, int]) -> tuple[str, ...]:
    """Return the names of required items whose stored checksum differs, sorted."""
    return tuple(
        sorted(
            name
            for name, data in required.items()
            if name not in OWN and stored.get(name) != crc32(data)
        )
    )


@dataclass
class Wanted:
    """The items that each heliostat should store, and the items known to differ.

    Attributes
    ----------
    items
        Bytes by heliostat and item.
    missing
        Names of items that differed in the last comparison or whose wanted value has changed since,
        by heliostat.
    """

    items: dict[str, dict[str, bytes]] = field(default_factory=dict)
    missing: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def check(self, heliostat: str, items: Mapping[str, bytes]) -> None:
        """Check that items can be pushed.

        Raises
        ------
        InputError
            If there are no items, or an item is not set by the plant or has the wrong length.
        """
        if not items:
            raise InputError(f"{heliostat}: no items; pass at least one, as returned by items_of")
        for name, data in items.items():
            if name in OWN or len(data) != SIZE_OF.get(name, -1):
                raise InputError(
                    f"{heliostat}: item {name!r} of {len(data)} bytes cannot be pushed; pass items "
                    "as returned by items_of"
                )

    def set(self, heliostat: str, items: Mapping[str, bytes]) -> None:
        """Add items to the wanted items of a heliostat; see `check`.

        An item whose wanted value changes counts as missing until a comparison finds the new value.
        """
        self.check(heliostat, items)
        before = self.items.get(heliostat, {})
        changed = {name for name, data in items.items() if before.get(name, data) != data}
        self.items[heliostat] = {**before, **items}
        if changed:
            self.missing[heliostat] = tuple(sorted(changed.union(self.missing.get(heliostat, ()))))

    def rest(self, heliostat: str, point: tuple[float, ...]) -> None:
        """Set the wanted standby point, if any, to the point that a heliostat received."""
        items = self.items.get(heliostat, {})
        if "standby" in items:
            items["standby"] = packed("standby", point)

    def compare(self, heliostat: str, stored: Mapping[str, int]) -> tuple[str, ...]:
        """Compare with the checksums that a heliostat reports; return the differing items."""
        found = differing(self.items.get(heliostat, {}), stored)
        if found:
            self.missing[heliostat] = found
        else:
            self.missing.pop(heliostat, None)
        return found
