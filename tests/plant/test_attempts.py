"""Attempts: waits, ends, alarms and new beginnings of what automatic control tries again."""

import math

import pytest

from heliotrope.plant.attempts import Attempts, RetryLaw
from heliotrope.safety import Alarm, alarms

LAW = RetryLaw(
    "visit",
    3,
    10.0,
    "a person looks at it",
    longest=15.0,
    rest=100.0,
    alarm=alarms.CALIBRATION_GIVEN_UP,
)


def waits(made: Attempts, subject: str) -> list[float]:
    """Waits after four failures in a row, each at the time at which the one before is due."""
    now, found = 0.0, []
    for _ in range(4):
        made.failed(subject, "no beam", now)
        (shown,) = (one for one in made.shown(now) if one.subject == subject)
        found.append(shown.left)
        assert not made.due(subject, now + shown.left - 1e-3)
        assert subject in made.waiting(now + shown.left - 1e-3)
        now += shown.left
        assert made.due(subject, now)
        assert subject not in made.waiting(now)
    return found


def test_each_failure_waits_longer_and_the_last_one_is_the_end_with_one_alarm_of_its_own() -> None:
    told: list[Alarm] = []
    made = Attempts(LAW, told.append)
    assert made.due("A", 0.0)
    assert made.shown(0.0) == ()
    assert waits(made, "A") == [10.0, 15.0, 100.0, 100.0]
    (shown,) = made.shown(0.0)
    assert (shown.count, shown.most, shown.given_up) == (3, 3, True)
    assert (shown.reason, shown.following) == ("no beam", "a person looks at it")
    assert [(alarm.condition, alarm.subject) for alarm in told] == [
        ("calibration_given_up", "A"),
        ("calibration_given_up", "A"),
    ], "again after the one more turn"
    assert "A: 3 visits to targets failed to calibrate it; the last visit: no beam." in told[0].text
    assert list(made.given_up) == ["A"]
    made.done("A")
    assert not told[-1].active
    assert made.shown(0.0) == ()
    made.done("A")
    assert len(told) == 3, "it ends once"


def test_who_knows_more_begins_anew_and_the_alarm_stays_until_it_is_done() -> None:
    told: list[Alarm] = []
    made = Attempts(LAW, told.append)
    made.give_up("A", "joined", 0.0)
    made.failed("B", "no beam", 0.0)
    assert made.counts == {"A": 3, "B": 1}
    made.renew(("A", "never failed"))
    assert made.due("A", 0.0)
    assert [alarm.active for alarm in told] == [True]
    made.done("A")
    assert [alarm.active for alarm in told] == [True, False]


@pytest.mark.parametrize(("pause", "count"), [(99.0, 2), (101.0, 1)])
def test_a_failure_of_long_ago_does_not_count(pause: float, count: int) -> None:
    made = Attempts(RetryLaw("raising", 5, 0.0, "", memory=100.0))
    made.failed("A", "lost", 0.0)
    made.failed("A", "lost", pause)
    assert made.counts == {"A": count}


def test_work_without_a_rest_gets_no_turn_by_itself() -> None:
    made = Attempts(RetryLaw("joint visit", 1, 0.0, "it goes alone"))
    made.failed("A", "not found", 0.0)
    (shown,) = made.shown(1e9)
    assert shown.left == math.inf
    assert not made.due("A", 1e9)
