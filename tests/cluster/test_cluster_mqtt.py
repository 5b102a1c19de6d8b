"""``heliotrope cluster`` for real: Mosquitto, time from a receiver, local controllers.

The cluster is a process of its own. Its bus and its receiver are pseudo-terminals: at one stand
real local controllers, at the other a thread that says the true second as a receiver does.
"""

import asyncio
import os
import signal
import subprocess
import threading
import time
import tty
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from heliotrope.links.clock import SystemClock, gps_seconds
from heliotrope.links.link import running
from heliotrope.links.messages import Status
from heliotrope.links.mqtt import Broker, mqtt_link
from support.broker import Mosquitto, mosquitto_for
from support.cluster_process import KEY, Line, Plant, ended, start, until, written
from support.clusters import Board
from support.nmea_talk import gga, rmc

PREFIX = "heliotrope/test"


class Receiver:
    """A satellite receiver at a pseudo-terminal; ``sky`` is whether it has a fix."""

    def __init__(self, path: Path) -> None:
        self.sky = True
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)  # nobody may be there to read
        path.symlink_to(os.ttyname(self._slave))
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._ending.wait(1.0 - time.time() % 1.0):
            now = datetime.now(UTC).replace(microsecond=0)
            said = gga(now) + rmc(now) if self.sky else gga(now, 0) + rmc(now, "V", "N")
            try:
                os.write(self._master, said)
            except BlockingIOError:
                continue

    def end(self) -> None:
        self._ending.set()
        self._thread.join()
        for end in (self._master, self._slave):
            os.close(end)


@pytest.fixture
def receiver(tmp_path: Path) -> Iterator[Receiver]:
    made = Receiver(tmp_path / "gps")
    yield made
    made.end()


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Line]:
    made = Line(tmp_path / "bus", [Board(1), Board(2)])
    yield made
    made.end()


@pytest.fixture
def mosquitto(tmp_path: Path) -> Iterator[Mosquitto]:
    yield from mosquitto_for(tmp_path)


def over_broker(folder: Path, port: int) -> Path:
    """The file of a cluster with a broker and a receiver."""
    config = written(folder, 1)
    text = config.read_text().replace(
        'url = "tcp://127.0.0.1:1"', f'url = "mqtt://127.0.0.1:{port}/{PREFIX}"'
    )
    config.write_text(f"""{text}
time = {{source = "gps", url = "{folder}/gps", latency_s = 0.5}}
""")
    return config


def test_a_cluster_with_a_receiver_and_a_broker(
    mosquitto: Mosquitto,
    line: Line,
    receiver: Receiver,
    tmp_path: Path,
) -> None:
    async def main() -> str:
        clock = SystemClock()
        broker = Broker("127.0.0.1", mosquitto.port)
        link = mqtt_link(broker, PREFIX, "C1", KEY, clock, plant=True)
        async with running(link):
            plant = Plant(link, clock)
            process = await asyncio.to_thread(start, over_broker(tmp_path, mosquitto.port))
            started.append(process)
            async with asyncio.TaskGroup() as group:
                group.create_task(plant.listen())
                leasing = group.create_task(plant.lease())
                await follow(plant, line, receiver)
                process.send_signal(signal.SIGTERM)
                text = await asyncio.to_thread(ended, process)
                leasing.cancel()
                await link.close()
        return text

    started: list[subprocess.Popen[str]] = []
    try:
        text = asyncio.run(main())
    finally:
        for process in started:
            process.kill()
            process.communicate()
    assert "time gps ±0.2" in text
    assert "C1: ended, DEFOCUS sent" in text


async def follow(plant: Plant, line: Line, receiver: Receiver) -> None:
    """From the first fix to the loss of the sky."""

    def last() -> Status | None:
        return next((each for each in reversed(plant.heard) if isinstance(each, Status)), None)

    def told(quality: str) -> bool:
        status = last()
        return status is not None and status.time_quality == quality

    await until(lambda: told("gps"))
    # The bus and its nodes have the receiver's time, and the sun of it, while the lease lasts.
    await until(lambda: all(board.node.controller.sun.fresh() for board in line.boards))
    status = last()
    assert status is not None
    assert 0.2 < status.time_error_s < 0.3
    true = gps_seconds(datetime.now(UTC))
    for board in line.boards:
        assert abs(board.node.controller.clock.second - true) < 3.0
    await until(lambda: bool((last() or status).nodes()["heard_ms"].max() < 2000))
    assert abs((last() or status).utc_s - time.time()) < 3.0
    receiver.sky = False
    await until(lambda: told("holdover"))
    assert 0.2 < (last() or status).time_error_s < 0.3
