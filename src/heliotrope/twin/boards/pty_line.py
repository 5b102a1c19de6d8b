"""The bus line as a pseudo-terminal, with boards at one end and a serial port at the other."""

import asyncio
import os
import tty
from collections.abc import Sequence

from heliotrope.links.clock import Clock
from heliotrope.twin.boards.bus import Station

#: Bytes that are read at once, and the longest unterminated frame that is kept.
_CHUNK, _LONGEST = 4096, 65_536


class PtyLine:
    """A pseudo-terminal with stations on it.

    Parameters
    ----------
    clock
        Clock whose monotonic time is the stations' time.
    stations
        Devices that receive every frame.

    Attributes
    ----------
    path
        Device to be opened as a serial port.
    """

    def __init__(self, clock: Clock, stations: Sequence[Station]) -> None:
        self._clock, self._stations = clock, tuple(stations)
        # The far end stays open here too; otherwise reads would fail while no program has it open.
        self._line, self._far = os.openpty()
        tty.setraw(self._far)
        os.set_blocking(self._line, False)
        self.path = os.ttyname(self._far)
        self._frame, self._closing = b"", asyncio.Event()

    async def run(self) -> None:
        """Let the stations receive and reply until the line is closed."""
        loop = asyncio.get_running_loop()
        loop.add_reader(self._line, self._read)
        try:
            await self._closing.wait()
        finally:
            loop.remove_reader(self._line)
            os.close(self._line)
            os.close(self._far)

    async def close(self) -> None:
        """Close the line permanently."""
        self._closing.set()

    def _read(self) -> None:
        *frames, rest = (self._frame + os.read(self._line, _CHUNK)).split(b"\0")
        self._frame = rest[-_LONGEST:]
        for frame in frames:
            for station in self._stations:
                answer = station.hear(frame + b"\0", self._clock.monotonic())
                if answer:
                    os.write(self._line, answer)
