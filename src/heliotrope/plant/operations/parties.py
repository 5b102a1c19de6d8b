"""Joint visits of automatic calibration: which heliostats go to a target together."""

import asyncio
from collections.abc import Callable, Collection, Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.imaging.coded import Verdict
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.calibration_book import CalibrationBook
from heliotrope.plant.operations.views import Planned
from heliotrope.plant.visits.calibration_cycle import CycleResult
from heliotrope.plant.visits.joint_cycle import JointCycle
from heliotrope.safety import Alarm, alarms

Mask = npt.NDArray[np.bool_]
#: Returns the next of the ready heliostats (N,) for a target; with True others go there with it.
Next = Callable[[str, Mask, bool], Planned | None]

#: Share of the largest expected error that a heliostat may have which automatic control sends.
_SURE = 0.75
#: Verdicts that say that something is wrong with a mirror or with what is believed of it.
_WRONG = (Verdict.STUCK, Verdict.EXCHANGED, Verdict.ELSEWHERE)


class Parties:
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
    """

    def __init__(
        self,
        plant: PlantController,
        book: CalibrationBook,
        cycle: JointCycle,
        tell: Callable[[Alarm], None],
    ) -> None:
        self._plant, self._book, self.cycle, self._tell = plant, book, cycle, tell
        self._asked: list[tuple[list[str], str]] = []
        #: Those that go alone next: something was wrong with them in a joint visit.
        self._alone: set[str] = set()
        self._disproved: set[str] = set()
        #: Targets whose last visit was a joint one.
        self._last: set[str] = set()
        self._choosing = asyncio.Lock()

    @property
    def asked(self) -> tuple[str, ...]:
        """Heliostats that persons want calibrated together."""
        return tuple(name for names, _ in self._asked for name in names)

    def ask(self, heliostats: Sequence[str], target: str) -> None:
        """Calibrate heliostats together, on a target or, for "", on the next free one."""
        self._asked.append((list(dict.fromkeys(heliostats)), target))

    def withdraw(self, heliostats: Collection[str]) -> None:
        """Forget that persons wanted these heliostats calibrated."""
        left = [([n for n in names if n not in heliostats], t) for names, t in self._asked]
        self._asked = [(names, target) for names, target in left if names]

    def wanted(self, target: str, ready: Mask) -> tuple[str, ...]:
        """Return the heliostats that persons want on a target together; () until all are ready."""
        for i, (names, where) in enumerate(self._asked):
            rows = [self._plant.field.place(name) for name in names]
            if where in ("", target) and ready[rows].all():
                del self._asked[i]
                return tuple(names)
        return ()

    async def chosen(self, target: str, ready: Mask, following: Next) -> tuple[str, ...]:
        """Return the ready heliostats (N,) that are due and known well enough; () if too few are.

        While others wait for their first calibration, every second visit to a target is a joint
        one at most.
        """
        settings, field = self.cycle.settings, self._plant.field
        first = ready & ~np.isfinite(self._book.calibrated_at)
        if first.any() and target in self._last:
            self._last.discard(target)
            return ()
        # The book has errors of the normal at the receiver; a beam is off by twice as much, and on
        # the target a little more. One that has no place in the visit would count as failed.
        known = ready & (2.0 * self._book.error <= _SURE * settings.known)
        known[[field.place(name) for name in self._alone]] = False
        if int(known.sum()) < settings.least:
            return ()
        names: list[str] = []
        # Two targets that chose in turn would leave too few to both.
        async with self._choosing:
            while len(names) < settings.most:
                planned = following(target, known, bool(names))
                if planned is None:
                    break
                names.append(planned.heliostat)
                known[field.place(planned.heliostat)] = False
                await asyncio.sleep(0.0)
        return tuple(names) if len(names) >= settings.least else ()

    def begun(self, target: str) -> None:
        """Note that a joint visit to a target begins."""
        self._last.add(target)

    def concluded(self, result: CycleResult, *, joint: bool) -> None:
        """Note the result of a visit: what it proves, or disproves, of a heliostat."""
        name, kind = result.heliostat, alarms.BEAM_DISPROVED
        if result.verdict is not None:
            self._alone.add(name)
        elif result.new and not joint:
            self._alone.discard(name)
        if result.verdict in _WRONG:
            self._disproved.add(name)
            self._tell(kind.raised(name, problem=result.text.removeprefix("unchanged: ")))
        elif result.new and name in self._disproved:
            self._disproved.discard(name)
            self._tell(kind.ended(name))
