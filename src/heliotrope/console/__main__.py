"""The console's process: ``python -m heliotrope.console``, started by `heliotrope run`.

It reads one line of JSON from standard input: the folder of the plant's sockets, the key and the
settings. When standard input ends, the plant has ended, and so does the console.
"""

import asyncio
import contextlib
import json
import os
import signal
import sys
import threading
from pathlib import Path
from typing import Any

from heliotrope.console.remote import BEAT, RemotePlant
from heliotrope.console.serve import ConsoleServer
from heliotrope.console.settings import ConsoleSettings
from heliotrope.errors import HeliotropeError

#: The plant goes first: less of the processor, and memory is taken from the console first.
_NICE, _EXPENDABLE = 5, 500
#: Time for the server to end, s.
_END = 3.0


def main() -> int:
    """Run the console until standard input ends; return the exit code."""
    # The plant stows its field after Ctrl-C, and people watch that here.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.nice(_NICE)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(_EXPENDABLE), encoding="ascii")
    given = json.loads(sys.stdin.buffer.readline())
    try:
        asyncio.run(_run(given))
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


async def _run(given: dict[str, Any]) -> None:
    plant = RemotePlant(Path(given["folder"]), given["key"])
    server = ConsoleServer(plant, ConsoleSettings.of(given["settings"]))
    loop = asyncio.get_running_loop()
    threading.Thread(target=_wait_for_the_end, args=(loop, server), daemon=True).start()
    async with asyncio.TaskGroup() as group:
        connecting = group.create_task(plant.run())
        beating = group.create_task(_beat(plant, server))
        await server.run()
        connecting.cancel()
        beating.cancel()


def _wait_for_the_end(loop: asyncio.AbstractEventLoop, server: ConsoleServer) -> None:
    """Close the server when standard input ends; end the process if that takes too long."""
    while sys.stdin.buffer.read(4096):
        pass
    with contextlib.suppress(RuntimeError):
        asyncio.run_coroutine_threadsafe(server.close(), loop)
    threading.Event().wait(_END)
    os._exit(0)


async def _beat(plant: RemotePlant, server: ConsoleServer) -> None:
    """Give a sign of life every second, with the address."""
    address = await server.address()
    while True:
        with contextlib.suppress(HeliotropeError):
            await plant.ask("heartbeat", address=address)
        await asyncio.sleep(BEAT)


if __name__ == "__main__":
    sys.exit(main())
