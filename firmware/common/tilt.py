"""The mirror's tilt by a LIS3DH, an accelerometer on an I2C bus (ST, DocID17530).

Mounted on the mirror: its z along the normal, its x along the secondary axis. Scale ±2 g in
high resolution, 1 mg a count, 100 measurements a second; the chip keeps the last 32 of them, whose
mean is good to about 0.2 mrad.
"""

import math
import struct

#: Registers.
IDENTITY, CONTROL_1, CONTROL_4, CONTROL_5, OUT, FIFO, FIFO_SOURCE = (
    0x0F, 0x20, 0x23, 0x24, 0x28, 0x2E, 0x2F,
)  # fmt: skip
#: What IDENTITY holds. The highest bit of a register's number lets it rise with each byte; with the
#: FIFO it goes from OUT + 5 back to OUT.
LIS3DH, RISING = 0x33, 0x80
#: CONTROL_1: 100 Hz, three axes; CONTROL_4: whole values only, ±2 g, high resolution; CONTROL_5:
#: FIFO; FIFO: a stream of the last 32.
SETUP = ((CONTROL_1, 0x57), (CONTROL_4, 0x88), (CONTROL_5, 0x40), (FIFO, 0x80))
COUNT, OVERRUN = 0x1F, 0x40
#: 1 g in the registers: 1000 counts of 16, which are left-justified.
G = 16000
#: At rest the sum of all is 1 g; beyond this share of it, it shakes or is broken.
STILL = 0.1


class Lis3dh:
    """One chip; ``address`` is 0x18 or, with SA0 high, 0x19.

    A chip that does not answer, or is another one, measures nothing: a heliostat goes without.
    """

    def __init__(self, i2c, address=0x18):
        self.i2c, self.address = i2c, address
        self.ready = False
        self._begin()

    def _begin(self):
        try:
            found = self.i2c.readfrom_mem(self.address, IDENTITY, 1)[0]
            if found == LIS3DH:
                for register, value in SETUP:
                    self.i2c.writeto_mem(self.address, register, bytes([value]))
            self.ready = found == LIS3DH
        except OSError:
            self.ready = False

    def _mean(self):
        """Return the mean of the last third of a second, in g; None without one."""
        state = self.i2c.readfrom_mem(self.address, FIFO_SOURCE, 1)[0]
        count = 32 if state & OVERRUN else state & COUNT
        if count == 0:
            return None
        data = self.i2c.readfrom_mem(self.address, OUT | RISING, 6 * count)
        sums = [0, 0, 0]
        for i in range(3 * count):
            sums[i % 3] += struct.unpack_from("<h", data, 2 * i)[0]
        return [each / (G * count) for each in sums]

    def read(self):
        """Return the mirror's turn about x and about y (rad), None where it is not known.

        By gravity: (0, 0) with the mirror up, (pi/2, 0) upright. A turn about the plumb line is
        not seen.
        """
        if not self.ready:
            self._begin()  # it may have been without power
            return None
        try:
            mean = self._mean()
        except OSError:
            self.ready = False
            return None
        if mean is None:
            return None
        x, y, z = mean
        whole = math.sqrt(x * x + y * y + z * z)
        if not abs(whole - 1.0) < STILL:
            return None
        return math.atan2(y, z), math.atan2(-x, math.sqrt(y * y + z * z))
