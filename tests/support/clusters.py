"""What the tests of the cluster share: real local controllers on a bus in memory, and a plant."""

import asyncio
import contextlib
import copy
import functools
import struct
from collections.abc import AsyncIterator, Callable, Coroutine
from datetime import UTC, datetime, timedelta
from typing import Any, TypeVar

from heliotrope.cluster.config import ClusterConfig, Member
from heliotrope.cluster.controller import Cluster
from heliotrope.cluster.memory import Kept
from heliotrope.cluster.timekeeping import SystemTime
from heliotrope.lcu import states, ticks
from heliotrope.lcu.journal import Journal
from heliotrope.lcu.node import Node
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.connection import CarriedLink
from heliotrope.links.in_process import memory_pair
from heliotrope.links.keys import KeyRing
from heliotrope.links.link import Bus, received, running
from heliotrope.links.messages import (
    ClusterStatus,
    Command,
    Emergency,
    Lease,
    Message,
    Progress,
    Stage,
    decode,
    encode,
)
from heliotrope.plant.field.cluster_alarms import ClusterAlarms
from heliotrope.safety import Alarm
from heliotrope.sun import Site
from heliotrope.twin.boards.bus import TwinBus
from support.lcu_machines import STOW, Flash, heliostat, items_of_heliostat, sha256

SITE = Site(37.09, -2.36, 500.0, name="Tabernas")
TOKEN = 0xABCD
AIM = (0.0, 0.0, 50.0)
M = TypeVar("M", bound=Message)


def key_of(number: int) -> bytes:
    return bytes([number]) * 32


class Timer:
    """A step timer that counts."""

    def __init__(self) -> None:
        self.made = list(STOW)

    def play(self, axis: int, direction: int, count: int, interval_us: int) -> None:
        self.made[axis] += direction * count

    def stop(self) -> tuple[int, int]:
        return 0, 0


class Board:
    """A local controller on the bus; ``on`` is its supply."""

    def __init__(self, number: int, address: int | None = None, *, configured: bool = True) -> None:
        self.number = number
        self.serial = 5000 + 37 * number
        self.flash, self.timer = Flash(), Timer()
        self.on = True
        self.out = bytearray()
        self.begin = self.at = 0.0
        if configured:
            items = items_of_heliostat(heliostat())
            items["address"] = struct.pack("<H", address or number)
            journal = Journal(self.flash)
            journal.load()
            journal.store(items)
            journal.zero(*STOW)
        self.boot(0.0)

    def boot(self, now: float) -> None:
        self.node = Node(
            self.flash,
            self.timer,
            self._write,
            self._tick(now),
            self.serial,
            sha256=sha256,
            key=key_of(self.number),
        )
        self.on = True

    def _write(self, data: bytes) -> None:
        self.out += data

    def _tick(self, now: float) -> int:
        self.at = now
        return round((now - self.begin) * 1000) % ticks.PERIOD

    def resume(self, now: float) -> "Board":
        """Go on in another field, whose time is another."""
        self.begin += now - self.at
        self.at = now
        return self

    def hear(self, data: bytes, now: float) -> bytes:
        self.out.clear()
        if self.on:
            self.node.on_bytes(data, self._tick(now))
        return bytes(self.out)

    def tick(self, now: float) -> bytes:
        self.out.clear()
        if self.on:
            self.node.on_tick(self._tick(now))
        return bytes(self.out)

    @property
    def state(self) -> str:
        return states.STATES[self.node.controller.state]


def config_of(count: int, **changes: Any) -> ClusterConfig:
    members = tuple(
        Member(f"A{n}", n, serial=5000 + 37 * n, key=key_of(n)) for n in range(1, count + 1)
    )
    values: dict[str, Any] = {"name": "C1", "site": SITE, "heliostats": members, **changes}
    return ClusterConfig(**values)


class Plant:
    """The plant's end of the link, and what came over it."""

    def __init__(self, link: CarriedLink, clock: VirtualClock) -> None:
        self.link, self.clock = link, clock
        self.heard: list[Message] = []
        self.leases = True
        self.token = TOKEN
        self.autonomy = 0.0
        self.run = "first"

    async def listen(self) -> None:
        told = ClusterAlarms(lambda alarm: None)
        async for data in received(self.link):
            message = decode(data)
            repeated = isinstance(message, Alarm) and not told.take("C1", message)
            if not repeated:
                self.heard.append(message)

    async def lease(self) -> None:
        while True:
            if self.leases:
                await self.send(Lease(self.token, autonomy=self.autonomy, run=self.run))
            await asyncio.sleep(1.0)

    async def send(self, message: Message) -> None:
        await self.link.send(encode(message), expires=self.clock.monotonic() + 1.0)

    def all(self, kind: type[M]) -> list[M]:
        return [each for each in self.heard if isinstance(each, kind)]

    def status(self) -> ClusterStatus:
        return self.all(ClusterStatus)[-1]

    def stages(self, identity: str, heliostat: str) -> list[Stage]:
        """The stages of a command at a heliostat, in order."""
        return [
            each.stage
            for each in self.all(Progress)
            if each.identity == identity and heliostat in each.heliostats
        ]

    def text(self, identity: str, heliostat: str = "") -> str:
        """Why a command was refused or failed."""
        return next(
            each.text
            for each in self.all(Progress)
            if each.identity == identity
            and each.stage in (Stage.REFUSED, Stage.FAILED)
            and (not heliostat or heliostat in each.heliostats)
        )

    def alarms(self, condition: str) -> list[Alarm]:
        return [each for each in self.all(Alarm) if each.condition == condition]


class Field:
    """A cluster, its boards, its bus and its plant, in virtual time."""

    def __init__(
        self,
        clock: VirtualClock,
        count: int = 2,
        *,
        boards: list[Board] | None = None,
        bus: Callable[[VirtualClock, list[Board]], Bus] | None = None,
        seed: int = 0,
        kept: Kept | None = None,
        line: Callable[[], bool] | None = None,
        bus_keys: KeyRing | None = None,
        begun: bool = False,
        **changes: Any,
    ) -> None:
        self.clock = clock
        now = clock.monotonic()
        if boards is None:
            self.boards = [Board(n) for n in range(1, count + 1)]
            for board in self.boards:
                board.boot(now)
        else:
            self.boards = [board.resume(now) for board in boards]
            count = len(boards)
        self.config = config_of(count, **changes)
        self.bus: Any = (
            bus(clock, self.boards) if bus else TwinBus(clock, [*self.boards], seed=seed)
        )
        near, far, self.line = memory_pair(clock, seed=seed)
        self.plant = Plant(near, clock)
        self.link = far
        self.time = SystemTime(clock)
        self.kept = kept or Kept(None)
        self.cluster = Cluster(
            self.config,
            self.bus,
            self.link,
            clock,
            self.time,
            self.kept,
            line=line,
            bus_keys=bus_keys,
        )
        if begun:
            # The cluster goes on: the DEFOCUS of its start is over.
            first = self.cluster._work._emergencies
            first._orders.clear()
            first.pressing = False

    async def _tick(self) -> None:
        while True:
            for board in self.boards:
                board.tick(self.clock.monotonic())
            await asyncio.sleep(0.05)

    @contextlib.asynccontextmanager
    async def alive(self) -> AsyncIterator["Field"]:
        """Run everything beside a block."""
        async with asyncio.TaskGroup() as group:
            others = [
                group.create_task(part())
                for part in (self._tick, self.plant.listen, self.plant.lease)
            ]
            async with (
                running(self.bus, self.link, self.plant.link, self.time),
                running(self.cluster),
            ):
                await self.until(lambda: bool(self.plant.all(ClusterStatus)))
                yield self
            for other in others:
                other.cancel()

    async def until(self, holds: Callable[[], bool], limit: float = 30.0) -> float:
        """Wait until something holds; returns how long that took, s."""
        begin = self.clock.monotonic()
        while not holds():
            assert self.clock.monotonic() - begin < limit, self.states()
            await asyncio.sleep(0.05)
        return self.clock.monotonic() - begin

    def states(self) -> list[str]:
        return [board.state for board in self.boards]

    async def order(self, identity: str, name: str, *values: float, **more: Any) -> None:
        await self.plant.send(
            Command(identity, name, values, **{"token": self.plant.token, **more})
        )

    async def emergency(self, identity: str, name: str, *heliostats: str) -> None:
        await self.plant.send(Emergency(identity, name, heliostats))

    async def to_tracking(self) -> None:
        """From power-on to tracking."""
        await self.until(self.sun_is_fresh)
        await self.order("aim", "AIM", *AIM)
        await self.order("approach", "APPROACH")
        await self.until(lambda: set(self.states()) == {"IDLE"}, 300.0)
        await self.order("track", "TRACK")
        await self.until(lambda: set(self.states()) == {"TRACKING"}, 10.0)

    def sun_is_fresh(self) -> bool:
        """Whether the sun has arrived everywhere."""
        return all(board.node.controller.sun.fresh() for board in self.boards if board.on)


#: When fields of new boards begin.
LATER = datetime(2026, 6, 21, 10, 15, tzinfo=UTC)


@functools.cache
def _saved() -> dict[str, tuple[list[Board], datetime]]:
    found = {}

    async def main(clock: VirtualClock) -> None:
        async with Field(clock).alive() as field:
            await field.until(field.sun_is_fresh)
            await field.order("aim", "AIM", *AIM)
            await field.order("approach", "APPROACH")
            await field.until(lambda: set(field.states()) == {"IDLE"}, 300.0)
            found["IDLE"] = copy.deepcopy(field.boards), clock.utc()
            await field.order("track", "TRACK")
            await field.until(lambda: set(field.states()) == {"TRACKING"}, 10.0)
            await asyncio.sleep(20.0)
            found["TRACKING"] = copy.deepcopy(field.boards), clock.utc()

    run_virtual(main)
    return found


def boards_in(state: str) -> tuple[list[Board], datetime]:
    """Two boards in IDLE or TRACKING, and when their field is to begin.

    They refuse a sun that cannot follow from the last one that they took.
    """
    boards, at = _saved()[state]
    return copy.deepcopy(boards), at.replace(microsecond=0) + timedelta(seconds=4)


def run(
    main: Callable[["Field"], Coroutine[Any, Any, None]],
    state: str = "",
    seed: int = 0,
    **settings: Any,
) -> Field:
    """Run a test in virtual time, on two boards of a state or on new ones, and return its field."""
    boards, start = boards_in(state) if state else (settings.pop("boards", None), LATER)

    async def live(clock: VirtualClock) -> Field:
        field = Field(clock, boards=boards, seed=seed, begun=bool(state), **settings)
        async with field.alive():
            await main(field)
        return field

    return run_virtual(live, seed, start=start)


class SlotBus(TwinBus):
    """A bus on which those who speak at once spoil each other, and late answers are heard."""

    STEP = 0.005

    async def transact(
        self,
        frame: bytes,
        timeout: float,
        *,
        expires: float | None = None,
        urgent: bool = False,
        complete: Callable[[bytes], bool] | None = None,
    ) -> bytes:
        boards: list[Any] = list(self.stations)
        now = self._clock.monotonic()
        heard = bytearray(_at_once([board.hear(frame, now) for board in boards]))
        while self._clock.monotonic() - now < timeout and not (heard and complete is None):
            await asyncio.sleep(self.STEP)
            heard += _at_once([board.tick(self._clock.monotonic()) for board in boards])
            if complete is not None and complete(bytes(heard)):
                break
        return bytes(heard)


def _at_once(spoken: list[bytes]) -> bytes:
    """What is heard of several who speak at once: the line is low where anyone pulls it low."""
    spoken = [data for data in spoken if data]
    if len(spoken) < 2:
        return b"".join(spoken)
    size = max(map(len, spoken))
    padded = [data + b"\xff" * (size - len(data)) for data in spoken]
    return bytes(
        functools.reduce(lambda a, b: a & b, column) for column in zip(*padded, strict=True)
    )
