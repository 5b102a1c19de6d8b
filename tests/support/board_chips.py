"""Stand-ins for the modules of MicroPython's boards: they do what the chips do, cycle by cycle.

Written from the data sheets of RP2040 (chapter 3, PIO), STM32F4 (RM0090, chapter 17, advanced
timers), W25Q and LIS3DH, and from MicroPython's documentation of ``rp2``, ``esp32.RMT``,
``pyb.Timer`` and ``machine``. ``Pulses`` are what a motor's driver would see at its step and
direction inputs.
"""

import contextlib
import importlib
import importlib.util
import random
import struct
import sys
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

FIRMWARE = Path(__file__).parents[2] / "firmware"


class World:
    """Time in µs, pins by name, and what runs by itself."""

    def __init__(self) -> None:
        self.us = 0.0
        self.pins: dict[object, int] = {}
        self.running: list[Any] = []
        #: Rising edges of each pin: (time in µs, level of all pins then).
        self.rises: dict[object, list[tuple[float, dict[object, int]]]] = {}
        self.irq_off = 0

    def ticks_ms(self) -> int:
        # Asking takes a little time, or a loop that waits would never end.
        self.advance(20)
        return int(self.us / 1000) & 0x3FFFFFFF

    def set(self, pin: object, level: int, at_us: float | None = None) -> None:
        before = self.pins.get(pin, 0)
        self.pins[pin] = level
        if level and not before:
            at = self.us if at_us is None else at_us
            self.rises.setdefault(pin, []).append((at, dict(self.pins)))

    def advance(self, us: float) -> None:
        """Let the hardware run on."""
        end = self.us + us
        for part in self.running:
            part.run(self.us, end)
        self.us = end

    def pulses(self, step: object, direction: object) -> list[tuple[float, int]]:
        """Times of the steps, with their sign."""
        return [(at, 1 if pins.get(direction, 0) else -1) for at, pins in self.rises.get(step, [])]


# machine


class Pin:
    IN, OUT, OUT_PP, PULL_UP = range(4)
    world: World

    def __init__(self, name: object, mode: int = 0, pull: int = -1, value: int | None = None):
        if isinstance(name, Pin):
            name = name.name
        self.name = name
        if value is not None:
            self(value)

    def __call__(self, value: object = None) -> int:
        if value is not None:
            self.world.set(self.name, int(bool(value)))
        return self.world.pins.get(self.name, 0)


class Uart:
    """A line that takes its time; ``sent`` holds what left while the driver was on."""

    world: World
    drive: object

    def __init__(self, *args: object, **settings: object) -> None:
        self.incoming, self.sent = b"", b""
        self._under_way = b""

    def any(self) -> int:
        return len(self.incoming)

    def read(self) -> bytes:
        data, self.incoming = self.incoming, b""
        return data

    def write(self, data: bytes) -> int:
        self._under_way += data
        return len(data)

    def flush(self) -> None:
        self.world.advance(len(self._under_way) * 87)
        if self.world.pins.get(self.drive, 0):
            self.sent += self._under_way
        self._under_way = b""


class Chip:
    """A W25Q on an SPI bus: pages wrap, bits are only cleared, writes need to be enabled."""

    world: World
    select: object
    dead = False

    def __init__(self, *args: object, **settings: object) -> None:
        self.cells = bytearray(b"\xff" * 65536)
        self.enabled, self.busy_until, self.command = False, 0.0, b""

    def write(self, data: bytes) -> None:
        assert self.world.pins.get(self.select) == 0
        self.command = bytes(data)
        code, at = data[0], int.from_bytes(data[1:4], "big")
        if code == 0x06:
            self.enabled = True
        elif code in (0x02, 0x20):
            assert self.enabled, "not enabled"
            assert self.world.us >= self.busy_until, "busy"
            self.enabled = False
            if code == 0x20:
                assert at % 4096 == 0
                self.cells[at : at + 4096] = b"\xff" * 4096
                self.busy_until = self.world.us + 45_000
            else:
                page = at & ~255
                for i, value in enumerate(data[4:]):
                    self.cells[page | (at + i) & 255] &= value
                self.busy_until = self.world.us + 700

    def read(self, size: int) -> bytes:
        if self.dead:
            return bytes(size)
        code, at = self.command[0], int.from_bytes(self.command[1:4], "big")
        if code == 0x9F:
            return b"\xef\x40\x15"[:size]
        if code == 0x05:
            return bytes([self.world.us < self.busy_until])
        assert code == 0x03
        assert self.world.us >= self.busy_until, "read while busy"
        return bytes(self.cells[at : at + size])


class Lis3dh:
    """A LIS3DH by its registers (DocID17530): identity, controls, and the FIFO in stream mode.

    ``gravity`` is what it measures, in g; each reading scatters by ``noise``. A measurement comes
    every 10 ms once it is set up.
    """

    world: World
    gravity = (0.0, 0.0, 1.0)
    noise = 0.7e-3
    identity = 0x33
    there = True

    def __init__(self, *args: object, **settings: object) -> None:
        self.registers = {0x0F: self.identity, 0x20: 0x07}
        self.since = self.world.us
        self.chance = random.Random(5)

    def _reached(self, address: int) -> None:
        if address != 0x18 or not self.there:
            raise OSError(19)  # ENODEV: nobody acknowledged

    def _waiting(self) -> int:
        """Measurements that nobody has read yet."""
        streaming = self.registers.get(0x24, 0) & 0x40 and self.registers.get(0x2E, 0) >> 6 == 2
        if not streaming or self.registers[0x20] != 0x57:
            return 0
        return int((self.world.us - self.since) / 10_000)

    def writeto_mem(self, address: int, register: int, data: bytes) -> None:
        self._reached(address)
        assert register in (0x20, 0x21, 0x22, 0x23, 0x24, 0x25, 0x2E), "read only"
        (self.registers[register],) = data
        self.since = self.world.us

    def readfrom_mem(self, address: int, register: int, size: int) -> bytes:
        self._reached(address)
        if register & 0x7F != 0x28:
            assert size == 1 or register & 0x80, "the number of the register rises only if told"
            if register == 0x2F:
                waiting = self._waiting()
                return bytes([0x40 | 31 if waiting > 31 else waiting or 0x20])
            return bytes([self.registers.get(register, 0)])
        assert register & 0x80
        assert size % 6 == 0
        # High resolution and ±2 g: 12 bits of 1 mg, left-justified; else 10 bits of 4 mg.
        fine = self.registers.get(0x23, 0) == 0x88
        data = b""
        assert size // 6 <= min(32, self._waiting()), "more than there is"
        for _ in range(size // 6):
            for part in self.gravity:
                mg = 1000.0 * (part + self.chance.gauss(0.0, self.noise))
                value = 16 * round(mg) if fine else 64 * round(mg / 4.0)
                data += struct.pack("<h", max(-32768, min(32767, value)))
        self.since = self.world.us
        return data


# rp2


class Instruction:
    """One instruction of PIO: what it is called with, its side-set and its delay."""

    def __init__(self, name: str, args: tuple[Any, ...]) -> None:
        self.name, self.args, self.level, self.delay = name, args, None, 0

    def side(self, level: int) -> "Instruction":
        self.level = level  # type: ignore[assignment]
        return self

    def __getitem__(self, delay: int) -> "Instruction":
        # One bit of the five is the side-set's, so four are left.
        assert 0 <= delay <= 15
        self.delay = delay
        return self


class Program:
    """A program as ``rp2.asm_pio`` makes it."""

    def __init__(self) -> None:
        self.code: list[Instruction] = []
        self.labels: dict[str, int] = {}
        self.target = self.last = 0

    def words(self) -> dict[str, Any]:
        def instruction(name: str) -> Callable[..., Instruction]:
            def made(*args: Any) -> Instruction:
                self.code.append(Instruction(name, args))
                return self.code[-1]

            return made

        names = ("x", "y", "isr", "osr", "pins", "null", "x_dec", "y_dec", "noblock", "block")
        return {
            **{name: instruction(name) for name in ("pull", "push", "out", "mov", "jmp", "set")},
            **{name: name for name in names},
            "invert": lambda source: "~" + source,
            "label": lambda name: self.labels.update({name: len(self.code)}),
            "wrap_target": lambda: setattr(self, "target", len(self.code)),
            "wrap": lambda: setattr(self, "last", len(self.code) - 1),
        }


def asm_pio(**settings: object) -> Callable[[Any], Program]:
    assert settings["out_shiftdir"] == 1

    def made(function: Any) -> Program:
        program = Program()
        types.FunctionType(function.__code__, program.words())()
        assert len(program.code) <= 32
        assert all(one.level is not None for one in program.code)
        return program

    return made


class StateMachine:
    """A state machine of PIO."""

    world: World

    def __init__(
        self, number: int, program: Program, *, freq: int, sideset_base: Pin, out_base: Pin
    ) -> None:
        self.program, self.clock = program, freq
        self.step, self.way = sideset_base.name, out_base.name
        self.x = self.y = self.isr = self.osr = self.pc = self.rest = 0
        self.tx: list[int] = []
        self.rx: list[int] = []
        self.on = False
        self.cycle = 0
        self.world.running.append(self)

    def active(self, on: int) -> None:
        self.on = bool(on)

    def restart(self) -> None:
        self.pc = self.program.target
        self.isr = self.rest = 0

    def put(self, word: int) -> None:
        assert len(self.tx) < 4, "put would block"
        assert 0 <= word < 1 << 32
        self.tx.append(word)

    def get(self) -> int:
        return self.rx.pop(0)

    def tx_fifo(self) -> int:
        return len(self.tx)

    def exec(self, text: str) -> None:
        program = Program()
        eval(text, program.words())  # as MicroPython does
        pc = self.pc
        assert self._do(program.code[0], program)
        self.pc = pc

    def run(self, start_us: float, end_us: float) -> None:
        end = round(end_us * self.clock / 1e6)
        self.cycle = max(self.cycle, round(start_us * self.clock / 1e6))
        while self.on and self.cycle < end:
            if self.rest:
                wait = min(self.rest, end - self.cycle)
                self.rest -= wait
                self.cycle += wait
                continue
            one = self.program.code[self.pc]
            if one.level is not None:
                self.world.set(self.step, one.level, 1e6 * self.cycle / self.clock)
            spins = one.name == "jmp" and self.program.labels.get(one.args[-1]) == self.pc
            if spins and one.args[0] == "y_dec" and self.y > 1:
                wait = min(self.y - 1, end - self.cycle)
                self.y -= wait
                self.cycle += wait
                continue
            if not self._do(one, self.program):
                self.cycle = end  # it waits for a word
                return
            self.cycle += 1
            self.rest = one.delay
        self.cycle = max(self.cycle, end)

    def _value(self, name: str) -> int:
        if name.startswith("~"):
            return self._value(name[1:]) ^ 0xFFFFFFFF
        return 0 if name == "null" else int(getattr(self, name))

    def _do(self, one: Instruction, program: Program) -> bool:
        """Do an instruction; False if it waits."""
        args = one.args
        following = program.target if self.pc == program.last else self.pc + 1
        if one.name == "pull":
            if not self.tx:
                if "noblock" not in args:
                    return False
                self.osr = self.x
            else:
                self.osr = self.tx.pop(0)
        elif one.name == "push":
            self.rx.append(self.isr)
            self.isr = 0
        elif one.name == "mov":
            setattr(self, args[0], self._value(args[1]))
        elif one.name == "out":
            value = self.osr & ((1 << args[1]) - 1)
            self.osr >>= args[1]
            if args[0] == "pins":
                self.world.set(self.way, value)
            else:
                setattr(self, args[0], value)
        elif one.name == "jmp":
            register = args[0][0]
            value = getattr(self, register)
            setattr(self, register, (value - 1) & 0xFFFFFFFF)
            if value:
                following = program.labels[args[1]]
        else:
            raise AssertionError(one.name)
        self.pc = following
        return True


# esp32


class Rmt:
    """A channel of the remote-control peripheral."""

    world: World

    def __init__(self, number: int, *, pin: Pin, resolution_hz: int, idle_level: bool) -> None:
        assert resolution_hz == 1_000_000
        assert idle_level is False
        self.pin, self.ends = pin.name, 0.0
        self.events: list[tuple[float, int]] = []
        self.world.running.append(self)

    def wait_done(self) -> bool:
        return self.world.us >= self.ends

    def write_pulses(self, times: list[int], levels: list[int]) -> None:
        assert self.wait_done(), "it would block"
        assert len(times) == len(levels)
        at = self.world.us
        for duration, level in zip(times, levels, strict=True):
            assert 1 <= duration <= 32767
            self.events.append((at, level))
            at += duration
        self.events.append((at, 0))
        self.ends = at

    def run(self, start_us: float, end_us: float) -> None:
        while self.events and self.events[0][0] < end_us:
            at, level = self.events.pop(0)
            self.world.set(self.pin, level, at)


class Partition:
    TYPE_DATA = 1
    device: "Partition | None" = None

    def __init__(self) -> None:
        self.cells = bytearray(b"\xff" * 65536)

    @classmethod
    def find(cls, kind: int, *, label: str) -> "list[Partition]":
        assert (kind, label) == (1, "journal")
        return [] if cls.device is None else [cls.device]

    def ioctl(self, what: int, block: int) -> int:
        if what == 4:
            return len(self.cells) // 4096
        assert what == 6
        self.cells[block * 4096 : block * 4096 + 4096] = b"\xff" * 4096
        return 0

    def readblocks(self, block: int, data: bytearray, offset: int) -> None:
        start = block * 4096 + offset
        data[:] = self.cells[start : start + len(data)]

    def writeblocks(self, block: int, data: bytes, offset: int) -> None:
        for i, value in enumerate(data, block * 4096 + offset):
            self.cells[i] &= value


# stm32

CR1, SR, EGR, CNT, ARR, RCR, CCR1 = 0x00, 0x10, 0x14, 0x24, 0x2C, 0x30, 0x34
BASES = {1: 0x40010000, 8: 0x40010400}


class Registers:
    """``machine.mem32`` over the timers."""

    def __init__(self) -> None:
        self.timers: dict[int, AdvancedTimer] = {}

    def __getitem__(self, address: int) -> int:
        timer = self.timers[address & ~0xFF]
        return timer.registers.get(address & 0xFF, 0)

    def __setitem__(self, address: int, value: int) -> None:
        self.timers[address & ~0xFF].written(address & 0xFF, value)


class AdvancedTimer:
    """TIM1 or TIM8: preload registers, repetition counter, one-pulse mode, PWM mode 2."""

    PWM_INVERTED = 2
    world: World
    memory: Registers
    #: Time from the update event to the handler, µs.
    latency = 12.0

    def __init__(self, number: int) -> None:
        self.registers = {CR1: 0, SR: 0, ARR: 0, RCR: 0, CCR1: 0}
        self.active = (1, 0, 1)  # period, repetitions left, compare
        self.count, self.pin = 0.0, None
        self.handler: Callable[[AdvancedTimer], None] | None = None
        self.due = 0.0
        self.memory.timers[BASES[number]] = self
        self.world.running.append(self)

    def source_freq(self) -> int:
        return 168_000_000

    def init(self, *, prescaler: int, period: int) -> None:
        assert prescaler == 167
        self.registers[ARR] = period
        self.registers[CR1] = 1
        self._take()

    def channel(self, number: int, mode: int, *, pin: Pin, pulse_width: int) -> None:
        assert (number, mode) == (1, self.PWM_INVERTED)
        self.pin = pin.name  # type: ignore[assignment]
        self.registers[CCR1] = pulse_width

    def callback(self, handler: "Callable[[AdvancedTimer], None]") -> None:
        self.handler = handler

    def _take(self) -> None:
        own = self.registers
        self.active = own[ARR] + 1, own[RCR], own[CCR1]
        self.count = 0.0

    def written(self, register: int, value: int) -> None:
        assert 0 <= value < 1 << 16
        if register == EGR:
            assert value == 1
            self._take()
            if not self.registers[CR1] & 4:
                self.registers[SR] |= 1
        elif register == SR:
            self.registers[SR] &= value
        else:
            assert register != RCR or value < 256
            assert register in self.registers
            self.registers[register] = value

    def run(self, start_us: float, end_us: float) -> None:
        now = start_us
        while True:
            if self.registers[SR] & 1 and not self.world.irq_off and self.due <= now:
                self.registers[SR] &= ~1
                assert self.handler is not None
                kept, self.world.us = self.world.us, now
                self.handler(self)
                self.world.us = kept
            limit = min(end_us, self.due) if self.registers[SR] & 1 else end_us
            if not self.registers[CR1] & 1:
                if limit >= end_us:
                    return
                now = limit
                continue
            period, left, compare = self.active
            # The next edge: to the compare value, or to the end of the period.
            edge = compare if self.count < compare else period
            wait = edge - self.count
            if now + wait > limit:
                self.count += limit - now
                now = limit
                if limit >= end_us:
                    return
                continue
            now += wait
            self.count = edge
            if edge == compare and edge < period:
                self.world.set(self.pin, 1, now)
            else:
                self.world.set(self.pin, 0, now)
                self._period_over(left, now)

    def _period_over(self, left: int, now: float) -> None:
        self.count = 0.0
        if left:
            self.active = self.active[0], left - 1, self.active[2]
            return
        self._take()
        self.registers[SR] |= 1
        self.due = now + self.latency
        if self.registers[CR1] & 8:
            self.registers[CR1] &= ~1


class Adc:
    CORE_TEMP, ATTN_11DB = 4, 3
    world: World

    def __init__(self, source: object, atten: int = 0) -> None:
        self.source = source.name if isinstance(source, Pin) else source

    def read_u16(self) -> int:
        if self.source == self.CORE_TEMP:
            return round(0.706 / 3.3 * 65535)
        return round(self.world.pins.get("mv", 24000) / 11 / 3300 * 65535)

    def read(self) -> int:
        return self.read_u16() >> 4

    def read_uv(self) -> int:
        return round(self.world.pins.get("mv", 24000) / 11 * 1000)

    def read_core_temp(self) -> float:
        return 27.0


class Dog:
    world: World

    def __init__(self, timeout: int) -> None:
        self.timeout, self.fed = timeout, self.world.us

    def feed(self) -> None:
        assert self.world.us - self.fed < 1000 * self.timeout, "the watchdog bit"
        self.fed = self.world.us


#: Pins of the flash chip's select and of the bus driver, by board.
SELECT = {"rp2": 17, "esp32": 5, "stm32": "B12"}
DRIVE = {"rp2": 2, "esp32": 4, "stm32": "A1"}


def modules(board: str, world: World) -> dict[str, ModuleType]:
    """The modules of all boards, over one world."""
    memory = Registers()

    def bound(kind: type, **more: object) -> Any:
        return type(kind.__name__, (kind,), {"world": world, **more})

    def irq(change: int) -> int:
        world.irq_off += change
        assert world.irq_off >= 0
        return 0

    pin, timer = bound(Pin), bound(AdvancedTimer, memory=memory)
    adc, dog = bound(Adc), bound(Dog)
    return {  # type: ignore[return-value]
        "machine": SimpleNamespace(
            Pin=pin,
            UART=bound(Uart, drive=DRIVE[board]),
            ADC=adc,
            SPI=bound(Chip, select=SELECT[board]),
            I2C=bound(Lis3dh),
            WDT=dog,
            mem32=memory,
            unique_id=lambda: b"\1\2\3\4",
            disable_irq=lambda: irq(1),
            enable_irq=lambda state: irq(-1),
        ),
        "rp2": SimpleNamespace(
            asm_pio=asm_pio,
            StateMachine=bound(StateMachine),
            PIO=SimpleNamespace(OUT_LOW=0, SHIFT_RIGHT=1),
        ),
        "esp32": SimpleNamespace(RMT=bound(Rmt), Partition=Partition, mcu_temperature=lambda: 27.4),
        "pyb": SimpleNamespace(
            Pin=pin, Timer=timer, ADC=adc, ADCAll=lambda bits, mask: adc("chip")
        ),
        "stm": SimpleNamespace(TIM1=BASES[1], TIM8=BASES[8]),
    }


@contextlib.contextmanager
def board_path(board: str, world: World) -> Iterator[Callable[[str], ModuleType]]:
    """Import the firmware's modules as on a board; what was imported before comes back."""
    names = ["board", "steps", "nor", "rs485", "inputs", "loop", "settings", "tilt"]
    clock = SimpleNamespace(
        ticks_ms=world.ticks_ms,
        ticks_diff=lambda one, two: ((one - two + 2**29) & 0x3FFFFFFF) - 2**29,
    )
    core = importlib.import_module("heliotrope.lcu")
    on_board: dict[str, Any] = {
        **modules(board, world),
        "lcu": core,
        "lcu.node": importlib.import_module("heliotrope.lcu.node"),
        "lcu.controller": importlib.import_module("heliotrope.lcu.controller"),
    }
    kept = {name: sys.modules.pop(name, None) for name in [*names, *on_board]}
    sys.modules.update(on_board)

    def load(name: str) -> ModuleType:
        for folder in (FIRMWARE / board, FIRMWARE / "common"):
            if (folder / f"{name}.py").exists():
                spec = importlib.util.spec_from_file_location(name, folder / f"{name}.py")
                assert spec is not None
                assert spec.loader is not None
                sys.modules[name] = importlib.util.module_from_spec(spec)
                spec.loader.exec_module(sys.modules[name])
                if hasattr(sys.modules[name], "time"):
                    sys.modules[name].time = clock  # type: ignore[attr-defined]
                return sys.modules[name]
        raise ModuleNotFoundError(name)

    try:
        yield load
    finally:
        for name, module in kept.items():
            sys.modules.pop(name, None)
            if module is not None:
                sys.modules[name] = module
