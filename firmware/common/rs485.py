"""A port to an RS485 bus whose driver must be switched on to send."""


class Port:
    """Sends bytes with the driver on, and reads the bytes received.

    ``uart`` is a ``machine.UART`` with a receive buffer of two frames; ``drive`` the pin of the
    transceiver's DE and /RE.
    """

    def __init__(self, uart, drive):
        self.uart, self.drive = uart, drive
        drive(0)

    def write(self, data):
        self.drive(1)
        try:
            self.uart.write(data)
            # The last bit must have left before the driver is switched off: 250 bytes take 22 ms at
            # 115,200 baud, and steps are queued for 100 ms.
            self.uart.flush()
        finally:
            self.drive(0)

    def read(self):
        return self.uart.read() if self.uart.any() else b""
