"""Sightings from the air whose errors are the same in all rows: they do not average out."""

from dataclasses import replace

import numpy as np
import pytest

from heliotrope.calibration import sightings as kinds
from heliotrope.calibration.fit.common import CommonErrors, fit_common
from heliotrope.calibration.fit.estimator import FieldFit, fit
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.sightings import Sightings, join
from heliotrope.geometry import MRAD, FloatArray, direction, normalize, reflect
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.kinds import azimuth_elevation

COUNT, POSES = 16, 4
PLACES = np.array([(12.0 * (i % 4) - 18.0, 90.0 + 12.0 * (i // 4), 0.0) for i in range(COUNT)])
NOMINAL = azimuth_elevation(PLACES, pivot_height=3.0)
MODEL = ("azimuth_bias", "elevation_bias", "tilt_east", "tilt_north")
SIZES = {"azimuth_bias": 3e-3, "elevation_bias": 3e-3, "tilt_east": 1e-3, "tilt_north": 1e-3}
#: Of the drone's position in a flight, m; of one orientation, and of a centroid's beam, rad.
OFFSET, OWN, BEAM = 0.05, 0.05 * MRAD, 0.2 * MRAD


def installed(rng: np.random.Generator) -> Mechanism:
    return NOMINAL.with_parameters({k: v * rng.standard_normal(COUNT) for k, v in SIZES.items()})


def flown(true: Mechanism, offset: FloatArray, rng: np.random.Generator) -> Sightings:
    """All mirrors in some poses, by a drone that records its positions ``offset`` too far."""
    rows = np.repeat(np.arange(COUNT), POSES)
    counts = np.stack([rng.uniform(2.4, 3.9, len(rows)), rng.uniform(0.5, 1.2, len(rows))], axis=-1)
    pose = true[rows].pose(counts)
    lean = OWN * rng.standard_normal((len(rows), 3))
    place = pose.vertex + 100.0 * normalize(pose.normal + lean) + offset
    return kinds.drone(rows, counts, place, place, sigma=2.0 * OWN)


def aimed(true: Mechanism, rows: list[int], rng: np.random.Generator) -> Sightings:
    """Photographs of some mirrors' beams on a target, in the course of a day."""
    which = np.repeat(rows, 8)
    sun = direction(rng.uniform(2.2, 4.0, len(which)), rng.uniform(0.4, 1.0, len(which)))
    target = np.array([0.0, 0.0, 40.0])
    pose = NOMINAL[which].pose(np.zeros((len(which), 2)))
    wanted = normalize(sun + normalize(target - pose.vertex))
    counts = np.stack(
        [np.arctan2(wanted[:, 0], wanted[:, 1]) % (2.0 * np.pi), np.arcsin(wanted[:, 2])], axis=-1
    )
    real = true[which].pose(counts)
    way = reflect(sun, real.normal) + BEAM * rng.standard_normal((len(which), 3))
    return kinds.camera_target(which, counts, sun, real.vertex + 110.0 * way, sigma=BEAM)


def shared(flight: Sightings, others: int = 0) -> CommonErrors:
    shift = np.zeros((others + len(flight), 3, 3))
    shift[others:] = np.eye(3)
    return CommonErrors(
        shift,
        np.zeros(3),
        OFFSET**2 * np.eye(3),
        np.zeros(len(shift), np.bool_),
        np.zeros(COUNT),
    )


def errors(found: FieldFit, true: Mechanism) -> tuple[FloatArray, FloatArray]:
    """Errors of the mirrors' normals in one pose, (N, 2) rad, and their covariances."""
    counts = np.tile([3.14, 0.9], (COUNT, 1))
    model = NOMINAL.with_parameters(found.parameters)
    place = true.pose(counts)
    seen = kinds.drone(
        np.arange(COUNT),
        counts,
        *(place.vertex + 1e6 * place.normal,) * 2,
    )
    seen = replace(seen, sigma=np.full(COUNT, 2.0))
    # With σ of one radian of the normal, whitened residuals are radians.
    lines = linearise(model, seen, found.names)
    spread = lines.jacobian @ found.covariance @ np.swapaxes(lines.jacobian, -1, -2)
    return lines.residual, spread


def chi(error: FloatArray, spread: FloatArray) -> float:
    return float(
        np.mean(np.einsum("na,na->n", error, np.linalg.solve(spread, error[..., None])[..., 0]))
    )


def test_an_offset_of_the_drone_is_not_taken_for_the_mirrors_errors() -> None:
    blind, told, off = [], [], []
    honest: list[float] = []
    naive: list[float] = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        true, offset = installed(rng), OFFSET * rng.standard_normal(3)
        ground, flight = aimed(true, [0, 5, 10, 15], rng), flown(true, offset, rng)
        both = join([ground, flight])
        alone = fit(NOMINAL, both, MODEL, adapt_scale=False)
        found = fit_common(NOMINAL, both, MODEL, shared(flight, len(ground)), adapt_scale=False)
        for fitted, kept, figures in ((alone, blind, naive), (found.fitted, told, honest)):
            error, spread = errors(fitted, true)
            kept.append(np.sqrt(np.mean(error**2)))
            figures.append(chi(error, spread))
        gap = found.shared - offset
        off.append(gap @ np.linalg.solve(found.shared_covariance, gap))
    # The beams of a quarter of the mirrors tell the offset, and with it all the others.
    assert np.mean(told) < 0.4 * np.mean(blind)
    # χ² of two degrees of freedom for each mirror, of three for the offset of each flight.
    assert 1.2 < np.mean(honest) < 3.2 < 20.0 < np.mean(naive)
    assert 1.0 < np.mean(off) < 6.0


def test_a_flight_alone_says_how_little_it_knows_of_its_offset() -> None:
    rng = np.random.default_rng(1)
    true = installed(rng)
    flight = flown(true, np.array([0.06, -0.04, 0.05]), rng)
    found = fit_common(NOMINAL, flight, MODEL, shared(flight), adapt_scale=False)
    error, spread = errors(found.fitted, true)
    alone, narrow = errors(fit(NOMINAL, flight, MODEL, adapt_scale=False), true)
    # Much of 50 mm at 100 m stays, however many mirrors and poses there are.
    wide, close = (np.sqrt(np.trace(c, axis1=-2, axis2=-1) / 2.0) for c in (spread, narrow))
    assert (wide > 0.15 * MRAD).all()
    assert np.median(wide / close) > 4.0
    assert chi(error, spread) < 4.0 < 20.0 < chi(alone, narrow)


def test_what_each_heliostat_reveals_adds_up_to_what_is_known() -> None:
    rng = np.random.default_rng(2)
    true, offset = installed(rng), np.array([0.05, 0.03, -0.06])
    ground, flight = aimed(true, list(range(COUNT)), rng), flown(true, offset, rng)
    both, common = join([ground, flight]), shared(flight, len(ground))
    found = fit_common(NOMINAL, both, MODEL, common, adapt_scale=False, loss="square")
    whole = np.linalg.inv(common.covariance) + found.information.sum(axis=0)
    np.testing.assert_allclose(found.shared_covariance, np.linalg.inv(whole), rtol=1e-9)
    np.testing.assert_allclose(
        found.shared, np.linalg.solve(whole, found.pull.sum(axis=0)), atol=1e-5
    )
    # One heliostat, with what all the others say of the offset, is as well known as among them.
    rest = np.arange(COUNT) != 3
    known = np.linalg.inv(np.linalg.inv(common.covariance) + found.information[rest].sum(axis=0))
    mine = np.flatnonzero(both.heliostat == 3)
    one = fit_common(
        NOMINAL[[3]],
        both.of(3),
        MODEL,
        replace(
            common,
            shift=common.shift[mine],
            turned=common.turned[mine],
            turn_sigma=np.zeros(1),
            mean=known @ found.pull[rest].sum(axis=0),
            covariance=known,
        ),
        adapt_scale=False,
        loss="square",
    )
    sigma = found.fitted.sigma[3]
    np.testing.assert_allclose(
        one.fitted.values[0], found.fitted.values[3], atol=0.02 * sigma.min()
    )
    np.testing.assert_allclose(one.fitted.sigma[0], sigma, rtol=1e-3)


def test_without_common_errors_it_is_the_plain_fit() -> None:
    rng = np.random.default_rng(3)
    true = installed(rng)
    ground = aimed(true, list(range(COUNT)), rng)
    nothing = CommonErrors(
        np.zeros((len(ground), 3, 0)),
        np.zeros(0),
        np.zeros((0, 0)),
        np.zeros(len(ground), np.bool_),
        np.zeros(COUNT),
    )
    plain, found = fit(NOMINAL, ground, MODEL), fit_common(NOMINAL, ground, MODEL, nothing)
    np.testing.assert_array_equal(found.fitted.values, plain.values)
    np.testing.assert_allclose(found.fitted.covariance, plain.covariance, rtol=1e-6)
    assert found.shared.shape == (0,)
    assert found.turn == pytest.approx(0.0)
