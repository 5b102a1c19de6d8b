"""A plant that lives in the twin: real plant, real clusters, a simulated field, cameras that see.

Everything runs in one event loop: the plant's program and its operations, a cluster program for
each bus, the field in ticks of 50 ms. Mirrors stand as a quick installation leaves them; the
plant is told of perfect ones, and learns from photographs. `LivePlant.running` runs it all beside a
block; its clock decides how fast: a `VirtualClock` on a `PacedLoop` (real time times a speed) or
on a `VirtualLoop` (as fast as it goes).
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from heliotrope import sun
from heliotrope.cluster.config import ClusterConfig, Member, spread_phase
from heliotrope.cluster.controller import Cluster
from heliotrope.cluster.timekeeping import SystemTime
from heliotrope.errors import InputError
from heliotrope.field import example, layouts
from heliotrope.field.example import roughly_installed
from heliotrope.field.layout_tower import square_target, watching_camera
from heliotrope.field.plant import Plant
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.synthetic.scenes import Scene
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock
from heliotrope.links.link import Bus, running
from heliotrope.mechanism.board_items import Axis, Machine
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.kernels import slots as slot
from heliotrope.mechanism.parameters import MODELS
from heliotrope.plant.assigned import Assigned, rest_on
from heliotrope.plant.audit import Audit, Record
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.operations.operations import Operations
from heliotrope.plant.schedule.plant_schedule import PlantSchedule, settings_for
from heliotrope.plant.schedule.scheduler import Scheduler
from heliotrope.plant.settings import PlantSettings, clusters_of
from heliotrope.plant.visits.calibration_cycle import CalibrationCycle
from heliotrope.plant.visits.settings import Centring, CycleSettings
from heliotrope.store.records import Records
from heliotrope.twin.boards import outfit
from heliotrope.twin.cameras import NEAR, Optics, Sight
from heliotrope.twin.live._boards import BoardField
from heliotrope.twin.live._camera import LiveCamera, SeenExactly
from heliotrope.twin.live._field import LiveField, key_of, ranges_of
from heliotrope.twin.live._link import NearLink, near_pair

#: The field goes on in ticks of so long, s; the true sun is computed so often, s.
_TICK, _SUN_EVERY = 0.05, 5.0
#: At most so many ticks are made up at once after a pause.
_MOST_TICKS = 20
#: Step counts of each heliostat are asked for each second in small plants, else every few.
_SMALL, _STEPS_EVERY = 320, 5
#: From the receiver to the standby point, in widths of the receiver and at least, m.
_ASIDE, _LEAST_ASIDE = 3.0, 8.0
#: Of calibrations: what a quick installation leaves, and what a photograph of the twin is worth.
CYCLE = CycleSettings(
    shots=4, interval=2.0, least=3, model=(*MODELS["malan8"], "canting"), sigma=2e-4
)


@dataclass(frozen=True)
class LiveOptions:
    """How a plant lives.

    Attributes
    ----------
    seed
        Of imperfections and noise.
    rendered
        Whether photographs are drawn and read; else centroids come with noise.
    threads
        For photographs; 0 in virtual time.
    installed
        How mirrors stand, from the nominal mechanism; None: as roughly as Malan's.
    boards
        Whether each heliostat is a firmware-true board; for small plants.
    centroid
        Variance of the centroids if they are not photographed, m².
    cycle, work, plant
        Settings of calibration, automatic work and plant; None: the twin's own.
    """

    seed: int = 0
    rendered: bool = True
    threads: int = 1
    installed: Callable[[Mechanism], Mechanism] | None = None
    boards: bool = False
    centroid: float = 1e-5
    cycle: CycleSettings | None = None
    work: AutomaticSettings | None = None
    plant: PlantSettings | None = None

    def __post_init__(self) -> None:
        if self.threads < 0 or not self.centroid >= 0.0:
            raise InputError(
                f"live plant: {self.threads} threads, centroids of {self.centroid} m²; give 0 or "
                "more of both"
            )


class Forgetful:
    """An audit that keeps nothing: for plants that are only looked at."""

    def begin(self, record: Record) -> None:
        """Take a record."""

    def finish(self, identity: str, result: str, at: str) -> None:
        """Take a result."""

    def confirm(self) -> None:
        """Nothing can go wrong."""

    def close(self) -> None:
        """Nothing is open."""


class LivePlant:
    """A plant and its world.

    Parameters
    ----------
    design
        As the plant knows it: heliostats of one group, all of one kind, each on a cluster; its
        mechanisms are taken as nominal.
    clock
        Of the loop that it will run in.
    options
        See there.
    audit, records, assigned
        Of the plant; None: nothing is kept.
    extra
        What the summary tells besides.

    Attributes
    ----------
    field
        The simulated one.
    plant, operations, logbook
        The real ones.
    links
        The plant's ends of the lines, by cluster; unplug one to cut its line.
    cameras
        See `_live_camera`.
    beats
        Ticks of the field that were left out since the loop was late.

    Raises
    ------
    InputError
        Several groups of heliostats, or drives without stops.
    """

    def __init__(
        self,
        design: Plant,
        clock: VirtualClock,
        options: LiveOptions | None = None,
        *,
        audit: Audit | None = None,
        records: Records | None = None,
        assigned: Assigned | None = None,
        extra: Callable[[], Mapping[str, Any]] | None = None,
    ) -> None:
        chosen = options or LiveOptions()
        if len(design.groups) != 1:
            raise InputError(
                f"live plant: {len(design.groups)} groups of heliostats; the twin takes one, with "
                "heliostats of one kind"
            )
        self.design, self.clock, self.options = design, clock, chosen
        (group,) = design.groups.values()
        self.names = group.names
        nominal = group.calibrated
        install = chosen.installed or partial(roughly_installed, seed=chosen.seed)
        self.truth = install(group.mechanism)
        self.machine = machine_of(design)
        if chosen.boards:
            self.machine = replace(self.machine, stow=outfit.STOW)
        self.field: LiveField | BoardField = (
            BoardField(clock, self.names, self.truth, nominal, self.machine, chosen.seed)
            if chosen.boards
            else LiveField(self.truth, nominal, self.machine)
        )
        self._sizes = np.stack([group.width, group.height], axis=-1)
        self._sun: tuple[float, FloatArray] | None = None
        self.beats = 0
        self._parts: list[Any] = []
        self._clusters: list[Cluster] = []
        self.logbook = Logbook(clock, records)
        self.links = self._wire(clusters_of(design), {n: i for i, n in enumerate(self.names)})
        self.audit = audit or Forgetful()
        self.plant = PlantController(
            design,
            self.logbook.tapped(self.links),
            clock,
            self.audit,
            settings=chosen.plant or PlantSettings(),
            assigned=assigned,
            on_alarm=self.logbook.take_alarm,
        )
        rest_on(self.plant.standbys, self.machine.standby)
        # The plant's rows go cluster by cluster, the field's as the design has them.
        self._rows = np.array([group.index(name) for name in self.plant.field.names])
        aims = self.plant.default_aims()
        self._points = np.empty((len(self.names), 3))
        self._points[self._rows] = np.stack([aims[name] for name in self.plant.field.names])
        self.cameras = self._new_cameras()
        cycle = CalibrationCycle(self.plant, self.cameras, chosen.cycle or CYCLE, Centring())
        self.operations = Operations(
            self.plant,
            self.logbook,
            cycle if design.targets else None,
            cameras={target.name: self.cameras for target in design.targets},
            scheduler=self._scheduler(cycle),
            records=records,
            truth=self.errors,
            extra=extra,
            settings=chosen.work or AutomaticSettings(wanted=True),
        )

    # -- putting it together ---------------------------------------------------------------

    def _wire(
        self, homes: Mapping[str, tuple[str, ...]], place: Mapping[str, int]
    ) -> dict[str, NearLink]:
        """Make a cluster for each name, with a bus; return the plant's ends of their lines."""
        links: dict[str, NearLink] = {}
        every = 1 if len(place) <= _SMALL else _STEPS_EVERY
        for k, (name, members) in enumerate(homes.items()):
            rows = [place[member] for member in members]
            if rows != list(range(rows[0], rows[0] + len(rows))):
                raise InputError(
                    f"live plant: the heliostats of cluster {name} do not stand together in the "
                    "plant file; sort them by cluster"
                )
            near, far = near_pair(self.clock, ("plant", name))
            bus: Bus = self.field.bus(range(rows[0], rows[0] + len(rows)))
            fits = tuple(
                Member(member, i + 1, 1 + row, key_of(member))
                for i, (member, row) in enumerate(zip(members, rows, strict=True))
            )
            config = ClusterConfig(
                name, self.design.site, fits, steps_every=every, phase=spread_phase(k, len(homes))
            )
            time = SystemTime(self.clock)
            self._clusters.append(Cluster(config, bus, far, self.clock, time))
            self._parts += [near, far, bus, time]
            links[name] = near
        return links

    def _new_cameras(self) -> LiveCamera | SeenExactly:
        seed = self.options.seed
        if not self.options.rendered:
            sight = Sight(self.clock, self._mirrors, self.sun)
            return SeenExactly(sight, self.options.centroid, seed)
        scenes = []
        for target in self.design.targets:
            cameras = [c for c in self.design.cameras if target.name in c.targets]
            if not cameras or cameras[0].position is None:
                raise InputError(
                    f"target {target.name}: no camera with a known position looks at it; add one "
                    "to the plant file, or take exact centroids"
                )
            scenes.append(Scene(cameras[0], (target,)))
        # Malan's small mirrors are of one piece.
        optics = Optics(facets=(1, 1))
        sight = Sight(self.clock, self._mirrors, self.sun)
        return LiveCamera(sight, scenes, optics=optics, seed=seed, threads=self.options.threads)

    def _scheduler(self, cycle: CalibrationCycle) -> PlantSchedule | None:
        if not self.design.targets:
            return None
        settings = settings_for(cycle.settings)
        names = self.plant.field.names
        chosen = Scheduler(self.design, settings, now=self.clock.utc(), names=names)
        return PlantSchedule(self.plant, chosen)

    # -- the world -------------------------------------------------------------------------

    def sun(self) -> FloatArray:
        """Return the true direction to the sun, (3,)."""
        now = self.clock.monotonic()
        place, part = divmod(now, _SUN_EVERY)
        if self._sun is None or self._sun[0] != place:
            utc = self.clock.utc().timestamp() - part
            ends = sun.vector(np.array([utc, utc + _SUN_EVERY]), self.design.site)
            self._sun = place, np.asarray(ends)
        first, second = self._sun[1]
        mixed = first + (second - first) * (part / _SUN_EVERY)
        return np.asarray(mixed / np.linalg.norm(mixed))

    def _mirrors(self) -> list[Any]:
        """Return the mirrors whose light may be on a target."""
        light, found = self.sun(), {}
        for target in self.design.targets:
            for mirror in self._near(target, light):
                found[mirror.heliostat] = mirror
        return list(found.values())

    def _near(self, target: Target, light: FloatArray) -> list[Any]:
        middle = np.asarray(target.corners).mean(axis=0)
        reach = NEAR * 0.5 * float(np.hypot(target.width, target.height))
        return self.field.mirrors_near(light, middle, target.normal, reach, self.names, self._sizes)

    def errors(self) -> FloatArray:
        """Return the true tracking errors at the design's aims, rad, (N,), in the plant's order."""
        return np.asarray(self.field.errors(self.sun(), self._points)[self._rows])

    async def _turn(self) -> None:
        """Let the field go on."""
        done = self.clock.monotonic()
        while True:
            await asyncio.sleep(_TICK)
            late = int((self.clock.monotonic() - done) / _TICK + 1e-6)
            ticks = min(late, _MOST_TICKS)
            self.beats += late - ticks
            done += late * _TICK
            self.field.advance(50 * ticks)

    async def _empty(self) -> None:
        """Photograph the targets before beams come."""
        if not isinstance(self.cameras, LiveCamera):
            return
        for target in self.design.targets:
            try:
                await self.cameras.take_empty(target)
            except InputError as error:
                self.logbook.event("calibration", "camera", str(error))

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator["LivePlant"]:
        """Run everything beside a block."""
        async with asyncio.TaskGroup() as group:
            turns = group.create_task(self._turn())
            async with (
                running(*self._parts),
                running(*self._clusters),
                running(self.plant),
                running(self.operations),
            ):
                looks = group.create_task(self._empty())
                yield self
                looks.cancel()
            turns.cancel()
        self.cameras.close()
        self.audit.close()

    async def end(self) -> None:
        """End operations and plant, and with them `running`."""
        await self.operations.close()
        await self.plant.close()

    async def stowed(self, limit: float = 300.0) -> bool:
        """Stow the field and wait until it is; False if it is not within ``limit`` s."""
        await self.operations.automatic.halt()
        self.plant.stow("live plant")
        until = self.clock.monotonic() + limit
        while self.clock.monotonic() < until:
            if self.plant.field.among((states.STOWED,), self.clock.monotonic()).all():
                return True
            await asyncio.sleep(0.5)
        return False


def machine_of(design: Plant) -> Machine:
    """Return limits, stow and standby of the heliostats of a design, which are all alike.

    Stow looks up with the azimuth in the middle of its stops. The standby point is beside the
    first receiver, as high as its middle.

    Raises
    ------
    InputError
        Heliostats without two drives, or drives without stops.
    """
    (group,) = design.groups.values()
    mechanism = group.mechanism
    drives = Drive(np.reshape(mechanism.drives.table, (-1, 2, slot.DRIVE_SLOTS))[0])
    if not np.isfinite(drives.table[:, [slot.MIN_ANGLE, slot.MAX_ANGLE]]).all():
        raise InputError("live plant: drives without stops; give min_angle and max_angle")
    ranges = ranges_of(mechanism)
    speed = drives.table[:, slot.SPEED]
    rate = int(speed[0]) if 0.0 < speed[0] <= 20_000.0 else 8000
    axes = [Axis(int(low), int(high), rate, 2 * rate, 40) for low, high in ranges]
    up = round(float(drives.counts(np.array([0.0, np.radians(88.0)]))[1]))
    middle = int(ranges[0].mean())
    standby = standby_of(design)
    return Machine((axes[0], axes[1]), (middle, up), standby, (0.1, 0.05))


def standby_of(design: Plant) -> tuple[float, float, float]:
    """Return the point beside the first receiver where beams wait, ENU, m."""
    if not design.receivers:
        raise InputError("live plant: no receiver; add one to the plant file")
    receiver = design.receivers[0]
    level = np.array([-receiver.normal[1], receiver.normal[0], 0.0])
    level = level / max(float(np.linalg.norm(level)), 1e-9)
    aside = max(_ASIDE * receiver.width, _LEAST_ASIDE) * level
    east, north, up = receiver.center + aside
    return float(east), float(north), float(up)


def prototype_plant() -> Plant:
    """Return a plant like Malan's prototype for boards: 18 heliostats, a target with a camera.

    Places and receiver are those of `field.example.prototype`; the gears are those of the
    boards (400,000 steps to a turn), and the target has marks.
    """
    like = example.prototype()
    (group,) = like.groups.values()
    mirror = layouts.Mirror(1.83, 1.22, pivot_height=1.2)
    mechanism = layouts.stepped(group.position, mirror)
    target = square_target("target", like.targets[0].center, 3.0, np.pi)
    camera = watching_camera(target, "camera", 20.0, 2.0, 3.0)
    return replace(
        like,
        groups={"azel": replace(group, mechanism=mechanism)},
        targets=(target,),
        cameras=(camera,),
    )
