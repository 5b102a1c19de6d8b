"""A simulated field as a separate program, reached like a real field.

`write_folder` writes what a plant needs to reach it: plant file, links file, keys. `TwinProgram`
runs field, boards and clusters, which connect to the plant over TCP, and serves photographs, the
state of its clock and the true errors over HTTP. `heliotrope twin` starts it, and `heliotrope run`
starts one if no links are specified.
"""

from heliotrope.twin.program.folder import LINKS, PLANT, TwinFolder, read_folder, write_folder
from heliotrope.twin.program.program import TwinOptions, TwinProgram

__all__ = [
    "LINKS",
    "PLANT",
    "TwinFolder",
    "TwinOptions",
    "TwinProgram",
    "read_folder",
    "write_folder",
]
