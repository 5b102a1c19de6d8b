"""What persons want measured in coded visits: several heliostats at once."""

from collections.abc import Callable, Collection, Sequence

import numpy as np
import numpy.typing as npt


class Requests:
    """Heliostats that persons want measured together, in the order in which they were asked.

    Parameters
    ----------
    place
        Returns the row of a heliostat.
    """

    def __init__(self, place: Callable[[str], int]) -> None:
        self._place = place
        self._asked: list[tuple[tuple[str, ...], str]] = []

    @property
    def asked(self) -> tuple[str, ...]:
        """The heliostats."""
        return tuple(name for names, _ in self._asked for name in names)

    def ask(self, heliostats: Sequence[str], surface: str) -> None:
        """Measure heliostats together on a surface or, for "", on the next free one."""
        self._asked.append((tuple(dict.fromkeys(heliostats)), surface))

    def withdraw(self, heliostats: Collection[str]) -> None:
        """Forget that persons wanted these heliostats measured."""
        left = [(tuple(n for n in names if n not in heliostats), s) for names, s in self._asked]
        self._asked = [(names, surface) for names, surface in left if names]

    def next(self, surface: str, ready: npt.NDArray[np.bool_]) -> tuple[str, ...]:
        """Return the next for a surface, once all of them are ready (N,); () if none are."""
        for i, (names, where) in enumerate(self._asked):
            if where in ("", surface) and ready[[self._place(name) for name in names]].all():
                del self._asked[i]
                return names
        return ()
