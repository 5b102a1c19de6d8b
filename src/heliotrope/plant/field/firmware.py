"""Firmware versions of the local controllers, compared with the version that the plant expects.

A status does not contain the versions, so each cluster is asked to search its bus once it is
connected.
"""

from collections.abc import Callable

from heliotrope.links.messages import Answer
from heliotrope.plant.field.clusters import Clusters
from heliotrope.plant.field.part import Part
from heliotrope.safety import Alarm, alarms

#: Longest search of a bus, s; a cluster that has not replied by then is queried again.
SEARCH = 600.0
#: Maximum number of boards named in one alarm.
_NAMED = 5


class Firmware(Part):
    """Compares the boards' firmware versions with the expected version.

    Parameters
    ----------
    expected
        Version that every board should have; None: no versions are compared, and no bus is
        searched.
    clusters
        The clusters, which are queried.
    tell
        Called with each alarm.
    """

    def __init__(
        self, expected: int | None, clusters: Clusters, tell: Callable[[Alarm], None]
    ) -> None:
        self._expected, self._clusters, self._tell = expected, clusters, tell
        #: When clusters that have not replied are queried next, monotonic s.
        self._due: dict[str, float] = {}
        self._raised: set[str] = set()

    def on_connected(self, cluster: str, now: float) -> None:
        """Make the comparison due for the boards of a newly connected cluster."""
        if self._expected is not None:
            self._due[cluster] = now

    def on_second(self, now: float) -> None:
        """Query the clusters that are due."""
        for cluster, due in self._due.items():
            if now >= due:
                self._due[cluster] = now + SEARCH
                end, take = self._clusters.ends[cluster], self._taker(cluster)
                self._clusters.ask(end, "discover", take, patience=SEARCH)

    def _taker(self, cluster: str) -> Callable[[Answer], None]:
        def take(answer: Answer) -> None:
            boards = answer.data.get("found")
            if not isinstance(boards, list):
                return  # it is queried again
            self._due.pop(cluster, None)
            others = {
                str(board.get("name") or f"serial number {board.get('serial')}"): board.get(
                    "firmware"
                )
                for board in boards
                if isinstance(board, dict) and board.get("firmware") != self._expected
            }
            if others:
                listed = [f"{name} ({version})" for name, version in others.items()][:_NAMED]
                more = f" and {len(others) - _NAMED} more" if len(others) > _NAMED else ""
                self._raised.add(cluster)
                self._tell(
                    alarms.FIRMWARE_DIFFERS.raised(
                        cluster, boards=", ".join(listed) + more, expected=self._expected
                    )
                )
            elif cluster in self._raised:
                self._raised.remove(cluster)
                self._tell(alarms.FIRMWARE_DIFFERS.ended(cluster))

        return take
