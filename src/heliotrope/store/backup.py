"""Backup and restore: one consistent snapshot of everything, taken while the plant runs.

A backup is a folder: ``store.sqlite`` (also for a store in PostgreSQL, so that each kind can be
restored into the other), the telemetry if requested, and ``manifest.json`` with the checksum of
every file; ``manifest.sig`` is the signature of the manifest, if a key was specified. A backup is
written completely or not at all. A restore needs an empty destination and never overwrites
anything.

The store in a backup is marked as a backup, however it reaches a plant: it contains a lock on the
tower, and none of its assigned points counts as confirmed. Locks and assignments made after the
backup are missing from it, so an operator confirms both before a heliostat leaves stow. Nobody can
sign in with the backup either: it contains no session and no token, and the second-factor codes
shown up to that time are marked as used. A restore repeats this for the time of the restore, and is
recorded in the store.
"""

import hashlib
import json
import math
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, delete, func, select
from sqlalchemy.exc import SQLAlchemyError

from heliotrope import __version__
from heliotrope.errors import FormatError
from heliotrope.safety import Severity
from heliotrope.store import _rows as rows
from heliotrope.store import audit, chain, tables
from heliotrope.store.database import FILE, HEAD, PRIVATE, Database, cause, make_private
from heliotrope.store.factors import NEAR, STEP
from heliotrope.store.records import Event, Kind, Lockout, StoreError
from heliotrope.store.signing import PublicKey, SigningKey

MANIFEST, SIGNATURE = "manifest.json", "manifest.sig"
TELEMETRY = "telemetry"
#: Owner of the lock on the tower that a backup holds; see `plant.field.lockouts`.
OWNER = "restored backup"
_ROWS = 5000


@dataclass(frozen=True)
class Backup:
    """A backup: folder, revision of the tables, time, size in bytes."""

    folder: Path
    revision: str
    made: str
    size: int


def backup(
    database: Database,
    folder: str | Path,
    now: datetime,
    telemetry: str | Path | None = None,
    *,
    key: SigningKey | None = None,
) -> Backup:
    """Make a backup.

    Parameters
    ----------
    database
        Database to back up; it may be written to in the meantime.
    folder
        Folder to create; it must not exist.
    now
        Time for the manifest.
    telemetry
        Folder of the archive to include.
    key
        Key that signs the backup; None: the backup is not signed.

    Raises
    ------
    StoreError
        If there is no store, or the backup cannot be made.
    """
    final = Path(folder)
    database.require()
    if final.exists():
        raise StoreError(f"backup {final}: this folder already exists; choose a new one")
    beside = final.with_name(f".{final.name}.{os.getpid()}.part")
    try:
        make_private(beside.parent)
        beside.mkdir(mode=0o700)
        if database.file is not None:
            _copy_file(database.file, beside / FILE)
        else:
            _copy_tables(database, Database(beside / FILE))
        with Database(beside / FILE) as copy, _changing(copy) as connection:
            _lock(connection, now)
            _end_access(connection, now)
        _close_log(beside / FILE)
        if telemetry is not None:
            _copy_telemetry(Path(telemetry), beside / TELEMETRY)
        files = {str(p.relative_to(beside)): checksum(p) for p in _files(beside)}
        size = sum(p.stat().st_size for p in _files(beside))
        manifest = {
            "heliotrope": __version__,
            "revision": HEAD,
            "made": now.isoformat(),
            "files": files,
        }
        text = json.dumps(manifest, indent=1).encode()
        (beside / MANIFEST).write_bytes(text)
        if key is not None:
            (beside / SIGNATURE).write_bytes(key.sign(text))
        for path in _files(beside):
            path.chmod(PRIVATE)
            _sync(path)
        beside.rename(final)
        _sync(final.parent)
    except (OSError, sqlite3.Error) as error:
        why = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise StoreError(f"backup {final}: it cannot be made ({why})") from None
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    return Backup(final, HEAD, now.isoformat(), size)


def check(folder: str | Path, *, signed_by: PublicKey | None = None) -> Backup:
    """Return a backup after checking every file's checksum, and the signature.

    Parameters
    ----------
    folder
        Folder of the backup.
    signed_by
        The key that must have signed the backup; None: the backup may be unsigned.

    Raises
    ------
    FormatError
        If the folder is not a backup, the backup is not signed by that key, or a file is missing,
        altered or added.
    """
    place = Path(folder)
    path = place / MANIFEST
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FormatError(path, f"{error.strerror}; specify the folder of a backup") from None
    if signed_by is not None:
        _check_signature(place, data, signed_by)
    try:
        manifest: Any = json.loads(data)
        files, revision, made = manifest["files"], manifest["revision"], manifest["made"]
        checksums = dict(files.items())
    except (ValueError, KeyError, TypeError, AttributeError):
        raise FormatError(path, "this is not the manifest of a backup") from None
    if FILE not in checksums:
        raise FormatError(path, f"{FILE} is not in it; this is not the manifest of a backup")
    size = 0
    for name, sum_ in checksums.items():
        file = place / name
        if ".." in Path(name).parts or Path(name).is_absolute():
            raise FormatError(path, f"the file {name!r} lies outside the backup")
        if not file.is_file():
            raise FormatError(file, "the file is missing; use another backup")
        if checksum(file) != sum_:
            raise FormatError(file, "its checksum differs; use another backup")
        size += file.stat().st_size
    for link in place.rglob("*"):
        if link.is_symlink():
            # Its content is stored elsewhere, so no checksum vouches for it.
            raise FormatError(link, "this is a link, and backups contain no links; remove it")
    for file in _files(place):
        if str(file.relative_to(place)) not in {*checksums, MANIFEST, SIGNATURE}:
            raise FormatError(
                file, "the manifest does not name it; remove it, or use another backup"
            )
    return Backup(place, revision, made, size)


def _check_signature(place: Path, manifest: bytes, key: PublicKey) -> None:
    path = place / SIGNATURE
    if not path.is_file():
        raise FormatError(path, "it is not signed; use a signed backup")
    if not key.signed(manifest, path.read_bytes()):
        raise FormatError(
            path, f"its signature was not made with the key {key.path}, or the manifest was altered"
        )


def restore(
    folder: str | Path,
    place: str | Path,
    now: datetime,
    telemetry: str | Path | None = None,
    *,
    signed_by: PublicKey | None = None,
    who: str = "",
) -> Backup:
    """Restore a backup into an empty place; a backup of an earlier program is migrated.

    Afterwards nobody is signed in, no token is valid, and an event records who restored what.

    Parameters
    ----------
    folder
        Folder of the backup.
    place
        As in `Database`; there must be no store yet.
    now
        Time of the restore.
    telemetry
        Destination of the backup's telemetry, if there is any; None: the telemetry is not restored.
    signed_by
        As in `check`.
    who
        Person who restores the backup, for the event.

    Raises
    ------
    FormatError
        If the backup is damaged, or not signed by that key.
    StoreError
        If there is already a store, another process has it open, it cannot be written, or the
        backup was made by a later program.
    """
    restored = check(folder, signed_by=signed_by)
    if restored.revision > HEAD:
        raise StoreError(
            f"backup {restored.folder}: its tables have revision {restored.revision}, this program "
            f"knows {HEAD}; update the program"
        )
    database = Database(place)
    try:
        if database.file is not None:
            make_private(database.file.parent)
        database.lock()
        if database.revision():
            raise StoreError(
                f"store {database.name}: it already exists; choose a new location, or move the "
                "existing store away"
            )
        if telemetry is not None and (restored.folder / TELEMETRY).is_dir():
            if Path(telemetry).exists() and any(Path(telemetry).iterdir()):
                raise StoreError(f"telemetry {telemetry}: it is not empty; move it away")
            shutil.copytree(restored.folder / TELEMETRY, telemetry, dirs_exist_ok=True)
        with tempfile.TemporaryDirectory(
            prefix=".restoring-", dir=None if database.file is None else database.file.parent
        ) as beside:
            copy = Path(beside) / FILE
            shutil.copyfile(restored.folder / FILE, copy)
            _begin_anew(copy, now, restored, who)
            if database.file is None:
                _copy_tables(Database(copy), database)
            else:
                copy.chmod(PRIVATE)
                _sync(copy)
                copy.rename(database.file)
                _sync(database.file.parent)
    except OSError as error:
        raise StoreError(f"store {database.name}: {error.strerror}") from None
    finally:
        database.close()
    return restored


def _begin_anew(copy: Path, now: datetime, restored: Backup, who: str) -> None:
    """Revoke all access to a restored store, and record who restored it."""
    at = now.timestamp()
    with Database(copy) as database:
        if restored.revision < HEAD:
            database.migrate()
        with _changing(database) as connection:
            _end_access(connection, now)
            account = tables.account.c
            enabled = select(account.name).where(~account.disabled).order_by(account.name)
            names = ", ".join(connection.scalars(enabled)) or "none"
            text = (
                f"{who or 'somebody'}: restored the backup of {restored.made}: all sessions and "
                f"tokens ended, accounts and roles are as they were then; enabled: {names}"
            )
            number = (connection.scalar(select(func.max(tables.event.c.number))) or 0) + 1
            event = Event(at, "security", text, Severity.WARNING)
            chain.add_event(connection, rows.row_of(tables.event, event, number=number))
    _close_log(copy)


def summary(database: Database) -> dict[str, Any]:
    """Return a store's revision, the number of rows in each table, and its first and last times.

    Raises
    ------
    StoreError
        If there is no store, or it cannot be read.
    """
    revision = database.revision()
    if not revision:
        database.require()
    figures: dict[str, Any] = {"store": database.name, "revision": revision, "rows": {}}
    if revision != HEAD:
        return figures
    with database.reading() as connection:
        for table in tables.metadata.sorted_tables:
            count = connection.scalar(select(func.count()).select_from(table))
            figures["rows"][table.name] = int(count or 0)
        time = tables.sighting.c.time
        first, last = connection.execute(select(func.min(time), func.max(time))).one()
        open_ = select(func.count()).where(tables.audit.c.result == "")
        figures["audit_without_result"] = int(connection.scalar(open_) or 0)
    # A missing time is NULL, which the column's type reads as NaN.
    times = {"first_sighting": first, "last_sighting": last}
    figures.update({name: None if math.isnan(at) else at for name, at in times.items()})
    if database.file is not None:
        figures["bytes"] = database.file.stat().st_size
    return figures


def migrate(place: str | Path) -> tuple[str, Path | None]:
    """Bring a store up to date; return its old revision, and the copy made beforehand.

    A file is first copied to ``store.before-REVISION.sqlite`` beside it; PostgreSQL changes its
    tables in one transaction.

    Raises
    ------
    StoreError
        If there is no store, another process has it open, it is newer than the program, or the
        migration fails.
    """
    with Database(place) as database:
        revision = database.revision()
        if not revision or revision > HEAD:
            database.require()
        if revision == HEAD:
            return revision, None
        copy = None
        database.lock()
        try:
            if database.file is not None:
                copy = database.file.with_name(f"{database.file.stem}.before-{revision}.sqlite")
                if not copy.exists():
                    _copy_file(database.file, copy)
                    _sync(copy)
            database.migrate()
        except (OSError, sqlite3.Error) as error:
            raise StoreError(f"store {database.name}: cannot be copied ({error})") from None
        return revision, copy


def checksum(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _files(folder: Path) -> Iterator[Path]:
    return (p for p in sorted(folder.rglob("*")) if p.is_file())


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _copy_file(source: Path, target: Path) -> None:
    """Copy an SQLite database in one step, so that the copy is consistent even during writes."""
    with (
        closing(sqlite3.connect(f"file:{source}?mode=ro", uri=True, timeout=10.0)) as old,
        closing(sqlite3.connect(target)) as new,
    ):
        old.backup(new)
    target.chmod(PRIVATE)
    _close_log(target)
    with closing(sqlite3.connect(target)) as new:
        (state,) = new.execute("PRAGMA quick_check(1)").fetchone()
    if state != "ok":
        raise StoreError(f"store {source}: it is damaged ({state}); restore a backup")


@contextmanager
def _changing(copy: Database) -> Iterator[Connection]:
    """Yield a connection with which to change a copy in one transaction."""
    try:
        with copy.connect() as connection, connection.begin():
            yield connection
    except SQLAlchemyError as error:
        raise StoreError(f"store {copy.name}: cannot be written ({cause(error)})") from None


def _end_access(connection: Connection, now: datetime) -> None:
    """End all sessions and tokens; mark second-factor codes shown until a given time as used."""
    factor, last = tables.second_factor, int(now.timestamp() // STEP) + NEAR
    with chain.changing_accounts(connection, None):
        for table in (tables.session, tables.api_token):
            connection.execute(delete(table))
        connection.execute(factor.update().where(factor.c.used < last).values(used=last))


def _lock(connection: Connection, now: datetime) -> None:
    """Lock the tower in a backup made at a given time, and mark its points as unconfirmed."""
    hold = Lockout(
        Kind.TOWER,
        "tower",
        OWNER,
        f"this store is a backup of {now:%d %b %Y %H:%M} UTC: locks taken, points assigned and "
        "accounts disabled since then are not in it",
        now.timestamp(),
    )
    own = (tables.hold.c.who == OWNER) & tables.hold.c.ended.is_(None)
    connection.execute(delete(tables.hold).where(own))
    number = connection.scalar(select(func.max(tables.hold.c.number))) or 0
    row = rows.row_of(tables.hold, hold, number=number + 1, ended=None, ended_by="")
    rows.insert(connection, tables.hold, [row])
    audit.doubt_points(connection)


def _close_log(file: Path) -> None:
    """Merge a database and its log into one file."""
    with closing(sqlite3.connect(file)) as connection:
        connection.execute("PRAGMA journal_mode=DELETE")


def _copy_tables(source: Database, target: Database) -> None:
    """Copy all rows from one store to a new one, in one transaction."""
    source.require()
    try:
        target.migrate()
        with source.reading() as old, target.connect() as new, new.begin():
            for table in tables.metadata.sorted_tables:
                for rows in _parts(old, table):
                    new.execute(table.insert(), rows)
    except SQLAlchemyError as error:
        raise StoreError(f"store {target.name}: cannot be written ({cause(error)})") from None
    finally:
        if source.file is not None:
            source.close()
        else:
            target.close()


def _parts(connection: Connection, table: Any) -> Iterator[list[dict[str, Any]]]:
    mappings = connection.execute(select(table).execution_options(yield_per=_ROWS)).mappings()
    for part in mappings.partitions():
        yield [{c.key: row[c] for c in table.columns} for row in part]


def _copy_telemetry(source: Path, target: Path) -> None:
    """Copy an archive, whose parts may become Parquet files in the meantime."""
    target.mkdir(mode=0o700)
    for _ in range(2):
        for path in sorted(source.glob("????-??-??/*.*")):
            if path.is_symlink() or path.parent.is_symlink():
                continue  # the archive has none
            copy = target / path.parent.name / path.name
            if path.suffix in (".parquet", ".part") and not copy.exists():
                copy.parent.mkdir(mode=0o700, exist_ok=True)
                try:
                    shutil.copyfile(path, copy)
                except FileNotFoundError:
                    # It has become a Parquet file, which the second round copies.
                    copy.unlink(missing_ok=True)
