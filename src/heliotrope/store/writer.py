"""A writing thread behind a bounded queue, which commits all waiting jobs together.

A caller queues a job and continues. The thread takes all queued jobs, runs them in one transaction,
and only then notifies the callers. If the database fails (disk full, read-only, server down), no
job is lost and the queue is kept: the thread retries, and `Writer.problem` states the reason. A job
that the database rejects because of its content (not because of the disk) is dropped and reported
in `Writer.refused`, and does not hold up other jobs.
"""

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from concurrent.futures import TimeoutError as NotYetError
from dataclasses import dataclass
from typing import Any, TypeVar

from sqlalchemy import Connection
from sqlalchemy.exc import (
    DataError,
    DBAPIError,
    IntegrityError,
    SQLAlchemyError,
    StatementError,
)

from heliotrope.store.database import Database, cause
from heliotrope.store.records import StoreError

T = TypeVar("T")
Work = Callable[[Connection], T]

#: Largest number of jobs in one transaction, so that no caller waits long behind the others.
MOST = 256
#: Wait after a failure, s: the first, and the longest.
_PAUSE = (0.25, 5.0)
#: How long a job may wait for more jobs to share its commit, s.
_LINGER = 0.05


@dataclass
class _Entry:
    """A waiting job.

    If ``kept``, it is retried until it is written; otherwise it is dropped after one attempt.
    """

    work: Work[Any]
    future: "Future[Any] | None"
    kept: bool


class Writer:
    """Writes to a database.

    Parameters
    ----------
    database
        Database that is ready and locked by this process.
    limit
        Number of jobs that may wait.
    inline
        Whether to write at once in the caller's thread, for virtual time, in which no thread can be
        awaited.
    """

    def __init__(self, database: Database, *, limit: int = 50_000, inline: bool = False) -> None:
        self._database, self._limit, self.inline = database, limit, inline
        self._queue: deque[_Entry] = deque()
        self._news = threading.Condition()
        self._attempt = threading.Lock()
        self._connection: Connection | None = None
        self._closing = self._hasty = False
        #: Why nothing can be written now, empty if it can.
        self.problem = ""
        #: The last job that was dropped, and the number dropped so far.
        self.refused, self.refused_count = "", 0
        self._thread: threading.Thread | None = None
        if not inline:
            self._thread = threading.Thread(target=self._run, name="store writer", daemon=True)
            self._thread.start()

    @property
    def backlog(self) -> int:
        """Number of waiting jobs."""
        return len(self._queue)

    @property
    def crowded(self) -> str:
        """Why no more jobs are accepted; "" while there is room."""
        if len(self._queue) < self._limit:
            return ""
        return (
            f"store {self._database.name}: {len(self._queue)} records are waiting to be written, "
            f"and no more are accepted ({self.problem or 'the disk is too slow'}); check the disk"
        )

    def put(self, work: Work[Any]) -> None:
        """Queue a job, to be done as soon as possible.

        Raises
        ------
        StoreError
            If too many jobs are already waiting, or the writer is closed.
        """
        if crowded := self.crowded:
            raise StoreError(crowded)
        self._add(_Entry(work, None, kept=True))

    def do(self, work: Work[T], timeout: float = 5.0) -> T:
        """Do a job and return its result once it is safely on disk.

        Raises
        ------
        StoreError
            If the job could not be written now; the job is dropped. After a ``timeout``, s, it may
            still be written, so repeating the job must do no harm.
        """
        future = self.attempt(work)
        try:
            return future.result(timeout)
        except NotYetError:
            future.cancel()
            why = self.problem or f"it took longer than {timeout:g} s"
            raise StoreError(f"store {self._database.name}: not written: {why}") from None
        except CancelledError:
            raise StoreError(f"store {self._database.name}: it is closed") from None

    def attempt(self, work: Work[T]) -> "Future[T]":
        """Queue a job for the next attempt; return a future that is done when it is safely stored.

        The future fails with `StoreError` if that attempt fails; the job is then dropped.

        Raises
        ------
        StoreError
            If the writer is closed.
        """
        future: Future[T] = Future()
        self._add(_Entry(work, future, kept=False))
        return future

    def confirmed(self) -> "Future[None]":
        """Return a future that is done once all earlier jobs are stored, or fails if they fail."""
        return self.attempt(_nothing)

    def close(self, timeout: float = 10.0) -> None:
        """Write the waiting jobs, and close.

        Raises
        ------
        StoreError
            If a job could not be written.
        """
        with self._news:
            self._closing = True
            self._news.notify_all()
        if self._thread is not None:
            self._thread.join(timeout)
        elif self._queue:
            self._step()
        if self._thread is None or not self._thread.is_alive():
            self._drop_connection()
        if self._queue:
            raise StoreError(
                f"store {self._database.name}: {len(self._queue)} records are lost: they could "
                f"not be written ({self.problem or 'no time was left'})"
            )

    def _add(self, entry: _Entry) -> None:
        with self._news:
            if self._closing:
                raise StoreError(f"store {self._database.name}: it is closed")
            self._queue.append(entry)
            # A waiting caller does not wait for the end of a pause.
            self._hasty |= entry.future is not None
            self._news.notify_all()
        if self.inline:
            self._step()

    def _run(self) -> None:
        pause = _PAUSE[0]
        while True:
            with self._news:
                self._news.wait_for(lambda: self._queue or self._closing)
                if not self._queue:
                    return
                # No caller waits for it, so more jobs may join the same commit.
                self._news.wait_for(self._in_haste, _LINGER)
            self._hasty = False
            if self._step():
                pause = _PAUSE[0]
                continue
            with self._news:
                if self._closing:
                    return
                self._news.wait_for(lambda: self._hasty or self._closing, pause)
            pause = min(2.0 * pause, _PAUSE[1])

    def _in_haste(self) -> bool:
        return self._hasty or self._closing or len(self._queue) >= MOST

    def _step(self) -> bool:
        """Write everything in the queue; return False if the database failed."""
        with self._attempt:
            while self._queue:
                batch = [self._queue[i] for i in range(min(MOST, len(self._queue)))]
                if not self._write(batch):
                    return False
        return True

    def _write(self, batch: list[_Entry]) -> bool:
        entries = [e for e in batch if e.future is None or e.future.set_running_or_notify_cancel()]
        try:
            results = self._transact(entries)
        except Exception as error:  # noqa: BLE001 - whatever work does, the thread goes on
            if _is_of_database(error):
                self._fail(entries, error)
                return False
            if len(entries) > 1:
                return self._write_singly(batch, entries)
            self._remove(batch)
            self._refuse(entries[0], error)
        else:
            self._remove(batch)
            self.problem = ""
            self._deliver(entries, results)
        return True

    def _write_singly(self, batch: list[_Entry], entries: list[_Entry]) -> bool:
        """Find the job that was rejected; write the rest of its batch."""
        retried = {id(entry) for entry in entries}
        self._remove([entry for entry in batch if id(entry) not in retried])
        for count, entry in enumerate(entries):
            try:
                results = self._transact([entry])
            except Exception as error:  # noqa: BLE001 - whatever work does, the thread goes on
                if _is_of_database(error):
                    self._fail(entries[count:], error)
                    return False
                self._remove([entry])
                self._refuse(entry, error)
            else:
                self._remove([entry])
                self.problem = ""
                self._deliver([entry], results)
        return True

    def _transact(self, entries: list[_Entry]) -> list[Any]:
        try:
            if self._connection is None:
                self._connection = self._database.connect()
            with self._connection.begin():
                return [entry.work(self._connection) for entry in entries]
        except BaseException:
            # Whatever the cause, the next attempt begins with a fresh connection.
            self._drop_connection()
            raise

    def _drop_connection(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            try:
                connection.close()
            except SQLAlchemyError:
                connection.invalidate()

    def _remove(self, entries: list[_Entry]) -> None:
        """Remove finished jobs from the head of the queue."""
        with self._news:
            for entry in entries:
                if self._queue[0] is not entry:
                    raise AssertionError("the writer's queue is out of order")
                self._queue.popleft()

    def _deliver(self, entries: list[_Entry], results: list[Any]) -> None:
        for entry, result in zip(entries, results, strict=True):
            if entry.future is not None:
                entry.future.set_result(result)

    def _refuse(self, entry: _Entry, error: Exception) -> None:
        text = f"store {self._database.name}: a record was refused: {cause(error)}"
        if entry.future is not None:
            own = not isinstance(error, SQLAlchemyError)
            entry.future.set_exception(error if own else StoreError(text))
        else:
            self.refused, self.refused_count = text, self.refused_count + 1

    def _fail(self, entries: list[_Entry], error: Exception) -> None:
        """Notify waiting callers that their jobs are dropped; kept jobs stay queued, in order."""
        why = str(error) if isinstance(error, StoreError) else cause(error)
        self.problem = f"store {self._database.name}: cannot be written ({why}); check the disk"
        with self._news:
            dropped = {id(e) for e in entries if not e.kept}
            kept = [e for e in self._queue if id(e) not in dropped and not _cancelled(e)]
            self._queue.clear()
            self._queue.extend(kept)
        for entry in entries:
            if entry.future is not None:
                entry.future.set_exception(StoreError(self.problem))


def _is_of_database(error: Exception) -> bool:
    """Return whether the state of the database is at fault rather than the job."""
    if isinstance(error, StatementError) and not isinstance(error, DBAPIError):
        return False  # a value that cannot be written
    if isinstance(error, IntegrityError | DataError):
        return False
    return isinstance(error, SQLAlchemyError | StoreError | OSError)


def _nothing(_: Connection) -> None:
    return None


def _cancelled(entry: _Entry) -> bool:
    return entry.future is not None and entry.future.cancelled()
