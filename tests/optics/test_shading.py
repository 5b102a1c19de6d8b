"""Shading and blocking: against exact references, simple shapes, and while mirrors move."""

import numpy as np
import pytest

from heliotrope.field.tower import Tower
from heliotrope.geometry import bisector, direction, normalize
from heliotrope.optics.scene import FacetTable, Mirrors, Scene
from heliotrope.optics.shading import Shading
from support import dunhuang


@pytest.mark.parametrize("sun", ["high", "mid", "low"])
def test_the_shares_of_a_real_plant_are_those_of_another_program(sun: str) -> None:
    exact = dunhuang.efficiencies()["suns"][sun]
    lit = Shading(dunhuang.scene(f"{sun}_flat")).lit
    # The reference has six digits.
    for name, share in (("shading", lit.shading), ("blocking", lit.blocking), ("both", lit.both)):
        assert np.abs(share - exact[name]).max() < 2e-6, name
        assert abs(share.mean() - exact["mean"][name]) < 2e-7, name


@pytest.mark.parametrize("name", ["high_slant", "mid_slant", "low_slant"])
def test_focused_mirrors_are_blocked_along_rays_that_converge(name: str) -> None:
    traced = dunhuang.flux(name)["mean_both"]
    # The rays' own noise is 3e-5, and the sun's size is in them.
    assert abs(Shading(dunhuang.scene(name)).lit.both.mean() - traced) < 1e-4


def row_of(places: list[list[float]], sun: np.ndarray, **more: object) -> Scene:
    """Mirrors of 2 m × 2 m that all face the sun, which they send back to itself."""
    given = np.array(places, dtype=float)
    aim = given + 1e6 * sun
    mirrors = Mirrors.of(given, sun, (2.0, 2.0), aim, focal=np.inf)
    return Scene(sun, 1000.0, mirrors, (), **more)  # type: ignore[arg-type]


def test_occluders_that_overlap_count_once() -> None:
    sun = np.array([0.0, -1.0, 0.0])
    # Seen from the sun, three squares hide a corner each, and two of them overlap.
    scene = row_of([[0, 0, 0], [1.5, -5, 0.0], [0.0, -9, 1.5], [1.5, -7, 1.0]], sun)
    shading = Shading(scene)
    # Right half metre, and upper half metre; the third lies in both.
    hidden = 0.5 * 2.0 + 0.5 * 2.0 - 0.5 * 0.5
    assert shading.lit.shading[0] == pytest.approx(1.0 - hidden / 4.0, abs=1e-12)
    assert shading.lit.both[0] == pytest.approx(1.0 - hidden / 4.0, abs=1e-12)
    area, x, y = shading.lit.moments[0, :3]
    assert area == pytest.approx(4.0 - hidden)
    # As seen from the front, east is on the right; a square of 1.5 m stays at the lower left.
    assert (x, y) == pytest.approx((-0.25, -0.25))
    assert shading.lit.moments[0, 3] == pytest.approx(1.5**2 / 12.0)
    pieces = shading.pieces(0)
    corners = np.concatenate(pieces)
    assert corners.min() == pytest.approx(-1.0)
    assert corners.max() == pytest.approx(0.5)


def test_any_number_of_occluders_is_taken() -> None:
    sun = np.array([0.0, -1.0, 0.0])
    # Sixty bars, each 1/30 m further to the right: together they hide 59/30 m + 1/60 m of 2 m.
    count = 60
    places = [[0.0, 0.0, 0.0]] + [[k / 30.0 - 1.0, -2.0 - k, 0.0] for k in range(count)]
    mirrors = Mirrors.of(
        np.array(places),
        sun,
        (np.array([2.0] + count * [1 / 60.0]), 2.0),
        np.array(places) + 1e6 * sun,
        focal=np.inf,
    )
    lit = Shading(Scene(sun, 1000.0, mirrors, ())).lit
    # The first is half beyond the left edge.
    assert lit.shading[0] == pytest.approx(1.0 - (count - 0.5) / 60.0 / 2.0, abs=1e-12)


def test_what_is_behind_the_mirror_or_the_aim_hides_nothing() -> None:
    sun = np.array([0.0, -1.0, 0.0])
    places = np.array([[0.0, 0.0, 0.0], [0.0, 5.0, 0.0], [0.0, -5.0, 0.0]])
    mirrors = Mirrors.of(places, sun, (2.0, 2.0), places + 3.0 * sun, focal=np.inf)
    lit = Shading(Scene(sun, 1000.0, mirrors, ())).lit
    assert lit.blocking == pytest.approx([1.0, 1.0, 1.0])
    assert lit.shading == pytest.approx([0.0, 0.0, 1.0])


def test_a_tower_s_shadow_is_as_wide_as_the_tower() -> None:
    sun = direction(np.radians(180.0), np.radians(45.0))
    scene = row_of([[0, 10, 0], [1.5, 10, 0], [4, 10, 0]], sun, towers=(Tower(0, 0, 1.0, -1, 50),))
    lit = Shading(scene).lit
    assert lit.shading == pytest.approx([0.0, 0.75, 1.0], abs=1e-9)


def field(seed: int, count: int = 300) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    place = np.column_stack([rng.uniform(-70, 70, (count, 2)), rng.uniform(0, 8, count)])
    place[:, 1] += 150.0
    return place, direction(np.radians(215.0), np.radians(12.0))


def poses(place: np.ndarray, sun: np.ndarray, aim: np.ndarray) -> Mirrors:
    normal = bisector(sun, normalize(aim - place))
    return Mirrors.of(place, normal, (4.0, 3.0), aim, focal=150.0)


def test_sampled_points_see_what_clipping_says() -> None:
    """Rays from a fine grid of points, against every other mirror."""
    place, sun = field(1, 120)
    mirrors = poses(place, sun, np.broadcast_to([0.0, 0.0, 60.0], place.shape))
    lit = Shading(Scene(sun, 1000.0, mirrors, ())).lit
    grid = (np.arange(60) + 0.5) / 60.0 - 0.5
    x, y = (a.ravel()[:, None] for a in np.meshgrid(4.0 * grid, 3.0 * grid))
    assert (lit.shading < 0.9).sum() > 20
    for i in np.argsort(lit.shading)[:12]:
        points = place[i] + x * mirrors.right[i] + y * mirrors.up[i]
        dark = np.zeros(len(points), dtype=bool)
        for j in range(len(place)):
            steep = mirrors.normal[j] @ sun
            along = (place[j] - points) @ mirrors.normal[j] / steep
            met = points + along[:, None] * sun - place[j]
            inside = (np.abs(met @ mirrors.right[j]) <= 2.0) & (np.abs(met @ mirrors.up[j]) <= 1.5)
            dark |= inside & (along > 0.0) & (j != i)
        assert 1.0 - dark.mean() == pytest.approx(lit.shading[i], abs=0.01)


def test_moving_some_mirrors_gives_what_a_new_scene_gives() -> None:
    place, sun = field(2)
    aim = np.tile([0.0, 0.0, 60.0], (len(place), 1))
    shading = Shading(Scene(sun, 1000.0, poses(place, sun, aim), ()))
    before = shading.lit.both.copy()
    rows = np.arange(0, len(place), 20)
    aim[rows] += [40.0, 0.0, 30.0]
    moved = poses(place, sun, aim)
    changed = shading.move(rows, moved)
    anew = Shading(Scene(sun, 1000.0, moved, ())).lit
    assert np.array_equal(shading.lit.both, anew.both)
    assert np.array_equal(shading.lit.moments, anew.moments)
    assert set(rows) < set(changed)
    assert len(changed) < len(place) // 2
    other = np.setdiff1d(np.arange(len(place)), changed)
    assert np.array_equal(before[other], anew.both[other])


def test_a_mirror_that_is_carried_elsewhere_is_found_there() -> None:
    place, sun = field(3)
    aim = np.tile([0.0, 0.0, 60.0], (len(place), 1))
    shading = Shading(Scene(sun, 1000.0, poses(place, sun, aim), ()))
    place = place.copy()
    place[7] = place[100] + 4.0 * sun
    moved = poses(place, sun, aim)
    shading.move(np.array([7]), moved)
    assert np.array_equal(shading.lit.both, Shading(Scene(sun, 1000.0, moved, ())).lit.both)


def test_facets_share_what_is_left_of_the_mirror() -> None:
    place, sun = field(4, 120)
    mirrors = poses(place, sun, np.broadcast_to([0.0, 0.0, 60.0], place.shape))
    x, y = (a.ravel() for a in np.meshgrid([-1.0, 1.0], [-0.75, 0.75]))
    center = np.stack([x, y], axis=-1)[None]
    half = np.broadcast_to([1.0, 0.75], (1, 4, 2))
    table = FacetTable(center, 0.0 * center, half, np.full((1, 4), np.inf))
    whole = Shading(Scene(sun, 1000.0, mirrors, ())).lit
    lit = Shading(Scene(sun, 1000.0, mirrors.with_facets(table), ())).lit
    areas = lit.moments[:, 0].reshape(-1, 4)
    assert areas.sum(axis=1) == pytest.approx(12.0 * whole.both)
    assert (areas.std(axis=1) > 0.1).any()


def test_a_tower_below_the_receiver_does_not_block_its_own_beams() -> None:
    """Also where an oblique mirror's nearer focus lies before the tower."""
    place, sun = field(6, 80)
    aim = np.tile([0.0, 5.0, 70.0], (len(place), 1))
    place[:, 2] = 0.0
    given = poses(place, sun, aim)
    mirrors = Mirrors.of(place, given.normal, (1.0, 1.0), aim)
    tower = Tower(0.0, 0.0, 4.5, 0.0, 60.0)
    alone = Shading(Scene(sun, 1000.0, mirrors, ())).lit
    lit = Shading(Scene(sun, 1000.0, mirrors, (), (tower,))).lit
    assert np.array_equal(lit.blocking, alone.blocking)
    # A target behind the tower is another matter.
    behind = np.tile([0.0, -40.0, 30.0], (len(place), 1))
    given = Mirrors.of(place, bisector(sun, normalize(behind - place)), (1.0, 1.0), behind)
    lit = Shading(Scene(sun, 1000.0, given, (), (tower,))).lit
    assert (lit.blocking < 0.01).any()
