"""The alarms that clusters have reported, compared with the alarms listed in their statuses."""

from collections.abc import Callable
from dataclasses import replace

from heliotrope.links.messages import ClusterStatus
from heliotrope.plant.field.part import Part
from heliotrope.safety import Alarm, alarms

_Key = tuple[str, str]


class ClusterAlarms(Part):
    """Alarms of clusters, each reported once and ended once, even if messages repeat or are lost.

    A message may be lost with its connection, or arrive while the plant's program is suspended. A
    cluster therefore repeats its alarms and lists them; see `ClusterStatus`.

    Parameters
    ----------
    tell
        Called with each alarm.
    """

    def __init__(self, tell: Callable[[Alarm], None]) -> None:
        self._tell = tell
        self._active: dict[str, dict[_Key, Alarm]] = {}

    def on_alarm(self, cluster: str, alarm: Alarm) -> None:
        """Report an alarm of a cluster if it is new."""
        for news in self.take(cluster, alarm):
            self._tell(news)

    def on_status(self, cluster: str, status: ClusterStatus, now: float) -> None:
        """Report the end of each alarm that a cluster no longer lists."""
        del now
        for news in self.compare(cluster, status):
            self._tell(news)

    def take(self, cluster: str, alarm: Alarm) -> list[Alarm]:
        """Accept an alarm of a cluster; return it if it is new."""
        alarm = replace(alarm, subject=alarm.subject or cluster)
        kind = alarms.KINDS.get(alarm.condition)
        if kind is not None and not kind.over:
            return [alarm]  # an event, which neither lasts nor ends
        active, key = self._active.setdefault(cluster, {}), (alarm.condition, alarm.subject)
        if not alarm.active:
            active.pop(key, None)
        elif active.get(key) == alarm:
            return []
        else:
            active[key] = alarm
        return [alarm]

    def compare(self, cluster: str, status: ClusterStatus) -> list[Alarm]:
        """Return the ends of the alarms that a cluster no longer lists."""
        if not status.alarms_listed:
            return []
        pairs = (line.partition(" ") for line in status.alarms)
        listed = {(condition, subject or cluster) for condition, _, subject in pairs}
        active = self._active.get(cluster, {})
        ended = [active.pop(key) for key in tuple(active) if key not in listed]
        return [replace(alarm, text=f"{alarm.condition}: over", active=False) for alarm in ended]
