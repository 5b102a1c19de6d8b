"""Planning of sightings: derivatives, optimality, campaigns without conflicts, the command."""

import csv
import json
import sys
import time
from datetime import UTC, datetime
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from heliotrope import sun
from heliotrope.calibration._allocation import Option, allocate, exchanged
from heliotrope.calibration.campaign import Campaign, Fleet, Timing, campaign
from heliotrope.calibration.estimator import fit
from heliotrope.calibration.information import Expectation, expectation, precision, suns_of_year
from heliotrope.calibration.planning import Candidates, Limits, Plan, candidates, grid, plan
from heliotrope.calibration.sighting_table import write_sightings
from heliotrope.calibration.sightings import Sightings, camera_target
from heliotrope.cli import main
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.example import azimuth_elevation, prototype
from heliotrope.field.formats.plant_file import write_plant
from heliotrope.field.plant import Plant
from heliotrope.field.target import Target
from heliotrope.geometry import MRAD, FloatArray, angle_between, bisector, reflect, tangent_axes
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import SLOTS, linear_paint
from heliotrope.mechanism.parameters import MODELS
from heliotrope.mechanism.tracking import Status, track

START = datetime(2026, 9, 2, tzinfo=UTC).timestamp()
DAY = 86400.0
NAMES = MODELS["malan8"]
PLANT = prototype()
FIELD = PLANT.groups["azel"].mechanism
AIM = PLANT.receivers[0].center


def _second_target() -> Target:
    """Beside the first, turned to the south-east."""
    first = PLANT.targets[0]
    turn = np.array([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    center = first.center + np.array([0.0, 0.0, -4.0])
    corners = (first.corners - first.center) @ turn.T + center
    return Target("lower", corners, center)


TARGETS = (*PLANT.targets, _second_target())


@pytest.fixture(scope="module")
def possible() -> Candidates:
    """Three days of the whole field on two targets."""
    return candidates(FIELD, PLANT.site, TARGETS, grid(START, START + 3 * DAY, 3600.0), NAMES)


@pytest.fixture(scope="module")
def year() -> Expectation:
    """What errors do over the year."""
    return expectation(FIELD, AIM, suns_of_year(PLANT.site, 2026), NAMES)


# --- candidates -----------------------------------------------------------------------


def test_candidates_keep_to_sun_stops_and_limits(possible: Candidates) -> None:
    limits = Limits()
    assert set(possible.heliostat) == set(range(18))
    assert set(possible.target) == {0, 1}
    above = sun.position(possible.time, PLANT.site)
    np.testing.assert_allclose(possible.sun, above.vector, rtol=0, atol=1e-12)
    assert (above.elevation >= limits.min_elevation).all()
    table = FIELD.drives.table[possible.heliostat]
    angles = FIELD[possible.heliostat].drives.angles(possible.counts)
    assert (angles >= table[..., SLOTS["min_angle"]] - 1e-9).all()
    assert (angles <= table[..., SLOTS["max_angle"]] + 1e-9).all()
    pose = FIELD[possible.heliostat].pose(possible.counts)
    ray = reflect(possible.sun, pose.normal)
    for k, target in enumerate(TARGETS):
        mine = possible.target == k
        hit = target.intersect(pose.vertex[mine], ray[mine])
        np.testing.assert_allclose(hit - target.center, 0.0, rtol=0, atol=1e-7)
        slant = angle_between(-ray[mine], np.broadcast_to(target.normal, ray[mine].shape))
        np.testing.assert_allclose(slant, possible.obliquity[mine], rtol=0, atol=1e-9)
    assert (possible.obliquity <= limits.max_obliquity).all()
    incidence = angle_between(possible.sun, pose.normal)
    np.testing.assert_allclose(incidence, possible.incidence, rtol=0, atol=1e-9)


def test_nothing_that_is_possible_is_left_out(possible: Candidates) -> None:
    """Counted again, one heliostat and one time after the other."""
    times = grid(START, START + 3 * DAY, 3600.0)
    count = 0
    for moment, vector in zip(times, sun.vector(times, PLANT.site), strict=True):
        if sun.position(moment, PLANT.site).elevation < Limits().min_elevation:
            continue
        for target in TARGETS:
            solved = track(FIELD, vector, target.center)
            ray = reflect(vector, solved.chosen(solved.normal))
            slant = angle_between(-ray, np.broadcast_to(target.normal, ray.shape))
            lit = angle_between(np.broadcast_to(vector, ray.shape), ray) / 2 <= np.radians(75.0)
            count += int((solved.chosen(solved.reachable) & lit & (slant <= np.radians(70))).sum())
    assert len(possible) == count


def test_limits_narrow_the_choice(possible: Candidates) -> None:
    times = grid(START, START + 3 * DAY, 3600.0)
    narrow = Limits(np.radians(30.0), np.radians(35.0), np.radians(40.0))
    found = candidates(FIELD, PLANT.site, TARGETS, times, NAMES, limits=narrow)
    assert 0 < len(found) < len(possible)
    assert found.incidence.max() <= narrow.max_incidence
    assert found.obliquity.max() <= narrow.max_obliquity


def _jack_plant() -> Mechanism:
    jacks = [
        linear_paint(154166.6667, 0.0774, 0.335, 0.338, 0.0446, clockwise=c, speed=300.0)
        for c in (0, 1)
    ]
    return kinds.azimuth_elevation(
        np.array([[20.0, -60.0, 0.0]]), pivot_height=1.7, pivot_offset=0.17,
        drives=(azimuth_elevation(np.zeros((1, 3))).drives[0], jacks[1]),
    )  # fmt: skip


@pytest.mark.parametrize("names", [NAMES, (*MODELS["khalsa8"], "sag", "pivot_offset")])
def test_jacobian_against_finite_differences(names: tuple[str, ...]) -> None:
    """Whitened normal minus bisector, the bisector moving with the vertex."""
    mechanism, sigma = FIELD[3:6], 4e-4
    found = candidates(mechanism, PLANT.site, TARGETS, grid(START, START + DAY, 7200.0), names,
                       sigma=sigma)  # fmt: skip
    assert len(found) > 20
    whole = mechanism[found.heliostat]
    centers = np.array([t.center for t in TARGETS])[found.target]
    pose = whole.pose(found.counts)
    way = centers - pose.vertex
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    v = bisector(found.sun, way)
    axes = tangent_axes(v)
    size = np.linalg.norm(found.sun + way, axis=-1)[:, None, None]
    # The covariance of the bisector for a ray known to sigma in both directions.
    across = axes / size
    turn = np.eye(3) - way[:, :, None] * way[:, None, :]
    covariance = across @ turn @ np.swapaxes(across, 1, 2) * sigma**2

    def gap(moved: Mechanism) -> FloatArray:
        there = moved.pose(found.counts)
        beam = centers - there.vertex
        beam /= np.linalg.norm(beam, axis=-1, keepdims=True)
        return np.einsum("mak,mk->ma", axes, there.normal - bisector(found.sun, beam))

    # Whitening is known up to a rotation: compare JᵀJ, which is all that planning uses.
    slopes = [
        (gap(whole.with_parameters({n: 1e-6})) - gap(whole.with_parameters({n: -1e-6}))) / 2e-6
        for n in names
    ]
    slope = np.stack(slopes, axis=-1)
    wanted = np.swapaxes(slope, 1, 2) @ np.linalg.inv(covariance) @ slope
    information = np.swapaxes(found.jacobian, 1, 2) @ found.jacobian
    largest = np.abs(wanted).max()
    np.testing.assert_allclose(information, wanted, rtol=0, atol=1e-7 * largest)


def test_beam_variance_against_moved_mirrors(year: Expectation) -> None:
    """The form gives the beam's error of a mirror that is not as it is believed to be."""
    rng = np.random.default_rng(1)
    suns = suns_of_year(PLANT.site, 2026)
    sizes = np.array([FIELD.parameter(n).prior for n in NAMES])
    for _ in range(3):
        x = rng.normal(0.0, 0.05 * sizes)
        moved = FIELD[7].with_parameters(dict(zip(NAMES, x, strict=True)))
        solved = track(FIELD[7], suns, AIM)
        pose = moved.pose(solved.chosen(solved.counts))
        way = (AIM - pose.vertex) / np.linalg.norm(AIM - pose.vertex, axis=-1, keepdims=True)
        beam = angle_between(reflect(suns, pose.normal), way)
        predicted = year.rms(np.multiply.outer(x, x))[7]
        assert predicted == pytest.approx(np.sqrt(np.mean(beam**2)), rel=0.01)


# --- plan -----------------------------------------------------------------------------


def _log_det(found: Candidates, rows: Any, information: FloatArray) -> float:
    slope = found.jacobian[list(rows)].reshape(-1, information.shape[-1])
    scale = 1.0 / np.sqrt(np.diagonal(information))
    total = (information + slope.T @ slope) * scale[:, None] * scale
    return float(np.linalg.slogdet(total)[1] - np.linalg.slogdet(
        information * scale[:, None] * scale)[1])  # fmt: skip


def _square(found: Candidates, rows: Any, information: FloatArray, form: FloatArray) -> float:
    slope = found.jacobian[list(rows)].reshape(-1, information.shape[-1])
    return float(np.trace(form @ np.linalg.inv(information + slope.T @ slope)))


def _planned(possible: Candidates, year: Expectation, i: int, count: int, **options: Any) -> Plan:
    return plan(possible.of(i), count, precision(FIELD, NAMES)[i], year.form[i], **options)


@pytest.mark.parametrize("criterion", ["d", "v"])
def test_never_worse_than_random(possible: Candidates, year: Expectation, criterion: Any) -> None:
    rng = np.random.default_rng(0)
    for i in (0, 8, 15):
        own, information = possible.of(i), precision(FIELD, NAMES)[i]
        found = _planned(possible, year, i, 6, criterion=criterion)
        times = np.unique(own.time)
        for _ in range(200):
            drawn = rng.choice(times, 6, replace=False)
            rows = [int(rng.choice(np.flatnonzero(own.time == t))) for t in drawn]
            if criterion == "d":
                assert found.log_det >= _log_det(own, rows, information) - 1e-9
            else:
                assert found.error[-1] ** 2 <= _square(own, rows, information, year.form[i]) * 1.001


def test_monotone_and_consistent(possible: Candidates, year: Expectation) -> None:
    information = precision(FIELD, NAMES)[4]
    before = 0.0
    for count in (1, 2, 4, 8):
        found = _planned(possible, year, 4, count)
        assert len(found) == count
        assert (found.gain > 0.0).all()
        assert found.log_det > before
        before = found.log_det
        assert (np.diff(np.append(found.before, found.error)) < 0.0).all()
        assert (np.diff(np.append(found.before, found.best_first)) < 0.0).all()
        assert found.best_first[-1] == pytest.approx(found.error[-1], rel=1e-9)
        assert sorted(found.rank) == list(range(1, count + 1))
        assert (np.diff(found.chosen.time) > 0.0).all()
        # Against the definitions, computed at once.
        rows = range(count)
        assert found.log_det == pytest.approx(_log_det(found.chosen, rows, information), rel=1e-9)
        square = _square(found.chosen, rows, information, year.form[4])
        assert found.error[-1] == pytest.approx(np.sqrt(square), rel=1e-8)
        assert year.rms(found.covariance)[4] == pytest.approx(np.sqrt(square), rel=1e-8)


@pytest.mark.parametrize("criterion", ["d", "v"])
def test_against_exhaustive_search(possible: Candidates, year: Expectation, criterion: Any) -> None:
    """Efficiency: the P-th root of the ratio of determinants; the ratio of squared errors."""
    worst = 1.0
    for i in (0, 5, 11, 17):
        own, information = possible.of(i), precision(FIELD, NAMES)[i]
        own = own.take(np.flatnonzero((own.target == 0) & (own.time < START + DAY)))
        assert 8 <= len(own) <= 12
        every = list(combinations(range(len(own)), 4))
        found = plan(own, 4, information, year.form[i], criterion=criterion)
        if criterion == "d":
            best = max(_log_det(own, rows, information) for rows in every)
            worst = min(worst, np.exp((found.log_det - best) / len(NAMES)))
            assert found.log_det <= best + 1e-9
        else:
            least = min(_square(own, rows, information, year.form[i]) for rows in every)
            worst = min(worst, least / found.error[-1] ** 2)
    print("EFF", criterion, worst)
    assert 0.95 <= worst <= 1.0 + 1e-9


def test_exchange_improves(possible: Candidates, year: Expectation) -> None:
    gained = 0.0
    for i in range(18):
        plain = _planned(possible, year, i, 5, exchange=False)
        better = _planned(possible, year, i, 5)
        assert better.log_det >= plain.log_det - 1e-9
        gained = max(gained, better.log_det - plain.log_det)
    assert gained > 0.0


def test_v_serves_the_beam_and_d_the_parameters(possible: Candidates, year: Expectation) -> None:
    errors, gains = [], []
    for i in range(18):
        both = [_planned(possible, year, i, 4, criterion=c) for c in ("d", "v")]
        errors.append([p.error[-1] for p in both])
        gains.append([p.log_det for p in both])
    mean, total = np.mean(errors, axis=0), np.mean(gains, axis=0)
    assert mean[1] < mean[0]
    assert total[1] < total[0]


def test_the_gap_is_kept(possible: Candidates, year: Expectation) -> None:
    found = _planned(possible, year, 2, 5, gap=4 * 3600.0)
    assert (np.diff(found.chosen.time) > 4 * 3600.0).all()


def test_what_is_known_already_counts(possible: Candidates, year: Expectation) -> None:
    first = _planned(possible, year, 9, 5)
    c = first.chosen
    centers = np.array([t.center for t in TARGETS])[c.target]
    made = camera_target(np.full(5, 9), c.counts, c.sun, centers, time=c.time)
    information = precision(FIELD, NAMES, made)
    np.testing.assert_allclose(np.linalg.inv(information[9]), first.covariance,
                               rtol=1e-6, atol=1e-14)  # fmt: skip
    np.testing.assert_array_equal(information[8], precision(FIELD, NAMES)[8])
    second = plan(possible.of(9), 5, information[9], year.form[9])
    assert second.before == pytest.approx(first.error[-1], rel=1e-8)
    assert second.log_det < first.log_det


def test_the_expected_error_comes_true(possible: Candidates, year: Expectation) -> None:
    """Mirrors drawn from the prior, measured as planned, fitted, and tracked for a year."""
    i, draws = 12, 150
    found = _planned(possible, year, i, 8)
    rng = np.random.default_rng(5)
    sizes = np.array([FIELD.parameter(n).prior for n in NAMES])
    nominal = FIELD[np.full(draws, i)]
    x = rng.normal(0.0, 1.0, (draws, len(NAMES))) * sizes
    truth = nominal.with_parameters({n: x[:, p] for p, n in enumerate(NAMES)})
    c = found.chosen
    pose = truth.pose(c.counts[:, None])
    ray = reflect(c.sun[:, None], pose.normal)
    noise = rng.normal(0.0, 5e-4, (*ray.shape[:2], 2))
    ray = ray + np.einsum("...a,...ak->...k", noise, tangent_axes(ray))
    centers = np.array([t.center for t in TARGETS])[c.target]
    spot = pose.vertex + ray * np.linalg.norm(centers[:, None] - pose.vertex, axis=-1)[..., None]
    heliostat = np.broadcast_to(np.arange(draws), (len(c), draws)).ravel()
    seen = camera_target(
        heliostat, np.repeat(c.counts, draws, axis=0), np.repeat(c.sun, draws, axis=0),
        spot.reshape(-1, 3),
    )  # fmt: skip
    learnt = fit(nominal, seen, NAMES, loss="square", adapt_scale=False)
    moved = nominal.with_parameters(learnt.parameters)
    suns = suns_of_year(PLANT.site, 2026)
    solved = track(moved, suns[:, None], AIM)
    there = truth.pose(solved.chosen(solved.counts))
    way = AIM - there.vertex
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    rms = float(np.sqrt(np.mean(angle_between(reflect(suns[:, None], there.normal), way) ** 2)))
    print("TRUE", rms, found.error[-1])
    assert rms == pytest.approx(found.error[-1], rel=0.15)
    assert found.error[-1] < 0.8 * MRAD < 20 * MRAD < found.before


def test_refusals(possible: Candidates, year: Expectation) -> None:
    information = precision(FIELD, NAMES)[0]
    own = possible.of(0)
    with pytest.raises(InputError, match="give 1 or more"):
        plan(own, 0, information, year.form[0])
    with pytest.raises(InputError, match="no candidate"):
        plan(own.take([]), 3, information, year.form[0])
    with pytest.raises(InputError, match="criterion 'a'"):
        plan(own, 3, information, year.form[0], criterion="a")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="there is no target"):
        candidates(FIELD, PLANT.site, (), [START], NAMES)
    with pytest.raises(InputError, match="one batch axis"):
        candidates(FIELD[0], PLANT.site, TARGETS, [START], NAMES)
    with pytest.raises(InputError, match="one batch axis"):
        precision(FIELD[0], NAMES)
    with pytest.raises(InputError, match="must be above 0"):
        precision(FIELD, NAMES, priors={"tilt_east": 0.0})
    with pytest.raises(UnknownNameError, match="tilt_up"):
        precision(FIELD, ("tilt_up",))
    made = camera_target([30], [[0.0, 0.0]], [0.0, 0.0, 1.0], [0.0, 0.0, 13.0])
    with pytest.raises(InputError, match="row 30; there are 18"):
        precision(FIELD, NAMES, made)
    with pytest.raises(InputError, match="end must be after"):
        grid(START, START, 60.0)
    with pytest.raises(InputError, match="more than 200,000"):
        grid(START, START + 30 * DAY, 1.0)
    with pytest.raises(InputError, match="max_incidence"):
        Limits(max_incidence=2.0)
    with pytest.raises(InputError, match="never 80° high"):
        suns_of_year(sun.Site(60.0, 0.0, 0.0), 2026, min_elevation=np.radians(80.0))
    with pytest.raises(InputError, match="give a day or more"):
        suns_of_year(PLANT.site, 2026, days=0)


# --- campaign -------------------------------------------------------------------------


def _fleet(mechanism: Mechanism, names: tuple[str, ...], aim: Any = AIM) -> Fleet:
    suns = suns_of_year(PLANT.site, 2026, days=6, hours=2.0)
    form = expectation(mechanism, aim, suns, names).form
    return Fleet(mechanism, names, precision(mechanism, names), form, aim)


def _check(found: Campaign, fleets: list[Fleet], timing: Timing, targets: Any) -> None:
    """No conflict, computed anew from the schedule alone."""
    for k in range(len(targets)):
        mine = np.flatnonzero(found.target == k)
        order = mine[np.argsort(found.arrive[mine], kind="stable")]
        assert (found.arrive[order][1:] >= found.done[order][:-1] - 1e-6).all()
    for i in np.unique(found.heliostat):
        mine = np.flatnonzero(found.heliostat == i)
        order = mine[np.argsort(found.leave[mine], kind="stable")]
        assert (found.leave[order][1:] >= found.back[order][:-1] - 1e-6).all()
    np.testing.assert_allclose(found.done - found.arrive, timing.slot, rtol=0, atol=1e-5)
    np.testing.assert_allclose(
        found.time - found.arrive, timing.settle + timing.exposure / 2, rtol=0, atol=1e-5
    )
    suns = sun.position(found.time, PLANT.site)
    edges = [sun.position(t, PLANT.site).elevation for t in (found.leave, found.arrive, found.done)]
    assert all((e >= Limits().min_elevation - 1e-3).all() for e in edges)
    offsets = np.concatenate([[0], np.cumsum([len(f) for f in fleets])])
    for k, fleet in enumerate(fleets):
        mine = np.flatnonzero((found.heliostat >= offsets[k]) & (found.heliostat < offsets[k + 1]))
        rows = found.heliostat[mine] - offsets[k]
        some, vector = fleet.mechanism[rows], suns.vector[mine]
        centers = np.array([t.center for t in targets])[found.target[mine]]
        solved = track(some, vector, centers, current=found.counts[mine])
        assert (solved.chosen(solved.status) == Status.OK).all()
        np.testing.assert_allclose(solved.chosen(solved.counts), found.counts[mine], atol=1e-3)
        home = track(some, vector, fleet.aim[rows])
        way = np.abs(found.counts[mine] - home.chosen(home.counts))
        seconds = (way / some.drives.table[..., SLOTS["speed"]]).max(axis=-1)
        assert (found.arrive[mine] - found.leave[mine] >= seconds - 1e-5).all()
        assert (found.back[mine] - found.done[mine] >= seconds - 1e-5).all()


@pytest.fixture(scope="module", params=[True, False], ids=["ahead", "by slot"])
def mixed(request: Any) -> tuple[list[Fleet], Campaign]:
    """Two kinds of heliostats with models of different sizes, two targets, two days."""
    fleets = [_fleet(FIELD, NAMES), _fleet(_jack_plant(), (*MODELS["guo6"], "pivot_offset"))]
    return fleets, campaign(
        fleets, PLANT.site, TARGETS, START, START + 1.3 * DAY, timing=Timing(10.0, 3.0, 7.0),
        ahead=request.param,
    )  # fmt: skip


def test_a_campaign_has_no_conflicts(mixed: tuple[list[Fleet], Campaign]) -> None:
    fleets, found = mixed
    assert len(found) > 100
    assert set(found.heliostat) == set(range(19))
    assert set(found.target) == {0, 1}
    assert len(found) <= found.slots
    _check(found, fleets, Timing(10.0, 3.0, 7.0), TARGETS)


def test_a_campaign_keeps_its_promise(mixed: tuple[list[Fleet], Campaign]) -> None:
    """The expected errors are those of the sightings it lists."""
    fleets, found = mixed
    assert (np.diff(np.append(found.before, found.error)) < 0.0).all()
    first = fleets[0]
    mine = np.flatnonzero(found.heliostat < len(first))
    centers = np.array([t.center for t in TARGETS])[found.target[mine]]
    suns = sun.vector(found.time[mine], PLANT.site)
    made = camera_target(found.heliostat[mine], found.counts[mine], suns, centers)
    covariance = np.linalg.inv(precision(FIELD, NAMES, made))
    rms = Expectation(NAMES, first.form, np.ones(18, dtype=np.int64)).rms(covariance)
    np.testing.assert_allclose(found.expected[:18], rms, rtol=1e-5)
    assert found.error[-1] == pytest.approx(np.sqrt(np.mean(found.expected**2)), rel=1e-9)
    last = {int(h): e for h, e in zip(found.heliostat, found.heliostat_error, strict=True)}
    for i, error in last.items():
        assert error == pytest.approx(found.expected[i], rel=1e-12)


def test_a_campaign_against_taking_turns() -> None:
    """As many measurements, heliostat after heliostat, which is hard to beat in a small field.

    Where there is room, far fewer measurements do as much.
    """
    fleet = _fleet(FIELD, NAMES)

    def turns(times: FloatArray) -> float:
        rows = np.arange(len(times)) % 18
        suns = sun.vector(times, PLANT.site)
        solved = track(FIELD[rows], suns, PLANT.targets[0].center)
        made = camera_target(rows, solved.chosen(solved.counts), suns, PLANT.targets[0].center)
        covariance = np.linalg.inv(precision(FIELD, NAMES, made))
        rms = Expectation(NAMES, fleet.form, np.ones(18, dtype=np.int64)).rms(covariance)
        return float(np.sqrt(np.mean(rms**2)))

    full = campaign([fleet], PLANT.site, PLANT.targets, START, START + DAY,
                    timing=Timing(200.0, 60.0, 40.0))  # fmt: skip
    assert full.error[-1] < 1.03 * turns(full.time)
    some = campaign([fleet], PLANT.site, PLANT.targets, START, START + DAY)
    assert len(some) < 0.12 * some.slots
    every = np.arange(some.time[0], some.time[-1], Timing().slot)
    assert some.error[-1] < turns(every[: len(some)]) / 4.0


def test_slow_drives_are_waited_for() -> None:
    table = FIELD.drives.table.copy()
    table[..., SLOTS["speed"]] = 400.0
    slow = Mechanism(**{**vars(FIELD[:3]), "drives": type(FIELD.drives)(table[:3])})
    fleet = _fleet(slow, NAMES)
    found = campaign([fleet], PLANT.site, TARGETS, START, START + DAY, worth=0.0)
    _check(found, [fleet], Timing(), TARGETS)
    assert (found.arrive - found.leave).min() > 60.0
    assert len(found) < found.slots / 4


def test_looking_ahead_ends_lower_with_as_many_measurements() -> None:
    """The same number of measurements in a day, chosen from the whole of it or one by one."""
    fleet = _fleet(FIELD, NAMES)
    timing = Timing(60.0, 2.0, 30.0)
    run = (PLANT.site, PLANT.targets, START, START + DAY)
    early = campaign([fleet], *run, timing=timing, ahead=False)
    late = campaign([fleet], *run, timing=timing)
    assert len(late) < 0.8 * len(early)
    assert late.error[-1] < 0.8 * early.error[len(late) - 1]


def test_a_campaign_ends_at_its_count_and_tells_of_progress() -> None:
    told: list[tuple[int, int]] = []
    fleet = _fleet(FIELD, NAMES)
    found = campaign([fleet], PLANT.site, TARGETS, START, START + DAY, count=7,
                     progress=lambda a, b: told.append((a, b)))  # fmt: skip
    assert len(found) == 7
    assert told[-1][0] == told[-1][1] > 0
    assert [a for a, _ in told] == sorted(a for a, _ in told)


def test_a_campaign_wants_more_for_less() -> None:
    fleet = _fleet(FIELD, NAMES)
    few, many = (
        campaign([fleet], PLANT.site, PLANT.targets, START, START + DAY, worth=w)
        for w in (0.4, 0.1)
    )
    assert len(few) < len(many)
    assert many.error[-1] < few.error[-1]


def test_campaign_refusals() -> None:
    fleet = _fleet(FIELD[:2], NAMES)
    run = (PLANT.site, TARGETS)
    with pytest.raises(InputError, match="at least one target"):
        campaign([fleet], PLANT.site, (), START, START + DAY)
    with pytest.raises(InputError, match="at least one target"):
        campaign([], *run, START, START + DAY)
    with pytest.raises(InputError, match="give 1 or more measurements"):
        campaign([fleet], *run, START, START + DAY, count=0)
    with pytest.raises(InputError, match="share from 0"):
        campaign([fleet], *run, START, START + DAY, worth=1.0)
    with pytest.raises(InputError, match="finite numbers"):
        campaign([fleet], *run, START, np.inf)
    with pytest.raises(InputError, match="0 slots of 12 s"):
        campaign([fleet], *run, START, START + 5.0)
    with pytest.raises(InputError, match="never 10° high"):
        campaign([fleet], *run, START + 0.9 * DAY, START + 0.95 * DAY)
    with pytest.raises(InputError, match="settle -1"):
        Timing(settle=-1.0)
    with pytest.raises(InputError, match="too short"):
        Timing(0.0, 0.0, 0.0)
    with pytest.raises(InputError, match="information of shape"):
        Fleet(FIELD, NAMES, fleet.information, fleet.form, AIM)
    with pytest.raises(InputError, match="one axis"):
        Fleet(FIELD[0], NAMES, fleet.information, fleet.form, AIM)
    blind = Fleet(FIELD[:2], NAMES, fleet.information, 0.0 * fleet.form, AIM)
    with pytest.raises(InputError, match="none would gain"):
        campaign([blind], *run, START, START + DAY)


@pytest.mark.slow
def test_ten_thousand_heliostats_in_a_minute() -> None:
    rng = np.random.default_rng(0)
    count = 10_000
    place = np.stack(
        [rng.uniform(-300, 300, count), rng.uniform(-600, -50, count), np.zeros(count)], axis=-1
    )
    mechanism = azimuth_elevation(place)
    lift = np.array([0.0, 0.0, 60.0])
    targets = tuple(Target(t.name, t.corners + lift, t.center + lift) for t in TARGETS)
    begin = time.perf_counter()
    fleet = _fleet(mechanism, NAMES, AIM + lift)
    found = campaign([fleet], PLANT.site, targets, START, START + DAY)
    assert time.perf_counter() - begin < 90.0
    assert len(found) > 0.99 * found.slots
    _check(found, [fleet], Timing(), targets)


# --- the command ----------------------------------------------------------------------


@pytest.fixture
def plant_file(tmp_path: Path) -> Path:
    """The example plant as a file."""
    write_plant(PLANT, tmp_path / "plant.toml")
    return tmp_path / "plant.toml"


@pytest.fixture
def run(capsys: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run a command; returns exit code, what it prints, and its complaint."""

    def call(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["heliotrope", "plan", *map(str, arguments)])
        with pytest.raises(SystemExit) as leaving:
            main()
        captured = capsys.readouterr()
        code = leaving.value.code
        return (code if isinstance(code, int) else 0), captured.out, captured.err

    return call


WEEK = ("--from", "2026-09-02T00:00Z", "--days", "7")


def test_command(run: Any, plant_file: Path, tmp_path: Path) -> None:
    table, picture = tmp_path / "plan.csv", tmp_path / "plan.png"
    arguments = (plant_file, "--heliostat", "P6A", *WEEK, "--count", "6")
    code, out, err = run(*arguments, "--csv", table, "--picture", picture, "--json")
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert found["parameters"] == list(NAMES)
    own = found["heliostats"]["P6A"]
    assert len(own["measurements"]) == 6
    errors = [m["expected_beam_rms_mrad"] for m in own["measurements"]]
    assert own["before_expected_beam_rms_mrad"] > errors[0] > errors[-1]
    assert errors == sorted(errors, reverse=True)
    for m in own["measurements"]:
        where = sun.position(m["time"], PLANT.site)
        assert m["sun_azimuth_deg"] == pytest.approx(np.degrees(where.azimuth), abs=1e-6)
        assert m["sun_elevation_deg"] == pytest.approx(np.degrees(where.elevation), abs=1e-6)
    with table.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [r["time"] for r in rows] == [m["time"] for m in own["measurements"]]
    assert picture.read_bytes().startswith(b"\x89PNG")
    code, out, _ = run(*arguments)
    assert code == 0
    assert out.count("2026-09-0") == 6
    assert f"{errors[-1]:.2f} mrad after" in out
    assert {p.name for p in tmp_path.iterdir()} == {
        "plant.toml", "plan.csv", "plan.png", *(p.name for p in tmp_path.glob("*plant*.csv")),
        *(p.name for p in tmp_path.glob("heliostats*")),
    }  # fmt: skip


def test_command_for_several_keeps_them_apart(run: Any, plant_file: Path, tmp_path: Path) -> None:
    code, out, _ = run(plant_file, *WEEK, "--count", "4", "--criterion", "v", "--json",
                       "--picture", tmp_path / "all.svg")  # fmt: skip
    assert code == 0
    found = json.loads(out)["heliostats"]
    assert list(found) == list(PLANT.names)
    times = sorted(sun.vector(m["time"], PLANT.site)[0] for h in found.values()
                   for m in h["measurements"])  # fmt: skip
    assert len(set(times)) == len(times) == 72
    assert "svg" in (tmp_path / "all.svg").read_text(encoding="utf-8")[:400]


def test_command_knows_what_was_measured(run: Any, plant_file: Path, tmp_path: Path) -> None:
    _, out, _ = run(plant_file, "--heliostat", "P2B", *WEEK, "--count", "5", "--json")
    first = json.loads(out)["heliostats"]["P2B"]
    ms = first["measurements"]
    made: Sightings = camera_target(
        np.full(5, PLANT.names.index("P2B")), [[m["count_1"], m["count_2"]] for m in ms],
        np.array([sun.vector(m["time"], PLANT.site) for m in ms]), PLANT.targets[0].center,
    )  # fmt: skip
    write_sightings(tmp_path / "made.csv", made, PLANT.names)
    code, out, err = run(plant_file, "--heliostat", "P2A", "--heliostat", "P2B", *WEEK, "--count",
                         "2", "--json", "--sightings", tmp_path / "made.csv")  # fmt: skip
    assert (code, err) == (0, "")
    second = json.loads(out)["heliostats"]
    before = second["P2B"]["before_expected_beam_rms_mrad"]
    assert before == pytest.approx(ms[-1]["expected_beam_rms_mrad"], rel=1e-6)
    assert second["P2A"]["before_expected_beam_rms_mrad"] > 20.0


def test_command_campaign(run: Any, plant_file: Path, tmp_path: Path) -> None:
    table, picture = tmp_path / "c.csv", tmp_path / "c.pdf"
    arguments = (plant_file, "--campaign", "--from", "2026-09-02T00:00Z", "--days", "1",
                 "--settle", "60s", "--clear", "30s")  # fmt: skip
    code, out, err = run(*arguments, "--csv", table, "--picture", picture, "--json")
    assert (code, err) == (0, "")
    found = json.loads(out)
    rows = found["measurements"]
    assert found["before_expected_beam_rms_mrad"] > 20.0
    assert found["after_expected_beam_rms_mrad"] < 2.0
    spans = sorted((r["arrive"], r["done"]) for r in rows)
    assert all(a[1] <= b[0] for a, b in pairwise(spans))
    with table.open(encoding="utf-8", newline="") as stream:
        assert len(list(csv.DictReader(stream))) == len(rows)
    assert picture.read_bytes().startswith(b"%PDF")
    _, out, _ = run(*arguments)
    assert f"{len(rows):,} measurements in" in out
    assert "more; --csv FILE writes them all" in out


REFUSED: list[tuple[list[str], str]] = [
    (["--from", "2026-09-02"], "has no time zone"),
    (["--heliostat", "P9Z"], "there is no heliostat 'P9Z'"),
    (["--days", "0"], "--days 0: give a number above 0"),
    (["--days", "99999"], "at most 3660"),
    (["--days", "1", "--to", "2027-01-01T00:00Z"], "not both"),
    (["--to", "2020-01-01T00:00Z"], "is not after --from"),
    (["--every", "1s"], "more than 200,000"),
    (["--every", "often"], "write it as 30s"),
    (["--target", "x"], "there is no target 'x'"),
    (["--model", "jacks"], "tilt_up"),
    (["--model", "foo"], "there is no model 'foo'"),
    (["--count", "0"], "give 1 or more"),
    (["--campaign", "--count", "0"], "give 1 or more"),
    (["--campaign", "--worth", "2"], "share from 0"),
    (["--picture", "a.bmp"], "give one of .png"),
    (["--csv", "nowhere/x.csv"], "there is no folder nowhere"),
    (["--sightings", "no.csv"], "there is no such file"),
    (["--sigma-mrad", "nan"], "--sigma-mrad nan"),
    (["--from", "2026-09-02T20:00Z", "--to", "2026-09-02T22:00Z"], "no measurement is possible"),
    (["--campaign", "--from", "2026-09-02T20:00Z", "--to", "2026-09-02T22:00Z"], "never 10° high"),
    (["--from", "9999-12-30T00:00Z"], "beyond the year 9999"),
]


@pytest.mark.parametrize(("arguments", "says"), REFUSED, ids=[" ".join(r[0]) for r in REFUSED])
def test_command_refuses_in_one_line(
    arguments: list[str], says: str, run: Any, plant_file: Path
) -> None:
    code, out, err = run(plant_file, *(["--days", "7"] if "--every" in arguments else []),
                         *arguments)  # fmt: skip
    assert code == 2
    assert out == ""
    assert says in err
    assert len(err.strip().splitlines()) == 1


def test_a_plant_without_targets(run: Any, tmp_path: Path) -> None:
    bare = Plant(PLANT.name, PLANT.site, PLANT.groups, (), PLANT.receivers)
    write_plant(bare, tmp_path / "plant.toml")
    code, _, err = run(tmp_path / "plant.toml")
    assert code == 2
    assert "this plant has no target" in err


def test_no_input_is_overwritten(run: Any, plant_file: Path, tmp_path: Path) -> None:
    table = next(tmp_path.glob("*.csv"))
    before = table.read_bytes()
    code, _, err = run(plant_file, "--heliostat", "P6A", *WEEK, "--csv", table)
    assert code == 2
    assert "this file is read from" in err
    assert table.read_bytes() == before


@pytest.mark.parametrize("seed", range(4))
def test_exchange_lowers_what_greedy_choice_leaves(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count, p = 12, 5
    covariance = np.broadcast_to(np.eye(p), (count, p, p)).copy()
    root = rng.normal(size=(count, p, p))
    form = root @ np.swapaxes(root, 1, 2)
    options = [
        Option(np.arange(count), size * rng.normal(size=(count, 2, p)), 5, np.full(count, 2))
        for size in (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
    ]

    def total(chosen: list[list[int]]) -> float:
        information = np.linalg.inv(covariance)
        for option, rows in zip(options, chosen, strict=True):
            assert len(rows) <= option.room
            for i in rows:
                assert rows.count(i) <= 2
                information[i] += option.slope[i].T @ option.slope[i]
        return float(np.einsum("npq,nqp->", form, np.linalg.inv(information)))

    first = allocate(covariance, form, options, 0.0, None)
    second = exchanged(covariance, form, options, first)
    assert sum(map(len, first)) == sum(map(len, second)) == 30
    assert total(second) < (1.0 - 1e-9) * total(first)
    assert total(first) < total([[] for _ in options])
    # Against the best of many random choices.
    least = min(
        total([list(rng.choice(count, 5, replace=False)) for _ in options]) for _ in range(500)
    )
    assert total(second) < least
    assert sum(map(len, allocate(covariance, form, options, 0.0, 7))) == 7
