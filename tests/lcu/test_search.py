"""The search spiral: even spacing, bounded."""

import math

import numpy as np
import pytest

from heliotrope.lcu.search import Spiral, displaced


def _points(pitch: float, radius: float) -> np.ndarray:
    spiral, found = Spiral(pitch, radius), []
    while spiral.advance():
        found.append(tuple(spiral.offset))
    assert not spiral.advance()
    return np.array(found)


@pytest.mark.parametrize(("pitch", "radius"), [(1e-3, 20e-3), (0.5e-3, 3e-3), (2e-3, 0.07)])
def test_points_are_evenly_spaced_and_bounded(pitch: float, radius: float) -> None:
    points = _points(pitch, radius)
    away = np.linalg.norm(points, axis=1)
    assert (away <= radius).all()
    assert (np.diff(away) > 0).all()
    assert away[-1] > radius - 0.5 * pitch
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)[3:]
    assert (np.abs(steps / pitch - 1.0) < 0.12).all()


def test_points_are_a_pitch_apart_along_the_spiral() -> None:
    angles = 2.0 * np.pi * np.linalg.norm(_points(1.0, 8.0), axis=1)
    lengths = (angles * np.sqrt(1.0 + angles**2) + np.arcsinh(angles)) / (4.0 * np.pi)
    np.testing.assert_allclose(np.diff(lengths), 1.0, atol=0.01)


def test_no_place_within_the_radius_is_missed() -> None:
    points = np.vstack([[0.0, 0.0], _points(1.0, 10.0)])
    rng = np.random.default_rng(1)
    angle, size = rng.uniform(0, 2 * np.pi, 4000), 9.0 * np.sqrt(rng.uniform(0, 1, 4000))
    places = np.stack([size * np.cos(angle), size * np.sin(angle)], axis=1)
    nearest = np.linalg.norm(places[:, None] - points, axis=-1).min(axis=1)
    assert nearest.max() < 0.85  # a square grid of the same pitch has 0.71


@pytest.mark.parametrize(
    ("pitch", "radius", "text"),
    [
        (0.0, 1.0, "above 0"),
        (1.0, math.nan, "finite"),
        (math.inf, 1.0, "finite"),
        (1e-5, 0.1, "too many"),
    ],
)
def test_searches_without_end_are_refused(pitch: float, radius: float, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        Spiral(pitch, radius)


@pytest.mark.parametrize("aim", [(0.0, 0.0, 40.0), (-30.0, 90.0, 5.0), (10.0, 20.0, 300.0)])
def test_the_aim_moves_right_and_up_as_seen_from_the_mirror(aim: tuple[float, ...]) -> None:
    vertex = (10.0, 20.0, 1.0)
    way = np.array(aim) - vertex
    slant = np.linalg.norm(way)
    across = np.array(displaced(aim, vertex, 3e-3, 0.0)) - aim  # type: ignore[arg-type]
    above = np.array(displaced(aim, vertex, 0.0, 2e-3)) - aim  # type: ignore[arg-type]
    assert np.linalg.norm(across) == pytest.approx(3e-3 * slant)
    assert np.linalg.norm(above) == pytest.approx(2e-3 * slant)
    assert abs(across @ way) < 1e-9
    assert abs(above @ way) < 1e-9
    if np.hypot(way[0], way[1]) > 0.0:
        np.testing.assert_allclose(
            across, 3e-3 * slant * np.cross(way, [0, 0, 1]) / np.hypot(way[0], way[1]), atol=1e-12
        )
        assert above[2] > 0.0


def test_straight_up_right_is_east_and_up_is_north() -> None:
    assert displaced((2.0, 3.0, 100.0), (2.0, 3.0, 0.0), 0.01, 0.02) == (3.0, 5.0, 100.0)
