"""One cluster of a simulation: its program, its bus with boards, its line to the plant."""

import asyncio
import random
from collections import Counter
from datetime import datetime

from heliotrope.cluster.config import ClusterConfig, Member
from heliotrope.cluster.controller import Cluster
from heliotrope.cluster.memory import Kept
from heliotrope.cluster.timekeeping import SystemTime
from heliotrope.lcu import wire
from heliotrope.links.clock import VirtualClock
from heliotrope.links.connection import CarriedLink
from heliotrope.links.in_process import MemoryLine
from heliotrope.links.messages import (
    Alarm,
    Command,
    Emergency,
    Lease,
    Message,
    Parameters,
    Progress,
    Status,
    decode,
)
from heliotrope.sun import Site
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.bus import TwinBus
from heliotrope.twin.boards.clocks import DriftingClock, SimulatedTime
from heliotrope.twin.invariants.invariants import Observer
from heliotrope.twin.invariants.ledger import Order
from heliotrope.twin.invariants.plant_observer import PlantObserver
from heliotrope.twin.world.intruder import Intruder
from heliotrope.twin.world.tapped import TappedLink

#: A cluster counts a command's life from when it comes: so long it may have been under way, s.
UNDER_WAY = 0.8
#: Line, bus and cluster count as whole after so long without a fault, s.
SETTLED = 4.0


class Pod:
    """One cluster; it may crash and start again, with what was on its disk.

    Parameters
    ----------
    name
        Of the cluster.
    boards
        On its bus.
    observer
        Of this cluster.
    clock, start
        True time, and UTC at its beginning.
    site
        Of the plant.
    chance
        Draws clocks and seeds.

    Attributes
    ----------
    bus, line
        As they are now.
    clock, time
        The cluster's own; ``time`` is None where it goes by its system's clock.
    tap
        The plant's end of the line; None while no plant runs.
    plant
        Who observes the plant; set by the owner.
    counts
        Of what the plant was told.
    """

    def __init__(
        self,
        name: str,
        boards: list[Board],
        observer: Observer,
        clock: VirtualClock,
        start: datetime,
        site: Site,
        chance: random.Random,
    ) -> None:
        self.name, self.boards, self.observer = name, boards, observer
        self.intruder = Intruder(observer.frames, [b.outfit.address for b in boards])
        self._true, self._site, self._chance = clock, site, chance
        drift = chance.choice([0.0, 50e-6, -50e-6, 200e-6])
        self.clock = DriftingClock(clock.monotonic, start, drift)
        self.time = SimulatedTime(self.clock) if chance.random() < 0.5 else None
        self._kept = Kept(None)  # what a cluster has on its disk outlasts its crashes
        self.line = MemoryLine(clock, seed=chance.getrandbits(31))
        self.bus = self._new_bus()
        self.link: CarriedLink | None = None
        self.tap: TappedLink | None = None
        self.plant: PlantObserver | None = None
        self.counts: Counter[str] = Counter()
        self._running: list[asyncio.Task[None]] = []
        self._names_of = {b.outfit.address: b.outfit.name for b in boards}
        self._whole_since = clock.monotonic()

    def _new_bus(self) -> TwinBus:
        return TwinBus(self._true, list(self.boards), seed=self._chance.getrandbits(32), tap=self)

    # -- the program -----------------------------------------------------------------------

    @property
    def runs(self) -> bool:
        """Whether the cluster's program runs."""
        return bool(self._running)

    def start(self, group: asyncio.TaskGroup) -> None:
        """Start the program anew, with a bus and an end of the line: nothing of before is left."""
        self.bus = self._new_bus()
        seed = self._chance.getrandbits(31)
        link = self.link = self.line.end(1, "plant", self.clock, seed=seed)
        keeper = self.time or SystemTime(self.clock)
        fits = [board.outfit for board in self.boards]
        members = tuple(Member(o.name, o.address, o.serial, o.key) for o in fits)
        config = ClusterConfig(self.name, self._site, members)
        cluster = Cluster(config, self.bus, link, self.clock, keeper, self._kept)
        self._running = [group.create_task(link.run()), group.create_task(cluster.run())]

    def crash(self) -> None:
        """End the program at once, wherever it is; the network tells the plant."""
        for task in self._running:
            task.cancel()
        self._running = []
        self.link = None
        self.line.drop()

    # -- whether it is whole ---------------------------------------------------------------

    def look(self, now: float, *, hindered: bool) -> None:
        """Note whether an order of now would surely be carried out."""
        tap, link = self.tap, self.link
        whole = tap is not None and link is not None and tap.connected and link.connected
        if hindered or not whole:
            self._whole_since = now
            self.observer.disturbed(now)

    def carried(self, now: float) -> bool:
        """Whether an order of now must be carried out."""
        return now - self._whole_since > SETTLED

    # -- the bus (Tap) ---------------------------------------------------------------------

    def sent(self, frame: bytes, now: float) -> None:
        """Pass on what the cluster sends."""
        self.observer.sent(frame, now)

    def heard(self, place: int, data: bytes, how: str, now: float) -> None:
        """Pass on what a board is about to hear."""
        self.observer.heard(place, data, how, now)

    def answered(self, data: bytes, how: str, now: float) -> None:
        """Pass on what the cluster hears, and keep the states that it was told."""
        self.observer.answered(data, how, now)
        if self.plant is None:
            return
        for frame in wire.Reader().feed(data):
            name = self._names_of.get(frame.sender)
            values = frame.values()
            if name is not None and frame.name == "STATUS" and values:
                self.plant.heard(name, int(values[0]), now)


class PlantEar:
    """Listens at the plant's end of one line, and tells both observers.

    Parameters
    ----------
    pod
        Whose line.
    plant
        Who observes the plant.
    """

    def __init__(self, pod: Pod, plant: PlantObserver) -> None:
        self._pod, self._plant = pod, plant
        self._addresses = {b.outfit.name: b.outfit.address for b in pod.boards}
        self._names: tuple[str, ...] = ()

    def posted(self, data: bytes, now: float) -> None:
        """Judge what the plant hands to the link."""
        self._plant.posted(len(self._addresses), decode(data), now)

    def sent(self, data: bytes, now: float) -> None:
        """Note what has gone out to the cluster."""
        message, observer = decode(data), self._pod.observer
        if isinstance(message, Lease):
            observer.leased(now)
        elif isinstance(message, Emergency):
            whom = message.heliostats or tuple(self._addresses)
            observer.emergency(message.name, now, carried=self._pod.carried(now), heliostats=whom)
        elif isinstance(message, Command | Parameters):
            observer.ordered(self.order(message, now, known=self._plant.known(message.token)))

    def order(self, message: Command | Parameters, now: float, *, known: bool) -> Order:
        """Return a command for the books; ``known``: its token is one of an authority."""
        if isinstance(message, Command):
            name, whom = message.name, message.heliostats or tuple(self._addresses)
        else:
            name, whom = "PARAMETERS", (message.heliostat,)
        until = self._plant.until(message.token, now + message.lifetime + UNDER_WAY)
        addresses = frozenset(self._addresses[each] for each in whom)
        return Order(message.identity, name, addresses, now, until, known, message.token)

    def received(self, data: bytes, now: float) -> None:
        """Judge what the plant is told."""
        message: Message = decode(data)
        observer, counts = self._pod.observer, self._pod.counts
        if isinstance(message, Status):
            counts["status"] += 1
            self._names = message.names or self._names
            if len(self._names) == len(message.nodes()):
                observer.status(message, self._names, now)
        elif isinstance(message, Progress):
            counts[f"progress {message.stage.value}"] += 1
            observer.progress(message, now)
        elif isinstance(message, Alarm):
            counts["alarms"] += 1
