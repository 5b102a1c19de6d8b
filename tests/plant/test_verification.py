"""The photograph that judges a fit which has not seen it."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from heliotrope.calibration.fit.estimator import FieldFit, fit
from heliotrope.calibration.learn import drift
from heliotrope.calibration.sightings import Sightings, sightings
from heliotrope.field.layouts import malan_plant
from heliotrope.geometry import MRAD, FloatArray, reflect
from heliotrope.mechanism.tracking import track
from heliotrope.plant.field.beliefs import Beliefs
from heliotrope.plant.visits.verification import Prediction
from heliotrope.sun import vector

PLANT = malan_plant(4)
NOMINAL = Beliefs(PLANT).nominal(PLANT.names[0])
NAMES = drift.zeros(NOMINAL)
SUN = vector(datetime(2026, 6, 1, 9, tzinfo=UTC).timestamp(), PLANT.site)
AIM = PLANT.targets[0].center
#: Noise of a photograph, rad of beam, and what the fit does not know of the two zeros, rad.
NOISE, UNKNOWN = 0.3 * MRAD, np.array([1.0, 0.4]) * MRAD


def photograph(zeros: FloatArray, noise: FloatArray) -> Sightings:
    """One sighting of a mirror whose zeros are off, with noise of the beam (3,), rad."""
    counts = track(NOMINAL, SUN, AIM).best_counts
    errors = {name: np.array([zero]) for name, zero in zip(NAMES, zeros, strict=True)}
    pose = NOMINAL.with_parameters(errors).pose(counts)
    away = np.linalg.norm(AIM - pose.vertex, axis=-1, keepdims=True)
    place = pose.vertex + away * (reflect(SUN, pose.normal) + noise)
    mine = np.zeros(1, np.intp)
    return sightings(mine, counts, SUN[None], place, sigma=NOISE)


@pytest.fixture(scope="module")
def fitted() -> FieldFit:
    """A fit that finds no error, and knows the zeros no better than `UNKNOWN`."""
    made = fit(NOMINAL, photograph(np.zeros(2), np.zeros(3)), NAMES)
    return replace(made, values=np.zeros_like(made.values), covariance=np.diag(UNKNOWN**2)[None])


def test_the_distance_counts_what_the_fit_and_the_photograph_do_not_know(
    fitted: FieldFit,
) -> None:
    """Of honest draws the squares of the distances have the mean of chi-square with two."""
    rng = np.random.default_rng(11)
    squares = [
        Prediction.of(
            NOMINAL, fitted, photograph(UNKNOWN * rng.normal(size=2), NOISE * rng.normal(size=3))
        ).deviations
        ** 2
        for _ in range(300)
    ]
    assert np.mean(squares) == pytest.approx(2.0, abs=0.35)
    assert np.mean(np.array(squares) > 4.605) == pytest.approx(0.1, abs=0.05)


def test_a_miss_is_told_as_angle_distance_and_spread(fitted: FieldFit) -> None:
    off = np.array([3.0, 0.0]) * MRAD
    made = photograph(off, np.zeros(3))
    found = Prediction.of(NOMINAL, fitted, made)
    pose = NOMINAL.pose(made.counts)
    place = made.destination[0] - pose.vertex[0]
    predicted = reflect(SUN, pose.normal)[0]
    cross = np.linalg.norm(np.cross(place / np.linalg.norm(place), predicted))
    assert found.miss == pytest.approx(float(np.arcsin(cross)), rel=1e-3)
    assert found.slant == pytest.approx(float(np.linalg.norm(place)), rel=1e-9)
    assert found.reach * found.deviations == pytest.approx(found.miss)
    # Three standard deviations of the zero, less what the noise of the photograph hides.
    assert 2.0 < found.deviations < 3.0
