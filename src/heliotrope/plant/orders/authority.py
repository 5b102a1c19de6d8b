"""Who may command: roles, and the plant's single command authority.

One person at a time holds the command authority. It comes with a 32-bit token, which the plant
sends to its clusters with every lease, and the clusters to their local controllers; a command with
any other token moves nothing. Each change of holder creates a new token, so that no command from an
earlier holder that is still in transit takes effect. An authority that is not renewed expires;
another person may also seize it.

A visit works under a `Mandate`, which the holder grants at its start and which is valid until the
visit ends, whoever takes command in the meantime. It covers only the heliostats of the visit, and
an operator's command to one of these heliostats removes it from the visit. Commands under a mandate
are sent with the current token; while nobody holds the authority and a mandate is open, the plant
has its own token.

DEFOCUS and STOW need no authority, no role and no token.
"""

import secrets
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from enum import IntEnum

from heliotrope import safety
from heliotrope.errors import InputError
from heliotrope.lcu import messages
from heliotrope.links.clock import Clock
from heliotrope.plant import refusals
from heliotrope.plant.refusals import RefusedError

__all__ = [
    "OPERATOR_COMMANDS",
    "Authority",
    "Grant",
    "Mandate",
    "Person",
    "RefusedError",
    "Role",
    "TakenOutError",
]


class TakenOutError(RefusedError):
    """A visit ends because other orders have removed all its heliostats."""


class Role(IntEnum):
    """The role of a person; a higher role may do everything that a lower role may."""

    VIEWER = 0
    OPERATOR = 1
    ENGINEER = 2

    @property
    def title(self) -> str:
        """The role in words."""
        return self.name.lower()

    @property
    def acknowledges_as(self) -> safety.AcknowledgeRole:
        """The role in the safety table: an engineer acts as supervisor, a viewer has no role."""
        return {
            Role.OPERATOR: safety.AcknowledgeRole.OPERATOR,
            Role.ENGINEER: safety.AcknowledgeRole.SUPERVISOR,
        }[self]


#: Bus commands that an operator may issue; all others require an engineer.
OPERATOR_COMMANDS = messages.BY_OPERATORS
#: Mandate tokens are larger than the wire tokens, which have 32 bits.
_MANDATES = 1 << 32


@dataclass(frozen=True)
class Person:
    """A person who commands.

    Parameters
    ----------
    name
        Name as recorded in the audit.
    role
        See `Role`.

    Raises
    ------
    InputError
        If the name is empty.
    """

    name: str
    role: Role

    def __post_init__(self) -> None:
        if not self.name.strip():
            raise InputError(
                "person: the name is empty; enter a name, because the audit log must record "
                "who gives each command"
            )

    def must_be(self, needed: Role, what: str) -> None:
        """Refuse a command if the person's role is too low; ``what`` names the command.

        Raises
        ------
        RefusedError
            If the role is too low.
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
        Token, 1 to 2^32 - 1.
    since, kept
        When the authority was taken and last renewed, monotonic s.
    """

    holder: Person
    token: int
    since: float
    kept: float


@dataclass(eq=False)
class Mandate:
    """The right of a visit to command its heliostats until it ends.

    Attributes
    ----------
    person
        The authority holder who granted it; commands are recorded under this name.
    token
        Token that represents the mandate within the plant; it is never sent to a cluster.
    where
        Name of the surface that the heliostats visit.
    heliostats
        Names of the heliostats that it covers, without those that were removed.
    taken
        Why heliostats were removed, by name.
    blameless
        Heliostats that did not cause their own removal: an operator's order or an emergency removed
        them.
    ended
        Why all commands under it are refused; "" while it is valid.
    """

    person: Person
    token: int
    where: str
    heliostats: set[str]
    taken: dict[str, str] = field(default_factory=dict)
    blameless: set[str] = field(default_factory=set)
    ended: str = ""

    def take_out(
        self, heliostats: Iterable[str], why: str, *, fault: bool = False
    ) -> tuple[str, ...]:
        """Remove heliostats for a reason ``why``; return the removed heliostats.

        With ``fault``, the heliostats themselves caused the order.
        """
        names = tuple(name for name in heliostats if name in self.heliostats)
        self.heliostats.difference_update(names)
        self.taken.update(dict.fromkeys(names, f"it dropped out of the visit: {why}"))
        if not fault:
            self.blameless.update(names)
        return names

    def give_up(self, heliostats: Iterable[str]) -> None:
        """Release heliostats by the visit's own decision."""
        self.heliostats.difference_update(heliostats)

    def refused(self, heliostats: Iterable[str]) -> dict[str, str]:
        """Return the heliostats that may not be commanded under the mandate, and the reasons."""
        return {
            name: self.ended or self.taken.get(name, "it is not in this visit")
            for name in heliostats
            if self.ended or name not in self.heliostats
        }


class Authority:
    """The plant's single command authority.

    Parameters
    ----------
    clock
        Clock of the plant.
    lifetime
        Lifetime of the authority without renewal, s.
    entropy
        Source of random bytes for the tokens.

    Attributes
    ----------
    lifetime
        As given.
    changed_at
        When `token` last changed, monotonic s; clusters learn of it within a second.

    Raises
    ------
    InputError
        If the lifetime is not above 0.
    """

    def __init__(
        self,
        clock: Clock,
        lifetime: float = 15.0,
        entropy: Callable[[int], bytes] = secrets.token_bytes,
    ) -> None:
        if not 0.0 < lifetime <= 3600.0:
            raise InputError(
                f"authority: the lifetime must be above 0 and at most 3600 s, not {lifetime} s"
            )
        self.lifetime = lifetime
        self._clock = clock
        self._entropy = entropy
        self._grant: Grant | None = None
        #: Open mandates by their tokens.
        self._mandates: dict[int, Mandate] = {}
        self._given = 0
        #: The plant's own token while nobody holds the authority and a mandate is open.
        self._own = 0
        self._last_token = 0
        self._last_kept = clock.monotonic()
        self.changed_at = clock.monotonic()

    @property
    def grant(self) -> Grant | None:
        """The present holder's grant; None if nobody holds the authority."""
        grant = self._grant
        if grant is not None and not self._clock.monotonic() - grant.kept < self.lifetime:
            self._give_up()
        return self._grant

    @property
    def token(self) -> int:
        """The token with which clusters accept commands; 0: they accept no commands.

        It is 0 while nobody holds the authority and no mandate is open.
        """
        grant = self.grant
        return self._own if grant is None else grant.token

    @property
    def silent_for(self) -> float:
        """Time since any authority was last renewed, or since the plant's start, s.

        It is 0 while a mandate is open, because the plant then commands by itself.
        """
        return 0.0 if self._mandates else self._clock.monotonic() - self._last_kept

    def take(self, person: Person) -> Grant:
        """Take the authority if nobody holds it; if the person already holds it, renew it.

        Raises
        ------
        RefusedError
            If the person is a viewer, or another person holds it.
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
        """Take the authority away from another person; the audit requires a reason.

        Raises
        ------
        RefusedError
            If the person is a viewer, there is no reason, or the holder has a higher role.
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
            If the person does not hold it, or has lost it.
        """
        grant = self._checked(person, token)
        self._last_kept = self._clock.monotonic()
        self._grant = grant = replace(grant, kept=self._last_kept)
        return grant

    def release(self, person: Person, token: int) -> None:
        """Release the authority.

        Raises
        ------
        RefusedError
            If the person does not hold it.
        """
        self._checked(person, token)
        self._give_up()

    def check(self, person: Person, token: int, command: str) -> None:
        """Check that a person may give a command now, and renew the authority.

        Raises
        ------
        RefusedError
            If the role is too low, or the person holds neither the authority nor a mandate.
        """
        needed = Role.OPERATOR if command in OPERATOR_COMMANDS else Role.ENGINEER
        person.must_be(needed, command)
        mandate = self._mandates.get(token)
        if mandate is None or mandate.person != person:
            self.keep(person, token)
        elif mandate.ended:
            raise RefusedError(f"{command}: {mandate.ended}")

    # -- mandates --------------------------------------------------------------------------

    @contextmanager
    def mandate(
        self, person: Person, token: int, heliostats: Sequence[str], where: str
    ) -> Iterator[Mandate]:
        """Grant a mandate for the duration of a visit.

        Parameters
        ----------
        person, token
            An engineer, with the token of the authority.
        heliostats, where
            Names of the heliostats of the visit, and of the surface that they visit.

        Raises
        ------
        RefusedError
            If the role is too low, or the person does not hold the authority.
        TakenOutError
            If the visit is refused because other orders have left it no heliostat.
        """
        person.must_be(Role.ENGINEER, "visit")
        self.keep(person, token)
        self._given += 1
        made = Mandate(person, _MANDATES + self._given, where, set(heliostats))
        self._mandates[made.token] = made
        try:
            yield made
        except RefusedError as error:
            if made.blameless and not made.heliostats:
                raise TakenOutError(str(error)) from error
            raise
        finally:
            made.ended = made.ended or "the visit has ended"
            del self._mandates[made.token]
            if not self._mandates:
                self._own, self._last_kept = 0, self._clock.monotonic()

    def mandate_of(self, token: int) -> Mandate | None:
        """Return the open mandate for a token; None if there is none."""
        return self._mandates.get(token)

    def visited(self) -> dict[str, Mandate]:
        """Return the open mandate of each heliostat that is in a visit, by name."""
        return {name: each for each in self._mandates.values() for name in each.heliostats}

    def taken_out(self, where: str) -> frozenset[str]:
        """Return the heliostats that orders have removed from the visit to a surface."""
        here = (each.taken for each in self._mandates.values() if each.where == where)
        return frozenset(name for taken in here for name in taken)

    def prevail(self, heliostats: Sequence[str], why: str, *, fault: bool = False) -> None:
        """Remove heliostats from their visits; see `Mandate.take_out`."""
        for each in self._mandates.values():
            each.take_out(heliostats, why, fault=fault)

    def end_mandates(self, person: Person, why: str) -> None:
        """End the mandates that a person granted; their visits move the beams off."""
        for each in self._mandates.values():
            if each.person == person:
                each.ended = why

    def lost(self, token: int, heliostats: Iterable[str]) -> frozenset[str]:
        """Return the heliostats that may no longer be commanded under a token.

        The token is a holder's or a mandate's.
        """
        mandate = self._mandates.get(token)
        if mandate is not None:
            return frozenset(mandate.refused(heliostats))
        return frozenset() if token == self.token else frozenset(heliostats)

    def left(self, token: int, heliostats: Iterable[str]) -> frozenset[str]:
        """Return the heliostats that are no longer covered by the mandate with a given token.

        A visit that has been told to end still covers its heliostats, because it moves their beams
        off.
        """
        mandate = self._mandates.get(token)
        if mandate is None:
            return self.lost(token, heliostats)
        return frozenset(heliostats) - mandate.heliostats

    def present(self, token: int) -> int:
        """Return the token to send to the clusters; 0 if a mandate has ended.

        Commands under a mandate are sent with the current token.
        """
        if token < _MANDATES:
            return token
        mandate = self._mandates.get(token)
        return 0 if mandate is None or mandate.ended else self.token

    def _drawn(self) -> int:
        """Return a new wire token."""
        token = 0
        while token in (0, self._last_token):
            token = int.from_bytes(self._entropy(4), "little")
        self._last_token = token
        return token

    def _give(self, person: Person) -> Grant:
        """Grant the authority to a person.

        The token stays the same if all open visits are this person's.
        """
        now, token = self._clock.monotonic(), self._own
        if not token or any(each.person != person for each in self._mandates.values()):
            token, self.changed_at = self._drawn(), now
        self._last_kept = now
        self._grant, self._own = Grant(person, token, now, now), 0
        return self._grant

    def _give_up(self) -> None:
        """End the grant.

        Open mandates continue under a token of the plant itself.
        """
        self._grant, self.changed_at = None, self._clock.monotonic()
        self._own = self._drawn() if self._mandates else 0

    def _checked(self, person: Person, token: int) -> Grant:
        grant = self.grant
        if grant is None:
            raise refusals.NO_AUTHORITY.error(person=person.name)
        if grant.holder != person or grant.token != token:
            raise refusals.OTHER_AUTHORITY.error(holder=grant.holder.name, person=person.name)
        return grant
