"""Strict tables and link URLs, used in both plant and cluster files.

Addresses and limits may be shared and kept under version control; keys may not: see `links.keys`.
"""

from ipaddress import ip_address
from pathlib import Path
from urllib.parse import urlsplit

from pydantic import BaseModel, ConfigDict

from heliotrope.errors import FormatError

_PORTS = {"tcp": None, "mqtt": 1883, "mqtts": 8883}


class Table(BaseModel):
    """A table of a configuration file; unknown keys in it are refused."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


def url_parts(path: Path, url: str, where: str) -> tuple[str, str, int, str]:
    """Return the scheme, host, port and topic prefix of a link URL.

    Parameters
    ----------
    path, where
        File of the URL, and its location there, for the error message.

    Raises
    ------
    FormatError
        If the text is not a link URL, or a part is missing.
    """
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        raise FormatError(path, f"{url!r} is not a URL; use tcp://host:port", where) from None
    if parts.scheme not in _PORTS or not parts.hostname:
        raise FormatError(
            path,
            f"{url!r}: use tcp://host:port, mqtt://host/prefix or mqtts://host/prefix",
            where,
        )
    port = port or _PORTS[parts.scheme]
    prefix = parts.path.strip("/")
    if port is None or (parts.scheme != "tcp" and not prefix):
        missing = "port: tcp://host:port" if port is None else "prefix: mqtt://host/prefix"
        raise FormatError(path, f"{url!r} has no {missing}", where)
    return parts.scheme, parts.hostname, port, prefix


def check_encryption(path: Path, host: str, where: str, accepted: bool) -> None:
    """Refuse an unencrypted link to another computer, unless the configuration accepts it.

    Parameters
    ----------
    path, where
        File of the address, and its location there, for the error message.
    host
        Host or address of the other end, or the address listened on.
    accepted
        Whether the link is encrypted, or the file states that it need not be.

    Raises
    ------
    FormatError
        If the link would carry clear text to another computer.
    """
    try:
        local = ip_address(host).is_loopback
    except ValueError:
        local = host == "localhost"
    if not (local or accepted):
        raise FormatError(
            path,
            f"{host} is not this machine, and the link is not encrypted; set up TLS, or write "
            "unencrypted = true if nobody else can reach the network between them",
            where,
        )
