"""Recent failed sign-ins, counted per name and address, per name, and per address.

Each of the three counts delays the next attempt, for longer as failures accumulate. Only the first
blocks guessing (`AN_HOUR` attempts by default); the other two merely slow it down, because an
attacker could otherwise lock out a person, or everyone at one address. Guessing one name from ever
new addresses is thus limited to some fourteen attempts an hour in total. A name that has signed in
from an address before is not delayed there by the failures of others.
"""

from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Collection
from typing import TypeVar

#: Time for which a failure counts, s, and number of attempts for one name at one address within it.
SPAN, AN_HOUR = 3600.0, 12
#: Delay after each failure of a name at an address, s; the first failures cause no delay.
_OWN = (0.0, 0.0, 0.0, 0.0, 15.0, 30.0, 60.0, 120.0, 240.0, 300.0, 300.0)
#: Number of failures of a name, and from an address, that cause no delay; after that the delay
#: doubles from 1 s up to the longest, s.
_NAME, _ADDRESS = (5, 300.0), (20, 10.0)
_KEPT = 64
Pair = tuple[str, str]
K = TypeVar("K")
V = TypeVar("V")


class SignInFailures:
    """The failed sign-ins of the last hour.

    Parameters
    ----------
    monotonic
        Function that returns the time, s.
    shared
        Addresses of many users, such as trusted proxies, which do not count as one caller.
    largest
        Number of names, addresses and pairs of them that are kept; the longest unused are dropped
        first.
    an_hour
        Number of attempts for one name at one address in an hour.
    """

    def __init__(
        self,
        monotonic: Callable[[], float],
        shared: Collection[str] = (),
        largest: int = 10_000,
        an_hour: int = AN_HOUR,
    ) -> None:
        self._an_hour = an_hour
        self._now, self._shared, self._largest = monotonic, frozenset(shared), largest
        self._pairs: OrderedDict[Pair, deque[float]] = OrderedDict()
        self._names: OrderedDict[str, deque[tuple[float, Pair]]] = OrderedDict()
        self._addresses: OrderedDict[str, deque[tuple[float, Pair]]] = OrderedDict()
        self._good: OrderedDict[Pair, None] = OrderedDict()
        self._homes = Counter[str]()

    def wait(self, name: str, address: str) -> float:
        """Return the time to wait before the next attempt, s; 0 if it may be made now."""
        now, pair = self._now(), (name, address)
        until = _own_until(self._pairs.get(pair, ()), now, self._an_hour)
        if not self.known(name, address):
            until = max(
                until,
                _shared_until(self._names.get(name, ()), now, *_NAME),
                _shared_until(self._addresses.get(address, ()), now, *_ADDRESS),
            )
        return max(0.0, until - now)

    def known(self, name: str, address: str) -> bool:
        """Return whether a name has signed in from an address."""
        return (name, address) in self._good

    def is_home(self, address: str) -> bool:
        """Return whether anyone has signed in from an address."""
        return address in self._homes

    def meet(self, name: str, address: str) -> None:
        """Record that a name has signed in from an address."""
        pair = (name, address)
        if pair not in self._good:
            self._homes[address] += 1
        self._good[pair] = None
        self._good.move_to_end(pair)
        if len(self._good) > self._largest:
            (_, oldest), _ = self._good.popitem(last=False)
            self._homes -= Counter([oldest])

    def begin(self, name: str, address: str) -> None:
        """Count an attempt as failed until `good` is called.

        Counting only after the slow password check would admit many attempts at once.
        """
        now, pair = self._now(), (name, address)
        _kept(self._pairs, pair, self._an_hour, self._largest).append(now)
        _kept(self._names, name, _KEPT, self._largest).append((now, pair))
        if address not in self._shared:
            _kept(self._addresses, address, _KEPT, self._largest).append((now, pair))

    def undo(self, name: str, address: str) -> None:
        """Discard the last attempt of a name at an address, because it was not a guess."""
        pair = (name, address)
        if times := self._pairs.get(pair):
            times.pop()
        for failures in (self._names.get(name), self._addresses.get(address)):
            last = [failure for failure in failures or () if failure[1] == pair][-1:]
            for failure in last:
                assert failures is not None
                failures.remove(failure)

    def good(self, name: str, address: str) -> None:
        """Drop the failures of a name at an address where it has signed in, and no others."""
        pair = (name, address)
        self._pairs.pop(pair, None)
        for failures in (self._names.get(name), self._addresses.get(address)):
            if failures is not None:
                others = [failure for failure in failures if failure[1] != pair]
                failures.clear()
                failures.extend(others)
        self.meet(name, address)


def _kept(kept: "OrderedDict[K, deque[V]]", key: K, most: int, largest: int) -> "deque[V]":
    """Return the failures of a key, and mark the key as most recently used."""
    failures = kept.setdefault(key, deque(maxlen=most))
    kept.move_to_end(key)
    if len(kept) > largest:
        kept.popitem(last=False)
    return failures


def _own_until(times: Collection[float], now: float, an_hour: int) -> float:
    """Return when a name may try again at an address, s."""
    recent = [at for at in times if now - at < SPAN]
    if not recent:
        return now
    if len(recent) >= an_hour:
        return recent[0] + SPAN
    return recent[-1] + _OWN[min(len(recent), len(_OWN)) - 1]


def _shared_until(
    failures: Collection[tuple[float, Pair]], now: float, free: int, longest: float
) -> float:
    """Return the time from which any attempt for a name or from an address is allowed, s."""
    recent = [at for at, _ in failures if now - at < SPAN]
    more = len(recent) - free
    return recent[-1] + min(longest, 2.0**more) if more >= 0 else now
