"""The process of page and API: ``python -m heliotrope.console``, started by `heliotrope run`."""

import contextlib
import sys
from pathlib import Path

from heliotrope.console.process import ProcessInput, main, serve
from heliotrope.console.remote import RemotePlant
from heliotrope.console.serve import ConsoleServer
from heliotrope.processes import give_way

#: The plant goes first: less of the processor, and memory is taken from the console first.
_NICE, _EXPENDABLE = 5, 500
#: Most memory, bytes: six times what it has beside 320 heliostats.
_MEMORY = 2 << 30


async def _run(inputs: ProcessInput) -> None:
    plant = RemotePlant(inputs.folder, inputs.key)
    server = ConsoleServer(plant, inputs.settings, inputs.line)
    await serve(
        server,
        plant.run,
        lambda address: plant.ask("heartbeat", part="console", address=address),
    )


if __name__ == "__main__":
    give_way(_NICE)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(_EXPENDABLE), encoding="ascii")
    sys.exit(main(_run, _MEMORY))
