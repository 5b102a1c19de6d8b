"""The audit log: exactly one record per accepted command: who, what, when, and the result.

A record is begun before its command is sent; if the record cannot be begun, the command is not
sent. DEFOCUS and STOW never wait: they are sent first, and their records are retried until they are
written. `Audit` is the protocol of a store, and `JsonLines` is a store in one file. Both wait for
their disk; `disk.Disk` keeps these waits out of the event loop.

The file contains two lines per record, "accepted" and "result", both appended and synced to disk.
`read` combines them. A line left incomplete by a power failure is skipped and counted; a record
without a result is completed at the next start.

::

    HeliotropeError
    └── AuditError            a record that could not be written
"""

import fcntl
import hashlib
import json
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Protocol

from heliotrope.errors import FormatError, HeliotropeError, InputError
from heliotrope.store.digests import AUDIT, GENESIS, Head, digest_of

#: Free disk space below which the disk counts as full, so that no record is truncated, bytes.
LEAST_FREE = 1 << 20
#: Result of a record that was open when the plant stopped.
STOPPED = "unknown, because the plant stopped before the result arrived"


class AuditError(HeliotropeError):
    """A record could not be written."""


@dataclass(frozen=True)
class Record:
    """One accepted command.

    Attributes
    ----------
    identity
        Unique for all time.
    who, role
        The person, or the part of the plant, that gave the command.
    what, values
        Name of the command, and its values; if groups of heliostats have different values, ``note``
        lists them.
    heliostats
        Names of the heliostats; () for all heliostats.
    at
        Time of acceptance, UTC, ISO 8601.
    note
        Reason or details.
    result, finished
        The result, and the time of the result; both "" until there is a result.
    """

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


class Audit(Protocol):
    """A store of records."""

    def begin(self, record: Record) -> None:
        """Write a record without a result; it is on disk when this returns."""
        ...

    def finish(self, identity: str, result: str, at: str) -> None:
        """Add the result to a record that was begun."""
        ...

    def confirm(self) -> None:
        """Check that a record could be written now."""
        ...

    def close(self) -> None:
        """Close the store."""
        ...


class Forgetful:
    """An audit log that stores nothing, for plants that are only inspected."""

    def begin(self, record: Record) -> None:
        """Accept a record."""

    def finish(self, identity: str, result: str, at: str) -> None:
        """Accept a result."""

    def confirm(self) -> None:
        """Do nothing, because nothing can fail."""

    def close(self) -> None:
        """Do nothing, because nothing is open."""


class JsonLines:
    """An audit in a single append-only file, line by line.

    The lines form a hash chain: each line has a digest of its content and of the previous line; see
    `verify`. Lines from earlier programs have no digest; the first digest covers all such lines.

    Parameters
    ----------
    path
        The file, created if it does not exist. Only one process at a time may open it.
    started
        Start time, UTC, written to records that are completed only now because the plant had
        stopped.

    Raises
    ------
    AuditError
        If the file cannot be opened, or another process has it open.
    FormatError
        If its records contradict each other.
    """

    def __init__(self, path: str | Path, started: datetime) -> None:
        self.path = Path(path)
        try:
            self._file = os.open(self.path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o600)
        except OSError as error:
            raise AuditError(
                f"audit {self.path}: {error.strerror}; specify a writable file"
            ) from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            records, torn = read(self.path)
        except BlockingIOError:
            os.close(self._file)
            raise AuditError(
                f"audit {self.path}: another process is writing to it; only one plant may run at a "
                f"time"
            ) from None
        except BaseException:
            os.close(self._file)
            raise
        self._open = {record.identity for record in records if not record.result}
        self._known = {record.identity for record in records}
        #: Number of lines torn by a power failure. If the last line is incomplete, the next one
        #: must not continue it.
        self.torn = torn
        self._torn = not _ends_with_newline(self._file)
        #: Digest of the last line; None: it must be read from the file.
        self._digest: str | None = None
        for identity in sorted(self._open):
            self.finish(identity, STOPPED, started.isoformat())

    def begin(self, record: Record) -> None:
        """Write a record without a result.

        Raises
        ------
        AuditError
            If it could not be written and synced.
        InputError
            If another record has the same identity.
        """
        if record.identity in self._known:
            raise InputError(
                f"audit: record {record.identity} already exists; each identity must be unique"
            )
        fields = asdict(record)
        del fields["result"], fields["finished"]
        self._append({"event": "accepted", **fields})
        self._known.add(record.identity)
        self._open.add(record.identity)

    def finish(self, identity: str, result: str, at: str) -> None:
        """Add the result to a record.

        Raises
        ------
        AuditError
            If it could not be written and synced.
        InputError
            If the record was not begun, or has a result.
        """
        if identity not in self._open:
            raise InputError(f"audit: no record {identity} is waiting for a result")
        line = {"event": "result", "identity": identity, "result": result, "finished": at}
        self._append(line)
        self._open.discard(identity)

    def confirm(self) -> None:
        """Check that a record could be written now: the disk syncs and has space.

        Raises
        ------
        AuditError
            If a record could not be written.
        """
        try:
            os.fsync(self._file)
            disk = os.fstatvfs(self._file)
        except OSError as error:
            raise AuditError(f"audit {self.path}: {error.strerror}") from None
        if disk.f_bavail * disk.f_frsize < LEAST_FREE:
            raise AuditError(
                f"audit {self.path}: {disk.f_bavail * disk.f_frsize} bytes are left on its disk, "
                f"the minimum is {LEAST_FREE}; free some space"
            )

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)

    def _append(self, fields: dict[str, Any]) -> None:
        if self._digest is None:
            self._digest = _last_digest(self.path.read_bytes())
        digest = digest_of(self._digest, [fields])
        # The line may have been written although its sync failed; then the file shows which line is
        # last.
        self._digest = None
        fields = {**fields, "digest": digest}
        line = json.dumps(fields, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
        data = (b"\n" if self._torn else b"") + line.encode() + b"\n"
        try:
            # A single write, so that O_APPEND appends it as a whole.
            written = os.write(self._file, data)
            os.fsync(self._file)
        except OSError as error:
            self._torn = True
            raise AuditError(f"audit {self.path}: {error.strerror}; check the disk") from None
        self._torn = written != len(data)
        if self._torn:
            raise AuditError(f"audit {self.path}: only {written} of {len(data)} bytes written")
        self._digest = digest


def _ends_with_newline(file: int) -> bool:
    size = os.fstat(file).st_size
    return size == 0 or os.pread(file, 1, size - 1) == b"\n"


def read(path: str | Path) -> tuple[list[Record], int]:
    """Return the records of a file in the order of acceptance, and the number of torn lines.

    Raises
    ------
    FormatError
        If an identity has two beginnings or two results, or a result without a beginning.
    """
    records: dict[str, Record] = {}
    torn = 0
    data = Path(path).read_bytes()
    for number, line in enumerate(data.split(b"\n"), 1):
        if not line:
            continue
        try:
            fields = json.loads(line)
            event, identity = fields.pop("event"), fields["identity"]
            fields.pop("digest", None)
        except (ValueError, KeyError, AttributeError, TypeError):
            torn += 1
            continue
        known = records.get(identity)
        if (known is not None) == (event == "accepted") or (known is not None and known.result):
            # A line may have been written although its sync failed.
            if known is not None and _repeats(known, event, fields):
                continue
            raise FormatError(
                path,
                f"{event!r} of record {identity} contradicts the lines before it",
                f"line {number}",
            )
        if known is None:
            fields["values"] = tuple(fields.get("values", ()))
            fields["heliostats"] = tuple(fields.get("heliostats", ()))
            try:
                records[identity] = Record(**fields)
            except TypeError as error:
                raise FormatError(path, f"no record: {error}", f"line {number}") from None
        else:
            records[identity] = replace(known, result=fields["result"], finished=fields["finished"])
    return list(records.values()), torn


def _repeats(known: Record, event: str, fields: dict[str, Any]) -> bool:
    """Whether a line repeats a record that is already known."""
    if event == "result":
        return bool(known.result == fields["result"])
    names = ("who", "what", "at")
    return all(str(getattr(known, name)) == fields.get(name) for name in names)


# -- the chain -----------------------------------------------------------------------------


def _fields(line: bytes) -> dict[str, Any] | None:
    """Return the fields of a line; None if a power failure left the line incomplete."""
    try:
        found = json.loads(line)
    except ValueError:
        return None
    return found if isinstance(found, dict) else None


def _before(data: bytes) -> str:
    """Return the digest before the first digest in the file.

    The returned digest covers all lines that have none.
    """
    older = data.rstrip(b"\n")
    return hashlib.sha256(older).hexdigest() if older else GENESIS


def _last_digest(data: bytes) -> str:
    """Return the digest of the last complete line with a digest, even if the chain is broken."""
    for line in reversed(data.split(b"\n")):
        fields = _fields(line)
        if fields is not None and isinstance(fields.get("digest"), str):
            return str(fields["digest"])
    return _before(data)


def verify(path: str | Path, known: Iterable[Head] = ()) -> Head:
    """Check the hash chain of an audit file; return its head.

    Known heads of the chain must be in it.

    Raises
    ------
    FormatError
        If a line does not fit the chain, or a head is not in the chain; the text names the first
        such line or head.
    """
    data, place = Path(path).read_bytes(), 0
    digests: list[str] = []
    last = GENESIS
    for number, line in enumerate(data.split(b"\n"), 1):
        fields = _fields(line)
        digest = None if fields is None else fields.pop("digest", None)
        if digest is None:
            if digests and fields is not None:
                raise FormatError(
                    path, "it has no digest, so it was altered or added", f"line {number}"
                )
        else:
            if not digests:
                last = _before(data[:place])
            last = digest_of(last, [fields])
            if last != digest:
                who = (fields or {}).get("identity", "")
                raise FormatError(
                    path,
                    f"record {who} does not match the hash chain; this record or an earlier one "
                    f"was altered",
                    f"line {number}",
                )
            digests.append(last)
        place += len(line) + 1
    for head in known:
        if head.chain != AUDIT or (head.number and digests[head.number - 1 :][:1] != [head.digest]):
            raise FormatError(path, f"head {head} is missing, so records were removed or rewritten")
    return Head(AUDIT, len(digests), last)
