"""How often callers may send requests: strangers by address, known callers by session or token."""

import math
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from fastapi import HTTPException
from starlette.requests import HTTPConnection

from heliotrope.console.auth import Caller, Console, find_caller
from heliotrope.console.headers import STRANGER, STRANGERS, address_of, network_of, secret_of
from heliotrope.local import Buckets

#: Requests of one session or token; 1/s, and at once.
KNOWN = (200.0, 1000.0)
#: Large bodies at the same time: from all, and of one session or token.
MOST_LARGE, OWN_LARGE = 4, 1
#: Sessions and tokens that are remembered as having been valid.
_MOST_SEEN = 4096


class Edge:
    """Counts requests before the application sees them.

    Parameters
    ----------
    monotonic
        Returns the time, s.
    """

    def __init__(self, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._stranger = Buckets(*STRANGER, monotonic)
        self._strangers = Buckets(*STRANGERS, monotonic)
        self._known = Buckets(*KNOWN, monotonic)
        self._admitted: OrderedDict[tuple[str, str], None] = OrderedDict()
        self._large: list[tuple[str, str]] = []

    async def find(self, console: Console, connection: HTTPConnection) -> Caller | None:
        """Return the caller, None for a stranger.

        A secret that was valid before is looked up at once. Any other one counts as a stranger's
        request first: a look at the store costs the plant something.

        Raises
        ------
        HTTPException
            429 if requests come too often.
        """
        secret = secret_of(console.settings, connection)
        if secret is None or secret not in self._admitted:
            self._count_stranger(console, connection)
        who = None if secret is None else await find_caller(console, connection)
        if secret is None or who is None:
            self._admitted.pop(secret or ("", ""), None)
            return None
        self._admitted[secret] = None
        self._admitted.move_to_end(secret)
        if len(self._admitted) > _MOST_SEEN:
            self._admitted.popitem(last=False)
        return who

    def _count_stranger(self, console: Console, connection: HTTPConnection) -> None:
        address = network_of(address_of(console.settings, connection))
        _refuse(self._stranger.take(address) or self._strangers.take(""))

    def count(self, who: Caller) -> None:
        """Count a request of a known caller.

        Raises
        ------
        HTTPException
            429 if requests come too often.
        """
        _refuse(self._known.take(f"{who.by} {who.secret}"))

    @contextmanager
    def large(self, who: Caller) -> Iterator[None]:
        """Hold one of the few places for large bodies.

        Raises
        ------
        HTTPException
            429 if all are taken.
        """
        key = (who.by, who.secret)
        if len(self._large) >= MOST_LARGE or self._large.count(key) >= OWN_LARGE:
            raise HTTPException(
                429, "another large request is at work; try again", {"Retry-After": "1"}
            )
        self._large.append(key)
        try:
            yield
        finally:
            self._large.remove(key)


def _refuse(wait: float) -> None:
    if wait > 0.0:
        raise HTTPException(
            429, "too many requests", {"Retry-After": str(math.ceil(wait)), "Connection": "close"}
        )
