"""The receiver visit: heliostats are measured while they track a receiver.

A few dozen heliostats that track the receiver move their beams by a milliradian, each by its own
code, while all others keep tracking. A camera observes the receiver. The movements are ordinary
orders of the plant, each checked before it is sent; the plant moves the beams back to their aims
whatever happens to the visit (`movements`). A heliostat leaves the receiver only for new parameters
that justify it, a few heliostats at a time, and only if no photograph must confirm them. Changes
that need confirmation, and heliostats with any fault, are left to a visit to a target.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from heliotrope.errors import InputError
from heliotrope.field.coded_visits import ReceiverSettings
from heliotrope.field.target import Target
from heliotrope.imaging.targets.view import posed_view
from heliotrope.lcu import states
from heliotrope.plant.controller import PlantController
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.plant.visits.calibration_cycle import CalibrationCycle, CycleResult, Leaving
from heliotrope.plant.visits.coded_cycle import CodedCycle, Light, Move, of_each
from heliotrope.plant.visits.coded_layout import Layout
from heliotrope.plant.visits.coded_visit import CodedVisit, Returned
from heliotrope.plant.visits.photographs import Photographs, Tell
from heliotrope.plant.visits.receiver_layout import arranged_on
from heliotrope.plant.visits.target_light import Exposed, LightCamera, light_on
from heliotrope.plant.visits.visit import Visit

#: Time limits for a movement, and for the return to the aims, s.
_ORDER, _BACK = 20.0, 60.0
#: Number of photographs that show whether sunlight is steady, and the interval between them, s.
_LOOKS, _BETWEEN = 3, 2.0
#: Smallest fraction of the receiver that a photograph must show below full scale.
_SEEN = 0.5


class ReceiverCycle(CodedCycle):
    """Calibration of heliostats that track a receiver; all others keep tracking undisturbed.

    Parameters
    ----------
    plant, camera, cycle
        See `CodedCycle`.
    settings
        See `ReceiverSettings`.

    Attributes
    ----------
    settings
        As given.
    """

    kind, comes = "receiver visit", False
    settings: ReceiverSettings

    def __init__(
        self,
        plant: PlantController,
        camera: LightCamera,
        cycle: CalibrationCycle,
        settings: ReceiverSettings,
    ) -> None:
        super().__init__(plant, camera, cycle)
        self.settings = settings

    def face(self, name: str) -> Target:
        """Return the face of a receiver; raise UnknownNameError if there is no such receiver."""
        return self._plant.design.receiver(name).face

    def _arranged(self, face: Target, names: tuple[str, ...]) -> Layout:
        return arranged_on(self._plant, face, names, self.settings)

    @contextlib.asynccontextmanager
    async def _stay(
        self, visit: CodedVisit, layout: Layout, light: Light, tell: Tell
    ) -> AsyncIterator[Move]:
        plant, moving = self._plant, visit.names
        light.view = posed_view(plant.design.camera(self.settings.camera), layout.target)
        with plant.stepping.fine(moving), plant.movements.ending(moving):
            light.usual = await self._steady(layout.target, light, tell)
            light.steady = self.settings.steady
            coarse = plant.stepping.coarse(visit.names, plant.now())
            visit.drop(dict.fromkeys(coarse, "it does not take fine steps"))
            yield partial(visit.move, limit=_ORDER)
        tell("back to the aims")
        until = plant.now() + _BACK
        while plant.now() < until and plant.movements.names & set(moving):
            await visit.look()

    async def _exposed(self, face: Target, light: Light) -> Exposed:
        """Photograph the receiver; the photograph is the mean of several frames."""
        frames = [
            await light_on(self._camera, face, light.view) for _ in range(self.settings.exposures)
        ]
        seen = np.logical_and.reduce([frame.seen for frame in frames])
        if seen.mean() < _SEEN:
            raise InputError(
                f"camera {self.settings.camera}: {100.0 * seen.mean():.0f} % of {face.name} is "
                "below full scale in its frames; shorten its exposure"
            )
        values = np.mean([frame.values / frame.exposure for frame in frames], axis=0)
        at = float(np.mean([frame.at for frame in frames]))
        return Exposed.read(replace(frames[0], values=values, seen=seen, exposure=1.0, at=at))

    async def _learn(
        self,
        visit: CodedVisit,
        layout: Layout,
        proven: Mapping[str, Photographs],
        light: Light,
        tell: Tell,
    ) -> dict[str, CycleResult]:
        """Learn from each identified beam; heliostats that leave the receiver return later."""
        del layout, light, tell
        plant = self._plant
        lit = plant.field.among((states.TRACKING,), plant.now())
        away = asyncio.Semaphore(max(1, int(self.settings.power * lit.sum())))

        async def one(name: str) -> CycleResult:
            async with contextlib.AsyncExitStack() as stack:

                async def leave(mirror: Visit) -> None:
                    await stack.enter_async_context(away)
                    back = Returned(plant, visit.mandate, (name,), visit.target)
                    await stack.enter_async_context(back)
                    await mirror.command("IDLE")

                leaving = Leaving(self.settings.worth, leave)
                return await self._learnt(visit, name, proven[name], leaving=leaving)

        return await of_each(proven, one)

    async def _steady(self, face: Target, light: Light, tell: Tell) -> float:
        """Return the brightness of the receiver; raise an error if it changes."""
        tell("checking that the sun is steady")
        seen = []
        for _ in range(_LOOKS):
            seen.append((await light_on(self._camera, face, light.view)).brightness)
            await asyncio.sleep(_BETWEEN)
        change = (max(seen) - min(seen)) / max(*seen, 1e-300)
        if not change <= self.settings.steady:
            raise RefusedError(
                f"{self.kind}: the light on {face.name} changed by {100.0 * change:.0f} % in "
                f"{_LOOKS * _BETWEEN:g} s (limit {100.0 * self.settings.steady:g} %); the visit "
                "starts once the light is steady"
            )
        return float(np.median(seen))
