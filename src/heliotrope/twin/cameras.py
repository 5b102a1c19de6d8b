"""Cameras of a simulated plant, which see the beams on the targets.

Both classes implement the port `plant.ports.Cameras`. `ExactCamera` returns the true centroid with
noise of known covariance. `RenderedCamera` renders a frame with all light that is on the target at
that time, whichever heliostats the light comes from, and evaluates the frame like a photograph of a
real plant. Neither camera knows more about the measured heliostat than a real camera could.
"""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.errors import FetchError, InputError, UnknownNameError
from heliotrope.field.camera import Camera
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.photograph import Photograph, PhotographSettings
from heliotrope.imaging.synthetic.scenes import Scene, Thrown
from heliotrope.imaging.targets.view import FaceView
from heliotrope.links.clock import Clock, sleep_until
from heliotrope.plant.io.camera_views import SEVERAL, Views, beam_of, light_of, picture_of, shot_of
from heliotrope.plant.operations.views import CameraView
from heliotrope.plant.visits.coded_layout import moments_on
from heliotrope.plant.visits.photographs import Shot
from heliotrope.plant.visits.target_light import Exposed, TargetLight
from heliotrope.plant.workers import Worker, at_once
from heliotrope.safety import Alarm
from heliotrope.twin.drawing import Drawer, Exposure, Optics, thrown
from heliotrope.twin.true_mirrors import NEAR, TrueMirror, within

#: Share of a mirror's size in its exact beam.
_FLAT = 0.7
#: Pictures of exact beams: pixels across, brightness of the paint and of one sun, and the noise.
_ACROSS, _PAINT, _SUN, _GRAIN = 96, 0.05, 0.1, 0.0005


@dataclass(frozen=True)
class FieldSnapshot:
    """The true mirrors and the sun at the moment when they are requested.

    Attributes
    ----------
    clock
        Clock of the plant.
    mirrors
        Returns all mirrors whose light may be on a target.
    sun
        Returns the unit vector to the sun, (3,).
    latency
        Time from the request for a photograph to the middle of its exposure, s.
    """

    clock: Clock
    mirrors: Callable[[], Sequence[TrueMirror]]
    sun: Callable[[], FloatArray]
    latency: float = 1.0

    async def exposure(self) -> float:
        """Wait for the middle of an exposure and return its time, monotonic s."""
        await sleep_until(self.clock, self.clock.monotonic() + self.latency)
        return self.clock.monotonic()


class ExactCamera:
    """Returns true beam centroids with noise, without photographs.

    Parameters
    ----------
    sight
        The true mirrors and the sun.
    covariance
        Covariance of a centroid in the plane of the target: a variance or (2, 2), m².
    seed
        Seed of the noise.

    Raises
    ------
    InputError
        If the covariance has another shape, or is not a valid covariance.
    """

    def __init__(
        self, sight: FieldSnapshot, covariance: npt.ArrayLike = 1e-4, seed: int = 0
    ) -> None:
        array = np.asarray(covariance, dtype=np.float64)
        plane = array * np.eye(2) if array.ndim == 0 else array
        if plane.shape != (2, 2) or not np.isfinite(plane).all():
            raise InputError(
                f"exact camera: covariance has shape {array.shape}; pass a variance or a (2, 2) "
                "matrix, m²"
            )
        values, vectors = np.linalg.eigh(plane)
        if not np.allclose(plane, plane.T, rtol=1e-9, atol=0.0) or values.min() < 0.0:
            raise InputError(
                "exact camera: a covariance must be symmetric and positive semidefinite"
            )
        self._sight = sight
        self._plane = plane
        # Matrix square root, because a covariance of 0 has no Cholesky factor.
        self._root = vectors * np.sqrt(values)
        self._chance = np.random.default_rng(seed)
        self._views: dict[str, CameraView] = {}

    def start(self, on_alarm: Callable[[Alarm], None]) -> None:
        """Do nothing: this camera never fails."""

    def close(self) -> None:
        """Do nothing: this camera has no process to end."""

    def sees(self, target: str) -> bool:
        """Return True: this camera covers every target."""
        del target
        return True

    def awake(self, target: str) -> bool:
        """Return True: this camera never stops responding."""
        return self.sees(target)

    async def look(self, target: str) -> None:
        """Do nothing: exact centroids need no photograph of the empty target."""

    def view(self, target: str) -> CameraView:
        """Return the last picture of a target."""
        return self._views.get(target, CameraView(target, 0, 0.0, b""))

    def eye(self, target: str) -> Camera:
        """Raise `UnknownNameError`: exact centroids need no camera."""
        raise UnknownNameError("target with a camera that takes pictures", target, ())

    def frame(self, target: str) -> Frame:
        """Raise `UnknownNameError`: there are no pictures."""
        raise UnknownNameError("target with a camera that takes pictures", target, ())

    def take_view(self, camera: Camera, target: Target, pictures: Mapping[str, FloatArray]) -> None:
        """Do nothing: there are no pictures."""

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        """Return the position of a heliostat's beam on a target; NaN if the beam is far away."""
        at = await self._sight.exposure()
        mirrors = {mirror.heliostat: mirror for mirror in self._sight.mirrors()}
        sun = self._sight.sun()
        places = {name: mirror.lit_centroid(target, sun)[0] for name, mirror in mirrors.items()}
        true = places.get(heliostat, np.full(3, np.nan))
        point = true + (self._root @ self._chance.standard_normal(2)) @ target.axes
        reasons = []
        if not within(target, true):
            reasons.append("no beam on the target")
        others = [n for n, p in places.items() if n != heliostat and within(target, p)]
        if others:
            reasons.append(f"several beams: {', '.join(others)} too")
        self._keep(target, point, (heliostat, *reasons))
        return Shot(point, at, target.axes.T @ self._plane @ target.axes, tuple(reasons))

    async def expose(self, target: Target, view: FaceView | None = None) -> Exposed:
        """Photograph a target and measure the light on it; see `light`."""
        light = await self.light(target, view)
        return Exposed.read(light)

    async def light(self, target: Target, view: FaceView | None = None) -> TargetLight:
        """Return the light on a target: a Gaussian at each beam's true position, with noise."""
        del view
        at, sun = await self._sight.exposure(), self._sight.sun()
        corners = target.plane_coordinates(target.corners)
        low, high = corners.min(axis=0), corners.max(axis=0)
        step = float((high - low).min()) / _ACROSS
        x = np.arange(low[0] + 0.5 * step, high[0], step)
        y = np.arange(high[1] - 0.5 * step, low[1], -step)
        values = _PAINT + _GRAIN * self._chance.standard_normal((len(y), len(x)))
        points = np.stack(np.meshgrid(x, y), axis=-1)
        for mirror in self._sight.mirrors():
            place, share = mirror.lit_centroid(target, sun)
            if not within(target, place, NEAR):
                continue
            size = mirror.width, mirror.height
            shape = moments_on(target, mirror.vertex, mirror.normal, *size, flat=_FLAT)
            power = share * mirror.width * mirror.height * float(mirror.normal @ sun)
            away = points - target.plane_coordinates(place)
            form = np.einsum("hwi,ij,hwj->hw", away, np.linalg.inv(shape), away)
            peak = _SUN * power / (2.0 * np.pi * np.sqrt(np.linalg.det(shape)))
            values += peak * np.exp(-0.5 * form)
        self._keep(target, np.full(3, np.nan), (SEVERAL,))
        mask = np.ones(values.shape, dtype=np.bool_)
        first = np.array([x[0], y[0]])
        return TargetLight(values.astype(np.float32), step, first, mask, 1.0, at)

    def _keep(self, target: Target, point: FloatArray, lines: tuple[str, ...]) -> None:
        centroid = None
        if np.isfinite(point).all():
            x, y = target.plane_coordinates(point)
            centroid = float(x), float(y)
        version = self.view(target.name).version + 1
        at = self._sight.clock.utc().timestamp()
        self._views[target.name] = CameraView(target.name, version, at, b"", lines, centroid)


class RenderedCamera:
    """Renders photographs and evaluates them.

    A photograph takes a second of CPU time. With a ``worker``, it is rendered in a separate process
    and evaluated by the worker, outside the event loop. Without one, both happen at once in the
    loop, as virtual time requires.

    Parameters
    ----------
    sight
        The true mirrors and the sun.
    scenes
        One scene per target: camera, target with its marks, lighting, paint and sensor, but no
        beams.
    optics
        Mirrors and light.
    settings
        Settings for evaluating photographs.
    seed
        Seed of the sensor's noise.
    worker
        Evaluates photographs; None if they are rendered and evaluated in the event loop itself.

    Attributes
    ----------
    taken
        Number of photographs so far, including empty ones.
    last
        The last frame; None before the first frame.

    Raises
    ------
    InputError
        If a scene has beams, or more than one target.
    """

    def __init__(
        self,
        sight: FieldSnapshot,
        scenes: Sequence[Scene],
        *,
        optics: Optics | None = None,
        settings: PhotographSettings | None = None,
        seed: int = 0,
        worker: Worker | None = None,
    ) -> None:
        for scene in scenes:
            names = ", ".join(target.name for target in scene.targets)
            if len(scene.targets) > 1 or scene.beams:
                raise InputError(
                    f"rendered camera: the scene of {names} has {len(scene.targets)} targets and "
                    f"{len(scene.beams)} beams; use one target and no beam, because mirrors add "
                    "beams"
                )
        self._sight, self._scenes = sight, {s.targets[0].name: s for s in scenes}
        self._optics, self._settings = optics or Optics(), settings or PhotographSettings()
        self._chance = np.random.default_rng(seed)
        self._worker, self._drawer = worker or at_once, None if worker is None else Drawer()
        self._views, self._empty = Views(), dict[str, Frame]()
        #: Frames, and cameras and targets as the plant knows them; the scenes hold the true ones.
        self._frames = dict[str, Frame]()
        self._known = {name: (s.camera, s.targets[0]) for name, s in self._scenes.items()}
        self.taken = 0
        self.last: Frame | None = None

    def start(self, on_alarm: Callable[[Alarm], None]) -> None:
        """Start the rendering process."""
        del on_alarm
        if self._drawer is not None:
            self._drawer.start()

    def close(self) -> None:
        """End the rendering process."""
        if self._drawer is not None:
            self._drawer.close()

    def sees(self, target: str) -> bool:
        """Return whether there is a scene for the target."""
        return target in self._scenes

    def awake(self, target: str) -> bool:
        """Return whether there is a scene for the target; a simulated camera always responds."""
        return self.sees(target)

    def view(self, target: str) -> CameraView:
        """Return the last photograph of a target, for display."""
        return self._views.view(target)

    def eye(self, target: str) -> Camera:
        """Return the camera of a target, as the plant knows it; see `plant.ports.Cameras`."""
        if target not in self._known:
            raise UnknownNameError("target with a camera", target, list(self._known))
        return self._known[target][0]

    def frame(self, target: str) -> Frame:
        """Return the last frame of a target; see `plant.ports.Cameras`."""
        camera = self.eye(target)
        if target not in self._frames:
            raise FetchError(f"camera {camera.name}: no photograph of {target} yet; take one")
        return self._frames[target]

    def take_view(self, camera: Camera, target: Target, pictures: Mapping[str, FloatArray]) -> None:
        """Set the camera and target marks used to evaluate later photographs.

        The scene keeps the true camera and marks.
        """
        self._known = {
            name: (camera if known.name == camera.name else known, surface)
            for name, (known, surface) in self._known.items()
        }
        self._known[target.name] = camera, target
        known = {**self._settings.pictures, **pictures}
        self._settings = replace(self._settings, pictures=known)

    async def look(self, target: str) -> None:
        """Photograph the empty target, as the background for later photographs.

        Raises
        ------
        InputError
            If a beam is on the target, or the target is not found in the photograph.
        UnknownNameError
            If there is no scene for the target.
        """
        picture, _ = await self._take(target)
        reading = picture.reading(target)
        if reading.spots:
            place = reading.spots[0].plane
            raise InputError(
                f"target {target}: a beam is on it, {place[0]:.2f} m right of and "
                f"{place[1]:.2f} m above its middle; take the empty frame before a beam arrives"
            )
        if not reading.found.found:
            raise InputError(f"target {target}: {reading.found.reason}; check the camera")
        self._empty[target] = picture.frame

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        """Return the beam seen on a target; the camera cannot tell which heliostat sends it.

        Raises
        ------
        UnknownNameError
            If there is no scene for the target.
        """
        del heliostat
        picture, at = await self._take(target.name)
        return shot_of(picture, target.name, at)

    async def expose(self, target: Target, view: FaceView | None = None) -> Exposed:
        """Photograph a target; see `plant.visits.target_light.LightCamera`.

        Raises
        ------
        UnknownNameError
            If there is no scene for the target.
        """
        name = target.name
        camera, known = self._known_of(name)
        shown, at = await self._expose(name)
        settings = self._settings

        async def read() -> TargetLight:
            frame = await self._drawn(shown)
            jpeg = await self._worker(picture_of, Photograph(frame, ()))
            self._views.show(name, shown.time.timestamp(), jpeg, SEVERAL)
            self.last = self._frames[name] = frame
            return await self._worker(light_of, frame, known, (known,), camera, settings, view, at)

        return Exposed(at, asyncio.create_task(read()))

    def beams(self, target: Target) -> tuple[Thrown, ...]:
        """Return the beams that are on a target now, or so close that a frame would show them."""
        return thrown(target, self._sight.mirrors(), self._sight.sun(), self._optics)

    def _known_of(self, name: str) -> tuple[Camera, Target]:
        if name not in self._scenes:
            raise UnknownNameError("target", name, list(self._scenes))
        return self._known[name]

    async def _expose(self, name: str) -> tuple[Exposure, float]:
        """Expose a frame; return the light and the time of the exposure, monotonic s."""
        at = await self._sight.exposure()
        scene = self._scenes[name]
        self.taken += 1
        shown = Exposure(
            scene,
            tuple(self._sight.mirrors()),
            self._sight.sun(),
            self._optics,
            int(self._chance.integers(1 << 32)),
            f"{scene.camera.name} {self.taken}",
            self._sight.clock.utc(),
        )
        return shown, at

    async def _drawn(self, shown: Exposure) -> Frame:
        """Return the rendered frame of an exposure."""
        if self._drawer is None:
            return shown.draw()
        return await asyncio.to_thread(self._drawer.draw, shown)

    async def _take(self, name: str) -> tuple[Photograph, float]:
        """Take a photograph; return its evaluation and the time of the exposure, monotonic s."""
        self._known_of(name)
        shown, at = await self._expose(name)
        (camera, target), settings = self._known[name], self._settings
        frame = await self._drawn(shown)
        picture, jpeg = await self._worker(
            beam_of, frame, (target,), camera, settings, self._empty.get(name)
        )
        self.last = self._frames[name] = frame
        self._views.keep(name, shown.time.timestamp(), picture, jpeg)
        return picture, at
