"""Frames of the bus protocol, version 2, and a gate that decides which frames may act.

A frame, before byte stuffing (numbers little-endian)::

    version  to  from  sequence  type  payload  [MAC]  CRC-32
       1      2    2       2       1   0..236     8       4      bytes

COBS removes every zero from the frame, and a zero ends it. ``from`` 0 is the cluster controller,
``to`` 0xFFFF addresses all. Only messages of class KEY have a MAC. The CRC covers all bytes before
it. A receiver that starts in the middle of a frame, or receives noise, is in step again at the next
zero; a sender may begin with a zero to end any preceding noise.

**Old frames.** Sequence numbers alone cannot distinguish a sender's restart, or a link that comes
back after an hour, from a replay. The sender therefore keeps a 32-bit count of its frames. The
lower 16 bits are the sequence, and once a second the sender broadcasts SESSION with the upper 16
bits, its epoch and the token of the one authority. The epoch increases with every start of the
sender (the GPS second of the start is suitable, and needs no memory) and whenever the count is used
up. A receiver accepts a SESSION whose (epoch, count) is greater than the last accepted pair, and
between SESSIONs each frame whose sequence is 1 to 32767 after the last accepted one. After a
restart of the receiver, or 10 s of silence (in which the bus carries far fewer than 32768 frames),
it accepts nothing but a SESSION at first. Frames from before a sender's restart that are still in
transit are refused because of their token, which changes with the epoch. A sender whose commands
are answered "duplicate" for any other reason starts a new epoch.

Messages that act have two further safeguards: they expire by the clock, within a time in which the
sequence cannot wrap, and messages that change stored settings carry a MAC and an edition that only
increases. DEFOCUS and STOW have no such safeguard, and queries change nothing. This prevents
accidents. Against an intruder on the bus only the MAC protects, and it covers only the stored
settings.

The hash function is injected: ``sha256(data) -> 32 bytes``.
"""

import math
import struct
from binascii import crc32

from . import messages, ticks

TYPE_CHECKING = False
if TYPE_CHECKING:  # for the type checker only; a microcontroller has neither module
    from collections.abc import Callable
    from typing import Any, Protocol

    class Signatures(Protocol):
        """Bus keys; see ``signing``."""

        @property
        def keyed(self) -> bool:
            """Return whether there is a key."""

        def judge(self, frame: "Frame", values: "tuple[Any, ...]", replay: "Replay") -> int:
            """Return DONE if a frame is signed as required."""


VERSION = 2
#: Version of a frame that is signed with the bus key; see ``signing``.
SIGNED = 3
CLUSTER_ADDRESS = 0
SESSION = 0x12
BROADCAST = 0xFFFF

#: Longest frame with its stuffing and its zero, and the longest payload that this leaves, bytes.
FRAME_LIMIT = 250
MAC_SIZE = 8
HEADER = "<BHHHB"
HEADER_SIZE = 8
CRC_SIZE = 4
PAYLOAD_LIMIT = FRAME_LIMIT - 2 - HEADER_SIZE - CRC_SIZE

#: Longest lifetime of a command, s. On the fastest bus, fewer than half of the sequence numbers are
#: used in this time, so an earlier command is either old by its number or expired.
HORIZON_S = 30
#: After this much silence from a sender, its next frame must be a SESSION, ms.
SILENCE_MS = 10000

RANGES = {
    "B": (0, 255),
    "b": (-128, 127),
    "H": (0, 65535),
    "h": (-32768, 32767),
    "I": (0, 4294967295),
    "i": (-2147483648, 2147483647),
}
LARGEST_SINGLE = 3.4028234663852886e38
LARGEST_DOUBLE = 1.7976931348623157e308


def stuff(data: bytes) -> bytes:
    """Return ``data`` without zeros (consistent overhead byte stuffing) and without terminator."""
    out = bytearray()
    start = 0
    while True:
        end = data.find(b"\0", start, start + 254)
        if end >= 0:
            out.append(end - start + 1)
            out += data[start:end]
            start = end + 1
        elif len(data) - start >= 254:
            out.append(255)
            out += data[start : start + 254]
            start += 254
            if start == len(data):
                return bytes(out)
        else:
            out.append(len(data) - start + 1)
            out += data[start:]
            return bytes(out)


def unstuff(data: bytes) -> "bytes | None":
    """Undo ``stuff``; return None if ``data`` cannot be its result."""
    out = bytearray()
    start = 0
    size = len(data)
    while start < size:
        code = data[start]
        end = start + code
        if code == 0 or end > size:
            return None
        out += data[start + 1 : end]
        if code < 255 and end < size:
            out.append(0)
        start = end
    return bytes(out)


def _single(codes: str) -> str:
    """Expand counts in codes, such as "B3d" to "Bddd"."""
    out = ""
    count = ""
    for code in codes:
        if "0" <= code <= "9":
            count += code
        else:
            out += code * int(count or "1")
            count = ""
    return out


def _refusal(code: str, value: "Any") -> str:
    """Return the reason why a value does not fit a code; empty if it fits."""
    if code == "s":
        return "" if isinstance(value, (bytes, bytearray)) else f"{value!r} is not bytes"
    if code in RANGES:
        low, high = RANGES[code]
        if not isinstance(value, (int, bool)):
            return f"{value!r} is not a whole number"
        return "" if low <= value <= high else f"{value} is not within {low} to {high}"
    if not isinstance(value, int) and not (isinstance(value, float) and math.isfinite(value)):
        return f"{value!r} is not a finite number"
    limit = LARGEST_SINGLE if code == "f" else LARGEST_DOUBLE
    return "" if -limit <= value <= limit else f"{value} is not within {-limit} to {limit}"


def pack(name: str, *values: "Any") -> bytes:
    """Return the payload of a message, including its head.

    Parameters
    ----------
    name
        Name of the message, as in the table.
    *values
        All numbers of the message in order; fields with several numbers contribute one value per
        number.

    Raises
    ------
    ValueError
        If the name is unknown, the number of values is wrong, or a value does not fit its code.
        (MicroPython's ``struct`` would truncate the value silently.)
    """
    number = messages.NUMBER_OF.get(name)
    if number is None:
        raise ValueError(f"no message {name!r}; see the table in messages")
    codes = _single(messages.codes_of(number))
    if len(values) != len(codes):
        fields = " ".join(messages.fields_of(number))
        raise ValueError(f"{name}: {len(values)} values, {len(codes)} needed: {fields}")
    for place, code in enumerate(codes):
        refusal = _refusal(code, values[place])
        if refusal:
            raise ValueError(f"{name}, value {place + 1}: {refusal}")
    if codes.endswith("s"):
        return struct.pack("<" + codes[:-1], *values[:-1]) + bytes(values[-1])
    return struct.pack("<" + codes, *values)


def fits(number: int, size: int) -> bool:
    """Return whether a known message can have a payload of ``size`` bytes."""
    return _fits(messages.codes_of(number), size)


def _fits(codes: str, size: int) -> bool:
    if codes.endswith("s"):
        return size >= struct.calcsize("<" + codes[:-1])
    return size == struct.calcsize("<" + codes)


def finite(values: "tuple[Any, ...]") -> bool:
    """Return whether all numbers are finite."""
    return not any(isinstance(value, float) and not math.isfinite(value) for value in values)


def unpack(number: int, payload: bytes) -> "tuple[Any, ...] | None":
    """Read the payload of a message, including its head.

    Returns
    -------
    tuple or None
        The numbers as ``pack`` takes them; None if the message is unknown, the length is wrong, or
        a number is not finite (no sender intends such a number, and it would pass every
        comparison).
    """
    if messages.who_of(number) < 0:
        return None
    codes = messages.codes_of(number)
    if not _fits(codes, len(payload)):
        return None
    if codes.endswith("s"):
        size = struct.calcsize("<" + codes[:-1])
        head = struct.unpack("<" + codes[:-1], payload[:size])
        return tuple(head) + (bytes(payload[size:]),)
    values = struct.unpack("<" + codes, payload)
    return values if finite(values) else None


class Frame:
    """A complete frame.

    Attributes
    ----------
    to, sender, sequence, number
        Values from the header; ``number`` is the type of the message.
    payload
        Bytes with the head, without the MAC. In a known message its length is valid; in an unknown
        message the payload is everything before the CRC.
    mac
        8 bytes in messages of class KEY and in signed frames, otherwise b"".
    version
        ``VERSION`` or ``SIGNED``.
    """

    def __init__(
        self,
        to: int,
        sender: int,
        sequence: int,
        number: int,
        payload: bytes,
        mac: bytes = b"",
        version: int = VERSION,
    ) -> None:
        self.to = to
        self.sender = sender
        self.sequence = sequence
        self.number = number
        self.payload = payload
        self.mac = mac
        self.version = version
        self._values: tuple[Any, ...] | None = None

    @property
    def name(self) -> str:
        """Return the name of the message; empty if it is unknown."""
        return messages.name_of(self.number)

    def values(self) -> "tuple[Any, ...] | None":
        """Return the payload's numbers, which are parsed only once; see ``unpack``."""
        if self._values is None:
            self._values = unpack(self.number, self.payload)
        return self._values

    def body(self) -> bytes:
        """Return the bytes that the MAC covers, that is, header and payload."""
        return (
            struct.pack(HEADER, self.version, self.to, self.sender, self.sequence, self.number)
            + self.payload
        )

    def for_address(self, address: int) -> bool:
        """Return whether the frame is meant for ``address``."""
        return self.to in (address, BROADCAST)


def hmac_sha256(sha256: "Callable[[bytes], bytes]", key: bytes, data: bytes) -> bytes:
    """Return HMAC-SHA256 (RFC 2104), 32 bytes."""
    if len(key) > 64:
        key = sha256(key)
    key = key + bytes(64 - len(key))
    inner = sha256(bytes([byte ^ 0x36 for byte in key]) + data)
    return sha256(bytes([byte ^ 0x5C for byte in key]) + inner)


def authenticate(sha256: "Callable[[bytes], bytes]", key: bytes, frame: Frame) -> bytes:
    """Return the MAC of a frame: the first 8 bytes of HMAC-SHA256 over header and payload.

    Raises
    ------
    ValueError
        If the key is empty.
    """
    if not key:
        raise ValueError(f"{frame.name or frame.number}: needs a key to be sent")
    return hmac_sha256(sha256, key, frame.body())[:MAC_SIZE]


def verify(sha256: "Callable[[bytes], bytes]", key: bytes, frame: Frame) -> bool:
    """Return whether a frame carries the MAC of ``key``; always False with an empty key."""
    return bool(key) and same(authenticate(sha256, key, frame), frame.mac)


def same(expected: bytes, mac: bytes) -> bool:
    """Return whether two MACs are equal.

    All bytes are compared, even if the first bytes differ, so that timing reveals nothing.
    """
    if len(mac) != MAC_SIZE:
        return False
    differ = 0
    for place in range(MAC_SIZE):
        differ |= expected[place] ^ mac[place]
    return differ == 0


def encode(frame: Frame) -> bytes:
    """Return a frame's bytes as sent on the bus, including the final zero.

    Raises
    ------
    ValueError
        If an address, sequence or type is out of range; if a payload does not fit the message or
        the frame; if a MAC is missing from a message of class KEY, or present in another message.
    """
    what = frame.name or f"message {frame.number}"
    header = (("to", frame.to), ("from", frame.sender), ("sequence", frame.sequence))
    for title, value in header + (("type", frame.number),):
        refusal = _refusal("B" if title == "type" else "H", value)
        if refusal:
            raise ValueError(f"{what}: {title}: {refusal}")
    if frame.name and not fits(frame.number, len(frame.payload)):
        raise ValueError(f"{what}: a payload of {len(frame.payload)} bytes does not fit it")
    keyed = frame.version == SIGNED or messages.who_of(frame.number) == messages.KEY
    needs = MAC_SIZE if keyed else 0
    if len(frame.mac) != needs:
        raise ValueError(f"{what}: a MAC of {len(frame.mac)} bytes, {needs} needed")
    if len(frame.payload) + needs > PAYLOAD_LIMIT:
        raise ValueError(
            f"{what}: {len(frame.payload) + needs} bytes of payload and MAC, "
            f"at most {PAYLOAD_LIMIT} fit a frame"
        )
    return sealed(frame)


def sealed(frame: Frame) -> bytes:
    """Return the bytes, as sent on the bus, of a frame that is known to be valid."""
    data = frame.body() + frame.mac
    return stuff(data + struct.pack("<I", crc32(data))) + b"\0"


class Reader:
    """Accepts bytes in pieces of any size and returns complete frames.

    Attributes
    ----------
    good, crc, cobs, length, version
        Numbers of complete frames; wrong checksums; invalid stuffing; frames that are too long, too
        short, or of a length that does not fit their message; frames of another version. A frame
        that is not counted under ``good`` has no other effect. At most one frame's bytes are kept.
    """

    def __init__(self) -> None:
        self.good = 0
        self.crc = 0
        self.cobs = 0
        self.length = 0
        self.version = 0
        self._kept = bytearray()
        self._too_long = False

    def feed(self, data: bytes) -> "list[Frame]":
        """Accept received bytes and return the frames that these bytes complete."""
        data = bytes(data)
        frames: list[Frame] = []
        start = 0
        while True:
            end = data.find(b"\0", start)
            self._keep(data[start:] if end < 0 else data[start:end])
            if end < 0:
                return frames
            frame = self._end()
            if frame is not None:
                frames.append(frame)
            start = end + 1

    def _keep(self, piece: bytes) -> None:
        if len(self._kept) + len(piece) >= FRAME_LIMIT:
            self._too_long = True
            self._kept = bytearray()
        if not self._too_long:
            self._kept += piece

    def _end(self) -> "Frame | None":
        stuffed = bytes(self._kept)
        self._kept = bytearray()
        if self._too_long:
            self._too_long = False
            self.length += 1
            return None
        return self._decode(stuffed) if stuffed else None

    def _decode(self, stuffed: bytes) -> "Frame | None":
        data = unstuff(stuffed)
        if data is None:
            self.cobs += 1
            return None
        end = len(data) - CRC_SIZE
        if end < HEADER_SIZE:
            self.length += 1
            return None
        if struct.unpack("<I", data[end:])[0] != crc32(data[:end]):
            self.crc += 1
            return None
        version, to, sender, sequence, number = struct.unpack(HEADER, data[:HEADER_SIZE])
        if version not in (VERSION, SIGNED):
            self.version += 1
            return None
        mac = b""
        who = messages.who_of(number)
        if who == messages.KEY or version == SIGNED:
            end = max(HEADER_SIZE, end - MAC_SIZE)
            mac = data[end:-CRC_SIZE]
        payload = data[HEADER_SIZE:end]
        if who >= 0 and not fits(number, len(payload)):
            self.length += 1
            return None
        self.good += 1
        return Frame(to, sender, sequence, number, payload, mac, version)


def expired(expires_s: int, now_s: "int | None") -> bool:
    """Return whether a command has expired by the clock.

    Parameters
    ----------
    expires_s
        Last GPS second at which the command is valid, modulo 2^32.
    now_s
        The present GPS second, modulo 2^32; None if unknown, in which case every command is void.

    Notes
    -----
    A command valid for more than ``HORIZON_S`` is also void, because 32-bit numbers that wrap
    cannot distinguish the distant past from the distant future.
    """
    return now_s is None or ((expires_s - now_s) & 0xFFFFFFFF) > HORIZON_S


class Replay:
    """Decides which frames of one sender are new; see the docstring of this module.

    Attributes
    ----------
    epoch, count
        Epoch and count of the last accepted frame; ``epoch`` is -1 before the first SESSION.
    """

    def __init__(self) -> None:
        self.epoch = -1
        self.count = 0
        self._heard = ticks.Deadline()

    def session(self, epoch: int, rollover: int, sequence: int, tick: int) -> bool:
        """Accept a SESSION and return whether it is new.

        Parameters
        ----------
        epoch, rollover
            Values from the payload.
        sequence
            Sequence from the header.
        tick
            Time of arrival, ms; see ``ticks``.
        """
        count = (rollover << 16) | sequence
        if self.epoch >= 0:
            ahead = (epoch - self.epoch) & 0xFFFFFFFF
            if ahead >= 0x80000000 or (ahead == 0 and count <= self.count):
                return False
        self.epoch = epoch
        self.count = count
        self._heard.start(tick, SILENCE_MS)
        return True

    def look(self, tick: int) -> bool:
        """Return whether the sender was heard recently; for how often to call, see ``Deadline``."""
        return not self._heard.over(tick)

    def silent(self) -> bool:
        """Return whether the sender had been silent for too long at the last check."""
        return self._heard.left == 0

    def fresh(self, sequence: int, tick: int) -> bool:
        """Return whether a frame other than SESSION is new, and if so, record it."""
        if not self.look(tick):
            return False
        ahead = (sequence - self.count) & 0xFFFF
        if not 0 < ahead < 0x8000:
            return False
        self.count += ahead
        self._heard.start(tick, SILENCE_MS)
        return True


class Gate:
    """Decides whether a frame may act; ensures invariants 4 and 5.

    Parameters
    ----------
    sha256
        The hash function; None if nothing may be stored.
    key
        Key of this local controller; with b"", nothing can be stored.
    edition
        Edition of the last stored message, from the journal.
    sender
        Address from which commands come.

    Attributes
    ----------
    bus
        Bus keys; None if there are none, in which case no frame needs to be signed.
    token
        Token of the command authority; 0 if nobody holds it.
    edition
        Edition of the last stored message; the caller stores it together with the message's items.
    """

    def __init__(
        self,
        sha256: "Callable[[bytes], bytes] | None" = None,
        key: bytes = b"",
        edition: int = 0,
        sender: int = CLUSTER_ADDRESS,
    ) -> None:
        self.replay = Replay()
        self.bus: Signatures | None = None
        self.token = 0
        self.edition = edition
        self._sha256 = sha256
        self._key = key
        self._sender = sender

    def judge(self, frame: Frame, tick: int, now_s: "int | None") -> int:
        """Return DONE if the frame may act, otherwise the reason for its refusal.

        Parameters
        ----------
        frame
            A frame meant for this address.
        tick
            Time of arrival, ms.
        now_s
            The present GPS second; None if it is unknown.
        """
        who = messages.who_of(frame.number)
        self.replay.look(tick)
        if who in (messages.ANYONE, messages.ASK):
            return messages.DONE
        values = frame.values()
        if values is None or who == messages.NODE:
            return messages.BAD_VALUE
        if frame.sender != self._sender:
            return messages.REFUSED_AUTHORITY
        # A frame that anyone can have created must not count as the last one.
        refusal = messages.DONE
        if who == messages.KEY:
            refusal = self.judge_key(frame, values[2])
        elif self.bus is not None:
            refusal = self.bus.judge(frame, values, self.replay)
        if refusal != messages.DONE:
            return refusal
        if frame.number == SESSION:
            if not self.replay.session(values[0], values[1], frame.sequence, tick):
                return messages.DUPLICATE
            self.token = values[2]
            return messages.DONE
        if not self.replay.fresh(frame.sequence, tick):
            return messages.DUPLICATE
        if who == messages.CLUSTER:
            return messages.DONE
        if self.token == 0 or values[0] != self.token:
            return messages.REFUSED_AUTHORITY
        if expired(values[1], now_s):
            return messages.EXPIRED
        if who == messages.KEY:
            self.edition = values[2]
        return messages.DONE

    def keyed(self) -> bool:
        """Return whether frames must be signed."""
        return self.bus is not None and self.bus.keyed

    def waits(self) -> bool:
        """Return whether a SESSION signed over a random number drawn here is needed."""
        return self.keyed() and (self.replay.epoch < 0 or self.replay.silent())

    def judge_key(self, frame: Frame, edition: int) -> int:
        """Return DONE if a frame has the MAC of this controller's key and a new edition."""
        if self._sha256 is None or not verify(self._sha256, self._key, frame):
            return messages.REFUSED_KEY
        if edition <= self.edition:
            return messages.DUPLICATE
        return messages.DONE
