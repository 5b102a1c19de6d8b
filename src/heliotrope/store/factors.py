"""Second factors of accounts: authenticator codes (TOTP, RFC 6238) and recovery codes.

The database contains no secret. The secret of an account is derived from a key file, which is not
part of any backup, and from the account name and a random word; recovery codes are stored as
SHA-256.
"""

import base64
import hashlib
import hmac
import os
import secrets
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from sqlalchemy import Connection, select

from heliotrope.errors import InputError
from heliotrope.store import chain, tables
from heliotrope.store.database import PRIVATE, Database
from heliotrope.store.records import StoreError
from heliotrope.store.writer import Work, Writer

T = TypeVar("T")
#: Name of the key file in the plant's data folder.
KEY_FILE = "second-factor.key"
#: Number of recovery codes of an account.
CODES = 8
#: Length of a code's time step, s, and number of steps before and after the present one that are
#: accepted.
STEP, NEAR = 30, 1
_FACTOR, _RECOVERY = tables.second_factor, tables.recovery_code
_BYTES = 32


@dataclass(frozen=True)
class Used:
    """A correct code: whether it was a recovery code, and how many recovery codes remain."""

    recovery: bool
    left: int


class Factors:
    """The second factors of a store; any thread may call any method.

    Parameters
    ----------
    database, writer
        Parts of the keeper.
    file
        Key file, created together with the first secret.
    entropy
        Function that returns random bytes.
    """

    def __init__(
        self,
        database: Database,
        writer: Writer,
        file: Path,
        entropy: Callable[[int], bytes] = secrets.token_bytes,
    ) -> None:
        self._database, self._writer, self._file, self._entropy = database, writer, file, entropy

    def begin(self, name: str, now: float) -> str:
        """Return a new secret for an account, base32.

        The secret is in force once `confirm` accepts a code made from it.

        Raises
        ------
        InputError
            If the account already has a second factor, or the key file cannot be used.
        StoreError
            If the secret could not be written.
        """
        word = self._entropy(16).hex()
        made = self._secret(name, word)

        def work(connection: Connection) -> None:
            factor = _find(connection, name)
            if factor is not None and factor.confirmed:
                raise InputError(
                    f"account {name}: it already has a second factor; remove that one first"
                )
            connection.execute(_FACTOR.delete().where(_FACTOR.c.name == name))
            row = {"name": name, "word": word, "since": now, "confirmed": False, "used": 0}
            connection.execute(_FACTOR.insert().values(row))

        self._change(name, work)
        return made

    def confirm(self, name: str, code: str, now: float) -> tuple[str, ...]:
        """Activate the secret from `begin`; return the recovery codes, which are shown only once.

        Raises
        ------
        InputError
            If there is no such secret, or the code is wrong.
        StoreError
            If the change could not be written.
        """
        codes = tuple(self._recovery_code() for _ in range(CODES))

        def work(connection: Connection) -> None:
            factor = _find(connection, name)
            if factor is None or factor.confirmed:
                raise InputError(f"account {name}: begin to set up a second factor first")
            step = self._step(name, factor.word, 0, code, now)
            if step is None:
                raise InputError(
                    "the code is wrong; check the clock of the device that generated it"
                )
            mine = _FACTOR.update().where(_FACTOR.c.name == name)
            connection.execute(mine.values(confirmed=True, used=step))
            connection.execute(_RECOVERY.delete().where(_RECOVERY.c.name == name))
            rows = [
                {"digest": _digest(name, recovery_code), "name": name} for recovery_code in codes
            ]
            connection.execute(_RECOVERY.insert(), rows)

        self._change(name, work)
        return codes

    def check(self, name: str, code: str, now: float) -> Used | None:
        """Use a code; return None if it is wrong.

        Each code is valid only once.

        Raises
        ------
        StoreError
            If the use of the code could not be written.
        """

        def work(connection: Connection) -> Used | None:
            factor = _find(connection, name)
            if factor is None or not factor.confirmed:
                return None
            mine = _RECOVERY.c.name == name
            which = mine & (_RECOVERY.c.digest == _digest(name, code))
            recovery = connection.execute(_RECOVERY.delete().where(which)).rowcount == 1
            if not recovery:
                step = self._step(name, factor.word, factor.used, code, now)
                if step is None:
                    return None
                update = _FACTOR.update().where(_FACTOR.c.name == name)
                connection.execute(update.values(used=step))
            remaining = connection.execute(select(_RECOVERY.c.digest).where(mine)).all()
            return Used(recovery, len(remaining))

        return self._change(name, work)

    def remove(self, name: str) -> bool:
        """Remove the second factor of an account; return whether there was one."""

        def work(connection: Connection) -> bool:
            connection.execute(_RECOVERY.delete().where(_RECOVERY.c.name == name))
            return connection.execute(_FACTOR.delete().where(_FACTOR.c.name == name)).rowcount > 0

        return self._change(name, work)

    def _change(self, name: str, work: Work[T]) -> T:
        """Change the second factor of an account; the change is linked into the chain."""

        def linked(connection: Connection) -> T:
            with chain.changing_accounts(connection, (name,)):
                return work(connection)

        return self._writer.do(linked)

    # -- codes ---------------------------------------------------------------------------

    def _step(self, name: str, word: str, used: int, code: str, now: float) -> int | None:
        """Return the time step of a correct, unused code; None if the code is not valid."""
        import pyotp

        clean = code.replace(" ", "")
        try:
            totp = pyotp.TOTP(self._secret(name, word))
        except InputError:
            return None  # without the key file, only recovery codes remain
        present = int(now // STEP)
        for step in range(max(used + 1, present - NEAR), present + NEAR + 1):
            if hmac.compare_digest(totp.at(step * STEP).encode(), clean.encode()):
                return step
        return None

    def _recovery_code(self) -> str:
        """Return a random code of 80 bits in groups that can be read aloud."""
        text = base64.b32encode(self._entropy(10)).decode().lower()
        return "-".join(text[k : k + 4] for k in range(0, 16, 4))

    def _secret(self, name: str, word: str) -> str:
        """Return the secret of an account, base32."""
        message = f"second factor\0{name}\0{word}".encode()
        return base64.b32encode(hmac.digest(self._key(), message, "sha256")[:20]).decode()

    def _key(self) -> bytes:
        """Return the key in the file, which is created if missing.

        Raises
        ------
        InputError
            If the file cannot be read or created, or others may read it.
        """
        try:
            if self._file.stat().st_mode & 0o077:
                raise InputError(f"key file {self._file}: others may read it; run chmod 600 on it")
            key = bytes.fromhex(self._file.read_text("ascii").strip())
        except FileNotFoundError:
            return self._make_key()
        except (OSError, ValueError) as error:
            raise InputError(f"key file {self._file}: it cannot be read ({error})") from None
        if len(key) != _BYTES:
            raise InputError(
                f"key file {self._file}: the key must have {_BYTES} bytes, in hexadecimal, not "
                f"{len(key)}"
            )
        return key

    def _make_key(self) -> bytes:
        with self._database.reading() as connection:
            if connection.execute(select(_FACTOR.c.name).where(_FACTOR.c.confirmed)).first():
                raise InputError(
                    f"key file {self._file}: it is missing, so no code of an authenticator can be "
                    "checked; restore it, or sign in with recovery codes"
                )
        key = self._entropy(_BYTES)
        try:
            made = os.open(self._file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, PRIVATE)
            with os.fdopen(made, "w") as file:
                file.write(key.hex() + "\n")
        except OSError as error:
            raise StoreError(f"key file {self._file}: {error.strerror}") from None
        return key


def _find(connection: Connection, name: str):  # type: ignore[no-untyped-def]
    return connection.execute(select(_FACTOR).where(_FACTOR.c.name == name)).first()


def _digest(name: str, code: str) -> str:
    clean = "".join(c for c in code.lower() if c.isalnum())
    return hashlib.sha256(f"{name}\0{clean}".encode(errors="replace")).hexdigest()
