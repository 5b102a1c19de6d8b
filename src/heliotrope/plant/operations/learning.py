"""Nightly learning of the hyperparameters of each group, in the background.

Hyperparameters describe how far the heliostats of a group differ from the plant file, how their
drives drift, and how noisy their photographs are. Visits use them to follow the drift, and they
determine the growth of predicted errors, in the schedule and in the displayed ellipses. An operator
may start learning at any time; no heliostat moves.
"""

import json
import math
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Protocol

from heliotrope.calibration.learn.drift import Hyperparameters
from heliotrope.calibration.learn.group import (
    GroupHistory,
    LearntGroup,
    defaults,
    described,
    document_of,
    read_hyperparameters,
)
from heliotrope.errors import HeliotropeError, InputError, UnknownNameError
from heliotrope.mechanism import parameters as parameter_table
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.keeping import Keeping
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.operations.views import LearningView
from heliotrope.plant.orders.authority import Person, Role
from heliotrope.store.records import LearningEntry

#: Minimum time between two nightly attempts, s, so that there is one per night.
EVERY = 16 * 3600.0


class Learner(Protocol):
    """Learns groups outside the plant's event loop."""

    async def learn(self, group: GroupHistory) -> LearntGroup:
        """Return the result of learning a group.

        Raises
        ------
        HeliotropeError
            If the group has too few data yet, or learning fails; the text is shown to operators.
        """
        ...


@dataclass
class _Group:
    """The hyperparameters in force for one group, and how the last attempt ended.

    Version 0 means the defaults.
    """

    entry: LearningEntry
    said: str = "the default values are in force because nothing has been learnt yet"
    #: Sightings known at the last attempt.
    known: int = -1


class Learning:
    """The nightly learning of a plant.

    Parameters
    ----------
    plant, log, keeping
        The controller, the logbook for events, and the store of results.
    model
        The parameters fitted for a heliostat with few sightings: a name of the table, or names.
    learner
        Runs the learning; None: nothing is learnt.
    person
        Name under which the audit log lists the nightly learning.
    """

    def __init__(
        self,
        plant: PlantController,
        log: Logbook,
        keeping: Keeping,
        model: str | tuple[str, ...],
        learner: Learner | None,
        person: Person,
    ) -> None:
        self._plant, self._log, self._keeping = plant, log, keeping
        self._model, self._learner, self._nightly = model, learner, person
        self._groups = {
            name: _Group(LearningEntry(name, 0, math.nan, "", 0, 0, math.nan, ""))
            for name in plant.design.groups
        }
        self._asked: dict[str, Person] = {}
        self._running, self._tried = "", -math.inf

    # -- people's requests -----------------------------------------------------------------

    def order(self, person: Person, group: str = "") -> None:
        """Learn a group ("": all) now.

        Raises
        ------
        RefusedError
            If the role is too low.
        UnknownNameError
            If there is no such group.
        InputError
            If the plant has no learner.
        """
        person.must_be(Role.ENGINEER, "learn")
        if group and group not in self._groups:
            raise UnknownNameError("group", group, self._groups)
        if self._learner is None:
            raise InputError(
                "learn: this plant was started without a learner, so the values in force stay"
            )
        wanted = (group,) if group else tuple(self._groups)
        self._asked |= dict.fromkeys(wanted, person)
        self._plant.note(person, "LEARN", f"group {', '.join(wanted)}")

    def views(self) -> tuple[LearningView, ...]:
        """Return the hyperparameters in force for each group."""
        return tuple(self._view(name, group) for name, group in self._groups.items())

    def _view(self, name: str, group: _Group) -> LearningView:
        entry = group.entry
        said = group.said
        if name == self._running:
            said = f"learning is running; {said}"
        elif name in self._asked:
            said = f"learning is queued; {said}"
        return LearningView(
            name,
            entry.version,
            entry.at,
            entry.person,
            entry.heliostats,
            entry.sightings,
            entry.gain,
            described(self._in_force(name)),
            said,
        )

    # -- learning --------------------------------------------------------------------------

    async def step(self, *, night: bool) -> None:
        """Learn one group that is due: a group that operators requested or, at night, any group."""
        if self._learner is None:
            return
        now = self._utc()
        if night and now - self._tried >= EVERY:
            self._tried = now
            due = [n for n, g in self._groups.items() if self._count(n) != g.known]
            self._asked |= {name: self._nightly for name in due if name not in self._asked}
        if not self._asked:
            return
        self._running = name = next(iter(self._asked))
        person = self._asked.pop(name)
        try:
            await self._learn(self._learner, name, person)
        finally:
            self._running = ""

    async def _learn(self, learner: Learner, name: str, person: Person) -> None:
        group, beliefs = self._groups[name], self._plant.beliefs
        group.known = self._count(name)
        heliostats = self._plant.design.groups[name]
        known = [beliefs.known(each) for each in heliostats.names]
        task = GroupHistory(
            heliostats.mechanism,
            tuple(None if item is None else item.sightings for item in known),
            self._names_of(name),
            self._in_force(name),
        )
        before = group.said
        try:
            result = await learner.learn(task)
        except HeliotropeError as error:
            version = group.entry.version
            kept = f"version {version} stays" if version else "the defaults stay"
            group.said = f"nothing new was learnt: {error}; {kept} in force"
        else:
            group.said = self._judged(name, group, person, result)
        if group.said != before:
            self._log.event("calibration", person.name, f"group {name}: {group.said}")

    def _judged(self, name: str, group: _Group, person: Person, found: LearntGroup) -> str:
        """Activate the result if it predicts photographs better; return a message about it."""
        origin = f"{found.sightings:,} photographs of {found.heliostats} heliostats"
        if not found.gain > 0.0:
            return f"{origin}: new values would not predict them better, so nothing changed"
        document = {"model": self._names_of(name), "hyper": document_of(found.hyper)}
        entry = LearningEntry(
            name,
            group.entry.version + 1,
            self._utc(),
            person.name,
            found.heliostats,
            found.sightings,
            found.gain,
            json.dumps(document),
        )
        self._adopt(entry, found.hyper)
        self._keeping.record(entry)
        said = f"version {entry.version}, from {origin}: {described(found.hyper)}"
        self._plant.note(person, "LEARNT", f"group {name}: {said}")
        return f"{said}; a photograph's log density rose by {found.gain:.2f}"

    def _adopt(self, entry: LearningEntry, hyper: Hyperparameters) -> None:
        group = self._groups[entry.group]
        group.entry = entry
        group.said = f"version {entry.version} of {_day(entry.at)} is in force"
        source = (
            f"learnt {_day(entry.at)} from {entry.sightings:,} photographs of "
            f"{entry.heliostats} heliostats: {described(hyper)}"
        )
        self._plant.beliefs.adopt(entry.group, hyper, source)

    def recall(self) -> None:
        """Put the results from before a restart in force."""
        for entry in self._keeping.learnings():
            if entry.group not in self._groups:
                continue  # the plant file has changed; the store still has it
            try:
                result = json.loads(entry.document)
                hyper = read_hyperparameters(result["hyper"])
                if not set(hyper.names) <= self._known_of(entry.group):
                    raise InputError("its parameters are not those of the mechanism")
            except (ValueError, KeyError, TypeError, InputError) as error:
                text = (
                    f"version {entry.version} cannot be used ({error}), so the default values are "
                    f"in force"
                )
                self._groups[entry.group].said = text
                self._log.event("calibration", "", f"group {entry.group}: {text}")
                continue
            self._adopt(entry, hyper)

    # -- of a group ------------------------------------------------------------------------

    def _known_of(self, name: str) -> set[str]:
        return set(self._plant.design.groups[name].mechanism.parameters)

    def _names_of(self, name: str) -> tuple[str, ...]:
        known = self._plant.design.groups[name].mechanism.parameters
        if isinstance(self._model, str):
            return parameter_table.model(self._model, known)
        return self._model

    def _in_force(self, name: str) -> Hyperparameters:
        heliostats = self._plant.design.groups[name]
        learnt = self._plant.beliefs.hyper(heliostats.names[0])
        return learnt or defaults(heliostats.mechanism, self._names_of(name))

    def _count(self, name: str) -> int:
        known = [self._plant.beliefs.known(n) for n in self._plant.design.groups[name].names]
        return sum(len(item) for item in known if item is not None)

    def _utc(self) -> float:
        return self._plant.clock.utc().timestamp()


def _day(at: float) -> str:
    return datetime.fromtimestamp(at, UTC).strftime("%Y-%m-%d")
