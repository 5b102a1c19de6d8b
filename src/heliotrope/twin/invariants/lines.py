"""The observer of the line between the plant and a cluster: one that was lost comes back.

A cluster that never rejoins is safe, and its mirrors are never used again. The observer knows from
the faults of the run when nothing stands between two programs that run (invariant 16). Then they
must be connected within a time, and the plant's leases must come at their rate, whoever has the
command authority. Its times are its own.
"""

from collections import Counter

from heliotrope.twin.invariants.invariants import InvariantError, Violation

#: A line on which nothing fails is connected within this, s.
REJOINS_WITHIN = 20.0
#: Greatest age of the last lease on a line that carries, s: the plant renews it every second.
LEASE_EVERY = 3.0


class LineObserver:
    """Observes one line.

    Parameters
    ----------
    cluster
        Name of the cluster.
    start
        Zero of the times that it reports, s.

    Attributes
    ----------
    checks
        Number of checks of each invariant.
    """

    def __init__(self, cluster: str, start: float) -> None:
        self.checks: Counter[int] = Counter()
        self._cluster, self._start = cluster, start
        self._apart_since = self._whole_since = self._leased_at = start

    def leased(self, now: float) -> None:
        """Note a lease that has left the plant."""
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
        self._check(apart <= REJOINS_WITHIN, now, saw)
        age = now - max(self._leased_at, self._whole_since)
        saw = f"the plant's last lease left {age:.1f} s ago, limit {LEASE_EVERY:g} s"
        self._check(age <= LEASE_EVERY, now, saw)

    def _check(self, good: bool, now: float, saw: str) -> None:
        self.checks[16] += 1
        if not good:
            raise InvariantError(Violation(16, now - self._start, self._cluster, saw))
