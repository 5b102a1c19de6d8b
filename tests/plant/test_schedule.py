"""The schedule: what is chosen, what is not, and what comes of it over days."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise

import numpy as np
import pytest
from benchmarks.days import Days, Standing
from hypothesis import given
from hypothesis import strategies as st

from heliotrope.calibration.growth import Growth
from heliotrope.calibration.learn import drift
from heliotrope.calibration.plan.planning import SightingLimits
from heliotrope.errors import InputError, TimeError, UnknownNameError
from heliotrope.field.layouts import malan_plant
from heliotrope.field.target import Target
from heliotrope.geometry import MRAD, direction
from heliotrope.lcu import states
from heliotrope.optics.shading import nearest
from heliotrope.plant.schedule import scheduler as schedule
from heliotrope.plant.schedule.choice import Sight, hidden
from heliotrope.plant.schedule.scheduler import (
    Assignment,
    Finished,
    Scheduler,
    Settings,
    Visited,
    Weather,
    compare,
)
from heliotrope.sun import vector

PLANT = malan_plant(24)
SMALL = malan_plant(10)
MORNING = datetime(2026, 6, 21, 8, 0, tzinfo=UTC)
DAY = 86400.0
BOTH = ("left", "right")


def scheduler(**settings: object) -> Scheduler:
    return Scheduler(PLANT, Settings(**settings), now=MORNING)  # type: ignore[arg-type]


def ask(one: Scheduler, now: datetime = MORNING, **more: object) -> Assignment | None:
    """One decision with all heliostats ready."""
    fields = {"states": Standing.ready(24), "free_targets": BOTH, **more}
    return one.next(now, vector(now, PLANT.site), **fields)  # type: ignore[arg-type]


# --- one decision ---------------------------------------------------------------------


def test_who_sees_the_sun_or_the_target_too_obliquely_is_not_considered() -> None:
    """A target that faces north, one heliostat before it and one far to the side."""
    corners = np.array([[2.0, 0, 4], [-2.0, 0, 4], [-2.0, 0, 0], [2.0, 0, 0]])
    target = Target("T", corners, np.array([0.0, 0.0, 2.0]))
    assert target.normal[1] > 0.99
    feet = np.array([[0.0, 100.0, 2.0], [100.0, 5.0, 2.0]])
    sight = Sight(target, feet, np.full((2, 2), 2.0), ())
    limits = SightingLimits()
    high = direction(np.radians(180.0), np.radians(60.0))
    assert sight.able(high, limits).tolist() == [True, False]
    # Low in the north, behind the mirror.
    behind = direction(0.0, np.radians(2.0))
    assert sight.able(behind, limits).tolist() == [False, False]


def test_a_decision_names_who_where_and_why() -> None:
    told = ask(scheduler())
    assert told is not None
    assert told.heliostat in PLANT.names
    assert told.target in BOTH
    assert told.at == MORNING.timestamp()
    assert told.until - told.at >= Settings().visit
    # The priors of the table allow a beam to be off by some 30 mrad.
    assert 20 * MRAD < told.before < 50 * MRAD
    assert told.after < 0.7 * told.before
    assert told.gain == told.before - told.after
    assert f"{1e3 * told.before:.2f}" in told.reason


def test_the_best_is_chosen_of_all_that_can_be() -> None:
    # Exactly judged one by one, none is worth more for its time than the one that is chosen.
    one = scheduler()
    best = ask(one)
    assert best is not None
    alone = []
    other = scheduler()
    for name in PLANT.names:
        others = tuple(n for n in PLANT.names if n != name)
        for target in BOTH:
            told = ask(other, holds=others, free_targets=(target,))
            if told is not None:
                other.cancel(name)
                alone.append((told.before**2 - told.after**2) / (told.until - told.at))
    assert len(alone) > 24
    value = (best.before**2 - best.after**2) / (best.until - best.at)
    assert value == pytest.approx(max(alone), rel=1e-9)


def test_whose_error_costs_power_under_a_flux_limit_comes_first() -> None:
    one = scheduler()
    usual = ask(one)
    assert usual is not None
    assert "flux limit" not in usual.reason
    row = PLANT.names.index(usual.heliostat)
    other = (row + 12) % 24
    worth = np.ones(24)
    worth[other] = 50.0
    one = scheduler()
    one.weigh(worth)
    told = ask(one)
    assert told is not None
    assert told.heliostat == PLANT.names[other]
    assert "counts 50.0 times under the flux limit" in told.reason
    one.cancel(told.heliostat)
    coming = one.plan(MORNING, timedelta(hours=1), Standing.ready(24))
    assert PLANT.names[other] in {planned.heliostat for planned in coming[:2]}


def test_two_targets_get_two_heliostats() -> None:
    one = scheduler()
    first = ask(one, free_targets=("left",))
    second = ask(one, free_targets=("right",))
    assert first is not None
    assert second is not None
    assert first.heliostat != second.heliostat
    assert (first.target, second.target) == BOTH
    assert set(one.running) == {first.heliostat, second.heliostat}
    one.cancel(first.heliostat)
    assert set(one.running) == {second.heliostat}


def test_holds_and_states_are_kept_to() -> None:
    allowed = PLANT.names[5]
    told = ask(scheduler(), holds=tuple(n for n in PLANT.names if n != allowed))
    assert told is not None
    assert told.heliostat == allowed
    seen = Standing.ready(24)
    seen.state[:] = states.STOWED
    seen.state[7] = states.TRACKING
    told = ask(scheduler(), states=seen)
    assert told is not None
    assert told.heliostat == PLANT.names[7]
    seen.state[7] = 255
    one = scheduler()
    assert ask(one, states=seen) is None
    assert one.reason == "no heliostat is ready"


@pytest.mark.parametrize(
    ("when", "weather", "reason"),
    [
        (datetime(2026, 6, 21, 22, tzinfo=UTC), Weather(), "the sun is at"),
        (MORNING, Weather(dni=120.0), "clouds: 120 W/m², below 300 W/m²"),
        (MORNING, Weather(wind=13.0), "wind: 13.0 m/s, above 12.0 m/s"),
    ],
)
def test_night_clouds_and_wind_close_the_sky(when: datetime, weather: Weather, reason: str) -> None:
    one = scheduler()
    assert ask(one, when, weather=weather) is None
    assert reason in one.reason
    assert not one.running


def test_no_photograph_against_the_sun() -> None:
    camera = PLANT.cameras[0]
    assert camera.position is not None
    behind = PLANT.target("left").center - camera.position
    # Lifted until the sun may be used at all; the limit of glare is widened as much.
    sun = behind / np.linalg.norm(behind)
    sun = direction(np.arctan2(sun[0], sun[1]), np.radians(20.0))
    one = scheduler(glare=np.radians(15.0))
    found = one.next(MORNING, sun, Standing.ready(24), ("left",))
    assert found is None
    assert one.reason == "the sun dazzles the cameras of left"


def test_a_low_sun_hides_mirrors_behind_others() -> None:
    low = direction(np.radians(60.0), np.radians(16.0))
    strict, mild = scheduler(most_hidden=0.0), scheduler(most_hidden=0.9)
    count = {"strict": 0, "mild": 0}
    for name, one in (("strict", strict), ("mild", mild)):
        while one.next(MORNING, low, Standing.ready(24), BOTH) is not None:
            count[name] += 1
    assert count["mild"] > count["strict"]


def test_a_neighbour_hides_what_it_overlaps_from_however_near_in_front() -> None:
    """Mirrors of 2 m by 2 m that look up, a neighbour half a mirror aside."""
    up, size = np.array([[0.0, 0.0, 1.0]]), np.full((1, 2), 2.0)
    for height, share in ((0.5, 0.5), (5.0, 0.5), (-0.5, 0.0)):
        offsets = np.array([[[1.0, 0.0, height]]])
        assert hidden(offsets, up, size, up[0]) == pytest.approx(share)


def test_a_mirror_alone_is_hidden_by_nobody() -> None:
    assert nearest(np.zeros((1, 3))).tolist() == [[]]
    assert nearest(np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]])).tolist() == [[1], [0]]


def test_far_drives_are_a_cost() -> None:
    near, far = Standing.ready(24), Standing.ready(24)
    far.counts[:] = [150_000.0, 100_000.0]
    told = [ask(scheduler(), states=seen) for seen in (near, far)]
    assert told[0] is not None
    assert told[1] is not None
    spans = [t.until - t.at for t in told]
    # 150,000 steps at 8000 a second and back.
    assert 20.0 < spans[1] - spans[0] < 45.0


def test_beams_that_miss_are_searched_for_or_left() -> None:
    sure, wild = scheduler(priors={"elevation_bias": 1e-3}), scheduler(priors={"tilt_north": 0.1})
    one, other = ask(sure), ask(wild)
    assert one is not None
    assert other is not None
    assert other.seen < one.seen <= 1.0
    # A search takes its time; without one the chance lowers what it is worth.
    assert other.until - other.at > one.until - one.at
    blunt = ask(scheduler(priors={"tilt_north": 0.1}, look=None))
    assert blunt is not None
    assert blunt.until - blunt.at < other.until - other.at


# --- what becomes of it ---------------------------------------------------------------


def test_what_failed_is_left_for_longer_each_time() -> None:
    one = scheduler(retry=600.0)
    only = PLANT.names[0]
    others = PLANT.names[1:]
    now, waits = MORNING, []
    for _ in range(4):
        told = ask(one, now, holds=others)
        assert told is not None
        one.done(Visited(only, told.target, now.timestamp(), False, text="no beam"))
        ended = now
        while ask(one, now, holds=others) is None:
            now += timedelta(seconds=60)
            assert now < MORNING + timedelta(hours=6)
        one.cancel(only)
        waits.append((now - ended).total_seconds())
    assert waits == [600.0, 1200.0, 2400.0, 4800.0]


def test_old_ones_come_first_whatever_the_gain() -> None:
    world = Days(PLANT, scheduler(most_age=3600.0 * 2), MORNING)
    world.live(timedelta(minutes=5))
    assert world.values
    done = next(iter(world.values))
    late = datetime.fromtimestamp(MORNING.timestamp() + 3600.0 * 3, UTC)
    world.scheduler.running.clear()
    told = ask(world.scheduler, late)
    assert told is not None
    assert told.overdue
    assert told.reason.startswith("due: ")
    assert told.heliostat not in world.values
    known = tuple(n for n in PLANT.names if n != done)
    told = ask(world.scheduler, late, holds=known)
    assert told is not None
    assert told.heliostat == done


def test_the_expected_error_fades_with_time_but_never_beyond_the_prior() -> None:
    world = Days(PLANT, scheduler(), MORNING)
    before = world.scheduler.expected(MORNING)
    world.live(timedelta(minutes=10))
    rows = [PLANT.names.index(name) for name in world.values]
    soon = world.scheduler.expected(world.now)[rows]
    later = world.scheduler.expected(world.now + timedelta(days=60))[rows]
    ever = world.scheduler.expected(world.now + timedelta(days=2_000_000))[rows]
    assert (soon < 0.7 * before[rows]).all()
    assert (later > soon).all()
    np.testing.assert_allclose(ever, before[rows], rtol=1e-9)


def test_growth_of_the_expected_error_brings_a_heliostat_back() -> None:
    # Known perfectly but for its zeros, which drift: no age limit, only growth.
    settings = {"goal": 2 * MRAD, "most_age": 1e9}
    still, drifts = scheduler(**settings), scheduler(**settings)
    world = Days(PLANT, still, MORNING)
    only = PLANT.names[0]
    world.holds = PLANT.names[1:]
    world.live(timedelta(hours=8), timedelta(minutes=20))
    assert still.expected(world.now)[0] < 2 * MRAD
    record, zeros = world.records[only], drift.zeros(next(iter(PLANT.groups.values())).mechanism)
    grows = Growth("test", stepping=zeros, rate=(MRAD**2,) * 2)
    still.learn(replace(record, growth=Growth()))
    drifts.learn(replace(record, growth=grows))
    morrow = MORNING + timedelta(days=5)
    assert ask(still, morrow, holds=world.holds) is None
    assert still.reason == "heliostats ready: 1; all are calibrated well enough"
    back = ask(drifts, morrow, holds=world.holds)
    assert back is not None
    assert back.heliostat == only
    assert not back.overdue


def test_a_mirror_that_is_found_elsewhere_is_known_less() -> None:
    world = Days(PLANT, scheduler(), MORNING)
    world.live(timedelta(minutes=10))
    one, name = world.scheduler, next(iter(world.values))
    row = PLANT.names.index(name)
    expected = float(one.expected(world.now)[row])
    assert not one.observe(name, 2.9 * expected, world.now)
    assert one.expected(world.now)[row] == pytest.approx(expected)
    prior = scheduler().expected(MORNING)[row]
    assert one.observe(name, 3.1 * expected, world.now)
    assert one.expected(world.now)[row] == pytest.approx(min(3.1 * expected, prior))


def test_a_surprise_at_a_visit_is_told_and_doubted() -> None:
    world = Days(PLANT, scheduler(), MORNING)
    world.live(timedelta(minutes=30))
    one = world.scheduler
    again = [a for a in world.made if a.heliostat in world.values]
    name = again[0].heliostat
    row = PLANT.names.index(name)
    one.running[name] = replace(again[0], predicted=1 * MRAD)
    one.done(Visited(name, "left", world.now.timestamp(), True, 0.9 * MRAD))
    calm = one.expected(world.now)[row]
    one.running[name] = replace(again[0], predicted=1 * MRAD)
    finished = one.done(Visited(name, "left", world.now.timestamp(), True, 3.1 * MRAD))
    assert finished is not None
    assert finished.surprise
    assert one.expected(world.now)[row] == pytest.approx(3.1 * calm, rel=1e-4)
    assert name in one.compared().surprises


def test_a_calibration_that_nobody_planned_still_teaches() -> None:
    world = Days(PLANT, scheduler(), MORNING)
    world.live(timedelta(minutes=10))
    name, record = next(iter(world.records.items()))
    row, fresh = PLANT.names.index(name), scheduler()
    before = fresh.expected(MORNING)[row]
    fresh.learn(record)
    assert fresh.expected(MORNING)[row] < 0.7 * before
    # A parameter that a calibration does not have stays as the prior says.
    other, less = scheduler(), record.names[:-1]
    other.learn(
        replace(
            record,
            names=less,
            values=record.values[:-1],
            covariance=record.covariance[:-1, :-1],
            prior=record.prior[:-1],
        )
    )
    assert fresh.expected(MORNING)[row] < other.expected(MORNING)[row] < before


# --- the plan, and the comparison -----------------------------------------------------


def test_the_plan_is_what_then_happens() -> None:
    # Told with the same sky, the first visits are those of the plan.
    world = Days(PLANT, scheduler(), MORNING)
    coming = world.scheduler.plan(MORNING, timedelta(hours=1), world.field, most=8)
    assert not world.scheduler.running
    assert len(coming) == 8
    world.live(timedelta(minutes=15), timedelta(seconds=1))
    assert [(a.heliostat, a.target) for a in world.made[:2]] == [
        (a.heliostat, a.target) for a in coming[:2]
    ]
    assert {a.heliostat for a in world.made[:8]} == {a.heliostat for a in coming}


def test_a_plan_waits_for_the_morning_and_keeps_targets_apart() -> None:
    night = datetime(2026, 6, 21, 20, 0, tzinfo=UTC)
    coming = scheduler().plan(night, timedelta(hours=16), most=12)
    assert len(coming) == 12
    first = datetime.fromtimestamp(coming[0].at, UTC)
    assert vector(first, PLANT.site)[2] >= np.sin(np.radians(15.0)) - 1e-6
    for target in BOTH:
        mine = [a for a in coming if a.target == target]
        assert all(b.at >= a.until for a, b in pairwise(mine))
    for told in coming:
        together = [a for a in coming if a.at < told.until and told.at < a.until]
        assert len({a.heliostat for a in together}) == len(together)


def test_a_plan_changes_nothing() -> None:
    one = scheduler()
    before = one.expected(MORNING)
    one.plan(MORNING, timedelta(hours=2), most=5)
    np.testing.assert_array_equal(one.expected(MORNING), before)
    first, second = ask(one), ask(scheduler())
    assert first == second


def test_a_plan_goes_on_from_what_is_under_way() -> None:
    one = scheduler()
    away = [ask(one, free_targets=(target,)) for target in BOTH]
    coming = one.plan(MORNING, timedelta(hours=1), most=6)
    for told in away:
        assert told is not None
        # Their targets are busy until they end, and they will be known better then.
        assert min(a.at for a in coming if a.target == told.target) >= told.until
        again = [a for a in coming if a.heliostat == told.heliostat]
        assert all(a.before < 0.8 * told.before for a in again)
    assert not {a.heliostat for a in coming} & {t.heliostat for t in away if t is not None}


def test_finished_visits_are_compared_with_their_prediction() -> None:
    told = Assignment("A", "left", 0.0, 100.0, 30e-3, 12e-3, 4e-3, 0.9, False, "")
    made = [
        Finished(told, Visited("A", "left", 110.0, True, 3e-3)),
        Finished(told, Visited("A", "left", 90.0, True, 5e-3)),
        Finished(told, Visited("B", "left", 130.0, False)),
    ]
    found = compare(made)
    assert (found.visits, found.calibrated, found.surprises) == (3, 2, ())
    assert found.measured == pytest.approx(np.sqrt(17.0) * 1e-3)
    assert found.predicted == pytest.approx(4e-3)
    assert found.longer == pytest.approx(1.1)
    assert found.text.startswith("3 visits, 2 calibrated; beam error found 4.12 mrad")
    assert compare([]).text == "no visits"
    assert compare(made[2:]).text == "1 visits, 0 calibrated; no error could be compared"


# --- days -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def days() -> Days:
    """Four days unattended, one mirror blind, one held, clouds on the second day."""
    settings = Settings(most_age=2.0 * DAY, retry=1800.0, goal=1.5 * MRAD, worth=0.2)
    world = Days(SMALL, Scheduler(SMALL, settings, now=MORNING), MORNING, seed=3)
    world.blind, world.holds = frozenset({SMALL.names[2]}), (SMALL.names[3],)
    for day in range(4):
        world.weather = Weather(dni=100.0 if day == 1 else 850.0, wind=3.0)
        world.live(timedelta(days=1), timedelta(minutes=20))
    return world


def test_days_unattended_calibrate_the_field(days: Days) -> None:
    free = [n for n in SMALL.names if n not in (SMALL.names[2], SMALL.names[3])]
    assert set(days.values) == set(free)
    assert SMALL.names[3] not in {a.heliostat for a in days.made}
    rows = [SMALL.names.index(n) for n in free]
    times = MORNING.timestamp() + DAY + np.array([0.0, 9e3, 2e4])
    after = days.look(times, tuple(SMALL.names[k] for k in rows))
    untouched = Days(SMALL, Scheduler(SMALL, now=MORNING), MORNING, seed=3)
    before = untouched.look(times, after.names)
    # As roughly installed, and without a prediction; after, as well as predicted.
    assert np.sqrt(np.mean(before.error**2)) > 7.5 * MRAD
    assert np.isnan(before.predicted).all()
    assert np.sqrt(np.mean(after.error**2)) < 0.5 * MRAD
    assert 0.6 < after.within <= 1.0


def test_days_are_dark_at_night_and_under_clouds(days: Days) -> None:
    assert any(reason.startswith("the sun is at") for reason in days.reasons)
    assert any(reason.startswith("clouds") for reason in days.reasons)
    for told in days.made:
        sun = vector(datetime.fromtimestamp(told.at, UTC), SMALL.site)
        assert sun[2] >= np.sin(np.radians(15.0)) - 1e-9
        assert not DAY <= told.at - MORNING.timestamp() < 2.0 * DAY


def test_no_one_waits_for_ever(days: Days) -> None:
    # Overdue after two days; a day of clouds and the nights come on top.
    ages = days.scheduler.age(days.now)
    for row, name in enumerate(SMALL.names):
        if name in days.values:
            assert ages[row] < 4.0 * DAY
    ends = {n: [a.until for a in days.made if a.heliostat == n] for n in days.values}
    for times in ends.values():
        gaps = np.diff([MORNING.timestamp(), *times])
        assert gaps.max() < 4.0 * DAY


def test_a_blind_mirror_does_not_hold_up_the_others(days: Days) -> None:
    tries = sum(a.heliostat == SMALL.names[2] for a in days.made)
    # Half an hour, an hour, two, … a day.
    assert 2 <= tries <= 9


def test_predictions_of_days_can_be_believed(days: Days) -> None:
    found = days.scheduler.compared()
    assert found.visits == len(days.scheduler.finished) > 40
    # The priors are wider than this installation by a third or so.
    assert 0.4 < found.ratio < 1.3
    later = days.scheduler.compared(MORNING + timedelta(days=2))
    assert later.visits < found.visits
    assert later.measured < found.measured


# --- laws and refusals ----------------------------------------------------------------


@given(
    azimuth=st.floats(-np.pi, np.pi),
    elevation=st.floats(-0.2, 1.55),
    dead=st.sets(st.integers(0, 23)),
    held=st.sets(st.integers(0, 23)),
)
def test_only_who_may_is_ever_chosen(
    azimuth: float, elevation: float, dead: set[int], held: set[int]
) -> None:
    one = _SHARED
    one.running.clear()
    seen = Standing.ready(24)
    seen.state[list(dead)] = states.FAULT
    told = one.next(
        MORNING, direction(azimuth, elevation), seen, BOTH, [PLANT.names[i] for i in held]
    )
    if told is None:
        assert one.reason
        return
    row = PLANT.names.index(told.heliostat)
    assert row not in dead | held
    assert elevation >= one.settings.limits.min_elevation - 1e-9
    assert 0.0 <= told.after < told.before
    assert told.until > told.at
    assert 0.0 < told.seen <= 1.0


_SHARED = scheduler(worth=0.0)


def test_what_cannot_be_used_is_refused() -> None:
    with pytest.raises(TimeError, match="has no time zone; pass UTC"):
        Scheduler(PLANT, now=datetime(2026, 1, 1))  # noqa: DTZ001 - that is what is tested
    with pytest.raises(InputError, match="0 targets and 24 heliostats"):
        Scheduler(replace(PLANT, targets=(), cameras=()), now=MORNING)
    with pytest.raises(InputError, match="23 names for 24 heliostats"):
        Scheduler(PLANT, now=MORNING, names=PLANT.names[1:])
    with pytest.raises(InputError, match="states have the shape"):
        ask(scheduler(), states=Standing.ready(23))
    with pytest.raises(UnknownNameError, match="there is no target 'up'"):
        ask(scheduler(), free_targets=("up",))
    with pytest.raises(UnknownNameError, match="there is no heliostat 'X'"):
        scheduler().observe("X", 1.0, MORNING)


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"shots": 0}, "shots must be 1 or more"),
        ({"sigma": 0.0}, "sigma must be above 0, not 0.0"),
        ({"most_age": float("inf")}, "most_age must be above 0, not inf"),
        ({"worth": 1.0}, "worth must be 0 or more and below 1, not 1.0"),
        ({"look": 0.0}, "look must be above 0, or None, not 0.0 s"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings: dict[str, float], text: str) -> None:
    with pytest.raises(InputError, match=text):
        Settings(**settings)  # type: ignore[arg-type]


def test_the_order_of_the_states_may_be_another() -> None:
    names = tuple(reversed(PLANT.names))
    one, other = scheduler(), Scheduler(PLANT, Settings(), now=MORNING, names=names)
    np.testing.assert_allclose(one.expected(MORNING), other.expected(MORNING)[::-1])
    seen = Standing.ready(24)
    seen.state[:] = states.STOWED
    seen.state[-1] = states.IDLE
    told = other.next(MORNING, vector(MORNING, PLANT.site), seen, BOTH)
    assert told is not None
    assert told.heliostat == PLANT.names[0]


def test_the_form_of_the_nearest_sample_is_good_enough() -> None:
    # 1000 heliostats, 200 of them computed: the others are within a per cent.
    from heliotrope.calibration.uncertainty import error_form, precision, suns_of_year

    plant = malan_plant(1000)
    one = Scheduler(plant, now=MORNING)
    rows = np.arange(3, 1000, 97)
    some = plant.groups["azel"].mechanism[rows]
    names = (
        "position_east",
        "position_north",
        "position_up",
        "tilt_north",
        "tilt_east",
        "azimuth_bias",
        "elevation_bias",
        "non_orthogonality",
    )
    suns = suns_of_year(plant.site, 2026, days=6)
    form = error_form(some, plant.receivers[0].center, suns, names)
    covariance = np.linalg.inv(precision(some, names))
    exact = np.sqrt(np.einsum("npq,nqp->n", form, covariance))
    np.testing.assert_allclose(one.expected(MORNING)[rows], exact, rtol=0.01)
    assert schedule.REMEMBERED > 1000
