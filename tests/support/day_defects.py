"""Defects that a working day must find: for `twin_defects`.

Each takes out what keeps persons and automatic control from hindering each other. The persons act
as planned, at the instant that matters.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from heliotrope.lcu import messages
from heliotrope.links.messages import Stage
from heliotrope.plant.attempts import Attempts
from heliotrope.plant.field.locks import Locks
from heliotrope.plant.operations.keeping import Keeping
from heliotrope.plant.operations.raising import Raising
from heliotrope.plant.orders import guards
from heliotrope.plant.orders.authority import Authority
from heliotrope.plant.orders.giving_back import GivingBack
from heliotrope.plant.orders.stepping import Stepping
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.plant.visits import coded_layout
from heliotrope.plant.visits.visit import Visit
from heliotrope.twin.invariants.invariants import L1, L2, L3, L4
from heliotrope.twin.world.crew import ANY_TIME, LOCKED, SCRIPT, CrewAct
from heliotrope.twin.world.faults import Fault

Plant = Callable[[pytest.MonkeyPatch], None]


def command_ends_visits(patch: pytest.MonkeyPatch) -> None:
    """Whoever takes the command authority ends the visits that others have begun."""
    give = Authority._give

    def alone(self: Any, person: Any) -> Any:
        for each in self._mandates.values():
            if each.person != person:
                each.ended = f"{person.name} has the command authority"
        return give(self, person)

    patch.setattr(Authority, "_give", alone)


def locks_kept(patch: pytest.MonkeyPatch) -> None:
    """Whatever breaks a visit off leaves a heliostat locked for its parameters."""

    patch.setattr(GivingBack, "_unlock", lambda self, now: None)
    unlock = Visit._unlock

    async def unlocked(self: Any) -> None:
        if not self.mandate.refused((self.heliostat,)):
            await unlock(self)

    patch.setattr(Visit, "_unlock", unlocked)


def locks_forgotten_by_a_restart(patch: pytest.MonkeyPatch) -> None:
    """A new program does not know what visits of the last one have locked."""
    patch.setattr(Locks, "recall", lambda self, held, now: None)


def movements_below_the_resolution(patch: pytest.MonkeyPatch) -> None:
    """Movements are as small as they like, and motors step roughly through a visit."""

    @contextmanager
    def rough(self: Any, heliostats: Iterable[str]) -> Iterator[None]:
        del self, heliostats
        yield

    patch.setattr(coded_layout, "LEAST_STEPS", 0.0)
    patch.setattr(Stepping, "fine", rough)
    patch.setattr(Stepping, "coarse", lambda self, heliostats, now: ())


def endless_retries(patch: pytest.MonkeyPatch) -> None:
    """No failure counts: work is tried again at once, without end."""
    patch.setattr(Attempts, "_note", lambda self, subject, reason, now, count: None)


def rough_in_a_visit(patch: pytest.MonkeyPatch) -> None:
    """A setting of a person reaches heliostats in a visit."""
    left = tuple(each for each in guards.GUARDS if each.commands != messages.SETTINGS)
    patch.setattr(guards, "GUARDS", left)


def taken_by_nobody(patch: pytest.MonkeyPatch) -> None:
    """A person's command takes no heliostat out of the visit that it is in."""
    patch.setattr(Authority, "prevail", lambda self, names, why, fault=False: None)


def done_at_once(patch: pytest.MonkeyPatch) -> None:
    """A STOW is done when it is acknowledged."""
    advance = Ticket.advance

    def hasty(self: Any, heliostats: Any, stage: Stage, *rest: Any) -> None:
        early = self.name == "STOW" and stage is Stage.ACKNOWLEDGED
        advance(self, heliostats, Stage.DONE if early else stage, *rest)

    patch.setattr(Ticket, "advance", hasty)


def not_tracked_again(patch: pytest.MonkeyPatch) -> None:
    """Automatic control leaves heliostats at standby."""

    async def nothing(self: Any, *rest: Any) -> None:
        del self, rest

    patch.setattr(Raising, "_join", nothing)


def back_in_service_by_a_restart(patch: pytest.MonkeyPatch) -> None:
    """A new program does not know what is out of service."""
    patch.setattr(Keeping, "lockouts", lambda self: ())


def _when(moment: str, what: str, after: float = 0.0) -> tuple[CrewAct, ...]:
    return (CrewAct(what, moment, after),)


#: A mirror goes out of service, and the plant's program ends a moment later.
RESTART = (Fault("plant_crash", 23.3, 5.0, 0, 0.5),)
#: The plant's program ends while three mirrors are locked for their first parameters.
IN_A_LOCK = (Fault("plant_crash", 72.0, 5.0, 0, 0.5),)
#: Invariants that may find it, name, defect, the acts of persons, the faults, the length of the
#: day, s, whether it is slow, and the seed that found it.
ROWS: tuple[
    tuple[
        tuple[int, ...], str, Plant, tuple[CrewAct, ...] | None, tuple[Fault, ...] | None,
        float, bool, int,
    ],
    ...,
] = (
    ((16,), "taking command ends a visit", command_ends_visits,
     _when("photograph", "duty", 1.0), (), 420.0, True, 1),
    ((L1,), "a visit's lock is not given back", locks_kept,
     _when(LOCKED, "emergency"), (), 420.0, True, 1),
    ((L1,), "a restart forgets a visit's lock", locks_forgotten_by_a_restart,
     (), IN_A_LOCK, 240.0, False, 4),
    ((16,), "movements below the resolution", movements_below_the_resolution,
     (), (), 420.0, True, 6),
    ((L2,), "retries without an end", endless_retries, (), (), 840.0, True, 14),
    ((16,), "ROUGH to all reaches a visit", rough_in_a_visit,
     _when("photograph", "rough", 1.0), (), 420.0, True, 8),
    ((4,), "a visit keeps what a person has taken", taken_by_nobody,
     (CrewAct("duty", "on the way", 1.0, SCRIPT),), (), 420.0, False, 4),
    ((L2,), "a STOW is done when it is acknowledged", done_at_once,
     _when(ANY_TIME, "off", 60.0), (), 240.0, False, 2),
    ((L3,), "automatic control leaves mirrors at standby", not_tracked_again,
     (), (), 660.0, False, 1),
    ((L4,), "a restart puts back in service", back_in_service_by_a_restart,
     _when(ANY_TIME, "hold", 19.0), RESTART, 240.0, False, 0),
)  # fmt: skip
