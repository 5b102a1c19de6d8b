"""The run of a plant that a cluster belongs to: one at a time, by the name in its leases.

Two plants with the same keys (a backup started on a second machine) reach a cluster in turns. It
belongs to the run whose lease it took, until that lease has ended. Another run that asks meanwhile
gets nothing, and must wait for `PATIENCE` more: where two plants take a line from each other, each
of them falls silent for seconds. If the lease is renewed after that, two plants are alive: the
other run is blocked until its plant is restarted, which gives it a new name. So a plant that froze
or lost its line for a while does not hand the field to an unknown one; somebody must want
it.

A plant of an older version gives no name. Its leases count as those of one run without a name,
which has to wait like any other, and is never blocked: no restart could give it another name.
"""

import math

#: A run that asked while the lease of another one ran waits for this long after its end, s.
PATIENCE = 10.0
#: Blocked runs are remembered up to this number; the oldest is forgotten first.
_MOST = 16
#: A blocked run that has not asked for this long counts as gone, s.
GONE = 60.0


class PlantRuns:
    """Runs of plants that ask for the lease of a cluster.

    Attributes
    ----------
    holder
        Run that the cluster belongs to, or last belonged to; "" before the first lease, and for a
        plant that gives no name.
    """

    def __init__(self) -> None:
        self.holder = ""
        self._over = -math.inf
        self._asked: set[str] = set()
        #: When each blocked run last asked, monotonic s.
        self._blocked: dict[str, float] = {}

    @property
    def blocked(self) -> tuple[str, ...]:
        """Runs that get no lease any more."""
        return tuple(self._blocked)

    def admits(self, run: str, now: float) -> bool:
        """Whether a run may have the lease now; note it if it may not."""
        if run in self._blocked:
            self._blocked[run] = now
            return False
        asked = run in self._asked
        if run == self.holder or now >= self._over + (PATIENCE if asked else 0.0):
            return True
        self._asked.add(run)
        return False

    def took(self, run: str, now: float, over: float) -> None:
        """Note an admitted lease; block the runs that have asked since the last one of its run."""
        if run == self.holder:
            self._blocked.update(dict.fromkeys(self._asked - {""}, now))
            for oldest in tuple(self._blocked)[:-_MOST]:
                del self._blocked[oldest]
        self._asked.clear()
        self.holder, self._over = run, over

    def second_plants(self, now: float) -> tuple[str, ...]:
        """Return the blocked runs that have asked lately: their plants are still alive."""
        return tuple(run for run, at in self._blocked.items() if now - at < GONE)
