"""The live stream: one message per second, created once for all viewers.

A new viewer gets the whole field, then only changed rows; `stream` defines the message format.

Messages are not queued, so a slow viewer misses messages and then gets the whole field again. Each
user has a few places, and the last places are reserved for users who may command.
"""

import asyncio
import contextlib
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.console.remote import RemotePlant
from heliotrope.console.stream import ROW, changed, message
from heliotrope.errors import HeliotropeError
from heliotrope.lcu import names as meanings
from heliotrope.plant.interface import BusyError, frame_of
from heliotrope.plant.operations.views import FieldFrame
from heliotrope.plant.orders.authority import Person, Role

#: Flags that change with every step or sun vector, and would change every row.
_RESTLESS = sum(1 << meanings.FLAGS.index(name) for name in ("MOVING", "SUN_FRESH"))
#: Flag of drives that are switched off at the heliostat, which confirms *out of service*.
_SWITCHED_OFF = 1 << meanings.FLAGS.index("LOCAL_SWITCH")


#: Number of streams of one person, and fraction of all places that is reserved for operators and
#: engineers.
OWN, RESERVED = 20, 0.2


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
    """Creates the messages, and wakes the waiting viewers for each message.

    Parameters
    ----------
    plant
        The running plant.
    period
        Interval between messages, s.
    most
        Maximum number of simultaneous viewers.
    """

    def __init__(self, plant: RemotePlant, period: float = 1.0, most: int = 200) -> None:
        self._plant, self._period, self._most = plant, period, most
        self._rows: npt.NDArray[Any] | None = None
        self._header: dict[str, Any] = {}
        self._whole = b""
        self.news = b""
        self.tick = 0
        #: Number of streams of each person.
        self._places = Counter[str]()
        self._turned, self._making = asyncio.Event(), asyncio.Lock()
        self._problem: str = ""

    async def run(self) -> None:
        """Create a message in each period while anyone is watching."""
        due = time.monotonic()
        while True:
            await asyncio.sleep(0.1 * self._period)
            if time.monotonic() < due:
                continue
            due = max(due + self._period, time.monotonic())
            if self._places:
                await self.make()

    async def make(self) -> None:
        """Create the next message."""
        async with self._making:
            try:
                value, blob = await self._plant.fetch("live")
            except HeliotropeError as error:
                # A plant that cannot be read is not shown; the page judges by the age of the last
                # message.
                self._problem = str(error)
                return
            self._take(value, blob)

    def _take(self, value: dict[str, Any], blob: bytes) -> None:
        rows, header = rows_of(frame_of(value["frame"], blob)), value["overview"]
        self.tick += 1
        # A viewer that joins now may get this message as the whole field, which is encoded only if
        # needed.
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

    @contextlib.contextmanager
    def place(self, who: Person) -> Iterator[None]:
        """Hold a place for one stream of a person during a block.

        Raises
        ------
        BusyError
            If the person has the maximum number of places, or all places open to them are taken.
        """
        most = self._most if who.role >= Role.OPERATOR else round(self._most * (1.0 - RESERVED))
        if self._places[who.name] >= OWN:
            raise BusyError(f"{OWN} streams of {who.name} are already open; close one")
        if self._places.total() >= most:
            raise BusyError(f"{most} streams are already open; close one")
        self._places[who.name] += 1
        try:
            yield
        finally:
            self._places -= Counter([who.name])

    async def follow(self, send: Callable[[bytes], Any]) -> None:
        """Send messages to one viewer until cancelled."""
        if self._places.total() == 1:
            await self.make()
        data = await self.whole()
        sent = self.tick if data else -1
        if data:
            await send(data)
        while True:
            await self._turned.wait()
            data = self.news if self.tick == sent + 1 else await self.whole()
            sent = self.tick
            await send(data)
