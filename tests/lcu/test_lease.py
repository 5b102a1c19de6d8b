"""The lease of a sun vector: which vectors follow from the last one."""

import math

import pytest

from heliotrope.lcu.lease import FASTEST, UNIT, Clock, SunLease

SPAN_MS = 6000
#: As far as the sun can have gone in a second, with a lease's time under way, rad.
REACH = FASTEST * (1000 + SPAN_MS)
#: Directions along which one component alone changes, to first order: which, and from where.
ALONE = {"east": (0.0, 0.0, 1.0), "north": (0.0, 0.0, 1.0), "up": (0.8, 0.6, 0.0)}


def turned(name: str, angle: float) -> tuple[float, float, float]:
    """The direction of `ALONE` after the sun has gone by an angle along one component."""
    east, north, up = ALONE[name]
    sine, cosine = math.sin(angle), math.cos(angle)
    way = {"east": (sine, 0.0, 0.0), "north": (0.0, sine, 0.0), "up": (0.0, 0.0, sine)}[name]
    return cosine * east + way[0], cosine * north + way[1], cosine * up + way[2]


@pytest.mark.parametrize("name", ALONE)
@pytest.mark.parametrize("way", [1, -1])
def test_a_leap_along_any_direction_is_refused_and_what_the_sun_can_do_is_taken(
    name: str, way: int
) -> None:
    lease, clock = SunLease(SPAN_MS), Clock()
    clock.set(0, 1000)

    def taken(second: int, angle: float) -> bool:
        now = 1000 * second
        clock.set(0, now)
        lease.look(now, 1000)
        values = tuple(round(UNIT * part) for part in turned(name, angle))
        return lease.take((second, *values, 0, 0, 0), clock, now)

    assert taken(1, 0.0)
    assert (lease.bad, lease.leaps) == (0, 0)
    assert not taken(2, way * 3.0 * REACH)
    assert (lease.bad, lease.leaps) == (1, 1)
    if name != "up" or way > 0:  # below the horizon there is no sun
        assert taken(3, way * 0.9 * REACH)
        assert (lease.bad, lease.leaps) == (1, 1)


@pytest.mark.parametrize(
    ("length", "taken"),
    [(0.0, False), (0.7, False), (0.999, False), (1.0, True), (1.001, False), (1.4, False)],
)
def test_a_vector_that_is_no_direction_is_refused(length: float, taken: bool) -> None:
    lease, clock = SunLease(SPAN_MS), Clock()
    clock.set(0, 1000)
    values = tuple(round(UNIT * length * part) for part in (0.0, 0.6, 0.8))
    assert lease.take((1, *values, 0, 0, 0), clock, 1000) is taken
    assert lease.bad == (not taken)


def test_a_clock_tells_how_far_its_time_jumps_and_of_no_jump_where_it_had_none() -> None:
    clock = Clock()
    assert clock.set(2000, 5500) == 0
    clock.elapse(700)
    assert clock.set(2000, 6200) == 0
    assert clock.set(2000, 9100) == 2900
    assert clock.set(2000, 8600) == -500
    assert clock.set(2001, 0) == 604_791_400
    clock.lose()
    assert clock.set(2000, 5500) == 0
