"""Raspberry Pi Pico, Pico 2 and other boards with an RP2040 or RP2350."""

from binascii import crc32

import machine
from inputs import DIVIDER, Inputs
from machine import ADC, I2C, SPI, UART, Pin
from nor import SpiNor
from rs485 import Port
from steps import Timer
from tilt import Lis3dh


class Board(Inputs):
    def __init__(self, settings):
        pins = settings.PINS
        self.firmware, self.key = settings.FIRMWARE, settings.KEY
        self.serial = crc32(machine.unique_id())
        clock, out, back, select = pins["flash"]
        spi = SPI(0, baudrate=10_000_000, sck=Pin(clock), mosi=Pin(out), miso=Pin(back))
        self.storage = SpiNor(spi, Pin(select, Pin.OUT, value=1))
        send, receive = pins["bus"]
        uart = UART(0, settings.BAUD, tx=Pin(send), rx=Pin(receive), rxbuf=512)
        self.port = Port(uart, Pin(pins["drive"], Pin.OUT, value=0))
        self.timer = Timer(pins["steps"])
        self.good = Pin(pins["supply_good"], Pin.IN, Pin.PULL_UP)
        self.limits = [Pin(number, Pin.IN, Pin.PULL_UP) for number in pins["limits"]]
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
        self.supply, self.warmth = ADC(pins["supply"]), ADC(ADC.CORE_TEMP)
        self.dog = machine.WDT(timeout=2000)

    def supply_mv(self):
        return self.supply.read_u16() * 3300 * DIVIDER // 65535

    def temperature_degc(self):
        # The sensor of the chip: 0.706 V at 27 °C, -1.721 mV/K.
        volts = self.warmth.read_u16() * 3.3 / 65535
        return round(27 - (volts - 0.706) / 0.001721)
