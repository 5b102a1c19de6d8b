"""Surfaces of mirrors, and where they show a lamp to a camera."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from heliotrope.airborne.mirror import (
    MirrorShape,
    ideal,
    measured_normal,
    rectangle,
    reflection_points,
    tiled,
)
from heliotrope.airborne.slopes import smooth_slopes
from heliotrope.errors import FormatError, InputError
from heliotrope.field.formats.frames import orientation
from heliotrope.field.formats.slopes import read_slopes, write_slopes
from heliotrope.field.heliostats import Facets, Heliostats
from heliotrope.geometry import MRAD, angle_between, normalize, rotation
from heliotrope.mechanism.kinds import azimuth_elevation

VERTEX = np.array([40.0, 120.0, 3.0])


def looking(direction: np.ndarray) -> np.ndarray:
    """Rotation from concentrator coordinates to ENU of a mirror that looks along a direction."""
    z = normalize(direction)
    x = normalize(np.cross((0.0, 0.0, 1.0), z))
    return np.stack([x, np.cross(z, x), z], axis=-1)


def four(rms: float = 0.8 * MRAD, seed: int = 1) -> MirrorShape:
    shape = tiled(2, 2, 1.6, 1.25, gap=0.02, focal=150.0)
    return shape.with_slopes(smooth_slopes(shape, np.random.default_rng(seed), rms))


def hover(turn: np.ndarray, count: int, distance: float = 150.0, seed: int = 2) -> np.ndarray:
    rng = np.random.default_rng(seed)
    local = np.c_[rng.uniform(-0.8, 0.8, (count, 2)), np.full(count, distance)]
    return VERTEX + local @ turn.T


def test_a_flat_mirror_shows_the_lamp_at_the_foot_of_the_perpendicular() -> None:
    shape, turn = rectangle(4.0, 3.0), looking(np.array([0.1, -0.5, 1.0]))
    camera = VERTEX + turn @ np.array([0.7, -0.4, 100.0])
    found = reflection_points(shape, turn, VERTEX, camera, camera)
    np.testing.assert_allclose(found.xy, [[0.7, -0.4]], atol=1e-9)
    np.testing.assert_allclose(found.point, [VERTEX + turn @ [0.7, -0.4, 0.0]], 1e-12)
    # A lamp at the same distance as the camera: half-way between.
    led = VERTEX + turn @ np.array([0.9, -0.4, 100.0])
    found = reflection_points(shape, turn, VERTEX, camera, led)
    np.testing.assert_allclose(found.xy, [[0.8, -0.4]], atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    rms=st.sampled_from([0.0, 0.3, 0.8, 2.0]),
    distance=st.floats(40.0, 250.0),
)
def test_the_law_holds_at_every_reflection(seed: int, rms: float, distance: float) -> None:
    shape = four(rms * MRAD, seed)
    turn = looking(np.array([0.3, -0.6, 0.7]))
    camera = hover(turn, 12, distance, seed)
    led = camera + turn @ np.array([0.12, -0.05, 0.02])
    found = reflection_points(shape, turn, VERTEX, camera, led)
    wanted = measured_normal(found.point, camera[found.position], led[found.position])
    normal = shape.normal_at(found.facet, found.xy) @ turn.T
    assert (angle_between(wanted, normal) < 1e-11).all()
    assert (shape.facet_at(found.xy) == found.facet).all()
    assert (np.diff(found.position) >= 0).all()


def dense_count(shape: MirrorShape, turn: np.ndarray, camera: np.ndarray, led: np.ndarray) -> int:
    """Reflections by the index of the field g on a fine grid: the sum of its turns is the count.

    Roots have index +1 or −1; the sum of the indices is counted on the outline, which no
    root-finder is needed for.
    """
    index = 0
    for k in range(len(shape)):
        s = np.linspace(-1.0, 1.0, 1500, endpoint=False)
        one = np.ones_like(s)
        edge = np.concatenate([np.c_[s, -one], np.c_[one, s], np.c_[-s, one], np.c_[-one, -s]])
        facet = np.full(len(edge), k)
        points = shape.on_facet(facet, edge * shape.half_size[k] * (1.0 - 1e-9))
        normal = shape.normal_at(facet, points[:, :2]) @ turn.T
        wanted = measured_normal(VERTEX + points @ turn.T, camera, led)
        g = (wanted - normal) @ turn[:, :2]
        angle = np.unwrap(np.arctan2(g[:, 1], g[:, 0]))
        close = np.unwrap(np.arctan2(g[[-1, 0], 1], g[[-1, 0], 0]))
        index += round((angle[-1] - angle[0] + close[1] - close[0]) / (2.0 * np.pi))
    return index


def signs(shape: MirrorShape, turn: np.ndarray, camera: np.ndarray, led: np.ndarray) -> int:
    """Sum of the indices of the reflections found, from finite differences."""
    found = reflection_points(shape, turn, VERTEX, camera, led)
    total, step = 0, 1e-6
    for k, xy in zip(found.facet, found.xy, strict=True):
        moved = xy + step * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        facet = np.full(4, k)
        points = shape.point_at(facet, moved)
        gap = measured_normal(VERTEX + points @ turn.T, camera, led) @ turn
        gap = (gap - shape.normal_at(facet, moved))[:, :2]
        total += int(np.sign(np.linalg.det(np.stack([gap[0] - gap[1], gap[2] - gap[3]]))))
    return total


@pytest.mark.parametrize("distance", [60.0, 120.0, 250.0])
def test_no_reflection_is_missed(distance: float) -> None:
    turn = looking(np.array([0.3, -0.6, 0.7]))
    most = 0
    for seed in range(6):
        shape = four(1.5 * MRAD, seed)
        camera = hover(turn, 1, distance, seed)[0]
        led = camera + turn @ np.array([0.12, 0.0, 0.0])
        most = max(most, len(reflection_points(shape, turn, VERTEX, camera, led)))
        assert signs(shape, turn, camera, led) == dense_count(shape, turn, camera, led)
    assert most >= 2 or distance < 100.0


def test_positions_are_independent_of_each_other() -> None:
    shape, turn = four(), looking(np.array([0.3, -0.6, 0.7]))
    camera = hover(turn, 30)
    together = reflection_points(shape, turn, VERTEX, camera, camera)
    for p in (0, 17, 29):
        alone = reflection_points(shape, turn, VERTEX, camera[p], camera[p])
        np.testing.assert_allclose(together.xy[together.position == p], alone.xy, atol=1e-10)
    assert len(together) > 20


def test_nothing_is_seen_from_behind_or_from_afar() -> None:
    shape, turn = four(), looking(np.array([0.3, -0.6, 0.7]))
    behind = VERTEX - 100.0 * turn[:, 2]
    beside = VERTEX + turn @ np.array([30.0, 0.0, 100.0])
    assert len(reflection_points(shape, turn, VERTEX, behind, behind)) == 0
    assert len(reflection_points(shape, turn, VERTEX, beside, beside)) == 0


def test_normals_belong_to_the_surface() -> None:
    shape = tiled(2, 2, 1.6, 1.25, focal=30.0).canted([3 * MRAD, -2 * MRAD])
    facet, xy = np.array([0, 1, 2, 3]), np.array([[-0.5, -0.3], [0.2, -0.9], [-1.1, 0.4], [1, 1]])
    step = 1e-5
    east, north = (
        (shape.point_at(facet, xy + d) - shape.point_at(facet, xy - d)) / (2 * step)
        for d in (np.array([step, 0]), np.array([0, step]))
    )
    np.testing.assert_allclose(shape.normal_at(facet, xy), normalize(np.cross(east, north)), 1e-8)
    np.testing.assert_allclose(shape.point_at(facet, xy)[:, :2], xy, atol=1e-12)


def test_a_slope_upwards_to_the_right_leans_the_normal_to_the_left() -> None:
    shape = rectangle(2.0, 2.0).with_slopes(np.full((1, 4, 4, 2), [2e-3, -1e-3]))
    normal = shape.normal_at([0], [[0.3, 0.4]])[0]
    np.testing.assert_allclose(normal[:2] / normal[2], [-2e-3, 1e-3])
    assert (shape.normal_at([0], [[0.3, 0.4]], slopes=False)[0] == [0, 0, 1]).all()
    assert (replace(shape, slope=None).normal_at([0], [[0.3, 0.4]])[0] == [0, 0, 1]).all()


def test_canted_facets_look_at_one_point() -> None:
    shape = tiled(3, 2, 1.2, 1.0, gap=0.05, focal=60.0)
    towards = normalize(np.array([0.0, 0.0, 120.0]) - shape.center)
    assert (angle_between(towards, shape.axes[:, 2]) < 1e-4 * MRAD * 100).all()
    assert shape.facet_at([[1.2, 0.5], [0.0, 0.0], [9.0, 0.0]]).tolist() == [5, -1, -1]
    np.testing.assert_allclose(shape.corners[0, 0, :2], [-1.85, -1.025], atol=1e-3)


def test_the_field_gives_the_ideal_mirror_and_its_orientation() -> None:
    mechanism = azimuth_elevation(np.array([VERTEX, VERTEX + 10.0]), pivot_offset=0.2)
    facets = Facets(
        np.zeros((2, 1, 3)),
        np.tile([1.5, 0.0, 0.0], (2, 1, 1)),
        np.tile([0.0, 1.0, 0.0], (2, 1, 1)),
    )
    group = Heliostats(("A", "B"), mechanism, np.array([3.0, 4.0]), np.array([2.0, 2.0]))
    one = Heliostats(("A", "B"), mechanism, np.array([3.0, 3.0]), np.array([2.0, 2.0]), facets)
    np.testing.assert_allclose(ideal(one, 0).corners, ideal(group, 0).corners)
    assert ideal(group, 1).half_size[0, 0] == 2.0
    counts = np.array([[0.4, 0.7], [3.0, 1.2]])
    turn, vertex = orientation(mechanism, counts)
    pose = mechanism.pose(counts)
    np.testing.assert_allclose(turn[..., 2], pose.normal, atol=1e-15)
    np.testing.assert_allclose(vertex, pose.vertex)
    np.testing.assert_allclose(
        turn @ np.swapaxes(turn, -1, -2), np.tile(np.eye(3), (2, 1, 1)), atol=1e-14
    )
    # An azimuth-elevation mirror keeps its lower edge level, and its top on top.
    np.testing.assert_allclose(turn[..., 2, 0], 0.0, atol=1e-15)
    assert (turn[..., 2, 1] > 0.0).all()
    np.testing.assert_allclose(np.linalg.det(turn), 1.0)


def test_slope_maps_are_read_as_they_were_written(tmp_path: Path) -> None:
    slope = four().slope
    assert slope is not None
    for name in ("map.npz", "map.csv"):
        write_slopes(tmp_path / name, slope)
        np.testing.assert_allclose(read_slopes(tmp_path / name, 4), slope, rtol=1e-14, atol=1e-20)
    holes = slope.copy()
    holes[2, 3, 4] = np.nan
    write_slopes(tmp_path / "holes.npz", holes)
    filled = read_slopes(tmp_path / "holes.npz", 4)
    assert any(
        (filled[2, 3, 4] == slope[2, i, j]).all() for i, j in ((2, 4), (4, 4), (3, 3), (3, 5))
    )


def test_random_surfaces_are_surfaces() -> None:
    shape = four(1e-3, 5)
    slope = shape.slope
    assert slope is not None
    np.testing.assert_allclose(np.sqrt(np.mean(slope**2, axis=(0, 1, 2))), 1e-3)
    np.testing.assert_allclose(slope.mean(axis=(1, 2)), 0.0, atol=1e-15)
    # The curl of a surface's slope is 0: both mixed derivatives agree.
    step = 2.0 * shape.half_size[0] / 24
    by_v = np.gradient(slope[0, ..., 0], step[1], axis=0)[2:-2, 2:-2]
    by_u = np.gradient(slope[0, ..., 1], step[0], axis=1)[2:-2, 2:-2]
    assert np.abs(by_v - by_u).max() < 0.2 * np.abs(by_v).max()


@pytest.mark.parametrize(
    ("slope", "text"),
    [
        (np.zeros((3, 4, 4, 2)), "the map has 3 facets, but the mirror has 4"),
        (np.full((4, 4, 4, 2), 0.4), "400 mrad is above 100 mrad"),
        (np.full((4, 4, 4, 2), np.nan), "facet 0: 100 % of its map is missing"),
        (np.zeros((4, 4, 2)), "slopes must have the shape"),
    ],
)
def test_wrong_slope_maps_are_refused(slope: np.ndarray, text: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "map.npz", slope=slope)
    with pytest.raises(FormatError, match=text):
        read_slopes(tmp_path / "map.npz", 4)


def test_wrong_files_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", height=np.zeros(3))
    (tmp_path / "no.npz").write_text("facet")
    (tmp_path / "part.csv").write_text(
        "facet,row,column,slope_u_mrad,slope_v_mrad\n3,90,90,0.1,0.1\n"
    )
    (tmp_path / "half.csv").write_text(
        "facet,row,column,slope_u_mrad,slope_v_mrad\n0.5,9,9,0.1,0.1\n"
    )
    for name, text in (
        ("other.npz", "no array 'slope' in it, only height"),
        ("no.npz", "expected a slope map: an .npz file written by NumPy"),
        ("part.csv", "1 rows for 4 × 91 × 91 cells"),
        ("half.csv", "are not whole numbers"),
        ("missing.npz", "no such file"),
    ):
        with pytest.raises(FormatError, match=text):
            read_slopes(tmp_path / name, 4)
    with pytest.raises(FormatError, match="slope maps are"):
        write_slopes(tmp_path / "map.txt", np.zeros((1, 2, 2, 2)))


def test_wrong_mirrors_are_refused() -> None:
    whole = rectangle(2.0, 1.0)
    with pytest.raises(InputError, match="no area"):
        MirrorShape(whole.center, whole.half_width, whole.half_width, whole.focal)
    with pytest.raises(InputError, match="focal length is 0"):
        rectangle(2.0, 1.0, 0.0)
    with pytest.raises(InputError, match="the slope map has"):
        whole.with_slopes(np.zeros((2, 4, 4, 2)))
    with pytest.raises(InputError, match="has holes"):
        whole.with_slopes(np.full((1, 4, 4, 2), np.nan))
    with pytest.raises(InputError, match="expected centres"):
        MirrorShape(whole.center, whole.half_width, np.zeros((2, 3)), whole.focal)
    with pytest.raises(InputError, match="an rms of"):
        smooth_slopes(whole, np.random.default_rng(), -1.0)


def test_a_turned_mirror_moves_the_reflection_by_turn_times_distance() -> None:
    """The rule that planning uses: a normal off by e moves the spot by e · distance."""
    shape, turn = rectangle(8.0, 8.0), looking(np.array([0.0, -1.0, 1.0]))
    camera = VERTEX + 150.0 * turn[:, 2]
    moved = turn @ rotation((0.0, 1.0, 0.0), 5 * MRAD)
    found = reflection_points(shape, moved, VERTEX, camera, camera)
    np.testing.assert_allclose(found.xy, [[-0.75, 0.0]], atol=1e-3)
