"""Cameras of a simulated plant: what they see of the beams on its targets.

Both cameras are a `control.calibration_cycle.Camera`. `ExactCamera` gives the true centroid with
noise of a known covariance. `RenderedCamera` draws the frame with all light that is on the target
at that moment, whoever threw it, and reads it as photographs of a real plant are read. Neither
looks at which heliostat is meant more than a real camera could.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, reflect
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.photograph import Reading, Settings, read_photograph
from heliotrope.imaging.synthetic.rendering import render
from heliotrope.imaging.synthetic.scenes import Scene, Thrown, exposed
from heliotrope.links.clock import Clock, sleep_until
from heliotrope.optics.mirror_image import reflected_beam
from heliotrope.plant.visits.photographs import Shot
from heliotrope.twin.boards.board import Board

#: Light further from the middle of a target than this many of its half diagonals is left out.
NEAR = 2.0
#: Cosine of the incidence below which a mirror throws no light worth drawing.
GRAZING = 0.05
#: Brightest reading that the exposure is set for, of the full scale.
PEAK = 0.7


@dataclass(frozen=True)
class Mirror:
    """One mirror as it stands.

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
    """

    heliostat: str
    vertex: FloatArray
    normal: FloatArray
    width: float = 3.0
    height: float = 2.0

    def on(self, target: Target, sun: FloatArray) -> FloatArray:
        """Return where its ray meets a target's plane, ENU, (3,); NaN if it never does."""
        if not float(self.normal @ sun) > GRAZING:
            return np.full(3, np.nan)
        return target.intersect(self.vertex, reflect(sun, self.normal))


@dataclass(frozen=True)
class Sight:
    """What there is to be seen: mirrors and sun, in truth, at the moment of the call.

    Attributes
    ----------
    clock
        Of the plant.
    mirrors
        Gives all mirrors whose light may be on a target.
    sun
        Gives the unit vector to the sun, (3,).
    latency
        From being asked for a photograph to the middle of its exposure, s.
    """

    clock: Clock
    mirrors: Callable[[], Sequence[Mirror]]
    sun: Callable[[], FloatArray]
    latency: float = 1.0

    async def exposure(self) -> float:
        """Wait for the middle of an exposure; return when it is, monotonic s."""
        await sleep_until(self.clock, self.clock.monotonic() + self.latency)
        return self.clock.monotonic()


def mirrors_of(
    boards: Mapping[str, Board], width: float = 3.0, height: float = 2.0
) -> Callable[[], Sequence[Mirror]]:
    """Return what gives the mirrors of boards, by name, each of one size in m."""

    def mirrors() -> Sequence[Mirror]:
        return [Mirror(name, *board.mirror(), width, height) for name, board in boards.items()]

    return mirrors


class ExactCamera:
    """Gives true centroids of beams with noise.

    Parameters
    ----------
    sight
        What there is to be seen.
    covariance
        Of a centroid in the target's plane: a variance or (2, 2), m².
    seed
        Of the noise.

    Raises
    ------
    InputError
        A covariance that none is.
    """

    def __init__(self, sight: Sight, covariance: npt.ArrayLike = 1e-4, seed: int = 0) -> None:
        given = np.asarray(covariance, dtype=np.float64)
        plane = given * np.eye(2) if given.ndim == 0 else given
        if plane.shape != (2, 2) or not np.isfinite(plane).all():
            raise InputError(
                f"exact camera: a covariance of shape {given.shape}; give a variance or (2, 2), m²"
            )
        values, vectors = np.linalg.eigh(plane)
        if not np.allclose(plane, plane.T, rtol=1e-9, atol=0.0) or values.min() < 0.0:
            raise InputError("exact camera: a covariance must be symmetric and nowhere below 0 m²")
        self._sight = sight
        self._plane = plane
        # Its root; a Cholesky factor would not bear a covariance of 0.
        self._root = vectors * np.sqrt(values)
        self._chance = np.random.default_rng(seed)

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        """Return where a heliostat's beam is on a target.

        Raises
        ------
        UnknownNameError
            If there is no such heliostat.
        """
        at = await self._sight.exposure()
        mirrors = {mirror.heliostat: mirror for mirror in self._sight.mirrors()}
        if heliostat not in mirrors:
            raise UnknownNameError("heliostat", heliostat, list(mirrors))
        sun = self._sight.sun()
        places = {name: mirror.on(target, sun) for name, mirror in mirrors.items()}
        true = places[heliostat]
        point = true + (self._root @ self._chance.standard_normal(2)) @ target.axes
        reasons = []
        if not _within(target, true):
            reasons.append("no beam on the target")
        others = [n for n, p in places.items() if n != heliostat and _within(target, p)]
        if others:
            reasons.append(f"several beams: {', '.join(others)} too")
        return Shot(point, at, target.axes.T @ self._plane @ target.axes, tuple(reasons))


@dataclass(frozen=True)
class Optics:
    """How mirrors throw their light.

    Attributes
    ----------
    slope_error
        Standard deviation of the mirrors' normals per axis, rad.
    dni, reflectivity
        W/m², and a share.
    facets
        Columns and rows, canted at the slant range.
    """

    slope_error: float = 1e-3
    dni: float = 850.0
    reflectivity: float = 0.9
    facets: tuple[int, int] = (2, 2)


class RenderedCamera:
    """Draws photographs and reads them.

    Parameters
    ----------
    sight
        What there is to be seen.
    scenes
        Of one target each: camera, target with its marks, light, paint and sensor, no beams.
    optics
        Of all mirrors.
    settings
        How photographs are read.
    seed
        Of the sensor's noise.

    Attributes
    ----------
    taken
        Photographs so far, empty ones too.
    last
        The frame that was taken last, None before.

    Raises
    ------
    InputError
        A scene with beams, or with more than one target.
    """

    def __init__(
        self,
        sight: Sight,
        scenes: Sequence[Scene],
        *,
        optics: Optics | None = None,
        settings: Settings | None = None,
        seed: int = 0,
    ) -> None:
        for scene in scenes:
            names = ", ".join(target.name for target in scene.targets)
            if len(scene.targets) > 1 or scene.beams:
                raise InputError(
                    f"rendered camera: the scene of {names} has {len(scene.targets)} targets and "
                    f"{len(scene.beams)} beams; give one target each and none: mirrors throw them"
                )
        self._sight, self._scenes = sight, {s.targets[0].name: s for s in scenes}
        self._optics, self._settings = optics or Optics(), settings or Settings()
        self._chance = np.random.default_rng(seed)
        self._empty: dict[str, Frame] = {}
        self.taken = 0
        self.last: Frame | None = None

    async def take_empty(self, target: Target) -> None:
        """Photograph a target before a beam comes: the background of what is taken later.

        Raises
        ------
        InputError
            If light of a beam is seen on it.
        UnknownNameError
            If there is no scene of it.
        """
        frame = await self._take(target.name)
        reading = self._read(target, frame, None)
        if reading.spots:
            place = reading.spots[0].plane
            raise InputError(
                f"target {target.name}: a beam is on it, {place[0]:.2f} m right of and "
                f"{place[1]:.2f} m above its middle; take the empty frame before one comes"
            )
        if not reading.found.found:
            raise InputError(f"target {target.name}: {reading.found.reason}; look at the camera")
        self._empty[target.name] = frame

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        """Return the beam that is seen on a target; the camera does not know whose it is.

        Raises
        ------
        UnknownNameError
            If there is no scene of the target.
        """
        del heliostat
        frame = await self._take(target.name)
        at = self._sight.clock.monotonic()
        reading = self._read(target, frame, self._empty.get(target.name))
        reasons = tuple(f"{reason.name}: {reason.text}" for reason in reading.reasons)
        if not reading.spots:
            return Shot(np.full(3, np.nan), at, 0.0, reasons)
        spot = reading.spots[0]
        return Shot(spot.point, at, spot.covariance_enu, reasons)

    def beams(self, target: Target) -> tuple[Thrown, ...]:
        """Return what is thrown on a target, and beside it as near as a frame shows, now."""
        sun, optics = self._sight.sun(), self._optics
        thrown = []
        for mirror in self._sight.mirrors():
            if not _within(target, mirror.on(target, sun), NEAR):
                continue
            # The facets are canted at the distance of the target, wherever the mirror looks.
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
            )
            thrown.append(Thrown(target.name, beam))
        return tuple(thrown)

    async def _take(self, name: str) -> Frame:
        if name not in self._scenes:
            raise UnknownNameError("target", name, list(self._scenes))
        await self._sight.exposure()
        scene = self._scenes[name]
        beams = self.beams(scene.targets[0])
        # As a camera with automatic exposure: the brightest of paint and beams sets it.
        scene = exposed(replace(scene, beams=beams), PEAK)
        self.taken += 1
        picture = render(
            scene,
            int(self._chance.integers(1 << 32)),
            name=f"{scene.camera.name} {self.taken}",
            time=self._sight.clock.utc(),
        )
        self.last = picture.frame
        return picture.frame

    def _read(self, target: Target, frame: Frame, without: Frame | None) -> Reading:
        scene = self._scenes[target.name]
        seen = read_photograph(
            frame, scene.targets, scene.camera, settings=self._settings, without=without
        )
        return seen.reading(target.name)


def _within(target: Target, point: FloatArray, share: float = 0.0) -> bool:
    """Whether a point of the plane is on a target, or within a share of its half diagonal."""
    if not np.isfinite(point).all():
        return False
    away = np.abs(target.plane_coordinates(point) - target.plane_coordinates(_middle(target)))
    half = 0.5 * np.array([target.width, target.height])
    if share > 0.0:
        return bool(np.linalg.norm(away) <= share * np.linalg.norm(half))
    return bool((away <= half).all())


def _middle(target: Target) -> FloatArray:
    return np.asarray(target.corners.mean(axis=0))
