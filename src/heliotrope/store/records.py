"""What the plant keeps: its records, and the protocol by which it keeps them.

Times are POSIX seconds (UTC) unless they say otherwise. A record is taken at once and written
behind; `Records.confirm` waits until all that was taken before is safe, and only what was
confirmed is promised to be there after a crash.

::

    HeliotropeError
    └── StoreError            a record that could not be kept, or a store that cannot be used
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from heliotrope.calibration.record import (
    CalibrationOutcome,
    HeliostatCalibration,
    Identities,
)
from heliotrope.calibration.sightings import Sightings
from heliotrope.errors import HeliotropeError
from heliotrope.safety import Severity

SEVERITIES = tuple(Severity)


class StoreError(HeliotropeError):
    """A record that could not be kept, or a store that cannot be used."""


@dataclass(frozen=True)
class KeptSightings:
    """M sightings as they are kept.

    Attributes
    ----------
    identities
        Numbers of the sightings, unique for all time, (M,).
    names
        Of the heliostats that the rows of ``sightings`` point to.
    sightings
        In the order of time.
    kinds, targets, campaigns
        Of each sighting, "" where there is none, (M,).
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
        """Return the sightings of one heliostat, renumbered to 0; none if it is not known."""
        row = self.names.index(heliostat) if heliostat in self.names else len(self.names)
        return self.sightings.of(row)


@dataclass(frozen=True)
class Event:
    """Something that happened.

    Attributes
    ----------
    at
        When.
    source
        What part of the plant says so ("calibration", "cluster C12", "store").
    text
        One line.
    severity
        One of `SEVERITIES`.
    heliostat
        Whom it is about; "" if about none.
    values
        Numbers to it, by name.
    number
        Counts up for all time; 0 before it is kept.
    """

    at: float
    source: str
    text: str
    severity: str = "info"
    heliostat: str = ""
    values: Mapping[str, float] = field(default_factory=dict)
    number: int = 0


@dataclass(frozen=True)
class AlarmEntry:
    """An alarm, from when it was raised to when it was over and acknowledged.

    Attributes
    ----------
    condition, subject
        What, and of what; together they name an alarm that stands.
    severity, text
        How bad, and one line.
    raised, cleared, acknowledged
        When; None if not yet.
    acknowledged_by
        By whom; "" if by nobody.
    number
        Counts up for all time.
    """

    condition: str
    subject: str
    severity: str
    text: str
    raised: float
    cleared: float | None = None
    acknowledged: float | None = None
    acknowledged_by: str = ""
    number: int = 0


@dataclass(frozen=True)
class Hold:
    """A heliostat that the schedule leaves alone.

    Attributes
    ----------
    heliostat, reason, person, since
        Which, why, by whom and from when.
    until
        When it ends by itself; None: only by `Records.unhold`.
    """

    heliostat: str
    reason: str
    person: str
    since: float
    until: float | None = None


@dataclass(frozen=True)
class PlannedVisit:
    """A measurement that the schedule plans.

    Attributes
    ----------
    heliostat, target, due
        Which, where, when.
    gain
        What the schedule expects of it, in its own unit.
    note
        Why now.
    """

    heliostat: str
    target: str
    due: float
    gain: float = float("nan")
    note: str = ""


@dataclass(frozen=True)
class VisitEntry:
    """A measurement that was made, or was tried: what was expected of it and what it brought.

    Attributes
    ----------
    heliostat, target, begun, finished
        Which, where, when.
    outcome
        What became of it.
    text
        The same for people, one line.
    gain
        What the schedule had expected of it.
    sigma_before, sigma_expected, sigma_after
        Predicted standard deviation of the normal, rad: before, as planned, and after.
    error_before, error_after
        Beam error over the sightings, rad RMS.
    sightings
        How many it brought.
    version
        Parameter version that it led to; 0 for none.
    campaign
        It belongs to.
    number
        Counts up for all time; 0 before it is kept.
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
        When; None while it runs.
    model, note
        Parameters that it learns, further details.
    expected, found
        Figures by name: what was predicted of it and what it brought.
    """

    name: str
    begun: float
    finished: float | None = None
    model: str = ""
    note: str = ""
    expected: Mapping[str, float] = field(default_factory=dict)
    found: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class AuditEntry:
    """One accepted command; as `control.audit.Record`, whose times are ISO 8601."""

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


class Records(Protocol):
    """Where the plant keeps what it must remember.

    Whatever begins with ``record_`` returns at once: the event loop never waits for a disk. It
    raises `StoreError` if too much waits already. What is read is what has been written:
    `confirm` first to find what was just recorded; holds are the exception, they hold at once.
    """

    @property
    def problem(self) -> str:
        """Why records cannot be written now, "" if they can: for an alarm."""
        ...

    @property
    def backlog(self) -> int:
        """How many records wait to be written."""
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
        """Keep sightings, whose rows point to ``names``; return their numbers, (M,)."""
        ...

    def record_calibration(self, record: HeliostatCalibration) -> None:
        """Keep a calibration, whose version is above those kept of the heliostat."""
        ...

    def record_visit(self, visit: VisitEntry) -> None:
        """Keep what became of a measurement."""
        ...

    def record_plan(self, plan: Sequence[PlannedVisit]) -> None:
        """Keep what the schedule plans, in place of the plan before."""
        ...

    def record_campaign(self, campaign: CampaignEntry) -> None:
        """Keep a campaign, in place of what was kept of the same name."""
        ...

    def record_event(self, event: Event) -> None:
        """Keep an event."""
        ...

    def record_alarm(
        self, condition: str, subject: str, severity: str, text: str, at: float, *, active: bool
    ) -> None:
        """Keep that an alarm stands, or (not active) that it is over."""
        ...

    def record_acknowledgement(self, condition: str, subject: str, person: str, at: float) -> None:
        """Keep that a person acknowledged an alarm."""
        ...

    def hold(
        self,
        heliostats: Sequence[str],
        reason: str,
        person: str,
        at: float,
        until: float | None = None,
    ) -> None:
        """Keep the schedule off some heliostats; one that is held already is held anew."""
        ...

    def unhold(self, heliostats: Sequence[str], person: str, at: float) -> None:
        """Give heliostats back to the schedule."""
        ...

    def holds(self, at: float) -> dict[str, Hold]:
        """Return what is held at a time, by heliostat."""
        ...

    async def confirm(self) -> None:
        """Wait until all that was recorded before is safe.

        Raises
        ------
        StoreError
            If an attempt to write it failed; it is kept waiting and tried again by itself.
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
        """Return sightings of some heliostats (None: of all), those of one campaign if named."""
        ...

    def latest_calibrations(
        self, heliostats: Sequence[str] | None = None
    ) -> dict[str, HeliostatCalibration]:
        """Return the last version of each, by heliostat, without sightings and residuals."""
        ...

    def calibration_history(self, heliostat: str) -> list[HeliostatCalibration]:
        """Return all versions of one heliostat, the oldest first, with their residuals."""
        ...

    def visits(self, limit: int = 100, heliostat: str = "") -> list[VisitEntry]:
        """Return measurements, the last first."""
        ...

    def plan(self) -> list[PlannedVisit]:
        """Return the plan that was kept last, the first due first."""
        ...

    def campaigns(self) -> list[CampaignEntry]:
        """Return the campaigns, the last first."""
        ...

    def events(
        self, limit: int = 100, *, heliostat: str = "", severity: str = "info", before: int = 0
    ) -> list[Event]:
        """Return events of a severity and above, the last first; those before a number if given."""
        ...

    def alarms(self, limit: int = 100, *, standing: bool = False) -> list[AlarmEntry]:
        """Return alarms, the last first; only those neither over nor acknowledged if standing."""
        ...

    def close(self) -> None:
        """Write what waits, and end."""
        ...
