"""One cluster of a simulation: its program, its bus with boards, and its line to the plant."""

import asyncio
import random
import struct
from collections import Counter
from collections.abc import Mapping
from datetime import datetime

from heliotrope.cluster.config import ClusterConfig, Member
from heliotrope.cluster.controller import Cluster
from heliotrope.cluster.memory import Kept
from heliotrope.cluster.timekeeping import SystemTime
from heliotrope.lcu import wire
from heliotrope.lcu.journal import CODES_OF
from heliotrope.links.clock import VirtualClock, VirtualLoop, context_of
from heliotrope.links.connection import CarriedLink
from heliotrope.links.in_process import MemoryLine
from heliotrope.links.messages import (
    Acknowledge,
    ClusterStatus,
    Command,
    Emergency,
    Lease,
    Message,
    Parameters,
    Progress,
    decode,
)
from heliotrope.links.tapped import TappedLink
from heliotrope.safety import Alarm
from heliotrope.sun import Site
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.bus import TwinBus
from heliotrope.twin.boards.clocks import DriftingClock, SimulatedTime
from heliotrope.twin.invariants.answers import AnswerObserver
from heliotrope.twin.invariants.invariants import Judge, Observer
from heliotrope.twin.invariants.ledger import PlantCommand
from heliotrope.twin.invariants.lines import LineObserver
from heliotrope.twin.invariants.panel import Panel
from heliotrope.twin.invariants.plant_observer import PlantObserver
from heliotrope.twin.world.intruder import Intruder
from heliotrope.twin.world.worlds import PodErrors

#: Extra age allowed for a command, because a cluster counts its lifetime from arrival, s.
UNDER_WAY = 0.8
#: Line, bus and cluster count as healthy after this long without a fault, s.
SETTLED = 4.0


class Pod:
    """One cluster, which may crash and restart with the contents of its disk.

    Parameters
    ----------
    name
        Name of the cluster.
    boards
        Boards on the cluster's bus.
    observer
        Observer of this cluster.
    clock, start
        True time, and UTC at its beginning.
    site
        Site of the plant.
    chance
        Source of random clocks and seeds.
    errors
        Errors that the cluster has from the start.

    Attributes
    ----------
    bus, line
        The bus and line in use now.
    clock, time
        The cluster's own clock and time; ``time`` is None if it uses its system clock.
    addresses
        Address of each heliostat as known to the cluster; swapped if ``errors`` say so.
    tap, ear
        The plant's end of the line and its listener; None while no plant runs.
    plant
        Observer of the plant; set by the owner.
    answers
        Observer of what the boards and the cluster report about themselves.
    lines
        Observer of the line; None if a second plant occasionally takes the line over.
    counts
        Messages to the plant, by kind.
    freezes
        Whether the cluster program can be frozen.
    file
        Errors in the cluster's file: the name that a heliostat has in it, or "" for a missing
        one.
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
        errors: PodErrors,
    ) -> None:
        self.name, self.boards, self.observer = name, boards, observer
        self.freezes, self.file = errors.freezes, dict[str, str]()
        self.intruder = Intruder(observer.frames, [b.outfit.address for b in boards])
        self._true, self._site, self._chance = clock, errors.site(site), chance
        drift = chance.choice([0.0, 50e-6, -50e-6, 200e-6])
        self.clock = DriftingClock(clock.monotonic, errors.start(start), drift)
        self.time = SimulatedTime(self.clock) if chance.random() < 0.5 else None
        self._kept = Kept(None)  # the cluster's disk survives its crashes
        self.line = MemoryLine(clock, seed=chance.getrandbits(31))
        self.bus = self._new_bus()
        self.link: CarriedLink | None = None
        self.tap: TappedLink | None = None
        self.ear: PlantEar | None = None
        self.plant: PlantObserver | None = None
        self.counts: Counter[str] = Counter()
        self._running: list[asyncio.Task[None]] = []
        #: Address at which the cluster is configured to find each heliostat.
        own = [b.outfit.address for b in boards]
        names = [b.outfit.name for b in boards]
        self.addresses = dict(zip(names, errors.addresses(own), strict=True))
        self._names_of = {address: name for name, address in self.addresses.items()}
        observer.call(self._names_of)
        self.answers = AnswerObserver(name, observer.accounts, clock.monotonic())
        self.answers.utc = lambda: clock.utc().timestamp()
        self._whole_since = clock.monotonic()
        self.lines = None if errors.shared else LineObserver(name, clock.monotonic())

    def _new_bus(self) -> TwinBus:
        return TwinBus(self._true, list(self.boards), seed=self._chance.getrandbits(32), tap=self)

    # -- the program -----------------------------------------------------------------------

    @property
    def runs(self) -> bool:
        """Whether the cluster program is running."""
        return bool(self._running)

    def start(self, group: asyncio.TaskGroup) -> None:
        """Start the program with a new bus and a new end of the line, without any earlier state."""
        self.bus = self._new_bus()
        seed = self._chance.getrandbits(31)
        link = self.link = self.line.end(1, "plant", self.clock, seed=seed)
        heard = TappedLink(link, self._true, _ClusterEar(self.observer))
        keeper = self.time or SystemTime(self.clock)
        fits = [board.outfit for board in self.boards if self.file.get(board.outfit.name) != ""]
        members = tuple(
            Member(self.file.get(o.name, o.name), self.addresses[o.name], o.serial, o.key)
            for o in fits
        )
        config = ClusterConfig(self.name, self._site, members)
        cluster = Cluster(config, self.bus, heard, self.clock, keeper, self._kept)
        context = context_of(self.name) if self.freezes else None
        self._running = [
            group.create_task(part, context=context) for part in (link.run(), cluster.run())
        ]

    def crash(self) -> None:
        """Kill the program at whatever point it is; the network then notifies the plant."""
        for task in self._running:
            task.cancel()
        self._running = []
        self.observer.runs.forget()
        self.link = None
        self.line.drop()
        loop = asyncio.get_running_loop()
        if self.freezes and isinstance(loop, VirtualLoop):
            loop.kill(self.name)

    def edit(self, file: Mapping[str, str], group: asyncio.TaskGroup) -> None:
        """Restart the program with another file, if ``file`` differs from the present one."""
        if file == self.file:
            return
        self.file = dict(file)
        now = self._true.monotonic()
        self.observer.edited(file, now)
        if self.runs:
            self.crash()
            self.observer.disturbed(now, crashed=True)
            self.start(group)

    def freeze(self, *, on: bool) -> None:
        """Freeze the program or let it continue."""
        loop = asyncio.get_running_loop()
        if self.freezes and isinstance(loop, VirtualLoop):
            (loop.freeze if on else loop.thaw)(self.name)

    # -- health ----------------------------------------------------------------------------

    def look(self, now: float, *, hindered: bool) -> None:
        """Record whether an order issued now would certainly be carried out."""
        tap, link = self.tap, self.link
        whole = tap is not None and link is not None and tap.connected and link.connected
        if hindered or not whole:
            self._whole_since = now
            self.observer.disturbed(now)
        if self.lines is not None:
            both = tap is not None and link is not None
            self.lines.look(now, clear=both and not hindered, connected=whole)

    @property
    def judges(self) -> tuple[Judge, ...]:
        """The observers of the cluster and of its line."""
        both = self.observer, self.answers
        return both if self.lines is None else (*both, self.lines)

    def carried(self, now: float) -> bool:
        """Whether an order issued now must be carried out."""
        return now - self._whole_since > SETTLED

    # -- the bus (Tap) ---------------------------------------------------------------------

    def sent(self, frame: bytes, now: float) -> None:
        """Pass on a frame that the cluster sends."""
        self.observer.sent(frame, now)

    def heard(self, place: int, data: bytes, how: str, now: float) -> None:
        """Pass on bytes that a board is about to receive."""
        self.observer.heard(place, data, how, now)
        self.answers.heard(how, now)

    def answered(self, data: bytes, how: str, now: float) -> None:
        """Pass on a reply to the cluster, and store reported states with the true step counts."""
        self.observer.answered(data, how, now)
        self.answers.answered(data, how, now)
        if self.plant is None:
            return
        for frame in wire.Reader().feed(data):
            name = self._names_of.get(frame.sender)
            values = frame.values()
            if name is not None and frame.name == "STATUS" and values:
                self.plant.heard(name, int(values[0]), now)
            if name is not None and frame.name == "STEPS":
                board = next(board for board in self.boards if board.outfit.name == name)
                azimuth, elevation = (
                    a.emitted - s for a, s in zip(board.axes, board.slip, strict=True)
                )
                self.plant.counted(name, (azimuth, elevation), now)


class _ClusterEar:
    """Listens at a cluster's end of its line for the leases that actually arrive."""

    def __init__(self, observer: Observer) -> None:
        self._observer = observer

    async def posted(self, data: bytes, now: float) -> None:
        """Let the cluster send."""

    def sent(self, data: bytes, now: float) -> None:
        """Let the cluster send."""

    async def waits(self) -> None:
        """Let the cluster receive."""

    def received(self, data: bytes, now: float) -> None:
        """Record a lease."""
        message = decode(data)
        if isinstance(message, Lease):
            self._observer.runs.leased(message.run, message.lifetime, now)


class PlantEar:
    """Listens at the plant's end of a line, reports to the observers, and can freeze the plant.

    Parameters
    ----------
    pod
        The cluster at the other end of the line.
    panel
        Observers of the plant.
    """

    def __init__(self, pod: Pod, panel: Panel) -> None:
        self._pod, self._plant = pod, panel.plant
        self._panel, self._judges = panel.each, (*pod.judges, *panel.each)
        self._addresses = pod.addresses
        self._names: tuple[str, ...] = ()
        self._goes = asyncio.Event()
        self._goes.set()
        self._ended = False

    def end(self) -> None:
        """Stop judging, because the last messages of a killed program never leave it."""
        self._ended = True

    def hang(self, *, on: bool) -> None:
        """Freeze the plant's program, or let it continue, while the connection stays up."""
        if on:
            self._goes.clear()
        else:
            self._goes.set()

    async def posted(self, data: bytes, now: float) -> None:
        """Judge a message that the plant hands to the link; hold it while the plant is frozen."""
        if self._ended:
            return
        self._plant.posted(tuple(self._addresses), decode(data), now)
        await self._goes.wait()

    async def waits(self) -> None:
        """Let the plant receive, unless it is frozen."""
        await self._goes.wait()

    def sent(self, data: bytes, now: float) -> None:
        """Record a message that has left for the cluster."""
        message, observer = decode(data), self._pod.observer
        if isinstance(message, Lease):
            for each in self._judges:
                each.on_lease(message.token, now)
        elif isinstance(message, Emergency):
            whom = message.heliostats or tuple(self._addresses)
            addressed = tuple(name for name in whom if name not in self._pod.file)
            carried = self._pod.carried(now)
            if addressed:
                observer.emergency(message.name, now, carried=carried, heliostats=addressed)
            for each in self._panel:
                each.on_emergency(message.name, whom, now)
        elif isinstance(message, Acknowledge) and message.condition == "clock_jump":
            observer.time_acknowledged()
        elif isinstance(message, Command | Parameters):
            observer.ordered(self.order(message, now, known=self._plant.known(message.token)))
            what, whom = self._asked(message)
            for name in whom if what in ("PARAMETERS", "ZERO") else ():
                for each in self._panel:
                    each.on_write(name, what, now)
            if isinstance(message, Parameters) and (stow := message.items().get("stow")):
                azimuth, elevation = struct.unpack(CODES_OF["stow"], stow)
                observer.given_stow(message.heliostat, (azimuth, elevation))
            if isinstance(message, Command):
                for each in self._panel:
                    each.on_command(message, whom, now)

    def _asked(self, message: Command | Parameters) -> tuple[str, tuple[str, ...]]:
        """Return the name of an order, and the heliostats that it concerns."""
        if isinstance(message, Command):
            return message.name, message.heliostats or tuple(self._addresses)
        return "PARAMETERS", (message.heliostat,)

    def order(self, message: Command | Parameters, now: float, *, known: bool) -> PlantCommand:
        """Return an order for the ledger.

        ``known`` means that its token has been issued before.
        """
        name, whom = self._asked(message)
        until = self._plant.until(message.token, now + message.lifetime + UNDER_WAY)
        addresses = frozenset(self._addresses[heliostat] for heliostat in whom)
        return PlantCommand(message.identity, name, addresses, now, until, known, message.token)

    def received(self, data: bytes, now: float) -> None:
        """Judge a message to the plant."""
        message: Message = decode(data)
        counts = self._pod.counts
        if isinstance(message, ClusterStatus):
            counts["status"] += 1
            for each in self._panel:
                each.on_heard(self._pod.name, now)
            self._names = message.names or self._names
            if len(self._names) == len(message.nodes()):
                for each in self._judges:
                    each.on_status(message, self._names, now)
        elif isinstance(message, Progress):
            counts[f"progress {message.stage.value}"] += 1
            for each in self._judges:
                each.on_progress(message, now)
        elif isinstance(message, Alarm):
            counts["alarms"] += 1
