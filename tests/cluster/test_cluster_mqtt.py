"""``heliotrope cluster`` for real: Mosquitto, time from a receiver, local controllers.

The cluster is a process of its own. Its bus is a pseudo-terminal with real local controllers; gpsd
reads a receiver at another.
"""

import asyncio
import signal
import subprocess
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from heliotrope.links.clock import SystemClock, gps_seconds
from heliotrope.links.link import running
from heliotrope.links.messages import Alarm, ClusterStatus
from heliotrope.links.mqtt import Broker, mqtt_link
from support.broker import Mosquitto, mosquitto_for
from support.cluster_process import KEY, Line, Plant, ended, start, until, written
from support.clusters import Board
from support.gpsd_process import GpsdProcess, gpsd_process

PREFIX = "heliotrope/test"


@pytest.fixture
def receiver() -> Iterator[GpsdProcess]:
    yield from gpsd_process()


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Line]:
    made = Line(tmp_path / "bus", [Board(1), Board(2)])
    yield made
    made.end()


@pytest.fixture
def mosquitto(tmp_path: Path) -> Iterator[Mosquitto]:
    yield from mosquitto_for(tmp_path)


def over_broker(folder: Path, port: int, gpsd: int) -> Path:
    """The file of a cluster with a broker and a receiver."""
    config = written(folder, 1)
    text = config.read_text().replace(
        'url = "tcp://127.0.0.1:1"', f'url = "mqtt://127.0.0.1:{port}/{PREFIX}"'
    )
    text = text.replace("error_s = 0.5", f'error_s = 0.25, gpsd = "127.0.0.1:{gpsd}"')
    config.write_text(text)
    return config


def test_a_cluster_with_a_receiver_and_a_broker(
    mosquitto: Mosquitto,
    line: Line,
    receiver: GpsdProcess,
    tmp_path: Path,
) -> None:
    async def main() -> str:
        clock = SystemClock()
        broker = Broker("127.0.0.1", mosquitto.port)
        link = mqtt_link(broker, PREFIX, "C1", KEY, clock, plant=True)
        async with running(link):
            plant = Plant(link, clock)
            process = await asyncio.to_thread(
                start, over_broker(tmp_path, mosquitto.port, receiver.port)
            )
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
    assert "time gps ±0.25 s" in text
    assert "C1: stopped, DEFOCUS sent" in text


async def follow(plant: Plant, line: Line, receiver: GpsdProcess) -> None:
    """From the first fix to the loss of the sky."""

    def last() -> ClusterStatus | None:
        return next(
            (each for each in reversed(plant.heard) if isinstance(each, ClusterStatus)), None
        )

    def alarms() -> list[Alarm]:
        return [each for each in plant.heard if isinstance(each, Alarm)]

    def told(quality: str) -> bool:
        status = last()
        return status is not None and status.time_quality == quality

    await until(lambda: told("gps"))
    # The bus and its nodes have the receiver's time, and the sun of it, while the lease lasts.
    await until(lambda: all(board.node.controller.sun.fresh() for board in line.boards))
    status = last()
    assert status is not None
    assert status.time_error_s == 0.25
    true = gps_seconds(datetime.now(UTC))
    for board in line.boards:
        assert abs(board.node.controller.clock.second - true) < 3.0
    await until(lambda: bool((last() or status).nodes()["heard_ms"].max() < 2000))
    assert abs((last() or status).utc_s - time.time()) < 3.0
    receiver.sky = False
    # The clock is believed without its receiver too; a receiver that contradicts it is not.
    await until(lambda: told("system"))
    assert (last() or status).time_error_s == 0.25
    receiver.sky, receiver.off = True, 30.0
    await until(lambda: told("none"))
    await until(lambda: any("from the receiver" in each.text for each in alarms()))
