"""The scene of a run: site, time, heliostat positions, and keep-out volumes."""

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

import numpy as np

from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.sun import Site, vector
from heliotrope.twin.boards.outfit import (
    KEEP_OUT,
    KEEP_OUT_RADIUS,
    RECEIVER,
    STANDBY,
    Ball,
    stow_beams,
)
from heliotrope.twin.invariants.invariants import OFF
from heliotrope.twin.world.worlds import DAYS, LIMIT, drawn, works

#: Minimum elevation of the sun at the start and end of a drawn scene, rad.
_LOWEST = math.radians(8.0)
#: Elevations of the sun below which automatic control stows the field and above which it raises the
#: field again; and lowest elevation in a run that crosses one of them, since beams need a sun above
#: the horizon, rad.
_STOWS, _RAISES, _UP = math.radians(8.0), math.radians(9.0), math.radians(1.0)
#: Smallest and largest fraction of a run before the evening limit is crossed; and longest time for
#: the former and before the morning limit, s.
_BEFORE, _SOON = (0.55, 0.75), 300.0
#: Minimum distance between heliostats, and of a beam at standby from the receiver, m.
_APART, _BESIDE = 6.0, 8.0
#: Clearance of a beam at stow from the receiver and volumes, beyond their radius, because the beam
#: cannot be moved and operators change the stow position slightly, m.
_ROOM = 10.0
#: Interval at which the sun position is checked, s.
_OFTEN = 60.0
#: Time after the evening limit of a short day in which the field goes to stow, s.
_EVENING = 130.0


@dataclass(frozen=True)
class Scene:
    """Where and when a run takes place.

    Attributes
    ----------
    site, start
        Site, and UTC at the beginning.
    places
        East and north of each heliostat, m; () if `outfits` draws them.
    keep_outs
        Spheres that no beam may enter; operators aim at the first.
    targets
        Calibration targets.
    lowest
        Elevation of the sun below which automatic control stows the field, rad.
    """

    site: Site
    start: datetime
    places: tuple[tuple[float, float], ...] = ()
    keep_outs: tuple[Ball, ...] = ((KEEP_OUT, KEEP_OUT_RADIUS),)
    targets: tuple[Target, ...] = ()
    lowest: float = math.radians(8.0)


def _square(name: str, middle: tuple[float, float, float], side: float) -> Target:
    """Return a target that faces the field in the north."""
    (east, north, up), half = middle, 0.5 * side
    corners = [(east + a * half, north, up + b * half) for a, b in _CORNERS]
    return Target(name, np.array(corners), np.array(middle))


#: Corners of a square as seen from its front, that is, by a viewer in the north.
_CORNERS = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))
#: Targets for visits, below the receiver and away from the usual keep-out volume.
TARGETS = (_square("left", (2.0, 0.0, 33.0), 7.0), _square("right", (14.0, 0.0, 27.0), 7.0))
#: The usual scene; its volume lies away from all ordinary beam paths.
USUAL = Scene(Site(37.4, -6.0, 100.0, name="simulation"), datetime(2026, 6, 21, 9, tzinfo=UTC))


def scene_of(worlds: Sequence[str], seed: int, seconds: float, heliostats: int) -> Scene:
    """Return the scene of a run: drawn at random in "place" and "day", otherwise the usual one.

    The scene of "days" has the usual places, and a sun that crosses the zenith.
    """
    targets = TARGETS if works(worlds) and LIMIT not in worlds else ()
    chance = random.Random(f"place {seed}")
    if DAYS in worlds:
        site, start, lowest = _short_day(chance, seconds)
        return replace(USUAL, site=site, start=start, targets=targets, lowest=lowest)
    if not drawn(worlds):
        return replace(USUAL, targets=targets)
    site, start = (_limit if "day" in worlds else _when)(chance, seconds)
    times = np.linspace(0.0, seconds, 2 + int(seconds / _OFTEN))
    suns = np.stack([vector(start.timestamp() + float(at), site) for at in times])
    places: list[tuple[float, float]] = []
    while len(places) < heliostats:
        bearing, away = chance.uniform(-math.pi, math.pi), chance.uniform(40.0, 150.0)
        place = (away * math.sin(bearing), away * math.cos(bearing))
        apart = all(math.dist(place, other) > _APART for other in places)
        off = _clear_at_stow([place], suns, (RECEIVER, OFF))
        if apart and off and _beside(place) > _BESIDE:
            places.append(place)
    balls = tuple(_ball(chance, places, suns) for _ in range(chance.randint(1, 3)))
    return Scene(site, start, tuple(places), balls, targets)


def _clear_at_stow(places: Sequence[tuple[float, float]], suns: FloatArray, ball: Ball) -> bool:
    """Return whether all beams at stow are clear of a ball for sun vectors (S, 3)."""
    (middle, radius), (vertex, direction) = ball, stow_beams(places, suns)
    along = ((np.array(middle) - vertex) * direction).sum(axis=-1, keepdims=True)
    miss = np.linalg.norm(np.array(middle) - vertex - np.maximum(along, 0.0) * direction, axis=-1)
    return bool((miss > radius + _ROOM).all())


def _beside(place: tuple[float, float]) -> float:
    """Return how far from the receiver a beam through the standby point passes, m."""
    direction = np.subtract(STANDBY, (*place, 2.0))
    goal = np.subtract(RECEIVER, (*place, 2.0))
    return float(np.linalg.norm(goal - direction * (goal @ direction) / (direction @ direction)))


def _when(chance: random.Random, seconds: float) -> tuple[Site, datetime]:
    """Return a site and a time from which the sun stays up."""
    while True:
        site = Site(
            chance.uniform(-50.0, 50.0), chance.uniform(-180.0, 180.0), 100.0, name="simulation"
        )
        start = datetime(2026, 1, 1, tzinfo=UTC) + timedelta(seconds=chance.uniform(0.0, 3.15e7))
        ends = (start.timestamp(), start.timestamp() + seconds)
        if all(math.asin(float(vector(at, site)[2])) > _LOWEST for at in ends):
            return site, start


def _limit(chance: random.Random, seconds: float) -> tuple[Site, datetime]:
    """Return a site and a time after which the sun crosses an elevation limit, and stays up.

    In the evening the sun falls below the limit late enough for the field to be up by then. In the
    morning the sun starts below the limit, and rises above the upper limit well before the end of
    the run; short runs have evenings only.
    """
    while True:
        site, midnight = _when(chance, 0.0)
        times = midnight.timestamp() + np.arange(0.0, 86400.0, _OFTEN)
        up = np.arcsin(vector(times, site)[:, 2])
        evening = chance.random() < 0.5
        before = up[:-1] > _STOWS if evening else up[:-1] < _STOWS
        crossings = np.flatnonzero(before & ((up[1:] < _STOWS) if evening else (up[1:] > _STOWS)))
        if not len(crossings):
            continue
        share = chance.uniform(*_BEFORE)
        lead = share * min(seconds, _SOON / _BEFORE[0]) if evening else chance.uniform(5.0, _OFTEN)
        k = crossings[0]
        first = float(times[k] + _OFTEN * (_STOWS - up[k]) / (up[k + 1] - up[k])) - lead
        suns = vector(first + np.linspace(0.0, seconds, 2 + int(seconds / _OFTEN)), site)
        height = np.arcsin(suns[:, 2])
        raised = evening or bool((height[: 1 + int(0.7 * len(height))] > _RAISES).any())
        if raised and bool((height > _UP).all()):
            return site, datetime.fromtimestamp(first, UTC)


def _short_day(chance: random.Random, seconds: float) -> tuple[Site, datetime, float]:
    """Return a site, a time, and the sun elevation, rad, that limits a short day from then on.

    If the sun crosses the zenith, its elevation changes by one degree in four minutes, so that a
    whole day of the field passes in less than an hour. One day in five begins below the limit, and
    the field waits at stow until the sun is high enough.
    """
    noon = datetime(2026, 1, 1, 12, tzinfo=UTC) + timedelta(days=chance.randrange(365))
    declination = math.degrees(math.asin(float(vector(noon.timestamp(), Site(90.0, 0.0, 0.0))[2])))
    site = Site(
        declination + chance.uniform(-0.2, 0.2),
        chance.uniform(-180.0, 180.0),
        100.0,
        name="simulation",
    )
    times = noon.timestamp() + np.arange(-43200.0, 43200.0, 10.0)
    highest = float(times[int(np.argmax(vector(times, site)[:, 2]))])
    evening = seconds - _EVENING
    share = chance.uniform(0.35, 0.48) if chance.random() < 0.8 else chance.uniform(0.51, 0.53)
    start = highest - share * evening
    lowest = math.asin(float(vector(start + evening, site)[2]))
    return site, datetime.fromtimestamp(start, UTC), lowest


def _ball(chance: random.Random, places: Sequence[tuple[float, float]], suns: FloatArray) -> Ball:
    """Return a ball on an ordinary beam path, clear of mirrors, receiver and beams at stow."""
    while True:
        radius = chance.uniform(1.0, 5.0)
        east, north = chance.choice(list(places))
        goal = chance.choice([STANDBY, STANDBY, RECEIVER])
        # On a beam at standby or at its aim, below one on its path up, or anywhere about the tower.
        share, low = chance.uniform(0.3, 0.95), chance.choice([1.0, 1.0, chance.random()])
        middle = (
            east + share * (goal[0] - east),
            north + share * (goal[1] - north),
            2.0 + low * share * (goal[2] - 2.0),
        )
        if chance.random() < 0.3:
            middle = (
                chance.uniform(-30.0, 30.0), chance.uniform(-30.0, 30.0), chance.uniform(5.0, 60.0)
            )  # fmt: skip
        clear = math.dist(middle, RECEIVER) > radius + 6.0
        clear &= all(math.dist(middle, (*p, 2.0)) > radius + 8.0 for p in places)
        if clear and _clear_at_stow(places, suns, (middle, radius)):
            return middle, radius
