"""Changes of parameters that wait for the approval of a second engineer; see `second_approval`.

A change of a heliostat's parameters by a person, or their roll-back, is not sent to the board until
it is approved. It also lapses when the heliostat receives other new parameters.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from heliotrope.links.messages import Stage
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.errands import Errands, Step
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.operations.second_approval import WaitingChanges, authority_of, utc
from heliotrope.plant.operations.typed_parameters import (
    PreparedChange,
    SecondPerson,
    TypedParameters,
)
from heliotrope.plant.orders.authority import Person, Role
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.store.records import Records

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
    def subject(self) -> str:
        """What the change concerns."""
        return f"parameters {self.heliostat}"

    @property
    def text(self) -> str:
        """What the change sets, and why, in words."""
        what = ", ".join(f"{parameter.name} {parameter.asked:g}" for parameter in self.parameters)
        again = f"restore version {self.version}: " if self.version else ""
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
            number, until = self.change.number, utc(self.change.until)
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
        self._plant, self._typed, self._errands = plant, typed, errands
        self._courses: dict[int, _Course] = {}
        self._changes = WaitingChanges(
            "parameters",
            plant,
            log,
            records,
            _read,
            overtaken=self._overtaken,
            ended=self._ended,
        )

    @property
    def needed(self) -> bool:
        """Whether a change of parameters needs a second engineer."""
        return self._changes.needed

    @property
    def waiting(self) -> tuple[WaitingChange, ...]:
        """The waiting changes, oldest first."""
        return self._changes.all

    def recall(self) -> None:
        """Continue with the changes that were waiting when the plant's program ended."""
        self._changes.recall()
        for change in self.waiting:
            if change.heliostat not in self._plant.field.names:
                self._changes.end(change, "the heliostat is no longer in the plant file")

    def step(self) -> None:
        """End the changes that are past their deadline or have been superseded."""
        self._changes.step()

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
        change = self._new(person, heliostat, version, prepared)
        self._changes.add(person, change)
        course = self._courses[change.number] = _Course(change)

        def progress(names: Sequence[str]) -> dict[str, Step]:
            return dict.fromkeys(names, course.step())

        patience = change.until - change.at + _WRITING
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
        change = self._changes.others(person, number)
        typed = {} if change.version else {p.name: p.asked for p in change.parameters}
        prepared = await self._prepared(change.heliostat, typed, change.version, change.reason)
        change = self._changes.others(person, number)  # it may have ended in the meantime
        grant = authority_of(self._plant, person.name, change.author)
        second = SecondPerson(change.author, person.name)
        ticket = self._typed.write(grant.holder, grant.token, prepared, second)
        if course := self._courses.pop(number, None):
            course.approver, course.written = person.name, ticket
        self._changes.approved(person, change)
        return ticket

    def refuse(self, person: Person, number: int, reason: str) -> None:
        """Refuse another engineer's change; see `WaitingChanges.refuse`."""
        self._changes.refuse(person, number, reason)

    def withdraw(self, person: Person, number: int) -> None:
        """Withdraw a person's own change; see `WaitingChanges.withdraw`."""
        self._changes.withdraw(person, number)

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
        mechanism = self._plant.beliefs.nominal(heliostat)
        number, now, until = self._changes.request()
        parameters = tuple(
            AskedParameter(
                name, mechanism.parameter(name).unit, before.get(name, 0.0), after.get(name, 0.0)
            )
            for name in mechanism.parameters
            if before.get(name, 0.0) != after.get(name, 0.0)
        )
        return WaitingChange(
            number,
            heliostat,
            person.name,
            prepared.reason,
            now,
            until,
            version,
            self._version(heliostat),
            parameters,
            *self._typed.beam_change(heliostat, before, after),
        )

    def _overtaken(self, change: WaitingChange) -> str:
        """Return the reason why a change is no longer valid; empty if it is."""
        if (version := self._version(change.heliostat)) != change.based_on:
            return f"the heliostat has received version {version} since the request"
        return ""

    def _ended(self, change: WaitingChange, why: str, person: Person | None) -> None:
        if course := self._courses.pop(change.number, None):
            course.ended = Step(why, Stage.FAILED if person is None else Stage.REFUSED)

    def _version(self, heliostat: str) -> int:
        record = self._plant.beliefs.record(heliostat)
        return 0 if record is None else record.version


def _read(document: dict[str, Any]) -> WaitingChange:
    """Return a change from its document."""
    rows = tuple(AskedParameter(**row) for row in document["parameters"])
    return WaitingChange(**{**document, "parameters": rows})
