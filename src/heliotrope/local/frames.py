"""Frames of the local interface.

A frame is the mark ``HLP1``, the lengths of head and blob (uint32 each, little-endian), the head (a
JSON object) and the blob (bytes). A request has ``id``, ``call``, ``arguments`` and, if a console
sends it, ``for``: the person on whose behalf the request is made. A reply has the ``id`` with a
``value``, or with ``error`` (its kind) and ``text``. The first frame of a connection identifies the
caller: ``key`` or ``token``.
"""

import asyncio
import json
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from heliotrope.errors import HeliotropeError

MARK = b"HLP1"
_PREFIX = struct.Struct("<4sII")
PREFIX = _PREFIX.size
#: Largest head and blob of a request, bytes. Python parses JSON without letting other threads run;
#: a head of this size takes less than 0.1 s.
REQUEST_HEAD, REQUEST_BLOB = 1 << 20, 8 << 20
#: Largest head before the caller is known, bytes.
HELLO_HEAD = 4096
#: Number of bytes read at a time when a blob is skipped.
_PART = 1 << 16
#: Error kind for a defect in the program.
INTERNAL = "internal"
#: Largest head and blob of a reply, bytes.
ANSWER_HEAD, ANSWER_BLOB = 64 << 20, 64 << 20


class FrameError(HeliotropeError):
    """The bytes are not a frame, or the frame is too large."""


@dataclass(frozen=True)
class Frame:
    """One frame."""

    head: dict[str, Any]
    blob: bytes = b""


def pack(head: dict[str, Any], blob: bytes = b"") -> bytes:
    """Return the bytes of a frame."""
    text = json.dumps(head, separators=(",", ":"), allow_nan=False).encode()
    return _PREFIX.pack(MARK, len(text), len(blob)) + text + blob


def lengths(prefix: bytes, most_head: int, most_blob: int) -> tuple[int, int]:
    """Return the lengths of head and blob.

    Raises
    ------
    FrameError
        If the mark is wrong, or a length is above its limit.
    """
    mark, head, blob = _PREFIX.unpack(prefix)
    if mark != MARK:
        raise FrameError(f"local interface: bytes that do not begin with {MARK.decode()}")
    if head > most_head or blob > most_blob:
        raise FrameError(
            f"local interface: a frame with a head of {head} and a blob of {blob} bytes; the "
            f"limits are {most_head} and {most_blob}"
        )
    return head, blob


def head_of(data: bytes) -> dict[str, Any]:
    """Return the head of a frame.

    Raises
    ------
    FrameError
        If the head is not a JSON object, or contains a number or text that no reply could return:
        an infinite number, or half of a surrogate pair.
    """
    try:
        # As text, because json would accept surrogates and UTF-16 in bytes.
        head = json.loads(data.decode(), parse_constant=_no_number, parse_float=_number)
        if b"\\u" in data:
            json.dumps(head, ensure_ascii=False).encode()
    except (ValueError, RecursionError):
        raise FrameError(f"local interface: a head of {len(data)} bytes that is not JSON") from None
    if not isinstance(head, dict):
        raise FrameError("local interface: a head that is not a JSON object")
    return head


def _no_number(text: str) -> float:
    raise ValueError(text)


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


async def read_frame(
    reader: asyncio.StreamReader,
    most_head: int = ANSWER_HEAD,
    most_blob: int = ANSWER_BLOB,
    accepts: Callable[[dict[str, Any]], bool] = lambda _: True,
) -> Frame:
    """Read one frame; skip its blob unless ``accepts`` returns True for its head.

    Raises
    ------
    FrameError
        See `lengths` and `head_of`.
    EOFError
        If the connection ends.
    """
    head, blob = lengths(await reader.readexactly(PREFIX), most_head, most_blob)
    content = head_of(await reader.readexactly(head))
    if accepts(content):
        return Frame(content, await reader.readexactly(blob))
    while blob:
        blob -= len(await reader.readexactly(min(blob, _PART)))
    return Frame(content)
