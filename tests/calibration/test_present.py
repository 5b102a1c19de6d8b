"""One mirror's parameters now: the drift is followed through its photographs."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from heliotrope.calibration.evaluation import beam_errors
from heliotrope.calibration.fit.estimator import FieldFit, FitOutcome, fit
from heliotrope.calibration.learn import drift, own_model, present
from heliotrope.calibration.sightings import Sightings, sightings
from heliotrope.field.layouts import malan_plant
from heliotrope.geometry import MRAD, FloatArray, angle_between, reflect
from heliotrope.mechanism import parameters
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.tracking import track
from heliotrope.sun import vector

PLANT = malan_plant(4)
NOMINAL = next(iter(PLANT.groups.values())).mechanism[:1]
ZEROS = drift.zeros(NOMINAL)
AIM = PLANT.targets[0].center
BEGIN = datetime(2026, 6, 1, tzinfo=UTC).timestamp()
DAY, SIGMA = 86400.0, 2e-4
#: Morning, noon and afternoon of 20 days, three days apart.
TIMES = BEGIN + (3.0 * np.arange(20)[:, None] + np.array([7.0, 11.0, 15.0]) / 24.0).ravel() * DAY


def photographs(zero: FloatArray, seed: int = 1, times: FloatArray = TIMES) -> Sightings:
    """Sightings at times of a mirror whose first zero is off by ``zero`` (M,), rad."""
    many, suns = NOMINAL[np.zeros(len(times), np.intp)], vector(times, PLANT.site)
    counts = track(many, suns, AIM).best_counts
    truth = many.with_parameters({ZEROS[0]: zero, "tilt_east": np.full(len(times), 2 * MRAD)})
    pose = truth.pose(counts)
    away = np.linalg.norm(AIM - pose.vertex, axis=1)[:, None]
    noise = SIGMA * np.random.default_rng(seed).standard_normal((len(times), 3))
    seen = pose.vertex + away * (reflect(suns, pose.normal) + noise)
    return sightings(np.zeros(len(times), np.intp), counts, suns, seen, time=times, sigma=5e-4)


def daylight(zero: FloatArray, times: FloatArray) -> Sightings:
    """Photographs at the suns of one forenoon, whatever their times say."""
    suns = TIMES[0] + 20.0 * np.arange(len(times))
    return replace(photographs(zero, 2, suns), time=times)


def followed(seen: Sightings) -> tuple[FieldFit, FieldFit]:
    """The fit of constants, and the one that follows the drift."""
    constants = fit(NOMINAL, seen, "malan8")
    return constants, present.fitting_present(NOMINAL, seen, constants)


def miss(fitted: FieldFit, seen: Sightings) -> float:
    """Beam error of the last three photographs by a fit, rad RMS."""
    last = seen.take(np.arange(len(seen) - 3, len(seen)))
    moved: Mechanism = NOMINAL.with_parameters(fitted.parameters)
    return float(np.sqrt(np.mean(beam_errors(moved, last).beam ** 2)))


def test_a_zero_that_drifts_is_followed() -> None:
    exact = photographs(np.linspace(0.0, 2 * MRAD, len(TIMES)))
    constants, now = followed(exact)
    assert miss(constants, exact) > 1.2 * MRAD
    assert miss(now, exact) < 0.5 * MRAD


def test_a_step_is_followed_at_once() -> None:
    seen = photographs(np.where(np.arange(len(TIMES)) < 54, 0.0, 3 * MRAD))
    constants, now = followed(seen)
    assert miss(constants, seen) > 3 * MRAD
    assert miss(now, seen) < 1 * MRAD


def test_where_nothing_moves_it_agrees_with_the_constants() -> None:
    seen = photographs(np.zeros(len(TIMES)))
    constants, now = followed(seen)
    assert abs(miss(now, seen) - miss(constants, seen)) < 0.1 * MRAD
    # The zeros may drift, so they are known less well than constants would be.
    place = now.names.index(ZEROS[0])
    assert now.sigma[0, place] > constants.sigma[0, place]


def test_one_photograph_of_another_light_moves_nothing() -> None:
    seen = photographs(np.zeros(len(TIMES)))
    wrong = seen.destination.copy()
    wrong[-1, 0] += 3.0
    _, good = followed(seen)
    _, now = followed(replace(seen, destination=wrong))
    assert abs(miss(now, seen) - miss(good, seen)) < 0.2 * MRAD


def test_the_order_of_the_rows_does_not_matter() -> None:
    seen = photographs(np.linspace(0.0, 2 * MRAD, len(TIMES)))
    mixed = seen.take(np.random.default_rng(3).permutation(len(seen)))
    _, now = followed(seen)
    _, same = followed(mixed)
    np.testing.assert_allclose(same.values, now.values, atol=1e-6 * MRAD)


def test_a_fit_that_has_failed_is_returned_as_it_is() -> None:
    seen = photographs(np.zeros(len(TIMES)))
    failed = replace(fit(NOMINAL, seen, "malan8"), outcome=np.array([FitOutcome.FAILED], np.int8))
    assert present.fitting_present(NOMINAL, seen, failed) is failed


@pytest.mark.parametrize(("shots", "visits"), [(3, 1), (1, 2)])
def test_a_step_overnight_is_taken_by_the_next_photographs(shots: int, visits: int) -> None:
    """Two visits a day, and 2 mrad in one night, seen by nobody: no worse than without a step.

    Three photographs of one visit settle it; of single ones the second does.
    """
    begin, count = BEGIN + 8 * DAY, 16 * shots + visits * shots
    hours = np.arange(9)[:, None] * DAY + 3600.0 * np.array([8.0, 14.0])
    times = (BEGIN + hours[:, :, None] + 20.0 * np.arange(shots)).ravel()[:count]
    noon = vector(BEGIN + 8.5 * DAY, PLANT.site)
    for seed in range(6):
        missed = []
        for jump in (0.0, 2 * MRAD * (-1) ** seed):
            seen = photographs(np.where(times < begin, 0.0, jump), seed, times)
            now = NOMINAL.with_parameters(followed(seen)[1].parameters)
            truth = NOMINAL.with_parameters({ZEROS[0]: jump, "tilt_east": 2 * MRAD})
            counts = track(now, noon, AIM).best_counts
            normals = (m.pose(counts).normal for m in (now, truth))
            missed.append(float(angle_between(*normals)[0]))
        assert max(missed) < 0.5 * MRAD


def test_constants_and_models_are_of_the_last_thousand_photographs() -> None:
    """The work of a visit does not grow with the age of the plant."""
    times = BEGIN + 3600.0 * np.arange(1200)
    old = np.where(np.arange(1200) < 200, 50 * MRAD, 0.0)
    mixed = daylight(old, times).take(np.random.default_rng(4).permutation(1200))
    recent = own_model.latest(mixed)
    np.testing.assert_array_equal(np.sort(recent.time), times[200:])
    unknown = replace(mixed, time=np.where(mixed.time > times[1000], mixed.time, np.nan))
    assert np.isfinite(own_model.latest(unknown).time).sum() == 199
    assert own_model.latest(recent) is recent
    model = own_model.OwnModel("malan8", parameters.model("malan8", NOMINAL.parameters))
    still, moving = model.fitting(NOMINAL, mixed)
    same, other = model.fitting(NOMINAL, recent)
    np.testing.assert_allclose(still.values, same.values, atol=1e-9)
    # The replay takes them all.
    assert np.abs(moving.covariance - other.covariance).max() > 0.0


def test_linearised_in_blocks_it_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = photographs(np.linspace(0.0, 2 * MRAD, len(TIMES)))
    _, whole = followed(seen)
    monkeypatch.setattr(present, "BLOCK", 7)
    _, blocks = followed(seen)
    np.testing.assert_allclose(blocks.values, whole.values, rtol=1e-9, atol=1e-12)
