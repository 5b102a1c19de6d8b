"""Boards with an ESP32, ESP32-S3 or another of the family that has the RMT peripheral."""

from binascii import crc32

import esp32
import machine
from inputs import DIVIDER, Inputs
from machine import ADC, I2C, SPI, UART, Pin
from nor import Blocks, SpiNor
from rs485 import Port
from steps import Timer
from tilt import Lis3dh


def storage(pins):
    """Return the partition "journal" if the board has one; else a chip on the SPI bus."""
    found = esp32.Partition.find(esp32.Partition.TYPE_DATA, label="journal")
    if found:
        return Blocks(found[0])
    clock, out, back, select = pins
    spi = SPI(2, baudrate=10_000_000, sck=Pin(clock), mosi=Pin(out), miso=Pin(back))
    return SpiNor(spi, Pin(select, Pin.OUT, value=1))


class Board(Inputs):
    def __init__(self, settings):
        pins = settings.PINS
        self.firmware, self.key = settings.FIRMWARE, settings.KEY
        self.serial = crc32(machine.unique_id())
        self.storage = storage(pins["flash"])
        send, receive = pins["bus"]
        uart = UART(2, settings.BAUD, tx=send, rx=receive, rxbuf=512)
        self.port = Port(uart, Pin(pins["drive"], Pin.OUT, value=0))
        self.timer = Timer(pins["steps"])
        self.good = Pin(pins["supply_good"], Pin.IN)
        self.limits = [Pin(number, Pin.IN) for number in pins["limits"]]
        self.address = [Pin(number, Pin.IN, Pin.PULL_UP) for number in pins["switches"]]
        local = settings.LOCAL_SWITCH
        self.local = None if local is None else Pin(local, Pin.IN, Pin.PULL_UP)
        enable = settings.ENABLE
        self.enable = None if enable is None else Pin(enable, Pin.OUT, value=0)
        wires = settings.TILT
        self.accelerometer = None
        if wires is not None:
            data, clock = Pin(wires[0]), Pin(wires[1])
            self.accelerometer = Lis3dh(I2C(0, sda=data, scl=clock, freq=400_000))
        self.supply = ADC(Pin(pins["supply"]), atten=ADC.ATTN_11DB)
        self.dog = machine.WDT(timeout=2000)

    def supply_mv(self):
        return self.supply.read_uv() * DIVIDER // 1000

    def temperature_degc(self):
        if hasattr(esp32, "mcu_temperature"):
            return int(esp32.mcu_temperature())
        return (esp32.raw_temperature() - 32) * 5 // 9  # the first ESP32 tells Fahrenheit
