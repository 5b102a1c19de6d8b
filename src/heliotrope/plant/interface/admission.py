"""How many ordinary orders are admitted: of one person, and of all.

EMERGENCY, DEFOCUS and STOW never ask here, nor do renewing and giving back the command authority.
"""

import math
import time
from collections.abc import Callable

from heliotrope.errors import HeliotropeError
from heliotrope.local import Buckets
from heliotrope.plant.authority import Person

#: Orders of one person, and of all: 1/s, and at once.
OWN, ALL = (10.0, 100.0), (30.0, 200.0)
#: Calls that give an order and are counted.
ORDERS = frozenset(
    (
        "withdraw_emergency", "acknowledge", "take_authority", "seize_authority", "command", "aim",
        "standby", "automatic", "resume", "switch_calibration", "calibrate", "take_photograph",
        "hold", "unhold", "put_timetable", "take_flight", "learn", "bus_frames", "set_parameters",
        "begin_marks", "mark_corners", "picture_to_mark", "give_reading",
    )
)  # fmt: skip


class BusyError(HeliotropeError):
    """Too many orders: nothing was sent."""


class Admission:
    """Counts orders.

    Parameters
    ----------
    monotonic
        Returns the time, s.
    own, everybody
        Orders of one person, and of all: 1/s, and at once.
    """

    def __init__(
        self,
        monotonic: Callable[[], float] = time.monotonic,
        own: tuple[float, float] = OWN,
        everybody: tuple[float, float] = ALL,
    ) -> None:
        self._own, self._all = Buckets(*own, monotonic), Buckets(*everybody, monotonic)

    def admit(self, call: str, person: Person) -> None:
        """Admit a call.

        Raises
        ------
        BusyError
            If it is an order, and there were too many of this person or of all.
        """
        if call not in ORDERS:
            return
        whose, wait = f"of {person.name}", self._own.take(person.name)
        if wait == 0.0:
            whose, wait = "of all persons", self._all.take("")
        if wait > 0.0:
            raise BusyError(
                f"{call}: too many orders {whose}, nothing was sent; try again in "
                f"{math.ceil(wait)} s; EMERGENCY, DEFOCUS and STOW are accepted at once"
            )
