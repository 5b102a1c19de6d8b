"""Limits on how many ordinary orders are admitted: per person, and in total.

EMERGENCY, DEFOCUS and STOW are not subject to these limits, nor are renewal and release of the
command authority.
"""

import math
import time
from collections.abc import Callable

from heliotrope.errors import HeliotropeError
from heliotrope.local import Buckets
from heliotrope.plant.orders.authority import Person

#: Rate (1/s) and burst of the orders of one person, and of all persons together.
OWN, ALL = (10.0, 100.0), (30.0, 200.0)


class BusyError(HeliotropeError):
    """There were too many orders; nothing was sent."""


class Admission:
    """Counts orders, and refuses orders beyond the limits.

    Parameters
    ----------
    monotonic
        Function that returns monotonic time, s.
    own, everybody
        Limits on the orders of one person, and on the orders of all users: rate, 1/s, and burst.
    """

    def __init__(
        self,
        monotonic: Callable[[], float] = time.monotonic,
        own: tuple[float, float] = OWN,
        everybody: tuple[float, float] = ALL,
    ) -> None:
        self._own, self._all = Buckets(*own, monotonic), Buckets(*everybody, monotonic)

    def admit(self, call: str, person: Person) -> None:
        """Admit an order.

        Raises
        ------
        BusyError
            If there were too many orders of this person or of all users.
        """
        whose, wait = f"from {person.name}", self._own.take(person.name)
        if wait == 0.0:
            whose, wait = "from all users", self._all.take("")
        if wait > 0.0:
            raise BusyError(
                f"{call}: too many orders {whose}, so nothing was sent; try again in "
                f"{math.ceil(wait)} s; EMERGENCY, DEFOCUS and STOW are still accepted"
            )
