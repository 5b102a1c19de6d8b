"""Fine steps for a measurement, and rough steps again after it.

Motors whose drivers rest stop at full steps only (ROUGH), too coarse to measure by: for the time of
a visit they take microsteps. So that they step roughly again whatever becomes of the visit, the
plant itself orders both: fine steps while a visit needs them, rough ones as soon as none does and
motions are accepted. That needs somebody's command authority, for clusters obey nobody else.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager

import numpy as np

from heliotrope.lcu import names as meanings
from heliotrope.plant.field.assigned import Held
from heliotrope.plant.field.state import FieldState

#: From an order to a report that the board may have made before it took the order, s.
_TAKEN_WITHIN = 1.0
#: Time after which an order that was not obeyed is given again, s.
_AGAIN = 3.0


class Stepping:
    """How local controllers must step.

    Parameters
    ----------
    field
        State of the field.
    rests
        Heliostats whose drivers rest by the plant file. One that takes microsteps when it is first
        heard was left so by an earlier run of the plant, and is ordered to step roughly.
    held
        Other heliostats that a visit of an earlier program has ordered to take fine steps.
    """

    def __init__(self, field: FieldState, rests: Iterable[str], held: Iterable[str] = ()) -> None:
        self._field, self._rests = field, frozenset(rests)
        #: Visits that need fine steps, by heliostat; heliostats that step roughly without one.
        self._needed = Counter[str]()
        self._rough = {*self._rests, *held}
        #: Heliostats that may not step as they must.
        self._open = set(self._rough)
        self._sent_at: dict[str, float] = {}

    @contextmanager
    def fine(self, heliostats: Iterable[str]) -> Iterator[None]:
        """Let heliostats take fine steps for the time of a block; blocks may overlap.

        The orders go out meanwhile; `coarse` says which heliostats do not follow them yet.
        """
        names = frozenset(heliostats)
        self._needed.update(names)
        self._open.update(names)
        try:
            yield
        finally:
            self._needed.subtract(names)

    def ordered(self, heliostats: Iterable[str], rough: bool) -> None:
        """Note how a person wants heliostats to step when no visit needs them."""
        if rough:
            self._rough.update(heliostats)
            self._open.update(heliostats)
        else:
            self._rough.difference_update(heliostats)

    @property
    def lent(self) -> frozenset[str]:
        """The heliostats that step roughly again after a visit, though not by the plant file."""
        return frozenset(self._open & self._rough - self._rests)

    def record(self, heliostats: Iterable[str]) -> Held:
        """Return what is to be stored before heliostats are ordered to take fine steps."""
        return {"ROUGH": {n: (0.0, 0.0, 0.0) for n in heliostats if n in self.lent}}

    def coarse(self, heliostats: Iterable[str], now: float) -> tuple[str, ...]:
        """Return the heliostats that are not known to take fine steps."""
        return tuple(name for name in heliostats if self._is_rough(name, now) is not False)

    def due(self, now: float, token: int) -> dict[bool, tuple[str, ...]]:
        """Return the heliostats that must be ordered to step roughly (True), or finely (False).

        None are without a command authority (``token`` 0).
        """
        found: dict[bool, list[str]] = {True: [], False: []}
        for name in sorted(self._open) if token else ():
            needed, rough = self._needed[name] > 0, self._is_rough(name, now)
            if rough and needed:
                self._rough.add(name)
            wanted = name in self._rough and not needed
            if rough == wanted and not needed:
                self._open.discard(name)
            elif rough is not None and rough != wanted and now >= self._sent(name) + _AGAIN:
                found[wanted].append(name)
        return {rough: tuple(names) for rough, names in found.items() if names}

    def sent(self, heliostats: Collection[str], now: float) -> None:
        """Note that heliostats have been ordered to step as they must, or could not be."""
        self._sent_at.update(dict.fromkeys(heliostats, now))

    def _is_rough(self, name: str, now: float) -> bool | None:
        """Return whether a heliostat steps roughly by a report from after the last order."""
        row = self._field.index[name]
        heard = float(self._field.heard[row])
        if not now - heard <= self._field.limit or heard < self._sent(name) + _TAKEN_WITHIN:
            return None
        return bool(self._field.rows["flags"][row] & meanings.ROUGH)

    def _sent(self, name: str) -> float:
        return self._sent_at.get(name, -np.inf)
