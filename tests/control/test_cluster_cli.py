"""``heliotrope cluster`` for real: own process, a pseudo-terminal as bus, TCP to a plant."""

import asyncio
import contextlib
import os
import select
import signal
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from clusters import Board
from heliotrope.control.clock import SystemClock
from heliotrope.control.link import Link, messages, running
from heliotrope.control.protocol import (
    Command,
    Lease,
    Message,
    Progress,
    Stage,
    Status,
    decode,
    encode,
)
from heliotrope.control.tcp import TcpServer
from heliotrope.lcu import states

KEY = bytes(range(32))
PATIENCE = 40.0
COMMAND = [sys.executable, "-c", "from heliotrope.cli import main; main()", "cluster"]


class Line:
    """The far end of a pseudo-terminal: local controllers in a thread, in real time."""

    def __init__(self, path: Path, boards: list[Board]) -> None:
        self.boards = boards
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        path.symlink_to(os.ttyname(self._slave))
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        for board in self.boards:
            board.boot(time.monotonic())
        while not self._ending.is_set():
            ready = select.select([self._master], [], [], 0.02)[0]
            data = os.read(self._master, 4096) if ready else b""
            for board in self.boards:
                answer = board.hear(data, time.monotonic()) if data else b""
                answer += board.tick(time.monotonic())
                if answer:
                    os.write(self._master, answer)

    def end(self) -> None:
        self._ending.set()
        self._thread.join()
        for end in (self._master, self._slave):
            os.close(end)


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Line]:
    made = Line(tmp_path / "bus", [Board(1), Board(2)])
    yield made
    made.end()


def written(folder: Path, port: int) -> Path:
    now = datetime.now(UTC)
    noon = -15.0 * (now.hour + now.minute / 60.0 - 12.0)  # where the sun is in the meridian
    text = f"""
format = "heliotrope-cluster"
version = 1
name = "C1"
keys = "keys.toml"
site = {{latitude_deg = 20.0, longitude_deg = {noon:.3f}}}
bus = {{url = "{folder}/bus", answer_s = 0.5}}
plant = {{url = "tcp://127.0.0.1:{port}"}}
heliostats = [{{name = "A1", address = 1}}, {{name = "A2", address = 2}}]
"""
    (folder / "C1.toml").write_text(text)
    (folder / "keys.toml").write_text(f'plant = "{KEY.hex()}"\n')
    (folder / "keys.toml").chmod(0o600)
    return folder / "C1.toml"


class Plant:
    """The plant's end."""

    def __init__(self, link: Link, clock: SystemClock) -> None:
        self.link, self.clock = link, clock
        self.heard: list[Message] = []

    async def listen(self) -> None:
        async for data in messages(self.link):
            self.heard.append(decode(data))

    async def lease(self) -> None:
        while True:
            await self.send(Lease(7))
            await asyncio.sleep(0.5)

    async def send(self, message: Message) -> None:
        await self.link.send(encode(message), expires=self.clock.monotonic() + 1.0)

    def calm(self) -> bool:
        """Whether the last status says that nothing is wrong."""
        statuses = [each for each in self.heard if isinstance(each, Status)]
        return bool(statuses) and not statuses[-1].acts

    def ended(self, identity: str) -> bool:
        """Whether a command has come to an end at both heliostats."""
        ends = (Stage.DONE, Stage.REFUSED, Stage.FAILED)
        names = [
            name
            for each in self.heard
            if isinstance(each, Progress) and each.identity == identity and each.stage in ends
            for name in each.heliostats or ("A1", "A2")
        ]
        return set(names) == {"A1", "A2"}

    def stages(self, identity: str) -> set[Stage]:
        """Ends of a command."""
        ends = (Stage.DONE, Stage.REFUSED, Stage.FAILED)
        found = [each for each in self.heard if isinstance(each, Progress)]
        return {each.stage for each in found if each.identity == identity and each.stage in ends}


async def until(holds: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE):
        while not holds():
            await asyncio.sleep(0.02)


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
                await until(lambda: any(isinstance(each, Status) for each in plant.heard))
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
                status = [each for each in plant.heard if isinstance(each, Status)][-1]
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
    assert "C1: ended, DEFOCUS sent" in text
    assert "C1: IDLE 2; silent 0" in text


def start(config: Path) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [*COMMAND, str(config), "--every", "1"],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def ended(process: "subprocess.Popen[str]") -> str:
    text, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, text
    return text


def test_a_file_that_is_wrong_ends_in_one_line(tmp_path: Path) -> None:
    config = written(tmp_path, 1)
    config.write_text(config.read_text().replace("latitude_deg = 20.0", "latitude_deg = 120.0"))
    found = subprocess.run(
        [*COMMAND, str(config)],
        capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert found.returncode == 2
    assert found.stderr.count("\n") == 1
    assert "site.latitude_deg: 120.0: input should be less than or equal to 90" in found.stderr


def test_check_only_reads_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from heliotrope.cli.cluster import cluster

    with contextlib.chdir(tmp_path):
        cluster(written(tmp_path, 1), check=True)
    assert "cluster C1 of 2 heliostats" in capsys.readouterr().out
