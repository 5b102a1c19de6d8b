"""Independent witnesses of the sun: a time or a site that is wrong in plant and clusters alike."""

import asyncio
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest

from heliotrope.calibration.record import HeliostatCalibration
from heliotrope.calibration.sightings import camera_target
from heliotrope.field.example import example_plant
from heliotrope.geometry import direction
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.gpsd import Gpsd
from heliotrope.mechanism.tracking import track
from heliotrope.plant.field.witnesses import PHOTOGRAPHS, SatelliteWitness, SunSensorFile, Witnesses
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.plant.orders.guards import Asked
from heliotrope.plant.refusals import NOT_NOW
from heliotrope.plant.settings import PlantSettings
from heliotrope.safety import Alarm, Severity
from heliotrope.store.keeper import Keeper
from heliotrope.sun import Site, fast_vector
from heliotrope.twin.live import World
from support.live import START, LivePlant, live
from support.plant_bench import OPERATOR, Bench, running

SENSOR = "sun sensor"
DAY = 86_400.0


class Day:
    """Witnesses of a plant, and its time."""

    def __init__(self, names: frozenset[str] | None) -> None:
        self.design = example_plant()
        self.site = self.design.site
        noon = 12.0 * 3600.0 - self.site.longitude_deg * 240.0
        self.utc = 1_781_913_600.0 + noon - 7200.0  # two hours before noon
        self.told: list[Alarm] = []
        self.witnesses = Witnesses(names, self.site, lambda: self.utc, self.told.append)

    def sun(self, late: float = 0.0, site: Site | None = None) -> np.ndarray:
        """The sun of a clock that is not ``late`` s behind, where the plant's is."""
        return fast_vector(self.utc + late, site or self.site)

    def standing(self) -> dict[str, Severity]:
        """Alarms that have not ended, by condition."""
        last = {(a.condition, a.subject): a for a in self.told}
        return {condition: a.severity for (condition, _), a in last.items() if a.active}

    def photograph(self, name: str, late: float, calibrated: float = -DAY) -> None:
        """Photograph a beam that tracks the middle of a target by a clock that is late."""
        group, row = self.design.find(name)
        mechanism = group.mechanism[np.array([row])]
        target = self.design.targets[0].center
        goal = track(mechanism.armature, self.sun()[None], target[None], drives=mechanism.drives)
        counts = goal.best_counts
        pose = mechanism.pose(counts)
        true = self.sun(late)
        beam = 2.0 * (pose.normal[0] @ true) * pose.normal[0] - true
        normal = self.design.targets[0].normal
        way = float((target - pose.vertex[0]) @ normal / (beam @ normal))
        spot = pose.vertex[0] + way * beam
        seen = camera_target(0, counts, self.sun()[None], spot[None], time=self.utc)
        record = HeliostatCalibration(
            name, self.utc + calibrated, ("tilt_north",), np.zeros(1), np.eye(1), np.ones(1)
        )
        self.witnesses.photographed(record, mechanism, seen)


def test_none_joins_before_a_witness_has_agreed_and_each_day_anew() -> None:
    day = Day(frozenset({SENSOR}))
    assert (
        "none of its witnesses (sun sensor) has confirmed the sun position today"
        in day.witnesses.refusal
    )
    day.witnesses.on_second(0.0)
    assert day.standing() == {"unwitnessed": Severity.ALARM}
    day.witnesses.take("another", day.sun(), 0.0)
    assert day.witnesses.refusal, "it is not one of those that count"
    day.witnesses.take(SENSOR, day.sun(), 0.0)
    assert day.witnesses.refusal is None
    assert day.standing() == {}
    day.utc += DAY
    assert day.witnesses.refusal
    count = len(day.told)
    for _ in range(3):
        day.witnesses.on_second(0.0)
    assert len(day.told) == count + 2, "it says so once a day, and that it begins anew"


@pytest.mark.parametrize("late", [600.0, -600.0])
def test_a_common_time_that_is_wrong_is_named_and_none_joins(late: float) -> None:
    day = Day(frozenset({SENSOR}))
    day.witnesses.take(SENSOR, day.sun(), 5e-3)
    day.witnesses.take(SENSOR, day.sun(late), 5e-3)
    assert day.standing() == {"sun_contradicted": Severity.ALARM}
    (alarm,) = [a for a in day.told if a.active and a.condition == "sun_contradicted"]
    seconds = float(alarm.text.partition("a clock that is ")[2].partition(" s ")[0])
    assert seconds == pytest.approx(600.0, abs=10.0)
    assert ("slow" if late > 0.0 else "fast") in alarm.text
    assert "sun sensor sees the sun" in day.witnesses.refusal
    day.witnesses.take(SENSOR, day.sun(), 5e-3)
    assert day.standing() == {}
    assert day.witnesses.refusal is None


def test_a_common_site_that_is_wrong_contradicts_a_satellite_receiver() -> None:
    async def main(clock: VirtualClock) -> None:
        design = example_plant()
        gpsd = Gpsd(clock)
        witness = SatelliteWitness(gpsd, clock)
        assert await witness.sun(design.site) is None
        for east, late, agrees in ((0.0, 0.0, True), (0.5, 0.0, False), (0.0, 600.0, False)):
            await asyncio.sleep(10.0)
            told: list[Alarm] = []
            names = frozenset({witness.name})
            utc = lambda: clock.utc().timestamp()  # noqa: E731
            witnesses = Witnesses(names, design.site, utc, told.append)
            at = clock.utc() + timedelta(seconds=late)
            lon = design.site.longitude_deg + east
            gpsd.hear(
                f'{{"class":"TPV","mode":3,"time":"{at.isoformat()}",'
                f'"lat":{design.site.latitude_deg},"lon":{lon},"altHAE":0.0}}\n'.encode()
            )
            seen = await witness.sun(design.site)
            assert seen is not None
            witnesses.take(witness.name, *seen)
            assert (witnesses.refusal is None) is agrees

    run_virtual(main)


def test_two_photographs_show_a_wrong_time_and_one_does_not() -> None:
    day = Day(frozenset({PHOTOGRAPHS}))
    first, second = day.design.names[:2]
    day.photograph(first, 120.0)
    assert day.standing() == {}, "that mirror may have moved"
    day.photograph(first, 120.0)
    assert day.standing() == {}
    day.photograph(second, 120.0)
    assert day.standing() == {"sun_contradicted": Severity.ALARM}
    assert (
        "mrad from where the plant computes it, which corresponds to a clock that is 1"
        in day.witnesses.refusal
    )
    # What two mirrors have contradicted, one does not settle, however often; two do.
    day.photograph(second, 0.0)
    day.photograph(second, 0.0)
    assert day.standing() == {"sun_contradicted": Severity.ALARM}
    day.photograph(first, 0.0)
    assert day.standing() == {}
    assert day.witnesses.refusal is None


def test_what_was_learnt_today_is_no_witness() -> None:
    day = Day(frozenset({PHOTOGRAPHS}))
    day.photograph(day.design.names[0], 0.0, calibrated=-3600.0)
    assert day.witnesses.refusal
    day.photograph(day.design.names[0], 0.0)
    assert day.witnesses.refusal is None


def test_mirrors_that_miss_each_in_its_own_direction_are_no_contradiction() -> None:
    day = Day(frozenset({PHOTOGRAPHS}))
    day.photograph(day.design.names[0], 120.0)
    day.photograph(day.design.names[1], -120.0)
    assert day.standing() == {}
    assert day.witnesses.refusal


def test_a_plant_without_a_witness_says_so_once_a_day_unless_that_is_accepted() -> None:
    day, accepted = Day(frozenset()), Day(None)
    for each in (day, accepted):
        each.utc -= 8.0 * 3600.0
        each.witnesses.on_second(0.0)
        assert each.told == [], "it is night"
        each.utc += 8.0 * 3600.0
        each.witnesses.on_second(0.0)
        each.witnesses.on_second(0.0)
        assert each.witnesses.refusal is None
    assert day.standing() == {"unwitnessed": Severity.WARNING}
    assert accepted.told == []


def test_a_plant_sends_beams_to_targets_only_until_a_witness_agrees(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        settings = replace(PlantSettings(), witnesses=frozenset({SENSOR}))
        async with running(Bench(clock, tmp_path, settings=settings)) as bench:
            plant, cluster = bench.plant, bench.cluster_of("P5A")
            token = await bench.commanded()
            sun = lambda late: fast_vector(clock.utc().timestamp() + late, plant.design.site)  # noqa: E731
            plant.aim(OPERATOR, token, plant.default_aims(("P5B",)))
            plant.aim(OPERATOR, token, {"P5A": np.asarray(plant.design.targets[0].center)})
            cluster.set(states.IDLE, "P5A", "P5B")
            await bench.wait(2.0)
            ticket = plant.command(OPERATOR, token, "TRACK", ("P5A", "P5B"))
            assert ticket.blocked.keys() == {"P5B"}
            assert "no independent witness confirms this plant's sun" in ticket.blocked["P5B"]
            assert not plant.guards.reasons(Asked("APPROACH", ("P5A",)), NOT_NOW)
            plant.witnesses.take(SENSOR, sun(600.0), 0.0)
            assert (
                "a clock that is"
                in plant.guards.reasons(Asked("APPROACH", ("P5A",)), NOT_NOW)["P5A"]
            ), "nothing leaves stow by it"
            with pytest.raises(RefusedError, match=r"TRACK P5B.*a clock that is 6\d\d s slow"):
                plant.command(OPERATOR, token, "TRACK", ("P5B",))
            plant.witnesses.take(SENSOR, sun(0.0), 0.0)
            assert not plant.guards.reasons(Asked("APPROACH", ("P5A",)), NOT_NOW)
            assert await plant.command(OPERATOR, token, "TRACK", ("P5B",)).end(5.0)

    run_virtual(main)


def test_a_file_of_a_sun_sensor_counts_when_it_is_replaced(tmp_path: Path) -> None:
    file, site = tmp_path / "sun", example_plant().site
    witness = SunSensorFile(file)

    def read() -> np.ndarray | None:
        seen = asyncio.run(witness.sun(site))
        return None if seen is None else seen[0]

    assert read() is None
    file.write_text("180.0 45.0")
    assert read() is None, "it may be old"
    assert read() is None
    for text, good in (("181.5 44.0\n", True), ("181.5", False), ("1 -2", False), ("x", False)):
        beside = tmp_path / "new"
        beside.write_text(text)
        beside.replace(file)
        seen = read()
        assert (seen is not None) is good, text
        if seen is not None:
            np.testing.assert_allclose(seen, direction(*np.radians((181.5, 44.0))))


def test_a_common_wrong_time_keeps_a_calibrated_field_off_the_receiver(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Plant, clusters and boards agree, and every beam goes beside its aim."""
    keeper = Keeper(tmp_path / "store.sqlite", inline=True)
    required = PlantSettings(witnesses=frozenset({PHOTOGRAPHS}))
    late, joined, versions = 0.0, [], []

    def sun(world: World) -> np.ndarray:
        return fast_vector(world.clock.utc().timestamp() + late, world.design.site)

    async def learn(plant: LivePlant) -> None:
        await asyncio.sleep(500.0)
        assert all(plant.plant.beliefs.record(name) is not None for name in plant.names)

    async def look(plant: LivePlant) -> None:
        await asyncio.sleep(400.0)
        on = [
            one
            for one in map(plant.operations.viewer.heliostat, plant.names)
            if one.on == "receiver"
        ]
        joined.append(len([one for one in on if one.state == "TRACKING"]))
        told = {a.condition for a in plant.operations.logbook.alarms() if a.active}
        assert ("sun_contradicted" in told) is bool(late), told
        assert "beam_blocked" not in told, "it is no matter of single heliostats"
        versions.append([plant.plant.beliefs.record(name).version for name in plant.names])

    monkeypatch.setattr(World, "sun", sun)
    work = AutomaticSettings(wanted=True)
    live(learn, work, records=keeper)
    for day, wrong in enumerate((0.0, 45.0), start=1):
        late = wrong
        live(look, work, records=keeper, plant=required, start=START + timedelta(days=day))
    keeper.close()
    assert joined[0] > 0
    assert joined[1] == 0
    assert versions[0] == versions[1], "nothing was learnt from the wrong sun"
