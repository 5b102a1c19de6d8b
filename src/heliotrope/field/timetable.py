"""The calibration timetable: which heliostats operators want calibrated on a target, and when.

This is Malan's calibration schedule (5.6.1): the operator chooses heliostats and times, and the
commands follow from that choice. The schedule of automatic control, which chooses by expected gain,
runs alongside.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, date, datetime, time
from functools import cached_property
from typing import Any

import numpy as np

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.files.cells import check_names
from heliotrope.geometry import FloatArray

#: Length of a day, s; shortest interval, s; maximum number of entries, and of times of day of an
#: entry.
DAY, LEAST_INTERVAL, MOST, MOST_TIMES = 86_400.0, 60.0, 100, 96


#: Rules for what automatic control chooses.
RULES = ("first", "never")


@dataclass(frozen=True)
class TimetableEntry:
    """Heliostats to calibrate at times of day, at intervals, or both; or a rule about them.

    Attributes
    ----------
    name
        Name of the entry, unique in its timetable.
    heliostats
        Names, in the order in which they are calibrated.
    target
        Name of the target; "": any free target.
    at
        Times of day with their time zone, as "08:30Z" or "10:30+02:00".
    every
        Interval, s, counted from midnight UTC; None: only ``at``.
    rule
        "" for entries with times; "first": automatic control calibrates these heliostats before all
        others whenever a visit is worthwhile; "never": only operators calibrate them, automatic
        control does not. A rule has neither times nor a target.

    Raises
    ------
    InputError
        If the entry has no heliostat or no time, or if a time or the interval is invalid.
    """

    name: str
    heliostats: tuple[str, ...]
    target: str = ""
    at: tuple[str, ...] = ()
    every: float | None = None
    rule: str = ""

    def __post_init__(self) -> None:
        who = f"timetable entry {self.name!r}"
        if not self.name or not self.heliostats:
            raise InputError(f"{who}: needs a name and at least one heliostat")
        if len(set(self.heliostats)) < len(self.heliostats):
            twice = next(n for n in self.heliostats if self.heliostats.count(n) > 1)
            raise InputError(f"{who}: heliostat {twice} is listed twice; list it once")
        if self.rule:
            if self.rule not in RULES:
                raise InputError(f"{who}: unknown rule {self.rule!r}; use {' or '.join(RULES)}")
            if self.at or self.every is not None or self.target:
                raise InputError(
                    f"{who}: {self.rule!r} applies at all times; remove times and target"
                )
            return
        if not self.at and self.every is None:
            raise InputError(
                f"{who}: no time is set; specify times of day (at) or an interval (every_s)"
            )
        if len(self.at) > MOST_TIMES:
            raise InputError(
                f"{who}: {len(self.at)} times of day; at most {MOST_TIMES} are allowed"
            )
        if self.every is not None and not LEAST_INTERVAL <= self.every <= DAY:
            raise InputError(
                f"{who}: the interval must be between {LEAST_INTERVAL:g} and {DAY:g} s, not "
                f"{self.every:g} s"
            )
        for text in self.at:
            _second_of_day(who, text)

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> "TimetableEntry":
        """Return the entry in a document that uses the keys of the plant file."""
        return cls(
            document["name"],
            tuple(document["heliostats"]),
            document.get("target") or "",
            tuple(document.get("at") or ()),
            document.get("every_s"),
            document.get("rule") or "",
        )

    @property
    def document(self) -> dict[str, Any]:
        """The entry as a document with the keys of the plant file; unset values are left out."""
        rest: dict[str, Any] = {"target": self.target, "at": list(self.at), "every_s": self.every}
        rest["rule"] = self.rule
        settings = {key: value for key, value in rest.items() if value}
        return {"name": self.name, "heliostats": list(self.heliostats), **settings}

    @cached_property
    def seconds(self) -> FloatArray:
        """Times at which the entry is due on each day, s after midnight UTC, ascending, (K,)."""
        often = np.arange(0.0, DAY, self.every) if self.every is not None else np.zeros(0)
        named = [_second_of_day(self.name, text) for text in self.at]
        return np.unique(np.concatenate([often, named]))

    def due(self, since: float, until: float) -> bool:
        """Return whether the entry was due after ``since`` and up to ``until``, POSIX s."""
        return not self.rule and self.next(since) <= until

    def next(self, after: float) -> float:
        """Return when the entry is next due after a given time, POSIX s; NaN for a rule."""
        if self.rule:
            return math.nan
        day = math.floor(after / DAY) * DAY
        remaining = self.seconds[self.seconds > after - day]
        return day + (float(remaining[0]) if len(remaining) else DAY + float(self.seconds[0]))


def check_timetable(
    entries: Iterable[TimetableEntry], heliostats: Iterable[str], targets: Iterable[str]
) -> None:
    """Check a timetable against the names of a plant.

    Raises
    ------
    InputError
        If there are more than ``MOST`` entries, or if two have the same name.
    UnknownNameError
        If an entry names a heliostat or a target that the plant does not have.
    """
    listed = tuple(entries)
    if len(listed) > MOST:
        raise InputError(f"timetable: {len(listed)} entries; at most {MOST} are allowed")
    check_names("timetable entry", (entry.name for entry in listed))
    known, surfaces = set(heliostats), tuple(targets)
    for entry in listed:
        for name in entry.heliostats:
            if name not in known:
                raise UnknownNameError("heliostat", name, known)
        if entry.target and entry.target not in surfaces:
            raise UnknownNameError("target", entry.target, surfaces)


def _second_of_day(who: str, text: str) -> float:
    """Return the time of day, s after midnight UTC."""
    try:
        parsed = time.fromisoformat(text)
    except (ValueError, TypeError):
        raise InputError(
            f"{who}: {text!r} is not a time of day; write 08:30Z or 10:30+02:00"
        ) from None
    if parsed.tzinfo is None:
        raise InputError(
            f"{who}: {text!r} has no time zone; write {text}Z for UTC, or {text}+02:00"
        )
    utc = datetime.combine(date(2000, 1, 2), parsed).astimezone(UTC)
    return 3600.0 * utc.hour + 60.0 * utc.minute + utc.second
