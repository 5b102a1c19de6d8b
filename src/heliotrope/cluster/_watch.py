"""Monitoring in a cluster: the cluster's rows of the safety table, and the plant's lease."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from heliotrope.cluster._reports import Reports
from heliotrope.cluster._runs import PlantRuns
from heliotrope.cluster.timekeeping import Time
from heliotrope.links.messages import Lease
from heliotrope.safety import (
    AcknowledgeRole,
    Act,
    Action,
    Alarm,
    Condition,
    Limits,
    Reading,
    SafetyState,
    Watcher,
    acknowledge,
    alarms,
    conditions,
    decision,
    evaluate,
    limited,
    start,
    watched_by,
)

_LINE = "emergency_line"
#: The condition for the plant's silence trips after this time plus the autonomy, s; no lease may be
#: longer.
_PLANT_LEASE = 3.0
#: Once that condition has tripped, it releases only below 2 s of silence; with a shorter lease it
#: would never release.
_SHORTEST_LEASE = 1.0
#: Represents an unknown time error, s.
_UNBOUNDED = 1e9  # beyond safety.condition.UNKNOWN_TIME


@dataclass(frozen=True)
class Verdict:
    """The actions that the safety table requires.

    Attributes
    ----------
    act
        The strongest required action; None if nothing is wrong.
    new
        DEFOCUS or STOW if the table has just begun to require it; None otherwise.
    acts
        All required actions, for the status, such as "DEFOCUS plant_link_lost".
    forbidden
        Reason why motion is forbidden; empty if motion is allowed.
    """

    act: Act | None = None
    new: Act | None = None
    acts: tuple[str, ...] = ()
    forbidden: str = ""

    @property
    def dark(self) -> bool:
        """Whether SUN must not be sent."""
        return self.act is not None and self.act >= Act.DEFOCUS


class Watch:
    """The safety table of a cluster, evaluated once a second, and the plant's lease.

    Parameters
    ----------
    cluster
        Name of the cluster.
    longest_autonomy
        Longest autonomy that the plant may grant, s.
    reports
        Receives alarms.
    now, present
        Monotonic time, s, and the reported time at that moment, with which the next second's time
        is compared.
    limits
        Limits of the safety table that the plant sets.
    line
        Function that returns whether current flows in the emergency line; None if there is no line.

    Attributes
    ----------
    token
        Token of the command authority in the last lease; 0 if there is none.
    verdict
        Actions that the safety table requires in this second.
    runs
        Run of the plant that the cluster belongs to, and the runs that it refuses.
    """

    def __init__(
        self,
        cluster: str,
        longest_autonomy: float,
        reports: Reports,
        now: float,
        present: Time,
        limits: Limits,
        line: Callable[[], bool] | None = None,
    ) -> None:
        self._cluster, self._longest, self._line = cluster, longest_autonomy, line
        self._reports, self._limits = reports, limits
        self._autonomy = 0.0
        self._state: SafetyState = start(self._table(), now)
        self._lease: Reading | None = None
        self._over = -math.inf
        self._offset: float | None = None
        self._step(present, now)
        self.token = 0
        self.verdict = Verdict()
        self.runs = PlantRuns()

    def _table(self) -> tuple[Condition, ...]:
        rows = watched_by(limited(conditions(self._autonomy), self._limits), Watcher.CLUSTER)
        return tuple(row for row in rows if self._line is not None or row.name != _LINE)

    # -- the lease -------------------------------------------------------------------------

    def take(self, lease: Lease, now: float) -> str | None:
        """Accept a new lease, or return the reason for its refusal."""
        if not _SHORTEST_LEASE <= lease.lifetime <= _PLANT_LEASE:
            return (
                f"the lease must last {_SHORTEST_LEASE:g} to {_PLANT_LEASE:g} s, not "
                f"{lease.lifetime:g} s"
            )
        if not (0 <= lease.token <= 0xFFFFFFFF and lease.autonomy >= 0.0):
            return f"lease with token {lease.token} and autonomy {lease.autonomy:g} s: out of range"
        autonomy = min(lease.autonomy, self._longest)
        if autonomy < lease.autonomy:
            self._reports.alarm(
                alarms.AUTONOMY_LIMITED.raised(
                    granted=lease.autonomy, cluster=self._cluster, longest=self._longest
                )
            )
        else:
            self._reports.clear(alarms.AUTONOMY_LIMITED.ended())
        if autonomy != self._autonomy:
            self._autonomy = autonomy
            self._state = replace(self._state, table=self._table())
        self.token = lease.token
        self._lease = Reading(_PLANT_LEASE - lease.lifetime, now)
        self._over = now + lease.lifetime
        self.runs.took(lease.run, now, self._over)
        return None

    def lease_left(self, now: float) -> float:
        """Return the plant's remaining lease without autonomy, s; below 0 once it has expired."""
        return max(self._over - now, -_UNBOUNDED)

    def alone(self, now: float) -> bool:
        """Return whether both the lease and the autonomy have expired."""
        return now >= self._over + self._autonomy

    def authority(self, now: float) -> int:
        """Return the token of the command authority; 0 once lease and autonomy have expired."""
        return 0 if self.alone(now) else self.token

    # -- the table -------------------------------------------------------------------------

    def second(self, time: Time, bus_errors: float, now: float) -> Verdict:
        """Evaluate the table for this second, and return its verdict."""
        readings = {
            ("bus_errors", ""): Reading(bus_errors, now),
            ("clock_step", ""): Reading(self._step(time, now), now),
            ("time_uncertainty", ""): Reading(
                time.error if math.isfinite(time.error) and time.quality != "none" else _UNBOUNDED,
                now,
            ),
        }
        if time.quality in ("gps", "system"):
            readings["time_source_silence", ""] = Reading(0.0, now)
        if self._lease is not None:
            readings["plant_silence", ""] = self._lease
        if self._line is not None:
            readings["emergency_line_live", ""] = Reading(float(self._line()), now)
        if time.note:
            self._reports.alarm(alarms.TIME_SOURCE.raised(problem=time.note))
        else:
            self._reports.clear(alarms.TIME_SOURCE.ended())
        if second := self.runs.second_plants(now):
            runs = ", ".join(second)
            self._reports.alarm(alarms.TWO_PLANTS.raised(runs=runs, holder=self.runs.holder))
        else:
            self._reports.clear(alarms.TWO_PLANTS.ended())
        before = self.verdict.act
        self._state, actions = evaluate(readings, self._state, now)
        self._alarm(actions)
        if self.alone(now):
            self.token = 0
        act = decision(actions, cluster=self._cluster)
        strong = act is not None and act >= Act.DEFOCUS
        fresh = any(action.new and action.act == act for action in actions)
        new = act if strong and (fresh or before != act) else None
        self.verdict = Verdict(
            act,
            new,
            tuple(f"{action.act.name} {action.condition}" for action in actions),
            next((a.text for a in actions if a.act >= Act.REFUSE_NEW), ""),
        )
        return self.verdict

    def _step(self, time: Time, now: float) -> float:
        """Return by how much the time has stepped relative to the monotonic clock, s.

        The comparison is with the last time that had a source, however old.
        """
        if time.quality == "none":
            return 0.0
        before, self._offset = self._offset, time.gps_s - now
        step = 0.0 if before is None else abs(self._offset - before)
        return max(step, 1.0 if time.jumped else 0.0)

    def _alarm(self, actions: list[Action]) -> None:
        tripped = {action.condition for action in actions}
        for alarm in self._reports.alarms:
            if alarm.condition not in tripped and alarm.subject == self._cluster:
                text = f"{alarm.condition}: over"
                self._reports.clear(replace(alarm, text=text, active=False))
        for action in actions:
            self._reports.alarm(
                Alarm(action.condition, self._cluster, action.severity, action.line)
            )

    def acknowledge(self, condition: str, who: str, role: AcknowledgeRole) -> str | None:
        """Acknowledge a latching row; return the reason for a refusal, or None if accepted."""
        self._state, refusal = acknowledge(self._state, condition, who, role)
        return refusal
