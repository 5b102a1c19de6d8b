"""Changes of parameters that wait for the approval of a second engineer.

If the plant file requires it (``[approval]``), a change of a heliostat's parameters by a person, or
their roll-back, is checked and then waits: nothing is sent to the board until another engineer has
approved it. Its author may withdraw it, and another engineer may refuse it. The change lapses at
its deadline, or when the heliostat receives other new parameters. It survives a restart.

This is the dual approval of IEC 62443-3-3, SR 2.1 RE 4.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any

from heliotrope.errors import UnknownNameError
from heliotrope.links.messages import Stage
from heliotrope.plant import refusals
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.errands import Errands, Step
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.operations.typed_parameters import (
    PreparedChange,
    SecondPerson,
    TypedParameters,
)
from heliotrope.plant.orders.authority import Grant, Person, Role
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.safety import alarms
from heliotrope.store.records import Records, StoreError

#: Time allowed for writing an approved change, s, after the wait for approval.
_WRITING = 900.0


@dataclass(frozen=True)
class AskedParameter:
    """A parameter that a change sets: its value in use at the request, and the new value."""

    name: str
    unit: str
    now: float
    asked: float


@dataclass(frozen=True)
class WaitingChange:
    """A change that waits for approval.

    Attributes
    ----------
    number
        Number of the change, unique within the plant.
    heliostat, author, reason
        Heliostat whose parameters it changes; the person who requested it, and why.
    at, until
        Time of the request, and deadline for the approval, POSIX s.
    version
        Version that the change restores; 0: the values were entered by hand.
    based_on
        Version in use at the time of the request; the change lapses once another version is in use.
    parameters
        Parameters that it changes.
    beam_rms, beam_most
        Change of the beam at its aim over the sun positions of that day, m; see
        `ParameterComparison`.
    """

    number: int
    heliostat: str
    author: str
    reason: str
    at: float
    until: float
    version: int
    based_on: int
    parameters: tuple[AskedParameter, ...]
    beam_rms: float
    beam_most: float

    @property
    def text(self) -> str:
        """What the change sets, and why, in words."""
        what = ", ".join(f"{parameter.name} {parameter.asked:g}" for parameter in self.parameters)
        again = f"back to version {self.version}: " if self.version else ""
        return f"PARAMETERS {self.heliostat}: {again}{what} ({self.reason})"


class _Course:
    """The progress of a change, which its author's ticket tracks."""

    def __init__(self, change: WaitingChange) -> None:
        self.change, self.approver = change, ""
        self.written: Ticket | None = None
        self.ended = Step("")

    def step(self) -> Step:
        """Return its present step."""
        if self.ended.text:
            return self.ended
        if self.written is None:
            number, until = self.change.number, _utc(self.change.until)
            return Step(f"change {number} waits until {until} for another engineer's approval")
        approved = f"approved by {self.approver}"
        if not self.written.finished:
            return Step(f"{approved}; being written")
        if self.written.good:
            return Step(approved, Stage.DONE)
        return Step(f"{approved}; {self.written.text}", Stage.FAILED)


class Approvals:
    """Manages the changes that wait for approval.

    Parameters
    ----------
    plant, log
        The controller, and the logbook for events.
    typed
        Checks and writes parameters.
    errands
        Tracks a change for its author.
    records
        Store of the waiting changes; None: they are lost when the program ends.
    """

    def __init__(
        self,
        plant: PlantController,
        log: Logbook,
        typed: TypedParameters,
        errands: Errands,
        records: Records | None,
    ) -> None:
        self._plant, self._log, self._typed = plant, log, typed
        self._errands, self._records = errands, records
        self._settings = plant.design.approval
        self._courses: dict[int, _Course] = {}
        self._last = 0

    @property
    def needed(self) -> bool:
        """Whether a change of parameters needs a second engineer."""
        return self._settings.parameters

    @property
    def waiting(self) -> tuple[WaitingChange, ...]:
        """The waiting changes, oldest first."""
        return tuple(course.change for course in self._courses.values())

    def recall(self) -> None:
        """Continue with the changes that were waiting when the plant's program ended."""
        if self._records is None:
            return
        try:
            document = self._records.waiting_changes()
            kept = [_read(item) for item in json.loads(document or "[]")]
        except StoreError as error:
            self._log.take_alarm(alarms.RECORDS.raised(problem=error))
            return
        except (ValueError, KeyError, TypeError) as error:
            text = f"the changes waiting for approval cannot be read ({error}); request them again"
            self._log.event("command", "", text)
            return
        for change in kept:
            self._courses[change.number] = _Course(change)
            self._last = max(self._last, change.number)
        if not self.needed:
            self._end_all("the plant file no longer requires a second approval")
        names = self._plant.field.names
        for change in self.waiting:
            if change.heliostat not in names:
                self._end(change, "the heliostat is no longer in the plant file")

    def step(self) -> None:
        """End the changes that are past their deadline or have been superseded."""
        for change in self.waiting:
            if reason := self._over(change):
                self._end(change, reason)

    # -- what people do --------------------------------------------------------------------

    async def ask(
        self,
        person: Person,
        heliostat: str,
        values: Mapping[str, float],
        version: int,
        reason: str,
    ) -> Ticket:
        """Request a change: values of parameters, or an earlier version; nothing is written yet.

        The ticket ends once the change is written, or with the reason why it is not.

        Raises
        ------
        RefusedError
            If the person is not an engineer, or another change of this heliostat is waiting.
        InputError, UnknownNameError
            See `TypedParameters.prepare`.
        """
        person.must_be(Role.ENGINEER, "parameters")
        prepared = await self._prepared(heliostat, values, version, reason)
        for change in self.waiting:
            if change.heliostat == heliostat:
                raise refusals.CHANGE_WAITS.error(
                    heliostat=heliostat, number=change.number, author=change.author
                )
        change = self._new(person, heliostat, version, prepared)
        course = self._courses[change.number] = _Course(change)
        self._keep()
        self._note(person, f"change {change.number} waits for approval: {change.text}")

        def progress(names: Sequence[str]) -> dict[str, Step]:
            return dict.fromkeys(names, course.step())

        patience = self._settings.within + _WRITING
        return self._errands.begin("APPROVAL", (heliostat,), progress, patience)

    async def approve(self, person: Person, number: int) -> Ticket:
        """Approve another engineer's change and write it; return the ticket for writing it.

        The change is written with the author's command authority or, failing that, the approver's.

        Raises
        ------
        RefusedError
            If the person is not an engineer or is its author, if neither has the command authority,
            or if the change cannot be written now, in which case it continues to wait.
        UnknownNameError
            If no such change is waiting.
        """
        change = self._others(person, number)
        typed = {} if change.version else {p.name: p.asked for p in change.parameters}
        prepared = await self._prepared(change.heliostat, typed, change.version, change.reason)
        change = self._others(person, number)  # it may have ended in the meantime
        grant = self._grant(change, person)
        second = SecondPerson(change.author, person.name)
        ticket = self._typed.write(grant.holder, grant.token, prepared, second)
        course = self._courses.pop(number)
        course.approver, course.written = person.name, ticket
        self._keep()
        self._note(person, f"change {number} of {change.author} approved: {change.text}")
        return ticket

    def refuse(self, person: Person, number: int, reason: str) -> None:
        """Refuse another engineer's change, with a reason.

        Raises
        ------
        RefusedError
            If the person is not an engineer, is the author of the change, or states no reason.
        UnknownNameError
            If no such change is waiting.
        """
        change = self._others(person, number)
        if not reason.strip():
            raise refusals.REASON_MISSING.error(what=f"change {number}")
        self._end(change, f"refused by {person.name}: {reason.strip()}", person)

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
                number=number,
                heliostat=change.heliostat,
                author=change.author,
                person=person.name,
            )
        self._end(change, f"withdrawn by {person.name}", person)

    # -- parts -----------------------------------------------------------------------------

    async def _prepared(
        self, heliostat: str, values: Mapping[str, float], version: int, reason: str
    ) -> PreparedChange:
        if version:
            return await self._typed.prepare_version(heliostat, version, reason)
        return self._typed.prepare(heliostat, values, reason)

    def _new(
        self, person: Person, heliostat: str, version: int, prepared: PreparedChange
    ) -> WaitingChange:
        before, after = self._typed.in_use(heliostat), prepared.record.parameters
        mechanism, now = self._plant.beliefs.nominal(heliostat), self._now()
        # Anyone who sees an earlier change can never approve a later one in its place.
        self._last = max(self._last + 1, int(1e3 * now))
        parameters = tuple(
            AskedParameter(
                name, mechanism.parameter(name).unit, before.get(name, 0.0), after.get(name, 0.0)
            )
            for name in mechanism.parameters
            if before.get(name, 0.0) != after.get(name, 0.0)
        )
        return WaitingChange(
            self._last,
            heliostat,
            person.name,
            prepared.reason,
            now,
            now + self._settings.within,
            version,
            self._version(heliostat),
            parameters,
            *self._typed.beam_change(heliostat, before, after),
        )

    def _others(self, person: Person, number: int) -> WaitingChange:
        """Return another person's change on which an engineer may decide."""
        person.must_be(Role.ENGINEER, "approval")
        change = self._find(number)
        if person.name == change.author:
            raise refusals.SECOND_PERSON.error(
                number=number, heliostat=change.heliostat, person=person.name
            )
        if reason := self._over(change):
            self._end(change, reason)
            raise refusals.CHANGE_OVERTAKEN.error(
                number=number, heliostat=change.heliostat, reason=reason
            )
        return change

    def _find(self, number: int) -> WaitingChange:
        if number not in self._courses:
            raise UnknownNameError("waiting change", str(number), map(str, self._courses))
        return self._courses[number].change

    def _over(self, change: WaitingChange) -> str:
        """Return the reason why a change can no longer wait; empty if it can."""
        if self._now() >= change.until:
            return f"nobody approved it by {_utc(change.until)}"
        if (version := self._version(change.heliostat)) != change.based_on:
            return f"the heliostat has received version {version} since the request"
        return ""

    def _grant(self, change: WaitingChange, person: Person) -> Grant:
        """Return the command authority of the approver or of the author."""
        grant = self._plant.authority.grant
        if grant is None:
            raise refusals.NO_AUTHORITY.error(person=person.name)
        if grant.holder.name not in (person.name, change.author):
            raise refusals.OTHER_AUTHORITY.error(holder=grant.holder.name, person=person.name)
        return grant

    def _version(self, heliostat: str) -> int:
        record = self._plant.beliefs.record(heliostat)
        return 0 if record is None else record.version

    def _end_all(self, why: str) -> None:
        for change in self.waiting:
            self._end(change, why)

    def _end(self, change: WaitingChange, why: str, person: Person | None = None) -> None:
        course = self._courses.pop(change.number)
        course.ended = Step(why, Stage.FAILED if person is None else Stage.REFUSED)
        self._keep()
        text = f"change {change.number} of {change.author} has ended, {why}: {change.text}"
        if person is None:
            self._log.event("command", "", text)
        else:
            self._note(person, text)

    def _note(self, person: Person, text: str) -> None:
        self._log.event("command", person.name, text)
        self._plant.note(person, "APPROVAL", text)

    def _keep(self) -> None:
        if self._records is None:
            return
        document = json.dumps([asdict(change) for change in self.waiting]) if self._courses else ""
        try:
            self._records.keep_waiting_changes(document)
        except StoreError as error:
            self._log.take_alarm(alarms.RECORDS.raised(problem=error))

    def _now(self) -> float:
        return self._plant.clock.utc().timestamp()


def _read(document: dict[str, Any]) -> WaitingChange:
    """Return a change from its document."""
    rows = tuple(AskedParameter(**row) for row in document["parameters"])
    return WaitingChange(**{**document, "parameters": rows})


def _utc(at: float) -> str:
    return f"{datetime.fromtimestamp(at, UTC):%Y-%m-%d %H:%M} UTC"
