"""The state of the whole field in one table, with the age of each row.

Rows come from the clusters' `ClusterStatus` messages. The age of a row is the age that the cluster
stated for the local controller's reply, plus the time since. A row older than the limit is stale,
and its values are masked, so that an unknown value is never shown as if it were known (invariant
11).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.geometry import FloatArray, as_float
from heliotrope.lcu import names as meanings
from heliotrope.lcu import states
from heliotrope.links.messages import NEVER, NODE, ClusterStatus

#: Age from which a row is stale, s: three missed polls.
STALE = 3.0

#: States in which a heliostat does not operate until an operator has attended to it.
OUT_OF_ORDER = (states.FAULT, states.UNCONFIGURED)
#: States in which a heliostat moves only to turn away and to go to stow.
_HELD = (states.LOCKED, states.FAULT)
#: If the goals in two reports differ by more steps than this, they belong to different motions.
_TURN = 200

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class HeliostatState:
    """One heliostat.

    Attributes
    ----------
    name, cluster
        Names.
    age
        Age of the values below, s; infinite if nothing was ever received.
    live
        Whether the age is below the limit. If it is not, ``state`` is "" and the other values are
        meaningless.
    state, fault, flags
        State, fault and flags in words.
    counts, goals
        Step counts of the two axes, and their goals, (2,).
    """

    name: str
    cluster: str
    age: float
    live: bool
    state: str = ""
    fault: str = ""
    flags: tuple[str, ...] = ()
    counts: tuple[int, int] = (0, 0)
    goals: tuple[int, int] = (0, 0)

    @property
    def text(self) -> str:
        """The state of the heliostat in one line."""
        return f"{self.name}: {self.condition}"

    @property
    def condition(self) -> str:
        """The state and the fault in words, or the time since the last report."""
        if not self.live:
            since = f"for {self.age:.0f} s" if math.isfinite(self.age) else "yet"
            return f"not heard {since}"
        fault = f", {self.fault}" if self.fault != "none" else ""
        return f"{self.state}{fault}"


class FieldState:
    """The state of N heliostats in C clusters.

    Parameters
    ----------
    clusters
        Names of the heliostats by cluster name.
    limit
        Age above which a row is stale, s.

    Attributes
    ----------
    names, index
        The N names, and the index of each name.
    clusters, members
        Names of the clusters, and of their heliostats.
    cluster
        Index of each heliostat's cluster, (N,).
    rows
        Last known rows of dtype `NODE`, (N,); use `values`, which masks stale rows.
    heard
        Time to which each row applies, monotonic s, (N,); minus infinity if nothing was received.
    counted_at
        The same for the step counts and the goals in the row.
    posed, posed_state, posed_at
        Step counts when they were last known, (N, 2), the state at that time, and the time, (N,). A
        local controller that has lost its counts continues to report numbers, which are
        meaningless.
    unlisted
        Heliostats for which their clusters report no row.
    restarted
        Heliostats whose boards had restarted, or stored another armature, at the last status; the
        boards may have been replaced.
    turned
        Whether a heliostat has moved since it was locked or in FAULT, (N,). If so, it has turned
        away and will not turn further, unless it was locked again between two statuses.

    Raises
    ------
    InputError
        If there are no heliostats, or one is in two clusters.
    """

    def __init__(self, clusters: Mapping[str, Sequence[str]], limit: float = STALE) -> None:
        self.clusters = tuple(clusters)
        self.members = {name: tuple(held) for name, held in clusters.items()}
        pairs = [(name, c) for c, held in enumerate(clusters.values()) for name in held]
        self.names = tuple(name for name, _ in pairs)
        self.index = {name: row for row, name in enumerate(self.names)}
        if len(self.index) != len(pairs) or not pairs:
            twice = sorted({name for name in self.names if self.names.count(name) > 1})
            raise InputError(
                f"field: heliostat {twice[0]} is in two clusters; list it in one cluster only"
                if twice
                else "field: no cluster has a heliostat; add at least one heliostat"
            )
        self.cluster = np.array([c for _, c in pairs], dtype=np.intp)
        self.limit = limit
        self.rows: npt.NDArray[Any] = np.zeros(len(pairs), NODE)
        self.heard = np.full(len(pairs), -np.inf)
        self.counted_at = np.full(len(pairs), -np.inf)
        self.posed = np.zeros((len(pairs), 2))
        self.posed_state = np.zeros(len(pairs), dtype=np.intp)
        self.posed_at = np.full(len(pairs), -np.inf)
        self.failed_at = np.full(len(pairs), -np.inf)
        self.turned = np.zeros(len(pairs), dtype=bool)
        self.status_at = dict.fromkeys(self.clusters, -math.inf)
        self.unlisted: set[str] = set()
        self.restarted: tuple[str, ...] = ()
        self._places: dict[str, tuple[tuple[str, ...], npt.NDArray[np.intp]]] = {}

    def __len__(self) -> int:
        return len(self.names)

    def take(self, cluster: str, status: ClusterStatus, at: float) -> list[str]:
        """Accept a status that arrived at ``at`` (monotonic s); return its problems.

        Raises
        ------
        ProtocolError
            If the data block is not a whole number of rows.
        """
        nodes, self.restarted = status.nodes(), ()
        if status.names:
            self.learn_order(cluster, status.names)
        known = self._places.get(cluster)
        if known is None:
            return [
                (
                    f"cluster {cluster}: its status arrived before its list of names, so the "
                    f"records cannot be assigned to heliostats"
                )
            ]
        reported, places = known
        if len(nodes) != len(reported):
            return [
                f"cluster {cluster}: its status has {len(nodes)} records for {len(reported)} names"
            ]
        self.status_at[cluster] = at
        problems = [
            f"cluster {cluster}: it reports heliostat {name}, which belongs to another cluster; "
            f"correct its configuration"
            for name, place in zip(reported, places, strict=True)
            if place < 0 and status.names
        ]
        good = (places >= 0) & (nodes["heard_ms"] != NEVER) & (nodes["state"] < len(states.STATES))
        mine, new = places[good], nodes[good]
        self._note_failures(mine, new, at)
        anew = self.rows["boots"][mine] != new["boots"]
        anew |= self.rows["armature_crc"][mine] != new["armature_crc"]
        anew &= np.isfinite(self.heard[mine])
        self.restarted = tuple(self.names[row] for row in mine[anew])
        before, goals = self.rows["state"][mine], self.goals(mine)
        self.rows[mine] = new
        stays = np.isin(before, _HELD) & (before == new["state"])
        moved = np.abs(self.goals(mine) - goals).max(axis=-1) > _TURN
        self.turned[mine] = stays & (self.turned[mine] | moved)
        self.heard[mine] = at - 1e-3 * new["heard_ms"].astype(np.float64)
        steps = new["steps_ms"].astype(np.float64)
        self.counted_at[mine] = np.where(steps < NEVER, at - 1e-3 * steps, -np.inf)
        known = (steps < NEVER) & (new["flags"] & meanings.COUNTS_UNKNOWN == 0)
        self.posed[mine[known]] = self.counts(mine[known])
        self.posed_state[mine[known]] = new["state"][known]
        self.posed_at[mine[known]] = self.counted_at[mine[known]]
        return problems

    def _rows_of(self, cluster: str, names: Sequence[str]) -> npt.NDArray[np.intp]:
        """Return the index of each named heliostat; -1 if it belongs to another cluster."""
        c = self.clusters.index(cluster)
        rows = [self.index.get(name, -1) for name in names]
        return np.array([r if r >= 0 and self.cluster[r] == c else -1 for r in rows], np.intp)

    def _note_failures(self, mine: npt.NDArray[np.intp], new: npt.NDArray[Any], at: float) -> None:
        """Note which heliostats are in FAULT, or silent although their cluster reports."""
        known = np.isfinite(self.heard[mine])
        before = self.rows["state"][mine] == states.FAULT
        faulty = known & ~before & (new["state"] == states.FAULT)
        silent = 1e-3 * new["heard_ms"].astype(np.float64) > self.limit
        was_silent = 1e-3 * self.rows["heard_ms"][mine].astype(np.float64) > self.limit
        self.failed_at[mine[faulty | (known & silent & ~was_silent)]] = at

    def learn_order(self, cluster: str, names: tuple[str, ...]) -> None:
        """Accept the heliostat names of a cluster's rows, in row order."""
        self._places[cluster] = (names, self._rows_of(cluster, names))
        members = self.members[cluster]
        self.unlisted.difference_update(members)
        self.unlisted.update(set(members).difference(names))

    def knows_order(self, cluster: str) -> bool:
        """Whether the heliostat names of a cluster's rows are known."""
        return cluster in self._places

    def place(self, name: str) -> int:
        """Return the index of a heliostat.

        Raises
        ------
        UnknownNameError
            If there is no such heliostat.
        """
        row = self.index.get(name)
        if row is None:
            raise UnknownNameError("heliostat", name, self.names)
        return row

    def age(self, now: float) -> FloatArray:
        """Return the age of each row, s, (N,); infinite if nothing was received."""
        return as_float(now - self.heard)

    def live(self, now: float) -> Mask:
        """Return a mask of the rows younger than the limit, (N,)."""
        return np.asarray(self.age(now) <= self.limit)

    def values(self, field: str, now: float) -> "np.ma.MaskedArray[Any, Any]":
        """Return one column of `NODE`, (N,); the values of stale rows are masked.

        Raises
        ------
        UnknownNameError
            If there is no such column.
        """
        if field not in (NODE.names or ()):
            raise UnknownNameError("value of a heliostat", field, NODE.names or ())
        return np.ma.MaskedArray(self.rows[field].copy(), mask=~self.live(now))

    def counts(self, rows: npt.NDArray[np.intp]) -> FloatArray:
        """Return the last reported step counts of heliostats (K,), (K, 2)."""
        return self._pairs(rows, "primary", "secondary")

    def goals(self, rows: npt.NDArray[np.intp]) -> FloatArray:
        """Return the last reported step-count goals of heliostats (K,), (K, 2)."""
        return self._pairs(rows, "primary_goal", "secondary_goal")

    def _pairs(self, rows: npt.NDArray[np.intp], *names: str) -> FloatArray:
        return np.stack([self.rows[name][rows] for name in names], axis=-1).astype(np.float64)

    def sure(self, now: float) -> Mask:
        """Return a mask of the heliostats that are live and have known step counts, (N,)."""
        known = (self.rows["flags"] & meanings.COUNTS_UNKNOWN == 0) & np.isfinite(self.counted_at)
        return np.asarray(self.live(now) & known)

    def among(self, numbers: Sequence[int], now: float) -> Mask:
        """Return a mask of the heliostats that are live and in one of the given states, (N,)."""
        return np.asarray(self.live(now) & np.isin(self.rows["state"], list(numbers)))

    def counted(self, now: float) -> dict[str, int]:
        """Return the number of heliostats in each state; stale heliostats count as "stale"."""
        live = self.live(now)
        totals = np.bincount(self.rows["state"][live], minlength=len(states.STATES))
        counts = {name: int(n) for name, n in zip(states.STATES, totals, strict=True) if n}
        stale = len(self) - int(live.sum())
        return {**counts, "stale": stale} if stale else counts

    def failed_share(self, now: float, span: float = 600.0) -> float:
        """Return the fraction of heliostats that failed within the last ``span`` s."""
        return float(np.mean(now - self.failed_at < span))

    def of(self, name: str, now: float) -> HeliostatState:
        """Return one heliostat.

        Raises
        ------
        UnknownNameError
            If there is no such heliostat.
        """
        row = self.place(name)
        cluster = self.clusters[self.cluster[row]]
        age = float(now - self.heard[row])
        if not age <= self.limit:
            return HeliostatState(name, cluster, age, live=False)
        node = self.rows[row]
        fault = int(node["fault"])
        flags = int(node["flags"])
        known = fault < len(meanings.FAULTS)
        return HeliostatState(
            name,
            cluster,
            age,
            live=True,
            state=states.STATES[int(node["state"])],
            fault=meanings.FAULTS[fault] if known else f"fault {fault}",
            flags=tuple(flag for i, flag in enumerate(meanings.FLAGS) if flags >> i & 1),
            counts=(int(node["primary"]), int(node["secondary"])),
            goals=(int(node["primary_goal"]), int(node["secondary_goal"])),
        )
