"""The light on a surface, as seen from its front, and the beams that it consists of."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeVar

import numpy as np

from heliotrope.errors import HeliotropeError
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.coded import ExpectedBeam, SeparatedBeam, Stack, Verdict, separate
from heliotrope.imaging.frame import Image
from heliotrope.imaging.targets.rectify import Mask, Rectified
from heliotrope.imaging.targets.view import FaceView
from heliotrope.plant.visits.photographs import TargetCamera

T = TypeVar("T")
#: A pixel is left out if it is clipped to at least this degree in any photograph.
_FULL = 0.01
#: A beam counts as merged with other light if its power, relative to the size of its mirror,
#: differs from that of the other beams by this fraction and by this many standard deviations.
_OTHER, _SIGMAS = 0.4, 4.0


@dataclass(frozen=True)
class TargetLight:
    """The light on a target in one photograph.

    Attributes
    ----------
    values
        Brightness as a fraction of full scale, (H, W), row 0 at the top.
    step
        Size of a pixel, m.
    first
        Position of the first pixel's centre, m right of and above the target's centre, (2,).
    seen
        Mask of the pixels that show bare paint of the target below full scale, (H, W).
    exposure
        Exposure times gain.
    at
        Middle of the exposure, s of the plant's monotonic clock.
    view
        Position of the target's face in the frame; None if there is no frame.
    shift
        The target's centre in the plane of the face, m, (2,).
    """

    values: Image
    step: float
    first: FloatArray
    seen: Mask
    exposure: float
    at: float
    view: FaceView | None = None
    shift: FloatArray = field(default_factory=lambda: np.zeros(2))

    @classmethod
    def of(cls, picture: Rectified, target: Target, exposure: float, at: float) -> "TargetLight":
        """Return the light on a target in a picture of its face."""
        shift = picture.face.plane(target.center)
        first = picture.first - shift
        rows, columns = picture.shape
        x = first[0] + picture.step * np.arange(columns)
        y = first[1] - picture.step * np.arange(rows)
        corners = target.plane_coordinates(target.corners)
        low, high = corners.min(axis=0), corners.max(axis=0)
        own = ((y >= low[1]) & (y <= high[1]))[:, None] & (x >= low[0]) & (x <= high[0])
        seen = picture.paint & own & (picture.clipped < _FULL)
        return cls(picture.values, picture.step, first, seen, exposure, at, picture.view, shift)

    @property
    def brightness(self) -> float:
        """Mean brightness as a fraction of full scale, at an exposure of 1."""
        return float(self.values[self.seen].mean()) / self.exposure

    def covariance_at(self, place: FloatArray) -> FloatArray:
        """Return the covariance of a position (2,) due to the error of the view, m², (2, 2)."""
        if self.view is None:
            return np.zeros((2, 2))
        return self.view.covariance_at(np.asarray(place) + self.shift)


def separated(
    pictures: Sequence[TargetLight],
    empty: TargetLight | None,
    moves: FloatArray,
    beams: Sequence[ExpectedBeam],
    powers: FloatArray | None,
) -> Sequence[SeparatedBeam]:
    """Return the M beams in photographs of one surface; see `separate`.

    Parameters
    ----------
    pictures, empty
        The light in K photographs, and the light of the surface without beams; None: never
        observed.
    moves, beams
        Movements, m right and up, (K, M, 2), and the expected beams.
    powers
        See `judged`; None: the powers of beams are not compared.
    """
    known = pictures if empty is None else (*pictures, empty)
    stack = Stack(
        np.stack([picture.values for picture in pictures]).astype(np.float64),
        pictures[0].step,
        pictures[0].first,
        np.logical_and.reduce([picture.seen for picture in known]),
        np.array([picture.exposure for picture in pictures]),
        None if empty is None else np.asarray(empty.values, dtype=np.float64) / empty.exposure,
    )
    found = separate(stack, moves, beams).beams
    return found if powers is None else judged(found, powers)


def judged(beams: Sequence[SeparatedBeam], powers: FloatArray) -> list[SeparatedBeam]:
    """Return the beams, (M,), with those marked as merged whose power does not fit their mirrors.

    The apparent brightness of the mirrors is not known in advance, but is assumed to be the same
    for all mirrors.

    Parameters
    ----------
    beams
        Beams as they were separated.
    powers
        Expected powers, in any common unit, (M,).
    """
    proven = np.array([beam.verdict is Verdict.PROVEN for beam in beams], dtype=np.bool_)
    if not proven.any():
        return list(beams)
    ratio = np.array([beam.power for beam in beams]) / powers
    gains = ratio / np.median(ratio[proven])
    spread = 1.4826 * float(np.median(np.abs(gains[proven] - 1.0)))
    wrong = proven & (np.abs(gains - 1.0) > max(_OTHER, _SIGMAS * spread))
    return [
        replace(beam, gain=float(gain), verdict=Verdict.JOINED)
        if bad
        else replace(beam, gain=float(gain))
        for beam, gain, bad in zip(beams, gains, wrong, strict=True)
    ]


@dataclass(frozen=True)
class Exposed:
    """A photograph that has been taken, and is evaluated while the beams move on.

    Attributes
    ----------
    at
        Middle of the exposure, s of the plant's monotonic clock.
    light
        Future that returns the light on the target, or raises the reason why there is none.
    """

    at: float
    light: "asyncio.Future[TargetLight]"

    @classmethod
    def read(cls, light: TargetLight) -> "Exposed":
        """Return a photograph that has already been evaluated."""
        done: asyncio.Future[TargetLight] = asyncio.get_running_loop().create_future()
        done.set_result(light)
        return cls(light.at, done)


class LightCamera(TargetCamera, Protocol):
    """A camera that measures the light on targets."""

    async def expose(self, target: Target, view: FaceView | None = None) -> Exposed:
        """Photograph a target, and return as soon as the photograph is taken.

        If the view of an earlier photograph is passed, the target is not searched for.
        """
        ...


async def light_on(
    camera: LightCamera, target: Target, view: FaceView | None = None
) -> TargetLight:
    """Return the light on a target in a new photograph; see `LightCamera.expose`."""
    return await (await camera.expose(target, view)).light


async def noting(look: Callable[[], Awaitable[None]], made: Awaitable[T]) -> T:
    """Return the result of some work; poll the heliostats in the meantime.

    Raises
    ------
    HeliotropeError
        If the work raises it.
    """
    found: list[T | HeliotropeError] = []

    async def looks() -> None:
        while True:
            await look()

    async with asyncio.TaskGroup() as group:
        looking = group.create_task(looks())
        try:
            found.append(await made)
        except HeliotropeError as error:
            found.append(error)  # a task group would wrap the error
        looking.cancel()
    if isinstance(found[0], HeliotropeError):
        raise found[0]
    return found[0]
