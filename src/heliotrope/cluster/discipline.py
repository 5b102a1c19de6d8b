"""A clock disciplined by a satellite receiver: its oscillator carries the time between the fixes.

What is kept is an interval: the least and the most that GPS time minus the monotonic clock can
be. A sentence that names the second T and came at the instant t says that this difference is at
least T - t, since it may have come late, but not early. The quickest of several sentences is less
than ``latency`` late, which gives the most. So a quicker sentence narrows the interval, a slower
one only confirms it, and every second widens it by what the oscillator may drift. Half of its
width is the error bound of the time; without fixes it grows (holdover), and from
``largest_error`` on there is no time any more.

A sentence outside the interval is not believed: not when a busy computer read it late, not when
its checksum fitted by chance, not when the receiver stands still, goes back or runs away. Only
when others in a row confirm it does the question arise who is right, and the computer's own clock
gives the second opinion (``system_tolerance``): a receiver that leaves the time kept so far is
followed only to where the computer's clock is, and the step is told as a jump.

Everything is reckoned in the GPS scale, so a leap second of the table (`clock.LEAP_SECONDS`) is
no step; one that the table lacks is a jump of one second.
"""

import math
from dataclasses import dataclass
from datetime import datetime

from heliotrope.cluster.nmea import NmeaReader, Report
from heliotrope.cluster.timekeeping import Quality, Steadiness, Time
from heliotrope.errors import InputError, TimeError
from heliotrope.links.clock import GPS_EPOCH, Clock, gps_seconds, utc_of_gps

#: A sentence may begin this much before the time it names, in s: receivers round.
_EARLY = 0.01
#: As many bytes as some seconds of sentences.
_ENOUGH = 500
#: Fixes in a row that make a claim.
_FIXES = 3


@dataclass(frozen=True)
class DisciplineSettings:
    """How far a receiver, an oscillator and the computer's clock are believed.

    Parameters
    ----------
    latency
        From the second that a sentence names to the arrival of its first byte, for the quickest
        of several, in s. Half of it is the error bound with a fix.
    drift_ppm
        Of the monotonic clock against true time, at most, in 1e-6. A plain crystal stays within
        50; where NTP slews the clock, it may bend its rate by up to 500.
    fresh
        After this long without a fix it is holdover, in s.
    largest_error
        Above this error bound there is no time, in s.
    confirm
        How long a receiver must agree with itself, without a pause longer than ``fresh``, before
        it is believed, in s.
    insist
        The same where it contradicts the time kept so far and nobody else takes its side, in s.
    system_tolerance
        The computer's clock has to be within this of the receiver, in s, when the receiver is
        first believed and when it jumps. None: that clock counts for nothing (no NTP, no battery).
    settle
        How long a jump is told, in s.

    Raises
    ------
    InputError
        A value outside its range.
    """

    latency: float = 0.5
    drift_ppm: float = 100.0
    fresh: float = 5.0
    largest_error: float = 1.0
    confirm: float = 3.0
    insist: float = 60.0
    system_tolerance: float | None = 2.0
    settle: float = 10.0

    def __post_init__(self) -> None:
        for name in ("latency", "drift_ppm", "fresh", "confirm", "insist", "settle"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise InputError(f"GPS time: {name} is {value}; it must be above 0")
        if not 0.5 * self.latency + _EARLY < self.largest_error < math.inf:
            raise InputError(
                f"GPS time: largest_error is {self.largest_error} s; with a latency of "
                f"{self.latency} s it must be above {0.5 * self.latency + _EARLY:g} s"
            )
        if self.system_tolerance is not None and not 0.0 < self.system_tolerance < math.inf:
            raise InputError(
                f"GPS time: system_tolerance is {self.system_tolerance} s; it must be above 0, or "
                "none, if the computer's clock counts for nothing"
            )


@dataclass(slots=True)
class DisciplineStatistics:
    """Counts of a disciplined clock.

    Attributes
    ----------
    fixes, no_fix
        Times with a fix; reports without one.
    accepted, refused
        Fixes that fit the time kept; that did not, or were not believed yet.
    rolled
        Dates carried over a rollover of the week.
    jumps
        How often the receiver was followed to another time.
    """

    fixes: int = 0
    no_fix: int = 0
    accepted: int = 0
    refused: int = 0
    rolled: int = 0
    jumps: int = 0


@dataclass(frozen=True, slots=True)
class Bounds:
    """GPS time minus monotonic time, in s: at least ``low``, at most ``high``, at ``at``."""

    low: float
    high: float
    at: float

    @property
    def middle(self) -> float:
        """The best guess, in s."""
        return 0.5 * (self.low + self.high)

    @property
    def error(self) -> float:
        """Half of the width, in s."""
        return 0.5 * (self.high - self.low)

    def later(self, now: float, drift: float) -> "Bounds":
        """Return them as they are at ``now``, of an oscillator that drifts up to ``drift``."""
        wider = drift * max(0.0, now - self.at)
        return Bounds(self.low - wider, self.high + wider, max(now, self.at))

    def meet(self, other: "Bounds") -> bool:
        """Return whether something is within both."""
        return self.low <= other.high and other.low <= self.high

    def confirmed(self, by: "Bounds") -> "Bounds":
        """Return them after a sentence that meets them; a slower one says nothing of the most."""
        if by.low < self.low:
            return self
        return Bounds(by.low, min(self.high, by.high), self.at)


@dataclass(slots=True)
class _Claim:
    """What a receiver says again and again, and is not believed yet."""

    bounds: Bounds
    since: float
    count: int = 1


class DisciplinedClock:
    """Time from the sentences of a receiver, without any port.

    Parameters
    ----------
    clock
        Its monotonic time is the oscillator; its UTC is the second opinion.
    settings
        See `DisciplineSettings`.

    Attributes
    ----------
    reader
        See `NmeaReader`: what came and could not be used.
    statistics
        See `DisciplineStatistics`.
    """

    def __init__(self, clock: Clock, settings: DisciplineSettings | None = None) -> None:
        self._clock = clock
        self._settings = settings or DisciplineSettings()
        self._drift = self._settings.drift_ppm * 1e-6
        self._kept: Bounds | None = None
        self._fixed_at = -math.inf
        self._claim: _Claim | None = None
        self._jumped_at = -math.inf
        self._last: datetime | None = None
        self._last_at = -math.inf
        self._no_fix_at = -math.inf
        self._doubt = ""
        self._system = Steadiness(clock, 0.1, self._settings.settle)
        self.reader = NmeaReader()
        self.statistics = DisciplineStatistics()

    # -- what the receiver says --------------------------------------------------------

    def hear(self, data: bytes) -> None:
        """Take bytes of the receiver that have just come."""
        for report, at in self.reader.feed(data, self._clock.monotonic()):
            self._take(report, at)

    def _take(self, report: Report, at: float) -> None:
        if not report.fix:
            self.statistics.no_fix += 1
            self._no_fix_at = at
            return
        if report.utc is None or report.utc == self._last:
            return  # a GGA; another sentence of the same second, or a receiver that stands
        self._last, self._last_at = report.utc, at
        self.statistics.fixes += 1
        self.statistics.rolled += report.rolled
        offset = gps_seconds(report.utc) - at
        new = Bounds(offset - _EARLY, offset + self._settings.latency, at)
        kept = None if self._kept is None else self._kept.later(at, self._drift)
        alive = kept is not None and kept.error <= self._settings.largest_error
        if kept is not None and alive and kept.meet(new):
            self._believe(kept.confirmed(new))
        else:
            self.statistics.refused += 1
            self._consider(new, kept)

    def _believe(self, bounds: Bounds) -> None:
        self._kept = bounds
        self._fixed_at = bounds.at
        self._claim = None
        self._doubt = ""
        self.statistics.accepted += 1

    def _consider(self, new: Bounds, kept: Bounds | None) -> None:
        """Follow what the receiver says if it says so long enough and others agree."""
        claim = self._claim
        if claim is not None and new.at - claim.bounds.at > self._settings.fresh:
            claim = None  # who is silent meanwhile doesn't insist
        said = None if claim is None else claim.bounds.later(new.at, self._drift)
        if claim is None or said is None or not said.meet(new):
            self._claim, self._doubt = _Claim(new, new.at), ""
            return
        said = said.confirmed(new)
        claim.bounds, claim.count = said, claim.count + 1
        wanted = self._wanted(said, kept)
        if claim.count >= _FIXES and new.at - claim.since >= wanted:
            # The first may have been too slow; the quickest decides on the most, too.
            believed = Bounds(said.low, said.low + _EARLY + self._settings.latency, new.at)
            if kept is not None and not kept.meet(believed):
                self._jumped_at = new.at
                self.statistics.jumps += 1
            self._believe(believed)

    def _wanted(self, said: Bounds, kept: Bounds | None) -> float:
        """Return how long a claim must hold before it is believed, in s; infinite: never."""
        settings = self._settings
        self._doubt = ""
        alive = kept is not None and kept.error <= settings.largest_error
        if settings.system_tolerance is None:
            return settings.insist if alive else settings.confirm
        away = self._system_minus(said)
        if abs(away) > settings.system_tolerance + said.error:
            self._doubt = (
                f"the computer's clock is {away:+.1f} s from the receiver, more than "
                f"{settings.system_tolerance:g} s; set it right (NTP), or have it count for nothing"
            )
            return math.inf
        if kept is None or not alive:
            return settings.confirm
        # Whoever was set just now is no witness, nor is one who agrees with both sides.
        one_sided = abs(self._system_minus(kept)) > settings.system_tolerance + kept.error
        return settings.confirm if one_sided and self._is_steady() else settings.insist

    # -- the computer's clock ----------------------------------------------------------

    def _is_steady(self) -> bool:
        return not self._system.see(_gps_of(self._clock.utc()))

    def _system_minus(self, bounds: Bounds) -> float:
        """Return how far the computer's clock is ahead of some bounds, in s."""
        now = self._clock.monotonic()
        return _gps_of(self._clock.utc()) - now - bounds.middle

    @property
    def system_ahead(self) -> float:
        """How far the computer's clock is ahead of the time kept, in s; nan without one."""
        return math.nan if self._kept is None else self._system_minus(self._kept)

    # -- what time it is ---------------------------------------------------------------

    def time(self) -> Time:
        """Return the time now; see `Time`."""
        now = self._clock.monotonic()
        self._is_steady()
        jumped = now - self._jumped_at < self._settings.settle
        if self._kept is None:
            utc = self._clock.utc()
            return Time(utc.timestamp(), _gps_of(utc), math.inf, "none", jumped)
        bounds = self._kept.later(now, self._drift)
        seconds = now + bounds.middle
        utc_s = utc_of_gps(seconds).timestamp()
        if bounds.error > self._settings.largest_error:
            return Time(utc_s, seconds, math.inf, "none", jumped)
        quality: Quality = "gps" if now - self._fixed_at <= self._settings.fresh else "holdover"
        return Time(utc_s, seconds, bounds.error, quality, jumped)

    @property
    def problem(self) -> str:
        """Why the time is not of quality "gps" now, in one line; "" if it is."""
        now, fresh = self._clock.monotonic(), self._settings.fresh
        if now - self._fixed_at <= fresh:
            return ""
        if self._claim is not None and now - self._claim.bounds.at <= fresh:
            if self._doubt:
                return self._doubt
            if self._kept is None:
                return "the receiver is not believed yet"
            away = self._claim.bounds.middle - self._kept.middle
            return f"the receiver is {away:+.1f} s from the time kept so far"
        if now - self._no_fix_at <= fresh:
            return "the receiver has no fix; does its antenna see the sky?"
        if self._last is not None:
            return (
                f"no new time for {now - self._last_at:.0f} s; the last was "
                f"{self._last:%Y-%m-%d %H:%M:%S} UTC"
            )
        if self.reader.received > _ENOUGH and self.reader.sentences == 0:
            return (
                f"{self.reader.received} bytes came, and no sentence that tells the time: is the "
                "baud rate right, and are RMC, or ZDA and GGA, switched on?"
            )
        return "no time has come from the receiver yet"


def _gps_of(utc: datetime) -> float:
    try:
        return gps_seconds(utc)
    except TimeError:  # before the scale began: a clock that was never set
        return (utc - GPS_EPOCH).total_seconds()
