"""The verification of a joint first visit: one more series of photographs of all mirrors together.

The fits of the visit end one after the other. Each heliostat that stores new parameters waits until
all the others do, or have ended otherwise; then they are verified together.
"""

import asyncio
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from heliotrope.calibration.fit.estimator import FieldFit
from heliotrope.calibration.uncertainty import expected_error
from heliotrope.errors import HeliotropeError
from heliotrope.field.coded_visits import JointSettings
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.coded import Verdict
from heliotrope.mechanism.chain import Mechanism
from heliotrope.plant.visits.coded_cycle import CodedCycle, Light
from heliotrope.plant.visits.coded_visit import CodedVisit
from heliotrope.plant.visits.joint_layout import verifying
from heliotrope.plant.visits.photographs import Photographs, Shot, Tell
from heliotrope.plant.visits.visit import Visit

#: Verdicts that are no mirror's fault: a verification that ends so is made again, once.
_AGAIN = (Verdict.JOINED, Verdict.CLOUD)


@dataclass(frozen=True)
class _Waiting:
    """A heliostat whose local controller stores a fit that is not verified.

    Attributes
    ----------
    visit
        Its visit.
    fitted, nominal
        The fit of batch shape (1,), and the mechanism that it starts from.
    problem
        Gives why the fit is not confirmed, "" if it is.
    """

    visit: Visit
    fitted: FieldFit
    nominal: Mechanism
    problem: "asyncio.Future[str]"

    def error(self, sun: FloatArray, target: Target) -> float:
        """Return the expected beam error of the new parameters on a target, rad RMS (2-D)."""
        found = expected_error(
            self.nominal.with_parameters(self.fitted.parameters),
            tuple(self.fitted.names),
            self.fitted.covariance[0],
            sun,
            target.center,
            current=self.visit.plant.field.counts(np.array([self.visit.row])),
        )
        return float(found.rms[0])


class JointVerification:
    """The heliostats of one joint visit on their way to a joint verification.

    Parameters
    ----------
    coded, settings
        Makes the visit; and its numbers.
    visit, light
        The visit to the target, and the light there.
    heliostats
        Names of all that may come.
    tell
        Called with the name of each step.

    Attributes
    ----------
    seen
        Sightings of those that were confirmed, by name.
    """

    def __init__(
        self,
        coded: CodedCycle,
        settings: JointSettings,
        visit: CodedVisit,
        light: Light,
        heliostats: Iterable[str],
        tell: Tell,
    ) -> None:
        self._coded, self._settings, self._visit = coded, settings, visit
        self._light, self._tell = light, tell
        self.seen: dict[str, Photographs] = {}
        self._coming = set(heliostats)
        self._waiting: dict[str, _Waiting] = {}
        self._complete = asyncio.Event()

    async def problem(
        self, visit: Visit, fitted: FieldFit, nominal: Mechanism, used: list[Shot], tell: Tell
    ) -> str:
        """Wait for the verification; see `Verification.problem`."""
        del used, tell
        problem: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._waiting[visit.heliostat] = _Waiting(visit, fitted, nominal, problem)
        self.leave(visit.heliostat)
        return await problem

    def leave(self, heliostat: str) -> None:
        """Note that a heliostat does not come any more, or has come."""
        self._coming.discard(heliostat)
        if not self._coming:
            self._complete.set()

    async def make(self) -> None:
        """Verify those that wait, once no more can come; where that fails, it fails for them."""
        await self._complete.wait()
        try:
            await self._confirm()
        except HeliotropeError as error:
            for one in self._waiting.values():
                if not one.problem.done():
                    one.problem.set_exception(error)

    async def _confirm(self) -> None:
        """Verify new parameters; the sightings of the confirmed go to `seen`.

        Those that would make the target too bright are photographed later. Those that other light
        hid come once more, each with a code of its own. Each series of photographs settles its own,
        whatever becomes of the next.
        """
        waits, own = tuple(self._waiting), False
        while waits:
            hidden: list[str] = []
            while waits:
                problems, again, waits = await self._verified(waits, own=own)
                hidden += () if own else again
                for name, problem in problems.items():
                    if name not in hidden and not self._waiting[name].problem.done():
                        self._waiting[name].problem.set_result(problem)
            waits, own = tuple(hidden), True

    async def _verified(
        self, names: Sequence[str], *, own: bool
    ) -> tuple[dict[str, str], list[str], tuple[str, ...]]:
        """Take one series of photographs.

        Returns
        -------
            Why each is not confirmed, "" if it is; those that may come once more; and those that
            wait for another series.
        """
        plant, target = self._visit.plant, self._visit.target
        sun = plant.sun_vector()
        errors = {name: self._waiting[name].error(sun, target) for name in names}
        layout, problems, waits = verifying(plant, target, errors, self._settings, own=own)
        if not layout.names:
            return problems, [], waits
        again = CodedVisit(plant, self._visit.mandate, layout.names, target)
        again.drop(self._misled(layout.start()))
        proven, others = await self._coded.photographed(
            again, layout, self._light, lambda stage: self._tell(f"verification: {stage}")
        )
        for name, result in others.items():
            text = result.text.removeprefix("unchanged: ")
            problems[name] = f"with the new parameters its beam was not proven: {text}"
        for name, photographs in proven.items():
            one, ((shot, counts),) = self._waiting[name], photographs.used
            judge = self._coded.cycle.verification.judge
            problems[name] = problem = judge(one.nominal, one.fitted, shot, counts)
            if not problem:
                self.seen[name] = photographs
        hidden = [name for name, one in others.items() if one.verdict in _AGAIN]
        return problems, hidden, waits

    def _misled(self, points: Mapping[str, FloatArray]) -> dict[str, str]:
        """Return the heliostats that have no free path to their points, and their reasons."""
        return {
            name: f"the new parameters have no free way to their photograph: {why}"
            for name, point in points.items()
            if (why := self._visit.plant.misled(name, point))
        }
