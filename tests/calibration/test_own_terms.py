"""Own error terms of drives: recovered from sightings, and sent to the motors."""

from collections.abc import Callable

import numpy as np
import pytest

import heliotrope as ht
from heliotrope.calibration.fit import DriveTerm, fit_terms, table_terms
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.geometry import FloatArray, reflect
from heliotrope.mechanism import Mechanism, kinds

SITE = ht.Site(37.0, -2.4, 500.0)
AIM = (0.0, 0.0, 40.0)
MODEL = "tilts+biases+non_orthogonality+canting"
SIGMA = 2e-4
ECCENTRIC = DriveTerm("eccentric", "azimuth", lambda angles: np.sin(angles[..., 0]), 5e-3)


def nominal() -> Mechanism:
    """Two heliostats west and east of the tower, whose azimuths cover most of a turn."""
    drives = (ht.rotary(200, 2400, microsteps=16), ht.rotary(200, 2400, microsteps=16))
    return kinds.azimuth_elevation(
        [(-60.0, 20.0, 0.0), (50.0, -30.0, 0.0)], pivot_height=1.5, drives=drives
    )


def seen(error: Callable[[FloatArray], FloatArray], sigma: float = SIGMA) -> ht.Sightings:
    """Return sightings of two roughly installed heliostats whose azimuth errs by ``error``.

    They are made without the code under test: the motor's error moves the counts of the true
    mechanism, and the beam goes where the mirror throws it.
    """
    machine = nominal()
    truth = ht.roughly_installed(machine, seed=6)
    spring, summer = (
        ht.sun.daylight(day, SITE, min_elevation=0.2)[::12] for day in ("2026-03-20", "2026-06-21")
    )
    times = spring.append(summer)
    suns = np.repeat(ht.sun.vector(times, SITE)[:, None], 2, axis=1)
    counts = ht.track(machine, suns, AIM).best_counts
    # Aims differ between the mirrors of a field, and with them the azimuths.
    counts = counts + np.random.default_rng(3).uniform(-4e5, 4e5, counts.shape) * [1.0, 0.1]
    angles = machine.drives.angles(counts)
    rate = machine.drives[0].radians_per_count(counts[..., 0])
    moved = counts.copy()
    moved[..., 0] += error(angles) / rate
    normal = truth.pose(moved).normal
    noise = np.random.default_rng(4).normal(0.0, sigma, normal.shape)
    ways = reflect(suns, normal) + noise
    return ht.sightings(
        [0, 1], counts, suns, ways, time=times, destination_at_infinity=True, sigma=sigma
    )


def test_a_sine_of_the_azimuth_is_recovered() -> None:
    true = np.array([3e-3, -2e-3])
    measured = seen(lambda angles: true * np.sin(angles[..., 0]))
    found = fit_terms(nominal(), measured, MODEL, [ECCENTRIC])
    off = (found.values[:, 0] - true) / found.sigma[:, 0]
    assert (found.sigma[:, 0] < 0.4e-3).all()
    assert (np.abs(off) < 4.0).all()
    plain = ht.fit(nominal(), measured, MODEL)
    without = ht.beam_errors(nominal().with_calibration(plain), measured).beam
    with_term = ht.beam_errors(found.mechanism, found.without_terms(measured)).beam
    assert np.median(without) > 2.0 * np.median(with_term)
    # Noise of 0.2 mrad in each of two directions: the median of a Rayleigh distribution.
    assert np.median(with_term) == pytest.approx(1.18 * SIGMA, rel=0.25)


def test_a_term_that_is_not_there_stays_near_zero_and_widens_the_parameters() -> None:
    measured = seen(lambda angles: 0.0 * angles[..., 0])
    found = fit_terms(nominal(), measured, MODEL, [ECCENTRIC])
    assert (np.abs(found.values) < 4.0 * found.sigma).all()
    plain = ht.fit(nominal(), measured, MODEL)
    assert (found.fitted.sigma > 0.99 * plain.sigma).all()
    assert (found.fitted.sigma > 1.05 * plain.sigma).any()


def test_a_look_up_table_is_recovered() -> None:
    knots = np.radians(np.arange(-180.0, 181.0, 45.0))
    heights = 2e-3 * np.sin(3.0 * knots)
    measured = seen(lambda angles: np.interp(angles[..., 0], knots, heights))
    # The table takes the place of the encoder's zero.
    model = MODEL.replace("biases", "elevation_bias")
    found = fit_terms(nominal(), measured, model, table_terms("azimuth", 0, knots, 0.01))
    assert [term.name for term in found.terms][:2] == ["azimuth_table_1", "azimuth_table_2"]
    zero = ht.roughly_installed(nominal(), seed=6).deviations["azimuth_bias"]
    off = found.values - heights - zero[:, None]
    known = found.sigma < 1e-3
    assert known.sum() >= 10
    assert (np.abs(off / found.sigma)[known] < 4.0).all()
    # The sightings say nothing of rows beyond the azimuths that they reach.
    assert (found.sigma > 0.9 * 0.01).any()
    after = ht.beam_errors(found.mechanism, found.without_terms(measured)).beam
    assert np.median(after) < 1.5 * SIGMA


def test_the_counts_to_send_bring_the_mirror_to_its_pose() -> None:
    measured = seen(lambda angles: 3e-3 * np.sin(angles[..., 0]))
    found = fit_terms(nominal(), measured, MODEL, [ECCENTRIC])
    sun = ht.sun.vector("2026-05-05T14:00Z", SITE)
    wanted = ht.track(found.mechanism, sun, AIM).best_counts
    sent = found.to_send([0, 1], wanted)
    assert (np.abs(sent - wanted)[:, 0] > 100.0).any()
    again = ht.sightings([0, 1], sent, sun, AIM, sigma=SIGMA)
    np.testing.assert_allclose(found.without_terms(again).counts, wanted, atol=1e-3)


def test_one_heliostat_of_a_plant_goes_by_its_name() -> None:
    plant = ht.example_plant()
    suns = ht.sun.vector(
        ht.sun.daylight("2026-03-20", plant.site, min_elevation=0.4)[::60], plant.site
    )
    counts = ht.track(plant["P6A"], suns, plant.targets[0].center).best_counts
    measured = ht.sightings("P6A", counts, suns, plant.targets[0].center, sigma=SIGMA)
    found = fit_terms(plant["P6A"], measured, "guo6", [ECCENTRIC])
    assert found.values.shape == (1, 1)
    assert np.abs(found.values).max() < 1e-6
    np.testing.assert_allclose(found.without_terms(measured).counts, counts, atol=1.0)


@pytest.mark.parametrize(
    ("terms", "text"),
    [
        ([], "the list is empty"),
        ([ECCENTRIC, ECCENTRIC], "term eccentric: the name occurs twice"),
        (
            [DriveTerm("x", "azimuth", lambda a: a[..., 0], 0.0)],
            r"term x: prior must be .* not 0.0",
        ),
        ([DriveTerm("x", "azimuth", lambda a: a, 1e-3)], r"term x: its function returned shape \("),
        ([DriveTerm("x", "azimuth", lambda a: a[..., 0] * np.nan, 1e-3)], "one finite number"),
        ([DriveTerm("x", "azimuth", lambda a: "much", 1e-3)], "one finite number"),
    ],
)
def test_wrong_terms_are_refused(terms: list[DriveTerm], text: str) -> None:
    with pytest.raises(InputError, match=text):
        fit_terms(nominal(), seen(lambda angles: 0.0 * angles[..., 0]), MODEL, terms)


def test_a_joint_that_is_not_driven_is_refused() -> None:
    wrong = DriveTerm("x", "canting", lambda a: a[..., 0], 1e-3)
    with pytest.raises(UnknownNameError, match="driven joint"):
        fit_terms(nominal(), seen(lambda angles: 0.0 * angles[..., 0]), MODEL, [wrong])


def test_knots_that_do_not_ascend_are_refused() -> None:
    with pytest.raises(InputError, match="at least 2 ascending angles"):
        table_terms("azimuth", 0, [0.0, 0.0, 1.0], 1e-3)
