"""The 12-byte packet of Malan's thesis, for controllers that understand no other.

From the thesis we have: twelve bytes; a 16-bit address; a byte for the type (Table D.1), of
which 0xD8 is the search of a target and the detection of motion; data; a checksum. **The rest is
ours, because the thesis's table was not at hand**: the order of the bytes, the other types, the
data in them, and that the checksum is the sum of the eleven bytes before it modulo 256. Before use
with a board that was built to the thesis, compare this table with its firmware::

    address (high, low)  type  data (8)  sum

A reader that looks for such a packet at every byte of a stream accepts false ones: one place in 256
has a matching sum by chance. Packets are therefore separated by silence on the line, as in Modbus
RTU: between two silences there are exactly twelve bytes with a matching sum, or nothing. A packet
damaged in one byte is always refused; damaged in several, still one in 256 passes. Hence version 2.

A packet has no sender, number, authority, expiry or MAC. ``to_packets`` leaves the head of a
command out and ``Joiner`` cannot restore it; a bridge to version 2 adds a head of its own. Messages
of class KEY have no packets: without a MAC nothing is stored. A message longer than eight bytes is
sent in parts of at most seven; the eighth byte of all its parts holds the same tag, which changes
from message to message, so that parts of two messages are never joined.
"""

import struct

from . import messages, ticks, wire

TYPE_CHECKING = False
if TYPE_CHECKING:  # for the type checker only: a microcontroller has no such module
    from typing import Any

SIZE = 12
DATA_SIZE = 8
#: Bits of a character on the line: start, eight, stop.
CHARACTER_BITS = 10
#: Silence that ends a packet, in characters.
GAP_CHARACTERS = 3.5

#: Microradian: the unit of the search's pitch and radius in a packet.
MICRO = 1e-6

#: Name of the message, and its parts as (type, codes of the data, big-endian).
PARTS = (
    ("QUERY_STEPS", ((0x01, ""),)),
    ("STEPS", ((0x81, "i"), (0x82, "i"), (0x83, "i"), (0x84, "i"))),
    ("QUERY_STATUS", ((0x03, ""),)),
    ("STATUS", ((0x85, "BIB"), (0x86, "I"), (0x87, "IHb"), (0x88, "IH"))),
    ("QUERY_POSITION", ((0x05, ""),)),
    ("POSITION", ((0x89, "f"), (0x8A, "f"), (0x8B, "f"))),
    ("QUERY_DIAGNOSIS", ((0x07, ""),)),
    ("DIAGNOSIS", ((0x8C, "Bi"), (0x8D, "i"), (0x8E, "f"), (0x8F, "f"))),
    ("ACK", ((0x0D, "HBB"),)),
    ("TIME", ((0x10, "HIB"),)),
    ("SUN", ((0x90, "I"), (0x91, "i"), (0x92, "i"), (0x93, "i"), (0x94, "hhh"))),
    ("DEFOCUS", ((0x20, ""),)),
    ("STOW", ((0x21, ""),)),
    ("APPROACH", ((0x30, ""),)),
    ("IDLE", ((0x31, ""),)),
    ("TRACK", ((0x32, ""),)),
    ("REFOCUS", ((0x33, ""),)),
    ("UNLOCK", ((0x34, ""),)),
    ("CLEAR_FAULT", ((0x35, ""),)),
    ("LOCK", ((0x36, ""),)),
    ("AIM", ((0x95, "f"), (0x96, "f"), (0x97, "f"))),
    ("LOCK_AIM", ((0x41, "B"),)),
    ("JOG", ((0x42, "Bi"),)),
    ("GOTO", ((0x43, "ii"),)),
    ("ROUGH", ((0x44, "B"),)),
    ("STANDBY", ((0x98, "f"), (0x99, "f"), (0x9A, "f"))),
)
#: One type for both, as in the thesis; the first byte of the data says which.
SEARCH_OR_DIAGNOSE = 0xD8
KINDS = ("SEARCH", "DIAGNOSE")

ROW_OF_NAME = {row[0]: row for row in PARTS}
PLACE_OF_TYPE = {part[0]: (row, place) for row in PARTS for place, part in enumerate(row[1])}


def checksum(data: bytes) -> int:
    """Return the sum of bytes modulo 256."""
    return sum(data) & 0xFF


def build(address: int, kind: int, data: bytes) -> bytes:
    """Return a packet; ``data`` of at most eight bytes is padded with zeros.

    Raises
    ------
    ValueError
        An address or a type out of range, or too much data.
    """
    if not 0 <= address <= 0xFFFF or not 0 <= kind <= 0xFF or len(data) > DATA_SIZE:
        raise ValueError(
            f"packet to {address}, type {kind}, {len(data)} bytes of data: the address must be "
            f"0 to 65535, the type 0 to 255, the data at most {DATA_SIZE} bytes"
        )
    packet = struct.pack(">HB", address, kind) + data + bytes(DATA_SIZE - len(data))
    return packet + bytes([checksum(packet)])


def parse(packet: bytes) -> "tuple[int, int, bytes] | None":
    """Return address, type and data of a packet; None if its length or its sum is wrong."""
    if len(packet) != SIZE or checksum(packet[:-1]) != packet[-1]:
        return None
    address, kind = struct.unpack(">HB", packet[:3])
    return address, kind, bytes(packet[3:-1])


def to_packets(address: int, name: str, values: "tuple[Any, ...]", tag: int = 0) -> "list[bytes]":
    """Write a message of version 2 as packets.

    Parameters
    ----------
    address
        Of the local controller: the receiver of a command, the sender of an answer.
    name
        Name of the message.
    values
        Its numbers without the head.
    tag
        0 to 255, different from that of the last message of the same name to that address.

    Raises
    ------
    ValueError
        A message that has no packet, or numbers that do not fit it.
    """
    if name in KINDS:
        data = struct.pack(">B", KINDS.index(name))
        if name == "SEARCH":
            pitch, radius = [int(value / MICRO + 0.5) for value in values]
            if not 0 <= pitch <= 0xFFFF or not 0 <= radius <= 0xFFFFFFFF:
                raise ValueError(f"SEARCH: pitch {values[0]} rad: must be 0 to 0.065535")
            data += struct.pack(">HI", pitch, radius)
        return [build(address, SEARCH_OR_DIAGNOSE, data)]
    if name not in ROW_OF_NAME:
        raise ValueError(f"{name}: no 12-byte packet holds it; send it by version 2")
    head = (0, 0) if messages.who_of(messages.NUMBER_OF[name]) == messages.AUTHORITY else ()
    wire.pack(name, *(head + tuple(values)))
    parts = ROW_OF_NAME[name][1]
    packets = []
    start = 0
    for kind, codes in parts:
        data = struct.pack(">" + codes, *values[start : start + len(codes)])
        if len(parts) > 1:
            data = data + bytes(DATA_SIZE - 1 - len(data)) + bytes([tag & 0xFF])
        packets.append(build(address, kind, data))
        start += len(codes)
    return packets


class Joiner:
    """Packets in, messages out: joins the parts of a message.

    The parts must come in order and without another packet of the same address between. It keeps
    the parts of one message only: on a polled bus no node interrupts another.
    """

    def __init__(self) -> None:
        self._forget()

    def _forget(self) -> None:
        self._address = -1
        self._name = ""
        self._tag = -1
        self._next = 0
        self._values: tuple[Any, ...] = ()

    def feed(self, packet: bytes) -> "tuple[int, str, tuple[Any, ...]] | None":
        """Take a packet, and return address, name and numbers of the message that it completes.

        Numbers come without the head of version 2. None: more parts are to come, or the packet
        is damaged, of an unknown type, or out of order.
        """
        parsed = parse(packet)
        if parsed is None:
            return None
        address, kind, data = parsed
        if kind == SEARCH_OR_DIAGNOSE:
            return _search_or_diagnose(address, data)
        if kind not in PLACE_OF_TYPE:
            return None
        (name, parts), place = PLACE_OF_TYPE[kind]
        codes = ">" + parts[place][1]
        values = struct.unpack(codes, data[: struct.calcsize(codes)])
        if not wire.finite(values):
            self._forget()
            return None
        if len(parts) == 1:
            return address, name, values
        if place == 0:
            self._forget()
            self._address, self._name, self._tag = address, name, data[-1]
        elif (address, name, data[-1], place) != (self._address, self._name, self._tag, self._next):
            self._forget()
            return None
        self._values = self._values + tuple(values)
        self._next = place + 1
        if self._next < len(parts):
            return None
        whole = self._values
        self._forget()
        return address, name, whole


def _search_or_diagnose(address: int, data: bytes) -> "tuple[int, str, tuple[Any, ...]] | None":
    if data[0] >= len(KINDS):
        return None
    if KINDS[data[0]] == "DIAGNOSE":
        return address, "DIAGNOSE", ()
    pitch, radius = struct.unpack(">HI", data[1:7])
    return address, "SEARCH", (pitch * MICRO, radius * MICRO)


class Splitter:
    """Bytes with their times in, packets out, separated by silence.

    Parameters
    ----------
    character_us
        Time of a character on the line, µs: 10 bits / rate (1042 at 9600 baud).
    gap_us
        Silence that ends a packet, µs; by default 3.5 characters.

    Attributes
    ----------
    good
        Packets received.
    bad
        Runs of bytes between two silences that were not packets.
    """

    def __init__(self, character_us: int, gap_us: int = 0) -> None:
        self.good = 0
        self.bad = 0
        self._character_us = character_us
        self._gap_us = gap_us or int(GAP_CHARACTERS * character_us)
        self._kept = b""
        self._length = 0
        self._end = 0

    def feed(self, tick: int, data: bytes = b"") -> "list[bytes]":
        """Take bytes that came without a pause, and return the packet that a silence ended.

        Parameters
        ----------
        tick
            When the first of the bytes began, µs modulo 2^30. They must not be older than the
            length of the silence: read the line at least that often.
        data
            The bytes; empty to report the time only.
        """
        silence = ticks.diff(tick, self._end)
        packets = []
        # Far before the last end is not an overlap but a counter that wrapped in a long silence.
        if self._length and (silence >= self._gap_us or silence < -SIZE * self._character_us):
            if self._length == SIZE and parse(self._kept) is not None:
                packets.append(self._kept)
                self.good += 1
            else:
                self.bad += 1
            self._kept = b""
            self._length = 0
        if data:
            self._length = min(self._length + len(data), SIZE + 1)
            self._kept = (self._kept + bytes(data))[:SIZE]
            self._end = ticks.add(tick, len(data) * self._character_us)
        return packets
