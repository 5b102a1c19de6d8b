"""``heliotrope cluster`` for real: own process, a pseudo-terminal as bus, TCP to a plant."""

import asyncio
import contextlib
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from heliotrope.lcu import states
from heliotrope.links.clock import SystemClock
from heliotrope.links.link import running
from heliotrope.links.messages import (
    ClusterStatus,
    Command,
    Stage,
)
from heliotrope.links.tcp import TcpServer
from support.cluster_process import (
    COMMAND,
    KEY,
    PATIENCE,
    Line,
    Plant,
    ended,
    start,
    until,
    written,
)
from support.clusters import Board


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Line]:
    made = Line(tmp_path / "bus", [Board(1), Board(2)])
    yield made
    made.end()


def test_a_cluster_in_its_own_process_over_a_port(line: Line, tmp_path: Path) -> None:
    async def main() -> str:
        clock = SystemClock()
        server = TcpServer("127.0.0.1", 0, {"C1": KEY}, clock)
        async with running(server):
            await server.listening()
            config = written(tmp_path, server.port)
            process = await asyncio.to_thread(start, config)
            started.append(process)
            link = server.links["C1"]
            plant = Plant(link, clock)
            async with asyncio.TaskGroup() as group:
                group.create_task(plant.listen())
                leasing = group.create_task(plant.lease())
                await until(lambda: any(isinstance(each, ClusterStatus) for each in plant.heard))
                boards = line.boards
                await until(lambda: all(b.node.controller.sun.fresh() for b in boards))
                # IDLE away from the receiver: it holds. A machine that stands still for seconds
                # lets the lease lapse, and the order is refused, rightly: then again.
                for attempt in range(9):
                    await until(plant.calm)
                    await plant.send(Command(f"idle{attempt}", "IDLE", token=7))
                    await until(lambda attempt=attempt: plant.ended(f"idle{attempt}"))
                    await asyncio.sleep(2.2)  # for a line of the log
                    if [board.state for board in boards] == ["IDLE", "IDLE"]:
                        break
                assert [board.state for board in boards] == ["IDLE", "IDLE"]
                assert plant.stages(f"idle{attempt}") == {Stage.DONE}
                status = [each for each in plant.heard if isinstance(each, ClusterStatus)][-1]
                rows = status.nodes()
                process.send_signal(signal.SIGTERM)
                text = await asyncio.to_thread(ended, process)
                # It defocused them before it ended.
                assert [board.state for board in boards] == ["DEFOCUSED", "DEFOCUSED"]
                assert (rows["answered"] > 0).all()
                assert {states.STATES[state] for state in rows["state"]} <= {"STOWED", "IDLE"}
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
    assert "C1: stopped, DEFOCUS sent" in text
    assert "C1: IDLE 2; silent 0" in text


def test_a_file_that_is_wrong_ends_in_one_line(tmp_path: Path) -> None:
    config = written(tmp_path, 1)
    config.write_text(config.read_text().replace("latitude_deg = 20.0", "latitude_deg = 120.0"))
    found = subprocess.run(
        [*COMMAND, str(config)],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert found.returncode == 2
    assert found.stderr.count("\n") == 1
    assert "site.latitude_deg: 120.0: input should be less than or equal to 90" in found.stderr


def test_check_only_reads_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from heliotrope.cli.cluster import cluster

    with contextlib.chdir(tmp_path):
        cluster(written(tmp_path, 1), check=True)
    assert "cluster C1 of 2 heliostats" in capsys.readouterr().out
