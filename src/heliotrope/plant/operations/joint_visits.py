"""Joint visits of automatic calibration: which heliostats go to a target together."""

import asyncio
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray
from heliotrope.imaging.coded import Verdict
from heliotrope.lcu import states
from heliotrope.plant.attempts import Retry
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.calibration_book import CalibrationBook
from heliotrope.plant.operations.requests import Requests
from heliotrope.plant.operations.views import Planned
from heliotrope.plant.visits.calibration_cycle import CycleResult
from heliotrope.plant.visits.joint_cycle import JointCycle
from heliotrope.safety import Alarm, alarms

Mask = npt.NDArray[np.bool_]
#: Returns the next of the ready heliostats (N,) for a target; with True others go there with it.
Next = Callable[[str, Mask, bool], Planned | None]

#: Share of the largest expected error that a heliostat may have which automatic control sends: the
#: sun moves on until the visit begins.
_SURE = 0.95
#: Longest wait of a target for a joint first visit while the field is raised, s.
_PATIENCE = 60.0
#: Heliostats that are judged at a time, some 10 ms.
_PART = 500
#: Verdicts that say that something is wrong with a mirror or with what is believed of it.
_WRONG = (Verdict.STUCK, Verdict.EXCHANGED, Verdict.ELSEWHERE)


class JointVisits:
    """The heliostats of joint visits.

    Parameters
    ----------
    plant, book
        The controller, and the predicted errors.
    cycle
        Makes a joint visit.
    tell
        Called with each alarm.

    Attributes
    ----------
    cycle
        As given.
    requests
        What persons want.
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
        #: Targets whose last visit was a joint one.
        self._last: set[str] = set()
        #: Since when a target has waited for a joint first visit.
        self._waited: dict[str, float] = {}
        self._choosing = asyncio.Lock()

    async def chosen(self, target: str, ready: Mask, following: Next) -> tuple[str, ...]:
        """Return the ready heliostats (N,) that go to a target together; () if too few would.

        Those that were never calibrated, or are known badly, come first; then those that are due.
        While others wait for their first calibration, every second visit to a target is a joint
        one at most.
        """
        settings, able = self.cycle.settings, ready & ~self.alone(ready)
        first = ready & ~np.isfinite(self._book.calibrated_at)
        error = await self._error_on(target, able & ~first)
        limit = _SURE * settings.known
        # Those that are known too badly on this target keep a code of their own, as new ones do.
        new = able & (first | (error > limit))
        if settings.first and int(new.sum()) >= settings.least:
            # The targets share those that are left.
            share = -(-int(new.sum()) // len(self._plant.design.targets))
            most = min(settings.first, max(settings.least, share))
            names = await self._several(target, new, following, most)
            # What makes the target too bright waits for the next visit.
            names = self.cycle.having_place(names, target) if names else ()
            if len(names) >= settings.least:
                return names
        if first.any() and target in self._last:
            self._last.discard(target)
            return ()
        # One that has no place in the visit would count as failed.
        known = able & (error <= limit)
        if int(known.sum()) < settings.least:
            return ()
        names = await self._several(target, known, following, settings.most)
        return names if len(names) >= settings.least else ()

    async def _error_on(self, target: str, heliostats: Mask) -> FloatArray:
        """Return the expected errors of beams on a target, as a joint visit judges them, rad, (N,).

        What counts is the error where the visit is: sightings on one target leave more open on the
        receiver.
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
        """Return up to so many of the ready heliostats (N,), in the order of their gain."""
        names: list[str] = []
        left = ready.copy()
        # Two targets that chose in turn would leave too few to both.
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
        """Return which of the ready heliostats (N,) go alone: joint visits did not prove them."""
        found = np.zeros_like(ready)
        found[[self._plant.field.place(name) for name in self.cycle.attempts.given_up]] = True
        return found & ready

    def awaited(self, target: str, ready: Mask) -> bool:
        """Return whether a target waits for others: the field is raised, and few are ready.

        It waits for `_PATIENCE` at most, once, for a joint first visit that is worth its way.
        """
        settings, now = self.cycle.settings, self._plant.now()
        full = settings.first * len(self._plant.design.targets)
        first = ~np.isfinite(self._book.calibrated_at)
        coming = first & self._plant.field.among((states.APPROACHING,), now)
        if int((ready & first).sum()) >= full or not coming.any():
            return False
        return now - self._waited.setdefault(target, now) < _PATIENCE

    def retries(self, now: float) -> tuple[Retry, ...]:
        """Return the heliostats that come again, or were given up."""
        return self.cycle.attempts.shown(now)

    def begun(self, target: str) -> None:
        """Note that a joint visit to a target begins."""
        self._last.add(target)

    def again(self, result: CycleResult) -> bool:
        """Return whether a result is no failure: its beam is looked for in another joint visit."""
        return result.verdict is not None and self.cycle.searching(result.heliostat)

    def concluded(self, result: CycleResult) -> None:
        """Note the result of a visit: what it proves, or disproves, of a heliostat."""
        self.cycle.note(result)
        name, kind = result.heliostat, alarms.BEAM_DISPROVED
        # Nothing says where the beam of a mirror without a calibration ought to be.
        known = np.isfinite(self._book.calibrated_at[self._plant.field.place(name)])
        if result.verdict in _WRONG and known:
            self._disproved.add(name)
            self._tell(kind.raised(name, problem=result.text.removeprefix("unchanged: ")))
        elif result.new and name in self._disproved:
            self._disproved.discard(name)
            self._tell(kind.ended(name))
