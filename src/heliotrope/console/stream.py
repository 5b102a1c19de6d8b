"""Messages of the live stream, written by the console and read by its clients.

A message is binary: the mark ``HLS1``, the length of a header (uint32), the header (JSON, padded
with spaces to a multiple of 4 bytes), then rows of `ROW`; all little-endian. The reference is
docs/reference/api-http.md.
"""

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.errors import HeliotropeError

MARK = b"HLS1"
ROW = np.dtype(
    [
        ("row", "<u4"),
        ("error", "<f4"),
        ("measured", "<f4"),
        ("calibrated", "<u4"),
        ("sightings", "<u2"),
        ("flags", "<u2"),
        ("state", "u1"),
        ("fault", "u1"),
        ("on", "u1"),
        ("held", "u1"),
    ]
)


class RemoteError(HeliotropeError):
    """The console refused a request.

    ``status`` is 0 if the console cannot be reached.
    """

    def __init__(self, text: str, status: int = 0) -> None:
        super().__init__(text)
        self.status = status


def changed(before: npt.NDArray[Any], after: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the rows of ``after`` that differ from ``before``; NaN equals NaN."""
    width = ROW.itemsize
    old = before.view(np.uint8).reshape(-1, width)
    new = after.view(np.uint8).reshape(-1, width)
    rows: npt.NDArray[Any] = after[(old != new).any(axis=1)]
    return rows


def message(header: dict[str, Any], rows: npt.NDArray[Any]) -> bytes:
    """Return a message of the stream."""
    text = json.dumps(header, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    return MARK + struct.pack("<I", len(text)) + text + rows.tobytes()


@dataclass(frozen=True)
class LiveMessage:
    """One message of the live stream: its header, and its rows."""

    header: Mapping[str, Any]
    rows: npt.NDArray[Any]


def read_message(data: bytes) -> LiveMessage:
    """Return a message of the live stream.

    Raises
    ------
    RemoteError
        If the bytes are not a message.
    """
    if len(data) < 8 or data[:4] != MARK:
        raise RemoteError(f"live stream: {len(data)} bytes that do not begin with {MARK.decode()}")
    (length,) = struct.unpack_from("<I", data, 4)
    rest = len(data) - 8 - length
    if rest < 0 or rest % ROW.itemsize:
        raise RemoteError(
            f"live stream: {rest} bytes after a header of {length} are not whole rows"
        )
    header = json.loads(data[8 : 8 + length])
    return LiveMessage(header, np.frombuffer(data, ROW, offset=8 + length))
