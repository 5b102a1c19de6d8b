"""Credentials of a program: key files and certificates, reloaded when they are renewed.

Files are checked every two seconds in a thread, so that a slow disk delays nothing. A file that
cannot be used raises an alarm, and the previous content stays in force. The expiry of certificates
is monitored.
"""

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator, Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path

from heliotrope.errors import FormatError, HeliotropeError, InputError
from heliotrope.links.clock import Clock
from heliotrope.links.tls import RenewedTls, client_tls
from heliotrope.safety import Alarm, alarms

#: Interval between two checks of the files, s.
LOOKED = 2.0
#: Number of days before the expiry of a certificate from which an alarm is active; it is raised
#: again each day.
DAYS = 30
_DAY = 86_400.0
#: Values that change when a file does: time, inode, size and mode; None if the file is missing.
_State = tuple[int, ...] | None


class _Renewal:
    """Files that are reloaded when they change.

    Attributes
    ----------
    count
        Number of times they have been loaded.
    """

    def __init__(self, files: Sequence[Path], take: Callable[[], None]) -> None:
        self._files, self._take = tuple(files), take
        self._last_state: tuple[_State, ...] | None = None
        self.count = 0

    def look(self) -> str:
        """Load changed files; return why they cannot be used, or empty if they can.

        Files that cannot be used are tried again at each check.
        """
        current = tuple(_state(file) for file in self._files)
        if current == self._last_state:
            return ""
        try:
            self._take()
        except HeliotropeError as error:
            self._last_state = None
            return str(error)
        self._last_state = current
        self.count += 1
        return ""


class _Certificate:
    """A certificate whose expiry is monitored."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._last_state: _State = None
        self.end: datetime | None = None
        self.problem = ""

    def look(self) -> None:
        """Read the certificate's expiry again if the file has changed."""
        current = _state(self.path)
        if self.end is not None and current == self._last_state:
            return
        try:
            self.end, self.problem, self._last_state = end_of(self.path), "", current
        except HeliotropeError as error:
            self.end, self.problem = None, str(error)

    def days(self, now: datetime) -> int | None:
        """Return the number of whole days left.

        It is below 0 once the certificate has expired, and None if the expiry is unknown.
        """
        if self.end is None:
            return None
        return math.floor((self.end - now).total_seconds() / _DAY)

    def line(self, now: datetime) -> str:
        """Return the certificate's expiry in words."""
        days = self.days(now)
        if days is None or self.end is None:
            return f"the expiry date of certificate {self.path} is unknown ({self.problem})"
        day = f"{self.end:%Y-%m-%d %H:%M} UTC"
        if days < 0:
            return f"certificate {self.path} expired on {day}"
        return f"certificate {self.path} expires on {day}, in {days} days"


class Papers:
    """Key files and certificates of a program.

    Parameters
    ----------
    clock
        Clock whose UTC decides whether certificates have expired.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._renewals: dict[str, _Renewal] = {}
        self._certificates: list[_Certificate] = []
        self._problems: dict[str, str] = {}
        self._counts: dict[str, int] = {}
        self._reported: dict[Path, tuple[int | None, str]] = {}

    def renew(self, name: str, files: Sequence[Path], take: Callable[[], None]) -> None:
        """Register a function to be called when files change.

        ``take`` is called in a thread whenever one of the files changes, and once at start-up.
        """
        self._renewals[name] = _Renewal(files, take)

    def watch_end(self, path: Path) -> None:
        """Monitor the expiry of the certificate in a file; if it has several, the earliest."""
        self._certificates.append(_Certificate(path))

    def lines(self) -> list[str]:
        """Return the expiry of each certificate in words."""
        for certificate in self._certificates:
            certificate.look()
        now = self._clock.utc()
        return [certificate.line(now) for certificate in self._certificates]

    @contextlib.asynccontextmanager
    async def watched(
        self, on_alarm: Callable[[Alarm], None], on_renewed: Callable[[str], None] | None = None
    ) -> AsyncIterator[None]:
        """Check the files during a block, raise and clear alarms, and report renewed files."""
        failure: Exception | None = None
        async with asyncio.TaskGroup() as group:
            task = group.create_task(self._run(on_alarm, on_renewed))
            try:
                yield
            except Exception as error:  # noqa: BLE001 (it goes on as it came, not in a group)
                failure = error
            task.cancel()
        if failure is not None:
            raise failure

    async def _run(
        self, on_alarm: Callable[[Alarm], None], on_renewed: Callable[[str], None] | None
    ) -> None:
        while True:
            for alarm in await asyncio.to_thread(self.look):
                on_alarm(alarm)
            for name in self.renewed():
                if on_renewed is not None:
                    on_renewed(name)
            await asyncio.sleep(LOOKED)

    def look(self) -> list[Alarm]:
        """Load changed files; return the alarms that begin, end or are repeated."""
        changes = []
        for name, renewal in self._renewals.items():
            problem = renewal.look()
            if problem != self._problems.get(name, ""):
                kind = alarms.RENEWAL
                changes.append(kind.raised(name, problem=problem) if problem else kind.ended(name))
            self._problems[name] = problem
        now = self._clock.utc()
        for certificate in self._certificates:
            certificate.look()
            changes += self._end_of(certificate, now)
        return changes

    def renewed(self) -> list[str]:
        """Return the files reloaded since the last call, not counting the first load."""
        before, self._counts = self._counts, {n: r.count for n, r in self._renewals.items()}
        return [n for n, count in self._counts.items() if count > max(1, before.get(n, 0))]

    def _end_of(self, certificate: _Certificate, now: datetime) -> list[Alarm]:
        kind, days, path = alarms.CERTIFICATE, certificate.days(now), certificate.path
        state = (days, certificate.problem)
        if self._reported.get(path) == state:
            return []
        stood = path in self._reported
        name = path.name
        # A new day is a new occurrence, even if someone acknowledged the previous one.
        over = [kind.ended(name)] if stood else []
        if days is not None and days >= DAYS:
            self._reported.pop(path, None)
            return over
        self._reported[path] = state
        worse = days is not None and days < 0
        return [*over, kind.raised(name, worse=worse, problem=certificate.line(now))]


def _state(path: Path) -> _State:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_ino, status.st_size, status.st_mode


def end_of(path: Path) -> datetime:
    """Return the expiry of a PEM certificate; of several certificates, the earliest.

    Raises
    ------
    InputError
        If the package that reads certificates is not installed.
    FormatError
        If the file cannot be read, or contains no certificate.
    """
    try:
        from cryptography import x509
    except ImportError:
        raise InputError(
            "cryptography is not installed; run pip install 'heliotrope[control]'"
        ) from None
    try:
        certificates = x509.load_pem_x509_certificates(path.read_bytes())
        ends = [certificate.not_valid_after_utc for certificate in certificates]
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})") from None
    except ValueError:
        raise FormatError(path, "holds no PEM certificate") from None
    return min(ends).astimezone(UTC)


def authority_of(papers: Papers, path: Path) -> RenewedTls:
    """Return TLS for a client that trusts only one authority; it is renewed with its file."""
    tls = RenewedTls(lambda: client_tls(path))
    papers.renew("certificate of the authority", [path], tls.renew)
    papers.watch_end(path)
    return tls
