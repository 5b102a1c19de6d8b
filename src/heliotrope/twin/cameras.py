"""Cameras of a simulated plant, which see the beams on its targets.

Both fit the port `plant.ports.Cameras`. `ExactCamera` gives the true centroid with noise of a
known covariance. `RenderedCamera` draws the frame with all light that is on the target at that
moment, whichever mirrors it comes from, and reads it as photographs of a real plant are read.
Neither knows more about the measured heliostat than a real camera could.
"""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import datetime
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from heliotrope.errors import FetchError, InputError, UnknownNameError
from heliotrope.field.camera import Camera
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, reflect
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.photograph import Photograph, PhotographSettings, read_photograph
from heliotrope.imaging.synthetic.rendering import render
from heliotrope.imaging.synthetic.scenes import Scene, Thrown, exposed
from heliotrope.imaging.targets.view import FaceView
from heliotrope.links.clock import Clock, sleep_until
from heliotrope.optics import Neighbours, centroid_shift, equal_facets, reflected_beam
from heliotrope.plant.camera_views import SEVERAL, Views, light_of, picture_of, shot_of
from heliotrope.plant.operations.views import CameraView
from heliotrope.plant.visits.joint_layout import moments_on
from heliotrope.plant.visits.photographs import Shot
from heliotrope.plant.visits.stacks import TargetLight
from heliotrope.safety import Alarm
from heliotrope.twin.boards.board import Board

#: Light further from the centre of a target than this many of its half diagonals is left out.
NEAR = 2.0
#: Cosine of the incidence below which the light of a mirror is not worth drawing.
GRAZING = 0.05
#: Least share of a mirror that is left by its neighbours for a beam to be drawn.
LEAST = 0.01
#: Brightest reading after exposure, as a share of full scale.
PEAK = 0.7
#: Share of a mirror's size in its exact beam.
_FLAT = 0.7
#: Pictures of exact beams: pixels across, brightness of the paint and of a sun, and its noise.
_ACROSS, _PAINT, _SUN, _GRAIN = 96, 0.05, 0.1, 0.0005

T = TypeVar("T")


@dataclass(frozen=True)
class TrueMirror:
    """True position and size of one mirror.

    Attributes
    ----------
    heliostat
        Name.
    vertex
        ENU, m, (3,).
    normal
        Unit normal, (3,).
    width, height
        m.
    neighbours
        Mirrors that may shade or block it; None: none does.
    """

    heliostat: str
    vertex: FloatArray
    normal: FloatArray
    width: float = 3.0
    height: float = 2.0
    neighbours: Neighbours | None = None

    def lit(self, target: Target, sun: FloatArray) -> tuple[FloatArray, float]:
        """Return where its centroid is on the plane of a target, ENU, m, (3,), and its lit share.

        NaN and 0 if neighbours hide all of it. Its facets are canted at the target's distance.
        """
        point = self.on(target, sun)
        if self.neighbours is None or not np.isfinite(point).all():
            return point, 1.0
        slant = float(np.linalg.norm(point - self.vertex))
        facets = equal_facets(self.width, self.height, (1, 1), slant)
        found = centroid_shift(
            target,
            self.vertex,
            sun,
            self.normal,
            facets,
            self.neighbours,
            facet_focal=slant,
            elements=24,
        )
        return point + found.shift @ target.axes, 1.0 - found.hidden

    def on(self, target: Target, sun: FloatArray) -> FloatArray:
        """Return where its ray meets the plane of a target, ENU, m, (3,); NaN if it does not."""
        if not float(self.normal @ sun) > GRAZING:
            return np.full(3, np.nan)
        return target.intersect(self.vertex, reflect(sun, self.normal))


@dataclass(frozen=True)
class FieldSnapshot:
    """The true mirrors and sun at the moment of the call.

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
        """Wait for the middle of an exposure; return its time, monotonic s."""
        await sleep_until(self.clock, self.clock.monotonic() + self.latency)
        return self.clock.monotonic()


def mirrors_of(
    boards: Mapping[str, Board], width: float = 3.0, height: float = 2.0
) -> Callable[[], Sequence[TrueMirror]]:
    """Return a function that gives the mirrors of boards, by name, all of one size in m."""

    def mirrors() -> Sequence[TrueMirror]:
        return [TrueMirror(name, *board.mirror(), width, height) for name, board in boards.items()]

    return mirrors


def mirrors_near(
    target: Target,
    sun: FloatArray,
    stand: tuple[FloatArray, FloatArray],
    names: tuple[str, ...],
    sizes: FloatArray,
    reach: float = NEAR,
    beside: npt.NDArray[np.intp] | None = None,
) -> list[TrueMirror]:
    """Return the mirrors whose rays meet the plane of a target near its centre.

    Parameters
    ----------
    target
        Its corners and normal count.
    sun
        Unit vector to the sun, (3,).
    stand
        Unit normals and vertices of N mirrors, (N, 3) each.
    names
        Heliostats, N.
    sizes
        Width and height of the mirrors, m, (N, 2).
    reach
        Largest distance from the centre, in half diagonals of the target.
    beside
        Rows of the neighbours of each mirror, (N, J); None: they hide nothing.
    """
    middle = np.asarray(target.corners).mean(axis=0)
    limit = reach * 0.5 * float(np.hypot(target.width, target.height))
    facing, vertex = stand
    cosine = facing @ sun
    rays = 2.0 * cosine[:, None] * facing - sun
    with np.errstate(divide="ignore", invalid="ignore"):
        along = ((middle - vertex) @ target.normal) / (rays @ target.normal)
    away = np.linalg.norm(vertex + along[:, None] * rays - middle, axis=-1)
    hits = np.flatnonzero((cosine > GRAZING) & (along > 0.0) & (away <= limit)).tolist()
    found = []
    for i in hits:
        size = float(sizes[i, 0]), float(sizes[i, 1])
        hiding = None
        if beside is not None and beside.shape[1]:
            near = beside[i]
            others = Neighbours(vertex[near], facing[near], *sizes[near].T)
            hides = others.before(vertex[i], facing[i], size, sun, rays[i])
            hiding = others.of(hides) if hides.any() else None
        found.append(TrueMirror(names[i], vertex[i], facing[i], *size, hiding))
    return found


class ExactCamera:
    """Gives true centroids of beams with noise, and no picture.

    Parameters
    ----------
    sight
        Mirrors and sun.
    covariance
        Of a centroid in the plane of the target: a variance or (2, 2), m².
    seed
        Seed of the noise.

    Raises
    ------
    InputError
        A covariance of another shape, or not a covariance.
    """

    def __init__(
        self, sight: FieldSnapshot, covariance: npt.ArrayLike = 1e-4, seed: int = 0
    ) -> None:
        given = np.asarray(covariance, dtype=np.float64)
        plane = given * np.eye(2) if given.ndim == 0 else given
        if plane.shape != (2, 2) or not np.isfinite(plane).all():
            raise InputError(
                f"exact camera: a covariance of shape {given.shape}; give a variance or (2, 2), m²"
            )
        values, vectors = np.linalg.eigh(plane)
        if not np.allclose(plane, plane.T, rtol=1e-9, atol=0.0) or values.min() < 0.0:
            raise InputError(
                "exact camera: a covariance must be symmetric and positive semidefinite"
            )
        self._sight = sight
        self._plane = plane
        # Its root; a Cholesky factor would not exist for a covariance of 0.
        self._root = vectors * np.sqrt(values)
        self._chance = np.random.default_rng(seed)
        self._views: dict[str, CameraView] = {}

    def start(self, on_alarm: Callable[[Alarm], None]) -> None:
        """Do nothing: this camera never fails."""

    def close(self) -> None:
        """Do nothing: nothing runs."""

    def sees(self, target: str) -> bool:
        """Return True: it looks at every target."""
        del target
        return True

    def awake(self, target: str) -> bool:
        """Return True: it never falls silent."""
        return self.sees(target)

    async def look(self, target: str) -> None:
        """Do nothing: exact centroids need no empty photograph."""

    def view(self, target: str) -> CameraView:
        """Return the last picture of a target."""
        return self._views.get(target, CameraView(target, 0, 0.0, b""))

    def eye(self, target: str) -> Camera:
        """Raise `UnknownNameError`: exact centroids come from no camera."""
        raise UnknownNameError("target with a camera that takes pictures", target, ())

    def frame(self, target: str) -> Frame:
        """Raise `UnknownNameError`: there are no pictures."""
        raise UnknownNameError("target with a camera that takes pictures", target, ())

    def take_view(self, camera: Camera, target: Target, pictures: Mapping[str, FloatArray]) -> None:
        """Do nothing: there are no pictures."""

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        """Return where a heliostat's beam is on a target; NaN where it is far from it."""
        at = await self._sight.exposure()
        mirrors = {mirror.heliostat: mirror for mirror in self._sight.mirrors()}
        sun = self._sight.sun()
        places = {name: mirror.lit(target, sun)[0] for name, mirror in mirrors.items()}
        true = places.get(heliostat, np.full(3, np.nan))
        point = true + (self._root @ self._chance.standard_normal(2)) @ target.axes
        reasons = []
        if not _within(target, true):
            reasons.append("no beam on the target")
        others = [n for n, p in places.items() if n != heliostat and _within(target, p)]
        if others:
            reasons.append(f"several beams: {', '.join(others)} too")
        self._keep(target, point, (heliostat, *reasons))
        return Shot(point, at, target.axes.T @ self._plane @ target.axes, tuple(reasons))

    async def light(self, target: Target, view: FaceView | None = None) -> TargetLight:
        """Return the light on a target: each beam a Gaussian at its true place, with noise."""
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
            place, share = mirror.lit(target, sun)
            if not _within(target, place, NEAR):
                continue
            size = mirror.width, mirror.height
            shape = moments_on(target, mirror.vertex, mirror.normal, *size, flat=_FLAT)
            power = share * mirror.width * mirror.height * float(mirror.normal @ sun)
            away = points - target.plane_coordinates(place)
            form = np.einsum("hwi,ij,hwj->hw", away, np.linalg.inv(shape), away)
            peak = _SUN * power / (2.0 * np.pi * np.sqrt(np.linalg.det(shape)))
            values += peak * np.exp(-0.5 * form)
        self._keep(target, np.full(3, np.nan), (SEVERAL,))
        seen = np.ones(values.shape, dtype=np.bool_)
        first = np.array([x[0], y[0]])
        return TargetLight(values.astype(np.float32), step, first, seen, 1.0, at)

    async def beside(self, work: Callable[[], T]) -> T:
        """Return the result of a computation."""
        return work()

    def _keep(self, target: Target, point: FloatArray, lines: tuple[str, ...]) -> None:
        centroid = None
        if np.isfinite(point).all():
            x, y = target.plane_coordinates(point)
            centroid = float(x), float(y)
        version = self.view(target.name).version + 1
        at = self._sight.clock.utc().timestamp()
        self._views[target.name] = CameraView(target.name, version, at, b"", lines, centroid)


@dataclass(frozen=True)
class Optics:
    """Quality of the mirrors and strength of the light.

    Attributes
    ----------
    slope_error
        Standard deviation of the mirrors' normals per axis, rad.
    dni
        W/m².
    reflectivity
        Share, 0 to 1.
    facets
        Columns and rows, canted at the slant range.
    """

    slope_error: float = 1e-3
    dni: float = 850.0
    reflectivity: float = 0.9
    facets: tuple[int, int] = (2, 2)


class RenderedCamera:
    """Draws photographs and reads them.

    A photograph takes a second of a processor. With ``threads`` it is drawn, read and annotated
    beside the event loop; without, at once, as virtual time needs it.

    Parameters
    ----------
    sight
        Mirrors and sun.
    scenes
        One target each: camera, target with its marks, light, paint and sensor, without beams.
    optics
        Mirrors and light.
    settings
        How photographs are read.
    seed
        Seed of the sensor's noise.
    threads
        Photographs that are worked on at a time; 0: in the event loop itself.

    Attributes
    ----------
    taken
        Photographs so far, empty ones included.
    last
        The last frame, None before the first.

    Raises
    ------
    InputError
        A scene with beams, or with more than one target.
    """

    def __init__(
        self,
        sight: FieldSnapshot,
        scenes: Sequence[Scene],
        *,
        optics: Optics | None = None,
        settings: PhotographSettings | None = None,
        seed: int = 0,
        threads: int = 0,
    ) -> None:
        for scene in scenes:
            names = ", ".join(target.name for target in scene.targets)
            if len(scene.targets) > 1 or scene.beams:
                raise InputError(
                    f"rendered camera: the scene of {names} has {len(scene.targets)} targets and "
                    f"{len(scene.beams)} beams; give one target and no beam: mirrors add beams"
                )
        self._sight, self._scenes = sight, {s.targets[0].name: s for s in scenes}
        self._optics, self._settings = optics or Optics(), settings or PhotographSettings()
        self._chance = np.random.default_rng(seed)
        self._pool = ThreadPoolExecutor(threads, "camera") if threads else None
        self._views, self._empty = Views(), dict[str, Frame]()
        #: Frames, and cameras and targets as they are known; the scenes have the true ones.
        self._frames = dict[str, Frame]()
        self._known = {name: (s.camera, s.targets[0]) for name, s in self._scenes.items()}
        self.taken = 0
        self.last: Frame | None = None

    def start(self, on_alarm: Callable[[Alarm], None]) -> None:
        """Do nothing: a simulated camera never falls silent."""

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)

    def sees(self, target: str) -> bool:
        """Return whether there is a scene of the target."""
        return target in self._scenes

    def awake(self, target: str) -> bool:
        """Return whether there is a scene of the target."""
        return self.sees(target)

    def view(self, target: str) -> CameraView:
        """Return the last photograph of a target, for people."""
        return self._views.view(target)

    def eye(self, target: str) -> Camera:
        """Return the camera of a target, as it is known; see `plant.ports.Cameras`."""
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
        """Read later photographs by a camera and a target's marks; the true ones stay."""
        self._known = {
            name: (camera if known.name == camera.name else known, there)
            for name, (known, there) in self._known.items()
        }
        self._known[target.name] = camera, target
        known = {**self._settings.pictures, **pictures}
        self._settings = replace(self._settings, pictures=known)

    async def look(self, target: str) -> None:
        """Photograph a target before a beam comes, as background for later photographs.

        Raises
        ------
        InputError
            A beam is on the target, or the target is not found in the photograph.
        UnknownNameError
            There is no scene of the target.
        """
        seen, _ = await self._take(target)
        reading = seen.reading(target)
        if reading.spots:
            place = reading.spots[0].plane
            raise InputError(
                f"target {target}: a beam is on it, {place[0]:.2f} m right of and "
                f"{place[1]:.2f} m above its middle; take the empty frame before one comes"
            )
        if not reading.found.found:
            raise InputError(f"target {target}: {reading.found.reason}; look at the camera")
        self._empty[target] = seen.frame

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        """Return the beam seen on a target; the camera does not know its heliostat.

        Raises
        ------
        UnknownNameError
            There is no scene of the target.
        """
        del heliostat
        seen, at = await self._take(target.name)
        return shot_of(seen, target.name, at)

    async def light(self, target: Target, view: FaceView | None = None) -> TargetLight:
        """Return the light on a target; see `plant.visits.stacks.StackCamera`.

        Raises
        ------
        InputError
            The target is not found in the photograph.
        UnknownNameError
            There is no scene of the target.
        """
        name = target.name
        camera, known = self._known_of(name)
        draw, utc, at = await self._expose(name)
        settings = self._settings

        def work() -> tuple[TargetLight, Frame]:
            frame = draw()
            self._views.show(name, utc.timestamp(), frame, SEVERAL)
            return light_of(frame, known, (known,), camera, settings, view, at), frame

        seen, frame = await self._worked(work)
        self.last = self._frames[name] = frame
        return seen

    async def beside(self, work: Callable[[], T]) -> T:
        """Return the result of a computation, made in a thread if there are any."""
        return await asyncio.to_thread(work) if self._pool is not None else work()

    def beams(self, target: Target) -> tuple[Thrown, ...]:
        """Return the beams on a target, and those beside it that a frame would show, now."""
        return _thrown(target, self._sight.mirrors(), self._sight.sun(), self._optics)

    def _known_of(self, name: str) -> tuple[Camera, Target]:
        if name not in self._scenes:
            raise UnknownNameError("target", name, list(self._scenes))
        return self._known[name]

    async def _expose(self, name: str) -> tuple[Callable[[], Frame], datetime, float]:
        """Expose a frame: return what draws it, and when it was exposed, UTC and monotonic s."""
        at = await self._sight.exposure()
        scene, utc = self._scenes[name], self._sight.clock.utc()
        mirrors, sun = self._sight.mirrors(), self._sight.sun()
        seed = int(self._chance.integers(1 << 32))
        self.taken += 1
        title = f"{scene.camera.name} {self.taken}"

        def draw() -> Frame:
            beams = _thrown(scene.targets[0], mirrors, sun, self._optics)
            # Automatic exposure: the brightest of paint and beams sets it.
            lit = exposed(replace(scene, beams=beams), PEAK)
            return render(lit, seed, name=title, time=utc).frame

        return draw, utc, at

    async def _worked(self, work: Callable[[], T]) -> T:
        """Return the result of work on a photograph."""
        if self._pool is None:
            return work()
        return await asyncio.get_running_loop().run_in_executor(self._pool, work)

    async def _take(self, name: str) -> tuple[Photograph, float]:
        """Take a photograph; return it as read, and when it was exposed, monotonic s."""
        self._known_of(name)
        draw, utc, at = await self._expose(name)
        (camera, target), settings = self._known[name], self._settings

        def work() -> tuple[Photograph, bytes]:
            seen = read_photograph(
                draw(),
                (target,),
                camera,
                settings=settings,
                without=self._empty.get(name),
            )
            return seen, picture_of(seen)

        seen, jpeg = await self._worked(work)
        self.last = self._frames[name] = seen.frame
        self._views.keep(name, utc.timestamp(), seen, jpeg)
        return seen, at


def _thrown(
    target: Target, mirrors: Sequence[TrueMirror], sun: FloatArray, optics: Optics
) -> tuple[Thrown, ...]:
    """Return the beams of mirrors on a target, and near enough beside it."""
    thrown = []
    for mirror in mirrors:
        place, share = mirror.lit(target, sun)
        if not (_within(target, place, NEAR) and share >= LEAST):
            continue
        # Facets are canted at the distance of the target, wherever the mirror looks.
        slant = float(np.linalg.norm(target.center - mirror.vertex))
        beam = reflected_beam(
            target,
            mirror.vertex,
            sun,
            mirror.width,
            mirror.height,
            normal=mirror.normal,
            facets=optics.facets,
            focal=slant,
            slope_error=optics.slope_error,
            reflectivity=optics.reflectivity,
            dni=optics.dni,
            neighbours=mirror.neighbours,
        )
        thrown.append(Thrown(target.name, beam))
    return tuple(thrown)


def _within(target: Target, point: FloatArray, share: float = 0.0) -> bool:
    """Return whether a point is on a target, or within a share of its half diagonal."""
    if not np.isfinite(point).all():
        return False
    away = np.abs(target.plane_coordinates(point) - target.plane_coordinates(_middle(target)))
    half = 0.5 * np.array([target.width, target.height])
    if share > 0.0:
        return bool(np.linalg.norm(away) <= share * np.linalg.norm(half))
    return bool((away <= half).all())


def _middle(target: Target) -> FloatArray:
    return np.asarray(target.corners.mean(axis=0))
