"""Drives that stall: seen by a tilt sensor or a photograph, kept off, and never proven."""

import asyncio
import contextlib
import itertools
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from heliotrope.field.example import example_plant
from heliotrope.field.plant import Plant
from heliotrope.lcu import diagnosis, names, states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import Command, Emergency
from heliotrope.plant.field.drive_checks import PHOTOGRAPH, TILT_SENSOR
from heliotrope.plant.operations import Logbook, Operations
from heliotrope.plant.operations.automatic import AutomaticControl, AutomaticSettings
from heliotrope.plant.operations.movement_checks import CHECKING, MOST
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.plant.settings import PlantSettings
from heliotrope.safety import Act, Alarm, alarms
from heliotrope.twin.boards.board import Board
from support.plant_bench import ENGINEER, OPERATOR, VIEWER, Bench, running
from support.whole_plant import MACHINE, WholePlant

MOVED = diagnosis.MOVED_PRIMARY | diagnosis.MOVED_SECONDARY
READY = 1 << names.FLAGS.index("READY")
STUCK = names.FAULTS.index("secondary drive stuck")
WORK = AutomaticSettings(wanted=True, calibrate=False)
Play = Callable[[Bench], Awaitable[None]]


def sensed() -> Plant:
    """The example's field, all of its mirrors with tilt sensors."""
    design = example_plant()
    free = tuple(replace(axis, low=-(1 << 28), high=1 << 28) for axis in MACHINE.axes)
    sensors = replace(MACHINE, axes=free, tilt_sensor=True)
    groups = {
        name: replace(group, machines=(sensors,) * len(group.names))
        for name, group in design.groups.items()
    }
    return replace(design, groups=groups)


def play(folder: Path, scene: Play, design: Plant | None = None, **options: object) -> None:
    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, folder, design=design or sensed(), **options)
        for cluster in bench.clusters.values():
            cluster.diagnoses = dict.fromkeys(cluster.names, MOVED)
            cluster.rows["flags"] = READY
        async with running(bench):
            await bench.wait(2.0)
            await scene(bench)

    run_virtual(main)


def standing(bench: Bench, kind: alarms.AlarmKind) -> set[str]:
    """Heliostats of which an alarm has not ended."""
    last = {a.subject: a.active for a in bench.plant.alarms if a.condition == kind.name}
    return {name for name, active in last.items() if active}


@contextlib.asynccontextmanager
async def automatic(
    bench: Bench, told: list[Alarm] | None = None
) -> AsyncIterator[AutomaticControl]:
    """Automatic control beside a block; its alarms are ``told``."""
    log = Logbook(bench.clock)
    log.forward = None if told is None else told.append
    control = AutomaticControl(bench.plant, log, settings=WORK)
    task = asyncio.create_task(control.run())
    try:
        yield control
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def diagnosed(bench: Bench, name: str, result: int) -> None:
    """A person gives Diagnose to a heliostat, and its board comes to a result."""
    cluster = bench.cluster_of(name)
    cluster.diagnoses[name] = result
    cluster.set(states.IDLE, name)
    await bench.wait(2.0)
    token = bench.plant.take_authority(ENGINEER).token
    assert await bench.plant.command(ENGINEER, token, "DIAGNOSE", (name,)).end(5.0)
    await bench.wait(1.0)


def test_a_mirror_that_does_not_follow_joins_no_receiver(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        await diagnosed(bench, "P5A", diagnosis.STUCK_PRIMARY | diagnosis.MOVED_SECONDARY)
        (alarm,) = [a for a in plant.alarms if a.condition == alarms.DRIVE_STALLED.name]
        assert alarm.text.startswith(
            "P5A: its primary drive made steps, but its mirror did not follow. It joins no receiver"
        )
        token = plant.take_authority(ENGINEER).token
        bench.cluster_of("P5B").set(states.IDLE, "P5B")
        plant.aim(ENGINEER, token, plant.default_aims(("P5A", "P5B")))
        await bench.wait(2.0)
        with pytest.raises(RefusedError, match=r"TRACK P5A.*its mirror did not follow"):
            plant.command(ENGINEER, token, "TRACK", ("P5A",))
        assert plant.command(ENGINEER, token, "TRACK", ("P5A", "P5B")).blocked.keys() == {"P5A"}
        # A person confirms it, and it is due to be diagnosed again.
        with pytest.raises(RefusedError):
            plant.acknowledge(VIEWER, "drive_stalled", "P5A")
        plant.acknowledge(OPERATOR, "drive_stalled", "P5A")
        assert not standing(bench, alarms.DRIVE_STALLED)
        assert "P5A" in plant.drive_checks.due
        assert not plant.command(ENGINEER, token, "TRACK", ("P5A",)).blocked
        # So does a diagnosis that sees it move, and a photograph on a target.
        for name, follow in (("P5A", TILT_SENSOR), ("P5B", PHOTOGRAPH)):
            await diagnosed(bench, name, diagnosis.STUCK_SECONDARY)
            assert standing(bench, alarms.DRIVE_STALLED) == {name}
            assert name not in plant.drive_checks.due
            if follow == TILT_SENSOR:
                await diagnosed(bench, name, diagnosis.MOVED_SECONDARY)
            else:
                plant.drive_checks.observed(name, PHOTOGRAPH)
            assert not standing(bench, alarms.DRIVE_STALLED)
            assert plant.drive_checks.shown[name] == follow

    play(tmp_path, scene)


def test_a_fault_that_a_board_reports_is_a_stall_until_it_is_confirmed(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        cluster = bench.cluster_of("P5A")
        row = cluster.names.index("P5A")
        cluster.set(states.FAULT, "P5A")
        cluster.rows["fault"][row] = STUCK
        await bench.wait(3.0)
        assert standing(bench, alarms.DRIVE_STALLED) == {"P5A"}
        assert "secondary" in bench.plant.drive_checks.stalled["P5A"]
        # A reset makes "latched" of the fault, and CLEAR_FAULT ends it; the mirror stays named.
        for fault in (names.FAULTS.index("latched before the reset"), 0):
            cluster.rows["fault"][row] = fault
            await bench.wait(2.0)
            assert standing(bench, alarms.DRIVE_STALLED) == {"P5A"}
        bench.plant.acknowledge(OPERATOR, "drive_stalled", "P5A")
        await bench.wait(2.0)
        assert not standing(bench, alarms.DRIVE_STALLED)
        cluster.rows["fault"][row] = STUCK
        await bench.wait(2.0)
        assert standing(bench, alarms.DRIVE_STALLED) == {"P5A"}

    play(tmp_path, scene)


@pytest.mark.parametrize("act", [Act.DEFOCUS, Act.STOW])
def test_nothing_that_a_stalled_mirror_reports_proves_an_emergency(
    act: Act, tmp_path: Path
) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        await diagnosed(bench, "P5A", diagnosis.STUCK_PRIMARY)
        order = plant.raise_emergency("Olga", act)
        await bench.wait(10.0)
        report = order.report(plant.now())
        assert report.not_done == ("P5A",)
        assert (
            "P5A: its primary drive made steps, but its mirror did not follow, so its reports "
            "cannot prove that its beam is off the receiver"
        ) in report.text
        plant.acknowledge(OPERATOR, "drive_stalled", "P5A")
        await bench.wait(3.0)
        assert order.report(plant.now()).complete

    play(tmp_path, scene)


def test_a_proof_says_which_mirrors_were_seen_to_follow_and_which_are_believed(
    tmp_path: Path,
) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        work = Operations(
            plant,
            log := Logbook(bench.clock),
            AutomaticControl(plant, log, settings=AutomaticSettings(calibrate=False)),
        )
        await diagnosed(bench, "P5A", MOVED)
        plant.drive_checks.observed("P5B", PHOTOGRAPH)
        plant.drive_checks.observed("P5C", PHOTOGRAPH)
        bench.cluster_of("P1A").deaf.add("P1A")
        bench.cluster_of("P1A").set(states.TRACKING, "P1A")
        plant.raise_emergency("Olga", Act.STOW)
        await bench.wait(10.0)
        view = work.viewer.emergency()
        assert (view.done, view.not_done) == (17, ("P1A",))
        assert view.followed == {TILT_SENSOR: 1, PHOTOGRAPH: 2}
        assert view.believed_count == len(view.believed) == 14
        assert {"P1A", "P5A", "P5B", "P5C"}.isdisjoint(view.believed)
        assert not view.measured
        assert view.basis == (
            "the flux on the receiver is not measured, so this is not proven, because a stalled "
            "drive reports the same; 2 seen to move today by photograph; 1 seen to move today by "
            "tilt sensor; "
            "14 by reports alone"
        )
        first = ": P1B, P1C, P2A, P2B, P2C, P3A, P3B, P3C, …"
        assert view.text.endswith(view.basis + first)
        assert len(work.viewer.emergency(5).believed) == 5
        # What was seen yesterday says nothing of today.
        plant.drive_checks._shown["P5B"] = (plant.drive_checks._today().replace(year=2000), "x")
        assert work.viewer.emergency().followed == {TILT_SENSOR: 1, PHOTOGRAPH: 1}

    play(tmp_path, scene)


def test_a_measured_flux_is_said_to_be_measured_and_hides_single_beams(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        work = Operations(
            plant,
            log := Logbook(bench.clock),
            AutomaticControl(plant, log, settings=AutomaticSettings(calibrate=False)),
        )
        plant.raise_emergency("Olga", Act.STOW)
        for _ in range(10):
            await bench.wait(1.0)
            plant.put("receiver_flux_nominal", 0.0)
        view = work.viewer.emergency()
        assert view.measured
        assert (
            "measured: the flux is below its limit (10% of nominal, where single be" in view.basis
        )
        assert "18 by reports alone" in view.basis
        assert "believed" not in view.basis

    settings = PlantSettings(sensors=frozenset({"receiver_flux_nominal"}))
    play(tmp_path, scene, settings=settings)


def test_each_mirror_is_diagnosed_at_stow_before_it_is_raised(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        stalls, blind = "P5A", "P5B"
        bench.cluster_of(stalls).diagnoses[stalls] = diagnosis.STUCK_SECONDARY
        bench.cluster_of(blind).diagnoses[blind] = diagnosis.NO_SENSOR
        async with automatic(bench) as control:
            await bench.until(lambda: bench.count(states.IDLE) == 17, 120.0)
            await bench.wait(60.0)
            assert standing(bench, alarms.DRIVE_STALLED) == {stalls}
            assert standing(bench, alarms.TILT_SENSOR_SILENT) == {blind}
            assert not plant.drive_checks.due
            state = plant.field.of(stalls, plant.now()).state
            assert state == "STOWED", "it is left at stow"
            assert "did not follow" in control.following(0.0, (stalls,))[stalls].text
            for cluster in bench.clusters.values():
                order = {
                    name: [
                        m.name
                        for _, m in cluster.taken
                        if isinstance(m, Command | Emergency)
                        and name in (m.heliostats or cluster.names)
                    ]
                    for name in cluster.names
                }
                for name, given in order.items():
                    up = [] if name == stalls else ["APPROACH"]
                    # An order that crosses a change of the authority is sent again.
                    begin = [what for what, _ in itertools.groupby(given)][: 3 + len(up)]
                    assert begin == ["IDLE", "DIAGNOSE", "STOW", *up], (name, given)
            # Nothing was counted as lost, and nobody has to press Resume.
            assert not control.waits
            assert not control.retries()
            # A person's word lets it be diagnosed again, and then it goes up.
            bench.cluster_of(stalls).diagnoses[stalls] = MOVED
            plant.acknowledge(OPERATOR, "drive_stalled", stalls)
            await bench.until(lambda: bench.count(states.IDLE) == 18, 120.0)
            assert plant.drive_checks.shown[stalls] == TILT_SENSOR

    play(tmp_path, scene)


def test_a_mirror_without_a_tilt_sensor_is_raised_as_ever(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        async with automatic(bench):
            await bench.until(lambda: bench.count(states.IDLE) == 18, 60.0)
        assert not any(c.commands("DIAGNOSE") for c in bench.clusters.values())

    play(tmp_path, scene, design=example_plant())


def test_a_diagnosis_that_does_not_end_is_given_up_with_an_alarm(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    law = replace(CHECKING, wait=2.0, rest=120.0)
    monkeypatch.setattr("heliotrope.plant.operations.movement_checks.CHECKING", law)

    async def scene(bench: Bench) -> None:
        cluster, told = bench.cluster_of("P5A"), list[Alarm]()
        cluster.stubborn.add("P5A")
        async with automatic(bench, told) as control:
            fails = alarms.DIAGNOSIS_FAILS.name
            await bench.until(lambda: fails in {a.condition for a in told}, 120.0)
            (retry,) = control.retries()
            assert (retry.work, retry.subject, retry.given_up) == (law.work, "P5A", True)
            assert len(cluster.commands("IDLE")) >= law.most
            assert bench.count(states.IDLE) == 17, "the others do not wait for it"
            cluster.stubborn.clear()
            await bench.until(lambda: "P5A" in bench.plant.drive_checks.shown, 200.0)
            await bench.until(lambda: not control.retries(), 20.0)
            assert [a.active for a in told if a.condition == fails] == [True, False]

    play(tmp_path, scene)


def test_no_more_than_a_bounded_number_is_diagnosed_at_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert MOST == 200
    monkeypatch.setattr("heliotrope.plant.operations.movement_checks.MOST", 4)
    most = 0

    async def scene(bench: Bench) -> None:
        nonlocal most
        async with automatic(bench) as control:
            while bench.count(states.IDLE) < 18:
                most = max(most, int(control._checks.moved.sum()))
                await bench.wait(0.5)

    play(tmp_path, scene)
    assert most == 4


def test_nothing_is_diagnosed_in_the_cold(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        async def feed(seconds: int) -> None:
            for _ in range(seconds):
                bench.plant.put("temperature", -3.0)
                await bench.wait(1.0)

        await feed(20)
        async with automatic(bench):
            await feed(60)
            assert not any(c.commands("IDLE") for c in bench.clusters.values())
            assert bench.count(states.STOWED) == 18

    play(tmp_path, scene, settings=PlantSettings(sensors=frozenset({"temperature"})))


def test_real_boards_are_diagnosed_by_their_tilt_sensors(tmp_path: Path) -> None:
    """Two real clusters and four boards; the mirror of one is frozen about its secondary axis."""

    async def main(clock: VirtualClock) -> None:
        whole = WholePlant(clock, tmp_path, tilt_sensors=True)
        frozen = "H3"

        def tilt(board: Board) -> tuple[float, float]:
            turned = [axis.turned for axis in board.axes]
            return float(board.outfit.mechanism.drives.angles(np.array(turned))[1]), 0.0

        async def sense() -> None:
            while True:
                for name, board in whole.boards.items():
                    board.tilt = (0.0, 0.0) if name == frozen else tilt(board)
                await asyncio.sleep(0.05)

        async with whole.alive():
            plant = whole.plant
            sensing = asyncio.create_task(sense())
            plant.release_authority(ENGINEER, whole.token)
            control = AutomaticControl(
                plant,
                Logbook(clock),
                settings=WORK,
            )
            task = asyncio.create_task(control.run())
            await whole.until(lambda: len(plant.drive_checks.shown) == 3, 300.0)
            await whole.until(lambda: whole.boards["H1"].state == states.IDLE, 300.0)
            assert plant.drive_checks.stalled.keys() == {frozen}
            await whole.until(lambda: plant.field.of(frozen, plant.now()).state == "FAULT", 60.0)
            for each in (task, sensing):
                each.cancel()
            await asyncio.gather(task, sensing, return_exceptions=True)

    run_virtual(main)
