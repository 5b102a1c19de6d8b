"""gpsd of a test's own, with a receiver that talks NMEA 0183 at a pseudo-terminal."""

import os
import shutil
import socket
import subprocess
import threading
import time
import tty
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

from support.absence import absent

PATIENCE = 90.0
_SBIN = "/usr/sbin:/usr/local/sbin"
GPSD = shutil.which("gpsd") or shutil.which("gpsd", path=_SBIN)
GPSFAKE = shutil.which("gpsfake")
CHRONYD = shutil.which("chronyd") or shutil.which("chronyd", path=_SBIN)


def needed(program: str | None, name: str, what: str) -> str:
    """Return a program; skip the test where it is absent, but fail where everything is tested."""
    if program is None:
        absent(f"{name} is not installed: {what} is not tested")
    return program


def free_port() -> int:
    """Return a port of this machine that nobody listens at."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


def _sentence(body: str) -> bytes:
    checksum = 0
    for byte in body.encode("ascii"):
        checksum ^= byte
    return f"${body}*{checksum:02X}\r\n".encode("ascii")


def sentences(utc: datetime, *, fix: bool = True) -> bytes:
    """Return what a receiver says in a second: RMC, GGA, GSA and GSV."""
    place = "2830.0000,S,02100.0000,E" if fix else ",,,"
    used = "02,05,07,10,13" if fix else ",,,,"
    status, mode = ("A", "A") if fix else ("V", "N")
    said = (
        f"GPRMC,{utc:%H%M%S}.00,{status},{place},0.01,,{utc:%d%m%y},,,{mode}",
        f"GPGGA,{utc:%H%M%S}.00,{place},{int(fix)},05,1.0,850.0,M,30.0,M,,",
        f"GPGSA,A,{3 if fix else 1},{used},,,,,,,,1.6,1.0,1.2",
        "GPGSV,2,1,07,02,40,083,46,05,17,308,41,07,67,172,44,10,22,228,45",
        "GPGSV,2,2,07,13,40,083,46,15,17,308,,20,67,172,",
    )
    return b"".join(_sentence(body) for body in said)


class GpsdProcess:
    """gpsd that reads a receiver at a pseudo-terminal.

    ``sky`` is whether the receiver has a fix; ``off`` by how much its time is wrong, in s.
    """

    def __init__(self, port: int | None = None) -> None:
        self.port = free_port() if port is None else port
        self.sky, self.off = True, 0.0
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)  # nobody may be there to read
        path = os.ttyname(self._slave)
        Path(path).chmod(0o666)  # gpsd gives up the rights of root
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._talk)
        self._thread.start()
        program = needed(GPSD, "gpsd", "a satellite receiver")
        self._process = subprocess.Popen(
            [program, "-N", "-n", "-s", "9600", "-S", str(self.port), path],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        until(self._listens)

    def _listens(self) -> bool:
        assert self._process.poll() is None, "gpsd ended at once"
        try:
            socket.create_connection(("127.0.0.1", self.port)).close()
        except ConnectionRefusedError:
            return False
        return True

    def _talk(self) -> None:
        while not self._ending.wait(1.0 - time.time() % 1.0):
            now = datetime.fromtimestamp(round(time.time() + self.off), UTC)
            try:
                os.write(self._master, sentences(now, fix=self.sky))
            except BlockingIOError:
                continue

    def kill(self) -> None:
        """End gpsd alone."""
        self._process.kill()
        self._process.wait()

    def end(self) -> None:
        """End gpsd and the receiver."""
        self.kill()
        self._ending.set()
        self._thread.join()
        for end in (self._master, self._slave):
            os.close(end)


def until(holds: Callable[[], bool]) -> None:
    """Wait for something, in real time."""
    deadline = time.monotonic() + PATIENCE
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def gpsd_process() -> Iterator[GpsdProcess]:
    """Give a test its gpsd; skip it where there is none, but not where everything is tested."""
    needed(GPSD, "gpsd", "a satellite receiver")
    made = GpsdProcess()
    yield made
    made.end()
