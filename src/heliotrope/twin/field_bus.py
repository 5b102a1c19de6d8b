"""A bus whose stations are rows of a vectorised field: frames in, frames out, in microseconds.

One `FieldBus` is one cluster's bus. It answers QUERY_STATUS and QUERY_STEPS, takes SUN, and passes
commands on to the `twin.field.Field`. There is neither noise nor a gate: for those, and for all
other messages, there are boards (`twin.board`) on a `twin.bus.TwinBus`.
"""

import asyncio
import struct
from binascii import crc32
from collections.abc import Callable

import numpy as np

from heliotrope.control.link import LinkClosedError, Outcome
from heliotrope.errors import InputError
from heliotrope.lcu import messages, states, wire
from heliotrope.twin.field import LEASE_MS, Field

_STATUS = struct.Struct(wire.HEADER + messages.codes_of(messages.NUMBER_OF["STATUS"]))
_STEPS = struct.Struct(wire.HEADER + messages.codes_of(messages.NUMBER_OF["STEPS"]))
_STATUS_NUMBER, _STEPS_NUMBER = messages.NUMBER_OF["STATUS"], messages.NUMBER_OF["STEPS"]
#: Bits of `lcu.names.FLAGS`: sun fresh, clock set, configured; at stow.
_SUN_FRESH, _SOUND, _AT_STOW = 1 << 1, 0b1100, 1 << 5
_NEVER = 0xFFFFFFFF
#: Commands that the field knows.
KNOWN = frozenset({"DEFOCUS", "STOW", "APPROACH", "IDLE", "TRACK", "REFOCUS", "AIM"})


class FieldBus:
    """The bus of one cluster of a field; a `control.link.Bus`.

    Parameters
    ----------
    field
        The whole field.
    rows
        Heliostats of this cluster, places in the field; their addresses are 1, 2, and so on.
    took
        Called with a command's name and the rows that it was for; None: nobody asks.

    Attributes
    ----------
    plugged
        Whether the port is there.

    Raises
    ------
    InputError
        Rows that are not of the field, or none.
    """

    def __init__(
        self,
        field: Field,
        rows: range,
        took: "Callable[[str, range], None] | None" = None,
    ) -> None:
        if not rows or not 0 <= min(rows) <= max(rows) < len(field):
            raise InputError(f"field bus: rows {rows} are not within 0 to {len(field) - 1}")
        self.plugged = True
        self._field = field
        self._rows = rows
        self._all = np.array(rows)
        self._took = took
        self._closing = asyncio.Event()

    @property
    def connected(self) -> bool:
        """Whether the port is open."""
        return self.plugged and not self._closing.is_set()

    @property
    def closed(self) -> bool:
        """Whether it was closed for good."""
        return self._closing.is_set()

    async def run(self) -> None:
        """Keep the port open until the bus is closed."""
        await self._closing.wait()

    async def close(self) -> None:
        """Close it for good."""
        self._closing.set()

    async def transmit(
        self, frame: bytes, *, expires: float | None = None, urgent: bool = False
    ) -> Outcome:
        """Send a frame that nobody answers."""
        del expires, urgent
        if self.closed:
            raise LinkClosedError("field bus: it is closed")
        if not self.plugged:
            return Outcome.DISCONNECTED
        self._hear(frame)
        return Outcome.SENT

    async def transact(
        self,
        frame: bytes,
        timeout: float,
        *,
        expires: float | None = None,
        urgent: bool = False,
        complete: Callable[[bytes], bool] | None = None,
    ) -> bytes:
        """Send a frame and return what is answered, b"" if nothing is."""
        del timeout, expires, urgent, complete
        if self.closed:
            raise LinkClosedError("field bus: it is closed")
        return self._hear(frame) if self.plugged else b""

    def _hear(self, data: bytes) -> bytes:
        raw = wire.unstuff(data[:-1])
        if raw is None or len(raw) < wire.HEADER_SIZE + wire.CRC_SIZE:
            return b""
        _, to, _, sequence, number = struct.unpack_from(wire.HEADER, raw)
        name = messages.name_of(number)
        place = to - 1
        if to == wire.BROADCAST:
            self._broadcast(name, raw[wire.HEADER_SIZE : -wire.CRC_SIZE])
            return b""
        if not 0 <= place < len(self._rows):
            return b""
        row = self._rows[place]
        if name == "QUERY_STATUS":
            return self._status(row, to, sequence)
        if name == "QUERY_STEPS":
            axes = self._field.axes
            one, two = axes["count"][row].tolist()
            goals = axes["goal"][row].tolist()
            body = _STEPS.pack(
                wire.VERSION, wire.CLUSTER_ADDRESS, to, sequence, _STEPS_NUMBER, one, two, *goals
            )
            return _framed(body)
        return self._command(name, raw[wire.HEADER_SIZE : -wire.CRC_SIZE], row, to, sequence)

    def _broadcast(self, name: str, payload: bytes) -> None:
        if name == "SUN":
            self._field.take_sun(struct.unpack("<Iiiihhh", payload), self._all)
        elif name in ("DEFOCUS", "STOW"):
            self._field.order(name, self._all)
            self._tell(name, self._rows)

    def _tell(self, name: str, rows: range) -> None:
        if self._took is not None:
            self._took(name, rows)

    def _status(self, row: int, to: int, sequence: int) -> bytes:
        field = self._field
        left = field.lease_left(row)
        state = int(field.state[row])
        flags = _SOUND | (_SUN_FRESH if left > 0 else 0)
        flags |= _AT_STOW if state == states.STOWED else 0
        age = LEASE_MS - left if left > 0 else _NEVER
        body = _STATUS.pack(
            wire.VERSION, wire.CLUSTER_ADDRESS, to, sequence, _STATUS_NUMBER,
            state, flags, 0, 0, age, 24_000, 25, 0, 1,
        )  # fmt: skip
        return _framed(body)

    def _command(self, name: str, payload: bytes, row: int, to: int, sequence: int) -> bytes:
        result = messages.REFUSED_STATE
        if name in KNOWN:
            aim = struct.unpack_from("<fff", payload, 8) if name == "AIM" else None
            taken = self._field.order(name, np.array([row]), aim)
            result = messages.DONE if taken[row] else messages.REFUSED_STATE
            self._tell(name, range(row, row + 1))
        payload = wire.pack("ACK", sequence, messages.NUMBER_OF[name], result)
        ack = wire.Frame(wire.CLUSTER_ADDRESS, to, sequence, messages.NUMBER_OF["ACK"], payload)
        return wire.encode(ack)


def _framed(body: bytes) -> bytes:
    """Return a frame's bytes from what the checksum covers."""
    return wire.stuff(body + struct.pack("<I", crc32(body))) + b"\0"
