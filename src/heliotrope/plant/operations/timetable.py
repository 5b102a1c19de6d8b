"""The timetable of a running plant: calibrations requested at times of day or at intervals.

When an entry is due, the timetable requests its heliostats as an operator would, so they come
before all heliostats that the schedule would choose. The timetable in the plant file is in force
until an operator activates another one, which survives a restart.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.errors import HeliotropeError
from heliotrope.field.timetable import TimetableEntry, check_timetable
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.keeping import Keeping
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.operations.views import TimetableRow
from heliotrope.plant.orders.authority import Person, RefusedError, Role
from heliotrope.plant.refusals import by_reason
from heliotrope.store.records import TimetableRecord

#: Function that requests the calibration of a heliostat on a target, "" for any.
Ask = Callable[[str, str], None]


@dataclass
class _Turn:
    """The last time that an entry was due, POSIX s, and its outcome."""

    at: float = float("nan")
    text: str = ""


class Timetable:
    """The timetable in force, and its due entries.

    Parameters
    ----------
    plant
        Supplies the time and the names.
    log
        Logbook for events.
    keeping
        Stores the timetables of operators.
    """

    def __init__(self, plant: PlantController, log: Logbook, keeping: Keeping) -> None:
        self._plant, self._log, self._keeping = plant, log, keeping
        self._entries = plant.design.timetable
        self._turns: dict[str, _Turn] = {}
        self._looked = self._now()

    def recall(self) -> None:
        """Restore the timetable that an operator had put in force before a restart."""
        kept = self._keeping.timetable()
        if kept is None or not kept.document:
            return
        try:
            entries = tuple(TimetableEntry.of(one) for one in json.loads(kept.document))
            self._check(entries)
        except (ValueError, KeyError, TypeError, HeliotropeError) as error:
            text = (
                f"timetable of {kept.person}: {error}; the plant file's timetable is in force "
                f"instead"
            )
            self._log.event("calibration", "", text)
        else:
            self._entries = entries

    def put(self, person: Person, entries: Sequence[TimetableEntry] | None) -> None:
        """Activate a timetable; None restores the timetable of the plant file.

        Raises
        ------
        RefusedError
            If the person is a viewer.
        InputError, UnknownNameError
            If the timetable is invalid, or names something that the plant does not have.
        """
        person.must_be(Role.OPERATOR, "timetable")
        made = self._plant.design.timetable if entries is None else tuple(entries)
        self._check(made)
        document = "" if entries is None else json.dumps([entry.document for entry in made])
        self._entries, self._turns = made, {}
        self._keeping.record(TimetableRecord(self._now(), person.name, document))
        names = ", ".join(entry.name for entry in made) or "empty"
        origin = " (that of the plant file)" if entries is None else ""
        self._log.event("calibration", person.name, f"timetable{origin}: {names}")
        self._plant.note(person, "TIMETABLE", f"{names}{origin}")

    def step(self, ask: Ask) -> None:
        """Request the heliostats of the entries that have come due since the last step."""
        since, self._looked = self._looked, self._now()
        for entry in self._entries:
            if entry.due(since, self._looked):
                self._ask(entry, ask)

    def ruled(self, rule: str) -> npt.NDArray[np.bool_]:
        """Return a mask of the heliostats to which a rule in the timetable applies, (N,)."""
        named = [n for entry in self._entries if entry.rule == rule for n in entry.heliostats]
        mask = np.zeros(len(self._plant.field.names), dtype=np.bool_)
        mask[[self._plant.field.place(name) for name in named]] = True
        return mask

    def rows(self) -> tuple[TimetableRow, ...]:
        """Return the entries in force, with their last and next times."""
        now, rows = self._now(), []
        for entry in self._entries:
            turn = self._turns.get(entry.name, _Turn())
            row = TimetableRow(
                entry.name,
                entry.heliostats,
                entry.target,
                entry.at,
                entry.every,
                entry.next(now),
                turn.at,
                turn.text,
                entry.rule,
            )
            rows.append(row)
        return tuple(rows)

    def _ask(self, entry: TimetableEntry, ask: Ask) -> None:
        refused = {}
        for name in entry.heliostats:
            try:
                ask(name, entry.target)
            except RefusedError as error:
                refused[name] = str(error)
        asked = len(entry.heliostats) - len(refused)
        text = f"requested {asked} of {len(entry.heliostats)} heliostats"
        text += f"; not {by_reason(refused)}" if refused else ""
        before = self._turns.get(entry.name, _Turn())
        # At night every occurrence of an entry ends the same way, so one event is enough.
        if text != before.text:
            about = entry.heliostats
            self._log.event("calibration", entry.name, f"timetable: {text}", heliostats=about)
        self._turns[entry.name] = _Turn(self._looked, text)

    def _check(self, entries: Sequence[TimetableEntry]) -> None:
        design = self._plant.design
        check_timetable(entries, self._plant.field.names, (t.name for t in design.targets))

    def _now(self) -> float:
        return self._plant.clock.utc().timestamp()
