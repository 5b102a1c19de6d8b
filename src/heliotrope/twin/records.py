"""Command records on a simulated disk, which may be full and which survives the plant program."""

import asyncio
from collections import deque
from collections.abc import Mapping
from contextvars import Context
from dataclasses import replace

from heliotrope.errors import InputError
from heliotrope.files.disk import Then, Work
from heliotrope.links.clock import Clock
from heliotrope.plant.field.assigned import Places
from heliotrope.plant.orders.audit import STOPPED, AuditError, Record


class RecordsDisk:
    """A disk with command records.

    Attributes
    ----------
    records
        Records by identity, in the order in which the commands began.
    full
        Whether nothing can be written.
    delay
        Time that each piece of work takes, s.
    well_since
        Time since which the disk has had space and has kept up with the work, s.
    """

    def __init__(self) -> None:
        self.records: dict[str, Record] = {}
        self.full = False
        self.delay = 0.0
        self.well_since = float("-inf")
        self._queue: DiskQueue | None = None

    def set_full(self, now: float, *, full: bool) -> None:
        """Fill the disk, or free space."""
        if self.full and not full:
            self.well_since = now
        self.full = full

    def set_slow(self, now: float, delay: float) -> None:
        """Set the time that each piece of work takes, s."""
        if self.delay and not delay:
            self.well_since = now if self._queue is None else max(now, self._queue.free_at)
        self.delay = delay

    def queue(self, clock: Clock, context: Context) -> "DiskQueue":
        """Return the work queue for a run of the plant program; see `DiskQueue`."""
        self._queue = DiskQueue(self, clock, context)
        return self._queue

    def lose(self) -> None:
        """Discard the pending work, because the plant program has ended."""
        if self._queue is not None:
            self._queue.lose()
            self._queue = None

    def busy(self, now: float) -> bool:
        """Whether writing a record may take long."""
        return self.delay > 0.0 or (self._queue is not None and self._queue.free_at > now)

    def check(self) -> None:
        """Check that the disk has space.

        Raises
        ------
        AuditError
            If the disk is full.
        """
        if self.full:
            raise AuditError("audit: no space left on the simulated disk; free some space")


class DiskQueue:
    """The pending work of a disk in virtual time; a `files.disk.Disk`.

    Parameters
    ----------
    disk
        Disk whose delay applies to each piece of work.
    clock
        Clock that shows true time.
    context
        Context of the program to which the work belongs.

    Attributes
    ----------
    free_at
        Time at which all work so far is done, s.
    """

    def __init__(self, disk: RecordsDisk, clock: Clock, context: Context) -> None:
        self._disk, self._clock, self._context = disk, clock, context
        self._waiting: deque[tuple[float, Work, Then]] = deque()
        self.free_at = clock.monotonic()

    def do(self, work: Work, then: Then) -> None:
        """Do the work after all earlier work is done and its own delay has passed."""
        now = self._clock.monotonic()
        self.free_at = max(self.free_at, now) + self._disk.delay
        self._waiting.append((self.free_at, work, then))
        if self.free_at > now:
            loop = asyncio.get_running_loop()
            loop.call_later(self.free_at - now, self._work, context=self._context)
        else:
            self._work()

    def _work(self) -> None:
        # A timer may fire a rounding error too early.
        while self._waiting and self._waiting[0][0] <= self._clock.monotonic() + 1e-6:
            _, work, then = self._waiting.popleft()
            try:
                work()
            except Exception as error:  # noqa: BLE001 - it goes to the plant
                then(error)
            else:
                then(None)

    def lose(self) -> None:
        """Discard the pending work."""
        self._waiting.clear()

    def close(self) -> None:
        """Do nothing, because the pending work continues by itself."""


class SimulatedAudit:
    """A `plant.orders.audit.Audit` of one run of the plant.

    Parameters
    ----------
    disk
        Disk that stores the records.
    started
        Start of this run, UTC, ISO 8601; used to close records that an earlier run of the plant
        left open.

    Raises
    ------
    AuditError
        If the disk is full.
    """

    def __init__(self, disk: RecordsDisk, started: str) -> None:
        self._disk = disk
        self._lost = False
        for identity, record in list(disk.records.items()):
            if not record.result:
                self.finish(identity, STOPPED, started)

    def begin(self, record: Record) -> None:
        """Store a record without a result.

        Raises
        ------
        AuditError
            If the disk is full.
        InputError
            If the identity has been used before.
        """
        self._check()
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
        self._check()
        known = self._disk.records.get(identity)
        if known is None or known.result:
            raise InputError(f"audit: no record {identity} is waiting for a result")
        self._disk.records[identity] = replace(known, result=result, finished=at)

    def confirm(self) -> None:
        """Check that a record could be written now.

        Raises
        ------
        AuditError
            If the disk is full.
        """
        self._check()

    def lose(self) -> None:
        """Accept no further records, because the plant program has ended, at whatever point."""
        self._lost = True

    def _check(self) -> None:
        if self._lost:
            raise AuditError("audit: the simulated program has ended")
        self._disk.check()

    def close(self) -> None:
        """Close the audit; all records are already on the disk."""


class EmergencyDisk:
    """The record of an emergency, an `EmergencyRecord` that survives the plant program."""

    def __init__(self) -> None:
        self._document = ""

    def emergency(self) -> str:
        """Return the stored document; empty if there is none."""
        return self._document

    def keep_emergency(self, document: str) -> None:
        """Replace the stored document."""
        self._document = document


class AssignedDisk:
    """Assigned points on a disk that survives the plant program; an `assigned.Assigned`."""

    def __init__(self) -> None:
        self._points: dict[str, Places] = {}

    def read(self) -> dict[str, Places]:
        """Return the stored points, by kind."""
        return {kind: dict(places) for kind, places in self._points.items()}

    def keep(self, points: Mapping[str, Places]) -> None:
        """Replace all stored points."""
        self._points = {kind: dict(places) for kind, places in points.items()}
