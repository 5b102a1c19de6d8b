"""The valid sessions and tokens with their owners: a snapshot, read from the store as needed.

A caller in the snapshot is recognised at once, even by a process that has never served that caller.
An unknown secret waits for the next read, which all such requests share, so requests from strangers
slow down neither the store nor known callers. If the store does not respond, the last snapshot
determines who may continue, because a store that fails must not blind the control room; the plant
itself sends no new motion without its record.
"""

import asyncio
import contextlib
import hashlib
import math
import time
from collections.abc import Awaitable, Callable, Mapping
from typing import Generic, TypeVar

from heliotrope.errors import HeliotropeError

#: Time for which a snapshot is trusted, and while the store does not respond, s.
TRUSTED, LONG_TRUSTED = 5.0, 3600.0
#: Minimum pause between two reads, and maximum pause if there are no requests, s.
_PAUSE, _PERIOD = 0.25, 2.5
#: An EMERGENCY, and everyone in the snapshot, waits this long for a read, s.
_WAITS = 1.0
#: Others wait this long, s.
_LONGEST = 5.0

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
        #: When the read under way began, s; None: there is none.
        self._reading_since: float | None = None
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
        self._reading_since = begun
        try:
            self._kept, self._at = await self._read(sorted(used)), begun
        except HeliotropeError as error:
            self._used |= used
            problem = error
        finally:
            self._reading_since = None
        for one in waiting:
            if one.done():  # the waiting caller has left
                continue
            if problem is None:
                one.set_result(None)
            else:
                one.set_exception(problem)

    async def find(self, by: str, secret: str) -> T | None:
        """Return the owner of a secret, a "session" or "token"; None if nobody owns it.

        If the store does not respond, an owner in the snapshot is returned, unless the snapshot is
        older than a change that was made here.

        Raises
        ------
        HeliotropeError
            If the store does not respond, and the snapshot does not tell.
        """
        key = _key(by, secret)
        known = key in self._kept and self._at >= self._least
        if not known or self._at < self._now() - TRUSTED:
            try:
                async with asyncio.timeout(self._patience() if known else _LONGEST):
                    await self._next_read()
            except (HeliotropeError, TimeoutError) as error:
                if known:
                    return self._last(key, error)
                raise _silent(error) from None
        if by == "token" and key in self._kept:
            self._used.add(key[1])
        return self._kept.get(key)

    async def _next_read(self) -> None:
        """Wait for a read that begins from now on; raises its `HeliotropeError`."""
        waiting: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.append(waiting)
        self._wanted.set()
        await waiting

    def _patience(self) -> float:
        """Return how long to wait for the store, s; less if it is already silent."""
        since = self._reading_since
        return _WAITS if since is None else max(0.0, _WAITS - (self._now() - since))

    def _last(self, key: Key, error: Exception) -> T:
        """Return the owner as last known; raises `HeliotropeError` if that is too long ago."""
        last = self._kept.get(key)
        if last is None or self._at < self._now() - LONG_TRUSTED:
            raise _silent(error) from None
        return last

    async def find_for_emergency(self, by: str, secret: str) -> T | None:
        """Return the owner of a secret like `find`, and in any case within a second."""
        try:
            async with asyncio.timeout(_WAITS):
                return await self.find(by, secret)
        except (HeliotropeError, TimeoutError) as error:
            return self._last(_key(by, secret), error)

    def forget(self) -> None:
        """Accept no caller on the basis of the present snapshot, because something has changed."""
        self._least = self._now()
        self._wanted.set()


def _silent(error: Exception) -> HeliotropeError:
    return HeliotropeError(f"the store cannot say who this is ({str(error) or 'no answer'})")


def _key(by: str, secret: str) -> Key:
    return by, hashlib.sha256(secret.encode(errors="replace")).hexdigest()
