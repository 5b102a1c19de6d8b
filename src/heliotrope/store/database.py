"""A database: SQLite in a folder, or PostgreSQL by URL; opened, locked and migrated.

Only one process at a time writes (the plant); others may read concurrently. SQLite runs in WAL
mode, and every commit is synced to disk. The single writing connection is also the only one that
checkpoints the log.
"""

import fcntl
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, NullPool, create_engine, event, inspect, text
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, SQLAlchemyError

from heliotrope.store.records import StoreError

#: Table revision that this program knows.
HEAD = "0013"
FILE = "store.sqlite"
#: Modes of a plant's folders and files: only for its user.
_PRIVATE_FOLDER, PRIVATE = 0o700, 0o600
#: Key of PostgreSQL's advisory lock; the second number identifies the schema.
_LOCK = 0x48454C49
#: Time limit for acquiring the lock, s.
_PATIENCE = 2
_LOCK_TIMEOUT = "55P03"


class Database:
    """A database.

    Parameters
    ----------
    place
        A folder (the database is ``store.sqlite`` in it), a file ``.sqlite``, or a URL
        ``postgresql://user@host/name``.

    Attributes
    ----------
    url
        URL of the database.
    file
        File of the SQLite database; None for PostgreSQL.

    Raises
    ------
    StoreError
        If the URL cannot be used.
    """

    def __init__(self, place: str | Path) -> None:
        self.url, self.file = _place(place)
        options: dict[str, Any] = {}
        if self.file is None:
            # A silent server is reported within seconds; the event loop never waits for it.
            options["connect_args"] = {"connect_timeout": 3, "tcp_user_timeout": 5000}
        self._reader = create_engine(
            self.url, pool_pre_ping=self.file is None, isolation_level=self._isolation(), **options
        )
        self._writer = create_engine(self.url, poolclass=NullPool, **options)
        if self.file is not None:
            _prepare(self._reader, "BEGIN", _READER)
            _prepare(self._writer, "BEGIN IMMEDIATE", _WRITER)
        else:
            _limit_waits(self._reader)
            _limit_waits(self._writer)
        self._lock: int | None = None
        self._spare: Connection | None = None
        self.locked = False

    def _isolation(self) -> Any:
        # Reads within one transaction must be consistent, as SQLite's always are.
        return "REPEATABLE READ" if self.file is None else "SERIALIZABLE"

    @property
    def name(self) -> str:
        """Name for messages: the file, or the URL without its password."""
        return str(self.file) if self.file is not None else self.url.render_as_string()

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """Yield a read-only connection with one consistent state.

        Raises
        ------
        StoreError
            If the database cannot be read.
        """
        try:
            with self._reader.connect() as connection, connection.begin():
                if self.file is None:
                    connection.execute(text("SET TRANSACTION READ ONLY"))
                yield connection
        except SQLAlchemyError as error:
            raise StoreError(f"store {self.name}: cannot be read ({cause(error)})") from None

    def connect(self) -> Connection:
        """Return a connection for writing.

        On PostgreSQL, the connection acquires the lock if this object holds the lock.

        Raises
        ------
        StoreError
            If another process holds the lock.
        """
        spare, self._spare = self._spare, None
        if spare is not None:
            return spare
        connection = self._writer.connect()
        if self.file is None and self.locked:
            self._lock_server(connection)
        return connection

    def lock(self) -> None:
        """Become the only process that writes.

        Raises
        ------
        StoreError
            If another process is already writing, or the folder cannot be written to.
        """
        if self.file is None:
            self.locked = True
            try:
                # The server's lock lasts as long as the connection that acquired it.
                self._spare = self.connect()
            except SQLAlchemyError as error:
                self.locked = False
                raise StoreError(f"store {self.name}: {cause(error)}") from None
            except StoreError:
                self.locked = False
                raise
            return
        path = self.file.with_name(self.file.name + ".lock")
        try:
            self._lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, PRIVATE)
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.close()
            raise StoreError(
                f"store {self.file}: another process writes to it; only one plant may run, and "
                "restore and migrate need it stopped"
            ) from None
        except OSError as error:
            raise StoreError(
                f"store {self.file}: {error.strerror}; choose a writable folder"
            ) from None
        self.locked = True

    def _lock_server(self, connection: Connection) -> None:
        """Acquire the server's lock, which an earlier connection may still hold for a moment."""
        key = {"key": _LOCK}
        try:
            with connection.begin():
                connection.execute(text(f"SET LOCAL lock_timeout = {1000 * _PATIENCE}"))
                lock = "SELECT pg_advisory_lock(:key, hashtext(current_schema()))"
                connection.execute(text(lock), key)
        except DBAPIError as error:
            connection.close()
            if getattr(error.orig, "sqlstate", "") != _LOCK_TIMEOUT:
                raise
            raise StoreError(
                f"store {self.name}: another process writes to it; only one plant may run"
            ) from None

    def revision(self) -> str:
        """Return the revision of the tables; empty if there are no tables.

        Raises
        ------
        StoreError
            If the database cannot be read.
        """
        if self.file is not None and not self.file.exists():
            return ""
        with self.reading() as connection:
            if not inspect(connection).has_table("alembic_version"):
                return ""
            return str(connection.scalar(text("SELECT version_num FROM alembic_version")) or "")

    def require(self) -> None:
        """Check that the tables exist and have the revision of this program.

        Raises
        ------
        StoreError
            If the tables do not exist, or have a different revision.
        """
        revision = self.revision()
        if not revision:
            raise StoreError(
                f"store {self.name}: there is no store here; `heliotrope run` creates one"
            )
        if revision != HEAD:
            raise StoreError(
                f"store {self.name}: its tables have revision {revision}, this program needs "
                f"{HEAD}; "
                + ("run `heliotrope store migrate`" if revision < HEAD else "update the program")
            )

    def prepare(self) -> None:
        """Create the tables of a new store; refuse a store with a different revision.

        Raises
        ------
        StoreError
            If the store has a different revision, or cannot be created.
        """
        if not self.revision():
            self.migrate()
        self.require()

    def migrate(self) -> None:
        """Bring the tables up to date, completely or not at all.

        Raises
        ------
        StoreError
            If migration fails; the store is then unchanged.
        """
        from alembic import command
        from alembic.config import Config
        from alembic.util import CommandError

        config = Config()
        folder = str(Path(__file__).with_name("migrations"))
        config.set_main_option("script_location", folder.replace("%", "%%"))
        try:
            if self.file is not None:
                # It holds password hashes, so only its owner may read it; its log gets the same
                # permissions.
                os.close(os.open(self.file, os.O_RDWR | os.O_CREAT, PRIVATE))
            with self._writer.connect() as connection:
                config.attributes["connection"] = connection
                with connection.begin():
                    command.upgrade(config, "head")
        except OSError as error:
            raise StoreError(f"store {self.name}: {error.strerror}") from None
        except (SQLAlchemyError, CommandError) as error:
            raise StoreError(f"store {self.name}: cannot be set up ({cause(error)})") from None

    def __enter__(self) -> "Database":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close connections and release the lock."""
        if self._spare is not None:
            self._spare.close()
            self._spare = None
        self._reader.dispose()
        self._writer.dispose()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
        self.locked = False


#: Longest wait for a lock that another program holds, ms.
_WAIT_MS = 5000
_READER = (f"PRAGMA busy_timeout={_WAIT_MS}", "PRAGMA wal_autocheckpoint=0", "PRAGMA query_only=ON")
_WRITER = (
    f"PRAGMA busy_timeout={_WAIT_MS}",
    "PRAGMA journal_mode=WAL",
    "PRAGMA synchronous=FULL",
    "PRAGMA foreign_keys=ON",
)


def _prepare(engine: Engine, begin: str, pragmas: tuple[str, ...]) -> None:
    """Let SQLAlchemy's transactions control SQLite's, and set up each connection."""

    @event.listens_for(engine, "connect")
    def connected(connection: Any, _: object) -> None:
        connection.isolation_level = None  # stop the driver from beginning transactions by itself
        for pragma in pragmas:
            connection.execute(pragma)

    @event.listens_for(engine, "begin")
    def began(connection: Connection) -> None:
        connection.exec_driver_sql(begin)


def _limit_waits(engine: Engine) -> None:
    """Let no statement wait for a locked table without end; each takes a thread meanwhile."""

    @event.listens_for(engine, "connect")
    def connected(connection: Any, _: object) -> None:
        connection.execute(f"SET lock_timeout = {_WAIT_MS}")
        connection.commit()


def _place(place: str | Path) -> tuple[URL, Path | None]:
    if isinstance(place, str) and "://" in place:
        try:
            url = make_url(place)
        except ArgumentError:
            raise StoreError(
                "store: the URL cannot be read; write postgresql://user@host/name"
            ) from None
        if url.get_backend_name() != "postgresql":
            raise StoreError(
                f"store: a URL of {url.get_backend_name()} cannot be used; specify a folder for "
                "SQLite, or a URL postgresql://user@host/name"
            )
        return url.set(drivername="postgresql+psycopg"), None
    file = Path(place)
    if file.suffix != ".sqlite":
        file = file / FILE
    return URL.create("sqlite", database=str(file)), file


def cause(error: Exception) -> str:
    """Return in one line why a database refused an operation."""
    inner = error.orig if isinstance(error, DBAPIError) and error.orig is not None else error
    lines = str(inner).strip().splitlines()
    return lines[0] if lines else type(inner).__name__


def make_private(folder: Path) -> None:
    """Create a folder and its missing parents, so that only this user may enter them."""
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    for place in reversed(missing):
        place.mkdir(mode=_PRIVATE_FOLDER, exist_ok=True)
    folder.mkdir(exist_ok=True)


#: Files and folders that a plant creates in its data folder, beside the store.
MADE = ("telemetry", "targets", "marks", "photographs", "interface", "first-password")


def tighten(folder: Path) -> None:
    """Revoke other users' access to a data folder of an earlier program, and to its content.

    Files that a plant did not create are not changed, nor is a folder that is shared by design.
    """
    status = folder.stat()
    if status.st_mode & stat.S_ISVTX or status.st_uid != os.geteuid():
        return
    folder.chmod(_PRIVATE_FOLDER)
    made = [*folder.glob(f"{FILE}*"), *(folder / name for name in MADE)]
    made = [path for path in made if not path.is_symlink()]
    inside = [path for top in made if top.is_dir() for path in top.rglob("*")]
    for path in [*made, *inside]:
        if path.is_symlink() or not path.exists() or path.is_socket():
            continue
        path.chmod(_PRIVATE_FOLDER if path.is_dir() else PRIVATE)
