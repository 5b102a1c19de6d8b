"""The aims that visits have moved, and the aims to which the beams return.

A receiver visit moves beams by a milliradian; a visit to a target gives heliostats an aim there. So
that the beams return whatever happens to the visit, the plant itself sends each beam back to its
aim (`giving_back`): when the visit requests it, when a small movement has not been renewed for a
while, and when the mandate or the command authority under which it was moved has ended. Sending
beams back requires a command authority, because clusters accept no other commands.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.field.target import Receiver, Target
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.armature import Armature
from heliotrope.plant.field.assigned import Held, Places
from heliotrope.plant.motion.proofs import BeamError
from heliotrope.plant.orders.tickets import Ticket

#: Largest angle of a beam from its aim, rad; below the limit of `pointing_disagrees`.
MOST = 3e-3
#: Time without a movement after which a beam is returned, s.
LIFE = 90.0
#: Time after which a beam that did not return is sent back again, s; it doubles with each attempt,
#: up to the longest.
_AGAIN, _LONGEST = 3.0, 300.0

#: Returns the heliostats for which no one is responsible any longer under a token.
Left = Callable[[int, Iterable[str]], frozenset[str]]


@dataclass(frozen=True)
class _Moved:
    """A beam away from its aim: the aim, the token that keeps the beam away, and the end time.

    ``small``: the beam is on the same receiver as its aim; ``pause``: before the next attempt, s.
    """

    aim: FloatArray
    token: int
    until: float
    small: bool
    pause: float = _AGAIN


class Movements:
    """The moved beams, by heliostat.

    Parameters
    ----------
    receivers
        Receivers of the plant; beams move on planar ones.
    armature
        Present believed armatures of all heliostats.
    """

    def __init__(self, receivers: Sequence[Receiver], armature: Armature) -> None:
        self._faces: tuple[Target, ...] = tuple(r.face for r in receivers if r.kind == "planar")
        self._armature = armature
        self._moved: dict[str, _Moved] = {}
        self._sent: list[Ticket] = []

    @property
    def names(self) -> frozenset[str]:
        """The heliostats whose beams are away from their aims, or on the way back."""
        return frozenset(self._moved)

    def aim(self, heliostat: str, present: FloatArray) -> FloatArray:
        """Return the aim to which a moved beam returns, (3,); ``present`` if it is not moved."""
        known = self._moved.get(heliostat)
        return present if known is None else known.aim

    def check(
        self,
        names: Sequence[str],
        rows: npt.NDArray[np.intp],
        aims: FloatArray,
        wanted: FloatArray,
        tracking: npt.NDArray[np.bool_],
    ) -> None:
        """Check that heliostats (K,) may be moved to points (K, 3).

        Parameters
        ----------
        names, rows
            Names and indices, (K,).
        aims, wanted
            Their aims, and the points, ENU, m, (K, 3).
        tracking
            Whether the heliostats track, (K,).

        Raises
        ------
        BeamError
            If a heliostat may not be moved.
        """
        base = np.stack([self.aim(name, aim) for name, aim in zip(names, aims, strict=True)])
        on = np.zeros(len(names), dtype=np.bool_)
        for face in self._faces:
            on |= face.holds(base) & face.holds(wanted)
        away = np.linalg.norm(wanted - base, axis=-1)
        slant = np.linalg.norm(base - self._armature.origin_1[rows], axis=-1)
        blocked = {}
        for i, name in enumerate(names):
            if not tracking[i]:
                blocked[name] = "it does not track the receiver"
            elif not on[i]:
                blocked[name] = "its aim or the displaced point is not on a flat receiver"
            elif not away[i] <= MOST * slant[i]:
                blocked[name] = (
                    f"{1e3 * away[i] / slant[i]:.1f} mrad from its aim; a movement is limited to "
                    f"{1e3 * MOST:g} mrad"
                )
        if blocked:
            raise BeamError("AIM", blocked)

    def take(self, names: Sequence[str], aims: FloatArray, token: int, now: float) -> None:
        """Record that beams are moved.

        A beam that was not moved before will return to its entry in ``aims``, (K, 3).
        """
        for name, present in zip(names, aims, strict=True):
            aim = np.array(self.aim(name, present))
            self._moved[name] = _Moved(aim, token, now + LIFE, small=True)

    def lend(self, names: Sequence[str], aims: FloatArray, wanted: FloatArray, token: int) -> None:
        """Note the aims that a visit assigns, and the present aims, (K, 3).

        The beams return to the present aims.

        A heliostat that is assigned its own aim, or that had no aim, does not return later.
        """
        for name, aim in self.record(names, aims, wanted)["LENT"].items():
            if aim is not None:
                self._moved[name] = _Moved(np.array(aim), token, np.inf, small=False)
            else:
                self._moved.pop(name, None)

    def recall(self, held: Places) -> None:
        """Return beams to the aims from which visits of an earlier program moved them."""
        for name, aim in held.items():
            self._moved[name] = _Moved(np.array(aim), 0, -np.inf, small=False)

    def record(self, names: Sequence[str], aims: FloatArray, wanted: FloatArray) -> Held:
        """Return the record to store before a visit assigns aims ``wanted``; see `lend`."""
        found: dict[str, tuple[float, ...] | None] = {}
        for name, present, point in zip(names, aims, wanted, strict=True):
            aim = np.array(self.aim(name, present))
            goes_back = np.isfinite(aim).all() and not np.array_equal(aim, point)
            found[name] = tuple(aim.tolist()) if goes_back else None
        return {"LENT": found}

    def small(self, names: Sequence[str]) -> frozenset[str]:
        """Return the heliostats that were moved only slightly, and so can return without a turn."""
        return frozenset(name for name in names if self._moved[name].small)

    def forget(self, heliostats: Iterable[str]) -> None:
        """Forget moved beams, because they have been assigned another aim."""
        for name in heliostats:
            self._moved.pop(name, None)

    @contextmanager
    def ending(self, heliostats: Collection[str]) -> Iterator[None]:
        """Send the beams of heliostats back at the end of a block, however the block ends."""
        try:
            yield
        finally:
            self.end(heliostats)

    def end(self, heliostats: Collection[str]) -> None:
        """Send beams back at the next check."""
        for name in heliostats:
            if name in self._moved:
                self._moved[name] = replace(self._moved[name], until=-np.inf)

    def due(self, now: float, token: int, left: Left) -> dict[str, FloatArray]:
        """Return the aims of beams that must go back now, by heliostat.

        Without a command authority (``token`` 0), no beam goes back. ``left`` returns the
        heliostats that no visit holds any longer under the token that moved them.
        """
        for ticket in [ticket for ticket in self._sent if ticket.finished]:
            self._sent.remove(ticket)
            self.forget(name for name in ticket.heliostats if name not in ticket.refusals)
        if not token:
            return {}
        back = {name for ticket in self._sent for name in ticket.waiting(ticket.heliostats)}
        return {
            name: moved.aim
            for name, moved in self._moved.items()
            if name not in back and (now >= moved.until or left(moved.token, (name,)))
        }

    def sent(self, ticket: Ticket, now: float) -> None:
        """Note the order that returns beams; beams that do not obey are sent back again."""
        self._sent.append(ticket)
        for name in ticket.heliostats:
            if (moved := self._moved.get(name)) is not None:
                pause = min(2.0 * moved.pause, _LONGEST)
                self._moved[name] = replace(moved, until=now + moved.pause, pause=pause)

    def wait(self, heliostats: Iterable[str], token: int, now: float) -> None:
        """Try again later to return beams that cannot return now."""
        for name in heliostats:
            if (moved := self._moved.get(name)) is not None:
                self._moved[name] = replace(moved, token=token, until=now + _AGAIN)
