"""The observer of the line between the plant and a cluster: a lost line must be restored.

A cluster that never reconnects is safe, but its heliostats are never used again. The observer knows
from the run's faults when both programs are running and nothing separates them. They must then be
connected within a time limit (invariant 16), and the plant's leases must arrive at their rate,
whoever holds the command authority. The time limits are the observer's own.
"""

from heliotrope.twin.invariants.invariants import Judge

#: A line without a fault is connected within this, s.
REJOINS_WITHIN = 20.0
#: Maximum age of the last lease on a working line, s; the plant renews it every second.
LEASE_EVERY = 3.0


class LineObserver(Judge):
    """Observes one line.

    Parameters
    ----------
    cluster
        Name of the cluster.
    start
        Origin of the times that it reports, s.

    """

    def __init__(self, cluster: str, start: float) -> None:
        super().__init__(start)
        self._cluster = cluster
        self._apart_since = self._whole_since = self._leased_at = start

    def on_lease(self, token: int, now: float) -> None:
        """Record a lease that has left the plant."""
        del token
        self._leased_at = now

    def look(self, now: float, *, clear: bool, connected: bool) -> None:
        """Judge the line.

        Parameters
        ----------
        now
            Time, s.
        clear
            Whether both programs are running, with no fault between them.
        connected
            Whether both ends report that the line is connected.
        """
        if connected or not clear:
            self._apart_since = now
        if not (clear and connected):
            self._whole_since = now
        apart = now - self._apart_since
        saw = f"nothing separates it from the plant, but it has not reconnected for {apart:.1f} s"
        self.check(16, apart <= REJOINS_WITHIN, now, self._cluster, saw)
        age = now - max(self._leased_at, self._whole_since)
        saw = f"the plant sent its last lease {age:.1f} s ago, limit {LEASE_EVERY:g} s"
        self.check(16, age <= LEASE_EVERY, now, self._cluster, saw)
