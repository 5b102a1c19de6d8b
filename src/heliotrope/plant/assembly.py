"""A real plant at work: clusters over their links, cameras over their sources, no twin.

It has the shape of `twin.live.LivePlant`: `RealPlant.running` runs it all beside a block, `stowed`
stows it, `end` ends it. A cluster that does not answer, or a camera that gives no frame, is an
alarm; the plant goes on with the others.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.errors import HeliotropeError
from heliotrope.field.plant import Plant
from heliotrope.lcu import states
from heliotrope.links.clock import SystemClock
from heliotrope.links.link import running
from heliotrope.mechanism.board_items import Machine, items_of
from heliotrope.mechanism.parameters import MODELS
from heliotrope.plant.assigned import Assigned, rest_on
from heliotrope.plant.audit import Audit
from heliotrope.plant.cameras import RealCameras
from heliotrope.plant.controller import PlantController
from heliotrope.plant.links_file import PlantLinks
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.operations.calibrating import Scheduling
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.operations.operations import Operations
from heliotrope.plant.operations.views import CalibrationEntry, Planned
from heliotrope.plant.schedule.plant_schedule import PlantSchedule, settings_for
from heliotrope.plant.schedule.scheduler import Scheduler
from heliotrope.plant.settings import PlantSettings
from heliotrope.plant.visits.calibration_cycle import CalibrationCycle
from heliotrope.plant.visits.settings import Centring, CycleSettings
from heliotrope.safety import alarms
from heliotrope.store.records import Records

#: Of calibrations: what a quick installation leaves, and what a photograph is worth.
CYCLE = CycleSettings(shots=4, interval=2.0, least=3, model=(*MODELS["malan8"], "canting"))
#: Who was not heard for so long is not waited for at the end, s.
SILENT = 10.0
#: Files of sensors are looked at so often, s.
_SENSED = 0.5
#: In these states a heliostat does not go to stow by an order: people have to see to it.
_STUCK = (states.FAULT, states.LOCKED, states.UNCONFIGURED)


class RealPlant:
    """A plant with what it is connected to.

    Parameters
    ----------
    design
        Site, heliostats with their clusters, receivers, targets, cameras.
    links
        To its clusters.
    clock
        Of this machine.
    audit, records, assigned
        See `PlantController` and `Operations`.
    cameras
        Of its targets; None: nothing is calibrated.
    machine
        Limits, stow and standby point that every local controller is to hold, besides its axes;
        None: local controllers keep what they hold.
    work, plant
        Settings.
    cycle
        Settings of the calibration.

    Attributes
    ----------
    plant, operations, logbook
        See their classes.

    Raises
    ------
    InputError
        Links that do not fit the design.
    """

    def __init__(
        self,
        design: Plant,
        links: PlantLinks,
        clock: SystemClock,
        audit: Audit,
        *,
        records: Records | None = None,
        assigned: Assigned | None = None,
        cameras: RealCameras | None = None,
        machine: Machine | None = None,
        work: AutomaticSettings | None = None,
        plant: PlantSettings | None = None,
        cycle: CycleSettings = CYCLE,
    ) -> None:
        self.design, self.clock, self.audit = design, clock, audit
        self._links, self._cameras = links, cameras
        self.logbook = Logbook(clock, records)
        if cameras is not None:
            cameras.on_alarm = self.logbook.take_alarm
        self.plant = PlantController(
            design,
            self.logbook.tapped(links.links),
            clock,
            audit,
            settings=plant or PlantSettings(sensors=links.sensors.names),
            assigned=assigned,
            on_alarm=self.logbook.take_alarm,
        )
        settings = work or AutomaticSettings()
        chosen = (
            None if cameras is None else CalibrationCycle(self.plant, cameras, cycle, Centring())
        )
        scheduler: Scheduling | None = None
        if chosen is not None and cameras is not None:
            scheduler = _Watched(self._scheduler(chosen), cameras)
        seen = (
            () if cameras is None else [t for t in design.targets if t.name not in cameras.unseen]
        )
        self.operations = Operations(
            self.plant,
            self.logbook,
            chosen,
            cameras={} if cameras is None else {t.name: cameras for t in seen},
            scheduler=scheduler,
            records=records,
            settings=settings,
            extra=self._extra,
        )
        if machine is not None:
            self._want(machine)

    def _scheduler(self, cycle: CalibrationCycle) -> Scheduling:
        names = self.plant.field.names
        chosen = Scheduler(
            self.design, settings_for(cycle.settings), now=self.clock.utc(), names=names
        )
        return PlantSchedule(self.plant, chosen)

    def _extra(self) -> Mapping[str, Any]:
        refusal = self._links.refusal()
        return {"refused link": refusal} if refusal else {}

    def _want(self, machine: Machine) -> None:
        """Want of every local controller what the design and the last calibration say."""
        rest_on(self.plant.standbys, machine.standby)
        for name in self.plant.field.names:
            mechanism = self.plant.beliefs.present(name)[0]
            self.plant.wanted.set(name, items_of(mechanism, machine))

    # -- running ---------------------------------------------------------------------------

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator["RealPlant"]:
        """Run everything beside a block."""
        local = self._links.local
        parts = [*self._links.parts, *(part for one in local for part in one.parts)]
        if self._cameras is not None:
            self._cameras.start()
        try:
            async with (
                running(*parts),
                running(*(one.cluster for one in local)),
                running(self.plant),
                running(self.operations),
                asyncio.TaskGroup() as group,
            ):
                tasks = [group.create_task(self._look()), group.create_task(self._sense())]
                yield self
                for task in tasks:
                    task.cancel()
        finally:
            self.audit.close()
            if self._cameras is not None:
                self._cameras.close()

    async def _sense(self) -> None:
        """Hand readings of sensors to the safety table as they come."""
        while True:
            news = await asyncio.to_thread(self._links.sensors.read)
            for name, value in news.values.items():
                self.plant.put(name, value)
            for name, text in news.problems.items():
                self.logbook.take_alarm(
                    alarms.SENSOR.raised(name, problem=text) if text else alarms.SENSOR.ended(name)
                )
            await asyncio.sleep(_SENSED)

    async def _look(self) -> None:
        """Photograph each target once: whether its camera works is known before a beam comes."""
        if self._cameras is None:
            return
        for target in self.design.targets:
            if target.name in self._cameras.unseen:
                self.logbook.event("calibration", target.name, "no camera looks at it")
                continue
            try:
                await self._cameras.look(target.name)
            except HeliotropeError as error:
                self.logbook.event("calibration", target.name, str(error))

    async def end(self) -> None:
        """End operations and plant, and with them `running`."""
        await self.operations.close()
        await self.plant.close()

    # -- the end ---------------------------------------------------------------------------

    async def stowed(self, limit: float = 300.0) -> bool:
        """Stow the field; return whether all of it is.

        It waits ``limit`` s at most, and for those only that are heard and can stow by an order;
        see `left` for the others.
        """
        await self.operations.automatic.halt()
        self.plant.stow("plant's end")
        until = self.clock.monotonic() + limit
        while self.clock.monotonic() < until:
            now = self.clock.monotonic()
            there = self.plant.field.among((states.STOWED,), now)
            if (there | self._hopeless(now)).all():
                return bool(there.all())
            await asyncio.sleep(0.25)
        return False

    def _hopeless(self, now: float) -> npt.NDArray[np.bool_]:
        """Return whom waiting does not help: silent, faulty, locked, unconfigured, (N,)."""
        field = self.plant.field
        silent = field.age(now) > SILENT
        return np.asarray(silent | field.among(_STUCK, now))

    def left(self) -> str:
        """Return who is not in stow, in words; "" if all are."""
        field, now = self.plant.field, self.clock.monotonic()
        rows = np.flatnonzero(~field.among((states.STOWED,), now))
        if not len(rows):
            return ""
        live = field.live(now)
        state = field.rows["state"]
        said = [
            f"{field.names[row]} {states.STATES[state[row]] if live[row] else 'silent'}"
            for row in rows[:5]
        ]
        more = f" and {len(rows) - 5} more" if len(rows) > 5 else ""
        return f"not in stow: {', '.join(said)}{more}"


class _Watched:
    """A schedule that leaves targets alone whose camera is silent."""

    def __init__(self, schedule: Scheduling, cameras: RealCameras) -> None:
        self._schedule, self._cameras = schedule, cameras

    def next(self, target: str, ready: npt.NDArray[np.bool_]) -> Planned | None:
        if not self._cameras.awake(target):
            return None
        return self._schedule.next(target, ready)

    def plan(self, ready: npt.NDArray[np.bool_], limit: int) -> Any:
        return self._schedule.plan(ready, limit)

    def done(self, entry: CalibrationEntry) -> None:
        self._schedule.done(entry)
