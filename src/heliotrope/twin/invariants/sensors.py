"""The observer of sensors: the readings that the plant received, and whether it acted.

A reading beyond its limit, or a missing reading, must be named by an alarm within 10 s, and take
every beam off the receiver within 30 s, which is part of invariant 2. The limits are the observer's
own. A sensor with a wrong value within its limits is not judged, because nobody could know.
"""

import math
from collections.abc import Mapping, Sequence, Set

from heliotrope.lcu import states
from heliotrope.safety import Alarm
from heliotrope.twin.boards.board import Board
from heliotrope.twin.invariants.beams import NAMED_WITHIN, OFF_WITHIN
from heliotrope.twin.invariants.invariants import Judge

#: For each reading: the alarms of which any one names it, the limit, and the delay beyond it, s.
LIMITS = {
    "wind_gust": (("wind_gust_stow", "wind_gust_defocus"), 15.0, 3.0),
    "wind_mean": (("wind_mean_stow", "wind_mean_defocus"), 11.0, 0.0),
    "receiver_flux": (("receiver_flux_high",), 1.0, 1.0),
}
#: A reading older than this counts as missing, s.
GONE = 5.0


class SensorObserver(Judge):
    """Observes the readings that the plant received, and heliostats that should have left.

    Parameters
    ----------
    start
        Origin of the times that it reports, s.
    boards
        Boards by cluster name.

    """

    def __init__(self, start: float, boards: Mapping[str, Sequence[Board]]) -> None:
        super().__init__(start)
        self._boards = boards
        self._value: dict[str, tuple[float, float]] = {}
        self._since: dict[str, float | None] = dict.fromkeys(LIMITS)
        self._alarms: set[str] = set()
        self.started_at = start
        self._cut_at = dict.fromkeys(boards, start)

    def fed(self, name: str, value: float, now: float) -> None:
        """Record a reading that the plant was given."""
        if math.isfinite(value):
            self._value[name] = value, now

    def on_alarm(self, alarm: Alarm, now: float) -> None:
        """Record an alarm of the plant."""
        del now
        (self._alarms.add if alarm.active else self._alarms.discard)(alarm.condition)

    def on_end(self, now: float) -> None:
        """Record that the plant program has ended, and its alarms with it.

        A frozen program keeps its alarms.
        """
        self._alarms.clear()
        self._rests(now)

    def _rests(self, now: float) -> None:
        """Restart the timing, because a plant that starts has not yet waited for its sensors."""
        self._since, self._value = dict.fromkeys(LIMITS), {}
        self.started_at = now

    def look(self, carried: Set[str], now: float, *, runs: bool) -> None:
        """Judge all readings; ``carried`` contains the clusters that the plant can reach."""
        for cluster in self._boards:
            if cluster not in carried:
                self._cut_at[cluster] = now
        if not runs:
            self._rests(now)
            return
        for name, (alarms, limit, delay) in LIMITS.items():
            value, at = self._value.get(name, (0.0, self.started_at))
            bad = value >= limit or now - at > GONE
            before = self._since[name]
            since = self._since[name] = None if not bad else now if before is None else before
            if since is None:
                continue
            passed = now - since - delay
            saw = f"{name} is {value:.3g}, {now - at:.1f} s old, for {passed:.1f} s, and no alarm"
            named = bool(self._alarms.intersection(alarms))
            self.check(2, named or passed <= NAMED_WITHIN, now, "plant", f"{saw} names it")
            self._off(name, since + delay, now)

    def _off(self, reading: str, since: float, now: float) -> None:
        for cluster, boards in self._boards.items():
            passed = now - max(since, self._cut_at[cluster])
            for board in boards:
                on = board.state in (states.TRACKING, states.SEARCHING)
                saw = f"{states.STATES[board.state]} {passed:.1f} s after {reading} demanded it off"
                good = not on or passed <= OFF_WITHIN
                self.check(2, good, now, board.outfit.name, saw)
