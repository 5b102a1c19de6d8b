"""Clusters of equal area, and short tours through them."""

from itertools import pairwise, permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from heliotrope.airborne.plan.clusters import clusters, ground_areas, tour
from heliotrope.errors import InputError
from support.flight_case import radial


def test_ten_thousand_heliostats() -> None:
    place = radial(10_000)
    found = clusters(place, size=100.0, max_radius=70.0)
    assert np.bincount(found.of).sum() == 10_000
    assert np.bincount(found.of).min() > 0
    # Equal to 3 %, as large as a disc of 100 m at most, and round.
    np.testing.assert_allclose(found.area, found.area.mean(), rtol=0.03)
    assert 0.8 < found.area.mean() / (np.pi * 50.0**2) <= 1.0
    assert found.radius.max() <= 70.0
    assert found.roundness.min() > 0.8
    assert np.median(found.roundness) > 0.9


def test_radius_limits_the_size() -> None:
    place = radial(1200)
    wide, narrow = clusters(place), clusters(place, max_radius=35.0)
    assert wide.radius.max() > 35.0
    assert narrow.radius.max() <= 35.0
    assert len(narrow) > len(wide)


def test_area_of_a_ring_and_of_squares() -> None:
    place = radial(3000)
    radius = np.linalg.norm(place, axis=-1)
    ring = np.pi * (radius.max() ** 2 - radius.min() ** 2)
    # The outermost heliostats' ground goes beyond them.
    assert ground_areas(place).sum() == pytest.approx(ring, rel=0.08)
    grid = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0), [0.0]), -1).reshape(-1, 3) * 7.0
    inner = ((grid[:, :2] > 1.0) & (grid[:, :2] < 130.0)).all(axis=1)
    np.testing.assert_allclose(ground_areas(grid)[inner], 49.0, rtol=0.15)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 50), size=st.floats(15.0, 200.0))
def test_every_heliostat_is_in_one_cluster(seed: int, count: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    place = np.column_stack([rng.uniform(-100.0, 100.0, (count, 2)), rng.normal(0.0, 2.0, count)])
    found = clusters(place, size=size, max_radius=60.0)
    assert sorted(np.concatenate([found.rows(k) for k in range(len(found))])) == list(range(count))
    assert found.radius.max() <= 60.0 or len(found) == count
    for k in range(len(found)):
        np.testing.assert_allclose(found.center[k], place[found.rows(k)].mean(axis=0), atol=1e-9)


def test_refusals() -> None:
    with pytest.raises(InputError, match="there is no heliostat"):
        clusters(np.empty((0, 3)))
    with pytest.raises(InputError, match="cluster size must be a length above 0, not 0 m"):
        clusters(radial(10), size=0.0)
    with pytest.raises(InputError, match="most heliostats have the same position"):
        clusters(np.zeros((5, 3)))


@pytest.mark.parametrize("seed", range(5))
def test_tour_is_nearly_the_shortest(seed: int) -> None:
    points = np.random.default_rng(seed).uniform(0.0, 100.0, (7, 2))
    start = np.zeros(2)

    def length(order: tuple[int, ...]) -> float:
        way = np.vstack([start, points[list(order)]])
        return float(sum(np.linalg.norm(b - a) for a, b in pairwise(way)))

    best = min(length(order) for order in permutations(range(7)))
    found = tuple(int(i) for i in tour(points, start))
    assert sorted(found) == list(range(7))
    assert length(found) <= 1.15 * best
