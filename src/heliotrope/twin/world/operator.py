"""Scripted operators at a real plant: shifts, commands and mistakes, drawn from a seed.

An operator and an engineer move the heliostats from state to state, change aims, call and withdraw
emergencies, send parameters, and seize each other's authority. They also issue commands with an
authority that they have lost, and a viewer tries commands that the role does not allow. Every
command that the plant accepts is reported to the plant's observer. A rogue plant sends commands
with old tokens on the plant's end of a line.
"""

import asyncio
import contextlib
import random
import struct
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from heliotrope.links.clock import Clock, sleep_until
from heliotrope.links.link import LinkClosedError
from heliotrope.links.messages import Command, encode
from heliotrope.mechanism.board_items import items_of, packed
from heliotrope.plant.controller import PlantController
from heliotrope.plant.emergency.order import EmergencyOrder
from heliotrope.plant.orders.authority import Person, RefusedError, Role
from heliotrope.plant.orders.parameters import TAKES_POSE
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.safety import FLUX_READING, Act, alarms
from heliotrope.twin.boards.outfit import MACHINE, RECEIVER, STANDBY, Outfit
from heliotrope.twin.invariants.panel import Panel
from heliotrope.twin.invariants.plant_observer import VOID_WITHIN
from heliotrope.twin.world.pod import PlantEar, Pod
from heliotrope.twin.world.worlds import Habits, narrow_limits

OPERATOR = Person("operator", Role.OPERATOR)
ENGINEER = Person("engineer", Role.ENGINEER)
VIEWER = Person("viewer", Role.VIEWER)
#: Command that advances a heliostat from each state.
ONWARDS = {
    "": ("APPROACH",), "STOWED": ("APPROACH",),
    "IDLE": ("TRACK", "TRACK", "TRACK", "SEARCH", "JOG"),
    "TRACKING": ("AIM", "AIM", "IDLE", "ROUGH"), "DEFOCUSED": ("REFOCUS", "IDLE"),
    "SEARCHING": ("TRACK", "IDLE"), "LOCKED": ("UNLOCK",), "FAULT": ("CLEAR_FAULT",),
}  # fmt: skip
#: Rows of the safety table that latch; all others release by themselves.
LATCHING = frozenset(
    {"operator_emergency", "nodes_unacknowledged", "flux_after_emergency", "clock_jump"}
)
Point = tuple[float, ...]


class Maintenance(Protocol):
    """The maintenance staff in the field; see `world.maintenance`."""

    def acts(self, plant: PlantController) -> None:
        """Perform one action."""
        ...

    def confirms(self, plant: PlantController) -> None:
        """Confirm a restored store."""
        ...


#: Fraction of the emergencies that a second operator orders too.
_SECOND = 0.3
#: Error from which an operator who looks at a heliostat notices its wrong pose, steps.
_SEEN_WRONG = 300


class Operator:
    """The operators of the plant.

    Parameters
    ----------
    clock
        Clock that shows true time.
    seed, habits
        Seed of the operators' actions, and how often they take each action.
    panel
        Observers of the plant, which are informed of each accepted command and operator order.
    fits
        The heliostats.
    pods
        Clusters whose lines the rogue plant uses.
    keep_out
        Centre of a keep-out volume, at which the operators occasionally aim.
    flux
        Function that returns the fraction of beams on the receiver; None if sensors supply it.

    Attributes
    ----------
    plant
        The plant, set by the owner; None while the plant is not running.
    away
        Whether nobody is on duty.
    waits
        Whether the plant's program is frozen, so that it replies to no command.
    commands
        Whether the operators hold the command authority; otherwise they leave it to automatic
        control.
    counts
        Number of actions of each kind.
    refusal
        Reason for the plant's last refusal.
    maintenance
        The maintenance staff, set by the owner; None if there is none.
    points
        Last accepted points, ENU, m, by command (AIM, STANDBY) and heliostat.
    panel
        Observers of the plant.
    """

    def __init__(
        self,
        clock: Clock,
        seed: int,
        habits: Habits,
        panel: Panel,
        fits: Sequence[Outfit],
        pods: Sequence[Pod],
        keep_out: tuple[float, float, float],
        flux: Callable[[], float] | None,
    ) -> None:
        self.plant: PlantController | None = None
        self.away = self.waits = False
        self.commands = True
        self.counts: Counter[str] = Counter()
        self.refusal = ""
        self.maintenance: Maintenance | None = None
        self.points: dict[tuple[str, str], Point] = {}
        self._clock, self._flux, self._habits = clock, flux, habits
        self.panel, self._observer, self._persons = panel, panel.plant, panel.persons
        self._chance = random.Random(f"operator {seed}")
        self._others = random.Random(f"others {seed}")
        self._fits, self._names = {fit.name: fit for fit in fits}, sorted(fit.name for fit in fits)
        self._pods, self._keep_out = pods, keep_out
        self._duty = ENGINEER
        self._tokens: dict[str, int] = {}
        self._rest_until = 0.0
        self._number = 0

    def begins(self, plant: PlantController | None) -> None:
        """Record that the plant has started, or (if ``plant`` is None) ended."""
        self.plant = plant

    # -- authority -------------------------------------------------------------------------

    async def keep(self) -> None:
        """Renew the authority and measure the flux, once a second."""
        while True:
            due = self._clock.monotonic() + 1.0
            plant = self.plant
            if plant is not None and not (self.away or self.waits):
                if self._flux is not None:
                    plant.put(FLUX_READING, self._flux())
                if self.commands:
                    self._renews(plant)
            await sleep_until(self._clock, due)

    def _renews(self, plant: PlantController) -> None:
        if plant.authority.grant is None:
            self._take(plant, self._chance.choice([OPERATOR, ENGINEER]))
        token = self._tokens.get(self._duty.name, 0)
        with contextlib.suppress(RefusedError):
            plant.authority.keep(self._duty, token)
            self._observer.kept(self._clock.monotonic())

    def _take(self, plant: PlantController, person: Person) -> None:
        try:
            token = plant.take_authority(person).token
        except RefusedError:
            return self.seize(plant, person)
        now = self._clock.monotonic()
        if token == self._tokens.get(person.name):
            self._observer.kept(now)
        else:
            self._granted(person, token, seized=False)
        return None

    def seize(self, plant: PlantController, person: Person) -> None:
        """Put an operator on duty, who seizes the authority from its holder."""
        try:
            token = plant.seize_authority(person, "on duty now").token
        except RefusedError:
            self.counts["authority refused"] += 1
        else:
            self._granted(person, token, seized=True)

    def _granted(self, person: Person, token: int, *, seized: bool) -> None:
        self.counts["authority broken" if seized else "authority taken"] += 1
        self._tokens[person.name] = token
        if person is not VIEWER:
            self._duty = person
        self._observer.granted(person, token, self._clock.monotonic(), seized=seized)

    def _change(self, plant: PlantController) -> None:
        """Put another operator on duty.

        The new operator seizes the authority, or takes it after its release.
        """
        other = OPERATOR if self._duty is ENGINEER else ENGINEER
        if self._chance.random() < 0.5:
            with contextlib.suppress(RefusedError):
                plant.release_authority(self._duty, self._tokens.get(self._duty.name, 0))
                self._observer.released(self._duty, self._clock.monotonic())
        self.seize(plant, self._chance.choice([other, other, VIEWER]))

    # -- actions ---------------------------------------------------------------------------

    async def work(self) -> None:
        """Issue commands until cancelled."""
        while True:
            await asyncio.sleep(self._chance.expovariate(1 / self._habits.pause))
            plant = self.plant
            if plant is None or self.away or self.waits:
                continue
            if self._clock.monotonic() < self._rest_until:
                continue
            self.clear(plant)
            does = self._chance.choices(
                [
                    self.onward,
                    self._everybody,
                    self._parameters,
                    self._emergency,
                    self._one_safe,
                    self._lock,
                    self._unauthorised,
                    self._change,
                    self._into_keep_out,
                ],
                self._habits.weights,
            )[0]
            if self.maintenance is not None and self._others.random() < self._habits.locks:
                does = self.maintenance.acts
            if self._chance.random() < self._habits.calibrates:
                does = self._calibrate
            does(plant)
            if self._chance.random() < 0.06:
                await self._rogue()

    def give(
        self,
        plant: PlantController,
        what: str,
        heliostats: Sequence[str] = (),
        person: Person | None = None,
        token: int | None = None,
        values: tuple[float, ...] | None = None,
    ) -> Ticket | None:
        """Issue a command and report it to the observer if accepted; otherwise return None."""
        who = person or self._duty
        mine = self._tokens.get(who.name, 0) if token is None else token
        names = heliostats or self._names
        self.counts["commands"] += 1
        try:
            if what in ("AIM", "STANDBY"):
                about, size = (RECEIVER, 1.0) if what == "AIM" else (STANDBY, 0.5)
                points = self._points(names, about, size)
                ticket = (plant.aim if what == "AIM" else plant.standby)(who, mine, points)
                self.points.update({(what, name): point for name, point in points.items()})
            else:
                numbers = self._values(what) if values is None else values
                ticket = plant.command(who, mine, what, heliostats, numbers)
        except RefusedError as error:
            self._refused(error, who, mine, what, heliostats)
            return None
        return self._accepted(who, mine, ticket, what)

    def _refused(
        self, error: RefusedError, who: Person, token: int, what: str, heliostats: Sequence[str]
    ) -> None:
        self.counts["refused"] += 1
        self.refusal = str(error)
        now = self._clock.monotonic()
        for each in self.panel.each:
            each.on_refused(who, token, (what, heliostats), self.refusal, now)

    def _accepted(self, who: Person, token: int, ticket: Ticket, what: str) -> Ticket:
        self.counts["accepted"] += 1
        self.accepted(who, token, ticket, what)
        return ticket

    def accepted(self, who: Person, token: int, ticket: Ticket, what: str) -> None:
        """Report a command that the plant has accepted."""
        for each in self.panel.each:
            each.on_accepted(who, token, ticket, what, self._clock.monotonic())

    def _into_keep_out(self, plant: PlantController) -> None:
        """Request a motion through the keep-out volume, which the plant must refuse."""
        name, mine = self._chance.choice(self._names), self._tokens.get(self._duty.name, 0)
        point = self._points((name,), self._keep_out, 0.5)
        what = self._chance.choice(["AIM", "STANDBY", "SEARCH"])
        self.counts["commands"] += 1
        try:
            if what == "AIM":
                ticket = plant.aim(self._duty, mine, point)
            elif what == "STANDBY":
                ticket = plant.standby(self._duty, mine, point)
            else:
                ticket = plant.command(self._duty, mine, what, (name,), (0.05, 0.5))
        except RefusedError:
            self.counts["refused"] += 1
            return
        self._accepted(self._duty, mine, ticket, what)

    def _points(
        self, names: Sequence[str], about: tuple[float, float, float], size: float
    ) -> dict[str, tuple[float, ...]]:
        point = tuple(x + self._chance.uniform(-size, size) for x in about)
        return dict.fromkeys(names, point)

    def _values(self, name: str) -> tuple[float, ...]:
        chance = self._chance
        if name == "SEARCH":
            return 2e-3, chance.choice([4e-3, 8e-3])
        if name == "JOG":
            return float(chance.randrange(2)), float(chance.choice([-100, 100]))
        if name == "ROUGH":
            return (float(chance.randrange(2)),)
        return ()

    def onward(self, plant: PlantController) -> None:
        """Advance one heliostat to the next state."""
        name = self._chance.choice(self._names)
        state = plant.field.of(name, plant.now()).state
        what = self._chance.choice(ONWARDS.get(state, ("APPROACH",)))
        if what == "APPROACH":
            self.give(plant, "AIM", (name,))
        self.give(plant, what, (name,))

    def _everybody(self, plant: PlantController) -> None:
        for what in self._chance.choice(
            [
                ("AIM",),
                ("APPROACH",),
                ("TRACK",),
                ("TRACK",),
                ("IDLE",),
                ("REFOCUS",),
                ("STANDBY",),
                ("AIM", "APPROACH"),
                ("DIAGNOSE",),
            ]
        ):
            if what != "IDLE" or self._habits.idle:
                self.give(plant, what)

    def _lock(self, plant: PlantController) -> None:
        self.give(plant, "LOCK", (self._chance.choice(self._names),))

    def _unauthorised(self, plant: PlantController) -> None:
        """Issue a command without authority: with an old or a foreign token, or as a viewer."""
        what = self._chance.choice(["TRACK", "APPROACH", "AIM", "REFOCUS", "STANDBY"])
        name = self._chance.choice(self._names)
        other = OPERATOR if self._duty is ENGINEER else ENGINEER
        who = self._chance.choice([other, other, VIEWER])
        token = self._chance.choice(
            [self._tokens.get(other.name, 0), self._tokens.get(self._duty.name, 0), 0, 1]
        )
        self.give(plant, what, (name,), who, token)

    def _parameters(self, plant: PlantController) -> None:
        """Push two calibration items to one heliostat, mostly to one whose beam is safe."""
        self.counts["parameters"] += 1
        chance = self._chance
        items = {
            "biases": struct.pack("<ff", chance.gauss(0.0, 1e-4), chance.gauss(0.0, 1e-4)),
            "defocus": struct.pack("<ff", chance.uniform(0.08, 0.12), chance.uniform(0.05, 0.06)),
        }
        self.push(plant, self._safe(plant), items)

    def _safe(self, plant: PlantController) -> str:
        """Return a heliostat to which parameters may be written, in most cases."""
        safe = np.flatnonzero(plant.field.among(TAKES_POSE, plant.now()))
        names = [plant.field.names[row] for row in safe]
        return self._chance.choice(names if names and self._chance.random() < 0.8 else self._names)

    def push(
        self, plant: PlantController, name: str, items: dict[str, bytes], confirmed: str = ""
    ) -> Ticket | None:
        """Push parameters to one heliostat; see `give`."""
        who, token = self._duty, self._tokens.get(self._duty.name, 0)
        try:
            ticket = plant.parameters(who, token, name, items, confirmed)
        except RefusedError as error:
            self._refused(error, who, token, "PARAMETERS", (name,))
            return None
        return self._accepted(who, token, ticket, "PARAMETERS")

    def zero(self, plant: PlantController, name: str, counts: Sequence[int]) -> Ticket | None:
        """Declare the step counts of one heliostat; see `give`."""
        who, token = self._duty, self._tokens.get(self._duty.name, 0)
        try:
            ticket = plant.commands.zero(who, token, name, counts)
        except RefusedError as error:
            self._refused(error, who, token, "ZERO", (name,))
            return None
        return self._accepted(who, token, ticket, "ZERO")

    def _calibrate(self, plant: PlantController) -> None:
        """Change parameters of one heliostat: correctly, slightly wrongly, or grossly."""
        chance, name = self._chance, self._safe(plant)
        fit = self._fits[name]
        slight = {k: v + chance.gauss(0.0, 3e-4) for k, v in fit.causes.items()}
        near = fit.with_causes(slight)
        what = chance.choice(["right", "slight", "belief", "belief", "another", "much", "machine"])
        self.counts[f"calibration {what}"] += 1
        if what == "belief":
            plant.want(name, chance.choice([fit.mechanism, near]))
        elif what == "machine":
            low, high = (chance.randrange(-2000, 2000) for _ in range(2))
            stow = packed("stow", (MACHINE.stow[0] + low, MACHINE.stow[1] + high))
            self.push(plant, name, chance.choice([{"stow": stow}, narrow_limits()]))
        elif what in ("another", "much"):
            causes = {k: v + chance.choice([-1.0, 1.0]) * 0.02 for k, v in fit.causes.items()}
            other = self._fits[chance.choice([n for n in self._names if n != name] or [name])]
            source = other.mechanism if what == "another" else fit.with_causes(causes)
            if other is not fit or what == "much":
                self.push(plant, name, {"armature": items_of(source)["armature"]})
        else:
            items = items_of(fit.mechanism if what == "right" else near)
            some = {k: items[k] for k in ("armature", "biases")}
            self.push(plant, name, some, chance.choice(["", "measured twice"]))

    # -- safety ----------------------------------------------------------------------------

    def _emergency(self, plant: PlantController) -> None:
        act = self._chance.choice([Act.DEFOCUS, Act.STOW])
        # Wait until the order is done or overdue.
        pause = self._chance.choice([2.0, 33.0, 33.0, 310.0])
        self._rest_until = self._clock.monotonic() + pause
        who = self._chance.choice([VIEWER, self._duty])
        if not plant.sentinel.pause(who.name):
            self.raises(plant, who, act)
        if self._others.random() < _SECOND:  # another operator has a separate reason
            others = [person for person in (OPERATOR, ENGINEER, VIEWER) if person is not who]
            act = self._others.choice([Act.DEFOCUS, Act.STOW])
            if not plant.sentinel.pause((other := self._others.choice(others)).name):
                self.raises(plant, other, act)

    def raises(self, plant: PlantController, who: Person, act: Act) -> EmergencyOrder:
        """Call an emergency, which anyone may do."""
        self.raised(who, act)  # the plant raises its alarm before it replies
        return plant.raise_emergency(who.name, act)

    def raised(self, who: Person, act: Act) -> None:
        """Record an emergency that an operator has called.

        An order that adds nothing to the person's own order merges with it and gets no record.
        """
        self.counts["emergencies"] += 1
        now, before = self._clock.monotonic(), self._persons.orders.get(who.name)
        if before is None or act > before[0]:
            self._observer.obeyed(who.name, act.name, now)
        for each in self.panel.each:
            each.on_call(who.name, act, now)

    def _one_safe(self, plant: PlantController) -> None:
        what = self._chance.choice(["DEFOCUS", "STOW"])
        self.safe(plant, what, self._chance.choice(self._names))

    def safe(self, plant: PlantController, what: str, name: str) -> Ticket:
        """Defocus or stow one heliostat, which anyone may do."""
        ticket = (plant.defocus if what == "DEFOCUS" else plant.stow)(VIEWER.name, (name,))
        self.took_off(ticket, what)
        return ticket

    def took_off(self, ticket: Ticket, what: str) -> None:
        """Report a DEFOCUS or STOW that the viewer has ordered."""
        for each in self.panel.each:
            each.on_safe(VIEWER, ticket, what, self._clock.monotonic())

    def clear(self, plant: PlantController) -> set[str]:
        """Withdraw an emergency order, acknowledge latched conditions, and return what is accepted.

        The order of another operator remains until the next call.
        """
        if self.maintenance is not None:
            self.maintenance.confirms(plant)
        if self._persons.orders:
            self.withdraws(plant, next(iter(self._persons.orders)))
        return self._acknowledge(plant)

    def withdraws(self, plant: PlantController, owner: str) -> None:
        """Withdraw an operator's order as that operator, or as an engineer for a viewer."""
        who = OPERATOR if owner == OPERATOR.name else ENGINEER
        now = self._clock.monotonic()
        try:
            plant.withdraw_emergency(who, owner)
        except RefusedError as error:
            self._persons.withdrawal_refused(owner, str(error), now)
        self._observer.obeyed(who.name, "WITHDRAW", now)
        self._persons.withdrew(owner)

    def _acknowledge(self, plant: PlantController) -> set[str]:
        """Acknowledge every latched condition; return the conditions that the plant accepts.

        The engineer acts for the supervisor.
        """
        taken: set[str] = set()
        waiting: dict[tuple[str, str], bool] = {}
        for alarm in plant.alarms:
            doubtful = alarm.condition == alarms.COUNTS_DOUBTFUL.name
            if alarm.condition in LATCHING or (doubtful and self._stands_right(alarm.subject)):
                waiting[alarm.condition, alarm.subject] = alarm.active
        for (condition, subject), active in waiting.items():
            if active:
                with contextlib.suppress(RefusedError):
                    plant.acknowledge(ENGINEER, condition, subject)
                    now = self._clock.monotonic()
                    self._observer.obeyed(ENGINEER.name, "ACKNOWLEDGE", now)
                    self.counts["acknowledgements"] += 1
                    taken.add(condition)
        return taken

    def _stands_right(self, name: str) -> bool:
        """Inspect a heliostat whose step counts are in doubt.

        If an operator confirmed the counts without looking, the beam could miss its point, which no
        software can detect. The operator would then violate invariant 12, so these operators do
        look.
        """
        boards = (board for pod in self._pods for board in pod.boards)
        board = next(board for board in boards if board.outfit.name == name)
        return max(abs(steps) for steps in board.slip) < _SEEN_WRONG

    # -- the rogue -------------------------------------------------------------------------

    async def _rogue(self) -> None:
        """Send commands that bypass the plant, with an invalid or a guessed token."""
        now = self._clock.monotonic()
        void = [token for token, at in self._observer.old.items() if now - at > VOID_WITHIN]
        token = self._chance.choice([0, self._chance.getrandbits(32), *void[-2:], *void[-2:]])
        pod = self._chance.choice(self._pods)
        tap = pod.tap
        if tap is None or (self._observer.known(token) and token not in void):
            return
        self._number += 1
        self.counts["rogue"] += 1
        whom = (self._chance.choice(pod.boards).outfit.name,)
        what = self._chance.choice(["TRACK", "APPROACH", "REFOCUS", "IDLE"])
        command = Command(f"rogue-{self._number}", what, (), whom, token, 5.0)
        ear = PlantEar(pod, self.panel)
        pod.observer.ordered(ear.order(command, now, known=False))
        with contextlib.suppress(LinkClosedError):
            await tap.inner.send(encode(command), expires=now + 5.0)
