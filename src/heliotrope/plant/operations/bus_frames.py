"""Frames from a cluster's bus, recorded and decoded for an operator."""

import asyncio
import math
import struct
from collections.abc import Iterator
from typing import Any

from heliotrope.lcu import messages, wire
from heliotrope.links.messages import BUS_ENTRY, BUS_SENT, Answer
from heliotrope.plant import refusals
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.views import BusFrame

#: Longest wait for a recording, s, which takes five seconds and is sent within another second.
PATIENCE = 20.0
_HEAD = struct.calcsize(BUS_ENTRY)


async def record(plant: PlantController, cluster: str) -> tuple[BusFrame, ...]:
    """Record the frames of a cluster's bus for five seconds; return them, oldest first.

    They are decoded in a thread, because hundreds of frames take tens of milliseconds, which would
    delay leases.

    Raises
    ------
    UnknownNameError
        If there is no such cluster.
    RefusedError
        If the cluster does not record frames.
    """
    answer = await plant.ask_cluster(cluster, "frames", PATIENCE)
    if answer is None:
        problem = f"the cluster did not reply within {PATIENCE:g} s; check that it is connected"
        raise refusals.BUS_NOT_RECORDED.error(cluster=cluster, problem=problem)
    if "error" in answer.data:
        raise refusals.BUS_NOT_RECORDED.error(cluster=cluster, problem=answer.data["error"])
    try:
        return await asyncio.to_thread(decoded, answer)
    except (struct.error, TypeError, ValueError, AttributeError):
        problem = (
            "the cluster's reply cannot be read; check that the cluster and the plant run "
            "the same release"
        )
        raise refusals.BUS_NOT_RECORDED.error(cluster=cluster, problem=problem) from None


def decoded(answer: Answer) -> tuple[BusFrame, ...]:
    """Return the frames in a cluster's reply.

    Raises
    ------
    ValueError
        If the reply is truncated. Other decoding errors are raised if it is damaged in another way.
    """
    begin, names = float(answer.data["utc_s"]), dict(answer.data["names"])
    if not math.isfinite(begin):
        raise ValueError("its time is not finite")
    found: list[BusFrame] = []
    for seconds, way, data in _entries(answer.block):
        found += _shown(begin + seconds, "sent" if way == BUS_SENT else "received", data, names)
    return tuple(found)


def _entries(block: bytes) -> Iterator[tuple[float, int, bytes]]:
    at = 0
    while at < len(block):
        seconds, way, size = struct.unpack_from(BUS_ENTRY, block, at)
        at += _HEAD + size
        if at > len(block):
            raise ValueError("an entry is cut off")
        yield seconds, way, block[at - size : at]


def _shown(at: float, way: str, data: bytes, names: dict[str, Any]) -> Iterator[BusFrame]:
    """Yield the frames in some bytes; replies of several controllers may arrive together."""
    for piece in data.split(b"\0"):
        if not piece:
            continue
        (frame,) = wire.Reader().feed(piece + b"\0") or (None,)
        size = len(piece) + 1
        if frame is None:
            yield BusFrame(at, way, "", "damaged", 0, size, False, piece.hex())
            continue
        other = frame.to if way == "sent" else frame.sender
        whom = "all" if other == wire.BROADCAST else str(names.get(str(other), f"address {other}"))
        kind = frame.name or f"0x{frame.number:02X}"
        signed = frame.version == wire.SIGNED
        yield BusFrame(at, way, whom, kind, frame.sequence, size, signed, _text(frame))


def _text(frame: wire.Frame) -> str:
    """Return the fields of a frame by their names."""
    values = frame.values()
    if values is None:
        return frame.payload.hex()
    fields = messages.fields_of(frame.number)
    if len(fields) != len(values):  # a field of several numbers
        return f"{' '.join(fields)}: {' '.join(map(_number, values))}"
    return " ".join(f"{field}={_number(v)}" for field, v in zip(fields, values, strict=True))


def _number(value: Any) -> str:
    if isinstance(value, bytes | bytearray):
        return value.hex() or "-"
    return f"{value:.9g}" if isinstance(value, float) else str(value)
