"""A day in short, replayed: runs under CPython and MicroPython alike.

``given`` holds the journal's items, and events: (tick, hex of bytes that came, or None for a
tick of the main loop). What the node orders and answers is summed up in a checksum.
"""

import hashlib
import json
import struct
from binascii import crc32, unhexlify

try:
    from heliotrope.lcu.journal import Journal
    from heliotrope.lcu.node import Node
except ImportError:  # on a board the folder is called lcu
    from lcu.journal import Journal
    from lcu.node import Node


def sha256(data):
    return hashlib.sha256(data).digest()


class FileFlash:
    """NOR flash in a file, so that it does not lie in MicroPython's memory."""

    block_size, blocks = 4096, 6

    def __init__(self, path):
        self.file = open(path, "w+b")  # noqa: SIM115, PTH123 - it stays open
        for block in range(self.blocks):
            self.erase(block)

    def read(self, offset, size):
        self.file.seek(offset)
        return self.file.read(size)

    def write(self, offset, data):
        for start in range(0, len(data), 64):  # a list of more would need much memory at once
            part = data[start : start + 64]
            old = self.read(offset + start, len(part))
            self.file.seek(offset + start)
            self.file.write(bytes([a & b for a, b in zip(old, part)]))  # noqa: B905

    def erase(self, block):
        self.file.seek(block * self.block_size)
        for _ in range(16):
            self.file.write(b"\xff" * (self.block_size // 16))


class Replay:
    """A node, and a checksum of all that it does."""

    def __init__(self, given, path):
        self.flash = flash = FileFlash(path)
        book = Journal(flash)
        book.load()
        items = given["items"]
        book.store({name: unhexlify(items[name]) for name in items})
        one, two = given["counts"]
        book.zero(one, two)
        self.sum, self.steps = 0, [one, two]
        key = items.get("bus_keys") and b"only a key of the bus needs it"
        self.node = Node(
            flash, self, self.write, given["start"], 4711, sha256=sha256, key=key or b""
        )

    def write(self, data):
        self.sum = crc32(data, self.sum)

    def play(self, axis, direction, count, interval_us):
        self.steps[axis] += direction * count
        self.sum = crc32(struct.pack("<BiiI", axis, direction, count, interval_us), self.sum)

    def stop(self):
        return 0, 0

    def event(self, tick, data):
        if data is None:
            self.node.on_tick(tick)
        else:
            self.node.on_bytes(unhexlify(data), tick)

    def result(self):
        self.flash.file.close()
        own = self.node.controller
        return [own.state, self.sum, self.steps, own.flags(), self.node.trouble]


def given_from(path):
    """Read what a test wrote."""
    with open(path) as file:  # noqa: PTH123 - MicroPython has no pathlib
        return json.load(file)
