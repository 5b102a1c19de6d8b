"""The observer of plant runs: a cluster obeys only one at a time.

A run that a cluster obeys holds the lease, and keeps it as long as its leases reach the cluster in
time. No motion command of another run may be sent on the bus before that lease has expired. The
observer does not rely on what a cluster reports: leases count when they reach the cluster, and
obedience is visible on the bus.
"""

from collections.abc import Iterable

#: The cluster's clock, and the interval between two of its looks, s.
SLACK = 0.1


class RunAccount:
    """The leases that have reached a cluster, and the run that the cluster obeys."""

    def __init__(self) -> None:
        self._over: dict[str, float] = {}
        self._obeyed = ""

    def leased(self, run: str, lifetime: float, now: float) -> None:
        """Record a lease that has reached the cluster."""
        if run == self._obeyed and now >= self._over.get(run, now):
            self._obeyed = ""  # the run has lost the lease, and may or may not hold it again
        self._over[run] = now + lifetime

    def forget(self) -> None:
        """Record that the cluster program has ended."""
        self._over.clear()
        self._obeyed = ""

    def obeyed(self, orders: Iterable[str], now: float) -> str:
        """Record a frame that carries out one of several orders; return an error in it, or "".

        Parameters
        ----------
        orders
            Identities of the plant's orders, which begin with the name of its run.
        now
            s.
        """
        runs = {identity.rpartition("-")[0] for identity in orders}
        remaining = self._over.get(self._obeyed, now) - now
        if self._obeyed and self._obeyed not in runs and remaining > SLACK:
            return (
                f"run {min(runs)} is obeyed although run {self._obeyed}, which was obeyed "
                f"before, still holds the lease for {remaining:.2f} s"
            )
        if len(runs) == 1:
            (self._obeyed,) = runs
        return ""
