"""Boards with an STM32F4, F7 or H7 that have TIM1 and TIM8 (pyboard, many Nucleo-64 and -144)."""

from binascii import crc32

import machine
import pyb
from inputs import DIVIDER, Inputs
from machine import I2C, SPI, UART
from nor import SpiNor
from pyb import Pin
from rs485 import Port
from steps import Timer
from tilt import Lis3dh


class Board(Inputs):
    def __init__(self, settings):
        pins = settings.PINS
        self.firmware, self.key = settings.FIRMWARE, settings.KEY
        self.serial = crc32(machine.unique_id())
        spi = SPI(2, baudrate=10_000_000)
        self.storage = SpiNor(spi, Pin(pins["flash"][3], Pin.OUT_PP, value=1))
        uart = UART(2, settings.BAUD, rxbuf=512)
        self.port = Port(uart, Pin(pins["drive"], Pin.OUT_PP, value=0))
        self.timer = Timer(pins["steps"])
        self.good = Pin(pins["supply_good"], Pin.IN, Pin.PULL_UP)
        self.limits = [Pin(name, Pin.IN, Pin.PULL_UP) for name in pins["limits"]]
        self.address = [Pin(name, Pin.IN, Pin.PULL_UP) for name in pins["switches"]]
        local = settings.LOCAL_SWITCH
        self.local = None if local is None else Pin(local, Pin.IN, Pin.PULL_UP)
        enable = settings.ENABLE
        self.enable = None if enable is None else Pin(enable, Pin.OUT_PP, value=0)
        wires = settings.TILT
        self.accelerometer = None
        if wires is not None:
            self.accelerometer = Lis3dh(I2C(1, freq=400_000))
        self.supply = pyb.ADC(Pin(pins["supply"]))
        self.chip = pyb.ADCAll(12, 0x70000)
        self.dog = machine.WDT(timeout=2000)

    def supply_mv(self):
        return self.supply.read() * 3300 * DIVIDER // 4095

    def temperature_degc(self):
        return int(self.chip.read_core_temp())
