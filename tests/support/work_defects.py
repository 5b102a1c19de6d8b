"""Defects of automatic control, and of what the plant shows of it: for `twin_defects`."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from heliotrope.plant.operations import calibration_book
from heliotrope.plant.operations.calibrating import Calibrating
from heliotrope.plant.operations.calibration_book import CalibrationBook
from heliotrope.plant.operations.keeping import Keeping
from heliotrope.plant.operations.operations import Operations
from heliotrope.plant.operations.raising import Raising
from heliotrope.plant.operations.viewing import Viewer
from heliotrope.plant.visits.calibration_cycle import CalibrationCycle
from heliotrope.twin.world.faults import Fault

Plant = Callable[[pytest.MonkeyPatch], None]
#: The plant's program ends after the first calibrations, and another one begins.
CRASH = (Fault("plant_crash", 150.0, 5.0, 0, 0.5),)


def counts_of_later(patch: pytest.MonkeyPatch) -> None:
    """A sighting has the step counts of a moment after its photograph."""
    sighting = CalibrationCycle._sighting

    def late(self: Any, shot: Any, counts: Any) -> Any:
        return sighting(self, shot, np.asarray(counts) + 150.0)

    patch.setattr(CalibrationCycle, "_sighting", late)


def one_too_many(patch: pytest.MonkeyPatch) -> None:
    """A result counts one sighting that the visit did not bring."""
    conclude = Calibrating._conclude

    def generous(self: Any, target: str, result: Any, *rest: Any, **more: Any) -> Any:
        return conclude(self, target, replace(result, new=result.new + 1), *rest, **more)

    patch.setattr(Calibrating, "_conclude", generous)


def not_kept(patch: pytest.MonkeyPatch) -> None:
    """The store gets no results."""
    patch.setattr(Keeping, "keep", lambda self, entry, begun, sigma: None)


def not_recalled(patch: pytest.MonkeyPatch) -> None:
    """A new program knows nothing of what the one before it has learnt."""
    recall = Keeping.recall

    def forgetful(self: Any) -> None:
        records = self._records
        patch.setattr(records, "latest_calibrations", lambda names: {})
        recall(self)

    patch.setattr(Keeping, "recall", forgetful)


def never_raised(patch: pytest.MonkeyPatch) -> None:
    """Automatic control leaves heliostats at stow."""

    async def nothing(self: Any, *rest: Any) -> None:
        del self, rest

    patch.setattr(Raising, "step", nothing)


def idle_target(patch: pytest.MonkeyPatch) -> None:
    """Nobody is sent to one of the targets."""
    visit = Calibrating.visit

    async def choosy(self: Any, target: str, *rest: Any) -> tuple[str, ...]:
        return () if target == "left" else await visit(self, target, *rest)

    patch.setattr(Calibrating, "visit", choosy)


def failing_part(patch: pytest.MonkeyPatch) -> None:
    """A part of automatic control fails, and is tried again."""

    def wrong(self: Any) -> None:
        raise ValueError("no predictions")

    patch.setattr(CalibrationBook, "refresh", wrong)


def told_twice(patch: pytest.MonkeyPatch) -> None:
    """An act of a person is two events."""
    tell = Operations._tell

    def twice(self: Any, person: Any, text: str, *more: Any) -> None:
        tell(self, person, text, *more)
        tell(self, person, f"again: {text}", *more)

    patch.setattr(Operations, "_tell", twice)


def beams_nowhere(patch: pytest.MonkeyPatch) -> None:
    """No beam is shown on a surface."""
    patch.setattr(Viewer, "_on", lambda self, now: np.zeros(len(self.positions), dtype=np.uint8))


def twice_the_error(patch: pytest.MonkeyPatch) -> None:
    """The error of the beam is shown as that of the normal."""
    expected = calibration_book.expected_errors
    patch.setattr(calibration_book, "expected_errors", lambda *given: 2.0 * expected(*given))


def never_out(patch: pytest.MonkeyPatch) -> None:
    """Whoever is out of service is shown as in service."""
    make = Viewer._make

    def hiding(self: Any, now: float) -> Any:
        frame = make(self, now)
        return replace(frame, held=np.zeros(len(frame.held), dtype=np.bool_))

    patch.setattr(Viewer, "_make", hiding)


#: Invariants that may find it, name, defect, the faults of its runs, whether it is slow, and the
#: seed that found it.
ROWS: tuple[tuple[tuple[int, ...], str, Plant, tuple[Fault, ...], bool, int], ...] = (
    ((16,), "a sighting with the step counts of later", counts_of_later, (), True, 0),
    ((16,), "a result counts one sighting too many", one_too_many, (), True, 0),
    ((16,), "the store gets no results", not_kept, (), False, 0),
    ((16,), "a new program has forgotten all", not_recalled, CRASH, True, 0),
    ((16,), "the field is not raised", never_raised, (), True, 0),
    ((16,), "a target stays idle", idle_target, (), True, 0),
    ((16,), "a part of automatic control fails", failing_part, (), False, 0),
    ((11,), "an act of a person is two events", told_twice, (), False, 0),
    ((11,), "no beam is shown on a surface", beams_nowhere, (), True, 0),
    ((11,), "the error of the beam is shown as the normal's", twice_the_error, (), True, 0),
    ((11,), "nobody is shown as out of service", never_out, (), True, 1),
)
