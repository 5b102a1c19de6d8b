"""The records of a plant: a database of records and people, and an archive of telemetry.

`Records` is the protocol of a plant's records; module ``keeper`` has `Keeper`, which
keeps them in SQLite or PostgreSQL. Modules ``backup``, ``export`` and ``people`` work on the same
database; ``telemetry`` writes the archive and ``telemetry_query`` answers questions about it in
SQL. These modules need the extra ``store``; the names below do not.

Begin with `Records` and `Event`.
"""

from heliotrope.store.records import (
    SEVERITIES,
    AlarmEntry,
    AuditEntry,
    CampaignEntry,
    Event,
    KeptSightings,
    Kind,
    Lockout,
    PlannedVisit,
    Records,
    StoreError,
    VisitEntry,
)

__all__ = [
    "SEVERITIES",
    "AlarmEntry",
    "AuditEntry",
    "CampaignEntry",
    "Event",
    "KeptSightings",
    "Kind",
    "Lockout",
    "PlannedVisit",
    "Records",
    "StoreError",
    "VisitEntry",
]
