"""Detects another plant with the same keys, because clusters report which run they obey."""

from collections.abc import Callable, Iterable

from heliotrope.links.messages import ClusterStatus
from heliotrope.plant.field.part import Part
from heliotrope.safety import Alarm, alarms


class SecondPlant(Part):
    """Detects clusters that refuse this plant because they belong to another plant.

    Parameters
    ----------
    run
        Name of this plant run, as sent in its leases.
    tell
        Called with each alarm.
    """

    def __init__(self, run: str, tell: Callable[[Alarm], None]) -> None:
        self._run, self._tell = run, tell
        #: The run that a cluster belongs to, by cluster.
        self._lost: dict[str, str] = {}

    def on_status(self, cluster: str, status: ClusterStatus, now: float) -> None:
        """Handle a cluster's status."""
        del now
        before = bool(self._lost)
        if self._run in status.barred:
            new = self._lost.get(cluster) != status.run
            self._lost[cluster] = status.run
        else:
            new = self._lost.pop(cluster, None) is not None
        if self._lost and new:
            clusters, holder = ", ".join(sorted(self._lost)), next(iter(self._lost.values()))
            self._tell(
                alarms.SECOND_PLANT.raised(run=self._run, clusters=clusters, holder=holder or "?")
            )
        elif before and not self._lost:
            self._tell(alarms.SECOND_PLANT.ended())

    def refusal(self, clusters: Iterable[str]) -> str | None:
        """Return the reason why clusters accept no motion from this plant, or None."""
        lost = sorted(set(clusters) & self._lost.keys())
        if not lost:
            return None
        return (
            f"{', '.join(lost)} belong to another plant with the same keys (alarm "
            f"{alarms.SECOND_PLANT.name}); shut down one of the two plants"
        )
