"""Command records on a simulated disk, which may be full and which survives the plant."""

from collections.abc import Mapping
from dataclasses import replace

from heliotrope.errors import InputError
from heliotrope.plant.assigned import Places
from heliotrope.plant.audit import STOPPED, AuditError, Record


class RecordsDisk:
    """A disk with records.

    Attributes
    ----------
    records
        Records by identity, in the order in which they began.
    full
        Whether nothing can be written.
    well_since
        Time since which the disk has had room, s.
    """

    def __init__(self) -> None:
        self.records: dict[str, Record] = {}
        self.full = False
        self.well_since = float("-inf")

    def set_full(self, now: float, *, full: bool) -> None:
        """Fill the disk, or make room."""
        if self.full and not full:
            self.well_since = now
        self.full = full

    def check(self) -> None:
        """Check that the disk has room.

        Raises
        ------
        AuditError
            If the disk is full.
        """
        if self.full:
            raise AuditError("audit: no space left on the simulated disk; make room")


class SimulatedAudit:
    """A `plant.audit.Audit` of one run of the plant.

    Parameters
    ----------
    disk
        Holds the records.
    started
        UTC, ISO 8601; closes the records that an earlier run of the plant left open.

    Raises
    ------
    AuditError
        If the disk is full.
    """

    def __init__(self, disk: RecordsDisk, started: str) -> None:
        self._disk = disk
        for identity, record in list(disk.records.items()):
            if not record.result:
                self.finish(identity, STOPPED, started)

    def begin(self, record: Record) -> None:
        """Keep a record without a result.

        Raises
        ------
        AuditError
            If the disk is full.
        InputError
            If the identity has been used before.
        """
        self._disk.check()
        if record.identity in self._disk.records:
            raise InputError(f"audit: record {record.identity} exists; identities are unique")
        self._disk.records[record.identity] = record

    def finish(self, identity: str, result: str, at: str) -> None:
        """Add the result to a record.

        Raises
        ------
        AuditError
            If the disk is full.
        InputError
            If the record was not begun, or already has a result.
        """
        self._disk.check()
        known = self._disk.records.get(identity)
        if known is None or known.result:
            raise InputError(f"audit: no record {identity} waits for a result")
        self._disk.records[identity] = replace(known, result=result, finished=at)

    def confirm(self) -> None:
        """Check that a record could be written now.

        Raises
        ------
        AuditError
            If the disk is full.
        """
        self._disk.check()

    def close(self) -> None:
        """Close the audit; everything is on the disk already."""


class AssignedDisk:
    """Assigned points on a disk that survives the plant's program; an `assigned.Assigned`."""

    def __init__(self) -> None:
        self._points: dict[str, Places] = {}

    def read(self) -> dict[str, Places]:
        """Return the points that are kept, by kind."""
        return {kind: dict(places) for kind, places in self._points.items()}

    def keep(self, points: Mapping[str, Places]) -> None:
        """Replace all points that are kept."""
        self._points = {kind: dict(places) for kind, places in points.items()}
