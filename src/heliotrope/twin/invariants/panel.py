"""The observers of one plant, of its program and of its operators."""

from dataclasses import dataclass

from heliotrope.twin.invariants.beams import BeamObserver
from heliotrope.twin.invariants.invariants import Judge
from heliotrope.twin.invariants.persons import PersonsObserver
from heliotrope.twin.invariants.plant_observer import PlantObserver


@dataclass(frozen=True)
class Panel:
    """The observers of one plant, some of which can be addressed by name.

    Attributes
    ----------
    plant, beams, persons
        Observers of the plant's command authority and records, of true beams, and of operators'
        orders and locks.
    others
        Further observers, which receive events only through their hooks.
    """

    plant: PlantObserver
    beams: BeamObserver
    persons: PersonsObserver
    others: tuple[Judge, ...] = ()

    @property
    def each(self) -> tuple[Judge, ...]:
        """All observers, in the order in which their hooks are called."""
        return self.plant, self.beams, self.persons, *self.others
