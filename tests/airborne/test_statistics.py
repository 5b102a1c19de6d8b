"""Rosner's test on published data, and the spread of means over mirrors by simulation."""

import numpy as np
import pytest

from heliotrope.airborne.evaluate.statistics import (
    few_sigma,
    matern,
    normality,
    plain_sigma,
    rosner,
    spread_mean,
    studentized_deviates,
)
from heliotrope.airborne.mirror import MirrorShape, tiled
from heliotrope.airborne.slopes import smooth_slopes
from heliotrope.errors import InputError

# NIST/SEMATECH e-Handbook of Statistical Methods, 1.3.5.17.3: Rosner's own example.
ROSNER = np.array(
    [
        -0.25,
        0.68,
        0.94,
        1.15,
        1.20,
        1.26,
        1.26,
        1.34,
        1.38,
        1.43,
        1.49,
        1.49,
        1.55,
        1.56,
        1.58,
        1.65,
        1.69,
        1.70,
        1.76,
        1.77,
        1.81,
        1.91,
        1.94,
        1.96,
        1.99,
        2.06,
        2.09,
        2.10,
        2.14,
        2.15,
        2.23,
        2.24,
        2.26,
        2.35,
        2.37,
        2.40,
        2.47,
        2.54,
        2.62,
        2.64,
        2.90,
        2.92,
        2.92,
        2.93,
        3.21,
        3.26,
        3.30,
        3.59,
        3.68,
        4.30,
        4.64,
        5.34,
        5.42,
        6.01,
    ]
)


def test_rosners_own_example() -> None:
    which, extreme, critical = studentized_deviates(ROSNER, 10)
    np.testing.assert_allclose(
        extreme, [3.118, 2.942, 3.179, 2.810, 2.815, 2.848, 2.279, 2.310, 2.101, 2.067], atol=1e-3
    )
    np.testing.assert_allclose(
        critical, [3.158, 3.151, 3.143, 3.136, 3.128, 3.120, 3.111, 3.103, 3.094, 3.085], atol=1e-3
    )
    assert sorted(ROSNER[rosner(ROSNER)]) == [5.34, 5.42, 6.01]
    assert sorted(ROSNER[which[:3]]) == [5.34, 5.42, 6.01]


def test_false_alarms_are_as_rare_as_asked() -> None:
    rng = np.random.default_rng(3)
    alarms = [rosner(rng.standard_normal(40)).any() for _ in range(400)]
    assert 0.02 < np.mean(alarms) < 0.09


def test_two_alike_do_not_hide_each_other() -> None:
    values = np.r_[np.random.default_rng(5).standard_normal(40), 30.0, 30.5]
    assert np.flatnonzero(rosner(values)).tolist() == [40, 41]
    assert not rosner(np.ones(20)).any()
    assert not rosner([1.0, 2.0, 90.0]).any()


@pytest.mark.parametrize("alpha", [0.0, 1.0, -3.0])
def test_a_probability_lies_between_0_and_1(alpha: float) -> None:
    with pytest.raises(InputError, match="between 0 and 1"):
        rosner(ROSNER, alpha=alpha)


def test_normality() -> None:
    rng = np.random.default_rng(1)
    assert normality(rng.standard_normal(80)) > 0.05
    assert normality(rng.exponential(size=80)) < 1e-4
    assert np.isnan(normality([1.0, 1.0, 1.0]))
    assert np.isnan(normality([1.0, 2.0]))


def spread(shape: MirrorShape, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """One point at random in each of count × count cells of each facet."""
    line = (2.0 * np.arange(count) + 1.0) / count - 1.0
    own = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    facet = np.repeat(np.arange(len(shape)), count**2)
    away = np.random.default_rng(9000 + seed).uniform(-1.0, 1.0, (len(facet), 2)) / count
    return facet, (np.tile(own, (len(shape), 1)) + away) * shape.half_size[facet]


SHAPE = tiled(2, 2, 1.6, 1.25, gap=0.02)


def sampled(facet: np.ndarray, uv: np.ndarray, seed: int, noise: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    shape = SHAPE.with_slopes(smooth_slopes(SHAPE, rng, 1.0, length=0.25))
    return shape.slope_at(facet, uv) + noise * rng.standard_normal((len(facet), 2))


@pytest.mark.parametrize(("count", "noise"), [(3, 0.1), (4, 0.1), (4, 1.5)])
def test_the_error_of_spread_points_is_what_simulation_finds(count: int, noise: float) -> None:
    """The mean over the mirror is 0 by construction, so each mean is its own error."""
    error, told, plain = [], [], []
    for seed in range(40):
        facet, uv = spread(SHAPE, count, seed)
        values = sampled(facet, uv, seed, noise)
        error.append(values.mean(axis=0))
        found = spread_mean(values, SHAPE, facet, uv)
        told.append(found.sigma)
        plain.append(plain_sigma(values))
    true = np.sqrt(np.mean(np.square(error)))
    better, simple = (float(np.sqrt(np.mean(np.square(s)))) for s in (told, plain))
    assert 0.85 < better / true < 1.35
    if noise < 1.0:
        # The fixed field, spread out, is averaged better than chance would.
        assert simple > 1.3 * true
        assert better < 0.85 * simple


def test_the_weighted_mean_is_better_where_sampling_is_uneven() -> None:
    rng = np.random.default_rng(8)
    facet = np.r_[np.zeros(40, dtype=int), np.repeat([1, 2, 3], 6)]
    uv = rng.uniform(-1.0, 1.0, (len(facet), 2)) * SHAPE.half_size[facet]
    plain, weighted, told = [], [], []
    for seed in range(40):
        cant = np.random.default_rng(1000 + seed).standard_normal((4, 2))
        cant -= cant.mean(axis=0)
        values = sampled(facet, uv, seed, 0.1) + cant[facet]
        found = spread_mean(values, SHAPE, facet, uv)
        assert abs(found.weights.sum() - 1.0) < 1e-9
        plain.append(values.mean(axis=0))
        weighted.append(found.weights @ values)
        told.append(found.sigma_weighted)
    errors = [float(np.sqrt(np.mean(np.square(e)))) for e in (plain, weighted, told)]
    assert errors[1] < 0.6 * errors[0]
    assert 0.5 < errors[2] / errors[1] < 2.0


def test_noise_alone_gives_the_plain_figure() -> None:
    facet, uv = spread(SHAPE, 4, 0)
    ratio = []
    for seed in range(20):
        values = np.random.default_rng(seed).standard_normal((len(facet), 2))
        ratio.append(spread_mean(values, SHAPE, facet, uv).sigma / plain_sigma(values))
    assert 0.75 < np.mean(ratio) < 1.25


def test_few_points_say_nothing_about_a_field() -> None:
    found = spread_mean(
        np.zeros((3, 2)) + [[1.0], [2.0], [4.0]], SHAPE, [0, 1, 2], np.zeros((3, 2))
    )
    np.testing.assert_array_equal(found.weights, np.full(3, 1.0 / 3.0))
    np.testing.assert_array_equal(found.sigma, found.sigma_weighted)
    assert np.isnan(plain_sigma(np.zeros((1, 2)))).all()
    assert spread_mean(np.zeros((0, 2)), SHAPE, [], np.zeros((0, 2))).weights.shape == (0,)


def test_the_correlation() -> None:
    assert matern(0.0) == 1.0
    np.testing.assert_allclose(matern(1.0), (1 + np.sqrt(3)) * np.exp(-np.sqrt(3)))


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_sigma_of_a_few_is_honest(count: int) -> None:
    rng = np.random.default_rng(count)
    inside = []
    for _ in range(400):
        # Mirrors are not alike: the prior is right on average only.
        true = 0.8e-3 * np.exp(0.25 * rng.standard_normal())
        values = true * rng.standard_normal((count, 2))
        sigma = few_sigma(values, 0.8e-3)
        inside.append(np.sum((values.mean(axis=0) / sigma) ** 2) < -2.0 * np.log(0.1))
    assert 0.85 < np.mean(inside) < 0.95


def test_many_of_a_few_forget_the_prior() -> None:
    values = np.random.default_rng(1).standard_normal((400, 2))
    np.testing.assert_allclose(few_sigma(values, 5.0), plain_sigma(values), rtol=0.4)
    np.testing.assert_allclose(few_sigma(values, 1.0), plain_sigma(values), rtol=0.03)
