"""The queue for an ordinary STOW of many heliostats, so that they start one after the other.

Like STOW ALL of Malan's controller (thesis, table D.1, 0xD9), it protects the power supply from the
current of all drives starting together. Emergencies, the safety table and expired leases never wait
here.
"""

from collections.abc import Collection, Iterable

from heliotrope.plant.orders.tickets import Ticket

#: Why a heliostat in the queue is not moved while it waits.
WAITS = "it is waiting its turn to go to stow"


class StowQueue:
    """Heliostats that wait for their STOW, in order.

    Parameters
    ----------
    rate
        Number of heliostats that start per second, and also at once after a pause; 0: no heliostat
        waits.
    """

    def __init__(self, rate: float) -> None:
        self.rate = rate
        self._waiting: dict[str, Ticket] = {}
        self._spare, self._at = rate, float("-inf")

    def __len__(self) -> int:
        return len(self._waiting)

    def __contains__(self, heliostat: str) -> bool:
        return heliostat in self._waiting

    def staggers(self, heliostats: Collection[str]) -> bool:
        """Return whether an order to some heliostats must be staggered."""
        return 0.0 < self.rate < len(heliostats)

    def put(self, ticket: Ticket, heliostats: Iterable[str]) -> dict[Ticket, list[str]]:
        """Add heliostats; return the heliostats of earlier orders that this order replaces.

        A heliostat that is already waiting keeps its place, so a repeated order delays no
        heliostat.
        """
        replaced: dict[Ticket, list[str]] = {}
        for name in heliostats:
            other = self._waiting.get(name)
            if other is not None and other is not ticket:
                replaced.setdefault(other, []).append(name)
            self._waiting[name] = ticket
        return replaced

    def due(self, now: float) -> dict[Ticket, list[str]]:
        """Remove and return the heliostats whose turn has come at a time, monotonic s."""
        if not self._waiting:
            return {}
        self._spare = min(self.rate, self._spare + self.rate * (now - self._at))
        self._at = now
        some = list(self._waiting)[: int(self._spare)]
        self._spare -= len(some)
        return self.take(some)

    def take(self, heliostats: Iterable[str]) -> dict[Ticket, list[str]]:
        """Remove and return some heliostats, whether or not their turn has come."""
        found: dict[Ticket, list[str]] = {}
        for name in heliostats if self._waiting else ():
            ticket = self._waiting.pop(name, None)
            if ticket is not None:
                found.setdefault(ticket, []).append(name)
        return found
