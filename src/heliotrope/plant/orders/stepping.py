"""Fine steps for a measurement, and coarse steps again afterwards.

Motors whose drivers switch off at rest stop only at full steps (ROUGH), which are too coarse for
measurements, so they use microsteps for the duration of a visit. To make sure that they return to
coarse steps whatever happens to the visit, the plant itself orders fine steps while a visit needs
them, and coarse steps as soon as no visit needs fine steps and motions are accepted. That requires
a command authority, because clusters accept no other commands.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager

import numpy as np

from heliotrope.lcu import names as meanings
from heliotrope.plant.field.assigned import Held
from heliotrope.plant.field.ledger import STEPPING, Ledger
from heliotrope.plant.field.state import FieldState, Mask

#: Time after which an order that was not obeyed, or could not be sent, is repeated, s.
_AGAIN = 3.0


class Stepping:
    """The step mode that local controllers must use.

    Parameters
    ----------
    field, ledger
        State of the field, and the orders sent.
    rests
        Heliostats whose drivers rest according to the plant file. If one of them uses microsteps at
        its first report, an earlier run of the plant left it so, and it is ordered to use coarse
        steps.
    held
        Other heliostats that a visit of an earlier program ordered to use fine steps.
    """

    def __init__(
        self, field: FieldState, ledger: Ledger, rests: Iterable[str], held: Iterable[str] = ()
    ) -> None:
        self._field, self._ledger, self._rests = field, ledger, frozenset(rests)
        #: Visits that need fine steps, by heliostat; heliostats that use coarse steps without a
        #: visit.
        self._needed = Counter[str]()
        self._rough = {*self._rests, *held}
        #: Heliostats that may not be using the required steps.
        self._open = set(self._rough)
        #: When an order was last attempted for each heliostat, monotonic s.
        self._tried: dict[str, float] = {}

    @contextmanager
    def fine(self, heliostats: Iterable[str]) -> Iterator[None]:
        """Order fine steps for the duration of a block; blocks may overlap.

        The orders are sent during the block; `coarse` lists the heliostats that do not follow them
        yet.
        """
        names = frozenset(heliostats)
        self._needed.update(names)
        self._open.update(names)
        try:
            yield
        finally:
            self._needed.subtract(names)

    def ordered(self, heliostats: Iterable[str], rough: bool) -> None:
        """Record the step mode that an operator orders for times without a visit."""
        if rough:
            self._rough.update(heliostats)
            self._open.update(heliostats)
        else:
            self._rough.difference_update(heliostats)

    @property
    def lent(self) -> frozenset[str]:
        """Heliostats, not listed in the plant file, that return to coarse steps after a visit."""
        return frozenset(self._open & self._rough - self._rests)

    def record(self, heliostats: Iterable[str]) -> Held:
        """Return the record to store before heliostats are ordered to use fine steps."""
        return {"ROUGH": {n: (0.0, 0.0, 0.0) for n in heliostats if n in self.lent}}

    def coarse(self, heliostats: Iterable[str], now: float) -> tuple[str, ...]:
        """Return the heliostats that are not known to use fine steps."""
        known, rough = self._reported(now)
        unsure = rough | ~known
        return tuple(name for name in heliostats if unsure[self._field.index[name]])

    def due(self, now: float, token: int) -> dict[bool, tuple[str, ...]]:
        """Return the heliostats to be ordered to coarse steps (key True) or fine steps (key False).

        Nothing is ordered without a command authority (``token`` 0).
        """
        found: dict[bool, list[str]] = {True: [], False: []}
        known, steps = self._reported(now)
        for name in sorted(self._open) if token else ():
            if not known[self._field.index[name]]:
                continue
            needed, rough = self._needed[name] > 0, bool(steps[self._field.index[name]])
            if rough and needed:
                self._rough.add(name)
            wanted = name in self._rough and not needed
            if rough == wanted and not needed:
                self._open.discard(name)
            elif rough != wanted and now >= self._tried.get(name, -np.inf) + _AGAIN:
                found[wanted].append(name)
        return {rough: tuple(names) for rough, names in found.items() if names}

    def tried(self, heliostats: Collection[str], now: float) -> None:
        """Record that the required step mode has been ordered, or could not be ordered."""
        self._tried.update(dict.fromkeys(heliostats, now))

    def _reported(self, now: float) -> tuple[Mask, Mask]:
        """Return masks of heliostats that reported since the order, and that use coarse steps."""
        known = self._field.live(now) & self._ledger.reported(STEPPING)
        return known, np.asarray(self._field.rows["flags"] & meanings.ROUGH != 0)
