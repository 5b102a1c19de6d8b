"""Small movements of beams about their aims on a receiver, and the way back.

A measurement in production moves beams by a milliradian. Their assigned aims stay in the store; so
that they come back whatever becomes of the measurement, the plant itself sends each beam back to
its aim: when the measurement says so, when it has not moved the beam for a while, and when the
command authority under which it moved it has ended. That needs somebody's command authority, for
clusters obey nobody else.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.field.target import Receiver, Target
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.armature import Armature
from heliotrope.plant.tickets import Ticket

#: Longest distance of a beam from its aim, rad: below that at which `pointing_disagrees` trips.
MOST = 3e-3
#: Time without a movement after which a beam goes back, s.
LIFE = 90.0
#: Time after which a beam that did not go back is sent back again, s.
_AGAIN = 3.0


@dataclass(frozen=True)
class _Moved:
    """A beam beside its aim: the aim, and until when which token keeps it there."""

    aim: FloatArray
    token: int
    until: float


class Movements:
    """The beams that are moved, by heliostat.

    Parameters
    ----------
    receivers
        Of the plant; beams move on planar ones.
    armature
        Of all heliostats, as they are believed now.
    """

    def __init__(self, receivers: Sequence[Receiver], armature: Armature) -> None:
        self._faces: tuple[Target, ...] = tuple(r.face for r in receivers if r.kind == "planar")
        self._armature = armature
        self._moved: dict[str, _Moved] = {}
        self._sent: list[Ticket] = []

    @property
    def names(self) -> frozenset[str]:
        """The heliostats whose beams are moved, or on the way back."""
        return frozenset(self._moved)

    def aim(self, heliostat: str, present: FloatArray) -> FloatArray:
        """Return the aim of a heliostat without movement, (3,); ``present`` if it is not moved."""
        known = self._moved.get(heliostat)
        return present if known is None else known.aim

    def refused(
        self,
        names: Sequence[str],
        rows: npt.NDArray[np.intp],
        aims: FloatArray,
        wanted: FloatArray,
        tracking: npt.NDArray[np.bool_],
    ) -> dict[str, str]:
        """Return which heliostats (K,) may not be moved to points (K, 3), and why."""
        base = np.stack([self.aim(name, aim) for name, aim in zip(names, aims, strict=True)])
        on = np.zeros(len(names), dtype=np.bool_)
        for face in self._faces:
            on |= face.holds(base) & face.holds(wanted)
        away = np.linalg.norm(wanted - base, axis=-1)
        slant = np.linalg.norm(base - self._armature.origin_1[rows], axis=-1)
        wrong = {}
        for i, name in enumerate(names):
            if not tracking[i]:
                wrong[name] = "it does not track the receiver"
            elif not on[i]:
                wrong[name] = "its aim, or the point beside it, is not on a planar receiver"
            elif not away[i] <= MOST * slant[i]:
                wrong[name] = (
                    f"{1e3 * away[i] / slant[i]:.1f} mrad beside its aim; a movement has "
                    f"{1e3 * MOST:g} mrad at most"
                )
        return wrong

    def take(self, names: Sequence[str], aims: FloatArray, token: int, now: float) -> None:
        """Note that beams are moved; ``aims`` (K, 3) are those of heliostats not moved before."""
        for name, present in zip(names, aims, strict=True):
            self._moved[name] = _Moved(np.array(self.aim(name, present)), token, now + LIFE)

    def forget(self, heliostats: Iterable[str]) -> None:
        """Forget beams that have another aim now."""
        for name in heliostats:
            self._moved.pop(name, None)

    def end(self, heliostats: Collection[str]) -> None:
        """Let beams go back at the next look."""
        for name in heliostats:
            if name in self._moved:
                self._moved[name] = replace(self._moved[name], until=-np.inf)

    def due(self, now: float, token: int) -> dict[str, FloatArray]:
        """Return the aims of beams that are to go back now, by heliostat.

        None are without a command authority (``token`` 0).
        """
        for ticket in [ticket for ticket in self._sent if ticket.finished]:
            self._sent.remove(ticket)
            self.forget(name for name in ticket.heliostats if name not in ticket.refusals)
        if not token:
            return {}
        return {
            name: moved.aim
            for name, moved in self._moved.items()
            if now >= moved.until or moved.token != token
        }

    def sent(self, ticket: Ticket, token: int, now: float) -> None:
        """Note the order that brings beams back; those that do not obey are sent back again."""
        self._sent.append(ticket)
        self.wait(ticket.heliostats, token, now)

    def wait(self, heliostats: Iterable[str], token: int, now: float) -> None:
        """Let beams that cannot go back now be tried again."""
        for name in heliostats:
            if name in self._moved:
                self._moved[name] = replace(self._moved[name], token=token, until=now + _AGAIN)
