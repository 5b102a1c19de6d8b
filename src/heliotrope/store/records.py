"""The records of a plant, and the protocol for storing them.

Times are POSIX seconds (UTC) unless stated otherwise. A record is accepted at once and written in
the background; `Records.confirm` waits until all earlier records are safely stored. Only confirmed
records are guaranteed to survive a crash.

::

    HeliotropeError
    └── StoreError            a record that could not be kept, or a store that cannot be used
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from typing import Protocol, TypeVar

from heliotrope.calibration.record import (
    CalibrationOutcome,
    HeliostatCalibration,
    Identities,
)
from heliotrope.calibration.sightings import Sightings
from heliotrope.errors import HeliotropeError
from heliotrope.safety import Alarm, Severity

T = TypeVar("T")
SEVERITIES = tuple(Severity)


class StoreError(HeliotropeError):
    """A record could not be stored, or a store cannot be used."""


@dataclass(frozen=True)
class KeptSightings:
    """M sightings from the store.

    Attributes
    ----------
    identities
        Numbers of the sightings, unique for all time, (M,).
    names
        Names of the heliostats to which the indices in ``sightings`` refer.
    sightings
        The sightings in order of time.
    kinds, targets, campaigns
        One word per sighting, (M,); empty if not set.
    """

    identities: Identities
    names: tuple[str, ...]
    sightings: Sightings
    kinds: tuple[str, ...]
    targets: tuple[str, ...]
    campaigns: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.identities)

    def of(self, heliostat: str) -> Sightings:
        """Return the sightings of one heliostat, with its heliostat index reset to 0.

        There are no sightings if the name is unknown.
        """
        row = self.names.index(heliostat) if heliostat in self.names else len(self.names)
        return self.sightings.of(row)


@dataclass(frozen=True)
class Event:
    """An event.

    Attributes
    ----------
    at
        POSIX s.
    source
        Part of the plant that reports it ("calibration", "cluster C12", "store").
    text
        One line.
    severity
        One of `SEVERITIES`.
    heliostat
        Heliostat concerned; empty if there is none.
    values
        Numeric details by name.
    number
        Number that always increases; 0 before the entry is recorded.
    """

    at: float
    source: str
    text: str
    severity: Severity = Severity.INFO
    heliostat: str = ""
    values: Mapping[str, float] = field(default_factory=dict)
    number: int = 0


@dataclass(frozen=True)
class AlarmEntry:
    """An alarm, from raising to clearing and acknowledgement.

    Attributes
    ----------
    condition, subject
        Condition, and the object that it concerns; together they identify an active alarm.
    severity, text
        Severity, and one-line text.
    raised, cleared, acknowledged
        Times, POSIX s; None if this has not happened yet.
    acknowledged_by
        Operator who acknowledged it; empty if not acknowledged.
    number
        Number that always increases.
    """

    condition: str
    subject: str
    severity: Severity
    text: str
    raised: float
    cleared: float | None = None
    acknowledged: float | None = None
    acknowledged_by: str = ""
    number: int = 0


class Kind(StrEnum):
    """The kind of object that an operator can lock."""

    HELIOSTAT = "heliostat"
    TARGET = "target"
    RECEIVER = "receiver"
    TOWER = "tower"


@dataclass(frozen=True)
class Lockout:
    """One operator's lock on a heliostat, a target, a receiver or the tower.

    Attributes
    ----------
    kind, name
        What is locked; the name of the tower is "tower".
    who, reason
        Operator who applied the lock, and why.
    since, until
        Time of locking, and expected return to service, POSIX s; NaN if not specified. The lock
        remains beyond that time, until `Records.unhold`.
    """

    kind: Kind
    name: str
    who: str
    reason: str
    since: float
    until: float = math.nan

    @property
    def text(self) -> str:
        """The lock in one line: reason, operator, since when, expected return."""
        back = f", expected back {_time(self.until)}" if math.isfinite(self.until) else ""
        return f"{self.reason} ({self.who}, since {_time(self.since)}{back})"


def _time(at: float) -> str:
    return f"{datetime.fromtimestamp(at, UTC):%d %b %H:%M} UTC"


@dataclass(frozen=True)
class PlannedVisit:
    """A calibration visit that the schedule plans.

    Attributes
    ----------
    heliostat, target
        Names.
    at
        Expected start, POSIX s.
    gain
        Expected reduction of the tracking error over the year, rad; NaN if unknown.
    reason
        Why it is due, for display.
    """

    heliostat: str
    target: str
    at: float
    gain: float = math.nan
    reason: str = ""


@dataclass(frozen=True)
class VisitEntry:
    """A calibration visit that was made or attempted: expectation and result.

    Attributes
    ----------
    heliostat, target, begun, finished
        Names, and POSIX s.
    outcome
        Outcome of the attempt.
    text
        The outcome for display, one line.
    gain
        Gain that the schedule expected.
    sigma_before, sigma_expected, sigma_after
        Predicted standard deviation of the normal, rad: before the visit, as planned, and after.
    error_before, error_after
        Beam error over the sightings, rad RMS.
    sightings
        Number of sightings.
    version
        Version of the resulting calibration; 0 if there is none.
    campaign
        Name of its campaign; empty if there is none.
    number
        Number that always increases; 0 before the entry is recorded.
    """

    heliostat: str
    target: str
    begun: float
    finished: float
    outcome: CalibrationOutcome
    text: str = ""
    gain: float = float("nan")
    sigma_before: float = float("nan")
    sigma_expected: float = float("nan")
    sigma_after: float = float("nan")
    error_before: float = float("nan")
    error_after: float = float("nan")
    sightings: int = 0
    version: int = 0
    campaign: str = ""
    number: int = 0

    @property
    def good(self) -> bool:
        """Whether the heliostat has new parameters."""
        return self.outcome.calibrated


@dataclass(frozen=True)
class CampaignEntry:
    """A campaign of measurements.

    Attributes
    ----------
    name
        Unique.
    begun, finished
        POSIX s; ``finished`` is None while it runs.
    model, note
        Model of the parameters, and notes.
    expected, found
        Numeric results by name: as predicted, and as found.
    """

    name: str
    begun: float
    finished: float | None = None
    model: str = ""
    note: str = ""
    expected: Mapping[str, float] = field(default_factory=dict)
    found: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class FlightEntry:
    """A drone flight that was imported into the plant.

    Attributes
    ----------
    name
        Unique.
    at
        Time of import, POSIX s.
    person
        Person who imported it.
    document
        Text of its file; see `calibration.flights`.
    """

    name: str
    at: float
    person: str
    document: str


@dataclass(frozen=True)
class LearningEntry:
    """The learnt hyperparameters of a heliostat group.

    Attributes
    ----------
    group, version
        Name of the group in the plant file, and 1, 2, ... for each group.
    at, person
        Time of learning, POSIX s, and the person who ordered it.
    heliostats, sightings
        Number of heliostats and number of sightings from which the result was learnt.
    gain
        Increase of a sighting's log probability density, predicted from earlier sightings.
    document
        The model and the hyperparameters as JSON; see `calibration.learn.group`.
    """

    group: str
    version: int
    at: float
    person: str
    heliostats: int
    sightings: int
    gain: float
    document: str


@dataclass(frozen=True)
class TimetableRecord:
    """A calibration timetable that an operator has activated.

    Attributes
    ----------
    at
        Time of activation, POSIX s.
    person
        Person who activated it.
    document
        Its entries as JSON, with the keys of the plant file; "": the timetable of the plant file.
    """

    at: float
    person: str
    document: str


@dataclass(frozen=True)
class FieldPoint:
    """Errors of all heliostats at one moment, calibrated or not.

    Attributes
    ----------
    at
        POSIX s.
    median, percentile_90
        Percentiles of their tracking errors, RMS over the sun positions of the year, rad.
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
        Number of heliostats that may be measured; the errors of all others stay constant.
    goal
        Tracking error that 90 % of the heliostats must not exceed, rad.
    reached
        When the goal is reached, POSIX s; None if it is not reached on this day.
    points
        The predicted curve, oldest first; the first point is the state at the time of the
        prediction.
    text
        The outcome for display.
    """

    made: float
    heliostats: int
    goal: float
    reached: float | None
    points: tuple[FieldPoint, ...]
    text: str

    @property
    def document(self) -> str:
        """The prediction as JSON, without the time at which it was made."""
        own = asdict(self)
        del own["made"]
        return json.dumps(own | {"points": [astuple(point) for point in self.points]})

    @classmethod
    def of(cls, made: float, document: str) -> "Outlook":
        """Return the prediction in a document, which was made at a given time."""
        own = json.loads(document)
        return cls(made, **own | {"points": tuple(FieldPoint(*point) for point in own["points"])})


@dataclass(frozen=True)
class PlantFigures:
    """Values for the whole plant at one moment.

    Attributes
    ----------
    at
        POSIX s.
    values
        Values by name, SI; NaN if unknown. See `plant.operations.history`.
    """

    at: float
    values: Mapping[str, float]


@dataclass(frozen=True)
class AuditEntry:
    """One accepted command, as in `plant.orders.audit.Record`; times are in ISO 8601."""

    identity: str
    who: str
    role: str
    what: str
    at: str
    values: tuple[float, ...] = ()
    heliostats: tuple[str, ...] = ()
    note: str = ""
    result: str = ""
    finished: str = ""


@dataclass(frozen=True)
class JournalQuery:
    """A query to the journal.

    Attributes
    ----------
    since, until
        Time range, POSIX s; ``until`` is excluded.
    kind
        "event", "alarm", "command" or "note"; "" for all. Notes are events, too.
    person, heliostat, text
        Person, heliostat, and a text whose case is ignored; "" for any.
    but
        Users whose commands are left out.
    limit
        Maximum number of entries.
    """

    since: float = 0.0
    until: float = 1e11
    kind: str = ""
    person: str = ""
    heliostat: str = ""
    text: str = ""
    but: str = ""
    limit: int = 200


@dataclass(frozen=True)
class JournalEntry:
    """One entry of the journal.

    Attributes
    ----------
    at
        POSIX s.
    kind
        "event", "alarm", "command" or "note".
    what
        Source of an event, condition of an alarm, or name of a command.
    text
        One line.
    severity
        "" for a command.
    heliostats
        Names of the first `JOURNAL_NAMES` heliostats, for a command to more than five heliostats.
    """

    at: float
    kind: str
    what: str
    text: str
    severity: str = ""
    heliostats: tuple[str, ...] = ()


#: Maximum number of heliostats of a command that the journal names.
JOURNAL_NAMES = 200


#: Source of an event that is an operator's note.
NOTE = "note"
#: A record that is one row of its own table.
Fact = (
    VisitEntry
    | CampaignEntry
    | FlightEntry
    | LearningEntry
    | TimetableRecord
    | Outlook
    | PlantFigures
)


class Records(Protocol):
    """Storage for the records of a plant.

    Methods that begin with ``record_`` return at once, because the event loop must not wait for a
    disk; they raise `StoreError` if too many records are already waiting. Reads return what has
    been written, so call `confirm` first to see the latest records. Locks are the exception,
    because they take effect at once.
    """

    @property
    def problem(self) -> str:
        """Why records cannot be written now, as the text of an alarm; empty if they can."""
        ...

    @property
    def refused(self) -> str:
        """The last record rejected because of its content; empty if there is none."""
        ...

    @property
    def refused_count(self) -> int:
        """Number of records rejected because of their content."""
        ...

    def record_sightings(
        self,
        names: Sequence[str],
        sightings: Sightings,
        *,
        kind: str = "camera_target",
        target: str = "",
        campaign: str = "",
    ) -> Identities:
        """Record sightings, whose indices refer to ``names``; return their numbers, (M,)."""
        ...

    def record_calibration(self, *records: HeliostatCalibration) -> None:
        """Record calibrations; a version must exceed all recorded versions of its heliostat."""
        ...

    def record(self, fact: Fact) -> None:
        """Record a fact; a fact keyed by time or name replaces an earlier fact with that key."""
        ...

    def record_event(self, event: Event) -> None:
        """Record an event."""
        ...

    def record_alarm(self, alarm: Alarm, at: float) -> None:
        """Record that an alarm was raised at a time, POSIX s, or (not active) that it cleared.

        An unknown severity counts as an alarm, so that no alarm is lost because of its severity.
        """
        ...

    def record_acknowledgement(self, condition: str, subject: str, person: str, at: float) -> None:
        """Record that an operator acknowledged an alarm."""
        ...

    def hold(self, holds: Sequence[Lockout]) -> None:
        """Store locks; a new lock replaces the same operator's earlier lock on the same object."""
        ...

    def unhold(self, holds: Sequence[Lockout], person: str, at: float) -> None:
        """End locks that ``person`` removed at the time ``at``, POSIX s."""
        ...

    def holds(self) -> tuple[Lockout, ...]:
        """Return the active locks."""
        ...

    def exchange_limits(self, numbers: Mapping[str, float]) -> dict[str, float]:
        """Store the safety-table limits in force; return the limits of the previous run, or {}."""
        ...

    def emergency(self) -> str:
        """Return the document about the active emergency; an empty document if there is none."""
        ...

    def keep_emergency(self, document: str) -> None:
        """Replace the document about the active emergency; an empty one means that it has ended."""
        ...

    def waiting_changes(self, kind: str) -> str:
        """Return the document about changes of a kind that await approval; empty if none do.

        The kinds are "parameters" and "plant file".
        """
        ...

    def keep_waiting_changes(self, kind: str, document: str) -> None:
        """Replace the document about changes that await approval; an empty one means none do."""
        ...

    def aimed_by_people(self) -> tuple[str, ...]:
        """Return the heliostats that operators have aimed, and that keep these aims."""
        ...

    def keep_aimed_by_people(self, heliostats: Sequence[str]) -> None:
        """Replace the set of heliostats that operators have aimed."""
        ...

    async def confirm(self) -> None:
        """Wait until all earlier records are safely stored.

        Raises
        ------
        StoreError
            If an attempt to write failed; the records stay queued and are retried.
        """
        ...

    async def read(self, work: "Callable[[Records], T]") -> T:
        """Return the result of work that reads, done in a thread that the store alone uses.

        A database that does not respond then holds up nothing but reads.
        """
        ...

    def sightings(
        self,
        heliostats: Sequence[str] | None = None,
        *,
        since: float = float("-inf"),
        until: float = float("inf"),
        campaign: str = "",
    ) -> KeptSightings:
        """Return sightings by time, for some heliostats (None: all) and optionally one campaign."""
        ...

    def latest_calibrations(
        self, heliostats: Sequence[str] | None = None
    ) -> dict[str, HeliostatCalibration]:
        """Return the latest version by heliostat, without sightings and residuals."""
        ...

    def calibration_history(self, heliostat: str) -> list[HeliostatCalibration]:
        """Return all versions of one heliostat, the oldest first.

        The sightings behind each version are in the order of their numbers. The residual of a
        sighting is stored with the version that first uses it; it is NaN in later versions.
        """
        ...

    def figures(self, since: float, until: float) -> list[PlantFigures]:
        """Return the plant's time series between two times, oldest first; the end is excluded."""
        ...

    def visits(
        self, limit: int = 100, heliostat: str = "", *, since: float = 0.0, until: float = 1e11
    ) -> list[VisitEntry]:
        """Return the calibration visits that finished within a time span, the latest first."""
        ...

    def campaigns(self) -> list[CampaignEntry]:
        """Return the campaigns, the latest first."""
        ...

    def flights(self) -> list[FlightEntry]:
        """Return the drone flights, in order of import."""
        ...

    def learnings(self) -> list[LearningEntry]:
        """Return the latest learnt hyperparameters of each group."""
        ...

    def timetables(self) -> list[TimetableRecord]:
        """Return the timetables that operators have activated, the latest first."""
        ...

    def outlooks(self, since: float) -> list[Outlook]:
        """Return the predictions made since a given time, oldest first."""
        ...

    def events(
        self,
        limit: int = 100,
        *,
        heliostat: str = "",
        severity: Severity = Severity.INFO,
        before: int = 0,
    ) -> list[Event]:
        """Return events of at least a given severity, latest first.

        If a number is specified, only events with lower numbers are returned.
        """
        ...

    def alarms(
        self,
        limit: int = 100,
        *,
        standing: bool = False,
        since: float = 0.0,
        until: float = 1e11,
    ) -> list[AlarmEntry]:
        """Return alarms that were active within a time span, the latest first.

        With ``standing``, alarms that are both cleared and acknowledged are left out.
        """
        ...

    def journal(self, query: JournalQuery) -> list[JournalEntry]:
        """Return the events, alarms and commands that match a query, the latest first."""
        ...

    def close(self) -> None:
        """Write the waiting records, and close."""
        ...
