"""The observer of the day: automatic control has the field at stow while the sun is low.

The observer learns from the operators which heliostats they have put under automatic control, and
what they have done to them since. It also knows the sun's elevation, the boards, and which periods
are undisturbed (`quiet`). Its limits are its own, not those of the code under test (invariant 16).
"""

from collections.abc import Iterable, Sequence, Set
from math import inf, radians, sin

from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.plant.controller import PlantController
from heliotrope.twin.boards.board import Board
from heliotrope.twin.invariants.invariants import Judge

#: Elevation of the sun below which the field belongs at stow, rad.
LOWEST = radians(8.0)
#: Time from that elevation, from the last operator action, and from the start of an undisturbed
#: period until a heliostat is on its way to stow, s. The sun is checked every 30 s, the field every
#: 2 s.
AWAY_WITHIN = 45.0
_UP = (
    states.APPROACHING,
    states.IDLE,
    states.TRACKING,
    states.SEARCHING,
    states.DEFOCUSED,
)


class DayObserver(Judge):
    """Checks that the field is at stow while the sun is low; see the module.

    Parameters
    ----------
    start
        Origin of the times that it reports, s.
    boards
        All heliostats.
    lowest
        Sun elevation below which the field belongs at stow, rad.

    """

    def __init__(self, start: float, boards: Sequence[Board], lowest: float = LOWEST) -> None:
        super().__init__(start)
        self._low = sin(lowest)
        self._boards = {board.outfit.name: board for board in boards}
        self._assigned: dict[str, float] = {}
        self._calm: dict[str, float] = {}
        self._low_at, self._acted_at = inf, -inf

    def given(self, heliostats: Iterable[str], now: float) -> None:
        """Record that an operator has put heliostats under automatic control."""
        for name in heliostats:
            self._assigned.setdefault(name, now)

    def taken(self, heliostats: Iterable[str]) -> None:
        """Record that an operator has moved heliostats, whose positions are then not judged."""
        for name in heliostats:
            self._assigned.pop(name, None)

    def took(self, now: float) -> None:
        """Record that an operator holds or requests the command authority."""
        self._acted_at = now

    def look(
        self, plant: PlantController | None, quiet: Set[str], sun: FloatArray, now: float
    ) -> None:
        """Check the positions of the heliostats.

        Parameters
        ----------
        plant
            The plant; None if it is not running.
        quiet
            Heliostats in an undisturbed period.
        sun
            True direction to the sun, (3,).
        now
            s.
        """
        self._low_at = min(self._low_at, now) if sun[2] < self._low else inf
        # A new program does not know which heliostats it controlled, and in an emergency it
        # releases all.
        if plant is None or plant.sentinel.order is not None:
            self._assigned.clear()
        self._calm = {name: self._calm.get(name, now) for name in quiet}
        for name, given_at in self._assigned.items():
            since = max(self._low_at, given_at, self._acted_at, self._calm.get(name, inf))
            if now - since > AWAY_WITHIN:
                state = self._boards[name].state
                saw = f"{states.STATES[state]}, and the sun has been low for "
                saw += f"{now - self._low_at:.0f} s"
                self.check(16, state not in _UP, now, name, saw)
