"""The journal's flash: a separate serial NOR chip (W25Q and similar), or a partition.

A separate chip, because the file system takes all of the board's own flash, and because the rp2
can run no code while its own flash is erased.
"""

import time

BLOCK, BLOCKS, PAGE = 4096, 16, 256
READ, PROGRAM, ENABLE, STATUS, ERASE, IDENTIFY = 0x03, 0x02, 0x06, 0x05, 0x20, 0x9F
#: Longest that a chip may be busy, ms: an erasure takes 45, at worst 400.
PATIENCE = 1000


class SpiNor:
    """A chip on an SPI bus, with the storage interface of ``lcu.journal``.

    Raises OSError where no chip answers, or one stays busy.
    """

    block_size, blocks = BLOCK, BLOCKS

    def __init__(self, spi, select):
        self.spi, self.select = spi, select
        select(1)
        self._wait()  # a reset may have come amid an erasure
        if self._ask(bytes([IDENTIFY]), 3) in (b"\0\0\0", b"\xff\xff\xff"):
            raise OSError("journal: no flash chip answers; check its wires")

    def _ask(self, command, size):
        self.select(0)
        self.spi.write(command)
        data = self.spi.read(size) if size else b""
        self.select(1)
        return data

    def _address(self, command, offset):
        return bytes([command, offset >> 16 & 255, offset >> 8 & 255, offset & 255])

    def _wait(self):
        begin = time.ticks_ms()
        while self._ask(bytes([STATUS]), 1)[0] & 1:
            if time.ticks_diff(time.ticks_ms(), begin) > PATIENCE:
                raise OSError("journal: the flash chip does not answer or stays busy")

    def _change(self, command):
        """Send a command that writes, and wait until it is done."""
        self._wait()
        self._ask(bytes([ENABLE]), 0)
        self._ask(command, 0)
        self._wait()

    def read(self, offset, size):
        return self._ask(self._address(READ, offset), size)

    def write(self, offset, data):
        start = 0
        while start < len(data):
            # A write beyond the end of a page continues at its beginning.
            size = min(len(data) - start, PAGE - (offset + start) % PAGE)
            here = self._address(PROGRAM, offset + start)
            self._change(here + data[start : start + size])
            start += size

    def erase(self, block):
        self._change(self._address(ERASE, block * BLOCK))


class Blocks:
    """A partition with MicroPython's block interface (esp32), as the same storage interface."""

    block_size = BLOCK

    def __init__(self, device):
        self.device = device
        self.blocks = min(BLOCKS, device.ioctl(4, 0))

    def read(self, offset, size):
        data = bytearray(size)
        self.device.readblocks(offset // BLOCK, data, offset % BLOCK)
        return bytes(data)

    def write(self, offset, data):
        # A write with an offset erases nothing first.
        self.device.writeblocks(offset // BLOCK, data, offset % BLOCK)

    def erase(self, block):
        self.device.ioctl(6, block)
