"""Security events of a plant: recorded as events, sent on, and watched for patterns.

A stranger can cause any number of some kinds, so each kind is recorded at most `MOST` times in a
`SPAN`; the rest are counted, and one event says how many there were.
"""

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from heliotrope.links.clock import Clock
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.safety import AlarmKind, Severity, alarms

#: Kind of these events in the store and in the page.
KIND = "security"
#: Most events of one kind that are recorded singly in a span, s.
MOST, SPAN = 30, 60.0
#: Refused orders within a span, s, that raise an alarm.
ORDERS, ORDERS_SPAN = 5, 300.0
#: An alarm ends after this time without a cause, s.
QUIET = 600.0
_LONGEST = 100


class SecurityEvent(Enum):
    """Kinds of security events: words for people, and severity."""

    SIGNED_IN = ("signed in", Severity.INFO)
    SIGN_IN_FAILED = ("failed to sign in", Severity.WARNING)
    LOCKED_OUT = ("sign-ins refused after too many failures", Severity.WARNING)
    SIGNED_OUT = ("signed out", Severity.INFO)
    SESSION_ENDED = ("session expired", Severity.INFO)
    TOKEN_ENDED = ("token expired", Severity.INFO)
    PASSWORD_CHANGED = ("changed their own password", Severity.INFO)
    PASSWORD_RESET = ("made a new password", Severity.WARNING)
    ACCOUNT_MADE = ("made an account", Severity.WARNING)
    ACCOUNT_CHANGED = ("changed an account", Severity.WARNING)
    TOKEN_MADE = ("made a token", Severity.INFO)
    TOKEN_REVOKED = ("revoked a token", Severity.INFO)
    TOKEN_REFUSED = ("a token was refused", Severity.WARNING)
    CONFIRMATION_FAILED = ("gave a wrong password for a change of accounts", Severity.WARNING)
    FACTOR_CHANGED = ("changed a second factor", Severity.WARNING)
    ORDER_REFUSED = ("order refused: the role is too low", Severity.WARNING)
    HOST_REFUSED = ("request for an unknown host name refused", Severity.WARNING)
    ORIGIN_REFUSED = ("request from another site refused", Severity.WARNING)
    LINK_REFUSED = ("link refused", Severity.WARNING)
    CHAIN_HEAD = ("head of the records' chains", Severity.INFO)

    @property
    def words(self) -> str:
        """Text for people."""
        return self.value[0]

    @property
    def severity(self) -> Severity:
        """Severity of the event."""
        return self.value[1]


@dataclass(frozen=True)
class SecurityNote:
    """One security event: kind, time (POSIX s), person, address of the caller, and details."""

    kind: SecurityEvent
    at: float
    who: str
    address: str
    detail: str

    @property
    def text(self) -> str:
        """One line: what happened, to what, and from where."""
        about = f": {self.detail}" if self.detail else ""
        return f"{self.kind.words}{about}" + (f" (from {self.address})" if self.address else "")


class SecurityLog:
    """Records security events, and raises alarms about patterns of them; used in the plant's loop.

    Parameters
    ----------
    logbook
        Takes events and alarms.
    clock
        Clock of the plant.

    Attributes
    ----------
    forward
        Takes each note that is recorded; None: nobody.
    """

    def __init__(self, logbook: Logbook, clock: Clock) -> None:
        self._log, self._clock = logbook, clock
        self.forward: Callable[[SecurityNote], None] | None = None
        self._recorded: dict[SecurityEvent, deque[float]] = {}
        self._more: dict[SecurityEvent, int] = {}
        self._orders: deque[float] = deque(maxlen=ORDERS)
        self._until: dict[AlarmKind, float] = {}
        self._link = ""

    def _utc(self) -> float:
        return self._clock.utc().timestamp()

    def note(self, kind: SecurityEvent, who: str = "", address: str = "", detail: str = "") -> None:
        """Record an event of a kind, unless there were too many of it lately."""
        made = SecurityNote(kind, self._utc(), plain(who), plain(address), plain(detail))
        now = self._clock.monotonic()
        self._watch(made, now)
        times = self._recorded.setdefault(kind, deque(maxlen=MOST))
        if len(times) == MOST and now - times[0] < SPAN:
            if not self._more.get(kind):
                asyncio.get_running_loop().call_later(SPAN, self._sum_up, kind)
            self._more[kind] = self._more.get(kind, 0) + 1
            return
        times.append(now)
        self._record(made)

    def _sum_up(self, kind: SecurityEvent) -> None:
        count = self._more.pop(kind, 0)
        self._record(SecurityNote(kind, self._utc(), "", "", f"at least {count} more in a minute"))

    def _record(self, made: SecurityNote) -> None:
        self._log.event(KIND, made.who, made.text, made.kind.severity)
        if self.forward is not None:
            self.forward(made)

    def look(self, refused_link: str = "") -> None:
        """End alarms whose causes have ceased; note a link that was refused since the last look."""
        now = self._clock.monotonic()
        for kind in [kind for kind, until in self._until.items() if now >= until]:
            del self._until[kind]
            self._log.take_alarm(kind.ended())
        if refused_link and refused_link != self._link:
            self.note(SecurityEvent.LINK_REFUSED, detail=refused_link)
        self._link = refused_link

    def _watch(self, made: SecurityNote, now: float) -> None:
        if made.kind is SecurityEvent.LOCKED_OUT:
            name = made.who or "an unknown name"
            self._raise(alarms.LOCKOUT, now, name, made.address)
        if made.kind is SecurityEvent.ORDER_REFUSED:
            self._orders.append(now)
            if len(self._orders) == ORDERS and now - self._orders[0] <= ORDERS_SPAN:
                self._raise(alarms.ORDERS_REFUSED, now, made.who, made.address)

    def _raise(self, kind: AlarmKind, now: float, who: str, address: str) -> None:
        if kind not in self._until:
            self._log.take_alarm(kind.raised(who=who, address=address or "this machine"))
        self._until[kind] = now + QUIET


def plain(text: str) -> str:
    """Return a stranger's text as one line of bounded length."""
    shown = "".join(c if c.isprintable() else "?" for c in text)
    return shown if len(shown) <= _LONGEST else shown[: _LONGEST - 1] + "…"
