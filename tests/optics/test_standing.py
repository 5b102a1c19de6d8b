"""Beams of mirrors that stand still: through the year, and together beside a receiver."""

from dataclasses import replace

import numpy as np
import pytest

from heliotrope.field.layouts import PATTERNS, lay_out, malan_plant
from heliotrope.field.volumes import Sphere, Volume
from heliotrope.geometry import direction, normalize, reflect
from heliotrope.optics import MirrorOptics
from heliotrope.optics.beam import Beams, crossing
from heliotrope.optics.standing import (
    entered_over_the_year,
    hottest,
    reach_of,
    standing_beams,
    stays_below,
    suns_of_the_year,
)
from heliotrope.plant.field.aims import BeamCheck, default_aims
from heliotrope.plant.motion.defocusing import defocused_field
from heliotrope.sun import Site, fast_vector

LATITUDE = np.radians(-28.5)
MIRROR = MirrorOptics.of(2.5, 2.0)


def test_every_sun_of_a_year_is_close_to_one_of_its_suns() -> None:
    site = Site(-28.5, 21.2, 830.0)
    suns = suns_of_the_year(LATITUDE)
    times = np.random.default_rng(1).uniform(0.0, 366.0 * 86_400.0, 400) + 1.79e9
    real = np.stack([fast_vector(time, site) for time in times])
    real = real[real[:, 2] > 0.0]
    nearest = np.arccos(np.clip((real @ suns.T).max(axis=1), -1.0, 1.0))
    assert len(real) > 150
    # A step is 1°; refraction lifts the lowest suns.
    assert np.degrees(nearest).max() < 0.75
    assert len(suns_of_the_year(np.radians(90.0))) > 1000


@pytest.mark.parametrize("seed", range(4))
def test_a_beam_that_enters_at_any_sun_of_the_year_is_found(seed: int) -> None:
    """Brute force over random suns never finds an entry that the proof calls clear."""
    random = np.random.default_rng(seed)
    count = 40
    vertex = random.uniform(-80.0, 80.0, (count, 3)) * (1.0, 1.0, 0.02)
    normal = normalize(random.normal(size=(count, 3)) + (0.0, 0.0, 2.0), "normal")
    volumes: list[Volume] = [
        Sphere("receiver", (0.0, 0.0, 40.0), 3.0),
        Sphere("low", (30.0, -20.0, 3.0), 4.0),
    ]
    mirrors = MIRROR.broadcast(count)
    entered = entered_over_the_year(vertex, normal, mirrors, volumes, float(LATITUDE), 1000.0)
    suns = suns_of_the_year(float(LATITUDE))
    suns = suns[(suns[:, 2] > 0.0)]
    suns = suns[random.integers(0, len(suns), 3000)]
    for v, volume in enumerate(volumes):
        assert isinstance(volume, Sphere)
        for i in range(count):
            light = suns[suns @ normal[i] > 0.0]
            way, to = reflect(light, normal[i]), np.array(volume.center) - vertex[i]
            along = way @ to
            off = np.sqrt(np.maximum(to @ to - along**2, 0.0))
            hit = bool(((along > 0.0) & (off < volume.radius)).any())
            assert entered[i, v] or not hit
    assert entered.any()
    assert not entered.all()


@pytest.mark.parametrize("seed", range(3))
def test_a_narrow_beam_between_the_suns_is_found(seed: int) -> None:
    """A pebble in the beam of a small and perfect mirror, at any sun of the year."""
    random = np.random.default_rng(seed)
    mirror = MirrorOptics.of(0.1, 0.1, error=0.0)
    latitude = random.uniform(-1.0, 1.0)
    tried = 0
    while tried < 40:
        declination, hour = random.uniform(-0.409, 0.409), random.uniform(-np.pi, np.pi)
        level = np.cos(declination) * np.cos(hour)
        sine, cosine = np.sin(latitude), np.cos(latitude)
        sun = np.array(
            [
                -np.cos(declination) * np.sin(hour),
                cosine * np.sin(declination) - sine * level,
                sine * np.sin(declination) + cosine * level,
            ]
        )
        normal = normalize(random.normal(size=3), "normal")
        if sun[2] < 0.02 or sun @ normal < 0.05:
            continue
        tried += 1
        pebble = Sphere("pebble", tuple(100.0 * reflect(sun, normal)), 0.01)
        found = entered_over_the_year(
            np.zeros((1, 3)), normal[None], mirror, [pebble], latitude, 200.0
        )
        assert found.all()


def test_a_mirror_to_the_ground_lights_nothing_above_it() -> None:
    vertex, down = np.array([[0.0, -50.0, 1.0]]), np.array([[0.0, 0.0, -1.0]])
    receiver = [Sphere("receiver", (0.0, 0.0, 40.0), 3.0)]
    mirrors = MIRROR.broadcast(1)
    assert not entered_over_the_year(vertex, down, mirrors, receiver, -0.5, 1000.0).any()
    # Facing up, it needs a sun in the south, 38° high: there is none far in the south.
    far_south, far_north = (
        entered_over_the_year(vertex, -down, mirrors, receiver, latitude, 1000.0).any()
        for latitude in (-0.9, 0.9)
    )
    assert not far_south
    assert far_north


def test_the_hottest_place_of_two_beams_is_where_they_cross() -> None:
    origin = np.array([[-50.0, 0.0, 0.0], [50.0, 0.0, 0.0], [0.0, -80.0, 0.0]])
    cross = np.array([0.0, 3.0, 40.0])
    way = normalize(np.array([cross, cross, (0.0, 0.0, 80.0)]) - origin, "way")
    mirrors = MirrorOptics.of(6.0, 6.0, focus=64.0).broadcast(3)
    given = Beams(origin, way, mirrors, np.full(3, 1000.0))
    found = hottest(given, np.array([0.0, 0.0, 40.0]), 60.0)
    at = crossing(given, cross, dni=1.0).irradiance[0]
    assert found.suns >= at
    assert np.linalg.norm(found.point - cross) < 2.0


def _crossed(seed: int) -> Beams:
    """Return the beams of a small field to points that lie a few metres apart."""
    random = np.random.default_rng(seed)
    count = int(random.integers(2, 40))
    origin = random.uniform((-60.0, -90.0, 0.0), (60.0, -20.0, 3.0), (count, 3))
    points = np.array([0.0, 0.0, 40.0]) + random.normal(size=(count, 3)) * random.uniform(0.3, 4.0)
    focus = np.linalg.norm(points - origin, axis=-1) * random.uniform(0.7, 1.5, count)
    width, height = random.uniform(1.0, 5.0, (2, count))
    mirrors = MirrorOptics.of(width, height, focus=focus, reflectivity=random.uniform(0.5, 1.0))
    return Beams(origin, normalize(points - origin, "way"), mirrors.broadcast(count),
                 random.uniform(70.0, 300.0, count))  # fmt: skip


@pytest.mark.parametrize("seed", range(12))
def test_no_point_of_a_fine_grid_is_brighter_than_the_bound(seed: int) -> None:
    given, center = _crossed(seed), np.array([0.0, 0.0, 40.0])
    found = hottest(given, center, 30.0)
    line = np.linspace(-10.0, 10.0, 61)
    grid = np.stack(np.meshgrid(line, line, line), axis=-1).reshape(-1, 3) + center
    # A grid near the strongest light as well, where a coarse one may miss a narrow peak.
    fine = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 21)] * 3), axis=-1).reshape(-1, 3)
    suns = np.concatenate([
        crossing(given, part, dni=1.0).irradiance
        for part in np.array_split(np.concatenate([grid, fine + found.point]), 30)
    ])  # fmt: skip
    assert suns.max() <= found.bound * (1.0 + 1e-9)
    assert found.suns >= 0.9 * suns.max()
    assert found.bound <= 1.2 * found.suns
    again = crossing(given, found.point[None], dni=1.0).irradiance[0]
    assert again == pytest.approx(found.suns)
    assert stays_below(given, center, 30.0, 1.3 * found.suns)
    assert not stays_below(given, center, 30.0, 0.99 * found.suns)


@pytest.mark.parametrize("seed", range(4))
def test_beyond_its_reach_no_light_exceeds_the_limit(seed: int) -> None:
    given, center = _crossed(seed), np.array([0.0, 0.0, 40.0])
    limit = 0.5 * hottest(given, center, 30.0).suns
    reach = reach_of(given, center, 30.0, limit)
    # The light falls off within decimetres, so the points lie along the beams.
    near = np.einsum("nk,nk->n", center - given.origin, given.direction)
    axes = given.point(near[:, None] + np.arange(-40.0, 40.0, 0.25))
    aside = np.stack(np.meshgrid(*[(-0.3, -0.1, 0.1, 0.3)] * 3), axis=-1).reshape(-1, 3)
    grid = (axes.reshape(-1, 1, 3) + aside).reshape(-1, 3)
    suns = np.concatenate(
        [crossing(given, part, dni=1.0).irradiance for part in np.array_split(grid, 60)]
    )
    away = np.linalg.norm(grid - center, axis=-1)[suns > limit]
    assert away.max(initial=0.0) <= reach
    assert reach <= away.max(initial=0.0) + 2.0
    assert reach_of(given, center, 30.0, 1e6) == 0.0


def test_a_peak_narrower_than_any_grid_is_found() -> None:
    """Two hundred beams as thin as a pencil cross far from the middle."""
    random = np.random.default_rng(7)
    origin = random.uniform((-9.0, -12.0, 0.0), (9.0, -4.0, 0.5), (200, 3))
    cross = np.array([3.3, 2.1, 11.7])
    way = normalize(cross - origin, "way")
    mirrors = MirrorOptics.of(0.02, 0.02, focus=20.0).broadcast(200)
    given = Beams(origin, way, mirrors, np.full(200, 100.0))
    found = hottest(given, np.array([0.0, 0.0, 8.0]), 20.0)
    assert found.bound >= crossing(given, cross, dni=1.0).irradiance[0]
    assert np.linalg.norm(found.point - cross) < 0.2


@pytest.mark.parametrize(("azimuth", "elevation"), [(0.0, 65.0), (90.0, 30.0)])
def test_spread_angles_of_the_defocus_part_the_beams(azimuth: float, elevation: float) -> None:
    design = malan_plant(600)
    check = BeamCheck(design, design.names)
    given = default_aims(design, design.names, check.armature.origin_1, None)
    aims, center = np.stack(list(given.values())), design.receivers[0].center
    sun = direction(np.radians(azimuth), np.radians(elevation))
    suns = {}
    for alike in (True, False):
        angles = defocused_field(check, aims, sun, alike=alike)
        found = hottest(check.together(angles, sun), center, 100.0)
        suns[alike] = found.suns
        # The place that was found has this light, by the beams of the whole field.
        beams = check.together(angles, sun)
        again = crossing(beams, found.point[None], dni=1.0).irradiance[0]
        assert again == pytest.approx(found.suns)
    assert suns[False] < 0.55 * suns[True]


def test_standing_beams_leave_as_the_mirror_reflects() -> None:
    sun = direction(0.3, 0.8)
    normal = normalize(sun + direction(2.0, 0.3), "normal")[None]
    found = standing_beams(np.zeros((1, 3)), normal, sun, MIRROR.broadcast(1), 100.0)
    np.testing.assert_allclose(found.direction[0], direction(2.0, 0.3), atol=1e-12)


def test_a_stow_position_that_lights_something_is_known() -> None:
    design = malan_plant(300)
    group = design.groups["azel"]
    names = design.names
    flat = max(one.stow[1] for one in group.machines)
    for allowed in (True, False):
        up = tuple(replace(one, stow=(0, flat), stow_lights=allowed) for one in group.machines)
        looking_up = replace(design, groups={"azel": replace(group, machines=up)})
        found = BeamCheck(looking_up, names).at_stow()
        assert bool(found) is not allowed
    assert 0 < len(found) < 300
    assert "at some time of the year; choose another stow position" in next(iter(found.values()))
    # A keep-out volume counts wherever it is.
    over = replace(design, keep_outs=(Sphere("corridor", (0.0, -60.0, 60.0), 40.0),))
    assert "corridor" in next(iter(BeamCheck(over, names).at_stow().values()))


@pytest.mark.parametrize("kind", PATTERNS)
@pytest.mark.parametrize("site", [Site(-28.5, 21.2, 830.0), Site(37.1, -2.4, 500.0)])
def test_no_mirror_of_a_generated_field_lights_anything_from_stow(kind: str, site: Site) -> None:
    design = lay_out(kind, 400, site=site)
    machines = design.groups["azel"].machines
    assert not any(one.stow_lights for one in machines)
    # The oracle is the proof of the whole beams; the layout reckons with cones of suns.
    assert BeamCheck(design, design.names).at_stow() == {}
    up = max(one.stow[1] for one in machines)
    assert 0 < sum(one.stow[1] < up for one in machines) < 400
