"""What gpsd tells of a receiver: its protocol without any port, and gpsd itself."""

import asyncio
import json
import math
import subprocess
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from heliotrope.cluster.timekeeping import SystemTime
from heliotrope.links.clock import SystemClock, VirtualClock
from heliotrope.links.gpsd import Gpsd, GpsdReader
from heliotrope.links.link import running
from support.gpsd_process import (
    CHRONYD,
    GPSFAKE,
    PATIENCE,
    GpsdProcess,
    free_port,
    gpsd_process,
    needed,
    sentences,
)

START = datetime(2026, 6, 21, 10, tzinfo=UTC)
DEPLOY = Path(__file__).parents[2] / "deploy"
# As gpsd 3.22 sends them.
VERSION = b'{"class":"VERSION","release":"3.22","rev":"3.22","proto_major":3,"proto_minor":14}\r\n'
SKY = (
    b'{"class":"SKY","device":"/dev/pps0","xdop":0.83,"ydop":0.88,"nSat":8,"uSat":5,'
    b'"satellites":[{"PRN":2,"el":40.0,"az":83.0,"ss":46.0,"used":true,"gnssid":0,"svid":2}]}\r\n'
)
NO_FIX = b'{"class":"TPV","device":"/dev/ttyACM0","mode":1}\r\n'


def tpv(utc: datetime, mode: int = 3) -> bytes:
    report = {
        "class": "TPV",
        "device": "/dev/ttyACM0",
        "mode": mode,
        "time": f"{utc:%Y-%m-%dT%H:%M:%S.%f}"[:-3] + "Z",
        "ept": 0.005,
        "lat": -28.5,
        "lon": 21.0,
        "altHAE": 880.0,
    }
    return json.dumps(report).encode() + b"\r\n"


@pytest.fixture
def gpsd() -> Iterator[GpsdProcess]:
    yield from gpsd_process()


# -- the protocol ----------------------------------------------------------------------


@pytest.mark.parametrize("size", [1, 7, 4096])
def test_reports_are_read_however_they_are_cut(size: int) -> None:
    reader = GpsdReader()
    assert reader.error == ""
    data = VERSION + SKY + tpv(START)
    found = [reader.feed(data[k : k + size]) for k in range(0, len(data), size)]
    assert sum(found) == 1
    receiver = reader.receiver
    assert (receiver.device, receiver.mode, receiver.fixed) == ("/dev/ttyACM0", 3, True)
    assert receiver.utc_s == START.timestamp()
    assert (receiver.latitude_deg, receiver.longitude_deg, receiver.height_m) == (-28.5, 21, 880)
    assert (receiver.used, receiver.seen) == (5, 8)
    assert receiver.text == "3D fix at -28.50000° 21.00000°, 5 of 8 satellites"
    assert reader.refused == 0


def test_a_fix_counts_once_and_its_loss_is_told() -> None:
    reader = GpsdReader()
    assert reader.feed(tpv(START))
    assert not reader.feed(tpv(START))
    assert not reader.feed(NO_FIX)
    assert not reader.receiver.fixed
    assert reader.receiver.text == "no fix, 0 of 0 satellites"
    assert reader.feed(tpv(START + timedelta(seconds=1), mode=2))
    assert reader.receiver.text.startswith("2D fix at")


@pytest.mark.parametrize(
    "line",
    [
        b"no JSON\r\n",
        b"[1, 2]\r\n",
        b'{"no": "class"}\r\n',
        b'{"class": "TPV", "mode": "many"}\r\n',
        b'{"class": "TPV", "mode": 3, "time": "yesterday"}\r\n',
        b'{"class": "TPV", "mode": 3, "time": 17}\r\n',
        b'{"class": "SKY", "uSat": []}\r\n',
        b"\xff\xfe\r\n",
        b"x" * 70000,
    ],
)
def test_a_line_that_is_not_gpsds_is_counted_and_changes_nothing(line: bytes) -> None:
    reader = GpsdReader()
    reader.feed(tpv(START))
    before = reader.receiver
    assert not reader.feed(line)
    assert reader.refused == 1
    assert reader.receiver == before
    assert reader.feed(tpv(START + timedelta(seconds=1)))


# -- as a second opinion ---------------------------------------------------------------


def heard(gpsd: Gpsd, clock: VirtualClock, seconds: int, off: float = 0.0) -> None:
    """Let a receiver report at each second, ``off`` seconds from the clock at its start."""
    for _ in range(seconds):
        gpsd.hear(tpv(clock.utc() + timedelta(seconds=off)))
        clock.advance(1.0)


def test_a_receiver_that_agrees_makes_the_time_gps() -> None:
    clock = VirtualClock(start=START)
    gpsd = Gpsd(clock)
    keeper = SystemTime(clock, error=0.1, gpsd=gpsd)
    assert (keeper.time().quality, gpsd.ahead) == ("system", None)
    heard(gpsd, clock, 5)
    now = keeper.time()
    assert (now.quality, now.error, now.note) == ("gps", 0.1, "")
    assert gpsd.ahead == pytest.approx(0.0)
    clock.advance(5.0)
    now = keeper.time()
    assert (now.quality, now.note, gpsd.receiver.fixed) == ("system", "", False)
    clock.advance(10.0)
    assert "gpsd at localhost:2947: not connected yet" in keeper.time().note


@pytest.mark.parametrize("off", [-619315200.0, -2.5, 2.5])
def test_a_receiver_that_contradicts_the_clock_leaves_no_time(off: float) -> None:
    clock = VirtualClock(start=START)
    gpsd = Gpsd(clock)
    keeper = SystemTime(clock, error=0.1, gpsd=gpsd)
    heard(gpsd, clock, 3, off)
    now = keeper.time()
    assert (now.quality, now.error) == ("none", math.inf)
    assert f"the computer's clock is {-off:+.1f} s from the receiver, the limit is 2 s" in now.note
    # A receiver alone decides nothing: without it the clock is believed again.
    clock.advance(6.0)
    assert keeper.time().quality == "system"


def test_a_report_read_late_does_not_contradict() -> None:
    clock = VirtualClock(start=START)
    gpsd = Gpsd(clock)
    heard(gpsd, clock, 5)
    clock.advance(0.9)
    gpsd.hear(tpv(START + timedelta(seconds=2.9 - 0.9)))
    assert gpsd.ahead == pytest.approx(0.0)


def test_a_clock_that_is_set_away_from_its_receiver_is_noticed_at_once() -> None:
    clock = VirtualClock(start=START)
    gpsd = Gpsd(clock)
    keeper = SystemTime(clock, gpsd=gpsd)
    heard(gpsd, clock, 5)
    assert keeper.time().quality == "gps"
    clock.jump(10.0)
    now = keeper.time()
    assert (now.quality, now.jumped) == ("none", True)
    assert gpsd.ahead == pytest.approx(10.0)


# -- gpsd itself -----------------------------------------------------------------------


async def until(holds: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE):
        while not holds():
            await asyncio.sleep(0.02)


def test_gpsd_tells_fix_loss_and_contradiction(gpsd: GpsdProcess) -> None:
    async def main() -> None:
        clock = SystemClock()
        client = Gpsd(clock, "127.0.0.1", gpsd.port)
        keeper = SystemTime(clock, error=0.1, gpsd=client)
        async with running(keeper):
            await until(lambda: keeper.time().quality == "gps" and client.receiver.used == 5)
            ahead = client.ahead
            assert ahead is not None
            assert -0.1 < ahead < 1.5  # reports come late, never early
            receiver = client.receiver
            assert receiver.mode == 3
            assert (receiver.latitude_deg, receiver.longitude_deg) == pytest.approx((-28.5, 21.0))
            assert receiver.height_m == pytest.approx(880.0)  # 850 m and the geoid's 30
            gpsd.off = 60.0
            await until(lambda: keeper.time().quality == "none")
            gpsd.off, gpsd.sky = 0.0, False
            await until(lambda: keeper.time().quality == "system")
            gpsd.sky = True
            await until(lambda: keeper.time().quality == "gps")

    asyncio.run(main())


def test_a_gpsd_that_comes_back_is_found_again(gpsd: GpsdProcess) -> None:
    async def main() -> None:
        client = Gpsd(SystemClock(), "127.0.0.1", gpsd.port)
        async with running(client):
            await until(lambda: client.receiver.fixed)
            gpsd.kill()
            await until(lambda: not client.receiver.fixed)
            again = GpsdProcess(gpsd.port)
            try:
                await until(lambda: client.receiver.fixed)
            finally:
                await asyncio.to_thread(again.end)

    asyncio.run(main())


def test_a_gpsd_that_is_not_there_is_a_problem_in_words() -> None:
    class Later(SystemClock):
        """A clock whose user has waited long enough."""

        def monotonic(self) -> float:
            return super().monotonic() + self.waited

        waited = 0.0

    async def main() -> str:
        clock = Later()
        port = free_port()
        client = Gpsd(clock, "127.0.0.1", port)
        async with running(client):
            await asyncio.sleep(0.3)
            assert client.problem == ""
            clock.waited = 60.0
            assert f"gpsd at 127.0.0.1:{port}: no connection (" in client.problem
        return client.problem

    asyncio.run(main())


def test_a_log_played_by_gpsfake(tmp_path: Path) -> None:
    program = needed(GPSFAKE, "gpsfake", "a receiver's log")
    log = tmp_path / "receiver.nmea"
    said = [sentences(START + timedelta(seconds=k)) for k in range(60)]
    log.write_bytes(b"# A receiver's minute\n" + b"".join(said))

    async def play(port: int) -> None:
        clock = SystemClock()
        client = Gpsd(clock, "127.0.0.1", port)
        async with running(client):
            async with asyncio.timeout(PATIENCE / 2):
                await until(lambda: client.receiver.fixed and client.receiver.used == 5)
            assert client.receiver.text == "3D fix at -28.50000° 21.00000°, 5 of 7 satellites"
            # The log is of another day than this one, which the clock cannot be.
            ahead = client.ahead
            assert ahead == pytest.approx(time.time() - START.timestamp(), abs=90.0)
            assert SystemTime(clock, gpsd=client).time().quality == "none"

    for last in (False, False, True):  # gpsfake gives up where gpsd is slow to start
        port = free_port()
        process = subprocess.Popen(
            [program, "-1", "-n", "-q", "-c", "0.2", "-P", str(port), str(log)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            asyncio.run(play(port))
        except TimeoutError:
            if last:
                raise
        else:
            return
        finally:
            process.terminate()
            process.wait()


def test_chronyd_and_gpsd_take_their_settings() -> None:
    program = needed(CHRONYD, "chronyd", "the settings of chrony")
    settings = DEPLOY / "chrony-cluster.conf"
    done = subprocess.run(
        [program, "-p", "-f", settings], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    # gpsd writes the receiver's seconds to SHM 0 and its pulse to SHM 1, before anybody asks.
    assert "refclock SHM 0 refid NMEA" in done.stdout
    assert "refclock SHM 1 refid PPS lock NMEA" in done.stdout
    shown = subprocess.run(
        ["sh", "-c", '. "$0"; printf %s "$GPSD_OPTIONS"', DEPLOY / "gpsd.default"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert shown.stdout == "-n"
