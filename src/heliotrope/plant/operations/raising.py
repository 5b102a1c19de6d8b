"""Raising the field: wanted heliostats go from stow to standby and to the receiver."""

import functools
import math
from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray
from heliotrope.lcu import names as meanings
from heliotrope.lcu import states
from heliotrope.plant import refusals
from heliotrope.plant.attempts import Attempts, RetryLaw
from heliotrope.plant.controller import PlantController
from heliotrope.plant.motion.proofs import BeamError
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.orders.authority import Person
from heliotrope.plant.orders.guards import Asked
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.safety import alarms

#: Time before a heliostat is retried if its beam has no free path, and if it was refused for
#: another reason, s.
_BLOCKED, _REFUSED = 300.0, 5.0
#: Time after which a heliostat that can only proceed from stow is sent to stow, s.
_HALTED = 10.0
#: Heliostats that were lost, or could not proceed from where they were, after being raised.
RAISING = RetryLaw(
    "raising",
    5,
    0.0,
    "an operator must find the cause and then press Automatic; otherwise it is raised once the "
    "next day",
    rest=16.0 * 3600.0,
    memory=1800.0,
    alarm=alarms.RAISING_GIVEN_UP,
)
#: Number of heliostats per step for which the guards of a command are evaluated.
ASKED = 1000
#: What holds heliostats at standby.
_UNCALIBRATED = (
    "it is not calibrated, and its beam could hit a target on the way to the receiver, so a visit "
    "to a target comes first"
)
_NO_AIM = "the flux limit leaves no aim on the receiver for it"
#: The next command of a heliostat on its way to the receiver, by its state.
_NEXT = {states.STOWED: "APPROACH", states.DEFOCUSED: "IDLE", states.IDLE: "TRACK"}

Rows = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]


class Raising:
    """Raises wanted heliostats to the receiver, a few at a time.

    An uncalibrated beam goes to the receiver only if it would miss every target by a wide margin.

    Parameters
    ----------
    plant, log
        The controller, and the logbook for blocked beams.
    person
        The person under whose name it commands.
    most
        Number of heliostats that leave stow, or go to the receiver, at a time.
    patience
        Time before the same command is repeated, s.
    clearance
        Tracking error with which an uncalibrated beam must still miss all targets, rad.
    wanted
        Whether all heliostats are wanted from the start.

    Attributes
    ----------
    aims
        Aims on the receiver, ENU, m, (3,), by name; a heliostat without an aim stays at standby.
        Under a flux limit, `Aiming` chooses the aims.
    wanted
        Which heliostats automatic control may move, (N,).
    left
        Heliostats that an emergency removed from automatic control, (N,): they wait for an
        operator's Resume.
    attempts
        Failed attempts to raise heliostats.
    """

    def __init__(
        self,
        plant: PlantController,
        log: Logbook,
        person: Person,
        *,
        most: int,
        patience: float,
        clearance: float,
        wanted: bool,
    ) -> None:
        self._plant, self._log, self._person = plant, log, person
        self._most, self._patience = most, patience
        self._names, count = plant.field.names, len(plant.field)
        self.wanted: Mask = np.full(count, wanted, dtype=np.bool_)
        self.left: Mask = np.zeros(count, dtype=np.bool_)
        self._by_people: Mask = np.zeros(count, dtype=np.bool_)
        self._busy_until = np.full(count, -math.inf)
        self._told_in = np.full(count, -1, dtype=np.int16)
        self._halted_at = np.full(count, math.inf)
        #: The row at which checks start for each command.
        self._next: dict[str, int] = {}
        #: Why beams have no free path, by heliostat.
        self._blocked: dict[str, str] = {}
        self.attempts = Attempts(RAISING, log.take_alarm)
        self._joins: list[Ticket] = []  # tickets whose heliostats partly still wait for their turn
        limited = plant.design.aims.limit is not None
        designed = plant.default_aims() if plant.design.receivers else {}
        self.aims: dict[str, FloatArray] = {} if limited else dict(designed)
        #: Middle, ENU, m, and radius of each target, m.
        self._targets = [
            (np.mean(each.corners, axis=0), 0.5 * math.hypot(each.width, each.height))
            for each in plant.design.targets
        ]
        # Under a flux limit an aim may be anywhere on the receiver.
        reach = plant.design.receivers[0] if limited else None
        room = 0.0 if reach is None else math.hypot(reach.width, reach.height)
        self._clear = self._clear_of_targets(clearance, designed, room)

    def want(self, heliostats: Sequence[str], *, wanted: bool, by_person: bool = False) -> None:
        """Put heliostats under automatic control, or remove them.

        With ``by_person``, an operator raises them; if they are lost afterwards, automatic control
        does not raise them again.
        """
        rows = [self._plant.field.place(name) for name in heliostats]
        self._by_people[rows] = by_person & (self._by_people[rows] | ~self.wanted[rows])
        self.wanted[rows], self.left[rows] = wanted, False
        self._busy_until[rows] = -math.inf
        for name in heliostats:
            self.attempts.done(name)

    def lose(self, lost: Mask) -> None:
        """Stop controlling those of the lost heliostats (N,) that operators had raised."""
        self.wanted &= ~(lost & self._by_people)
        self._failed(np.flatnonzero(lost & self.wanted), "left the receiver without an order")

    def _failed(self, rows: Rows, reason: str) -> None:
        for row in rows:
            self.attempts.failed(self._plant.field.names[row], reason, self._plant.now())

    def given_up(self) -> Mask:
        """Return a mask of the heliostats not raised for now after too many failures, (N,)."""
        resting = np.zeros(len(self._plant.field), dtype=np.bool_)
        waiting = self.attempts.waiting(self._plant.now())
        resting[[self._plant.field.place(name) for name in waiting]] = True
        return resting

    def why_not(self, heliostat: str) -> str | None:
        """Return the reason why a heliostat is neither raised nor next in turn, or None."""
        if why := self._plant.drive_checks.stalled.get(heliostat):
            return f"{why}: see the alarm {alarms.DRIVE_STALLED.name}"
        if heliostat in self._blocked:
            return f"there is no free path for its beam: {self._blocked[heliostat]}"
        if not self.attempts.due(heliostat, self._plant.now()):
            return f"too many attempts to raise it failed: {alarms.RAISING_GIVEN_UP.name}"
        return None

    def waits(self, heliostats: Sequence[str]) -> dict[str, str]:
        """Return what wanted heliostats wait for, apart from their turn."""
        plant = self._plant
        found = plant.guards.reasons(Asked("APPROACH", tuple(heliostats)), refusals.NOT_NOW)
        asked = np.zeros(len(plant.field), dtype=np.bool_)
        asked[[plant.field.place(name) for name in heliostats]] = True
        for state, command in _NEXT.items():
            there = asked & plant.field.among((state,), plant.now())
            if command == "TRACK":
                there &= self.able()
                at_standby = [self._names[row] for row in np.flatnonzero(there)]
                if plant.design.aims.limit is not None:
                    found |= {name: _NO_AIM for name in at_standby if name not in self.aims}
                found |= dict.fromkeys(self.uncalibrated(at_standby), _UNCALIBRATED)
                there &= self._known() & self._aimed()
            found |= plant.guards.reasons(self._asked(command, np.flatnonzero(there)))
        return found

    def uncalibrated(self, heliostats: Sequence[str]) -> tuple[str, ...]:
        """Return the heliostats that must be calibrated before they may go to the receiver."""
        known, place = self._known(), self._plant.field.place
        return tuple(name for name in heliostats if not known[place(name)])

    def joinable(self) -> Mask:
        """Return a mask of the heliostats that may go to the receiver when they have an aim, (N,).

        They are known well enough, and their beams have a free path.
        """
        free = [name not in self._blocked for name in self._names]
        return np.asarray(self._known() & free)

    def _known(self) -> Mask:
        """Return a mask of the heliostats whose beams are known well enough for the receiver, (N,).

        They are calibrated, or their beams would miss all targets by a wide margin.
        """
        calibrated = [self._plant.beliefs.record(name) is not None for name in self._names]
        return np.asarray(self._clear | np.array(calibrated, dtype=np.bool_))

    def _aimed(self) -> Mask:
        """Return a mask of the heliostats that have an aim, (N,)."""
        return np.array([name in self.aims for name in self._names], dtype=np.bool_)

    def _asked(self, command: str, rows: Rows) -> Asked:
        """Return a command to heliostats (K,) in the form that guards check.

        Whether the paths are free is checked only when the command is issued.
        """
        names = tuple(self._names[row] for row in rows)
        aims = [self.aims[name] for name in names] if command == "TRACK" else []
        return Asked(command, names, np.stack(aims) if aims else None)

    def _first(self, command: str, rows: Rows) -> Rows:
        """Return the first heliostats, as indices (K,), that may be sent a command.

        At most `ASKED` heliostats are checked; if all of them are blocked, the next step continues
        with the heliostats after them.
        """
        asked = np.roll(rows, -int(np.searchsorted(rows, self._next.get(command, 0))))[:ASKED]
        blocked = self._plant.guards.reasons(self._asked(command, asked))
        free = [row for row in asked if self._names[row] not in blocked]
        self._next[command] = int(asked[-1]) + 1 if len(asked) and not free else 0
        return np.array(free[: self._most], dtype=np.intp)

    def give_up(self) -> None:
        """Remove all heliostats from automatic control, until an operator resumes."""
        self.left |= self.wanted
        self.wanted[:] = False

    def resume(self) -> int:
        """Take back the heliostats that an emergency has removed; return their number."""
        names = [self._names[row] for row in np.flatnonzero(self.left)]
        self.want(names, wanted=True)
        return len(names)

    def release(self, heliostat: str) -> None:
        """Allow a new command to a heliostat at once, because its visit to a target has ended."""
        self._busy_until[self._plant.field.place(heliostat)] = -math.inf

    def _clear_of_targets(
        self, clearance: float, aims: Mapping[str, FloatArray], about: float
    ) -> Mask:
        """Return a mask of the uncalibrated beams that would miss all targets at the aims, (N,).

        ``about`` is how far from these aims the beams may be sent, m.
        """
        plant = self._plant
        if not aims:
            return np.zeros(len(plant.field), dtype=np.bool_)
        points = np.stack([aims[name] for name in plant.field.names])
        slant = np.linalg.norm(points - plant.beams.armature.origin_1, axis=-1)
        room = np.full(len(points), math.inf)
        for middle, reach in self._targets:
            room = np.minimum(room, np.linalg.norm(points - middle, axis=-1) - reach - about)
        # The beam error is twice that of the normal, which is two-dimensional.
        return np.asarray(math.sqrt(2.0) * clearance * slant < room)

    def _on_targets(self, points: FloatArray) -> Mask:
        """Return a mask of points (N, 3) on a target where an operator has ended the visit."""
        on_target = np.zeros(len(points), dtype=np.bool_)
        for middle, reach in self._targets:
            on_target |= np.linalg.norm(points - middle, axis=-1) <= reach
        return on_target

    def stuck(self, visiting: Collection[str], resting: Mask) -> Rows:
        """Return the indices of wanted heliostats that can proceed only by way of stow.

        A heliostat refuses to track unless it has reached standby from stow since its last boot or
        stow. A heliostat that stores parameters other than the desired ones may not move, and
        parameters are written at stow. After a DEFOCUS, the path back to standby may be blocked.
        Heliostats are given some time to recover by themselves.
        """
        plant, now = self._plant, self._plant.now()
        field = plant.field
        halted = self.wanted & ~resting & field.among((states.IDLE, states.DEFOCUSED), now)
        shut_in = np.zeros(len(halted), dtype=np.bool_)
        shut_in[[field.place(name) for name in self._blocked]] = True
        halted &= ~self.able() | shut_in & field.among((states.DEFOCUSED,), now)
        halted[[field.place(name) for name in visiting]] = False
        self._halted_at = np.where(halted, np.minimum(self._halted_at, now), math.inf)
        overdue = now - self._halted_at >= _HALTED
        self._halted_at[overdue] = math.inf
        self._failed(np.flatnonzero(overdue), "could not continue from its position")
        return np.flatnonzero(overdue)

    def able(self) -> Mask:
        """Return a mask of the heliostats that report that they can track from standby, (N,)."""
        field = self._plant.field
        able: Mask = field.rows["flags"] & meanings.READY != 0
        able[[field.place(name) for name in self._plant.wanted.missing]] = False
        return able

    async def step(self, token: int, visiting: Callable[[], frozenset[str]], resting: Mask) -> None:
        """Issue the commands that may be issued now.

        Parameters
        ----------
        token
            Token of the command authority.
        visiting
            Returns the heliostats in calibration visits now.
        resting
            Heliostats that are left where they are, (N,).
        """
        plant, now = self._plant, self._plant.now()
        self._look_at_blocked()
        busy = (self._busy_until >= now) & (self._told_in == plant.field.rows["state"])
        free = self.wanted & ~busy & ~resting
        free[[plant.field.place(name) for name in visiting()]] = False
        # A heliostat that may not move now, as in a cluster with a wrong clock, does not delay
        # others.
        unknown = plant.standby_unknown & plant.field.among((states.STOWED,), now)
        if len(rows := self._first("STANDBY", np.flatnonzero(free & unknown))):
            await self._rest_again(rows, token)
        free &= ~unknown
        strayed = (states.TRACKING, "IDLE", self._on_targets(plant.aims))
        here = np.ones(len(free), dtype=np.bool_)
        for state, name, where in (
            (states.STOWED, "APPROACH", here), (states.DEFOCUSED, "IDLE", self.able()), strayed
        ):  # fmt: skip
            rows = np.flatnonzero(free & where & plant.field.among((state,), now))
            if len(rows := self._first(name, rows)):
                give = functools.partial(plant.command, self._person, token, name)
                self._give(rows, state, give)
        able = free & self._known() & self._aimed() & plant.field.among((states.IDLE,), now)
        rows = self._first("TRACK", np.flatnonzero(able))
        if len(rows) and plant.waiting < self._most:
            await self._join(rows, token, visiting)

    async def _rest_again(self, rows: Rows, token: int) -> None:
        """Send standby points to heliostats at stow whose stored standby points are unknown."""
        plant = self._plant
        points = {plant.field.names[row]: plant.standbys[row].copy() for row in rows}
        given = self._give(
            rows,
            states.STOWED,
            lambda names: plant.standby(self._person, token, {n: points[n] for n in names}),
        )
        if given is not None:
            names, ticket = given
            await ticket.end(10.0)
            for name in names:
                self.release(name)

    async def _join(self, rows: Rows, token: int, visiting: Callable[[], frozenset[str]]) -> None:
        """Assign heliostats their aims on the receiver, and send them there."""
        plant, aims = self._plant, dict(self.aims)
        given = self._give(
            rows,
            states.IDLE,
            lambda names: plant.aim(self._person, token, {n: aims[n] for n in names}),
        )
        if given is None:
            return
        names, ticket = given
        await ticket.end(10.0)
        # By now a calibration visit may have begun, whose aim must stay, or an operator may have
        # stowed a heliostat.
        away, place = visiting() | ticket.refusals.keys(), plant.field.place
        done = tuple(
            name
            for name in names
            if name not in away and self.wanted[place(name)] and self.aims.get(name) is aims[name]
        )
        if done:
            self._joins.append(plant.command(self._person, token, "TRACK", done))

    def _give(
        self, rows: Rows, state: int, give: Callable[[tuple[str, ...]], Ticket]
    ) -> tuple[tuple[str, ...], Ticket] | None:
        """Issue a command to the heliostats whose beams have a clear path; the rest wait."""
        names = tuple(self._plant.field.names[row] for row in rows)
        while names:
            try:
                ticket = give(names)
            except BeamError as error:
                wrong = error.refusals
            else:
                told = [self._plant.field.place(name) for name in names]
                # They receive no further command until their state changes or the patience has
                # elapsed.
                self._busy_until[told] = self._plant.now() + self._patience
                self._told_in[told] = state
                self._block(ticket.blocked, state)
                return names, ticket
            self._block(wrong, state)
            names = tuple(name for name in names if name not in wrong)
        return None

    def _block(self, wrong: Mapping[str, str], state: int) -> None:
        """Postpone heliostats without a free path; retry other refused heliostats soon."""
        for name, text in wrong.items():
            row, blocked = self._plant.field.place(name), isinstance(text, refusals.NoFreePath)
            self._busy_until[row] = self._plant.now() + (_BLOCKED if blocked else _REFUSED)
            self._told_in[row] = state
            if blocked:
                self._blocked[name] = text
                self._log.take_alarm(alarms.BEAM_BLOCKED.raised(name, reason=text))

    def _look_at_blocked(self) -> None:
        """Raise alarms about beams that were blocked in their turn; clear obsolete alarms."""
        for ticket in [ticket for ticket in self._joins if ticket.finished]:
            self._joins.remove(ticket)
            self._block(ticket.blocked, states.IDLE)
        for name in sorted(self._blocked):
            row = self._plant.field.place(name)
            if self._plant.field.rows["state"][row] != self._told_in[row]:
                del self._blocked[name]
                self._log.take_alarm(alarms.BEAM_BLOCKED.ended(name))
