"""The limits of a site: what a plant may set in the safety table, and what no file loosens."""

import math

import pytest

from heliotrope import safety
from heliotrope.errors import InputError
from heliotrope.safety import CONDITIONS, Act, Condition
from heliotrope.safety.limits import NOTICED, schema

SETTABLE = [row for row in CONDITIONS if safety.settings_of(row)]


def row_of(table: tuple[Condition, ...], name: str) -> Condition:
    return next(row for row in table if row.name == name)


def test_limits_change_their_rows_and_no_others() -> None:
    given = {
        "wind_gust_stow": {"trips_m_s": 18.0, "releases_m_s": 13.0},
        "pointing_disagrees": {"trips_mrad": 2.5},
        "sun_below_horizon": {"trips_deg": 4.0, "releases_deg": 6.0},
        "receiver_flow_low": {"trips_percent": 85.0},
        "pointing_disagrees_many": {"trips": 40.0},
        "wind_mean_defocus": {"then_stow_s": 60.0, "clear_for_s": 300.0},
    }
    table = safety.limited(CONDITIONS, given)
    assert {row.name for row in table if row not in CONDITIONS} == set(given)
    assert [row.name for row in table] == [row.name for row in CONDITIONS]
    assert row_of(table, "wind_gust_stow").trips == 18.0
    assert row_of(table, "pointing_disagrees").trips == pytest.approx(2.5e-3)
    assert row_of(table, "sun_below_horizon").releases == pytest.approx(math.radians(6.0))
    assert row_of(table, "receiver_flow_low").trips == pytest.approx(0.85)
    assert row_of(table, "pointing_disagrees_many").trips == 40.0
    assert row_of(table, "wind_mean_defocus").then_stow == 60.0


@pytest.mark.parametrize("row", SETTABLE, ids=[row.name for row in SETTABLE])
def test_a_row_takes_its_own_numbers_and_the_ends_of_its_range(row: Condition) -> None:
    keys = {key: one for key, one in safety.settings_of(row).items() if not key.endswith("_mrad")}
    own = {key: one.shown(row) for key, one in keys.items() if math.isfinite(one.shown(row))}
    again = row_of(safety.limited(CONDITIONS, {row.name: own}), row.name)
    assert again.trips == pytest.approx(row.trips)
    for one in keys.values():
        if one.number == "trips":
            for wrong in (one.low - 1e-3, one.high * 1.001 + 1e-9, math.nan, math.inf):
                with pytest.raises(InputError, match="must be between"):
                    safety.limited(CONDITIONS, {row.name: {one.key: wrong}})


def test_no_limits_loosen_the_time_in_which_beams_are_off() -> None:
    """A fault is noticed and left in time, whatever a plant sets."""
    for row in SETTABLE:
        for key, one in safety.settings_of(row).items():
            if one.number in ("trips", "releases"):
                continue
            try:
                (changed,) = safety.limited([row], {row.name: {key: one.high}})
            except InputError:
                assert one.number in ("delay", "stale_after")
                continue
            if row.act in NOTICED:
                assert changed.detection <= NOTICED[row.act]
            if math.isfinite(changed.then_stow):
                assert changed.then_stow <= min(row.then_stow, 120.0)
            assert (changed.budget, changed.act) == (row.budget, row.act)


def test_rows_of_leases_and_of_orders_cannot_be_set() -> None:
    fixed = {row.name for row in CONDITIONS} - {row.name for row in SETTABLE}
    assert {"operator_emergency", "emergency_line", "plant_link_lost", "cluster_silent"} <= fixed
    assert "sun_stale" in fixed
    for name in fixed:
        with pytest.raises(InputError, match=f"{name}: its limits cannot be set in a plant file,"):
            safety.limited(CONDITIONS, {name: {"delay_s": 1.0}})


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (
            {"wind_gust_stow": {"trips_m_s": 45.0}},
            "wind_gust_stow.trips_m_s must be between 5 and 30, not 45",
        ),
        (
            {"wind_gust_stow": {"trips_m_s": 14.0}},
            (
                "wind_gust_stow: the release at 15 m/s must be below the trip at 14 m/s; "
                "set trips and releases together"
            ),
        ),
        (
            {"ups_charge_low": {"releases_percent": 40.0}},
            (
                "ups_charge_low: the release at 40 % must be above the trip at 50 %; set "
                "trips and releases together"
            ),
        ),
        (
            {"wind_gust_defocus": {"trips_m_s": 22.0}},
            (
                "wind_gust_defocus: DEFOCUS at 22 m/s would come after STOW at 20 m/s "
                "(wind_gust_defocus, wind_gust_stow); set both"
            ),
        ),
        (
            {"wind_gust_defocus": {"delay_s": 6.0}},
            (
                "wind_gust_defocus: the condition would be noticed after 11 s, and DEFOCUS needs "
                "10 s at most; shorten delay_s or stale_after_s"
            ),
        ),
        (
            {"wind_gust_stow": {"trips_ms": 18.0}},
            "wind_gust_stow.trips_ms is not known; did you mean trips_m_s?",
        ),
        (
            {"wind_gst_stow": {"trips_m_s": 18.0}},
            "wind_gst_stow: no such condition is in this table; did you mean wind_gust_stow?",
        ),
        (
            {"pointing_disagrees": {"trips_deg": 0.2, "trips_mrad": 3.0}},
            "pointing_disagrees.trips_mrad: trips is specified twice",
        ),
        (
            {"keep_out_predicted": {"then_stow_s": 31.0}},
            "keep_out_predicted.then_stow_s must be between 0 and 30, not 31",
        ),
    ],
)
def test_limits_that_cannot_be_are_one_line(given: safety.Limits, text: str) -> None:
    with pytest.raises(InputError) as caught:
        safety.limited(CONDITIONS, given)
    assert str(caught.value) == text


def test_what_differs_is_said_with_the_old_and_the_new_number() -> None:
    table = safety.limited(CONDITIONS, {"wind_gust_stow": {"trips_m_s": 18.0}})
    before, after = safety.numbers(CONDITIONS), safety.numbers(table)
    assert safety.differences(before, before) == []
    assert safety.differences(before, after) == ["wind_gust_stow.trips_m_s: 20 → 18"]
    known = {key: value for key, value in before.items() if key != "wind_gust_stow.trips_m_s"}
    assert safety.differences(known, after) == []


def test_the_schema_has_a_key_for_each_number() -> None:
    found = schema(CONDITIONS)["properties"]
    assert set(found) == {row.name for row in SETTABLE}
    gust = found["wind_gust_stow"]["properties"]
    assert gust["trips_m_s"] == {"type": "number", "default": 20.0, "minimum": 5.0, "maximum": 30.0}
    assert {row.act for row in SETTABLE} == {Act.ALARM, Act.REFUSE_NEW, Act.DEFOCUS, Act.STOW}
