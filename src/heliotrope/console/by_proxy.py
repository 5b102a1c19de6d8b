"""People whom a trusted proxy has signed in, for example by OpenID Connect.

The proxy names the person and their groups in headers, and proves itself by a shared secret in
another one. Each header is believed only from an address of `ConsoleSettings.proxies`. Accounts are
made and get their role from the groups at each sign-in; they have no password.
"""

import hmac
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from fastapi import HTTPException
from pydantic import BaseModel, ConfigDict, Field
from starlette.datastructures import Headers

from heliotrope.errors import FormatError
from heliotrope.files.documents import read_document
from heliotrope.files.text import read_text
from heliotrope.store.people import BY_PROXY, ROLES, Account

_Header = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9-]{0,63}$")]
_Role = Annotated[str, Field(pattern=f"^({'|'.join(ROLES)})$")]
#: Shortest secret, characters, and largest file that has it, bytes.
_SHORTEST, _LARGEST = 32, 4096


class _ProxyFile(BaseModel):
    model_config = ConfigDict(extra="forbid")

    format: str
    version: Literal[1]
    person: _Header
    groups: _Header
    secret: _Header
    secret_file: Annotated[str, Field(min_length=1)]
    roles: Annotated[dict[str, _Role], Field(min_length=1)]


@dataclass(frozen=True)
class Introduced:
    """A person as the proxy names them, and the highest role of their groups; "" for none."""

    name: str
    role: str


@dataclass(frozen=True)
class ByProxy:
    """How a trusted proxy names people.

    Attributes
    ----------
    person, groups, secret
        Names of the headers.
    word
        Content of the secret header.
    roles
        Role by group.
    """

    person: str
    groups: str
    secret: str
    word: str = field(repr=False)
    roles: dict[str, str]

    @classmethod
    def read(cls, path: Path) -> "ByProxy":
        """Return the content of a file and of its secret's.

        Raises
        ------
        FormatError
            If one cannot be used, or others may read the secret.
        """
        document = read_document(path, "proxy", _ProxyFile, (_ProxyFile,))
        place = path.parent / document.secret_file
        word = read_text(place, "the secret of a proxy", _LARGEST).strip()
        if place.stat().st_mode & 0o077:
            raise FormatError(place, "others may read it; run chmod 600 on it")
        if len(word) < _SHORTEST or not (word.isascii() and word.isalnum()):
            raise FormatError(
                place, f"give at least {_SHORTEST} letters and digits, as of `openssl rand -hex 32`"
            )
        return cls(document.person, document.groups, document.secret, word, document.roles)

    def introduced(self, headers: Headers) -> Introduced | None:
        """Return the person of a request from a proxy; None without the secret or a name."""
        word = headers.get(self.secret, "").encode()
        names = headers.getlist(self.person)
        if not hmac.compare_digest(word, self.word.encode()) or len(names) != 1 or not names[0]:
            return None
        groups = {group.strip() for group in ",".join(headers.getlist(self.groups)).split(",")}
        roles = [role for group, role in self.roles.items() if group in groups]
        return Introduced(names[0], max(roles, key=ROLES.index, default=""))


def check_account(who: Introduced, account: Account | None) -> None:
    """Check that a person whom the proxy names may enter.

    Raises
    ------
    HTTPException
        403 if no group gives a role, or the account has a password of its own, or is disabled.
    """
    if not who.role:
        raise HTTPException(403, f"{who.name}: none of your groups has a role here")
    if account is not None and account.password_hash != BY_PROXY:
        raise HTTPException(
            403, f"{who.name}: an account of that name has a password here; choose another name"
        )
    if account is not None and account.disabled:
        raise HTTPException(403, f"{who.name}: the account is disabled; ask an engineer")
