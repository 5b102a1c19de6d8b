"""Steps: every one counted, no limit exceeded, and the way they are made."""

import itertools
import math
import random

import pytest

from heliotrope.lcu.stepper import BOTH, PRIMARY_FIRST, SECONDARY_FIRST, Axis, Stepper, root

SLOT, AHEAD, SEGMENT = 50, 100, 7


class Motors:
    """Hardware that plays segments, axis by axis, and checks rate and acceleration."""

    def __init__(self, stepper: Stepper, start: tuple[int, int] = (0, 0)) -> None:
        self.stepper, self.made = stepper, list(start)
        self.speeds = [0.0, 0.0]
        self.path: list[tuple[int, int]] = []

    def run(self, ticks: int = 1, elapsed_ms: int = SLOT) -> None:
        for _ in range(ticks):
            out: list[tuple[int, ...]] = []
            room = -(-(AHEAD - max(0, self.stepper.queued_ms - elapsed_ms)) // SLOT)
            self.stepper.advance(elapsed_ms, out, SEGMENT)
            per_axis = [0, 0]
            for kind, axis, direction, count, interval in out:
                assert kind == SEGMENT
                assert count > 0
                assert direction in (1, -1)
                limits = self.stepper.axes[axis]
                assert interval * limits.rate >= 1_000_000
                self.made[axis] += direction * count
                assert limits.low <= self.made[axis] <= limits.high
                per_axis[axis] += 1
                # A whole step may fall into this slot or the next.
                speed = direction * count
                allowed = limits.acceleration * (SLOT / 1000) ** 2
                if room == 1:
                    assert abs(speed - self.speeds[axis]) <= allowed + 2
                self.speeds[axis] = speed
            for axis in (0, 1):
                assert per_axis[axis] <= room
                if per_axis[axis] == 0:
                    self.speeds[axis] = 0.0
            self.path.append(tuple(self.made))
            assert self.made == [axis.count for axis in self.stepper.axes]

    def settle(self) -> None:
        for _ in range(100_000):
            self.run()
            if self.stepper.still():
                return
        raise AssertionError("never still")


def _stepper(backlash: int = 0, rate: int = 2000, acceleration: int = 4000) -> Stepper:
    axes = [Axis(-30_000, 40_000, rate, acceleration, backlash, SLOT) for _ in range(2)]
    return Stepper(axes, SLOT, AHEAD)


def test_roots_are_exact() -> None:
    for square in [*range(3000), 10**9 - 1, 10**12, 2**61 + 12345]:
        assert root(square) == math.isqrt(square)


@pytest.mark.parametrize("backlash", [0, 40])
@pytest.mark.parametrize(("rate", "acceleration"), [(2000, 4000), (37, 3), (20_000, 900), (60, 10)])
def test_a_goal_is_reached_exactly(rate: int, acceleration: int, backlash: int) -> None:
    stepper = _stepper(backlash, rate, acceleration)
    motors = Motors(stepper)
    for goal in ((500, -300), (499, -301), (502, 0), (0, 0)):
        assert stepper.go(*goal, BOTH)
        motors.settle()
        assert tuple(motors.made) == goal
        if backlash:
            # From below: the last motion of both axes went up.
            assert [axis.direction for axis in stepper.axes] == [1, 1]


def test_a_motion_takes_little_more_time_than_it_must() -> None:
    stepper = _stepper()
    motors = Motors(stepper)
    stepper.go(10_000, 0, BOTH)
    motors.settle()
    shortest = 10_000 / 2000 + 2000 / 4000
    assert shortest < len(motors.path) * SLOT / 1000 < 1.05 * shortest + 0.3


@pytest.mark.parametrize("seed", range(40))
def test_steps_are_counted_whatever_happens(seed: int) -> None:
    """Goals replaced, stopped and halted midway, late ticks: counted equals made, in range."""
    rng = random.Random(seed)
    rate, acceleration = rng.choice([(2000, 4000), (37, 3), (9000, 700), (500, 100_000)])
    stepper = _stepper(rng.choice([0, 0, 17, 300]), rate, acceleration)
    motors = Motors(stepper)
    for _ in range(60):
        chosen = rng.random()
        goal = [
            rng.choice([rng.randint(-40_000, 50_000), count + rng.randint(-50, 50)])
            for count in motors.made
        ]
        if chosen < 0.5:
            inside = all(-30_000 <= value <= 40_000 for value in goal)
            assert stepper.go(*goal, rng.choice([BOTH, PRIMARY_FIRST, SECONDARY_FIRST])) == inside
        elif chosen < 0.7:
            stepper.rough = rng.choice([0, 20])
            stepper.follow(*goal)
        elif chosen < 0.85:
            stepper.stop()
        elif chosen < 0.92:
            left = [rng.randint(0, 3) * (a.direction if a.speed else 0) for a in stepper.axes]
            stepper.undone(*left)
            motors.made = [made - rest for made, rest in zip(motors.made, left, strict=True)]
            motors.speeds = [0.0, 0.0]
        motors.run(rng.randint(1, 30))
        if chosen > 0.96:
            motors.speeds = [0.0, 0.0]
            motors.run(1, rng.choice([60, 1000, 3000]))
    stepper.go(123, -45, BOTH)
    motors.settle()
    assert motors.made == [123, -45]


def test_stopping_keeps_to_the_acceleration() -> None:
    stepper = _stepper()
    motors = Motors(stepper)
    stepper.go(30_000, -20_000, BOTH)
    motors.run(60)
    before = list(motors.made)
    stepper.stop()
    motors.settle()
    # v²/2a at 2000 steps/s, and what a slot rounds.
    for made, start in zip(motors.made, before, strict=True):
        assert 300 <= abs(made - start) <= 500 + 2000 * SLOT // 1000
    assert motors.made[0] < 30_000


def test_an_axis_that_was_stopped_has_its_place_for_its_goal() -> None:
    stepper = Stepper([Axis(-20_000, 400_000, 8000, 16_000, 40, SLOT) for _ in (0, 1)], SLOT, AHEAD)
    motors = Motors(stepper)
    stepper.go(50_000, 0, BOTH)
    motors.run(30)
    stepper.stop()
    motors.run(60)
    assert stepper.still()
    assert 0 < motors.made[0] < 50_000
    # A motion by so many steps begins there, and not at the goal that was given up.
    assert [axis.goal for axis in stepper.axes] == motors.made


def test_the_second_axis_waits_for_the_first() -> None:
    for order, first in ((PRIMARY_FIRST, 0), (SECONDARY_FIRST, 1)):
        stepper = _stepper(backlash=20)
        motors = Motors(stepper)
        stepper.go(3000, 5000, order)
        motors.settle()
        assert motors.made == [3000, 5000]
        for place in motors.path:
            if place[1 - first] != 0:
                assert place[first] == (3000, 5000)[first]


def test_an_axis_that_must_wait_stops_first() -> None:
    stepper = _stepper()
    motors = Motors(stepper)
    stepper.go(20_000, 20_000, BOTH)
    motors.run(60)
    stepper.go(-20_000, 10_000, PRIMARY_FIRST)
    motors.run(20)
    waiting = motors.made[1]
    while stepper.axes[0].count != -20_000:
        motors.run()
        assert motors.made[1] == waiting
    motors.settle()
    assert motors.made == [-20_000, 10_000]


def test_slow_goals_are_followed_within_the_lead() -> None:
    """Down, up and down again, a step or so a second, with a backlash of 80 steps."""
    stepper = _stepper(backlash=80)
    motors = Motors(stepper)
    stepper.go(1000, 0, BOTH)
    motors.settle()
    for second in range(400):
        goal = 1000 + round(150 * math.cos(second / 60))
        assert stepper.follow(goal, 0)
        motors.run(20)
        assert abs(motors.made[0] - goal) <= 10 or not stepper.axes[0].still()
    ways = [b[0] - a[0] for a, b in itertools.pairwise(motors.path) if a[0] != b[0]]
    passes = sum(a < 0 < b for a, b in itertools.pairwise(ways))
    # It goes down by some 450 steps, but does not pass the goal by the backlash for each.
    assert 10 < passes < 60


def test_rough_stepping_moves_seldom() -> None:
    moves = {}
    for rough in (0, 25):
        stepper = _stepper()
        stepper.rough = rough
        motors = Motors(stepper)
        for second in range(300):
            stepper.follow(second, -second)
            motors.run(20)
            assert abs(motors.made[0] - second) <= max(1, rough)
        moves[rough] = len({place[0] for place in motors.path})
    assert moves[25] < moves[0] / 3


def test_rough_stepping_ends_on_the_nearest_full_step() -> None:
    for backlash in (0, 40):
        stepper = _stepper(backlash=backlash)
        stepper.rough, stepper.full = 16, (8, 4)
        motors = Motors(stepper)
        for second in range(200):
            stepper.follow(second, -second)
            motors.run(20)
            if stepper.still():
                assert [made % full for made, full in zip(motors.made, (8, 4), strict=True)] == [
                    0,
                    0,
                ]
                assert abs(motors.made[0] - second) <= 4
                # On its way down it is ahead by an eighth of the backlash, in full steps.
                assert abs(motors.made[1] + second) <= 2 + (8 if backlash else 0)
        assert abs(motors.made[0]) > 180


@pytest.mark.parametrize("beside", [1, -1])
def test_rough_stepping_leaves_no_axis_one_microstep_beside_a_full_step(beside: int) -> None:
    stepper = _stepper()
    motors = Motors(stepper)
    stepper.go(80 + beside, -40 + beside, BOTH)
    motors.settle()
    stepper.rough, stepper.full = 16, (8, 4)
    stepper.follow(80 + beside, -40 + beside)
    motors.settle()
    assert motors.made == [80, -40]


def test_a_dry_queue_starts_from_rest() -> None:
    stepper = _stepper()
    motors = Motors(stepper)
    stepper.go(30_000, 0, BOTH)
    motors.run(60)
    assert stepper.axes[0].speed > 50 * stepper.axes[0].change // 10
    out: list[tuple[int, ...]] = []
    stepper.advance(10 * AHEAD, out, SEGMENT)
    assert out[0][3] <= 4000 * (SLOT / 1000) ** 2


@pytest.mark.parametrize(
    ("numbers", "text"),
    [
        ((5, 5, 1, 1, 0), "range is empty"),
        ((0, 9, 1, 1, 9), "backlash"),
        ((0, 9, 0, 1, 0), "rate"),
        ((0, 9, 1, 0, 0), "acceleration"),
    ],
)
def test_axes_that_cannot_move_are_refused(numbers: tuple[int, ...], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        Axis(*numbers, SLOT)
