"""Reports to the plant: command stages, alarms, replies and the status."""

import asyncio
from collections import deque
from dataclasses import replace

from heliotrope.links.messages import Answer, ClusterStatus, Message, Progress, Stage
from heliotrope.safety import Alarm

#: Messages that may wait; the oldest are dropped first. Only the newest status is kept.
_CAPACITY = 256
_FINAL = (Stage.DONE, Stage.REFUSED, Stage.FAILED)


class Reports:
    """A bounded outbox of reports, which are sent in order.

    The same stage of one command at several heliostats becomes one message. An alarm is reported
    when it changes, and again at intervals while it is active. A status with names lists the active
    alarms, and the commands that were acknowledged and have not ended.
    """

    def __init__(self) -> None:
        self._groups: dict[tuple[str, Stage, str], list[str]] = {}
        self._out: deque[Message] = deque(maxlen=_CAPACITY)
        self._status: ClusterStatus | None = None
        self._alarms: dict[tuple[str, str], Alarm] = {}
        #: Heliostats that acknowledged a command and have not ended it, by the command's identity.
        self._open: dict[str, set[str]] = {}
        self._published = asyncio.Event()

    def add(self, identity: str, stage: Stage, heliostat: str = "", text: str = "") -> None:
        """Report a stage of a command; a command without identity is the cluster's own command."""
        if not identity:
            return
        self._groups.setdefault((identity, stage, text), []).append(heliostat)
        if stage is Stage.ACKNOWLEDGED:
            self._open.setdefault(identity, set()).add(heliostat)
        elif stage in _FINAL and (members := self._open.get(identity)) is not None:
            members.discard(heliostat)
            if not members:
                del self._open[identity]

    def answer(self, answer: Answer) -> None:
        """Report a reply to a query."""
        self._out.append(answer)

    def status(self, status: ClusterStatus) -> None:
        """Report the status, which replaces a waiting status."""
        self._status = status

    def alarm(self, alarm: Alarm) -> None:
        """Report an alarm if it is new or its severity has changed."""
        key = alarm.condition, alarm.subject
        known = self._alarms.get(key)
        if known is None or known.severity != alarm.severity:
            self._alarms[key] = alarm
            self._out.append(alarm)

    def event(self, alarm: Alarm) -> None:
        """Report an event without duration each time that it happens."""
        self._out.append(alarm)

    def clear(self, ended: Alarm) -> None:
        """Report that an alarm has ended, with the severity with which it was raised."""
        known = self._alarms.pop((ended.condition, ended.subject), None)
        if known is not None:
            self._out.append(replace(ended, severity=known.severity))

    @property
    def alarms(self) -> tuple[Alarm, ...]:
        """Active alarms."""
        return tuple(self._alarms.values())

    def repeat(self) -> None:
        """Report all active alarms to a new connection, and also because any report may be lost."""
        waiting = {id(message) for message in self._out}
        self._out.extend(alarm for alarm in self._alarms.values() if id(alarm) not in waiting)

    # -- to the sender ---------------------------------------------------------------------

    def publish(self) -> None:
        """Pass the waiting reports to the sender, if there are any."""
        if self._groups or self._out or self._status:
            self._published.set()

    async def published(self) -> None:
        """Wait until `publish` is called with reports."""
        await self._published.wait()
        self._published.clear()

    def take(self) -> list[Message]:
        """Return all waiting reports and clear the outbox."""
        messages = list(self._out)
        self._out.clear()
        for (identity, stage, text), names in self._groups.items():
            messages.append(Progress(identity, stage, tuple(n for n in names if n), text))
        self._groups.clear()
        if self._status is not None:
            messages.append(self._listing(self._status))
            self._status = None
        return messages

    def _listing(self, status: ClusterStatus) -> ClusterStatus:
        """Return a status; if it contains names, the alarms and commands in progress are added."""
        if not status.names:
            return status
        listed = tuple(f"{condition} {subject}" for condition, subject in self._alarms)
        return replace(
            status,
            alarms=listed,
            alarms_listed=True,
            commands=tuple(self._open),
            commands_listed=True,
        )
