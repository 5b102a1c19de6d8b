"""Sentences of NMEA 0183 from a satellite receiver: bytes in, reports of its time out.

Three sentences tell the time: RMC (time, date, whether the fix is valid), ZDA (time, date of four
digits, no word about validity) and GGA (time of day, quality of the fix). A time counts only with
a fix: ZDA borrows it from an RMC or GGA of the same seconds, and of a second for which one
sentence denies a fix, none after it is believed. A receiver has to send RMC, or ZDA and GGA, once
a second or more often.

The checksum is an exclusive or of bytes: one damaged byte is always found, but one in 256 of
sentences damaged at random passes. So a report is a claim; `discipline.DisciplinedClock` believes
what several in a row confirm.

A receiver whose firmware is older than a rollover of the 10 bits of the week (every 1024 weeks)
tells a date 19.6 years back. Such a date is carried forward until it is no longer before
`timekeeping.NOT_BEFORE`, and counted.
"""

import re
from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta
from typing import Any

from pynmeagps import NMEAReader  # type: ignore[import-untyped]
from pynmeagps.exceptions import (  # type: ignore[import-untyped]
    NMEAMessageError,
    NMEAParseError,
    NMEAStreamError,
    NMEATypeError,
)

from heliotrope.cluster.timekeeping import NOT_BEFORE

#: The standard allows 82 characters; receivers of several systems send somewhat more.
_LONGEST = 120
_SENTENCE = re.compile(rb"\$[A-Z]{2}(RMC|ZDA|GGA),([ -#%-)+-~]*)\*[0-9A-Fa-f]{2}")
_ANY_SENTENCE = re.compile(rb"\$P?[A-Z]{1,5}[^$*]*\*[0-9A-Fa-f]{2}")
_TIME = re.compile(r"\d{6}(\.\d{1,6})?")
_ROLLOVER = timedelta(weeks=1024)
#: From the beginning of GPS to the end of what two digits of RMC can tell.
_YEARS = range(1980, 2100)
#: Autonomous, differential, precise, real-time kinematic (fixed, float). Not: estimated (dead
#: reckoning), manual, simulated.
_RMC_MODES = "ADPRF"
_GGA_QUALITIES = (1, 2, 3, 4, 5)
#: A verdict of RMC or GGA is good for a ZDA of up to this later, in s.
_VERDICT = 2.0


@dataclass(frozen=True)
class Report:
    """What one sentence says.

    Attributes
    ----------
    utc
        The time it names; None: it has no date, or none yet.
    fix
        Whether it rests on satellites now.
    rolled
        Whether its date was carried over a rollover of the week.
    """

    utc: datetime | None
    fix: bool
    rolled: bool = False


class NmeaReader:
    """Cuts bytes into sentences and reads those that tell the time.

    Attributes
    ----------
    received
        Bytes.
    sentences, damaged, unusable
        Sentences that tell the time; those begun that are none, for their form or their checksum;
        those whose values are no time.
    """

    def __init__(self) -> None:
        self._line = bytearray()
        self._began = 0.0
        self._verdict: tuple[float, bool] | None = None
        self.received = 0
        self.sentences = 0
        self.damaged = 0
        self.unusable = 0

    def feed(self, data: bytes, at: float) -> list[tuple[Report, float]]:
        """Take bytes, and return what they complete.

        Parameters
        ----------
        data
            Any bytes, cut anywhere.
        at
            When they came, in s of a monotonic clock.

        Returns
        -------
        list of (Report, float)
            Each with the instant at which its ``$`` came.
        """
        reports = []
        self.received += len(data)
        for piece in data.splitlines(keepends=True):
            begin = piece.rfind(b"$")
            if begin >= 0:  # it begins here, whatever came before: half a sentence, binary data
                self.damaged += bool(self._line)
                self._line[:] = piece[begin:]
                self._began = at
            elif self._line:
                self._line += piece
            if len(self._line) > _LONGEST:
                self.damaged += 1
                self._line.clear()
            elif self._line and piece.endswith((b"\n", b"\r")):
                report = self._read(bytes(self._line).strip())
                self._line.clear()
                if report is not None:
                    reports.append((report, self._began))
        return reports

    def _read(self, line: bytes) -> Report | None:
        known = _SENTENCE.fullmatch(line)
        if known is None:
            # Sentences of other kinds are many, and none of our business.
            self.damaged += _ANY_SENTENCE.fullmatch(line) is None
            return None
        try:
            message: Any = NMEAReader.parse(line + b"\r\n")
        except (NMEAParseError, NMEAMessageError, NMEATypeError, NMEAStreamError, ValueError):
            message = None
        if message is None:
            self.damaged += 1
            return None
        self.sentences += 1
        of_day = getattr(message, "time", None)
        raw = known[2].split(b",", 1)[0].decode("ascii", "replace")
        if not isinstance(of_day, time) or not _TIME.fullmatch(raw):
            # Also the leap second itself, 23:59:60, which the time before it is carried over.
            self.unusable += bool(raw)
            return Report(None, fix=False)
        kind = known[1]
        if kind == b"GGA":
            fix = getattr(message, "quality", None) in _GGA_QUALITIES
            return Report(None, self._judge(of_day, fix=fix))
        if kind == b"RMC":
            return self._rmc(message, of_day)
        return self._zda(message, of_day)

    def _judge(self, of_day: time, *, fix: bool) -> bool:
        """Return whether all that was said of this second so far says that there is a fix."""
        if self._verdict is not None and self._verdict[0] == _seconds(of_day):
            fix = fix and self._verdict[1]
        self._verdict = (_seconds(of_day), fix)
        return fix

    def _rmc(self, message: Any, of_day: time) -> Report:
        mode = getattr(message, "posMode", "") or "A"  # there is none before NMEA 2.3
        fix = getattr(message, "status", "") == "A" and mode in _RMC_MODES
        fix = self._judge(of_day, fix=fix)
        day = getattr(message, "date", None)
        if not isinstance(day, date):
            self.unusable += fix
            return Report(None, fix=False)
        # Two digits: 69 to 99 are read as years of the last century, in which we are not.
        return self._dated(day.replace(year=2000 + day.year % 100), of_day, fix=fix)

    def _zda(self, message: Any, of_day: time) -> Report:
        fix = False
        if self._verdict is not None:
            since = (_seconds(of_day) - self._verdict[0]) % 86400.0
            fix = self._verdict[1] and since <= _VERDICT
        try:
            day = date(message.year, message.month, message.day)
        except (AttributeError, TypeError, ValueError):
            self.unusable += fix
            return Report(None, fix=False)
        if day.year not in _YEARS:
            self.unusable += 1
            return Report(None, fix=False)
        return self._dated(day, of_day, fix=fix)

    def _dated(self, day: date, of_day: time, *, fix: bool) -> Report:
        utc = datetime.combine(day, of_day, UTC)
        rolled = False
        while utc < NOT_BEFORE:
            utc += _ROLLOVER
            rolled = True
        return Report(utc, fix, rolled)


def _seconds(of_day: time) -> float:
    return of_day.hour * 3600.0 + of_day.minute * 60.0 + of_day.second + of_day.microsecond / 1e6
