"""People: accounts with their roles, sessions that expire, tokens for programs.

Passwords are hashed by whoever asks for them (argon2); here only the hash is kept. Of the secrets
of sessions and tokens, which are made here from 32 random bytes, only their SHA-256 is kept: who
reads the database cannot use them. Times are POSIX seconds and always arguments.
"""

import hashlib
import secrets
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field

from sqlalchemy import ColumnElement, Connection, Table, select

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.store import tables
from heliotrope.store.database import Database
from heliotrope.store.records import StoreError
from heliotrope.store.writer import Writer

_ACCOUNT, _SESSION, _TOKEN = tables.account, tables.session, tables.api_token
ROLES = ("viewer", "operator", "engineer")


@dataclass(frozen=True)
class Account:
    """A person.

    Attributes
    ----------
    name
        Unique; case counts.
    role
        One of `ROLES`.
    password_hash
        As it was given; never shown.
    disabled
        Whether the person is kept out.
    created, changed
        When.
    """

    name: str
    role: str
    password_hash: str = field(repr=False)
    disabled: bool
    created: float
    changed: float


@dataclass(frozen=True)
class Session:
    """A person who is logged in: name and present role, since and until when.

    ``key`` names the session without giving its secret away: for a list of sessions.
    """

    key: str
    name: str
    role: str
    since: float
    expires: float
    note: str = ""


@dataclass(frozen=True)
class ApiToken:
    """A program that acts for a person.

    Attributes
    ----------
    key
        Names it without giving its secret away.
    name
        Of the account that it belongs to.
    label
        What it is for.
    role
        What it may do: at most what its account may do now.
    created, expires, last_used
        When; None for never.
    """

    key: str
    name: str
    label: str
    role: str
    created: float
    expires: float | None
    last_used: float | None


#: What only its SHA-256 is kept of: random bytes.
_SECRET = 32
#: The last use of a token is noted no more often than this, s.
_NOTED = 60.0


class People:
    """Accounts, sessions and tokens in a database.

    What is read and written here is small; a call takes below a millisecond to read and a commit
    to write. All methods may be called from any thread.

    Parameters
    ----------
    database, writer
        Of the keeper.
    entropy
        Gives random bytes.
    """

    def __init__(
        self,
        database: Database,
        writer: Writer,
        entropy: Callable[[int], bytes] = secrets.token_bytes,
    ) -> None:
        self._database, self._writer, self._entropy = database, writer, entropy
        self._noted: dict[str, float] = {}

    @property
    def near(self) -> bool:
        """Whether the database is a file of this machine, and no server that may be slow."""
        return self._database.file is not None

    # -- accounts ------------------------------------------------------------------------

    def empty(self) -> bool:
        """Whether there is no account yet: the first start."""
        return not self.accounts()

    def accounts(self) -> tuple[Account, ...]:
        """Return all accounts by name."""
        with self._database.reading() as connection:
            found = connection.execute(select(_ACCOUNT).order_by(_ACCOUNT.c.name)).mappings()
            return tuple(Account(**row) for row in found)

    def account(self, name: str) -> Account | None:
        """Return an account, None if there is none of that name."""
        with self._database.reading() as connection:
            row = connection.execute(select(_ACCOUNT).where(_ACCOUNT.c.name == name))
            found = row.mappings().first()
        return None if found is None else Account(**found)

    def add(self, name: str, password_hash: str, role: str, now: float) -> Account:
        """Make an account.

        Raises
        ------
        InputError
            A name that exists, is empty or too long; an empty hash.
        UnknownNameError
            If there is no such role.
        StoreError
            If it could not be written.
        """
        _check_role(role)
        if not name.strip() or len(name) > 100 or not name.isprintable():
            raise InputError(f"account {name!r}: give a name of 1 to 100 printable characters")
        if not password_hash:
            raise InputError(f"account {name}: without a hash of its password nobody can log in")
        made = Account(name, role, password_hash, disabled=False, created=now, changed=now)

        def work(connection: Connection) -> None:
            if _find(connection, name) is not None:
                raise InputError(f"account {name}: it exists; change it, or give another name")
            connection.execute(_ACCOUNT.insert().values(asdict(made)))

        self._writer.do(work)
        return made

    def change(
        self,
        name: str,
        now: float,
        *,
        password_hash: str | None = None,
        role: str | None = None,
        disabled: bool | None = None,
    ) -> Account:
        """Change an account. A new password, and disabling, end its sessions.

        Raises
        ------
        InputError
            If no engineer would be left.
        UnknownNameError
            If there is no such account or role.
        StoreError
            If it could not be written.
        """
        given = {"password_hash": password_hash, "role": role, "disabled": disabled}
        new = {key: value for key, value in given.items() if value is not None}
        if role is not None:
            _check_role(role)
        if password_hash == "":
            raise InputError(f"account {name}: without a hash of its password nobody can log in")

        def work(connection: Connection) -> Account:
            _need(connection, name)
            values = {**new, "changed": now}
            connection.execute(_ACCOUNT.update().where(_ACCOUNT.c.name == name).values(values))
            _check_engineers(connection, name)
            if password_hash is not None or disabled:
                connection.execute(_SESSION.delete().where(_SESSION.c.name == name))
            return _need(connection, name)

        return self._writer.do(work)

    def remove(self, name: str) -> None:
        """Remove an account with its sessions and tokens.

        Raises
        ------
        InputError
            If no engineer would be left.
        UnknownNameError
            If there is no such account.
        StoreError
            If it could not be written.
        """

        def work(connection: Connection) -> None:
            _need(connection, name)
            for table in (_SESSION, _TOKEN, _ACCOUNT):
                connection.execute(table.delete().where(table.c.name == name))
            _check_engineers(connection, name)

        self._writer.do(work)

    # -- sessions ------------------------------------------------------------------------

    def open_session(self, name: str, now: float, lifetime: float, note: str = "") -> str:
        """Return the secret of a new session, which expires ``lifetime`` s from now.

        Raises
        ------
        InputError
            If the account is disabled.
        UnknownNameError
            If there is no such account.
        StoreError
            If it could not be written.
        """
        secret = self._secret()
        row = {"key": _key(secret), "name": name, "since": now, "expires": now + lifetime}

        def work(connection: Connection) -> None:
            if _need(connection, name).disabled:
                raise InputError(f"account {name}: it is disabled; ask an engineer")
            connection.execute(_SESSION.insert().values({**row, "note": note}))

        self._writer.do(work)
        return secret

    def session(self, secret: str, now: float) -> Session | None:
        """Return the session of a secret; None if there is none, or it may not go on."""
        joined = select(_SESSION, _ACCOUNT.c.role, _ACCOUNT.c.disabled).join(_ACCOUNT)
        query = joined.where(_SESSION.c.key == _key(secret), _SESSION.c.expires > now)
        with self._database.reading() as connection:
            row = connection.execute(query).mappings().first()
        if row is None or row["disabled"]:
            return None
        return Session(
            row["key"], row["name"], row["role"], row["since"], row["expires"], row["note"]
        )

    def sessions(self, now: float) -> tuple[Session, ...]:
        """Return all sessions that have not expired, the oldest first."""
        joined = select(_SESSION, _ACCOUNT.c.role).join(_ACCOUNT)
        query = joined.where(_SESSION.c.expires > now).order_by(_SESSION.c.since, _SESSION.c.key)
        with self._database.reading() as connection:
            return tuple(Session(**row) for row in connection.execute(query).mappings())

    def keep_session(self, secret: str, now: float, lifetime: float) -> None:
        """Let a session that has not expired end ``lifetime`` s from now; written behind."""
        which = (_SESSION.c.key == _key(secret)) & (_SESSION.c.expires > now)
        self._writer.put(
            lambda c: c.execute(_SESSION.update().where(which).values(expires=now + lifetime))
        )

    def close_session(self, secret: str) -> None:
        """End a session; nothing is done if there is none."""
        self._writer.do(lambda c: _delete(c, _SESSION, _SESSION.c.key == _key(secret)))

    def close_sessions(self, name: str) -> None:
        """End all sessions of an account."""
        self._writer.do(lambda c: _delete(c, _SESSION, _SESSION.c.name == name))

    # -- tokens --------------------------------------------------------------------------

    def add_token(
        self, name: str, label: str, role: str, now: float, lifetime: float | None = None
    ) -> tuple[ApiToken, str]:
        """Make a token of an account; return it with its secret, which is shown only now.

        Raises
        ------
        InputError
            If the account may not do what the token should.
        UnknownNameError
            If there is no such account or role.
        StoreError
            If it could not be written.
        """
        _check_role(role)
        secret = self._secret()
        expires = None if lifetime is None else now + lifetime
        made = ApiToken(_key(secret), name, label, role, now, expires, None)

        def work(connection: Connection) -> None:
            owner = _need(connection, name)
            if ROLES.index(role) > ROLES.index(owner.role):
                raise InputError(
                    f"token {label!r}: its role {role} is above that of {name}, {owner.role}"
                )
            connection.execute(_TOKEN.insert().values(asdict(made)))

        self._writer.do(work)
        return made, secret

    def token(self, secret: str, now: float) -> ApiToken | None:
        """Return the token of a secret and note its use; None if there is none that may act."""
        role = _ACCOUNT.c.role.label("owner_role")
        query = select(_TOKEN, role, _ACCOUNT.c.disabled).join(_ACCOUNT)
        with self._database.reading() as connection:
            found = connection.execute(query.where(_TOKEN.c.key == _key(secret)))
            row = found.mappings().first()
        if row is None or row["disabled"]:
            return None
        if row["expires"] is not None and row["expires"] <= now:
            return None
        self._note_use(row["key"], now)
        least = min(row["role"], row["owner_role"], key=ROLES.index)
        return ApiToken(
            row["key"],
            row["name"],
            row["label"],
            least,
            row["created"],
            row["expires"],
            row["last_used"],
        )

    def _note_use(self, key: str, now: float) -> None:
        last = self._noted.get(key)
        if last is None or abs(now - last) >= _NOTED:
            self._noted[key] = now
            which = _TOKEN.c.key == key
            # Who may act does not hang on a disk that is full.
            with suppress(StoreError):
                self._writer.put(
                    lambda c: c.execute(_TOKEN.update().where(which).values(last_used=now))
                )

    def tokens(self, name: str = "") -> tuple[ApiToken, ...]:
        """Return the tokens of an account, or all, the oldest first."""
        query = select(_TOKEN).order_by(_TOKEN.c.created, _TOKEN.c.key)
        if name:
            query = query.where(_TOKEN.c.name == name)
        with self._database.reading() as connection:
            return tuple(ApiToken(**row) for row in connection.execute(query).mappings())

    def revoke_token(self, key: str) -> None:
        """Remove a token by its key; nothing is done if there is none."""
        self._writer.do(lambda c: _delete(c, _TOKEN, _TOKEN.c.key == key))

    def forget_expired(self, now: float) -> None:
        """Let go of sessions and tokens that have expired; written behind."""

        def work(connection: Connection) -> None:
            for table in (_SESSION, _TOKEN):
                connection.execute(table.delete().where(table.c.expires <= now))

        self._writer.put(work)

    def _secret(self) -> str:
        return self._entropy(_SECRET).hex()


def _key(secret: str) -> str:
    return hashlib.sha256(secret.encode(errors="replace")).hexdigest()


def _check_role(role: str) -> None:
    if role not in ROLES:
        raise UnknownNameError("role", role, ROLES)


def _find(connection: Connection, name: str) -> Account | None:
    row = connection.execute(select(_ACCOUNT).where(_ACCOUNT.c.name == name)).mappings().first()
    return None if row is None else Account(**row)


def _need(connection: Connection, name: str) -> Account:
    found = _find(connection, name)
    if found is None:
        raise UnknownNameError("account", name, connection.scalars(select(_ACCOUNT.c.name)))
    return found


def _check_engineers(connection: Connection, name: str) -> None:
    able = (_ACCOUNT.c.role == ROLES[-1]) & ~_ACCOUNT.c.disabled
    if connection.execute(select(_ACCOUNT.c.name).where(able)).first() is None:
        raise InputError(
            f"account {name}: no engineer would be left; make another account an engineer first"
        )


def _delete(connection: Connection, table: Table, which: ColumnElement[bool]) -> None:
    connection.execute(table.delete().where(which))
