"""Operator actions at a plant with automatic control, through the same calls that a page makes.

Each action that the plant accepts is reported to the observers. `shift` and `crew` determine who
acts, and when.
"""

import asyncio
import contextlib
import random
from collections.abc import Callable, Mapping, Sequence

from heliotrope.errors import InputError
from heliotrope.links.clock import Clock
from heliotrope.links.messages import Stage
from heliotrope.plant.operations import Operations
from heliotrope.plant.operations.automatic import AUTOMATIC
from heliotrope.plant.orders.authority import Person, RefusedError, Role
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.safety import Act
from heliotrope.twin.boards.outfit import RECEIVER, STANDBY
from heliotrope.twin.invariants.alarms import CALLED
from heliotrope.twin.invariants.watch import Watch
from heliotrope.twin.world.operator import ENGINEER, VIEWER, Operator
from heliotrope.twin.world.work import Work

#: What an operator does each second on duty, with the token of the command authority.
Commanding = Callable[[Operations, Person, int], None]
#: Time until the clusters have a new token and a command that only changes a setting is done, s.
_DONE = 4.0
#: Time for which an operator waits for heliostats to reach stow and accept UNLOCK, s.
_UNLOCKED_WITHIN = 120.0
#: Noise of a parameter measured by an operator, rad, and of points chosen by operators, m.
_MEASURED, _BESIDE = 3e-4, 0.5
#: Minimum time on duty, s.
_LEAST_DUTY = 2.0


class Acts:
    """Actions of operators; each raises `RefusedError` if the plant refuses it.

    Parameters
    ----------
    work
        Automatic control.
    operator
        Operator who clears latched alarms and calls emergencies.
    watch
        Observers of automatic control, which are informed of each action.
    truth
        True imperfections of each heliostat, rad, by name and parameter.
    clock
        Clock that shows true time.
    seed
        Seed of the actions.

    Attributes
    ----------
    names
        The heliostats.
    chance
        Source of random numbers.
    """

    def __init__(
        self,
        work: Work,
        operator: Operator,
        watch: Watch,
        truth: Mapping[str, Mapping[str, float]],
        clock: Clock,
        seed: int,
    ) -> None:
        self._work, self._operator = work, operator
        panel, self._watch = operator.panel, watch
        self._observer, self._beams, self._persons = panel.plant, panel.beams, panel.persons
        self.names, self._truth, self._clock = tuple(truth), truth, clock
        self.chance = random.Random(f"shift {seed}")
        self._others = random.Random(f"locks {seed}")
        self._withheld: set[str] = set()  # withheld from automatic control
        self._locked: dict[str, str] = {}  # who has locked each heliostat
        #: UNLOCK in progress: the plant's program, its ticket, and who had locked each heliostat.
        self._unlocking: list[tuple[Operations, Ticket, dict[str, str]]] = []
        operator.commands = False

    def now(self) -> float:
        """Return the true time, s."""
        return self._clock.monotonic()

    def present(self) -> Operations | None:
        """Return the plant's operations; None while it is not running, or nobody is present."""
        away = self._operator.away or self._operator.waits
        return None if away else self._work.operations

    def acted(self, word: str, person: Person = ENGINEER) -> None:
        """Report an action; the text of its event must contain ``word``."""
        self._watch.acted(self._work.operations, person, word, self.now())

    # -- giving back -------------------------------------------------------------------------

    def tidies(self, operations: Operations) -> None:
        """Clear latched alarms, resume automatic control, and give the field back to it."""
        taken = self._operator.clear(operations.plant)
        holds = operations.plant.sentinel.on
        if CALLED in taken or not holds:
            self._watch.emergency(on=False)
        if holds:
            return
        if operations.automatic.waits:
            self._beams.released(self.now())
            operations.resume(ENGINEER)
            self.acted("resumed")
        names = tuple(name for name in self.names if name not in self._withheld)
        for name, owners in self._persons.locks.items():
            if name not in self._withheld:
                self._returns(operations, name, owners)
        operations.give_back(ENGINEER, names)
        self.acted(f"put {len(names)} heliostats under")
        self._beams.given(names, self.now())
        self._watch.given(names, self.now())
        self._withheld.clear()

    def _returns(self, operations: Operations, name: str, owners: Sequence[str]) -> None:
        """Remove one of the locks on a heliostat, as its owner or as an engineer."""
        owner = owners[0]
        who = ENGINEER
        if owner != ENGINEER.name and self._others.random() < 0.5:
            who = Person(owner, Role.OPERATOR)
        operations.unhold(who, [name], owner=owner, reason="the day ends")
        if who.name != owner:
            self.acted(f"removed {owner}'s lock", who)
        self.acted("back in service" if len(owners) == 1 else "it stays locked", who)
        self._persons.returned(owner, [name])
        if len(owners) == 1:
            self._watch.held([name], self.now(), out=False)

    # -- command authority -------------------------------------------------------------------

    async def duty(
        self,
        operations: Operations,
        person: Person,
        *,
        most: float,
        commands: Commanding,
        reason: str = "",
        leaves: bool = False,
    ) -> None:
        """Take the command authority for a while, and issue commands; automatic control yields.

        Parameters
        ----------
        operations, person
            The plant's operations, and the operator on duty.
        most
            Longest time on duty, s.
        commands
            Function that is called each second with a probability of one fifth.
        reason
            Reason for seizing the authority from its holder; empty if it is taken only when free.
        leaves
            Whether the operator leaves without releasing the authority, so that it expires.
        """
        token = self._takes(operations, person, reason)
        until = self.now() + self.chance.uniform(_LEAST_DUTY, most)
        with contextlib.suppress(RefusedError):
            while self.now() < until and self.present() is operations:
                operations.plant.authority.keep(person, token)
                self._observer.kept(self.now())
                self._watch.day.took(self.now())
                self._hear()
                if self.chance.random() < 0.2:
                    commands(operations, person, token)
                await asyncio.sleep(1.0)
        if leaves or self._work.operations is not operations or self._operator.waits:
            return
        with contextlib.suppress(RefusedError):
            until = self.now() + _UNLOCKED_WITHIN
            while self.present() is operations and self.now() < until:
                for name in [name for name, by in self._locked.items() if by == person.name]:
                    self.command(operations, person, token, "UNLOCK", (name,))
                if not self._unlocking:
                    break
                operations.plant.authority.keep(person, token)
                self._observer.kept(self.now())
                await asyncio.sleep(_DONE)
                self._hear()
            self._gives(operations, person, token)

    async def once(
        self, operations: Operations, person: Person, what: str, values: Sequence[float]
    ) -> None:
        """Take the command authority for one field-wide command, then release it."""
        token = self._takes(operations, person, "")
        await asyncio.sleep(_DONE)  # until the clusters have the new token
        self.command(operations, person, token, what, (), values)
        await asyncio.sleep(_DONE)
        self._gives(operations, person, token)

    def _gives(self, operations: Operations, person: Person, token: int) -> None:
        operations.release_authority(person, token)
        self.acted("command authority back", person)
        self._observer.released(person, self.now())

    def _takes(self, operations: Operations, person: Person, reason: str) -> int:
        grant = operations.plant.authority.grant
        its = grant.token if grant is not None and grant.holder == AUTOMATIC else 0
        self._observer.gave_way(self.now(), its)
        self._watch.took(operations, self.now())
        if reason:
            token = operations.seize_authority(person, reason).token
            self.acted("has seized the command authority", person)
        else:
            token = operations.take_authority(person).token
            self.acted("has the command authority", person)
        self._observer.granted(person, token, self.now(), seized=bool(reason))
        return token

    def commands(self, operations: Operations, person: Person, token: int) -> None:
        """Issue commands to one heliostat."""
        name = self.chance.choice(self.names)
        what = self.chance.choice(["IDLE", "TRACK", "APPROACH", "REFOCUS"])
        self.command(operations, person, token, what, (name,))

    def command(
        self,
        operations: Operations,
        person: Person,
        token: int,
        what: str,
        names: Sequence[str],
        values: Sequence[float] = (),
    ) -> None:
        """Issue a command to some heliostats, or to all if ``heliostats`` is ()."""
        if what not in ("ROUGH", "LOCK_AIM"):
            self._watch.taken(names or self.names)
        ticket = operations.command(person, token, what, names, values)
        self.accepted(person, token, ticket, what)
        self._watch.commanded(what, ticket.heliostats)
        if what == "LOCK":
            self._locked.update(dict.fromkeys(ticket.heliostats, person.name))
        elif what == "UNLOCK":
            mine = {n: self._locked.pop(n) for n in ticket.heliostats if n in self._locked}
            if mine:
                self._unlocking.append((operations, ticket, mine))

    def _hear(self) -> None:
        """Handle the result of UNLOCK, which a heliostat on its way to stow refuses."""
        pending = self._unlocking
        self._unlocking = []
        for program, ticket, mine in pending:
            if program is self._work.operations and not ticket.finished:
                self._unlocking.append((program, ticket, mine))
                continue
            refused = {n: by for n, by in mine.items() if ticket.stage(n) is not Stage.DONE}
            self._locked.update(refused)
            self._watch.commanded("LOCK", list(refused))

    def aims(
        self, operations: Operations, person: Person, token: int, names: Sequence[str]
    ) -> None:
        """Aim some heliostats at the receiver again, or at a target."""
        where = self.chance.choice(("receiver", *operations.targets))
        self._watch.taken(names)
        ticket = operations.aim_at(person, token, names, where)
        self.accepted(person, token, ticket, "AIM")

    def points(
        self, operations: Operations, person: Person, token: int, names: Sequence[str]
    ) -> None:
        """Set new standby points, or new aims on the receiver, for some heliostats."""
        what = self.chance.choice(("STANDBY", "AIM"))
        gives, about = {
            "STANDBY": (operations.standby, STANDBY),
            "AIM": (operations.aim, RECEIVER),
        }[what]
        chosen = {
            name: tuple(x + self.chance.uniform(-_BESIDE, _BESIDE) for x in about) for name in names
        }
        self._watch.taken(names)
        if what == "AIM":
            self._watch.aimed(chosen)
        self.accepted(person, token, gives(person, token, chosen), what)

    def parameters(self, operations: Operations, person: Person, token: int) -> None:
        """Set a parameter of one heliostat to the value measured at its mirror.

        The reason passed with it confirms a large change, as the plant requires.
        """
        name = self.chance.choice(self.names)
        causes = self._truth[name]
        which = self.chance.choice(sorted(causes))
        values = {which: causes[which] + self.chance.gauss(0.0, _MEASURED)}
        typed = operations.parameters.change
        try:
            ticket = typed(person, token, name, values, "measured with an inclinometer")
        except InputError:
            return  # implausible for an installation, or already in use
        self._watch.typed((name,))
        self.accepted(person, token, ticket, "PARAMETERS")

    def accepted(self, person: Person, token: int, ticket: Ticket, what: str) -> None:
        """Report a command that the plant has accepted."""
        self.acted(f"{what} {ticket.heliostats[0]}", person)
        self._operator.accepted(person, token, ticket, what)

    # -- what anybody may do -----------------------------------------------------------------

    async def takes_off(self, operations: Operations) -> None:
        """Order a heliostat off its target or the receiver, even during a visit."""
        name = self.chance.choice(self.names)
        self._watch.taken((name,))
        what = self.chance.choice(["DEFOCUS", "STOW"])
        ticket = (operations.defocus if what == "DEFOCUS" else operations.stow)(VIEWER, (name,))
        self.acted(f"{what} {name}", VIEWER)
        self._operator.took_off(ticket, what)
        self._withheld.add(name)

    async def holds(self, operations: Operations, person: Person = ENGINEER) -> None:
        """Take a heliostat out of service, even if others have locked it; it goes to stow."""
        name = self.chance.choice(self.names)
        if self._persons.locks and self._others.random() < 0.5:
            name = self._others.choice(sorted(self._persons.locks))
        self._watch.taken((name,))
        self._beams.taken((name,))
        operations.hold(person, (name,), "washing")
        self.acted(f"{name} out of service", person)
        self._persons.locked(person.name, (name,), self.now())
        self._watch.held((name,), self.now(), out=True)
        self._observer.obeyed(person.name, "STOW", self.now())
        self._withheld.add(name)

    def emergency(self, operations: Operations, person: Person, act: Act) -> None:
        """Call an emergency, which releases all heliostats from automatic control."""
        self._watch.taken(self.names)
        stand = {call.who: Act[call.act] for call in operations.plant.sentinel.calls}
        operations.emergency(person, act.name, "somebody is in the field")
        if act <= stand.get(person.name, Act.ALARM):
            return  # it merges with the person's own order, which is at least as strong
        self.acted(f"EMERGENCY {act.name}", person)
        self._operator.raised(person, act)
        self._watch.emergency(on=True)

    def calibrate(
        self, operations: Operations, person: Person, *, together: bool, receiver: bool
    ) -> None:
        """Request the calibration of one or several heliostats now."""
        count = self.chance.randint(2, 3) if together or receiver else 1
        first, *others = self.chance.sample(self.names, count)
        operations.calibrate(person, first, together=others, receiver=receiver)
        self.acted("requested a", person)
        self._watch.asked((first, *others))

    def switches(self, operations: Operations, person: Person, *, on: bool) -> None:
        """Switch calibration on or off."""
        operations.switch_calibration(person, on)
        self.acted(f"calibration switched {'on' if on else 'off'}", person)
        self._watch.switched(on=on)
