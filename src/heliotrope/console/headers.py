"""What the request headers say: destination, origin, and client."""

import ipaddress
from urllib.parse import SplitResult, urlsplit

from starlette.requests import HTTPConnection

from heliotrope.console.settings import ConsoleSettings

_COOKIE = "heliotrope_session"
#: A longer word is no session's or token's secret, characters.
LONGEST_SECRET = 200
#: Requests of strangers: from one address, and from all; 1/s, and at once.
STRANGER, STRANGERS = (50.0, 200.0), (300.0, 600.0)


def host_known(settings: ConsoleSettings, netloc: str) -> bool:
    """Whether a request names this machine by a known name."""
    host = netloc.rpartition(":")[0] if netloc.rpartition(":")[2].isdigit() else netloc
    return host.lower() in settings.hosts


def parts_of(url: str) -> SplitResult:
    """Return the parts of a URL that a caller wrote; they are empty where it is none."""
    try:
        return urlsplit(url)
    except ValueError:  # as http://[
        return urlsplit("")


def address_of(settings: ConsoleSettings, connection: HTTPConnection) -> str:
    """Return the address that a request comes from: what a trusted proxy says, or the other end's.

    Each proxy adds the address that it saw at the end of ``X-Forwarded-For``, so the last one that
    is no proxy's counts; what a caller writes there itself stands before.
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
    """Return the address that is counted: of IPv6 the /64, of which one machine has all."""
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

    A browser takes ``__Host-`` from this host alone, by TLS: neither a program on another port nor
    another machine of the domain can put one in its place.
    """
    return f"__Host-{_COOKIE}" if settings.secure else _COOKIE


def secret_of(settings: ConsoleSettings, connection: HTTPConnection) -> tuple[str, str] | None:
    """Return kind and secret of the caller's token or session, whether valid or not; None for none.

    A request with a token is never taken for one of a session.
    """
    bearer = connection.headers.get("authorization", "")
    if bearer:
        kind, _, word = bearer.partition(" ")
        by, secret = "token", word.strip() if kind.lower() == "bearer" else ""
    else:
        by, secret = "session", connection.cookies.get(cookie_of(settings), "")
    return (by, secret) if 0 < len(secret) <= LONGEST_SECRET else None
