"""Who may command: roles, and the one command authority of the plant.

One person at a time holds the command authority. With it comes a token of 32 bits, which the plant
sends to its clusters with every lease, and they to their local controllers: a command with another
token moves nothing. Each change of holder makes a new token, so that no command of an earlier
holder that is still under way takes effect. An authority that is not renewed expires; another
person may break it.

DEFOCUS and STOW need no authority, no role and no token.
"""

import secrets
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum

from heliotrope import safety
from heliotrope.errors import InputError
from heliotrope.links.clock import Clock
from heliotrope.plant import refusals
from heliotrope.plant.refusals import RefusedError

__all__ = ["OPERATOR_COMMANDS", "Authority", "Grant", "Person", "RefusedError", "Role"]


class Role(IntEnum):
    """The role of a person; a higher role may do all that a lower one may."""

    VIEWER = 0
    OPERATOR = 1
    ENGINEER = 2

    @property
    def title(self) -> str:
        """The role in words."""
        return self.name.lower()

    @property
    def acknowledges_as(self) -> safety.AcknowledgeRole:
        """The role in the safety table, where an engineer acts as supervisor; a viewer has none."""
        return {
            Role.OPERATOR: safety.AcknowledgeRole.OPERATOR,
            Role.ENGINEER: safety.AcknowledgeRole.SUPERVISOR,
        }[self]


#: Wire commands that an operator may give; all others need an engineer.
OPERATOR_COMMANDS = frozenset(
    {
        "APPROACH",
        "IDLE",
        "TRACK",
        "REFOCUS",
        "LOCK",
        "UNLOCK",
        "AIM",
        "STANDBY",
        "LOCK_AIM",
        "SEARCH",
    }
)


@dataclass(frozen=True)
class Person:
    """A person who commands.

    Parameters
    ----------
    name
        Name as the audit records it.
    role
        See `Role`.

    Raises
    ------
    InputError
        An empty name.
    """

    name: str
    role: Role

    def __post_init__(self) -> None:
        if not self.name.strip():
            raise InputError("person: the name is empty; the audit must record who commands")

    def must_be(self, needed: Role, what: str) -> None:
        """Refuse a command to a person whose role is too low; ``what`` names the command.

        Raises
        ------
        RefusedError
            If it is too low.
        """
        if self.role < needed:
            raise refusals.ROLE_TOO_LOW.error(
                what=what, person=self.name, role=self.role.title, needed=needed.title
            )


@dataclass(frozen=True)
class Grant:
    """The command authority of one holder.

    Attributes
    ----------
    holder
        The person.
    token
        1 to 2^32 - 1.
    since, kept
        When it was taken and last renewed, monotonic s.
    """

    holder: Person
    token: int
    since: float
    kept: float


class Authority:
    """The one command authority of a plant.

    Parameters
    ----------
    clock
        Clock of the plant.
    lifetime
        Life of the authority without renewal, s.
    entropy
        Source of random bytes for the tokens.

    Raises
    ------
    InputError
        A lifetime that is not above 0.
    """

    def __init__(
        self,
        clock: Clock,
        lifetime: float = 15.0,
        entropy: Callable[[int], bytes] = secrets.token_bytes,
    ) -> None:
        if not 0.0 < lifetime <= 3600.0:
            raise InputError(f"authority: a lifetime of {lifetime} s; give above 0 to 3600 s")
        self.lifetime = lifetime
        self._clock = clock
        self._entropy = entropy
        self._grant: Grant | None = None
        self._last_token = 0
        self._last_kept = clock.monotonic()

    @property
    def grant(self) -> Grant | None:
        """The present holder's grant, None if nobody has the authority."""
        grant = self._grant
        if grant is not None and not self._clock.monotonic() - grant.kept < self.lifetime:
            self._grant = grant = None
        return grant

    @property
    def token(self) -> int:
        """The token that clusters accept commands with; 0 while nobody holds the authority."""
        grant = self.grant
        return 0 if grant is None else grant.token

    @property
    def silent_for(self) -> float:
        """Time since any authority was last renewed, or since the plant began, s."""
        return self._clock.monotonic() - self._last_kept

    def take(self, person: Person) -> Grant:
        """Take the authority if nobody has it; its holder renews it.

        Raises
        ------
        RefusedError
            For a viewer, or if another person has it.
        """
        grant = self.grant
        person.must_be(Role.OPERATOR, "command authority")
        if grant is None:
            return self._give(person)
        if grant.holder != person:
            age = self._clock.monotonic() - grant.kept
            raise refusals.AUTHORITY_HELD.error(holder=grant.holder.name, age=age)
        return self.keep(person, grant.token)

    def seize(self, person: Person, reason: str) -> Grant:
        """Break another person's authority and take it; the audit needs a reason.

        Raises
        ------
        RefusedError
            For a viewer, without a reason, or if the holder has a higher role.
        """
        grant = self.grant
        person.must_be(Role.OPERATOR, "command authority")
        if not reason.strip():
            raise refusals.REASON_MISSING.error(what="breaking the command authority")
        if grant is not None and grant.holder.role > person.role:
            raise refusals.HOLDER_OUTRANKS.error(
                holder=grant.holder.name,
                holder_role=grant.holder.role.title,
                person=person.name,
                role=person.role.title,
            )
        return self._give(person)

    def keep(self, person: Person, token: int) -> Grant:
        """Renew the authority.

        Raises
        ------
        RefusedError
            If the person does not have it, or has lost it.
        """
        grant = self._checked(person, token)
        self._last_kept = self._clock.monotonic()
        self._grant = grant = replace(grant, kept=self._last_kept)
        return grant

    def release(self, person: Person, token: int) -> None:
        """Give the authority back.

        Raises
        ------
        RefusedError
            If the person does not have it.
        """
        self._checked(person, token)
        self._grant = None

    def check(self, person: Person, token: int, command: str) -> None:
        """Check that a person may give a command now, and renew the authority.

        Raises
        ------
        RefusedError
            If the role is too low, or the person does not have the authority.
        """
        needed = Role.OPERATOR if command in OPERATOR_COMMANDS else Role.ENGINEER
        person.must_be(needed, command)
        self.keep(person, token)

    def _give(self, person: Person) -> Grant:
        token = 0
        while token in (0, self._last_token):
            token = int.from_bytes(self._entropy(4), "little")
        now = self._clock.monotonic()
        self._last_token, self._last_kept = token, now
        self._grant = Grant(person, token, now, now)
        return self._grant

    def _checked(self, person: Person, token: int) -> Grant:
        grant = self.grant
        if grant is None:
            raise refusals.NO_AUTHORITY.error(person=person.name)
        if grant.holder != person or grant.token != token:
            raise refusals.OTHER_AUTHORITY.error(holder=grant.holder.name, person=person.name)
        return grant
