"""The journal: events, alarms and commands from the store in one searchable list."""

from datetime import UTC, datetime
from typing import Any

from sqlalchemy import ColumnElement, Connection, String, cast, or_, select

from heliotrope.store import _rows as rows
from heliotrope.store import tables
from heliotrope.store.records import (
    JOURNAL_NAMES,
    NOTE,
    AlarmEntry,
    AuditEntry,
    Event,
    JournalEntry,
    JournalQuery,
)

_EVENT, _ALARM, _AUDIT = tables.event.c, tables.alarm.c, tables.audit.c
#: Number of heliostats that are named for a command; beyond it, their number is stated.
_NAMED = 5


def search(connection: Connection, query: JournalQuery) -> list[JournalEntry]:
    """Return the entries that match a query, latest first."""
    parts = {"event": _events, "alarm": _alarms, "command": _commands, NOTE: _events}
    kinds = [query.kind] if query.kind else ["event", "alarm", "command"]
    found = [entry for kind in kinds for entry in parts[kind](connection, query)]
    return sorted(found, key=lambda entry: -entry.at)[: query.limit]


def _within(column: ColumnElement[Any], query: JournalQuery, *, text: bool = False) -> Any:
    """Return the SQL condition for a time range, in POSIX s or, with ``text``, in ISO 8601."""
    since, until = (
        datetime.fromtimestamp(at, UTC).isoformat(timespec="milliseconds") if text else at
        for at in (query.since, query.until)
    )
    return [column >= since, column < until]


def _has(text: str, *columns: ColumnElement[Any]) -> list[Any]:
    """Return the SQL condition that any of some columns contains a text, ignoring case."""
    return [or_(*(column.icontains(text, autoescape=True) for column in columns))] if text else []


def _events(connection: Connection, query: JournalQuery) -> list[JournalEntry]:
    # The text of an event by a person or about a heliostat begins with the name.
    by = [_EVENT.text.istartswith(f"{query.person}: ", autoescape=True)] if query.person else []
    about = _has(query.heliostat, _EVENT.heliostat, _EVENT.text)
    notes = [_EVENT.source == NOTE] if query.kind == NOTE else []
    wanted = select(tables.event).where(
        *notes,
        *_within(_EVENT.at, query),
        *by,
        *about,
        *_has(query.text, _EVENT.text, _EVENT.source),
    )
    found = rows.records(
        connection, Event, wanted.order_by(_EVENT.number.desc()).limit(query.limit)
    )
    return [
        JournalEntry(one.at, _kind(one), one.source, one.text, one.severity.value) for one in found
    ]


def _kind(event: Event) -> str:
    return NOTE if event.source == NOTE else "event"


def _alarms(connection: Connection, query: JournalQuery) -> list[JournalEntry]:
    by = [_ALARM.acknowledged_by == query.person] if query.person else []
    about = _has(query.heliostat, _ALARM.subject)
    wanted = select(tables.alarm).where(
        *_within(_ALARM.raised, query),
        *by,
        *about,
        *_has(query.text, _ALARM.text, _ALARM.condition),
    )
    found = rows.records(
        connection, AlarmEntry, wanted.order_by(_ALARM.number.desc()).limit(query.limit)
    )
    return [
        JournalEntry(one.raised, "alarm", one.condition, _alarm_text(one), one.severity.value)
        for one in found
    ]


def _alarm_text(alarm: AlarmEntry) -> str:
    ends = "" if alarm.cleared is None else f"; cleared at {_clock(alarm.cleared)}"
    if alarm.acknowledged is not None:
        ends += f"; acknowledged by {alarm.acknowledged_by} at {_clock(alarm.acknowledged)}"
    return f"{alarm.text}{ends}"


def _clock(at: float) -> str:
    return f"{datetime.fromtimestamp(at, UTC):%d %b %H:%M:%S} UTC"


def _commands(connection: Connection, query: JournalQuery) -> list[JournalEntry]:
    names = cast(_AUDIT.heliostats, String)
    by = [_AUDIT.who == query.person] if query.person else [_AUDIT.who != query.but]
    # Without names, it was a command to the whole field.
    about = [*_has(f'"{query.heliostat}"', names), names == "[]"] if query.heliostat else []
    wanted = select(tables.audit).where(
        *_within(_AUDIT.at, query, text=True),
        *by,
        *([or_(*about)] if about else []),
        *_has(query.text, _AUDIT.what, _AUDIT.note, _AUDIT.result),
    )
    found = rows.records(
        connection, AuditEntry, wanted.order_by(_AUDIT.number.desc()).limit(query.limit)
    )
    return [
        JournalEntry(
            datetime.fromisoformat(one.at).timestamp(),
            "command",
            one.what,
            _said(one),
            heliostats=one.heliostats[:JOURNAL_NAMES] if len(one.heliostats) > _NAMED else (),
        )
        for one in found
    ]


def _said(entry: AuditEntry) -> str:
    count, names = len(entry.heliostats), ", ".join(entry.heliostats[:_NAMED])
    whom = names if count <= _NAMED else f"{count:,} heliostats ({names}, …)"
    note = f" ({entry.note})" if entry.note else ""
    return (
        f"{entry.who} ({entry.role}): {whom or 'all'}{note}{entry.result and f': {entry.result}'}"
    )
