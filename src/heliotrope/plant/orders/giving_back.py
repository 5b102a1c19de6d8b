"""Restores what visits have taken (moved aims, locks and fine steps) once no visit holds it.

A visit restores what it took. If a visit ends without doing so, or an operator's order removes a
heliostat from the visit, the plant restores the rest itself, under whatever command authority
exists, as soon as motions are accepted.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial

import numpy as np

from heliotrope.files.disk import Work
from heliotrope.geometry import FloatArray
from heliotrope.plant.field.part import Part
from heliotrope.plant.field.state import FieldState
from heliotrope.plant.motion.proofs import BeamError
from heliotrope.plant.orders.audit import AuditError
from heliotrope.plant.orders.authority import Authority, RefusedError
from heliotrope.plant.orders.commands import Commands, NewPoints
from heliotrope.plant.orders.guards import Asked, Guards
from heliotrope.plant.orders.queue import PlantOrders
from heliotrope.plant.orders.taken import Taken
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.plant.refusals import BEAM_REFUSED, NOT_NOW

#: Name and role in the record.
_PLANT = ("plant", "anybody")


class GivingBack(Part):
    """Sends beams back to their aims, unlocks heliostats, and restores their steps after a visit.

    Parameters
    ----------
    field, authority, orders, guards, commands
        Parts of the plant.
    taken
        What visits have taken.
    stow
        Function that sends heliostats to stow.
    """

    def __init__(
        self,
        field: FieldState,
        authority: Authority,
        orders: PlantOrders,
        guards: Guards,
        commands: Commands,
        taken: Taken,
        stow: Callable[[Sequence[str]], object],
    ) -> None:
        self._field, self._authority, self._orders = field, authority, orders
        self._guards, self._commands = guards, commands
        self._movements, self._locks, self._stepping = taken.movements, taken.locks, taken.stepping
        self._stow = stow

    def on_beat(self, now: float) -> None:
        """Restore what must be restored, as far as motions are accepted now."""
        self._unlock(now)
        self._bring_back(now)
        self._step(now)

    # -- locks -----------------------------------------------------------------------------

    def _unlock(self, now: float) -> None:
        for what, names in self._locks.due(now, self._authority.left).items():
            self._locks.sent(what, self._ordered(what, tuple(names)))

    def _ordered(self, what: str, names: tuple[str, ...]) -> tuple[str, ...]:
        """Order heliostats that were left locked; return heliostats that need no other order."""
        if what == "STOW":
            held = self._guards.reasons(Asked(what, names), NOT_NOW)
            free = tuple(name for name in names if name not in held)
            if left := tuple(n for n in free if n not in self._locks.under_way(free)):
                self._stow(left)
            return free
        if not self._authority.token:
            return ()
        try:
            _, blocked = self._commands.examine(what, (), names)
        except RefusedError:
            return ()
        return self._give(what, (), names, blocked, "a visit has left it locked")

    def _give(
        self,
        what: str,
        values: tuple[float, ...],
        names: tuple[str, ...],
        blocked: Mapping[str, str],
        note: str,
        store: tuple[Work, Work] | None = None,
    ) -> tuple[str, ...]:
        """Issue an order to heliostats; return the heliostats that are not blocked.

        The ticket names the blocked heliostats; the order to them is tried again later.
        """
        token = self._authority.token
        able = tuple(name for name in names if name not in blocked)
        try:
            ticket = self._orders.accept((*_PLANT, what), values, names, note, store=store)
        except AuditError:
            return ()
        ticket.block(blocked)

        def send(again: bool) -> None:
            if again:
                left = Asked(what, ticket.waiting(able))
                ticket.block(self._guards.reasons(left, NOT_NOW))
            self._orders.command(ticket, what, values, ticket.waiting(able), token)

        self._orders.when_recorded(ticket, send)
        return able

    # -- aims ------------------------------------------------------------------------------

    def _bring_back(self, now: float) -> None:
        """Send moved beams back to their aims."""
        token = self._authority.token
        due = self._movements.due(now, token, self._authority.left)
        live = self._field.live(now)
        due = {name: aim for name, aim in due.items() if live[self._field.place(name)]}
        if not due:
            return
        self._movements.wait(due, token, now)
        names = self._free_to_return(due)
        if not names:
            return
        wanted = np.stack([due[name] for name in names])

        def check(some: tuple[str, ...]) -> None:
            aimed, moved = self._commands.aimed, self._movements.names
            # Changes may have come while the record was written.
            if elsewhere := [n for n in some if n in aimed or n not in moved]:
                raise BeamError("AIM", dict.fromkeys(elsewhere, "its aim has changed since"))

        def accept(store: tuple[Work, Work] | None) -> Ticket:
            note = f"{len(names)} beams return to their aims"
            ticket = self._orders.accept((*_PLANT, "AIM"), (), names, note, store=store)
            self._movements.sent(ticket, now)
            return ticket

        free = partial(self._movements.small, names)
        store = partial(self._commands.storing, "AIM")
        new = NewPoints("AIM", names, wanted, token, store, check=check, free=free)
        with suppress(AuditError):
            self._commands.give_points(new, accept)

    def _free_to_return(self, due: Mapping[str, FloatArray]) -> tuple[str, ...]:
        """Return the moved beams that may go back now."""
        aimed = self._commands.aimed  # they go elsewhere when their turn comes
        names = tuple(name for name in due if name not in aimed)
        while names:
            try:
                self._guards.refuse_now("AIM", names)
                self._commands.prove_points("AIM", names, np.stack([due[n] for n in names]))
                break
            except BeamError as error:
                names = tuple(name for name in names if name not in error.refusals)
            except RefusedError:
                return ()
        return names

    # -- steps -----------------------------------------------------------------------------

    def _step(self, now: float) -> None:
        """Order heliostats to use fine steps for a visit, or coarse steps again."""
        token = self._authority.token
        for rough, due in self._stepping.due(now, token).items():
            self._stepping.tried(due, now)
            asked = Asked("ROUGH", tuple(due))
            blocked = self._guards.reasons(asked, NOT_NOW, BEAM_REFUSED)
            names = tuple(name for name in due if name not in blocked)
            if not names:
                continue
            note = f"{len(names)} step {'roughly again' if rough else 'finely for a visit'}"
            store = None if rough else self._commands.holding(self._stepping.record(names))
            self._give("ROUGH", (float(rough),), due, blocked, note, store)
