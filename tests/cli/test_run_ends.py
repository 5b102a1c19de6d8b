"""How ``heliotrope run`` ends: real processes, a viewer at the live stream, and Ctrl-C."""

import asyncio
import signal
import sqlite3
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from heliotrope.console.client import Client
from heliotrope.console.stream import RemoteError
from support.one_time_link import set_password
from support.program import MAIN, Program

#: A plant whose loop hangs: it says when it has begun, and after the first signal.
HANGS = """
import asyncio
import time
from heliotrope.cli.run._shared import Ending

async def main():
    ending = Ending()
    print("begun", flush=True)
    await ending.asked.wait()
    print("asked", flush=True)
    time.sleep(600.0)

asyncio.run(main())
"""
#: A plant whose loop has ended, while the rest of its program has not.
LOOP_OVER = """
import asyncio
import time
from heliotrope.cli.run._shared import Ending

async def main():
    Ending().ask()

asyncio.run(main())
print("over", flush=True)
time.sleep(600.0)
"""
PASSWORD = "a password of one's own"


def children(number: int) -> list[int]:
    """Return the processes that a process has started, and theirs."""
    found = []
    for file in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(file.read_text().rpartition(")")[2].split()[1])
        except (OSError, ValueError):
            continue
        if parent == number:
            child = int(file.parent.name)
            found += [child, *children(child)]
    return found


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Program]:
    words = "--heliostats", "6", "--port", "0", "--no-browser", "--data", str(tmp_path / "data")
    made = Program(MAIN, "run", *words, "--every", "1")
    yield made
    made.close()


@pytest.mark.parametrize("emergency", [False, True])
def test_ctrl_c_ends_a_simulated_plant_with_its_processes_and_a_viewer_at_the_stream(
    plant: Program, tmp_path: Path, emergency: bool
) -> None:
    link = plant.says(r"console: (\S+)")[1]
    address = link.partition("enter")[0]
    token, watching, ended = _token(link, address), threading.Event(), list[str]()

    async def follow() -> None:
        client = Client(token, address)
        try:
            async for _ in client.live():
                watching.set()
        except RemoteError as error:
            ended.append(str(error))
        finally:
            client.close()

    viewer = threading.Thread(target=asyncio.run, args=(follow(),))
    viewer.start()
    assert watching.wait(60.0)
    if emergency:
        with Client(token, address) as client:
            client.ask("POST", "emergency", {"act": "DEFOCUS", "reason": "smoke"})
    started = children(plant.process.pid)
    assert len(started) >= 4, "two of the console, and those that compute and draw"
    plant.process.send_signal(signal.SIGINT)
    assert plant.ends() == 0, plant.text
    viewer.join()
    assert len(ended) == 1
    assert "Traceback" not in plant.text
    assert "stowing" not in plant.text
    assert plant.text.endswith("\nended\n")
    until = time.monotonic() + 20.0
    while left := [n for n in started if Path(f"/proc/{n}").exists()]:
        assert time.monotonic() < until, left
        time.sleep(0.05)
    store = tmp_path / "data" / "store.sqlite"
    with sqlite3.connect(store) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
    connection.close()


def _token(link: str, address: str) -> str:
    set_password(link, PASSWORD)
    with Client(url=address) as client:
        client.sign_in("engineer", PASSWORD)
        made = client.ask(
            "POST", "tokens", {"label": "viewer", "role": "operator", "own_password": PASSWORD}
        )
        return str(made["secret"])


def test_a_second_ctrl_c_kills_a_program_that_hangs() -> None:
    hangs = Program(HANGS)
    try:
        hangs.says("begun")
        hangs.process.send_signal(signal.SIGINT)
        hangs.says("asked")
        hangs.process.send_signal(signal.SIGINT)
        assert hangs.ends() == 130
    finally:
        hangs.close()


def test_a_second_signal_is_silent_once_the_loop_has_ended() -> None:
    plant = Program(LOOP_OVER)
    try:
        plant.says("over")
        plant.process.send_signal(signal.SIGINT)
        assert plant.ends() == 130
        assert plant.text == "over\n"
    finally:
        plant.close()
