"""The observers of one plant, its program and its operators."""

from dataclasses import dataclass

from heliotrope.twin.invariants.beams import BeamObserver
from heliotrope.twin.invariants.invariants import Judge
from heliotrope.twin.invariants.persons import PersonsObserver
from heliotrope.twin.invariants.plant_observer import PlantObserver


@dataclass(frozen=True)
class Panel:
    """The observers of one plant: some by name, for those who ask them or report to one alone.

    Attributes
    ----------
    plant, beams, persons
        Observers of its authority and records, of true beams, and of persons' orders and locks.
    others
        Further observers, which hear of everything by their hooks alone.
    """

    plant: PlantObserver
    beams: BeamObserver
    persons: PersonsObserver
    others: tuple[Judge, ...] = ()

    @property
    def each(self) -> tuple[Judge, ...]:
        """All observers, in the order in which their hooks are called."""
        return self.plant, self.beams, self.persons, *self.others
