"""Neighbours that hide a part of a mirror from its calibration in a running plant."""

from collections.abc import Awaitable, Callable
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from typing import Any, TypeVar

import numpy as np
import pytest

from heliotrope.calibration.evaluation import beam_errors
from heliotrope.calibration.sightings import camera_target
from heliotrope.field.example import roughly_installed
from heliotrope.field.layouts import malan_plant
from heliotrope.geometry import reflect
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.plant import assembly
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.visits import CalibrationCycle, JointCycle, Shot, Unhidden
from heliotrope.plant.visits.neighbours import Standing
from support.live import LiveOptions, LivePlant
from support.visit_scene import CYCLE, ENGINEER, VisitScene, believe, in_command, raised

T = TypeVar("T")

MRAD = 1e-3
#: The sun stands 20° high: neighbours hide 28 to 37 % of the mirrors in the second row.
EARLY = datetime(2026, 10, 21, 5, 30, tzinfo=UTC)


def missed(live: LivePlant, name: str) -> float:
    """How far the beam of a mirror truly is from where it is believed to be, rad."""
    row = live.names.index(name)
    normals, vertices = live.field.stand()
    target, light = live.design.target("left"), live.world.sun()
    counts = live.plant.field.posed[[live.plant.field.place(name)]]
    true = target.intersect(vertices[row], reflect(light, normals[row]))
    seen = camera_target(0, counts, light[None], true[None])
    return float(beam_errors(live.plant.beliefs.present(name), seen).beam[0])


class Counted:
    """Where shifts are computed: counts them."""

    def __init__(self) -> None:
        self.count = 0

    async def __call__(self, work: Callable[..., Any], *given: Any) -> Any:
        self.count += 1
        return work(*given)


def early(scene: Callable[[LivePlant, int], Awaitable[None]]) -> None:
    """Play a scene with six mirrors that track the receiver at a low sun."""

    async def main(clock: VirtualClock) -> None:
        options = LiveOptions(
            rendered=False,
            threads=0,
            installed=partial(roughly_installed, seed=3, scale=0.03),
            work=AutomaticSettings(wanted=True, calibrate=False),
            cycle=CYCLE,
            centroid=1e-6,
        )
        live = LivePlant(malan_plant(6), clock, options)
        async with live.running():
            plant = live.plant
            try:
                await raised(live)
                believe(live, 3e-4)
                token = plant.take_authority(ENGINEER).token
                await in_command(VisitScene(live, token), lambda: scene(live, token))
            finally:
                await live.operations.automatic.halt()
                await live.end()

    run_virtual(main, start=EARLY)


def test_mirrors_in_the_shade_of_neighbours_are_calibrated_as_if_they_were_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    left: dict[str, float] = {}
    made: list[CalibrationCycle] = []

    def making(*given: Any) -> CalibrationCycle:
        made.append(CalibrationCycle(*given))
        return made[0]

    monkeypatch.setattr(assembly, "CalibrationCycle", making)

    async def scene(live: LivePlant, token: int) -> None:
        plant, few = live.plant, replace(CYCLE, shots=1)
        for name, corrects in (("P0001F", None), ("P0001C", made[0].unhidden)):
            cycle = CalibrationCycle(plant, live.cameras, few, unhidden=corrects)
            result = await cycle.run(ENGINEER, token, name, "left")
            assert result.outcome.calibrated, result.text
            left[name] = missed(live, name)
        joint = JointCycle(plant, live.cameras, cycle)
        for result in await joint.run(ENGINEER, token, ("P0001D", "P0001E"), "left"):
            assert result.outcome.calibrated, result.text
            left[result.heliostat] = missed(live, result.heliostat)

    early(scene)
    # Without the correction C is 2.6 mrad off, and E 1.1.
    assert left["P0001F"] > 1.5 * MRAD
    assert left["P0001C"] < 0.5 * MRAD
    assert left["P0001E"] < 0.5 * MRAD


def test_a_shift_is_computed_where_something_hides_and_is_as_sure_as_the_neighbours_are() -> None:
    async def scene(live: LivePlant, token: int) -> None:
        del token
        plant, target, beside = live.plant, live.design.target("left"), Counted()
        unhidden, standing = Unhidden(plant, beside), Standing.of(plant.field)
        middle = Shot(target.center, plant.now(), 1e-4)

        async def shot(name: str, stood: Standing) -> Shot:
            return await unhidden.shot(target, name, middle, stood)

        def spread(seen: Shot) -> float:
            return float(np.sqrt(np.trace(np.asarray(seen.covariance)) - 3e-4))

        hidden = await shot("P0001C", standing)
        moved = float(np.linalg.norm(hidden.point - target.center))
        assert beside.count == 1
        assert moved > 0.1
        assert 0.25 * moved < spread(hidden) < 0.8 * moved
        # Neighbours that turn, or whose counts are old, may have hidden anything.
        turning = replace(standing, goals=standing.goals + 500.0)
        old = replace(standing, at=standing.at - 100.0)
        for other in (turning, old):
            seen = await shot("P0001C", other)
            assert np.allclose(seen.point, hidden.point)
            assert moved < spread(seen) < 1.5 * moved
        never = replace(standing, at=np.full_like(standing.at, -np.inf))
        assert await shot("P0001C", never) == middle
        # The first row is clear, which no computation has to tell.
        begin = beside.count
        names = [name for name in live.names if await shot(name, standing) is middle]
        assert names
        assert beside.count - begin <= len(live.names) - len(names)
        # A photograph that counts for nothing is left as it is.
        bad = replace(middle, reasons=("cloud",))
        assert await unhidden.shot(target, "P0001C", bad, standing) is bad

    early(scene)
