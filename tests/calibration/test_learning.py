"""Learning a field: regimes, steps, outliers, wandering; what is predicted, and how surely."""

import dataclasses

import numpy as np
import pytest
from numba import njit

from heliotrope.calibration.evaluation import split
from heliotrope.calibration.learn import _drift_kernels as kernels
from heliotrope.calibration.learn import drift, learning
from heliotrope.calibration.learn.assessment import assess
from heliotrope.calibration.learn.learned import Learned
from heliotrope.calibration.learn.learning import learn
from heliotrope.calibration.learn.outliers import critical, generalised_esd, left_out
from heliotrope.calibration.learn.regimes import find_regimes, regime_at
from heliotrope.calibration.sightings import Sightings, sightings
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, direction, reflect
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import direct
from heliotrope.mechanism.tracking import track

AIM = np.array([0.0, 0.0, 40.0])


@njit
def cost_and_gradient(*data):  # type: ignore[no-untyped-def]
    return kernels.cost_and_gradient(*data)


DAY = 86400.0
START = 1.7e9
PRIORS = {
    "tilt_north": 8e-3, "tilt_east": 8e-3, "azimuth_bias": 5e-3, "elevation_bias": 5e-3,
    "non_orthogonality": 2e-3, "canting": 2e-3,
}  # fmt: skip


def field(rows: int, seed: int = 0) -> Mechanism:
    rng = np.random.default_rng(seed)
    place = np.c_[rng.uniform(-80, 80, rows), rng.uniform(-150, -60, rows), np.zeros(rows)]
    drives = (direct(), direct(min_angle=-0.1, max_angle=1.7))
    return kinds.azimuth_elevation(place, pivot_height=2.0, drives=drives)


def measured(
    nominal: Mechanism,
    seed: int,
    *,
    days: int = 10,
    each: int = 4,
    noise: float = 2e-4,
    moved: dict[tuple[int, str], FloatArray] | None = None,
    known: dict[str, float] | None = None,
) -> tuple[Sightings, dict[str, FloatArray]]:
    """Return sightings over a year, ``each`` a day; ``moved`` shifts a parameter by row and day.

    ``known`` gives a parameter the same value everywhere.
    """
    rng = np.random.default_rng(seed)
    count = len(nominal)
    truth = {n: rng.normal(0, s, count) for n, s in PRIORS.items()}
    truth |= {n: np.full(count, value) for n, value in (known or {}).items()}
    parts = []
    for day in range(days):
        now = {n: v.copy() for n, v in truth.items()}
        for (row, name), shift in (moved or {}).items():
            now[name][row] += shift[day]
        real = nominal.with_parameters(now)
        hours = np.sort(rng.uniform(-4, 4, each))
        for hour in hours:
            sun = direction(np.pi + 0.35 * hour, 0.9 - 0.02 * hour**2 - 0.02 * day)
            wanted = track(nominal, sun, AIM)
            counts = wanted.best_counts
            pose = real.pose(counts)
            ray = reflect(sun, pose.normal)
            way = AIM - pose.vertex
            length = np.linalg.norm(way, axis=-1, keepdims=True)
            spot = pose.vertex + length * ray / np.sum(ray * way / length, axis=-1, keepdims=True)
            spot += rng.normal(0.0, noise, spot.shape) * length
            time = START + DAY * (36.0 * day) + 3600.0 * hour
            parts.append(
                (np.arange(count), counts, np.tile(sun, (count, 1)), spot, np.full(count, time))
            )
    rows, counts, source, spot, time = (np.concatenate(p) for p in zip(*parts, strict=True))
    return sightings(rows, counts, source, spot, time=time, sigma=2e-4), truth


@pytest.fixture(scope="module")
def troubled() -> tuple[Learned, Sightings, np.ndarray]:
    """Ten mirrors: 0 has a new reference, 1 one lost for a while, 2 a small step, 3 mistakes."""
    nominal = field(10)
    late, between, small = np.zeros(10), np.zeros(10), np.zeros(10)
    late[6:], between[3:5], small[5:] = 12e-3, -9e-3, 1.2e-3
    moved = {
        (0, "azimuth_bias"): late,
        (1, "elevation_bias"): between,
        (2, "elevation_bias"): small,
    }
    seen, _ = measured(nominal, 5, moved=moved)
    rows = np.flatnonzero(seen.heliostat == 3)
    spoilt = rows[[4, 5, 21, 30]]
    spots = seen.destination.copy()
    spots[spoilt] += [4.0, 0.0, 1.0]
    spots[spoilt[2:]] += [-9.0, 0.0, 0.5]
    seen = dataclasses.replace(seen, destination=spots)
    return learn(nominal, seen, "guo6"), seen, spoilt


def test_a_new_reference_cuts_time(troubled: tuple[Learned, Sightings, np.ndarray]) -> None:
    found, seen, _ = troubled
    day = np.round((seen.time - START) / DAY / 36.0).astype(int)
    mine = seen.heliostat == 0
    before, after = set(found.regime[mine & (day < 6)]), set(found.regime[mine & (day >= 6)])
    assert len(before) == len(after) == 1
    assert before != after
    lost = seen.heliostat == 1
    assert set(found.regime[lost & ((day < 3) | (day > 4))]) == {0}
    assert set(found.regime[lost & (day >= 3) & (day <= 4)]) == {1}
    assert not found.regime[seen.heliostat >= 3].any()
    # The latest regime is what the future is predicted with.
    future = np.full(1, START + 400.0 * DAY)
    assert set(found.regimes(0, future)) == after
    names = found.names
    shift = found.parameters_at([0, 0], [START + 400 * DAY, START + 100 * DAY])[0]
    moved = shift[0, names.index("azimuth_bias")] - shift[1, names.index("azimuth_bias")]
    assert moved == pytest.approx(12e-3, abs=0.5e-3)


def test_a_step_is_found_where_it_was(troubled: tuple[Learned, Sightings, np.ndarray]) -> None:
    found, _, _ = troubled
    steps = found.members[2].data.steps * DAY
    assert len(steps) == 1
    assert START + 4 * 36 * DAY < steps[0] < START + 5 * 36 * DAY
    assert sum(len(m.data.steps) for m in found.members) == 1
    names = found.names
    values, _ = found.parameters_at([2, 2], [START + 400 * DAY, START])
    place = names.index("elevation_bias")
    assert values[0, place] - values[1, place] == pytest.approx(1.2e-3, abs=0.3e-3)


def test_outliers_are_named_and_only_they(troubled: tuple[Learned, Sightings, np.ndarray]) -> None:
    found, _, spoilt = troubled
    assert set(np.flatnonzero(found.outlier)) == set(spoilt)


def test_outliers_are_reversible(troubled: tuple[Learned, Sightings, np.ndarray]) -> None:
    """Nothing is thrown away: without them the same field is learnt again."""
    found, seen, _ = troubled
    again = learn(found.mechanism, seen, "guo6", used=~found.outlier)
    assert not again.outlier.any()
    now = np.full(10, START + 330 * DAY)
    first, _ = found.parameters_at(np.arange(10), now)
    second, spread = again.parameters_at(np.arange(10), now)
    sigma = np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
    assert (np.abs(first - second) < 0.5 * sigma + 1e-9).all()


def test_two_alike_do_not_hide_each_other() -> None:
    rng = np.random.default_rng(0)
    rest = rng.normal(size=(30, 2))
    rest[[3, 4]] = [9.0, 9.0]
    rest[20] = [0.0, -7.5]
    # The pair hides nothing: neither itself nor the third.
    mask = generalised_esd(rest, np.eye(60))
    assert set(np.flatnonzero(mask)) == {3, 4, 20}
    shared = np.eye(60) + 4.0 * np.kron(np.ones((30, 30)), np.eye(2))
    assert set(np.flatnonzero(generalised_esd(rest + 3.0, shared))) == {3, 4, 20}


def test_false_alarms_are_as_rare_as_stated() -> None:
    rng = np.random.default_rng(1)
    trials = [generalised_esd(rng.normal(size=(25, 2)), np.eye(50), alpha=0.05) for _ in range(400)]
    share = np.mean([mask.any() for mask in trials])
    assert 0.02 < share < 0.09
    assert critical(100, 0.01) == pytest.approx(2 * np.log(1e4))
    with pytest.raises(InputError, match=r"alpha must be .* not 2"):
        generalised_esd(rng.normal(size=(5, 2)), np.eye(10), alpha=2.0)


def test_noise_alone_makes_no_regimes() -> None:
    rng = np.random.default_rng(2)
    slope = np.tile(2000.0 * np.eye(2), (60, 1, 1))
    for _ in range(20):
        time = np.sort(rng.uniform(0, 1e7, 60))
        assert not find_regimes(time, rng.normal(size=(60, 2)), slope).any()
    # Nor do unknown times, or too few.
    assert not find_regimes(np.full(60, np.nan), rng.normal(size=(60, 2)) + 50, slope).any()
    assert not find_regimes([0.0], [[1.0, 2.0]], slope[:1]).any()


def test_regime_between_sightings_is_the_nearest() -> None:
    time, label = np.array([10.0, 0.0, np.nan, 20.0]), np.array([1, 0, 0, 2])
    when = np.array([-5.0, 4.0, 6.0, 14.0, 16.0, 99.0, np.nan])
    np.testing.assert_array_equal(regime_at(time, label, when), [0, 0, 1, 1, 2, 2, 0])


@pytest.fixture(scope="module")
def wandering() -> tuple[Learned, Sightings]:
    """Thirty mirrors whose zeros creep by 0.5 mrad within 200 days."""
    nominal = field(30, seed=1)
    rng = np.random.default_rng(7)
    steps = np.exp(-36.0 / 200.0)
    moved = {}
    for row in range(30):
        for name in ("azimuth_bias", "elevation_bias"):
            x = [rng.normal(0, 5e-4)]
            for _ in range(15):
                x.append(steps * x[-1] + np.sqrt(1 - steps**2) * rng.normal(0, 5e-4))
            moved[row, name] = np.array(x)
    seen, _ = measured(nominal, 8, days=16, moved=moved)
    return learn(nominal, seen, "guo6", used=split(seen, "random", 0.7, 0)), seen


def test_wandering_is_learnt(wandering: tuple[Learned, Sightings]) -> None:
    found, _ = wandering
    h = found.hyper
    slow = [a for p, a in zip(h.processes, h.amplitude, strict=True) if p.group == "slow"]
    assert np.mean(slow) == pytest.approx(5e-4, rel=0.4)
    assert 80.0 < h.tau[h.groups.index("slow")] < 500.0
    assert h.noise == pytest.approx(1.0, rel=0.15)


def test_what_wanders_is_predicted_and_the_ellipse_is_true(
    wandering: tuple[Learned, Sightings],
) -> None:
    found, seen = wandering
    names = tuple(f"H{i}" for i in range(30))
    moving = assess(names, found)
    still = assess(names, learn(found.mechanism, seen, "guo6", used=found.used, processes=()))
    assert moving.median_of_medians < 0.75 * still.median_of_medians
    assert 0.85 <= moving.coverage <= 0.95
    assert moving.blunders == 0
    document = moving.document()
    assert {"n", "median_beam_mrad", "rms_beam_mrad", "p95_beam_mrad", "coverage_90"} <= set(
        document["heliostats"]["H0"]
    )


def test_tracking_by_the_learnt_mirror_of_the_day(wandering: tuple[Learned, Sightings]) -> None:
    """The processes' mean is in the mechanism that tracks, and their spread in its covariance."""
    found, seen = wandering
    rows, time = seen.heliostat[:60], seen.time[:60]
    machines = found.mechanism_at(rows, time)
    assert track(machines, seen.source[:60], AIM).reachable.all()
    near = found.parameters_at(rows[:5], time[:5])[1]
    far = found.parameters_at(rows[:5], time[:5] + 3000 * DAY)[1]
    place = found.names.index("azimuth_bias")
    assert (far[:, place, place] > near[:, place, place]).all()
    unknown, _ = found.parameters_at([0], [np.nan])
    assert np.isfinite(unknown).all()


def test_threads_and_order_change_no_bit(
    wandering: tuple[Learned, Sightings], monkeypatch: pytest.MonkeyPatch
) -> None:
    found, seen = wandering
    order = np.random.default_rng(3).permutation(len(seen))
    mixed = learn(found.mechanism, seen.take(order), "guo6", used=found.used[order])
    monkeypatch.setenv("HELIOTROPE_THREADS", "1")
    single = learn(found.mechanism, seen, "guo6", used=found.used)
    when = np.full(30, START + 500 * DAY)
    wanted = found.parameters_at(np.arange(30), when)
    for other in (mixed, single):
        values = other.parameters_at(np.arange(30), when)
        np.testing.assert_array_equal(values[0], wanted[0])
        np.testing.assert_array_equal(values[1], wanted[1])
        np.testing.assert_array_equal(other.static.values, found.static.values)
    np.testing.assert_array_equal(mixed.outlier, found.outlier[order])


def test_gradient_of_the_evidence() -> None:
    nominal = field(3)
    seen, _ = measured(nominal, 2, days=5)
    first = drift.start(nominal, ("tilt_north", "azimuth_bias", "elevation_bias"))
    used = np.ones(len(seen), dtype=np.bool_)
    prepared = learning.prepare(
        nominal, seen, ("tilt_north", "azimuth_bias", "elevation_bias"), first.names, used
    )
    data = dataclasses.replace(prepared.field[0], steps=np.array([START / DAY + 80.0]))

    def value(vector: FloatArray) -> tuple[float, FloatArray]:
        h = first.with_vector(vector)
        return cost_and_gradient(
            data.jacobian,
            data.time,
            data.regime,
            data.epoch,
            data.rest(h),
            data.spread(h) ** 2,
            h.regime**2,
            h.step**2,
            h.part,
            h.group,
            h.amplitude,
            h.tau,
            h.noise,
        )

    at = first.vector + 0.3
    _, gradient = value(at)
    for k in range(len(at)):
        shift = np.zeros(len(at))
        shift[k] = 1e-5
        numeric = (value(at + shift)[0] - value(at - shift)[0]) / 2e-5
        assert gradient[k] == pytest.approx(numeric, rel=1e-4, abs=1e-4)
    # The cost is the evidence, but for its constant.
    h = first.with_vector(at)
    evidence = drift.posterior(h, data).log_evidence()
    assert value(at)[0] == pytest.approx(-evidence - len(data) * np.log(2 * np.pi), rel=1e-9)


def test_left_out_is_what_learning_without_it_says() -> None:
    nominal = field(2)
    seen, _ = measured(nominal, 4, days=4)
    first = drift.start(nominal, tuple(PRIORS))
    used = np.ones(len(seen), dtype=np.bool_)
    data = learning.prepare(nominal, seen, tuple(PRIORS), first.names, used).field[0]
    whole = drift.posterior(first, data)
    square, error, spread = whole.left_out()
    for k in (0, 7, 15):
        others = np.delete(np.arange(len(data)), k)
        apart = drift.posterior(first, data.take(others))
        one = data.take([k])
        values, cov = apart.at(one.time, one.regime)
        expected = one.jacobian[0] @ (values[0] - data.centre)
        np.testing.assert_allclose(error[k], data.value[k] - expected, atol=1e-6)
        wanted = one.jacobian[0] @ cov[0] @ one.jacobian[0].T + first.noise**2 * np.eye(2)
        np.testing.assert_allclose(spread[k], wanted, rtol=1e-6, atol=1e-8)
    assert square.shape == (len(data),)


def test_nothing_to_learn_from_is_the_prior() -> None:
    nominal = field(3)
    seen, _ = measured(nominal, 2, days=2)
    found = learn(nominal, seen.take(seen.heliostat == 1), "guo6")
    values, spread = found.parameters_at([0, 1, 2], [START] * 3)
    place = found.names.index("tilt_north")
    assert np.isfinite(values).all()
    assert spread[0, place, place] > 5 * spread[1, place, place]
    empty = learn(nominal, seen.take([]), "guo6")
    assert np.isfinite(empty.parameters_at([0], [START])[0]).all()


def test_guos_zeros_are_those_before_the_fit_and_his_scatter_that_after_it() -> None:
    nominal = field(2, seed=3)
    # His zeros are measured minus true: our biases with the opposite sign.
    seen, _ = measured(
        nominal, 8, noise=2e-4, known={"azimuth_bias": -8e-3, "elevation_bias": 6e-3}
    )
    found = learn(nominal, seen, "guo6", used=split(seen, "random", 0.7))
    for figures in assess(("A", "B"), found).heliostats:
        assert figures.axes is not None
        # The held-out mean has the error of a dozen sightings and of the correlation with tilt.
        assert figures.axes.gamma_0 == pytest.approx(8e-3, abs=1e-3)
        assert figures.axes.alpha_0 == pytest.approx(-6e-3, abs=0.5e-3)
        # 0.2 mrad of the beam is 0.1 mrad of the normal; azimuth shows it magnified.
        assert 0.05e-3 < figures.axes.sigma_alpha < 0.2e-3
        assert 0.05e-3 < figures.axes.sigma_gamma < 0.6e-3
        assert figures.document()["gamma_0_mrad"] == pytest.approx(8.0, abs=1.0)


def test_left_out_and_gains_are_those_of_the_definition() -> None:
    """Every sighting is predicted from the others, and every step weighed, without the lemmas."""
    rng = np.random.default_rng(5)
    n, size = 7, 2
    root = rng.normal(size=(2 * n, 2 * n))
    covariance = root @ root.T + np.eye(2 * n)
    rest, slope = rng.normal(size=(n, 2)), rng.normal(size=(n, 2, size))
    inverse, variance = np.linalg.inv(covariance), np.array([0.5, 2.0])
    square, error, spread = left_out(inverse, inverse @ rest.ravel())
    for i in range(n):
        mine = np.array([2 * i, 2 * i + 1])
        others = np.setdiff1d(np.arange(2 * n), mine)
        share = covariance[np.ix_(mine, others)] @ np.linalg.inv(covariance[np.ix_(others, others)])
        gap = rest[i] - share @ rest.ravel()[others]
        left = covariance[np.ix_(mine, mine)] - share @ covariance[np.ix_(others, mine)]
        np.testing.assert_allclose(error[i], gap, rtol=1e-9)
        np.testing.assert_allclose(spread[i], left, rtol=1e-9)
        assert square[i] == pytest.approx(gap @ np.linalg.solve(left, gap))
    gains = kernels.step_gains(inverse, inverse @ rest.ravel(), slope, variance)
    assert gains[0] == 0.0
    for k in range(1, n):
        moved = slope.copy()
        moved[:k] = 0.0
        moved = moved.reshape(2 * n, size)
        with_step = covariance + moved @ np.diag(variance) @ moved.T
        fits = [
            rest.ravel() @ np.linalg.solve(c, rest.ravel()) + np.linalg.slogdet(c)[1]
            for c in (covariance, with_step)
        ]
        assert gains[k] == pytest.approx(0.5 * (fits[0] - fits[1]), rel=1e-9)
