"""The checks of local controllers on a `FieldBus`: the firmware's gate, one per heliostat.

Without gates a field obeys every frame. With gates each heliostat accepts a bus key, and checks
signatures, numbers, tokens, expiries, MACs and editions with the firmware's own code
(`lcu.wire.Gate`, `lcu.signing.BusKeys`).
"""

import struct
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.lcu import journal, messages, names, wire
from heliotrope.lcu.controller import HARMLESS
from heliotrope.lcu.signing import BusKeys
from heliotrope.links.clock import WEEK
from heliotrope.twin.boards.outfit import sha256
from heliotrope.twin.field.field import Field

_KEYED = 1 << names.FLAGS.index("BUS_KEY")
_WANTS = 1 << names.FLAGS.index("SESSION_WANTED")
#: Items that no reply reveals.
SECRET = frozenset({"key_id", "bus_keys"})
Flags = npt.NDArray[np.uint32]


class Gates:
    """The gates of one bus, one gate per heliostat.

    Parameters
    ----------
    field
        The whole field; bus keys are kept in its journals.
    rows
        Indices of the bus's heliostats in the field.
    keys
        Key of each local controller, in the same order.

    Attributes
    ----------
    boots
        Number of boots of each heliostat, (N,).
    """

    def __init__(self, field: Field, rows: range, keys: Sequence[bytes]) -> None:
        self._field, self._rows, self._keys = field, rows, tuple(keys)
        self._all = np.array(rows)
        self.boots = np.zeros(len(rows), dtype=np.int64)
        self._off = np.zeros(len(rows), dtype=np.bool_)
        self._gates = [self._started(place) for place in range(len(rows))]
        self._second: int | None = None

    def _started(self, place: int) -> wire.Gate:
        """Return the gate of a heliostat that is booting."""
        items, own = self._field.journals.items(self._rows[place]), self._keys[place]
        edition = struct.unpack("<I", items["edition"])[0] if "edition" in items else 0
        self.boots[place] += 1
        gate = wire.Gate(sha256, own, edition)
        gate.bus = bus = BusKeys(sha256, own, 1 + self._rows[place], int(self.boots[place]))
        if "bus_keys" in items:
            bus.take(items["bus_keys"])
        return gate

    def _keys_of(self, place: int) -> BusKeys:
        bus = self._gates[place].bus
        assert isinstance(bus, BusKeys)
        return bus

    def look(self) -> bool:
        """Boot the heliostats whose power has returned; return whether there were any."""
        off = self._field.state[self._all] < 0
        back = np.flatnonzero(self._off & ~off)
        self._off = off
        for place in back:
            self._gates[place] = self._started(int(place))
        return len(back) > 0

    def flags(self) -> Flags:
        """Return the STATUS flags that concern keys and sessions, (N,)."""
        return np.array(
            [_KEYED * gate.keyed() + _WANTS * gate.waits() for gate in self._gates], dtype=np.uint32
        )

    def judge(self, frame: wire.Frame, place: int) -> int:
        """Return DONE if a frame may act on a heliostat, otherwise the reason for its refusal."""
        if self._off[place]:
            return messages.REFUSED_STATE
        result = self._gates[place].judge(frame, self._field.now_ms, self._second)
        values = frame.values()
        if result == messages.DONE and frame.name == "TIME" and values is not None:
            self._second = int(values[0] * WEEK + values[1] // 1000)
        return result

    def reported(self, place: int) -> tuple[int, ...]:
        """Return the values of a heliostat's BUS message."""
        return self._keys_of(place).told()

    def take_key(self, frame: wire.Frame, place: int) -> int:
        """Apply SET_BUS_KEY to a heliostat; return the result."""
        gate, bus, values = self._gates[place], self._keys_of(place), frame.values()
        if values is None:
            return messages.BAD_VALUE
        result = gate.judge_key(frame, values[2])
        row = self._rows[place]
        if result == messages.DONE and self._field.state[row] not in HARMLESS:
            return messages.REFUSED_STATE
        if result == messages.DONE:
            keyed, stored = bus.keyed, bus.with_key(frame.payload)
            self._field.store(row, {"bus_keys": stored, "edition": frame.payload[8:12]})
            gate.edition = values[2]
            bus.take(stored)
            if not keyed:
                gate.replay.epoch = -1  # anyone may have set it
        return result


def stored(field: Field, row: int, number: int) -> bytes:
    """Return the reply to QUERY_STORED for an item number; b"" if the item is secret or unknown."""
    if not 0 < number <= len(journal.ITEMS):
        return b""
    name = journal.ITEMS[number - 1][0]
    return b"" if name in SECRET else field.journals.items(row).get(name, b"")
