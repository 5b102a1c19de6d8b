"""The observer of the line between the plant and a cluster: a lost line must be restored.

A cluster that never reconnects is safe, but its heliostats are never used again. The observer knows
from the faults of the run when nothing separates two running programs (invariant 16). They must
then be connected within a time limit, and the plant's leases must arrive at their rate, whoever
holds the command authority. The time limits are the observer's own.
"""

from heliotrope.twin.invariants.invariants import Judge

#: A line on which nothing fails is connected within this, s.
REJOINS_WITHIN = 20.0
#: Greatest age of the last lease on a line that carries, s: the plant renews it every second.
LEASE_EVERY = 3.0


class LineObserver(Judge):
    """Observes one line.

    Parameters
    ----------
    cluster
        Name of the cluster.
    start
        Zero of the times that it reports, s.

    """

    def __init__(self, cluster: str, start: float) -> None:
        super().__init__(start)
        self._cluster = cluster
        self._apart_since = self._whole_since = self._leased_at = start

    def on_lease(self, token: int, now: float) -> None:
        """Note a lease that has left the plant."""
        del token
        self._leased_at = now

    def look(self, now: float, *, clear: bool, connected: bool) -> None:
        """Judge the line.

        Parameters
        ----------
        now
            s.
        clear
            Whether both programs run, and no fault is between them.
        connected
            Whether both ends say that it is connected.
        """
        if connected or not clear:
            self._apart_since = now
        if not (clear and connected):
            self._whole_since = now
        apart = now - self._apart_since
        saw = f"nothing stands between it and the plant, and for {apart:.1f} s it has not rejoined"
        self.check(16, apart <= REJOINS_WITHIN, now, self._cluster, saw)
        age = now - max(self._leased_at, self._whole_since)
        saw = f"the plant's last lease left {age:.1f} s ago, limit {LEASE_EVERY:g} s"
        self.check(16, age <= LEASE_EVERY, now, self._cluster, saw)
