"""The joint visit: several heliostats come to one target, and leave before evaluation.

The empty target is photographed first. New parameters are learnt in the same way as after an
ordinary visit.

Uncalibrated heliostats go together, each with its own code. Heliostats that have stored their first
parameters return together, and a second series of photographs must find each beam at the position
that its parameters predict, which is also the second sighting.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from heliotrope.calibration.fit.estimator import FieldFit
from heliotrope.calibration.plan.on_target import LOOKS
from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.calibration.uncertainty import expected_error
from heliotrope.errors import HeliotropeError
from heliotrope.field.coded_visits import JointSettings
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.coded import Verdict
from heliotrope.mechanism.chain import Mechanism
from heliotrope.plant.attempts import Attempts, RetryLaw
from heliotrope.plant.controller import PlantController
from heliotrope.plant.visits.calibration_cycle import CalibrationCycle, CycleResult
from heliotrope.plant.visits.coded_cycle import CodedCycle, Light, Move, of_each
from heliotrope.plant.visits.coded_layout import Layout
from heliotrope.plant.visits.coded_visit import CodedVisit
from heliotrope.plant.visits.fitting import first_model
from heliotrope.plant.visits.joint_layout import arranged, errors_on, newcomers, verifying
from heliotrope.plant.visits.photographs import Photographs, Shot, Tell
from heliotrope.plant.visits.target_light import Exposed, LightCamera, light_on
from heliotrope.plant.visits.visit import Visit

#: Number of sightings that a first fit needs. One is enough, since all photographs of a visit
#: agree, and further photographs verify the fit.
_FIRST = 1
#: Verdicts on a new heliostat whose beam may be beside the target; light that does not move at its
#: place may come from another heliostat.
_NOT_FOUND = (Verdict.FAINT, Verdict.ELSEWHERE, Verdict.STUCK)
#: Joint visits that did not identify a heliostat's beam. If the beam may be beside the target, the
#: heliostat comes again and aims at another place beside the target.
JOINT = RetryLaw(
    "joint visit",
    LOOKS,
    0.0,
    "it goes to a target alone, with a search for its beam",
)
#: Verdicts for which no heliostat is responsible; a verification with such a verdict is repeated
#: once.
_AGAIN = (Verdict.JOINED, Verdict.CLOUD)


class JointCycle(CodedCycle):
    """Calibration of several heliostats on one target at once.

    Parameters
    ----------
    plant, camera, cycle
        See `CodedCycle`.
    settings
        See `JointSettings`.

    Attributes
    ----------
    settings
        See `JointSettings`.
    attempts
        Number of joint visits that did not identify a heliostat's beam; heliostats that exceed the
        limit go alone.
    """

    kind, comes = "joint visit", True
    settings: JointSettings

    def __init__(
        self,
        plant: PlantController,
        camera: LightCamera,
        cycle: CalibrationCycle,
        settings: JointSettings | None = None,
    ) -> None:
        super().__init__(plant, camera, cycle)
        self.settings = settings or JointSettings()
        self.attempts = Attempts(JOINT)

    # -- which heliostats ------------------------------------------------------------------

    def searching(self, heliostat: str) -> bool:
        """Return whether a joint first visit searches again for a beam that was not found."""
        return 0 < self.attempts.counts.get(heliostat, 0) < LOOKS

    def note(self, result: CycleResult) -> None:
        """Record from the result of a joint or single visit whether the heliostat may join again.

        If the beams of all new heliostats miss the target, the target is as dark as under a cloud.
        Darkness therefore does not end the search; it continues at the next position.
        """
        name, now, text = result.heliostat, self._plant.now(), result.text
        new = self._plant.beliefs.record(name) is None
        if result.new:
            self.attempts.done(name)
        elif new and (
            result.verdict in _NOT_FOUND
            or (result.verdict is Verdict.CLOUD and self.attempts.counts.get(name, 0) < LOOKS - 1)
        ):
            self.attempts.failed(name, text, now)
        elif (
            result.verdict not in (None, Verdict.CLOUD)
            or result.outcome is CalibrationOutcome.NOT_VERIFIED
        ):
            self.attempts.give_up(name, text, now)

    def first(self, heliostats: Sequence[str], target: Target) -> bool:
        """Return whether a visit needs individual codes for new or poorly known heliostats."""
        errors = errors_on(self._plant, target, heliostats, self.settings).values()
        return bool(self.settings.first) and not all(e <= self.settings.known for e in errors)

    def having_place(self, heliostats: Sequence[str], target: str) -> tuple[str, ...]:
        """Return which of some heliostats can have a place in a visit now."""
        return self._arranged(self.face(target), tuple(heliostats)).names

    # -- a visit ---------------------------------------------------------------------------

    def face(self, name: str) -> Target:
        """Return a target; raise UnknownNameError if there is no such target."""
        return self._plant.design.target(name)

    def _arranged(self, face: Target, names: tuple[str, ...]) -> Layout:
        if not self.first(names, face):
            return arranged(self._plant, face, names, self.settings)
        nominal, cycle = self._plant.beliefs.nominal, self.cycle.settings
        model = {name: first_model(cycle, nominal(name)).parameters for name in names}
        return newcomers(self._plant, face, names, self.settings, model, self.attempts.counts)

    @contextlib.asynccontextmanager
    async def _stay(
        self, visit: CodedVisit, layout: Layout, light: Light, tell: Tell
    ) -> AsyncIterator[Move]:
        if light.empty is None:
            tell("the empty target")
            light.empty = await light_on(self._camera, layout.target)
            light.view = light.empty.view
        async with visit:
            tell(f"{len(visit.names)} on the way")
            await visit.go(layout.start(), self.cycle.settings.arrival)
            yield visit.aim
            tell(f"{len(visit.names)} on the way back")

    async def _exposed(self, face: Target, light: Light) -> Exposed:
        return await self._camera.expose(face, light.view)

    async def _learn(
        self,
        visit: CodedVisit,
        layout: Layout,
        proven: Mapping[str, Photographs],
        light: Light,
        tell: Tell,
    ) -> dict[str, CycleResult]:
        if not layout.first:
            return await of_each(proven, lambda name: self._learnt(visit, name, proven[name]))
        verification = _Verification(self, visit, light, proven, tell)

        async def one(name: str) -> CycleResult:
            try:
                result = await self._learnt(
                    visit, name, proven[name], confirming=verification.problem, least=_FIRST
                )
            finally:
                verification.leave(name)
            seen = verification.seen.get(name)
            if seen is None or not result.outcome.calibrated:
                return result
            return result.then(await self._learnt(visit, name, seen, least=_FIRST))

        return await of_each(proven, one, verification.make())


@dataclass(frozen=True)
class _Waiting:
    """A heliostat whose local controller stores a fit that is not verified yet.

    Attributes
    ----------
    visit
        Visit of the heliostat.
    fitted, nominal
        The fit of batch shape (1,), and the mechanism from which it starts.
    problem
        Future with the reason why the fit is not confirmed; None if it is confirmed.
    """

    visit: Visit
    fitted: FieldFit
    nominal: Mechanism
    problem: "asyncio.Future[str | None]"

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


class _Verification:
    """The verification of a joint first visit: a further series of photographs of all beams.

    The fits of the visit end one after the other. Each heliostat that stores new parameters waits
    until all other heliostats have stored theirs or dropped out; then all are verified together.

    Parameters
    ----------
    coded
        Cycle that makes the visit.
    visit, light
        The visit to the target, and the light there.
    heliostats
        Names of all heliostats that may come.
    tell
        Called with the name of each step.

    Attributes
    ----------
    seen
        Sightings of the confirmed heliostats, by name.
    """

    def __init__(
        self,
        coded: JointCycle,
        visit: CodedVisit,
        light: Light,
        heliostats: Iterable[str],
        tell: Tell,
    ) -> None:
        self._coded, self._visit = coded, visit
        self._light, self._tell = light, tell
        self.seen: dict[str, Photographs] = {}
        self._coming = set(heliostats)
        self._waiting: dict[str, _Waiting] = {}
        self._complete = asyncio.Event()

    async def problem(
        self, visit: Visit, fitted: FieldFit, nominal: Mechanism, used: list[Shot], tell: Tell
    ) -> str | None:
        """Wait for the verification; see `Verification.problem`."""
        del used, tell
        problem: asyncio.Future[str | None] = asyncio.get_running_loop().create_future()
        self._waiting[visit.heliostat] = _Waiting(visit, fitted, nominal, problem)
        self.leave(visit.heliostat)
        return await problem

    def leave(self, heliostat: str) -> None:
        """Record that a heliostat has come, or will no longer come."""
        self._coming.discard(heliostat)
        if not self._coming:
            self._complete.set()

    async def make(self) -> None:
        """Verify the waiting heliostats once no others can come; a failure applies to all."""
        await self._complete.wait()
        try:
            await self._confirm()
        except HeliotropeError as error:
            for one in self._waiting.values():
                if not one.problem.done():
                    one.problem.set_exception(error)

    async def _confirm(self) -> None:
        """Verify new parameters; store the sightings of confirmed heliostats in `seen`.

        Heliostats that would make the target too bright are photographed later. Heliostats whose
        beams are hidden by other light come once more, each with its own code. Each series of
        photographs is conclusive for its heliostats, whatever the next series shows.
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
    ) -> tuple[dict[str, str | None], list[str], tuple[str, ...]]:
        """Take one series of photographs.

        Returns
        -------
            Why each heliostat is not confirmed (None if it is); the heliostats that may come once
            more; and the heliostats that wait for another series.
        """
        plant, target = self._visit.plant, self._visit.target
        sun = plant.sun_vector()
        errors = {name: self._waiting[name].error(sun, target) for name in names}
        layout, waits = verifying(plant, target, errors, self._coded.settings, own=own)
        problems: dict[str, str | None] = dict(layout.left_out)
        if not layout.names:
            return problems, [], waits
        again = CodedVisit(plant, self._visit.mandate, layout.names, target)
        paths = {n: plant.misled(n, point) for n, point in layout.start().items()}
        text = "with the new parameters the path to the verification photograph is not free"
        again.drop({name: f"{text}: {why}" for name, why in paths.items() if why})
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
