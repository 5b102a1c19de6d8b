"""Time from a satellite receiver at a serial port (NMEA 0183), or at a serial server.

`GpsTime` keeps the port open and hands every byte to a `DisciplinedClock`, which decides; see
discipline.py for what is believed, and docs/how-to/time.md for receivers and settings.
"""

import asyncio
import random
from dataclasses import dataclass, field

import serialx

from heliotrope.cluster.discipline import (
    DisciplinedClock,
    DisciplineSettings,
    DisciplineStatistics,
)
from heliotrope.cluster.timekeeping import Time
from heliotrope.errors import InputError
from heliotrope.links.clock import Clock, sleep_until
from heliotrope.links.link import Backoff, LinkError, until_closed

_BAUD_RATES = (1200, 921_600)
#: How often the computer's clock is looked at, in s.
_LOOK = 1.0


@dataclass(frozen=True)
class GpsSettings:
    """How a receiver is read.

    Parameters
    ----------
    baud_rate
        NMEA 0183 has 4800, most receivers 9600.
    silence
        A port on which nothing comes for this long is opened anew, in s: a serial server in the
        network may be gone without a word.
    discipline
        See `DisciplineSettings`.
    first_pause, longest_pause
        Between attempts to open the port, in s.
    open_limit
        For opening it, in s.

    Raises
    ------
    InputError
        A rate, a silence or pauses that no port has.
    """

    baud_rate: int = 9600
    silence: float = 10.0
    discipline: DisciplineSettings = field(default_factory=DisciplineSettings)
    first_pause: float = 0.2
    longest_pause: float = 5.0
    open_limit: float = 3.0

    def __post_init__(self) -> None:
        low, high = _BAUD_RATES
        if not low <= self.baud_rate <= high:
            raise InputError(f"GPS receiver: {self.baud_rate} baud; give {low} to {high}")
        if not self.silence > 0.0:
            raise InputError(f"GPS receiver: a silence of {self.silence} s; it must be above 0")
        if not 0.0 < self.first_pause <= self.longest_pause:
            raise InputError(
                f"GPS receiver: pauses of {self.first_pause} s to {self.longest_pause} s between "
                "attempts; the first must be above 0 and not above the longest"
            )


class _Port(asyncio.Protocol):
    """Hands on what comes, and notes when, and when the port is gone."""

    def __init__(self, clock: Clock, disciplined: DisciplinedClock) -> None:
        self._clock = clock
        self._disciplined = disciplined
        self.heard_at = clock.monotonic()
        self.lost = asyncio.Event()
        self.problem = ""

    def data_received(self, data: bytes) -> None:
        self.heard_at = self._clock.monotonic()
        self._disciplined.hear(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self.problem = str(exc) if exc else "the port closed"
        self.lost.set()


class GpsTime:
    """A `TimeKeeper` on a satellite receiver.

    Parameters
    ----------
    url
        Of its port: a device ("/dev/ttyACM0"), or a serial server ("socket://10.0.0.7:4001").
    clock
        Its monotonic time is the oscillator of the holdover; its UTC is the second opinion.
    settings
        See `GpsSettings`.

    Attributes
    ----------
    failures
        Attempts to open the port that failed.
    """

    def __init__(self, url: str, clock: Clock, settings: GpsSettings | None = None) -> None:
        self._url = url
        self._clock = clock
        self._settings = settings or GpsSettings()
        self._disciplined = DisciplinedClock(clock, self._settings.discipline)
        self._port: _Port | None = None
        self._port_problem = "not opened yet"
        self._closing = asyncio.Event()
        self._running = False
        self.failures = 0

    @property
    def connected(self) -> bool:
        """Whether the port is open."""
        return self._port is not None

    @property
    def statistics(self) -> DisciplineStatistics:
        """Counts of fixes since it was made."""
        return self._disciplined.statistics

    @property
    def problem(self) -> str:
        """Why the time is not of quality "gps" now, in one line; "" if it is."""
        problem = self._disciplined.problem
        if problem and self._port is None:
            problem = self._port_problem
        return f"GPS receiver {self._url}: {problem}" if problem else ""

    @property
    def system_ahead(self) -> float:
        """How far the computer's clock is ahead of the receiver's time, in s; nan without one."""
        return self._disciplined.system_ahead

    def time(self) -> Time:
        """Return the time now."""
        return self._disciplined.time()

    async def close(self) -> None:
        """End ``run``; the time goes on in holdover."""
        self._closing.set()

    async def run(self) -> None:
        """Keep the port open until closed.

        Raises
        ------
        LinkError
            If it runs already.
        """
        if self._running:
            raise LinkError(f"GPS receiver {self._url}: it runs already")
        self._running = True
        try:
            await until_closed(self._closing, self._keep(), self._look())
        finally:
            self._running = False

    async def _look(self) -> None:
        """Look at the computer's clock, so that no jump of it is missed for long."""
        while True:
            self._disciplined.time()
            await sleep_until(self._clock, self._clock.monotonic() + _LOOK)

    async def _keep(self) -> None:
        backoff = Backoff(self._settings.first_pause, self._settings.longest_pause, random.Random())
        while True:
            try:
                async with asyncio.timeout(self._settings.open_limit):
                    port, transport = await self._open_port()
            except (OSError, ValueError, serialx.SerialException) as error:
                self.failures += 1
                self._port_problem = f"it cannot be opened ({str(error) or 'it takes too long'})"
            else:
                backoff.reset()
                await self._hold(port, transport)
            await asyncio.sleep(backoff.next())

    async def _open_port(self) -> tuple[_Port, serialx.BaseSerialTransport]:
        port = _Port(self._clock, self._disciplined)
        transport, _ = await serialx.create_serial_connection(
            asyncio.get_running_loop(), lambda: port, self._url, self._settings.baud_rate
        )
        return port, transport

    async def _hold(self, port: _Port, transport: serialx.BaseSerialTransport) -> None:
        self._port = port
        try:
            while not port.lost.is_set():
                left = port.heard_at + self._settings.silence - self._clock.monotonic()
                if left <= 0.0:
                    self._port_problem = f"silent for {self._settings.silence:g} s"
                    return
                try:
                    async with asyncio.timeout(left):
                        await port.lost.wait()
                except TimeoutError:
                    continue
            self._port_problem = port.problem
        finally:
            self._port = None
            transport.abort()
            await transport.wait_closed()
