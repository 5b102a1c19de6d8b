"""Commands that move axes by counts are proven too: no beam enters a keep-out volume."""

import asyncio
import re
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from heliotrope.field.example import example_plant
from heliotrope.field.layouts import malan_plant
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver
from heliotrope.field.volumes import Box, Sphere
from heliotrope.geometry import FloatArray, reflect
from heliotrope.lcu import names, states
from heliotrope.lcu.diagnosis import NUDGE
from heliotrope.lcu.stepper import BOTH, PRIMARY_FIRST, Axis, Stepper
from heliotrope.links.clock import VirtualClock, gps_seconds, run_virtual
from heliotrope.links.messages import Emergency, Stage
from heliotrope.mechanism.board_items import items_of
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.machine import AxisLimits, Machine
from heliotrope.mechanism.tracking import track
from heliotrope.optics import MirrorOptics, beams, find_entries
from heliotrope.plant import refusals
from heliotrope.plant.controller import PlantController
from heliotrope.plant.field.aims import BeamCheck, _disc
from heliotrope.plant.field.assigned import rest_on
from heliotrope.plant.motion.defocusing import defocused, order_out
from heliotrope.plant.motion.paths import Paths
from heliotrope.plant.motion.proofs import BeamError, PathProofs
from heliotrope.plant.motion.watch import BeamWatch
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.orders import joining
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.safety import Act
from heliotrope.sun import broadcast_values, vector
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.outfit import MACHINE, RECEIVER, Outfit, outfits, own_items
from heliotrope.twin.field.field import Field
from heliotrope.twin.world.design import design_of
from heliotrope.twin.world.scene import TARGETS, scene_of
from support.live import LiveOptions, LivePlant
from support.plant_bench import ENGINEER, OPERATOR, Bench, running
from support.six_kinds import mixed

#: South of the tower; P5A stands due south of it and shines to the tower.
WALKWAY = Sphere("walkway", (0.0, -12.0, 8.0), 1.0)
SOUTH = np.array([0.0, -1.0, 0.0])
WEST, EAST = (-8.0, 0.0, 8.0), (8.0, 0.0, 16.5)
DESIGN = replace(example_plant(), keep_outs=(WALKWAY,))


def play(folder: Path, scene: Callable[[Bench], Awaitable[None]], design: Plant = DESIGN) -> Bench:
    """Run a scene in virtual time, on a plant that declares the walkway, or on another."""
    made: list[Bench] = []

    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, folder, design=design)
        made.append(bench)
        async with running(bench):
            await scene(bench)

    run_virtual(main)
    return made[0]


def counts(plant: PlantController, name: str, point: tuple[float, float, float]) -> list[int]:
    """The step counts that put the beam of a heliostat on a point."""
    group, row = DESIGN.find(name)
    found = track(group.mechanism[row], plant.sun_vector(), point)
    return [round(float(x)) for x in found.best_counts]


async def stands(bench: Bench, name: str, state: int, at: list[int], seconds: float = 2.0) -> None:
    """Let a heliostat report that it stands at counts."""
    cluster = bench.cluster_of(name)
    cluster.set(state, name)
    row = cluster.names.index(name)
    for end, value in zip(("primary", "secondary"), at, strict=True):
        cluster.rows[end][row] = cluster.rows[f"{end}_goal"][row] = value
    await bench.wait(seconds)


def test_a_move_by_counts_through_a_volume_is_refused(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        token = await bench.commanded(ENGINEER)
        west, east = counts(plant, "P5A", WEST), counts(plant, "P5A", EAST)
        await stands(bench, "P5A", states.IDLE, west)
        text = r"P5A: the beam enters walkway \d+ m from the mirror on its way"
        with pytest.raises(RefusedError, match="GOTO " + text):
            plant.command(ENGINEER, token, "GOTO", ("P5A",), east)
        # One axis alone, right across the middle of it.
        middle = counts(plant, "P5A", (0.0, -12.0, 8.0))
        for axis in (0, 1):
            begin = [n - 200_000 * (axis == i) for i, n in enumerate(middle)]
            await stands(bench, "P5A", states.IDLE, begin)
            with pytest.raises(RefusedError, match="JOG " + text):
                plant.command(ENGINEER, token, "JOG", ("P5A",), (axis, 400_000))
            # Away from it, and a little towards it.
            for steps in (-10_000, 1_000):
                assert await plant.command(ENGINEER, token, "JOG", ("P5A",), (axis, steps)).end(5.0)
                # The next one starts from its end, which no report has shown yet.
                with pytest.raises(RefusedError, match="no report shows where it is now"):
                    plant.command(ENGINEER, token, "JOG", ("P5A",), (axis, steps))
                await bench.wait(2.5)
        await stands(bench, "P5A", states.IDLE, west)
        # One of two: the other is sent.
        ticket = plant.command(ENGINEER, token, "GOTO", ("P5A", "P5B"), east)
        assert not await ticket.end(5.0)
        assert list(ticket.refusals) == ["P5A"]
        # There is no such axis: the local controller says so.
        plant.command(ENGINEER, token, "JOG", ("P5A",), (7, 10))

    bench = play(tmp_path, scene)
    assert [m.heliostats for m in bench.cluster_of("P5A").commands("GOTO")] == [("P5B",)]


#: Far from the walkway, and on the same side of it.
BESIDE, FURTHER = (8.0, 0.0, 16.5), (9.0, 0.0, 17.0)


@pytest.mark.parametrize("last", ["DEFOCUS", "TRACK", "AIM", "STANDBY"])
def test_no_mirror_comes_to_standby_before_it_shows_where_it_is_since_its_last_order(
    last: str, tmp_path: Path
) -> None:
    """Simulated runs 3700096 and 3800145: the way was proven from where it had been before."""

    async def scene(bench: Bench) -> None:
        plant, token = bench.plant, await bench.commanded(ENGINEER)
        await plant.standby(ENGINEER, token, {"P5A": BESIDE, "P5B": BESIDE}).end(5.0)
        await plant.aim(ENGINEER, token, {"P5A": BESIDE, "P5B": BESIDE}).end(5.0)
        state = states.IDLE if last in ("TRACK", "STANDBY") else states.TRACKING
        for name in ("P5A", "P5B"):
            await stands(bench, name, state, counts(plant, name, BESIDE))
        if last == "DEFOCUS":
            plant.defocus("a visit", ["P5A"])
        elif last in ("AIM", "STANDBY"):
            (plant.aim if last == "AIM" else plant.standby)(ENGINEER, token, {"P5A": FURTHER})
        else:
            plant.command(ENGINEER, token, last, ("P5A",))
        await bench.wait(0.5)
        ticket = plant.command(ENGINEER, token, "IDLE", ("P5A", "P5B"))
        assert ticket.blocked == {"P5A": refusals.PLACE_UNKNOWN.text}
        with pytest.raises(BeamError, match="no report shows where it is now"):
            plant.command(ENGINEER, token, "IDLE", ("P5A",))
        await bench.wait(2.5)
        assert not plant.command(ENGINEER, token, "IDLE", ("P5A",)).blocked

    play(tmp_path, scene)


def test_an_order_that_was_long_under_way_counts_from_its_acknowledgement(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant, token = bench.plant, await bench.commanded(ENGINEER)
        for give in (plant.standby, plant.aim):
            await give(ENGINEER, token, {"P5A": BESIDE}).end(5.0)
        await stands(bench, "P5A", states.IDLE, counts(plant, "P5A", BESIDE))
        cluster = bench.cluster_of("P5A")
        obey, row = cluster._obey, plant.field.place("P5A")

        async def late(identity: str, name: str, heliostats: tuple[str, ...]) -> None:
            await asyncio.sleep(2.55)
            await obey(identity, name, heliostats)

        cluster._obey = late
        ticket = plant.command(ENGINEER, token, "TRACK", ("P5A",))
        await bench.until(lambda: ticket.stage("P5A") is Stage.DONE, 10.0)
        taken = plant.now()
        assert not plant.ledger.reported()[row]
        await bench.until(lambda: bool(plant.field.heard[row] > taken), 5.0)
        assert plant.ledger.reported()[row]

    play(tmp_path, scene)


def test_a_mirror_that_moves_or_is_silent_does_not_come_to_standby(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant, token = bench.plant, await bench.commanded(ENGINEER)
        for give in (plant.standby, plant.aim):
            await give(ENGINEER, token, {"P5A": BESIDE}).end(5.0)
        here = counts(plant, "P5A", BESIDE)
        await stands(bench, "P5A", states.TRACKING, here)
        cluster = bench.cluster_of("P5A")
        goal = cluster.rows["primary_goal"]
        goal[cluster.names.index("P5A")] = here[0] + 5000
        await bench.wait(2.0)
        with pytest.raises(BeamError, match="still moving"):
            plant.command(ENGINEER, token, "IDLE", ("P5A",))
        goal[cluster.names.index("P5A")] = here[0]
        await bench.wait(2.0)
        ages = cluster.age_ms
        ages[cluster.names.index("P5A")] = 5000
        await bench.wait(2.0)
        with pytest.raises(BeamError, match="no report shows where it is now"):
            plant._proofs.clear("IDLE", (), ("P5A",), plant.now())
        wrong = plant._proofs.joining("TRACK", (), ("P5A",), plant.now())
        assert wrong["P5A"] == refusals.PLACE_UNKNOWN.text
        ages[:] = 0
        await bench.wait(2.0)
        assert plant._proofs.clear("IDLE", (), ("P5A",), plant.now()) == (("P5A",), {})

    play(tmp_path, scene)


def test_no_new_point_is_given_to_a_mirror_whose_place_is_not_known(tmp_path: Path) -> None:
    """The way is proven from the point before, which the mirror has left or not yet reached."""

    async def scene(bench: Bench) -> None:
        plant, token = bench.plant, await bench.commanded(ENGINEER)
        for give in (plant.standby, plant.aim):
            await give(ENGINEER, token, {"P5A": BESIDE, "P5B": BESIDE}).end(5.0)
        for name in ("P5A", "P5B"):
            await stands(bench, name, states.IDLE, counts(plant, name, BESIDE))
        await bench.wait(1.0)
        plant.command(ENGINEER, token, "TRACK", ("P5A",))
        await bench.wait(0.5)
        for give in (plant.standby, plant.aim):
            with pytest.raises(BeamError, match="no report shows where it is now"):
                give(ENGINEER, token, {"P5A": FURTHER})
            assert not give(ENGINEER, token, {"P5B": BESIDE}).blocked
        await bench.wait(2.5)
        for give in (plant.standby, plant.aim):
            assert not give(ENGINEER, token, {"P5A": FURTHER}).blocked
        # On its way back to standby by an order that is known.
        cluster = bench.cluster_of("P5A")
        cluster.set(states.IDLE, "P5A")
        cluster.rows["primary_goal"][cluster.names.index("P5A")] += 5000
        await bench.wait(2.0)
        with pytest.raises(BeamError, match="still moving"):
            plant.standby(ENGINEER, token, {"P5A": BESIDE})

    play(tmp_path, scene)


@pytest.mark.parametrize("state", [states.LOCKED, states.FAULT])
def test_the_way_of_a_mirror_that_has_just_been_unlocked_is_proven(
    state: int, tmp_path: Path
) -> None:
    async def scene(bench: Bench) -> None:
        plant, token = bench.plant, await bench.commanded(ENGINEER)
        await plant.standby(ENGINEER, token, {"P5A": EAST}).end(5.0)
        await stands(bench, "P5A", state, counts(plant, "P5A", WEST))
        with pytest.raises(BeamError, match=r"P5A: the beam enters walkway"):
            plant.command(ENGINEER, token, "IDLE", ("P5A",))

    play(tmp_path, scene)


def test_no_mirror_joins_before_it_shows_where_it_is_since_its_defocus(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant, token = bench.plant, await bench.commanded(ENGINEER)
        await plant.aim(ENGINEER, token, {"P5A": BESIDE}).end(5.0)
        await stands(bench, "P5A", states.TRACKING, counts(plant, "P5A", BESIDE))
        plant.defocus("a visit", ["P5A"])
        await bench.wait(0.5)
        ticket = plant.command(ENGINEER, token, "REFOCUS", ("P5A",))
        await bench.wait(1.0)
        assert ticket.blocked == {"P5A": refusals.PLACE_UNKNOWN.text}
        await bench.wait(2.5)
        again = plant.command(ENGINEER, token, "REFOCUS", ("P5A",))
        await bench.wait(1.0)
        assert not again.blocked

    play(tmp_path, scene)


def test_one_that_moves_joins_only_if_its_way_is_free_from_wherever_it_is(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant, proofs = bench.plant, bench.plant._proofs
        row = plant.field.place("P5A")
        west, east = counts(plant, "P5A", WEST), counts(plant, "P5A", EAST)
        await stands(bench, "P5A", states.IDLE, east)
        plant.aims[row] = EAST
        assert not proofs.joining("TRACK", (), ("P5A",), plant.now())
        cluster = bench.cluster_of("P5A")
        for end, value in zip(("primary_goal", "secondary_goal"), west, strict=True):
            cluster.rows[end][cluster.names.index("P5A")] = value
        await bench.wait(2.0)
        wrong = proofs.joining("TRACK", (), ("P5A",), plant.now())
        assert "the beam enters walkway" in wrong["P5A"]

    play(tmp_path, scene)


def test_a_diagnosis_beside_a_volume_is_refused(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        token = await bench.commanded(ENGINEER)
        for name, east, clear in (("P5B", -8.0, True), ("P5A", -1.9, False)):
            # Beside the walkway it is ordered off within two seconds.
            at = counts(plant, name, (east, -12.0, 8.0))
            await stands(bench, name, states.IDLE, at, 1.5)
            if clear:
                assert plant.command(ENGINEER, token, "DIAGNOSE", (name,))
            else:
                with pytest.raises(RefusedError, match="DIAGNOSE P5A: the beam enters walkway"):
                    plant.command(ENGINEER, token, "DIAGNOSE", (name,))

    play(tmp_path, scene)


def test_to_standby_only_where_the_way_is_clear(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        token = await bench.commanded()
        plant.standby(OPERATOR, token, {"P5A": EAST})
        await stands(bench, "P5A", states.TRACKING, counts(plant, "P5A", EAST))
        assert await plant.command(OPERATOR, token, "IDLE", ("P5A",)).end(5.0)
        await stands(bench, "P5A", states.TRACKING, counts(plant, "P5A", WEST))
        with pytest.raises(RefusedError, match="IDLE P5A: the beam enters walkway"):
            plant.command(OPERATOR, token, "IDLE", ("P5A",))
        await stands(bench, "P5B", states.DEFOCUSED, counts(plant, "P5B", WEST))
        with pytest.raises(
            RefusedError, match="IDLE P5B: the plant does not know its standby point"
        ):
            plant.command(OPERATOR, token, "IDLE", ("P5B",))
        rest_on(plant.standbys, (-12.0, 0.0, 8.0))
        assert np.array_equal(plant.standbys[plant.field.place("P5A")], EAST)
        assert await plant.command(OPERATOR, token, "IDLE", ("P5B",)).end(5.0)
        # Off is always possible.
        assert await plant.command(OPERATOR, token, "STOW", ("P5A",)).end(300.0)

    play(tmp_path, scene)


def test_standby_points_that_were_not_taken_count_as_long_as_the_mirror_may_go_there(
    tmp_path: Path,
) -> None:
    """Simulated run 2401709: a local controller goes to the standby point that it has."""

    async def scene(bench: Bench) -> None:
        plant, other = bench.plant, (-12.0, 0.0, 8.0)
        token, points = await bench.commanded(), plant._proofs.points
        row = np.array([plant.field.place("P5A")])
        points.assign("STANDBY", row, np.array([EAST]))
        points.assign("STANDBY", row, np.array([other]))
        await stands(bench, "P5A", states.TRACKING, counts(plant, "P5A", WEST))
        with pytest.raises(RefusedError, match="IDLE P5A: the beam enters walkway"):
            plant.command(OPERATOR, token, "IDLE", ("P5A",))
        points.taken("STANDBY", row)
        assert await plant.command(OPERATOR, token, "IDLE", ("P5A",)).end(5.0)
        # The way from stow to a point before is not free, that to the new one is.
        rest_on(plant.standbys, (4.0, 0.0, 14.0))
        blocked = tuple(plant.command(OPERATOR, token, "APPROACH").blocked)
        rows = np.array([plant.field.place(name) for name in blocked])
        points.assign("STANDBY", rows, np.tile(other, (len(rows), 1)))
        assert plant.command(OPERATOR, token, "APPROACH").blocked.keys() >= set(blocked)
        points.taken("STANDBY", rows)
        assert not set(blocked) <= plant.command(OPERATOR, token, "APPROACH").blocked.keys()

    play(tmp_path, scene)


def test_a_search_does_not_reach_into_a_volume(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        token = await bench.commanded()
        aim = (-6.0, 0.0, 14.0)
        assert await plant.aim(OPERATOR, token, {"P5A": aim}).end(5.0)
        await stands(bench, "P5A", states.IDLE, counts(plant, "P5A", aim))
        narrow = plant.command(OPERATOR, token, "SEARCH", ("P5A",), (2e-3, 1e-2))
        assert await narrow.end(10.0)
        wide = plant.command(OPERATOR, token, "SEARCH", ("P5A",), (2e-2, 0.3))
        assert not await wide.end(10.0)
        assert "walkway" in wide.refusals["P5A"]
        assert "during the beam search" in wide.refusals["P5A"]

    play(tmp_path, scene)


@pytest.mark.parametrize("radius", [0.01, 0.05, 0.2, 0.4])
def test_a_search_is_wide_enough_as_seen_by_single_beams(radius: float) -> None:
    """Whatever a beam at a random offset enters, the check of the search has found."""
    rng = np.random.default_rng(int(1000 * radius))
    sun = np.array([0.3, -0.4, 0.866])
    sun /= np.linalg.norm(sun)
    names, rows = DESIGN.names, np.array([DESIGN.names.index("P5A")], dtype=np.intp)
    mirror = DESIGN.position[rows[0]]
    aim = np.array([[0.5, 0.0, 15.0]])
    hits = 0
    for _ in range(60):
        place = mirror + rng.uniform(0.3, 0.9) * (aim[0] - mirror) + rng.normal(0.0, 3.0, 3)
        check = BeamCheck(DESIGN, names, [Sphere("ball", place, 0.3)])
        way = aim[0] - mirror
        right = np.cross(way, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        up = np.cross(right, way) / np.linalg.norm(way)
        turn, off = rng.uniform(0, 2 * np.pi), np.linalg.norm(way) * np.tan(radius) * 0.95
        point = aim + off * (np.cos(turn) * right + np.sin(turn) * up)
        nowhere = np.full((1, 3), np.nan)
        single = check.problems(rows, point, sun, start=nowhere, stopped=False)
        if any("enters" in text for text in single.values()):
            hits += 1
            assert check.around(rows, aim, radius, sun)
    assert hits > 0


@pytest.mark.parametrize("way", [(0.0, 0.0, 40.0), (30.0, -20.0, 40.0), (10.0, 0.0, 0.0)])
def test_a_search_is_a_disc_across_the_beam(way: tuple[float, float, float]) -> None:
    """Straight up too, where no direction is to the right."""
    eye = np.array([5.0, 6.0, 2.0])
    offsets = _disc(eye, eye + way, 0.1, 1.0) - (eye + way)
    np.testing.assert_allclose(offsets @ np.array(way), 0.0, atol=1e-9)
    far = np.linalg.norm(offsets, axis=1)
    assert far.max() == pytest.approx(np.linalg.norm(way) * np.tan(0.1))
    np.testing.assert_allclose(offsets[far > 0.99 * far.max()].mean(axis=0), 0.0, atol=1e-9)


def test_by_night_and_without_volumes_nothing_is_in_the_way() -> None:
    rows = np.array([0], dtype=np.intp)
    path = np.array([[[0.0, 0.0], [6.0, 1.5]]])
    aim = np.array([[0.0, 0.0, 15.0]])
    for design, sun in ((DESIGN, (0.0, 0.6, -0.8)), (example_plant(), (0.0, -0.6, 0.8))):
        check = BeamCheck(design, design.names)
        assert check.moving(rows, path, np.array(sun)) == {}
        assert check.around(rows, aim, 0.3, np.array(sun)) == {}


def test_by_night_the_way_of_a_beam_is_that_under_an_overhead_sun() -> None:
    check, rows = BeamCheck(DESIGN, DESIGN.names), np.arange(3)
    aims = np.tile(WALKWAY.center, (3, 1))
    night, noon = (check.poses(rows, aims, np.array([0.0, y, z])) for y, z in ((0.6, -0.8), (0, 1)))
    np.testing.assert_array_equal(night.best_counts, noon.best_counts)


def reports(bench: Bench, name: str, state: int, at: list[int], end: list[int]) -> None:
    """Let a heliostat report that it goes from counts to others."""
    cluster = bench.cluster_of(name)
    cluster.set(state, name)
    row = cluster.names.index(name)
    for axis, what in enumerate(("primary", "secondary")):
        cluster.rows[what][row] = at[axis]
        cluster.rows[f"{what}_goal"][row] = end[axis]


def alarmed(plant: PlantController) -> set[str]:
    """The heliostats whose alarm has not ended."""
    last = {a.subject: a.active for a in plant.alarms if a.condition == "keep_out_predicted"}
    return {name for name, active in last.items() if active}


@pytest.mark.parametrize("commanded", [True, False])
def test_a_beam_in_a_volume_or_heading_for_one_is_sent_off(commanded: bool, tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        assert "keep_out_predicted" not in plant.sentinel.table.unwatched
        if commanded:
            await bench.commanded()
        inside = counts(plant, "P5B", (0.0, -12.0, 8.0))
        # P5C goes to stow across it, which is never held up; the beam of P5B stands in it.
        west, east = counts(plant, "P5A", WEST), counts(plant, "P5A", EAST)
        reports(bench, "P5A", states.IDLE, west, east)
        reports(bench, "P5B", states.TRACKING, inside, inside)
        begin, end = counts(plant, "P5C", WEST), counts(plant, "P5C", EAST)
        reports(bench, "P5C", states.STOWING, begin, end)
        await bench.wait(6.0)
        told = {a.subject for a in plant.alarms if a.condition == "keep_out_predicted"}
        assert told == {"P5A", "P5B"}
        alarms = [a for a in plant.alarms if a.condition == "keep_out_predicted"]
        texts = [a.text for a in alarms if a.active]
        assert all("DEFOCUS or STOW of heliostat" in text for text in texts)
        # P5A is defocused and does not go on; P5B has obeyed too, but its beam is where it was.
        reports(bench, "P5A", states.DEFOCUSED, west, west)
        await bench.wait(60.0)
        assert alarmed(plant) == {"P5B"}
        sent = [m.name for m in bench.cluster_of("P5A").of(Emergency) if "P5B" in m.heliostats]
        assert sent[0] == "DEFOCUS"
        assert sent[1:].count("STOW") >= 2
        await stands(bench, "P5B", states.STOWED, counts(plant, "P5B", EAST))
        await bench.wait(6.0)
        assert alarmed(plant) == set()
        sent = bench.cluster_of("P5A").of(Emergency)
        await bench.wait(70.0)
        assert bench.cluster_of("P5A").of(Emergency) == sent

    bench = play(tmp_path, scene)
    cluster = bench.cluster_of("P5A")
    assert {name for m in cluster.of(Emergency) for name in m.heliostats} == {"P5A", "P5B"}
    assert not cluster.commands("LOCK")


@pytest.mark.parametrize("state", range(len(states.STATES)), ids=states.STATES)
def test_a_beam_in_a_volume_is_seen_in_every_state(state: int, tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        inside = counts(bench.plant, "P5A", (0.0, -12.0, 8.0))
        bench.cluster_of("P5A").deaf.add("P5A")
        reports(bench, "P5A", state, inside, inside)
        await bench.wait(6.0)
        assert alarmed(bench.plant) == {"P5A"}
        await bench.wait(40.0)
        assert alarmed(bench.plant) == {"P5A"}

    sent = play(tmp_path, scene).cluster_of("P5A").of(Emergency)
    assert len({m.identity.split(".")[0] for m in sent}) > 2
    assert {m.heliostats for m in sent} == {("P5A",)}
    assert sent[-1].name == "STOW"


@pytest.mark.parametrize("whom", ["itself", "the field"])
def test_a_mirror_that_has_turned_into_a_volume_is_stowed_although_it_was_just_sent_off(
    whom: str, tmp_path: Path
) -> None:
    """Simulated run 990504: it had turned while the plant was frozen; then DEFOCUS was ordered."""

    async def scene(bench: Bench) -> None:
        inside = counts(bench.plant, "P5A", (0.0, -12.0, 8.0))
        outside = counts(bench.plant, "P5B", EAST)
        reports(bench, "P5A", states.DEFOCUSED, inside, inside)
        reports(bench, "P5B", states.DEFOCUSED, outside, outside)
        if whom == "itself":
            bench.plant.defocus(OPERATOR.name, ("P5A", "P5B"))
        else:
            bench.plant.raise_emergency(OPERATOR.name, Act.DEFOCUS)
        await bench.wait(6.0)
        assert alarmed(bench.plant) == {"P5A"}
        # P5B stands too, where it does no harm: another row that sends it off waits as ever.
        for name, where in (("P5A", inside), ("P5B", outside)):
            reports(bench, name, states.DEFOCUSED, where, where)
        await bench.wait(4.0)
        assert [name for name in ("P5A", "P5B") if bench.plant._watch.turned(name)] == ["P5A"]

    sent = play(tmp_path, scene).cluster_of("P5A").of(Emergency)
    assert [m.heliostats for m in sent if m.name == "STOW"] == [("P5A",)]


@pytest.mark.parametrize("state", [states.LOCKED, states.FAULT])
def test_a_held_mirror_that_has_turned_is_stowed_at_once(state: int, tmp_path: Path) -> None:
    """DEFOCUS turns it once; another would leave its beam where it is for 10 s."""

    async def scene(bench: Bench) -> None:
        bench.cluster_of("P5A").deaf.add("P5A")
        inside, outside = (counts(bench.plant, "P5A", p) for p in ((0.0, -12.0, 8.0), WEST))
        reports(bench, "P5A", state, outside, outside)
        await bench.wait(3.0)
        assert not bench.plant.field.turned.any()
        reports(bench, "P5A", state, inside, inside)
        await bench.wait(6.0)
        assert alarmed(bench.plant) == {"P5A"}
        # Out of that state, it turns again.
        assert bench.plant.field.turned.sum() == 1
        reports(bench, "P5A", states.IDLE, inside, inside)
        await bench.wait(3.0)
        assert not bench.plant.field.turned.any()

    sent = play(tmp_path, scene).cluster_of("P5A").of(Emergency)
    assert sent[0].name == "STOW"


@pytest.mark.parametrize("name", ["CLEAR_FAULT", "UNLOCK"])
def test_a_mirror_is_not_stopped_while_it_is_sent_off(name: str, tmp_path: Path) -> None:
    """Simulated run 2401327: a cleared fault made it stand still in the volume."""

    async def scene(bench: Bench) -> None:
        inside, outside = (counts(bench.plant, "P5A", p) for p in ((0.0, -12.0, 8.0), WEST))
        reports(bench, "P5A", states.LOCKED, inside, inside)
        reports(bench, "P5B", states.LOCKED, outside, outside)
        token = await bench.commanded(ENGINEER)
        await bench.wait(6.0)
        assert alarmed(bench.plant) == {"P5A"}
        with pytest.raises(RefusedError, match=rf"{name} P5A: keep_out_predicted P5A: its beam"):
            bench.plant.command(ENGINEER, token, name, ("P5A",))
        assert bench.plant.command(ENGINEER, token, name, ("P5B",))
        reports(bench, "P5A", states.LOCKED, outside, outside)
        await bench.wait(6.0)
        bench.plant.authority.keep(ENGINEER, token)
        assert bench.plant.command(ENGINEER, token, name, ("P5A",))

    play(tmp_path, scene)


@pytest.mark.parametrize("state", [states.DEFOCUSED, states.LOCKED, states.FAULT])
def test_a_way_off_that_would_end_in_a_volume_is_seen_before_it_ends(
    state: int, tmp_path: Path
) -> None:
    async def scene(bench: Bench) -> None:
        inside = counts(bench.plant, "P5A", (0.0, -12.0, 8.0))
        reports(bench, "P5A", state, counts(bench.plant, "P5A", WEST), inside)
        await bench.wait(6.0)
        assert alarmed(bench.plant) == {"P5A"}

    play(tmp_path, scene)


@pytest.mark.parametrize("lost", ["counts", "heliostat"])
def test_a_beam_in_a_volume_stays_known_when_its_heliostat_is_lost(
    lost: str, tmp_path: Path
) -> None:
    async def scene(bench: Bench) -> None:
        plant, cluster = bench.plant, bench.cluster_of("P5A")
        inside = counts(plant, "P5A", (0.0, -12.0, 8.0))
        await stands(bench, "P5A", states.TRACKING, inside)
        row = cluster.names.index("P5A")
        if lost == "counts":
            cluster.rows["flags"][row] = 1 << names.FLAGS.index("COUNTS_UNKNOWN")
            await stands(bench, "P5A", states.FAULT, [0, 0])
        else:
            cluster.age_ms[row] = 20_000
        await bench.wait(30.0)
        assert alarmed(plant) == {"P5A"}
        cluster.age_ms[row] = cluster.rows["flags"][row] = 0
        await stands(bench, "P5A", states.STOWED, counts(plant, "P5A", EAST))
        await bench.wait(6.0)
        assert alarmed(plant) == set()

    play(tmp_path, scene)


def test_an_approach_is_known_to_turn_azimuth_first(tmp_path: Path) -> None:
    """One way turns in the volume, the other passes beside it; both join the same two places."""

    async def scene(bench: Bench) -> None:
        plant = bench.plant
        group, row = DESIGN.find("P5A")
        found = track(group.mechanism[row], plant.sun_vector(), WALKWAY.center)
        inside, drives = found.best_angles, group.mechanism[row].drives

        def steps(angles: FloatArray) -> list[int]:
            return [round(float(x)) for x in drives.counts(angles)]

        # Elevation alone, then azimuth alone, leads through it.
        begin, end = inside - np.array([0.0, 0.4]), inside + np.array([0.4, 0.0])
        for first, last, seen in ((begin, end, False), (end, begin, True)):
            reports(bench, "P5A", states.APPROACHING, steps(first), steps(last))
            before = len(plant.alarms)
            await bench.wait(5.0)
            told = [a for a in list(plant.alarms)[before:] if a.condition == "keep_out_predicted"]
            assert bool(told) == seen

    play(tmp_path, scene)


def test_the_order_out_is_the_one_that_ends_outside_and_is_inside_for_less() -> None:
    sun = np.array([0.3, -0.4, 0.866])
    sun /= np.linalg.norm(sun)
    row = DESIGN.names.index("P5A")
    group, place = DESIGN.find("P5A")
    drives = group.mechanism[place].drives
    found = track(group.mechanism[place], sun, WALKWAY.center)
    begin, here = found.best_angles, found.best_counts
    limits = (AxisLimits(-(1 << 28), 1 << 28, 1000, 1000, 0),) * 2
    far = tuple(round(x) for x in drives.counts(begin + np.array([0.8, 0.3])))
    machine = Machine(limits, (far[0], far[1]), (0.1, 0.1))
    check = BeamCheck(DESIGN, DESIGN.names)

    def ordered(machine: Machine | None) -> Act:
        check.machines = {} if machine is None else {"P5A": machine}
        return order_out(Paths(check), row, here, sun)

    assert ordered(machine) is Act.DEFOCUS
    assert ordered(None) is Act.DEFOCUS
    # Along the walkway it would stay inside for longer than on the path to stow.
    assert ordered(Machine(limits, (far[0], far[1]), (0.5, 0.02))) is Act.STOW
    # Where the defocus ends, another volume begins.
    end = group.mechanism[place].armature.pose(begin + 0.1)
    normal, vertex = end[0], end[1]
    ball = Sphere("ball", vertex + 20.0 * (2.0 * (sun @ normal) * normal - sun), 1.0)
    check = BeamCheck(DESIGN, DESIGN.names, [WALKWAY, ball])
    assert ordered(machine) is Act.STOW
    assert check.inside(row, begin[None], np.array([0.0, 0.6, -0.8])).tolist() == [False]


def test_from_standby_and_an_approach_no_defocus_lights_the_receiver_whatever_the_aim() -> None:
    """In 249 of 1,216 cases it did, where the aim was on the right target: run 980292."""
    design = malan_plant(320)
    check = BeamCheck(design, design.names)
    paths, rows = Paths(check), np.arange(3, 320, 32)
    own = [design.machine(design.names[row]).standby for row in rows]
    standbys, aims = np.array(own, dtype=np.float64), np.tile((45.0, 0.0, 36.0), (len(rows), 1))
    points, length = paths.points(rows, standbys)
    late = 0.5 * (points[np.arange(len(rows)), length - 2] + standbys)
    held = 0
    for hour in (9, 12, 15):
        moment = datetime(2026, 3, 21, hour, tzinfo=UTC)
        sun = vector(moment - timedelta(hours=design.site.longitude_deg / 15.0), design.site)
        for state, places in ((states.LOCKED, standbys), (states.APPROACHING, late)):
            begin = np.round(check.poses(rows, places, sun, paths.stow[rows]).best_counts)
            for how in (state, states.FAULT):
                reported = np.full(len(rows), how)
                angles = defocused(paths, rows, begin, sun, reported, aims, standbys)
                ends = Drive(check.drives.table[rows]).counts(angles)
                lit = check.crossing(rows, paths.motion(rows, begin, ends), sun, "now")
                held += len(lit) if how == states.FAULT else 0
                assert how == states.FAULT or not lit
    assert held > 0  # turned off the aim


@pytest.mark.parametrize("field", [False, True])
def test_who_goes_off_is_not_stopped_on_the_way(field: bool, tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        await bench.commanded()
        cluster = bench.cluster_of("P5A")
        cluster.deaf.add("P5A")  # it does not show yet that it obeys
        if field:
            plant.raise_emergency("Vera")
        else:
            plant.defocus("Vera", ("P5A",))
        await stands(bench, "P5A", states.TRACKING, counts(plant, "P5A", (0.0, -12.0, 8.0)))
        await bench.wait(5.0)
        assert [a for a in plant.alarms if a.condition == "keep_out_predicted" and a.active]

    bench = play(tmp_path, scene)
    assert not bench.cluster_of("P5A").commands("LOCK")


def test_without_volumes_nobody_is_looked_at(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path)
        async with running(bench):
            await bench.wait(2.0)
            assert "keep_out_predicted" in bench.plant.sentinel.table.unwatched

    run_virtual(main)


# -- the way from stow ---------------------------------------------------------------------------

#: North of the tower, where beams pass on their ways along the ground to its foot and up.
GATE = Box("gate", (0.0, 60.0, 2.0), (6.0, 4.0, 4.0))
NOON = datetime(2026, 6, 21, 10, tzinfo=UTC)


def gated(count: int) -> Plant:
    """A field south of its tower, with a gate across the ways of some beams."""
    return replace(malan_plant(count), keep_outs=(GATE,))


def inside(
    check: BeamCheck, normal: FloatArray, vertex: FloatArray, sun: FloatArray, error: float
) -> npt.NDArray[np.bool_]:
    """Which true beams, (N,), are in a volume; ``error`` widens them, rad."""
    sizes = check.mirrors.width, check.mirrors.height
    mirrors = MirrorOptics.of(*sizes, error=error)
    way = 2.0 * (normal @ sun)[:, None] * normal - sun
    found = find_entries(beams(vertex, vertex + way, mirrors, reach=3000.0), check.volumes)
    return np.asarray(found.entered.any(axis=-1) & (normal @ sun > 0.0))


def test_who_would_cross_a_volume_on_the_way_from_stow_is_known_beforehand() -> None:
    """The oracle: the true beams of simulated heliostats that go, every 50 ms."""
    design = gated(96)
    machine = design.machine(design.names[0])
    assert machine.standby is not None
    check = BeamCheck(design, design.names)

    def sun(ahead: float) -> FloatArray:
        return vector(NOON.timestamp() + ahead, design.site)

    rows = np.arange(96)
    stow, standby = (np.tile(np.array(x, dtype=float), (96, 1)) for x in _rest(machine))
    paths = Paths(check)
    found = paths.approach(rows, stow, standby, sun)
    assert all("gate" in text and "from stow to standby" in text for text in found.values())
    refused = np.array([name in found for name in design.names])

    crossed, near = np.zeros((2, 96), dtype=np.bool_)
    for normal, vertex, light in goes(design, NOON):
        crossed |= inside(check, normal, vertex, light, 0.0)
        near |= inside(check, normal, vertex, light, 0.02)
    assert 10 < crossed.sum() < 86
    assert not (crossed & ~refused).any()
    assert not (refused & ~near).any()


def goes(design: Plant, begin: datetime) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
    """Let simulated heliostats go from stow to standby: normals, vertices, sun, every 50 ms."""
    field = Field(design.groups["azel"].calibrated, design.machine(design.names[0]))
    for tick in range(1200):
        at = begin.timestamp() + 0.05 * tick
        if tick % 20 == 0:
            values = broadcast_values(int(gps_seconds(begin)) + tick // 20, at, design.site)
            assert values is not None
            field.take_sun(values)
            if tick == 0:
                field.order("APPROACH")
        field.advance(50)
        yield *field.stand(), vector(at, design.site)
        if not (field.state == states.APPROACHING).any():
            break
    assert (field.state == states.IDLE).all()


def test_who_would_cross_the_receiver_on_the_way_from_stow_is_known_beforehand() -> None:
    """The oracle: how near the middle of each true beam comes to the middle of the receiver."""
    design = malan_plant(96)
    machine, middle = design.machine(design.names[0]), design.receivers[0].center
    half = 0.5 * np.hypot(design.receivers[0].width, design.receivers[0].height)
    begin = datetime(2026, 11, 22, 14, tzinfo=UTC)

    def sun(ahead: float) -> FloatArray:
        return vector(begin.timestamp() + ahead, design.site)

    check, rows = BeamCheck(design, design.names), np.arange(96)
    stow, standby = (np.tile(np.array(x, dtype=float), (96, 1)) for x in _rest(machine))
    found = Paths(check).approach(rows, stow, standby, sun)
    text = "the beam crosses the receiver on its way from stow to standby; try again"
    assert all(text in each for each in found.values())
    refused = np.array([name in found for name in design.names])
    nearest = np.full(96, np.inf)
    for normal, vertex, light in goes(design, begin):
        way = 2.0 * (normal @ light)[:, None] * normal - light
        along = ((middle - vertex) * way).sum(axis=-1)
        miss = np.linalg.norm(middle - vertex - along[:, None] * way, axis=-1)
        nearest = np.minimum(nearest, np.where(along > 0.0, miss, np.inf))
    assert 10 < refused.sum() < 60
    assert nearest[~refused].min() > half + 0.4
    assert nearest[refused].max() < half + 2.0


def _rest(machine: Machine) -> tuple[tuple[int, int], tuple[float, float, float]]:
    assert machine.standby is not None
    return machine.stow, machine.standby


def test_a_way_is_the_one_that_the_motors_go() -> None:
    """No count of the local controller's stepper is further than the backlash from the path."""
    rng = np.random.default_rng(5)
    design = gated(6)
    name, row = design.names[0], np.array([0])
    limits = (AxisLimits(-200_000, 200_000, 8000, 16_000, 40), AxisLimits(0, 99_000, 3000, 9000, 0))
    machine = replace(design.machine(name), axes=limits, stow=(0, 90_000))
    check = BeamCheck(design, design.names)
    check.machines[name] = machine
    paths = Paths(check)
    drives = Drive(check.drives.table[0])
    worst = 0.0
    for case in range(40):
        spread = 10.0 ** rng.uniform(2.0, 4.7)
        begin = np.array([0, 50_000]) + rng.integers(-40_000, 40_000, 2)
        end = np.clip(begin + spread * rng.uniform(-1.0, 1.0, 2), (-200_000, 0), (200_000, 99_000))
        end = end.round()
        axes = [Axis(x.low, x.high, x.rate, x.acceleration, x.backlash, 50) for x in limits]
        for axis, count in zip(axes, begin, strict=True):
            axis.count = axis.goal = axis.leg = int(count)
        stepper = Stepper(axes, 50, 100)
        turns = case % 2 == 0
        stepper.go(int(end[0]), int(end[1]), PRIMARY_FIRST if turns else BOTH)
        path = (paths.turns if turns else paths.motion)(row, begin[None] * 1.0, end[None])[0]
        ticks = 0
        while ticks == 0 or not stepper.still():
            stepper.advance(50, [], 0)
            ticks += 1
            at = drives.angles(np.array([axis.count for axis in axes], dtype=float))
            worst = max(worst, _apart(at, path))
        took = float(paths.lasts(row, begin[None] * 1.0, end[None], turns=turns)[0])
        assert abs(took - 0.05 * ticks) < 0.3 + 0.02 * took
    assert worst < 1.5e-3


def test_a_path_without_ramps_is_that_of_two_axes_at_their_rates() -> None:
    """The corner is where the axis with less to do arrives."""
    rng = np.random.default_rng(6)
    design = gated(6)
    name, row = design.names[0], np.array([0])
    limits = (AxisLimits(-200_000, 200_000, 8000, 16_000, 40), AxisLimits(0, 99_000, 3000, 9000, 0))
    machine = replace(design.machine(name), axes=limits, stow=(0, 90_000))
    check = BeamCheck(design, design.names)
    check.machines[name] = machine
    paths, drives = Paths(check), Drive(check.drives.table[0])
    rates = np.array([8000.0, 3000.0])
    for _ in range(20):
        begin = rng.uniform((-100_000.0, 20_000.0), (100_000.0, 80_000.0)).round()
        end = (begin + rng.uniform(200.0, 20_000.0, 2) * rng.choice((-1.0, 1.0), 2)).round()
        path = paths.motion(row, begin[None], end[None], ramps=False)[0]
        # A goal below is reached from below: the axis goes past it first.
        goal = end - np.where(end < begin, (40.0, 0.0), 0.0)
        lasts = float((np.abs(goal - begin) / rates).max())
        for time in np.linspace(0.0, lasts, 23):
            made = np.minimum(rates * time, np.abs(goal - begin))
            at = drives.angles(begin + np.sign(goal - begin) * made)
            assert _apart(at, path) < 2e-5
        np.testing.assert_allclose(path[-1], drives.angles(end), atol=1e-9)


def test_each_leg_of_an_approach_is_proven_in_the_sun_of_its_moment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In a sun that goes ten times as fast, a proof in that of the start would be far off."""
    design = gated(6)
    machine = design.machine(design.names[0])
    check, rows = BeamCheck(design, design.names), np.arange(3)
    paths = Paths(check)
    stow, standby = (np.tile(np.array(x, dtype=float), (3, 1)) for x in _rest(machine))
    asked: list[tuple[Any, ...]] = []
    poses = check.poses

    def noted(*values: Any) -> Any:
        asked.append(values)
        return poses(*values)

    def sun(ahead: float) -> FloatArray:
        return vector(NOON.timestamp() + 10.0 * ahead, design.site)

    monkeypatch.setattr(check, "poses", noted)
    assert not paths.approach(rows, stow, standby, sun)
    time, at = np.zeros(3), stow
    for leg, (_, _, light, begin) in enumerate(asked):
        if leg:
            time = time + paths.lasts(rows, at, begin, turns=leg == 1)
        at = begin
        exact = np.array([sun(float(each)) for each in time])
        assert np.linalg.norm(light - exact, axis=-1).max() < 2e-3
    assert time.min() > 20.0


def test_a_diagnosis_passes_a_nudge_of_each_axis_both_ways() -> None:
    design = gated(6)
    check, rows = BeamCheck(design, design.names), np.array([1, 3])
    counts = np.array([[1000.0, 60_000.0], [-2000.0, 40_000.0]])

    class Standing(tuple[str, ...]):
        def counts(self, of: object) -> FloatArray:
            assert of is rows
            return counts

    field: Any = Standing(design.names)
    proofs = PathProofs(Paths(check), field, field, field, field)
    path = proofs._by_counts("DIAGNOSE", (), rows)
    begin = Drive(check.drives.table[rows]).angles(counts)
    nudges = [(0, 0), (1, 0), (-1, 0), (0, 0), (0, 1), (0, -1)]
    np.testing.assert_allclose(path, begin[:, None] + NUDGE * np.array(nudges), atol=1e-12)


@pytest.mark.parametrize("azimuth", [0, 1])
def test_an_approach_leaves_stow_as_long_as_its_other_axis_stands_there(azimuth: int) -> None:
    design = gated(6)
    machine = replace(design.machine(design.names[0]), azimuth_axis=azimuth)
    check, rows = BeamCheck(design, design.names), np.arange(4)
    known: Any = design.names  # what is asked of the field is its size alone
    stow = np.array(machine.stow, dtype=float)
    begin = np.tile(stow, (4, 1))
    begin[1, azimuth] += 5000.0  # on its way: the azimuth has moved
    begin[2, 1 - azimuth] -= 5000.0  # and now the other axis has
    end = begin + 40_000.0
    state = np.array([states.APPROACHING] * 3 + [states.STOWING])
    check.machines = dict.fromkeys(design.names, machine)
    watch = BeamWatch(PathProofs(Paths(check), known, known, known, known))
    assert list(watch._leaves_stow(rows, state, begin, end)) == [True, True, False, False]
    # Where the place of stow is not known, a long way tells it.
    check.machines = {}
    watch = BeamWatch(PathProofs(Paths(check), known, known, known, known))
    near = np.where(np.arange(4)[:, None] == 2, begin + 10.0, begin + 900_000.0)
    assert list(watch._leaves_stow(rows, state, begin, near)) == [True, True, False, False]


def _apart(point: FloatArray, path: FloatArray) -> float:
    """The distance of a point (2,) from a line through points (W, 2)."""
    begin, leg = path[:-1], np.diff(path, axis=0)
    size = np.maximum((leg**2).sum(axis=-1), 1e-30)
    share = np.clip(((point - begin) * leg).sum(axis=-1) / size, 0.0, 1.0)
    return float(np.linalg.norm(point - begin - share[:, None] * leg, axis=-1).min())


def test_the_points_of_a_way_are_those_of_a_board() -> None:
    design = gated(6)
    check = BeamCheck(design, design.names)
    rows = np.array([1, 4])
    machine = design.machine(design.names[0])
    given = ((3.0, -20.0, 0.0), (3.0, -4.0, 0.5))
    machines = dict.fromkeys(design.names, machine)
    machines[design.names[4]] = replace(machine, way=given)
    check.machines = machines
    paths = Paths(check)
    for standby in ((21.0, 0.0, 81.7), (-30.0, 0.0, 60.0)):
        points, length = paths.points(rows, np.tile(standby, (2, 1)))
        for row, found, count in zip(rows, points, length, strict=True):
            name, mechanism = design.names[row], design.groups["azel"].mechanism[row]
            items = items_of(mechanism, replace(machines[name], standby=standby))
            board = Board(Outfit(name, 1, 1, b"key", mechanism, {}, {**items, **own_items(1)}))
            board.power_on(0.0)
            assert board.controller is not None
            assert np.allclose(found[:count], board.controller.motion.way(), atol=1e-4)


def test_an_approach_is_refused_by_name_and_the_others_go(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        token = await bench.commanded()
        with pytest.raises(
            RefusedError, match="APPROACH P5A: the plant does not know its standby point"
        ):
            plant.command(OPERATOR, token, "APPROACH", ("P5A",))
        rest_on(plant.standbys, (4.0, 0.0, 14.0))
        free, texts = [], {}
        for name in plant.field.names:
            try:
                plant.command(OPERATOR, token, "APPROACH", (name,))
                free.append(name)
            except RefusedError as error:
                texts[name] = str(error)
        assert free
        assert texts
        assert all("walkway" in t and "on its way from stow" in t for t in texts.values())
        ticket = plant.command(OPERATOR, token, "APPROACH")
        assert ticket.blocked.keys() == texts.keys()
        # What is in the way is gone.
        plant.beams.volumes = ()
        for name in texts:
            plant.command(OPERATOR, token, "APPROACH", (name,))

    play(tmp_path, scene)


def test_parameters_that_would_lead_the_present_beam_into_a_volume_are_not_written(
    tmp_path: Path,
) -> None:
    """A poisoned calibration: by its parameters the way is free, and the true beam is elsewhere."""
    standby = (-3.5, -12.0, 8.0)

    async def scene(bench: Bench) -> None:
        plant = bench.plant
        plant.standbys[plant.field.place("P5A")] = standby
        await stands(bench, "P5A", states.LOCKED, counts(plant, "P5A", standby))
        group, row = DESIGN.find("P5A")
        nominal, seen = group.mechanism[row], {True: 0, False: 0}
        for lean in np.linspace(-0.2, 0.2, 41):
            new = nominal.with_parameters({"canting": lean})
            solved = track(new, plant.sun_vector(), standby)
            # The oracle: where the present mirror shines in the pose that the new one takes.
            pose = nominal.pose(np.round(solved.best_counts))
            ray = reflect(plant.sun_vector(), pose.normal)
            way = np.array(WALKWAY.center) - pose.vertex
            inside = float(np.linalg.norm(way - ray * (way @ ray))) < WALKWAY.radius
            why = plant._proofs.rewriting("P5A", new.armature.table, new.drives.table)
            seen[inside] += 1
            assert not inside or "walkway" in why
        assert min(seen.values()) > 0
        assert plant._proofs.rewriting("P5A", nominal.armature.table, nominal.drives.table) is None

    play(tmp_path, scene)


@pytest.mark.parametrize("name", ["TRACK", "IDLE"])
def test_unverified_parameters_lead_no_beam_into_a_volume_if_the_earlier_are_right(
    tmp_path: Path, name: str
) -> None:
    """To the verifying photograph, and back: the true beam may be where the earlier ones say."""
    point = (-3.5, -12.0, 8.0)

    async def scene(bench: Bench) -> None:
        plant, proofs = bench.plant, bench.plant._proofs
        place = plant.field.place("P5A")
        (plant.aims if name == "TRACK" else plant.standbys)[place] = point
        state = states.IDLE if name == "TRACK" else states.TRACKING
        await stands(bench, "P5A", state, counts(plant, "P5A", WEST))

        def why() -> dict[str, str]:
            if name == "TRACK":
                return proofs.joining("TRACK", (), ("P5A",), plant.now())
            return proofs._back_to_standby(np.array([place]), plant.now())

        group, row = DESIGN.find("P5A")
        nominal, seen = group.mechanism[row], {True: 0, False: 0}
        for lean in np.linspace(-0.1, 0.1, 21):
            new = nominal.with_parameters({"canting": lean})
            # The oracle: where the present mirror shines in the pose that the new one takes.
            pose = nominal.pose(np.round(track(new, plant.sun_vector(), point).best_counts))
            ray = reflect(plant.sun_vector(), pose.normal)
            way = np.array(WALKWAY.center) - pose.vertex
            inside = float(np.linalg.norm(way - ray * (way @ ray))) < WALKWAY.radius
            seen[inside] += 1
            with plant.unverified("P5A"):
                plant.want("P5A", new)
                assert not inside or "walkway" in why()["P5A"]
                unproven = why()
            plant.want("P5A", nominal)
            assert lean or not unproven
        assert min(seen.values()) > 0
        assert not why()

    play(tmp_path, scene)


def test_an_approach_of_many_is_proven_and_sent_in_slices(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The proof of a whole field would hold up leases; a DEFOCUS ends what has not gone yet."""
    monkeypatch.setattr(joining, "SLICE", 2)
    proven: list[int] = []
    prove = Paths.approach

    def counted(self: Paths, rows: npt.NDArray[np.intp], *given: Any) -> dict[str, str]:
        proven.append(len(rows))
        return prove(self, rows, *given)

    async def scene(bench: Bench) -> None:
        plant = bench.plant
        token = await bench.commanded()
        rest_on(plant.standbys, (4.0, 0.0, 14.0))
        blocked = plant.command(OPERATOR, token, "APPROACH", plant.field.names[:2]).blocked
        monkeypatch.setattr(Paths, "approach", counted)
        ticket = plant.command(OPERATOR, token, "APPROACH")
        assert not proven
        count = len(plant.field)
        await bench.until(lambda: sum(proven) == count, 60.0)
        assert max(proven) == 2
        assert blocked.items() <= ticket.blocked.items()
        assert 0 < len(ticket.blocked) < count
        sent = {
            n for c in bench.clusters.values() for m in c.commands("APPROACH") for n in m.heliostats
        }
        assert sent == set(plant.field.names) - ticket.blocked.keys() | (
            set(plant.field.names[:2]) - blocked.keys()
        )
        ticket = plant.command(OPERATOR, token, "APPROACH")
        plant.defocus(OPERATOR.name)
        before = len(proven)
        await bench.wait(2.0)
        assert len(proven) == before
        assert all("DEFOCUS" in text for text in ticket.refusals.values())

    play(tmp_path, scene)


def test_an_approach_across_the_receiver_is_refused_by_name(tmp_path: Path) -> None:
    """It needs no keep-out volume, and beams are still sent to the receiver."""
    furnace = Receiver("furnace", "planar", np.array([0.0, -12.0, 8.0]), SOUTH, 1.0, 1.0)
    design = replace(example_plant(), receivers=(furnace,), keep_outs=())

    async def scene(bench: Bench) -> None:
        plant = bench.plant
        token = await bench.commanded()
        # A standby point that is not known here: nothing can be proven, and no volume is near.
        assert not plant.command(OPERATOR, token, "APPROACH").blocked
        rest_on(plant.standbys, (4.0, 0.0, 14.0))
        ticket = plant.command(OPERATOR, token, "APPROACH")
        assert 0 < len(ticket.blocked) < len(plant.field)
        text = "the beam crosses receiver furnace on its way from stow to standby"
        assert all(text in each for each in ticket.blocked.values())
        first = next(iter(ticket.blocked))
        with pytest.raises(RefusedError, match=f"APPROACH {first}: the beam crosses"):
            plant.command(OPERATOR, token, "APPROACH", (first,))
        assert await plant.aim(OPERATOR, token, {first: furnace.center}).end(5.0)
        await stands(bench, first, states.IDLE, counts(plant, first, (4.0, 0.0, 14.0)))
        assert await plant.command(OPERATOR, token, "TRACK", (first,)).end(10.0)

    play(tmp_path, scene, design)


def test_automatic_control_raises_those_with_a_free_way_and_names_the_others() -> None:
    design = gated(48)
    work = AutomaticSettings(wanted=True, calibrate=False)
    options = LiveOptions(rendered=False, threads=0, work=work, installed=lambda real: real)
    lit: set[str] = set()

    async def main(clock: VirtualClock) -> None:
        async with LivePlant(design, clock, options).running() as live:
            plant = live.plant
            for _ in range(900):
                await asyncio.sleep(0.1)
                beams_in = inside(plant.beams, *live.field.stand(), live.world.sun(), 0.0)
                lit.update(live.names[i] for i in np.flatnonzero(beams_in))
            told = [a for a in live.operations.logbook.alarms() if a.condition == "beam_blocked"]
            blocked = {a.subject for a in told}
            now = plant.now()
            state = {name: plant.field.of(name, now).state for name in live.names}
            assert {name for name in live.names if state[name] == "STOWED"} == blocked
            assert 5 < len(blocked) < 43
            assert all("gate" in a.text and a.count == 1 for a in told)
            assert {state[name] for name in live.names if name not in blocked} <= {
                "IDLE",
                "TRACKING",
            }
            assert not [a for a in plant.alarms if a.condition == "keep_out_predicted"]
            asked = [t for t in plant.orders if t.name == "APPROACH"]
            assert not asked
            await live.end()

    run_virtual(main, start=NOON)
    assert not lit


def test_the_way_to_an_aim_is_that_of_the_branch_on_which_the_mirror_stands() -> None:
    """A mirror without known stops reaches an aim in two poses; it takes the nearer one."""
    fits = outfits(4, 5)
    scene = scene_of(("visits",), 5, 180.0, 4)
    design = _stopless(design_of(fits, {"C1": [each.name for each in fits]}, scene))
    check, rows = BeamCheck(design, design.names), np.arange(4)
    sun = vector(scene.start.timestamp(), scene.site)
    stow = np.tile(np.array(MACHINE.stow, dtype=float), (4, 1))
    found = check.poses(rows, np.tile(RECEIVER, (4, 1)), sun, stow)
    here = found.best_counts
    aims = np.tile(TARGETS[0].center, (4, 1))
    turned: list[float] = []

    def motion(some: npt.NDArray[np.intp], begin: FloatArray, end: FloatArray) -> FloatArray:
        turned.append(float(np.abs(end - begin).max()))
        table = check.drives.table[some][:, None]
        angles: FloatArray = Drive(table).angles(np.stack([begin, end], axis=1))
        return angles

    assert check.on_the_way(rows, here, aims, sun, motion) == {}
    assert 0.0 < turned[0] < 20_000


def _stopless(design: Plant) -> Plant:
    """The same plant, whose file tells nothing of the motors."""
    groups = {name: replace(group, machines=()) for name, group in design.groups.items()}
    return replace(design, groups=groups)


def test_poses_are_those_within_the_limits_of_the_motors() -> None:
    """By another pose an approach was proven, and the true beam crossed the receiver."""
    scene = scene_of(("place",), 800085, 180.0, 4)
    fits = outfits(4, 800085, scene.places)
    design = design_of(fits, {"C1": [each.name for each in fits]}, scene)
    rows, stow = np.arange(4), np.tile(np.array(MACHINE.stow, dtype=float), (4, 1))
    sun = vector(scene.start.timestamp() + 15.0, scene.site)

    def first(check: BeamCheck) -> FloatArray:
        """Where the axes are at the first point of the way from stow."""
        standbys = np.tile(np.array(MACHINE.standby, dtype=float), (4, 1))
        points = Paths(check).points(rows, standbys)[0][:, 0]
        solved = check.poses(rows, points, sun, stow)
        return np.asarray(solved.chosen(solved.counts))

    low, high = np.transpose([(axis.low, axis.high) for axis in MACHINE.axes])
    check = BeamCheck(design, design.names)
    assert ((first(check) >= low) & (first(check) <= high)).all()
    drives = design.groups["all"].mechanism.drives.table[0]
    check.replace(0, check.armature.table[0].copy(), drives.copy())  # a new calibration
    assert ((first(check) >= low) & (first(check) <= high)).all()
    free = first(BeamCheck(_stopless(design), design.names))
    assert (free[0] > high).any()


def test_a_stop_that_the_safe_path_passes_is_named() -> None:
    """A tilt-roll mirror whose tilt ends at 90° cannot lead a low sun's beam along the ground."""
    design = mixed(["tilt_roll"], 4)
    (group,) = design.groups.values()
    quarter = 100_000  # steps
    axis = replace(group.machines[0].axes[0], low=-quarter, high=quarter)
    machines = tuple(replace(machine, axes=(axis, axis)) for machine in group.machines)
    stopped = replace(design, groups={"t": replace(group, machines=machines)})
    noon = datetime(2026, 6, 21, 12, tzinfo=UTC) - timedelta(hours=design.site.longitude_deg / 15)

    def found(plant: Plant, hours: float) -> dict[str, str]:
        paths = Paths(BeamCheck(plant, plant.names))
        points = np.array([machine.standby for machine in group.machines], dtype=np.float64)
        light = vector(noon + timedelta(hours=hours), plant.site)
        return paths.approach(np.arange(4), paths.stow, points, lambda _: light)

    morning = found(stopped, -5.0)
    assert set(morning) == set(stopped.names)
    for text in morning.values():
        assert re.fullmatch(
            r"point 1 of \d+ of the safe path, \(.*, 0\.0\) m: axis 1 would have to turn to "
            r"-\d+\.\d°, beyond its stop at -90\.0°; move the stop in the plant file, or set other "
            r"points in way_m",
            text,
        )
    assert not any("stop" in text for text in found(stopped, 0.0).values())
    assert not any("stop" in text for text in found(design, -5.0).values())
