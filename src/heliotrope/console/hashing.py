"""Queue for password hashing, which is costly: few checks run at a time, and few wait.

Users who sign in from where they have signed in before take precedence, and have places that
strangers cannot take, so guesses with ever new addresses and names cannot lock these users out. A
client that has disconnected loses its place without a check.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass, field

from heliotrope.console._attempts import Pair
from heliotrope.errors import HeliotropeError

#: Number of checks at a time; each takes 50 ms of a core and 64 MiB.
AT_WORK = 2
#: Number of waiting checks: of strangers, and of users known at their address.
STRANGERS, KNOWN = 8, 32
#: Number of waiting checks from strangers at one address, and for one known name.
OF_ADDRESS, OF_NAME = 4, 4


class CrowdError(HeliotropeError):
    """Too many callers are waiting for a password check."""


class GoneError(HeliotropeError):
    """The caller left while waiting for a check."""


@dataclass(eq=False)
class _Place:
    pair: Pair
    known: bool
    gone: Callable[[], Awaitable[bool]]
    turn: "asyncio.Future[None]" = field(
        default_factory=lambda: asyncio.get_running_loop().create_future()
    )


class Hashing:
    """The password-check queue of one console.

    Parameters
    ----------
    at_work
        Number of checks at a time.
    """

    def __init__(self, at_work: int = AT_WORK) -> None:
        self._free = at_work
        self._waiting: list[_Place] = []

    @contextlib.asynccontextmanager
    async def turn(
        self, pair: Pair, gone: Callable[[], Awaitable[bool]], *, known: bool
    ) -> AsyncIterator[None]:
        """Wait for a turn, and hold it during a block.

        Parameters
        ----------
        pair
            Name and address of the caller.
        gone
            Function that returns whether the caller has left.
        known
            Whether the caller has signed in there before.

        Raises
        ------
        CrowdError
            If too many callers are waiting.
        GoneError
            If the caller left before their turn.
        """
        if not self._free:
            await self._wait(_Place(pair, known, gone))
        else:
            self._free -= 1
        try:
            yield
        finally:
            self._pass_on()

    async def _wait(self, place: _Place) -> None:
        """Wait until a turn is passed on."""
        if self._full(place):
            gone = [other for other in self._waiting if await other.gone()]
            self._waiting = [other for other in self._waiting if other not in gone]
            for other in gone:
                if not other.turn.done():
                    other.turn.set_exception(_left(other))
            if self._full(place):
                raise CrowdError("too many people are signing in at once")
        self._waiting.append(place)
        try:
            await place.turn
        except asyncio.CancelledError:
            if place in self._waiting:
                self._waiting.remove(place)
            elif place.turn.done() and not place.turn.cancelled() and not place.turn.exception():
                self._pass_on()
            raise
        if await place.gone():
            self._pass_on()
            raise _left(place)

    def _full(self, place: _Place) -> bool:
        """Return whether the queue is full for callers of this kind."""
        alike = [other.pair for other in self._waiting if other.known == place.known]
        name, address = place.pair
        if place.known:
            return len(alike) >= KNOWN or sum(one[0] == name for one in alike) >= OF_NAME
        return len(alike) >= STRANGERS or sum(one[1] == address for one in alike) >= OF_ADDRESS

    def _pass_on(self) -> None:
        """Give the next turn to the first known caller in the queue, else to the first stranger."""
        place = min(self._waiting, key=lambda one: not one.known, default=None)
        if place is None:
            self._free += 1
            return
        self._waiting.remove(place)
        place.turn.set_result(None)


def _left(place: _Place) -> GoneError:
    return GoneError(f"{place.pair[1]} has left before its turn")
