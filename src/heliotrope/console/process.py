"""A console process, which the plant's process starts and monitors, and which ends with it.

The process reads one line of JSON from standard input: the folder of the plant's sockets, the key,
the settings, and the descriptor of its listening socket. When standard input ends, the plant has
ended, and so does this process.
"""

import asyncio
import contextlib
import json
import os
import resource
import signal
import socket
import sys
import threading
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from heliotrope.console.settings import ConsoleSettings
from heliotrope.errors import HeliotropeError
from heliotrope.local import log_lines

#: Interval between two signs of life, s.
BEAT = 1.0
#: Time allowed for the server to end, s.
_END = 1.0


@dataclass(frozen=True)
class ProcessInput:
    """The input of a process; see the docstring of this module."""

    folder: Path
    key: str
    settings: ConsoleSettings
    line: socket.socket


class Served(Protocol):
    """A server that runs until it is closed."""

    async def run(self) -> None:
        """Serve until closed."""

    async def close(self) -> None:
        """Stop serving, so that ``run`` returns."""

    async def address(self) -> str:
        """Wait until the server listens, then return its address."""
        ...


def main(work: Callable[[ProcessInput], Coroutine[Any, Any, None]], memory: int) -> int:
    """Do the work of a process until standard input ends; return the exit code.

    Parameters
    ----------
    work
        Coroutine function that does the work.
    memory
        Maximum memory of the process, bytes. It limits how much memory others can make the process
        use, so that the plant or its computer does not run out of memory.
    """
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
    # The plant stows its field after Ctrl-C, and operators watch that on the page.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    log_lines.install()
    read = json.loads(sys.stdin.buffer.readline())
    line = socket.socket(fileno=read["line"])
    settings = ConsoleSettings.of(read["settings"])
    try:
        asyncio.run(work(ProcessInput(Path(read["folder"]), read["key"], settings, line)))
    except ExceptionGroup as group:
        known, _ = group.split(HeliotropeError)
        if known is None:
            raise
        sys.stderr.write(f"heliotrope: {_first(known)}\n")
        return 2
    return 0


def _first(error: Exception) -> Exception:
    while isinstance(error, ExceptionGroup):
        error = error.exceptions[0]
    return error


async def serve(
    server: Served,
    connect: Callable[[], Coroutine[Any, Any, None]],
    beat: Callable[[str], Awaitable[Any]],
) -> None:
    """Run a server until standard input ends.

    Parameters
    ----------
    server
        The server.
    connect
        Coroutine that maintains the connections to the plant.
    beat
        Function that sends a sign of life, with the address of the server.
    """
    loop = asyncio.get_running_loop()
    threading.Thread(target=_wait_for_the_end, args=(loop, server), daemon=True).start()
    async with asyncio.TaskGroup() as group:
        works = [group.create_task(connect()), group.create_task(_beat(server, beat))]
        await server.run()
        for work in works:
            work.cancel()


def _wait_for_the_end(loop: asyncio.AbstractEventLoop, server: Served) -> None:
    """Close the server when standard input ends.

    If closing takes too long, end the process.
    """
    while sys.stdin.buffer.read(4096):
        pass
    with contextlib.suppress(RuntimeError):
        asyncio.run_coroutine_threadsafe(server.close(), loop)
    threading.Event().wait(_END)
    os._exit(0)


async def _beat(server: Served, beat: Callable[[str], Awaitable[Any]]) -> None:
    """Send a sign of life, with the server's address, every second."""
    address = await server.address()
    while True:
        with contextlib.suppress(HeliotropeError):
            await beat(address)
        await asyncio.sleep(BEAT)
