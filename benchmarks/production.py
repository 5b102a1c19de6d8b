"""Mirrors in production measured on the receiver of a simulated plant, by the plant's own programs.

Clusters, drives and orders are those of operation; the camera shows the light of all mirrors from
where they truly stand, with noise. All heliostats track the receiver, and some of them are measured
at once. What the movements cost is the light on the receiver during the visit, against the same
beams at their aims.
"""

import asyncio
import time
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial

import numpy as np

from benchmarks._run import Result, Row
from heliotrope.calibration.evaluation import beam_errors
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.record import HeliostatCalibration
from heliotrope.calibration.sightings import Sightings
from heliotrope.field import ReceiverSettings
from heliotrope.field.example import roughly_installed
from heliotrope.field.layout_tower import watching_camera
from heliotrope.field.layouts import malan_plant
from heliotrope.field.plant import Plant
from heliotrope.field.target import Target
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.mechanism.chain import Mechanism
from heliotrope.optics.beam import CHI_SQUARE_90
from heliotrope.plant.assembly import AssemblySettings, MachineTables, PlantAssembly
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.orders.authority import Person, Role
from heliotrope.plant.visits.calibration_cycle import CalibrationCycle
from heliotrope.plant.visits.coded_layout import moments_on
from heliotrope.plant.visits.neighbours import Unhidden
from heliotrope.plant.visits.receiver_cycle import ReceiverCycle
from heliotrope.plant.visits.receiver_layout import caught, sunlight_on
from heliotrope.plant.visits.settings import Centring, CycleSettings
from heliotrope.plant.workers import at_once
from heliotrope.twin.live import World, WorldOptions
from heliotrope.twin.true_mirrors import mirrors_near

START = datetime(2026, 10, 21, 7, tzinfo=UTC)
ENGINEER = Person("benchmark", Role.ENGINEER)
BIASES = ("azimuth_bias", "elevation_bias")
CYCLE = CycleSettings(least=1, model=BIASES, sigma=2e-4)
#: Errors of the mirrors' zeros as the plant knows them, rad per axis; goals.
KNOWN, GOAL_MRAD, LOST = 3e-4, 0.5, 0.01
#: Radius about the middle in which the aims are spread, m.
SPREAD = 1.0


def watched(count: int, most: int) -> Plant:
    """Return a plant whose receiver is seen by a camera."""
    plain = malan_plant(count)
    face = plain.receivers[0].face
    camera = replace(watching_camera(face, "eye", 120.0, 30.0, 10.0), targets=("left",))
    settings = ReceiverSettings("eye", face.name, least=1, most=most, power=LOST)
    return replace(plain, cameras=(*plain.cameras, camera), receiver_visits=settings)


class Light:
    """The light on the receiver, by the true beams, in square metres of sunlight."""

    def __init__(self, world: World, face: Target) -> None:
        self._world, self._face = world, face
        groups = world.design.groups.values()
        self._sizes = np.concatenate([np.stack([g.width, g.height], axis=-1) for g in groups])
        self.seen: list[float] = []

    def now(self) -> float:
        """Return the light now."""
        world, sun, total = self._world, self._world.sun(), 0.0
        stand = world.field.stand()
        for mirror in mirrors_near(self._face, sun, stand, world.names, self._sizes):
            place = mirror.on(self._face, sun)
            if np.isfinite(place).all():
                at = self._face.plane_coordinates(place)
                size = mirror.width, mirror.height
                shape = moments_on(self._face, mirror.vertex, mirror.normal, *size, flat=0.7)
                power = size[0] * size[1] * float(mirror.normal @ sun)
                total += power * caught(self._face, at, shape)
        return total

    def note(self, stage: str) -> None:
        """Note the light in which a photograph begins."""
        if stage.startswith("photograph"):
            self.seen.append(self.now())


async def _visit(clock: VirtualClock, count: int, most: int, rows: list[Row]) -> None:
    design = watched(count, most)
    options = WorldOptions(rendered=False, installed=partial(roughly_installed, seed=3, scale=0.03))
    world = World(design, clock, options)
    work = AutomaticSettings(wanted=True, calibrate=False)
    built = PlantAssembly(
        design, world.ports(), AssemblySettings(work, cycle=CYCLE, machines=MachineTables.HELD)
    )
    plant, face = built.plant, design.receivers[0].face
    async with built.running():
        while not plant.field.among((states.TRACKING,), plant.now()).all():
            await asyncio.sleep(2.0)
        await built.operations.automatic.halt()
        at, spread = clock.utc().timestamp(), np.diag([KNOWN**2, KNOWN**2])
        for name in plant.field.names:
            record = HeliostatCalibration(name, at, BIASES, np.zeros(2), spread, np.full(2, 5e-3))
            plant.beliefs.take(record)
        token = plant.take_authority(ENGINEER).token
        await asyncio.sleep(3.0)
        rng = np.random.default_rng(7)
        radius, turn = SPREAD * np.sqrt(rng.random(count)), 2.0 * np.pi * rng.random(count)
        places = radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        aims = dict(zip(plant.field.names, face.point(places), strict=True))
        keeping = asyncio.create_task(_stay(built, token))
        await plant.aim(ENGINEER, token, aims).end(300.0)
        await asyncio.sleep(30.0)
        rows.append(await _measured(built, world, token, most))
        keeping.cancel()
        await built.end()


async def _stay(built: PlantAssembly, token: int) -> None:
    while True:
        built.plant.authority.keep(ENGINEER, token)
        await asyncio.sleep(1.0)


async def _measured(built: PlantAssembly, world: World, token: int, most: int) -> Row:
    plant, settings = built.plant, built.design.receiver_visits
    assert settings is not None
    unhidden = Unhidden(plant, at_once)
    whole = CalibrationCycle(plant, world.cameras, CYCLE, Centring(), unhidden)
    cycle = ReceiverCycle(plant, world.cameras, whole, settings)
    face = built.design.receiver(settings.receiver).face
    light = Light(world, face)
    before, begun, spent = light.now(), plant.now(), time.process_time()
    order = np.random.default_rng(1).permutation(plant.field.names)[:most]
    stages: list[tuple[str, float]] = []

    def tell(stage: str) -> None:
        stages.append((stage, plant.now()))
        light.note(stage)

    results = await cycle.run(ENGINEER, token, tuple(order.tolist()), face.name, tell)
    after = light.now()
    error, inside = [], []
    for result in results:
        seen = plant.beliefs.known(result.heliostat)
        if seen is None:
            continue
        true = world.truth[np.array([world.names.index(result.heliostat)])]
        miss, distance = _miss(true, seen.sightings)
        error.append(miss)
        inside.append(distance < CHI_SQUARE_90)
    taken = [at for stage, at in stages if stage.startswith("photograph")]
    usual = 0.5 * (before + after)
    return {
        "field": len(plant.field),
        "mirrors": len(results),
        "photographs": len(taken),
        "seen": len(error),
        "rms_mrad": 1e3 * float(np.sqrt(np.mean(np.square(error)))),
        "worst_mrad": 1e3 * max(error),
        "within_90": float(np.mean(inside)),
        "power_lost_share": float(1.0 - np.mean(light.seen) / usual),
        "production_m2": sunlight_on(plant, face),
        "stack_s": taken[-1] - taken[0],
        "visit_s": plant.now() - begun,
        "cpu_s": time.process_time() - spent,
        "changed": sum(result.outcome.calibrated for result in results),
    }


def _miss(true: Mechanism, seen: Sightings) -> tuple[float, float]:
    """Return how far a sighting is from the truth, rad, and in squared deviations."""
    residual = linearise(true, seen, BIASES).residual[0]
    return float(beam_errors(true, seen).beam[0]), float(residual @ residual)


def run(quick: bool) -> Result:
    """Measure the error of mirrors that are measured in production."""
    rows: list[Row] = []
    for count, most in ((4, 2),) if quick else ((150, 50),):
        run_virtual(partial(_visit, count=count, most=most, rows=rows), start=START)
    last = rows[-1]
    return Result(
        rows,
        f"{last['mirrors']} of {last['field']} mirrors in production: {last['rms_mrad']:.2f} mrad "
        f"RMS at {100.0 * float(last['power_lost_share'] or 0.0):.2g} % of the power",
        {},
        bool(
            float(last["rms_mrad"] or 1.0) <= GOAL_MRAD
            and float(last["power_lost_share"] or 0.0) <= LOST
        ),
    )
