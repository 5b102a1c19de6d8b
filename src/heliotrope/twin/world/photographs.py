"""The camera of target visits: true centroids with noise, and false photographs.

A beam fluctuates by as much as the plant assumes before it has learnt the fluctuation, so that the
covariance of a calibration, which is based on that assumption, is correct, and `VisitObserver` can
judge it.
"""

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeVar

import numpy as np

from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.targets.view import FaceView
from heliotrope.plant.visits import Shot
from heliotrope.plant.visits.target_light import Exposed, TargetLight
from heliotrope.twin.cameras import ExactCamera, FieldSnapshot

T = TypeVar("T")
#: What a photograph may show instead of the heliostat's beam.
LIES = ("still", "passing", "before")
#: What may spoil the photographs of a stack, how often relative to false photographs, the size of a
#: lamp, m, and the longest time between photographs of a stack, s.
SPOILS, _STACKS_SPOILT, _LAMP, _GAP = ("lamp", "cloud"), 0.1, 0.3, 20.0
#: Variance of a centroid in the plane of the target, m².
_CENTROID = 1e-4
#: Numbers of consecutive photographs that show the same lie; the same for lights that last for
#: minutes.
_RUNS, _LONG_RUNS = (1, 3, 4, 6, 12), (12, 24, 48)
#: Maximum speed of another heliostat's spot across a target, m/s.
_SPEED = 0.3


@dataclass(frozen=True)
class _Lie:
    """A false light on a target.

    Its position in the target plane, m, (2,), its velocity, m/s, and its start time.
    """

    kind: str
    place: FloatArray
    speed: FloatArray
    since: float
    remaining: int


@dataclass(frozen=True)
class _Spoilt:
    """A disturbance of a stack: a lamp at a point of the target, m, (2,), or less sun."""

    kind: str
    place: FloatArray
    sun: float
    lamp: float
    remaining: int


class LyingCamera:
    """A target camera whose photographs are occasionally false.

    Parameters
    ----------
    sight
        The true mirrors and the sun.
    seed
        Seed of noise and lies.
    share
        Fraction of the photographs with which lies begin.
    waver
        Standard deviation of a beam's fluctuation in each direction, in addition to the centroid
        noise, rad.
    standing
        Whether every lie is a light that stays for minutes, such as a lamp or the beam of a
        heliostat left there.

    Attributes
    ----------
    lies
        Number of false photographs of each kind.
    taken
        Times of all photographs of single beams, s of the monotonic clock.
    told
        Function called for each of these photographs with the heliostat, target, measured point,
        ENU, m, (3,), and time.
    """

    def __init__(
        self, sight: FieldSnapshot, seed: int, share: float, waver: float, *, standing: bool
    ) -> None:
        self._true = ExactCamera(sight, _CENTROID, seed)
        self._sight, self._share, self._waver = sight, share, waver
        self._standing = standing
        self._wind = np.random.default_rng([seed, 1])
        self._chance = random.Random(f"camera {seed}")
        self._lie: dict[str, _Lie] = {}
        self._last: dict[str, Shot] = {}
        self._spoilt: dict[str, _Spoilt] = {}
        self._stacked: list[float] = []
        self.lies = dict.fromkeys((*LIES, *SPOILS), 0)
        self.taken: list[float] = []
        self.on_photograph: Callable[[str, str, FloatArray, float], None] | None = None

    def away(self, at: float) -> float:
        """Return the difference between a monotonic time and the nearest photograph's time, s.

        A sighting from a stack has the mid-time of the stack, which may lie between two
        photographs.
        """
        near = min((abs(at - taken) for taken in self.taken), default=math.inf)
        between = any(
            before <= at <= after <= before + _GAP for before, after in pairwise(self._stacked)
        )
        return 0.0 if between else near

    async def expose(self, target: Target, view: FaceView | None = None) -> Exposed:
        """Photograph a target; see `light`."""
        return Exposed.read(await self.light(target, view))

    async def light(self, target: Target, view: FaceView | None = None) -> TargetLight:
        """Return the light on a target, occasionally next to a lamp or under a cloud."""
        true = await self._true.light(target, view)
        self._stacked.append(true.at)
        spoilt = self._spoilt.get(target.name)
        if spoilt is None and self._chance.random() < self._share * _STACKS_SPOILT:
            spoilt = self._spoiling()
        if spoilt is None:
            return true
        if spoilt.remaining > 1:
            self._spoilt[target.name] = replace(spoilt, remaining=spoilt.remaining - 1)
        else:
            self._spoilt.pop(target.name, None)
        self.lies[spoilt.kind] += 1
        rows, columns = true.values.shape
        x = true.first[0] + true.step * np.arange(columns)
        y = true.first[1] - true.step * np.arange(rows)
        across = (x - spoilt.place[0]) ** 2 + (y[:, None] - spoilt.place[1]) ** 2
        lamp = spoilt.lamp * np.exp(-0.5 * across / _LAMP**2)
        return replace(true, values=(spoilt.sun * true.values + lamp).astype(np.float32))

    def _spoiling(self) -> _Spoilt:
        chance = self._chance
        place = np.array([chance.uniform(-3.0, 3.0), chance.uniform(-3.0, 3.0)])
        if chance.random() < 0.5:
            return _Spoilt("lamp", place, 1.0, chance.uniform(0.05, 0.5), chance.choice(_LONG_RUNS))
        return _Spoilt("cloud", place, chance.uniform(0.2, 0.95), 0.0, chance.choice(_RUNS))

    async def beside(self, work: Callable[[], T]) -> T:
        """Run a computation at once and return its result."""
        return work()

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        """Return the light in a photograph: the heliostat's beam, or another light."""
        shot = await self._photographed(target, heliostat)
        if self.on_photograph is not None:
            self.on_photograph(heliostat, target.name, shot.point, shot.at)
        return shot

    async def _photographed(self, target: Target, heliostat: str) -> Shot:
        true = self._wavered(target, await self._true.photograph(target, heliostat), heliostat)
        self.taken.append(true.at)
        lie = self._lie.get(target.name)
        if lie is None and self._chance.random() < self._share:
            lie = self._begun(target, true.at)
        before, self._last[target.name] = self._last.get(target.name), true
        if lie is None:
            return true
        rest = replace(lie, remaining=lie.remaining - 1)
        if rest.remaining > 0:
            self._lie[target.name] = rest
        else:
            self._lie.pop(target.name, None)
        shown = self._shown(target, true, before, lie)
        self._last[target.name] = shown
        return shown

    def _wavered(self, target: Target, shot: Shot, heliostat: str) -> Shot:
        """Return a photograph of the beam with its random fluctuation."""
        mirrors = {mirror.heliostat: mirror for mirror in self._sight.mirrors()}
        if (mirror := mirrors.get(heliostat)) is None:  # it is covered
            return shot
        slant = float(np.linalg.norm(target.center - mirror.vertex))
        return replace(
            shot,
            point=shot.point + (slant * self._waver * self._wind.standard_normal(2)) @ target.axes,
        )

    def _begun(self, target: Target, now: float) -> _Lie:
        chance = self._chance
        size = 0.4 * np.array([target.width, target.height])
        place = size * np.array([chance.uniform(-1.0, 1.0), chance.uniform(-1.0, 1.0)])
        kind = "still" if self._standing else chance.choice(LIES)
        speed = np.zeros(2)
        if kind == "passing":
            speed = np.array([chance.uniform(-_SPEED, _SPEED), chance.uniform(-_SPEED, _SPEED)])
        runs = _LONG_RUNS if self._standing else _RUNS
        return _Lie(kind, place, speed, now, chance.choice(runs))

    def _shown(self, target: Target, true: Shot, before: Shot | None, lie: _Lie) -> Shot:
        if lie.kind == "before":
            if before is None:
                return true
            self.lies[lie.kind] += 1
            return replace(before, at=true.at)
        self.lies[lie.kind] += 1
        place = lie.place + (true.at - lie.since) * lie.speed
        return Shot(np.asarray(target.point(place)), true.at, _CENTROID)
