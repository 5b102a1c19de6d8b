"""The joint visit: many mirrors come to one target, and go home before their beams are told apart.

The empty target is photographed first. New parameters are learnt as after an ordinary visit.

Heliostats that were never calibrated go together, each with a code of its own. Those that store
their first parameters come back together, and a second series of photographs must prove each at
the place that its parameters predict; it is their second sighting.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Mapping, Sequence

from heliotrope.calibration.plan.on_target import LOOKS
from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.field.coded_visits import JointSettings
from heliotrope.field.target import Target
from heliotrope.imaging.coded import Verdict
from heliotrope.plant.attempts import Attempts, RetryLaw
from heliotrope.plant.controller import PlantController
from heliotrope.plant.visits.calibration_cycle import CalibrationCycle, CycleResult
from heliotrope.plant.visits.coded_cycle import CodedCycle, Light, Move, of_each
from heliotrope.plant.visits.coded_layout import Layout
from heliotrope.plant.visits.coded_visit import CodedVisit
from heliotrope.plant.visits.first_layout import newcomers
from heliotrope.plant.visits.fitting import first_model
from heliotrope.plant.visits.joint_layout import arranged, errors_on
from heliotrope.plant.visits.joint_verification import JointVerification
from heliotrope.plant.visits.photographs import Photographs, Tell
from heliotrope.plant.visits.target_light import Exposed, LightCamera, light_on

#: Sightings that a first fit needs: all photographs of a visit agree, and others verify it.
_FIRST = 1
#: Verdicts on a new mirror whose beam may be beside the target: light that does not move at its
#: place may be another one's.
_NOT_FOUND = (Verdict.FAINT, Verdict.ELSEWHERE, Verdict.STUCK)
#: Joint visits that have not proven a heliostat; one whose beam may be beside the target comes
#: again, and aims at another place beside it.
JOINT = RetryLaw(
    "joint visit",
    LOOKS,
    0.0,
    "it goes to a target alone, with a search for its beam",
)


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
        Joint visits that have not proven a heliostat; those given up go alone.
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
        """Return whether a beam that was not found is looked for again in a joint first visit."""
        return 0 < self.attempts.counts.get(heliostat, 0) < LOOKS

    def note(self, result: CycleResult) -> None:
        """Note the result of a visit, joint or alone: whether the heliostat may come together.

        Where the beams of all new mirrors are beside the target, it is as dark as under a cloud:
        they are looked for at the next place, but no cloud ends the search.
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
        """Return whether a visit is one of own codes: some are new, or not known well enough."""
        errors = errors_on(self._plant, target, heliostats, self.settings).values()
        return bool(self.settings.first) and not all(e <= self.settings.known for e in errors)

    def having_place(self, heliostats: Sequence[str], target: str) -> tuple[str, ...]:
        """Return those of some heliostats that have a place in a visit now."""
        return self._arranged(self.face(target), tuple(heliostats))[0].names

    # -- a visit ---------------------------------------------------------------------------

    def face(self, name: str) -> Target:
        """Return a target; raise UnknownNameError if there is none of that name."""
        return self._plant.design.target(name)

    def _arranged(self, face: Target, names: tuple[str, ...]) -> tuple[Layout, dict[str, str]]:
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
        verification = JointVerification(self, self.settings, visit, light, proven, tell)

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

        async with asyncio.TaskGroup() as group:
            results = group.create_task(of_each(proven, one))
            await verification.make()
        return results.result()
