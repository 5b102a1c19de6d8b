"""Calibrating the field: one visit after another to each target, as the schedule says."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Protocol

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.errors import HeliotropeError
from heliotrope.geometry import FloatArray
from heliotrope.plant.authority import Person, RefusedError
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.calibration_book import CalibrationBook
from heliotrope.plant.operations.foresight import Foreseeing
from heliotrope.plant.operations.keeping import Keeping
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.operations.pictures import Pictures
from heliotrope.plant.operations.views import CalibrationEntry, Planned, Running
from heliotrope.plant.visits.calibration_cycle import CalibrationCycle, CycleResult

#: Time between computations of the true errors, s.
_TRUTH_EVERY = 5.0


class Scheduling(Foreseeing, Protocol):
    """The choice of the heliostat that is calibrated next."""

    def next(self, target: str, ready: npt.NDArray[np.bool_]) -> Planned | None:
        """Return the next of the ready heliostats (N,) for a free target, None if none is due."""
        ...

    def plan(self, ready: npt.NDArray[np.bool_], limit: int) -> Sequence[Planned]:
        """Return the coming visits."""
        ...

    def done(self, entry: CalibrationEntry) -> None:
        """Take the result of a visit."""
        ...


class TrueErrors:
    """True tracking errors, known to a twin only, computed every five seconds.

    Parameters
    ----------
    plant
        The errors are timed by its clock.
    truth
        Returns the errors, rad, (N,); None: they are unknown.
    """

    def __init__(self, plant: PlantController, truth: Callable[[], FloatArray] | None) -> None:
        self._plant, self._truth = plant, truth
        self._known: tuple[float, FloatArray] | None = None

    def all(self) -> FloatArray | None:
        """Return the errors of all heliostats, rad, (N,); None if they are unknown."""
        if self._truth is None:
            return None
        now = self._plant.now()
        if self._known is None or now - self._known[0] >= _TRUTH_EVERY:
            self._known = now, self._truth()
        return self._known[1]

    def now(self, row: int) -> float:
        """Return the present error of one heliostat, rad; NaN if it is unknown."""
        self._known = None
        found = self.all()
        return math.nan if found is None else float(found[row])


class Calibrating:
    """The visits of automatic calibration, and their results.

    Parameters
    ----------
    plant, log
        The controller, and the logbook for events.
    cycle
        Makes one visit.
    scheduler
        Chooses the heliostats.
    book, keeping
        Take the results.
    truth
        True errors, known to a twin only.
    first
        Returns the heliostats to be visited first, after those in doubt.
    pictures
        Keeps the photographs with the results; None: they are not kept.
    """

    def __init__(
        self,
        plant: PlantController,
        log: Logbook,
        cycle: CalibrationCycle,
        scheduler: Scheduling,
        book: CalibrationBook,
        keeping: Keeping,
        truth: TrueErrors,
        first: Callable[[], Collection[str]],
        pictures: Pictures | None = None,
    ) -> None:
        self._first = first
        self._plant, self._log, self._cycle, self._scheduler = plant, log, cycle, scheduler
        self._book, self._keeping, self._truth = book, keeping, truth
        self._pictures = pictures
        self._running: dict[str, Running] = {}
        self._asked: dict[str, tuple[str, bool]] = {}

    @property
    def asked(self) -> tuple[str, ...]:
        """Heliostats that persons want calibrated next, in the order in which they were asked."""
        return tuple(self._asked)

    def ask(self, heliostat: str, target: str, *, search: bool = False) -> None:
        """Calibrate a heliostat before all others, on a target or, for "", on the next free one.

        With ``search`` its beam is only searched for.
        """
        self._asked[heliostat] = target, search

    def withdraw(self, heliostats: Sequence[str]) -> None:
        """Forget that persons wanted these heliostats calibrated."""
        for name in heliostats:
            self._asked.pop(name, None)

    @property
    def running(self) -> Mapping[str, Running]:
        """Visits under way, by target."""
        return MappingProxyType(self._running)

    def plan(self, ready: npt.NDArray[np.bool_], limit: int) -> tuple[Planned, ...]:
        """Return the coming visits of the ready heliostats, (N,)."""
        return tuple(self._scheduler.plan(ready, limit))

    async def visit(
        self, target: str, ready: npt.NDArray[np.bool_], person: Person, token: int
    ) -> str:
        """Calibrate the next of the ready heliostats (N,); return its name, "" if none is due.

        Those that persons asked for come first, then those whose step counts are in doubt: a
        photograph ends it. Then those for which a flight has brought a large change, which a
        photograph confirms.
        """
        name, search = self._chosen(target, ready)
        if not name:
            return ""
        begun = self._now()

        def tell(stage: str) -> None:
            self._running[target] = Running(name, target, stage, begun)

        tell("on the way")
        if self._pictures is not None:
            self._pictures.begin(name)
        row = self._plant.field.place(name)
        truth, sigma = self._truth.now(row), float(self._book.error[row])
        try:
            work = self._cycle.search if search else self._cycle.run
            result = await work(person, token, name, target, tell)
        except RefusedError as error:
            result = CycleResult(name, CalibrationOutcome.REFUSED, str(error))
        except HeliotropeError as error:
            text = f"{type(error).__name__}: {error}"
            result = CycleResult(name, CalibrationOutcome.ERROR, text)
        finally:
            self._running.pop(target, None)
        self._conclude(target, result, truth, begun, sigma)
        return name

    def _chosen(self, target: str, ready: npt.NDArray[np.bool_]) -> tuple[str, bool]:
        """Return the heliostat, and whether its beam is only searched for."""
        for name, (where, search) in self._asked.items():
            if where in ("", target) and ready[self._plant.field.place(name)]:
                del self._asked[name]
                return name, search
        changed = np.isin(self._plant.field.names, list(self._first()))
        for rows in (ready & self._plant.doubts.standing, ready & changed, ready):
            chosen = self._scheduler.next(target, rows) if rows.any() else None
            if chosen is not None:
                return chosen.heliostat, False
        return "", False

    def _now(self) -> float:
        return self._plant.clock.utc().timestamp()

    def _conclude(
        self, target: str, result: CycleResult, truth: float, begun: float, sigma: float
    ) -> None:
        row, good = self._plant.field.place(result.heliostat), result.outcome.calibrated
        record = result.record
        entry = CalibrationEntry(
            self._now(),
            result.heliostat,
            target,
            result.outcome,
            result.before,
            result.after,
            result.measured,
            float(self._book.error[row]),
            truth,
            self._truth.now(row) if good else math.nan,
            self._plant.beliefs.count(result.heliostat),
            result.new,
            "; ".join((result.text, *result.rejected[:2])),
            0 if record is None else record.version,
        )
        self._book.conclude(entry)
        self._scheduler.done(entry)
        self._log.event("calibration", entry.heliostat, f"at {target}: {entry.text}")
        self._keeping.keep(entry, begun, sigma)
        if self._pictures is not None:
            self._pictures.conclude(entry)
