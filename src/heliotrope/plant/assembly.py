"""Assembles a plant from its design, its ports and its settings.

A real and a simulated plant are assembled by the same code; what differs is passed in as `Ports`. A
cluster that does not respond or a camera that delivers no frame raises an alarm, and the plant
continues with the rest.
"""

import asyncio
import contextlib
import math
from collections import Counter
from collections.abc import AsyncIterator, Callable, Coroutine, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.errors import HeliotropeError
from heliotrope.field.approval import ApprovalSettings
from heliotrope.field.plant import Plant
from heliotrope.lcu import states
from heliotrope.links.clock import sleep_until
from heliotrope.links.link import first_of, running
from heliotrope.mechanism.board_items import items_of
from heliotrope.plant.controller import PlantController, Stores
from heliotrope.plant.emergency import at_stow
from heliotrope.plant.field.assigned import rest_on
from heliotrope.plant.io.sensors import Sensors
from heliotrope.plant.operations.automatic import AutomaticControl, AutomaticSettings
from heliotrope.plant.operations.calibrating import Scheduling, Visits
from heliotrope.plant.operations.foresight import Prospect
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.operations.marking import Marking
from heliotrope.plant.operations.operations import Operations, Photography
from heliotrope.plant.operations.pictures import KeptCamera
from heliotrope.plant.operations.views import CalibrationEntry
from heliotrope.plant.orders.authority import Person, Role
from heliotrope.plant.ports import Cameras, Ports
from heliotrope.plant.schedule.plant_schedule import PlantSchedule, settings_for
from heliotrope.plant.schedule.scheduler import Scheduler
from heliotrope.plant.settings import PlantSettings
from heliotrope.plant.visits.calibration_cycle import CalibrationCycle
from heliotrope.plant.visits.joint_cycle import JointCycle
from heliotrope.plant.visits.neighbours import Unhidden
from heliotrope.plant.visits.receiver_cycle import ReceiverCycle
from heliotrope.plant.visits.settings import Centring, CycleSettings
from heliotrope.safety import (
    CONDITIONS,
    FLUX_READING,
    Severity,
    alarms,
    differences,
    limited,
    numbers,
)
from heliotrope.store.records import PlannedVisit, StoreError

#: A calibration that removes the errors of quick installation.
CYCLE = CycleSettings(shots=4, interval=2.0, least=3, model="auto")
#: At its end the plant does not wait for a heliostat that has been silent for longer than this, s.
SILENT = 10.0
#: At its end the plant no longer waits for a locked or faulty heliostat that has not moved for this
#: time, s. In large plants step counts are polled every five seconds.
_STANDS = 15.0
#: Interval at which the sensors are read, s.
_SENSED = 0.5
#: Interval at which the witnesses of the sun are queried, s.
_WITNESSED = 5.0
#: The name under which the audit records changed limits.
_PLANT_FILE = Person("plant file", Role.ENGINEER)


class MachineTables(Enum):
    """Whether the local controllers store the machine tables of the plant file."""

    #: Unknown: the controllers keep the tables that they hold, and the plant assumes nothing.
    UNKNOWN = "unknown"
    #: The controllers already hold them, as simulated boards do.
    HELD = "held"
    #: The plant compares the tables, and writes those that differ.
    WRITTEN = "written"


@dataclass(frozen=True)
class AssemblySettings:
    """Settings of a running plant.

    Attributes
    ----------
    work
        Automatic control.
    plant
        Times and limits, to which the readings of the sensor port are added.
    cycle
        Calibration.
    machines
        Whether the local controllers store the plant file's machine tables.
    """

    work: AutomaticSettings = field(default_factory=AutomaticSettings)
    plant: PlantSettings = field(default_factory=PlantSettings)
    cycle: CycleSettings = CYCLE
    machines: MachineTables = MachineTables.UNKNOWN


class _Begun:
    """Operations that begin once the field is ready.

    The plant controls the field before they begin.
    """

    def __init__(
        self, operations: Operations, ready: Callable[[], Coroutine[Any, Any, None]] | None
    ) -> None:
        self._operations, self._ready = operations, ready
        self._closing = asyncio.Event()

    async def run(self) -> None:
        """Wait until the field is ready, and work until closed."""
        if self._ready is not None:
            await first_of(self._ready(), self._closing.wait())
        if not self._closing.is_set():
            await self._operations.run()

    async def close(self) -> None:
        """End the operations."""
        self._closing.set()
        await self._operations.close()


class PlantAssembly:
    """A plant with everything to which it is connected.

    Parameters
    ----------
    design
        Site, heliostats with their clusters, receivers, targets, cameras.
    ports
        Its connections.
    settings
        Its settings.

    Attributes
    ----------
    plant, operations, logbook
        See their classes.
    schedule
        Calibration schedule; None: nothing is calibrated.

    Raises
    ------
    InputError
        If links do not fit the design, or a group lacks the machine table that ``settings``
        requires.
    """

    def __init__(
        self, design: Plant, ports: Ports, settings: AssemblySettings | None = None
    ) -> None:
        chosen = settings or AssemblySettings()
        self.design, self.ports, self.settings = design, ports, chosen
        self.clock = ports.clock
        self.logbook = Logbook(ports.clock, ports.records)
        fed = frozenset() if ports.sensors is None else ports.sensors.names
        self.plant = PlantController(
            design,
            self.logbook.tapped(ports.links),
            ports.clock,
            Stores(ports.audit, assigned=ports.assigned, record=ports.records, disk=ports.disk),
            settings=replace(chosen.plant, sensors=chosen.plant.sensors | fed),
            on_alarm=self.logbook.take_alarm,
        )
        cameras = ports.cameras if design.targets else None
        self.schedule: PlantSchedule | None = None
        automatic = AutomaticControl(
            self.plant,
            self.logbook,
            None if cameras is None else self._visits(cameras),
            records=ports.records,
            truth=ports.truth,
            settings=chosen.work,
            learner=ports.learner,
        )
        self.operations = Operations(
            self.plant,
            self.logbook,
            automatic,
            photography=Photography(
                {} if cameras is None else dict.fromkeys(self._seen(cameras), cameras),
                ports.pictures,
                None if cameras is None else self._marking(cameras),
            ),
            records=ports.records,
            extra=ports.facts,
            worker=ports.worker,
            file=ports.file,
        )
        #: When each heliostat last moved, or was ordered to move, on its way to stow at the end.
        self._moved_at = np.full(len(self.names), math.inf)
        self._record_limits()
        if chosen.machines is not MachineTables.UNKNOWN:
            self._rest_on_machines()
        if chosen.machines is MachineTables.WRITTEN:
            self._want()

    @property
    def names(self) -> tuple[str, ...]:
        """The heliostats, in the order of the plant's field."""
        return self.plant.field.names

    def _record_limits(self) -> None:
        """Record which limits of the safety table and of approvals differ from the previous run.

        At the first run the limits are compared with the defaults.
        """
        if self.ports.records is None:
            return
        now = numbers(limited(CONDITIONS, self.design.safety)) | self.design.approval.numbers
        try:
            before = self.ports.records.exchange_limits(now) or numbers(CONDITIONS)
            before = ApprovalSettings().numbers | before
        except StoreError as error:
            self.logbook.take_alarm(alarms.RECORDS.raised(problem=error))
            return
        for line in differences(before, now):
            self.logbook.event("safety", "limits", line, Severity.WARNING)
            self.plant.note(_PLANT_FILE, "LIMITS", line)

    def _seen(self, cameras: Cameras) -> list[str]:
        return [target.name for target in self.design.targets if cameras.sees(target.name)]

    def _marking(self, cameras: Cameras) -> Marking:
        made = Marking(cameras, self.plant, self.logbook, self.ports.marks)
        made.resume()
        return made

    def _visits(self, cameras: Cameras) -> Visits:
        """Return the visits that the design and its cameras allow, and create their schedule."""
        plant, design, ports, settings = self.plant, self.design, self.ports, self.settings.cycle
        eye = cameras if ports.pictures is None else KeptCamera(cameras, ports.pictures)
        unhidden = Unhidden(plant, ports.worker)
        cycle = CalibrationCycle(plant, eye, settings, Centring(), unhidden, ports.worker)
        scheduler = Scheduler(
            design, settings_for(settings), now=self.clock.utc(), names=self.names
        )
        self.schedule = PlantSchedule(plant, scheduler)
        joint, receiver = design.joint_visits, design.receiver_visits
        return Visits(
            cycle,
            _WhereAwake(self.schedule, cameras),
            None if joint is None else JointCycle(plant, eye, cycle, joint),
            None if receiver is None else ReceiverCycle(plant, eye, cycle, receiver),
            ports.pictures,
        )

    def _rest_on_machines(self) -> None:
        """Set the plant file's standby points for heliostats without an assigned standby point."""
        for row, name in enumerate(self.names):
            rest_on(self.plant.standbys[row : row + 1], self.design.machine(name).standby)

    def aim_as_designed(self) -> None:
        """Set the design's aims for heliostats without an assigned aim; they then track them."""
        aims = self.plant.default_aims(self.names)
        for row, name in enumerate(self.names):
            rest_on(self.plant.aims[row : row + 1], tuple(aims[name]))

    def _want(self) -> None:
        """Set the machine table and the last calibration as wanted in each local controller."""
        for name, point in zip(self.names, self.plant.standbys, strict=True):
            mechanism = self.plant.beliefs.present(name)[0]
            self.plant.wanted.set(name, items_of(mechanism, self.design.machine(name)))
            if np.isfinite(point).all():
                self.plant.wanted.rest(name, tuple(point))

    # -- running ---------------------------------------------------------------------------

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator["PlantAssembly"]:
        """Run the plant, its operations and all accompanying tasks for the duration of a block."""
        cameras, sensors = self.ports.cameras, self.ports.sensors
        if cameras is not None:
            cameras.start(self.logbook.take_alarm)
        try:
            async with (
                self.ports.beside(),
                running(self.plant),
                contextlib.AsyncExitStack() as later,
            ):
                group = await later.enter_async_context(asyncio.TaskGroup())
                tasks = []
                # The safety table expects readings from the start.
                if sensors is not None:
                    tasks.append(group.create_task(self._sense(sensors)))
                await later.enter_async_context(running(_Begun(self.operations, self.ports.ready)))
                if cameras is not None:
                    tasks.append(group.create_task(self._look(cameras)))
                if self.ports.witnesses:
                    tasks.append(group.create_task(self._witness()))
                yield self
                for task in tasks:
                    task.cancel()
        finally:
            if self.ports.disk is not None:
                self.ports.disk.close()
            self.ports.audit.close()
            if self.ports.pictures is not None:
                self.ports.pictures.close()
            if cameras is not None:
                cameras.close()

    async def _sense(self, sensors: Sensors) -> None:
        """Pass sensor readings to the safety table as they arrive."""
        while True:
            news = await sensors.news()
            for name, value in news.values.items():
                self.plant.put(name, value, made=news.made.get(name))
            if FLUX_READING in news.seen:
                self.operations.flux_check.see(news.seen[FLUX_READING])
            for name, text in news.problems.items():
                self.logbook.take_alarm(
                    alarms.SENSOR.raised(name, problem=text) if text else alarms.SENSOR.ended(name)
                )
            await asyncio.sleep(_SENSED)

    async def _witness(self) -> None:
        """Compare the plant's sun vector with the witnesses' sun vectors as they arrive."""
        while True:
            for witness in self.ports.witnesses:
                seen = await witness.sun(self.design.site)
                if seen is not None:
                    self.plant.witnesses.take(witness.name, *seen)
            await sleep_until(self.clock, self.clock.monotonic() + _WITNESSED)

    async def _look(self, cameras: Cameras) -> None:
        """Photograph each target once, so that a camera failure is known before a beam arrives."""
        await self.operations.begun.wait()
        for target in self.design.targets:
            if not cameras.sees(target.name):
                self.logbook.event("calibration", target.name, "no camera views it")
                continue
            try:
                await cameras.look(target.name)
            except HeliotropeError as error:
                self.logbook.event("calibration", target.name, str(error))

    async def end(self) -> None:
        """End the operations and the plant, and with them `running`."""
        await self.operations.close()
        await self.plant.close()

    # -- the end ---------------------------------------------------------------------------

    async def stowed(self, limit: float = 300.0) -> bool:
        """Stow the field; return whether every heliostat is stowed.

        The call waits ``limit`` s at most, and only for heliostats on their way (`to_stow`); `left`
        names all heliostats that are not stowed.
        """
        await self.operations.automatic.halt()
        ticket, rows = self.plant.stow("plant's end"), self.plant.field
        until = self.clock.monotonic() + limit
        self._moved_at[:], before = self.clock.monotonic(), rows.posed.copy()
        while (now := self.clock.monotonic()) < until and self._on_the_way(now).any():
            unheard = [rows.place(name) for name in ticket.unacknowledged()]
            self._moved_at[unheard] = self._moved_at[(rows.posed != before).any(axis=-1)] = now
            before = rows.posed.copy()
            await asyncio.sleep(0.25)
        return not self.left()

    def _on_the_way(self, now: float) -> npt.NDArray[np.bool_]:
        """Return a mask of the heliostats that are on their way to stow by an order, (N,)."""
        rows = self.plant.field
        away = (rows.age(now) <= SILENT) & ~(rows.live(now) & at_stow(rows.rows))
        # In these states, only the motion shows whether a heliostat obeys STOW.
        stands = rows.among(states.KEPT, now) & (now - self._moved_at > _STANDS)
        return np.asarray(away & ~stands)

    def to_stow(self) -> tuple[dict[str, int], float]:
        """Return the heliostats on their way to stow, and about how long they will take.

        Returns
        -------
            Their number in each state; and the time, s, that the furthest heliostat needs to turn
            both axes, one after the other, once the heliostats before it have been sent. NaN if the
            positions are unknown.
        """
        rows, now = self.plant.field, self.clock.monotonic()
        away = np.flatnonzero(self._on_the_way(now))
        machines, turns = self.plant.beams.machines, [math.nan]
        for row in away:
            machine = machines.get(rows.names[row])
            if machine is not None and np.isfinite(rows.posed_at[row]):
                way = np.abs(rows.posed[row] - machine.stow)
                turns.append(float((way / [axis.rate for axis in machine.axes]).sum()))
        rate = self.plant.settings.stow_rate
        seconds = float(np.fmax.reduce(turns)) + (len(away) / rate if rate else 0.0)
        found = Counter(states.STATES[state] for state in rows.rows["state"][away])
        return dict(found.most_common()), seconds

    def left(self) -> str:
        """Return the heliostats that are not stowed, in words; empty if all are stowed."""
        rows, now = self.plant.field, self.clock.monotonic()
        away = np.flatnonzero(~(rows.live(now) & at_stow(rows.rows)))
        if not len(away):
            return ""
        live, state = rows.live(now), rows.rows["state"]
        said = [
            f"{rows.names[row]} {states.STATES[state[row]] if live[row] else 'silent'}"
            for row in away[:5]
        ]
        more = f" and {len(away) - 5} more" if len(away) > 5 else ""
        return f"not in stow: {', '.join(said)}{more}"


class _WhereAwake:
    """A schedule that omits targets whose camera is silent."""

    def __init__(self, schedule: Scheduling, cameras: Cameras) -> None:
        self._schedule, self._cameras = schedule, cameras
        self.attempts, self._asleep = schedule.attempts, ""

    @property
    def reason(self) -> str:
        return self._asleep or self._schedule.reason

    def next(
        self, target: str, ready: npt.NDArray[np.bool_], beside: bool = False
    ) -> PlannedVisit | None:
        awake = self._cameras.awake(target)
        self._asleep = "" if awake else f"the camera of target {target} is silent"
        if not awake:
            return None
        return self._schedule.next(target, ready, beside)

    def plan(self, ready: npt.NDArray[np.bool_], limit: int) -> Sequence[PlannedVisit]:
        return self._schedule.plan(ready, limit)

    def foresee(self, able: npt.NDArray[np.bool_], targets: Sequence[str]) -> Prospect | None:
        awake = [target for target in targets if self._cameras.awake(target)]
        return self._schedule.foresee(able, awake)

    def done(self, entry: CalibrationEntry) -> None:
        self._schedule.done(entry)

    def shone(self, mirrors: int, lit: int, seconds: float) -> None:
        self._schedule.shone(mirrors, lit, seconds)
