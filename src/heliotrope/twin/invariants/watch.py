"""The observers of automatic control in a run, and the operators' reports that they need."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy.typing as npt

from heliotrope.plant.operations import Operations
from heliotrope.plant.orders.authority import Person
from heliotrope.twin.invariants.day import DayObserver
from heliotrope.twin.invariants.flux import FluxObserver
from heliotrope.twin.invariants.invariants import Judge
from heliotrope.twin.invariants.progress import ProgressObserver
from heliotrope.twin.invariants.results import ResultObserver
from heliotrope.twin.invariants.shown import ShownObserver
from heliotrope.twin.invariants.visits import VisitObserver


@dataclass(frozen=True)
class Watch:
    """The observers of automatic control and of what the plant displays about it.

    ``flux`` is None if the plant has no flux limit.
    """

    visits: VisitObserver
    day: DayObserver
    results: ResultObserver
    progress: ProgressObserver
    shown: ShownObserver
    flux: FluxObserver | None = None

    @property
    def each(self) -> tuple[Judge, ...]:
        """All observers, in the order in which their hooks are called."""
        each = self.visits, self.day, self.results, self.progress, self.shown
        return each if self.flux is None else (*each, self.flux)

    # -- reports of operators -------------------------------------------------------------------

    def acted(self, operations: Operations | None, person: Person, word: str, now: float) -> None:
        """Record an action in a program; the event's text there must contain ``word``."""
        self.shown.acted(operations, person.name, word, now)

    def given(self, heliostats: Sequence[str], now: float) -> None:
        """Record that heliostats were put under automatic control."""
        self.day.given(heliostats, now)
        self.progress.given(heliostats)

    def taken(self, heliostats: Sequence[str]) -> None:
        """Record that an operator moves heliostats."""
        self.day.taken(heliostats)
        self.progress.taken(heliostats)

    def aimed(self, points: Mapping[str, npt.ArrayLike]) -> None:
        """Record aims that an operator gives, ENU, m, (3,), by heliostat."""
        if self.flux is not None:
            self.flux.aimed(points)
            self.flux.commanded("AIM")

    def commanded(self, what: str, heliostats: Sequence[str]) -> None:
        """Record an operator command that the plant has accepted."""
        self.progress.commanded(what, heliostats)
        if self.flux is not None:
            self.flux.commanded(what)

    def asked(self, heliostats: Sequence[str]) -> None:
        """Record that an operator requests the calibration of heliostats now."""
        self.results.asked(heliostats)

    def typed(self, heliostats: Sequence[str]) -> None:
        """Record that an operator has set parameters of heliostats."""
        self.taken(heliostats)
        self.results.typed(heliostats)

    def emergency(self, *, on: bool) -> None:
        """Record that an operator has called an emergency, or that it was cleared."""
        self.progress.emergency(on=on)

    def took(self, operations: Operations, now: float) -> None:
        """Record that an operator has taken the command authority."""
        self.day.took(now)
        self.progress.took(operations, now)

    def switched(self, *, on: bool) -> None:
        """Record that an operator switches calibration on or off."""
        self.progress.switched(on=on)

    def held(self, heliostats: Sequence[str], now: float, *, out: bool) -> None:
        """Record that heliostats are taken out of service, or put back."""
        self.progress.held(heliostats, now, out=out)
        self.shown.held(heliostats, now, out=out)
