"""The plant run that a cluster belongs to, identified by the name in the run's leases.

Two plants with the same keys (for example a backup started on a second computer) reach a cluster
alternately. The cluster belongs to the run whose lease it accepted, until that lease has expired.
Another run that sends leases in the meantime gets no response, and must wait `PATIENCE` longer,
because when two plants compete for a line, each of them is silent for seconds at a time. If the
first run's lease is renewed after another run has asked, two plants are alive. The other run is
then blocked until its plant is restarted, which gives the run a new name. A plant that froze or
lost its line for a while therefore does not hand the field over to an unknown plant; an operator
has to decide this.

A plant with an older version sends no name. Its leases count as the leases of one unnamed run. That
run has to wait like any other, but is never blocked, because no restart could give it another name.
"""

import math

#: A run that asked while another run held the lease waits this long after the lease ends, s.
PATIENCE = 10.0
#: Maximum number of blocked runs that are kept; the oldest is dropped first.
_MOST = 16
#: A blocked run that has not asked for this long is considered gone, s.
GONE = 60.0


class PlantRuns:
    """Plant runs that request the lease of a cluster.

    Attributes
    ----------
    holder
        Run that the cluster belongs to, or last belonged to; "" before the first lease, and for a
        plant that sends no name.
    """

    def __init__(self) -> None:
        self.holder = ""
        self._over = -math.inf
        self._asked: set[str] = set()
        #: When each blocked run last asked, monotonic s.
        self._blocked: dict[str, float] = {}

    @property
    def blocked(self) -> tuple[str, ...]:
        """Runs that can no longer get a lease."""
        return tuple(self._blocked)

    def admits(self, run: str, now: float) -> bool:
        """Return whether a run may have the lease now; if not, record its request."""
        if run in self._blocked:
            self._blocked[run] = now
            return False
        asked = run in self._asked
        if run == self.holder or now >= self._over + (PATIENCE if asked else 0.0):
            return True
        self._asked.add(run)
        return False

    def took(self, run: str, now: float, over: float) -> None:
        """Record an admitted lease; block runs that asked since the previous lease of its run."""
        if run == self.holder:
            self._blocked.update(dict.fromkeys(self._asked - {""}, now))
            for oldest in tuple(self._blocked)[:-_MOST]:
                del self._blocked[oldest]
        self._asked.clear()
        self.holder, self._over = run, over

    def second_plants(self, now: float) -> tuple[str, ...]:
        """Return the blocked runs that have asked recently; their plants are still alive."""
        return tuple(run for run, at in self._blocked.items() if now - at < GONE)
