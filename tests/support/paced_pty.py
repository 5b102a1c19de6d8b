"""An RS485 bus of pseudo-terminals: bytes take the time that a UART needs for them.

`PacedBus` starts a process of its own that stands for the wire. It gives one path for each
station: a program opens it as its serial port. What a station writes, all others hear, each byte
ten bits after the one before it, in pieces of eight as a UART's buffer hands them on. Two that
speak at once spoil each other's bytes, as on a wire; nobody hears himself (an adapter with echo
off).

A pseudo-terminal alone carries bytes at once and without limit, so a master's timing that is too
tight, and a cycle that is too long, would not show.

::

    with PacedBus(stations=4, baud_rate=115200) as bus:
        master, *nodes = bus.paths
        ...
        print(bus.statistics())

Linux only. Python's own delays come on top: the wire is never faster than it says, and on a busy
machine slower.
"""

import argparse
import heapq
import itertools
import json
import os
import select
import subprocess
import sys
import time
import tty
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self

#: Start, eight data bits, stop.
_BITS = 10
#: What a UART hands on at once.
_PIECE = 8
#: Bytes of one station that wait for the wire; a station that has more waiting is not read.
_BACKLOG = 4096
#: The standard input of the wire's process: whatever comes asks for the counts.
_ASKED = 0


class PacedBus:
    """The wire, as a process; a context manager.

    Parameters
    ----------
    stations
        How many ports there are, at least two.
    baud_rate
        Bits in a second; a byte has ten.

    Attributes
    ----------
    paths
        Of the ports, one a station.
    """

    def __init__(self, stations: int = 2, baud_rate: int = 115200) -> None:
        if stations < 2 or baud_rate < 300:
            raise ValueError(f"{stations} stations at {baud_rate} baud make no bus")
        self._arguments = [sys.executable, __file__, str(stations), str(baud_rate)]
        self.paths: list[str] = []

    def __enter__(self) -> Self:
        self._process = subprocess.Popen(
            self._arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.paths = self._read()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()  # its end is the wire's end
        self._process.wait()
        self._process.stdout.close()

    def _read(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"the wire's process ended with {self._process.wait()}")
        return json.loads(line)

    def statistics(self) -> dict[str, Any]:
        """Return counts since the start.

        Returns
        -------
        dict
            ``bytes`` by station, as sent; ``spoilt`` bytes that collided; ``lost`` bytes that a
            station did not take; ``busy_s``, how long the wire was in use.
        """
        assert self._process.stdin is not None
        self._process.stdin.write("statistics\n")
        self._process.stdin.flush()
        found: dict[str, Any] = self._read()
        return found


@dataclass
class _Piece:
    """Some bytes on the wire, from one instant to another."""

    station: int
    data: bytes
    begin: float
    end: float
    spoilt: bool = False


@dataclass
class _Station:
    near: int
    far: int
    free_at: float = 0.0
    waiting: int = 0
    sent: int = 0
    last: "_Piece | None" = None


@dataclass
class _Wire:
    """Moves bytes between the stations, in time."""

    stations: list[_Station]
    byte: float
    spoilt: int = 0
    lost: int = 0
    busy: float = 0.0
    _under_way: list[tuple[float, int, _Piece]] = field(default_factory=list)
    _number: "itertools.count[int]" = field(default_factory=itertools.count)

    def take(self, number: int, now: float) -> None:
        """Put what a station has written on the wire."""
        station = self.stations[number]
        data = os.read(station.near, _BACKLOG - station.waiting)
        begin = max(now, station.free_at)
        for place in range(0, len(data), _PIECE):
            part = data[place : place + _PIECE]
            piece = _Piece(number, part, begin, begin + len(part) * self.byte)
            heapq.heappush(self._under_way, (piece.end, next(self._number), piece))
            begin = piece.end
        station.free_at = begin
        station.waiting += len(data)
        station.sent += len(data)
        self.busy += len(data) * self.byte

    def deliver(self, now: float) -> float | None:
        """Hand on what has come through, and return when the next piece will have."""
        while self._under_way:
            due, _, piece = self._under_way[0]
            if due > now:
                return due
            heapq.heappop(self._under_way)
            self._meet(piece)
            sender = self.stations[piece.station]
            sender.waiting -= len(piece.data)
            sender.last = piece
            data = piece.data
            if piece.spoilt:
                self.spoilt += len(data)
                data = bytes(byte & 0x55 for byte in data)
            for number, station in enumerate(self.stations):
                if number != piece.station:
                    self._hand(station, data)
        return None

    def _meet(self, piece: _Piece) -> None:
        """Spoil what was on the wire together with a piece."""
        others = [other for _, _, other in self._under_way]
        others += [station.last for station in self.stations if station.last is not None]
        for other in others:
            apart = other.end <= piece.begin or piece.end <= other.begin
            if other.station != piece.station and not apart:
                piece.spoilt = other.spoilt = True

    def _hand(self, station: _Station, data: bytes) -> None:
        try:
            self.lost += len(data) - os.write(station.near, data)
        except BlockingIOError:  # nobody reads there
            self.lost += len(data)

    def listening(self) -> dict[int, int]:
        """Return which of the stations' ends may be read now."""
        return {
            station.near: number
            for number, station in enumerate(self.stations)
            if station.waiting < _BACKLOG
        }

    def counts(self) -> dict[str, Any]:
        sent = [station.sent for station in self.stations]
        return {"bytes": sent, "spoilt": self.spoilt, "lost": self.lost, "busy_s": self.busy}


def _station() -> _Station:
    near, far = os.openpty()
    tty.setraw(far)  # held open, so that a program may come and go
    os.set_blocking(near, False)
    return _Station(near, far)


def main() -> None:
    """Be the wire until the standard input ends."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("stations", type=int)
    parser.add_argument("baud_rate", type=int)
    given = parser.parse_args()
    wire = _Wire([_station() for _ in range(given.stations)], _BITS / given.baud_rate)
    print(json.dumps([os.ttyname(station.far) for station in wire.stations]), flush=True)
    while True:
        due = wire.deliver(time.monotonic())
        ends = wire.listening()
        patience = None if due is None else max(0.0, due - time.monotonic())
        for ready in select.select([_ASKED, *ends], [], [], patience)[0]:
            if ready != _ASKED:
                wire.take(ends[ready], time.monotonic())
            elif os.read(_ASKED, 100):
                print(json.dumps(wire.counts()), flush=True)
            else:
                return


if __name__ == "__main__":
    main()
