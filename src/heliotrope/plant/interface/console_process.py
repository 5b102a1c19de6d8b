"""The console's process: started beside the plant, watched, and started again.

Nothing that happens to it reaches the plant: a console that ends, or gives no sign of life, is
killed and started again after a pause that grows from one failure to the next.
"""

import asyncio
import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from heliotrope.plant.interface.service import PlantInterface
from heliotrope.safety import Alarm, alarms

#: Time between two looks at the process, s.
_LOOK = 0.2
#: Time for the process to end by itself, s.
_END = 3.0


@dataclass(frozen=True)
class Patience:
    """How long the console may take, s.

    Attributes
    ----------
    begin
        Until its first sign of life.
    silent
        Between two signs of life.
    pause, longest
        Before it is started again: at first, and at most.
    well
        Time at work after which the pause is short again.
    """

    begin: float = 90.0
    silent: float = 10.0
    pause: float = 1.0
    longest: float = 60.0
    well: float = 60.0


class ConsoleProcess:
    """The console of a plant in a process of its own.

    Parameters
    ----------
    interface
        The plant's interface, through which it gives its signs of life.
    settings
        Settings of the console, as JSON values.
    on_alarm
        Takes the alarm in the plant's loop.
    on_address
        Called once, in the interface's thread, with the address at which it listens.
    patience
        See `Patience`.

    Attributes
    ----------
    pid
        Of the process; 0 while there is none.
    starts
        Number of starts.
    """

    def __init__(
        self,
        interface: PlantInterface,
        settings: Mapping[str, Any],
        on_alarm: Callable[[Alarm], None],
        on_address: Callable[[str], None],
        patience: Patience | None = None,
    ) -> None:
        self._interface, self._settings = interface, dict(settings)
        self._on_alarm, self._on_address = on_alarm, on_address
        self._patience = patience or Patience()
        self._told = self._alarmed = False
        self.pid = self.starts = 0

    async def run(self) -> None:
        """Keep the process running until cancelled."""
        pause = self._patience.pause
        while True:
            begun = time.monotonic()
            problem = await self._one()
            if time.monotonic() - begun > self._patience.well:
                pause = self._patience.pause
            self._alarmed = True
            self._alarm(alarms.CONSOLE.raised(problem=problem))
            await asyncio.sleep(pause)
            pause = min(2.0 * pause, self._patience.longest)

    async def _one(self) -> str:
        """Run the process; return why it has to be started again."""
        process = await asyncio.to_thread(self._start)
        try:
            problem = await self._watch(process)
            process.kill()  # nothing, if it has ended
            return problem
        finally:
            self.pid = 0
            await asyncio.to_thread(_end, process)

    def _start(self) -> "subprocess.Popen[bytes]":
        process = subprocess.Popen(
            [sys.executable, "-m", "heliotrope.console"],
            stdin=subprocess.PIPE,
            # Ctrl-C in the plant's terminal is the plant's: it stows the field first.
            start_new_session=True,
        )
        self.starts += 1
        self.pid = process.pid
        given = {
            "folder": str(self._interface.folder.absolute()),
            "key": self._interface.key,
            "settings": self._settings,
        }
        assert process.stdin is not None
        with contextlib.suppress(OSError):
            process.stdin.write(json.dumps(given).encode() + b"\n")
            process.stdin.flush()
        return process

    async def _watch(self, process: "subprocess.Popen[bytes]") -> str:
        begun = time.monotonic()
        while True:
            await asyncio.sleep(_LOOK)
            if (code := process.poll()) is not None:
                return f"has ended with {_words(code)}"
            now, heard = time.monotonic(), self._interface.heard
            if heard >= begun:
                self._well()
                if now - heard > self._patience.silent:
                    return f"gives no sign of life for {now - heard:.0f} s"
            elif now - begun > self._patience.begin:
                return f"does not begin within {self._patience.begin:g} s"

    def _well(self) -> None:
        """Note a sign of life."""
        if not self._told:
            self._told = True
            self._on_address(self._interface.address)
            # The next one listens at the same port.
            port = self._interface.address.rstrip("/").rpartition(":")[2]
            if port.isdigit():
                self._settings["port"] = int(port)
        if self._alarmed:
            self._alarmed = False
            self._alarm(alarms.CONSOLE.ended())

    def _alarm(self, alarm: Alarm) -> None:
        self._interface.in_plant(lambda: self._on_alarm(alarm))


def _end(process: "subprocess.Popen[bytes]") -> None:
    """End the process: it ends by itself when its input does; one that does not is killed."""
    if process.stdin is not None:
        with contextlib.suppress(OSError):
            process.stdin.close()
    try:
        process.wait(_END)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _words(code: int) -> str:
    return f"signal {-code}" if code < 0 else f"exit code {code}"
