"""Parts that are the same on all boards: switches, limits, supply, watchdog, drivers."""

import hashlib

#: Volts at the supply's divider (100 kΩ over 10 kΩ) per volt at the pin.
DIVIDER = 11


class Inputs:
    """Inputs read, and outputs set, the same way on all boards.

    ``good``, ``limits`` and ``address`` are pins of the board, ``local`` and ``enable`` are pins or
    None, ``accelerometer`` has ``read()`` or is None, ``dog`` is its watchdog.
    """

    def sha256(self, data):
        return hashlib.sha256(data).digest()

    def feed(self):
        self.dog.feed()

    def tilt(self):
        return None if self.accelerometer is None else self.accelerometer.read()

    def switches(self):
        return sum([(not pin()) << place for place, pin in enumerate(self.address)])

    def supply_good(self):
        return self.good() == 1

    def limit_hit(self):
        # Switches open when they are hit, so that a broken wire stops the axis too.
        return any([pin() for pin in self.limits])

    def drivers(self, on):
        # ENABLE of the usual drivers (A4988, DRV8825, TMC22xx) is low for on.
        if self.enable is not None:
            self.enable(not on)

    def switched_off(self):
        # The contact is closed while the drives have power, so that a broken wire locks too.
        return self.local is not None and self.local() == 1
