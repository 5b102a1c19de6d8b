"""Automatic control in a run: raising, visits to targets, and the records of both.

The environments "visits", "lights", "day", "parties" and "days" run the whole plant, not only its
controller: `Operations` with automatic control and calibration visits. The store outlives the plant
program, as a disk does.
"""

import contextlib
import math
import random
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.learn.drift import START_NOISE
from heliotrope.links.clock import Clock
from heliotrope.mechanism.board_items import items_of
from heliotrope.plant.assembly import CYCLE
from heliotrope.plant.attempts import Attempts
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations import AutomaticControl, AutomaticSettings, Logbook, Operations
from heliotrope.plant.operations.calibrating import Visits
from heliotrope.plant.operations.views import CalibrationEntry
from heliotrope.plant.schedule.plant_schedule import PlantSchedule, settings_for
from heliotrope.plant.schedule.scheduler import VISITS, Scheduler
from heliotrope.plant.visits import CalibrationCycle, Centring, CycleSettings, JointCycle
from heliotrope.plant.visits.receiver_cycle import ReceiverCycle
from heliotrope.plant.workers import at_once
from heliotrope.safety import Alarm
from heliotrope.store.keeper import Keeper
from heliotrope.store.records import PlannedVisit
from heliotrope.twin.cameras import FieldSnapshot
from heliotrope.twin.invariants.flux import FluxObserver
from heliotrope.twin.world.photographs import LyingCamera

#: Number of heliostats that may be lost together without an operator; a small field may have only
#: two.
LOSSES = 1
#: Settings with short pauses before orders are repeated.
SETTINGS = AutomaticSettings(losses=LOSSES, patience=20.0)
#: Settings of a visit that fits into a run of some minutes.
VISIT = CycleSettings(shots=3, interval=2.0, arrival=60.0, least=3, model=CYCLE.model)
#: Settings of a search that stays near its target.
SEARCH = Centring(most=8)


@dataclass(frozen=True)
class WorkKind:
    """How automatic control works in a run, and what its camera sees.

    Attributes
    ----------
    lies
        Fraction of the photographs at which false light begins.
    searches
        Fraction of the runs whose visits search for the beam and follow it, so that a stationary
        light is never taken for the beam.
    lights
        Whether lights stay on the targets for minutes.
    together
        Whether the plant chooses heliostats by its own schedule, and measures several at once.
    lowest
        Elevation of the sun below which the field is stowed, rad.
    """

    lies: float = 0.2
    searches: float = 0.5
    lights: bool = False
    together: bool = False
    lowest: float = math.radians(8.0)


#: Kinds of work: of most worlds, of "lights", and of "days".
USUAL_WORK = WorkKind()
LIT_WORK = WorkKind(0.5, 0.25, lights=True)
DAY_WORK = WorkKind(0.02)


class _Rounds:
    """The schedule of a short run: the ready heliostat that has waited longest is next."""

    def __init__(self, names: Sequence[str], clock: Clock) -> None:
        self._names, self._clock = names, clock
        self._last = dict.fromkeys(names, -1)
        self.attempts, self.reason = Attempts(VISITS), "in turn"
        self._count = 0

    def next(
        self, target: str, ready: npt.NDArray[np.bool_], beside: bool = False
    ) -> PlannedVisit | None:
        del beside
        able = [name for name, free in zip(self._names, ready, strict=True) if free]
        if not able:
            return None
        name = min(able, key=lambda candidate: self._last[candidate])
        self._count += 1
        self._last[name] = self._count
        return PlannedVisit(name, target, self._clock.utc().timestamp(), 0.0, "in turn")

    def plan(self, ready: npt.NDArray[np.bool_], limit: int) -> Sequence[PlannedVisit]:
        del ready, limit
        return ()

    def foresee(self, able: npt.NDArray[np.bool_], targets: Sequence[str]) -> None:
        """Return nothing, because this schedule predicts nothing."""
        del able, targets

    def done(self, entry: CalibrationEntry) -> None:
        """Do nothing, because results do not affect the order."""

    def shone(self, mirrors: int, lit: int, seconds: float) -> None:
        """Do nothing, because this schedule predicts nothing."""


class Work:
    """Automatic control in a run, which is recreated whenever the plant program starts.

    Parameters
    ----------
    seed
        Seed of the camera, and of the kind of visits.
    sight
        The true mirrors and the sun.
    exits
        Closes the store at the end of the run.
    kind
        How automatic control works.
    flux
        Observer of the flux limit; None if there is none.

    Attributes
    ----------
    centred
        Whether visits search for the beam and follow it; otherwise they photograph whatever light
        is there.
    camera
        Camera of the targets.
    records
        The store.
    operations, logbook
        Operations and logbook of the plant program; None while it is not running.
    """

    def __init__(
        self,
        seed: int,
        sight: FieldSnapshot,
        exits: contextlib.ExitStack,
        kind: WorkKind,
        flux: FluxObserver | None = None,
    ) -> None:
        # A stack of photographs distinguishes beams, as a search does.
        searches = random.Random(f"visits {seed}").random() < kind.searches
        self.centred = kind.together or searches
        self._together, self._kind, self._flux = kind.together, kind, flux
        self._settings = replace(SETTINGS, lowest=kind.lowest)
        waver = START_NOISE * VISIT.sigma
        self.camera = LyingCamera(sight, seed, kind.lies, waver, standing=kind.lights)
        self._clock = sight.clock
        folder = exits.enter_context(tempfile.TemporaryDirectory())
        self.records = Keeper(Path(folder) / "records.sqlite", inline=True)
        exits.callback(self.records.close)
        self.operations: Operations | None = None
        self.logbook: Logbook | None = None

    def away(self, at: float) -> float:
        """Return the difference between a POSIX time, s, and the nearest photograph's time, s."""
        zero = self._clock.utc().timestamp() - self._clock.monotonic()
        return self.camera.away(at - zero)

    def opens(self, on_alarm: Callable[[Alarm], None]) -> Logbook:
        """Return the logbook of a new program, which records every alarm that begins or ends."""
        self.logbook = Logbook(self._clock, self.records)
        self.logbook.forward = on_alarm
        return self.logbook

    def begins(self, plant: PlantController) -> Operations:
        """Return the operations of a new program.

        Local controllers should store the program's parameters.
        """
        assert self.logbook is not None
        centring = SEARCH if self.centred else None
        cycle = CalibrationCycle(plant, self.camera, VISIT, centring)
        rounds = _Rounds(plant.field.names, self._clock)
        visits = Visits(
            cycle,
            self._schedule(plant) if self._together else rounds,
            self._joint(plant, cycle),
            self._receiver(plant, cycle),
        )
        automatic = AutomaticControl(
            plant, self.logbook, visits, records=self.records, settings=self._settings
        )
        worker = at_once if self._flux is None else self._flux.worker(plant.field.names)
        self.operations = Operations(
            plant, self.logbook, automatic, records=self.records, worker=worker
        )
        for name in plant.field.names:
            believed = plant.beliefs.present(name)[0]
            plant.wanted.set(name, items_of(believed, plant.design.machine(name)))
        return self.operations

    def _schedule(self, plant: PlantController) -> PlantSchedule:
        now, names = self._clock.utc(), plant.field.names
        scheduler = Scheduler(plant.design, settings_for(VISIT), now=now, names=names)
        return PlantSchedule(plant, scheduler)

    def _joint(self, plant: PlantController, cycle: CalibrationCycle) -> JointCycle | None:
        settings = plant.design.joint_visits
        return None if settings is None else JointCycle(plant, self.camera, cycle, settings)

    def _receiver(self, plant: PlantController, cycle: CalibrationCycle) -> ReceiverCycle | None:
        settings = plant.design.receiver_visits
        return None if settings is None else ReceiverCycle(plant, self.camera, cycle, settings)

    def take_alarm(self, alarm: Alarm) -> None:
        """Accept an alarm of the plant."""
        if self.logbook is not None:
            self.logbook.take_alarm(alarm)

    def ends(self) -> None:
        """Record that the program has ended, at whatever point it was."""
        if self.operations is not None:
            self.operations.automatic.stop()
        self.operations = self.logbook = None
