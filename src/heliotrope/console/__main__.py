"""The process of the page and the API: ``python -m heliotrope.console``.

`heliotrope run` starts it.
"""

import contextlib
import sys
from pathlib import Path

from heliotrope.console.process import ProcessInput, main, serve
from heliotrope.console.remote import RemotePlant
from heliotrope.console.serve import ConsoleServer
from heliotrope.processes import give_way

#: The plant takes precedence: the console gets less processor time, and memory is taken from it
#: first.
_NICE, _EXPENDABLE = 5, 500
#: Maximum memory, bytes; six times what the process uses with 320 heliostats.
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
