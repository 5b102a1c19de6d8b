"""Failsafe: one table of conditions and actions, and its evaluation.

Plant, clusters and local controllers each watch the rows that name them. A row says which
reading trips it, from which value on and after which delay, what is then done to what, how
bad it is, whether it latches, who must acknowledge it, and when it releases. Nothing here
reads a clock or a sensor: readings and time (monotonic seconds) are arguments.

Rules that hold for every row:

- A reading that is missing, not finite or from the future does not count; the last good one
  does, until it is older than the row's age. Then its worst case counts. A reading that is
  itself an age (silence) grows by itself.
- Only fresh readings release: a stream that stands still never improves anything.
- A latched row stays until its cause has gone *and* a person of the row's role or above
  acknowledges it. An acknowledgement before the cause has gone is refused.
- The strongest action wins. A released row moves no mirror: that needs a fresh command.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.safety.condition import Act, Condition, Role, Scope, Severity, Watcher
from heliotrope.safety.conditions import CONDITIONS, conditions
from heliotrope.safety.proof import (
    DEFOCUS_BUDGET,
    ORDER_BUDGET,
    STOW_BUDGET,
    JoinLimiter,
    Proof,
    ProofReport,
    Reading,
    proof_readings,
)

__all__ = [
    "CONDITIONS", "DEFOCUS_BUDGET", "ORDER_BUDGET", "STOW_BUDGET", "Act", "Action", "Condition",
    "JoinLimiter", "Proof", "ProofReport", "Reading", "Role", "SafetyState", "Scope", "Severity",
    "Watcher", "acknowledge", "adjusted", "conditions", "decision", "evaluate", "proof_readings",
    "start", "watched_by",
]  # fmt: skip

#: What a state is kept for: name of the condition and of the cluster or heliostat ("" = all).
Key = tuple[str, str]


@dataclass(frozen=True)
class Track:
    """What is remembered of one row for one subject.

    Attributes
    ----------
    value, seen
        Last good reading (``None`` before the first) and its time, s; before the first, the
        time of the start.
    beyond_since
        Since when the value has been beyond the trip, s, if it is.
    safe_since
        Time of the first of the unbroken safe readings, s, if the last is safe.
    tripped_at
        When the row tripped, s, if it is tripped.
    cleared
        Whether the cause has gone and only the acknowledgement is missing.
    acknowledged_by
        Who acknowledged the last trip.
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
    """All that the evaluation remembers: rows, their tracks, and the time of the last one, s."""

    table: tuple[Condition, ...]
    now: float
    tracks: Mapping[Key, Track] = field(default_factory=dict)

    def tripped(self) -> tuple[Key, ...]:
        """Which rows are tripped, for which subjects."""
        return tuple(key for key, track in self.tracks.items() if track.tripped_at is not None)


@dataclass(frozen=True)
class Action:
    """What a tripped row demands.

    Attributes
    ----------
    act, scope, subject
        What is to be done, to what; name of the cluster or heliostat, "" for the field.
    condition, severity, budget
        Of the row; s.
    since
        When it tripped, monotonic s.
    new
        Whether it tripped, or became a STOW, in this evaluation.
    waits
        Whether only an acknowledgement is missing.
    text
        One line for the operator.
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


def start(
    table: Iterable[Condition], now: float, subjects: Mapping[str, Iterable[str]] | None = None
) -> SafetyState:
    """Return the state before the first evaluation: nothing tripped, nothing seen.

    Parameters
    ----------
    table
        The rows to evaluate, as of :func:`conditions` and :func:`watched_by`.
    now
        Monotonic seconds; the ages of readings that never come count from here.
    subjects
        By the name of a row of scope CLUSTER or HELIOSTAT: the clusters or heliostats that
        it is evaluated for. Without, it is evaluated once, for the subject "".

    Raises
    ------
    InputError
        If ``now`` is not finite, or a name stands twice in the table.
    UnknownNameError
        If ``subjects`` names a row that is not in the table.
    """
    rows = tuple(table)
    if not math.isfinite(now):
        raise InputError(f"start at {now} s: the monotonic time must be finite")
    names = [row.name for row in rows]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"condition {name}: it stands twice in the table")
    given = dict(subjects or {})
    for name in given:
        if name not in names:
            raise UnknownNameError("condition", name, names)
    keys = ((row.name, subject) for row in rows for subject in given.get(row.name, ("",)))
    return SafetyState(rows, now, {key: Track(seen=now) for key in keys})


def narrowed(state: SafetyState, name: str, subjects: Iterable[str]) -> SafetyState:
    """Return the state with a row evaluated for some subjects, besides those that it trips for.

    For a row about heliostats, of which few are ever worth a look.

    Parameters
    ----------
    state
        As of :func:`start` or the last evaluation.
    name
        Of the row.
    subjects
        Whose readings are there.
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


def evaluate(
    readings: Mapping[Key, Reading], state: SafetyState, now: float
) -> tuple[SafetyState, list[Action]]:
    """Return the next state and all actions that are demanded now, the strongest first.

    Parameters
    ----------
    readings
        By name of the reading and subject. The reading of subject "" serves where a
        subject has none of its own.
    state
        As :func:`start` or the last evaluation gave it.
    now
        Monotonic seconds. A time before the last one is a broken clock: DEFOCUS of the
        field is demanded, and nothing ages or releases.
    """
    actions: list[Action] = []
    time = now
    if not (now >= state.now and math.isfinite(now)):
        time = state.now
        text = f"the monotonic time went from {state.now:g} s to {now:g} s; restart this controller"
        actions.append(
            Action(
                Act.DEFOCUS,
                Scope.FIELD,
                "",
                "time_went_back",
                Severity.EMERGENCY,
                DEFOCUS_BUDGET,
                time,
                new=True,
                waits=False,
                text=text,
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
    actions.sort(key=lambda a: (-a.act, -a.scope, -a.severity, a.since, a.condition, a.subject))
    return SafetyState(state.table, time, tracks), actions


def _advance(row: Condition, track: Track, reading: Reading | None, now: float) -> Track:
    """Return the track after a reading, or after none, at ``now``."""
    value, seen, fresh = track.value, track.seen, False
    if reading is not None and math.isfinite(reading.value) and seen <= reading.at <= now:
        # Of two readings of one time the worse counts.
        worse = value is None or (reading.value > value if row.above else reading.value < value)
        if reading.at > seen or worse:
            value, seen, fresh = reading.value, reading.at, True
    counts = _counting(row, value, seen, now)
    beyond = row.beyond(counts)
    beyond_since = (now if track.beyond_since is None else track.beyond_since) if beyond else None
    safe_since = track.safe_since
    if not row.safe(counts):
        safe_since = None
    elif fresh and safe_since is None:
        safe_since = seen
    tripped_at, cleared, by = track.tripped_at, track.cleared, track.acknowledged_by
    if beyond_since is not None and now - beyond_since >= row.delay:
        # A second trip needs a second acknowledgement.
        tripped_at = now if tripped_at is None else tripped_at
        cleared, by = False, "" if track.tripped_at is None else by
    elif tripped_at is not None:
        # Safe time counts up to the last reading only, so that silence releases nothing.
        cleared = safe_since is not None and seen - safe_since >= row.clear_for
        if cleared and not row.latched:
            tripped_at, cleared = None, False
    return Track(seen, value, beyond_since, safe_since, tripped_at, cleared, by)


def _counting(row: Condition, value: float | None, seen: float, now: float) -> float:
    """Return the value that counts now."""
    age = now - seen
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
    if waits and row.role is not None:
        text += f"; the cause has gone, {row.role.name.lower()} to acknowledge"
    scope = row.scope.name.lower()
    text += f"; {act.name} {scope}{f' {subject}' if subject else ''}"
    return Action(
        act, row.scope, subject, row.name, row.severity, row.budget, since, new, waits, text
    )


def _act(row: Condition, tripped_for: float) -> Act:
    return max(row.act, Act.STOW) if tripped_for >= row.then_stow else row.act


def _said(row: Condition, track: Track, now: float) -> str:
    """Return what the reading is, in words."""
    counts = _counting(row, track.value, track.seen, now)
    if math.isinf(counts):
        return f"no {row.what} for {now - track.seen:.1f} s (limit {row.stale_after:g} s)"
    unit = "" if row.unit == "1" else f" {row.unit}"
    side = "at or above" if row.above else "at or below"
    if not row.beyond(counts):
        side = "released at" if row.safe(counts) else "not yet back at"
        return f"{row.what} is {counts:.3g}{unit}, {side} {row.releases:g}{unit}"
    return f"{row.what} is {counts:.3g}{unit}, {side} {row.trips:g}{unit}"


def _strangers(readings: Mapping[Key, Reading], state: SafetyState, now: float) -> Iterable[Action]:
    """Yield an alarm for each reading that no row waits for: a wrong name watches nothing."""
    known = {row.reading for row in state.table}
    for name in sorted({name for name, _ in readings} - known):
        text = f"reading {name!r} is in no row of the table; correct its name"
        yield Action(
            Act.ALARM,
            Scope.FIELD,
            "",
            "unknown_reading",
            Severity.WARNING,
            0.0,
            now,
            new=False,
            waits=False,
            text=text,
        )


def acknowledge(
    state: SafetyState, condition: str, who: str, role: Role, subject: str = ""
) -> tuple[SafetyState, str]:
    """Return the state after a person's acknowledgement, and why it was refused ("" if not).

    Parameters
    ----------
    state
        After the last evaluation.
    condition, subject
        The row, and the cluster or heliostat it is about.
    who, role
        The person's name, for the audit record, and role.
    """
    rows = {row.name: row for row in state.table}
    row, track = rows.get(condition), state.tracks.get((condition, subject))
    label = f"{condition} {subject}".strip()
    if row is None or track is None:
        return state, f"{label}: there is no such condition here"
    if track.tripped_at is None:
        return state, f"{label}: it is not tripped; there is nothing to acknowledge"
    if row.role is None:
        return state, f"{label}: it releases by itself; it needs no acknowledgement"
    if not who.strip():
        return state, f"{label}: an acknowledgement needs a person's name"
    if role < row.role:
        return state, f"{label}: {row.role.name.lower()} must acknowledge, not {role.name.lower()}"
    if not track.cleared:
        return state, f"{label}: the cause has not gone: {_said(row, track, state.now)}"
    released = replace(
        track, tripped_at=None, cleared=False, beyond_since=None, acknowledged_by=who.strip()
    )
    return replace(state, tracks={**state.tracks, (condition, subject): released}), ""


def decision(actions: Iterable[Action], cluster: str = "", heliostat: str = "") -> Act | None:
    """Return the strongest action that concerns a heliostat of a cluster; ``None`` if none does.

    An action without a subject concerns all that the evaluating tier commands.
    """
    ours = {Scope.HELIOSTAT: heliostat, Scope.CLUSTER: cluster, Scope.FIELD: ""}
    acts = (a.act for a in actions if a.subject in {"", ours[a.scope]})
    return max(acts, default=None)


def watched_by(table: Iterable[Condition], watcher: Watcher) -> tuple[Condition, ...]:
    """Return the rows that a tier evaluates."""
    return tuple(row for row in table if row.watcher is watcher)


def adjusted(table: Iterable[Condition], name: str, **changes: float) -> tuple[Condition, ...]:
    """Return the table with numbers of one row changed, such as ``trips`` and ``releases``.

    Raises
    ------
    UnknownNameError
        If there is no such row, or a row has no such number.
    InputError
        If the row does not hold together any more.
    """
    rows = tuple(table)
    numbers = ("trips", "releases", "budget", "then_stow", "delay", "clear_for", "stale_after")
    for change in changes:
        if change not in numbers:
            raise UnknownNameError("number of a condition", change, numbers)
    names = [row.name for row in rows]
    if name not in names:
        raise UnknownNameError("condition", name, names)
    k = names.index(name)
    numeric: dict[str, float] = {key: float(value) for key, value in changes.items()}
    # dataclasses.replace takes fields of several types; these are all floats.
    changed = replace(rows[k], **numeric)  # type: ignore[arg-type]
    return (*rows[:k], changed, *rows[k + 1 :])
