"""The program of a simulated field: its clock, its clusters, and its server."""

import asyncio
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from heliotrope.cluster.controller import Cluster
from heliotrope.errors import FetchError
from heliotrope.field.plant import Plant
from heliotrope.imaging.frame import Frame
from heliotrope.links.clock import Clock, SystemClock, VirtualClock
from heliotrope.links.connection import CarriedLink
from heliotrope.links.link import LinkSettings, first_of, running
from heliotrope.links.tcp import tcp_link
from heliotrope.safety import FLUX_READING
from heliotrope.twin import warm
from heliotrope.twin.drawing import Drawer
from heliotrope.twin.live import PacedLoop, World, WorldOptions
from heliotrope.twin.program.boards import BOARDS, read_boards
from heliotrope.twin.program.cameras import TwinCameras
from heliotrope.twin.program.folder import TwinFolder, sensor_file
from heliotrope.twin.program.server import TwinServer
from heliotrope.twin.weather import WeatherStation

#: Share of the chosen speed at which time advances until all clusters are connected.
_FIRST = 0.02
#: If the plant's lease is this long, the plant leads the cluster, s.
_LED = 1.5
#: Time is held this long before the end of a lease, s, so that the plant, which renews the lease
#: each second, takes no cluster status for old; and this long before a connection counts as lost,
#: s.
_HELD, _HEARD = 1.4, 0.4
#: Wall time for which it is held while the plant hangs, s: ten times the longest computation of a
#: plant of 10,000 heliostats, because the computer may have other work.
_HANGS = 60.0
#: Time within which clusters send their first orders, and within which the plant receives word that
#: the field is tracking, s.
_BEGUN, _REPORTED = 0.5, 1.2
#: Least and greatest wall time between checks of the leases, s; each looks at all clusters.
_CHECKED, _RARELY = 0.02, 0.2
#: Clusters soon retry the connection to a plant that starts beside them.
_LINK = LinkSettings(longest_pause=0.2)
#: Time between values of the sensors, s.
_SENSED = 1.0


@dataclass(frozen=True)
class TwinOptions:
    """Options of a simulated field that runs as a program.

    Attributes
    ----------
    start
        Simulated time at the start; None if the field follows the computer's clock, as a real field
        does.
    speed
        Simulated seconds per second of real time; only with ``start``.
    seed
        Seed of the true installation errors and of all noise.
    boards
        Whether each heliostat is a board with the real firmware; for small plants.
    pty
        Whether the bus of boards is a pseudo-terminal.
    up
        Whether the heliostats track as soon as the plant controls them; otherwise they begin at
        stow.
    waits
        Whether the program waits for the file of its local controllers' parameters (`write_boards`)
        and for the plant to start.
    """

    start: datetime | None = None
    speed: float = 1.0
    seed: int = 0
    boards: bool = False
    pty: bool = False
    up: bool = False
    waits: bool = False


@dataclass(frozen=True)
class _Parts:
    """Objects that are created once the local controllers are known."""

    world: World
    cameras: TwinCameras


class TwinProgram:
    """A simulated field whose clusters connect to a plant over TCP.

    Parameters
    ----------
    design
        The plant; see `twin.live.World`.
    files
        Folder and addresses of the simulated field.
    options
        See `TwinOptions`.
    """

    def __init__(self, design: Plant, files: TwinFolder, options: TwinOptions) -> None:
        self._design, self._files, self._options = design, files, options
        self._waits = self._begun = False
        self._parts: _Parts | None = None

    def loop(self) -> asyncio.AbstractEventLoop:
        """Return a new event loop for the program; its time stands still until the field starts."""
        if self._options.start is None:
            return asyncio.SelectorEventLoop()
        loop = PacedLoop(self._options.speed)
        loop.speed = 0.0
        return loop

    async def run(self, ending: asyncio.Event) -> None:
        """Run until the event ``ending`` is set."""
        loop = asyncio.get_running_loop()
        paced = loop if isinstance(loop, PacedLoop) else None
        start = self._options.start
        clock: Clock = SystemClock()
        if start is not None:
            clock = VirtualClock(loop.time, start)

        def link(name: str) -> CarriedLink:
            return tcp_link(*self._files.plant, name, self._files.keys[name], clock, _LINK)

        files, go, drawer = self._files, _Go(), Drawer(warm.drawing)
        server = TwinServer(
            files.serves,
            files.secret,
            lambda: self._clock(clock, paced),
            loop,
            self._photograph,
            lambda: self._built().world.errors().tobytes(),
            go.begin,
        )
        server.start()
        if self._design.cameras:
            drawer.start()
        try:
            design = await self._stored(ending)
            if ending.is_set():
                return
            options = WorldOptions(
                self._options.seed, boards=self._options.boards, pty=self._options.pty, link=link
            )
            world = World(design, clock, options)
            cameras = TwinCameras(world, loop, self._options.seed, drawer)
            self._parts = _Parts(world, cameras)
            sensors = _Sensors(world, self._options.seed)
            # The plant reads these files as soon as it starts.
            _write(self._files.folder, sensors.readings())
            self._waits = True
            if paced is not None:
                await first_of(go.event.wait(), ending.wait())
                paced.speed = _FIRST * self._options.speed
            async with (
                world.running(),
                running(*world.far),
                asyncio.TaskGroup() as group,
            ):
                tasks = [
                    group.create_task(self._sense(sensors)),
                    group.create_task(self._lead(world, cameras, paced)),
                ]
                if paced is not None:
                    tasks.append(group.create_task(_hold(world, paced)))
                await ending.wait()
                for task in tasks:
                    task.cancel()
        finally:
            server.close()
            drawer.close()

    async def _stored(self, ending: asyncio.Event) -> Plant:
        """Return the plant with the parameters that its local controllers store."""
        path = self._files.folder / BOARDS
        if not self._options.waits:
            return self._design
        while not (ending.is_set() or path.exists()):
            await asyncio.to_thread(time.sleep, _CHECKED)
        return self._design if ending.is_set() else read_boards(path, self._design)

    def _photograph(self, camera: str) -> Frame:
        return self._built().cameras.photograph(camera)

    def _built(self) -> "_Parts":
        if self._parts is None:
            raise FetchError("the simulated field has not started")
        return self._parts

    async def _lead(self, world: World, cameras: TwinCameras, loop: PacedLoop | None) -> None:
        """Start the field once the plant has the lead of the clusters."""
        # Connecting and the first rendering take wall time; the plant's taking the lead takes
        # simulated time.
        await asyncio.to_thread(cameras.wait)
        while not all(cluster.connected for cluster in world.clusters):
            await _wall(_CHECKED)
        if loop is not None:
            loop.speed = self._options.speed
        while min(cluster.lease_left for cluster in world.clusters) < _LED:
            await _wall(_CHECKED)
        await asyncio.sleep(_BEGUN)
        if self._options.up:
            world.put_up()
        await asyncio.sleep(_REPORTED)
        self._begun = True

    def _clock(self, clock: Clock, paced: PacedLoop | None) -> dict[str, Any]:
        """Return the clock's state: monotonic time (s), UTC, speed, and whether the field is up."""
        now = clock.monotonic()
        return {
            "now": now,
            "utc": clock.utc().timestamp(),
            "speed": 1.0 if paced is None else paced.speed,
            "asked": self._options.speed,
            "waits": self._waits,
            "begun": self._begun,
        }

    async def _sense(self, sensors: "_Sensors") -> None:
        """Write the sensor values to their files."""
        while True:
            await asyncio.to_thread(_write, self._files.folder, sensors.readings())
            await asyncio.sleep(_SENSED)


async def _hold(world: World, loop: PacedLoop) -> None:
    """Repeatedly hold the loop's time before a plant lease or a connection ends.

    If the computer is too slow, everything takes longer, but no lease or connection is lost by
    being late. A plant that is connected to no cluster counts as ended, and a plant that has sent
    nothing for a long time counts as hung.
    """
    said = time.monotonic()
    while True:
        ends = min(map(_ends, world.clusters, world.far), default=math.inf)
        if ends > 0.0:
            said = time.monotonic()
        hangs = time.monotonic() - said > _HANGS
        loop.until = math.inf if hangs else loop.time() + max(0.0, ends)
        # Most of what is left may pass unchecked, because the loop stops at `until` by itself.
        await _wall(min(max(_CHECKED, 0.25 * ends / max(1.0, loop.speed)), _RARELY))


def _ends(cluster: Cluster, link: CarriedLink) -> float:
    """Return for how long time may run before a cluster must have heard from its plant, s."""
    if not link.connected:
        return math.inf
    lease = cluster.lease_left
    return min(link.lasts - _HEARD, lease - _HELD if lease > 0.0 else math.inf)


class _Sensors:
    """All sensors of a world."""

    def __init__(self, world: World, seed: int) -> None:
        self._flux = world.flux
        self._weather = WeatherStation(world.design.site.height, world.clock, world.sun, seed)

    def readings(self) -> dict[str, float]:
        """Return the present readings."""
        flux = {} if self._flux is None else {FLUX_READING: self._flux.share()}
        return self._weather.readings() | flux


class _Go:
    """The plant's permission for the field to start."""

    def __init__(self) -> None:
        self.event = asyncio.Event()

    def begin(self) -> bytes:
        self.event.set()
        return b""


async def _wall(seconds: float) -> None:
    """Wait for a wall-clock duration, because the loop's own time may be slowed down."""
    await asyncio.to_thread(time.sleep, seconds)


def _write(folder: Path, values: Mapping[str, float]) -> None:
    for name, value in values.items():
        path = folder / sensor_file(name)
        new = path.with_suffix(".new")
        new.write_text(f"{value:.5f}\n", encoding="ascii")
        new.replace(path)
