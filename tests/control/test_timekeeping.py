"""The time of a cluster: what the system says, and whether it was set."""

import asyncio
import math
from datetime import UTC, datetime, timedelta

import pytest

from heliotrope.control.clock import VirtualClock, gps_seconds, run_virtual
from heliotrope.control.link import running
from heliotrope.control.timekeeping import SystemTime
from heliotrope.errors import InputError

START = datetime(2026, 6, 21, 10, tzinfo=UTC)


def test_the_system_tells_its_time_on_both_scales() -> None:
    clock = VirtualClock(start=START)
    keeper = SystemTime(clock, error=0.2)
    clock.advance(1.5)
    now = keeper.time()
    assert now.utc_s == pytest.approx(START.timestamp() + 1.5, abs=1e-6)
    assert now.gps_s == pytest.approx(gps_seconds(START) + 1.5, abs=1e-6)
    assert (now.error, now.quality, now.jumped) == (0.2, "system", False)


@pytest.mark.parametrize("jump", [-3600.0, -0.2, 0.2, 86400.0])
def test_a_jump_is_told_until_it_has_settled(jump: float) -> None:
    clock = VirtualClock(start=START)
    keeper = SystemTime(clock, settle=10.0)
    assert not keeper.time().jumped
    clock.advance(1.0)
    clock.jump(jump)
    assert keeper.time().jumped
    clock.advance(9.0)
    assert keeper.time().jumped
    clock.advance(1.5)
    assert not keeper.time().jumped
    assert keeper.jumps == 1


def test_slewing_and_a_clock_that_runs_fast_are_no_jumps_but_many_small_steps_are() -> None:
    clock = VirtualClock(start=START)
    keeper = SystemTime(clock)
    for _ in range(1000):
        clock.advance(1.0)
        clock.jump(0.0005)
        assert not keeper.time().jumped
    for _ in range(10):
        clock.advance(0.01)
        clock.jump(0.05)
        keeper.time()
    assert keeper.jumps >= 1


@pytest.mark.parametrize("year", [1970, 1981, 2025])
def test_a_clock_that_was_never_set_is_no_source(year: int) -> None:
    now = SystemTime(VirtualClock(start=datetime(year, 1, 1, 2, tzinfo=UTC))).time()
    assert (now.quality, now.error) == ("none", math.inf)


def test_a_jump_there_and_back_between_two_questions_is_seen_by_run() -> None:
    async def main(clock: VirtualClock) -> int:
        keeper = SystemTime(clock)
        async with running(keeper):
            await asyncio.sleep(3.0)
            clock.jump(60.0)
            await asyncio.sleep(3.0)
            clock.jump(-60.0)
            await asyncio.sleep(3.0)
            assert keeper.time().jumped
        assert clock.utc() - START < timedelta(seconds=10.0)
        return keeper.jumps

    assert run_virtual(main) == 2


@pytest.mark.parametrize("value", [0.0, -1.0, math.inf, math.nan])
def test_bounds_that_are_none_are_refused(value: float) -> None:
    clock = VirtualClock()
    with pytest.raises(InputError, match="error bound"):
        SystemTime(clock, error=value)
    with pytest.raises(InputError, match="tolerance"):
        SystemTime(clock, tolerance=value)
    with pytest.raises(InputError, match="duration of a jump"):
        SystemTime(clock, settle=value)
