"""The process for the EMERGENCY path, which `heliotrope run` starts; see `urgent`.

``python -m heliotrope.console.urgent_process``
"""

import asyncio
import sys
import time
from typing import Any

from heliotrope.console.process import ProcessInput, main, serve
from heliotrope.console.server import Server
from heliotrope.console.urgent import LIMITS, EmergencyWay
from heliotrope.local import EMERGENCY, LocalConnection

#: Timeout for a reply from the plant, s.
_ANSWER = 10.0
#: Timeout for connecting to the plant, s; the connection is reopened when it has ended.
_CONNECT = 5.0
#: Maximum memory, bytes.
_MEMORY = 512 << 20


def way_of(plant: LocalConnection, inputs: ProcessInput) -> EmergencyWay:
    """Return the application of the EMERGENCY path.

    An order waits until the plant is connected.
    """

    async def ask(call: str, arguments: dict[str, Any], **named: Any) -> tuple[Any, bytes]:
        until = time.monotonic() + _CONNECT
        while not plant.up and time.monotonic() < until:
            await asyncio.sleep(0.02)
        return await plant.ask(call, arguments, **named)

    return EmergencyWay(ask, inputs.settings)


def server_of(way: EmergencyWay, inputs: ProcessInput) -> Server:
    """Return the server of the EMERGENCY path."""
    return Server(way, inputs.line, LIMITS, inputs.settings, page=False)


async def _run(inputs: ProcessInput) -> None:
    plant = LocalConnection(inputs.folder / EMERGENCY, {"key": inputs.key}, _ANSWER)
    way = way_of(plant, inputs)

    async def connect() -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(plant.run())
            group.create_task(way.roster.run())

    await serve(
        server_of(way, inputs),
        connect,
        lambda address: plant.ask("heartbeat", {"part": "emergency", "address": address}),
    )


if __name__ == "__main__":
    sys.exit(main(_run, _MEMORY))
