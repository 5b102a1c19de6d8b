"""Settings of the console."""

import ipaddress
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from heliotrope.errors import InputError, UnknownNameError

#: Limits: a session, hours; the idle lock, minutes; failed sign-ins an hour.
_HOURS, _IDLE, _SIGN_INS = (0.25, 168.0), (0.0, 600.0), (3, 100)
_FILES = ("certificate", "key", "people_by_proxy")


@dataclass(frozen=True)
class ConsoleSettings:
    """Address and limits of the console.

    Attributes
    ----------
    host, port
        Address to bind; port 0 selects a free port.
    names
        Further names of this computer in a browser's address bar. A request for any other name is
        refused, because a foreign page may resolve its own name to this computer.
    certificate, key
        TLS certificate and its key, PEM files; None for plain HTTP.
    session_s
        Length of a session, s; 15 min to 7 days.
    sign_ins
        Attempts to sign in that fail, for one name at one address, in an hour; 3 to 100. The next
        attempt waits until the first of them is an hour ago.
    period
        Interval between messages of the live stream, s.
    viewers
        Maximum number of concurrent live streams; see `live` for the limit per person.
    plain
        Whether other computers may connect without TLS, behind a proxy that provides it.
    proxies
        Addresses of trusted proxies: ``X-Forwarded-For`` names the caller of their requests.
    people_by_proxy
        File that states how a trusted proxy identifies users, see `by_proxy`; None if no proxy
        identifies users.
    second_factor
        Minimum role that needs a second factor; "" for none.
    emergency_port
        Port that serves EMERGENCY alone; None for the next port, or a free port if that is taken.
    idle_s
        Time without an order after which a page's next order requires the password again, s; 0 for
        never.
    notice
        Text shown before sign-in; "" for none.

    Raises
    ------
    InputError
        If a port is invalid, a key has no certificate, a time or a number of attempts is beyond its
        limits, or an address other than this computer's own lacks TLS.
    """

    host: str = "127.0.0.1"
    port: int = 8080
    names: tuple[str, ...] = ()
    certificate: Path | None = None
    key: Path | None = None
    session_s: float = 36_000.0
    sign_ins: int = 12
    period: float = 1.0
    viewers: int = 200
    plain: bool = False
    proxies: tuple[str, ...] = ()
    people_by_proxy: Path | None = None
    second_factor: str = ""
    emergency_port: int | None = None
    idle_s: float = 1800.0
    notice: str = ""

    def __post_init__(self) -> None:
        for port in (self.port, self.emergency_port or 0):
            if not 0 <= port <= 65_535:
                raise InputError(
                    f"console: port must be between 1 and 65535, or 0 for a free port, not {port}"
                )
        if (self.certificate is None) != (self.key is None):
            raise InputError("console: TLS needs both files, --certificate and --key")
        if not self.period > 0.0:
            raise InputError(f"console: period must be above 0, not {self.period} s")
        for what, value, (least, most), unit in (
            ("a session", self.session_s / 3600.0, _HOURS, "hours"),
            ("the idle lock", self.idle_s / 60.0, _IDLE, "minutes"),
            ("the limit on sign-ins", self.sign_ins, _SIGN_INS, "an hour"),
        ):
            if not least <= value <= most:
                raise InputError(
                    f"console: {what} must be {least:g} to {most:g} {unit}, not {value:g}"
                )
        if self.second_factor:
            # The process for the EMERGENCY path does not use the store, and so starts sooner.
            from heliotrope.store.people import ROLES

            if self.second_factor not in ROLES:
                raise UnknownNameError("role", self.second_factor, ROLES)
        if self.people_by_proxy is not None and not self.proxies:
            raise InputError(
                "console: --people-by-proxy trusts only the addresses of --proxy; specify --proxy"
            )
        for proxy in self.proxies:
            _check_address(proxy)
        if not self.local and not self.tls and not self.plain:
            raise InputError(
                f"console: {self.host} is reached from other machines, and without TLS passwords "
                "can be read in transit; use --certificate and --key, or --plain behind a proxy "
                "that has TLS"
            )

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> "ConsoleSettings":
        """Return the settings that were stored as `values`."""
        files = {name: Path(values[name]) for name in _FILES if values[name]}
        tuples = {name: tuple(values[name]) for name in ("names", "proxies")}
        return cls(**{**values, **tuples, **files})

    @property
    def values(self) -> dict[str, Any]:
        """The settings as JSON values, for the console's process."""
        files = {name: str(getattr(self, name) or "") or None for name in _FILES}
        lists = {"names": list(self.names), "proxies": list(self.proxies)}
        return {**asdict(self), **lists, **files}

    @property
    def papers(self) -> tuple[Path, Path] | None:
        """The certificate and its key; None if there is no TLS."""
        if self.certificate is None or self.key is None:
            return None
        return self.certificate, self.key

    @property
    def tls(self) -> bool:
        """Whether the console itself uses TLS."""
        return self.certificate is not None

    @property
    def secure(self) -> bool:
        """Whether browsers reach the console over TLS, the console's own or a proxy's."""
        return self.tls or self.plain

    @property
    def local(self) -> bool:
        """Whether only this computer can connect."""
        return self.host == "localhost" or is_loopback(self.host)

    @property
    def for_one(self) -> bool:
        """Whether a one-time link may sign a user in, as only this computer's browsers connect.

        This requires that there is no TLS, no proxy that hides the origin of a request, and no
        required second factor.
        """
        asks = self.secure or self.proxies or self.second_factor
        return self.local and not asks

    @property
    def hosts(self) -> frozenset[str]:
        """Host names that a request may carry, in lower case."""
        own = {"127.0.0.1", "localhost", "[::1]", "::1"}
        return frozenset(own.union(name.lower() for name in (self.host, *self.names)))

    def address(self, port: int) -> str:
        """Return the console's address for a browser."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'https' if self.tls else 'http'}://{host}:{port}/"


def is_loopback(address: str) -> bool:
    """Return whether an address is this computer's own address."""
    try:
        found = ipaddress.ip_address(address)
    except ValueError:
        return False
    mapped = getattr(found, "ipv4_mapped", None)
    return (mapped or found).is_loopback


def _check_address(text: str) -> None:
    try:
        if str(ipaddress.ip_address(text)) == text:
            return
    except ValueError:
        pass
    raise InputError(
        f"console: proxy {text!r} is not an IP address; specify the IP address that the console "
        "sees"
    )
