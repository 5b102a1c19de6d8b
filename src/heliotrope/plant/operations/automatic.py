"""Automatic control: raises the field, calibrates it target by target, and stows it before night.

It commands under its own name. It takes the command authority while nobody else holds it, and
yields at once: it starts nothing new, and visits in progress are completed. It moves only *wanted*
heliostats. A heliostat that an operator stows, defocuses or locks is not wanted until an operator
gives it back; after an emergency, no heliostat is wanted. After the loss of a large number of
heliostats it waits for an operator (`losses`).
"""

import asyncio
import math
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.links.clock import sleep_until
from heliotrope.links.messages import Stage
from heliotrope.plant import refusals
from heliotrope.plant.attempts import Attempts, Retry, RetryLaw
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.calibrating import Calibrating, TrueErrors, Visits
from heliotrope.plant.operations.calibration_book import RESULTS, CalibrationBook
from heliotrope.plant.operations.errands import Step
from heliotrope.plant.operations.flights import FlightIntake
from heliotrope.plant.operations.foresight import POINT_EVERY, Foresight
from heliotrope.plant.operations.keeping import Keeping
from heliotrope.plant.operations.learning import Learner, Learning
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.operations.losses import Losses
from heliotrope.plant.operations.movement_checks import MovementChecks
from heliotrope.plant.operations.raising import Raising
from heliotrope.plant.operations.service import Service
from heliotrope.plant.operations.timetable import Timetable
from heliotrope.plant.operations.views import CalibrationView, Running
from heliotrope.plant.orders.authority import Person, RefusedError, Role
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.plant.visits.settings import CycleSettings
from heliotrope.safety import alarms
from heliotrope.store.records import Kind, PlannedVisit, Records

#: The person under whose name it commands.
AUTOMATIC = Person("automatic control", Role.ENGINEER)
#: What an operator should do about states from which automatic control raises no heliostat.
_REMEDIES = {
    states.LOCKED: "unlock it",
    states.FAULT: "find the cause, then clear the fault",
    states.UNCONFIGURED: "store its parameters",
}
#: What a heliostat under automatic control is doing, in the states in which it follows.
_DOING = {
    states.APPROACHING: "on its way to standby",
    states.IDLE: "at standby",
    states.TRACKING: "tracking its aim",
}
#: What a heliostat that waits for its turn will do next, in the other states.
_NEXT = {
    states.STOWED: "to leave stow",
    states.STOWING: "to leave stow, and is still on its way there",
    states.DEFOCUSED: "to return to standby",
    states.IDLE: "to be raised again, because it can only track after an approach from stow",
}
#: Parts of the work that failed; each failure raises an alarm, and the part is soon retried.
PARTS = RetryLaw(
    "part of automatic control",
    1,
    5.0,
    "automatic control repeats it; command by hand what it does not do",
    rest=5.0,
    alarm=alarms.WORK,
)
#: Why nothing is moved before automatic control has taken the command authority.
_STARTING = "it is starting"
#: Outcomes after which a requested calibration visit need not be repeated.
_AS_WANTED = (
    CalibrationOutcome.CALIBRATED,
    CalibrationOutcome.UNCHANGED,
    CalibrationOutcome.NO_BETTER,
)
#: Time within which a heliostat under automatic control must follow, s; and within which it must
#: report.
_FOLLOWS, _HEARD = 120.0, 15.0
#: Time within which an emergency must have ended after an operator's Resume has acknowledged it, s.
_ENDED = 5.0
#: Interval between checks of the sun's elevation, s; a heliostat that is locked for its parameters
#: at one check in the evening is stowed at the next.
_SUN_EVERY = 10.0
#: Wait after an operator has released the command authority before it is taken, s.
_COURTESY = 5.0
#: Interval between predictions of the field errors, s.
_LOOK_EVERY = 10.0


@dataclass(frozen=True)
class AutomaticSettings:
    """Settings of automatic control.

    Attributes
    ----------
    wanted
        Whether all heliostats are wanted from the start; otherwise only heliostats passed to
        `give_back`.
    calibrate
        Whether calibration is switched on at the start.
    beat
        Time between checks of the field, s.
    lowest
        Elevation of the sun below which the field is stowed, rad.
    patience
        Minimum time before the same command is repeated, s.
    margin
        Clearance of an uncalibrated beam from the targets, standard deviations.
    losses
        Number of heliostats that may be lost within 30 s; after a larger loss, automatic control
        waits for an operator's Resume.
    losses_share
        Fraction of the field that may be lost within 30 s, if that is fewer: in a small field the
        above number may be most of the field.
    foresee
        Time between predictions of the field errors for the rest of the day, s; 0: no predictions.
    events
        Age at which events, and alarms that are cleared and acknowledged, are removed, days.
    """

    wanted: bool = False
    calibrate: bool = True
    beat: float = 2.0
    lowest: float = math.radians(8.0)
    patience: float = 60.0
    margin: float = 3.0
    losses: int = 3
    losses_share: float = 0.5
    foresee: float = 0.0
    events: float = 400.0

    def __post_init__(self) -> None:
        if not (0.0 < self.beat <= 60.0 and self.margin >= 0.0):
            raise InputError(
                f"automatic control: a cycle of {self.beat:g} s, a margin of {self.margin:g}; the "
                "ranges are above 0 to 60 s, and 0 or more"
            )
        if self.losses < 0:
            raise InputError(f"automatic control: losses must be 0 or more, not {self.losses}")
        if not 0.0 <= self.losses_share <= 1.0:
            raise InputError(
                "automatic control: losses_share must be between 0 and 1, not "
                f"{self.losses_share:g}"
            )
        if not 0.0 <= self.foresee < math.inf:
            raise InputError(
                "automatic control: the interval of predictions must be 0 (none) or more, not "
                f"{self.foresee} s"
            )
        if not self.events > 0.0:
            raise InputError(
                f"automatic control: events must be kept for more than 0 days, not {self.events} "
                "days"
            )


class AutomaticControl:
    """Automatic control of a plant.

    Parameters
    ----------
    plant, logbook
        The controller, and the logbook of its alarms and events.
    visits
        The visits that it can perform; None: nothing is calibrated.
    records
        Store of everything that survives a restart; None: nothing is stored.
    truth
        Function that returns the true tracking errors, known only to a twin, rad, (N,); None: they
        are unknown.
    settings
        Its settings.
    learner
        Learns heliostat groups at night; None: nothing is learnt.

    Attributes
    ----------
    book
        The calibration book.
    truth
        True errors, known only to a twin.
    service
        Heliostats out of service.
    flights
        Imports drone flights.
    learning
        The nightly learning for each heliostat group.
    timetable
        Calibrations at times of day and at intervals.
    installed
        Expected tracking error of an uncalibrated heliostat according to the priors, rad.
    """

    def __init__(
        self,
        plant: PlantController,
        logbook: Logbook,
        visits: Visits | None = None,
        *,
        records: Records | None = None,
        truth: Callable[[], FloatArray] | None = None,
        settings: AutomaticSettings | None = None,
        learner: Learner | None = None,
    ) -> None:
        settings = settings or AutomaticSettings()
        self._plant, self._log, self._settings = plant, logbook, settings
        self._on, self._day, self._gave_way_at = settings.calibrate, True, -math.inf
        self._token, self._sun_at, self._resumed_at = 0, -math.inf, -math.inf
        self.truth = TrueErrors(plant, truth)
        cycle = CycleSettings() if visits is None else visits.cycle.settings
        self._keeping = Keeping(plant.field.names, plant.beliefs, records)
        if visits is not None:
            self._keeping.recall()
        self.book = CalibrationBook(plant, "malan8" if visits is None else cycle.first_model)
        self.installed = self.book.installed()
        self.service = Service(plant, self._keeping, logbook.take_alarm)
        self._parts = Attempts(PARTS, logbook.take_alarm)
        self._raising = Raising(
            plant,
            logbook,
            AUTOMATIC,
            most=max(2, round(plant.join_rate * settings.beat)),
            patience=settings.patience,
            clearance=settings.margin * self.installed,
            wanted=settings.wanted,
        )
        self._checks = MovementChecks(plant, AUTOMATIC, logbook.take_alarm)
        most = min(settings.losses, math.floor(settings.losses_share * len(plant.field)))
        self._losses = Losses(plant, logbook, most, records, self._wait)
        self.flights = FlightIntake(plant, logbook, self._keeping, cycle)
        self.learning = Learning(
            plant, logbook, self._keeping, cycle.first_model, learner, AUTOMATIC
        )
        self.timetable = Timetable(plant, logbook, self._keeping)
        self._calibrating: Calibrating | None = None
        self._foresight: Foresight | None = None
        if visits is not None:
            self._calibrating = Calibrating(
                plant,
                logbook,
                visits,
                self.book,
                self._keeping,
                self.truth,
                self.flights.first,
                self.timetable.ruled,
            )
            if settings.foresee > 0.0:
                self._foresight = Foresight(
                    plant, self._keeping, visits.scheduler, settings.foresee, visits.cycle.worker
                )
        self._stopped = False
        if visits is not None:
            self.book.recall(self._keeping.results(RESULTS))
            self.learning.recall()
            self.flights.recall()
            self.timetable.recall()
        if self._foresight is not None:
            self._foresight.recall()

    # -- people's requests -----------------------------------------------------------------

    def switch(self, on: bool) -> None:
        """Switch calibration on or off."""
        self._on = on

    def want(self, heliostats: Sequence[str], *, wanted: bool, by_person: bool = False) -> None:
        """Put heliostats under automatic control, or remove them; see `Raising.want`."""
        self._raising.want(heliostats, wanted=wanted, by_person=by_person)
        if not wanted:
            self._withdraw(
                heliostats or self._plant.field.names,
                "an operator has taken it out of automatic control",
            )

    def hold(
        self, person: Person, places: Sequence[tuple[Kind, str]], reason: str, hours: float
    ) -> tuple[str, ...]:
        """Lock objects for a person; return the heliostats sent to stow. See `Operations.hold`."""
        names = self.service.take(person, places, reason, hours)
        self._withdraw(names, f"{person.name} took it out of service")
        return names

    def drop(self, heliostats: Sequence[str], why: str) -> None:
        """Drop the operators' requests for heliostats."""
        self._withdraw(heliostats, why)

    def _withdraw(self, heliostats: Sequence[str], why: str) -> None:
        if self._calibrating is not None:
            self._calibrating.withdraw(heliostats, why)

    def calibrate(
        self,
        heliostat: str,
        target: str,
        *,
        search: bool,
        together: Sequence[str],
        receiver: bool,
    ) -> None:
        """Calibrate a heliostat before all others; see `Operations.calibrate`."""
        names = tuple(dict.fromkeys((heliostat, *together)))
        for name, reason in zip(names, self._locked(names), strict=True):
            if reason is None:
                continue
            each = {"what": "calibration of", "heliostat": name, "more": "", "reason": reason}
            raise refusals.OUT_OF_SERVICE.error(**each)
        if target:
            self._plant.design.target(target)
            if why := self.service.closed(target):
                why = f"target {target} is locked: {why}"
                raise refusals.NO_CALIBRATION.error(heliostat=heliostat, why=why)
        self._check_calibration(names)
        if self._calibrating is None:
            return
        if receiver:
            why = (
                ""
                if self._calibrating.receiver
                else ("the plant file does not name a camera for it")
            )
            why = (
                "a receiver visit neither searches for a beam nor uses a target"
                if search or target
                else why
            )
            if why:
                raise refusals.NO_CALIBRATION.error(heliostat=heliostat, why=why)
            self._calibrating.ask_together(names, self._calibrating.receiver)
        elif len(names) > 1:
            if not self._calibrating.joint:
                why = "the plant file does not allow joint visits; request one heliostat at a time"
                raise refusals.NO_CALIBRATION.error(heliostat=heliostat, why=why)
            self._calibrating.ask_together(names, target)
        else:
            self._calibrating.ask(heliostat, target, search=search)

    def _check_calibration(self, heliostats: Sequence[str]) -> None:
        """Refuse a calibration that cannot be made; accept it if it must only wait a little."""
        idle, wanted = self._why_not(), self._raising.wanted
        for name in heliostats:
            why = "" if idle == _STARTING else idle
            if not why and not wanted[self._plant.field.place(name)]:
                why = "it is not under automatic control"
            if why:
                raise refusals.NO_CALIBRATION.error(heliostat=name, why=why)

    def _locked(self, heliostats: Sequence[str]) -> list[str | None]:
        """Return in words the locks that keep heliostats from their aims; None if none do."""
        aims = self._plant.aims[[self._plant.field.place(name) for name in heliostats]]
        return self._plant.lockouts.reasons(heliostats, aims)

    # -- progress --------------------------------------------------------------------------

    @property
    def follows_within(self) -> float:
        """Time within which all heliostats under automatic control must follow, s."""
        return _FOLLOWS + len(self._plant.field) / self._plant.join_rate

    def following(self, since: float, heliostats: Sequence[str]) -> Mapping[str, Step]:
        """Return whether heliostats follow automatic control, or why not.

        Parameters
        ----------
        since
            When they were put under automatic control, monotonic s.
        heliostats
            Names.
        """
        idle, visiting = self._why_idle(), self._visiting()
        field, age = self._plant.field, self._plant.now() - since
        out = dict(zip(heliostats, self._locked(heliostats), strict=True))
        able, state = self._raising.able(), field.rows["state"]
        waits = self._raising.waits(heliostats)
        steps = {}
        for name in heliostats:
            if text := out[name]:
                steps[name] = Step(text, Stage.REFUSED)
            elif not self._raising.wanted[field.place(name)]:
                text = "it is no longer under automatic control"
                steps[name] = Step(text, Stage.REFUSED)
            elif idle == _STARTING:
                steps[name] = Step(idle)
            elif idle:
                text = f"it is under automatic control, which is idle: {idle}"
                steps[name] = Step(text, Stage.FAILED)
            elif name in visiting:
                steps[name] = Step("it is under automatic control and being calibrated", Stage.DONE)
            else:
                row = field.place(name)
                why, ready = waits.get(name, ""), bool(able[row])
                steps[name] = self._up_step(name, int(state[row]), age, why, able=ready)
        return steps

    def _up_step(self, name: str, state: int, age: float, waits: str, *, able: bool) -> Step:
        """Return the step of a heliostat that automatic control may move.

        ``waits`` is what the heliostat waits for, apart from its turn; empty if for nothing.
        """
        shown = self._plant.field.of(name, self._plant.now())
        if not shown.live:
            return Step(shown.condition, Stage.FAILED if age > _HEARD else None)
        if state in _REMEDIES:
            return Step(f"it is {shown.condition}: {_REMEDIES[state]}", Stage.FAILED)
        if why := self._raising.why_not(name):
            return Step(why, Stage.FAILED)
        if state == states.APPROACHING or (state in states.AVAILABLE and able):
            text = f"it is under automatic control, {_DOING[state]}"
            return Step(f"{text}; it is waiting: {waits}" if waits else text, Stage.DONE)
        turn = f"it is waiting its turn {_NEXT.get(state, 'to move')}"
        return Step(f"it is waiting: {waits}" if waits else turn)

    def calibrating(self, since: float, heliostats: Sequence[str]) -> Mapping[str, Step]:
        """Return the progress of calibrations that operators requested at a given time, POSIX s."""
        return {name: self._calibration_step(name, since) for name in heliostats}

    def wants(self, heliostat: str) -> bool:
        """Return whether a heliostat is under automatic control."""
        return bool(self._raising.wanted[self._plant.field.place(heliostat)])

    def needs_calibration(self, heliostat: str) -> bool:
        """Return whether a heliostat goes no further until it is calibrated."""
        return heliostat in self._raising.uncalibrated((heliostat,))

    def visit_of(self, heliostat: str) -> Running | None:
        """Return the visit of a heliostat that is in progress; None if there is none."""
        running = () if self._calibrating is None else self._calibrating.running.values()
        return next((one for one in running if heliostat in one.heliostats), None)

    def _calibration_step(self, name: str, since: float) -> Step:
        assert self._calibrating is not None
        run = self.visit_of(name)
        if name in self._calibrating.asked:
            return Step(f"it is waiting: {self._why_waiting(name, run is not None)}")
        if run is not None:
            return Step(f"at {run.target}: {run.stage}", Stage.ACKNOWLEDGED)
        found = self._calibrating.result(name, since)
        if isinstance(found, str):
            return Step(found, Stage.REFUSED)
        broken = (CalibrationOutcome.REFUSED, CalibrationOutcome.TAKEN_OUT)
        stages = dict.fromkeys(_AS_WANTED, Stage.DONE) | dict.fromkeys(broken, Stage.REFUSED)
        return Step(f"at {found.target}: {found.text}", stages.get(found.outcome, Stage.FAILED))

    def _why_waiting(self, name: str, visits: bool) -> str:
        """Return the reason why a requested calibration has not begun."""
        row = self._plant.field.place(name)
        if why := self._why_not():
            return why
        if visits:
            return "another visit of the same heliostat must end first"
        if not self._ready()[row]:
            return f"it is not ready: {self._plant.field.of(name, self._plant.now()).condition}"
        assert self._calibrating is not None
        busy = [f"{run.heliostat} ({run.stage})" for run in self._calibrating.running.values()]
        return f"it is next after {', '.join(busy)}" if busy else "it is next"

    def retries(self) -> tuple[Retry, ...]:
        """Return the tasks that are being retried or were given up, with the reasons."""
        now, visits = self._plant.now(), self._calibrating
        return (
            *(() if visits is None else visits.retries()),
            *self._raising.attempts.shown(now),
            *self._checks.attempts.shown(now),
            *self.service.attempts.shown(now),
            *self._parts.shown(now),
        )

    @property
    def waits(self) -> str:
        """Why automatic control waits for an operator's Resume; empty if it does not wait."""
        return self._losses.reason

    @property
    def to_resume(self) -> str:
        """What an operator's Resume would do; empty if nothing waits for a Resume."""
        left = 0 if self._plant.sentinel.on else int(self._raising.left.sum())
        after = f"The emergency is over: {left:,} heliostats wait until an operator presses Resume."
        return self.waits or (after if left else "")

    def left_by_emergency(self, heliostat: str) -> bool:
        """Return whether an emergency has removed a heliostat and no Resume has followed."""
        return bool(self._raising.left[self._plant.field.place(heliostat)])

    def resume(self) -> int:
        """Continue after a large loss of heliostats or an emergency; return how many come back."""
        self._losses.resume()
        if not self._plant.sentinel.on:
            return self._raising.resume()
        self._resumed_at = self._plant.now()  # an emergency that has been acknowledged ends soon
        return int((self._raising.left | self._raising.wanted).sum())

    def give_up(self, why: str) -> None:
        """Remove all heliostats from automatic control, until an operator resumes."""
        self._raising.give_up()
        self._resumed_at = -math.inf
        self._withdraw(self._plant.field.names, why)

    def stop(self) -> None:
        """Start nothing more; to be called before `run` is cancelled."""
        self._stopped = True
        self._end_visits("automatic control has been stopped")

    async def halt(self, limit: float = 5.0) -> None:
        """Stop all work, and wait for visits in progress to end, at most ``limit`` s."""
        self._on = False
        self._raising.give_up()
        self.give_way()
        self._end_visits("automatic control has been stopped")
        until = self._plant.now() + limit
        while self._visiting() and self._plant.now() < until:
            await self._sleep(0.5)

    def give_way(self) -> None:
        """Yield the command authority to an operator; visits in progress are completed."""
        self._gave_way_at = self._plant.now()
        if self._has_authority():
            self._plant.release_authority(AUTOMATIC, self._token)

    def _wait(self) -> None:
        """Begin to wait for an operator's Resume; visits in progress end, too."""
        self.give_way()
        self._end_visits("automatic control waits for Resume")

    def _end_visits(self, why: str) -> None:
        """Refuse all further commands of visits in progress; their beams are moved off."""
        self._plant.authority.end_mandates(AUTOMATIC, why)

    # -- aims ------------------------------------------------------------------------------

    @property
    def aims(self) -> dict[str, FloatArray]:
        """Aims on the receiver; see `Raising.aims`."""
        return self._raising.aims

    @property
    def idle(self) -> str:
        """Why nothing is moved now; empty if heliostats may be moved."""
        return self._why_idle() or ""

    @property
    def lowest(self) -> float:
        """Elevation of the sun below which the field is stowed, rad."""
        return self._settings.lowest

    def movable(self) -> npt.NDArray[np.bool_]:
        """Return a mask of the wanted heliostats that automatic control may move, (N,)."""
        return np.asarray(self._raising.wanted & ~self._left_alone())

    def joinable(self) -> npt.NDArray[np.bool_]:
        """Return a mask of the heliostats that can go to the receiver; see `Raising.joinable`."""
        return self._raising.joinable()

    @property
    def visiting(self) -> frozenset[str]:
        """The heliostats in visits."""
        return self._visiting()

    def move(self, points: Mapping[str, FloatArray]) -> Ticket:
        """Aim tracking heliostats at new points, ENU, m, (3,); see `PlantController.aim`."""
        return self._plant.aim(AUTOMATIC, self._token, points)

    def rest(self, heliostats: Sequence[str]) -> Ticket:
        """Send heliostats to standby; they stay wanted."""
        return self._plant.command(AUTOMATIC, self._token, "IDLE", heliostats)

    def turn_away(self, heliostats: Sequence[str]) -> Ticket:
        """Defocus heliostats; they stay wanted."""
        return self._plant.command(AUTOMATIC, self._token, "DEFOCUS", heliostats)

    # -- views -----------------------------------------------------------------------------

    def view(self) -> CalibrationView:
        """Return the progress of calibration."""
        reason = self._why_not()
        running = {} if self._calibrating is None else self._calibrating.running
        return CalibrationView(
            not reason,
            reason or "",
            self.book.calibrated,
            len(self._plant.field) - self.book.calibrated,
            self.book.failed,
            tuple(running.values()),
            tuple(list(self.book.results)[:-51:-1]),
            tuple(self.book.quality),
            () if self._calibrating is None else self._calibrating.asked,
            () if self._foresight is None else tuple(self._foresight.points),
            () if self._foresight is None else self._foresight.outlooks,
            "" if self._calibrating is None else self._calibrating.choice,
        )

    def plan(self, limit: int) -> tuple[PlannedVisit, ...]:
        """Return the planned visits."""
        return () if self._calibrating is None else self._calibrating.plan(self._ready(), limit)

    # -- running ---------------------------------------------------------------------------

    async def run(self) -> None:
        """Run until cancelled."""
        async with asyncio.TaskGroup() as group:
            for part in (self._govern, self._raise, self._diagnose, self._look, self._learn):
                name = part.__name__.strip("_")
                group.create_task(self._again(name, part, self._settings.beat))
            if self._calibrating is not None:
                due = self._due(self._calibrating)
                group.create_task(self._again("timetable", due, self._settings.beat))
                for target in self._plant.design.targets:
                    visits = self._visits(self._calibrating, target.name)
                    group.create_task(self._again(f"target {target.name}", visits, 1.0))
                if self._calibrating.receiver:
                    visits = self._on_receiver(self._calibrating)
                    group.create_task(self._again(self._calibrating.receiver, visits, _LOOK_EVERY))
            if self._foresight is not None:
                look = self._foresee(self._foresight)
                group.create_task(self._again("prediction", look, POINT_EVERY))

    async def _again(self, name: str, part: Callable[[], Awaitable[None]], pause: float) -> None:
        """Repeat a part of the work; a failure raises an alarm, but does not end the repetition."""
        refused = ""
        # A cancelled visit brings its beam home, and may then end with another error.
        while not self._stopped:
            try:
                await part()
                refused = ""
                self._parts.done(name)
            except RefusedError as error:
                if str(error) != refused:
                    self._log.event("calibration", AUTOMATIC.name, str(error))
                refused = str(error)
            except Exception as error:  # noqa: BLE001 - the work survives whatever fails in a part
                text = f"{type(error).__name__}: {error}"
                self._parts.failed(name, text, self._plant.now())
                await self._sleep(PARTS.rest)
            await self._sleep(pause)

    async def _sleep(self, seconds: float) -> None:
        await sleep_until(self._plant.clock, self._plant.now() + seconds)

    def _utc(self) -> float:
        return self._plant.clock.utc().timestamp()

    # -- authority and day -----------------------------------------------------------------

    def _has_authority(self) -> bool:
        grant = self._plant.authority.grant
        return grant is not None and grant.holder == AUTOMATIC and grant.token == self._token

    def _why_not(self) -> str | None:
        """Return the reason why nothing is calibrated now; None if calibration may run."""
        if self._calibrating is None:
            return "there is no camera"
        if not self._on:
            return "it is switched off"
        return self._why_idle()

    def _why_idle(self) -> str | None:
        """Return the reason why nothing is moved now; None if heliostats may be moved."""
        if self._plant.sentinel.on:
            return "an emergency is active"
        if self.waits:
            return "automatic control waits for Resume"
        if not self._day:
            return "the sun is too low"
        if not self._has_authority():
            grant = self._plant.authority.grant
            return f"{grant.holder.name} has the command authority" if grant else _STARTING
        if not self._raising.wanted.any():
            return (
                "no heliostat is under automatic control; select heliostats, then press Automatic"
            )
        return None

    async def _govern(self) -> None:
        """Hold the command authority while nobody else wants it.

        Automatic control gives it up in an emergency and at night.
        """
        plant, wanted = self._plant, self._raising.wanted
        if plant.sentinel.on:
            self._raising.give_up()
        grant, since = plant.authority.grant, plant.now() - self._gave_way_at
        if self._has_authority():
            plant.authority.keep(AUTOMATIC, self._token)
        elif grant is None and since > _COURTESY and (wanted.any() or self._on):
            self._token = plant.take_authority(AUTOMATIC).token
        self._night()

    def _night(self) -> None:
        """Stow the wanted heliostats before the sun is low, and later any found out of stow."""
        now = self._plant.now()
        if now - self._sun_at < _SUN_EVERY:
            return
        self._sun_at = now
        elevation = math.asin(float(np.clip(self._plant.sun_vector()[2], -1.0, 1.0)))
        lowest = self._settings.lowest
        if elevation < lowest:
            falls, self._day = self._day, False
            # A heliostat that did not report then, or was returned since, is stowed when it
            # reports, but not while an operator has the command authority.
            if falls or self._plant.authority.grant is None or self._has_authority():
                self._stow_up(told=falls)
            self._withdraw(
                self._plant.field.names, "the sun is too low; repeat the request tomorrow"
            )
        elif not self._day and elevation > lowest + math.radians(1.0):
            self._day = True
            self._log.event("plant", AUTOMATIC.name, "the sun is high enough")

    def _stow_up(self, *, told: bool) -> None:
        """Stow the wanted heliostats that are up; with ``told``, report this even if none is up."""
        up = self._plant.field.among(states.UP, self._plant.now()) & self._raising.wanted
        names = tuple(self._plant.field.names[row] for row in np.flatnonzero(up))
        if names:
            self._plant.stow(AUTOMATIC.name, names)
        if told or names:
            text = f"the sun is low, so {len(names)} heliostats go to stow"
            self._log.event("plant", AUTOMATIC.name, text, heliostats=names)

    # -- parts of the work -----------------------------------------------------------------

    async def _raise(self) -> None:
        self.service.park()
        if self._plant.sentinel.on:
            self._raising.give_up()
        elif self._plant.now() - self._resumed_at < _ENDED:
            self._raising.resume()
        self._raising.lose(self._losses.look(self._raising.wanted, self._checks.moved))
        if not self._why_idle():
            resting = self._left_alone() | self._checks.resting
            self._start_again(self._raising.stuck(self._visiting(), resting))
            await self._raising.step(self._token, self._visiting, resting)

    def _left_alone(self) -> npt.NDArray[np.bool_]:
        """Return a mask of the heliostats that automatic control does not move, (N,)."""
        return self._losses.settling() | self.service.rows() | self._raising.given_up()

    async def _diagnose(self) -> None:
        """Check every day, before heliostats are raised, that their drives move the mirrors."""
        if not self._why_idle():
            free = self._raising.wanted & ~self._left_alone()
            await self._checks.step(self._token, free)

    def _start_again(self, rows: npt.NDArray[np.intp]) -> None:
        """Stow heliostats that cannot proceed from their present pose, to raise them again."""
        if len(rows):
            names = tuple(self._plant.field.names[row] for row in rows)
            self._plant.stow(AUTOMATIC.name, names)
            text = (
                "cannot continue from its current position, so it goes to stow and is raised again"
            )
            for name in names:
                self._log.event("plant", name, text)

    def _visiting(self) -> frozenset[str]:
        if self._calibrating is None:
            return frozenset()
        running = self._calibrating.running.values()
        return frozenset(name for run in running for name in run.heliostats)

    def _ready(self) -> npt.NDArray[np.bool_]:
        """Return a mask of the heliostats that may be calibrated now, (N,)."""
        ready = self._plant.field.among(states.AVAILABLE, self._plant.now()) & self._raising.wanted
        ready &= ~self.service.rows() & self._raising.able()
        ready[[self._plant.field.place(name) for name in self._visiting()]] = False
        return ready

    def _visits(self, calibrating: Calibrating, target: str) -> Callable[[], Awaitable[None]]:
        async def visit() -> None:
            if self._why_not() or self.service.closed(target):
                return
            for name in await calibrating.visit(target, self._ready(), AUTOMATIC, self._token):
                self._raising.release(name)

        return visit

    def _due(self, calibrating: Calibrating) -> Callable[[], Awaitable[None]]:
        def ask(heliostat: str, target: str) -> None:
            if heliostat not in calibrating.asked:
                self.calibrate(heliostat, target, search=False, together=(), receiver=False)

        async def look() -> None:
            self.timetable.step(ask)

        return look

    def _on_receiver(self, calibrating: Calibrating) -> Callable[[], Awaitable[None]]:
        async def visit() -> None:
            if self._why_not():
                return
            for name in await calibrating.receiver_visit(self._ready(), AUTOMATIC, self._token):
                self._raising.release(name)

        return visit

    async def _learn(self) -> None:
        """Learn the groups that are due, in the background."""
        await self.learning.step(night=not self._day)

    def _foresee(self, foresight: Foresight) -> Callable[[], Awaitable[None]]:
        async def look() -> None:
            able = self._raising.wanted & ~self.service.rows()
            await foresight.look(able, self._ready(), running=not self._why_not())

        return look

    async def _look(self) -> None:
        """Update predicted errors and the field's quality; check the records."""
        self.book.refresh()
        self.book.point(self._utc(), self.truth.all())
        self.flights.look()
        self._keeping.forget(self._utc(), self._settings.events)
        self._log.check_records(self._keeping.problem)
        await self._sleep(_LOOK_EVERY)
