"""The local interface of a running plant: frames over Unix sockets, with limits on all resources.

`LocalServer` listens in the plant's process; `LocalConnection` (asyncio) and `ask_once` (blocking)
call it. The package is independent of the plant: `plant.interface` defines the calls and the
callers allowed to make them. The package needs only the standard library, so that an emergency
command starts at once.

Begin with `frames`.
"""

from heliotrope.local.buckets import Buckets
from heliotrope.local.client import AwayError, CallError, LocalConnection, ask_once, fetch_once
from heliotrope.local.frames import INTERNAL, Frame, FrameError, pack
from heliotrope.local.server import LocalLimits, LocalServer
from heliotrope.local.sockets import EMERGENCY, ORDINARY, name_here, socket_folder

__all__ = [
    "EMERGENCY",
    "INTERNAL",
    "ORDINARY",
    "AwayError",
    "Buckets",
    "CallError",
    "Frame",
    "FrameError",
    "LocalConnection",
    "LocalLimits",
    "LocalServer",
    "ask_once",
    "fetch_once",
    "name_here",
    "pack",
    "socket_folder",
]
