"""Two plants with the same keys: a cluster belongs to one run at a time."""

import asyncio

from heliotrope.cluster._runs import GONE, PATIENCE, PlantRuns
from heliotrope.links.messages import Lease, Stage, decode, encode
from support.clusters import Field, run

OTHER = 0x1234


def test_a_run_waits_until_the_lease_of_the_other_has_ended() -> None:
    runs = PlantRuns()
    assert runs.admits("first", 0.0)
    runs.took("first", 0.0, 3.0)
    assert not runs.admits("second", 2.9)
    # One that had not asked before may have it at once, the other one some seconds later.
    assert runs.admits("third", 3.0)
    assert not runs.admits("second", 3.0 + PATIENCE - 0.1)
    assert runs.admits("second", 3.0 + PATIENCE)
    runs.took("second", 3.0 + PATIENCE, 6.0 + PATIENCE)
    assert runs.holder == "second"
    assert runs.blocked == ()


def test_a_plant_that_was_silent_for_a_while_keeps_its_cluster() -> None:
    runs = PlantRuns()
    runs.took("first", 0.0, 3.0)
    assert not runs.admits("second", 2.0)
    assert not runs.admits("second", 8.0)
    assert runs.admits("first", 9.0)
    runs.took("first", 9.0, 12.0)
    assert runs.blocked == ("second",)


def test_a_run_that_asked_while_another_renewed_is_barred_for_good() -> None:
    runs = PlantRuns()
    runs.took("first", 0.0, 3.0)
    assert not runs.admits("second", 0.5)
    assert runs.blocked == ()
    runs.took("first", 1.0, 4.0)
    assert runs.blocked == ("second",)
    assert not runs.admits("second", 500.0)
    assert runs.second_plants(500.0) == ("second",)
    assert runs.second_plants(500.0 + GONE) == ()
    # The first one only froze; and a restart gives the second plant another name.
    assert runs.admits("first", 500.0)
    assert runs.admits("third", 500.0)


def test_who_returns_to_a_cluster_that_has_changed_hands_is_barred() -> None:
    runs = PlantRuns()
    runs.took("first", 0.0, 3.0)
    runs.took("second", 4.0, 7.0)
    assert not runs.admits("first", 4.5)
    runs.took("second", 5.0, 8.0)
    assert runs.blocked == ("first",)


def test_a_plant_without_a_name_waits_too_and_is_never_barred() -> None:
    runs = PlantRuns()
    runs.took("first", 0.0, 3.0)
    assert not runs.admits("", 1.0)
    runs.took("first", 1.0, 4.0)
    assert runs.blocked == ()
    assert not runs.admits("", 2.0)
    over = 4.0 + PATIENCE
    assert runs.admits("", over)
    runs.took("", over, over + 3.0)
    assert not runs.admits("first", over + 1.0)


def test_few_barred_runs_are_remembered() -> None:
    runs = PlantRuns()
    runs.took("first", 0.0, 3.0)
    for i in range(20):
        assert not runs.admits(f"{i}", 1.0)
        runs.took("first", 1.0, 4.0)
    assert runs.blocked == tuple(f"{i}" for i in range(4, 20))


def test_an_older_plant_gives_no_name_and_an_older_cluster_ignores_one() -> None:
    assert decode(b'{"kind":"lease","version":1,"token":7}') == Lease(7)
    assert b'"run":"r"' in encode(Lease(7, run="r"))


def test_a_second_plant_commands_nothing_but_defocus() -> None:
    """It shares the line, as two plants do at one broker."""

    async def main(field: Field) -> None:
        plant = field.plant
        await asyncio.sleep(4.0)
        assert plant.status().run == "first"
        for _ in range(3):
            await plant.send(Lease(OTHER, run="second"))
            await asyncio.sleep(0.4)
            await field.order("theirs", "LOCK", token=OTHER)
            await asyncio.sleep(0.6)
        assert "the token is out of date" in plant.text("theirs")
        assert field.states() == ["TRACKING", "TRACKING"]
        (alarm,) = plant.alarms("two_plants")
        assert "run second; the cluster belongs to run first" in alarm.text
        await asyncio.sleep(1.0)
        assert plant.status().barred == ("second",)
        await field.order("ours", "AIM", 0.0, 0.0, 51.0)
        await field.until(lambda: Stage.DONE in plant.stages("ours", "A1"), 5.0)
        await field.emergency("off", "DEFOCUS")
        await field.until(lambda: field.states() == ["DEFOCUSED", "DEFOCUSED"], 3.0)
        await field.until(lambda: not plant.alarms("two_plants")[-1].active, GONE + 5.0)

    run(main, "TRACKING")


def test_a_cluster_whose_plant_has_gone_takes_another() -> None:
    async def main(field: Field) -> None:
        plant = field.plant
        await asyncio.sleep(4.0)
        plant.run, plant.token = "second", OTHER
        await field.until(lambda: plant.status().run == "second", 6.0 + PATIENCE)
        await field.order("ours", "LOCK", heliostats=("A1",), token=OTHER)
        await field.until(lambda: Stage.DONE in plant.stages("ours", "A1"), 5.0)
        assert plant.status().barred == ()
        assert not plant.alarms("two_plants")

    run(main, "TRACKING")
