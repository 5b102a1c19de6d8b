"""Emergency orders of users: one per user, until it is withdrawn.

An order that a person repeats merges with the active one and is neither recorded nor sent again, so
that a program that repeats it hundreds of times a second cannot fill the store or the event list.
If an order is withdrawn while its author (or a program with the author's token) keeps repeating it,
or is withdrawn by others five times within ten minutes, that person's next order is accepted only
after a pause. Nobody else is affected. A person's first order is never refused, nor is the first
order after another person has withdrawn that person's order.
"""

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

from heliotrope.plant import refusals
from heliotrope.plant.emergency.standing import Call
from heliotrope.safety import Act

#: An order counts as being repeated if it was given this often within a time, s.
REPEATED, REPEATED_SPAN = 10, 10.0
#: The first pause, s; each later pause is twice as long, up to the longest.
PAUSE, LONGEST_PAUSE = 30.0, 480.0
#: Number of withdrawals by others after which a person must pause. With fewer, the person may have
#: a good reason to repeat the order.
MOST_WITHDRAWN = 5
#: Withdrawals count for this long after the last one, s.
REMEMBERED = 600.0
#: Number of reasons stored for one order.
MOST_REASONS = 5
_BETWEEN = "; "


@dataclass
class _History:
    """History of one person's orders: when they were issued, repeated and withdrawn."""

    given: deque[float] = field(default_factory=lambda: deque(maxlen=REPEATED))
    merged: int = 0
    strikes: int = 0
    struck: float = -math.inf
    until: float = -math.inf


class Callers:
    """The persons whose emergency orders are active.

    Parameters
    ----------
    calls
        Orders that were active when the last program ended.
    """

    def __init__(self, calls: Iterable[Call] = ()) -> None:
        self._calls = {call.who: call for call in calls}
        self._histories: dict[str, _History] = {}

    @property
    def calls(self) -> tuple[Call, ...]:
        """The active orders, one for each person."""
        return tuple(self._calls.values())

    def pause(self, who: str, now: float) -> float:
        """Return the time until an order of a person is accepted, s; 0 if it is accepted now."""
        history = self._histories.get(who)
        if history is None or who in self._calls:
            return 0.0
        return max(0.0, history.until - now)

    def take(self, who: str, act: Act, reason: str, at: float, now: float) -> bool:
        """Accept an order of a person.

        Parameters
        ----------
        who, act, reason
            As for `Call`. If a person orders again, the stronger action and all reasons are kept.
        at, now
            The time of the order, POSIX s, and the present time, monotonic s.

        Returns
        -------
        Whether the order goes beyond the active one.

        Raises
        ------
        RefusedError
            If the person must pause.
        """
        if (wait := self.pause(who, now)) > 0.0:
            raise refusals.EMERGENCY_PAUSED.error(who=who, wait=math.ceil(wait))
        history, before = self._histories.setdefault(who, _History()), self._calls.get(who)
        history.given.append(now)
        if before is None:
            history.merged = 0
            self._calls[who] = Call(who, reason, act.name, at)
            return True
        reasons, stronger = before.reason, max(act, Act[before.act])
        known = f"{_BETWEEN}{reasons}{_BETWEEN}"
        if f"{_BETWEEN}{reason}{_BETWEEN}" not in known and known.count(_BETWEEN) <= MOST_REASONS:
            reasons = f"{reasons}{_BETWEEN}{reason}"
        self._calls[who] = Call(who, reasons, stronger.name, before.at)
        new = self._calls[who] != before
        history.merged += not new
        return new

    def withdraw(self, who: str, by: str, now: float) -> str:
        """Withdraw a person's order.

        Returns
        -------
        A message for the operator: how often the order was repeated, and when the person's next
        order is accepted.
        """
        self._calls.pop(who, None)
        self._histories = {
            name: one
            for name, one in self._histories.items()
            if name == who or name in self._calls or now < one.struck + REMEMBERED
        }
        history = self._histories.setdefault(who, _History())
        if now >= history.struck + REMEMBERED:
            history.strikes = 0
        often = len(history.given) == REPEATED and now - history.given[0] < REPEATED_SPAN
        text = f"the order was repeated {history.merged:,} times" if history.merged else ""
        if often or by != who:
            history.strikes = max(history.strikes + 1, MOST_WITHDRAWN if often else 0)
            history.struck = now
            if (more := history.strikes - MOST_WITHDRAWN) >= 0:
                pause = min(LONGEST_PAUSE, PAUSE * 2.0**more)
                history.until = now + pause
                text += f"{text and _BETWEEN}{who}'s next order is accepted in {pause:.0f} s"
        history.merged = 0
        return text
