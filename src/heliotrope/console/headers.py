"""Information in the request headers: destination, origin and client."""

import ipaddress
from urllib.parse import SplitResult, urlsplit

from starlette.requests import HTTPConnection

from heliotrope.console.settings import ConsoleSettings

_COOKIE = "heliotrope_session"
#: Maximum length of the secret of a session or token, characters.
LONGEST_SECRET = 200
#: Request limits of strangers, from one address and from all addresses: rate, 1/s, and burst.
STRANGER, STRANGERS = (50.0, 200.0), (300.0, 600.0)


def host_known(settings: ConsoleSettings, netloc: str) -> bool:
    """Return whether a request addresses this computer by a known name."""
    host = netloc.rpartition(":")[0] if netloc.rpartition(":")[2].isdigit() else netloc
    return host.lower() in settings.hosts


def parts_of(url: str) -> SplitResult:
    """Return the parts of a URL that a caller wrote; empty parts if it is not a URL."""
    try:
        return urlsplit(url)
    except ValueError:  # for example http://[
        return urlsplit("")


def address_of(settings: ConsoleSettings, connection: HTTPConnection) -> str:
    """Return the client address of a request, from a trusted proxy's header or the connection.

    Each proxy appends the address that it saw to ``X-Forwarded-For``, so the last address that is
    not a proxy's counts; any address that a caller writes there comes before it.
    """
    address = connection.client.host if connection.client else ""
    if address in settings.proxies:
        for text in reversed(",".join(connection.headers.getlist("x-forwarded-for")).split(",")):
            try:
                said = str(ipaddress.ip_address(text.strip()))
            except ValueError:
                break
            if said not in settings.proxies:
                return said
    return address


def network_of(address: str) -> str:
    """Return the address that is counted.

    For IPv6 it is the /64 network, which one computer may own.
    """
    try:
        ip = ipaddress.ip_address(address)
    except ValueError:
        return address
    if isinstance(ip, ipaddress.IPv4Address):
        return str(ip)
    if ip.ipv4_mapped is not None:
        return str(ip.ipv4_mapped)
    return str(ipaddress.IPv6Network((int(ip) >> 64 << 64, 64)))


def cookie_of(settings: ConsoleSettings) -> str:
    """Return the name of the session's cookie.

    A browser accepts ``__Host-`` only from this host over TLS, so neither a program on another port
    nor another computer in the domain can replace it.
    """
    return f"__Host-{_COOKIE}" if settings.secure else _COOKIE


def secret_of(settings: ConsoleSettings, connection: HTTPConnection) -> tuple[str, str] | None:
    """Return the kind and the secret of the caller's token or session; None if there is none.

    The secret may be invalid. A request with a token never counts as a request of a session.
    """
    bearer = connection.headers.get("authorization", "")
    if bearer:
        kind, _, word = bearer.partition(" ")
        by, secret = "token", word.strip() if kind.lower() == "bearer" else ""
    else:
        by, secret = "session", connection.cookies.get(cookie_of(settings), "")
    return (by, secret) if 0 < len(secret) <= LONGEST_SECRET else None
