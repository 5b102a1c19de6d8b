"""Forwards security events and alarms to a syslog receiver, following RFC 5424.

The transports are UDP (RFC 5426), TCP with octet counting (RFC 6587, section 3.4.1) and TLS (RFC
5425). Messages wait in a bounded queue for a dedicated thread, so a receiver that is slow or
unreachable delays nothing else. Messages that arrive when the queue is full are discarded and
counted, and the count is reported to the receiver and to the plant. A message that TCP had accepted
when a connection broke may be lost uncounted; the numbers in ``meta sequenceId`` (RFC 5424, section
7.3.1) reveal this to the receiver.
"""

import contextlib
import os
import queue
import socket
import ssl
import threading
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import urlsplit

from heliotrope.errors import InputError
from heliotrope.links.tls import client_tls
from heliotrope.plant.operations.security import SecurityNote
from heliotrope.safety import Alarm, Severity

#: Ports registered for syslog: RFC 5426, IANA's syslog-conn, RFC 5425.
_PORTS = {"udp": 514, "tcp": 601, "tls": 6514}
#: Facilities (RFC 5424, section 6.2.1): security and authorization; local use 0.
_SECURITY, _LOCAL = 10, 16
_SEVERITIES = {
    Severity.INFO: 6, Severity.WARNING: 4, Severity.ALARM: 3, Severity.EMERGENCY: 1,
}  # fmt: skip
#: Longest message, octets; every receiver of RFC 5424 should accept it.
_LONGEST = 2048
#: Number of messages that may wait.
_WAITING = 10_000
#: Time limit for connecting and for sending, and pauses between attempts, s.
_PATIENCE, _FIRST_PAUSE, _LONGEST_PAUSE = 5.0, 0.5, 30.0
#: After this number, the numbers restart at 1 (section 7.3.1).
_LAST_NUMBER = 2_147_483_647


@dataclass(frozen=True)
class Receiver:
    """Destination of messages: transport (``udp``, ``tcp``, ``tls``), host, port, TLS authority."""

    scheme: str
    host: str
    port: int
    authority: Path | None = None

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.scheme}://{host}:{self.port}"

    @classmethod
    def read(cls, url: str, authority: Path | None = None) -> "Receiver":
        """Return the receiver from a URL; its certificate is checked against the authority.

        Raises
        ------
        InputError
            If the URL is not a receiver URL, or the authority cannot be used.
        """
        try:
            parts = urlsplit(url)
            host, port = parts.hostname, parts.port
        except ValueError:
            host = port = None
        if not host or parts.scheme not in _PORTS or parts.path.strip("/") or port == 0:
            raise InputError(
                f"syslog {url!r}: specify udp://host, tcp://host or tls://host, with :port unless "
                f"it is 514, 601 or 6514"
            )
        if authority is not None:
            if parts.scheme != "tls":
                raise InputError(
                    f"syslog {url}: a certificate authority can be used only with tls://"
                )
            client_tls(authority)
        return cls(parts.scheme, host, port or _PORTS[parts.scheme], authority)


@dataclass(frozen=True)
class _Message:
    """A message without its number."""

    priority: int
    at: float
    identifier: str
    text: str

    def octets(self, number: int, host: str) -> bytes:
        """Return the message in the format of RFC 5424, section 6."""
        at = datetime.fromtimestamp(self.at, UTC).isoformat(timespec="milliseconds")
        head = (
            f"<{self.priority}>1 {at.replace('+00:00', 'Z')} {host} heliotrope {os.getpid()} "
            f'{self.identifier} [meta sequenceId="{number}"] '
        )
        text = "".join(c if c.isprintable() else " " for c in self.text)
        made = head.encode() + b"\xef\xbb\xbf" + text.encode(errors="replace")
        # Cut at a character boundary.
        return made[:_LONGEST].decode(errors="ignore").encode()


class Syslog:
    """Sends messages to a receiver.

    Parameters
    ----------
    receiver
        Destination of the messages.
    now
        Function that returns the time of an alarm, POSIX s.
    most
        Maximum number of waiting messages.

    Attributes
    ----------
    receiver
        As given.
    lost
        Number of messages for which there was no room in the queue.
    problem
        Why messages cannot be sent now; empty if they can.
    """

    def __init__(self, receiver: Receiver, now: Callable[[], float], most: int = _WAITING) -> None:
        self.receiver, self._now = receiver, now
        self.lost, self.problem = 0, ""
        self._told, self._number = 0, 0
        self._waiting: queue.Queue[_Message] = queue.Queue(most)
        self._socket: socket.socket | None = None
        self._ending = threading.Event()
        self._host = _host_name()
        self._thread = threading.Thread(target=self._run, name="plant syslog", daemon=True)
        self._thread.start()

    # -- from the plant's loop -------------------------------------------------------------

    def note(self, note: SecurityNote) -> None:
        """Send a security event."""
        who = f" by {note.who}" if note.who else ""
        self._put(_SECURITY, note.kind.severity, note.at, note.kind.name, f"{note.text}{who}")

    def alarm(self, alarm: Alarm) -> None:
        """Report that an alarm begins or has ended."""
        about = f" {alarm.subject}" if alarm.subject else ""
        text = f"{alarm.condition}{about}: {alarm.text}" + ("" if alarm.active else " (over)")
        severity = alarm.severity if alarm.active else Severity.INFO
        self._put(_LOCAL, severity, self._now(), alarm.condition, text)

    def _put(self, facility: int, severity: Severity, at: float, name: str, text: str) -> None:
        made = _Message(8 * facility + _SEVERITIES[Severity(severity)], at, name[:32], text)
        try:
            self._waiting.put_nowait(made)
        except queue.Full:
            self.lost += 1

    def close(self, timeout: float = 5.0) -> None:
        """Send the waiting messages, for at most ``timeout`` s, and end."""
        self._ending.set()
        self._thread.join(timeout)

    # -- the thread ------------------------------------------------------------------------

    def _run(self) -> None:
        pause = _FIRST_PAUSE
        message: _Message | None = None
        while True:
            try:
                message = message or self._next()
                if message is None:
                    break
                self._send(message)
            except OSError as error:
                self.problem = f"{self.receiver} ({error.strerror or error})"
                self._disconnect()
                if self._ending.wait(pause) and pause > _FIRST_PAUSE:
                    break  # waiting messages are lost with the program
                pause = min(2.0 * pause, _LONGEST_PAUSE)
            else:
                self.problem, message, pause = "", None, _FIRST_PAUSE
        self._disconnect()

    def _next(self) -> _Message | None:
        """Wait for the next message; None at the end.

        Lost messages are reported before the messages that follow them.
        """
        if self.lost > self._told and self._waiting.qsize() <= self._waiting.maxsize // 2:
            count, self._told = self.lost - self._told, self.lost
            text = (
                f"{count} messages were lost because more than {self._waiting.maxsize} were waiting"
            )
            return _Message(8 * _LOCAL + 4, self._now(), "LOST", text)
        while not self._ending.is_set():
            with contextlib.suppress(queue.Empty):
                return self._waiting.get(timeout=0.2)
            self._look()
        with contextlib.suppress(queue.Empty):
            return self._waiting.get_nowait()
        return None

    def _look(self) -> None:
        """Detect, between messages, that the receiver has closed the connection."""
        if self._socket is None or self.receiver.scheme == "udp":
            return
        self._socket.settimeout(0.0)
        try:
            ended = not self._socket.recv(4096)
        except (BlockingIOError, ssl.SSLWantReadError):
            ended = False
        finally:
            self._socket.settimeout(_PATIENCE)
        if ended:
            raise OSError("the receiver ended the connection")

    def _send(self, message: _Message) -> None:
        made = message.octets(self._number % _LAST_NUMBER + 1, self._host)
        if self._socket is None:
            self._socket = self._connect()
        elif self.receiver.scheme != "udp":
            self._look()
        if self.receiver.scheme == "udp":
            self._socket.send(made)
        else:
            self._socket.sendall(b"%d %s" % (len(made), made))
        self._number += 1

    def _connect(self) -> socket.socket:
        to = self.receiver
        if to.scheme == "udp":
            family, kind, *_, place = socket.getaddrinfo(to.host, to.port, type=socket.SOCK_DGRAM)[
                0
            ]
            made = socket.socket(family, kind)
            made.connect(place)
            return made
        made = socket.create_connection((to.host, to.port), timeout=_PATIENCE)
        if to.scheme == "tcp":
            return made
        try:
            # Created for each connection, so that a renewed authority takes effect at once.
            tls = ssl.create_default_context() if to.authority is None else client_tls(to.authority)
            return tls.wrap_socket(made, server_hostname=to.host)
        except InputError as error:
            made.close()
            raise OSError(str(error)) from None
        except OSError:
            made.close()
            raise

    def _disconnect(self) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.close()
            self._socket = None


def _host_name() -> str:
    """Return this computer's name in printable ASCII, as the header requires."""
    name = "".join(c for c in socket.gethostname() if "!" <= c <= "~")
    return name[:255] or "-"
