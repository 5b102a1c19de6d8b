"""Clocks (real, manual and virtual), and the GPS scale of seconds, which has no leap seconds.

All code that judges time receives a `Clock`. Decisions (leases, deadlines, expiries) rest on
`monotonic`; `utc` is for information only. An asyncio wait may end early or late, so code that has
waited reads the clock again (`sleep_until`).

The time of a `VirtualLoop` advances only when nothing is left to do at the current time. The loop
runs ready callbacks in a random order drawn from its seed, because no code may depend on the order
that asyncio happens to keep; the same seed yields the same run.
"""

import asyncio
import itertools
import random
import selectors
import time
from collections import deque
from collections.abc import Callable, Coroutine
from contextvars import Context, ContextVar, copy_context
from datetime import UTC, datetime, timedelta
from typing import Any, Protocol, TypeVar

from heliotrope.errors import InputError, TimeError

T = TypeVar("T")

GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
WEEK = 604800

#: GPS minus UTC in s, from each date on. IERS Bulletin C announces changes half a year in advance.
LEAP_SECONDS = (
    (datetime(1980, 1, 6, tzinfo=UTC), 0), (datetime(1981, 7, 1, tzinfo=UTC), 1),
    (datetime(1982, 7, 1, tzinfo=UTC), 2), (datetime(1983, 7, 1, tzinfo=UTC), 3),
    (datetime(1985, 7, 1, tzinfo=UTC), 4), (datetime(1988, 1, 1, tzinfo=UTC), 5),
    (datetime(1990, 1, 1, tzinfo=UTC), 6), (datetime(1991, 1, 1, tzinfo=UTC), 7),
    (datetime(1992, 7, 1, tzinfo=UTC), 8), (datetime(1993, 7, 1, tzinfo=UTC), 9),
    (datetime(1994, 7, 1, tzinfo=UTC), 10), (datetime(1996, 1, 1, tzinfo=UTC), 11),
    (datetime(1997, 7, 1, tzinfo=UTC), 12), (datetime(1999, 1, 1, tzinfo=UTC), 13),
    (datetime(2006, 1, 1, tzinfo=UTC), 14), (datetime(2009, 1, 1, tzinfo=UTC), 15),
    (datetime(2012, 7, 1, tzinfo=UTC), 16), (datetime(2015, 7, 1, tzinfo=UTC), 17),
    (datetime(2017, 1, 1, tzinfo=UTC), 18),
)  # fmt: skip
#: The table is known to be complete up to this date (IERS leap-seconds.list); after it, a leap
#: second may be missing.
LEAP_SECONDS_VALID_UNTIL = datetime(2027, 6, 28, tzinfo=UTC)


class Clock(Protocol):
    """A source of monotonic time and UTC."""

    def monotonic(self) -> float:
        """Return seconds since an arbitrary instant; they never run backwards and never jump."""
        ...

    def utc(self) -> datetime:
        """Return the system's UTC, which may be wrong and may jump."""
        ...


class SystemClock:
    """The clocks of this computer.

    Notes
    -----
    On Linux the monotonic time is CLOCK_BOOTTIME, which continues while the computer sleeps.
    CLOCK_MONOTONIC does not, and would extend a lease by the duration of the sleep.
    """

    def __init__(self) -> None:
        self._clock = getattr(time, "CLOCK_BOOTTIME", None)

    def monotonic(self) -> float:
        """Return the seconds since the computer booted."""
        return time.monotonic() if self._clock is None else time.clock_gettime(self._clock)

    def utc(self) -> datetime:
        """Return the system's time."""
        return datetime.now(UTC)


class VirtualClock:
    """A clock driven from outside, for simulation and tests.

    Parameters
    ----------
    source
        Function that returns monotonic seconds, such as `time` of a `VirtualLoop`; if None, time
        only passes when `advance` is called.
    start
        UTC when the clock is created.
    rate
        Seconds of this clock per second of the source; a value other than 1 simulates an inaccurate
        oscillator.
    """

    def __init__(
        self,
        source: Callable[[], float] | None = None,
        start: datetime = datetime(2026, 6, 21, 10, tzinfo=UTC),
        *,
        rate: float = 1.0,
    ) -> None:
        self._by_hand = 0.0
        self._source = source if source is not None else self._hand
        self._begin = self._source()
        self._start = start
        self._rate = rate
        self._jumped = 0.0

    def _hand(self) -> float:
        return self._by_hand

    def monotonic(self) -> float:
        """Return the source's seconds, at this clock's rate."""
        return self._begin + self._rate * (self._source() - self._begin)

    def utc(self) -> datetime:
        """Return UTC: the start, plus the time passed, plus all jumps."""
        return self._start + timedelta(seconds=self.monotonic() - self._begin + self._jumped)

    def advance(self, seconds: float) -> None:
        """Advance the time; only for a clock without a source.

        Raises
        ------
        InputError
            If the time is negative.
        """
        if not seconds >= 0.0:
            raise InputError(f"advance of {seconds} s: time only goes forward; use jump")
        self._by_hand += seconds

    def jump(self, seconds: float) -> None:
        """Step UTC forward or back without letting time pass, as an operator may."""
        self._jumped += seconds


async def sleep_until(clock: Clock, instant: float) -> None:
    """Wait until `clock` reaches `instant`, in s of its monotonic time."""
    while (remaining := instant - clock.monotonic()) > 0.0:
        # A remainder left by rounding would not advance a virtual clock.
        await asyncio.sleep(max(remaining, 1e-6))


# -- the GPS scale ---------------------------------------------------------------------


def leap_seconds(utc: datetime) -> int:
    """Return GPS minus UTC at a given time, in s.

    Raises
    ------
    TimeError
        If the time has no time zone, or is before the start of the GPS time scale.
    """
    if utc.tzinfo is None:
        raise TimeError(f"{utc} has no time zone; pass UTC")
    for since, count in reversed(LEAP_SECONDS):
        if utc >= since:
            return count
    raise TimeError(f"{utc} lies before the beginning of GPS time, 6 January 1980")


def gps_seconds(utc: datetime) -> float:
    """Return seconds of the GPS time scale since 6 January 1980.

    Parameters
    ----------
    utc
        Time after 1980, with a time zone. The result is exact while the leap-second table is valid
        (`LEAP_SECONDS_VALID_UNTIL`); later it may be low by a second or more.
    """
    count = leap_seconds(utc)
    return (utc - GPS_EPOCH).total_seconds() + count


def utc_of_gps(seconds: float) -> datetime:
    """Return UTC for GPS seconds: the inverse of `gps_seconds`.

    A leap second itself (23:59:60), which a datetime cannot represent, is returned as the last
    microsecond before it.
    """
    for since, count in reversed(LEAP_SECONDS):
        begin = (since - GPS_EPOCH).total_seconds() + count
        if seconds >= begin:
            return GPS_EPOCH + timedelta(seconds=seconds - count)
        if seconds >= begin - 1.0 and count > 0:
            return since - timedelta(microseconds=1)
    raise TimeError(f"{seconds} s lies before the beginning of GPS time, 6 January 1980")


def gps_week(utc: datetime) -> tuple[int, int]:
    """Return the full GPS week and the time of the week, ms."""
    milliseconds = round(gps_seconds(utc) * 1000.0)
    return milliseconds // (WEEK * 1000), milliseconds % (WEEK * 1000)


def utc_of_week(week: int, time_of_week_ms: int, not_before: datetime) -> datetime:
    """Return UTC for a GPS week whose upper bits may be missing.

    Parameters
    ----------
    week
        Week as transmitted: full, or modulo 1024 (the signal's 10 bits, which roll over every 19.6
        years).
    time_of_week_ms
        0 to 604,799,999.
    not_before
        A time known to be in the past; the result is the first matching week that is not older.

    Raises
    ------
    InputError
        If the week is negative, or the time is outside the week.
    """
    if week < 0 or not 0 <= time_of_week_ms < WEEK * 1000:
        raise InputError(
            f"GPS week {week}, {time_of_week_ms} ms: the week must not be negative, and the "
            f"time of week must be 0 to {WEEK * 1000 - 1} ms"
        )
    seconds = week * WEEK + time_of_week_ms / 1000.0
    floor = gps_seconds(not_before)
    if seconds < floor:
        seconds += -(-(floor - seconds) // (1024 * WEEK)) * 1024 * WEEK
    return utc_of_gps(seconds)


# -- virtual time ----------------------------------------------------------------------


#: The simulated program to which a task belongs, empty if it belongs to none; see
#: `VirtualLoop.freeze`.
PROGRAM: ContextVar[str] = ContextVar("PROGRAM", default="")


def context_of(program: str) -> Context:
    """Return a context for the tasks of a simulated program; tasks that they create inherit it."""
    context = copy_context()
    context.run(PROGRAM.set, program)
    return context


class _Drawn(deque[asyncio.Handle]):
    """Ready callbacks, which are taken in random order; callbacks of frozen programs wait."""

    def __init__(self, chance: random.Random, nothing: asyncio.Handle) -> None:
        super().__init__()
        self._chance, self._nothing = chance, nothing
        self.held: dict[str, list[asyncio.Handle]] = {}

    def popleft(self) -> asyncio.Handle:
        if len(self) > 1:
            self.rotate(-self._chance.randrange(len(self)))
        handle = super().popleft()
        if self.held:
            context: Context = handle._context  # type: ignore[attr-defined] # noqa: SLF001
            held = self.held.get(context.get(PROGRAM, ""))
            if held is not None:
                held.append(handle)
                return self._nothing
        return handle


class _NumberedTask(asyncio.Task[Any]):
    """A task whose hash is its number.

    A `TaskGroup` cancels a set of tasks in the order of their hashes, which would otherwise be
    addresses.
    """

    def __init__(self, coro: Coroutine[Any, Any, Any], number: int, **options: Any) -> None:
        self._number = number
        super().__init__(coro, **options)

    def __hash__(self) -> int:
        return self._number


class _NoWait(selectors.SelectSelector):
    """A selector that never waits: it advances the loop's time instead."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0

    def register(self, fileobj: Any, events: int, data: Any = None) -> selectors.SelectorKey:
        if self.get_map():  # the first is the loop's own pipe for signals and threads
            raise RuntimeError(
                "virtual time has no sockets, files or processes: use memory links, or the real "
                "loop"
            )
        return super().register(fileobj, events, data)

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        events = super().select(0.0)
        if not events and timeout is None:
            raise RuntimeError(
                "virtual time stands still: every task waits, and no timer is left to wake one"
            )
        if not events and timeout is not None:
            self.now += max(0.0, timeout)
        return events


class VirtualLoop(asyncio.SelectorEventLoop):
    """An event loop in virtual time; see the docstring of this module.

    Parameters
    ----------
    seed
        Seed for the order of ready callbacks; None for first in, first out, as in asyncio.
    start
        First value of `time`, in s.

    Raises
    ------
    RuntimeError
        If a socket or a thread is used, or if every task waits and no timer is running.
    """

    def __init__(self, seed: int | None = None, start: float = 1000.0) -> None:
        self._no_wait = _NoWait()
        self._no_wait.now = start
        super().__init__(self._no_wait)
        if seed is not None:
            # asyncio offers no public way to order callbacks; a test checks that this one works.
            nothing = asyncio.Handle(lambda: None, (), self)
            nothing.cancel()
            self._ready: _Drawn = _Drawn(random.Random(seed), nothing)
        numbers = itertools.count()
        self.set_task_factory(
            lambda loop, coro, **options: _NumberedTask(coro, next(numbers), loop=loop, **options)
        )

    def time(self) -> float:
        """Return the virtual time in s."""
        return self._no_wait.now

    def freeze(self, program: str) -> None:
        """Stop a program until `thaw`, like a stopped process or a suspended computer.

        None of the program's code runs, while time continues. The program's tasks are the tasks
        created in `context_of`; the loop needs a seed.
        """
        self._ready.held.setdefault(program, [])

    def thaw(self, program: str) -> None:
        """Let a frozen program continue: everything overdue then runs at once, in any order."""
        self._ready.extend(self._ready.held.pop(program, ()))

    def kill(self, program: str) -> None:
        """End a frozen program at the point where it stopped.

        The owner must have cancelled the program's tasks. Pending work is not done: no task takes
        another step, and no timer wakes a task.
        """
        for handle in self._ready.held.get(program, ()):
            # The program's task groups and tasks must still be notified of their end.
            owner = getattr(handle._callback, "__self__", None)  # type: ignore[attr-defined] # noqa: SLF001
            if isinstance(owner, asyncio.Task):
                owner.cancel()
            elif not isinstance(owner, asyncio.TaskGroup):
                handle.cancel()
        self.thaw(program)

    def run_in_executor(  # type: ignore[override]
        self, executor: Any, func: Callable[..., Any], *args: Any
    ) -> asyncio.Future[Any]:
        """Refuse, because a thread would run in real time."""
        raise RuntimeError(
            f"virtual time has no threads: {func!r} with {len(args)} arguments cannot be run in "
            f"one (executor {executor!r})"
        )


def run_virtual(
    main: Callable[[VirtualClock], Coroutine[Any, Any, T]],
    seed: int | None = 0,
    *,
    start: datetime = datetime(2026, 6, 21, 10, tzinfo=UTC),
) -> T:
    """Run a coroutine to its end in virtual time, and return its result.

    Parameters
    ----------
    main
        Called with the loop's clock.
    seed
        As in `VirtualLoop`.
    start
        UTC at the start.
    """
    with asyncio.Runner(loop_factory=lambda: VirtualLoop(seed)) as runner:
        clock = VirtualClock(runner.get_loop().time, start)
        return runner.run(main(clock))
