"""The keeper: stores `Records` in a database through a single writer.

The keeper numbers each record on acceptance, so the caller knows the numbers of sightings before
they are written, and a record written twice is stored once. Only one process can open a store for
writing.
"""

import asyncio
import json
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from sqlalchemy import Connection, Select, Table, and_, delete, func, select, update

from heliotrope.calibration.record import HeliostatCalibration, Identities
from heliotrope.calibration.sightings import Sightings
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.safety import Alarm, Severity
from heliotrope.store import _rows as rows
from heliotrope.store import chain, journal, tables
from heliotrope.store.database import Database, make_private
from heliotrope.store.people import People
from heliotrope.store.records import (
    SEVERITIES,
    AlarmEntry,
    CampaignEntry,
    Event,
    Fact,
    FlightEntry,
    JournalEntry,
    JournalQuery,
    KeptSightings,
    LearningEntry,
    Lockout,
    Outlook,
    PlantFigures,
    StoreError,
    TimetableRecord,
    VisitEntry,
)
from heliotrope.store.writer import Work, Writer

T = TypeVar("T")
_NUMBERED = (tables.sighting, tables.visit, tables.hold, tables.event, tables.alarm)
#: Table for each kind of fact, and the function that writes its row.
_FACTS: dict[type[Fact], tuple[Table, Callable[[Connection, Table, list[rows.Row]], object]]] = {
    VisitEntry: (tables.visit, rows.insert),
    CampaignEntry: (tables.campaign, rows.replace),
    FlightEntry: (tables.flight, rows.insert),
    LearningEntry: (tables.learning, rows.insert),
    TimetableRecord: (tables.timetable, rows.replace),
    Outlook: (tables.outlook, rows.replace),
    PlantFigures: (tables.figures, rows.replace),
}
#: With more names than this, a query reads all rows and filters them afterwards.
_MANY = 500
#: Number of threads that read.
_READERS = 4
#: Row of the table ``about`` with the limits of the safety table in force.
_LIMITS = "safety limits"
#: Name of the document about the active emergency.
_EMERGENCY = "emergency"
#: Names of the documents about changes that await approval, by kind.
_CHANGES = {"parameters": "waiting changes", "plant file": "waiting plant file"}
_AIMED = "aimed by people"


class Keeper:
    """Keeps the records of a plant; see `Records` for the guarantees of each method.

    Parameters
    ----------
    place
        A folder (created if missing), a file ``.sqlite``, or a URL ``postgresql://...``.
    inline
        Whether to write at once in the caller's thread, for virtual time, in which no thread can be
        awaited.
    limit
        Number of records that may wait.

    Attributes
    ----------
    database, writer, people
        Parts of the keeper.

    Raises
    ------
    StoreError
        If the store cannot be opened, belongs to another program, or is open in another process.
    """

    def __init__(self, place: str | Path, *, inline: bool = False, limit: int = 50_000) -> None:
        self.database = Database(place)
        if self.database.file is not None:
            _make_folder(self.database.file.parent)
        self.database.lock()
        try:
            self.database.prepare()
            with self.database.reading() as connection:
                self._numbers = {t.name: _last_number(connection, t) for t in _NUMBERED}
                self._versions = _last_versions(connection)
                self._holds = _standing_holds(connection)
        except BaseException:
            self.database.close()
            raise
        self._mine = threading.Lock()
        self._readers = ThreadPoolExecutor(_READERS, "store reader")
        self.writer = Writer(self.database, limit=limit, inline=inline)
        self.people = People(self.database, self.writer)

    @property
    def problem(self) -> str:
        """Why records cannot be written now; empty if they can."""
        return self.writer.problem or self.writer.crowded

    @property
    def refused(self) -> str:
        """The last record that the database rejected because of its content; empty if none was."""
        return self.writer.refused

    @property
    def refused_count(self) -> int:
        """Number of records that the database rejected because of their content."""
        return self.writer.refused_count

    def close(self) -> None:
        """Write the waiting records, and close.

        Raises
        ------
        StoreError
            If a record could not be written.
        """
        self._readers.shutdown(wait=False, cancel_futures=True)
        try:
            self.writer.close()
        finally:
            self.database.close()

    async def confirm(self) -> None:
        """Wait until all earlier records are safely stored.

        Raises
        ------
        StoreError
            If an attempt to write failed; the records stay queued and are retried.
        """
        done = self.writer.confirmed()
        if self.writer.inline:
            done.result()
        else:
            await asyncio.wrap_future(done)

    async def read(self, work: "Callable[[Keeper], T]") -> T:
        """Return the result of work that reads, done in one of the store's own threads."""
        return await asyncio.get_running_loop().run_in_executor(self._readers, work, self)

    def _take_numbers(self, table: Table, count: int = 1) -> int:
        """Return the first of a range of new numbers."""
        with self._mine:
            first = self._numbers[table.name] + 1
            self._numbers[table.name] += count
        return first

    def _records(self, kind: type[T], query: Select[Any]) -> list[T]:
        with self.database.reading() as connection:
            return rows.records(connection, kind, query)

    # -- sightings and parameters --------------------------------------------------------

    def record_sightings(
        self,
        names: Sequence[str],
        sightings: Sightings,
        *,
        kind: str = "camera_target",
        target: str = "",
        campaign: str = "",
    ) -> Identities:
        """Record sightings, whose indices refer to ``names``; return their numbers, (M,).

        Raises
        ------
        InputError
            If an index is beyond the names.
        StoreError
            If too many records are already waiting.
        """
        if len(sightings) and int(sightings.heliostat.max()) >= len(names):
            raise InputError(
                f"sightings: heliostat row {int(sightings.heliostat.max())}, but there are only "
                f"{len(names)} names; pass the names of all heliostats"
            )
        first = self._take_numbers(tables.sighting, len(sightings))
        numbers = np.arange(first, first + len(sightings), dtype=np.int64)
        made = rows.sighting_rows(numbers, names, sightings, kind, target, campaign)
        self.writer.put(lambda c: rows.insert(c, tables.sighting, made))
        return numbers

    def record_calibration(self, *records: HeliostatCalibration) -> None:
        """Record calibrations; a version must exceed all recorded versions of its heliostat.

        Raises
        ------
        InputError
            If a version does not exceed the recorded versions, or a heliostat occurs twice; in that
            case no calibration is recorded.
        StoreError
            If too many records are already waiting.
        """
        with self._mine:
            versions = dict[str, int]()
            for record in records:
                if record.heliostat in versions:
                    raise InputError(
                        f"calibration of {record.heliostat}: two versions at once; record the "
                        "second when the first is recorded"
                    )
                last = self._versions.get(record.heliostat, 0)
                if record.version <= last:
                    raise InputError(
                        f"calibration of {record.heliostat}: version {record.version} is not above "
                        f"{last}, the last one recorded; use a higher version"
                    )
                versions[record.heliostat] = record.version
            made = [rows.row_of(tables.parameter_version, record) for record in records]

            def work(connection: Connection) -> None:
                rows.insert(connection, tables.parameter_version, made)
                _change_behind(connection, records)

            self.writer.put(work)
            self._versions |= versions

    def sightings(
        self,
        heliostats: Sequence[str] | None = None,
        *,
        since: float = float("-inf"),
        until: float = float("inf"),
        campaign: str = "",
    ) -> KeptSightings:
        """Return sightings by time, for some heliostats (None: all) and optionally one campaign."""
        s = tables.sighting.c
        query = select(tables.sighting).order_by(s.time, s.number)
        if heliostats is not None and len(heliostats) <= _MANY:
            query = query.where(s.heliostat.in_(list(heliostats)))
        if since > float("-inf"):
            query = query.where(s.time >= since)
        if until < float("inf"):
            query = query.where(s.time <= until)
        if campaign:
            query = query.where(s.campaign == campaign)
        with self.database.reading() as connection:
            matches = connection.execute(query).all()
        if heliostats is not None and len(heliostats) > _MANY:
            selected = set(heliostats)
            matches = [row for row in matches if row.heliostat in selected]
        return rows.kept_sightings(matches)

    def latest_calibrations(
        self, heliostats: Sequence[str] | None = None
    ) -> dict[str, HeliostatCalibration]:
        """Return the latest version by heliostat, without sightings and residuals."""
        table = tables.parameter_version
        last = (
            select(table.c.heliostat, func.max(table.c.version).label("version"))
            .group_by(table.c.heliostat)
            .subquery()
        )
        same = and_(table.c.heliostat == last.c.heliostat, table.c.version == last.c.version)
        query = select(table).join(last, same).order_by(table.c.heliostat)
        if heliostats is not None and len(heliostats) <= _MANY:
            query = query.where(table.c.heliostat.in_(list(heliostats)))
        selected = None if heliostats is None else set(heliostats)
        return {
            record.heliostat: record
            for record in self._records(HeliostatCalibration, query)
            if selected is None or record.heliostat in selected
        }

    def calibration_history(self, heliostat: str) -> list[HeliostatCalibration]:
        """Return all versions of one heliostat, oldest first; see `Records`."""
        with self.database.reading() as connection:
            return calibration_history(connection, heliostat)

    # -- measurements -----------------------------------------------------

    def record(self, fact: Fact) -> None:
        """Record a fact; see `Records`."""
        table, write = _FACTS[type(fact)]
        number = {"number": self._take_numbers(table)} if table in _NUMBERED else {}
        row = rows.row_of(table, fact, **number)
        self.writer.put(lambda c: write(c, table, [row]))

    def flights(self) -> list[FlightEntry]:
        """Return the flights, in order of import."""
        return self._records(FlightEntry, select(tables.flight).order_by(tables.flight.c.at))

    def learnings(self) -> list[LearningEntry]:
        """Return the latest learnt hyperparameters of each group."""
        entries = self._records(
            LearningEntry, select(tables.learning).order_by(tables.learning.c.version)
        )
        return list({entry.group: entry for entry in entries}.values())

    def timetables(self) -> list[TimetableRecord]:
        """Return the timetables that operators have activated, latest first."""
        order = tables.timetable.c.at.desc()
        return self._records(TimetableRecord, select(tables.timetable).order_by(order))

    def outlooks(self, since: float) -> list[Outlook]:
        """Return the predictions made since a given time, oldest first."""
        o = tables.outlook.c
        query = select(o.made, o.document).where(o.made >= since).order_by(o.made)
        with self.database.reading() as connection:
            return [Outlook.of(*row) for row in connection.execute(query)]

    def figures(self, since: float, until: float) -> list[PlantFigures]:
        """Return the plant's time series between two times, oldest first; the end is excluded."""
        f = tables.figures.c
        query = select(tables.figures).where(f.at >= since, f.at < until).order_by(f.at)
        return self._records(PlantFigures, query)

    def visits(
        self, limit: int = 100, heliostat: str = "", *, since: float = 0.0, until: float = 1e11
    ) -> list[VisitEntry]:
        """Return the calibration visits that finished within a time span, latest first."""
        v = tables.visit.c
        query = select(tables.visit).where(v.finished >= since, v.finished < until)
        query = query.order_by(v.number.desc()).limit(limit)
        if heliostat:
            query = query.where(v.heliostat == heliostat)
        return self._records(VisitEntry, query)

    def campaigns(self) -> list[CampaignEntry]:
        """Return the campaigns, latest first."""
        query = select(tables.campaign).order_by(tables.campaign.c.begun.desc())
        return self._records(CampaignEntry, query)

    # -- events and alarms ---------------------------------------------------------------

    def record_event(self, event: Event) -> None:
        """Record an event.

        Raises
        ------
        UnknownNameError
            If there is no such severity.
        """
        _check_severity(event.severity)
        with self._mine:
            # In the order of their numbers, in which they are linked.
            number = self._numbers[tables.event.name] + 1
            row = rows.row_of(tables.event, event, number=number)
            self.writer.put(lambda c: chain.add_event(c, row))
            self._numbers[tables.event.name] = number

    def record_alarm(self, alarm: Alarm, at: float) -> None:
        """Record that an alarm was raised, or (not active) that it cleared; see `Records`."""
        severity = Severity.read(alarm.severity)
        number = self._take_numbers(tables.alarm)
        entry = AlarmEntry(alarm.condition, alarm.subject, severity, alarm.text, at, number=number)
        row = rows.row_of(tables.alarm, entry)
        a = tables.alarm.c
        subject = and_(a.condition == alarm.condition, a.subject == alarm.subject)
        now = {"severity": severity, "text": alarm.text}
        change = now if alarm.active else {"cleared": at}

        def work(connection: Connection) -> None:
            changed = connection.execute(
                update(tables.alarm).where(subject, a.cleared.is_(None)).values(change)
            )
            if alarm.active and not changed.rowcount:
                rows.insert(connection, tables.alarm, [row])

        self.writer.put(work)

    def record_acknowledgement(self, condition: str, subject: str, person: str, at: float) -> None:
        """Record that a person acknowledged an alarm."""
        a = tables.alarm.c
        which = and_(a.condition == condition, a.subject == subject, a.acknowledged.is_(None))
        change = {"acknowledged": at, "acknowledged_by": person}
        self.writer.put(lambda c: c.execute(update(tables.alarm).where(which).values(change)))

    def events(
        self,
        limit: int = 100,
        *,
        heliostat: str = "",
        severity: Severity = Severity.INFO,
        before: int = 0,
    ) -> list[Event]:
        """Return events of at least a given severity, latest first.

        If a number is specified, only events with lower numbers are returned.
        """
        _check_severity(severity)
        e = tables.event.c
        query = select(tables.event).where(e.severity >= severity)
        if heliostat:
            query = query.where(e.heliostat == heliostat)
        if before:
            query = query.where(e.number < before)
        return self._records(Event, query.order_by(e.number.desc()).limit(limit))

    def alarms(
        self,
        limit: int = 100,
        *,
        standing: bool = False,
        since: float = 0.0,
        until: float = 1e11,
    ) -> list[AlarmEntry]:
        """Return alarms that were active within a time span, latest first; see `Records`."""
        a = tables.alarm.c
        query = select(tables.alarm).where(
            a.raised < until, a.cleared.is_(None) | (a.cleared >= since)
        )
        query = query.order_by(a.number.desc()).limit(limit)
        if standing:
            query = query.where(a.cleared.is_(None) | a.acknowledged.is_(None))
        return self._records(AlarmEntry, query)

    def journal(self, query: JournalQuery) -> list[JournalEntry]:
        """Return the events, alarms and commands that match a query, latest first."""
        with self.database.reading() as connection:
            return journal.search(connection, query)

    def forget_events(self, before: float) -> None:
        """Remove events, predictions and time series up to a time, and alarms cleared by then."""
        a = tables.alarm.c
        over = and_(a.cleared < before, a.acknowledged < before)

        def work(connection: Connection) -> None:
            chain.forget_events(connection, before)
            connection.execute(delete(tables.alarm).where(over))
            connection.execute(delete(tables.outlook).where(tables.outlook.c.made < before))
            connection.execute(delete(tables.figures).where(tables.figures.c.at < before))

        self.writer.put(work)

    # -- holds ---------------------------------------------------------------------------

    def hold(self, holds: Sequence[Lockout]) -> None:
        """Store locks; a new lock replaces the same person's earlier lock on the same object."""
        new = {_locked(hold): hold for hold in holds}
        first = self._take_numbers(tables.hold, len(new))
        made = [
            rows.row_of(tables.hold, hold, number=first + i, ended=None, ended_by="")
            for i, hold in enumerate(new.values())
        ]

        def work(connection: Connection) -> None:
            for hold in new.values():
                _end_hold(connection, hold, hold.who, hold.since)
            rows.insert(connection, tables.hold, made)

        with self._mine:
            self.writer.put(work)
            # A new dictionary, so that a reader of the old one sees one consistent state.
            self._holds = {**self._holds, **new}

    def unhold(self, holds: Sequence[Lockout], person: str, at: float) -> None:
        """End locks that ``person`` removed at the time ``at``, POSIX s."""
        ended = {_locked(hold): hold for hold in holds}

        def work(connection: Connection) -> None:
            for hold in ended.values():
                _end_hold(connection, hold, person, at)

        with self._mine:
            self.writer.put(work)
            self._holds = {k: hold for k, hold in self._holds.items() if k not in ended}

    def holds(self) -> tuple[Lockout, ...]:
        """Return the active locks."""
        return tuple(self._holds.values())

    def exchange_limits(self, numbers: Mapping[str, float]) -> dict[str, float]:
        """Store the safety-table limits in force; return the limits of the previous run, or {}."""
        about = tables.about

        def work(connection: Connection) -> str | None:
            query = select(about.c.value).where(about.c.name == _LIMITS)
            before: str | None = connection.scalar(query)
            rows.replace(connection, about, [{"name": _LIMITS, "value": json.dumps(dict(numbers))}])
            return before

        before = self.do(work)
        return {} if before is None else dict(json.loads(before))

    def emergency(self) -> str:
        """Return the document about the active emergency; an empty document if there is none."""
        return self._document(_EMERGENCY)

    def keep_emergency(self, document: str) -> None:
        """Replace the document about the active emergency; an empty one means that it has ended."""
        self._keep_document(_EMERGENCY, document)

    def waiting_changes(self, kind: str) -> str:
        """Return the document about changes of a kind that await approval; empty if none do.

        The kinds are "parameters" and "plant file".
        """
        return self._document(_CHANGES[kind])

    def keep_waiting_changes(self, kind: str, document: str) -> None:
        """Replace the document about changes that await approval; an empty one means none do."""
        self._keep_document(_CHANGES[kind], document)

    def aimed_by_people(self) -> tuple[str, ...]:
        """Return the heliostats that operators have aimed, and that keep these aims."""
        return tuple(json.loads(self._document(_AIMED) or "[]"))

    def keep_aimed_by_people(self, heliostats: Sequence[str]) -> None:
        """Replace the set of heliostats that operators have aimed."""
        self._keep_document(_AIMED, json.dumps(list(heliostats)) if heliostats else "")

    def _document(self, name: str) -> str:
        about = tables.about
        query = select(about.c.value).where(about.c.name == name)
        return str(self.do(lambda connection: connection.scalar(query)) or "")

    def _keep_document(self, name: str, document: str) -> None:
        row = {"name": name, "value": document}
        self.writer.put(lambda connection: rows.replace(connection, tables.about, [row]))

    def do(self, work: Work[Any], timeout: float = 5.0) -> Any:
        """Do work in the writer thread and return its result; see `Writer.do`."""
        return self.writer.do(work, timeout)


def calibration_history(connection: Connection, heliostat: str) -> list[HeliostatCalibration]:
    """Return all versions of one heliostat, oldest first; see `Records`."""
    versions, used = tables.parameter_version, tables.parameter_sighting
    query = select(used).where(used.c.heliostat == heliostat).order_by(used.c.sighting)
    behind = rows.Behind(connection.execute(query).mappings().all())
    query = select(versions).where(versions.c.heliostat == heliostat).order_by(versions.c.version)
    return [rows.calibration(row, behind) for row in connection.execute(query).mappings().all()]


def _change_behind(connection: Connection, records: Sequence[HeliostatCalibration]) -> None:
    """Record which sightings are behind versions, where this differs from the previous version."""
    used = tables.parameter_sighting.c
    standing: dict[str, dict[int, bool]] = {record.heliostat: {} for record in records}
    names = list(standing)
    for k in range(0, len(names), _MANY):
        mine = and_(used.heliostat.in_(names[k : k + _MANY]), used.until.is_(None))
        for name, number, use in connection.execute(
            select(used.heliostat, used.sighting, used.used).where(mine)
        ):
            standing[name][number] = bool(use)
    rows_made: list[rows.Row] = []
    for record in records:
        made, dropped = rows.behind_rows(record, standing[record.heliostat])
        for k in range(0, len(dropped), _MANY):
            ended = and_(
                used.heliostat == record.heliostat,
                used.until.is_(None),
                used.sighting.in_(dropped[k : k + _MANY]),
            )
            connection.execute(
                update(tables.parameter_sighting).where(ended).values(until=record.version)
            )
        rows_made += made
    rows.insert(connection, tables.parameter_sighting, rows_made)


def _make_folder(folder: Path) -> None:
    try:
        make_private(folder)
    except OSError as error:
        raise StoreError(f"store {folder}: {error.strerror}; choose a writable folder") from None


def _last_number(connection: Connection, table: Table) -> int:
    return int(connection.scalar(select(func.max(table.c.number))) or 0)


def _last_versions(connection: Connection) -> dict[str, int]:
    table = tables.parameter_version.c
    query = select(table.heliostat, func.max(table.version)).group_by(table.heliostat)
    return {name: int(version) for name, version in connection.execute(query)}


def _locked(hold: Lockout) -> tuple[str, str, str]:
    """Return the key of a lock: the place and the person.

    At most one lock is in force for each key.
    """
    return hold.kind, hold.name, hold.who


def _standing_holds(connection: Connection) -> dict[tuple[str, str, str], Lockout]:
    query = select(tables.hold).where(tables.hold.c.ended.is_(None))
    return {_locked(held): held for held in rows.records(connection, Lockout, query)}


def _end_hold(connection: Connection, hold: Lockout, person: str, at: float) -> None:
    h = tables.hold.c
    same = and_(h.kind == hold.kind, h.name == hold.name, h.who == hold.who)
    part = and_(same, h.ended.is_(None))
    connection.execute(update(tables.hold).where(part).values(ended=at, ended_by=person))


def _check_severity(severity: str) -> None:
    if severity not in SEVERITIES:
        raise UnknownNameError("severity", severity, SEVERITIES)
