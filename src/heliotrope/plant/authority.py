"""Who may command: roles, and the one authority that holds the field.

One person at a time holds the command authority. With it comes a token of 32 bits, which the
plant tells its clusters with every lease, and they their local controllers: a command with any
other token moves nothing. Each change of holder makes a new token, so what an earlier holder
left under way is void. An authority that is not kept up expires; another person may break it.

DEFOCUS and STOW need no authority, no role and no token.

::

    HeliotropeError
    └── RefusedError          a command that is not accepted; nothing was sent
"""

import secrets
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum

from heliotrope import safety
from heliotrope.errors import HeliotropeError, InputError
from heliotrope.links.clock import Clock


class RefusedError(HeliotropeError):
    """A command that is not accepted; nothing was sent and nothing moves."""


class Role(IntEnum):
    """What a person may do; a higher role may do all that a lower one may."""

    VIEWER = 0
    OPERATOR = 1
    ENGINEER = 2

    @property
    def acknowledges_as(self) -> "safety.Role | None":
        """The role in the safety table, where an engineer stands in for a supervisor."""
        return {Role.OPERATOR: safety.Role.OPERATOR, Role.ENGINEER: safety.Role.SUPERVISOR}.get(
            self
        )


#: Commands that an operator may give; all others of the wire need an engineer.
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
    """Who commands.

    Parameters
    ----------
    name
        As it goes into the audit.
    role
        What they may do.

    Raises
    ------
    InputError
        An empty name.
    """

    name: str
    role: Role

    def __post_init__(self) -> None:
        if not self.name.strip():
            raise InputError("person: the name is empty; the audit needs to know who commands")


@dataclass(frozen=True)
class Grant:
    """The authority of one holder.

    Attributes
    ----------
    holder
        Who has it.
    token
        1 to 2^32 - 1.
    since, kept
        When it was taken and last kept up, monotonic s.
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
        Its monotonic time decides.
    lifetime
        How long it lasts without being kept up, s.
    entropy
        Gives random bytes, for the tokens.

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
        """Who has it now, None if nobody has."""
        grant = self._grant
        if grant is not None and not self._clock.monotonic() - grant.kept < self.lifetime:
            self._grant = grant = None
        return grant

    @property
    def token(self) -> int:
        """The token that clusters are to take commands with; 0 while nobody may command."""
        grant = self.grant
        return 0 if grant is None else grant.token

    @property
    def silent_for(self) -> float:
        """How long ago any authority was kept up last (or the plant began), s."""
        return self._clock.monotonic() - self._last_kept

    def take(self, person: Person) -> Grant:
        """Take the authority if nobody has it; who has it keeps it up.

        Raises
        ------
        RefusedError
            To a viewer; if somebody else has it.
        """
        grant = self.grant
        self._may_hold(person)
        if grant is None:
            return self._give(person)
        if grant.holder != person:
            raise RefusedError(
                f"authority: {grant.holder.name} has it, kept up "
                f"{self._clock.monotonic() - grant.kept:.0f} s ago; ask for it, or break it"
            )
        return self.keep(person, grant.token)

    def seize(self, person: Person, reason: str) -> Grant:
        """Break another's authority and take it; a reason is needed, for the audit.

        Raises
        ------
        RefusedError
            To a viewer; if the holder has a higher role; without a reason.
        """
        grant = self.grant
        self._may_hold(person)
        if not reason.strip():
            raise RefusedError("authority: to break it a reason is needed; give one")
        if grant is not None and grant.holder.role > person.role:
            raise RefusedError(
                f"authority: {grant.holder.name} has it as {grant.holder.role.name.lower()}; "
                f"{person.name} as {person.role.name.lower()} cannot break it; DEFOCUS and STOW "
                "need no authority"
            )
        return self._give(person)

    def keep(self, person: Person, token: int) -> Grant:
        """Keep the authority up.

        Raises
        ------
        RefusedError
            If it is not theirs (any more).
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
            If it is not theirs.
        """
        self._checked(person, token)
        self._grant = None

    def check(self, person: Person, token: int, command: str) -> None:
        """See that a person may give a command now; it keeps the authority up.

        Raises
        ------
        RefusedError
            If the role is too low, or the authority is not theirs.
        """
        needed = Role.OPERATOR if command in OPERATOR_COMMANDS else Role.ENGINEER
        if person.role < needed:
            raise RefusedError(
                f"{command}: {person.name} is {person.role.name.lower()}; it needs "
                f"{needed.name.lower()}"
            )
        self.keep(person, token)

    def _may_hold(self, person: Person) -> None:
        if person.role < Role.OPERATOR:
            raise RefusedError(f"authority: {person.name} is viewer; it needs operator")

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
            raise RefusedError(f"authority: nobody has it; {person.name} must take it first")
        if grant.holder != person or grant.token != token:
            raise RefusedError(
                f"authority: {grant.holder.name} has it, not {person.name} with this token; "
                "take it anew"
            )
        return grant
