"""Joint visits to a target of a simulated plant, for tests.

Mirrors drive, clusters poll and the plant commands as in operation; only the light is drawn by the
test's cameras, from where the mirrors truly stand.
"""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from heliotrope.field.example import roughly_installed
from heliotrope.field.layouts import malan_plant
from heliotrope.geometry import bisector, reflect
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.operations.pictures import Pictures
from heliotrope.plant.settings import PlantSettings
from heliotrope.plant.visits import (
    CalibrationCycle,
    Centring,
    CycleResult,
    CycleSettings,
    JointCycle,
    Unhidden,
)
from heliotrope.plant.workers import Worker, at_once
from support.live import LiveOptions, LivePlant
from support.visit_scene import CYCLE, ENGINEER, START, VisitScene, believe, in_command, raised


@dataclass(kw_only=True)
class Scene(VisitScene):
    """A plant whose heliostats are up, and an engineer in command."""

    cycle: JointCycle

    async def run(self, *names: str) -> dict[str, CycleResult]:
        found = await self.cycle.run(ENGINEER, self.token, names or self.names, "left", self.tell)
        return {result.heliostat: result for result in found}

    def lit(self) -> list[str]:
        """Heliostats whose beams are on the target, in truth."""
        target, light = self.live.design.targets[0], self.live.world.sun()
        normals, vertices = self.live.field.stand()
        points = target.intersect(vertices, reflect(light, normals))
        on = target.holds(points)
        return [name for name, here in zip(self.live.names, on, strict=True) if here]


def joint(
    scene: Callable[[Scene], Awaitable[None]],
    count: int = 6,
    *,
    rendered: bool = False,
    settings: PlantSettings | None = None,
    installed: float | None = None,
    cycle: CycleSettings = CYCLE,
    pictures: Pictures | None = None,
    worker: Worker = at_once,
) -> None:
    """Play a scene in virtual time.

    ``installed`` is the scale of the mirrors' errors; None: they are calibrated to 0.3 mrad.
    """

    async def main(clock: VirtualClock) -> None:
        design = malan_plant(count)
        rough = partial(roughly_installed, seed=3, scale=0.03 if installed is None else installed)
        work = AutomaticSettings(wanted=True, calibrate=False)
        options = LiveOptions(
            rendered=rendered,
            threads=0,
            installed=rough,
            work=work,
            cycle=cycle,
            plant=settings or PlantSettings(),
        )
        live = LivePlant(design, clock, options, pictures=pictures)
        plant = live.plant
        async with live.running():
            try:
                await raised(live)
                if installed is None:
                    believe(live, 3e-4)
                unhidden = Unhidden(plant, worker)
                whole = CalibrationCycle(plant, live.cameras, cycle, Centring(), unhidden, worker)
                token = plant.take_authority(ENGINEER).token
                joint_cycle = JointCycle(plant, live.cameras, whole)
                made = Scene(live=live, token=token, cycle=joint_cycle)
                await in_command(made, lambda: scene(made))
            finally:
                await live.operations.automatic.halt()
                await live.end()

    run_virtual(main, start=START)


def spoil(scene: Scene, stuck: str = "", traded: tuple[str, ...] = ()) -> None:
    """From the first photograph on a mirror stands still, and two send their beams crosswise."""
    live, target = scene.live, scene.live.design.targets[0]
    true, held, aims = live.field.stand, {}, []

    def during(stage: str) -> None:
        if stage.startswith("photograph 1 ") and not aims:
            aims.append(live.plant.aims.copy())  # before the first movement

    scene.during = during

    def stand() -> tuple[np.ndarray, np.ndarray]:
        normals, vertices = (np.array(each) for each in true())
        if scene.photographs():
            light = live.world.sun()
            if stuck:
                row = live.names.index(stuck)
                normals[row] = held.setdefault(stuck, normals[row].copy())
            rows = [live.names.index(name) for name in traded]
            points = target.intersect(vertices, reflect(light, normals))
            places = [live.plant.field.place(name) for name in traded]
            for row, mine, other in zip(rows, places, places[::-1], strict=True):
                there = points[row] + aims[0][other] - aims[0][mine]
                way = there - vertices[row]
                normals[row] = bisector(light, way / np.linalg.norm(way))
        return normals, vertices

    live.field.stand = stand  # type: ignore[method-assign]
