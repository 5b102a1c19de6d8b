"""Settings that differ from board to board; docs/how-to/firmware.md explains each pin."""

FIRMWARE = 1
BAUD = 115200
#: 32 bytes known to the plant and this board only; if empty, nothing can be stored over the wire.
KEY = b""
#: Pin of the contact that opens when the drives are switched off at the mirror; None: no contact.
LOCAL_SWITCH = None
#: Pin of both drivers' ENABLE, low for on; None: they are always on.
ENABLE = None
#: Pins of an accelerometer's SDA and SCL: ("B7", "B6"), those of I2C 1; None: none is fitted.
TILT = None
PINS = {
    # The chip fixes these pins of UART 2 and SPI 2; only the flash's select can change.
    "bus": ("A2", "A3"), "flash": ("B13", "B15", "B14", "B12"),
    "drive": "A1", "steps": ("A8", "B0", "C6", "B1"),
    "supply_good": "C0", "limits": ("C1", "C2"),
    "switches": ("A4", "A5", "A6", "A7", "C5"), "supply": "C3",
}  # fmt: skip
