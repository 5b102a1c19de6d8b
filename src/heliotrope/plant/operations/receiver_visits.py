"""Receiver visits of automatic calibration: which heliostats are measured where they shine."""

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.imaging.coded import Verdict
from heliotrope.lcu import states
from heliotrope.plant.attempts import Attempts, Retry, RetryLaw
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.calibration_book import CalibrationBook
from heliotrope.plant.operations.requests import Requests
from heliotrope.plant.visits.calibration_cycle import CycleResult
from heliotrope.plant.visits.receiver_cycle import ReceiverCycle
from heliotrope.safety import Alarm, alarms

Mask = npt.NDArray[np.bool_]

#: Share of the largest expected error that a heliostat may have which automatic control measures.
_SURE = 0.75
#: Receiver visits that came to nothing: mostly the light is to blame, and not a mirror.
RECEIVER = RetryLaw(
    "visits on this receiver",
    5,
    600.0,
    "a person looks at its camera and its light; one visit an hour until then",
    growth=1.5,
    longest=3600.0,
    rest=3600.0,
    alarm=alarms.VISITS_FAIL,
)
#: Receiver visits that a heliostat was refused for, or that an error broke off, while they measured
#: others.
MIRROR = RetryLaw(
    "receiver visit",
    3,
    0.0,
    "it goes to a target alone; one receiver visit a day until then",
    rest=16.0 * 3600.0,
)
_BROKEN = (CalibrationOutcome.REFUSED, CalibrationOutcome.ERROR)
#: Verdicts after which a heliostat is looked at on a target.
_ODD = (Verdict.STUCK, Verdict.EXCHANGED, Verdict.ELSEWHERE, Verdict.JOINED, Verdict.FAINT)


class ReceiverVisits:
    """The heliostats of receiver visits.

    Parameters
    ----------
    plant, book
        The controller, and the predicted errors.
    cycle
        Makes a receiver visit.
    tell
        Called with each alarm.

    Attributes
    ----------
    cycle
        As given.
    requests
        What persons want.
    attempts
        Visits that came to nothing, by receiver.
    mirrors
        Visits from which a heliostat was left out, by heliostat.
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
        #: When each heliostat was measured last, monotonic s.
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

        Those that persons asked for come first, then those whose errors may be largest.
        """
        field, settings, now = self._plant.field, self._settings, self._plant.now()
        lit = ready & self._shining()
        if names := self.requests.next(self.surface, lit):
            return names
        # The book has errors of the normal; a beam is off by twice as much.
        due = lit & (2.0 * self._book.error <= _SURE * settings.known)
        due &= now - self._at >= settings.every
        due[[field.place(name) for name in self.mirrors.waiting(now)]] = False
        if not self.attempts.due(self.surface, now) or int(due.sum()) < settings.least:
            return ()
        rows = np.flatnonzero(due)
        first = rows[np.argsort(-self._book.error[rows], kind="stable")][: settings.most]
        return tuple(field.names[row] for row in first)

    def retries(self, now: float) -> tuple[Retry, ...]:
        """Return the visits that are tried again, or were given up."""
        return *self.attempts.shown(now), *self.mirrors.shown(now)

    def concluded(self, results: Sequence[CycleResult]) -> tuple[str, ...]:
        """Note a visit's results; return the heliostats that are to be looked at on a target.

        Where less than half of the beams are proven, the light is to blame and not the mirrors.
        One that was refused too often while others were measured goes to a target, too.
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
