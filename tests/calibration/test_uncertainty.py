"""Uncertainty: the bound of Cramér and Rao, ellipses, what is not seen, Malan's geometry."""

import dataclasses
import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from heliotrope.calibration.fit.estimator import fit
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.learn.learning import learn
from heliotrope.calibration.sightings import Sightings, sightings
from heliotrope.calibration.uncertainty import expected_error, unobservable, year_map
from heliotrope.geometry import FloatArray, direction, reflect
from heliotrope.mechanism import kinds, parameters
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import direct
from heliotrope.mechanism.tracking import track
from heliotrope.optics.beam import CHI_SQUARE_90
from support.machines import every_kind

AIM = np.array([0.0, 0.0, 40.0])
EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module")
def malan() -> ModuleType:
    spec = importlib.util.spec_from_file_location("malan_noise", EXAMPLES / "malan_noise.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _thrown(
    truth: Mechanism, suns: FloatArray, aim: FloatArray, noise: float, seed: int
) -> Sightings:
    """Beams of true mirrors near ``aim``, seen with ``noise`` rad."""
    rng = np.random.default_rng(seed)
    parts = []
    for sun in suns:
        wanted = track(truth, sun, aim)
        counts = wanted.best_counts
        pose = truth.pose(counts)
        ray = reflect(sun, pose.normal)
        length = np.linalg.norm(aim - pose.vertex, axis=-1, keepdims=True)
        spot = pose.vertex + length * ray
        spot += rng.normal(0.0, noise, spot.shape) * length
        good = np.flatnonzero(wanted.reachable)
        parts.append((good, counts[good], np.tile(sun, (len(good), 1)), spot[good]))
    rows, counts, source, spot = (np.concatenate(p) for p in zip(*parts, strict=True))
    return sightings(rows, counts, source, spot, sigma=noise)


@pytest.mark.parametrize(
    ("way", "model"),
    [
        *(("fit", model) for model in ("guo6", "malan8", "khalsa8", "full", "jacks")),
        *(("learn", model) for model in ("guo6", "full", "jacks")),
        pytest.param("learn", "malan8", marks=pytest.mark.slow),
        pytest.param("learn", "khalsa8", marks=pytest.mark.slow),
    ],
)
def test_efficiency_against_cramer_rao(way: str, model: str) -> None:
    """Over many mirrors drawn from the priors: bound / variance ≥ 0.95, all parameters together.

    With priors the bound is (J'J + prior⁻¹)⁻¹ at the truth (van Trees 1968, section 2.4).
    """
    count, noise = 400, 3e-4
    rng = np.random.default_rng(11)
    if model == "jacks":
        # It faces south, as at Jülich: put it north of the tower.
        one = dataclasses.replace(every_kind()["two_jacks"], position=np.array([30.0, 150.0, 0.3]))
        nominal = one[np.zeros(count, dtype=np.intp)] if one.shape else one[None][[0] * count]
        aim = np.array([0.0, 3.0, 40.0])
        azimuths = np.linspace(2.2, 4.0, 30)
    else:
        place = np.tile([30.0, -70.0, 0.0], (count, 1))
        drives = (direct(), direct(min_angle=-0.1, max_angle=1.7))
        nominal = kinds.azimuth_elevation(place, pivot_height=2.0, drives=drives)
        aim, azimuths = AIM, np.linspace(1.8, 4.5, 30)
    suns = direction(azimuths, 0.9 - 0.25 * (azimuths - np.pi) ** 2 + 0.2 * rng.random(30))
    names = parameters.model(model, nominal.parameters)
    priors = {n: 0.3 * nominal.parameter(n).prior for n in names}
    truth = {n: rng.normal(0.0, s, count) for n, s in priors.items()}
    real = nominal.with_parameters(truth)
    seen = _thrown(real, suns, aim, noise, 3)
    if way == "fit":
        found = fit(nominal, seen, names, priors=priors, adapt_scale=False, loss="square").values
    else:
        known = learn(nominal, seen, names, priors=priors, processes=(), rounds=1)
        found = known.parameters_at(np.arange(count), np.full(count, np.nan))[0][:, : len(names)]
    line = linearise(real[seen.heliostat], seen, names)
    scale = np.array([priors[n] for n in names])
    squares = 0.0
    for i in range(count):
        rows = seen.heliostat == i
        slope = line.jacobian[rows].reshape(-1, len(names)) * scale
        information = slope.T @ slope + np.eye(len(names))
        error = (found[i] - np.array([truth[n][i] for n in names])) / scale
        squares += float(error @ information @ error)
    efficiency = count * len(names) / squares
    # Mean of a χ² of 400 P degrees of freedom: known to √(2 / 400 P), 3 % for six.
    assert efficiency >= 0.95


def test_malan_in_his_geometry(malan: ModuleType) -> None:
    found = malan.study(0.005)
    limits = {"the same day": 0.08e-3, "four days later": 0.08e-3, "21 December": 0.33e-3}
    for day, limit in limits.items():
        assert found.actual[day] <= limit
        assert found.predicted[day] == pytest.approx(found.actual[day], rel=0.10)


def test_malan_with_a_worm(malan: ModuleType) -> None:
    worm = ("elevation_worm_cos", "elevation_worm_sin")
    without = malan.study(0.005, mirrors=60, worm=1.35e-3)
    found = malan.study(0.005, mirrors=60, worm=1.35e-3, model=(*malan.MODEL, *worm))
    assert without.actual["the same day"] > 1e-3
    assert found.actual["the same day"] <= 0.1e-3
    assert found.actual["four days later"] <= 0.1e-3
    for name in worm:
        error = found.found.parameters[name] - found.truth[name]
        assert np.sqrt(np.mean(error**2)) < 0.1e-3


def test_the_line_of_sight_is_named(malan: ModuleType) -> None:
    """One day at one target: the position along the line of sight rests on the prior alone."""
    found = malan.study(0.005, mirrors=3)
    drawn = malan.nominal(3)
    names = found.found.names
    prior = [malan.PRIORS[n] for n in names]
    weak = dict(malan.PRIORS, position_east=0.02, position_north=0.02, position_up=0.01)
    seen = malan.measure(drawn, drawn, 0.005, 1)
    tight = fit(drawn, seen, names, priors=weak, loss="square", adapt_scale=False)
    line = malan.TARGET - drawn.position[0]
    blind = unobservable(names, tight.covariance[0], [weak[n] for n in names], line)
    assert blind[0].remaining > 0.9
    words = " ".join(b.text for b in blind)
    assert "known only from the prior" in words
    assert "position along the line of sight" in words
    # What the data do decide is not called blind.
    assert not any(name == "tilt_north" for b in blind for name, _ in b.loadings)
    assert all(b.remaining >= 0.9 for b in unobservable(names, found.found.covariance[0], prior))


def test_the_ellipse_holds_nine_of_ten() -> None:
    """Mirrors drawn from a covariance send their beams into the ellipse, for any sun."""
    count = 3000
    rng = np.random.default_rng(2)
    place = np.tile([20.0, -60.0, 0.0], (count, 1))
    drives = (direct(), direct(min_angle=-0.1, max_angle=1.7))
    nominal = kinds.azimuth_elevation(place, pivot_height=2.0, drives=drives)
    names = ("tilt_north", "azimuth_bias", "elevation_bias", "position_east")
    root = np.diag([4e-4, 8e-4, 2e-4, 0.02]) @ (np.eye(4) + 0.4 * np.tri(4, k=-1))
    draws = rng.normal(size=(count, 4)) @ root.T
    real = nominal.with_parameters({n: draws[:, p] for p, n in enumerate(names)})
    sun = direction(2.4, 0.7)
    found = expected_error(nominal[0], names, root @ root.T, sun, AIM)
    wanted = track(nominal, sun, AIM)
    pose = real.pose(wanted.best_counts)
    ray = reflect(sun, pose.normal)
    way = AIM - pose.vertex
    way = way / np.linalg.norm(way, axis=-1, keepdims=True)
    right = np.stack([way[:, 1], -way[:, 0], 0 * way[:, 0]], axis=-1)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    error = np.stack([np.sum(ray * right, -1), np.sum(ray * np.cross(right, way), -1)], axis=-1)
    square = np.einsum("na,ab,nb->n", error, np.linalg.inv(found.covariance[0]), error)
    assert np.mean(square <= CHI_SQUARE_90) == pytest.approx(0.9, abs=0.02)
    np.testing.assert_allclose(np.cov(error.T), found.covariance[0], rtol=0.12, atol=1e-9)
    assert found.rms[0] == pytest.approx(np.sqrt(np.mean(np.sum(error**2, -1))), rel=0.05)
    long, short, angle = found.ellipse
    assert long[0] > short[0] > 0
    turned = error @ np.array([np.cos(angle[0]), np.sin(angle[0])])
    assert turned.std() * np.sqrt(CHI_SQUARE_90) == pytest.approx(long[0], rel=0.06)


def test_the_year_has_night_and_summer() -> None:
    nominal = kinds.azimuth_elevation(
        [20.0, 60.0, 0.0], pivot_height=2.0, drives=(direct(), direct())
    )
    found = year_map(nominal, ("elevation_bias",), [[1e-6]], AIM, 50.0, size=(5, 13))
    assert found.rms.shape == (5, 13)
    assert np.isnan(found.rms[0, 0])
    assert found.rms[4, 6] == pytest.approx(2e-3, rel=0.02)
    assert np.isfinite(found.rms[4]).sum() > np.isfinite(found.rms[0]).sum()


def test_out_of_reach_is_no_number() -> None:
    drives = (direct(), direct(min_angle=0.5, max_angle=0.6))
    nominal = kinds.azimuth_elevation([20.0, -60.0, 0.0], pivot_height=2.0, drives=drives)
    suns = direction(np.array([3.0, 3.0]), np.array([0.2, 1.5]))
    found = expected_error(nominal, ("elevation_bias",), [[1e-6]], suns, AIM)
    assert not found.reachable.all()
    assert np.isnan(found.rms[~found.reachable]).all()
