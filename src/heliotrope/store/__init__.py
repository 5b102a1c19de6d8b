"""The records of a plant: a database of records and accounts, and a telemetry archive.

`Records` is the protocol for a plant's records; `Keeper`, in module ``keeper``, stores them in
SQLite or PostgreSQL. Modules ``backup``, ``export`` and ``people`` work on the same database;
``telemetry`` writes the archive and ``telemetry_query`` runs SQL queries on it. These modules need
the extra ``store``; the names below do not.

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
