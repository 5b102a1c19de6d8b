"""A calibration cycle that finds beams which miss the target, and brings them to its middle.

A mirror that was never calibrated may miss by more than the target is wide. If nothing is seen,
the aim goes along a square spiral in the target's plane until light appears; the aim is then
moved by as much as the beam was off. Only what is seen on the target is used, and only light that
goes where the aim goes: beams of others cross targets while a field is raised.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from heliotrope.calibration.sightings import Sightings
from heliotrope.errors import InputError
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.plant.authority import RefusedError
from heliotrope.plant.controller import PlantController
from heliotrope.plant.visits.calibration_cycle import (
    CalibrationCycle,
    Camera,
    CycleSettings,
    Shot,
)
from heliotrope.plant.visits.visit import Visit


@dataclass(frozen=True)
class Centring:
    """How a beam is looked for.

    Attributes
    ----------
    pitch
        Between neighbouring aims, as a share of the target's lesser side.
    most
        Aims that are tried beside the middle.
    near
        A beam this close to where it is wanted is left there, as a share of the lesser side.
    spread
        Photographs after the first are taken with the beam so far off the middle, as a share of
        half of what the beam leaves free of the target: the further apart sightings are, the more
        they tell. 0: all in the middle.
    slope
        Half the breadth of a beam, rad, beside that of its mirror.
    astray
        Light so far from where the aim has moved it is another's, as a share of the lesser side.
    looks
        A beam is looked for so often, if what was seen first was another's.
    """

    pitch: float = 0.7
    most: int = 24
    near: float = 0.15
    spread: float = 0.8
    slope: float = 8e-3
    astray: float = 0.06
    looks: int = 3

    def __post_init__(self) -> None:
        if not (0.0 < self.pitch <= 2.0 and self.most >= 0 and 0.0 < self.near <= 0.5):
            raise InputError(
                f"centring: pitch {self.pitch}, {self.most} aims, near {self.near}; give above 0 "
                "to 2, 0 or more, and above 0 to 0.5"
            )


#: Where the photographs after the first are taken: right and up, in turn.
CORNERS = ((1.0, 1.0), (-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0))


def spiral(count: int) -> Iterator[tuple[int, int]]:
    """Yield the first places of a square spiral about (0, 0), which is left out."""
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


class CentringCycle(CalibrationCycle):
    """A `CalibrationCycle` with a search and with its beam brought to the middle.

    Parameters
    ----------
    plant, camera, settings
        As of `CalibrationCycle`.
    centring
        How beams are looked for.
    on_stage
        Called with heliostat, target and what is done now.
    """

    def __init__(
        self,
        plant: PlantController,
        camera: Camera,
        settings: CycleSettings | None = None,
        centring: Centring | None = None,
        on_stage: Callable[[str, str, str], None] | None = None,
    ) -> None:
        super().__init__(plant, camera, settings)
        self._centring = centring or Centring()
        self.on_stage = on_stage

    @property
    def settings(self) -> CycleSettings:
        """How it calibrates."""
        return self._settings

    @property
    def model(self) -> str | tuple[str, ...]:
        """Parameters that are fitted: a name of the table, or names."""
        return self._settings.model

    @property
    def model_name(self) -> str:
        """The same as one word."""
        model = self._settings.model
        return model if isinstance(model, str) else "+".join(model)

    def _tell(self, visit: Visit, stage: str) -> None:
        if self.on_stage is not None:
            self.on_stage(visit.heliostat, visit.target.name, stage)

    async def _shoot(self, visit: Visit) -> tuple[list[Sightings], list[str]]:
        found: list[Sightings] = []
        rejected: list[str] = []
        before: FloatArray | None = None
        for _ in range(self._centring.looks):
            light = await self._find(visit, before)
            if light is None:
                tries = self._centring.most + 1
                rejected.append(f"no beam was seen on {visit.target.name} in {tries} photographs")
                return [], rejected
            found = await self._series(visit, light, rejected)
            if found:
                break
            before = light.aim
        return found, rejected

    async def _series(self, visit: Visit, light: "_Light", rejected: list[str]) -> list[Sightings]:
        """Take the photographs of a beam that was found; none if it was another's."""
        plant, settings = self._plant, self._settings
        found: list[Sightings] = []
        aim, middle, room = light.aim, light.aim, self._room(visit)
        # Two more than are wanted: one or the other may be cut at an edge.
        for k in range(settings.shots + 2):
            if len(found) >= settings.shots:
                break
            self._tell(visit, f"photograph {k + 1}")
            due = plant.now() + settings.interval
            shot = await self._photograph(visit)
            astray = self._astray(visit.target, shot, aim, light)
            if astray and not found:
                rejected.append(f"photograph {k + 1}: {astray}")
                return found
            if astray or shot.reasons:
                rejected.append(f"photograph {k + 1}: {astray or '; '.join(shot.reasons)}")
            else:
                found.append(self._sighting(shot, await visit.counts_at(shot.at)))
            if len(found) < settings.shots:
                x, y = CORNERS[k % len(CORNERS)]
                # What could not be used there may be better in the middle.
                off = np.array([x, y]) * (0.0 if shot.reasons or astray else room)
                await self._go(visit, np.asarray(middle + off @ visit.target.axes), aim)
                aim = np.asarray(middle + off @ visit.target.axes)
            while plant.now() < due and len(found) < settings.shots:
                await visit.look()
        return found

    def _astray(self, target: Target, shot: Shot, aim: FloatArray, light: "_Light") -> str:
        """Return why light is not that which was found first, "" if it is; it moves as aims do."""
        place = seen(target, shot)
        if place is None:
            return "" if shot.reasons else "no light on the target"
        expected = light.place + target.axes @ (aim - light.first)
        away = float(np.linalg.norm(place - expected))
        if away <= self._centring.astray * min(target.width, target.height):
            return ""
        return f"light {away:.1f} m from where the aim went: another beam's"

    def _room(self, visit: Visit) -> float:
        """Return how far a beam may be off the middle on both sides, m."""
        target, plant, row = visit.target, self._plant, visit.row
        group, place = plant.design.find(visit.heliostat)
        mirror = 0.5 * math.hypot(float(group.width[place]), float(group.height[place]))
        slant = float(np.linalg.norm(plant.beams.armature.origin_1[row] - target.center))
        free = 0.5 * min(target.width, target.height) - mirror - self._centring.slope * slant
        return self._centring.spread * max(0.0, free)

    async def _go(self, visit: Visit, aim: FloatArray, before: FloatArray) -> None:
        if np.linalg.norm(aim - before) > 0.05:
            await visit.aim(aim)
            await visit.arrived(self._settings.arrival)

    async def _photograph(self, visit: Visit) -> Shot:
        shot = await self._camera.photograph(visit.target, visit.heliostat)
        if visit.state != states.TRACKING:
            raise RefusedError(f"{visit.heliostat}: it left its aim while it was photographed")
        return shot

    async def _find(self, visit: Visit, before: FloatArray | None = None) -> "_Light | None":
        """Look for the beam, and aim so that it is near the middle; None if it is nowhere."""
        target, centring = visit.target, self._centring
        middle = np.asarray(target.center)
        pitch = centring.pitch * min(target.width, target.height)
        for k, (x, y) in enumerate([(0, 0), *spiral(centring.most)]):
            aim = np.asarray(middle + pitch * (np.array([x, y]) @ target.axes))
            self._tell(visit, f"search {k}" if k else "first look")
            if k:
                await visit.aim(aim)
                await visit.arrived(self._settings.arrival)
            else:
                await self._go(visit, aim, middle if before is None else before)
            shot = await self._photograph(visit)
            place = seen(target, shot)
            if place is not None:
                return await self._centre(visit, aim, place)
        return None

    async def _centre(self, visit: Visit, aim: FloatArray, place: FloatArray) -> "_Light":
        """Move the aim by as much as the beam is off the middle."""
        target = visit.target
        if np.linalg.norm(place) <= self._centring.near * min(target.width, target.height):
            return _Light(aim, aim, place)
        self._tell(visit, "to the middle")
        moved = np.asarray(aim - place @ target.axes)
        await visit.aim(moved)
        await visit.arrived(self._settings.arrival)
        return _Light(moved, aim, place)


@dataclass(frozen=True)
class _Light:
    """Where to aim for the middle; light was first seen at ``place`` (m, (2,)) by ``first``."""

    aim: FloatArray
    first: FloatArray
    place: FloatArray


def seen(target: Target, shot: Shot) -> FloatArray | None:
    """Return where a shot shows light, right of and above the aim point, m, (2,); None: nowhere."""
    if not np.isfinite(shot.point).all():
        return None
    place = target.plane_coordinates(shot.point)
    corners = target.plane_coordinates(target.corners)
    if (place < corners.min(axis=0)).any() or (place > corners.max(axis=0)).any():
        return None
    return np.asarray(place)
