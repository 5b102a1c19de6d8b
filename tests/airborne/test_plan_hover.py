"""Hover patterns: every place of every mirror is seen, as often as was asked for."""

import numpy as np
import pytest

from heliotrope.airborne.mirror import ideal, reflection_points
from heliotrope.airborne.plan.airspace import Airspace
from heliotrope.airborne.plan.calibration_points import (
    CalibrationPoints,
    PointSelection,
    calibration_points,
    directions,
)
from heliotrope.airborne.plan.hover import (
    HoverMirrors,
    Pattern,
    Sampling,
    face,
    mirrors,
    pattern,
    spacing,
)
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.sightings import drone
from heliotrope.calibration.uncertainty import precision, suns_of_year
from heliotrope.errors import InputError
from heliotrope.field.formats.frames import orientation
from heliotrope.field.plant import Plant
from heliotrope.geometry import (
    MRAD,
    FloatArray,
    angle_between,
    bisector,
    direction,
    normalize,
    reflect,
    rotation,
    tangent_axes,
)
from heliotrope.mechanism.parameters import MODELS
from support.flight_case import CENTRE, HALF, staggered

NAMES = MODELS["malan8"]
TOWARDS = direction(np.radians(35.0), np.radians(40.0))


def _faced(
    plant: Plant, distance: float = 150.0, rows: slice = slice(0, 40)
) -> tuple[HoverMirrors, FloatArray, FloatArray]:
    """Mirrors of a corner of the field that look at one point, with their vertices."""
    all_mirrors = mirrors(plant)
    group = plant.groups["azel"].take(np.arange(len(plant))[rows])
    some = mirrors(Plant("some", plant.site, {"azel": group}))
    point = plant.position[rows].mean(axis=0) + distance * TOWARDS
    facing = face(some.armature, some.drives, point)
    assert facing.able.all()
    assert len(all_mirrors) == len(plant)
    return some, facing.vertex, point


def _pattern(
    some: HoverMirrors, vertex: FloatArray, point: FloatArray, sampling: Sampling
) -> Pattern:
    return pattern(vertex, some.corners, some.slopes, some.facet_area, point, TOWARDS, sampling)


def test_axes_go_through_the_point() -> None:
    plant = staggered(60)
    group = plant.groups["azel"]
    all_mirrors = mirrors(plant)
    point = np.array([40.0, 90.0, 70.0])
    facing = face(all_mirrors.armature, all_mirrors.drives, point)
    # The chain itself, not the armature, at the commanded counts.
    pose = group.calibrated.pose(facing.counts)
    away = normalize(point - pose.vertex)
    assert angle_between(pose.normal, away).max() < 1e-9
    np.testing.assert_allclose(pose.vertex, facing.vertex, rtol=0, atol=1e-9)


def test_a_wrong_normal_moves_the_reflection_by_distance_times_error() -> None:
    """On a flat mirror; by ray tracing, not by the formula of the pattern."""
    distance, error = 150.0, 5.0 * MRAD
    drone_at = np.array([0.0, 0.0, distance])
    tilted = rotation([0.0, 1.0, 0.0], error) @ np.array([0.0, 0.0, 1.0])
    shift = distance * np.tan(error)
    # The mirror's plane turns about its vertex: the place that shows the drone lies on it.
    foot = drone_at - (drone_at @ tilted) * tilted
    assert np.linalg.norm(foot) == pytest.approx(shift, rel=1e-4)
    to_drone = normalize(drone_at - foot)
    assert angle_between(reflect(to_drone, tilted), to_drone) < 1e-9
    assert shift == pytest.approx(0.75, rel=1e-3)


@pytest.mark.parametrize(("canting", "focal"), [(np.inf, np.inf), (180.0, np.inf), (120.0, 120.0)])
def test_all_of_every_mirror_is_seen(canting: float, focal: float) -> None:
    """Whatever place of a facet and whatever wrong normal: the drone is there at some time."""
    rng = np.random.default_rng(7)
    sampling = Sampling(pointing=4.0 * MRAD, focal=focal)
    some, vertex, point = _faced(staggered(200, canting))
    found = _pattern(some, vertex, point, sampling)
    plane = tangent_axes(TOWARDS)
    extent = 0.5 * found.spacing * np.array([found.columns, found.rows])
    worst = np.zeros(2)
    for i in range(len(some)):
        normal = normalize(point - vertex[i])
        axes = tangent_axes(normal)
        right, up = -axes[0], axes[1]
        for _ in range(40):
            facet, local = rng.integers(4), rng.uniform(-HALF, HALF, 2)
            local = np.where(rng.random(2) < 0.3, HALF * np.sign(local), local)
            centre = some.corners[i, facet].mean(axis=0)
            x, y = centre + local
            slope = some.slopes[i, facet] - local / (2.0 * focal)
            lean = rng.uniform(0.0, 2.0 * np.pi)
            wrong = sampling.pointing * (np.cos(lean) * right + np.sin(lean) * up)
            ray = normalize(normal + slope[0] * right + slope[1] * up + wrong)
            place = vertex[i] + x * right + y * up
            # Along its normal the place sees lamp and camera together.
            met = place + ray * ((point - place) @ TOWARDS) / (ray @ TOWARDS)
            assert angle_between(bisector(ray, normalize(met - place)), ray) < 1e-9
            off = np.abs(plane @ (met - found.center))
            worst = np.maximum(worst, off)
            assert (off <= extent + 1e-3).all()
    # And the pattern is not much larger than it must be.
    assert (worst > extent - 2.0 * found.spacing).all()


@pytest.mark.parametrize("focal", [np.inf, 300.0, 40.0])
def test_samples_on_each_facet(focal: float) -> None:
    """Counted hover point by hover point, through the place of the facet that each sees."""
    sampling = Sampling(samples=16.0, focal=focal, least_spacing=0.01)
    some, vertex, point = _faced(staggered(200))
    found = _pattern(some, vertex, point, sampling)
    assert found.samples == pytest.approx(16.0)
    for i in range(0, len(some), 8):
        slant = np.linalg.norm(point - vertex[i])
        normal = normalize(point - vertex[i])
        axes = tangent_axes(normal)
        right, up = -axes[0], axes[1]
        away = found.camera - vertex[i]
        # On a plane across the axis through the drone's place.
        across = np.stack([away @ right, away @ up], axis=-1)
        depth = away @ normal
        scale = np.abs(1.0 - slant / (2.0 * focal))
        expected = (2.0 * HALF * scale / found.spacing) ** 2
        # What was asked for is what the worst mirror gets.
        assert expected >= 15.9
        for facet in range(4):
            centre = some.corners[i, facet].mean(axis=0)
            # q = x + D s(x) solved for the place within the facet.
            local = (across - centre) / (1.0 - depth[:, None] / (2.0 * focal))
            seen = int((np.abs(local) <= HALF).all(axis=1).sum())
            assert 0.55 * expected <= seen <= 1.75 * expected


def test_least_spacing_costs_samples() -> None:
    step, samples = spacing(np.full(3, (2 * HALF) ** 2), np.full(3, 150.0), Sampling(samples=100.0))
    assert step == 0.6
    assert samples == pytest.approx((2.0 * HALF / 0.6) ** 2)


def test_centre_of_curvature_is_refused() -> None:
    with pytest.raises(InputError, match="close to twice the focal length"):
        spacing(np.ones(2), np.array([120.0, 151.0]), Sampling(focal=75.0))


def test_lamp_beside_the_camera() -> None:
    """The mirror looks half-way between them, so the camera gives way by half the offset."""
    some, vertex, point = _faced(staggered(100))
    plain = _pattern(some, vertex, point, Sampling())
    moved = _pattern(some, vertex, point, Sampling(led_offset=(0.2, 0.1, 0.05)))
    ahead = -TOWARDS
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(ahead, right)
    lamp = 0.2 * right + 0.1 * down + 0.05 * ahead
    np.testing.assert_allclose(moved.camera + 0.5 * lamp, plain.camera, rtol=0, atol=1e-9)


def test_neighbours_in_the_way_of_a_pattern() -> None:
    some, vertex, point = _faced(staggered(100))
    found = _pattern(some, vertex, point, Sampling())
    steps = np.linalg.norm(np.diff(found.camera, axis=0), axis=-1)
    np.testing.assert_allclose(steps, found.spacing, rtol=1e-9)
    np.testing.assert_allclose((found.camera - found.center) @ TOWARDS, 0.0, atol=1e-9)
    assert len(found) == found.columns * found.rows


# --- calibration points ---------------------------------------------------------------


def _chosen(selection: PointSelection, airspace: Airspace | None = None) -> CalibrationPoints:
    plant = staggered(80)
    middle = plant.groups["azel"].calibrated[np.array([40])]
    return calibration_points(
        mirrors(plant),
        np.arange(80),
        middle,
        plant.receivers[0].center,
        NAMES,
        suns_of_year(plant.site, 2026),
        airspace or Airspace(ground=plant.position),
        Sampling(),
        selection,
        "C1",
    )


def test_directions_are_apart_and_within_their_elevations() -> None:
    found = directions(
        PointSelection(min_elevation=np.radians(25.0), max_elevation=np.radians(80.0))
    )
    elevation = np.degrees(np.arcsin(found[:, 2]))
    assert elevation.min() == pytest.approx(25.0)
    assert elevation.max() == pytest.approx(80.0)
    gap = angle_between(found[:, None], found[None]) + 10.0 * np.eye(len(found))
    assert np.degrees(gap.min()) > 8.0


def test_choice_tells_more_than_chance() -> None:
    selection = PointSelection(points=12, scatter=0.0, least=0.0)
    best = _chosen(selection)
    assert len(best) == 12
    assert best.facing.able.all()
    plant = staggered(80)
    middle = plant.groups["azel"].calibrated[np.array([40])]
    known = precision(middle, NAMES)[0]
    rng = np.random.default_rng(3)
    towards = directions(selection)
    towards = towards[150.0 * towards[:, 2] < 105.0]
    centre = plant.position.mean(axis=0)

    def told(rows: FloatArray) -> float:
        points = centre + 150.0 * rows
        facing = face(middle.armature, middle.drives, points[:, None])
        zero = np.zeros(len(rows), dtype=np.intp)
        seen = drone(zero, facing.counts[:, 0], points, points, sigma=2.0 * selection.sigma)
        slope = linearise(middle[zero], seen, NAMES).jacobian
        total = known + np.einsum("map,maq->pq", slope, slope)
        return float(np.linalg.slogdet(total)[1] - np.linalg.slogdet(known)[1])

    chance = [told(towards[rng.permutation(len(towards))[:12]]) for _ in range(40)]
    assert best.plan.log_det > max(chance)
    # Twelve tell what the mirror will do: from tens of milliradians to about one.
    assert best.plan.before > 20.0 * MRAD
    assert best.plan.error[-1] < 1.5 * MRAD


def test_jacobian_of_candidates_against_finite_differences() -> None:
    found = _chosen(PointSelection(points=10, sigma=3e-4, scatter=0.0)).plan.chosen
    plant = staggered(80)
    middle = plant.groups["azel"].calibrated[np.array([40])]
    points = plant.position[:80].mean(axis=0) + np.array([0.0, 0.0, 0.0])
    where = points + 150.0 * found.sun

    def gap(step: dict[str, float]) -> FloatArray:
        moved = middle.with_parameters(step)
        pose = moved[np.zeros(len(found), dtype=np.intp)].pose(found.counts)
        return pose.normal - normalize(where - pose.vertex)

    axes = tangent_axes(found.normal)
    for p, name in enumerate(NAMES):
        h = 1e-6
        slope = (gap({name: h}) - gap({name: -h})) / (2.0 * h)
        # A normal known to 0.3 mrad in both directions.
        wanted = np.einsum("mak,mk->ma", axes, slope) / 3e-4
        np.testing.assert_allclose(found.jacobian[:, :, p], wanted, rtol=0, atol=2.0)


def test_more_points_than_unknowns() -> None:
    PointSelection(points=9).check(NAMES, "malan8")
    with pytest.raises(InputError, match="has 8 unknowns; use 9 points or more"):
        PointSelection(points=8).check(NAMES, "malan8")


def test_no_room_in_the_air() -> None:
    with pytest.raises(InputError, match="allow no position at 150 m"):
        _chosen(PointSelection(points=9), Airspace(max_height=30.0))
    fence = np.array([[-300.0, -300.0], [300.0, -300.0], [300.0, 10.0], [-300.0, 10.0]])
    with pytest.raises(InputError, match=r"C1: \d+ directions are possible for 60 calibration"):
        _chosen(PointSelection(points=60), Airspace(fence=fence))
    with pytest.raises(InputError, match="and 0 of these show 60 reflections on the median mirror"):
        _chosen(PointSelection(points=9, least=60.0))


def test_pattern_keeps_off_the_limits() -> None:
    """Directions whose pattern would leave the permitted heights are not chosen."""
    air = Airspace(max_height=100.0, min_height=40.0)
    found = _chosen(PointSelection(points=10), air)
    plant = staggered(80)
    all_mirrors = mirrors(plant)
    for k in range(len(found)):
        one = pattern(
            found.facing.vertex[k],
            all_mirrors.corners,
            all_mirrors.slopes,
            all_mirrors.facet_area,
            found.point[k],
            found.direction[k],
            Sampling(),
        )
        assert air.free(one.camera).all()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"distance": 0.0}, "distance must be above 0, not 0 m"),
        ({"pointing": 0.2}, "pointing error must be between 0 and 100 mrad, not 200"),
        ({"focal": 0.0}, "focal length must not be 0 m"),
        ({"led_offset": (1.0, np.nan, 0.0)}, "led_offset: use three numbers"),
        ({"samples": -1.0}, "samples must be above 0, not -1"),
    ],
)
def test_sampling_refuses(change: dict[str, float], text: str) -> None:
    with pytest.raises(InputError, match=text):
        Sampling(**change)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"points": 0}, "calibration points must be .* not 0"),
        ({"sigma": 0.0}, "sigma of a normal must be .* not 0.0 rad"),
        ({"min_elevation": 1.5, "max_elevation": 1.0}, "the lower first"),
        ({"share": 0.0}, "share must be .* not 0.0"),
    ],
)
def test_choosing_refuses(change: dict[str, float], text: str) -> None:
    with pytest.raises(InputError, match=text):
        PointSelection(**change)


def test_facets_of_the_case() -> None:
    some = mirrors(staggered(3, 100.0))
    np.testing.assert_allclose(some.corners[0, 0].mean(axis=0), [-CENTRE, -CENTRE])
    np.testing.assert_allclose(some.slopes[0, 0], [CENTRE / 200.0, CENTRE / 200.0], rtol=1e-9)
    np.testing.assert_allclose(some.facet_area, (2 * HALF) ** 2, rtol=1e-4)


@pytest.mark.parametrize(("canting", "focal"), [(np.inf, np.inf), (120.0, 120.0)])
def test_by_the_exact_law_every_quarter_of_every_facet_is_sampled(
    canting: float, focal: float
) -> None:
    """With the lamp where it is, mirrors that point wrong, and the law solved on the surface."""
    rng = np.random.default_rng(5)
    sampling = Sampling(
        pointing=5.0 * MRAD,
        focal=focal,
        led_offset=(0.15, 0.05, 0.0),
        samples=16.0,
        least_spacing=0.05,
    )
    plant = staggered(120, canting)
    some, vertex, point = _faced(plant)
    found = _pattern(some, vertex, point, sampling)
    group = plant.groups["azel"]
    facing = face(some.armature, some.drives, point)
    ahead = -TOWARDS
    right = normalize(np.cross(ahead, [0.0, 0.0, 1.0]))
    lamp = found.camera + 0.15 * right + 0.05 * np.cross(ahead, right)
    for i in (0, 17, 39):
        turn, place = orientation(group.calibrated[i], facing.counts[i])
        np.testing.assert_allclose(place, vertex[i], rtol=0, atol=1e-8)
        lean = rng.uniform(0.0, 2.0 * np.pi)
        wrong = rotation(turn @ np.array([np.cos(lean), np.sin(lean), 0.0]), sampling.pointing)
        seen = reflection_points(ideal(group, i, focal), wrong @ turn, place, found.camera, lamp)
        quarters = np.zeros((4, 2, 2), dtype=np.int64)
        for facet in range(4):
            local = seen.xy[seen.facet == facet] - some.corners[i, facet].mean(axis=0)
            east, north = (local > 0.0).astype(np.int64).T
            np.add.at(quarters[facet], (east, north), 1)
        # Four each are wanted.
        assert quarters.min() >= 2
        slant = np.linalg.norm(point - vertex[i])
        scale = np.abs(1.0 - slant / (2.0 * focal))
        expected = 4.0 * (2.0 * HALF * scale / found.spacing) ** 2
        assert len(seen) == pytest.approx(expected, rel=0.25)
