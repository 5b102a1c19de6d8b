"""The calibration cycle against scripted clusters: what goes wrong, and how it ends.

That a cycle makes a real mirror better is shown in test_plant_whole.py.
"""

import asyncio
import contextlib
import re
from collections.abc import Awaitable, Callable
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from zlib import crc32

import numpy as np
import pytest

from heliotrope import sun
from heliotrope.calibration.fit import fit
from heliotrope.calibration.flights import Flight
from heliotrope.calibration.record import CalibrationOutcome, HeliostatCalibration
from heliotrope.calibration.sightings import drone
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.example import example_plant
from heliotrope.field.plant import Plant
from heliotrope.field.target import Target
from heliotrope.geometry import angle_between, normalize, reflect
from heliotrope.lcu import names as meanings
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import Parameters
from heliotrope.mechanism.board_items import items_of, packed
from heliotrope.mechanism.tracking import track
from heliotrope.plant.field.flights import TakenFlight
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.plant.visits.calibration_cycle import (
    CalibrationCycle,
    CycleResult,
    CycleSettings,
    Shot,
)
from heliotrope.plant.visits.settings import SIMPLE
from heliotrope.plant.visits.visit import Visit
from heliotrope.safety import alarms
from support.plant_bench import ENGINEER, OPERATOR, Bench, running

NAME = "P2A"
HOME = states.IDLE
STOPPED = "it has been stopped"


class Eye:
    """A camera: says where the beam of a mirror is that is off by ``error`` (rad) from nominal."""

    def __init__(self, bench: Bench, **error: float) -> None:
        self.bench, self.error = bench, error
        self.reasons: tuple[str, ...] = ()
        self.count = 0
        self.during: Callable[[], None] = lambda: None

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        await self.bench.wait(0.5)
        at = self.bench.clock.monotonic()
        self.count += 1
        self.during()
        cluster = self.bench.cluster_of(heliostat)
        node = cluster.rows[cluster.names.index(heliostat)]
        group, row = self.bench.design.find(heliostat)
        real = group.mechanism[row].with_parameters(self.error)
        pose = real.pose([float(node["primary"]), float(node["secondary"])])
        sun = self.bench.plant.sun_vector()
        ray = 2.0 * (pose.normal @ sun) * pose.normal - sun
        return Shot(target.intersect(pose.vertex, ray), at, 1e-4, self.reasons)


async def follow(bench: Bench, *, learns: bool) -> None:
    """The scripted mirror tracks the target as its nominal mechanism, or its board, says."""
    cluster, plant = bench.cluster_of(NAME), bench.plant
    place, row = cluster.names.index(NAME), np.array([plant.field.place(NAME)])
    aim, nominal = bench.design.targets[0].center, plant.beliefs.nominal(NAME)[0]
    while True:
        if learns:
            aims = plant.aims[row] if np.isfinite(plant.aims[row]).all() else aim[None]
            poses = plant.beams.poses(row, aims, plant.sun_vector())
            counts = poses.best_counts[0]
            armature = packed("armature", tuple(plant.beams.armature.table[row[0]]))
            cluster.rows["armature_crc"][place] = crc32(armature)
        else:
            found = track(nominal, plant.sun_vector(), aim)
            counts = found.best_counts
        for axis, end in enumerate(("primary", "secondary")):
            count = round(float(counts[axis]))
            cluster.rows[end][place] = cluster.rows[f"{end}_goal"][place] = count
        await bench.wait(0.2)


def cycle(
    folder: Path,
    scene: Callable[[Bench, CalibrationCycle, Eye, int], Awaitable[None]],
    settings: CycleSettings | None = None,
    state: int = HOME,
    design: Plant | None = None,
    learns: bool = False,
    **error: float,
) -> Bench:
    """Play a scene with a heliostat at standby and an engineer who stays."""
    made: list[Bench] = []

    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, folder, design=design)
        made.append(bench)
        bench.cluster_of(NAME).set(state, NAME)
        async with running(bench):
            token = await bench.commanded(ENGINEER)
            eye = Eye(bench, **error)
            given = settings or CycleSettings(shots=2, interval=5.0, least=2)
            whole = CalibrationCycle(bench.plant, eye, given)

            async def stay() -> None:
                while bench.plant.authority.token == token:
                    bench.plant.authority.keep(ENGINEER, token)
                    await bench.wait(1.0)

            async with asyncio.TaskGroup() as group:
                others = [
                    group.create_task(stay()),
                    group.create_task(follow(bench, learns=learns)),
                ]
                await scene(bench, whole, eye, token)
                for other in others:
                    other.cancel()

    run_virtual(main)
    return made[0]


def state_of(bench: Bench) -> int:
    cluster = bench.cluster_of(NAME)
    return int(cluster.rows["state"][cluster.names.index(NAME)])


def test_two_visits_make_one_fit_and_the_second_changes_nothing_more(tmp_path: Path) -> None:
    results: list[CycleResult] = []
    taken: list[HeliostatCalibration] = []

    async def scene(bench: Bench, whole: CalibrationCycle, eye: Eye, token: int) -> None:
        known: list[object] = []
        bench.plant.beliefs.subscribe(taken.append)
        eye.during = lambda: known.append(bench.plant.beliefs.record(NAME))
        results.append(await whole.run(ENGINEER, token, NAME, "target"))
        assert state_of(bench) == HOME
        assert eye.count == 3
        # The third photograph confirms a fit that has not seen it, and is learnt from after that.
        assert known == [None, None, None]
        record = bench.plant.beliefs.record(NAME)
        assert record is not None
        assert (record.version, len(record.sightings)) == (2, 3)
        results.append(await whole.run(ENGINEER, token, NAME, "target"))
        # Only a first calibration and a large change are confirmed by one photograph more.
        assert eye.count == 5
        new = items_of(bench.plant.beliefs.present(NAME)[0])
        assert bench.cluster_of(NAME).stored[NAME] == new

    bench = cycle(tmp_path, scene, azimuth_bias=3e-3, elevation_bias=-2e-3)
    assert [(r.known, r.new) for r in results] == [(3, 3), (5, 2)]
    assert all(r.outcome is CalibrationOutcome.CALIBRATED for r in results)
    first = f"calibrated: beam error {1e3 * results[0].before:.2f} to "
    assert results[0].text.startswith(first), results[0].text
    assert results[0].text.endswith("over 3 sightings")
    records = [r.record for r in results]
    assert [r and r.version for r in records] == [2, 3]
    assert bench.plant.beliefs.record(NAME) is records[1]
    assert results[0].after < 1e-4 < 3e-3 < results[0].before
    # It was locked each time; the drives were not known there, and needed no second writing.
    assert [record.version for record in taken] == [1, 2, 3]
    assert set(taken[0].pushed) == set(items_of(prototype_machine(bench)))
    assert len(bench.cluster_of(NAME).commands("LOCK")) == 3
    assert "drive_primary" not in taken[2].pushed
    assert bench.cluster_of(NAME).commands("AIM")[0].values == (0.0, 0.0, 13.0)


def prototype_machine(bench: Bench) -> Any:
    group, row = bench.design.find(NAME)
    return group.mechanism[row]


def test_a_visit_fits_the_rows_of_a_flight_with_its_photographs(tmp_path: Path) -> None:
    results: list[CycleResult] = []
    error = {"azimuth_bias": 3e-3, "elevation_bias": -2e-3}

    async def scene(bench: Bench, whole: CalibrationCycle, eye: Eye, token: int) -> None:
        group, row = bench.design.find(NAME)
        counts = np.array([[20_000.0 + 4_000.0 * k, 6_000.0 + 3_000.0 * k] for k in range(4)])
        pose = group.mechanism[[row] * 4].with_parameters(error).pose(counts)
        place = pose.vertex + 100.0 * pose.normal
        at = bench.clock.utc().timestamp() - 3600.0
        made = drone(np.zeros(4, int), counts, place, place, time=at, sigma=1e-4)
        shift = np.tile(np.eye(3), (4, 1, 1))
        flight = Flight(
            "one", (NAME,), made, np.array([1e-4]), ("e", "n", "u"), 1e-4 * np.eye(3), shift
        )
        numbers = np.array([7, 8, 9, 10])
        beliefs = bench.plant.beliefs
        beliefs.flights = beliefs.flights.adding(TakenFlight(flight, numbers, 1.8e9, "Egon"))
        results.append(await whole.run(ENGINEER, token, NAME, "target"))
        # What the visit revealed of the flight's errors counts for all other mirrors.
        mean, covariance = beliefs.flights.shared()
        assert np.abs(mean).max() < 0.01
        assert np.trace(covariance) < 0.999 * 3e-4

    cycle(tmp_path, scene, **error)
    (result,) = results
    assert (result.outcome, result.known, result.new) == (CalibrationOutcome.CALIBRATED, 7, 3)
    assert result.record is not None
    assert result.record.sightings.tolist()[3:] == [7, 8, 9, 10]
    found = result.record.parameters
    sigma = dict(zip(result.record.names, result.record.sigma, strict=True))
    assert sigma["azimuth_bias"] < 1e-3
    assert abs(found["azimuth_bias"] - 3e-3) < 3.0 * sigma["azimuth_bias"]


@pytest.mark.parametrize(
    ("settings", "error", "reasons", "outcome", "said"),
    [
        (
            {"most": 0.01},
            {"azimuth_bias": 3e-3},
            (),
            CalibrationOutcome.IMPLAUSIBLE,
            "prior standard deviations from its expected value, above the limit of 0.01",
        ),
        (
            {},
            {"tilt_east": 0.3},
            (),
            CalibrationOutcome.POOR_FIT,
            "the fit leaves .* above the limit of 3 mrad",
        ),
        (
            {"least": 5},
            {},
            (),
            CalibrationOutcome.TOO_FEW_SIGHTINGS,
            "unchanged: 2 sightings, 5 are needed",
        ),
        (
            {},
            {},
            ("cloud",),
            CalibrationOutcome.NO_PHOTOGRAPH,
            "unchanged: no photograph could be used",
        ),
        (
            {"gain": 0.5, "model": ("azimuth_bias",)},
            {"elevation_bias": 1e-3},
            (),
            CalibrationOutcome.NO_BETTER,
            "the fit leaves .* not below 0.5 times",
        ),
    ],
)
def test_what_has_not_earned_it_is_not_pushed(
    tmp_path: Path,
    settings: dict[str, Any],
    error: dict[str, float],
    reasons: tuple[str, ...],
    outcome: CalibrationOutcome,
    said: str,
) -> None:
    results: list[CycleResult] = []

    async def scene(bench: Bench, whole: CalibrationCycle, eye: Eye, token: int) -> None:
        eye.reasons = reasons
        results.append(await whole.run(ENGINEER, token, NAME, "target"))
        assert state_of(bench) == HOME

    given = CycleSettings(**{"shots": 2, "interval": 5.0, "least": 2, **settings})
    bench = cycle(tmp_path, scene, given, **error)
    (result,) = results
    assert re.search(said, result.text), result.text
    assert result.outcome is outcome
    assert result.record is None
    assert len(result.rejected) == (2 if reasons else 0)
    assert not bench.cluster_of(NAME).of(Parameters)


def test_a_calibration_stays_if_its_verification_cannot_be_learnt_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results: list[CycleResult] = []
    pushes: list[str] = []
    push = CalibrationCycle._push

    async def once(self: CalibrationCycle, visit: Visit, mechanism: Any, why: str) -> Any:
        pushes.append(why)
        if len(pushes) == 2:
            raise RefusedError(f"{NAME}: it is waiting its turn to go to stow")
        return await push(self, visit, mechanism, why)

    monkeypatch.setattr(CalibrationCycle, "_push", once)

    async def scene(bench: Bench, whole: CalibrationCycle, eye: Eye, token: int) -> None:
        results.append(await whole.run(ENGINEER, token, NAME, "target"))

    bench = cycle(tmp_path, scene, azimuth_bias=3e-3, elevation_bias=-2e-3)
    (result,) = results
    assert pushes == ["fit of 2 sightings", "fit of 3 sightings"]
    assert (result.outcome, result.known, result.new) == (CalibrationOutcome.CALIBRATED, 2, 2)
    assert bench.plant.beliefs.record(NAME) is result.record
    assert bench.plant.wanted.items[NAME] == items_of(bench.plant.beliefs.present(NAME)[0])


def sent_to_the_receiver(bench: Bench, token: int) -> None:
    """As if the aim on the receiver had been given before the visit."""
    plant, row = bench.plant, bench.plant.field.place(NAME)
    before = plant.aims[row].copy()
    plant.aims[row] = plant.default_aims((NAME,))[NAME]
    try:
        plant.command(ENGINEER, token, "REFOCUS", (NAME,))
    finally:
        plant.aims[row] = before


def test_one_whose_verification_was_broken_off_moves_when_the_old_parameters_are_back(
    tmp_path: Path,
) -> None:
    async def scene(bench: Bench, whole: CalibrationCycle, eye: Eye, token: int) -> None:
        plant, cluster = bench.plant, bench.cluster_of(NAME)
        await whole.run(ENGINEER, token, NAME, "target")
        old = dict(cluster.stored[NAME])
        eye.error = {"azimuth_bias": 9e-3}
        begin = eye.count
        eye.during = lambda: (
            plant.authority.end_mandates(ENGINEER, STOPPED) if eye.count >= begin + 6 else None
        )
        with pytest.raises(RefusedError, match=STOPPED):
            await whole.run(ENGINEER, token, NAME, "target")
        assert cluster.stored[NAME] != old
        again = plant.take_authority(ENGINEER).token
        cluster.set(states.IDLE, NAME)
        for _ in range(40):
            await bench.wait(1.0)
            plant.authority.keep(ENGINEER, again)
            for name in ("TRACK", "REFOCUS"):
                with pytest.raises(RefusedError, match=f"{name} P2A.*stored parameters differ"):
                    plant.command(ENGINEER, again, name, (NAME,))
        assert cluster.stored[NAME] != old, "its beam is out: they are written at stow"
        told = [a for a in plant.alarms if a.condition == alarms.PARAMETERS_DIFFER.name]
        assert told[-1].subject == NAME
        assert "No motion except DEFOCUS and STOW is accepted" in told[-1].text
        plant.stow("Vera", (NAME,))
        for _ in range(70):
            await bench.wait(1.0)
            plant.authority.keep(ENGINEER, again)
        assert cluster.stored[NAME] == old
        assert state_of(bench) == states.STOWED
        cluster.set(states.IDLE, NAME)
        await bench.wait(2.0)
        plant.aim(ENGINEER, again, plant.default_aims((NAME,)))
        plant.command(ENGINEER, again, "TRACK", (NAME,))

    settings = CycleSettings(shots=5, interval=5.0, least=2, left=1.0)
    cycle(tmp_path, scene, settings, azimuth_bias=1e-3)


@pytest.mark.parametrize("why", ["another light", "cloud", "stopped"])
def test_a_large_change_that_no_photograph_confirms_is_withdrawn(tmp_path: Path, why: str) -> None:
    results: list[CycleResult] = []
    refused: list[str] = []

    async def scene(bench: Bench, whole: CalibrationCycle, eye: Eye, token: int) -> None:
        plant, cluster = bench.plant, bench.cluster_of(NAME)
        first = await whole.run(ENGINEER, token, NAME, "target")
        old = dict(cluster.stored[NAME])
        assert first.outcome is CalibrationOutcome.CALIBRATED
        seen = plant.beliefs.known(NAME)
        eye.error = {"azimuth_bias": 9e-3}
        begin = eye.count

        def during() -> None:
            if eye.count < begin + 6:
                return
            assert plant.wanted.items[NAME] != old
            if state_of(bench) == states.TRACKING and plant.authority.token == token:
                with pytest.raises(RefusedError, match=r"AIM P2A.*has yet to verify"):
                    plant.aim(ENGINEER, token, plant.default_aims((NAME,)))
                with pytest.raises(RefusedError, match=r"REFOCUS P2A.*has yet to verify"):
                    sent_to_the_receiver(bench, token)
                refused.append(why)
            eye.error = {"azimuth_bias": -9e-3} if why == "another light" else eye.error
            eye.reasons = ("cloud",) if why == "cloud" else ()
            if why == "stopped":
                plant.authority.end_mandates(ENGINEER, STOPPED)

        eye.during = during
        if why == "stopped":
            with pytest.raises(RefusedError, match=STOPPED):
                await whole.run(ENGINEER, token, NAME, "target")
        else:
            results.append(await whole.run(ENGINEER, token, NAME, "target"))
            assert cluster.stored[NAME] == old
        assert plant.wanted.items[NAME] == old
        assert plant.beliefs.record(NAME) is first.record
        assert plant.beliefs.known(NAME) is seen
        old_table = plant.beliefs.present(NAME)[0].armature.table
        assert (plant.beams.armature.table[plant.field.place(NAME)] == old_table).all()

    settings = CycleSettings(shots=5, interval=5.0, least=2, left=1.0)
    cycle(tmp_path, scene, settings, learns=True, azimuth_bias=1e-3)
    assert refused
    for result in results:
        assert result.outcome is CalibrationOutcome.NOT_VERIFIED
        assert result.record is None
        said = {"another light": "m from its predicted position", "cloud": "be used: cloud"}[why]
        assert said in result.text


def test_a_mirror_that_leaves_its_aim_is_not_believed(tmp_path: Path) -> None:
    async def scene(bench: Bench, whole: CalibrationCycle, eye: Eye, token: int) -> None:
        def fault() -> None:
            bench.cluster_of(NAME).set(states.FAULT, NAME)

        async def photograph(target: Target, heliostat: str) -> Shot:
            fault()
            await bench.wait(2.5)
            return Shot(target.center, bench.clock.monotonic())

        eye.photograph = photograph  # type: ignore[method-assign]
        with pytest.raises(RefusedError, match="it left its aim while it was photographed"):
            await whole.run(ENGINEER, token, NAME, "target")
        assert bench.plant.beliefs.known(NAME) is None

    cycle(tmp_path, scene)


def test_a_visit_that_is_stopped_takes_the_beam_off_the_target(tmp_path: Path) -> None:
    async def scene(bench: Bench, whole: CalibrationCycle, eye: Eye, token: int) -> None:
        eye.during = lambda: bench.plant.authority.end_mandates(ENGINEER, STOPPED)
        with pytest.raises(RefusedError, match=STOPPED):
            await whole.run(ENGINEER, token, NAME, "target")
        await bench.wait(1.0)
        assert state_of(bench) == states.DEFOCUSED

    cycle(tmp_path, scene, CycleSettings(shots=1, least=1))


def test_a_cycle_that_is_cancelled_takes_the_beam_off_too(tmp_path: Path) -> None:
    async def scene(bench: Bench, whole: CalibrationCycle, eye: Eye, token: int) -> None:
        del eye
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(9.0):
                await whole.run(ENGINEER, token, NAME, "target")
        await bench.wait(2.0)
        assert state_of(bench) in (states.IDLE, states.DEFOCUSED)

    cycle(tmp_path, scene, CycleSettings(shots=9, interval=30.0))


def test_who_is_not_at_standby_stays_where_it_is(tmp_path: Path) -> None:
    async def scene(bench: Bench, whole: CalibrationCycle, eye: Eye, token: int) -> None:
        del eye
        with pytest.raises(RefusedError, match=r"P2A is STOWED; bring it to standby"):
            await whole.run(ENGINEER, token, NAME, "target")
        with pytest.raises(UnknownNameError, match="no target 'wall'"):
            await whole.run(ENGINEER, token, NAME, "wall")
        with pytest.raises(RefusedError, match="visit: Olga is operator"):
            await whole.run(OPERATOR, token, NAME, "target")
        bench.clusters["pod-2"].age_ms[:] = 9000
        await bench.wait(5.0)
        with pytest.raises(RefusedError, match=r"P2A: not heard for \d+ s; it cannot be commanded"):
            await whole.run(ENGINEER, token, NAME, "target")

    bench = cycle(tmp_path, scene, state=states.STOWED)
    assert not bench.cluster_of(NAME).commands("IDLE")
    with pytest.raises(InputError, match="shots must be 1 or more"):
        CycleSettings(shots=0)


class _Stuck(Visit):
    """Of a heliostat that cannot be brought home."""

    def __init__(self) -> None:
        self.heliostat = "A"
        fine = SimpleNamespace(fine=lambda names: contextlib.nullcontext())
        self.plant = SimpleNamespace(stepping=fine)  # type: ignore[assignment]

    async def home(self) -> None:
        raise RefusedError("nobody has the authority")


def test_who_is_cancelled_ends_as_cancelled_whatever_happens_on_the_way_home() -> None:
    async def main(_: VirtualClock) -> None:
        with pytest.raises(RefusedError, match="authority"):
            async with _Stuck():
                pass
        started = asyncio.Event()

        async def visit() -> None:
            async with _Stuck():
                started.set()
                await asyncio.Event().wait()

        task = asyncio.create_task(visit())
        await started.wait()
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    run_virtual(main)


def doubtful(bench: Bench, boots: int) -> None:
    """Let the board report that its step counts are in doubt."""
    cluster = bench.cluster_of(NAME)
    row = cluster.names.index(NAME)
    cluster.rows["flags"][row] = 1 << meanings.FLAGS.index("COUNTS_DOUBTFUL")
    cluster.rows["boots"][row] = boots


@pytest.mark.parametrize("seen", ["the beam", "nothing", "a power cut"])
def test_a_photograph_confirms_step_counts_in_doubt(tmp_path: Path, seen: str) -> None:
    async def scene(bench: Bench, whole: CalibrationCycle, eye: Eye, token: int) -> None:
        plant, row = bench.plant, bench.plant.field.place(NAME)
        doubtful(bench, 4)
        await bench.wait(2.0)
        assert plant.doubtful.standing[row]
        if seen == "nothing":
            eye.reasons = ("cloud",)
        elif seen == "a power cut":
            # It shows in no state; the photographs say nothing of the counts after it.
            eye.during = lambda: doubtful(bench, 5)
        await whole.run(ENGINEER, token, NAME, "target")
        await bench.wait(2.0)
        assert plant.doubtful.standing[row] == (seen != "the beam")
        if seen == "the beam":
            doubtful(bench, 5)
            await bench.wait(2.0)
            assert plant.doubtful.standing[row], "the next cut ends the confirmation"

    cycle(tmp_path, scene)


def test_a_beam_that_is_beside_its_place_confirms_nothing(tmp_path: Path) -> None:
    """Six milliradians off, and too few sightings for a fit that could explain them."""

    async def scene(bench: Bench, whole: CalibrationCycle, eye: Eye, token: int) -> None:
        del eye
        doubtful(bench, 4)
        await whole.run(ENGINEER, token, NAME, "target")
        await bench.wait(2.0)
        assert bench.plant.doubtful.standing[bench.plant.field.place(NAME)]

    given = CycleSettings(shots=1, interval=5.0, least=5)
    cycle(tmp_path, scene, given, azimuth_bias=3e-3)


#: To the next visit, s: from June 21, 10:00 UTC, to September 21 and December 21, so that the
#: elevation crosses half a radian, 2.6 turns of the worm.
HOUR = 3600.0
STEPS_OF_TIME = [2 * HOUR, 2 * HOUR, (92 * 24 - 8) * HOUR]
STEPS_OF_TIME += [1.5 * HOUR] * 5 + [(91 * 24 - 8.5) * HOUR] + [1.5 * HOUR] * 8


def ungeared() -> Plant:
    """The plant without the ratios of the worms in its plant file."""
    plant = example_plant()
    groups = {}
    for name, group in plant.groups.items():
        drives = group.mechanism.drives.replace(worm_ratio=0.0)
        groups[name] = replace(group, mechanism=replace(group.mechanism, drives=drives))
    return replace(plant, groups=groups)


def test_the_plant_finds_a_worm_that_the_constants_leave(tmp_path: Path) -> None:
    """Malan's worm, 1.35 mrad at 30:1 on the elevation; the plant file does not name it."""
    results: list[CycleResult] = []
    left: dict[str, list[float]] = {"constants": [], "plant": []}

    async def scene(bench: Bench, whole: CalibrationCycle, eye: Eye, token: int) -> None:
        for step in STEPS_OF_TIME:
            results.append(await whole.run(ENGINEER, token, NAME, "target"))
            bench.clock.jump(step)
            await bench.wait(3.0)
            bench.cluster_of(NAME).set(HOME, NAME)
        beliefs = bench.plant.beliefs
        seen, nominal = beliefs.known(NAME), beliefs.nominal(NAME)
        assert seen is not None
        constants = nominal.with_parameters(fit(nominal, seen.sightings, SIMPLE).parameters)
        real = nominal.with_parameters(eye.error)
        for day in (20, 60):
            for hour in range(7, 17):
                utc = bench.clock.utc() + timedelta(days=day, hours=hour)
                light = sun.vector(utc, bench.design.site)
                if light[2] < 0.25:
                    continue
                aim = bench.design.targets[0].center
                for name, machine in (("constants", constants), ("plant", beliefs.present(NAME))):
                    found = track(machine, light, aim)
                    pose = real.pose(found.best_counts)
                    ray = reflect(light, pose.normal[0])
                    left[name].append(float(angle_between(ray, normalize(aim - pose.vertex[0]))))

    made = cycle(
        tmp_path,
        scene,
        CycleSettings(shots=2, interval=5.0, least=2, model="auto"),
        design=ungeared(),
        learns=True,
        tilt_north=3e-3,
        azimuth_bias=-4e-3,
        elevation_worm_cos=1.03e-3,
        elevation_worm_sin=0.87e-3,
        elevation_worm_ratio=30.0,
    )
    assert results[0].record is not None
    assert results[0].record.model == SIMPLE
    last = made.plant.beliefs.record(NAME)
    assert last is not None
    assert last.model.endswith("worm")
    assert float(np.sqrt(np.mean(np.square(left["constants"])))) > 1e-3
    assert float(np.sqrt(np.mean(np.square(left["plant"])))) < 0.5e-3
    assert last.parameters["elevation_worm_ratio"] == pytest.approx(30.0, abs=0.5)
