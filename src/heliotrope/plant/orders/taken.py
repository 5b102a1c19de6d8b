"""Heliostats and aims that visits have taken, with a record that outlives the program."""

from collections.abc import Callable

from heliotrope.files.disk import Work
from heliotrope.plant.field.assigned import Points
from heliotrope.plant.field.locks import Locks
from heliotrope.plant.field.part import Part
from heliotrope.plant.orders.movements import Movements
from heliotrope.plant.orders.stepping import Stepping


class Taken(Part):
    """Aims that visits moved, heliostats that they locked, and fine steps that they need.

    Parameters
    ----------
    movements, locks, stepping
        The three kinds of things taken; the owner of this object restores them from the records.
    points
        The records, stored with the assigned points (`assigned.HELD`).
    owe
        Function that hands work to the disk.

    Attributes
    ----------
    movements, locks, stepping
        As given.
    """

    def __init__(
        self,
        movements: Movements,
        locks: Locks,
        stepping: Stepping,
        points: Points,
        owe: Callable[[Work], None],
    ) -> None:
        self.movements, self.locks, self.stepping = movements, locks, stepping
        self._points, self._owe = points, owe

    def on_second(self, now: float) -> None:
        """Settle acknowledged points, and remove records of what no visit holds."""
        held = {
            "LOCKED": self.locks.names,
            "LENT": self.movements.names,
            "ROUGH": self.stepping.lent,
        }
        for work in (self._points.settling(), self._points.released(held, now)):
            if work is not None:
                self._owe(work)
