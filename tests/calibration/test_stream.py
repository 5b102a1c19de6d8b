"""The streaming learner: equal to the batch, and hypotheses that later sightings settle."""

import dataclasses
import json

import numpy as np
import pytest
from tests.support.machines import jacks

from heliotrope.calibration.learn import drift, stream
from heliotrope.calibration.learn.drift import Hyperparameters, Linear
from heliotrope.calibration.learn.stream import Belief, Event
from heliotrope.geometry import FloatArray
from heliotrope.mechanism import kinds

MODEL = ("tilt_north", "canting", "elevation_initial_angle", "azimuth_initial_angle")


@pytest.fixture(scope="module")
def hyper() -> Hyperparameters:
    found = drift.start(kinds.two_jacks(np.zeros((1, 3)), drives=jacks()), MODEL)
    mean = np.linspace(-1e-3, 1e-3, len(found.names)) * (found.spread > 0)
    return dataclasses.replace(found, mean=mean, rate=1e-3, spread=np.minimum(found.spread, 8e-3))


def _drawn(
    hyper: Hyperparameters,
    seed: int,
    days: FloatArray,
    shift: FloatArray | None = None,
    steep: float = 4000.0,
) -> tuple[FloatArray, FloatArray]:
    """Derivatives and values of a mirror with constants and noise; ``shift`` moves one zero."""
    rng = np.random.default_rng(seed)
    jacobian = rng.normal(0.0, steep, (len(days), 2, len(hyper.names)))
    truth = hyper.mean + rng.normal(0.0, hyper.spread)
    values = np.tile(truth, (len(days), 1))
    if shift is not None:
        values[:, hyper.names.index("azimuth_initial_angle")] += shift
    value = np.einsum("nap,np->na", jacobian, values)
    return jacobian, value + rng.normal(0.0, hyper.noise, value.shape)


def _streamed(
    hyper: Hyperparameters, jacobian: FloatArray, value: FloatArray, days: FloatArray
) -> Belief:
    belief = stream.begin(hyper)
    for j, v, day in zip(jacobian, value, days, strict=True):
        belief = stream.update(belief, j, v, day)
    return belief


def test_it_equals_the_batch_where_the_events_are_known(hyper: Hyperparameters) -> None:
    """Constants, drift, two steps, a regime, a sighting at an unknown time: to 1e-6 sigma."""
    rng = np.random.default_rng(1)
    count = 60
    # Milder than real ones: the batch subtracts nearly equal numbers where the prior is wide.
    hyper = dataclasses.replace(
        hyper, regime=0.2 * hyper.regime, spread=0.2 * hyper.spread, wide=hyper.spread
    )
    days = np.sort(np.r_[rng.uniform(0, 400, 30), 200 + rng.uniform(0, 1, 30)])
    jacobian, value = _drawn(hyper, 2, days, steep=1000.0)
    value += rng.normal(0.0, 2.0, value.shape)
    regime = np.zeros(count, dtype=np.int64)
    regime[20:32], regime[50:] = 1, 2
    steps = np.array([0.5 * (days[9] + days[10]), 0.5 * (days[39] + days[40])])
    times = days.copy()
    times[5] = np.nan
    data = Linear(
        jacobian=jacobian,
        value=value,
        time=times,
        regime=regime,
        centre=np.linspace(0.0, 1e-3, len(hyper.names)),
        own=np.arange(len(hyper.names)) == 1,
        steps=steps,
        suspect=np.zeros(count, dtype=np.bool_),
    )
    batch = drift.posterior(hyper, data)
    belief = stream.begin(hyper, data.centre, data.own)
    for k in range(count):
        event = Event.NOTHING
        if k in (10, 40):
            event = Event.STEP
        elif k > 0 and regime[k] != regime[k - 1]:
            event = Event.REGIME if regime[k] else Event.RETURN
        belief = stream.update(belief, jacobian[k], value[k], float(times[k]), event)
        if k < 45:
            continue
        values, spread = belief.at(days[k] + 3.0)
        part = drift.posterior(hyper, dataclasses.replace(data.take(np.arange(k + 1)), steps=steps))
        expected, covariance = part.at(np.array([days[k] + 3.0]), regime[k : k + 1])
        sigma = np.sqrt(np.diagonal(covariance[0]))
        assert np.abs((values - expected[0]) / sigma).max() < 1e-6
        assert np.abs((spread - covariance[0]) / np.outer(sigma, sigma)).max() < 1e-6
    assert belief.density == pytest.approx(batch.log_evidence(), abs=1e-5)
    assert len(belief.weight) == 1


def test_one_strange_sighting_remains_a_hypothesis(hyper: Hyperparameters) -> None:
    """A single beam 30 mrad away hardly moves the mirror but is not forgotten; four move it."""
    days = 3.0 * np.arange(34.0)
    lost = np.where(days >= 90.0, 15e-3, 0.0)
    jacobian, value = _drawn(hyper, 4, days, lost)
    place = hyper.names.index("azimuth_initial_angle")
    before = _streamed(hyper, jacobian[:30], value[:30], days[:30])
    usual = before.at(days[29])[0][place]
    one = stream.update(before, jacobian[30], value[30], days[30])
    assert 0.5 < one.mistaken < 1.0
    assert abs(one.at(days[30])[0][place] - usual) < 7e-3
    # The other hypothesis waits: it has a weight, and its zero is where the beam was.
    view = one.layout.view[place]
    moved = one.mean @ view - before.mean[0] @ view
    waiting = np.abs(moved - 15e-3) < 3e-3
    assert 1e-4 < one.weight[waiting].sum() < 0.5
    now = one
    for k in range(31, 34):
        now = stream.update(now, jacobian[k], value[k], days[k])
    assert abs(now.at(days[33])[0][place] - usual - 15e-3) < 2e-3
    # Had the next ones been as before, the strange one would have been settled as a mistake.
    jacobian, value = _drawn(hyper, 4, days, np.where(days == 90.0, 15e-3, 0.0))
    back = one
    for k in range(31, 34):
        back = stream.update(back, jacobian[k], value[k], days[k])
    assert abs(back.at(days[33])[0][place] - usual) < 1e-3
    assert not back.regime[0]


def test_a_step_is_followed(hyper: Hyperparameters) -> None:
    days = 3.0 * np.arange(40.0)
    jacobian, value = _drawn(hyper, 7, days, np.where(days >= 100.0, 2.5e-3, 0.0))
    place = hyper.names.index("azimuth_initial_angle")
    early = _streamed(hyper, jacobian[:33], value[:33], days[:33])
    late = _streamed(hyper, jacobian, value, days)
    moved = late.at(days[-1])[0][place] - early.at(days[32])[0][place]
    assert moved == pytest.approx(2.5e-3, abs=0.4e-3)
    quiet = dataclasses.replace(hyper, rate=0.0)
    belief = stream.begin(quiet)
    for k in range(40):
        belief = stream.update(belief, jacobian[k], value[k], days[k], Event.NOTHING)
    assert late.density > belief.density + 4.0


def test_a_belief_outlives_the_program(hyper: Hyperparameters) -> None:
    days = 3.0 * np.arange(12.0)
    jacobian, value = _drawn(hyper, 8, days, np.where(days >= 20.0, 1.5e-3, 0.0))
    belief = _streamed(hyper, jacobian[:11], value[:11], days[:11])
    again = stream.read_belief(hyper, json.loads(json.dumps(belief.document())))
    both = [stream.update(b, jacobian[11], value[11], days[11]) for b in (belief, again)]
    np.testing.assert_array_equal(both[0].mean, both[1].mean)
    assert both[0].document() == both[1].document()


def test_the_state_does_not_grow(hyper: Hyperparameters) -> None:
    rng = np.random.default_rng(9)
    days = np.cumsum(rng.exponential(5.0, 600))
    jacobian, value = _drawn(hyper, 9, days)
    value[rng.random(600) < 0.05] += 60.0
    belief = _streamed(hyper, jacobian, value, days)
    assert len(belief.weight) <= stream.kernels.MOST
    assert belief.weight.sum() == pytest.approx(1.0)
    for covariance in belief.covariance:
        assert np.linalg.eigvalsh(covariance).min() > -1e-12


def test_errors_that_some_sightings_share_are_constants_for_as_long(hyper: Hyperparameters) -> None:
    """Against the posterior of all at once, with the shared errors integrated out."""
    rng, days, shared = np.random.default_rng(7), np.full(9, 3.0), ("one", "two")
    jacobian, value = _drawn(hyper, 8, days)
    of_shared, spread = rng.normal(0.0, 1.0, (9, 2, 2)), np.array([1.5, 0.5])
    of_shared[[0, 1, 8]] = 0.0  # they belong to the sightings between
    value = value + of_shared @ (spread * rng.standard_normal(2))
    belief = start = stream.begin(hyper)
    for k, day in enumerate(days):
        if k == 2:
            belief = stream.with_constants(belief, shared, spread)
        inside = 2 <= k < 8
        row = np.concatenate([jacobian[k], of_shared[k]], axis=1) if inside else jacobian[k]
        belief = stream.update(belief, row, value[k], day, Event.NOTHING)
        if k == 7:
            belief = stream.without_constants(belief, shared)
    assert belief.hyper.names == hyper.names
    rows = (jacobian @ start.layout.view).reshape(18, -1)
    common = (of_shared * spread).reshape(18, 2)
    noise = hyper.noise**2 * np.eye(18) + common @ common.T
    before = start.covariance[0]
    gain = before @ rows.T @ np.linalg.inv(rows @ before @ rows.T + noise)
    mean = start.mean[0] + gain @ (value.ravel() - rows @ start.mean[0])
    covariance = before - gain @ rows @ before
    sigma = np.sqrt(np.maximum(np.diagonal(covariance), 1e-30))
    assert np.abs((belief.mean[0] - mean) / sigma).max() < 1e-4
    found = np.diagonal(belief.covariance[0])
    np.testing.assert_allclose(found, np.diagonal(covariance), rtol=1e-4, atol=1e-20)
