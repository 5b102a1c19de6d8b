"""Evaluation of the safety table: a pure function of readings, state and time.

The plant, the clusters and the local controllers each evaluate the rows assigned to them. A row
defines the reading that trips it, the limit and the delay; the action, its scope and its severity;
whether the row latches and which role must acknowledge it; and when it releases. This module reads
no clock and no sensor: readings and time (monotonic seconds) are arguments.

Rules for every row:

- A reading that is missing, not finite or from the future is ignored. The last valid reading is
  used until it is older than the age limit of the row; after that the worst case is assumed. A
  reading that is itself an age (the duration of a silence) keeps increasing.
- Only fresh readings release a row, so a frozen data stream never improves the situation.
- A latched row stays tripped until its cause has gone *and* an operator with the row's role or a
  higher role acknowledges it. An acknowledgement before the cause has gone is refused.
- The strongest action takes precedence. The release of a row does not move any heliostat; motion
  needs a new command.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.safety import alarms
from heliotrope.safety.condition import (
    AcknowledgeRole,
    Act,
    Condition,
    Reading,
    Scope,
    Severity,
    Watcher,
)
from heliotrope.safety.proof import DEFOCUS_BUDGET

#: Key of a track: name of the condition, and name of the cluster or heliostat ("" for all).
Key = tuple[str, str]


@dataclass(frozen=True)
class Track:
    """What the evaluation remembers about one row for one subject.

    Attributes
    ----------
    value, seen
        Last valid reading and its time, s. Before the first reading, these are ``None`` and the
        start time.
    beyond_since
        Time at which the value went beyond the trip limit, s; None while it is within the limit.
    safe_since
        Time at which the present unbroken series of safe readings began, s; None if the last
        reading is not safe.
    tripped_at
        Time at which the row tripped, s; None while the row is not tripped.
    cleared
        Whether the cause has gone and only the acknowledgement is missing.
    acknowledged_by
        The person who acknowledged the last trip.
    """

    seen: float
    value: float | None = None
    beyond_since: float | None = None
    safe_since: float | None = None
    tripped_at: float | None = None
    cleared: bool = False
    acknowledged_by: str = ""


@dataclass(frozen=True)
class SafetyState:
    """State of the evaluation: rows, their tracks, and the time of the last evaluation, s."""

    table: tuple[Condition, ...]
    now: float
    tracks: Mapping[Key, Track] = field(default_factory=dict)

    def tripped(self) -> tuple[Key, ...]:
        """Return the tripped rows, each with its subject."""
        return tuple(key for key, track in self.tracks.items() if track.tripped_at is not None)


@dataclass(frozen=True)
class Action:
    """The action required by a tripped row.

    Attributes
    ----------
    act, scope, subject
        The action, its scope, and the name of the cluster or heliostat ("" for the field).
    condition, severity, budget
        Name, severity and budget (s) of the row.
    since
        Time of the trip, monotonic s.
    new
        Whether the row tripped, or changed to STOW, in this evaluation.
    waits
        Whether the row waits only for an acknowledgement.
    text, remedy
        What is wrong and what happens automatically, and what the operator should do.
    """

    act: Act
    scope: Scope
    subject: str
    condition: str
    severity: Severity
    budget: float
    since: float
    new: bool
    waits: bool
    text: str
    remedy: str = ""

    @property
    def line(self) -> str:
        """Text and remedy, for an alarm."""
        return f"{self.text}. {self.remedy}" if self.remedy else self.text


def start(
    table: Iterable[Condition], now: float, subjects: Mapping[str, Iterable[str]] | None = None
) -> SafetyState:
    """Return the state before the first evaluation, in which no row has tripped.

    Parameters
    ----------
    table
        The rows to evaluate, from `conditions` and `watched_by`.
    now
        Monotonic time, s. The age of a reading that never arrives is counted from this time.
    subjects
        For rows of scope CLUSTER or HELIOSTAT, keyed by row name: the clusters or heliostats for
        which to evaluate the row. Without subjects a row is evaluated once, for the subject "".

    Raises
    ------
    InputError
        If ``now`` is not finite, or a name occurs twice in the table.
    UnknownNameError
        If a name in ``subjects`` is not in the table.
    """
    rows = tuple(table)
    if not math.isfinite(now):
        raise InputError(f"start at {now} s: the monotonic time must be finite")
    names = [row.name for row in rows]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"condition {name}: it is in the table twice; remove one of the two")
    subjects_of = dict(subjects or {})
    for name in subjects_of:
        if name not in names:
            raise UnknownNameError("condition", name, names)
    keys = ((row.name, subject) for row in rows for subject in subjects_of.get(row.name, ("",)))
    return SafetyState(rows, now, {key: Track(seen=now) for key in keys})


def narrowed(state: SafetyState, name: str, subjects: Iterable[str]) -> SafetyState:
    """Return the state in which one row is evaluated only for some subjects.

    Subjects for which the row has already tripped are kept. This is meant for rows about
    heliostats, of which only a few ever need evaluation.

    Parameters
    ----------
    state
        State from `start` or from the last evaluation.
    name
        Name of the row.
    subjects
        Subjects with a reading.
    """
    tracks = {
        key: track
        for key, track in state.tracks.items()
        if key[0] != name or not key[1] or track.tripped_at is not None
    }
    for subject in subjects:
        key = (name, subject)
        tracks[key] = state.tracks.get(key, Track(seen=state.now))
    return replace(state, tracks=tracks)


def recalled(state: SafetyState, keys: Iterable[Key]) -> SafetyState:
    """Return the state with rows tripped, each for its subject, as they were before a restart.

    These rows release like all rows, through fresh readings and, where required, an
    acknowledgement. A row that is no longer in the table is left out.
    """
    known = {row.name: row for row in state.table}
    tripped = {
        key: Track(seen=state.now, tripped_at=state.now)
        for key in keys
        if key[0] in known and (key in state.tracks or known[key[0]].scope is Scope.HELIOSTAT)
    }
    return replace(state, tracks={**state.tracks, **tripped})


def evaluate(
    readings: Mapping[Key, Reading], state: SafetyState, now: float
) -> tuple[SafetyState, list[Action]]:
    """Return the next state and every action required now, the strongest first.

    Parameters
    ----------
    readings
        Readings, keyed by reading name and subject. A reading with the subject "" is used for
        subjects that have no reading of their own.
    state
        State from `start` or from the last evaluation.
    now
        Monotonic time, s. A time before the last evaluation indicates a faulty clock; a field-wide
        DEFOCUS is then required, and no row ages or releases.
    """
    actions: list[Action] = []
    time = now
    if not (now >= state.now and math.isfinite(now)):
        time = state.now
        kind = alarms.TIME_WENT_BACK
        text = kind.text.format(before=state.now, now=now)
        actions.append(
            Action(
                Act.DEFOCUS,
                Scope.FIELD,
                "",
                kind.name,
                kind.severity,
                DEFOCUS_BUDGET,
                time,
                new=True,
                waits=False,
                text=text,
                remedy=kind.remedy,
            )
        )
    rows = {row.name: row for row in state.table}
    tracks: dict[Key, Track] = {}
    for (name, subject), track in state.tracks.items():
        row = rows[name]
        reading = readings.get((row.reading, subject), readings.get((row.reading, "")))
        after = tracks[name, subject] = _advance(row, track, reading, time)
        if after.tripped_at is not None:
            actions.append(_action(row, subject, track, after, state.now, time))
    actions += _strangers(readings, state, time)
    actions.sort(
        key=lambda a: (-a.act, -a.scope, -a.severity.rank, a.since, a.condition, a.subject)
    )
    return SafetyState(state.table, time, tracks), actions


def _advance(row: Condition, track: Track, reading: Reading | None, now: float) -> Track:
    """Return the track advanced to ``now``, with or without a new reading."""
    value, read_at, fresh = track.value, track.seen, False
    if reading is not None and math.isfinite(reading.value) and read_at <= reading.at <= now:
        # Of two readings with the same time, the worse one is used.
        worse = value is None or (reading.value > value if row.above else reading.value < value)
        if reading.at > read_at or worse:
            value, read_at, fresh = reading.value, reading.at, True
    counts = _counting(row, value, read_at, now)
    beyond = row.beyond(counts)
    beyond_since = (now if track.beyond_since is None else track.beyond_since) if beyond else None
    safe_since = track.safe_since
    if not row.safe(counts):
        safe_since = None
    elif fresh and safe_since is None:
        safe_since = read_at
    tripped_at, cleared, by = track.tripped_at, track.cleared, track.acknowledged_by
    if beyond_since is not None and now - beyond_since >= row.delay:
        # A second trip needs its own acknowledgement.
        tripped_at = now if tripped_at is None else tripped_at
        cleared, by = False, "" if track.tripped_at is None else by
    elif tripped_at is not None:
        # Safe time is counted only up to the last reading, so that silence does not release a row.
        cleared = safe_since is not None and read_at - safe_since >= row.clear_for
        if cleared and not row.latched:
            tripped_at, cleared = None, False
    return Track(read_at, value, beyond_since, safe_since, tripped_at, cleared, by)


def _counting(row: Condition, value: float | None, read_at: float, now: float) -> float:
    """Return the value with which the row is evaluated now."""
    age = now - read_at
    if row.ages:
        return (0.0 if value is None else value) + age
    if age > row.stale_after:
        return row.worst
    # Before the first reading nothing trips and nothing is safe.
    return 0.5 * (row.trips + row.releases) if value is None else value


def _action(
    row: Condition, subject: str, before: Track, after: Track, last: float, now: float
) -> Action:
    since = now if after.tripped_at is None else after.tripped_at
    act = _act(row, now - since)
    new = before.tripped_at is None or _act(row, last - since) != act
    waits = after.cleared
    text = f"{row.name}{f' {subject}' if subject else ''}: {_said(row, after, now)}"
    if not waits and row.safe(_counting(row, after.value, after.seen, now)):
        text += f", and must stay so for {row.clear_for:g} s"
    elif now - since >= 1.0 and not (row.ages or waits):
        text += f", for {now - since:.0f} s"
    kind = row.scope.name.lower()
    place = f"{kind} {subject}" if subject else f"the {kind}"
    doing = {
        Act.ALARM: f"nothing moves or stops in {place}",
        Act.REFUSE_NEW: f"new motions of {place} are refused",
    }.get(act, f"{row.ordered(act)} of {place}")
    if waits and row.role is not None:
        doing = (
            f"the cause is gone; {doing} remains in force until an {row.role.title} acknowledges"
        )
    text += f"; {doing}"
    return Action(
        act,
        row.scope,
        subject,
        row.name,
        row.severity,
        row.budget,
        since,
        new,
        waits,
        text,
        row.remedy,
    )


def _act(row: Condition, tripped_for: float) -> Act:
    return max(row.act, Act.STOW) if tripped_for >= row.then_stow else row.act


def _said(row: Condition, track: Track, now: float) -> str:
    """Return, in words, the value with which the row is evaluated."""
    counts = _counting(row, track.value, track.seen, now)
    if track.value is None and not row.ages and now - track.seen <= row.stale_after:
        return (
            f"it was tripped when the plant's program ended, and {row.what} has not been read since"
        )
    if math.isinf(counts):
        return (
            f"no reading of {row.what} for {now - track.seen:.1f} s, so the worst case is assumed"
        )
    if row.beyond(counts):
        return row.wrong.format(value=row.shown(counts)) + row.limit
    back = row.shown(row.releases)
    if row.safe(counts):
        level = f": {row.what} is {row.shown(counts)}, released at {back}"
        return row.release + ("" if row.unit == "yes/no" else level)
    return f"{row.what} is {row.shown(counts)}, not yet back at {back}"


def _strangers(readings: Mapping[Key, Reading], state: SafetyState, now: float) -> Iterable[Action]:
    """Yield an alarm for each reading that no row uses, because its name may be misspelt."""
    known = {row.reading for row in state.table}
    kind = alarms.UNKNOWN_READING
    for name in sorted({name for name, _ in readings} - known):
        yield Action(
            Act.ALARM,
            Scope.FIELD,
            "",
            kind.name,
            kind.severity,
            0.0,
            now,
            new=False,
            waits=False,
            text=kind.text.format(reading=name),
            remedy=kind.remedy,
        )


def acknowledge(
    state: SafetyState, condition: str, who: str, role: AcknowledgeRole, subject: str = ""
) -> tuple[SafetyState, str | None]:
    """Return the state after an operator's acknowledgement, and the reason if it is refused.

    Parameters
    ----------
    state
        State after the last evaluation.
    condition, subject
        The row, and the cluster or heliostat that it concerns.
    who, role
        Name of the operator, for the record, and role of the operator.
    """
    rows = {row.name: row for row in state.table}
    row, track = rows.get(condition), state.tracks.get((condition, subject))
    label = f"{condition} {subject}".strip()
    if row is None or track is None:
        return state, f"{label}: no such condition is in this table"
    if track.tripped_at is None:
        return state, f"{label}: it is not tripped; there is nothing to acknowledge"
    needed = row.waiver if row.role is None else row.role
    if needed is None:
        return state, f"{label}: it releases by itself and needs no acknowledgement"
    if not who.strip():
        return state, f"{label}: an acknowledgement needs the user's name"
    if role < needed:
        return state, f"{label}: {needed.title} must acknowledge, not {role.title}"
    if not track.cleared and row.waiver is None:
        return state, f"{label}: {_remains(row, track, state.now)}"
    released = replace(
        track, tripped_at=None, cleared=False, beyond_since=None, acknowledged_by=who.strip()
    )
    return replace(state, tracks={**state.tracks, (condition, subject): released}), None


def _remains(row: Condition, track: Track, now: float) -> str:
    """Return the reason why a row cannot be acknowledged before its safe time has passed."""
    if not row.safe(_counting(row, track.value, track.seen, now)):
        return f"the cause is not gone: {_said(row, track, now)}. {row.remedy}"
    safe = 0.0 if track.safe_since is None else track.seen - track.safe_since
    return (
        f"{row.release}, and must stay so for {row.clear_for:g} s; acknowledge again in "
        f"{math.ceil(max(row.clear_for - safe, 1.0))} s"
    )


def decision(actions: Iterable[Action], cluster: str = "", heliostat: str = "") -> Act | None:
    """Return the strongest action that applies to a heliostat in a cluster; None if there is none.

    An action without a subject applies to everything that the evaluating tier commands.
    """
    ours = {Scope.HELIOSTAT: heliostat, Scope.CLUSTER: cluster, Scope.FIELD: ""}
    acts = (a.act for a in actions if a.subject in {"", ours[a.scope]})
    return max(acts, default=None)


def watched_by(table: Iterable[Condition], watcher: Watcher) -> tuple[Condition, ...]:
    """Return the rows that a control tier evaluates."""
    return tuple(row for row in table if row.watcher is watcher)
