"""What is to be told to the plant: stages of commands, alarms, answers; bounded, and in order."""

from collections import deque
from dataclasses import replace

from heliotrope.links.messages import Answer, Message, Progress, Stage, Status
from heliotrope.safety import Alarm

#: Messages that wait; the oldest are dropped first. A status waits alone: only the newest counts.
_CAPACITY = 256


class Reports:
    """An outbox.

    Stages of one command that follow each other are told of in one message for all its heliostats.
    Alarms are told of when they change, and all that are active to each new connection.
    """

    def __init__(self) -> None:
        self._groups: dict[tuple[str, Stage, str], list[str]] = {}
        self._out: deque[Message] = deque(maxlen=_CAPACITY)
        self._status: Status | None = None
        self._alarms: dict[tuple[str, str], Alarm] = {}

    def add(self, identity: str, stage: Stage, heliostat: str = "", text: str = "") -> None:
        """Note a stage of a command; one without identity is the cluster's own."""
        if identity:
            self._groups.setdefault((identity, stage, text), []).append(heliostat)

    def answer(self, answer: Answer) -> None:
        """Note an answer."""
        self._out.append(answer)

    def status(self, status: Status) -> None:
        """Note the status, in place of the one before."""
        self._status = status

    def alarm(self, alarm: Alarm) -> None:
        """Report an alarm if it is new or its severity has changed."""
        key = alarm.condition, alarm.subject
        known = self._alarms.get(key)
        if known is None or known.severity != alarm.severity:
            self._alarms[key] = alarm
            self._out.append(alarm)

    def event(self, alarm: Alarm) -> None:
        """Report something that happens and is over, each time."""
        self._out.append(alarm)

    def clear(self, ended: Alarm) -> None:
        """Report that an alarm is over, with the severity that it was raised with."""
        known = self._alarms.pop((ended.condition, ended.subject), None)
        if known is not None:
            self._out.append(replace(ended, severity=known.severity))

    @property
    def alarms(self) -> tuple[Alarm, ...]:
        """What is wrong now."""
        return tuple(self._alarms.values())

    def greet(self) -> None:
        """Tell a new connection what is wrong."""
        waiting = {id(message) for message in self._out}
        self._out.extend(alarm for alarm in self._alarms.values() if id(alarm) not in waiting)

    @property
    def waiting(self) -> bool:
        """Whether there is something to tell."""
        return bool(self._groups or self._out or self._status)

    def take(self) -> list[Message]:
        """Return all that is to be told, and forget it."""
        messages = list(self._out)
        self._out.clear()
        for (identity, stage, text), names in self._groups.items():
            messages.append(Progress(identity, stage, tuple(n for n in names if n), text))
        self._groups.clear()
        if self._status is not None:
            messages.append(self._status)
            self._status = None
        return messages
