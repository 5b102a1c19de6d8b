"""Coded visits in automatic calibration: which heliostats are measured together, and where."""

import asyncio
from collections.abc import Callable, Collection, Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.geometry import FloatArray
from heliotrope.imaging.coded import Verdict
from heliotrope.lcu import states
from heliotrope.plant.attempts import Attempts, Retry, RetryLaw
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.calibration_book import CalibrationBook
from heliotrope.plant.visits.calibration_cycle import CycleResult
from heliotrope.plant.visits.joint_cycle import JointCycle
from heliotrope.plant.visits.receiver_cycle import ReceiverCycle
from heliotrope.safety import Alarm, alarms
from heliotrope.store.records import PlannedVisit

Mask = npt.NDArray[np.bool_]
#: Function that returns the next of the ready heliostats (N,) for a target; True: in a joint visit.
Next = Callable[[str, Mask, bool], PlannedVisit | None]

#: Automatic control sends a heliostat to a joint visit only if its expected error is at most this
#: fraction of the largest permitted one, because the sun moves until the visit begins.
_JOINT_SURE = 0.95
#: Longest wait of a target for a joint first visit while the field is raised, s.
_PATIENCE = 60.0
#: Number of heliostats judged without a break, which takes some 10 ms.
_PART = 500
#: Verdicts that indicate a fault of a heliostat or of what is believed about it.
_WRONG = (Verdict.STUCK, Verdict.EXCHANGED, Verdict.ELSEWHERE)
#: Automatic control measures a heliostat on a receiver only if its expected error is at most this
#: fraction of the largest permitted one.
_RECEIVER_SURE = 0.75
#: Receiver visits without a result, mostly because of the light and not of a heliostat.
RECEIVER = RetryLaw(
    "visits on this receiver",
    5,
    600.0,
    "an operator must check its camera and the light on it; until then there is one visit an hour",
    growth=1.5,
    longest=3600.0,
    rest=3600.0,
    alarm=alarms.VISITS_FAIL,
)
#: Receiver visits in which a heliostat was refused, or an error ended its measurement, while others
#: were measured.
MIRROR = RetryLaw(
    "receiver visit",
    3,
    0.0,
    "it visits a target alone; until then it has one receiver visit a day",
    rest=16.0 * 3600.0,
)
_BROKEN = (CalibrationOutcome.REFUSED, CalibrationOutcome.ERROR)
#: Verdicts after which a heliostat is examined on a target.
_ODD = (Verdict.STUCK, Verdict.EXCHANGED, Verdict.ELSEWHERE, Verdict.JOINED, Verdict.FAINT)


class Requests:
    """Heliostats that operators want measured together, in the order of the requests.

    Parameters
    ----------
    place
        Function that returns the index of a heliostat.
    """

    def __init__(self, place: Callable[[str], int]) -> None:
        self._place = place
        self._asked: list[tuple[tuple[str, ...], str]] = []

    @property
    def asked(self) -> tuple[str, ...]:
        """The requested heliostats."""
        return tuple(name for names, _ in self._asked for name in names)

    def ask(self, heliostats: Sequence[str], surface: str) -> None:
        """Request a joint measurement on a surface ("": the next free surface)."""
        self._asked.append((tuple(dict.fromkeys(heliostats)), surface))

    def withdraw(self, heliostats: Collection[str]) -> None:
        """Drop operators' requests for these heliostats."""
        left = [(tuple(n for n in names if n not in heliostats), s) for names, s in self._asked]
        self._asked = [(names, surface) for names, surface in left if names]

    def next(self, surface: str, ready: Mask) -> tuple[str, ...]:
        """Return the next group for a surface, once all its heliostats are ready; () if none is."""
        for i, (names, where) in enumerate(self._asked):
            if where in ("", surface) and ready[[self._place(name) for name in names]].all():
                del self._asked[i]
                return names
        return ()


class JointVisits:
    """The heliostats of joint visits.

    Parameters
    ----------
    plant, book
        The controller, and the predicted errors.
    cycle
        Cycle that makes a joint visit.
    tell
        Called with each alarm.

    Attributes
    ----------
    cycle
        As given.
    requests
        Requests of operators.
    """

    def __init__(
        self,
        plant: PlantController,
        book: CalibrationBook,
        cycle: JointCycle,
        tell: Callable[[Alarm], None],
    ) -> None:
        self._plant, self._book, self.cycle, self._tell = plant, book, cycle, tell
        self.requests = Requests(plant.field.place)
        self._disproved: set[str] = set()
        #: Targets whose last visit was a joint visit.
        self._last: set[str] = set()
        #: Since when a target has waited for a joint first visit.
        self._waited: dict[str, float] = {}
        self._choosing = asyncio.Lock()

    async def chosen(self, target: str, ready: Mask, following: Next) -> tuple[str, ...]:
        """Return the ready heliostats (N,) that go to a target together; () if there are too few.

        Heliostats that were never calibrated, or are poorly known, come first; heliostats that are
        due come next. While heliostats wait for their first calibration, at most every second visit
        to a target is a joint visit.
        """
        settings, able = self.cycle.settings, ready & ~self.alone(ready)
        first = ready & ~np.isfinite(self._book.calibrated_at)
        error = await self._error_on(target, able & ~first)
        limit = _JOINT_SURE * settings.known
        # Heliostats that are too poorly known on this target keep their own code, as new ones do.
        new = able & (first | (error > limit))
        if settings.first and int(new.sum()) >= settings.least:
            # The targets share the remaining heliostats.
            share = -(-int(new.sum()) // len(self._plant.design.targets))
            most = min(settings.first, max(settings.least, share))
            names = await self._several(target, new, following, most)
            # Heliostats that would make the target too bright wait for the next visit.
            names = self.cycle.having_place(names, target) if names else ()
            if len(names) >= settings.least:
                return names
        if first.any() and target in self._last:
            self._last.discard(target)
            return ()
        # A heliostat without a place in the visit would count as failed.
        known = able & (error <= limit)
        if int(known.sum()) < settings.least:
            return ()
        names = await self._several(target, known, following, settings.most)
        return names if len(names) >= settings.least else ()

    async def _error_on(self, target: str, heliostats: Mask) -> FloatArray:
        """Return the beam errors that a joint visit to a target expects, rad, (N,).

        The error at the place of the visit is used, because sightings on one target leave a larger
        error on the receiver.
        """
        again, place = 2.0 * self.cycle.settings.visit**2, self._plant.design.target(target)
        found, rows = np.full(len(heliostats), np.nan), np.flatnonzero(heliostats)
        for k in range(0, len(rows), _PART):
            part = rows[k : k + _PART]
            found[part] = np.sqrt(self._book.error_on(place, part) ** 2 + again)
            await asyncio.sleep(0.0)
        return found

    async def _several(
        self, target: str, ready: Mask, following: Next, most: int
    ) -> tuple[str, ...]:
        """Return up to ``most`` of the ready heliostats (N,), by decreasing gain."""
        names: list[str] = []
        left = ready.copy()
        # If two targets chose alternately, too few would be left for both.
        async with self._choosing:
            while len(names) < most:
                planned = following(target, left, bool(names))
                if planned is None:
                    break
                names.append(planned.heliostat)
                left[self._plant.field.place(planned.heliostat)] = False
                await asyncio.sleep(0.0)
        return tuple(names)

    def alone(self, ready: Mask) -> Mask:
        """Return a mask of the ready heliostats that joint visits gave up, (N,); they go alone."""
        found = np.zeros_like(ready)
        found[[self._plant.field.place(name) for name in self.cycle.attempts.given_up]] = True
        return found & ready

    def awaited(self, target: str, ready: Mask) -> bool:
        """Return whether a target waits for more heliostats, because few have been raised yet.

        A target waits only once, for at most `_PATIENCE`, for a worthwhile joint first visit.
        """
        settings, now = self.cycle.settings, self._plant.now()
        full = settings.first * len(self._plant.design.targets)
        first = ~np.isfinite(self._book.calibrated_at)
        coming = first & self._plant.field.among((states.APPROACHING,), now)
        if int((ready & first).sum()) >= full or not coming.any():
            return False
        return now - self._waited.setdefault(target, now) < _PATIENCE

    def retries(self, now: float) -> tuple[Retry, ...]:
        """Return the heliostats that are retried, or were given up."""
        return self.cycle.attempts.shown(now)

    def begun(self, target: str) -> None:
        """Note that a joint visit to a target begins."""
        self._last.add(target)

    def again(self, result: CycleResult) -> bool:
        """Return whether another joint visit will search for the beam, so this one did not fail."""
        return result.verdict is not None and self.cycle.searching(result.heliostat)

    def concluded(self, result: CycleResult) -> None:
        """Note the result of a visit; raise or end the alarm that a beam is not as predicted."""
        self.cycle.note(result)
        name, kind = result.heliostat, alarms.BEAM_DISPROVED
        # Nothing predicts where the beam of an uncalibrated heliostat should be.
        known = np.isfinite(self._book.calibrated_at[self._plant.field.place(name)])
        if result.verdict in _WRONG and known:
            self._disproved.add(name)
            self._tell(kind.raised(name, problem=result.text.removeprefix("unchanged: ")))
        elif result.new and name in self._disproved:
            self._disproved.discard(name)
            self._tell(kind.ended(name))


class ReceiverVisits:
    """The heliostats of receiver visits.

    Parameters
    ----------
    plant, book
        The controller, and the predicted errors.
    cycle
        Cycle that makes a receiver visit.
    tell
        Called with each alarm.

    Attributes
    ----------
    cycle
        As given.
    requests
        Requests of operators.
    attempts
        Visits without a result, by receiver.
    mirrors
        Visits that left out a heliostat, by heliostat.
    """

    def __init__(
        self,
        plant: PlantController,
        book: CalibrationBook,
        cycle: ReceiverCycle,
        tell: Callable[[Alarm], None],
    ) -> None:
        self._plant, self._book, self.cycle = plant, book, cycle
        self._settings, self.requests = cycle.settings, Requests(plant.field.place)
        self._face = cycle.face(self.surface)
        self.attempts, self.mirrors = Attempts(RECEIVER, tell), Attempts(MIRROR)
        #: When each heliostat was last measured, monotonic s.
        self._at = np.full(len(plant.field), -np.inf)

    @property
    def surface(self) -> str:
        """Name of the receiver."""
        return self._settings.receiver

    @property
    def lit(self) -> int:
        """Number of heliostats that track the receiver."""
        return int(self._shining().sum())

    def _shining(self) -> Mask:
        tracking = self._plant.field.among((states.TRACKING,), self._plant.now())
        return np.asarray(tracking & self._face.holds(self._plant.aims))

    def chosen(self, ready: Mask) -> tuple[str, ...]:
        """Return the ready heliostats (N,) that are measured next; () if there are too few.

        Heliostats requested by operators come first, then heliostats whose errors may be largest.
        """
        field, settings, now = self._plant.field, self._settings, self._plant.now()
        lit = ready & self._shining()
        if names := self.requests.next(self.surface, lit):
            return names
        # The book contains errors of the normal; beam errors are twice as large.
        due = lit & (2.0 * self._book.error <= _RECEIVER_SURE * settings.known)
        due &= now - self._at >= settings.every
        due[[field.place(name) for name in self.mirrors.waiting(now)]] = False
        if not self.attempts.due(self.surface, now) or int(due.sum()) < settings.least:
            return ()
        rows = np.flatnonzero(due)
        first = rows[np.argsort(-self._book.error[rows], kind="stable")][: settings.most]
        return tuple(field.names[row] for row in first)

    def retries(self, now: float) -> tuple[Retry, ...]:
        """Return the visits that are being retried or were given up."""
        return *self.attempts.shown(now), *self.mirrors.shown(now)

    def concluded(self, results: Sequence[CycleResult]) -> tuple[str, ...]:
        """Note a visit's results; return the heliostats to measure on a target.

        If fewer than half of the heliostats are measured, the light is assumed to be the cause, not
        the heliostats. A heliostat that failed too often while other heliostats were measured also
        goes to a target.
        """
        results = [r for r in results if r.outcome is not CalibrationOutcome.TAKEN_OUT]
        now, seen = self._plant.now(), [r.heliostat for r in results if r.verdict is None]
        good = [r for r in results if r.new > 0 or r.outcome is CalibrationOutcome.NOT_VERIFIED]
        if good:
            self.attempts.done(self.surface)
        elif results:
            self.attempts.failed(self.surface, results[0].text, now)
        self._at[[self._plant.field.place(name) for name in seen]] = now
        if 2 * len(good) < len(results):
            return ()
        for result in results:
            if result.outcome in _BROKEN:
                self.mirrors.failed(result.heliostat, result.text, now)
            else:
                self.mirrors.done(result.heliostat)
        given_up = self.mirrors.given_up
        return tuple(
            result.heliostat
            for result in results
            if result.verdict in _ODD
            or result.outcome is CalibrationOutcome.NOT_VERIFIED
            or result.heliostat in given_up
        )
