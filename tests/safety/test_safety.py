"""The safety table: every row trips, latches and releases as it says, and no way leads around."""

import math
import re
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from heliotrope import safety
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.safety import (
    CONDITIONS,
    AcknowledgeRole,
    Act,
    Action,
    Condition,
    FluxProof,
    JoinLimiter,
    Proof,
    Reading,
    SafetyState,
    Scope,
    Severity,
    Watcher,
)

ROWS = {row.name: row for row in CONDITIONS}
#: Row: a bad value, a safe one, what is done to what, what the line says. Written by hand
#: from the requirements, not from the table.
TRIPS = {
    "operator_emergency": (1.0, 0.0, Act.DEFOCUS, Scope.FIELD, "order is active"),
    "emergency_line": (0.0, 1.0, Act.DEFOCUS, Scope.FIELD, "emergency line carries no current"),
    "nodes_unacknowledged": (1.0, 0.0, Act.DEFOCUS, Scope.FIELD, "emergency order: 1"),
    "flux_after_emergency": (0.11, 0.02, Act.STOW, Scope.FIELD, "is 11 % of nominal after an em"),
    "unproven_after_emergency": (1.0, 0.0, Act.DEFOCUS, Scope.HELIOSTAT, "nothing shows that it"),
    "authority_lost": (10.5, 0.0, Act.REFUSE_NEW, Scope.FIELD, "authority for 1[01].* s .*10 s"),
    "receiver_flux_high": (1.02, 0.5, Act.DEFOCUS, Scope.FIELD, "is 102 % of its limit"),
    "receiver_temperature_high": (1.01, 0.9, Act.DEFOCUS, Scope.FIELD, "temperature .* is 101 %"),
    "receiver_flow_low": (0.7, 1.0, Act.DEFOCUS, Scope.FIELD, r"70 % of demand \(limit 80 %\)"),
    "receiver_camera_lost": (11.0, 0.0, Act.REFUSE_NEW, Scope.FIELD, "no picture from .* for 1"),
    "wind_gust_stow": (21.0, 5.0, Act.STOW, Scope.FIELD, r"gust of 21 m/s \(limit 20 m/s\); ST"),
    "wind_gust_defocus": (16.0, 5.0, Act.DEFOCUS, Scope.FIELD, r"of 16 m/s \(limit 15 m/s\)"),
    "wind_mean_stow": (14.5, 5.0, Act.STOW, Scope.FIELD, r"mean wind of 14.5 m/s"),
    "wind_mean_defocus": (11.5, 5.0, Act.DEFOCUS, Scope.FIELD, "mean wind of 11.5 m/s"),
    "cold": (-3.0, 9.0, Act.REFUSE_NEW, Scope.FIELD, r"the air is at -3 °C: ice .*limit 1 °C\)"),
    "sun_below_horizon": (-0.01, 0.5, Act.STOW, Scope.FIELD, r"is -0.573° \(limit 0°\)"),
    "plant_link_lost": (3.1, 0.0, Act.DEFOCUS, Scope.CLUSTER, r"plant for .* s \(limit 3 s\)"),
    "cluster_silent": (3.1, 0.0, Act.DEFOCUS, Scope.CLUSTER, r"cluster for .* s \(limit 3 s\)"),
    "broker_lost": (3.1, 0.0, Act.REFUSE_NEW, Scope.FIELD, r"from the broker for .* s"),
    "bus_errors": (0.3, 0.0, Act.REFUSE_NEW, Scope.CLUSTER, "30 % of the frames .* are bad"),
    "bus_failed": (0.95, 0.0, Act.DEFOCUS, Scope.CLUSTER, r"95 % of the .* \(limit 90 %\)"),
    "sun_stale": (6.1, 0.0, Act.DEFOCUS, Scope.HELIOSTAT, "no sun vector for 6"),
    "clock_jump": (0.7, 0.0, Act.DEFOCUS, Scope.CLUSTER, "time stepped by 0.7 s"),
    "time_source_lost": (61.0, 0.0, Act.ALARM, Scope.CLUSTER, "no time source for 6"),
    "holdover_exhausted": (1.2, 0.1, Act.DEFOCUS, Scope.CLUSTER, "time is uncertain by 1.2 s"),
    "ups_on_battery": (1.0, 0.0, Act.DEFOCUS, Scope.FIELD, "runs on battery: mains power is lost"),
    "ups_charge_low": (0.4, 1.0, Act.STOW, Scope.FIELD, r"UPS is 40 % \(limit 50 %\)"),
    "database_unwritable": (5.5, 0.0, Act.REFUSE_NEW, Scope.FIELD, "not confirmed a write for"),
    "keep_out_predicted": (
        1.0,
        0.0,
        Act.DEFOCUS,
        Scope.HELIOSTAT,
        "in a keep-out volume or headin",
    ),
    "beam_unsent": (1.0, 0.0, Act.DEFOCUS, Scope.HELIOSTAT, "on a receiver, but it was not sent"),
    "pointing_disagrees": (
        5e-3,
        0.0,
        Act.DEFOCUS,
        Scope.HELIOSTAT,
        r"beam is 0.286° away from where it",
    ),
    "pointing_disagrees_many": (
        120.0,
        0.0,
        Act.DEFOCUS,
        Scope.FIELD,
        "counts the beams of at least 120 heliostats",
    ),
    "cluster_time_differs": (5.0, 0.0, Act.DEFOCUS, Scope.CLUSTER, "differs from the .* by 5 s"),
    "cluster_site_differs": (0.04, 0.0, Act.DEFOCUS, Scope.CLUSTER, "site is 2.29° off that of"),
    "node_faults": (0.03, 0.0, Act.REFUSE_NEW, Scope.FIELD, "3 % of the heliostats failed"),
    "node_faults_many": (0.2, 0.0, Act.DEFOCUS, Scope.FIELD, "20 % of the heliostats failed"),
}
LATCHED = [row.name for row in CONDITIONS if row.latched]


class Run:
    """One row evaluated each half second."""

    def __init__(self, *names: str, step: float = 0.5) -> None:
        self.rows = [ROWS[name] for name in names]
        self.now, self.step = 100.0, step
        self.state = safety.start(self.rows, self.now)
        self.actions: list[Action] = []

    def feed(self, value: float | None, seconds: float) -> "Run":
        """Give the same reading to all rows; ``None`` gives none."""
        for _ in range(max(1, round(seconds / self.step))):
            self.now += self.step
            readings = {}
            if value is not None:
                readings = {(row.reading, ""): Reading(value, self.now) for row in self.rows}
            self.state, self.actions = safety.evaluate(readings, self.state, self.now)
        return self

    @property
    def act(self) -> Act | None:
        return safety.decision(self.actions)


def test_the_expected_table_is_complete() -> None:
    assert set(TRIPS) == set(ROWS)


@pytest.mark.parametrize("name", TRIPS)
def test_row_trips_and_says_so(name: str) -> None:
    bad, good, act, scope, text = TRIPS[name]
    row = ROWS[name]
    run = Run(name).feed(good, 3.0)
    assert run.actions == []
    seconds = row.delay + 0.5 if math.isinf(row.then_stow) else row.delay + 1.0
    run.feed(bad, seconds)
    (action,) = run.actions
    assert (action.act, action.scope, action.condition) == (act, scope, name)
    assert action.severity is row.severity
    assert re.search(text, action.text), action.text
    assert action.text.startswith(name)
    # Only a look at the beam tells which of the two takes it away.
    either = name in ("keep_out_predicted", "beam_unsent")
    ordered = "DEFOCUS or STOW" if either else act.name
    place = scope.name.lower()
    says = {
        Act.ALARM: f"nothing moves or stops in the {place}",
        Act.REFUSE_NEW: f"new motions of the {place} are refused",
    }
    assert action.text.endswith(f"; {says.get(act, f'{ordered} of the {place}')}")


@pytest.mark.parametrize("name", TRIPS)
def test_row_waits_for_its_delay(name: str) -> None:
    bad, good, *_ = TRIPS[name]
    row = ROWS[name]
    if row.delay == 0.0:
        assert Run(name).feed(good, 1.0).feed(bad, 0.5).actions
        return
    run = Run(name).feed(good, 1.0).feed(bad, row.delay)
    assert run.actions == []
    # One reading within the limits starts the delay anew.
    assert run.feed(good, 0.5).feed(bad, row.delay).actions == []
    assert run.feed(bad, 0.5).actions


@pytest.mark.parametrize("name", TRIPS)
def test_row_holds_in_its_hysteresis_and_releases_beyond(name: str) -> None:
    bad, good, *_ = TRIPS[name]
    row = ROWS[name]
    run = Run(name).feed(bad, row.delay + 1.0)
    between = 0.5 * (row.trips + row.releases)
    assert run.feed(between, row.clear_for + 5.0).actions, "between the limits it must stay"
    run.feed(good, row.clear_for)
    assert run.actions, "it released before its time"
    run.feed(good, 1.0)
    if row.latched:
        (action,) = run.actions
        assert action.waits
        assert "the cause is gone" in action.text
    else:
        assert run.actions == []


@pytest.mark.parametrize("name", TRIPS)
def test_a_reading_that_is_missing_counts_as_the_worst(name: str) -> None:
    _, good, *_ = TRIPS[name]
    row = ROWS[name]
    for missing in (None, math.nan, math.inf, -math.inf):
        run = Run(name).feed(good, 2.0)
        run.feed(missing, row.detection - row.delay - 0.5)
        assert run.actions == [], "it must wait for its age"
        run.feed(missing, row.delay + 1.5)
        (action,) = run.actions
        assert action.condition == name
        if not row.ages:
            assert f"no reading of {row.what} for" in action.text
        # It stays so for ever.
        assert run.feed(missing, 50.0).actions


@pytest.mark.parametrize("name", TRIPS)
def test_readings_never_seen_trip_too(name: str) -> None:
    row = ROWS[name]
    assert Run(name).feed(None, row.detection + 1.0).actions


@pytest.mark.parametrize("name", LATCHED)
def test_latched_rows_need_their_person(name: str) -> None:
    bad, good, *_ = TRIPS[name]
    row = ROWS[name]
    run = Run(name).feed(bad, row.delay + 1.0)

    def refused(who: str, role: AcknowledgeRole) -> str:
        state, why = safety.acknowledge(run.state, name, who, role)
        assert state is run.state
        return why

    assert "the cause is not gone" in refused("Ada", AcknowledgeRole.SUPERVISOR)
    run.feed(good, row.clear_for + 1.0)
    assert "needs the user's name" in refused("  ", AcknowledgeRole.SUPERVISOR)
    if row.role is AcknowledgeRole.SUPERVISOR:
        assert "engineer must acknowledge, not operator" in refused("Ada", AcknowledgeRole.OPERATOR)
    assert run.feed(good, 1000.0).actions, "time alone must not release"
    run.state, why = safety.acknowledge(run.state, name, "Ada", AcknowledgeRole.SUPERVISOR)
    assert why is None
    assert run.state.tracks[name, ""].acknowledged_by == "Ada"
    assert run.feed(good, 1.0).actions == []
    # The next trip is a new one.
    run.feed(bad, row.delay + 1.0)
    assert run.state.tracks[name, ""].acknowledged_by == ""
    assert "the cause is not gone" in refused("Ada", AcknowledgeRole.SUPERVISOR)


def test_a_cause_that_has_just_gone_is_said_in_plain_words() -> None:
    run = Run("operator_emergency").feed(1.0, 1.0)
    refused = safety.acknowledge(run.state, "operator_emergency", "Ada", AcknowledgeRole.OPERATOR)
    assert refused[1] == (
        "operator_emergency: the cause is not gone: a user's emergency order is active. Keep "
        "people away from the receiver and the beams; find the cause, then withdraw the order and "
        "acknowledge."
    )
    run.feed(0.0, 1.0)
    refused = safety.acknowledge(run.state, "operator_emergency", "Ada", AcknowledgeRole.OPERATOR)
    assert refused[1] == (
        "operator_emergency: the order is withdrawn, and must stay so for 2 s; acknowledge again "
        "in 2 s"
    )
    (action,) = run.actions
    assert action.text == (
        "operator_emergency: the order is withdrawn, and must stay so for 2 s; DEFOCUS of the field"
    )
    (action,) = run.feed(0.0, 2.0).actions
    assert action.text == (
        "operator_emergency: the order is withdrawn; the cause is gone; DEFOCUS of the field "
        "remains in force until an operator acknowledges"
    )


def test_acknowledgements_that_mean_nothing_are_refused() -> None:
    run = Run("wind_gust_stow", "operator_emergency").feed(0.0, 1.0)

    def why(name: str, subject: str = "") -> str:
        return safety.acknowledge(run.state, name, "Ada", AcknowledgeRole.SUPERVISOR, subject)[1]

    assert "nothing to acknowledge" in why("operator_emergency")
    assert "no such condition" in why("earthquake")
    assert "operator_emergency C7: no such condition" in why("operator_emergency", "C7")
    run.feed(25.0, 1.0)
    assert "releases by itself" in why("wind_gust_stow")


def test_a_cleared_cause_that_returns_cannot_be_acknowledged() -> None:
    row = ROWS["receiver_flux_high"]
    run = Run(row.name).feed(1.5, 3.0).feed(0.5, row.clear_for + 1.0)
    # 0.95 does not trip, but is not safe either.
    run.feed(0.95, 0.5)
    _, why = safety.acknowledge(run.state, row.name, "Ada", AcknowledgeRole.SUPERVISOR)
    assert "95 %, not yet back at 90 %" in why


def test_defocus_becomes_stow_after_its_time() -> None:
    run = Run("operator_emergency").feed(1.0, 0.5)
    assert run.act is Act.DEFOCUS
    assert run.actions[0].new
    run.feed(1.0, 29.5)
    assert run.act is Act.DEFOCUS
    assert not run.actions[0].new
    run.feed(1.0, 0.5)
    assert run.act is Act.STOW
    assert run.actions[0].new
    assert not run.feed(1.0, 0.5).actions[0].new


def test_wind_that_rises_defocuses_then_stows_and_the_stronger_wins() -> None:
    run = Run("wind_gust_defocus", "wind_gust_stow").feed(10.0, 2.0)
    assert run.act is None
    assert run.feed(16.0, 4.0).act is Act.DEFOCUS
    assert run.feed(22.0, 0.5).act is Act.STOW
    assert [a.act for a in run.actions] == [Act.STOW, Act.DEFOCUS]
    # 14 m/s is below both trips and releases the stow row only, after its time.
    assert run.feed(14.0, 601.0).act is Act.DEFOCUS
    assert run.feed(11.0, 599.5).act is Act.DEFOCUS
    assert run.feed(11.0, 1.5).act is None


def test_gusts_about_the_limit_do_not_chatter() -> None:
    run = Run("wind_gust_stow")
    changes, before = 0, run.act
    for k in range(400):
        run.feed(20.5 if k % 2 else 14.0, 0.5)
        changes += run.act is not before
        before = run.act
    assert changes == 1


def test_a_stream_that_stands_still_releases_nothing() -> None:
    row = replace(ROWS["holdover_exhausted"], clear_for=3.0, stale_after=60.0, budget=100.0)
    state = safety.start([row], 0.0)
    for now, value in ((1.0, 2.0), (2.0, 0.1), (4.0, 0.1)):
        readings = {(row.reading, ""): Reading(value, now)}
        state, actions = safety.evaluate(readings, state, now)
        assert actions
    for now in range(5, 60):
        state, actions = safety.evaluate(readings, state, float(now))
        assert actions, "the last reading is of 4 s; at 2 s to 4 s it was safe for 2 s only"
    _, actions = safety.evaluate({(row.reading, ""): Reading(0.1, 60.0)}, state, 60.0)
    assert actions == []


def test_old_and_future_readings_do_not_count() -> None:
    row = ROWS["operator_emergency"]
    state = safety.start([row], 0.0)

    def at(value: float, taken: float, now: float) -> list[Action]:
        nonlocal state
        readings = {(row.reading, ""): Reading(value, taken)}
        state, actions = safety.evaluate(readings, state, now)
        return actions

    assert at(0.0, 1.0, 1.0) == []
    assert at(1.0, 0.5, 1.5) == [], "a reordered reading"
    assert at(1.0, 9.0, 2.0) == [], "a reading from the future"
    assert at(1.0, 1.0, 2.5), "of two readings of one time the worse counts"
    at(0.0, 1.0, 3.0)
    assert state.tracks[row.name, ""].value == 1.0, "and the better does not come back"


def test_a_clock_that_goes_back_or_is_no_number_defocuses() -> None:
    run = Run("wind_mean_stow").feed(20.0, 1.0)
    kept = run.state.now
    for now in (kept - 50.0, math.nan, math.inf):
        state, actions = safety.evaluate({}, run.state, now)
        assert state.now == kept
        assert {a.condition for a in actions} == {"wind_mean_stow", "time_went_back"}
        assert safety.decision(actions) is Act.STOW
        (broken,) = (a for a in actions if a.condition == "time_went_back")
        assert (broken.act, broken.severity) == (Act.DEFOCUS, Severity.EMERGENCY)
        assert broken.text.startswith("the monotonic time went from")
        assert "Restart the controller" in broken.remedy


def test_a_clock_that_jumps_ahead_makes_everything_stale() -> None:
    run = Run("plant_link_lost").feed(0.0, 5.0)
    _, actions = safety.evaluate({}, run.state, run.now + 1e6)
    assert safety.decision(actions) is Act.DEFOCUS


def test_a_wrong_name_is_told() -> None:
    run = Run("wind_mean_stow")
    _, actions = safety.evaluate({("wind_maen", ""): Reading(3.0, 100.5)}, run.state, 100.5)
    assert [a.text for a in actions] == [
        (
            "reading 'wind_maen' is not used by any condition of the safety table, so nothing "
            "monitors it"
        )
    ]
    assert not actions[0].waits  # there is nothing to acknowledge


def test_only_the_cluster_that_is_silent_is_defocused() -> None:
    row = ROWS["cluster_silent"]
    state = safety.start([row], 0.0, {row.name: ("A", "B")})
    for k in range(1, 20):
        now = 0.5 * k
        readings = {(row.reading, "A"): Reading(0.0, now)}
        if now < 3.0:
            readings[row.reading, "B"] = Reading(0.0, now)
        state, actions = safety.evaluate(readings, state, now)
    assert state.tripped() == (("cluster_silent", "B"),)
    assert safety.decision(actions, cluster="A") is None
    assert safety.decision(actions, cluster="B") is Act.DEFOCUS
    assert actions[0].text.endswith("DEFOCUS of cluster B")


def test_the_table_holds_its_budgets() -> None:
    for row in CONDITIONS:
        if row.act is Act.DEFOCUS:
            # At least 20 s remain for the motion within the 30 s of the requirement.
            assert row.detection + 20.0 <= row.budget <= 30.0, row.name
        if row.act is Act.STOW or math.isfinite(row.then_stow):
            start = row.detection + (0.0 if row.act is Act.STOW else row.then_stow)
            assert start + 120.0 <= safety.STOW_BUDGET, row.name
        assert (row.severity is Severity.EMERGENCY) <= row.latched, row.name
    assert ROWS["plant_link_lost"].trips == 3.0
    # Nobody knows keep-out volumes then, so no beam may wait 30 s in one for its STOW.
    assert ROWS["plant_link_lost"].then_stow == 20.0
    assert ROWS["sun_stale"].trips == 6.0


def test_autonomy_moves_the_plant_link_only() -> None:
    other = {row.name: row for row in safety.conditions(autonomy=120.0)}
    changed = [name for name, row in other.items() if row != ROWS[name]]
    assert changed == ["plant_link_lost"]
    assert other["plant_link_lost"].trips == 123.0
    for wrong in (-1.0, math.nan):
        with pytest.raises(InputError, match=r"autonomy must be finite"):
            safety.conditions(wrong)


def test_every_tier_has_its_rows() -> None:
    parts = [safety.watched_by(CONDITIONS, tier) for tier in Watcher]
    assert sorted(row.name for part in parts for row in part) == sorted(ROWS)
    assert [row.name for row in parts[2]] == ["sun_stale"]


@pytest.mark.parametrize(
    ("name", "changes", "text"),
    [
        ("wind_gust_stow", {"trips": 15.0}, "trips and releases are both 15"),
        ("wind_gust_stow", {"trips": math.nan}, "must be finite numbers"),
        ("wind_gust_stow", {"stale_after": 400.0}, "noticed after 400 s, later than its budget of"),
        ("wind_gust_stow", {"delay": -1.0}, r"delay must be 0 or more and finite, not -1\.0 s"),
        ("operator_emergency", {"then_stow": math.nan}, "then_stow must be 0 or more, not nan s"),
        ("sun_stale", {"trips": 1.0, "releases": 2.0}, "an age must trip above its release"),
    ],
)
def test_a_row_that_contradicts_itself_is_refused(
    name: str, changes: dict[str, Any], text: str
) -> None:
    with pytest.raises(InputError, match=text):
        replace(ROWS[name], **changes)


def test_start_refuses_what_cannot_be_watched() -> None:
    with pytest.raises(InputError, match="is in the table"):
        safety.start((*CONDITIONS, CONDITIONS[0]), 0.0)
    with pytest.raises(InputError, match="monotonic time must be finite"):
        safety.start(CONDITIONS, math.nan)
    with pytest.raises(UnknownNameError, match="no condition 'cluster_slient'; did you mean"):
        safety.start(CONDITIONS, 0.0, {"cluster_slient": ("A",)})


def test_an_alarm_tells_who_must_acknowledge_it_if_anybody_must() -> None:
    row = ROWS["operator_emergency"]
    assert row.consequence == (
        "DEFOCUS of the field; STOW after 30 s; holds until acknowledged (operator)."
    )
    supervised = replace(row, role=AcknowledgeRole.SUPERVISOR)
    assert supervised.consequence.endswith("; holds until acknowledged (engineer).")
    assert replace(row, role=None).consequence == "DEFOCUS of the field; STOW after 30 s."


def test_texts_of_acts_name_what_pre_empts() -> None:
    assert "pre-empts everything" in Act.STOW.text
    assert list(Act) == sorted(Act)
    assert max(Act) is Act.STOW


VALUE = st.sampled_from(
    [
        -math.inf,
        -1.0,
        0.0,
        0.05,
        0.3,
        0.45,
        0.55,
        0.7,
        0.85,
        0.95,
        1.1,
        4.0,
        8.0,
        11.5,
        16.0,
        30.0,
        math.nan,
    ]
)
STEP = st.sampled_from([0.0, 0.5, 1.0, 3.0, 20.0])
NAMES = sorted({row.reading for row in CONDITIONS})


def _steps(count: int = 20) -> st.SearchStrategy[list[tuple[float, dict[str, float]]]]:
    given_ = st.dictionaries(st.sampled_from(NAMES), VALUE, max_size=6)
    return st.lists(st.tuples(STEP, given_), max_size=count)


def _readings(values: dict[str, float], now: float) -> dict[tuple[str, str], Reading]:
    return {(name, ""): Reading(value, now) for name, value in values.items()}


@given(st.sampled_from(LATCHED), _steps())
def test_no_readings_lead_out_of_a_latched_emergency(
    name: str, steps: list[tuple[float, dict[str, float]]]
) -> None:
    row = ROWS[name]
    bad = TRIPS[name][0]
    state, now = safety.start(CONDITIONS, 0.0), 0.0
    while (name, "") not in state.tripped():
        now += 0.5
        state, _ = safety.evaluate({(row.reading, ""): Reading(bad, now)}, state, now)
    for step, values in steps:
        now += step
        state, actions = safety.evaluate(_readings(values, now), state, now)
        demanded = safety.decision(actions)
        assert demanded is not None
        assert demanded >= row.act
        assert name in {a.condition for a in actions}


def _worse(row: Condition, a: float, b: float) -> float:
    """The worse of two values for a row; a value that is none is left alone."""
    return max(a, b) if row.above else min(a, b)


@given(st.sampled_from(CONDITIONS), st.lists(st.tuples(STEP, VALUE, VALUE), max_size=60))
def test_worse_readings_never_demand_less(
    row: Condition, steps: list[tuple[float, float, float]]
) -> None:
    mild = strong = safety.start([row], 0.0)
    now = 0.0
    for step, a, b in steps:
        now += step
        counts = math.isfinite(a) and math.isfinite(b)
        milder, worse = (a, _worse(row, a, b)) if counts else (math.nan, math.nan)
        mild, less = safety.evaluate({(row.reading, ""): Reading(milder, now)}, mild, now)
        strong, more = safety.evaluate({(row.reading, ""): Reading(worse, now)}, strong, now)
        assert _rank(more) >= _rank(less)


def _rank(actions: list[Action]) -> int:
    act = safety.decision(actions)
    return -1 if act is None else int(act)


@given(_steps(20), st.lists(STEP, max_size=30), st.sets(st.sampled_from(NAMES)))
def test_staleness_never_improves_anything(
    steps: list[tuple[float, dict[str, float]]], silence: list[float], repeated: set[str]
) -> None:
    state, now = safety.start(CONDITIONS, 0.0), 0.0
    last: dict[tuple[str, str], Reading] = {}
    actions: list[Action] = []
    for step, values in steps:
        now += step
        last = _readings(values, now)
        state, actions = safety.evaluate(last, state, now)
    # Some readings are given again and again as they were, the others cease.
    frozen = {key: reading for key, reading in last.items() if key[0] in repeated}
    for step in silence:
        now += step
        before, was = set(state.tripped()), _rank(actions)
        state, actions = safety.evaluate(frozen, state, now)
        assert before <= set(state.tripped())
        assert _rank(actions) >= was
    for later in (1000.0, 1010.0):
        state, actions = safety.evaluate({}, state, now + later)
    assert {a.condition for a in actions} == set(ROWS), "in the end every row has tripped"


@given(_steps(15))
def test_evaluation_is_pure(steps: list[tuple[float, dict[str, float]]]) -> None:
    def run() -> tuple[SafetyState, list[Action]]:
        state, now, actions = safety.start(CONDITIONS, 0.0), 0.0, []
        for step, values in steps:
            now += step
            state, actions = safety.evaluate(_readings(values, now), state, now)
        return state, actions

    assert run() == run()


# The proof of an emergency


def test_proof_names_every_node_that_is_silent() -> None:
    proof = Proof.of("DEFOCUS", ("A1", "A2", "A3"), 50.0)
    for node in ("A1", "A3"):
        proof = proof.with_news(acknowledged={node: 50.4})
    early = proof.report(50.9)
    assert (early.unacknowledged, early.late) == (("A2",), ())
    assert safety.proof_readings(proof, 50.9)["nodes_unacknowledged", ""].value == 0.0
    report = proof.report(51.1)
    assert report.late == ("A2",)
    assert "1 not acknowledged: A2; 3 not done: A1, A2, A3; flux not proven yet" in report.text
    assert safety.proof_readings(proof, 51.1)["nodes_unacknowledged", ""].value == 1.0


def test_proof_is_complete_only_with_every_node_and_the_flux() -> None:
    proof = Proof.of("DEFOCUS", ("A1", "A2"), 0.0)
    for node, at in (("A1", 12.0), ("A2", 20.0)):
        proof = proof.with_news(acknowledged={node: 0.5}).with_news(done={node: at})
    assert not proof.report(21.0).complete
    proof = proof.with_flux(0.3, 20.0)
    assert not proof.report(21.0).complete
    proof = proof.with_flux(0.04, 21.0)
    report = proof.report(22.0)
    assert report.complete
    assert report.late == ()
    assert "the flux is below its limit" in report.text
    # The reading grows old, and proves nothing any more.
    assert proof.report(40.0).flux is FluxProof.NOT_BELOW
    assert "flux not proven to be below 10%" in proof.report(40.0).text
    assert safety.proof_readings(proof, 40.0)["flux_after_emergency", ""].value == 1.0


def test_proof_counts_what_is_late() -> None:
    proof = Proof.of("DEFOCUS", ("A1", "A2", "A3"), 0.0)
    proof = proof.with_news(acknowledged={"A1": 2.0}).with_news(done={"A2": 31.0})
    assert proof.report(29.0).late == ("A1", "A2", "A3")
    done = (
        proof.with_news(done={"A1": 10.0})
        .with_news(acknowledged={"A3": 0.2})
        .with_news(done={"A3": 20.0})
    )
    assert done.report(40.0).late == ("A1", "A2"), "late once is late"
    assert Proof.of("STOW", ("A1",), 0.0).with_news(done={"A1": 0.9}).report(299.0).late == ()
    assert Proof.of("STOW", ("A1",), 0.0).with_news(acknowledged={"A1": 0.9}).report(
        301.0
    ).late == ("A1",)
    assert proof.report(math.nan).late == ("A1", "A2", "A3")


def test_reports_that_prove_nothing_are_counted_and_left_out() -> None:
    proof = Proof.of("STOW", ("A1",), 10.0)
    proof = (
        proof.with_news(acknowledged={"A1": 9.9})
        .with_news(done={"B7": 11.0})
        .with_news(done={"A1": math.nan})
    )
    proof = proof.with_flux(math.nan, 12.0).with_flux(0.01, 9.0)
    assert proof.refused == 5
    assert proof.report(11.0).unacknowledged == ("A1",)
    proof = proof.with_flux(0.5, 12.0).with_flux(0.01, 11.0)
    assert proof.flux == Reading(0.5, 12.0), "a reordered reading must not replace a newer one"
    again = proof.with_news(acknowledged={"A1": 10.5}).with_news(acknowledged={"A1": 30.0})
    assert again.acknowledged == {"A1": 10.5}
    with pytest.raises(InputError, match="only DEFOCUS and STOW are proven"):
        Proof.of("TRACK", (), 0.0)
    with pytest.raises(InputError, match="not a time"):
        Proof.of("STOW", (), math.nan)


def test_a_proof_rests_on_the_mirrors_where_nobody_measures_the_flux() -> None:
    proof = Proof.of("DEFOCUS", ("A1", "A2"), 0.0, flux_measured=False)
    proof = proof.with_news(acknowledged={"A1": 0.5}).with_news(done={"A1": 12.0})
    report = proof.report(40.0)
    assert not report.complete, "A2 is not known to be done"
    assert "1 not done: A2; the flux on the receiver is not measured" in report.text
    assert safety.proof_readings(proof, 40.0)["flux_after_emergency", ""].value == 0.0
    report = proof.with_news(done={"A2": 41.0}).report(50.0)
    assert report.complete
    assert report.flux is FluxProof.NOT_MEASURED
    assert report.text.endswith("a stalled drive reports the same")


@pytest.mark.parametrize(("share", "trips"), [(0.05, False), (0.12, True), (None, True)])
def test_flux_that_stays_after_an_emergency_stows(share: float | None, trips: bool) -> None:
    proof = Proof.of("DEFOCUS", ("A1",), 0.0)
    row = ROWS["flux_after_emergency"]
    state = safety.start([row], 0.0)
    for now in range(1, 40):
        if share is not None:
            proof = proof.with_flux(share, float(now))
        readings = safety.proof_readings(proof, float(now))
        mine = {key: value for key, value in readings.items() if key[0] == row.reading}
        state, actions = safety.evaluate(mine, state, float(now))
        assert now > 30 or actions == []
    assert (safety.decision(actions) is Act.STOW) is trips


def test_without_an_emergency_the_proof_is_silent() -> None:
    assert {r.value for r in safety.proof_readings(None, 5.0).values()} == {0.0}


# Joining


def test_joining_is_bounded_in_every_span() -> None:
    limiter, joined = JoinLimiter(rate=4.0, burst=3), []
    for k in range(400):
        now = 0.05 * k
        limiter, granted = limiter.admit(100, now)
        joined += [now] * granted
    for k, at in enumerate(joined):
        for span in (0.0, 0.5, 1.0, 5.0):
            assert sum(at <= t <= at + span + 1e-9 for t in joined[k:]) <= 3 + 4.0 * span + 1e-6
    assert len(joined) == pytest.approx(4.0 * 19.95, abs=1.0), "and it is not bounded to less"


@given(
    st.lists(
        st.tuples(
            st.sampled_from([-5.0, 0.0, 0.1, 1.0, 1e9, math.nan, math.inf]), st.integers(-2, 50)
        ),
        max_size=40,
    )
)
def test_no_clock_lets_more_mirrors_join(steps: list[tuple[float, int]]) -> None:
    limiter, now, total, most = JoinLimiter(2.0, 5), 0.0, 0, 0.0
    for step, wanted in steps:
        at = now + step
        limiter, granted = limiter.admit(wanted, at)
        assert 0 <= granted <= max(wanted, 0)
        assert granted <= 5
        if math.isfinite(step):
            most += min(5.0, 2.0 * max(step, 0.0))
            now = max(now, at) if step > 0.0 else now
        total += granted
    assert total <= most + 1e-6


def test_a_new_limiter_starts_empty_and_zero_joins_none() -> None:
    limiter, granted = JoinLimiter(10.0, 5).admit(5, 1000.0)
    assert granted == 0
    assert limiter.admit(5, 1000.2)[1] == 2
    assert limiter.admit(-3, 2000.0)[1] == 0
    with pytest.raises(
        InputError, match=r"joining rate must be finite and 0 or more, not -1\.0 heliostats/s"
    ):
        JoinLimiter(-1.0, 5)
    with pytest.raises(
        InputError, match="joining burst must be a whole number of at least 1, not 0"
    ):
        JoinLimiter(1.0, 0)


def test_a_row_about_heliostats_is_evaluated_for_those_with_a_reading() -> None:
    row = next(r for r in CONDITIONS if r.name == "keep_out_predicted")
    state = safety.start([row], 0.0)
    for now, subjects, tripped in (
        (1.0, (), set()),
        (2.0, ("A", "B"), {"A", "B"}),
        (3.0, ("A",), {"A", "B"}),
        # Clear for two seconds.
        (6.0, ("A",), {"A"}),
        (7.0, (), {"A"}),
        (10.0, (), set()),
        (11.0, (), set()),
    ):
        state = safety.narrowed(state, row.name, subjects)
        readings = {(row.reading, subject): Reading(1.0, now) for subject in subjects}
        readings[row.reading, ""] = Reading(0.0, now)
        state, actions = safety.evaluate(readings, state, now)
        assert {a.subject for a in actions} == tripped
        assert {a.act for a in actions} <= {Act.DEFOCUS}
    assert set(safety.narrowed(state, row.name, ()).tracks) == {(row.name, "")}


def test_an_unknown_time_is_not_shown_as_a_number() -> None:
    row = ROWS["holdover_exhausted"]
    assert row.shown(3600.0) == "3.6e+03 s"
    told = row.wrong.format(value=row.shown(1e9))
    assert told == "the cluster's time is uncertain by an unknown time"
