"""Whether the user of a session is still present: locks a page that was left open.

A page that has sent no orders for a while continues to show the field, but its next order requires
the user's password again. EMERGENCY, DEFOCUS and STOW never require it. Automatic requests do not
count as orders, because a page renews the command authority by itself every few seconds.
"""

from collections import OrderedDict
from collections.abc import Callable

#: Number of sessions that are remembered; the least recently used are dropped first, and then count
#: as new.
_MOST = 2000


class Presence:
    """The times of the last orders of sessions.

    Parameters
    ----------
    idle_s
        Time after which a person must confirm their presence, s; 0 for never.
    monotonic
        Function that returns the time, s.
    """

    def __init__(self, idle_s: float, monotonic: Callable[[], float]) -> None:
        self._idle, self._now = idle_s, monotonic
        self._last: OrderedDict[str, float] = OrderedDict()

    def away(self, secret: str) -> bool:
        """Return whether a session has sent no order for too long.

        For an unknown session, the time begins now.
        """
        now = self._now()
        return 0.0 < self._idle <= now - self._last.setdefault(secret, now)

    def seen(self, secret: str) -> None:
        """Record that the person of a session is present."""
        self._last[secret] = self._now()
        self._last.move_to_end(secret)
        if len(self._last) > _MOST:
            self._last.popitem(last=False)
