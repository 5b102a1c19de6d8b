"""Accounts with their roles, sessions that expire, and tokens for programs.

The caller hashes passwords (argon2), and only the hash is stored. Session and token secrets are
created here from 32 random bytes, and only their SHA-256 is stored, so reading the database does
not reveal usable secrets. Times are POSIX seconds and always arguments.
"""

import hashlib
import secrets
import unicodedata
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from sqlalchemy import (
    ColumnElement,
    Connection,
    FromClause,
    RowMapping,
    Select,
    Table,
    func,
    literal,
    select,
)

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.store import _rows as rows
from heliotrope.store import chain, tables
from heliotrope.store.database import Database
from heliotrope.store.factors import Factors
from heliotrope.store.records import StoreError
from heliotrope.store.writer import Work, Writer

T = TypeVar("T")
_ACCOUNT, _SESSION, _TOKEN = tables.account, tables.session, tables.api_token
_DUE, _FACTOR = tables.password_due, tables.second_factor
#: Stored in place of a password hash if a trusted proxy signs that person in.
BY_PROXY = "by the proxy"
#: Stored in the same place if nobody has set a password yet.
UNSET = "none yet"
_STATE = (
    _DUE.c.name.is_not(None).label("password_due"),
    _FACTOR.c.name.is_not(None).label("factor"),
    (_ACCOUNT.c.password_hash == BY_PROXY).label("by_proxy"),
    (_ACCOUNT.c.password_hash == UNSET).label("no_password"),
)
ROLES = ("viewer", "operator", "engineer")
#: Longest name of an account, characters.
LONGEST_NAME = 100


@dataclass(frozen=True)
class Account:
    """A person's account.

    Attributes
    ----------
    name
        Unique name; case-sensitive.
    role
        One of `ROLES`.
    password_hash
        Password hash; never displayed.
    disabled
        Whether the account is disabled.
    created, changed
        POSIX s.
    password_due
        Whether the password must be changed at its next use, because someone else set it.
    factor
        Whether the account has a second factor.
    by_proxy
        Whether the account has no password, because a trusted proxy signs the person in.
    no_password
        Whether no password has been set yet, so that the person signs in through a one-time link.
    """

    name: str
    role: str
    password_hash: str = field(repr=False)
    disabled: bool
    created: float
    changed: float
    password_due: bool = False
    factor: bool = False
    by_proxy: bool = False
    no_password: bool = False

    @property
    def has_password(self) -> bool:
        """Whether there is a password to check."""
        return not self.by_proxy and not self.no_password


@dataclass(frozen=True)
class Session:
    """The session of a signed-in person: name, current role, start and end.

    ``key`` identifies the session in lists without revealing its secret.
    """

    key: str
    name: str
    role: str
    since: float
    expires: float
    note: str = ""
    password_due: bool = False
    factor: bool = False
    by_proxy: bool = False
    no_password: bool = False


@dataclass(frozen=True)
class ApiToken:
    """A program that acts for a person.

    Attributes
    ----------
    key
        Identifies the token without revealing its secret.
    name
        Account to which it belongs.
    label
        Purpose.
    role
        Role of the token: at most the current role of its account.
    created, expires, last_used
        POSIX s; None for never.
    """

    key: str
    name: str
    label: str
    role: str
    created: float
    expires: float | None
    last_used: float | None


@dataclass(frozen=True)
class Valid:
    """All sessions and tokens that are valid now."""

    sessions: tuple[Session, ...]
    tokens: tuple[ApiToken, ...]


@dataclass(frozen=True)
class Expired:
    """An expired session of a person, or an expired token with its label."""

    token: bool
    name: str
    label: str


_DAY = 86_400.0
#: Longest validity of a token by its role, s. A viewer's token can do no harm, so programs that
#: only read need a new one once a year; programs that command need one every quarter.
LONGEST = {"viewer": 365.0 * _DAY, "operator": 90.0 * _DAY, "engineer": 90.0 * _DAY}
#: Maximum number of sessions and of tokens of one account, for a person's browsers and programs.
MOST_SESSIONS, MOST_TOKENS = 20, 50
#: Length of a secret in random bytes; only its SHA-256 is stored.
_SECRET = 32
#: The last use of a token is recorded at most this often, s.
_NOTED = 60.0


#: Tokens, with the account data that `_valid_token` needs.
_TOKENS = select(_TOKEN, _ACCOUNT.c.role.label("owner_role"), _ACCOUNT.c.disabled).join(_ACCOUNT)


#: Lower-case letters that look like others in lower or upper case: Cyrillic, Greek and digits.
_ALIKE = str.maketrans(
    "авекмнорстухісѕјԁһӏԛԝѵαβεζηικμνορτυχϲ10|i",
    "abekmhopctyxlcsjdhlqwvabezhlkmvoptyxcloll",
)


class People:
    """Accounts, sessions and tokens in a database.

    All tables are small, so a read takes less than a millisecond, and a write takes one commit. Any
    thread may call any method.

    Parameters
    ----------
    database, writer
        Parts of the keeper.
    entropy
        Function that returns random bytes.
    """

    def __init__(
        self,
        database: Database,
        writer: Writer,
        entropy: Callable[[int], bytes] = secrets.token_bytes,
    ) -> None:
        self._database, self._writer, self._entropy = database, writer, entropy
        self._noted: dict[str, float] = {}

    # -- accounts ------------------------------------------------------------------------

    def empty(self) -> bool:
        """Whether there is no account yet, as at the first start-up."""
        return not self.accounts()

    def accounts(self) -> tuple[Account, ...]:
        """Return all accounts, sorted by name."""
        with self._database.reading() as connection:
            return tuple(rows.records(connection, Account, _accounts().order_by(_ACCOUNT.c.name)))

    def account(self, name: str) -> Account | None:
        """Return an account; None if the name is unknown."""
        with self._database.reading() as connection:
            return _find(connection, name)

    def add(
        self, name: str, password_hash: str, role: str, now: float, *, due: bool = False
    ) -> Account:
        """Create an account; a password that is ``due`` must be changed at first use.

        Raises
        ------
        InputError
            If the name exists already, resembles another name, is empty or too long, or if the hash
            is empty.
        UnknownNameError
            If the role is unknown.
        StoreError
            If the change could not be written.
        """
        _check_role(role)
        if not name.strip(" .") or len(name) > LONGEST_NAME or not name.isprintable():
            raise InputError(
                f"account {name[:LONGEST_NAME]!r}: the name must have 1 to {LONGEST_NAME} "
                "printable characters, and not only dots"
            )
        if not password_hash:
            raise InputError(f"account {name}: a password hash is needed to sign in")
        made = Account(name, role, password_hash, False, now, now, due)

        def work(connection: Connection) -> None:
            if _find(connection, name) is not None:
                raise InputError(
                    f"account {name}: it already exists; change it, or choose another name"
                )
            for other in connection.scalars(select(_ACCOUNT.c.name)):
                if _likeness(other) == _likeness(name):
                    raise InputError(
                        f"account {name}: the name looks like that of {other}; choose a different "
                        "one"
                    )
            connection.execute(_ACCOUNT.insert().values(rows.row_of(_ACCOUNT, made)))
            _set_due(connection, name, due=due)

        self._change((name,), work)
        return made

    def change(
        self,
        name: str,
        now: float,
        *,
        password_hash: str | None = None,
        role: str | None = None,
        disabled: bool | None = None,
        due: bool = False,
    ) -> Account:
        """Change an account.

        A new password, or disabling the account, ends its sessions and tokens.

        A new password that is ``due`` must be changed at first use.

        Raises
        ------
        InputError
            If no engineer would be left.
        UnknownNameError
            If the account or role is unknown.
        StoreError
            If the change could not be written.
        """
        changes = {"password_hash": password_hash, "role": role, "disabled": disabled}
        new = {key: value for key, value in changes.items() if value is not None}
        if role is not None:
            _check_role(role)
        if password_hash == "":
            raise InputError(f"account {name}: a password hash is needed to sign in")

        def work(connection: Connection) -> Account:
            _need(connection, name)
            values = {**new, "changed": now}
            connection.execute(_ACCOUNT.update().where(_ACCOUNT.c.name == name).values(values))
            _check_engineers(connection, name)
            if password_hash is not None:
                _set_due(connection, name, due=due)
            if password_hash is not None or disabled:
                for table in (_SESSION, _TOKEN):
                    connection.execute(table.delete().where(table.c.name == name))
            return _need(connection, name)

        return self._change((name,), work)

    def remove(self, name: str) -> None:
        """Remove an account with its sessions and tokens.

        Raises
        ------
        InputError
            If no engineer would be left.
        UnknownNameError
            If the account is unknown.
        StoreError
            If the change could not be written.
        """

        def work(connection: Connection) -> None:
            _need(connection, name)
            for table in (_SESSION, _TOKEN, _DUE, tables.recovery_code, _FACTOR, _ACCOUNT):
                connection.execute(table.delete().where(table.c.name == name))
            _check_engineers(connection, name)

        self._change((name,), work)

    def _change(self, names: Iterable[str], work: Work[T]) -> T:
        """Change the accounts and tokens of some persons; the change is added to the chain."""

        def linked(connection: Connection) -> T:
            with chain.changing_accounts(connection, names):
                return work(connection)

        return self._writer.do(linked)

    def factors(self, file: Path) -> Factors:
        """Return the second factors of the accounts; ``file`` contains the key to their secrets."""
        return Factors(self._database, self._writer, file, self._entropy)

    # -- sessions ------------------------------------------------------------------------

    def open_session(self, name: str, now: float, lifetime: float, note: str = "") -> str:
        """Return the secret of a new session, which expires ``lifetime`` s from now.

        If the account already has `MOST_SESSIONS` sessions, the oldest sessions end.

        Raises
        ------
        InputError
            If the account is disabled.
        UnknownNameError
            If the account is unknown.
        StoreError
            If the session could not be written.
        """
        secret = self._secret()
        row = {"key": _key(secret), "name": name, "since": now, "expires": now + lifetime}

        def work(connection: Connection) -> None:
            if _need(connection, name).disabled:
                raise InputError(f"account {name}: it is disabled; ask an engineer")
            own = select(_SESSION.c.key).where(_SESSION.c.name == name)
            newest = own.order_by(_SESSION.c.since.desc(), _SESSION.c.key).offset(MOST_SESSIONS - 1)
            for key in connection.scalars(newest).all():
                _delete(connection, _SESSION, _SESSION.c.key == key)
            connection.execute(_SESSION.insert().values({**row, "note": note}))

        self._writer.do(work)
        return secret

    def valid(self, now: float, used: Collection[str] = ()) -> Valid:
        """Return all valid sessions and tokens; record the use of tokens with the given keys."""
        for key in used:
            self._note_use(key, now)
        columns = (_SESSION, _ACCOUNT.c.role, *_STATE)
        joined = select(*columns).select_from(_with_state(_SESSION.join(_ACCOUNT)))
        query = joined.where(_SESSION.c.expires > now, ~_ACCOUNT.c.disabled)
        with self._database.reading() as connection:
            sessions = rows.records(connection, Session, query)
            tokens = [_valid_token(row, now) for row in connection.execute(_TOKENS).mappings()]
        return Valid(tuple(sessions), tuple(token for token in tokens if token is not None))

    def close_session(self, secret: str) -> None:
        """End a session, if it exists."""
        self._writer.do(lambda c: _delete(c, _SESSION, _SESSION.c.key == _key(secret)))

    def close_sessions(self, name: str) -> None:
        """End all sessions of an account."""
        self._writer.do(lambda c: _delete(c, _SESSION, _SESSION.c.name == name))

    # -- tokens --------------------------------------------------------------------------

    def add_token(
        self, name: str, label: str, role: str, now: float, lifetime: float | None = None
    ) -> tuple[ApiToken, str]:
        """Create a token for an account; return the token and its secret, which is shown only once.

        The token expires ``lifetime`` s from now, and at the latest after the `LONGEST` time for
        its role.

        Raises
        ------
        InputError
            If the token's role is above the account's role, the lifetime is too long, or the
            account already has `MOST_TOKENS` tokens.
        UnknownNameError
            If the account or role is unknown.
        StoreError
            If the token could not be written.
        """
        _check_role(role)
        longest = LONGEST[role]
        if lifetime is not None and lifetime > longest:
            raise InputError(
                f"token {label!r}: {lifetime / _DAY:g} days; a token of role {role} lasts at most "
                f"{longest / _DAY:g}"
            )
        secret = self._secret()
        expires = None if lifetime is None else now + lifetime
        made = ApiToken(_key(secret), name, label, role, now, expires, None)

        def work(connection: Connection) -> None:
            owner = _need(connection, name)
            if ROLES.index(role) > ROLES.index(owner.role):
                raise InputError(
                    f"token {label!r}: its role {role} is above that of {name}, {owner.role}"
                )
            own = select(func.count()).where(_TOKEN.c.name == name)
            if (connection.scalar(own) or 0) >= MOST_TOKENS:
                raise InputError(
                    f"token {label!r}: {name} already has {MOST_TOKENS} tokens; revoke one first"
                )
            connection.execute(_TOKEN.insert().values(asdict(made)))

        self._change((name,), work)
        return made, secret

    def token(self, secret: str, now: float) -> ApiToken | None:
        """Return the token that has a secret, and record its use; None if no valid token has it."""
        with self._database.reading() as connection:
            result = connection.execute(_TOKENS.where(_TOKEN.c.key == _key(secret)))
            row = result.mappings().first()
        found = None if row is None else _valid_token(row, now)
        if found is not None:
            self._note_use(found.key, now)
        return found

    def _note_use(self, key: str, now: float) -> None:
        last = self._noted.get(key)
        if last is None or abs(now - last) >= _NOTED:
            self._noted[key] = now
            which = _TOKEN.c.key == key
            # A full disk must not lock anyone out.
            with suppress(StoreError):
                self._writer.put(
                    lambda c: c.execute(_TOKEN.update().where(which).values(last_used=now))
                )

    def tokens(self, name: str = "") -> tuple[ApiToken, ...]:
        """Return the tokens of an account, or all tokens, oldest first."""
        query = select(_TOKEN).order_by(_TOKEN.c.created, _TOKEN.c.key)
        if name:
            query = query.where(_TOKEN.c.name == name)
        with self._database.reading() as connection:
            return tuple(rows.records(connection, ApiToken, query))

    def revoke_token(self, key: str) -> None:
        """Remove a token by its key, if it exists."""
        owners = {token.name for token in self.tokens() if token.key == key}
        self._change(owners, lambda c: _delete(c, _TOKEN, _TOKEN.c.key == key))

    def forget_expired(self, now: float) -> tuple[Expired, ...]:
        """Remove expired sessions and tokens; return them.

        Raises
        ------
        StoreError
            If the sessions and tokens could not be removed.
        """
        expired, keys = [], []
        with self._database.reading() as connection:
            for table, label in ((_SESSION, None), (_TOKEN, _TOKEN.c.label)):
                query = select(table.c.key, table.c.name, literal("") if label is None else label)
                for key, name, text in connection.execute(query.where(table.c.expires <= now)):
                    expired.append(Expired(table is _TOKEN, name, text))
                    keys.append((table, key))

        def work(connection: Connection) -> None:
            for table, key in keys:
                _delete(connection, table, table.c.key == key)

        if keys:
            self._change({ended.name for ended in expired if ended.token}, work)
        return tuple(expired)

    def _secret(self) -> str:
        return self._entropy(_SECRET).hex()


def _likeness(name: str) -> str:
    """Return the form that names share if people could confuse them."""
    return " ".join(unicodedata.normalize("NFKC", name).casefold().translate(_ALIKE).split())


def _valid_token(row: RowMapping, now: float) -> ApiToken | None:
    """Return the token in a row of `_TOKENS`; None if it is not valid."""
    # Earlier programs issued tokens that last for years, or forever.
    ends = row["created"] + LONGEST[row["role"]]
    if row["disabled"] or now >= min(ends, row["expires"] if row["expires"] is not None else ends):
        return None
    least = min(row["role"], row["owner_role"], key=ROLES.index)
    return rows.record_of(ApiToken, row, role=least)


def _key(secret: str) -> str:
    return hashlib.sha256(secret.encode(errors="replace")).hexdigest()


def _check_role(role: str) -> None:
    if role not in ROLES:
        raise UnknownNameError("role", role, ROLES)


def _accounts() -> Select[Any]:
    return select(_ACCOUNT, *_STATE).select_from(_with_state(_ACCOUNT))


def _with_state(accounts: FromClause) -> FromClause:
    """Join to the accounts the columns that `_STATE` needs."""
    factor = (_FACTOR.c.name == _ACCOUNT.c.name) & _FACTOR.c.confirmed
    return accounts.outerjoin(_DUE, _DUE.c.name == _ACCOUNT.c.name).outerjoin(_FACTOR, factor)


def _set_due(connection: Connection, name: str, *, due: bool) -> None:
    """Note whether a password must be changed at first use."""
    _delete(connection, _DUE, _DUE.c.name == name)
    if due:
        connection.execute(_DUE.insert().values(name=name))


def _find(connection: Connection, name: str) -> Account | None:
    accounts = rows.records(connection, Account, _accounts().where(_ACCOUNT.c.name == name))
    return accounts[0] if accounts else None


def _need(connection: Connection, name: str) -> Account:
    account = _find(connection, name)
    if account is None:
        raise UnknownNameError("account", name, connection.scalars(select(_ACCOUNT.c.name)))
    return account


def _check_engineers(connection: Connection, name: str) -> None:
    able = (_ACCOUNT.c.role == ROLES[-1]) & ~_ACCOUNT.c.disabled
    if connection.execute(select(_ACCOUNT.c.name).where(able)).first() is None:
        raise InputError(
            f"account {name}: no engineer would be left; make another account an engineer first"
        )


def _delete(connection: Connection, table: Table, which: ColumnElement[bool]) -> None:
    connection.execute(table.delete().where(which))
