"""Cameras of a live plant: photographs drawn and read beside the event loop, and shown to people.

A photograph takes a second of a processor, so it is drawn, read and annotated in a thread; where
time is virtual it is done at once, since there a thread would have no time at all.
"""

import asyncio
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.photograph import Photograph, read_photograph
from heliotrope.imaging.synthetic.rendering import render
from heliotrope.imaging.synthetic.scenes import Scene, Thrown, exposed
from heliotrope.plant.camera_views import Views, picture_of, shot_of
from heliotrope.plant.operations.views import CameraView
from heliotrope.plant.visits.photographs import Shot
from heliotrope.twin.cameras import PEAK, ExactCamera, Mirror, Optics, RenderedCamera, Sight


class LiveCamera(RenderedCamera):
    """Photographs of a live plant.

    Parameters
    ----------
    sight, scenes, optics, seed
        As of `RenderedCamera`.
    threads
        How many photographs are worked on at a time; 0: in the event loop itself.
    """

    def __init__(
        self,
        sight: Sight,
        scenes: Sequence[Scene],
        *,
        optics: Optics | None = None,
        seed: int = 0,
        threads: int = 1,
    ) -> None:
        super().__init__(sight, scenes, optics=optics, seed=seed)
        self._pool = ThreadPoolExecutor(threads, "camera") if threads else None
        self._views = Views()
        self._known: dict[str, tuple[Any, ...]] = {}

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)

    def view(self, target: str) -> CameraView:
        """Return the last photograph of a target for people."""
        return self._views.view(target)

    async def take_empty(self, target: Target) -> None:
        """Photograph a target before a beam comes; see `RenderedCamera.take_empty`."""
        seen, frame, _ = await self._look(target)
        reading = seen.reading(target.name)
        if reading.spots:
            raise InputError(f"target {target.name}: a beam is on it; its empty frame comes later")
        if not reading.found.found:
            raise InputError(f"target {target.name}: {reading.found.reason}; look at the camera")
        self._empty[target.name] = frame

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        """Return the beam that is seen on a target; see `RenderedCamera.photograph`."""
        del heliostat
        seen, _, at = await self._look(target)
        return shot_of(seen, target.name, at)

    async def _look(self, target: Target) -> tuple[Photograph, Frame, float]:
        name = target.name
        if name not in self._scenes:
            raise UnknownNameError("target", name, list(self._scenes))
        at = await self._sight.exposure()
        scene = self._scenes[name]
        utc, seed = self._sight.clock.utc(), int(self._chance.integers(1 << 32))
        thrown = self._sight.mirrors(), self._sight.sun()
        self.taken += 1
        number = self.taken

        def work() -> tuple[Photograph, Frame, bytes]:
            beams = self._thrown(scene.targets[0], *thrown)
            lit = exposed(replace(scene, beams=beams), PEAK)
            frame = render(lit, seed, name=f"{scene.camera.name} {number}", time=utc).frame
            seen = read_photograph(
                frame,
                scene.targets,
                scene.camera,
                settings=self._settings,
                previous=self._known.get(name, ()),
                without=self._empty.get(name),
            )
            return seen, frame, picture_of(seen)

        if self._pool is None:
            seen, frame, jpeg = work()
        else:
            seen, frame, jpeg = await asyncio.get_running_loop().run_in_executor(self._pool, work)
        self._views.keep(name, utc.timestamp(), seen, jpeg)
        return seen, frame, at

    def _thrown(
        self, target: Target, mirrors: Sequence[Mirror], sun: FloatArray
    ) -> tuple[Thrown, ...]:
        """Return what some mirrors throw on a target, as `RenderedCamera.beams` does."""
        still = replace(self._sight, mirrors=lambda: mirrors, sun=lambda: sun)
        return RenderedCamera(still, (), optics=self._optics).beams(target)


class SeenExactly(ExactCamera):
    """An `ExactCamera` that says what it saw, without a picture: for quick simulations."""

    def __init__(self, *values: Any, **named: Any) -> None:
        super().__init__(*values, **named)
        self._views: dict[str, CameraView] = {}

    def view(self, target: str) -> CameraView:
        """Return what was seen last of a target; there is no picture."""
        return self._views.get(target, CameraView(target, 0, 0.0, b""))

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        """See `ExactCamera.photograph`."""
        shot = await super().photograph(target, heliostat)
        x, y = target.plane_coordinates(shot.point)
        self._views[target.name] = CameraView(
            target.name,
            self.view(target.name).version + 1,
            self._sight.clock.utc().timestamp(),
            b"",
            (heliostat, *shot.reasons),
            (float(x), float(y)),
        )
        return shot

    def close(self) -> None:
        """Nothing is to be ended."""
