"""The valid sessions and tokens with their owners: a snapshot, read from the store as needed.

A caller in the snapshot is recognised at once, even by a process that has never served that caller.
An unknown secret waits for the next read, which all such requests share, so requests from strangers
slow down neither the store nor known callers. If the store does not respond, the last snapshot
determines who may order an EMERGENCY.
"""

import asyncio
import contextlib
import hashlib
import math
import time
from collections.abc import Awaitable, Callable, Mapping
from typing import Generic, TypeVar

from heliotrope.errors import HeliotropeError

#: Time for which a snapshot is trusted, and for EMERGENCY alone, s.
TRUSTED, LONG_TRUSTED = 5.0, 3600.0
#: Minimum pause between two reads, and maximum pause if there are no requests, s.
_PAUSE, _PERIOD = 0.25, 2.5
#: An EMERGENCY waits this long for a read, s.
_WAITS = 1.0

T = TypeVar("T")
#: "session" or "token", and the SHA-256 of its secret.
Key = tuple[str, str]


class Roster(Generic[T]):
    """The valid sessions and tokens.

    Parameters
    ----------
    read
        Function that returns the owner of each session and token, given the keys of the tokens used
        since the last read. It raises `HeliotropeError` if the store does not respond.
    monotonic
        Function that returns the time, s.
    """

    def __init__(
        self,
        read: Callable[[list[str]], Awaitable[Mapping[Key, T]]],
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._read, self._now = read, monotonic
        self._kept: Mapping[Key, T] = {}
        #: When the read of the snapshot began, and the earliest acceptable start of a read, s.
        self._at = self._least = -math.inf
        self._used = set[str]()
        self._wanted = asyncio.Event()
        self._waiting: list[asyncio.Future[None]] = []

    async def run(self) -> None:
        """Read the store whenever a request waits, and from time to time, until cancelled."""
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_PERIOD):
                    await self._wanted.wait()
            self._wanted.clear()
            await self._read_once()
            await asyncio.sleep(_PAUSE)

    async def _read_once(self) -> None:
        """Read the store, and answer the requests that were already waiting."""
        waiting, self._waiting = self._waiting, []
        used, self._used = self._used, set()
        begun, problem = self._now(), None
        try:
            self._kept, self._at = await self._read(sorted(used)), begun
        except HeliotropeError as error:
            self._used |= used
            problem = error
        for one in waiting:
            if one.done():  # the waiting caller has left
                continue
            if problem is None:
                one.set_result(None)
            else:
                one.set_exception(problem)

    async def find(self, by: str, secret: str) -> T | None:
        """Return the owner of a secret, a "session" or "token"; None if nobody owns it.

        Raises
        ------
        HeliotropeError
            If the store does not respond.
        """
        key = _key(by, secret)
        if key not in self._kept or self._at < max(self._now() - TRUSTED, self._least):
            waiting: asyncio.Future[None] = asyncio.get_running_loop().create_future()
            self._waiting.append(waiting)
            self._wanted.set()
            await waiting
        if by == "token" and key in self._kept:
            self._used.add(key[1])
        return self._kept.get(key)

    async def find_for_emergency(self, by: str, secret: str) -> T | None:
        """Return the owner of a secret like `find`.

        If the store does not reply, the last known owner is returned.
        """
        try:
            async with asyncio.timeout(_WAITS):
                return await self.find(by, secret)
        except (HeliotropeError, TimeoutError) as error:
            last = self._kept.get(_key(by, secret))
            if last is None or self._at < self._now() - LONG_TRUSTED:
                why = str(error) or "no answer"
                raise HeliotropeError(f"the store cannot say who this is ({why})") from None
            return last

    def forget(self) -> None:
        """Accept no caller on the basis of the present snapshot, because something has changed."""
        self._least = self._now()


def _key(by: str, secret: str) -> Key:
    return by, hashlib.sha256(secret.encode(errors="replace")).hexdigest()
