"""EMERGENCY, DEFOCUS and STOW on the plant's computer when its console is dead: real processes."""

import getpass
import os
import queue
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

MAIN = [sys.executable, "-c", "from heliotrope.cli import main; main()"]
#: The machine may be busy, s.
PATIENCE = 240.0


class RunningPlant:
    """`heliotrope run` in a process of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        words = ["run", "--heliostats", "4", "--port", "0", "--data", str(folder)]
        self._lines: queue.Queue[str] = queue.Queue()
        self._popen = subprocess.Popen([*MAIN, *words], stdout=subprocess.PIPE, text=True)
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self._popen.stdout is not None
        for line in self._popen.stdout:
            self._lines.put(line)

    def says(self, pattern: str) -> None:
        """Wait for a line."""
        until = time.monotonic() + PATIENCE
        while not re.search(pattern, self._lines.get(timeout=until - time.monotonic())):
            pass

    def kill_console(self) -> None:
        """Kill every process that the plant has started."""
        for task in Path(f"/proc/{self._popen.pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                os.kill(int(child), signal.SIGKILL)

    def end(self) -> None:
        """End the plant at once."""
        self._popen.kill()
        self._popen.wait(PATIENCE)
        self._reader.join()
        assert self._popen.stdout is not None
        self._popen.stdout.close()


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningPlant]:
    made = RunningPlant(tmp_path_factory.mktemp("plant"))
    try:
        made.says("console: ")
        made.kill_console()
        yield made
    finally:
        made.end()


def ctl(plant: RunningPlant, *words: str, token: str = "") -> tuple[int, str]:
    """Return exit code and text of ``heliotrope ctl --data``, with no token unless one is given."""
    outside = {k: v for k, v in os.environ.items() if not k.startswith("HELIOTROPE_")}
    if token:
        outside["HELIOTROPE_TOKEN"] = token
    line = [*MAIN, "ctl", "--data", str(plant.folder), *words]
    done = subprocess.run(line, env=outside, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


@pytest.mark.parametrize("token", ["", "one that has expired"])
def test_an_emergency_needs_neither_console_nor_token(plant: RunningPlant, token: str) -> None:
    code, text = ctl(plant, "emergency", "--reason", "smoke", token=token)
    assert (code, text.startswith("emergency in force")) == (0, True), text
    code, text = ctl(plant, "show", "emergency")
    assert code == 0
    assert f'"who": "{getpass.getuser()} on this machine"' in text


@pytest.mark.parametrize("word", ["stow", "defocus"])
def test_beams_are_taken_away_without_a_token(plant: RunningPlant, word: str) -> None:
    code, text = ctl(plant, word, "--all")
    assert (code, "STOW" in text or "DEFOCUS" in text) == (0, True), text


def test_what_brings_beams_back_needs_a_person_with_a_token(plant: RunningPlant) -> None:
    for words in (("emergency", "--withdraw"), ("command", "track", "--all"), ("resume",)):
        code, text = ctl(plant, *words)
        assert (code, text.count("\n")) == (2, 1)
        assert (
            f"{getpass.getuser()} on this machine is viewer, but the command needs operator" in text
        )
