"""The audit log and the assigned points in the plant's store.

`KeptAudit` is an `audit.Audit`, `KeptPoints` an `assigned.Assigned`, both based on a
`store.Keeper`. They wait for the disk, so a plant uses them in the thread of its `disk.Disk`.
`KeptAudit.confirm` does not wait; it relies on the last result from the store.
"""

import math
import os
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import asdict
from datetime import datetime
from typing import TypeVar

from sqlalchemy import Connection

from heliotrope.links.clock import Clock
from heliotrope.plant.field.assigned import AssignedError, Places
from heliotrope.plant.orders.audit import LEAST_FREE, STOPPED, AuditError, Record
from heliotrope.store import audit
from heliotrope.store.keeper import Keeper
from heliotrope.store.records import AuditEntry, StoreError

T = TypeVar("T")

#: Longest wait for the commit of a record or of points, s. The points of a whole field (10,000)
#: take 0.1 s.
PATIENCE = 30.0
#: A store that has confirmed nothing for this time cannot be relied on, s.
SILENCE = 5.0
#: Pause between two probes of the store, s.
ASKED = 1.0


class KeptAudit:
    """An audit log in a store.

    Parameters
    ----------
    keeper
        Open keeper of the store; it stays open when the audit is closed.
    clock
        The computer's clock; its monotonic time limits the silence of the store. (The clock of a
        simulated plant may run faster than the disk.)
    started
        Start time, UTC, written to records that are completed only now because the plant had
        stopped.

    Attributes
    ----------
    ended
        Number of records that were completed at the start.

    Raises
    ------
    AuditError
        If the records without a result could not be completed.
    """

    def __init__(self, keeper: Keeper, clock: Clock, started: datetime) -> None:
        self._keeper, self._clock = keeper, clock
        self._asked: Future[None] | None = None
        self._asked_at = -math.inf
        self.ended = self._do(lambda c: audit.finish_open(c, STOPPED, started.isoformat()))
        self._heard_at = clock.monotonic()

    def begin(self, record: Record) -> None:
        """Write a record without a result; it is on the disk when this returns.

        Raises
        ------
        AuditError
            If it could not be written and synced.
        InputError
            If another record has the same identity.
        """
        entry = AuditEntry(**asdict(record))
        self._do(lambda c: audit.begin(c, entry))

    def finish(self, identity: str, result: str, at: str) -> None:
        """Add the result to a record that was begun.

        Raises
        ------
        AuditError
            If it could not be written and synced.
        InputError
            If the record was not begun, or has another result.
        """
        self._do(lambda c: audit.finish(c, identity, result, at))

    def confirm(self) -> None:
        """Check that a record could be written now, without waiting for the disk.

        Raises
        ------
        AuditError
            If the last write failed, the store has been silent for too long, or the disk is full.
        """
        now = self._clock.monotonic()
        self._hear(now)
        problem = self._keeper.writer.problem or _room(self._keeper)
        if problem:
            raise AuditError(f"audit: {problem}")
        if now - self._heard_at > SILENCE:
            raise AuditError(
                f"audit: store {self._keeper.database.name} has written nothing for "
                f"{now - self._heard_at:.0f} s; check the disk"
            )

    def _hear(self, now: float) -> None:
        """Note when the store last responded, and probe it again."""
        asked = self._asked
        if asked is not None and asked.done():
            if asked.exception() is None:
                self._heard_at = now
            self._asked = asked = None
        if asked is None and now - self._asked_at >= ASKED:
            self._asked_at = now
            try:
                self._asked = self._keeper.writer.attempt(audit.probe)
            except StoreError as error:
                raise AuditError(f"audit: {error}") from None

    def close(self) -> None:
        """Do nothing, because everything is in the store."""

    def _do(self, work: Callable[[Connection], T]) -> T:
        try:
            return self._keeper.writer.do(work, PATIENCE)
        except StoreError as error:
            raise AuditError(f"audit: {error}") from None


class KeptPoints:
    """Assigned points in a store; only changes are written.

    Parameters
    ----------
    keeper
        Open keeper of the store; it stays open.
    """

    def __init__(self, keeper: Keeper) -> None:
        self._keeper = keeper
        self._kept: dict[str, Places] | None = None

    def read(self) -> dict[str, Places]:
        """Return the stored points, by kind; an empty mapping if there are none.

        Raises
        ------
        StoreError
            If the store cannot be read.
        """
        with self._keeper.database.reading() as connection:
            self._kept = audit.points(connection)
        return {kind: dict(places) for kind, places in self._kept.items()}

    def keep(self, points: Mapping[str, Places]) -> None:
        """Replace the stored points; the new points are on the disk when this returns.

        Raises
        ------
        AssignedError
            If they could not be written and synced; the earlier points stay stored.
        """
        try:
            before = self.read() if self._kept is None else self._kept
            new = {
                kind: {n: p for n, p in places.items() if before.get(kind, {}).get(n) != p}
                for kind, places in points.items()
            }
            gone = {kind: places.keys() - points.get(kind, {}) for kind, places in before.items()}
            self._keeper.writer.do(lambda c: audit.change_points(c, new, gone), PATIENCE)
        except StoreError as error:
            # The commit may have succeeded all the same, so the store is read before the next one.
            self._kept = None
            raise AssignedError(f"assigned points: {error}") from None
        self._kept = {kind: dict(places) for kind, places in points.items()}


def _room(keeper: Keeper) -> str | None:
    """Return the refusal to show if the disk is full; None if it has space."""
    file = keeper.database.file
    if file is None:
        return None
    try:
        disk = os.statvfs(file.parent)
    except OSError as error:
        return f"store {file}: {error.strerror}; check the disk"
    free = disk.f_bavail * disk.f_frsize
    if free >= LEAST_FREE:
        return None
    return (
        f"store {file}: {free} bytes are left on its disk, the minimum is {LEAST_FREE}; free "
        "some space"
    )
