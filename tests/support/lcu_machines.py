"""What the tests of the local controller share: single precision, a heliostat, a bench."""

import copy
import functools
import hashlib
import importlib
import importlib.util
import math
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np

import heliotrope.lcu
from heliotrope.geometry import direction
from heliotrope.lcu import controller, drives, messages, signing, states, ticks, wire
from heliotrope.lcu.journal import CODES_OF, Journal
from heliotrope.lcu.names import FLAGS
from heliotrope.lcu.node import Node
from heliotrope.lcu.sender import Sender
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import Drive, rotary
from heliotrope.mechanism.kernels import slots as slot
from support.machines import imperfect


def single(name: str) -> ModuleType:
    """A copy of a module of the local controller whose ``math`` gives 32-bit floats.

    Fed with ``numpy.float32`` it rounds every operation to single precision, as a board
    without doubles does.
    """
    package = "lcu_single"
    if package not in sys.modules:
        init = Path(heliotrope.lcu.__file__)
        spec = importlib.util.spec_from_file_location(
            package, init, submodule_search_locations=[str(init.parent)]
        )
        assert spec is not None
        sys.modules[package] = importlib.util.module_from_spec(spec)
    module = importlib.import_module(f"{package}.{name}")

    def rounding(function):  # type: ignore[no-untyped-def]
        return lambda *values: np.float32(function(*map(float, values)))

    rounded = {name: rounding(getattr(math, name)) for name in ("sqrt", "sin", "cos", "atan2")}
    shim = SimpleNamespace(
        pi=np.float32(math.pi),
        inf=np.float32(math.inf),
        floor=math.floor,
        ceil=math.ceil,
        isfinite=math.isfinite,
        **rounded,
    )
    for other in ("vectors", name):
        sys.modules[f"{package}.{other}"].math = shim  # type: ignore[attr-defined]
    return module


def f32(values: object) -> tuple[np.float32, ...]:
    return tuple(np.float32(value) for value in np.asarray(values, dtype=float))


ORDER = (
    slot.ZERO, slot.RATE, slot.STROKE, slot.OFFSET, slot.RADIUS, slot.SCALE, slot.WORM_COS,
    slot.WORM_SIN, slot.WORM_RATIO, slot.SAG,
)  # fmt: skip


def numbers_of(known: Drive) -> tuple[int, tuple[float, ...], float]:
    """Kind, ten numbers and bias of a drive of the mechanism."""
    table = known.table
    kind = drives.ROTARY
    if table[slot.KIND] == slot.LINEAR:
        kind = drives.JACK_RISING if table[slot.SENSE] > 0 else drives.JACK_FALLING
    numbers = tuple(float(table[i]) for i in ORDER)
    phase = float(table[slot.SAG_PHASE])
    return (kind, *drives.reduced(kind, numbers, float(table[slot.BIAS]), phase))


@functools.cache
def _tracking() -> "Bench":
    bench = Bench()
    bench.to_tracking()
    return bench


def tracking() -> "Bench":
    """A bench whose heliostat tracks."""
    return copy.deepcopy(_tracking())


@functools.cache
def _standing_by() -> "Bench":
    bench = Bench()
    bench.run(1.5)
    assert bench.order("AIM", *AIM) == bench.order("APPROACH") == messages.DONE
    bench.run(240, until="IDLE")
    return bench


def standing_by() -> "Bench":
    """A bench whose heliostat has come to standby."""
    return copy.deepcopy(_standing_by())


ADDRESS, TOKEN, KEY, START_S = 17, 0xABCD, b"k" * 32, 1_400_000_000
AIM, STANDBY = (0.0, 0.0, 50.0), (12.0, 0.0, 40.0)
#: Counts of stow: looking up, azimuth east.
STOW = (480_000, 470_000)
#: 1.92 million steps a turn: 3.3 µrad a step; 1.5°/s.
GEAR = {"steps_per_turn": 200, "gear_ratio": 2400, "microsteps": 4}
LIMITS = (8000, 16_000, 40)


def sha256(data: bytes) -> bytes:
    """The hash."""
    return hashlib.sha256(data).digest()


def heliostat() -> Mechanism:
    """An imperfect azimuth-elevation heliostat, 90 m from the tower."""
    return imperfect(
        kinds.azimuth_elevation(
            (40.0, 80.0, 0.0),
            pivot_height=2.0,
            pivot_offset=0.2,
            drives=(rotary(**GEAR), rotary(**GEAR)),
        ),
        seed=3,
        size=4e-3,
    )


def items_of_heliostat(machine: Mechanism) -> dict[str, bytes]:
    """What the journal of a complete controller holds."""
    made = [numbers_of(machine.drives[i]) for i in (0, 1)]
    limits = [(-100_000, 1_950_000, *LIMITS), (-20_000, 500_000, *LIMITS)]
    numbers: dict[str, tuple[object, ...]] = {
        "address": (ADDRESS,), "location": tuple(machine.position),
        "armature": tuple(machine.armature.table), "stow": STOW, "standby": STANDBY,
        "biases": (made[0][2], made[1][2]), "defocus": (0.1, 0.05),
    }  # fmt: skip
    for i, end in enumerate(("primary", "secondary")):
        numbers[f"drive_{end}"] = (made[i][0], *made[i][1])
        numbers[f"limits_{end}"] = limits[i]
    return {name: struct.pack(CODES_OF[name], *values) for name, values in numbers.items()}


class Flash:
    """NOR flash in memory."""

    block_size, blocks = 4096, 6

    def __init__(self) -> None:
        self.data = bytearray(b"\xff" * self.block_size * self.blocks)

    def read(self, offset: int, size: int) -> bytes:
        return bytes(self.data[offset : offset + size])

    def write(self, offset: int, data: bytes) -> None:
        for i, value in enumerate(data, offset):
            self.data[i] &= value

    def erase(self, block: int) -> None:
        start = block * self.block_size
        self.data[start : start + self.block_size] = b"\xff" * self.block_size


class Motors:
    """A step timer that makes its steps at once, within the limits of the heliostat.

    ``made`` are the counts of the motors; ``undone`` is what the next emergency stop takes back.
    """

    def __init__(self) -> None:
        self.made, self.undone, self.stops = list(STOW), (0, 0), 0
        self.powered = True
        self.node: Node | None = None

    def play(self, axis: int, direction: int, count: int, interval_us: int) -> None:
        assert self.node is not None
        assert self.powered
        assert interval_us * LIMITS[0] >= 1_000_000
        self.made[axis] += direction * count
        limits = self.node.controller.config.axes[axis]
        assert limits is not None
        assert limits.low <= self.made[axis] <= limits.high
        assert self.node.trouble or not self.node.journal.rest

    def stop(self) -> tuple[int, int]:
        self.stops += 1
        undone, self.undone = self.undone, (0, 0)
        self.made[0] -= undone[0]
        self.made[1] -= undone[1]
        return undone


def signer(key: bytes) -> Callable[[bytes], bytes]:
    """What signs frames with a key of the bus."""
    return functools.partial(signing.tag, sha256, signing.pads_of(key))


#: The flag of a board that wants a session signed over its own number.
WANTED = 1 << FLAGS.index("SESSION_WANTED")


class Bench:
    """A board with its node, a cluster controller that talks to it, and a sun.

    Invariants are checked after every call; ``made`` counts the steps of the motors. With a key
    of the bus both ends have it.
    """

    def __init__(self, flash: Flash | None = None, tick: int = 0, bus_key: bytes = b"") -> None:
        self.bus_key = bus_key
        self.machine = heliostat()
        self.motors, self.slip = Motors(), [0, 0]
        self.now, self.true_ms = tick, 0
        self.sender = self.new_sender(START_S)
        self.sends_sun = self.sends_time = True
        self.clock_error_ms = 0
        self.tilt: tuple[float, float] | None = None
        self.answers: list[tuple[int, tuple[object, ...]]] = []
        self.edition = 0
        self.fed = False
        self.last_sun_ms = -(10**9)
        self.start(flash)

    def start(self, flash: Flash | None = None) -> None:
        """Switch the board on, with an empty or a given flash."""
        if flash is None:
            flash = Flash()
            journal = Journal(flash)
            journal.load()
            journal.store(items_of_heliostat(self.machine))
            if self.bus_key:
                journal.store({"bus_keys": self.bus_key + signing.NO_KEY})
            journal.zero(*STOW)
        self.flash = flash
        before = self.made
        kept = Journal(flash)
        kept.load()
        # Where the journal's counts are not those of the motors, it slips for good.
        counts = [kept.primary, kept.secondary]
        self.slip = [s + m - c for s, m, c in zip(self.slip, before, counts, strict=True)]
        self.made = counts
        self.motors.node, self.motors.powered = None, True
        self.node = Node(
            flash,
            self.motors,
            self.hear,
            self.now,
            4711,
            sha256=sha256,
            key=KEY,
            sensor=self.read_tilt,
            feed=self.feed,
            drivers=self.drive,
        )
        self.motors.node = self.node
        self.journal.zero = self.declare  # type: ignore[method-assign]
        self.check()

    def declare(self, primary: int, secondary: int, doubtful: int = 0) -> None:
        """ZERO: the motors stand where they stood, under other counts."""
        counts = primary, secondary
        slip = zip(self.slip, self.made, counts, strict=True)
        self.slip = [s + m - c for s, m, c in slip]
        self.made = list(counts)
        Journal.zero(self.journal, primary, secondary, doubtful)

    def read_tilt(self) -> tuple[float, float] | None:
        """The accelerometer."""
        return self.tilt

    def drive(self, on: bool) -> None:
        """Switch the motors' drivers; without current a rotor turns to a full step."""
        self.motors.powered = on
        if not on:
            assert self.controller.config.rests
            for made, full in zip(self.made, self.controller.config.microsteps, strict=True):
                assert made % full == 0

    def feed(self) -> None:
        """The watchdog."""
        self.fed = True

    def hear(self, data: bytes) -> None:
        """What the cluster controller gets."""
        for frame in wire.Reader().feed(data):
            assert frame.to == 0
            values = frame.values()
            assert values is not None
            self.answers.append((frame.number, values))

    @property
    def controller(self) -> controller.Controller:
        return self.node.controller

    @property
    def journal(self) -> Journal:
        return self.node.journal

    @property
    def made(self) -> list[int]:
        return self.motors.made

    @made.setter
    def made(self, counts: list[int]) -> None:
        self.motors.made[:] = counts

    @property
    def state(self) -> str:
        return states.STATES[self.controller.state]

    def do(self, actions: list[tuple[object, ...]]) -> None:
        """Obey the controller's actions, where a test calls it past the node."""
        self.node._obey(actions, self.now)
        self.check()

    def check(self) -> None:
        """What must hold after every event."""
        own = self.controller
        if own.motion.stepper is not None and own.motion.known:
            assert [axis.count for axis in own.motion.stepper.axes] == self.made
        if own.state in states.NEED_SUN:
            assert own.sun.fresh()
            assert own.sun.age_ms() <= own.config.lease_ms
            assert self.true_ms - self.last_sun_ms <= own.config.lease_ms
        if own.state == states.TRACKING:
            assert own.motion.ready
            assert own.fault == controller.NO_FAULT

    # The cluster controller.

    def new_sender(self, epoch: int) -> Sender:
        """A cluster that has just started."""
        sender = Sender(0, epoch, sha256)
        sender.sign = signer(self.bus_key) if self.bus_key else None
        return sender

    def ask_bus(self) -> tuple[bytes, int, int]:
        """The number that the board has drawn, and the fingerprints of its keys."""
        self.answers.clear()
        self.send("QUERY_BUS")
        ((number, (high, low, newest, old)),) = self.answers
        assert number == 0x0F
        return struct.pack("<II", high, low), newest, old  # type: ignore[return-value]

    def meet(self) -> None:
        """Begin a signed session with a board that wants one."""
        if self.bus_key and self.controller.flags() & WANTED:
            number, _, _ = self.ask_bus()
            self.deliver(self.sender.session_to(ADDRESS, TOKEN, number, signer(self.bus_key)))

    def gps_ms(self) -> int:
        return START_S * 1000 + self.true_ms + self.clock_error_ms

    def sun(self, second: float) -> np.ndarray:
        """A sun in the south that goes west."""
        hour = 7.27e-5 * (second - START_S) % (2.0 * np.pi)
        return np.array(direction(np.pi + hour, 0.7 + 0.2 * np.sin(hour)))

    def send(self, name: str, *values: object, to: int = ADDRESS) -> None:
        """Send a message."""
        key = KEY if messages.who_of(messages.NUMBER_OF[name]) == messages.KEY else b""
        self.deliver(self.sender.frame(to, name, *values, key=key))

    def deliver(self, data: bytes) -> None:
        """Bring bytes to the board."""
        self.node.on_bytes(data, self.now)
        self.check()

    def order(self, name: str, *values: object, life_s: int = 5, token: int = TOKEN) -> int:
        """Give a command and return the result in the ACK."""
        head: tuple[object, ...] = (token, self.gps_ms() // 1000 + life_s)
        if messages.who_of(messages.NUMBER_OF[name]) == messages.KEY:
            self.edition += 1
            head = (*head, self.edition)
        if messages.who_of(messages.NUMBER_OF[name]) == messages.ANYONE:
            head = ()
        self.answers.clear()
        self.send(name, *head, *values)
        number, (_, of, result) = self.answers[-1]
        assert (number, of) == (0x0D, messages.NUMBER_OF[name])
        return result  # type: ignore[return-value]

    def second(self) -> None:
        """What the cluster sends each second."""
        if self.sends_time:
            seconds, ms = divmod(self.gps_ms(), 1000)
            self.deliver(self.sender.session(TOKEN))
            self.meet()
            self.send("TIME", seconds // 604_800, seconds % 604_800 * 1000 + ms, 1, to=0xFFFF)
        if self.sends_sun:
            self.last_sun_ms = self.true_ms
            self.send("SUN", *self.sun_values(self.gps_ms() // 1000), to=0xFFFF)

    def sun_values(self, second: int) -> tuple[int, ...]:
        here, there = self.sun(second), self.sun(second + 1)
        return (
            second,
            *(round(x * 2**30) for x in here),
            *(round(x * 2**28) for x in there - here),
        )

    # Time.

    def tick(self, ms: int = 50) -> None:
        self.now = ticks.add(self.now, ms)
        self.true_ms += ms
        self.fed = False
        self.node.on_tick(self.now)
        self.check()

    def run(self, seconds: float, *, until: str = "") -> float:
        """Let time pass, at most until a state is reached; returns how long that took, s."""
        begin = self.true_ms
        while self.true_ms - begin < 1000 * seconds:
            part = 0
            if self.true_ms % 1000 == 0:
                # Messages come between ticks.
                part = 20
                self.now, self.true_ms = ticks.add(self.now, part), self.true_ms + part
                self.second()
            self.tick(50 - part)
            if until and self.state == until:
                break
        return (self.true_ms - begin) / 1000

    def to_tracking(self) -> None:
        """From stow to tracking by the authority's commands."""
        self.run(1.5)
        assert self.order("AIM", *AIM) == messages.DONE
        assert self.order("APPROACH") == messages.DONE
        self.run(240, until="IDLE")
        assert self.order("TRACK") == messages.DONE
        self.run(20)
        assert self.state == "TRACKING"

    def pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Normal and vertex of the mirror, by the mechanism."""
        return self.machine.armature.pose(self.machine.drives.angles(np.add(self.made, self.slip)))

    def miss(self, aim: tuple[float, float, float]) -> float:
        """Distance by which the true beam passes a point, m; infinite if it goes away from it."""
        normal, vertex = self.pose()
        sun = self.sun(self.gps_ms() / 1000)
        ray = 2.0 * (normal @ sun) * normal - sun
        way = np.array(aim) - vertex
        return float(np.linalg.norm(np.cross(way, ray))) if way @ ray > 0 else math.inf
