"""The time of a cluster: what the system says, and whether it was set."""

import asyncio
import contextlib
import ctypes
import math
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace

import pytest

from heliotrope.cluster.timekeeping import SystemTime, Time, kernel_bound
from heliotrope.errors import InputError
from heliotrope.links.clock import VirtualClock, gps_seconds, run_virtual
from heliotrope.links.link import running

START = datetime(2026, 6, 21, 10, tzinfo=UTC)


def test_the_system_tells_its_time_on_both_scales() -> None:
    clock = VirtualClock(start=START)
    keeper = SystemTime(clock, error=0.2)
    clock.advance(1.5)
    now = keeper.time()
    assert now.utc_s == pytest.approx(START.timestamp() + 1.5, abs=1e-6)
    assert now.gps_s == pytest.approx(gps_seconds(START) + 1.5, abs=1e-6)
    assert (now.error, now.quality, now.jumped) == (0.2, "system", False)


def test_a_time_is_sent_only_if_it_has_a_source_and_is_known_within_a_second() -> None:
    known = Time(START.timestamp(), gps_seconds(START), 0.99, "holdover", jumped=False)
    assert known.usable
    assert not replace(known, error=1.01).usable
    assert not replace(known, error=0.01, quality="none").usable


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


@pytest.mark.parametrize(("step", "jumped"), [(0.5, False), (-0.5, False), (0.75, True)])
def test_a_step_of_the_tolerance_is_no_jump(step: float, jumped: bool) -> None:
    clock = VirtualClock(start=START)
    keeper = SystemTime(clock, tolerance=0.5)
    keeper.time()
    clock.jump(step)
    assert keeper.time().jumped is jumped


@pytest.mark.parametrize(
    ("ahead", "quality"), [(None, "system"), (2.0, "gps"), (-2.0, "gps"), (2.01, "none")]
)
def test_a_clock_and_a_receiver_contradict_each_other_beyond_two_seconds(
    ahead: float | None, quality: str
) -> None:
    receiver = SimpleNamespace(ahead=ahead, problem="")
    keeper = SystemTime(VirtualClock(start=START), gpsd=receiver)  # type: ignore[arg-type]
    assert keeper.time().quality == quality


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
    assert now.note == f"the computer's clock shows {year}-01-01, so it was never set"


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


class Kernel:
    """A kernel: its bound grows by 0.5 ms in each whole second, unless somebody renews it."""

    def __init__(self, clock: VirtualClock, error: float) -> None:
        self._clock = clock
        self.renew(error)

    def renew(self, error: float) -> None:
        self._error, self._at = error, self._clock.monotonic()

    def __call__(self) -> float:
        return self._error + 500e-6 * math.floor(self._clock.monotonic() - self._at)


def kept() -> tuple[VirtualClock, Kernel, SystemTime]:
    clock = VirtualClock(start=START)
    kernel = Kernel(clock, 0.01)
    return clock, kernel, SystemTime(clock, bound=kernel)


def test_the_bound_is_the_kernels() -> None:
    clock, kernel, keeper = kept()
    assert (keeper.time().quality, keeper.time().error, keeper.time().note) == ("system", 0.01, "")
    for error in (0.02, 0.005, 0.3, 0.3):
        clock.advance(60.0)
        kernel.renew(error)
        assert (keeper.time().quality, keeper.time().error) == ("system", error)


def test_a_clock_that_nobody_keeps_any_more_holds_over_and_ends() -> None:
    clock, kernel, keeper = kept()
    for _ in range(300):
        assert keeper.time().quality == "system"
        clock.advance(1.0)
    clock.advance(1.0)
    now = keeper.time()
    assert (now.quality, now.jumped) == ("holdover", False)
    assert now.error == pytest.approx(0.01 + 500e-6 * 301)
    assert "may be off by 0.16 s: chronyd has lost its sources" in now.note
    clock.advance(1600.0)
    assert keeper.time().quality == "holdover"
    clock.advance(100.0)
    now = keeper.time()
    assert (now.quality, now.error) == ("none", math.inf)
    assert "may be off by 1 s, more than 1 s" in now.note
    kernel.renew(0.01)
    assert (keeper.time().quality, keeper.time().error) == ("system", 0.01)


def test_a_restart_of_chronyd_ends_nothing_but_a_clock_set_meanwhile_does() -> None:
    clock, kernel, keeper = kept()
    assert keeper.time().quality == "system"
    kernel.renew(math.inf)
    clock.advance(20.0)
    now = keeper.time()
    assert (now.quality, now.error) == ("holdover", pytest.approx(0.01 + 500e-6 * 20))
    assert "the computer's clock is not disciplined" in now.note
    clock.jump(5.0)
    now = keeper.time()
    assert (now.quality, now.error, now.jumped) == ("none", math.inf, True)
    clock.advance(60.0)  # the jump has settled; nobody knows the time all the same
    assert keeper.time().quality == "none"
    kernel.renew(0.02)
    assert (keeper.time().quality, keeper.time().error) == ("system", 0.02)


def test_a_clock_that_nobody_keeps_for_long_ends_too() -> None:
    clock, kernel, keeper = kept()
    keeper.time()
    kernel.renew(math.inf)
    clock.advance(1900.0)
    assert keeper.time().quality == "holdover"
    clock.advance(200.0)
    assert (keeper.time().quality, keeper.time().error) == ("none", math.inf)


def test_a_clock_that_nobody_ever_kept_is_no_source() -> None:
    now = SystemTime(VirtualClock(start=START), bound=lambda: math.inf).time()
    assert (now.quality, now.error) == ("none", math.inf)
    assert now.note == "the computer's clock is not disciplined; check that chronyd is running"


@pytest.mark.parametrize(
    ("state", "bound_us", "wanted"),
    [(0, 300_000, 0.3), (1, 10, 1e-5), (4, 16_000_000, 16.0), (5, 10, math.inf)],
)
def test_the_kernel_is_asked(
    monkeypatch: pytest.MonkeyPatch, state: int, bound_us: int, wanted: float
) -> None:
    class Library:
        """A C library whose kernel is in a state."""

        def adjtimex(self, timex: "ctypes.Array[ctypes.c_long]") -> int:
            assert not any(timex)  # it changes nothing
            # modes (padded), offset, freq, maxerror: struct timex of Linux
            timex[:5] = [0, 12, 34, bound_us, 56]
            return state

    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: Library())
    assert kernel_bound() == pytest.approx(wanted)


def test_a_kernel_that_does_not_say_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: object())
    with pytest.raises(InputError, match="does not report whether its clock is synchronised"):
        kernel_bound()


def test_the_kernel_of_this_machine_answers_or_says_that_it_does_not() -> None:
    with contextlib.suppress(InputError):  # in a container it may be forbidden
        assert kernel_bound() >= 0.0


@pytest.mark.parametrize("value", [0.0, -1.0, math.inf, math.nan])
def test_bounds_that_are_none_are_refused(value: float) -> None:
    clock = VirtualClock()
    with pytest.raises(InputError, match="error bound"):
        SystemTime(clock, error=value)
    with pytest.raises(InputError, match="tolerance"):
        SystemTime(clock, tolerance=value)
    with pytest.raises(InputError, match="duration of a jump"):
        SystemTime(clock, settle=value)
