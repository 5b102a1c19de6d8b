"""A satellite receiver as reported by gpsd: position, fix, and an independent time check.

gpsd reads the receiver and feeds chrony, which disciplines the computer's clock
(docs/how-to/time.md). A cluster takes its time from that clock. It listens to gpsd only to show the
receiver status and to detect disagreement between clock and receiver; a plant listens to gpsd as an
independent witness of its time and site.

`GpsdReader` converts bytes of gpsd's JSON protocol into a `SatelliteReceiver` without any input or
output; `Gpsd` keeps a connection open and feeds a reader.
"""

import asyncio
import json
import math
import random
from collections import deque
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from heliotrope.errors import FormatError
from heliotrope.links.clock import Clock, sleep_until
from heliotrope.links.link import Backoff, until_closed

PORT = 2947
_WATCH = b'?WATCH={"enable":true,"json":true};\n'
#: A line from gpsd has a few kB at most; a longer line does not come from gpsd.
_LONGEST_LINE = 65536
#: Lowest modes of a TPV report with a fix, and with a height.
_FIX_2D, _FIX_3D = 2, 3
#: A fix older than this counts as lost, s.
_FRESH = 5.0
#: The fastest of this many reports shows how far the clock is ahead, because any report may be read
#: late.
_REPORTS = 10
#: A missing fix is a problem after this time, s, because opening the receiver takes a moment.
_PATIENCE = 10.0
#: A connection silent for this long is reopened, s, because gpsd reports at least once a second.
_SILENCE = 30.0
_OPEN_LIMIT = 3.0
_FIRST_PAUSE, _LONGEST_PAUSE = 0.5, 10.0


def gpsd_at(path: Path, text: str, key: str) -> tuple[str, int]:
    """Return the host and port of gpsd, read from a key of a configuration file.

    Raises
    ------
    FormatError
        If the text is not a host with a port.
    """
    try:
        parts = urlsplit(f"//{text}")
        host, port = parts.hostname, parts.port or PORT
    except ValueError:
        host = None
    if not host or parts.path:
        raise FormatError(path, f"{text!r}: specify host or host:port of gpsd", key)
    return host, port


@dataclass(frozen=True)
class SatelliteReceiver:
    """State of a receiver.

    Attributes
    ----------
    device
        Name of the device in gpsd.
    mode
        0 or 1: no fix; 2: fix without height; 3: fix with height.
    utc_s
        POSIX seconds of the last fix; nan if there has been none.
    latitude_deg, longitude_deg, height_m
        Position of the last fix, with height above the ellipsoid; nan if unknown.
    used, seen
        Numbers of satellites used and seen.
    """

    device: str = ""
    mode: int = 0
    utc_s: float = math.nan
    latitude_deg: float = math.nan
    longitude_deg: float = math.nan
    height_m: float = math.nan
    used: int = 0
    seen: int = 0

    @property
    def fixed(self) -> bool:
        """Whether the last report contained a fix."""
        return self.mode >= _FIX_2D

    @property
    def text(self) -> str:
        """State in a few words, for a log."""
        kind = "3D fix" if self.mode >= _FIX_3D else "2D fix" if self.fixed else "no fix"
        place = ""
        if self.fixed and math.isfinite(self.latitude_deg + self.longitude_deg):
            place = f" at {self.latitude_deg:.5f}° {self.longitude_deg:.5f}°"
        return f"{kind}{place}, {self.used} of {self.seen} satellites"


class GpsdReader:
    """A parser of gpsd's JSON lines.

    Attributes
    ----------
    receiver
        Last reported state.
    error
        Last error reported by gpsd; empty if there is none.
    refused
        Number of received lines that cannot come from gpsd.
    """

    def __init__(self) -> None:
        self.receiver = SatelliteReceiver()
        self.error = ""
        self.refused = 0
        self._rest = b""

    def feed(self, data: bytes) -> bool:
        """Accept bytes and return whether they contained a new fix."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > _LONGEST_LINE:
            self._rest, self.refused = b"", self.refused + 1
        fixes = [self._take(line) for line in lines if line.strip()]
        return any(fixes)

    def _take(self, line: bytes) -> bool:
        try:
            report = json.loads(line)
            kind = report["class"]
            if kind == "TPV":
                return self._take_fix(report)
            if kind == "SKY" and "uSat" in report:
                self.receiver = replace(
                    self.receiver, used=int(report["uSat"]), seen=int(report.get("nSat", 0))
                )
            elif kind == "ERROR":
                self.error = str(report.get("message", ""))
        except (ValueError, TypeError, KeyError, OverflowError):
            self.refused += 1
        return False

    def _take_fix(self, report: dict[str, Any]) -> bool:
        """Accept a TPV report; return whether its time is new."""
        mode = int(report.get("mode", 0))
        device = str(report.get("device", self.receiver.device))
        if mode < _FIX_2D or "time" not in report:
            self.receiver = replace(self.receiver, device=device, mode=min(mode, 1))
            return False
        before = self.receiver.utc_s
        self.receiver = replace(
            self.receiver,
            device=device,
            mode=mode,
            utc_s=datetime.fromisoformat(report["time"]).timestamp(),
            latitude_deg=float(report.get("lat", math.nan)),
            longitude_deg=float(report.get("lon", math.nan)),
            height_m=float(report.get("altHAE", math.nan)),
        )
        self.error = ""
        return self.receiver.utc_s != before


class Gpsd:
    """A connection to gpsd.

    Parameters
    ----------
    host, port
        Address on which gpsd listens.
    clock
        Clock whose monotonic time measures the age of a fix.
    """

    def __init__(self, clock: Clock, host: str = "localhost", port: int = PORT) -> None:
        self._clock, self._host, self._port = clock, host, port
        self._reader = GpsdReader()
        #: UTC of each of the last fixes minus the monotonic time of its arrival, s.
        self._offsets: deque[float] = deque(maxlen=_REPORTS)
        self._fixed_at = -math.inf
        self._begun = clock.monotonic()
        self._trouble = "not connected yet"
        self._closing = asyncio.Event()

    @property
    def receiver(self) -> SatelliteReceiver:
        """State of the receiver; ``mode`` says "no fix" if there is no recent fix."""
        receiver = self._reader.receiver
        return receiver if self._fresh else replace(receiver, mode=min(receiver.mode, 1))

    @property
    def _fresh(self) -> bool:
        return self._clock.monotonic() - self._fixed_at <= _FRESH

    @property
    def ahead(self) -> float | None:
        """Time by which the computer's clock leads the receiver, s; None without a recent fix.

        The time includes the delay of the fastest recent report, a few tenths of a second.
        """
        if not self._fresh:
            return None
        receiver_utc = self._clock.monotonic() + max(self._offsets)
        return self._clock.utc().timestamp() - receiver_utc

    @property
    def problem(self) -> str:
        """Reason why there is no fix.

        It is empty with a fix, and while the first fix may still be pending.
        """
        now = self._clock.monotonic()
        if now - max(self._fixed_at, self._begun) <= _PATIENCE:
            return ""
        where = f"gpsd at {self._host}:{self._port}"
        if self._trouble:
            return f"{where}: {self._trouble}"
        if self._reader.error:
            return f"{where}: {self._reader.error}"
        return f"{where}: the receiver has no fix; does its antenna see the sky?"

    def hear(self, data: bytes) -> None:
        """Accept bytes just received from gpsd."""
        reader = self._reader
        if reader.feed(data):
            now = self._clock.monotonic()
            if now - self._fixed_at > _FRESH:
                self._offsets.clear()
            self._fixed_at = now
            self._offsets.append(reader.receiver.utc_s - now)

    async def run(self) -> None:
        """Keep the connection open until `close` is called."""
        await until_closed(self._closing, self._keep())

    async def close(self) -> None:
        """End ``run``."""
        self._closing.set()

    async def _keep(self) -> None:
        backoff = Backoff(_FIRST_PAUSE, _LONGEST_PAUSE, random.Random())
        while True:
            try:
                async with asyncio.timeout(_OPEN_LIMIT):
                    reader, writer = await asyncio.open_connection(self._host, self._port)
            except (OSError, TimeoutError) as error:
                self._trouble = f"no connection ({str(error) or 'timed out'})"
            else:
                await self._listen(reader, writer)
                backoff.reset()
            await sleep_until(self._clock, self._clock.monotonic() + backoff.next())

    async def _listen(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            writer.write(_WATCH)
            await writer.drain()
            self._trouble = ""
            while True:
                async with asyncio.timeout(_SILENCE):
                    data = await reader.read(_LONGEST_LINE)
                if not data:
                    self._trouble = "the connection was closed"
                    return
                self.hear(data)
        except TimeoutError:
            self._trouble = f"silent for {_SILENCE:g} s"
        except OSError as error:
            self._trouble = str(error)
        finally:
            writer.close()
