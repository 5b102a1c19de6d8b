"""A bus whose stations are heliostats of a vectorised field; a frame takes microseconds.

One `FieldBus` is the bus of one cluster. It replies to QUERY_STATUS and QUERY_STEPS, receives SUN,
and passes commands on to the `Field`. It has no noise, and checks frames only if it is given the
keys of its local controllers (`Gates`). Boards (`twin.boards`) on a `TwinBus` have noise and gates,
and support all other messages.
"""

import asyncio
import struct
from binascii import crc32
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.lcu import journal, messages, states, wire
from heliotrope.links.link import LinkClosedError, SendOutcome
from heliotrope.twin.field.field import LEASE_MS, Field
from heliotrope.twin.field.gates import Gates, stored

_HEADER = struct.Struct(wire.HEADER)
_SUN, _AIM = struct.Struct("<Iiiihhh"), struct.Struct("<fff")
_ACK = struct.Struct("<" + messages.codes_of(messages.NUMBER_OF["ACK"]))
_BUS = struct.Struct("<" + messages.codes_of(messages.NUMBER_OF["BUS"]))
_STEPS = struct.Struct("<" + messages.codes_of(messages.NUMBER_OF["STEPS"]))
_NUMBERS = messages.NUMBER_OF
#: `messages.name_of` searches a string, which suits a microcontroller.
_NAMES = {number: name for name, number in messages.NUMBER_OF.items()}
#: A STATUS for each heliostat: state, flags, fault, uptime, age of the sun, supply, temperature,
#: checksum of the armature, boots.
_STATUS = np.dtype(
    [(f"f{i}", f"<{code}") for i, code in enumerate(messages.codes_of(_NUMBERS["STATUS"]))]
)
#: Bits of `lcu.names.FLAGS`: sun fresh; clock set, configured; ready; at stow.
_SUN_FRESH, _SOUND, _READY, _AT_STOW = 1 << 1, 0b1100, 1 << 4, 1 << 5
_NEVER = 0xFFFFFFFF
#: Size of a keyed message's header, and the position of the edition in it.
_KEY_HEAD = struct.calcsize("<" + messages.HEADS[messages.KEY][0])
_EDITION = slice(_KEY_HEAD - 4, _KEY_HEAD)
#: Calibration messages with the states that accept them, and the states that accept all other
#: messages.
_TAKES_ALL = (states.LOCKED, states.FAULT)
_TAKES_POSE = (*_TAKES_ALL, states.STOWED)
_TAKES_HARMLESS = (*_TAKES_POSE, states.IDLE, states.DEFOCUSED)
_TAKES = {
    "SET_ARMATURE": _TAKES_POSE,
    "SET_BIAS": _TAKES_POSE,
    "SET_POSITION": _TAKES_HARMLESS,
    "SET_DEFOCUS": _TAKES_HARMLESS,
}
#: Messages that need no gate: those that anyone may send, and queries.
_OPEN = frozenset(
    name
    for number, name in _NAMES.items()
    if name != "QUERY_BUS" and messages.who_of(number) in (messages.ANYONE, messages.ASK)
)
#: Commands that the field supports.
KNOWN = frozenset(
    {
        "DEFOCUS",
        "STOW",
        "APPROACH",
        "IDLE",
        "TRACK",
        "REFOCUS",
        "AIM",
        "LOCK",
        "UNLOCK",
        "CLEAR_FAULT",
    }
)


class FieldBus:
    """The bus of one cluster of a field; a `links.link.Bus`.

    Parameters
    ----------
    field
        The whole field.
    rows
        Indices of this cluster's heliostats in the field; their addresses are 1, 2, and so on.
    took
        Function called with each command's name and heliostat indices; None for no call.
    keys
        Key of each local controller, in the same order; with a key, a local controller has a gate
        and accepts a bus key. Without keys every valid frame is obeyed, signed or not.

    Attributes
    ----------
    plugged
        Whether the port is present.

    Raises
    ------
    InputError
        If indices are outside the field or empty, or there are keys for a different number of
        heliostats.
    """

    def __init__(
        self,
        field: Field,
        rows: range,
        took: "Callable[[str, range], None] | None" = None,
        keys: Sequence[bytes] = (),
    ) -> None:
        if not rows or not 0 <= min(rows) <= max(rows) < len(field):
            raise InputError(f"field bus: rows {rows} are not within 0 to {len(field) - 1}")
        if keys and len(keys) != len(rows):
            raise InputError(f"field bus: {len(keys)} keys for {len(rows)} heliostats")
        self.plugged = True
        self._field = field
        self._rows = rows
        self._all = np.array(rows)
        self._took = took
        self._gates = Gates(field, rows, keys) if keys else None
        self._closing = asyncio.Event()
        #: Payloads of every STATUS, and the edition of the field that they are valid for.
        self._status_payloads: list[bytes] = []
        self._edition = -1

    @property
    def connected(self) -> bool:
        """Whether the port is open."""
        return self.plugged and not self._closing.is_set()

    @property
    def closed(self) -> bool:
        """Whether the bus is closed permanently."""
        return self._closing.is_set()

    async def run(self) -> None:
        """Keep the port open until the bus is closed."""
        await self._closing.wait()

    async def close(self) -> None:
        """Close the bus permanently."""
        self._closing.set()

    async def transmit(
        self, frame: bytes, *, expires: float | None = None, urgent: bool = False
    ) -> SendOutcome:
        """Send a frame that expects no reply, and let the process's other buses take their turn."""
        del expires, urgent
        await asyncio.sleep(0)
        if self.closed:
            raise LinkClosedError("field bus: closed")
        if not self.plugged:
            return SendOutcome.DISCONNECTED
        self._hear(frame)
        return SendOutcome.SENT

    async def transact(
        self,
        frame: bytes,
        timeout: float,
        *,
        expires: float | None = None,
        urgent: bool = False,
        complete: Callable[[bytes], bool] | None = None,
    ) -> bytes:
        """Send a frame and return the reply; empty if there is none."""
        del timeout, expires, complete
        if urgent:
            # In an emergency all buses and the plant take turns.
            await asyncio.sleep(0)
        if self.closed:
            raise LinkClosedError("field bus: closed")
        return self._hear(frame) if self.plugged else b""

    def _hear(self, data: bytes) -> bytes:
        raw = _unstuffed(data)
        if len(raw) < wire.HEADER_SIZE + wire.CRC_SIZE:
            return b""
        version, to, _, sequence, number = _HEADER.unpack_from(raw)
        name = _NAMES.get(number, "")
        if self._gates is not None and self._gates.look():
            self._edition = -1
        if self._gates is not None and name not in _OPEN:
            return self._judged(self._gates, data)
        end = wire.CRC_SIZE + (wire.MAC_SIZE if version == wire.SIGNED else 0)
        payload = raw[wire.HEADER_SIZE : -end]
        if to == wire.BROADCAST:
            self._broadcast(name, payload, self._all)
            return b""
        place = to - 1
        if not 0 <= place < len(self._rows):
            return b""
        row = self._rows[place]
        if name == "QUERY_STATUS":
            return self._answer(place, sequence, "STATUS", self._statuses()[place])
        if name == "QUERY_STEPS":
            axes = self._field.axes[row]
            counts = _STEPS.pack(*axes["count"].tolist(), *axes["goal"].tolist())
            return self._answer(place, sequence, "STEPS", counts)
        return self._command(name, number, payload, place, sequence)

    def _judged(self, gates: Gates, data: bytes) -> bytes:
        """Pass a frame to the heliostats whose gates accept it, and return their reply."""
        frame = next(iter(wire.Reader().feed(data)), None)
        if frame is None:
            return b""
        name, number, sequence = frame.name, frame.number, frame.sequence
        self._edition = -1  # the reported flags may change
        if frame.to == wire.BROADCAST:
            good = [gates.judge(frame, k) == messages.DONE for k in range(len(self._rows))]
            if any(good):
                self._broadcast(name, frame.payload, self._all[good])
            return b""
        place = frame.to - 1
        if not 0 <= place < len(self._rows):
            return b""
        if name == "QUERY_BUS":
            return self._answer(place, sequence, "BUS", _BUS.pack(*gates.reported(place)))
        if name == "SET_BUS_KEY":
            result = gates.take_key(frame, place)
        else:
            result = gates.judge(frame, place)
            if result == messages.DONE and name != "SESSION":
                mac = frame.mac if messages.who_of(number) == messages.KEY else b""
                return self._command(name, number, frame.payload + mac, place, sequence)
        if name == "SESSION":
            return b""
        return self._answer(place, sequence, "ACK", _ACK.pack(sequence, number, result))

    def _broadcast(self, name: str, payload: bytes, rows: "npt.NDArray[np.intp]") -> None:
        if name == "SUN":
            self._field.take_sun(_SUN.unpack(payload), rows)
        elif name in ("DEFOCUS", "STOW"):
            self._field.order(name, self._all)
            self._tell(name, self._rows)
        else:
            self._field.hear(rows)

    def _tell(self, name: str, rows: range) -> None:
        if self._took is not None:
            self._took(name, rows)

    def _statuses(self) -> list[bytes]:
        """Return the STATUS payloads of the whole bus.

        A cluster requests them one after another, and nothing changes in between.
        """
        field = self._field
        if self._edition != field.edition:
            lease, state = field.leases(self._all), field.state[self._all]
            made = np.zeros(len(self._rows), dtype=_STATUS)
            fresh = lease > 0
            made["f0"] = np.maximum(state, 0)
            made["f1"] = _SOUND + _SUN_FRESH * fresh + _AT_STOW * field.at_stow(self._all)
            made["f1"] += (_READY * field.ready(self._all)).astype(np.uint32)
            made["f2"] = field.fault[self._all]
            made["f4"] = np.where(fresh, LEASE_MS - lease, _NEVER)
            made["f5"], made["f6"], made["f8"] = 24_000, 25, 1
            if self._gates is not None:
                made["f1"] += self._gates.flags()
                made["f8"] = self._gates.boots
            made["f7"] = field.journals.checksums[self._all]
            data, size = made.tobytes(), made.itemsize
            self._status_payloads = [data[i : i + size] for i in range(0, len(data), size)]
            self._edition = field.edition
        return self._status_payloads

    def _answer(self, place: int, sequence: int, name: str, payload: bytes) -> bytes:
        """Return a heliostat's reply frame; empty if the heliostat has no power."""
        if self._field.state[self._rows[place]] < 0:
            return b""
        head = _HEADER.pack(wire.VERSION, wire.CLUSTER_ADDRESS, place + 1, sequence, _NUMBERS[name])
        check = crc32(payload, crc32(head)).to_bytes(4, "little")
        if name != "STATUS":
            return _stuffed(head + payload + check) + b"\0"
        first, middle, last = _parts(payload)
        return _stuffed(head + first) + middle + _stuffed(last + check) + b"\0"

    def _command(self, name: str, number: int, payload: bytes, place: int, sequence: int) -> bytes:
        result, row = messages.REFUSED_STATE, self._rows[place]
        if name == "QUERY_STORED":
            item = stored(self._field, row, payload[0])
            return self._answer(place, sequence, "STORED", payload[:1] + item)
        if name == "STANDBY" or messages.who_of(number) == messages.KEY:
            result = self._store(name, number, payload, row)
        elif name in KNOWN:
            aim = _AIM.unpack_from(payload, 8) if name == "AIM" else None
            # Most have received the broadcast before and do nothing.
            idle = name == "DEFOCUS" and self._field.state[row] == states.DEFOCUSED
            if idle or self._field.order(name, self._all[place : place + 1], aim)[row]:
                result = messages.DONE
            self._tell(name, range(row, row + 1))
        return self._answer(place, sequence, "ACK", _ACK.pack(sequence, number, result))

    def _store(self, name: str, number: int, payload: bytes, row: int) -> int:
        if name == "STANDBY":
            self._field.store(row, {"standby": payload[8:20]})
            return messages.DONE
        state = int(self._field.state[row])
        if state not in _TAKES.get(name, _TAKES_ALL):
            return messages.REFUSED_STATE
        body = payload[: len(payload) - wire.MAC_SIZE]
        targets = journal.TARGETS.get(name, ())
        size = struct.calcsize("<" + messages.codes_of(number))
        if len(body) != size or not targets or name == "SET_ADDRESS":
            return messages.BAD_VALUE
        data = body[_KEY_HEAD:]
        if len(targets) == 2:
            axis, data = data[0], data[1:]
            targets = targets[axis : axis + 1]
        self._field.store(row, {targets[0]: data, "edition": body[_EDITION]})
        return messages.DONE


def _unstuffed(data: bytes) -> bytes:
    """Return the payload of stuffed bytes, the inverse of `_stuffed`; empty if they are invalid."""
    if data.find(0) != len(data) - 1:
        return b""
    out, place, end = bytearray(data), 0, len(data) - 1
    while place < end:
        code = out[place]
        out[place] = 0
        place += code
    return bytes(out[1:-1]) if place == end else b""


def _stuffed(data: bytes) -> bytes:
    """Return the result of `wire.stuff`, computed block by block instead of byte by byte.

    No frame is long enough (`wire.FRAME_LIMIT`) for a block of 254 bytes, so parts between zeros
    may be stuffed separately and joined.
    """
    return b"".join([_LENGTHS[len(block)] + block for block in data.split(b"\0")])


@lru_cache(maxsize=4096)
def _parts(payload: bytes) -> tuple[bytes, bytes, bytes]:
    """Split a payload at its first and last zero; return the three parts, the middle one stuffed.

    A field's heliostats stay in the same state for hours, so few payloads differ. Each has at least
    two zeros, since a STATUS of a field reports no uptime.
    """
    first, _, rest = payload.partition(b"\0")
    middle, _, last = rest.rpartition(b"\0")
    return first, _stuffed(middle), last


_LENGTHS = [bytes([length + 1]) for length in range(wire.FRAME_LIMIT)]
