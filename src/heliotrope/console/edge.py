"""Limits on the request rate, for strangers per address and for known callers per user."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from fastapi import HTTPException
from starlette.requests import HTTPConnection

from heliotrope.console.auth import Caller, Console, find_caller
from heliotrope.console.headers import STRANGER, STRANGERS, network_of
from heliotrope.local import Buckets

#: Request limit of one person: rate, 1/s, and burst.
KNOWN = (200.0, 1000.0)
#: Number of large bodies at the same time: from all, and from one person.
MOST_LARGE, OWN_LARGE = 4, 1


class Edge:
    """Counts requests before the application sees them.

    Parameters
    ----------
    monotonic
        Function that returns the time, s.
    """

    def __init__(self, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._stranger = Buckets(*STRANGER, monotonic)
        self._strangers = Buckets(*STRANGERS, monotonic)
        self._known = Buckets(*KNOWN, monotonic)
        self._large: list[str] = []

    async def find(self, console: Console, connection: HTTPConnection) -> Caller | None:
        """Return the caller of a request; None for a stranger.

        A known caller's request never counts as a stranger's request. Requests of strangers from an
        address where someone has signed in are counted separately from other addresses.

        Raises
        ------
        HTTPException
            429 if there are too many requests.
        """
        who = await find_caller(console, connection)
        if who is None:
            address = network_of(console.address(connection))
            _refuse(self._stranger.take(address))
            if not console.attempts.is_home(address):
                _refuse(self._strangers.take(""))
        return who

    def count(self, who: Caller) -> None:
        """Count a request of a known caller.

        Raises
        ------
        HTTPException
            429 if there are too many requests.
        """
        _refuse(self._known.take(who.person.name))

    @contextmanager
    def large(self, who: Caller) -> Iterator[None]:
        """Hold one of the few places for large bodies during a block.

        Raises
        ------
        HTTPException
            429 if all places are taken.
        """
        key = who.person.name
        if len(self._large) >= MOST_LARGE or self._large.count(key) >= OWN_LARGE:
            raise HTTPException(
                429, "another large request is being processed; try again", {"Retry-After": "1"}
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
