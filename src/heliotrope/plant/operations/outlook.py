"""The errors of the field that the plant predicts for the rest of a day, as plain values."""

import json
from dataclasses import dataclass

from heliotrope.store.records import OutlookEntry
from heliotrope.sun import Site

_DAY = 86_400.0


@dataclass(frozen=True)
class FieldPoint:
    """Errors of all heliostats at one moment, calibrated or not.

    Attributes
    ----------
    at
        POSIX s.
    median, percentile_90
        Percentiles of their tracking errors, RMS over the suns of the year, rad.
    """

    at: float
    median: float
    percentile_90: float


@dataclass(frozen=True)
class Outlook:
    """A prediction for the rest of a day, or until the goal is reached.

    Attributes
    ----------
    made
        POSIX s.
    heliostats
        Number of heliostats that may be measured; the others keep their errors.
    goal
        Tracking error that 90 % of the heliostats shall not exceed, rad.
    reached
        When they do not, POSIX s; None if not on this day.
    points
        The predicted curve, oldest first; the first is what was known when it was made.
    text
        The outcome for people.
    """

    made: float
    heliostats: int
    goal: float
    reached: float | None
    points: tuple[FieldPoint, ...]
    text: str

    def document(self) -> str:
        """Return it as JSON for the store."""
        curve = [(p.at, p.median, p.percentile_90) for p in self.points]
        own = {"heliostats": self.heliostats, "goal": self.goal, "text": self.text}
        return json.dumps(own | {"reached": self.reached, "points": curve})

    @classmethod
    def of(cls, entry: OutlookEntry) -> "Outlook":
        """Return the prediction that the store has kept."""
        kept = json.loads(entry.document)
        points = tuple(FieldPoint(*map(float, point)) for point in kept["points"])
        rest = kept["heliostats"], kept["goal"], kept["reached"]
        return cls(entry.at, *rest, points, kept["text"])


def day_of(at: float, site: Site) -> int:
    """Return the number of the day of local mean solar time, from 1970."""
    return int((at + _ahead(site)) // _DAY)


def end_of_day(at: float, site: Site) -> float:
    """Return the next midnight of local mean solar time, POSIX s."""
    return (day_of(at, site) + 1) * _DAY - _ahead(site)


def _ahead(site: Site) -> float:
    """Return local mean solar time less UTC, s."""
    return site.longitude_deg / 360.0 * _DAY
