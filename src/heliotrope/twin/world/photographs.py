"""The camera of the world "visits": true centroids with noise, and photographs that lie."""

import random
from dataclasses import dataclass, replace

import numpy as np

from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.plant.visits import Shot
from heliotrope.twin.cameras import ExactCamera, FieldSnapshot

#: What a photograph may show instead of the heliostat's beam.
LIES = ("still", "passing", "before")
#: Photographs in turn that show the same lie.
_RUNS = (1, 3, 4, 6, 12)
#: Greatest speed of another mirror's spot that crosses a target, m/s.
_SPEED = 0.3


@dataclass(frozen=True)
class _Lie:
    """A light on a target: its place in the target's plane, m, (2,), its speed, m/s, since when."""

    kind: str
    place: FloatArray
    speed: FloatArray
    since: float
    left: int


class LyingCamera:
    """A camera of targets whose photographs lie now and then.

    Parameters
    ----------
    sight
        True mirrors and sun.
    seed
        Seed of noise and lies.
    share
        Share of the photographs with which lies begin.

    Attributes
    ----------
    lies
        Number of photographs of each kind that lied.
    """

    def __init__(self, sight: FieldSnapshot, seed: int, share: float) -> None:
        self._true = ExactCamera(sight, 1e-4, seed)
        self._sight, self._share = sight, share
        self._chance = random.Random(f"camera {seed}")
        self._lie: dict[str, _Lie] = {}
        self._last: dict[str, Shot] = {}
        self.lies = dict.fromkeys(LIES, 0)

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        """Return what a photograph shows: the heliostat's beam, or something else."""
        true = await self._true.photograph(target, heliostat)
        lie = self._lie.get(target.name)
        if lie is None and self._chance.random() < self._share:
            lie = self._begun(target, true.at)
        before, self._last[target.name] = self._last.get(target.name), true
        if lie is None:
            return true
        left = replace(lie, left=lie.left - 1)
        if left.left > 0:
            self._lie[target.name] = left
        else:
            self._lie.pop(target.name, None)
        shown = self._shown(target, true, before, lie)
        self._last[target.name] = shown
        return shown

    def _begun(self, target: Target, now: float) -> _Lie:
        chance = self._chance
        size = 0.4 * np.array([target.width, target.height])
        place = size * np.array([chance.uniform(-1.0, 1.0), chance.uniform(-1.0, 1.0)])
        kind = chance.choice(LIES)
        speed = np.zeros(2)
        if kind == "passing":
            speed = np.array([chance.uniform(-_SPEED, _SPEED), chance.uniform(-_SPEED, _SPEED)])
        return _Lie(kind, place, speed, now, chance.choice(_RUNS))

    def _shown(self, target: Target, true: Shot, before: Shot | None, lie: _Lie) -> Shot:
        if lie.kind == "before":
            if before is None:
                return true
            self.lies[lie.kind] += 1
            return replace(before, at=true.at)
        self.lies[lie.kind] += 1
        place = lie.place + (true.at - lie.since) * lie.speed
        return Shot(np.asarray(target.point(place)), true.at, 1e-4)
