"""Firmware versions of boards, compared with the one that the plant expects."""

from pathlib import Path
from typing import Any

import pytest

from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import Ask
from heliotrope.plant.field import firmware
from heliotrope.plant.settings import PlantSettings
from heliotrope.safety import alarms
from support.plant_bench import Bench, running


def here(name: str, version: int, serial: int = 7) -> dict[str, Any]:
    """One answer to a search of the bus."""
    return {"name": name, "firmware": version, "serial": serial, "address": 1, "expected": 1}


def named(bench: Bench) -> dict[str, str]:
    """Texts of the alarms that have not ended, by cluster."""
    kind = alarms.FIRMWARE_DIFFERS.name
    last = {a.subject: a for a in bench.plant.alarms if a.condition == kind}
    return {name: a.text for name, a in last.items() if a.active}


def test_boards_with_another_version_are_named_until_they_have_the_expected_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(firmware, "SEARCH", 90.0)

    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path, settings=PlantSettings(firmware=12))
        for name, cluster in bench.clusters.items():
            cluster.found = [here(each, 12) for each in cluster.names]
            if name == "pod-2":
                cluster.found = [here("P2A", 11), here("", 12), here("", 9, serial=99)]
        bench.clusters["pod-3"].found = None  # it cannot search now
        async with running(bench):
            await bench.wait(10.0)
            odd = bench.clusters["pod-2"]
            assert named(bench).keys() == {"pod-2"}
            text = "cluster pod-2: P2A (11), serial number 99 (9) do not have firmware version"
            assert named(bench)["pod-2"].startswith(f"{text} 12")
            assert [ask.what for ask in odd.of(Ask)].count("discover") == 1
            odd.found = [here("P2A", 12)]
            bench.clusters["pod-3"].found = [here("P3A", 3)]
            line = bench.lines["pod-2"]
            line.cut()
            await bench.wait(20.0)
            line.heal()
            await bench.wait(30.0)
            assert named(bench).keys() == set()
            await bench.wait(60.0)
            assert named(bench).keys() == {"pod-3"}, "it was asked again"
            # A bus that was searched is not searched again before its cluster connects.
            assert [ask.what for ask in odd.of(Ask)].count("discover") == 2

    run_virtual(main)


def test_no_bus_is_searched_where_no_version_is_expected(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        async with running(Bench(clock, tmp_path)) as bench:
            await bench.wait(10.0)
            asked = [ask.what for cluster in bench.clusters.values() for ask in cluster.of(Ask)]
            assert "discover" not in asked

    run_virtual(main)
