"""Security events of a plant: recorded as events, forwarded, and monitored for patterns.

Anyone can cause any number of events of some kinds. Events of one kind and user are therefore
recorded at most `MOST` times in a `SPAN`; the rest are counted, and one event states the count. The
events of one user never displace those of another.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from heliotrope.links.clock import Clock
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.safety import AlarmKind, Severity, alarms

#: Kind of these events in the store and on the page.
KIND = "security"
#: Maximum number of events of one kind and user that are recorded individually in a span.
MOST = 30
#: The same for all users together.
MOST_OF_ALL = 300
#: Length of a span, s.
SPAN = 60.0
#: Number of refused orders that raise an alarm, and the span in which they count, s.
ORDERS, ORDERS_SPAN = 5, 300.0
#: An alarm ends after this time without a cause, s.
QUIET = 600.0
_LONGEST = 100


class SecurityEvent(Enum):
    """Kinds of security events: display text and severity."""

    SIGNED_IN = ("signed in", Severity.INFO)
    SIGN_IN_FAILED = ("failed to sign in", Severity.WARNING)
    LOCKED_OUT = ("sign-ins refused after too many failures", Severity.WARNING)
    SIGNED_OUT = ("signed out", Severity.INFO)
    SESSION_ENDED = ("session expired", Severity.INFO)
    TOKEN_ENDED = ("token expired", Severity.INFO)
    PASSWORD_CHANGED = ("changed their own password", Severity.INFO)
    PASSWORD_RESET = ("created a new password", Severity.WARNING)
    ACCOUNT_MADE = ("created an account", Severity.WARNING)
    ACCOUNT_CHANGED = ("changed an account", Severity.WARNING)
    TOKEN_MADE = ("created a token", Severity.INFO)
    TOKEN_REVOKED = ("revoked a token", Severity.INFO)
    TOKEN_REFUSED = ("a token was refused", Severity.WARNING)
    CONFIRMATION_FAILED = ("entered a wrong password for an account change", Severity.WARNING)
    FACTOR_CHANGED = ("changed a second factor", Severity.WARNING)
    ORDER_REFUSED = ("order refused: the role is too low", Severity.WARNING)
    HOST_REFUSED = ("request for an unknown host name refused", Severity.WARNING)
    ORIGIN_REFUSED = ("request from another site refused", Severity.WARNING)
    LINK_REFUSED = ("link refused", Severity.WARNING)
    BACKED_UP = ("made a backup", Severity.INFO)
    EXPORTED = ("exported calibrations", Severity.INFO)
    QUERIED = ("queried the telemetry", Severity.INFO)
    KEYS_RENEWED = ("keys or certificates renewed", Severity.WARNING)
    CHAIN_HEAD = ("head of the records' hash chains", Severity.INFO)

    @property
    def words(self) -> str:
        """Display text."""
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
        """The event in one line: what happened, to what, and from where."""
        about = f": {self.detail}" if self.detail else ""
        return f"{self.kind.words}{about}" + (f" (from {self.address})" if self.address else "")


@dataclass
class _Span:
    """A time span: its start, s, and its numbers of recorded and unrecorded events."""

    begun: float
    recorded: int = 0
    more: int = 0


class EventCounter:
    """Decides which security events are recorded individually; counts the rest by kind and user."""

    def __init__(self) -> None:
        self._spans: dict[tuple[SecurityEvent, str | None], _Span] = {}

    def admits(self, kind: SecurityEvent, who: str, now: float, count: int = 1) -> bool:
        """Whether an event, or a total of ``count`` events, is recorded rather than counted."""
        person, everybody = self._span((kind, who), now), self._span((kind, None), now)
        if person.recorded < MOST and everybody.recorded < MOST_OF_ALL:
            person.recorded += 1
            everybody.recorded += 1
            return True
        self.count(kind, who, now, count)
        return False

    def count(self, kind: SecurityEvent, who: str, now: float, count: int) -> None:
        """Add events to the total of their kind and user."""
        self._span((kind, who), now).more += count

    def sums(self, now: float, *, all_: bool = False) -> list[tuple[SecurityEvent, str, int]]:
        """Return the kind, the user and the number of events counted in expired (or all) spans."""
        over = [key for key, span in self._spans.items() if all_ or now - span.begun >= SPAN]
        spans = [(*key, self._spans.pop(key).more) for key in over]
        return [(kind, who, more) for kind, who, more in spans if who is not None and more]

    def _span(self, key: tuple[SecurityEvent, str | None], now: float) -> _Span:
        span = self._spans.setdefault(key, _Span(now))
        if now - span.begun >= SPAN:
            span.begun, span.recorded = now, 0
        return span


class SecurityLog:
    """Records security events, and raises alarms about patterns; used in the plant's event loop.

    Parameters
    ----------
    logbook
        Logbook of events and alarms.
    clock
        Clock of the plant.

    Attributes
    ----------
    forward
        Function called with each recorded note; None: no function.
    """

    def __init__(self, logbook: Logbook, clock: Clock) -> None:
        self._log, self._clock = logbook, clock
        self.forward: Callable[[SecurityNote], None] | None = None
        self._counter = EventCounter()
        self._orders: deque[float] = deque(maxlen=ORDERS)
        self._until: dict[AlarmKind, float] = {}
        self._link = ""

    def _utc(self) -> float:
        return self._clock.utc().timestamp()

    def note(
        self, kind: SecurityEvent, who: str = "", address: str = "", detail: str = "", more: int = 0
    ) -> None:
        """Record an event, unless there were too many of its kind recently.

        A console passes the number of further events that it has counted as ``more``.
        """
        text = _sum_of(more) if more else plain(detail)
        made = SecurityNote(kind, self._utc(), plain(who), plain(address), text)
        now = self._clock.monotonic()
        self._watch(made, now)
        if self._counter.admits(kind, made.who, now, more or 1):
            self._record(made)

    def close(self) -> None:
        """Record the totals of events counted so far."""
        self._sum_up(all_=True)

    def _sum_up(self, *, all_: bool = False) -> None:
        for kind, who, more in self._counter.sums(self._clock.monotonic(), all_=all_):
            self._record(SecurityNote(kind, self._utc(), who, "", _sum_of(more)))

    def _record(self, made: SecurityNote) -> None:
        self._log.event(KIND, made.who, made.text, made.kind.severity)
        if self.forward is not None:
            self.forward(made)

    def look(self, refused_link: str = "") -> None:
        """Clear alarms whose causes have gone; record links refused since the last call.

        Totals of events that were not recorded individually are recorded once their minute is over.
        """
        self._sum_up()
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


def _sum_of(more: int) -> str:
    return f"{more} more in a minute"


def plain(text: str) -> str:
    """Return an untrusted text as one printable line of bounded length."""
    shown = "".join(c if c.isprintable() else "?" for c in text)
    return shown if len(shown) <= _LONGEST else shown[: _LONGEST - 1] + "…"
