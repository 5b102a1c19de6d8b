"""Settings that all clusters should share, compared through the checksum in each status."""

from collections import Counter
from collections.abc import Callable

from heliotrope.links.messages import ClusterStatus
from heliotrope.plant.field.part import Part
from heliotrope.safety import Alarm, alarms

#: The alarm is raised only after this time, s, because right after a start the first clusters to
#: report may be the minority.
PATIENCE = 5.0
#: Name of the reference if the plant knows what every cluster should have.
EXPECTED = "this plant"


class ClusterSettings(Part):
    """Compares the clusters' settings with the settings that the plant expects.

    If the plant expects no checksum, the clusters are compared with each other. A cluster is named
    if its checksum differs from the checksums of more than half of the other clusters; if there are
    only two clusters and they differ, both are named. A cluster that has fallen silent counts with
    its last checksum. An older cluster that sends no checksum is not compared.

    Parameters
    ----------
    tell
        Called with each alarm, when it is raised or ends, and again when its text changes.
    expected
        Checksum of the settings that every cluster should have; "": unknown.
    """

    def __init__(self, tell: Callable[[Alarm], None], expected: str = "") -> None:
        self._tell, self._expected = tell, expected
        #: Checksums by cluster, and how many clusters have each.
        self._known: dict[str, str] = {}
        self._counts: Counter[str] = Counter()
        #: When a cluster was first found to differ, monotonic s; alarms raised, by cluster.
        self._since: dict[str, float] = {}
        self._raised: dict[str, Alarm] = {}

    def on_status(self, cluster: str, status: ClusterStatus, now: float) -> None:
        """Accept a cluster's status that arrived at a monotonic time, s."""
        self._learn(cluster, status.settings)
        others = self._differing(cluster)
        if not others:
            self._since.pop(cluster, None)
            if self._raised.pop(cluster, None) is not None:
                self._tell(alarms.SETTINGS_DIFFER.ended(cluster))
        elif now - self._since.setdefault(cluster, now) >= PATIENCE:
            alarm = alarms.SETTINGS_DIFFER.raised(cluster, others=others)
            if self._raised.get(cluster) != alarm:
                self._raised[cluster] = alarm
                self._tell(alarm)

    def _learn(self, cluster: str, checksum: str) -> None:
        before = self._known.pop(cluster, "")
        if before != checksum:
            self._counts.subtract([before] if before else [])
            self._counts.update([checksum] if checksum else [])
            self._counts = +self._counts
        if checksum:
            self._known[cluster] = checksum

    def _differing(self, cluster: str) -> str | None:
        """Return in words which clusters a cluster differs from; None if it agrees with them."""
        checksum = self._known.get(cluster, "")
        if self._expected:
            return EXPECTED if checksum not in ("", self._expected) else None
        own, total = self._counts[checksum], len(self._known)
        others, differ = total - 1, total - own
        if not own or 2 * differ <= others:
            return None
        if others == 1:
            return next(name for name in self._known if name != cluster)
        if len(self._counts) == 2 and own == 1:
            return f"the {others} other clusters, which all have the same settings"
        return f"{differ} of the {others} other clusters, whose settings are not all the same"
