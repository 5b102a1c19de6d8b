"""The sender's side of the bus protocol: numbers, frames and signatures; not on boards."""

import struct

from . import messages, wire

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

    Sign = Callable[[bytes], bytes]


class Sender:
    """Numbers and frames the messages of one sender; the counterpart of ``Gate``.

    Parameters
    ----------
    address
        Address of the sender.
    epoch
        Epoch, which must be greater than at any earlier start, such as the GPS second of the start.
    sha256
        The hash function, for messages of class KEY.

    Attributes
    ----------
    epoch, count
        Epoch and count of the last frame created.
    sign
        Function that returns the tag of bytes under the bus key (`signing.tag`); None if no frame
        is signed.
    """

    def __init__(
        self,
        address: int,
        epoch: int,
        sha256: "Callable[[bytes], bytes] | None" = None,
    ) -> None:
        self.address = address
        self.epoch = epoch
        self.count = 0
        self.sign: Sign | None = None
        self._sha256 = sha256

    def frame(self, to: int, name: str, *values: "Any", key: bytes = b"") -> bytes:
        """Return the next frame's bytes; class KEY needs ``key``, the receiver's key.

        Raises
        ------
        ValueError
            See ``pack`` and ``encode``.
        """
        return self._make(to, name, wire.pack(name, *values), key, self.sign)

    def session(self, token: int) -> bytes:
        """Return a SESSION for all, to be sent once a second; with ``token`` 0, no authority.

        The next epoch begins when at most 65536 numbers of the present epoch are left.
        """
        return self._session(wire.BROADCAST, token, self.sign)

    def session_to(self, address: int, token: int, number: bytes, sign: "Sign") -> bytes:
        """Return a SESSION for one address, signed over the random number of the receiver."""
        return self._session(address, token, sign, number)

    def _session(self, to: int, token: int, sign: "Sign | None", number: bytes = b"") -> bytes:
        if self.count >= 0xFFFF0000:
            self.epoch = (self.epoch + 1) & 0xFFFFFFFF
            self.count = 0
        upper = (self.count + 1) >> 16
        return self._make(
            to, "SESSION", wire.pack("SESSION", self.epoch, upper, token), b"", sign, number
        )

    def _make(
        self,
        to: int,
        name: str,
        payload: bytes,
        key: bytes,
        sign: "Sign | None",
        fresh: bytes = b"",
    ) -> bytes:
        number = messages.NUMBER_OF[name]
        frame = wire.Frame(to, self.address, (self.count + 1) & 0xFFFF, number, payload)
        who = messages.who_of(number)
        if who == messages.KEY and self._sha256 is not None:
            frame.mac = wire.authenticate(self._sha256, key, frame)
        elif who in (messages.AUTHORITY, messages.CLUSTER) and sign is not None:
            frame.version = wire.SIGNED
            fresh = fresh or struct.pack("<II", self.epoch, self.count + 1)
            frame.mac = sign(fresh + frame.body())
        data = wire.encode(frame)
        self.count += 1
        return data
