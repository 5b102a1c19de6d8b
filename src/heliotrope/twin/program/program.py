"""The program of a simulated field: its clock, its clusters, and what it serves."""

import asyncio
import time
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from heliotrope.field.plant import Plant
from heliotrope.links.clock import Clock, SystemClock, VirtualClock
from heliotrope.links.connection import CarriedLink
from heliotrope.links.link import LinkSettings
from heliotrope.links.tcp import tcp_link
from heliotrope.twin.live import PacedLoop, World, WorldOptions
from heliotrope.twin.program.cameras import TwinCameras
from heliotrope.twin.program.folder import FLUX, TwinFolder
from heliotrope.twin.program.server import TwinServer

#: Share of the speed at which time goes on until the plant leads all clusters.
_SLOW = 0.2
#: Wall time between checks whether the plant leads all clusters, s.
_CHECKED = 0.05
#: Clusters call a plant that begins beside them soon again.
_LINK = LinkSettings(longest_pause=0.2)
#: Time between values of the sensors, s.
_SENSED = 1.0


@dataclass(frozen=True)
class TwinOptions:
    """Options of a simulated field as a program.

    Attributes
    ----------
    start
        Its time at the beginning; None: it follows this machine's clock, as a real field does.
    speed
        Simulated seconds per second; only with ``start``.
    seed
        Of how the mirrors really stand, and of all noise.
    boards
        Whether each heliostat is a firmware-true board; for small plants.
    up
        Whether the heliostats track as soon as the plant leads them; else they begin at stow.
    """

    start: datetime | None = None
    speed: float = 1.0
    seed: int = 0
    boards: bool = False
    up: bool = False


class TwinProgram:
    """A simulated field whose clusters connect to a plant over TCP.

    Parameters
    ----------
    design
        The plant; see `twin.live.World`.
    files
        Its folder and addresses.
    options
        See `TwinOptions`.
    """

    def __init__(self, design: Plant, files: TwinFolder, options: TwinOptions) -> None:
        self._design, self._files, self._options = design, files, options
        self._begun = False

    def loop(self) -> asyncio.AbstractEventLoop:
        """Return a new event loop for it."""
        if self._options.start is None:
            return asyncio.SelectorEventLoop()
        return PacedLoop(self._options.speed)

    async def run(self, ending: asyncio.Event) -> None:
        """Run until ``ending`` is set."""
        loop = asyncio.get_running_loop()
        paced = loop if isinstance(loop, PacedLoop) else None
        start = self._options.start
        clock: Clock = SystemClock()
        if start is not None:
            clock = VirtualClock(loop.time, start)

        def link(name: str) -> CarriedLink:
            return tcp_link(*self._files.plant, name, self._files.keys[name], clock, _LINK)

        options = WorldOptions(
            self._options.seed,
            boards=self._options.boards,
            up=self._options.up,
            link=link,
        )
        world = World(self._design, clock, options)
        files, cameras = self._files, TwinCameras(world, loop, self._options.seed)
        server = TwinServer(
            files.serves,
            files.secret,
            lambda: self._clock(clock, paced),
            loop,
            cameras.photograph,
            lambda: world.errors().tobytes(),
        )
        server.start()
        cameras.start()
        try:
            async with world.running(), asyncio.TaskGroup() as group:
                sensing = group.create_task(self._sense(world))
                self._begun = True
                if paced is not None:
                    paced.speed = _SLOW * self._options.speed
                    await self._led(world, ending)
                    paced.speed = self._options.speed
                await ending.wait()
                sensing.cancel()
        finally:
            server.close()
            cameras.close()

    async def _led(self, world: World, ending: asyncio.Event) -> None:
        """Wait until the plant leads all clusters."""
        while not ending.is_set() and not all(cluster.leased for cluster in world.clusters):
            await _wall(_CHECKED)

    def _clock(self, clock: Clock, paced: PacedLoop | None) -> dict[str, Any]:
        """Return the state of the clock: monotonic s, UTC, speed, and whether the field is up."""
        now = clock.monotonic()
        return {
            "now": now,
            "utc": clock.utc().timestamp(),
            "speed": 1.0 if paced is None else paced.speed,
            "asked": self._options.speed,
            "begun": self._begun,
        }

    async def _sense(self, world: World) -> None:
        """Write the values of the sensors into their files."""
        if world.flux is None:
            return
        path = self._files.folder / FLUX
        while True:
            share = world.flux.share()
            await asyncio.to_thread(_replace, path, f"{share:.5f}\n")
            await asyncio.sleep(_SENSED)


async def _wall(seconds: float) -> None:
    """Wait for wall time; the loop's own may stand still."""
    await asyncio.to_thread(time.sleep, seconds)


def _replace(path: Path, text: str) -> None:
    new = path.with_suffix(".new")
    new.write_text(text, encoding="ascii")
    new.replace(path)
