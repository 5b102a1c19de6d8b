"""Alarms, events and packets of a running plant, for display."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np

from heliotrope.errors import HeliotropeError, UnknownNameError
from heliotrope.links.clock import Clock
from heliotrope.links.link import Link
from heliotrope.links.messages import ClusterStatus, ProtocolError, decode
from heliotrope.links.tapped import TappedLink
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.views import AlarmRow, ClusterRow, EventRow, PacketRow
from heliotrope.safety import Alarm, Severity, alarms
from heliotrope.store.records import Event, Records, StoreError

#: Messages sent every second, of which only the last of each cluster is kept.
_STEADY = ("lease", "status")
#: Longest text of a packet, characters.
_LONGEST = 240
#: Maximum number of heliostats named in the text of an event; more are only counted.
MOST_NAMED = 3
#: Alarms that the table evaluation raises and clears by itself, so they need no acknowledgement.
_UNACKNOWLEDGED = (alarms.TIME_WENT_BACK.name, alarms.UNKNOWN_READING.name)
#: Alarms that the plant lets operators acknowledge, besides the rows of the safety table.
_CONFIRMED = (alarms.COUNTS_DOUBTFUL.name, alarms.DRIVE_STALLED.name)
#: Alarms that are raised once and whose cause the plant itself removes.
_PASSING = (alarms.PARAMETERS_DIFFER.name,)


class Logbook:
    """Alarms, events and packets.

    Parameters
    ----------
    clock
        Clock of the plant.
    records
        Store that also keeps alarms and events; None: no store.
    events, packets
        Number of events and packets kept in memory.

    Attributes
    ----------
    refused
        Number of unreadable messages from each cluster.
    forward
        Function that takes each alarm raised or cleared; None: no function.
    """

    def __init__(
        self,
        clock: Clock,
        records: Records | None = None,
        *,
        events: int = 2000,
        packets: int = 4000,
    ) -> None:
        self._clock, self._records = clock, records
        self._alarms: dict[tuple[str, str], AlarmRow] = {}
        self._events: deque[EventRow] = deque(maxlen=events)
        #: Heliostats of events whose text does not name all of them, by event number.
        self._named: dict[int, tuple[str, ...]] = {}
        self._numbers = count(1)
        self._packets: deque[tuple[float, str, str, bytes]] = deque(maxlen=packets)
        self._steady: dict[tuple[str, str, str], tuple[float, bytes]] = {}
        self._links: dict[str, Link] = {}
        self._statuses: dict[str, ClusterStatus] = {}
        self.refused: dict[str, int] = {}
        self.forward: Callable[[Alarm], None] | None = None
        #: The last refused record while its alarm is active, and the store's count of refused
        #: records.
        self._refused, self._refused_count = "", 0

    def _now(self) -> float:
        return self._clock.utc().timestamp()

    # -- taking ----------------------------------------------------------------------------

    def tapped(self, links: Mapping[str, Link]) -> dict[str, Link]:
        """Return the plant's links, wrapped so that every message is noted in this logbook."""
        self._links.update(links)
        return {
            name: TappedLink(link, self._clock, _Listener(name, self))
            for name, link in links.items()
        }

    def packet(self, cluster: str, way: str, data: bytes) -> None:
        """Note a message on a link; ``way`` is "to" or "from"."""
        kind = _kind(data)
        if kind in _STEADY:
            self._steady[cluster, way, kind] = self._now(), data
        else:
            self._packets.append((self._now(), cluster, way, data))

    def take_alarm(self, alarm: Alarm) -> None:
        """Accept an alarm from the plant or a cluster; a self-clearing alarm becomes an event."""
        if alarm.condition in _PASSING:
            self.event("plant", alarm.subject, alarm.text)
            return
        key = (alarm.condition, alarm.subject)
        known = self._alarms.get(key)
        new = alarm.active and (known is None or not known.active)
        count = (known.count if known is not None else 0) + new
        by = known.acknowledged_by if known is not None and not new else ""
        at = self._now() if new or known is None else known.at
        self._alarms[key] = AlarmRow(**vars(alarm), at=at, acknowledged_by=by, count=max(count, 1))
        if new or (known is not None and known.active != alarm.active):
            over = "" if alarm.active else " (over)"
            # A condition of the safety table names itself in its text.
            text = alarm.text.removeprefix(f"{alarm.condition}: ")
            self.event("alarm", alarm.subject, f"{alarm.condition}: {text}{over}")
            if self.forward is not None:
                self.forward(alarm)
            if self._records is not None:
                self._keep(self._records.record_alarm, alarm, self._now())

    def event(
        self,
        kind: str,
        who: str,
        text: str,
        severity: Severity = Severity.INFO,
        heliostats: Sequence[str] = (),
    ) -> None:
        """Record an event; see `EventRow`.

        ``heliostats`` are all heliostats that the event concerns.
        """
        number, names = next(self._numbers), tuple(heliostats)
        if len(names) > MOST_NAMED or not all(name in text for name in names):
            self._named[number] = names
        row = EventRow(self._now(), kind, who, text, number, len(self._named.get(number, ())))
        if len(self._events) == self._events.maxlen:
            self._named.pop(self._events[0].number, None)
        self._events.append(row)
        if self._records is not None and kind != "alarm":
            line = f"{who}: {text}" if who else text
            self._keep(self._records.record_event, Event(self._now(), kind, line, severity))

    def _keep(self, keep: Any, *values: Any) -> None:
        """Store a record; if that fails, an alarm is raised and work continues."""
        try:
            keep(*values)
        except StoreError as error:
            self.take_alarm(alarms.RECORDS.raised(problem=error))
        except HeliotropeError as error:
            self._refuse(str(error))

    def _refuse(self, problem: str) -> None:
        """Raise the alarm about a record that was refused for its content."""
        self._refused = problem
        self.take_alarm(alarms.RECORD_REFUSED.raised(problem=problem))

    def check_records(self, lost: str) -> None:
        """Raise and clear the alarms about the store.

        ``lost`` is the reason why a record of another kind was not kept.
        """
        if self._records is None:
            return
        problem, kind = lost or self._records.problem, alarms.RECORDS
        if problem:
            self.take_alarm(kind.raised(problem=problem))
        elif self.stands(kind):
            self.take_alarm(kind.ended())
        count = self._records.refused_count
        if count > self._refused_count:
            self._refused_count = count
            self._refuse(self._records.refused)
        elif self._refused:
            self._refused, reason = "", self._refused
            self.take_alarm(alarms.RECORD_REFUSED.ended(problem=reason))

    def stands(self, kind: alarms.AlarmKind) -> bool:
        """Whether an alarm about the plant as a whole is active."""
        known = self._alarms.get((kind.name, ""))
        return known is not None and known.active

    def acknowledge(self, who: str, condition: str, subject: str) -> None:
        """Note that an operator acknowledged an alarm."""
        known = self._alarms.get((condition, subject))
        if known is not None:
            self._alarms[condition, subject] = replace(known, acknowledged_by=who)
        if self._records is not None:
            self._keep(self._records.record_acknowledgement, condition, subject, who, self._now())

    # -- views -----------------------------------------------------------------------------

    @staticmethod
    def is_plain(condition: str) -> bool:
        """Whether acknowledging an alarm has no effect on the plant."""
        return condition in alarms.KINDS and condition not in _UNACKNOWLEDGED + _CONFIRMED

    @property
    def open_alarms(self) -> int:
        """Number of alarms that are active or not acknowledged."""
        return sum(_open(row) for row in self._alarms.values())

    def alarms(self) -> tuple[AlarmRow, ...]:
        """Return the alarms: open ones first, then the newest."""
        rows = sorted(self._alarms.values(), key=lambda row: (not _open(row), -row.at))
        return tuple(rows[:500])

    def events(self, limit: int = 200) -> tuple[EventRow, ...]:
        """Return the latest events, newest first."""
        return tuple(list(self._events)[: -limit - 1 : -1])

    def named(self, number: int) -> tuple[str, ...]:
        """Return the heliostats of an event whose text does not name all of them.

        Raises
        ------
        UnknownNameError
            If there is no such event, or its text names all its heliostats.
        """
        if number not in self._named:
            raise UnknownNameError("event of many heliostats", str(number), ())
        return self._named[number]

    def packets(self, limit: int, cluster: str = "") -> tuple[PacketRow, ...]:
        """Return the latest messages, newest first."""
        found = [
            (at, name, way, data)
            for (name, way, _), (at, data) in self._steady.items()
            if name == cluster
        ]
        for packet in reversed(self._packets):
            if len(found) >= limit:
                break
            if not cluster or packet[1] == cluster:
                found.append(packet)
        found.sort(key=lambda packet: -packet[0])
        return tuple(_shown(packet) for packet in found[:limit])

    def cluster_rows(self, plant: PlantController) -> tuple[ClusterRow, ...]:
        """Return the health of each cluster."""
        field, now = plant.field, plant.now()
        live, size = field.live(now), len(field.clusters)
        counted = [
            np.bincount(field.cluster, weights=weights, minlength=size)
            for weights in (None, live, field.rows["asked"], field.rows["answered"])
        ]
        return tuple(
            self._cluster_row(name, now - field.status_at[name], field.limit, *numbers)
            for name, *numbers in zip(field.clusters, *counted, strict=True)
        )

    def _cluster_row(
        self,
        name: str,
        age: float,
        limit: float,
        count: float,
        live: float,
        asked: float,
        answered: float,
    ) -> ClusterRow:
        status, link = self._status(name), self._links.get(name)
        nan = float("nan")
        return ClusterRow(
            name,
            age <= limit,
            age,
            link is not None and link.connected,
            int(count),
            int(live),
            status.cycle_s if status else nan,
            answered / asked if asked else nan,
            self.refused.get(name, 0),
            status.time_quality if status else "",
            status.time_error_s if status else nan,
            status.settings if status else "",
            status.lease_left if status else nan,
            status.acts if status else (),
            link.problem if link is not None else "",
        )

    def _status(self, cluster: str) -> ClusterStatus | None:
        _, data = self._steady.get((cluster, "from", "status"), (0.0, b""))
        try:
            found = decode(data) if data else None
        except ProtocolError:
            self.refused[cluster] = self.refused.get(cluster, 0) + 1
            self._steady.pop((cluster, "from", "status"))
            found = None
        if isinstance(found, ClusterStatus):
            self._statuses[cluster] = found
        return self._statuses.get(cluster)


class _Listener:
    """Records the messages on one link in the logbook."""

    def __init__(self, cluster: str, book: Logbook) -> None:
        self._cluster, self._book = cluster, book

    async def posted(self, data: bytes, now: float) -> None:
        """Do nothing: only messages that were sent are noted."""

    def sent(self, data: bytes, now: float) -> None:
        del now  # the logbook uses its own time
        self._book.packet(self._cluster, "to", data)

    async def waits(self) -> None:
        """Wait for nothing."""

    def received(self, data: bytes, now: float) -> None:
        del now
        self._book.packet(self._cluster, "from", data)


def _open(row: AlarmRow) -> bool:
    return row.active or not row.acknowledged_by


def _kind(data: bytes) -> str:
    """Return the kind of a message, without parsing the rest of it."""
    head, _, rest = data.partition(b'"kind":"')
    return rest.partition(b'"')[0].decode("ascii", "replace") if len(head) < 8 else ""


def _shown(packet: tuple[float, str, str, bytes]) -> PacketRow:
    at, cluster, way, data = packet
    line, _, block = data.partition(b"\n")
    text = line.decode("utf-8", "replace")
    if len(text) > _LONGEST:
        text = text[:_LONGEST] + "…"
    more = f" + {len(block)} bytes" if block else ""
    return PacketRow(at, cluster, way, _kind(data), len(data), text + more)
