"""Puts an image outside of the heap, as a board has it in flash, and runs what is in it."""

import os
import sys

import ffi
import uctypes
import vfs

size = os.stat("code.romfs")[6]  # noqa: PTH116 - MicroPython has no pathlib
flash = uctypes.bytearray_at(ffi.open("libc.so.6").func("P", "malloc", "I")(size), size)
with open("code.romfs", "rb") as file:  # noqa: PTH123
    part = bytearray(256)
    for place in range(0, size, 256):
        got = file.readinto(part)
        flash[place : place + got] = part if got == 256 else part[:got]
del part
vfs.mount(vfs.VfsRom(flash), "/rom")
sys.path[:] = ["/rom"]
import heap_on_micropython  # noqa: E402, F401
