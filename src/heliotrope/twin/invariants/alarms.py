"""The observer of alarms: each alarm must have a true cause, and must end when its cause ends.

An alarm exempts the heliostats that it names from the work checks (`twin.invariants.quiet`), so an
alarm without a cause would hide any fault. The observer has a table of the alarms that simulated
faults cause and of those caused by operators, weather and automatic control; any other alarm has no
valid cause. An alarm caused by a fault may be raised only while the fault lasts, or soon after;
once everything is in order the alarm must clear by itself, unless an operator has to clear it. A
board without power, a board in FAULT, and a cluster from which the plant receives nothing must be
named within a time limit (invariant 16). The table and the time limits are the observer's own.

Some alarms report that heliostats did something that nobody ordered. If no fault is near, only the
plant itself can have caused it, and the plant's own action is not a valid cause (L2).

An alarm about a heliostat that points elsewhere reports that whatever should have prevented the
motion has failed. It has a valid cause only if a cluster is wrong from the start, if a belief
changes, or if a fault is near.
"""

import re
from collections.abc import Collection, Mapping
from math import inf
from types import MappingProxyType

from heliotrope.lcu import states
from heliotrope.safety import Act, Alarm
from heliotrope.twin.boards.board import Board
from heliotrope.twin.invariants.invariants import L2, Judge

#: Alarms that only faults cause, and the time within which they clear once nothing near the subject
#: is faulty, s; inf: an operator or another run of a program clears them.
BY_FAULTS = {
    "bus_errors": 60.0, "bus_failed": 60.0, "clock_jump": inf, "cluster_silent": 20.0,
    "cluster_site_differs": 30.0, "cluster_time_differs": 30.0, "database_unwritable": 60.0,
    "holdover_exhausted": 30.0, "node_fault": inf,
    "node_silent": 15.0, "order_unacknowledged": 15.0, "plant_link_lost": 20.0, "second_plant": inf,
    "sun_jumped": 75.0, "time_source": 30.0, "time_source_lost": 30.0, "two_plants": 90.0,
}  # fmt: skip
#: Alarms that operators, weather, wrong parameters and automatic control cause.
BY_OTHERS = frozenset({
    "aims", "authority_lost", "firmware_differs", "flux_above_limit", "heliostat_unlisted",
    "not_parked", "sun_contradicted",
    "unwitnessed", "beam_blocked", "beam_disproved", "beam_unsent", "counts_doubtful",
    "flux_after_emergency",
    "identity", "keep_out_predicted", "nodes_unacknowledged", "operator_emergency",
    "parameters_differ", "pointing_disagrees", "receiver_flux_high", "resume_needed",
    "sun_below_horizon", "unknown_reading", "unproven_after_emergency", "wind_gust_defocus",
    "wind_gust_stow",
    "wind_mean_defocus", "wind_mean_stow",
})  # fmt: skip
#: Alarms about heliostats that point elsewhere, and the worlds in which they occur without a fault.
MISLED = {
    "identity": frozenset({"addresses", "parameters", "calibrations", "repairs"}),
    "pointing_disagrees": frozenset({
        "clock", "site", "calibrations", "repairs", "visits", "day", "lights", "parties", "days",
    }),
}  # fmt: skip
#: Alarms that report that heliostats did what nobody ordered, or did not do what was ordered. Their
#: only cause is a fault that ended no longer ago than this, s. A new program continues earlier
#: alarms.
UNORDERED = {
    "counts_doubtful": 60.0, "flux_after_emergency": 90.0, "nodes_unacknowledged": 90.0,
    "resume_needed": 60.0,
}  # fmt: skip
#: The alarm whose only cause is an emergency that an operator has called.
CALLED = "operator_emergency"
RECALLED_WITHIN = 5.0
#: The alarm which says that records cannot be written.
UNWRITTEN = "database_unwritable"
#: An alarm is raised at most this long after its cause has ended, s.
RAISED_WITHIN = 30.0
#: Deadlines for naming, s. A board without power: silence for 10 s, a poll every 5 s, and the
#: transfer to the plant. The other two: a board in FAULT, and a cluster from which nothing is
#: received.
SILENT_WITHIN, FAULT_WITHIN, UNHEARD_WITHIN = 18.0, 10.0, 8.0
#: Deadlines for naming a heliostat that no cluster's file contains, and a wrong time that plant and
#: clusters share, s. A cluster reports its names with its first status.
UNLISTED_WITHIN, CONTRADICTED_WITHIN = 10.0, 10.0
#: Strings that no text for an operator may contain.
_NONSENSE = re.compile(r"[{}]|\bnan\b|\bNone\b|\binf\b|<[a-z_.]+ ")


class AlarmObserver(Judge):
    """Observes the alarms of a plant.

    Parameters
    ----------
    start
        Origin of the times that it reports, s.
    boards
        Boards by cluster name.
    worlds
        Worlds of the run. If a second plant runs at times, its alarms are reported here too, and it
        takes over the lines to the clusters.

    """

    def __init__(
        self, start: float, boards: Mapping[str, Collection[Board]], worlds: Collection[str]
    ) -> None:
        super().__init__(start)
        self._alone = "twice" not in worlds
        self._works, self._began_at = "days" in worlds, start
        sound = [kind for kind, causes in MISLED.items() if causes.isdisjoint(worlds)]
        self._by_faults = BY_FAULTS | dict.fromkeys(sound, inf)
        self._boards = {board.outfit.name: board for some in boards.values() for board in some}
        self._clusters = {name: [b.outfit.name for b in some] for name, some in boards.items()}
        self._active: dict[tuple[str, str], float] = {}
        self._new: list[tuple[Alarm, bool]] = []  # and whether an emergency had been called by then
        self._last: dict[tuple[str, str], Alarm] = {}
        self._heard = dict.fromkeys(boards, start)
        self._runs_since = inf
        self._wrote_at = start
        self._well = dict.fromkeys(boards, inf)
        self._off: dict[str, float] = {}
        self._faulty: dict[str, float] = {}
        self._unlisted: dict[str, float] = {}
        self._called = False

    def on_alarm(self, alarm: Alarm, now: float) -> None:
        """Record an alarm of the plant, to be judged at the next check.

        The same alarm may arrive twice: from the controller, and from the logbook, which also
        contains the alarms of automatic control.
        """
        key = alarm.condition, alarm.subject
        if self._last.get(key) == alarm:
            return
        self._last[key] = alarm
        if alarm.active:
            self._active.setdefault(key, now)
            self._new.append((alarm, self._called))
        else:
            self._active.pop(key, None)
            self._called &= alarm.condition != CALLED

    def on_call(self, owner: str, act: Act, now: float) -> None:
        """Record that an operator has called an emergency."""
        del owner, act, now
        self._called = True

    def on_end(self, now: float) -> None:
        """Record that the plant program, and its alarms with it, has ended."""
        del now
        self._active.clear()
        self._last.clear()
        self._new.clear()
        self._began_at = inf
        self._runs_since = inf  # it may start again before the next check

    def on_heard(self, cluster: str, now: float) -> None:
        """Record a status that the plant has received."""
        self._heard[cluster] = now

    def look(
        self,
        rest: Mapping[str, float],
        carried: Collection[str],
        now: float,
        *,
        runs: bool,
        writes: bool,
        files: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Judge all alarms.

        Parameters
        ----------
        rest
            When the last fault affecting each heliostat ended or will end, s.
        carried
            Clusters that the plant can reach.
        now
            s.
        runs
            Whether the plant program is running.
        writes
            Whether the disk stores the plant's records in time; a slow disk completes its writes
            one by one.
        files
            Errors in the clusters' files; see `Pod.file`.
        """
        self._wrote_at = self._wrote_at if writes else now
        rests = dict(rest)
        rests |= {
            name: max(rest[heliostat] for heliostat in some)
            for name, some in self._clusters.items()
        }
        rests |= {written: rest[name] for name, written in files.items() if written}
        rests[""] = rests["receiver"] = max(rest.values())
        new, self._new = self._new, []
        if runs:
            self._began_at = min(self._began_at, now)
        for alarm, called in new:
            self._caused(alarm, rests, now, called=called)
        self._runs_since = min(self._runs_since, now) if runs else inf
        if not (runs and self._alone):
            self._heard = dict.fromkeys(self._heard, now)
            return
        for (kind, subject), since in self._active.items():
            ends = max(since, rests.get(subject, inf), self._runs_since)
            passed = now - (max(ends, self._wrote_at) if kind == UNWRITTEN else ends)
            limit = self._by_faults.get(kind, inf)
            saw = f"{kind} is active {passed:.0f} s after the last fault, limit {limit:g} s"
            self.check(16, passed <= limit, now, subject, saw)
        for cluster, some in self._clusters.items():
            self._named_cluster(cluster, now)
            connected = cluster in carried
            self._well[cluster] = min(self._well[cluster], now) if connected else inf
            for name in some:
                self._named(name, max(self._well[cluster], self._runs_since), now, files)

    def contradicted(self, now: float, *, runs: bool) -> None:
        """Check that an alarm reports a time that is wrong in both the plant and the clusters."""
        self._runs_since = min(self._runs_since, now) if runs else inf
        named = any(kind == "sun_contradicted" for kind, _ in self._active)
        passed = now - self._runs_since
        saw = (
            f"its time has been wrong for {passed:.0f} s, and sun_contradicted has not been raised"
        )
        self.check(16, named or passed <= CONTRADICTED_WITHIN, now, "plant", saw)

    def _caused(
        self, alarm: Alarm, rests: Mapping[str, float], now: float, *, called: bool
    ) -> None:
        """Check that an alarm has a possible cause, an existing subject, and a useful text."""
        kind, subject = alarm.condition, alarm.subject
        saw = f"{kind} is raised: {alarm.text}"
        known = kind in BY_FAULTS or kind in BY_OTHERS
        self.check(16, known, now, subject, f"{saw}: nothing in this world causes it")
        self.check(16, subject in rests, now, subject, f"{saw}: there is no {subject!r}")
        sense = len(alarm.text) > len(kind) and not _NONSENSE.search(alarm.text)
        self.check(16, sense, now, subject, f"{saw}: the text says nothing")
        recalled = now - self._began_at <= RECALLED_WITHIN
        if kind == CALLED and self._alone:
            nobody = f"{saw}: nobody has ordered one since the last one ended"
            self.check(L2, called or recalled, now, subject, nobody)
        if kind in UNORDERED and self._works:
            calm = now - rests[""]
            good = calm <= UNORDERED[kind] or recalled
            own = f"nothing has failed for {calm:.0f} s; its cause is the plant's own act"
            self.check(L2, good, now, subject, f"{saw}: {own}")
        if kind in self._by_faults:
            calm = now - rests[subject]
            good = calm <= RAISED_WITHIN
            self.check(16, good, now, subject, f"{saw}: the last fault ended {calm:.1f} s ago")

    def _named_cluster(self, cluster: str, now: float) -> None:
        silent = now - max(self._heard[cluster], self._runs_since)
        named = ("cluster_silent", cluster) in self._active
        saw = f"the plant has received nothing from it for {silent:.1f} s, and no alarm says so"
        self.check(16, named or silent <= UNHEARD_WITHIN, now, cluster, saw)

    def _named(self, name: str, well: float, now: float, files: Mapping[str, str]) -> None:
        """Check that alarms name boards without power, in FAULT, or missing from the file."""
        state, heard = self._boards[name].state, name not in files
        for since, holds, alarm, within, what in (
            (self._off, heard and state < 0, "node_silent", SILENT_WITHIN, "without power"),
            (self._faulty, heard and state == states.FAULT, "node_fault", FAULT_WITHIN, "in FAULT"),
            (self._unlisted, not heard, "heliostat_unlisted", UNLISTED_WITHIN, "in no file"),
        ):
            if not holds:
                since.pop(name, None)
                continue
            passed = now - max(since.setdefault(name, now), well)
            named = (alarm, name) in self._active
            saw = f"it has been {what} for {passed:.1f} s, and no {alarm} names it"
            self.check(16, named or passed <= within, now, name, saw)
