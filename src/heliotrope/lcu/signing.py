"""Signed frames of a bus: the keys of a local controller, and protection against old frames.

A bus may have a key that its cluster and its local controllers share. A signed frame has version 3:
its last 8 bytes before the CRC are a tag, a truncated HMAC-SHA256 over a freshness value, header
and payload. The freshness value is not transmitted, because both ends know it:

- of SESSION to one address: the number that the receiver drew (sent in BUS), valid for one use;
- of SESSION to all: the epoch in its payload, and the count in its payload and header;
- of every other frame: the epoch of the last SESSION, and the 32-bit count of the frame, which the
  receiver completes from the 16 bits of its sequence.

A recorded frame is therefore refused, because its count has passed. After a start, a receiver knows
neither epoch nor count, and a recorded SESSION could set old values. The receiver therefore accepts
its first SESSION only with a tag over its own number, which nobody can have recorded. That number
is itself a tag, over the serial number, the boot count and a count of the numbers drawn. It never
repeats, and nobody without the key can predict it, so no board needs a source of random numbers.

The HMAC inputs for different purposes under one key differ in length: a frame has 16 bytes or more,
a number is drawn from 8 bytes, and a fingerprint is made from 2.

A board imports this module only when it has a key or receives one.
"""

import struct

from . import messages, wire

TYPE_CHECKING = False
if TYPE_CHECKING:  # for the type checker only; a microcontroller has no such modules
    from collections.abc import Callable
    from typing import Any

    Hash = Callable[[bytes], bytes]
    Pads = tuple[bytes, bytes]

KEY_SIZE = 16
NO_KEY = bytes(KEY_SIZE)


def pads_of(key: bytes) -> "Pads":
    """Return the two padded HMAC keys.

    They are kept because that halves the computing time here.
    """
    key += bytes(64 - len(key))
    return bytes([byte ^ 0x36 for byte in key]), bytes([byte ^ 0x5C for byte in key])


def tag(sha256: "Hash", pads: "Pads", data: bytes) -> bytes:
    """Return the first 8 bytes of HMAC-SHA256."""
    return sha256(pads[1] + sha256(pads[0] + data))[: wire.MAC_SIZE]


def counted(epoch: int, count: int) -> bytes:
    """Return the freshness value of a frame, from its epoch and count."""
    return struct.pack("<II", epoch, count & 0xFFFFFFFF)


def fingerprint(sha256: "Hash", pads: "Pads") -> int:
    """Return a number that identifies a key but reveals nothing about it; 0 means no key."""
    return int(struct.unpack("<I", tag(sha256, pads, b"id")[:4])[0]) or 1


def wrapped(sha256: "Hash", own_key: bytes, edition: int, key: bytes) -> bytes:
    """Return the bus key as encrypted in SET_BUS_KEY, or decrypt it.

    The key is combined by XOR with the HMAC-SHA256 of the edition under the local controller's key.
    An edition is used only once, so this is a one-time pad; the MAC of the message protects it from
    changes.
    """
    pad = wire.hmac_sha256(sha256, own_key, struct.pack("<I", edition))
    return bytes([key[place] ^ pad[place] for place in range(KEY_SIZE)])


class BusKeys:
    """The bus keys of a local controller: the newest key, and the old key during a key change.

    Parameters
    ----------
    sha256
        The hash function.
    own_key
        Key of the local controller, under which bus keys are sent to it.
    serial, boots
        Serial number and boot count of the local controller, for the numbers that it draws.

    Attributes
    ----------
    stored
        Both keys, newest first; zeros stand for no key.
    nonce
        The random number over which the next SESSION to this address must be signed.
    """

    def __init__(self, sha256: "Hash", own_key: bytes, serial: int, boots: int) -> None:
        self._sha256, self._own_key = sha256, own_key
        self._serial, self._boots = serial, boots
        self._drawn = 0
        self._pads: list[Pads] = []
        self.stored = NO_KEY + NO_KEY
        self.nonce = b""

    def take(self, stored: bytes) -> None:
        """Use these keys from now on."""
        self.stored = stored
        self._pads = [
            pads_of(key) for key in (stored[:KEY_SIZE], stored[KEY_SIZE:]) if key != NO_KEY
        ]
        self._draw()

    def with_key(self, payload: bytes) -> bytes:
        """Return the record to store after a SET_BUS_KEY.

        A new key is placed before the present key. Sending the present key again removes the old
        key, and zeros remove both keys.
        """
        edition = struct.unpack("<I", payload[8:12])[0]
        key = wrapped(self._sha256, self._own_key, edition, payload[12:])
        newest = self.stored[:KEY_SIZE]
        return key + (NO_KEY if key in (newest, NO_KEY) else newest)

    @property
    def keyed(self) -> bool:
        """Return whether there is a key."""
        return len(self._pads) > 0

    def told(self) -> "tuple[int, ...]":
        """Return the numbers of BUS: the random number, in two halves, and both fingerprints."""
        prints = [fingerprint(self._sha256, pads) for pads in self._pads] + [0, 0]
        high, low = struct.unpack("<II", self.nonce or bytes(8))
        return high, low, prints[0], prints[1]

    def judge(self, frame: "wire.Frame", values: "tuple[Any, ...]", replay: "wire.Replay") -> int:
        """Return DONE if a frame is signed as required; without a key, every frame passes."""
        if not self._pads:
            return messages.DONE
        alone = frame.number == wire.SESSION and frame.to != wire.BROADCAST
        if frame.version != wire.SIGNED:
            return messages.REFUSED_KEY
        if alone:
            fresh = self.nonce
        elif replay.epoch < 0:
            return messages.DUPLICATE
        elif frame.number == wire.SESSION:
            fresh = counted(values[0], values[1] << 16 | frame.sequence)
        else:
            fresh = counted(replay.epoch, replay.count + (frame.sequence - replay.count & 0xFFFF))
        data = fresh + frame.body()
        for pads in self._pads:
            if wire.same(tag(self._sha256, pads, data), frame.mac):
                if alone:
                    replay.epoch = -1
                    self._draw()
                return messages.DONE
        return messages.REFUSED_KEY

    def _draw(self) -> None:
        if self._pads:
            self._drawn = self._drawn + 1 & 0xFFFF
            data = struct.pack("<IHH", self._serial, self._boots, self._drawn)
            self.nonce = tag(self._sha256, self._pads[0], data)
