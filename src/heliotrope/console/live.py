"""The live stream: one message a second, made once for all who look.

Who comes gets the whole field, then only rows that changed. A message is binary: the mark
``HLS1``, the length of a header (uint32), the header (JSON, padded with spaces to a multiple of
4 bytes), then rows of `ROW`; all little-endian. The reference stands in docs/reference/api-http.md.

A viewer that is slow misses messages, and then gets the whole field again: nothing is queued.
"""

import asyncio
import json
import struct
import time
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.console.models import plain
from heliotrope.errors import HeliotropeError
from heliotrope.lcu import names as meanings
from heliotrope.plant.operations.operations import Operations

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
#: Flags that come and go with every step or sun vector: they would make every row change.
_RESTLESS = sum(1 << meanings.FLAGS.index(name) for name in ("MOVING", "SUN_FRESH"))
#: Health of a cluster as the page colours it.
WELL, TROUBLED, SILENT = 0, 1, 2


def rows_of(operations: Operations) -> npt.NDArray[Any]:
    """Return the field as rows of `ROW`, (N,)."""
    frame = operations.frame()
    rows = np.zeros(len(frame.state), ROW)
    rows["row"] = np.arange(len(rows))
    rows["error"], rows["measured"] = frame.error, frame.measured
    rows["calibrated"] = np.nan_to_num(frame.calibrated_at, nan=0.0).astype(np.uint32)
    rows["sightings"] = np.minimum(frame.sightings, 65_535)
    rows["flags"] = frame.flags & (0xFFFF ^ _RESTLESS)
    rows["state"], rows["fault"] = frame.state, frame.fault
    rows["on"], rows["held"] = frame.on, frame.held
    return rows


def changed(before: npt.NDArray[Any], after: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the rows of ``after`` that differ; NaN is the same as NaN."""
    width = ROW.itemsize
    one = before.view(np.uint8).reshape(-1, width)
    other = after.view(np.uint8).reshape(-1, width)
    found: npt.NDArray[Any] = after[(one != other).any(axis=1)]
    return found


def message(header: dict[str, Any], rows: npt.NDArray[Any]) -> bytes:
    """Return a message of the stream."""
    text = json.dumps(header, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    return MARK + struct.pack("<I", len(text)) + text + rows.tobytes()


class Stream:
    """Makes the messages, and tells who waits that there is a new one.

    Parameters
    ----------
    operations
        What is shown.
    period
        Between messages, s.
    """

    def __init__(self, operations: Operations, period: float = 1.0) -> None:
        self._operations, self._period = operations, period
        self._rows: npt.NDArray[Any] | None = None
        self._header: dict[str, Any] = {}
        self._whole = b""
        self.news = b""
        self.tick = 0
        self.viewers = 0
        self._turned = asyncio.Event()
        self._problem: str = ""

    async def run(self) -> None:
        """Make a message each period, for as long as anybody looks.

        The period is of the people who look: a loop of a simulation may run faster.
        """
        due = time.monotonic()
        while True:
            await asyncio.sleep(0.1 * self._period)
            if time.monotonic() < due:
                continue
            due = max(due + self._period, time.monotonic())
            if self.viewers:
                self.make()

    def make(self) -> None:
        """Make the next message."""
        try:
            rows = rows_of(self._operations)
            header = header_of(self._operations)
        except HeliotropeError as error:
            # What cannot be read is not shown: the page tells by the age of the last message.
            self._problem = str(error)
            return
        self.tick += 1
        # Who joins now may get this one as the whole; it is encoded only if somebody does.
        header["tick"], header["problem"] = self.tick, self._problem
        news = rows if self._rows is None else changed(self._rows, rows)
        self.news = message({**header, "whole": self._rows is None}, news)
        self._header, self._rows, self._whole = header, rows, b""
        turned, self._turned = self._turned, asyncio.Event()
        turned.set()

    def whole(self) -> bytes:
        """Return the last message with all rows."""
        if self._rows is None:
            self.make()
        if not self._whole and self._rows is not None:
            self._whole = message({**self._header, "whole": True}, self._rows)
        return self._whole

    async def follow(
        self, send: Callable[[bytes], Any], allowed: Callable[[], Awaitable[bool]]
    ) -> None:
        """Send to one viewer for as long as they are allowed to look."""
        self.viewers += 1
        try:
            if self.viewers == 1:
                self.make()
            await send(self.whole())
            seen = self.tick
            while True:
                await self._turned.wait()
                if not await allowed():
                    return
                data = self.news if self.tick == seen + 1 else self.whole()
                seen = self.tick
                await send(data)
        finally:
            self.viewers -= 1


def header_of(operations: Operations) -> dict[str, Any]:
    """Return what a message tells besides the rows."""
    summary, light = operations.summary(), operations.sun()
    calibration = operations.calibration()
    quality = calibration.quality[-1] if calibration.quality else None
    cameras = {}
    for target in operations.targets:
        try:
            cameras[target] = operations.camera(target).version
        except HeliotropeError:
            continue
    found: dict[str, Any] = plain(summary)
    found |= {
        "utc": summary.at.timestamp(),
        "sun": {"azimuth": light.azimuth, "elevation": light.elevation},
        "surfaces": list(operations.aim_names),
        "clusters": [_health(row) for row in operations.cluster_rows()],
        "measuring": plain(list(calibration.running)),
        "calibration": {
            "on": calibration.on,
            "reason": calibration.reason,
            "done": calibration.done,
            "waiting": calibration.waiting,
            "failed": calibration.failed,
            "quality": plain(quality),
        },
        "cameras": cameras,
        "order": plain(operations.emergency_view()),
        "events": _newest(operations),
    }
    return found


def _newest(operations: Operations) -> float:
    """Return when the last event was, POSIX s; 0 before the first."""
    events = operations.events(1)
    return events[0].at if events else 0.0


def _health(row: Any) -> int:
    if not row.alive:
        return SILENT
    # NaN, not known yet, is no trouble.
    return TROUBLED if row.live < row.heliostats or row.answered < 0.95 or row.acts else WELL
