"""A simulated field as a separate program, reached like a real field.

`write_folder` writes the files with which a plant reaches the field: plant file, links file and
keys. `TwinProgram` runs the field, boards and clusters, which connect to the plant over TCP, and
serves photographs, the state of its clock and the true errors over HTTP. `heliotrope twin` starts
it, and `heliotrope run` starts one if no links are specified.
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
