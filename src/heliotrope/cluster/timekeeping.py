"""The time of a cluster, with a bound on its error and with its source.

The sun moves 73 µrad per second, and a heliostat that tracks with a wrong time is off by just as
much. A cluster therefore always uses a `Time`, which is an interval (`Time.error`).

The computer's clock is disciplined by chrony (or another NTP program), from a satellite receiver
with a pulse output, from time servers, or from both. The kernel maintains a bound on the clock
error, which chrony renews, and which grows by 0.5 ms per second between renewals. `SystemTime` uses
that bound.

A `Time` is for information only. Leases, deadlines and expiries rest on `Clock.monotonic` alone, so
a jump, forward or back, extends nothing; `Steadiness` detects a jump by comparison with the
monotonic clock.
"""

import asyncio
import ctypes
import math
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal, Protocol

from heliotrope.errors import InputError, TimeError
from heliotrope.links.clock import GPS_EPOCH, Clock, gps_seconds, sleep_until
from heliotrope.links.gpsd import Gpsd

Quality = Literal["gps", "system", "holdover", "none"]

#: A time before this is not believed, since a computer without a clock battery starts in the past.
NOT_BEFORE = datetime(2026, 1, 1, tzinfo=UTC)
#: adjtimex(2) returns this for a clock that is not synchronised.
_TIME_ERROR = 5
#: Index of the clock's error bound in ``struct timex``, counted in longs; in µs.
_MAXERROR = 3
#: The rates of two oscillators are assumed to agree within this, twice the largest slew of NTP.
_SLEW = 1e-3
#: The kernel lets the error bound of a clock grow at this rate (MAXFREQ, 500 ppm), once a second.
_GROWTH = 500e-6
#: A bound that exceeds its growth by more than this was renewed, s: two ticks of a second.
_RENEWED = 1e-3
#: A bound not renewed for this long is holdover, s.
_FRESH = 300.0
#: Above this error bound the time is unusable, s.
LARGEST_ERROR = 1.0
#: Clock and receiver contradict each other above this difference, s; reports arrive up to 1 s late.
CONTRADICTION = 2.0


@dataclass(frozen=True)
class Time:
    """A time, its error bound and its source.

    Attributes
    ----------
    utc_s
        POSIX seconds.
    gps_s
        Seconds of the GPS time scale since 6 January 1980, which has no leap seconds.
    error
        Bound on the error of both times, s; infinite if unknown.
    quality
        "gps": a disciplined clock, confirmed by a receiver with a fix; "system": a disciplined
        clock; "holdover": a clock that has not been disciplined for some time, so that its bound
        grows; "none": unusable.
    jumped
        Whether the clock was set, forward or back, within the last seconds; intervals across the
        jump are then meaningless.
    note
        Description of the problem in one line, for the operator; empty if there is none.
    """

    utc_s: float
    gps_s: float
    error: float
    quality: Quality
    jumped: bool
    note: str = ""

    @property
    def usable(self) -> bool:
        """Whether the time may be sent, that is, whether it is known within 1 s."""
        return self.quality != "none" and self.error < LARGEST_ERROR


class TimeKeeper(Protocol):
    """A cluster's source of time.

    The owner runs ``run`` in a TaskGroup (or uses `link.running`); it returns when the keeper is
    closed. ``time`` may be called at any time, even before ``run`` and after ``close``.
    """

    def time(self) -> Time:
        """Return the current time."""
        ...

    async def run(self) -> None:
        """Run until closed."""
        ...

    async def close(self) -> None:
        """Make ``run`` return."""
        ...


class Steadiness:
    """Detects that a clock was set by comparing it with the monotonic clock.

    Parameters
    ----------
    clock
        Clock whose monotonic time is the reference.
    tolerance
        A step up to this size is not a jump, s. Slewing (up to 1 ms in a second) never counts as a
        jump.
    settle
        Time for which a jump is reported, s.

    Raises
    ------
    InputError
        If the tolerance or the duration is not above 0.
    """

    def __init__(self, clock: Clock, tolerance: float, settle: float) -> None:
        for name, value in (("tolerance", tolerance), ("duration of a jump", settle)):
            if not 0.0 < value < math.inf:
                raise InputError(f"time: a {name} must be above 0, not {value} s")
        self._clock = clock
        self._tolerance = tolerance
        self._settle = settle
        self._offset: float | None = None
        self._at = -math.inf
        self._jumped_at = -math.inf
        self.jumps = 0

    def see(self, seconds: float) -> bool:
        """Record the present time in s, and return whether it jumped within ``settle``."""
        now = self._clock.monotonic()
        offset = seconds - now
        if self._offset is None:
            self._offset = offset
        step = offset - self._offset
        if abs(step) > self._tolerance + _SLEW * (now - self._at):
            self._jumped_at = now
            self.jumps += 1
            self._offset = offset
        else:
            # The reference follows no faster than a clock is slewed, so that many small steps
            # add up to a jump.
            most = _SLEW * (now - self._at)
            self._offset += max(-most, min(most, step))
        self._at = now
        return now - self._jumped_at < self._settle


def kernel_bound() -> float:
    """Return the kernel's bound on its clock error, s; infinite if the clock is undisciplined.

    chronyd (with ``rtcsync``, as packaged) and ntpd report the bound (the root distance to their
    source) whenever they correct the clock. Between corrections the kernel adds 0.5 ms per second.
    systemd-timesyncd reports 0 instead of the root distance, so use chronyd.

    Raises
    ------
    InputError
        If the system does not provide the bound.
    """
    ask = getattr(ctypes.CDLL(None, use_errno=True), "adjtimex", None)
    timex = (ctypes.c_long * 128)()  # zeros change nothing; larger than any struct timex
    state = -1 if ask is None else int(ask(timex))
    if state < 0:
        raise InputError(
            "time: this system does not report whether its clock is synchronised; state its error "
            "with error_s"
        )
    return math.inf if state == _TIME_ERROR else 1e-6 * timex[_MAXERROR]


class _Bound:
    """The kernel's bound, which survives a restart of the program that renews it.

    chronyd declares the clock unsynchronised when it starts. The oscillator is not affected, so the
    previous bound stays valid and continues to grow, unless the clock is set in the meantime.
    """

    def __init__(self, ask: Callable[[], float]) -> None:
        self._ask = ask
        self._error, self._at = math.inf, 0.0
        self.kept = False
        self.renewed_at = -math.inf

    def at(self, now: float, *, jumped: bool) -> float:
        """Return the bound at a monotonic time, s."""
        grown = self._error + _GROWTH * (now - self._at)
        reported = self._ask()
        self.kept = reported < math.inf
        if not self.kept:
            if jumped:
                self._error = math.inf
            return math.inf if jumped else grown
        if reported < self._error or reported > grown + _RENEWED:
            self.renewed_at = now
        self._error, self._at = reported, now
        return reported


class SystemTime:
    """The time of this computer.

    Parameters
    ----------
    clock
        Clock whose ``utc`` is the time, and whose ``monotonic`` is the reference for jumps.
    error
        Bound on the clock error that the operator guarantees, s; used without ``bound``.
    settle
        Time for which a jump is reported, s.
    tolerance
        Largest step that does not count as a jump, s.
    bound
        Function that returns the bound on the clock error, s, infinite if the clock is
        undisciplined, such as `kernel_bound`. If None, ``error`` always applies.
    gpsd
        A receiver that must agree with the clock; it is run and closed with this object.

    Raises
    ------
    InputError
        If the error, tolerance or duration is not above 0.
    """

    def __init__(
        self,
        clock: Clock,
        error: float = 0.5,
        settle: float = 10.0,
        tolerance: float = 0.1,
        *,
        bound: Callable[[], float] | None = None,
        gpsd: Gpsd | None = None,
    ) -> None:
        if not 0.0 < error < math.inf:
            raise InputError(f"time: an error bound must be above 0, not {error} s")
        self._clock = clock
        self._error = error
        self._bound = None if bound is None else _Bound(bound)
        self._gpsd = gpsd
        self._steadiness = Steadiness(clock, tolerance, settle)
        self._closing = asyncio.Event()

    @property
    def jumps(self) -> int:
        """Number of times the clock was set since this object was created."""
        return self._steadiness.jumps

    def time(self) -> Time:
        """Return the current time."""
        utc = self._clock.utc()
        jumped = self._steadiness.see(utc.timestamp())
        error, quality, note = self._judged(utc, jumped=jumped)
        return Time(utc.timestamp(), _gps(utc), error, quality, jumped, note)

    def _judged(self, utc: datetime, *, jumped: bool) -> tuple[float, Quality, str]:
        """Return the error bound, the quality and the note."""
        now = self._clock.monotonic()
        error = self._error if self._bound is None else self._bound.at(now, jumped=jumped)
        if utc < NOT_BEFORE:
            return (
                math.inf,
                "none",
                f"the computer's clock shows {utc:%Y-%m-%d}, so it was never set",
            )
        if error == math.inf:
            return (
                math.inf,
                "none",
                "the computer's clock is not disciplined; check that chronyd is running",
            )
        if error > LARGEST_ERROR:
            return math.inf, "none", _old(error, f", more than {LARGEST_ERROR:g} s")
        ahead = None if self._gpsd is None else self._gpsd.ahead
        if ahead is not None and abs(ahead) > CONTRADICTION:
            note = (
                f"the computer's clock is {ahead:+.1f} s from the receiver, the limit is "
                f"{CONTRADICTION:g} s; one of the two is wrong; chronyc sources shows which source "
                f"chronyd uses"
            )
            return math.inf, "none", note
        if self._bound is not None and now - self._bound.renewed_at > _FRESH:
            return error, "holdover", _old(error, "")
        if self._bound is not None and not self._bound.kept:
            return (
                error,
                "holdover",
                "the computer's clock is not disciplined; check that chronyd is running",
            )
        problem = "" if self._gpsd is None else self._gpsd.problem
        return error, "system" if ahead is None else "gps", problem

    async def run(self) -> None:
        """Check the clock every second, so that a jump forward and back does not go unnoticed."""
        if self._gpsd is None:
            await self._look()
            return
        async with asyncio.TaskGroup() as group:
            group.create_task(self._gpsd.run())
            await self._look()
            await self._gpsd.close()

    async def _look(self) -> None:
        while not self._closing.is_set():
            self.time()
            due = self._clock.monotonic() + 1.0
            try:
                async with asyncio.timeout(1.0):
                    await self._closing.wait()
            except TimeoutError:
                await sleep_until(self._clock, due)

    async def close(self) -> None:
        """Make ``run`` return."""
        self._closing.set()


def _old(error: float, limit: str) -> str:
    return (
        f"the computer's clock may be off by {error:.2g} s{limit}: chronyd has lost its sources; "
        "chronyc sources shows why"
    )


def _gps(utc: datetime) -> float:
    try:
        return gps_seconds(utc)
    except TimeError:  # before the GPS scale began: the clock was never set
        return (utc - GPS_EPOCH).total_seconds()
