"""Simulated surroundings of a plant: a field on buses, clusters, cameras, and true values.

`World` provides the ports of `plant.assembly.PlantAssembly`. Everything runs in one event loop: the
plant program and its operations, a cluster program for each bus, the field in ticks of 50 ms.
Heliostats have the errors of a rough installation; the plant assumes perfect ones, and learns from
photographs. The clock determines the speed: a `VirtualClock` on a `PacedLoop` (real time times a
speed) or on a `VirtualLoop` (as fast as possible).
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from heliotrope import sun
from heliotrope.cluster.config import ClusterConfig, Member, spread_phase
from heliotrope.cluster.controller import Cluster
from heliotrope.errors import InputError
from heliotrope.field.example import roughly_installed
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.plant import Plant
from heliotrope.field.target import Target
from heliotrope.files.disk import Disk
from heliotrope.geometry import FloatArray
from heliotrope.imaging.synthetic.scenes import Scene
from heliotrope.links.clock import Clock, gps_seconds
from heliotrope.links.connection import CarriedLink
from heliotrope.links.keys import KeyRing
from heliotrope.links.link import Bus, running
from heliotrope.mechanism import kinds
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.machine import Machine
from heliotrope.optics import nearest
from heliotrope.plant.field.aims import default_aims
from heliotrope.plant.field.assigned import Assigned
from heliotrope.plant.orders.audit import Audit, Forgetful
from heliotrope.plant.ports import Ports
from heliotrope.plant.settings import clusters_of
from heliotrope.plant.visits.settings import CycleSettings
from heliotrope.plant.workers import Worker, at_once
from heliotrope.safety import CONDITIONS, Watcher, watched_by
from heliotrope.store.records import Records
from heliotrope.twin.boards.bus import TwinBus
from heliotrope.twin.boards.clocks import SimulatedTime
from heliotrope.twin.boards.pty_line import PtyLine
from heliotrope.twin.cameras import ExactCamera, FieldSnapshot, RenderedCamera
from heliotrope.twin.drawing import Optics
from heliotrope.twin.field.field import Field
from heliotrope.twin.field.field_bus import FieldBus
from heliotrope.twin.live.boards import BoardField, key_of
from heliotrope.twin.live.near_link import NearLink, near_pair
from heliotrope.twin.sensors import FluxSensor
from heliotrope.twin.true_mirrors import TrueMirror, mirrors_near

#: Rows of the safety table that clusters watch.
_OF_CLUSTERS = frozenset(row.name for row in watched_by(CONDITIONS, Watcher.CLUSTER))
#: Tick of the field, and period at which the true sun is computed, s.
_TICK, _SUN_EVERY = 0.05, 5.0
#: Largest number of ticks made up at once after a pause.
_MOST_TICKS = 20
#: Step counts of each heliostat are requested each second in plants up to this size, and every few
#: seconds in larger ones.
_SMALL, _STEPS_EVERY = 320, 5
#: Settings of a calibration that removes the errors of a rough installation, with the standard
#: deviation of a beam in this simulation, rad.
CYCLE = CycleSettings(shots=4, interval=2.0, least=3, model="auto", sigma=2e-4)


@dataclass(frozen=True)
class WorldOptions:
    """Options of the simulated surroundings.

    Attributes
    ----------
    seed
        Seed of imperfections and noise.
    rendered
        Whether photographs are rendered and evaluated; otherwise centroids are returned with noise.
    worker
        Runs computations outside the event loop; None if there is no worker, as in virtual time.
    installed
        Function that derives the true mechanisms from the nominal ones; if None, the errors are as
        large as in Malan's field.
    boards
        Whether each heliostat is a board with the real firmware; for small plants.
    centroid
        Variance of centroids that are returned without a photograph, m².
    link
        Function that returns a cluster's end of the link to its plant, by cluster name; if None,
        both ends are in this process, and `World.links` contains the plant's ends.
    bus_key
        Key that signs the frames on every bus; with b"", frames are not signed, and a field of
        arrays obeys every frame.
    pty
        Whether the bus of boards is a pseudo-terminal, which the cluster opens as a serial port.
    """

    seed: int = 0
    rendered: bool = True
    worker: Worker | None = None
    installed: Callable[[Mechanism], Mechanism] | None = None
    boards: bool = False
    centroid: float = 1e-5
    bus_key: bytes = b""
    link: Callable[[str], CarriedLink] | None = None
    pty: bool = False

    def __post_init__(self) -> None:
        if not self.centroid >= 0.0:
            raise InputError(
                f"simulated plant: centroid variance must be 0 or more, not {self.centroid} m²"
            )


class World:
    """The simulated surroundings of a plant.

    Parameters
    ----------
    design
        The plant: groups of any kind of mechanism with two drives and a machine table, each
        heliostat in a cluster. Its mechanisms count as nominal; the local controllers store the
        nominal mechanisms with the parameters of the plant's heliostats.
    clock
        Clock of the event loop in which the world will run.
    options
        See `WorldOptions`.

    Attributes
    ----------
    names
        Heliostats, in the order of the design.
    truth
        True mechanisms, (N,).
    field
        The simulated heliostats.
    links
        The plant's end of the link to each cluster.
    buses
        Bus of each cluster.
    clusters, far
        Programs of the clusters; the clusters' ends of the links to an external plant, to be run
        within `running`.
    cameras
        Cameras of the targets; None if the plant has its own cameras, which receive photographs.
    flux
        Sensor of the flux on the receivers; None if there is no receiver.
    beats
        Number of ticks skipped because the computer was too slow.

    Raises
    ------
    InputError
        If the heliostats of a cluster are not consecutive, a target has no camera, a mechanism has
        one drive, or a machine table is missing or incomplete.
    """

    def __init__(self, design: Plant, clock: Clock, options: WorldOptions | None = None) -> None:
        chosen = options or WorldOptions()
        self.design, self.clock, self.options = design, clock, chosen
        groups = design.groups.values()
        self.names = design.names
        self.truth = true_mechanisms(design, chosen)
        believed, machines = together([g.calibrated for g in groups]), machines_of(design)
        self.field: Field | BoardField = (
            BoardField(clock, self.names, self.truth, believed, machines, chosen.seed)
            if chosen.boards
            else Field(self.truth, machines, believed=believed)
        )
        self._sizes = np.concatenate([np.stack([g.width, g.height], axis=-1) for g in groups])
        self._beside = nearest(design.position)
        self._sun: tuple[float, FloatArray] | None = None
        self.beats = 0
        self._parts: list[Any] = []
        self.far: list[CarriedLink] = []
        self.clusters: list[Cluster] = []
        self.links: dict[str, NearLink] = {}
        self.buses: dict[str, Bus] = {}
        homes = clusters_of(design)
        place = {name: row for row, name in enumerate(self.names)}
        for k, (name, members) in enumerate(homes.items()):
            self._wire(name, [place[member] for member in members], spread_phase(k, len(homes)))
        # The plant sorts heliostats by cluster, whereas the field keeps the order of the design.
        self._rows = np.array([place[name] for members in homes.values() for name in members])
        aims = default_aims(design, self.names, design.position, None)
        self._aims = np.stack([aims[name] for name in self.names])
        self.cameras = self._new_cameras() if chosen.link is None else None
        receivers = design.receivers
        self.flux = FluxSensor(receivers, clock, self.field.stand, self.sun) if receivers else None

    # -- assembly --------------------------------------------------------------------------

    def _wire(self, name: str, rows: list[int], phase: float) -> None:
        """Create a cluster with its bus and its link to the plant."""
        if rows != list(range(rows[0], rows[0] + len(rows))):
            raise InputError(
                f"simulated plant: the heliostats of cluster {name} are not consecutive in the "
                "plant file; sort them by cluster"
            )
        span = range(rows[0], rows[0] + len(rows))
        far: NearLink | CarriedLink
        if self.options.link is None:
            near, far = near_pair(self.clock, ("plant", name))
            self.links[name] = near
            self._parts += [near, far]
        else:
            far = self.options.link(name)
            self.far.append(far)
        key = self.options.bus_key
        own = [key_of(self.names[row]) for row in span] if key else ()
        bus: Bus
        if isinstance(self.field, BoardField):
            boards = self.field.bus(span)
            bus = self._serial(boards) if self.options.pty else boards
        else:
            bus = FieldBus(self.field, span, keys=own)
        members = tuple(
            Member(self.names[row], i + 1, 1 + row, key_of(self.names[row]))
            for i, row in enumerate(rows)
        )
        config = ClusterConfig(
            name,
            self.design.site,
            members,
            steps_every=steps_every(len(self.names)),
            phase=phase,
            limits={k: v for k, v in self.design.safety.items() if k in _OF_CLUSTERS},
        )
        # A clock that reads earlier than this program was never set; simulated time may be that
        # early.
        time = SimulatedTime(self.clock)
        ring = KeyRing(key) if key else None
        self.clusters.append(Cluster(config, bus, far, self.clock, time, bus_keys=ring))
        self._parts += [bus, time]
        self.buses[name] = bus

    def _serial(self, boards: TwinBus) -> Bus:
        """Return a serial bus that is connected to boards."""
        # Only this function needs the serial port library.
        from heliotrope.cluster.serial_bus import SerialBus

        line = PtyLine(self.clock, boards.stations)
        self._parts.append(line)
        return SerialBus(line.path, self.clock)

    def _new_cameras(self) -> ExactCamera | RenderedCamera:
        seed, sight = self.options.seed, FieldSnapshot(self.clock, self.mirrors, self.sun)
        if not self.options.rendered:
            return ExactCamera(sight, self.options.centroid, seed)
        scenes = []
        for target in self.design.targets:
            cameras = [c for c in self.design.cameras if target.name in c.targets]
            if not cameras or cameras[0].position is None:
                raise InputError(
                    f"target {target.name}: no camera with a known position views it; add one "
                    "to the plant file, or take exact centroids"
                )
            scenes.append(Scene(cameras[0], (target,)))
        if (visits := self.design.receiver_visits) is not None:
            scenes += [Scene(self.design.camera(visits.camera), (face,)) for face in self.faces]
        # Malan's small mirrors have a single facet.
        optics = Optics(facets=(1, 1))
        return RenderedCamera(sight, scenes, optics=optics, seed=seed, worker=self.options.worker)

    def ports(
        self,
        *,
        audit: Audit | None = None,
        disk: Disk | None = None,
        records: Records | None = None,
        assigned: Assigned | None = None,
        facts: Callable[[], Mapping[str, Any]] = dict,
    ) -> Ports:
        """Return these surroundings as the ports of a plant, with storage for its records."""
        return Ports(
            self.links,
            self.clock,
            audit or Forgetful(),
            self.cameras,
            self.flux,
            disk=disk,
            records=records,
            assigned=assigned,
            beside=self.running,
            truth=self.errors,
            worker=self.options.worker or at_once,
            facts=facts,
        )

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

    def mirrors(self) -> list[TrueMirror]:
        """Return the mirrors whose light may fall on a target."""
        light, stand = self.sun(), self.field.stand()
        mirrors: dict[str, TrueMirror] = {}
        for target in (*self.design.targets, *self.faces):
            for mirror in mirrors_near(
                target, light, stand, self.names, self._sizes, beside=self._beside
            ):
                mirrors[mirror.heliostat] = mirror
        return list(mirrors.values())

    @property
    def faces(self) -> tuple[Target, ...]:
        """The face of the receiver on which heliostats are measured."""
        visits = self.design.receiver_visits
        return () if visits is None else (self.design.receiver(visits.receiver).face,)

    def errors(self) -> FloatArray:
        """Return the true tracking errors at the design's aims, rad, (N,), in the plant's order."""
        return np.asarray(self.field.errors(self.sun(), self._aims)[self._rows])

    async def _turn(self) -> None:
        """Advance the field tick by tick."""
        done = self.clock.monotonic()
        while True:
            await asyncio.sleep(_TICK)
            late = int((self.clock.monotonic() - done) / _TICK + 1e-6)
            ticks = min(late, _MOST_TICKS)
            self.beats += late - ticks
            done += late * _TICK
            self.field.advance(50 * ticks)

    def put_up(self) -> None:
        """Set a field of arrays to tracking, as on a working day.

        The plant must control the field.
        """
        gps = gps_seconds(self.clock.utc())
        utc = self.clock.utc().timestamp()
        values = sun.broadcast_values(round(gps), utc, self.design.site)
        if values is not None and isinstance(self.field, Field):
            self.field.put_up(values, self._aims)

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Run the field, buses, links and clusters for the duration of a block."""
        async with asyncio.TaskGroup() as group:
            turns = group.create_task(self._turn())
            async with running(*self._parts), running(*self.clusters):
                yield
            turns.cancel()


def steps_every(heliostats: int) -> int:
    """Return the time between requests for step counts in a plant of a given size, s."""
    return 1 if heliostats <= _SMALL else _STEPS_EVERY


def true_mechanisms(design: Plant, options: WorldOptions) -> Mechanism:
    """Return the true mechanisms of the simulation, in the order of the design, (N,).

    The true mechanisms do not depend on the parameters in the design, which the simulated local
    controllers store.

    Raises
    ------
    InputError
        If a mechanism has one drive.
    """
    groups = design.groups.values()
    return together([_installed(group, options, i) for i, group in enumerate(groups)])


def _installed(group: Heliostats, options: WorldOptions, number: int) -> Mechanism:
    """Return the true mechanisms of a group, whose errors are drawn separately."""
    if len(group.mechanism.driven) != 2:
        raise InputError(
            f"simulated plant: mechanisms of kind {group.mechanism.kind} have "
            f"{len(group.mechanism.driven)} drive; the simulation needs two"
        )
    install = options.installed or partial(roughly_installed, seed=options.seed + number)
    return install(group.mechanism)


def together(parts: Sequence[Mechanism]) -> Mechanism:
    """Join arrays of mechanisms to one array; different kinds become armatures with drives."""
    if len(parts) == 1:
        return parts[0]
    return kinds.of_armature(
        Armature(np.concatenate([part.armature.table for part in parts])),
        Drive(np.concatenate([part.drives.table for part in parts])),
        np.concatenate([part.position for part in parts]),
    )


def machines_of(design: Plant) -> list[Machine]:
    """Return the machine table of each heliostat of a design.

    Raises
    ------
    InputError
        If a machine table is missing, or has no standby point.
    """
    machines = [design.machine(name) for name in design.names]
    for name, machine in zip(design.names, machines, strict=True):
        if machine.standby is None:
            raise InputError(
                f"simulated plant: heliostat {name} has no standby point; set standby_m in the "
                "machine table of its group"
            )
    return machines
