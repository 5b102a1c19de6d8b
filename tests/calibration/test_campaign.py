"""Campaigns of a field: no conflicts, promises kept, what looking ahead is worth."""

from typing import Any

import numpy as np
import pytest

from heliotrope import sun
from heliotrope.calibration.plan._allocation import Option, allocate, exchanged
from heliotrope.calibration.plan.campaign import CalibrationCampaign, Fleet, Timing, plan_campaign
from heliotrope.calibration.plan.planning import SightingLimits
from heliotrope.calibration.sightings import camera_target
from heliotrope.calibration.uncertainty import error_form, precision, suns_of_year
from heliotrope.errors import InputError
from heliotrope.field.example import azimuth_elevation
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import SLOTS, linear_paint
from heliotrope.mechanism.parameters import MODELS
from heliotrope.mechanism.tracking import TrackingStatus, track
from support.planning_case import AIM, DAY, FIELD, NAMES, PLANT, START, TARGETS


def _jack_plant() -> Mechanism:
    jacks = [
        linear_paint(154166.6667, 0.0774, 0.335, 0.338, 0.0446, clockwise=c, speed=300.0)
        for c in (0, 1)
    ]
    return kinds.azimuth_elevation(
        np.array([[20.0, -60.0, 0.0]]),
        pivot_height=1.7,
        pivot_offset=0.17,
        drives=(azimuth_elevation(np.zeros((1, 3))).drives[0], jacks[1]),
    )


def _fleet(mechanism: Mechanism, names: tuple[str, ...], aim: Any = AIM) -> Fleet:
    suns = suns_of_year(PLANT.site, 2026, days=6, hours=2.0)
    form = error_form(mechanism, aim, suns, names)
    return Fleet(mechanism, names, precision(mechanism, names), form, aim)


def _check(found: CalibrationCampaign, fleets: list[Fleet], timing: Timing, targets: Any) -> None:
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
    assert all((e >= SightingLimits().min_elevation - 1e-3).all() for e in edges)
    offsets = np.concatenate([[0], np.cumsum([len(f) for f in fleets])])
    for k, fleet in enumerate(fleets):
        mine = np.flatnonzero((found.heliostat >= offsets[k]) & (found.heliostat < offsets[k + 1]))
        rows = found.heliostat[mine] - offsets[k]
        some, vector = fleet.mechanism[rows], suns.vector[mine]
        centers = np.array([t.center for t in targets])[found.target[mine]]
        solved = track(some, vector, centers, current=found.counts[mine])
        assert (solved.chosen(solved.status) == TrackingStatus.OK).all()
        np.testing.assert_allclose(solved.best_counts, found.counts[mine], atol=1e-3)
        home = track(some, vector, fleet.aim[rows])
        way = np.abs(found.counts[mine] - home.best_counts)
        seconds = (way / some.drives.table[..., SLOTS["speed"]]).max(axis=-1)
        assert (found.arrive[mine] - found.leave[mine] >= seconds - 1e-5).all()
        assert (found.back[mine] - found.done[mine] >= seconds - 1e-5).all()


@pytest.fixture(scope="module", params=[True, False], ids=["ahead", "by slot"])
def mixed(request: Any) -> tuple[list[Fleet], CalibrationCampaign]:
    """Two kinds of heliostats with models of different sizes, two targets, two days."""
    fleets = [_fleet(FIELD, NAMES), _fleet(_jack_plant(), (*MODELS["guo6"], "pivot_offset"))]
    return fleets, plan_campaign(
        fleets,
        PLANT.site,
        TARGETS,
        START,
        START + 1.3 * DAY,
        timing=Timing(10.0, 3.0, 7.0),
        ahead=request.param,
    )


def test_a_campaign_has_no_conflicts(mixed: tuple[list[Fleet], CalibrationCampaign]) -> None:
    fleets, found = mixed
    assert len(found) > 100
    assert set(found.heliostat) == set(range(19))
    assert set(found.target) == {0, 1}
    assert len(found) <= found.slots
    _check(found, fleets, Timing(10.0, 3.0, 7.0), TARGETS)


def test_a_campaign_keeps_its_promise(mixed: tuple[list[Fleet], CalibrationCampaign]) -> None:
    """The expected errors are those of the sightings it lists."""
    fleets, found = mixed
    assert (np.diff(np.append(found.before, found.error)) < 0.0).all()
    first = fleets[0]
    mine = np.flatnonzero(found.heliostat < len(first))
    centers = np.array([t.center for t in TARGETS])[found.target[mine]]
    suns = sun.vector(found.time[mine], PLANT.site)
    made = camera_target(found.heliostat[mine], found.counts[mine], suns, centers)
    covariance = np.linalg.inv(precision(FIELD, NAMES, made))
    rms = np.sqrt(np.einsum("npq,nqp->n", first.form, covariance))
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
        made = camera_target(rows, solved.best_counts, suns, PLANT.targets[0].center)
        covariance = np.linalg.inv(precision(FIELD, NAMES, made))
        rms = np.sqrt(np.einsum("npq,nqp->n", fleet.form, covariance))
        return float(np.sqrt(np.mean(rms**2)))

    full = plan_campaign(
        [fleet], PLANT.site, PLANT.targets, START, START + DAY, timing=Timing(200.0, 60.0, 40.0)
    )
    assert full.error[-1] < 1.03 * turns(full.time)
    some = plan_campaign([fleet], PLANT.site, PLANT.targets, START, START + DAY)
    assert len(some) < 0.12 * some.slots
    every = np.arange(some.time[0], some.time[-1], Timing().slot)
    assert some.error[-1] < turns(every[: len(some)]) / 4.0


def test_slow_drives_are_waited_for() -> None:
    table = FIELD.drives.table.copy()
    table[..., SLOTS["speed"]] = 400.0
    slow = Mechanism(**{**vars(FIELD[:3]), "drives": type(FIELD.drives)(table[:3])})
    fleet = _fleet(slow, NAMES)
    found = plan_campaign([fleet], PLANT.site, TARGETS, START, START + DAY, worth=0.0)
    _check(found, [fleet], Timing(), TARGETS)
    assert (found.arrive - found.leave).min() > 60.0
    assert len(found) < found.slots / 4


def test_looking_ahead_ends_lower_with_as_many_measurements() -> None:
    """The same number of measurements in a day, chosen from the whole of it or one by one."""
    fleet = _fleet(FIELD, NAMES)
    timing = Timing(60.0, 2.0, 30.0)
    run = (PLANT.site, PLANT.targets, START, START + DAY)
    early = plan_campaign([fleet], *run, timing=timing, ahead=False)
    late = plan_campaign([fleet], *run, timing=timing)
    assert len(late) < 0.8 * len(early)
    assert late.error[-1] < 0.8 * early.error[len(late) - 1]


def test_a_campaign_ends_at_its_count_and_tells_of_progress() -> None:
    told: list[tuple[int, int]] = []
    fleet = _fleet(FIELD, NAMES)
    found = plan_campaign(
        [fleet],
        PLANT.site,
        TARGETS,
        START,
        START + DAY,
        count=7,
        progress=lambda a, b: told.append((a, b)),
    )
    assert len(found) == 7
    assert told[-1][0] == told[-1][1] > 0
    assert [a for a, _ in told] == sorted(a for a, _ in told)


def test_a_campaign_wants_more_for_less() -> None:
    fleet = _fleet(FIELD, NAMES)
    few, many = (
        plan_campaign([fleet], PLANT.site, PLANT.targets, START, START + DAY, worth=w)
        for w in (0.4, 0.1)
    )
    assert len(few) < len(many)
    assert many.error[-1] < few.error[-1]


def test_campaign_refusals() -> None:
    fleet = _fleet(FIELD[:2], NAMES)
    run = (PLANT.site, TARGETS)
    with pytest.raises(InputError, match="at least one target"):
        plan_campaign([fleet], PLANT.site, (), START, START + DAY)
    with pytest.raises(InputError, match="at least one target"):
        plan_campaign([], *run, START, START + DAY)
    with pytest.raises(InputError, match="count must be 1 measurement or more"):
        plan_campaign([fleet], *run, START, START + DAY, count=0)
    with pytest.raises(InputError, match="worth must be 0 or more"):
        plan_campaign([fleet], *run, START, START + DAY, worth=1.0)
    with pytest.raises(InputError, match="finite numbers"):
        plan_campaign([fleet], *run, START, np.inf)
    with pytest.raises(InputError, match="0 slots of 12 s"):
        plan_campaign([fleet], *run, START, START + 5.0)
    with pytest.raises(InputError, match="never reaches 10°"):
        plan_campaign([fleet], *run, START + 0.9 * DAY, START + 0.95 * DAY)
    with pytest.raises(InputError, match="settle must be 0 or more"):
        Timing(settle=-1.0)
    with pytest.raises(InputError, match="too short"):
        Timing(0.0, 0.0, 0.0)
    with pytest.raises(InputError, match="information has the shape"):
        Fleet(FIELD, NAMES, fleet.information, fleet.form, AIM)
    with pytest.raises(InputError, match="one axis"):
        Fleet(FIELD[0], NAMES, fleet.information, fleet.form, AIM)
    blind = Fleet(FIELD[:2], NAMES, fleet.information, 0.0 * fleet.form, AIM)
    with pytest.raises(InputError, match="no heliostat can reach its aim"):
        plan_campaign([blind], *run, START, START + DAY)


@pytest.mark.slow
def test_ten_thousand_heliostats() -> None:
    rng = np.random.default_rng(0)
    count = 10_000
    place = np.stack(
        [rng.uniform(-300, 300, count), rng.uniform(-600, -50, count), np.zeros(count)], axis=-1
    )
    mechanism = azimuth_elevation(place)
    lift = np.array([0.0, 0.0, 60.0])
    targets = tuple(Target(t.name, t.corners + lift, t.center + lift) for t in TARGETS)
    fleet = _fleet(mechanism, NAMES, AIM + lift)
    found = plan_campaign([fleet], PLANT.site, targets, START, START + DAY)
    assert len(found) > 0.99 * found.slots
    _check(found, [fleet], Timing(), targets)


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
