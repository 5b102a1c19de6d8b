"""A live plant whose groups have different kinds of mechanism (Grigoriev's point: any of them)."""

import asyncio
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from heliotrope.field.formats.plant_file import read_plant, write_plant
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.orders.authority import Person, Role
from support.live import LiveOptions, LivePlant
from support.six_kinds import BUILDERS, mixed

MRAD = 1e-3
#: Then every heliostat of these layouts has a way past the receiver.
START = datetime(2026, 1, 10, 7, 0, tzinfo=UTC)
SIX = [kind for kind in BUILDERS if kind != "two_jacks"]


def test_every_kind_of_mechanism_is_learnt_live(tmp_path: Path) -> None:
    """Six groups of six kinds are raised, photographed at two visits each, and learnt."""
    write_plant(mixed(SIX), tmp_path / "six.toml")
    design = read_plant(tmp_path / "six.toml")

    async def main(clock: VirtualClock) -> None:
        options = LiveOptions(rendered=False, threads=0, together=True)
        async with LivePlant(design, clock, options).running() as plant:
            before, done = plant.errors(), Counter[str]()
            end = clock.monotonic() + 1200.0
            while min(done[name] for name in plant.names) < 2 and clock.monotonic() < end:
                await asyncio.sleep(10.0)
                results = plant.operations.automatic.view().results
                done = Counter(entry.heliostat for entry in results if entry.good)
            assert min(done[name] for name in plant.names) >= 2, [e.text for e in results]
            plant.operations.switch_calibration(Person("operator", Role.OPERATOR), on=False)
            await asyncio.sleep(90.0)
            assert plant.operations.summary().states == {"TRACKING": len(plant.names)}
            assert np.median(before) > 5 * MRAD
            assert np.median(plant.errors()) < 0.1 * np.median(before)
            for name in plant.names:
                assert any(
                    k.endswith("_bias") for k in plant.operations.viewer.heliostat(name).parameters
                )

    run_virtual(main, start=START)


@pytest.mark.parametrize("kind", list(BUILDERS))
def test_boards_of_every_kind_track(kind: str) -> None:
    """Two groups, on firmware-true boards that store perfect mechanisms."""
    design = mixed(["azimuth_elevation", kind])

    async def main(clock: VirtualClock) -> None:
        options = LiveOptions(
            rendered=False,
            threads=0,
            boards=True,
            installed=lambda nominal: nominal,
            work=AutomaticSettings(wanted=True, calibrate=False),
        )
        async with LivePlant(design, clock, options).running() as plant:
            end = clock.monotonic() + 400.0
            while plant.operations.summary().states != {"TRACKING": 2} and clock.monotonic() < end:
                await asyncio.sleep(5.0)
            await asyncio.sleep(10.0)
            assert (plant.errors() < 0.2 * MRAD).all(), plant.errors()

    run_virtual(main, start=START)
