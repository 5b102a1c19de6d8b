"""The state table, exhaustively; and its page in the documentation."""

from collections.abc import Callable

import pytest
from scripts import state_table

from heliotrope.lcu import names, states
from heliotrope.lcu.motion import Motion

TRANSITIONS = names.transitions()
EVERY = range(len(states.STATES))


def _reached(start: int, kinds: tuple[int, ...]) -> set[int]:
    """States that events of these kinds can lead to."""
    found, open_ = {start}, [start]
    while open_:
        state = open_.pop()
        for event, (kind, _) in names.EVENTS.items():
            step = states.transition(state, event) if kind in kinds else None
            if step is not None and step[0] not in found:
                found.add(step[0])
                open_.append(step[0])
    return found


def test_every_row_is_whole() -> None:
    rows = [(state, event) for state, event, _, _ in TRANSITIONS]
    assert len(set(rows)) == len(rows)
    for state, event, new, motion in TRANSITIONS:
        assert states.transition(state, event) == (new, motion)
        assert event in names.EVENTS
        if motion:
            assert motion in names.MOTIONS
            assert callable(getattr(Motion, motion))
    assert {event for _, event, _, _ in TRANSITIONS} == set(names.EVENTS)
    assert {row[3] for row in TRANSITIONS} - {""} == set(names.MOTIONS)
    assert all(names.EVENTS[event][0] in (0, 1, 2) for event in names.EVENTS)


@pytest.mark.parametrize("start", [s for s in EVERY if s != states.TRACKING])
def test_no_way_to_tracking_without_a_command(start: int) -> None:
    """Invariant 3, for STOWED and FAULT and for every other state as well."""
    reached = _reached(start, (names.SAFE, names.INTERNAL))
    assert states.TRACKING not in reached


@pytest.mark.parametrize("start", [states.STOWED, states.FAULT, states.UNCONFIGURED, states.LOCKED])
def test_no_beam_on_the_receiver_without_a_command(start: int) -> None:
    reached = _reached(start, (names.SAFE, names.INTERNAL))
    assert not reached & {states.TRACKING, states.SEARCHING, states.APPROACHING, states.IDLE}


@pytest.mark.parametrize("start", EVERY)
def test_defocus_and_stow_are_taken_in_every_state(start: int) -> None:
    """Invariant 4: never refused, never answered by staying on the receiver."""
    on_the_way = {states.APPROACHING, states.TRACKING, states.SEARCHING, states.IDLE}
    for event, motions in (
        ("DEFOCUS", {"defocus", "stow_directly"}),
        ("STOW", {"stow", "stow_directly"}),
    ):
        step = states.transition(start, event)
        assert step is not None
        assert step[0] not in on_the_way
        if start in on_the_way or start in (states.LOCKED, states.FAULT):
            assert step[1] in motions


@pytest.mark.parametrize("start", EVERY)
def test_stow_leads_to_stowed_by_itself(start: int) -> None:
    step = states.transition(start, "STOW")
    assert step is not None
    if start in (states.UNCONFIGURED, states.LOCKED, states.FAULT):
        assert step == (start, "stow_directly")  # the mirror goes, the latch stays
    elif step[0] == states.STOWING:
        assert states.transition(states.STOWING, "ARRIVED") == (states.STOWED, "hold")
    else:
        assert step[0] == states.STOWED


def test_what_needs_the_sun_is_left_when_it_lapses() -> None:
    for state in states.NEED_SUN:
        step = states.transition(state, "LAPSED")
        assert step == (states.DEFOCUSED, "defocus")
    step = states.transition(states.DEFOCUSED, "SILENT")
    assert step == (states.STOWING, "stow_directly")


@pytest.mark.parametrize("state", [states.LOCKED, states.UNCONFIGURED, states.FAULT])
def test_a_latched_mirror_goes_when_the_cluster_falls_silent(state: int) -> None:
    """Invariant 13: the latch stays, the beam goes."""
    assert states.transition(state, "LAPSED") == (state, "defocus")
    assert states.transition(state, "SILENT") == (state, "stow_directly")


def test_fault_and_lock_are_left_by_their_own_commands_alone() -> None:
    for state, word in ((states.FAULT, "CLEAR_FAULT"), (states.LOCKED, "UNLOCK")):
        for start, event, new, _ in TRANSITIONS:
            if start == state and new != state and not event.startswith(word):
                assert (state, event) == (states.FAULT, "LOCK")  # and UNLOCK_FAULT leads back
    for start, event, new, _ in TRANSITIONS:
        if event in ("CLEAR_FAULT", "CLEAR_FAULT_STOWED"):
            assert start == states.FAULT
            assert new in (states.IDLE, states.STOWED)


def test_every_state_is_reached_and_none_is_a_trap() -> None:
    every = (names.SAFE, names.COMMAND, names.INTERNAL)
    assert _reached(states.UNCONFIGURED, every) == set(EVERY)
    for state in EVERY:
        assert states.STOWED in _reached(state, every)


def test_an_illegal_event_is_refused() -> None:
    assert states.transition(states.STOWED, "TRACK") is None
    assert states.transition(states.STOWED, "REFOCUS") is None
    assert states.transition(states.TRACKING, "GOTO") is None
    assert states.transition(states.TRACKING, "NO_SUCH_EVENT") is None


def test_the_page_shows_every_transition() -> None:
    text = state_table.table()
    assert text.count("\n| ") == len(TRANSITIONS)
    for state, event, new, _ in TRANSITIONS:
        assert f"| {states.STATES[state]} | {event} | {states.STATES[new]} |" in text


# The named sets.


@pytest.mark.parametrize(
    ("sets", "leads"),
    [
        (states.UP, lambda s: states.transition(s, "STOW") == (states.STOWING, "stow")),
        (states.ON_AIM, lambda s: s in _reached_by("TRACK") | _reached_by("SEARCH")),
        (states.KEPT, lambda s: s not in states.TO_STOW and _after(s, "STOW") == s),
    ],
)
def test_the_named_sets_agree_with_the_table(
    sets: tuple[int, ...], leads: Callable[[int], bool]
) -> None:
    assert set(sets) == {state for state in EVERY if leads(state)}


def test_the_named_sets_lie_in_each_other() -> None:
    assert set(states.ON_AIM) < set(states.BEAM_OUT) < set(states.UP)
    assert set(states.AVAILABLE) < set(states.BEAM_OUT)
    assert not set(states.BEAM_OUT) & {*states.LEAVING, *states.TO_STOW, *states.AWAY}


def test_every_flag_has_its_bit() -> None:
    assert [getattr(names, flag) for flag in names.FLAGS] == [1 << i for i in range(20)]


def _after(state: int, event: str) -> int | None:
    step = states.transition(state, event)
    return None if step is None else step[0]


def _reached_by(event: str) -> set[int | None]:
    return {_after(state, event) for state in EVERY} - {None}
