"""The console processes: started beside the plant, monitored, and restarted.

A failure in these processes does not affect the plant: a process that ends, or sends no sign of
life, is killed and restarted after a pause that increases with each failure.
"""

import asyncio
import contextlib
import json
import logging
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from heliotrope.errors import InputError
from heliotrope.plant.interface.service import PlantInterface
from heliotrope.safety import Alarm, AlarmKind, alarms

_LOG = logging.getLogger(__name__)
#: Interval between two checks of the process, s.
_LOOK = 0.2
#: Time allowed for the process to end by itself, s.
_END = 1.0


@dataclass(frozen=True)
class Part:
    """A part of a console, in its own process.

    Attributes
    ----------
    name
        Name that the process states in its signs of life.
    module
        Module of the program.
    alarm
        Alarm that is active while the process is not running.
    """

    name: str
    module: str
    alarm: AlarmKind


#: Page and API; and the path for EMERGENCY alone.
CONSOLE = Part("console", "heliotrope.console", alarms.CONSOLE)
EMERGENCY_WAY = Part("emergency", "heliotrope.console.urgent_process", alarms.EMERGENCY_WAY)


@dataclass(frozen=True)
class Patience:
    """How long a process may take, s.

    Attributes
    ----------
    begin
        Maximum time until its first sign of life.
    silent
        Maximum time between two signs of life.
    pause, longest
        First and longest pause before it is restarted.
    well
        Running time after which the pause returns to its first value.
    """

    begin: float = 90.0
    silent: float = 10.0
    pause: float = 1.0
    longest: float = 60.0
    well: float = 60.0


class ConsoleProcess:
    """A part of a plant's console in its own process.

    Parameters
    ----------
    interface
        The plant's interface, through which the process sends its signs of life.
    part
        The part.
    listen
        Function that returns the listening socket (the same at each call) and the console settings
        as JSON values. It is called in threads, and raises `InputError` if the address is not
        available.
    on_alarm
        Function that takes an alarm in the plant's event loop.
    on_address
        Function called once, in the interface's thread, with the address at which the process
        listens, when the plant is running.
    patience
        See `Patience`.

    Attributes
    ----------
    pid
        Process identifier; 0 if there is no process.
    starts
        Number of starts.
    """

    def __init__(
        self,
        interface: PlantInterface,
        part: Part,
        listen: Callable[[], tuple[socket.socket, Mapping[str, Any]]],
        on_alarm: Callable[[Alarm], None],
        on_address: Callable[[str], None],
        patience: Patience | None = None,
    ) -> None:
        self._interface, self._part, self._listen = interface, part, listen
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
            self._alarm(self._part.alarm.raised(problem=problem))
            await asyncio.sleep(pause)
            pause = min(2.0 * pause, self._patience.longest)

    async def _one(self) -> str:
        """Run the process; return why it must be restarted."""
        try:
            process = await asyncio.to_thread(self._start)
        except InputError as error:
            _LOG.warning("%s", error)
            return f"cannot begin ({error})"
        try:
            problem = await self._watch(process)
            process.kill()  # does nothing if it has ended
            return problem
        finally:
            self.pid = 0
            await asyncio.to_thread(_end, process)

    def _start(self) -> "subprocess.Popen[bytes]":
        line, settings = self._listen()
        process = subprocess.Popen(  # noqa: S603  # programs of ours
            [sys.executable, "-m", self._part.module],
            stdin=subprocess.PIPE,
            pass_fds=[line.fileno()],
            # Ctrl-C in the plant's terminal is only for the plant, which stows the field first.
            start_new_session=True,
        )
        self.starts += 1
        self.pid = process.pid
        given = {
            "folder": str(self._interface.folder.absolute()),
            "key": self._interface.key,
            "line": line.fileno(),
            "settings": dict(settings),
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
            now, heard = time.monotonic(), self._interface.heard.get(self._part.name, 0.0)
            if heard >= begun:
                self._well()
                if now - heard > self._patience.silent:
                    return f"has not responded for {now - heard:.0f} s"
            elif now - begun > self._patience.begin:
                return f"did not start within {self._patience.begin:g} s"

    def _well(self) -> None:
        """Note a sign of life."""
        if not self._told and self._interface.begun:
            self._told = True
            self._on_address(self._interface.addresses[self._part.name])
        if self._alarmed:
            self._alarmed = False
            self._alarm(self._part.alarm.ended())

    def _alarm(self, alarm: Alarm) -> None:
        self._interface.in_plant(lambda: self._on_alarm(alarm))


def _end(process: "subprocess.Popen[bytes]") -> None:
    """End the process by closing its input; kill the process if it does not end."""
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
