"""Field calibration: successive visits to each target, as scheduled."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.errors import HeliotropeError
from heliotrope.geometry import FloatArray
from heliotrope.imaging.coded import Verdict
from heliotrope.plant.attempts import Attempts, Retry, RetryLaw
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.calibration_book import CalibrationBook
from heliotrope.plant.operations.coded_visits import JointVisits, ReceiverVisits, Requests
from heliotrope.plant.operations.foresight import Foreseeing
from heliotrope.plant.operations.keeping import Keeping
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.operations.pictures import Pictures
from heliotrope.plant.operations.views import CalibrationEntry, Running
from heliotrope.plant.orders.authority import Person, RefusedError, TakenOutError
from heliotrope.plant.visits.calibration_cycle import CalibrationCycle, CycleResult
from heliotrope.plant.visits.coded_cycle import CodedCycle
from heliotrope.plant.visits.joint_cycle import JointCycle
from heliotrope.plant.visits.receiver_cycle import ReceiverCycle
from heliotrope.safety import alarms
from heliotrope.store.records import PlannedVisit

#: Visits to a target that failed through no fault of a heliostat: camera, clouds, refusals.
PLACES = RetryLaw(
    "visits to this target",
    5,
    10.0,
    "an operator must check its camera and the light on it; until then there is one visit an hour",
    longest=600.0,
    rest=3600.0,
    alarm=alarms.VISITS_FAIL,
)
#: Outcomes of visits that were aborted.
_BROKEN = (
    CalibrationOutcome.REFUSED,
    CalibrationOutcome.TAKEN_OUT,
    CalibrationOutcome.ERROR,
)
#: After a heliostat has been on a target, it leaves targets to other heliostats for this time, s.
FRESH = 600.0
#: Interval between computations of the true errors, s.
_TRUTH_EVERY = 5.0


class Scheduling(Foreseeing, Protocol):
    """The choice of the next heliostat to calibrate.

    Attributes
    ----------
    attempts
        Failed visits, by heliostat; times in POSIX s.
    """

    attempts: Attempts

    @property
    def reason(self) -> str:
        """Why the last visit was chosen, or why none was; "" before the first choice."""
        ...

    def next(
        self, target: str, ready: npt.NDArray[np.bool_], beside: bool = False
    ) -> PlannedVisit | None:
        """Return the next of the ready heliostats (N,) for a free target; None if none is due.

        With ``beside``, the heliostat joins the visit of the heliostats returned by earlier calls.
        """
        ...

    def plan(self, ready: npt.NDArray[np.bool_], limit: int) -> Sequence[PlannedVisit]:
        """Return the planned visits."""
        ...

    def done(self, entry: CalibrationEntry) -> None:
        """Accept the result of a visit."""
        ...

    def shone(self, mirrors: int, lit: int, seconds: float) -> None:
        """Record the time of a receiver visit, in which some of the heliostats on it took part."""
        ...


@dataclass(frozen=True)
class Visits:
    """The visits that a plant can make, and the parts that choose and store them.

    Attributes
    ----------
    cycle
        Calibrates one heliostat.
    scheduler
        Chooses the next heliostat.
    joint
        Calibrates several heliostats on one target; None: each is calibrated alone.
    receiver
        Calibrates heliostats on a receiver; None: they go to targets.
    pictures
        Stores photographs with their results; None: they are not stored.
    """

    cycle: CalibrationCycle
    scheduler: Scheduling
    joint: JointCycle | None = None
    receiver: ReceiverCycle | None = None
    pictures: Pictures | None = None


class TrueErrors:
    """True tracking errors, known only to a twin, and computed every five seconds.

    Parameters
    ----------
    plant
        Plant whose clock times the errors.
    truth
        Function that returns the errors, rad, (N,); None: they are unknown.
    """

    def __init__(self, plant: PlantController, truth: Callable[[], FloatArray] | None) -> None:
        self._plant, self._truth = plant, truth
        self._known: tuple[float, FloatArray] | None = None

    @property
    def known(self) -> bool:
        """Whether the errors are known."""
        return self._truth is not None

    def all(self) -> FloatArray | None:
        """Return the errors of all heliostats, rad, (N,); None if they are unknown."""
        if self._truth is None:
            return None
        now = self._plant.now()
        if self._known is None or now - self._known[0] >= _TRUTH_EVERY:
            self._known = now, self._truth()
        return self._known[1]

    def now(self) -> FloatArray:
        """Return the present errors of all heliostats, rad, (N,); NaN if they are unknown."""
        self._known = None
        found = self.all()
        return np.full(len(self._plant.field), np.nan) if found is None else found


class Calibrating:
    """The visits of automatic calibration, and their results.

    Parameters
    ----------
    plant, log
        The controller, and the logbook for events.
    visits
        The visits that the plant can make.
    book, keeping
        Accept the results.
    truth
        True errors, known to a twin only.
    first
        Function that returns the heliostats to be visited first, after the doubtful ones.
    ruled
        Function that returns a mask of the heliostats under a timetable rule, (N,); None: there are
        no rules.
    """

    def __init__(
        self,
        plant: PlantController,
        log: Logbook,
        visits: Visits,
        book: CalibrationBook,
        keeping: Keeping,
        truth: TrueErrors,
        first: Callable[[], Collection[str]],
        ruled: Callable[[str], npt.NDArray[np.bool_]] | None = None,
    ) -> None:
        self._plant, self._log, self._first = plant, log, first
        self._book, self._keeping, self._truth = book, keeping, truth
        self._cycle, self._scheduler = visits.cycle, visits.scheduler
        self._pictures, joint, receiver = visits.pictures, visits.joint, visits.receiver
        tell = log.take_alarm
        self._ruled = ruled or (lambda _: np.zeros(len(plant.field.names), dtype=np.bool_))
        self._joint = None if joint is None else JointVisits(plant, book, joint, tell)
        self._receiver = None if receiver is None else ReceiverVisits(plant, book, receiver, tell)
        self._running: dict[str, Running] = {}
        self._asked: dict[str, tuple[str, bool]] = {}
        #: Why operators' requests were dropped, and the last result, by heliostat.
        self._withdrawn: dict[str, str] = {}
        self._last: dict[str, CalibrationEntry] = {}
        #: When each heliostat was last on a target, POSIX s, (N,).
        self._visited = np.full(len(plant.field.names), -np.inf)
        self._flown: frozenset[str] = frozenset()
        self._places = Attempts(PLACES, log.take_alarm)
        self._scheduler.attempts.report_to(log.take_alarm)

    @property
    def asked(self) -> tuple[str, ...]:
        """Heliostats that operators want calibrated next, in the order of the requests."""
        return (*self._asked, *(name for each in self._requests for name in each.asked))

    @property
    def _requests(self) -> tuple[Requests, ...]:
        """The requests of operators for joint visits and receiver visits."""
        return tuple(each.requests for each in (self._joint, self._receiver) if each is not None)

    def ask(self, heliostat: str, target: str, *, search: bool = False) -> None:
        """Calibrate a heliostat before all others, on a target ("": the next free target).

        With ``search``, its beam is only searched for.
        """
        self._forget((heliostat,))
        self._asked[heliostat] = target, search

    def _forget(self, heliostats: Sequence[str]) -> None:
        """Forget the reasons why earlier requests for heliostats were dropped."""
        for name in heliostats:
            self._withdrawn.pop(name, None)

    @property
    def joint(self) -> bool:
        """Whether there are joint visits."""
        return self._joint is not None

    @property
    def receiver(self) -> str:
        """Name of the receiver on which heliostats are measured; empty if there is none."""
        return "" if self._receiver is None else self._receiver.surface

    def ask_together(self, heliostats: Sequence[str], surface: str) -> None:
        """Calibrate heliostats in a coded visit before all others.

        Parameters
        ----------
        heliostats
            Names.
        surface
            A target, "" for the next free target, or the receiver.
        """
        visits = self._receiver if surface and surface == self.receiver else self._joint
        if visits is not None:
            self._forget(heliostats)
            visits.requests.ask(heliostats, surface)

    def withdraw(self, heliostats: Collection[str], why: str) -> None:
        """Withdraw operators' requests to calibrate these heliostats, with the reason."""
        self._withdrawn |= dict.fromkeys(set(self.asked).intersection(heliostats), why)
        for each in self._requests:
            each.withdraw(heliostats)
        for name in heliostats:
            self._asked.pop(name, None)

    @property
    def running(self) -> Mapping[str, Running]:
        """Visits in progress, by target, with the heliostats that no order has removed."""
        left = self._plant.authority.taken_out
        present = ((place, run.without(left(place))) for place, run in self._running.items())
        return {place: run for place, run in present if run is not None}

    def result(self, heliostat: str, since: float) -> CalibrationEntry | str:
        """Return the result of a visit that ended after a time, POSIX s, or why there is none."""
        found, why = self._last.get(heliostat), self._withdrawn.get(heliostat)
        if why is None and found is not None and found.at >= since:
            return found
        return f"withdrawn: {why or 'the visit was aborted'}"

    def retries(self) -> tuple[Retry, ...]:
        """Return the visits that are being retried or were given up."""
        now, joint, receiver = self._plant.now(), self._joint, self._receiver
        return (
            *self._scheduler.attempts.shown(self._now()),
            *(() if joint is None else joint.retries(now)),
            *self._places.shown(now),
            *(() if receiver is None else receiver.retries(now)),
        )

    @property
    def choice(self) -> str:
        """Why the last visit was chosen, or why none was; "" before the first choice."""
        return self._scheduler.reason

    def plan(self, ready: npt.NDArray[np.bool_], limit: int) -> tuple[PlannedVisit, ...]:
        """Return the next planned visits of the ready heliostats, (N,)."""
        return tuple(self._scheduler.plan(self._chooses(ready), limit))

    def _chooses(self, ready: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Return a mask of the ready heliostats that the schedule itself may choose, (N,)."""
        return np.asarray(ready & ~self._ruled("never"))

    async def visit(
        self, target: str, ready: npt.NDArray[np.bool_], person: Person, token: int
    ) -> tuple[str, ...]:
        """Calibrate the next of the ready heliostats (N,), or several together; return which.

        Heliostats requested by operators come first, then heliostats with doubtful step counts,
        because a photograph resolves the doubt, then heliostats for which a flight has brought a
        large change, because a photograph confirms the change. A heliostat that was on a target a
        moment ago comes after all others.
        """
        if not self.asked and not self._places.due(target, self._plant.now()):
            return ()
        if self._joint is not None:
            if not self.asked and self._joint.awaited(target, self._chooses(ready)):
                return ()
            if names := await self._for_joint_visit(self._joint, target, ready):
                self._joint.begun(target)
                await self._coded_visit(self._joint.cycle, names, target, person, token)
                return names
            ready = ready & ~self._away()
        name, search = self._chosen(target, ready)
        if not name:
            return ()
        begun = self._now()

        def tell(stage: str) -> None:
            self._running[target] = Running(name, target, stage, begun)

        tell("on the way")
        if self._pictures is not None:
            self._pictures.begin(name)
        row = self._plant.field.place(name)
        truth, sigma = float(self._truth.now()[row]), float(self._book.error[row])
        blameless = False
        try:
            work = self._cycle.search if search else self._cycle.run
            result = await work(person, token, name, target, tell)
        except RefusedError as error:
            result = CycleResult(name, _outcome(error), str(error))
            blameless = self._interrupted(token)
        except HeliotropeError as error:
            text, blameless = f"{type(error).__name__}: {error}", True
            result = CycleResult(name, CalibrationOutcome.ERROR, text)
        finally:
            self._running.pop(target, None)
        if result.outcome is not CalibrationOutcome.TAKEN_OUT:
            self._note_place(target, result.text if blameless else "", token)
        after = float(self._truth.now()[row]) if result.outcome.calibrated else math.nan
        self._conclude(target, result, (truth, after), begun, sigma, blameless=blameless)
        return (name,)

    async def _for_joint_visit(
        self, joint: JointVisits, target: str, ready: npt.NDArray[np.bool_]
    ) -> tuple[str, ...]:
        """Return the heliostats of a joint visit; () if a single heliostat comes next."""
        if names := joint.requests.next(target, ready):
            return names
        alone = any(
            where in ("", target) and ready[self._plant.field.place(name)]
            for name, (where, _) in self._asked.items()
        )
        ready = self._chooses(ready)
        if alone or (ready & self._pressing() & self._fresh()).any():
            return ()
        names = await joint.chosen(target, ready, self._scheduler.next)
        away = self._away()
        free = tuple(name for name in names if not away[self._plant.field.place(name)])
        return free if len(free) > 1 else ()

    def _away(self) -> npt.NDArray[np.bool_]:
        """Return a mask of the heliostats in visits, (N,), which may have begun during a choice."""
        names = [name for run in self.running.values() for name in run.heliostats]
        return np.isin(self._plant.field.names, names)

    async def receiver_visit(
        self, ready: npt.NDArray[np.bool_], person: Person, token: int
    ) -> tuple[str, ...]:
        """Calibrate on the receiver those of the ready heliostats (N,) that are due; return which.

        A heliostat with a doubtful result is measured on a target next.
        """
        if self._receiver is None:
            return ()
        names = self._receiver.chosen(ready & ~self._pressing())
        if not names:
            return ()
        begun, lit, cycle = self._now(), self._receiver.lit, self._receiver.cycle
        results = await self._coded_visit(cycle, names, self.receiver, person, token)
        # A visit that was aborted or yielded nothing does not show how long a visit takes.
        if any(result.new > 0 for result in results):
            moved = sum(result.outcome not in _BROKEN for result in results)
            self._scheduler.shone(moved, lit, self._now() - begun)
        odd = () if self._interrupted(token) else self._receiver.concluded(results)
        for name in odd:
            self.ask(name, "")
        return names

    async def _coded_visit(
        self,
        cycle: CodedCycle,
        names: tuple[str, ...],
        place: str,
        person: Person,
        token: int,
    ) -> tuple[CycleResult, ...]:
        """Calibrate heliostats together at one place."""
        begun, field = self._now(), self._plant.field

        def tell(stage: str) -> None:
            self._running[place] = Running(names[0], place, stage, begun, names[1:])

        tell("on the way")
        if self._pictures is not None:
            self._pictures.begin_coded(place)
        rows = [field.place(name) for name in names]
        before, sigma = self._truth.now()[rows], self._book.error[rows]
        outcome, said = CalibrationOutcome.REFUSED, ""
        try:
            results = await cycle.run(person, token, names, place, tell)
        except RefusedError as error:
            outcome, said = _outcome(error), str(error)
        except HeliotropeError as error:
            outcome, said = CalibrationOutcome.ERROR, f"{type(error).__name__}: {error}"
        finally:
            self._running.pop(place, None)
        if said:
            results = tuple(CycleResult(name, outcome, said) for name in names)
        clouds = [result for result in results if result.verdict is Verdict.CLOUD]
        if place != self.receiver and outcome is not CalibrationOutcome.TAKEN_OUT:
            self._note_place(
                place, said or (clouds[0].text if 2 * len(clouds) > len(results) else ""), token
            )
        good = [result.outcome.calibrated for result in results]
        after = np.where(good, self._truth.now()[rows], np.nan)
        truths = zip(before.tolist(), after.tolist(), strict=True)
        entries = [
            self._conclude(place, result, truth, begun, expected, joint=True, refused=bool(said))
            for result, truth, expected in zip(results, truths, sigma.tolist(), strict=True)
        ]
        if self._pictures is not None:
            self._pictures.conclude_coded(place, entries)
        proven = sum(result.new > 0 for result in results)
        text = f"the beams of {proven} of {len(names)} heliostats were identified together"
        said = f"{cycle.kind}: {text}{said and f'; {said}'}"
        self._log.event("calibration", place, said, heliostats=names)
        return results

    def _fresh(self) -> npt.NDArray[np.bool_]:
        """Return a mask of the heliostats that were not on a target a moment ago, (N,)."""
        return np.asarray(self._now() - self._visited > FRESH)

    def _interrupted(self, token: int) -> bool:
        """Return whether an emergency, or an operator who took command, may have ended a visit."""
        grant = self._plant.authority.grant
        return self._plant.sentinel.on or grant is None or grant.token != token

    def _note_place(self, place: str, problem: str, token: int) -> None:
        """Record why a visit to a place failed through no fault of a heliostat.

        ``problem`` is empty if the visit did not fail in this way.
        """
        if not problem:
            self._places.done(place)
        elif not self._interrupted(token):
            self._places.failed(place, problem, self._plant.now())

    def _pressing(self) -> npt.NDArray[np.bool_]:
        """Return a mask of the heliostats that need a photograph of their own, (N,).

        They are in doubt, or a flight has changed them, so they visit a target alone.
        """
        first = frozenset(self._first())
        # A flight brings new knowledge about heliostats that were given up.
        self._scheduler.attempts.renew(first - self._flown)
        self._flown = first
        changed = np.isin(self._plant.field.names, list(first))
        return np.asarray(self._plant.doubtful.standing | changed)

    def _chosen(self, target: str, ready: npt.NDArray[np.bool_]) -> tuple[str, bool]:
        """Return the heliostat chosen, and whether its beam is only searched for."""
        for name, (where, search) in self._asked.items():
            if where in ("", target) and ready[self._plant.field.place(name)]:
                del self._asked[name]
                return name, search
        changed = np.isin(self._plant.field.names, list(self._first()))
        ready = self._chooses(ready)
        fresh = ready & self._fresh()
        before = fresh & self._ruled("first")
        alone = fresh if self._joint is None else self._joint.alone(fresh)
        doubted = fresh & self._plant.doubtful.standing
        for rows in (doubted, fresh & changed, before, alone, fresh, ready):
            chosen = self._scheduler.next(target, rows) if rows.any() else None
            if chosen is not None:
                return chosen.heliostat, False
        return self._witness(fresh), False

    def _witness(self, ready: npt.NDArray[np.bool_]) -> str:
        """Return a heliostat whose photographs would show the sun direction; "" if not needed."""
        plant = self._plant
        if not plant.witnesses.awaits_photographs:
            return ""
        for row in np.flatnonzero(ready)[np.argsort(self._visited[ready], kind="stable")]:
            name: str = plant.field.names[row]
            if plant.witnesses.testifies(plant.beliefs.record(name)):
                return name
        return ""

    def _now(self) -> float:
        return self._plant.clock.utc().timestamp()

    def _conclude(
        self,
        target: str,
        result: CycleResult,
        truth: tuple[float, float],
        begun: float,
        sigma: float,
        *,
        joint: bool = False,
        refused: bool = False,
        blameless: bool = False,
    ) -> CalibrationEntry:
        row, good = self._plant.field.place(result.heliostat), result.outcome.calibrated
        record = result.record
        entry = CalibrationEntry(
            self._now(),
            result.heliostat,
            target,
            result.outcome,
            result.before,
            result.after,
            result.measured,
            float(self._book.error[row]),
            *truth,
            self._plant.beliefs.count(result.heliostat),
            result.new,
            "; ".join((result.text, *result.rejected[:2])),
            0 if record is None else record.version,
        )
        lit = target == self.receiver
        self._last[result.heliostat] = entry
        if not lit:
            self._visited[row] = entry.at
        if self._joint is not None:
            self._joint.concluded(result)
        self._book.conclude(entry)
        # The schedule plans visits to targets. A receiver visit without a result is therefore no
        # failure, nor is a visit ended by the camera, a cloud or another order; and a beam that is
        # searched for in several joint visits has not failed yet.
        looked = joint and self._joint is not None and self._joint.again(result)
        blameless |= refused or result.verdict is Verdict.CLOUD
        blameless |= result.outcome is CalibrationOutcome.TAKEN_OUT
        if good or not (lit or looked or blameless):
            self._scheduler.done(entry)
        # A joint visit that was refused as a whole is one event, not one event per heliostat.
        if not refused:
            self._log.event("calibration", entry.heliostat, f"at {target}: {entry.text}")
        self._keeping.keep(entry, begun, sigma)
        if self._pictures is not None:
            self._pictures.conclude(entry)
        return entry


def _outcome(error: RefusedError) -> CalibrationOutcome:
    """Return the outcome of a visit that ended with an error."""
    taken = isinstance(error, TakenOutError)
    return CalibrationOutcome.TAKEN_OUT if taken else CalibrationOutcome.REFUSED
