"""``heliotrope cluster`` in a process of its own, its bus at a pseudo-terminal, its plant here."""

import asyncio
import os
import select
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from heliotrope.links.clock import SystemClock
from heliotrope.links.link import Link, received
from heliotrope.links.messages import (
    ClusterStatus,
    Lease,
    Message,
    Progress,
    Stage,
    decode,
    encode,
)
from support.clusters import Board

KEY = bytes(range(32))
PATIENCE = 90.0
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
time = {{error_s = 0.5}}
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
        async for data in received(self.link):
            self.heard.append(decode(data))

    async def lease(self) -> None:
        while True:
            await self.send(Lease(7))
            await asyncio.sleep(0.5)

    async def send(self, message: Message) -> None:
        await self.link.send(encode(message), expires=self.clock.monotonic() + 1.0)

    def calm(self) -> bool:
        """Whether the last status says that nothing is wrong."""
        statuses = [each for each in self.heard if isinstance(each, ClusterStatus)]
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


def start(config: Path) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [*COMMAND, str(config), "--every", "1"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def ended(process: "subprocess.Popen[str]") -> str:
    text, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, text
    return text
