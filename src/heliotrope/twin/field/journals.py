"""Journals of the local controllers in a vectorised field, and the mechanisms that they imply."""

import struct
from binascii import crc32
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray
from heliotrope.lcu.journal import CODES_OF
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.board_items import DRIVE_NUMBERS, items_of
from heliotrope.mechanism.board_motion import Corners
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.kernels import slots as slot
from heliotrope.mechanism.machine import Machine
from heliotrope.mechanism.tracking import TrackingStatus, track

Rows = npt.NDArray[np.intp]
Bools = npt.NDArray[np.bool_]


class Journals:
    """Journals of N local controllers, with the mechanisms and positions they imply as arrays.

    Parameters
    ----------
    believed
        Mechanisms stored initially, (N,).
    machine
        Limits and rest positions: one for all heliostats, or one per heliostat.

    Attributes
    ----------
    armatures
        Tables, (N, 18).
    checksums
        CRC-32 of the armatures, (N,).
    standby
        Standby points, ENU, m, (N, 3).
    """

    def __init__(self, believed: Mechanism, machine: Machine | Sequence[Machine]) -> None:
        count = len(believed)
        self._machines = [machine] * count if isinstance(machine, Machine) else list(machine)
        if len(self._machines) != count:
            raise InputError(f"field: {len(self._machines)} machine tables for {count} heliostats")
        self._nominal = believed
        self._items: dict[int, dict[str, bytes]] = {}
        self.armatures = np.array(np.broadcast_to(believed.armature.table, (count, 18)))
        shape = (count, 2, slot.DRIVE_SLOTS)
        self._drives = np.array(np.broadcast_to(believed.drives.table, shape))
        self.checksums = np.array(
            [crc32(struct.pack("<18d", *row)) for row in self.armatures], dtype=np.uint32
        )
        self.standby = np.full((count, 3), np.nan)
        for table, rows in self.machines():
            # The motor limits act as stops, so a pose beyond them is impossible.
            for i, axis in enumerate(table.axes):
                own = self._drives[rows, i]
                self._drives[rows, i, slot.MIN_COUNT] = np.maximum(own[:, slot.MIN_COUNT], axis.low)
                self._drives[rows, i, slot.MAX_COUNT] = np.minimum(
                    own[:, slot.MAX_COUNT], axis.high
                )
            if table.standby is not None:
                self.standby[rows] = table.standby

    def machines(self) -> list[tuple[Machine, Rows]]:
        """Return each distinct machine table with the indices of its heliostats."""
        rows: dict[Machine, list[int]] = {}
        for row, table in enumerate(self._machines):
            rows.setdefault(table, []).append(row)
        return [(table, np.array(members, dtype=np.intp)) for table, members in rows.items()]

    @property
    def corners(self) -> list[Corners]:
        """Points of the safe paths that the plant file specifies for the N heliostats, ENU, m."""
        return [table.way for table in self._machines]

    @property
    def origin(self) -> FloatArray:
        """Points at which beams start, ENU, m, (N, 3)."""
        return Armature(self.armatures).origin_1

    @property
    def position(self) -> FloatArray:
        """Positions of the heliostats, ENU, m, (N, 3)."""
        return np.broadcast_to(self._nominal.position, (len(self.armatures), 3))

    def drives(self, rows: Rows) -> Drive:
        """Return the drives of some heliostats as their controllers believe them, (M, 2)."""
        return Drive(self._drives[rows])

    def pose(
        self, rows: Rows, sun: FloatArray, aims: FloatArray, counts: FloatArray
    ) -> tuple[FloatArray, Bools]:
        """Return the joint angles that bring beams to aims, and whether each aim can be reached.

        Parameters
        ----------
        rows
            Heliostats, (M,).
        sun
            Unit vector to the sun, (3,).
        aims
            Aim points, ENU, m, (M, 3).
        counts
            Present step counts, (M, 2): the pose that needs the least motion is chosen.
        """
        solution = track(
            Armature(self.armatures[rows]),
            sun,
            aims,
            drives=self.drives(rows),
            current=counts,
            tolerance=2e-10,
        )
        good = np.asarray(solution.chosen(solution.status) == TrackingStatus.OK)
        return np.asarray(solution.best_angles), good

    def items(self, row: int) -> dict[str, bytes]:
        """Return the items that a controller stores."""
        if row not in self._items:
            self._items[row] = items_of(self._nominal[row], self._machines[row])
        return self._items[row]

    def store(self, row: int, items: dict[str, bytes]) -> None:
        """Store items in a controller's journal and apply them."""
        self.items(row).update(items)
        if "armature" in items:
            self.armatures[row] = struct.unpack(CODES_OF["armature"], items["armature"])
            self.checksums[row] = crc32(items["armature"])
        if "biases" in items:
            biases = struct.unpack(CODES_OF["biases"], items["biases"])
            self._drives[row, :, slot.BIAS] = biases
        for axis, end in enumerate(("primary", "secondary")):
            name = f"drive_{end}"
            if name in items:
                numbers = struct.unpack(CODES_OF[name], items[name])[1:]
                self._drives[row, axis, list(DRIVE_NUMBERS)] = numbers
        if "standby" in items:
            self.standby[row] = struct.unpack(CODES_OF["standby"], items["standby"])
