"""The plant's local interface: what consoles, `heliotrope ctl` and gateways may call, and who may.

`PlantInterface` serves two sockets in the plant's data folder: one for all calls, and one for
EMERGENCY, DEFOCUS and STOW alone. Connections, keys, reading and writing are handled in a separate
thread; only the call itself runs in the plant's event loop. `calls` is the table of the calls.
`ConsoleProcess` runs a part of the console beside the plant and restarts it.
"""

from heliotrope.plant.interface.admission import BusyError
from heliotrope.plant.interface.calls import CALLS, Call, WithBlob
from heliotrope.plant.interface.console_process import CONSOLE, EMERGENCY_WAY, ConsoleProcess
from heliotrope.plant.interface.encoding import frame_of, frame_parts, plain
from heliotrope.plant.interface.errors import kind_of, remade
from heliotrope.plant.interface.service import PlantInterface

__all__ = [
    "CALLS",
    "CONSOLE",
    "EMERGENCY_WAY",
    "BusyError",
    "Call",
    "ConsoleProcess",
    "PlantInterface",
    "WithBlob",
    "frame_of",
    "frame_parts",
    "kind_of",
    "plain",
    "remade",
]
