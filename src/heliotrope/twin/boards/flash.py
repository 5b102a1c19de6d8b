"""NOR flash of a board whose supply may fail at any byte."""

import random

from heliotrope.errors import HeliotropeError


class PowerCutError(HeliotropeError):
    """The supply failed during a write or an erase operation; the board stops at once."""


class NorFlash:
    """NOR flash in memory that rejects operations that real flash cannot perform.

    Parameters
    ----------
    seed
        Seed of the bits that a power failure leaves.
    block_size, blocks
        Bytes per block, and number of blocks.

    Attributes
    ----------
    budget
        Number of bytes written or erased after which the supply fails; None if it never fails.
    ragged
        Whether a power failure leaves all bytes of the operation with a mixture of new and old
        bits, as if a page stored them in any order; otherwise only the byte at the failure.
    erasures
        Number of erase operations per block.

    Raises
    ------
    PowerCutError
        Raised by ``write`` and ``erase``, at the power failure.
    ValueError
        Raised by ``write`` if a byte has already been written since it was erased; the journal
        never does this.
    """

    def __init__(self, seed: int = 0, block_size: int = 4096, blocks: int = 6) -> None:
        self.block_size = block_size
        self.blocks = blocks
        self.budget: int | None = None
        self.ragged = False
        self.erasures = [0] * blocks
        self._cells = bytearray(b"\xff" * (blocks * block_size))
        self._chance = random.Random(seed)

    def read(self, offset: int, size: int) -> bytes:
        """Return bytes from an address."""
        return bytes(self._cells[offset : offset + size])

    def write(self, offset: int, data: bytes) -> None:
        """Write ``data``: clear the bits that are 0 in it."""
        if self._cells[offset : offset + len(data)] != b"\xff" * len(data):
            raise ValueError(
                f"flash: {len(data)} bytes at {offset} are already written; erase them"
            )
        self._change(offset, data)

    def erase(self, block: int) -> None:
        """Set all bits of a block."""
        self.erasures[block] += 1
        self._change(block * self.block_size, b"\xff" * self.block_size)

    def _change(self, offset: int, data: bytes) -> None:
        size = len(data)
        if self.budget is not None and self.budget < size:
            whole = 0 if self.ragged else self.budget
            self._cells[offset : offset + whole] = data[:whole]
            for place in range(whole, size if self.ragged else whole + 1):
                taken = self._chance.getrandbits(8)
                old = self._cells[offset + place]
                self._cells[offset + place] = old & ~taken | data[place] & taken
            self.budget = None
            raise PowerCutError(f"flash: the supply failed within {size} bytes at {offset}")
        if self.budget is not None:
            self.budget -= size
        self._cells[offset : offset + size] = data
