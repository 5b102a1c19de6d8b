"""Beam paths: distances, entries at rest and in motion, the safe way, beams that cross."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from heliotrope import optics
from heliotrope.errors import InputError
from heliotrope.field.volumes import Box, Cylinder, Prism, Sphere, Volume
from heliotrope.geometry import FloatArray, direction, normalize, rotation
from heliotrope.mechanism import kinds
from heliotrope.mechanism.tracking import track
from heliotrope.optics import MirrorOptics

L_SHAPE = ((0.0, 0.0), (20.0, 0.0), (20.0, 8.0), (8.0, 8.0), (8.0, 20.0), (0.0, 20.0))
ZOO: tuple[Volume, ...] = (
    Sphere("balloon", (30.0, -20.0, 25.0), 8.0),
    Box("hall", (-40.0, 10.0, 6.0), (30.0, 12.0, 12.0), azimuth=0.7),
    Cylinder("tower", (0.0, 0.0, 0.0), (0.0, 0.0, 60.0), 5.0),
    Cylinder("corridor", (-100.0, 40.0, 60.0), (100.0, 60.0, 120.0), 15.0),
    Prism("yard", np.array(L_SHAPE) + (10.0, 30.0), 0.0, 4.0),
)


def _inside(volume: Volume, points: FloatArray) -> np.ndarray:
    """Which points lie in a volume, from its definition alone."""
    x, y, z = np.moveaxis(points, -1, 0)
    match volume:
        case Sphere():
            return np.linalg.norm(points - np.asarray(volume.center), axis=-1) <= volume.radius
        case Box():
            # Turned back so that forwards is north.
            u = (points - np.asarray(volume.center)) @ rotation((0, 0, 1), volume.azimuth).T
            return (np.abs(u) <= 0.5 * np.asarray(volume.size)).all(axis=-1)
        case Cylinder():
            a, b = np.asarray(volume.start), np.asarray(volume.end)
            share = (points - a) @ (b - a) / ((b - a) @ (b - a))
            off = np.linalg.norm(points - a - share[..., None] * (b - a), axis=-1)
            return (share >= 0.0) & (share <= 1.0) & (off <= volume.radius)
        case Prism():
            x, y = x - 10.0, y - 30.0
            shape = (x >= 0) & (y >= 0) & (x <= 20) & (y <= 20) & ((x <= 8) | (y <= 8))
            return shape & (z >= volume.bottom) & (z <= volume.top)


@pytest.mark.parametrize("k", range(len(ZOO)), ids=[v.name for v in ZOO])
def test_clearance_has_the_sign_of_the_definition(k: int) -> None:
    rng = np.random.default_rng(k)
    points = rng.uniform((-110, -40, -10), (110, 110, 130), (20000, 3))
    # Half of them close to the volume.
    near = np.argsort(np.abs(optics.clearance(points, ZOO)[:, k]))[:200]
    points = np.concatenate([points, *(points[near] + rng.normal(0, 3, (200, 3)),) * 20])
    points[20000:] += rng.normal(0.0, 2.0, (4000, 3))
    signed = optics.clearance(points, ZOO)[:, k]
    assert np.array_equal(signed < 0.0, _inside(ZOO[k], points))
    assert 100 < (signed < 0.0).sum() < 20000


@pytest.mark.parametrize("k", range(len(ZOO)), ids=[v.name for v in ZOO])
def test_clearance_is_a_distance(k: int) -> None:
    """A ball of that radius does not reach the surface; one a little larger does."""
    rng = np.random.default_rng(10 + k)
    points = rng.uniform((-110, -40, -10), (110, 110, 130), (300, 3))
    signed = optics.clearance(points, ZOO)[:, k]
    step = 1e-4
    slope = np.stack(
        [
            (optics.clearance(points + step * e, ZOO) - optics.clearance(points - step * e, ZOO))[
                :, k
            ]
            for e in np.eye(3)
        ],
        axis=-1,
    ) / (2 * step)
    steepness = np.linalg.norm(slope, axis=-1)
    assert steepness.max() < 1.0 + 1e-6, "it grows faster than the way: a march would overshoot"
    # Away from the few edges at which the nearest point changes it is exactly 1.
    smooth = steepness > 1.0 - 1e-6
    assert smooth.mean() > 0.9
    foot = points - signed[:, None] * slope
    assert np.abs(optics.clearance(foot[smooth], ZOO)[:, k]).max() < 1e-4


def _beam(origin: tuple[float, ...], aim: tuple[float, ...], **shape: float) -> optics.Beams:
    return optics.beams(origin, aim, MirrorOptics.of(2.0, 2.0, **shape))


def test_entry_into_a_ball_by_hand() -> None:
    # The beam's edge: r = √2 + (4.65 + 5) mrad · t; the ball's centre is 10 m off the axis.
    ball = Sphere("ball", (10.0, 500.0, 0.0), 4.0)
    entry = optics.find_entries(_beam((0, 0, 0), (0, 1, 0)), [ball])
    t = float(entry.first[0, 0])

    def gap(t: float) -> float:
        return math.hypot(10.0, 500.0 - t) - 4.0 - math.sqrt(2.0) - 9.65e-3 * t

    assert abs(gap(t)) < 2e-3
    assert all(gap(s) > 0.0 for s in np.linspace(0.0, t - 0.1, 500))
    assert entry.point[0, 0] == pytest.approx([0.0, t, 0.0])
    assert abs(gap(float(entry.last[0, 0]))) < 2e-3
    assert entry.last[0, 0] > 500.0
    # Without the spread it passes.
    narrow = optics.beams((0, 0, 0), (0, 1, 0), MirrorOptics.of(2.0, 2.0, error=0.0))
    assert not optics.find_entries(narrow, [Sphere("ball", (10.0, 500.0, 0.0), 4.0)]).entered[0, 0]


def test_beams_end_at_their_reach_and_begin_at_the_mirror() -> None:
    ball = [Sphere("ball", (0.0, 200.0, 0.0), 5.0)]
    mirror = MirrorOptics.of(2.0, 2.0)
    ahead = optics.beams((0, 0, 0), (0, 100, 0), mirror, reach=190.0)
    assert not optics.find_entries(ahead, ball).entered.any()
    assert optics.find_entries(
        optics.beams((0, 0, 0), (0, 100, 0), mirror, reach=195.0), ball
    ).entered.all()
    assert not optics.find_entries(
        optics.beams((0, 0, 0), (0, -100, 0), mirror), ball
    ).entered.any()
    inside = optics.find_entries(optics.beams((0, 200, 0), (0, 300, 0), mirror), ball)
    assert inside.first[0, 0] == 0.0


@pytest.mark.parametrize("focus", [math.inf, 120.0, 40.0])
def test_entries_agree_with_points_of_the_beam(focus: float) -> None:
    """Sampled points of ideal sun beams never lie in a volume that is said to be clear."""
    rng = np.random.default_rng(3)
    origin = rng.uniform((-120, -120, 2), (120, -60, 4), (40, 3))
    aim = rng.uniform((-60, -40, 0), (60, 60, 90), (40, 3))
    given_ = optics.beams(
        origin, aim, MirrorOptics.of(3.0, 2.0, focus=focus, error=1e-9), reach=300.0
    )
    entered = optics.find_entries(given_, ZOO).entered
    # Rays: any point of the mirror, bent to the focus, plus any direction within the sun.
    rays = 150
    tangent = rng.normal(size=(40, rays, 3))
    tangent -= (
        np.sum(tangent * given_.direction[:, None], -1, keepdims=True) * (given_.direction[:, None])
    )
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    start = given_.origin[:, None] + tangent * rng.uniform(0, 0.5 * math.hypot(3, 2), (40, rays, 1))
    way = given_.direction[:, None] - (start - given_.origin[:, None]) / focus
    other = np.cross(given_.direction[:, None], tangent)
    way = normalize(way + 4.6e-3 * (rng.choice([-1, 1], (40, rays, 1)) * other))
    t = np.linspace(0.0, 290.0, 300)
    found = np.zeros_like(entered)
    for i in range(40):
        points = start[i, :, None] + t[None, :, None] * way[i, :, None]
        for v, volume in enumerate(ZOO):
            found[i, v] = _inside(volume, points).any()
    assert (entered | ~found).all(), "a ray is in a volume that the check calls clear"
    assert found.sum() > 12
    # And it is not merely careful: few entries are without a ray.
    assert (entered & ~found).mean() < 0.08


def test_strength_is_that_of_the_focus_if_it_lies_in_the_volume() -> None:
    mirror = MirrorOptics.of(10.0, 10.0, focus=300.0, reflectivity=0.9, error=0.0)
    given_ = optics.beams((0, 0, 0), (0, 300, 0), mirror)
    volumes = [Box("at focus", (0, 300, 0), (50, 60, 50)), Box("far", (0, 900, 0), (50, 60, 50))]
    strength = optics.find_entries(given_, volumes, dni=900.0).irradiance[0]
    # The solid reaches a radius ahead of its section, so the entry counts a little earlier.
    line = optics.concentration(np.linspace(270.0, 330.0, 4001), 100.0, 300.0).max()
    ahead = optics.concentration(np.linspace(260.0, 330.0, 4001), 100.0, 300.0).max()
    assert 900.0 * 0.9 * line <= strength[0] <= 900.0 * 0.9 * ahead
    peak = optics.find_entries(
        given_, [Box("all", (0, 300, 0), (50, 500, 50))], dni=900.0
    ).irradiance
    whole = optics.concentration(np.linspace(1.0, 600.0, 100_001), 100.0, 300.0).max()
    assert peak[0, 0] == pytest.approx(900.0 * 0.9 * whole, rel=1e-4)
    # Behind the focus C = (x/b − 1)⁻²: at the face, 870 m, 1/1.9²; the solid, 21 m wide, is
    # there a radius earlier.
    assert 900.0 * 0.9 / 1.9**2 < strength[1] < 900.0 * 0.9 / 1.8**2
    assert optics.find_entries(given_, [Sphere("aside", (0, 0, 80), 1)]).irradiance[0, 0] == 0.0


def test_concentration_by_hand() -> None:
    # Flat: never more than one sun; far away R² / (x β)².
    assert optics.concentration(5.0, 4.0, math.inf) == 1.0
    far = optics.concentration(2000.0, 4.0, math.inf)
    assert far == pytest.approx((4.0 / math.pi) / (2000.0 * 4.65e-3) ** 2)
    # In the focus the mirror is all sun: area over image area.
    at_focus = optics.concentration(300.0, 100.0, 300.0)
    assert at_focus == pytest.approx(100.0 / (math.pi * (300.0 * 4.65e-3) ** 2))
    # Half-way a beam of half the diameter is four suns.
    assert optics.concentration(150.0, 100.0, 300.0) == pytest.approx(4.0)


# Motion

SUN = direction(math.radians(200.0), math.radians(50.0))


def _field(count: int, seed: int) -> tuple[kinds.Mechanism, FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    position = rng.uniform((-120, -130, 0), (120, -50, 0), (count, 3))
    field = kinds.azimuth_elevation(position, pivot_height=2.0, pivot_offset=0.4)
    start = rng.uniform((-2.0, 0.3), (2.0, 1.6), (count, 2))
    goal = start + rng.uniform(-1.0, 1.0, (count, 2))
    return field, start, goal


def test_motion_misses_nothing_that_fine_samples_find() -> None:
    field, start, goal = _field(80, seed=5)
    mirrors = MirrorOptics.of(3.0, 2.0, focus=150.0)
    path = np.stack([start, goal], axis=1)
    motion = optics.sweep(field.armature, path, SUN, mirrors, ZOO, reach=400.0)
    found = np.zeros((80, len(ZOO)), dtype=bool)
    first = np.full((80, len(ZOO)), np.inf)
    for share in np.linspace(0.0, 1.0, 401):
        normal, vertex = field.armature.pose(start + share * (goal - start))
        cosine = normal @ SUN
        beam = optics.Beams(
            vertex, 2 * cosine[:, None] * normal - SUN, mirrors.broadcast(80), np.full(80, 400.0)
        )
        now = optics.find_entries(beam, ZOO).entered & (cosine > 0.0)[:, None]
        first = np.where(now & ~found, share, first)
        found |= now
    assert found.sum() > 25
    assert (motion.entered | ~found).all()
    # It enters no later than the samples say, and not much earlier.
    assert (motion.at[found] <= first[found] + 1e-9).all()
    assert np.quantile(first[found] - motion.at[found], 0.9) < 0.02
    assert (motion.entered & ~found).mean() < 0.02
    assert motion.irradiance[motion.entered].min() > 0.0
    assert (motion.irradiance[~motion.entered] == 0.0).all()


def test_a_flash_between_two_samples_is_found() -> None:
    """A thin pole that a fast sweep passes in 0.2 % of its time."""
    pole = Cylinder("pole", (0.0, 300.0, 0.0), (0.0, 300.0, 20.0), 0.05)
    mechanism = kinds.azimuth_elevation((0.0, 0.0, 0.0), pivot_height=10.0)
    sun = direction(0.0, 0.4)
    mirror = MirrorOptics.of(0.2, 0.2, error=0.0)
    angles = np.radians([[-40.0, 11.46], [40.0, 11.46]])
    motion = optics.sweep(mechanism.armature, angles, sun, mirror, [pole])
    assert motion.entered[0, 0]
    coarse = [
        optics.find_entries(
            optics.Beams(v[None], (2 * (n @ sun) * n - sun)[None], mirror, np.array([3000.0])),
            [pole],
        ).entered.any()
        for n, v in (
            mechanism.armature.pose(angles[0] + s * (angles[1] - angles[0]))
            for s in np.linspace(0.0, 1.0, 50)
        )
    ]
    assert not any(coarse), "the case must be one that 50 samples miss"


def test_a_finer_resolution_only_removes_entries() -> None:
    field, start, goal = _field(60, seed=8)
    path = np.stack([start, goal], axis=1)
    mirrors = MirrorOptics.of(3.0, 2.0)
    coarse, fine = (
        optics.sweep(field.armature, path, SUN, mirrors, ZOO, resolution=r).entered
        for r in (0.05, 1e-3)
    )
    assert (coarse | ~fine).all()
    assert coarse.sum() > fine.sum()


def test_a_mirror_that_shows_its_back_sends_no_beam() -> None:
    mechanism = kinds.azimuth_elevation((0.0, 0.0, 0.0))
    down = np.radians([[0.0, -89.0], [180.0, -60.0]])
    everything = [Sphere("all", (0.0, 0.0, 0.0), 500.0)]
    mirrors = MirrorOptics.of(3.0, 3.0)
    noon = direction(0.0, math.radians(80.0))
    assert not optics.sweep(mechanism.armature, down, noon, mirrors, everything).entered.any()
    assert optics.sweep(mechanism.armature, -down, noon, mirrors, everything).entered.all()


def test_a_grazing_beam_at_the_end_of_a_turn_is_found() -> None:
    """The mirror shows its back for most of the turn; at its end light grazes the front."""
    mechanism = kinds.azimuth_elevation((0.0, 0.0, 100.0))
    noon = direction(0.0, math.radians(60.0))
    behind = [Sphere("behind", tuple(np.array([0.0, 0.0, 100.0]) - 60.0 * noon), 6.0)]
    # The normal passes the plane across the sun's direction at an elevation of −30°.
    turn = np.radians([[0.0, -33.4], [0.0, -27.7]])
    mirrors = MirrorOptics.of(2.0, 2.0)
    assert optics.sweep(mechanism.armature, turn, noon, mirrors, behind).entered.all()
    back = np.radians([[0.0, -36.0], [0.0, -30.5]])
    assert not optics.sweep(mechanism.armature, back, noon, mirrors, behind).entered.any()


def test_a_path_of_one_pose_is_that_pose() -> None:
    field, start, _ = _field(40, seed=9)
    mirrors = MirrorOptics.of(3.0, 2.0)
    motion = optics.sweep(field.armature, start[:, None], SUN, mirrors, ZOO)
    normal, vertex = field.armature.pose(start)
    cosine = normal @ SUN
    beam = optics.Beams(
        vertex, 2 * cosine[:, None] * normal - SUN, mirrors.broadcast(40), np.full(40, 3000.0)
    )
    rest = optics.find_entries(beam, ZOO)
    lit = cosine > 0.0
    assert lit.sum() > 20
    assert np.array_equal(motion.entered[lit], rest.entered[lit])
    both = motion.entered & lit[:, None]
    assert motion.distance[both] == pytest.approx(rest.first[both])
    assert motion.irradiance[both] == pytest.approx(rest.irradiance[both])
    assert not motion.entered[~lit].any()


# The safe way

TOWER = Cylinder("tower", (0.0, 0.0, 4.0), (0.0, 0.0, 52.0), 4.0)
RECEIVER = Sphere("receiver", (0.0, 0.0, 50.0), 5.0)
FOOT, STANDBY = (14.0, 0.0, 0.0), (14.0, 0.0, 48.0)


def _way(volumes: tuple[Volume, ...], east: float = 30.0) -> optics.Way:
    mechanism = kinds.azimuth_elevation((east, -80.0, 0.0), pivot_height=2.0, pivot_offset=0.2)
    noon = direction(math.radians(190.0), math.radians(55.0))
    return optics.safe_way(
        mechanism.armature,
        (0.0, math.pi / 2),
        noon,
        FOOT,
        STANDBY,
        MirrorOptics.of(2.0, 2.0),
        volumes,
    )


def test_the_safe_way_turns_azimuth_first_and_follows_the_ground() -> None:
    way = _way((TOWER, RECEIVER))
    assert way.clear, way.text
    stow, turned, lowered = way.path[:3]
    assert turned[0] != stow[0]
    assert turned[1] == stow[1], "azimuth first"
    assert lowered[0] == turned[0], "elevation last"
    aims = way.aims
    assert aims[-1] == pytest.approx(STANDBY)
    corner = int(np.argmin(np.linalg.norm(aims - np.array(FOOT), axis=1)))
    assert np.abs(aims[corner] - FOOT).max() < 1e-9
    assert np.abs(aims[: corner + 1, 2]).max() == 0.0, "along the ground"
    assert (np.diff(aims[corner:, 2]) > 0.0).all(), "and up"
    assert np.abs(aims[corner:, :2] - FOOT[:2]).max() < 1e-9
    sight = normalize(aims - np.array([30.0, -80.0, 2.0]))
    assert np.arccos(np.clip(np.sum(sight[1:] * sight[:-1], -1), -1, 1)).max() < 0.025
    # The beams really go to the aims.
    mechanism = kinds.azimuth_elevation((30.0, -80.0, 0.0), pivot_height=2.0, pivot_offset=0.2)
    normal, vertex = mechanism.armature.pose(way.path[2:])
    noon = direction(math.radians(190.0), math.radians(55.0))
    beam = 2 * (normal @ noon)[:, None] * normal - noon
    assert np.abs(beam - normalize(aims - vertex)).max() < 1e-9
    assert np.array_equal(way.back, way.path[::-1])


def test_the_way_leaves_the_tower_aside_where_straight_ahead_is_not_clear() -> None:
    """Tilted down straight ahead of the tower, the beam would sweep down over the receiver."""
    place = (80.0, 0.0, 0.0)
    mechanism = kinds.azimuth_elevation(place, pivot_height=2.0)
    sun = direction(math.radians(95.0), math.radians(55.0))
    mirror, stow = MirrorOptics.of(2.0, 2.0), (0.0, math.pi / 2)
    straight = track(mechanism, sun, (70.0, 0.0, 0.0))
    goal = straight.best_angles
    path = np.array([[goal[0], math.pi / 2], goal])
    assert optics.sweep(mechanism.armature, path, sun, mirror, [RECEIVER]).entered.any()
    foot, standby = (14.0, 3.0, 0.0), (14.0, 12.0, 48.0)
    way = optics.safe_way(mechanism.armature, stow, sun, foot, standby, mirror, [RECEIVER])
    assert way.clear, way.text
    ahead = way.aims[0] - place
    assert abs(math.degrees(math.atan2(ahead[1], -ahead[0]))) > 15.0


def test_a_way_that_is_barred_says_what_bars_it() -> None:
    lid = Prism("airfield", ((-4000, -4000), (4000, -4000), (4000, 4000), (-4000, 4000)), 20, 600)
    way = _way((TOWER, lid))
    assert not way.clear
    assert "the beam enters airfield" in way.text
    assert "turning the azimuth" in way.text
    gate = Box("gate", (14.0, 0.0, 30.0), (6.0, 6.0, 4.0))
    way = _way((gate,))
    assert "the beam enters gate" in way.text
    assert "at aim" in way.text


def test_aims_out_of_reach_are_told() -> None:
    mechanism = kinds.azimuth_elevation((30.0, -80.0, 0.0), pivot_height=2.0)
    from heliotrope.mechanism.drives import Drive, direct

    short = direct(min_angle=-0.2, max_angle=0.2)
    high = direct(min_angle=0.0, max_angle=1.6)
    drives = Drive(np.stack([short.table, high.table]))
    way = optics.safe_way(
        mechanism.armature,
        (0.0, 1.57),
        direction(1.5, 0.6),
        FOOT,
        STANDBY,
        MirrorOptics.of(2, 2),
        [],
        drives=drives,
    )
    assert not way.clear
    assert "a stop is in the way" in way.text


# Beams that cross


def _shining(
    mirror_radius: float,
    focus: float,
    point: FloatArray,
    rng: np.random.Generator,
    half_angle: float,
) -> float:
    """Concentration by sampling the mirror disk: light at distance point[1] beside the axis."""
    n = 400_000
    r, a = mirror_radius * np.sqrt(rng.random(n)), rng.uniform(0, 2 * np.pi, n)
    u = np.stack([r * np.cos(a), r * np.sin(a)], axis=-1)
    x = point[1]
    landing = u * (1.0 - x / focus)
    seen = np.linalg.norm(landing - point[[0, 2]], axis=-1) <= x * half_angle
    return float(seen.mean()) * mirror_radius**2 / (x * half_angle) ** 2


@pytest.mark.parametrize("focus", [math.inf, 100.0, 60.0])
@pytest.mark.parametrize("off", [0.0, 0.4, 0.9, 1.6])
def test_crossing_agrees_with_sampled_mirrors(focus: float, off: float) -> None:
    rng = np.random.default_rng(11)
    mirror = MirrorOptics.of(2.0, 2.0, focus=focus)
    given_ = optics.beams((0, 0, 0), (0, 1, 0), mirror)
    point = np.array([off, 100.0, 0.0])
    found = optics.crossing(given_, point)
    wanted = _shining(math.sqrt(4.0 / math.pi), focus, point, rng, optics.SUN_RADIUS)
    assert found.concentration[0, 0] == pytest.approx(wanted, abs=0.03)


@pytest.mark.parametrize("focus", [math.inf, 150.0, 60.0])
def test_no_light_is_lost_or_made(focus: float) -> None:
    """Over a section of the beam the concentration adds up to the mirror's area."""
    given_ = optics.beams((0, 0, 0), (0, 1, 0), MirrorOptics.of(2.0, 1.5, focus=focus))
    line = np.linspace(-4.0, 4.0, 161)
    x, z = np.meshgrid(line, line)
    points = np.stack([x, np.full_like(x, 120.0), z], axis=-1).reshape(-1, 3)
    total = optics.crossing(given_, points).concentration.sum() * (line[1] - line[0]) ** 2
    assert total == pytest.approx(3.0, rel=0.01)


def test_crossing_sums_the_beams_that_are_there() -> None:
    origin = np.array([[0.0, -100.0, 0.0], [20.0, -100.0, 0.0], [-20.0, -100.0, 0.0]])
    aims = np.array([[0.0, 0.0, 40.0], [0.0, 0.0, 40.0], [300.0, 0.0, 40.0]])
    mirrors = MirrorOptics.of(2.0, 2.0, reflectivity=[1.0, 0.5, 1.0])
    here = optics.crossing(
        optics.beams(origin, aims, mirrors), [[0.0, 0.0, 40.0], [0.0, 0.0, 90.0]], dni=800.0
    )
    assert here.count.tolist() == [2, 0]
    slant = math.hypot(100.0, 40.0), math.sqrt(100**2 + 40**2 + 20**2)
    each = [float(optics.concentration(s, 4.0, math.inf)) for s in slant]
    assert here.irradiance[0] == pytest.approx(800.0 * (each[0] + 0.5 * each[1]))
    assert here.irradiance[1] == 0.0


@given(st.floats(0.1, 5.0), st.floats(20.0, 2000.0), st.floats(5.0, 3000.0), st.floats(0.0, 40.0))
def test_beside_the_axis_it_is_never_stronger(
    size: float, focus: float, distance: float, off: float
) -> None:
    given_ = optics.beams((0, 0, 0), (0, 1, 0), MirrorOptics.of(size, size, focus=focus))
    found = optics.crossing(given_, (off, distance, 0.0)).concentration[0, 0]
    axis = float(optics.concentration(distance, size * size, focus))
    assert 0.0 <= found <= axis * (1.0 + 1e-6) + 1e-9 or abs(1 - distance / focus) < 2e-4


def test_what_cannot_be_is_refused() -> None:
    refusals = (
        (lambda: Sphere("a", (0, 0, 0), 0.0), "volume a: radius must be above 0"),
        (lambda: Sphere("a", (0, 0, math.nan), 1.0), "volume a: center.* is not a finite number"),
        (
            lambda: Sphere("a", ((0, 0, 0),), 1.0),
            r"volume a: center must be 3 numbers, but has the shape \(1, 3\)",
        ),
        (lambda: Box("b", (0, 0, 0), (1, -2, 1)), "volume b: size must be above 0"),
        (lambda: Box("b", (0, 0, 0), (1, 2, 1), math.inf), "volume b: azimuth inf rad"),
        (lambda: Cylinder("c", (1, 1, 1), (1, 1, 1), 2.0), "volume c: its two ends coincide"),
        (lambda: Prism("d", ((0, 0), (1, 0)), 0, 1), "volume d: corners have the shape"),
        (lambda: Prism("d", ((0, 0), (1, 0), (1, math.nan)), 0, 1), "d: a corner or height is not"),
        (
            lambda: Prism("d", ((0, 0), (1, 0), (1, 1)), 3, 1),
            r"top \(1 m\) must be above bottom \(3 m\)",
        ),
        (lambda: Prism("d", ((0, 0), (0, 0), (1, 1)), 0, 1), "two neighbouring corners coincide"),
        (lambda: MirrorOptics.of(0.0, 1.0), "mirrors: width must be above 0 and finite, not 0.0 m"),
        (
            lambda: MirrorOptics.of(1.0, 1.0, reflectivity=1.5),
            "reflectivity must be .* at most 1, not 1.5",
        ),
        (lambda: MirrorOptics.of(1.0, 1.0, focus=-3.0), "a focus must be above 0 m"),
        (lambda: MirrorOptics.of(1.0, 1.0, error=0.6), "an error must be between 0 and 0.5 rad"),
        (lambda: MirrorOptics.of(np.ones((2, 2)), 1.0), "expected numbers or"),
        (lambda: MirrorOptics.of([1.0, 1.0], 1.0).broadcast(3), "mirrors: got 2 for 3 beams"),
        (
            lambda: optics.beams((0, 0, 0), (0, 0, 0), MirrorOptics.of(1, 1)),
            "length 0 has no direction",
        ),
        (
            lambda: optics.beams(np.zeros((2, 2, 3)), (0, 1, 0), MirrorOptics.of(1, 1)),
            "expected .N, 3.",
        ),
        (
            lambda: optics.beams((0, 0, 0), (0, 1, 0), MirrorOptics.of(1, 1), reach=-1.0),
            "reach -1.0 m",
        ),
    )
    for call, text in refusals:
        with pytest.raises(InputError, match=text):
            call()
    arm, mirror = kinds.azimuth_elevation((0, 0, 0)).armature, MirrorOptics.of(1, 1)
    with pytest.raises(InputError, match="pass finite joint angles"):
        optics.sweep(arm, (0.0, 1.0), SUN, mirror, ZOO)
    with pytest.raises(InputError, match=r"resolution must be above 0, not 0\.0 rad"):
        optics.sweep(arm, [(0.0, 1.0)], SUN, mirror, ZOO, resolution=0.0)
    many = kinds.azimuth_elevation(np.zeros((2, 3))).armature
    with pytest.raises(InputError, match="3 paths for 2 heliostats"):
        optics.sweep(many, np.zeros((3, 2, 2)), SUN, mirror, ZOO)
    with pytest.raises(InputError, match="pass one heliostat"):
        optics.safe_way(many, (0, 1), SUN, FOOT, STANDBY, mirror, ZOO)
    with pytest.raises(InputError, match="pass the 2 joint angles"):
        optics.safe_way(arm, (0, 1, 2), SUN, FOOT, STANDBY, mirror, ZOO)
    with pytest.raises(InputError, match=r"first_distance must be above 0, not 0\.0 m"):
        optics.safe_way(arm, (0, 1), SUN, FOOT, STANDBY, mirror, ZOO, first_distance=0.0)
