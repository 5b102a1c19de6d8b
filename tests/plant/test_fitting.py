"""What a visit proposes: the drift followed, or constants where the belief sees mistakes."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from heliotrope.calibration.evaluation import beam_errors
from heliotrope.calibration.fit.estimator import fit
from heliotrope.calibration.learn import drift
from heliotrope.calibration.learn.own_model import OwnModel
from heliotrope.calibration.record import CalibrationOutcome, HeliostatCalibration
from heliotrope.calibration.sightings import Sightings, sightings
from heliotrope.calibration.uncertainty import expected_error
from heliotrope.field.example import roughly_installed
from heliotrope.field.layouts import malan_plant
from heliotrope.geometry import MRAD, FloatArray, reflect
from heliotrope.mechanism import parameters
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.tracking import track
from heliotrope.optics.beam import CHI_SQUARE_90
from heliotrope.plant.field.beliefs import Beliefs
from heliotrope.plant.visits.fitting import Believed, JudgedFit, fit_heliostat, surprise_of
from heliotrope.plant.visits.settings import CycleSettings
from heliotrope.plant.visits.swings import swung
from heliotrope.sun import vector

PLANT = malan_plant(4)
NAME = PLANT.names[0]
BEGIN = datetime(2026, 6, 1, 7, tzinfo=UTC).timestamp()
HOUR, DAY = 3600.0, 86400.0


def photographs(times: FloatArray, zero: FloatArray) -> Sightings:
    """Sightings of a mirror whose first zero is off by ``zero`` (M,), rad."""
    nominal, count = Beliefs(PLANT).nominal(NAME), len(times)
    suns, aim = vector(times, PLANT.site), PLANT.targets[0].center
    many = nominal[np.zeros(count, np.intp)]
    counts = track(many, suns, aim).best_counts
    pose = many.with_parameters({drift.zeros(nominal)[0]: zero}).pose(counts)
    away = np.linalg.norm(aim - pose.vertex, axis=1)[:, None]
    noise = 2e-4 * np.random.default_rng(5).standard_normal((count, 3))
    seen = pose.vertex + away * (reflect(suns, pose.normal) + noise)
    return sightings(np.zeros(count, np.intp), counts, suns, seen, time=times, sigma=5e-4)


def fitted(beliefs: Beliefs, seen: Sightings) -> JudgedFit:
    names = parameters.model("malan8", beliefs.nominal(NAME).parameters)
    return fit_heliostat(
        Believed.of(beliefs, NAME), CycleSettings(), OwnModel("malan8", names), seen
    )


def believed(beliefs: Beliefs, found: JudgedFit, at: float) -> HeliostatCalibration:
    """Let the plant believe a fit, as a visit does."""
    record = HeliostatCalibration(
        NAME, at, found.fitted.names, found.fitted.values[0], found.fitted.covariance[0],
        found.fitted.prior[0],
    )  # fmt: skip
    return beliefs.take(record)


def test_a_mirror_that_has_stepped_is_calibrated_by_its_last_photographs() -> None:
    """Constants are held back by the 30 photographs before the step."""
    times = BEGIN + np.concatenate(
        [DAY * day + HOUR * np.array([0.0, 3.0, 6.0]) for day in np.arange(0.0, 24.0, 2.0)]
    )
    seen = photographs(times, np.where(times < BEGIN + 21 * DAY, 0.0, 2 * MRAD))
    beliefs = Beliefs(PLANT)
    old = seen.take(np.arange(33))
    record = believed(beliefs, fitted(beliefs, old), float(old.time[-1]))
    found = fitted(beliefs, seen)
    assert found.outcome is CalibrationOutcome.CALIBRATED
    assert found.before > 3 * MRAD
    assert found.after < 1 * MRAD
    assert surprise_of(record, beliefs.nominal(NAME), seen.take(np.arange(33, 36))) > 4.0


def test_what_came_within_the_hour_is_proposed_as_constants_explain_it() -> None:
    """No step is believed within an hour; constants leave it to the verification."""
    times = BEGIN + np.concatenate([60.0 * np.arange(5), 900.0 + 60.0 * np.arange(5)])
    seen = photographs(times, np.where(np.arange(10) < 5, 0.0, 8 * MRAD))
    beliefs = Beliefs(PLANT)
    first = fitted(beliefs, seen.take(np.arange(5)))
    believed(beliefs, first, float(times[4]))
    names = parameters.model("malan8", beliefs.nominal(NAME).parameters)
    model = OwnModel("malan8", names)
    constants = fit(beliefs.nominal(NAME), seen, names)
    found = fit_heliostat(Believed.of(beliefs, NAME), CycleSettings(left=1.0), model, seen)
    np.testing.assert_array_equal(found.fitted.values, constants.values)


def test_photographs_surprise_less_the_older_the_calibration() -> None:
    times = BEGIN + HOUR * np.arange(6.0)
    beliefs = Beliefs(PLANT)
    record = believed(beliefs, fitted(beliefs, photographs(times, np.zeros(6))), times[-1])
    nominal, surprise = beliefs.nominal(NAME), []
    usual = photographs(times[-1] + np.array([600.0]), np.zeros(1))
    assert surprise_of(record, nominal, usual) < 4.0
    shifted = photographs(times[-1] + np.array([600.0]), np.full(1, 2 * MRAD))
    for days in (0.0, 30.0, 300.0):
        later = replace(shifted, time=shifted.time + days * DAY)
        surprise.append(surprise_of(record, nominal, later))
    assert surprise[0] > 4.0
    assert (np.diff(surprise) < -0.3).all()


#: Photographs of a first visit: where on the target, m right and up of its middle.
CORNERS = np.array([(0.0, 0.0), (3.0, 3.0), (-3.0, -3.0), (3.0, -3.0)])
MODEL = "malan8+canting"


def first_visit(
    truth: Mechanism, begin: float, rng: np.random.Generator, swing: float
) -> Sightings:
    """Four photographs in half a minute, each in a swing of the first axis with 6 %."""
    target = PLANT.targets[0]
    aims, times = target.center + CORNERS @ target.axes, begin + 8.0 * np.arange(4)
    suns, many = vector(times, PLANT.site), truth[np.zeros(4, np.intp)]
    counts = track(many, suns, aims).best_counts
    steps = swing / np.abs(truth.drives.radians_per_count(counts[0]))[..., 0]
    away = np.linalg.norm(aims - many.pose(counts).vertex, axis=1)
    seen = aims + (1e-4 * away[:, None] * rng.standard_normal((4, 2))) @ target.axes
    counts[:, 0] -= (rng.random(4) < 0.06) * steps
    return sightings(np.zeros(4, np.intp), counts, suns, seen, time=times, sigma=2e-4)


@pytest.mark.parametrize("case", ["as wrong as the priors say", "a quick installation that swings"])
def test_a_field_freshly_commissioned_knows_its_errors(case: str) -> None:
    """The 90 % ellipse of each beam on the receiver: at once, an hour, and a day after a visit."""
    plant, rng = malan_plant(320), np.random.default_rng(4)
    beliefs, settings = Beliefs(plant), CycleSettings(sigma=2e-4)
    (group,) = plant.groups.values()
    known = group.mechanism.parameters
    names = parameters.model(MODEL, known)
    swings = case.endswith("swings")
    truth = (
        roughly_installed(group.mechanism, seed=1)
        if swings
        else group.mechanism.with_parameters(
            {name: rng.normal(0.0, known[name].prior, len(group)) for name in names}
        )
    )
    aim, inside = plant.receivers[0].center, []
    for i in rng.permutation(len(group))[:40]:
        here, name = truth[np.array([i])], group.names[i]
        seen = first_visit(here, BEGIN, rng, 0.63 * MRAD if swings else 0.0)
        found = fit_heliostat(Believed.of(beliefs, name), settings, OwnModel(MODEL, names), seen)
        for later in (0.0, HOUR, DAY):
            sun = vector(np.array([BEGIN + later]), PLANT.site)
            spread = beliefs.growth(name).grown(
                found.fitted.covariance[0], found.fitted.names, later / DAY
            )
            expected = expected_error(found.mechanism, found.fitted.names, spread, sun, aim)
            sent = sightings(
                np.zeros(1, np.intp), track(found.mechanism, sun, aim).best_counts, sun, aim
            )
            off = beam_errors(here, sent).offset[0]
            inside.append(off @ np.linalg.solve(expected.covariance[0], off) <= CHI_SQUARE_90)
    share = np.mean(np.reshape(inside, (40, 3)), axis=0)
    assert (share >= 0.85).all(), share
    assert share.mean() <= 0.98, share


def test_a_photograph_in_a_swing_leaves_a_mirror_that_knows_its_error() -> None:
    """One photograph of four at the deepest point of a swing, told or not that it may be one."""
    plant, rng, settings = malan_plant(320), np.random.default_rng(4), CycleSettings(sigma=2e-4)
    (group,) = plant.groups.values()
    axis, target = plant.machine(group.names[0]).axes[0], PLANT.targets[0]
    truth = roughly_installed(group.mechanism, seed=1)
    names = parameters.model(MODEL, group.mechanism.parameters)
    aim, sun = plant.receivers[0].center, vector(np.array([BEGIN]), PLANT.site)
    inside, error = np.zeros((24, 2)), np.zeros((24, 2))
    for k, i in enumerate(rng.permutation(len(group))[:24]):
        here, name = truth[np.array([i])], group.names[i]
        seen = first_visit(here, BEGIN, rng, 0.0)
        swings, m = np.zeros_like(seen.counts), int(rng.integers(4))
        swings[m, 0] = axis.backlash
        beams = [
            target.intersect(p.vertex, reflect(seen.source, p.normal))
            for p in (
                here[np.zeros(4, np.intp)].pose(seen.counts - s) for s in (0.0 * swings, swings)
            )
        ]
        off = (beams[1] - beams[0])[m]
        slope = off / axis.backlash
        wider = np.zeros((4, 3, 3))
        wider[m] = swung(axis, 10.0, 1.0) * np.outer(slope, slope)
        moved = seen.destination.copy()
        moved[m] += off
        for told in (0, 1):
            covariance = seen.destination_covariance + told * wider
            made = replace(seen, destination=moved, destination_covariance=covariance)
            beliefs = Beliefs(plant)
            found = fit_heliostat(
                Believed.of(beliefs, name), settings, OwnModel(MODEL, names), made
            )
            expected = expected_error(
                found.mechanism, found.fitted.names, found.fitted.covariance[0], sun, aim
            )
            sent = sightings(
                np.zeros(1, np.intp), track(found.mechanism, sun, aim).best_counts, sun, aim
            )
            miss = beam_errors(here, sent).offset[0]
            error[k, told] = np.linalg.norm(miss)
            inside[k, told] = miss @ np.linalg.solve(expected.covariance[0], miss) <= CHI_SQUARE_90
    share, worst = inside.mean(axis=0), np.percentile(error, 90, axis=0)
    assert share[0] < 0.75, share
    assert share[1] >= 0.8, share
    assert worst[1] < 0.7 * worst[0], worst
