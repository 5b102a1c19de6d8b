"""Attempts: what automatic control retries, how often, and what happens after the last failure.

Work that may fail is retried by one rule: each consecutive failure lengthens the wait, and after
the last attempt the work is *given up* with an alarm that names the reason and the next step.
Given-up work is tried once more after a pause, and starts afresh when new information arrives from
an operator or a program (`Attempts.renew`).

This module reads no clock: times are arguments, all from one clock.
"""

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from heliotrope.safety import Alarm, alarms


@dataclass(frozen=True)
class RetryLaw:
    """The rule by which one kind of work is retried.

    Attributes
    ----------
    work
        What is tried, for display.
    most
        Number of consecutive failures after which it is given up.
    wait, growth, longest
        Wait after the first failure, s; the factor by which each further wait grows; and the
        longest wait, s.
    rest
        Time until work that was given up is tried once more, s; infinite: it is not tried again
        automatically.
    memory
        Time after which an earlier failure no longer counts, s.
    following
        What follows once it is given up: a clause for display.
    alarm
        Alarm raised when it is given up; None: what follows needs no operator.
    """

    work: str
    most: int
    wait: float
    following: str
    growth: float = 2.0
    longest: float = math.inf
    rest: float = math.inf
    memory: float = math.inf
    alarm: alarms.AlarmKind | None = None


@dataclass(frozen=True)
class Retry:
    """Work that has failed and is not done yet.

    Attributes
    ----------
    work, subject
        What is tried, and the heliostat, target, receiver or part of the work.
    count, most
        Number of consecutive failures, and the number after which it is given up.
    reason
        Why it failed last.
    left
        Time until the next attempt, s; 0: at the next opportunity; infinite: no automatic attempt.
    given_up
        Whether it was given up.
    following
        What follows when it is given up.
    """

    work: str
    subject: str
    count: int
    most: int
    reason: str
    left: float
    given_up: bool
    following: str


@dataclass(frozen=True)
class _Failed:
    """Failures of one subject: their number, the last reason, its time, and the next attempt."""

    count: int
    reason: str
    at: float
    next_at: float


class Attempts:
    """The failures of one kind of work, by subject.

    Parameters
    ----------
    law
        See `RetryLaw`.
    tell
        Called with each alarm; None: there are no alarms.
    """

    def __init__(self, law: RetryLaw, tell: Callable[[Alarm], None] | None = None) -> None:
        self.law, self._tell = law, tell
        self._failed: dict[str, _Failed] = {}
        self._named: set[str] = set()

    def report_to(self, tell: Callable[[Alarm], None]) -> None:
        """Call the given function with each alarm from now on."""
        self._tell = tell

    # -- results ---------------------------------------------------------------------------

    def failed(self, subject: str, reason: str, now: float) -> None:
        """Note a failure; after the last attempt the work is given up."""
        before = self._failed.get(subject)
        fresh = before is None or now - before.at > self.law.memory
        self._note(subject, reason, now, 1 if fresh or before is None else before.count + 1)

    def give_up(self, subject: str, reason: str, now: float) -> None:
        """Give the work up without a further try."""
        self._note(subject, reason, now, self.law.most)

    def _note(self, subject: str, reason: str, now: float, count: int) -> None:
        law, count = self.law, min(count, self.law.most)
        over = count >= law.most
        wait = law.rest if over else min(law.wait * law.growth ** (count - 1), law.longest)
        self._failed[subject] = _Failed(count, reason, now, now + wait)
        if over and law.alarm is not None and self._tell is not None:
            self._named.add(subject)
            self._tell(law.alarm.raised(subject, reason=reason, count=count))

    def done(self, subject: str) -> None:
        """Note that the work has succeeded, or is no longer wanted; its alarm ends."""
        self._failed.pop(subject, None)
        if subject in self._named and self.law.alarm is not None and self._tell is not None:
            self._named.discard(subject)
            self._tell(self.law.alarm.ended(subject))

    def renew(self, subjects: Iterable[str]) -> None:
        """Start afresh, because another attempt is wanted or more is known.

        An alarm stays until `done` is called.
        """
        for subject in subjects:
            self._failed.pop(subject, None)

    # -- what is due -----------------------------------------------------------------------

    @property
    def counts(self) -> Mapping[str, int]:
        """Number of consecutive failures, by subject; subjects without failures are left out."""
        return MappingProxyType({name: one.count for name, one in self._failed.items()})

    @property
    def given_up(self) -> Collection[str]:
        """The subjects that were given up."""
        return [name for name, one in self._failed.items() if one.count >= self.law.most]

    def waiting(self, now: float) -> Collection[str]:
        """Return the subjects whose next attempt is not due yet."""
        return [name for name, one in self._failed.items() if now < one.next_at]

    def due(self, subject: str, now: float) -> bool:
        """Return whether a subject may be tried now."""
        one = self._failed.get(subject)
        return one is None or now >= one.next_at

    def shown(self, now: float) -> tuple[Retry, ...]:
        """Return the work that awaits another attempt or was given up, for display."""
        law = self.law
        return tuple(
            Retry(
                law.work,
                name,
                one.count,
                law.most,
                one.reason,
                max(0.0, one.next_at - now),
                one.count >= law.most,
                law.following,
            )
            for name, one in self._failed.items()
        )
