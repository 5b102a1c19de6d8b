"""Strict tables, URLs of links and key files, shared by the files of plants and clusters.

Addresses and limits may be shared and kept under version control; keys may not. Keys stand in a
separate file that only its owner may read.
"""

import string
from difflib import get_close_matches
from ipaddress import ip_address
from pathlib import Path
from urllib.parse import urlsplit

from pydantic import BaseModel, ConfigDict

from heliotrope.errors import FormatError
from heliotrope.files.documents import read_toml

_SHORTEST_KEY, _LONGEST_KEY = 16, 64
_OTHERS = 0o077
_MISSING = {
    "heliostats": "the cluster has no such heliostat",
    "clusters": "the plant has no such cluster",
}
_PORTS = {"tcp": None, "mqtt": 1883, "mqtts": 8883}


class Table(BaseModel):
    """A table of a configuration file: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


def url_parts(path: Path, url: str, where: str) -> tuple[str, str, int, str]:
    """Return scheme, host, port and prefix of a link's URL.

    Parameters
    ----------
    path, where
        File and place of the URL, for the error message.

    Raises
    ------
    FormatError
        If it is not the URL of a link, or a part is missing.
    """
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        raise FormatError(path, f"{url!r} is not a URL; give tcp://host:port", where) from None
    if parts.scheme not in _PORTS or not parts.hostname:
        raise FormatError(
            path,
            f"{url!r}: give tcp://host:port, mqtt://host/prefix or mqtts://host/prefix",
            where,
        )
    port = port or _PORTS[parts.scheme]
    prefix = parts.path.strip("/")
    if port is None or (parts.scheme != "tcp" and not prefix):
        missing = "port: tcp://host:port" if port is None else "prefix: mqtt://host/prefix"
        raise FormatError(path, f"{url!r} has no {missing}", where)
    return parts.scheme, parts.hostname, port, prefix


def check_encryption(path: Path, host: str, where: str, accepted: bool) -> None:
    """Refuse a link to another machine that is not encrypted, unless that is accepted.

    Parameters
    ----------
    path, where
        File and place of the address, for the error message.
    host
        Host or address of the other end, or the address listened on.
    accepted
        Whether the link is encrypted, or the file says that it need not be.

    Raises
    ------
    FormatError
        Clear text beyond this machine.
    """
    try:
        here = ip_address(host).is_loopback
    except ValueError:
        here = host == "localhost"
    if not (here or accepted):
        raise FormatError(
            path,
            f"{host} is not this machine, and the link is not encrypted; set up TLS, or write "
            "unencrypted = true if nobody else can reach the network between them",
            where,
        )


class Keys:
    """A key file: ``plant``, ``password`` and a table of keys; keys are hexadecimal.

    Parameters
    ----------
    path
        None: there is no file, and there are no keys.
    table
        Name of the table: "heliostats" in a cluster's file, "clusters" in a plant's.

    Attributes
    ----------
    plant, password
        b"" and "" where absent.
    members
        Keys of the table, by name.

    Raises
    ------
    FormatError
        If others may read the file, or a value is not a key.
    """

    def __init__(self, path: Path | None, table: str) -> None:
        self._path, self._table = path, table
        self.plant, self.password = b"", ""
        self.members: dict[str, bytes] = {}
        if path is None:
            return
        # An empty file has no keys; members without a key are refused later.
        empty = path.is_file() and path.stat().st_size == 0
        raw = {} if empty else read_toml(path, "a key file")
        if path.stat().st_mode & _OTHERS:
            mode = path.stat().st_mode & 0o777
            raise FormatError(path, f"others may read it (mode {mode:o}); run chmod 600 on it")
        for key in raw:
            if key not in ("plant", "password", table):
                raise FormatError(path, f"{key!r} is not known; give plant, password, {table}")
        if "plant" in raw:
            self.plant = self._key("plant", raw["plant"])
        password, keys = raw.get("password", ""), raw.get(table, {})
        if not isinstance(password, str) or not isinstance(keys, dict):
            raise FormatError(path, f"password must be a text, and {table} a table of keys")
        self.password = password
        self.members = {name: self._key(name, value) for name, value in keys.items()}

    def _key(self, name: str, value: object) -> bytes:
        text = value if isinstance(value, str) else ""
        good = set(text) <= set(string.hexdigits) and len(text) % 2 == 0
        if not (good and _SHORTEST_KEY <= len(text) // 2 <= _LONGEST_KEY):
            # The value is not shown: it would end up in a log.
            raise FormatError(
                self._path,
                f"a key of {len(text)} characters; give {_SHORTEST_KEY} to "
                f"{_LONGEST_KEY} bytes in hexadecimal, as of: openssl rand -hex 32",
                name,
            )
        return bytes.fromhex(text)

    def check(self, names: list[str]) -> None:
        """Refuse keys of members that do not exist."""
        for name in self.members:
            if name not in names:
                close = get_close_matches(name, names, n=1)
                hint = f"; did you mean {close[0]!r}?" if close else "; remove it"
                raise FormatError(
                    self._path, f"{_MISSING[self._table]}{hint}", f"{self._table}.{name}"
                )
