"""Settings that differ from board to board; docs/how-to/firmware.md explains each pin."""

FIRMWARE = 1
BAUD = 115200
#: 32 bytes known to the plant and this board only; if empty, nothing can be stored over the wire.
KEY = b""
#: Pin of the contact that opens when the drives are switched off at the mirror; None: no contact.
LOCAL_SWITCH = None
#: Pin of both drivers' ENABLE, low for on; None: they are always on.
ENABLE = None
#: Pins of an accelerometer's SDA and SCL, any two that are free; None: none is fitted.
TILT = None
PINS = {
    "bus": (17, 16), "flash": (18, 23, 19, 5),
    "drive": 4, "steps": (25, 26, 27, 14),
    "supply_good": 35, "limits": (34, 39),
    "switches": (32, 33, 13, 21, 22), "supply": 36,
}  # fmt: skip
