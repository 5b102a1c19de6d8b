"""Settings that differ from board to board; docs/how-to/firmware.md explains each pin."""

FIRMWARE = 1
BAUD = 115200
#: 32 bytes known to the plant and this board only; if empty, nothing can be stored over the wire.
KEY = b""
#: Pin of the contact that opens when the drives are switched off at the mirror; None: no contact.
LOCAL_SWITCH = None
#: Pin of both drivers' ENABLE, low for on; None: they are always on.
ENABLE = None
#: Pins of an accelerometer's SDA and SCL, of I2C 0: (4, 5) or (12, 13); None: none is fitted.
TILT = None
PINS = {
    "bus": (0, 1), "flash": (18, 19, 16, 17),
    "drive": 2, "steps": (6, 7, 8, 9),
    "supply_good": 3, "limits": (10, 11),
    "switches": (20, 21, 22, 14, 15), "supply": 26,
}  # fmt: skip
