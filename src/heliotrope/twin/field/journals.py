"""A vectorised field that can be calibrated: it takes new parameters, and answers for its journal.

`LiveField` is a `twin.field.Field` whose controllers' beliefs change heliostat by heliostat.
`LiveBus` is its bus with the messages that calibration needs: what is stored, what is to be
stored, standby points. MACs are not checked here: for that there are boards.
"""

import asyncio
import hashlib
import struct
from binascii import crc32
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray, bisector, normalize
from heliotrope.lcu import journal, messages, states, wire
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.board_items import Machine, items_of
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.kernels import slots as slot
from heliotrope.mechanism.tracking import Status, track
from heliotrope.twin.cameras import Mirror
from heliotrope.twin.field.field import Bools, Field, Rows
from heliotrope.twin.field.field_bus import FieldBus

#: States in which calibration is taken, and those in which all is.
_TAKES = (states.STOWED, states.LOCKED, states.FAULT, states.IDLE, states.DEFOCUSED)
_CALIBRATION = frozenset({"SET_ARMATURE", "SET_BIAS", "SET_POSITION", "SET_DEFOCUS"})
_ALL = (states.LOCKED, states.FAULT)
#: The numbers of a drive in the order of its item, as `control.parameters` gives them.
_NUMBERS = (
    slot.ZERO, slot.RATE, slot.STROKE, slot.OFFSET, slot.RADIUS, slot.SCALE, slot.WORM_COS,
    slot.WORM_SIN, slot.WORM_RATIO, slot.SAG,
)  # fmt: skip
_ITEMS = tuple(row[0] for row in journal.ITEMS)
_KEY_HEAD = struct.calcsize("<" + messages.HEADS[messages.KEY][0])


class LiveField(Field):
    """A field whose controllers can be told of new calibrations.

    Parameters
    ----------
    mechanism, believed, options
        As of `Field`; ``believed`` is needed.
    machine
        What no calibration changes, the same for all.

    Attributes
    ----------
    stored
        Items by row, of those that were written.
    checksums
        Of the armatures, (N,).
    """

    def __init__(
        self, mechanism: Mechanism, believed: Mechanism, machine: Machine, **options: Any
    ) -> None:
        super().__init__(
            mechanism,
            believed=believed,
            stow=machine.stow,
            ranges=[(axis.low, axis.high) for axis in machine.axes],
            limits=(machine.axes[0].rate, machine.axes[0].acceleration, machine.axes[0].backlash),
            standby=machine.standby or (0.0, 0.0, 0.0),
            defocus=machine.defocus,
            **options,
        )
        count = len(mechanism)
        self.stored: dict[int, dict[str, bytes]] = {}
        self._nominal, self._machine = believed, machine
        self._armatures = np.array(believed.armature.table)
        shape = (count, 2, slot.DRIVE_SLOTS)
        self._drive_table = np.array(np.broadcast_to(believed.drives.table, shape))
        self.checksums = np.array(
            [crc32(struct.pack("<18d", *row)) for row in self._armatures], dtype=np.uint32
        )

    def _drives(self, rows: Rows) -> Drive:
        # The field's own beginning asks before there is a table.
        table = getattr(self, "_drive_table", None)
        return super()._drives(rows) if table is None else Drive(table[rows])

    def _pose(self, rows: Rows, aims: FloatArray, ahead_ms: int) -> tuple[FloatArray, Bools]:
        light = self._sun[0] + self._sun[1] * (self._sun_ms + ahead_ms) // 1000
        return self.believed_pose(rows, normalize(light.astype(np.float64)), aims)

    def believed_pose(
        self, rows: Rows, sun: FloatArray, aims: FloatArray
    ) -> tuple[FloatArray, Bools]:
        """Return joint angles (M, 2) that the controllers would take, and whether they reach."""
        found = track(
            Armature(self._armatures[rows]),
            sun,
            aims,
            drives=Drive(self._drive_table[rows]),
            current=self.axes["count"][rows].astype(np.float64),
            tolerance=2e-10,
        )
        good = np.asarray(found.chosen(found.status) == Status.OK)
        return np.asarray(found.chosen(found.angles)), good

    def bus(self, rows: range) -> "LiveBus":
        """Return the bus of a cluster of some rows."""
        return LiveBus(self, rows)

    def items(self, row: int) -> dict[str, bytes]:
        """Return what a controller has stored."""
        if row not in self.stored:
            self.stored[row] = items_of(self._nominal[row], self._machine)
        return self.stored[row]

    def store(self, row: int, items: dict[str, bytes]) -> None:
        """Let a controller take items into its journal and its beliefs."""
        self.items(row).update(items)
        if "armature" in items:
            self._armatures[row] = struct.unpack("<18d", items["armature"])
            self.checksums[row] = crc32(items["armature"])
        if "biases" in items:
            self._drive_table[row, :, slot.BIAS] = struct.unpack("<ff", items["biases"])
        for axis, end in enumerate(("primary", "secondary")):
            if f"drive_{end}" in items:
                numbers = struct.unpack("<B10d", items[f"drive_{end}"])[1:]
                self._drive_table[row, axis, list(_NUMBERS)] = numbers
        if "standby" in items:
            self.standby[row] = struct.unpack("<fff", items["standby"])
        self.edition += 1

    # -- what is true ----------------------------------------------------------------------

    def errors(self, sun: FloatArray, aims: FloatArray) -> FloatArray:
        """Return by how much each normal would be off if it tracked aims (N, 3) now, rad, (N,)."""
        rows = np.arange(len(self))
        angles, good = self.believed_pose(rows, sun, aims)
        counts = np.floor(self._drives(rows).counts(angles) + 0.5)
        pose = self.mechanism.pose(counts)
        wanted = bisector(sun, normalize(aims - pose.vertex))
        off = np.linalg.norm(np.cross(pose.normal, wanted), axis=-1)
        return np.where(good, np.arcsin(np.clip(off, 0.0, 1.0)), np.nan)

    def mirrors_near(
        self,
        sun: FloatArray,
        middle: FloatArray,
        normal: FloatArray,
        reach: float,
        names: tuple[str, ...],
        sizes: FloatArray,
    ) -> list[Mirror]:
        """Return the mirrors whose rays meet a plane within a distance of its middle, m."""
        return near(self._stand(), sun, middle, normal, reach, names, sizes)


class LiveBus(FieldBus):
    """The bus of a cluster of a `LiveField`."""

    def __init__(self, field: LiveField, rows: range) -> None:
        super().__init__(field, rows)
        self._live = field

    async def transact(
        self,
        frame: bytes,
        timeout: float,
        *,
        expires: float | None = None,
        urgent: bool = False,
        complete: Callable[[bytes], bool] | None = None,
    ) -> bytes:
        """As of any bus; in an emergency all buses and the plant have their turns between."""
        if urgent:
            await asyncio.sleep(0)
        return await super().transact(frame, timeout, expires=expires, complete=complete)

    def _statuses(self) -> list[bytes]:
        if self._edition != self._field.edition:
            told = super()._statuses()
            sums = self._live.checksums[self._all].astype("<u4").tobytes()
            self._told = [
                data[:-6] + sums[4 * i : 4 * i + 4] + data[-2:] for i, data in enumerate(told)
            ]
        return self._told

    def _command(self, name: str, number: int, payload: bytes, place: int, sequence: int) -> bytes:
        row = self._rows[place]
        if name == "QUERY_STORED":
            item = payload[0] - 1
            known = 0 <= item < len(_ITEMS)
            data = self._live.items(row).get(_ITEMS[item], b"") if known else b""
            return self._answer(place, sequence, "STORED", payload[:1] + data)
        if name == "STANDBY" or messages.who_of(number) == messages.KEY:
            result = self._store(name, number, payload, row)
            values = struct.pack(
                "<" + messages.codes_of(messages.NUMBER_OF["ACK"]), sequence, number, result
            )
            return self._answer(place, sequence, "ACK", values)
        return super()._command(name, number, payload, place, sequence)

    def _store(self, name: str, number: int, payload: bytes, row: int) -> int:
        state = int(self._field.state[row])
        if name == "STANDBY":
            self._live.store(row, {"standby": payload[8:20]})
            return messages.DONE
        if state not in (_TAKES if name in _CALIBRATION else _ALL):
            return messages.REFUSED_STATE
        size = struct.calcsize("<" + messages.codes_of(number))
        body = payload[: len(payload) - wire.MAC_SIZE]
        targets = journal.TARGETS.get(name, ())
        if len(body) != size or not targets or name == "SET_ADDRESS":
            return messages.BAD_VALUE
        data = body[_KEY_HEAD:]
        if len(targets) == 2:
            axis, data = data[0], data[1:]
            targets = targets[axis : axis + 1]
        edition = body[_KEY_HEAD - 4 : _KEY_HEAD]
        self._live.store(row, {targets[0]: data, "edition": edition})
        return messages.DONE


def near(
    stand: tuple[FloatArray, FloatArray],
    sun: FloatArray,
    middle: FloatArray,
    normal: FloatArray,
    reach: float,
    names: tuple[str, ...],
    sizes: FloatArray,
) -> list[Mirror]:
    """Return the mirrors whose rays meet a plane within a distance of its middle.

    Parameters
    ----------
    stand
        Normals and vertices, (N, 3).
    sun
        Unit vector, (3,).
    middle, normal, reach
        Of the plane, m.
    names, sizes
        Of the heliostats; width and height, m, (N, 2).
    """
    facing, vertex = stand
    cosine = facing @ sun
    rays = 2.0 * cosine[:, None] * facing - sun
    with np.errstate(divide="ignore", invalid="ignore"):
        along = ((middle - vertex) @ normal) / (rays @ normal)
    away = np.linalg.norm(vertex + along[:, None] * rays - middle, axis=-1)
    hits = np.flatnonzero((cosine > 0.05) & (along > 0.0) & (away <= reach))
    return [
        Mirror(names[i], vertex[i], facing[i], float(sizes[i, 0]), float(sizes[i, 1])) for i in hits
    ]


def key_of(name: str) -> bytes:
    """Return the key of a simulated heliostat."""
    return hashlib.sha256(b"live " + name.encode()).digest()


def ranges_of(mechanism: Mechanism) -> npt.NDArray[np.int64]:
    """Return the lowest and highest counts of both axes between the stops, (2, 2), of all alike."""
    drives = Drive(np.reshape(mechanism.drives.table, (-1, 2, slot.DRIVE_SLOTS))[0])
    ends = [drives.counts(drives.table[:, end]) for end in (slot.MIN_ANGLE, slot.MAX_ANGLE)]
    return np.sort(np.round(np.stack(ends, axis=-1)), axis=-1).astype(np.int64)
