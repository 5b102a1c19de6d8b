"""The live stream: one message a second, made once for all viewers.

A new viewer gets the whole field, then only rows that changed; `stream` holds the messages' form.

A slow viewer misses messages, and then gets the whole field again: nothing is queued.
"""

import asyncio
import time
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.console.remote import RemotePlant
from heliotrope.console.stream import ROW, changed, message
from heliotrope.errors import HeliotropeError
from heliotrope.lcu import names as meanings
from heliotrope.plant.interface import frame_of
from heliotrope.plant.operations.views import FieldFrame

#: Flags that come and go with every step or sun vector, which would change every row.
_RESTLESS = sum(1 << meanings.FLAGS.index(name) for name in ("MOVING", "SUN_FRESH"))
#: Flag of drives that are switched off at the mirror: it confirms *out of service*.
_SWITCHED_OFF = 1 << meanings.FLAGS.index("LOCAL_SWITCH")


def rows_of(frame: FieldFrame) -> npt.NDArray[Any]:
    """Return the field as rows of `ROW`, (N,)."""
    rows = np.zeros(len(frame.state), ROW)
    rows["row"] = np.arange(len(rows))
    rows["error"], rows["measured"] = frame.error, frame.measured
    rows["calibrated"] = np.nan_to_num(frame.calibrated_at, nan=0.0).astype(np.uint32)
    rows["sightings"] = np.minimum(frame.sightings, 65_535)
    rows["flags"] = frame.flags & (0xFFFF ^ _RESTLESS)
    rows["state"], rows["fault"] = frame.state, frame.fault
    rows["on"], rows["held"] = frame.on, np.where(frame.flags & _SWITCHED_OFF, 2, 1) * frame.held
    return rows


class Stream:
    """The maker of the messages, which wakes the waiting viewers for each.

    Parameters
    ----------
    plant
        The plant at work.
    period
        Time between messages, s.
    """

    def __init__(self, plant: RemotePlant, period: float = 1.0) -> None:
        self._plant, self._period = plant, period
        self._rows: npt.NDArray[Any] | None = None
        self._header: dict[str, Any] = {}
        self._whole = b""
        self.news = b""
        self.tick = 0
        self.viewers = 0
        self._turned, self._making = asyncio.Event(), asyncio.Lock()
        self._problem: str = ""

    async def run(self) -> None:
        """Make a message each period while anybody is watching."""
        due = time.monotonic()
        while True:
            await asyncio.sleep(0.1 * self._period)
            if time.monotonic() < due:
                continue
            due = max(due + self._period, time.monotonic())
            if self.viewers:
                await self.make()

    async def make(self) -> None:
        """Make the next message."""
        async with self._making:
            try:
                value, blob = await self._plant.fetch("live")
            except HeliotropeError as error:
                # A plant that cannot be read is not shown: the page judges by the age of the last
                # message.
                self._problem = str(error)
                return
            self._take(value, blob)

    def _take(self, value: dict[str, Any], blob: bytes) -> None:
        rows, header = rows_of(frame_of(value["frame"], blob)), value["overview"]
        self.tick += 1
        # A viewer that joins now may get this one as the whole; it is encoded only if one does.
        header["tick"], header["problem"] = self.tick, self._problem
        news = rows if self._rows is None else changed(self._rows, rows)
        self.news = message({**header, "whole": self._rows is None}, news)
        self._header, self._rows, self._whole = header, rows, b""
        turned, self._turned = self._turned, asyncio.Event()
        turned.set()

    async def whole(self) -> bytes:
        """Return the last message with all rows."""
        if self._rows is None:
            await self.make()
        if not self._whole and self._rows is not None:
            self._whole = message({**self._header, "whole": True}, self._rows)
        return self._whole

    async def follow(
        self, send: Callable[[bytes], Any], allowed: Callable[[], Awaitable[bool]]
    ) -> None:
        """Send to one viewer for as long as they are allowed to watch."""
        self.viewers += 1
        try:
            if self.viewers == 1:
                await self.make()
            data = await self.whole()
            sent = self.tick if data else -1
            if data:
                await send(data)
            while True:
                await self._turned.wait()
                if not await allowed():
                    return
                data = self.news if self.tick == sent + 1 else await self.whole()
                sent = self.tick
                await send(data)
        finally:
            self.viewers -= 1
