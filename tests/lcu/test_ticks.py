"""Ticks that wrap, and spans of time that nothing extends."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from heliotrope.lcu import ticks

TICK = st.integers(0, ticks.PERIOD - 1)
STEP = st.integers(-ticks.HALF, ticks.HALF - 1)


@pytest.mark.parametrize(
    ("later", "earlier", "difference"),
    [  # as MicroPython 1.25's time.ticks_diff; test_micropython.py compares at random
        (5, (1 << 30) - 5, 10),
        ((1 << 30) - 5, 5, -10),
        (0, 1 << 29, -(1 << 29)),
        (1 << 29, 0, -(1 << 29)),
        ((1 << 29) - 1, 0, (1 << 29) - 1),
        (7, 7, 0),
    ],
)
def test_differences(later: int, earlier: int, difference: int) -> None:
    assert ticks.diff(later, earlier) == difference


@given(TICK, STEP)
def test_adding_and_taking_the_difference(tick: int, step: int) -> None:
    later = ticks.add(tick, step)
    assert 0 <= later < ticks.PERIOD
    assert ticks.diff(later, tick) == step


def test_a_deadline_is_over_when_made() -> None:
    assert ticks.Deadline().over(12345)


@given(TICK, st.integers(1, 100_000))
def test_a_deadline_ends_on_time(start: int, span: int) -> None:
    deadline = ticks.Deadline()
    deadline.start(start, span)
    assert deadline.look(ticks.add(start, span // 2)) == span - span // 2
    assert not deadline.over(ticks.add(start, span - 1))
    assert deadline.over(ticks.add(start, span))


@given(TICK, st.integers(0, ticks.HALF - 1), st.lists(STEP, max_size=40))
def test_no_jump_and_no_wrap_extends_a_deadline(start: int, span: int, steps: list[int]) -> None:
    """Steps back are jumps of the counter: they take no time, but are charged all the same."""
    deadline = ticks.Deadline()
    deadline.start(start, span)
    tick, passed, was_over = start, 0, span == 0
    for step in steps:
        tick = ticks.add(tick, step)
        passed += max(0, step)
        over = deadline.over(tick)
        assert over or passed < span, "still running after its time"
        assert over or not was_over, "came back to life"
        was_over = over


def test_a_jump_is_no_more_time_than_was_left() -> None:
    """A counter set back by a second, then running on: the span ends a second early."""
    deadline = ticks.Deadline()
    deadline.start(10_000, 3000)
    deadline.look(10_500)
    assert deadline.look(9_500) == 1500
    assert deadline.over(11_000)


def test_a_deadline_polled_for_weeks() -> None:
    """The counter wraps every 12.4 days; a span renewed now and then ends as told each time."""
    rng = random.Random(31)
    deadline, tick = ticks.Deadline(), 0
    for _ in range(2000):
        span = rng.randrange(1, 6000)
        deadline.start(tick, span)
        waited = 0
        while not deadline.over(tick):
            step = rng.randrange(1, 50)
            waited += step
            tick = ticks.add(tick, step)
        assert span <= waited < span + 50
        tick = ticks.add(tick, rng.randrange(1 << 28))
        assert deadline.over(tick)


def test_end() -> None:
    deadline = ticks.Deadline()
    deadline.start(0, 100)
    deadline.end()
    assert deadline.over(0)


@pytest.mark.parametrize("span", [-1, 1 << 29, 1 << 30])
def test_a_span_that_cannot_be_measured(span: int) -> None:
    deadline = ticks.Deadline()
    deadline.start(0, 100)
    with pytest.raises(ValueError, match=rf"span of {span} ticks: must be 0 to 536870911"):
        deadline.start(0, span)
    assert deadline.over(0)
