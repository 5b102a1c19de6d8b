"""Defects that a working day must find: for `twin_defects`.

Each takes out what keeps persons and automatic control from hindering each other. The persons act
as planned, at the instant that matters.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from heliotrope.plant.attempts import Attempts
from heliotrope.plant.authority import Authority
from heliotrope.plant.giving_back import GivingBack
from heliotrope.plant.operations.keeping import Keeping
from heliotrope.plant.operations.raising import Raising
from heliotrope.plant.permission import Permission
from heliotrope.plant.stepping import Stepping
from heliotrope.plant.visits import joint_layout, receiver_layout
from heliotrope.plant.visits.visit import Visit

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

    async def nothing(self: Any) -> None:
        del self

    @contextmanager
    def no(*_: object) -> Iterator[None]:
        yield

    patch.setattr(GivingBack, "_unlock", lambda self, now: None)
    unlock = Visit._unlock

    async def unlocked(self: Any) -> None:
        if not self.mandate.refused((self.heliostat,)):
            await unlock(self)

    patch.setattr(Visit, "_unlock", unlocked)


def movements_below_the_resolution(patch: pytest.MonkeyPatch) -> None:
    """Movements are as small as they like, and motors step roughly through a visit."""

    @contextmanager
    def rough(self: Any, heliostats: Iterable[str]) -> Iterator[None]:
        del self, heliostats
        yield

    patch.setattr(joint_layout, "LEAST_STEPS", 0.0)
    patch.setattr(receiver_layout, "LEAST_STEPS", 0.0)
    patch.setattr(Stepping, "fine", rough)
    patch.setattr(Stepping, "coarse", lambda self, heliostats, now: ())


def endless_retries(patch: pytest.MonkeyPatch) -> None:
    """No failure counts: work is tried again at once, without end."""
    patch.setattr(Attempts, "_note", lambda self, subject, reason, now, count: None)


def rough_in_a_visit(patch: pytest.MonkeyPatch) -> None:
    """A setting of a person reaches heliostats in a visit."""
    patch.setattr(Permission, "_visited", lambda self, token, names: {})


def not_tracked_again(patch: pytest.MonkeyPatch) -> None:
    """Automatic control leaves heliostats at standby."""

    async def nothing(self: Any, *rest: Any) -> None:
        del self, rest

    patch.setattr(Raising, "_join", nothing)


def back_in_service_by_a_restart(patch: pytest.MonkeyPatch) -> None:
    """A new program does not know what is out of service."""
    patch.setattr(Keeping, "lockouts", lambda self: {})
