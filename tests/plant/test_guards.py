"""The table of guards: what stops a heliostat, and which reason is given."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from heliotrope.lcu import messages, states
from heliotrope.plant.motion.proofs import BeamError
from heliotrope.plant.orders.guards import Asked, Guards
from heliotrope.plant.refusals import BEAM_REFUSED, NOT_NOW, OUT_OF_SERVICE, RefusedError

NAMES = ("A", "B", "C")
COMMANDS = messages.ORDERS | messages.SAFE | {"PARAMETERS"}


def plant(**parts: Any) -> Guards:
    """Guards of three heliostats in two clusters; nothing stops them but ``parts``."""
    field = SimpleNamespace(
        index={name: i for i, name in enumerate(NAMES)},
        place={name: i for i, name in enumerate(NAMES)}.__getitem__,
        clusters=("north", "south"),
        cluster=np.array([0, 0, 1]),
        rows={"state": np.full(3, states.STOWED)},
    )
    free: dict[str, Any] = {
        "field": field,
        "authority": SimpleNamespace(visited=dict),
        "orders": SimpleNamespace(to_stow=lambda name: False),
        "sentinel": alarms({}),
        "second_plant": SimpleNamespace(refusal=lambda clusters: ""),
        "witnesses": SimpleNamespace(contradiction=""),
        "identities": SimpleNamespace(blocked=lambda name: None),
        "sync": SimpleNamespace(differing=lambda name: None),
        "doubtful": SimpleNamespace(reasons=lambda names, points: [None] * len(names)),
        "lockouts": SimpleNamespace(reasons=lambda names, points: ()),
        "given": SimpleNamespace(untaken=lambda *_: None, unknown=lambda *_: None),
        "aims": np.zeros((3, 3)),
    }
    return Guards(**(free | parts))


def alarms(blocked: dict[str, dict[str, str]], cluster: str = "", night: str = "") -> Any:
    """A sentinel whose rows keep heliostats from their aims, or hold a cluster."""

    def of(condition: str = "") -> dict[str, str]:
        some = blocked.values() if not condition else [blocked.get(condition, {})]
        return {name: text for each in some for name, text in each.items()}

    return SimpleNamespace(
        table=SimpleNamespace(blocked=of),
        refusal=lambda clusters: f"{cluster} holds" if cluster in clusters else "",
        night=night,
    )


def stopped(plant: Guards, *kinds: Any) -> set[str]:
    """The commands that guards stop for heliostat A."""
    return {name for name in COMMANDS if plant.reasons(Asked(name, ("A",)), *kinds)}


def test_nothing_leaves_stow_by_a_sun_that_a_witness_contradicts() -> None:
    contradicted = plant(witnesses=SimpleNamespace(contradiction="x"))
    assert stopped(contradicted, NOT_NOW) == {"APPROACH"}
    assert not stopped(contradicted, BEAM_REFUSED, OUT_OF_SERVICE)


def test_nothing_stops_a_plant_in_order() -> None:
    assert not stopped(plant(), OUT_OF_SERVICE, NOT_NOW, BEAM_REFUSED)


@pytest.mark.parametrize(
    ("parts", "commands"),
    [
        (
            {"given": SimpleNamespace(untaken=lambda *_: "x", unknown=lambda *_: None)},
            messages.JOINING,
        ),
        (
            {"given": SimpleNamespace(untaken=lambda *_: None, unknown=lambda *_: "x")},
            messages.TO_STANDBY,
        ),
        (
            {"doubtful": SimpleNamespace(reasons=lambda names, points: ["x"] * len(names))},
            messages.JOINING | {"AIM"},
        ),
        ({"sentinel": alarms({"any": {"A": "x"}})}, messages.JOINING),
        (
            {"sentinel": alarms({"unproven_after_emergency": {"A": "x"}})},
            messages.JOINING | messages.TO_STANDBY,
        ),
        (
            {"sentinel": alarms({"pointing_disagrees": {"A": "x"}})},
            messages.JOINING | messages.TO_STANDBY,
        ),
        (
            {"sentinel": alarms({"beam_unsent": {"A": "x"}})},
            messages.JOINING | messages.RELEASES,
        ),
        (
            {"sentinel": alarms({"keep_out_predicted": {"A": "x"}})},
            messages.JOINING | messages.RELEASES,
        ),
        ({"orders": SimpleNamespace(to_stow=lambda name: True)}, messages.MOTIONS),
        (
            {"sync": SimpleNamespace(differing=lambda name: "x")},
            messages.MOTIONS | messages.POINTS,
        ),
    ],
)
def test_a_guard_stops_the_commands_with_its_traits(
    parts: dict[str, Any], commands: frozenset[str]
) -> None:
    assert stopped(plant(**parts), BEAM_REFUSED) == commands
    assert not stopped(plant(**parts), NOT_NOW, OUT_OF_SERVICE)


def test_a_board_of_another_takes_only_what_makes_it_safe() -> None:
    other = plant(identities=SimpleNamespace(blocked=lambda name: "another"))
    assert COMMANDS - stopped(other, BEAM_REFUSED) == {"LOCK", "DEFOCUS", "STOW"}


def test_lock_is_accepted_while_an_alarm_holds_and_not_beside_a_second_plant() -> None:
    assert "LOCK" not in stopped(plant(sentinel=alarms({}, "north")), NOT_NOW)
    assert "GOTO" in stopped(plant(sentinel=alarms({}, "north")), NOT_NOW)
    second = plant(second_plant=SimpleNamespace(refusal=lambda clusters: "a second plant"))
    assert "LOCK" in stopped(second, NOT_NOW)


def test_the_night_holds_what_follows_the_sun() -> None:
    night = plant(sentinel=alarms({}, night="the sun is down"))
    assert stopped(night, NOT_NOW) == messages.JOINING | messages.TO_STANDBY


def test_a_lock_of_a_person_lets_pass_what_moves_nothing() -> None:
    out = plant(lockouts=SimpleNamespace(reasons=lambda names, points: ["locked", None, None]))
    assert COMMANDS - stopped(out, OUT_OF_SERVICE) == messages.HARMLESS | messages.SAFE


def test_a_beam_that_went_astray_may_be_sent_to_standby_from_its_aim() -> None:
    astray = plant(sentinel=alarms({"pointing_disagrees": {"A": "astray"}}))
    asked = Asked("IDLE", ("A",))
    assert astray.reasons(asked, BEAM_REFUSED) == {"A": "astray"}
    astray.field.rows["state"][0] = states.TRACKING
    assert not astray.reasons(asked, BEAM_REFUSED)


def test_a_setting_waits_for_the_end_of_a_visit_of_others() -> None:
    visit = SimpleNamespace(where="target 1", token=7)
    visited = plant(authority=SimpleNamespace(visited=lambda: {"A": visit}))
    (text,) = visited.reasons(Asked("ROUGH", NAMES, token=1), BEAM_REFUSED).values()
    assert "on a calibration visit to target 1" in text
    assert not visited.reasons(Asked("ROUGH", NAMES, token=7), BEAM_REFUSED)
    assert not visited.reasons(Asked("ROUGH", NAMES), BEAM_REFUSED), "the plant's own order"
    assert not visited.reasons(Asked("IDLE", NAMES, token=1), BEAM_REFUSED)


def test_the_first_row_gives_the_reason_and_heliostats_keep_their_order() -> None:
    several = plant(
        given=SimpleNamespace(untaken=lambda kind, name: "aim" if name == "C" else None),
        identities=SimpleNamespace(blocked=lambda name: f"{name} is not known"),
    )
    found = several.reasons(Asked("TRACK", NAMES), BEAM_REFUSED)
    assert list(found.items()) == [("A", "A is not known"), ("B", "B is not known"), ("C", "aim")]


def test_a_command_goes_to_the_others_and_is_refused_where_none_is_left() -> None:
    some = plant(sync=SimpleNamespace(differing=lambda name: "differs" if name != "B" else None))
    assert some.passed(Asked("IDLE", NAMES), NOT_NOW, BEAM_REFUSED) == (
        ("B",),
        {"A": "differs", "C": "differs"},
    )
    with pytest.raises(BeamError, match=r"IDLE A \(and 1 more\): differs"):
        some.passed(Asked("IDLE", ("A", "C")), NOT_NOW, BEAM_REFUSED)
    with pytest.raises(RefusedError, match="IDLE: not accepted now: north holds"):
        plant(sentinel=alarms({}, "north")).passed(Asked("IDLE", ("A", "B")), NOT_NOW, BEAM_REFUSED)
    locked = plant(lockouts=SimpleNamespace(reasons=lambda names, _: ["hands"] * len(names)))
    with pytest.raises(RefusedError, match="IDLE A and 2 more: hands"):
        locked.passed(Asked("IDLE", NAMES), OUT_OF_SERVICE)


def test_a_hold_of_one_cluster_refuses_points_by_heliostat() -> None:
    north = plant(sentinel=alarms({}, "north"))
    with pytest.raises(BeamError) as refused:
        north.refuse_now("AIM", NAMES)
    assert refused.value.refusals == {"A": "north holds", "B": "north holds"}
    north.refuse_now("AIM", ("C",))
    with pytest.raises(RefusedError, match="not accepted now: north holds"):
        north.refuse_now("AIM", ("A", "B"))


def test_beams_in_doubt_are_judged_by_where_a_command_sends_them() -> None:
    asked_of = []

    def reasons(names: tuple[str, ...], points: Any) -> list[None]:
        asked_of.append(points.tolist())
        return [None] * len(names)

    doubtful = plant(doubtful=SimpleNamespace(reasons=reasons), aims=np.eye(3))
    doubtful.reasons(Asked("TRACK", ("B",)), BEAM_REFUSED)
    doubtful.reasons(Asked("AIM", ("B",), np.full((1, 3), 5.0)), BEAM_REFUSED)
    assert asked_of == [[[0.0, 1.0, 0.0]], [[5.0, 5.0, 5.0]]]
