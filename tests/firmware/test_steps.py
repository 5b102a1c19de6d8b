"""Step pulses of the three boards: as many as ordered, no faster than allowed, exact at a stop."""

import itertools
import random
from collections.abc import Callable
from typing import Any

import pytest

from heliotrope.lcu.stepper import BOTH, Axis, Stepper
from support.board_chips import World, board_path

PINS = ("step1", "way1", "step2", "way2")
BOARDS = ("rp2", "esp32", "stm32")
RATE, ACCELERATION = 8000, 16_000


class Bench:
    """A board's step timer, a planner of steps, and a main loop that is not always in time."""

    def __init__(self, board: str, seed: int = 1, rate: int = RATE) -> None:
        self.world = World()
        with board_path(board, self.world) as load:
            self.timer: Any = load("steps").Timer(PINS)
        self.random = random.Random(seed)
        # Between two rounds of the loop; the esp32 needs it more often, see its steps.py.
        self.pauses = [1, 2, 4, 6] if board == "esp32" else [1, 2, 5, 10, 30]
        self.hurry = 7 / 8 if board == "esp32" else 1.0
        self.axes = [Axis(-(10**6), 10**6, rate, ACCELERATION, 0, 50) for _ in (0, 1)]
        self.planner = Stepper(self.axes, 50, 100)
        self.ordered: list[list[tuple[int, int, int]]] = [[], []]

    def turn(self) -> None:
        """Some milliseconds of the main loop."""
        ms = self.random.choice(self.pauses)
        self.world.advance(1000 * ms)
        self.timer.pump()
        segments: list[tuple[int, ...]] = []
        self.planner.advance(ms, segments, 0)
        for _, axis, direction, count, interval in segments:
            self.timer.play(axis, direction, count, interval)
            self.ordered[axis].append((direction, count, interval))

    def run(self, done: Callable[[], bool]) -> None:
        for _ in range(20_000):
            if done():
                return
            self.turn()
        raise AssertionError("it does not end")

    def made(self, axis: int) -> list[tuple[float, int]]:
        return self.world.pulses(PINS[2 * axis], PINS[2 * axis + 1])


@pytest.mark.parametrize("board", BOARDS)
def test_motions_of_two_axes_come_as_ordered(board: str) -> None:
    bench = Bench(board)
    for goal in ([5000, -3000], [4990, -2999], [4990, 2000], [-20, 0], [-19, 300]):
        bench.planner.go(goal[0], goal[1], BOTH)
        bench.run(bench.planner.still)
        bench.world.advance(400_000)  # what a board still has in hand
        bench.timer.pump()
        bench.world.advance(400_000)
        for axis in (0, 1):
            moved = sum(sign for _, sign in bench.made(axis))
            assert moved == goal[axis] == bench.axes[axis].count
    for axis in (0, 1):
        ordered = sum(count for _, count, _ in bench.ordered[axis])
        assert len(bench.made(axis)) == ordered


@pytest.mark.parametrize("board", BOARDS)
def test_no_pulse_comes_sooner_than_the_rate_allows(board: str) -> None:
    bench = Bench(board, seed=2)
    bench.planner.go(9000, -1200, BOTH)
    bench.run(bench.planner.still)
    bench.world.advance(400_000)
    for axis in (0, 1):
        times = [at for at, _ in bench.made(axis)]
        gaps = [b - a for a, b in itertools.pairwise(times)]
        # Whole units: a fifth of a microsecond in the state machine, one in the RMT.
        assert min(gaps) >= bench.hurry * 1e6 / RATE * (1 - 6e-3)


@pytest.mark.parametrize("board", ["rp2", "stm32"])
def test_pulses_of_a_motion_have_no_pauses(board: str) -> None:
    # The RMT of the esp32 has them: see docs/how-to/firmware.md.
    bench = Bench(board, seed=3)
    bench.planner.go(12_000, 0, BOTH)
    bench.run(bench.planner.still)
    bench.world.advance(400_000)
    times = [at for at, _ in bench.made(0)]
    planned = [interval for _, count, interval in bench.ordered[0] for _ in range(count)]
    for i in range(1, len(times)):
        allowed = max(planned[i - 1], planned[i])
        assert times[i] - times[i - 1] <= allowed + 15


@pytest.mark.parametrize("board", BOARDS)
@pytest.mark.parametrize("rate", [7000, 8000])
def test_the_hardware_never_falls_behind_the_plan(board: str, rate: int) -> None:
    bench = Bench(board, seed=4, rate=rate)
    bench.planner.go(60_000, 0, BOTH)
    bench.run(bench.planner.still)
    # When the planner says that all stands, no more than a slot is left.
    for _ in range(12):
        bench.world.advance(5_000)
        bench.timer.pump()
    assert len(bench.made(0)) == 60_000
    assert bench.timer.axes[0].stop() == 0


@pytest.mark.parametrize("board", BOARDS)
@pytest.mark.parametrize("seed", range(12))
def test_a_stop_at_any_instant_loses_no_step(board: str, seed: int) -> None:
    bench = Bench(board, seed)
    rand = random.Random(100 + seed)
    total = [0, 0]
    for _ in range(6):
        bench.planner.go(rand.randint(-4000, 4000), rand.randint(-400, 400), BOTH)
        for _ in range(rand.randint(1, 40)):
            bench.turn()
        bench.world.advance(rand.randint(0, 60_000) + rand.random())
        undone = bench.timer.stop()
        before = [len(bench.made(axis)) for axis in (0, 1)]
        bench.planner.undone(*undone)
        bench.world.advance(200_000)
        bench.timer.pump()
        for axis in (0, 1):
            pulses = bench.made(axis)
            assert sum(sign for _, sign in pulses) == bench.axes[axis].count
            total[axis] = len(pulses)
            if board == "rp2":
                assert len(pulses) == before[axis]  # at once
    assert max(total) > 100


def test_a_stop_between_any_two_cycles_of_the_state_machine_is_exact() -> None:
    world = World()
    with board_path("rp2", world) as load:
        steps = load("steps")
        axis = steps.Axis(0, "step", "way")
    for cycle in range(3 * 40 * 5 + 60):
        before = len(world.pulses("step", "way"))
        for _ in range(3):
            axis.play(1, 2, 20)
        world.advance(cycle / 5)
        undone = axis.stop()
        world.advance(500)
        made = len(world.pulses("step", "way")) - before
        assert made + undone == 6, cycle


@pytest.mark.parametrize(("count", "interval"), [(1, 50_000), (400, 125), (1000, 50), (3, 16_666)])
def test_words_of_the_state_machine_last_as_long_as_they_say(count: int, interval: int) -> None:
    world = World()
    with board_path("rp2", world) as load:
        axis = load("steps").Axis(0, "step", "way")
    for _ in range(2):
        axis.play(-1, count, interval)
    world.advance(2 * count * interval + 1)
    pulses = world.pulses("step", "way")
    assert len(pulses) == 2 * count
    assert {sign for _, sign in pulses} == {-1}
    took = pulses[count][0] - pulses[0][0]  # from a pulse to the same one of the next segment
    assert 0 <= count * interval - took <= 0.2 * count + 1e-6


@pytest.mark.parametrize("board", BOARDS)
def test_the_direction_is_there_before_the_pulse(board: str) -> None:
    bench = Bench(board)
    bench.timer.play(0, 1, 3, 1000)
    bench.timer.play(0, -1, 3, 1000)
    bench.timer.play(0, 1, 2, 1000)
    for _ in range(20):
        bench.world.advance(5000)
        bench.timer.pump()
    assert [sign for _, sign in bench.made(0)] == [1, 1, 1, -1, -1, -1, 1, 1]


@pytest.mark.parametrize("latency", [0.5, 12.0, 90.0])
def test_the_interrupt_of_a_burst_may_be_late(latency: float) -> None:
    bench = Bench("stm32")
    for axis in bench.timer.axes:
        axis.timer.latency = latency
    bench.planner.go(3000, -3000, BOTH)
    bench.run(bench.planner.still)
    bench.world.advance(200_000)
    for axis, sign in ((0, 1), (1, -1)):
        assert sum(s for _, s in bench.made(axis)) == 3000 * sign
