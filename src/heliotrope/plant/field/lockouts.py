"""Personal locks: heliostats out of service, and targets, receivers and towers under work.

Each person applies their own lock, as lockout-tagout requires; a locked object returns to service
when the last lock is removed. A locked heliostat stays at stow: neither an operator nor automatic
control nor a group command moves it. No beam is sent to a locked target or receiver, and while the
tower is locked no heliostat leaves stow. EMERGENCY, DEFOCUS and STOW override locks.
"""

import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray
from heliotrope.store.records import Kind, Lockout

#: Name of the tower as a lockable object.
TOWER = "tower"
#: A beam whose aim is this close to the edge of a locked surface counts as on it, m.
_BESIDE = 2.0


class Lockouts:
    """All personal locks of a plant.

    Parameters
    ----------
    design
        The plant, with its targets and receivers.
    """

    def __init__(self, design: Plant) -> None:
        self._locks: dict[tuple[Kind, str], dict[str, Lockout]] = {}
        self._surfaces = {
            (kind, surface.name): surface
            for kind, surfaces in (
                (Kind.TARGET, design.targets),
                (Kind.RECEIVER, design.receivers),
            )
            for surface in surfaces
        }

    def __iter__(self) -> Iterator[Lockout]:
        return (lock for locks in self._locks.values() for lock in locks.values())

    def __contains__(self, heliostat: object) -> bool:
        return (Kind.HELIOSTAT, heliostat) in self._locks

    @property
    def heliostats(self) -> tuple[str, ...]:
        """The heliostats that are individually locked."""
        return tuple(name for kind, name in self._locks if kind is Kind.HELIOSTAT)

    def put(self, locks: Iterable[Lockout]) -> None:
        """Apply locks; a new lock replaces the same person's earlier lock on the object."""
        for lock in locks:
            self._locks.setdefault((lock.kind, lock.name), {})[lock.who] = lock

    def remove(self, kind: Kind, name: str, who: str) -> None:
        """Remove one person's lock, if there is one."""
        locks = self._locks.get((kind, name), {})
        locks.pop(who, None)
        if not locks:
            self._locks.pop((kind, name), None)

    def on(self, kind: Kind, name: str) -> tuple[Lockout, ...]:
        """Return the locks on an object, in the order in which they were applied."""
        return tuple(self._locks.get((kind, name), {}).values())

    def text(self, kind: Kind, name: str) -> str:
        """Return the locks on an object in one line."""
        return "; ".join(lock.text for lock in self.on(kind, name))

    def closed(self, points: FloatArray) -> dict[str, npt.NDArray[np.bool_]]:
        """Return, by reason, a mask of the points (K, 3), ENU, m, that lie on locked surfaces."""
        masks = {}
        for kind, name in self._locks:
            surface = self._surfaces.get((kind, name))
            if surface is not None:
                reach = 0.5 * math.hypot(surface.width, surface.height) + _BESIDE
                near = np.linalg.norm(points - surface.center, axis=-1) <= reach
                masks[f"{kind} {name} is locked: {self.text(kind, name)}"] = np.asarray(near)
        return masks

    def reasons(
        self, heliostats: Sequence[str], points: FloatArray | None = None
    ) -> list[str | None]:
        """Return, for each heliostat, why no command may move it; None if it may be moved.

        Parameters
        ----------
        heliostats
            Names (K).
        points
            Points to which their beams are to be sent, ENU, m, (K, 3); None: the beams go to no
            surface.
        """
        tower = self.text(Kind.TOWER, TOWER)
        texts = np.full(len(heliostats), f"the tower is locked: {tower}" if tower else None, "O")
        for text, on in {} if points is None or tower else self.closed(points).items():
            texts[on] = text
        for i, name in enumerate(heliostats if self.heliostats else ()):
            if name in self:
                texts[i] = f"out of service: {self.text(Kind.HELIOSTAT, name)}"
        reasons: list[str | None] = texts.tolist()
        return reasons
