"""Users whom a trusted proxy has signed in, for example through OpenID Connect.

The proxy names the user and their groups in headers, and authenticates itself by a shared secret in
another header. These headers are accepted only from an address in `ConsoleSettings.proxies`. An
account is created at the first sign-in, and gets its role from the groups at each sign-in; it has
no password.
"""

import hmac
import unicodedata
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
#: Minimum length of the secret, characters, and maximum size of its file, bytes.
_SHORTEST, _LARGEST = 32, 4096


class _ProxyFile(BaseModel):
    model_config = ConfigDict(extra="forbid")

    format: str
    version: Literal[1]
    person: _Header
    groups: _Header
    secret: _Header
    secret_file: Annotated[str, Field(min_length=1)]
    separator: Annotated[str, Field(pattern=r"^[!-~]{1,4}$")] = ","
    roles: Annotated[dict[str, _Role], Field(min_length=1)]


@dataclass(frozen=True)
class Introduced:
    """A person identified by the proxy, with the highest role of their groups; "" for no role."""

    name: str
    role: str


@dataclass(frozen=True)
class ByProxy:
    """How a trusted proxy identifies users.

    Attributes
    ----------
    person, groups, secret
        Names of the headers.
    word
        Content of the secret header.
    roles
        Role by group.
    separator
        Separator between groups; a group whose name contains it counts as two.
    """

    person: str
    groups: str
    secret: str
    word: str = field(repr=False)
    roles: dict[str, str]
    separator: str = ","

    @classmethod
    def read(cls, path: Path) -> "ByProxy":
        """Return the content of a configuration file and of the secret file that it names.

        Raises
        ------
        FormatError
            If a file cannot be used, or others may read the secret.
        """
        document = read_document(path, "proxy", _ProxyFile, (_ProxyFile,))
        place = path.parent / document.secret_file
        word = read_text(place, "the secret of a proxy", _LARGEST).strip()
        if place.stat().st_mode & 0o077:
            raise FormatError(place, "others may read it; run chmod 600 on it")
        if len(word) < _SHORTEST or not (word.isascii() and word.isalnum()):
            raise FormatError(
                place,
                f"the secret must have at least {_SHORTEST} letters and digits, such as the "
                "output of `openssl rand -hex 32`",
            )
        names = (document.person, document.groups, document.secret)
        return cls(*names, word, document.roles, document.separator)

    def sends(self, headers: Headers) -> bool:
        """Return whether a request, which then carries the secret, comes from the proxy."""
        return hmac.compare_digest(headers.get(self.secret, "").encode(), self.word.encode())

    def introduced(self, headers: Headers) -> Introduced | None:
        """Return the person named in a proxy's request; None without the secret or a name."""
        names = [_text(name) for name in headers.getlist(self.person)]
        if not self.sends(headers) or len(names) != 1 or not names[0]:
            return None
        listed = self.separator.join(map(_text, headers.getlist(self.groups)))
        groups = {group.strip() for group in listed.split(self.separator)}
        roles = [role for group, role in self.roles.items() if group in groups]
        return Introduced(names[0], max(roles, key=ROLES.index, default=""))


def _text(header: str) -> str:
    """Return the text of a header, which is UTF-8; empty if the header is not valid UTF-8."""
    try:
        return unicodedata.normalize("NFC", header.encode("latin-1").decode())
    except UnicodeError:
        return ""


def check_account(who: Introduced, account: Account | None) -> None:
    """Check that a person whom the proxy identifies may sign in.

    Raises
    ------
    HTTPException
        403 if no group grants a role, or the account has its own password or is disabled.
    """
    if not who.role:
        raise HTTPException(403, f"{who.name}: none of your groups has a role here")
    if account is not None and account.password_hash != BY_PROXY:
        raise HTTPException(
            403, f"{who.name}: an account of that name has a password here; choose another name"
        )
    if account is not None and account.disabled:
        raise HTTPException(403, f"{who.name}: the account is disabled; ask an engineer")
