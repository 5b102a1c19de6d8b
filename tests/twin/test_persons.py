"""The observer of persons' orders and locks can fail, and knows what a restored store has."""

from types import SimpleNamespace
from typing import Any

import pytest

from heliotrope.lcu import states
from heliotrope.safety import Act
from heliotrope.twin.invariants.invariants import WORDS, InvariantError
from heliotrope.twin.invariants.persons import PersonsObserver


def board(state: int = states.STOWED, place: int = 0) -> Any:
    """Return a board that rests."""
    axes = [SimpleNamespace(turned=place, idle=True) for _ in range(2)]
    return SimpleNamespace(
        outfit=SimpleNamespace(name="H1"), state=state, axes=axes, node=SimpleNamespace()
    )


def plant(act: Act | None, *callers: str, locks: tuple[tuple[str, str], ...] = ()) -> Any:
    """Return a plant with an emergency, or None, that persons have called, and with locks."""
    sentinel = SimpleNamespace(
        calls=[SimpleNamespace(who=who) for who in callers],
        order=None if act is None else SimpleNamespace(act=act),
        on=act is not None,
    )
    return SimpleNamespace(
        sentinel=sentinel,
        lockouts=[SimpleNamespace(name=name, who=who) for name, who in locks],
    )


def looks(observer: PersonsObserver, seen: Any, *times: float) -> None:
    """Let an observer look at a plant."""
    for now in times:
        observer.look(seen, now)


def test_an_order_stands_under_its_owners_name_until_it_is_withdrawn() -> None:
    observer = PersonsObserver(0.0, [board()])
    observer.on_call("Ann", Act.DEFOCUS, 0.0)
    observer.on_call("Ben", Act.STOW, 0.0)
    observer.on_call("Ben", Act.DEFOCUS, 5.0)  # the stronger act holds
    looks(observer, plant(Act.STOW, "Ann", "Ben"), 0.0, 10.0)
    with pytest.raises(InvariantError, match=r"invariant 17 .* Ben ordered STOW .* DEFOCUS holds"):
        looks(observer, plant(Act.DEFOCUS, "Ann", "Ben"), 10.0, 13.0)
    with pytest.raises(InvariantError, match=r"Ann ordered DEFOCUS .* names no such order"):
        looks(observer, plant(Act.STOW, "Ben"), 10.0, 13.0)
    observer.withdrew("Ann")
    looks(observer, plant(Act.STOW, "Ben"), 10.0, 13.0)
    with pytest.raises(
        InvariantError, match="an emergency order of Ann is still active, although it was"
    ):
        looks(observer, plant(Act.STOW, "Ann", "Ben"), 10.0, 13.0)
    with pytest.raises(InvariantError, match="the withdrawal of Ben's order is refused: no"):
        observer.withdrawal_refused("Ben", "no", 14.0)
    assert observer.checks[WORDS] > 10


def test_no_mirror_is_up_while_an_order_stands_unless_another_plant_commands() -> None:
    for alone in (True, False):
        observer = PersonsObserver(0.0, [board(states.TRACKING)], alone=alone)
        observer.on_call("Ann", Act.DEFOCUS, 0.0)
        looks(observer, None, 30.0)
        if alone:
            with pytest.raises(InvariantError, match=r"H1: TRACKING 31.5 s after Ann ordered DEFO"):
                looks(observer, None, 31.5)
        else:
            looks(observer, None, 31.5)


def test_a_locked_mirror_stands_still_until_the_last_lock_is_returned() -> None:
    one = board()
    observer = PersonsObserver(0.0, [one])
    observer.locked("Ann", ["H1"], 0.0)
    observer.locked("Ben", ["H1"], 1.0)
    looks(observer, None, 10.0)
    one.axes[0].turned = 400  # it is on its way to stow
    looks(observer, None, 20.0, 21.0)
    observer.returned("Ann", ["H1"])
    one.axes[1].turned = 33
    with pytest.raises(InvariantError, match=r"H1: STOWED, 33 steps from .* locked by Ben"):
        looks(observer, None, 22.0)
    one.node = SimpleNamespace()  # it starts anew, and what it does then no lock prevents
    looks(observer, None, 23.0)
    one.axes[1].turned = 66
    with pytest.raises(InvariantError, match="33 steps"):
        looks(observer, None, 24.0)
    with pytest.raises(InvariantError, match=r"H1: ZERO is sent to it 24\.0 s after it was locked"):
        observer.on_write("H1", "ZERO", 25.0)
    observer.returned("Ben", ["H1"])
    looks(observer, None, 25.0)
    observer.on_write("H1", "ZERO", 25.0)


def test_the_plant_has_the_locks_of_each_person_once_a_restored_store_is_confirmed() -> None:
    observer = PersonsObserver(0.0, [board()])
    observer.locked("Ann", ["H1"], 0.0)
    observer.on_call("Ann", Act.DEFOCUS, 0.0)
    words = observer.words()
    observer.withdrew("Ann")
    observer.locked("Ben", ["H1"], 5.0)
    both = (("H1", "Ann"), ("H1", "Ben"))
    looks(observer, plant(None, locks=both), 10.0, 13.0)
    with pytest.raises(InvariantError, match="H1: the lock of Ben is not there"):
        looks(observer, plant(None, locks=both[:1]), 10.0, 13.0)
    with pytest.raises(InvariantError, match="H1: the lock of Eve is there, and was returned"):
        looks(observer, plant(None, locks=(*both, ("H1", "Eve"))), 10.0, 13.0)
    observer.restored(words, 20.0)
    assert not observer.sure
    # The backup has the order that was withdrawn since, and not the second lock.
    looks(observer, plant(Act.DEFOCUS, "Ann", locks=both[:1]), 20.0, 25.0)
    observer.confirmed()
    with pytest.raises(InvariantError, match="H1: the lock of Ben is not there"):
        looks(observer, plant(Act.DEFOCUS, "Ann", locks=both[:1]), 30.0, 35.0)
