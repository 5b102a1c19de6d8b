"""Growth of a calibration's covariance with the time since its fit."""

from dataclasses import replace

import numpy as np
import pytest

from heliotrope.calibration.growth import Growth, default_growth
from heliotrope.calibration.learn import drift
from heliotrope.calibration.record import HeliostatCalibration, covariances_at
from heliotrope.field.layouts import malan_plant
from heliotrope.geometry import MRAD

DAY = 86400.0
MECHANISM = next(iter(malan_plant(2).groups.values())).mechanism
ZEROS = drift.zeros(MECHANISM)
NAMES = (*ZEROS, "axis_tilt_east")


def record(at: float = 1e9, growth: Growth | None = None) -> HeliostatCalibration:
    root = np.random.default_rng(7).normal(0.0, 0.1 * MRAD, (3, 3))
    return HeliostatCalibration(
        "A", at, NAMES, np.zeros(3), root @ root.T, np.full(3, 10 * MRAD),
        growth=growth or default_growth(MECHANISM),
    )  # fmt: skip


def test_a_value_that_is_held_misses_by_what_the_process_has_moved() -> None:
    """The growth is the mean square of the difference of simulated processes."""
    tau, step, chance = 20.0, 0.5, np.random.default_rng(3)
    hyper = drift.start(MECHANISM, ZEROS)
    hyper = replace(hyper, tau=np.where(np.array(hyper.groups) == "slow", tau, hyper.tau))
    amplitude = hyper.amplitude[0]
    path = [chance.normal(0.0, amplitude, 40_000)]
    keep = np.exp(-step / tau)
    for _ in range(120):
        fresh = chance.normal(0.0, amplitude * np.sqrt(1.0 - keep**2), 40_000)
        path.append(keep * path[-1] + fresh)
    days = step * np.array([2, 20, 120])
    moved = np.array([np.mean((path[round(d / step)] - path[0]) ** 2) for d in days])
    found = Growth.of(hyper, "test").variances(NAMES, days)
    np.testing.assert_allclose(found[:, 0], moved, rtol=0.03)
    assert (found[:, 2] == 0.0).all()


def test_steps_widen_the_zeros_by_their_rate() -> None:
    hyper = replace(drift.start(MECHANISM, ZEROS, processes=()), rate=0.01)
    found = Growth.of(hyper, "test").variances(NAMES, 50.0)
    np.testing.assert_allclose(np.sqrt(found), drift.STEP_RAD * np.sqrt([0.5, 0.5, 0.0]))


def test_motion_within_hours_belongs_to_the_noise_of_a_sighting() -> None:
    hyper = drift.start(MECHANISM, ZEROS, processes=(drift.Process(ZEROS[0], "hours"),))
    assert Growth.of(hyper, "test").variances(NAMES, 10.0).max() == 0.0


def test_a_covariance_grows_from_the_fit_and_never_before_it() -> None:
    one = record()
    np.testing.assert_array_equal(one.covariance_at(one.at), one.covariance)
    np.testing.assert_array_equal(one.covariance_at(one.at - DAY), one.covariance)
    later = one.covariance_at(one.at + DAY * np.array([1.0, 10.0, 1000.0]))
    added = later - one.covariance
    assert (np.diff(added[:, 0, 0]) > 0.0).all()
    np.testing.assert_allclose(added[:, 0, 2], 0.0, atol=1e-20)
    # As Jülich's: 1 mrad within 300 days and a step of 1 mrad in 1,000.
    assert np.sqrt(added[0, 0, 0]) == pytest.approx(0.0874 * MRAD, rel=0.01)
    assert np.sqrt(added[2, 0, 0]) == pytest.approx(1.713 * MRAD, rel=0.01)
    np.testing.assert_allclose(one.sigma_at(one.at + DAY) ** 2, np.diagonal(later[0]))


def test_records_of_a_group_grow_together_as_each_does_alone() -> None:
    growth = default_growth(MECHANISM)
    records = [record(1e9 - days * DAY, growth) for days in (0.0, 3.0, 400.0)]
    together = covariances_at(records, 1e9)
    for one, found in zip(records, together, strict=True):
        np.testing.assert_allclose(found, one.covariance_at(1e9), rtol=1e-12, atol=1e-20)


def test_without_a_growth_a_record_keeps_its_covariance() -> None:
    one = record(growth=Growth())
    np.testing.assert_array_equal(one.covariance_at(one.at + 1e9), one.covariance)
