"""The photographs of a visit, taken with or without searching for and centring the beam.

A heliostat that was never calibrated may miss by more than the width of the target. If the first
photograph shows no light, the aim moves along a square spiral in the target plane until light
appears, and then by the distance of the beam from the middle. Only light on the target counts, and
only light that moves as the aim moves, because other beams cross targets while a field is raised.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.plant.visits.settings import Centring, CycleSettings
from heliotrope.plant.visits.swings import spread_at
from heliotrope.plant.visits.visit import Visit

#: Positions of the photographs after the first: right and up, in turn.
CORNERS = ((1.0, 1.0), (-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0))
#: Number of spare photographs, because some may be cut off at the edge of the target.
_SPARE = 2
#: If light was once absent where it was expected, it is used only after it has followed the aim
#: this many times.
_FOLLOWED = 2
#: An aim this close to the previous one is not sent, m.
_SAME = 0.05

#: Called with the name of each step.
Tell = Callable[[str], None]


@dataclass(frozen=True)
class Shot:
    """One beam as seen in a photograph of a target.

    Attributes
    ----------
    point
        Centroid, ENU, m, (3,).
    at
        Middle of the exposure, s on the plant's monotonic clock.
    covariance
        Covariance of the point, m²: a variance or (3, 3).
    reasons
        Why the shot cannot be used; () if it can.
    """

    point: FloatArray
    at: float
    covariance: npt.ArrayLike = 0.0
    reasons: tuple[str, ...] = ()

    def wider(self, covariance: FloatArray) -> "Shot":
        """Return the shot with the covariance of its point increased, m², (3, 3)."""
        given = np.asarray(self.covariance, dtype=np.float64)
        own = given * np.eye(3) if given.ndim == 0 else given
        return replace(self, covariance=own + covariance)


class TargetCamera(Protocol):
    """A camera that photographs targets and evaluates the photographs."""

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        """Return a heliostat's beam in a new photograph."""
        ...


@dataclass
class Photographs:
    """The photographs of one visit.

    Attributes
    ----------
    used
        Photographs, each with the step counts of the two axes, (2,), at its exposure.
    rejected
        Why the remaining photographs were not used, in words.
    found
        Whether the beam was seen in any photograph.
    """

    used: list[tuple[Shot, FloatArray]] = field(default_factory=list)
    rejected: list[str] = field(default_factory=list)
    found: bool = True


class Photographing(Protocol):
    """A method of taking the photographs of a visit."""

    async def take(self, visit: Visit, tell: Tell) -> Photographs:
        """Photograph the beam of a heliostat that has arrived at its target."""
        ...


class Plain:
    """Photographs of the beam in its present position, without searching or centring."""

    def __init__(self, camera: TargetCamera, settings: CycleSettings) -> None:
        self._camera, self._settings = camera, settings

    async def take(self, visit: Visit, tell: Tell) -> Photographs:
        """Take the photographs; see `Photographing`."""
        plant, taken = visit.plant, Photographs()
        for k in range(self._settings.shots):
            tell(f"photograph {k + 1}")
            due = plant.now() + self._settings.interval
            shot = await photographed(self._camera, visit)
            if shot.reasons:
                taken.rejected.append(f"photograph {k + 1}: {'; '.join(shot.reasons)}")
            else:
                taken.used.append(await measured(visit, shot))
            while plant.now() < due and k + 1 < self._settings.shots:
                await visit.look()
        return taken


class Centred:
    """Photographs of a beam that is first searched for and centred, then moved over the target."""

    def __init__(self, camera: TargetCamera, settings: CycleSettings, centring: Centring) -> None:
        self._camera, self._settings, self._centring = camera, settings, centring

    async def take(self, visit: Visit, tell: Tell) -> Photographs:
        """Take the photographs; see `Photographing`."""
        taken, before = Photographs(), np.asarray(visit.target.center)
        for _ in range(self._centring.looks):
            light = await self._find(visit, before, tell)
            if light is None:
                tries = self._centring.most + 1
                taken.rejected.append(
                    f"no beam was seen on {visit.target.name} in {tries} photographs"
                )
                taken.found = False
                return taken
            before = await self._series(visit, light, taken, tell)
            if taken.used:
                break
        return taken

    async def search(self, visit: Visit, tell: Tell) -> tuple[FloatArray | None, str]:
        """Search for the beam until the camera sees it move with its aim; nothing is learnt.

        Returns
        -------
            The distance by which the beam misses its aim, right and up, m, (2,), or None if it was
            not found; and the reason.
        """
        target = visit.target
        light = await self._find(visit, np.asarray(target.center), tell)
        if light is None:
            tries = self._centring.most + 1
            return None, f"no beam was seen on {target.name} in {tries} photographs"
        corner = np.array(CORNERS[0]) * room_of(visit, self._centring)
        goal = np.asarray(light.aim + corner @ target.axes)
        tell("checking that it moves with the aim")
        await self._go(visit, goal, light.aim)
        shot = await photographed(self._camera, visit)
        astray = self._astray(target, shot, goal, light)
        if not astray and np.linalg.norm(goal - light.first) <= _SAME:
            astray = "the target is too small to move a beam on it"
        if astray or seen(target, shot) is None:
            said = astray or "; ".join(shot.reasons)
            return None, f"light was seen, but was not shown to move with the aim: {said}"
        return light.place - target.axes @ (light.first - target.center), ""

    async def _find(self, visit: Visit, before: FloatArray, tell: Tell) -> "_Light | None":
        """Search for the beam and bring it near the middle; return None if it is not found.

        ``before`` is the present aim.
        """
        target, centring = visit.target, self._centring
        pitch = centring.pitch * min(target.width, target.height)
        for k, place in enumerate([(0, 0), *spiral(centring.most)]):
            aim = np.asarray(target.center + pitch * (np.array(place) @ target.axes))
            tell(f"search {k}" if k else "first look")
            await self._go(visit, aim, before)
            before = aim
            light = seen(target, await photographed(self._camera, visit))
            if light is not None:
                return await self._centre(visit, aim, light, tell)
        return None

    async def _centre(
        self, visit: Visit, aim: FloatArray, place: FloatArray, tell: Tell
    ) -> "_Light":
        """Move the aim by the beam's offset from the middle."""
        target = visit.target
        if np.linalg.norm(place) <= self._centring.near * min(target.width, target.height):
            return _Light(aim, aim, place)
        tell("centring")
        moved = np.asarray(aim - place @ target.axes)
        await visit.aim(moved)
        await visit.arrived(self._settings.arrival)
        return _Light(moved, aim, place)

    async def _series(
        self, visit: Visit, light: "_Light", taken: Photographs, tell: Tell
    ) -> FloatArray:
        """Take the photographs of the beam that was found; end at once if it is a different beam.

        Returns the last aim.
        """
        plant, settings = visit.plant, self._settings
        aim, room = light.aim, room_of(visit, self._centring)
        # Whether the beam was absent where it was expected, and how often it followed its aim.
        missed, moves = False, 0
        last = light.aim
        for k in range(settings.shots + _SPARE):
            tell(f"photograph {k + 1}")
            due = plant.now() + settings.interval
            shot = await photographed(self._camera, visit)
            astray = self._astray(visit.target, shot, aim, light)
            good = not astray and not shot.reasons
            missed |= bool(astray) or seen(visit.target, shot) is None
            if good:
                moves += bool(np.linalg.norm(aim - last) > _SAME)
                last = aim
                taken.used.append(await measured(visit, shot))
            else:
                taken.rejected.append(f"photograph {k + 1}: {astray or '; '.join(shot.reasons)}")
            if len(taken.used) >= settings.shots or (astray and not taken.used):
                break
            # A photograph that failed away from the middle may succeed in the middle.
            corner = np.array(CORNERS[k % len(CORNERS)]) * (room if good else 0.0)
            goal = np.asarray(light.aim + corner @ visit.target.axes)
            await self._go(visit, goal, aim)
            aim = goal
            while plant.now() < due:
                await visit.look()
        if missed and moves < min(_FOLLOWED, settings.shots - 1):
            # Any light agrees with the place where it was found, and passing light may agree with
            # the next.
            taken.used.clear()
            taken.rejected.append("the light did not move with the aim often enough")
        return aim

    def _astray(self, target: Target, shot: Shot, aim: FloatArray, light: "_Light") -> str | None:
        """Return the reason why light cannot be the beam: it does not move with the aim."""
        place = seen(target, shot)
        if place is None:
            return None if shot.reasons else "no light on the target"
        expected = light.place + target.axes @ (aim - light.first)
        away = float(np.linalg.norm(place - expected))
        if away <= self._centring.astray * min(target.width, target.height):
            return None
        return f"light {away:.1f} m from the expected position: another heliostat's beam"

    async def _go(self, visit: Visit, aim: FloatArray, before: FloatArray) -> None:
        if np.linalg.norm(aim - before) > _SAME:
            await visit.aim(aim)
            await visit.arrived(self._settings.arrival)


@dataclass(frozen=True)
class _Light:
    """Light first seen at ``place``, m, (2,), with the aim ``first``; ``aim`` would centre it."""

    aim: FloatArray
    first: FloatArray
    place: FloatArray


def room_of(visit: Visit, centring: Centring) -> float:
    """Return how far the beam may be moved from the middle of the target, right and up, m."""
    target, plant, row = visit.target, visit.plant, visit.row
    group, place = plant.design.find(visit.heliostat)
    mirror = 0.5 * math.hypot(float(group.width[place]), float(group.height[place]))
    slant = float(np.linalg.norm(plant.beams.armature.origin_1[row] - target.center))
    free = 0.5 * min(target.width, target.height) - mirror - centring.slope * slant
    return centring.spread * max(0.0, free)


async def photographed(camera: TargetCamera, visit: Visit) -> Shot:
    """Return a photograph of a heliostat that tracks its aim.

    Raises
    ------
    RefusedError
        If the heliostat has left its aim in the meantime.
    """
    shot = await camera.photograph(visit.target, visit.heliostat)
    if visit.state != states.TRACKING:
        raise RefusedError(f"{visit.heliostat}: it left its aim while it was photographed")
    return shot


async def measured(visit: Visit, shot: Shot) -> tuple[Shot, FloatArray]:
    """Return a shot and the step counts at its exposure, (2,).

    The point of the shot is less certain if an axis may have been taking up its backlash; see
    `swings`.

    Raises
    ------
    RefusedError
        As in `Visit.counts_at`.
    """
    counts = await visit.counts_at(shot.at)
    return shot.wider(spread_at(visit, shot.at, counts)), counts


def seen(target: Target, shot: Shot) -> FloatArray | None:
    """Return the position of the light in a shot; None if it shows no light.

    The position is the offsets right of and above the centre, m, (2,).
    """
    if not np.isfinite(shot.point).all():
        return None
    place = target.plane_coordinates(shot.point)
    corners = target.plane_coordinates(target.corners)
    if (place < corners.min(axis=0)).any() or (place > corners.max(axis=0)).any():
        return None
    return np.asarray(place)


def spiral(count: int) -> Iterator[tuple[int, int]]:
    """Yield the first places of a square spiral about (0, 0), without (0, 0) itself."""
    x = y = 0
    step, turn, left = 1, 0, 1
    ways = ((1, 0), (0, 1), (-1, 0), (0, -1))
    for _ in range(count):
        x, y = x + ways[turn % 4][0], y + ways[turn % 4][1]
        yield x, y
        left -= 1
        if left == 0:
            turn += 1
            step += turn % 2 == 0
            left = step
