"""NOR flash with a supply that fails at a chosen byte; runs on CPython and MicroPython."""

import random


class CutError(Exception):
    """The supply failed."""


class Nor:
    """Flash that refuses what real flash cannot do.

    After ``budget`` bytes of writing and erasing the supply fails: at that byte some of its bits
    are changed and some not; if ``ragged``, of all bytes of the operation, as if a page took its
    bits in any order.
    """

    def __init__(self, blocks=4, block_size=512, seed=1):
        self.blocks = blocks
        self.block_size = block_size
        self.cells = bytearray(b"\xff" * (blocks * block_size))
        self.erased = [0] * blocks
        self.operations = 0
        self.budget = None
        self.ragged = False
        self.stuck = None  # offset of a byte that does not take its bits
        random.seed(seed)

    def read(self, offset, size):
        return bytes(self.cells[offset : offset + size])

    def write(self, offset, data):
        self.operations += 1
        for place in range(len(data)):
            if self.cells[offset + place] != 0xFF:
                raise ValueError("written twice")
        self._change(offset, data)

    def erase(self, block):
        self.operations += 1
        self.erased[block] += 1
        self._change(block * self.block_size, b"\xff" * self.block_size)

    def _change(self, offset, data):
        size = len(data)
        if self.budget is not None and self.budget < size:
            whole = 0 if self.ragged else self.budget
            self.cells[offset : offset + whole] = data[:whole]
            for place in range(whole, size if self.ragged else whole + 1):
                taken = random.getrandbits(8)
                old = self.cells[offset + place]
                self.cells[offset + place] = old & ~taken | data[place] & taken
            self.budget = 0
            raise CutError
        if self.budget is not None:
            self.budget -= size
        self.cells[offset : offset + size] = data
        if self.stuck is not None and offset <= self.stuck < offset + size:
            self.cells[self.stuck] = 0xFF
