"""The cameras of a simulated field, which deliver photographs on request like real cameras."""

import asyncio
import itertools

import numpy as np

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.synthetic.scenes import Scene
from heliotrope.twin.drawing import Drawer, Exposure, Optics
from heliotrope.twin.live import World

#: Longest wait for the event loop, s.
_PATIENCE = 10.0


class TwinCameras:
    """Photographs of a world's targets, rendered in a separate process.

    Parameters
    ----------
    world
        The world.
    loop
        Event loop of the world.
    seed
        Seed of the sensors' noise.
    drawer
        The rendering process, which takes some seconds to start.

    Raises
    ------
    InputError
        If a camera has no position.
    """

    def __init__(
        self, world: World, loop: asyncio.AbstractEventLoop, seed: int, drawer: Drawer
    ) -> None:
        self._world, self._loop = world, loop
        self._chance, self._numbers = np.random.default_rng(seed), itertools.count(1)
        self._drawer, self._scenes = drawer, dict[str, Scene]()
        surfaces = {target.name: target for target in (*world.design.targets, *world.faces)}
        visits = world.design.receiver_visits
        for camera in world.design.cameras:
            names = set(camera.targets or (target.name for target in world.design.targets))
            if visits is not None and visits.camera == camera.name:
                names.add(visits.receiver)
            seen = tuple(surface for name, surface in surfaces.items() if name in names)
            if seen and camera.position is None:
                raise InputError(
                    f"camera {camera.name} has no position; specify it in the plant file"
                )
            if seen:
                self._scenes[camera.name] = Scene(camera, seen)

    def wait(self) -> None:
        """Wait until the rendering process is ready; call this in a thread.

        The first start takes several seconds.
        """
        for name in list(self._scenes)[:1]:
            self.photograph(name)

    def photograph(self, name: str) -> Frame:
        """Take a photograph with a camera now and return it; call this in a thread.

        Raises
        ------
        FetchError
            If the rendering process has died.
        UnknownNameError
            If there is no such camera.
        """
        if name not in self._scenes:
            raise UnknownNameError("camera", name, list(self._scenes))
        exposing = asyncio.run_coroutine_threadsafe(self._expose(name), self._loop)
        return self._drawer.draw(exposing.result(_PATIENCE))

    async def _expose(self, name: str) -> Exposure:
        world, number = self._world, next(self._numbers)
        return Exposure(
            self._scenes[name],
            tuple(world.mirrors()),
            world.sun(),
            # Malan's small mirrors have a single facet.
            Optics(facets=(1, 1)),
            int(self._chance.integers(1 << 32)),
            f"{name} {number}",
            world.clock.utc(),
        )
