"""Changes that wait for the approval of a second engineer.

If the plant file requires it (``[approval]``), a change that an engineer requests is checked and
then waits: nothing is written until another engineer has approved it. Its author may withdraw it,
and another engineer may refuse it. The change lapses at its deadline. It survives a restart.

This is the dual approval of IEC 62443-3-3, SR 2.1 RE 4.
"""

import json
from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any, Generic, Protocol, TypeVar

from heliotrope.errors import UnknownNameError
from heliotrope.plant import refusals
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.orders.authority import Grant, Person, Role
from heliotrope.safety import alarms
from heliotrope.store.records import Records, StoreError


class Change(Protocol):
    """What every waiting change states."""

    @property
    def number(self) -> int:
        """Number of the change, unique within its kind."""

    @property
    def author(self) -> str:
        """The engineer who requested it."""

    @property
    def until(self) -> float:
        """Deadline for the approval, POSIX s."""

    @property
    def subject(self) -> str:
        """What it changes, as refusals name it."""

    @property
    def text(self) -> str:
        """The change in words."""


C = TypeVar("C", bound=Change)


class WaitingChanges(Generic[C]):
    """The waiting changes of one kind.

    Parameters
    ----------
    kind
        What they change: "parameters" or "plant file".
    plant, log
        The controller, and the logbook for events.
    records
        Store of the waiting changes; None: they are lost when the program ends.
    read
        Function that makes a change from its stored fields.
    overtaken
        Function that returns why a change lapses before its deadline; empty if it does not. None:
        none does.
    ended
        Called with a change that has ended without approval, why, and the person who ended it;
        None: nobody needs to know.
    """

    def __init__(
        self,
        kind: str,
        plant: PlantController,
        log: Logbook,
        records: Records | None,
        read: Callable[[dict[str, Any]], C],
        *,
        overtaken: Callable[[C], str] | None = None,
        ended: Callable[[C, str, Person | None], None] | None = None,
    ) -> None:
        self._kind, self._plant, self._log, self._records = kind, plant, log, records
        self._read, self._overtaken, self._ended = read, overtaken, ended
        self._settings = plant.design.approval
        self._changes: dict[int, C] = {}
        self._last = 0

    @property
    def needed(self) -> bool:
        """Whether a change needs a second engineer."""
        return self._settings.parameters

    @property
    def all(self) -> tuple[C, ...]:
        """The waiting changes, oldest first."""
        return tuple(self._changes.values())

    def recall(self) -> None:
        """Continue with the changes that were waiting when the plant's program ended."""
        if self._records is None:
            return
        try:
            document = self._records.waiting_changes(self._kind)
            changes = [self._read(item) for item in json.loads(document or "[]")]
        except StoreError as error:
            self._log.take_alarm(alarms.RECORDS.raised(problem=error))
            return
        except (ValueError, KeyError, TypeError) as error:
            what = f"the changes of {self._kind} waiting for approval"
            self._log.event("command", "", f"{what} cannot be read ({error}); request them again")
            return
        for change in changes:
            self._changes[change.number] = change
            self._last = max(self._last, change.number)
        if not self.needed:
            for change in self.all:
                self.end(change, "the plant file no longer requires a second approval")

    def step(self) -> None:
        """End the changes that are past their deadline or have been overtaken."""
        for change in self.all:
            if why := self._over(change):
                self.end(change, why)

    def request(self) -> tuple[int, float, float]:
        """Return the number of a new change, the present time, and its deadline, POSIX s."""
        # Anyone who sees an earlier change can never approve a later one in its place.
        now = self._now()
        self._last = max(self._last + 1, int(1e3 * now))
        return self._last, now, now + self._settings.within

    def add(self, person: Person, change: C) -> None:
        """Let a change wait that a person requests.

        Raises
        ------
        RefusedError
            If another change of the same subject is waiting.
        """
        for other in self.all:
            if other.subject == change.subject:
                raise refusals.CHANGE_WAITS.error(
                    subject=other.subject, number=other.number, author=other.author
                )
        self._changes[change.number] = change
        self._keep()
        self._note(person, f"change {change.number} waits for approval: {change.text}")

    def others(self, person: Person, number: int) -> C:
        """Return another person's change on which an engineer may decide.

        Raises
        ------
        RefusedError
            If the person is not an engineer or is its author, or if it is no longer valid.
        UnknownNameError
            If no such change is waiting.
        """
        person.must_be(Role.ENGINEER, "approval")
        change = self._find(number)
        if person.name == change.author:
            raise refusals.SECOND_PERSON.error(
                number=number, subject=change.subject, person=person.name
            )
        if why := self._over(change):
            self.end(change, why)
            raise refusals.CHANGE_OVERTAKEN.error(number=number, subject=change.subject, reason=why)
        return change

    def approved(self, person: Person, change: C) -> None:
        """Remove a change that a person has approved."""
        self._changes.pop(change.number, None)  # it may have lapsed while it was written
        self._keep()
        self._note(person, f"change {change.number} of {change.author} approved: {change.text}")

    def refuse(self, person: Person, number: int, reason: str) -> None:
        """Refuse another engineer's change, with a reason.

        Raises
        ------
        RefusedError
            If the person is not an engineer, is the author of the change, or states no reason.
        UnknownNameError
            If no such change is waiting.
        """
        change = self.others(person, number)
        if not reason.strip():
            raise refusals.REASON_MISSING.error(what=f"change {number}")
        self.end(change, f"refused by {person.name}: {reason.strip()}", person)

    def withdraw(self, person: Person, number: int) -> None:
        """Withdraw a person's own change.

        Raises
        ------
        RefusedError
            If another person requested it.
        UnknownNameError
            If no such change is waiting.
        """
        change = self._find(number)
        if person.name != change.author:
            raise refusals.NOT_AUTHOR.error(
                number=number, subject=change.subject, author=change.author, person=person.name
            )
        self.end(change, f"withdrawn by {person.name}", person)

    def end(self, change: C, why: str, person: Person | None = None) -> None:
        """End a change without approval."""
        del self._changes[change.number]
        if self._ended is not None:
            self._ended(change, why, person)
        self._keep()
        text = f"change {change.number} of {change.author} has ended, {why}: {change.text}"
        if person is None:
            self._log.event("command", "", text)
        else:
            self._note(person, text)

    def _find(self, number: int) -> C:
        if number not in self._changes:
            raise UnknownNameError("waiting change", str(number), map(str, self._changes))
        return self._changes[number]

    def _over(self, change: C) -> str:
        if self._now() >= change.until:
            return f"nobody approved it by {utc(change.until)}"
        return "" if self._overtaken is None else self._overtaken(change)

    def _note(self, person: Person, text: str) -> None:
        self._log.event("command", person.name, text)
        self._plant.note(person, "APPROVAL", text)

    def _keep(self) -> None:
        if self._records is None:
            return
        changes = [asdict(change) for change in self.all]  # type: ignore[call-overload]
        try:
            self._records.keep_waiting_changes(self._kind, json.dumps(changes) if changes else "")
        except StoreError as error:
            self._log.take_alarm(alarms.RECORDS.raised(problem=error))

    def _now(self) -> float:
        return self._plant.clock.utc().timestamp()


def authority_of(plant: PlantController, person: str, author: str) -> Grant:
    """Return the command authority of a person or of the author of a change.

    Raises
    ------
    RefusedError
        If neither has it.
    """
    grant = plant.authority.grant
    if grant is None:
        raise refusals.NO_AUTHORITY.error(person=person)
    if grant.holder.name not in (person, author):
        raise refusals.OTHER_AUTHORITY.error(holder=grant.holder.name, person=person)
    return grant


def utc(at: float) -> str:
    """Return a time, POSIX s, as a person reads it."""
    return f"{datetime.fromtimestamp(at, UTC):%Y-%m-%d %H:%M} UTC"
