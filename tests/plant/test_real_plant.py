"""The whole of a real plant but its hardware: photographs through sources, fits, pushes, stow.

Clusters and mirrors are the twin's, in real time; plant, cameras and reading are those of
`heliotrope run --clusters`.
"""

import asyncio
import threading
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from heliotrope.field.camera import Camera
from heliotrope.field.layouts import malan_plant
from heliotrope.field.plant import Plant
from heliotrope.imaging.sources import SimulatedSource, Source
from heliotrope.imaging.synthetic.rendering import render
from heliotrope.imaging.synthetic.scenes import exposed
from heliotrope.links.clock import SystemClock
from heliotrope.plant.assembly import AssemblySettings, PlantAssembly
from heliotrope.plant.audit import JsonLines
from heliotrope.plant.cameras import RealCameras
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.twin.drawing import PEAK
from heliotrope.twin.live import World
from support.live import in_thread

#: Heliostats that must have learnt, and the time for it, s.
LEARNT, PATIENCE = 2, 200.0


def at_noon() -> Plant:
    """A small plant where the sun stands in the meridian now."""
    design, now = malan_plant(32), datetime.now(UTC)
    longitude = (12.0 - now.hour - now.minute / 60.0) * 15.0
    return replace(design, site=replace(design.site, longitude_deg=longitude))


def drawn(world: World) -> Any:
    """Return what makes sources that draw what is on a target now, a frame a second."""

    def made(camera: Camera, folder: Path, stop: threading.Event) -> Source:
        target = world.design.target(camera.targets[0])
        (scene,) = (s for s in world.cameras._scenes.values() if s.camera.name == camera.name)

        def frame(_: datetime) -> Any:
            stop.wait(1.0)
            at = datetime.now(UTC)
            lit = exposed(replace(scene, beams=world.cameras.beams(target)), PEAK)
            seed = int(at.timestamp() * 1e3) % (1 << 31)
            return replace(render(lit, seed, name=camera.name, time=at).frame, time_deviation=0.05)

        return SimulatedSource(frame, lambda: datetime.now(UTC), stop=stop)

    return made


@pytest.mark.slow
def test_a_real_plant_learns_from_its_cameras(tmp_path: Path) -> None:
    async def main() -> dict[str, tuple[float, float]]:
        clock, design = SystemClock(), at_noon()
        world = World(design, clock)
        cameras = RealCameras(
            design,
            tmp_path,
            clock,
            memory=tmp_path / "m",
            sources=drawn(world),
            worker=in_thread,
        )
        # As in simulation, but for its cameras, and nobody knows the truth.
        audit = JsonLines(tmp_path / "audit.jsonl", clock.utc())
        ports = replace(world.ports(audit=audit), cameras=cameras, truth=None, worker=in_thread)
        settings = AssemblySettings(AutomaticSettings(wanted=True))
        async with PlantAssembly(design, ports, settings).running() as plant:
            before = world.errors()
            async with asyncio.timeout(PATIENCE):
                while plant.operations.calibration().done < LEARNT:
                    await asyncio.sleep(0.5)
            after = world.errors()
            rows = np.flatnonzero(np.isfinite(plant.operations.automatic.book.error))
            found = {str(row): (float(before[row]), float(after[row])) for row in rows}
            assert await plant.stowed()
            assert plant.left() == ""
            await plant.end()
        return found

    found = asyncio.run(main())
    print(found)
    assert len(found) >= LEARNT
    # One target tells not everything: but every mirror stands better than it was installed.
    assert np.median([after for _, after in found.values()]) < 2e-3
    assert list((tmp_path / "m").glob("*.npz"))
