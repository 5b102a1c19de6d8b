"""Whether the user of a session is still present: locks a page that was left open.

A page that has given no orders for a while continues to show the field, but its next order requires
the user's password again. EMERGENCY, DEFOCUS and STOW never do. Automatic requests of a page do not
count, because it renews the command authority every few seconds.
"""

from collections import OrderedDict
from collections.abc import Callable

#: Number of sessions that are remembered; the least recently used are dropped first, and then count
#: as new.
_MOST = 2000


class Presence:
    """The last orders of sessions.

    Parameters
    ----------
    idle_s
        Time after which a person must confirm their presence, s; 0: never.
    monotonic
        Function that returns the time, s.
    """

    def __init__(self, idle_s: float, monotonic: Callable[[], float]) -> None:
        self._idle, self._now = idle_s, monotonic
        self._last: OrderedDict[str, float] = OrderedDict()

    def away(self, secret: str) -> bool:
        """Whether a session has ordered nothing for too long; an unknown session begins now."""
        now = self._now()
        return 0.0 < self._idle <= now - self._last.setdefault(secret, now)

    def seen(self, secret: str) -> None:
        """Note that the person of a session is present."""
        self._last[secret] = self._now()
        self._last.move_to_end(secret)
        if len(self._last) > _MOST:
            self._last.popitem(last=False)
