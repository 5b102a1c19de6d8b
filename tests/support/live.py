"""A simulated plant at work, for tests: the plant's assembly and the world around it."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from heliotrope.field.layouts import lay_out
from heliotrope.field.mirror_surface import MirrorSurface
from heliotrope.field.plant import Plant
from heliotrope.files.disk import Disk
from heliotrope.geometry import FloatArray
from heliotrope.links.clock import Clock, VirtualClock, run_virtual
from heliotrope.mechanism.chain import Mechanism
from heliotrope.plant.assembly import AssemblySettings, MachineTables, PlantAssembly
from heliotrope.plant.field.assigned import Assigned
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.operations.learning import Learner
from heliotrope.plant.operations.pictures import Pictures
from heliotrope.plant.orders.audit import Audit
from heliotrope.plant.settings import PlantSettings
from heliotrope.plant.visits.settings import CycleSettings
from heliotrope.store.records import Records
from heliotrope.twin.live import CYCLE, World, WorldOptions

#: Morning: the sun is at 20°, and rises.
START = datetime(2026, 10, 21, 7, tzinfo=UTC)


async def in_thread(work: Callable[..., Any], *given: Any) -> Any:
    """Compute in a thread: tests wait for no process."""
    return await asyncio.to_thread(work, *given)


@dataclass(frozen=True)
class LiveOptions:
    """Options of the world, and settings of the plant; see `WorldOptions`, `AssemblySettings`.

    New mirrors go to a target one by one, which tests of single visits need, unless ``together``.
    """

    seed: int = 0
    rendered: bool = True
    threads: int = 1
    installed: Callable[[Mechanism], Mechanism] | None = None
    boards: bool = False
    centroid: float = 1e-5
    bus_key: bytes = b""
    cycle: CycleSettings = CYCLE
    work: AutomaticSettings = field(default_factory=lambda: AutomaticSettings(wanted=True))
    plant: PlantSettings = field(default_factory=PlantSettings)
    together: bool = False

    def world(self) -> WorldOptions:
        """Return the options of the world."""
        return WorldOptions(
            self.seed,
            self.rendered,
            in_thread if self.threads else None,
            self.installed,
            self.boards,
            self.centroid,
            self.bus_key,
        )

    def settings(self) -> AssemblySettings:
        """Return the settings of the plant."""
        return AssemblySettings(self.work, self.plant, self.cycle, MachineTables.HELD)


class LivePlant:
    """A plant with its world."""

    def __init__(
        self,
        design: Plant,
        clock: Clock,
        options: LiveOptions | None = None,
        *,
        audit: Audit | None = None,
        disk: Disk | None = None,
        records: Records | None = None,
        assigned: Assigned | None = None,
        extra: Callable[[], Mapping[str, Any]] = dict,
        pictures: Pictures | None = None,
        marks: Path | None = None,
        file: Path | None = None,
        learner: Learner | None = None,
        stored: Plant | None = None,
    ) -> None:
        """``stored``: the plant whose parameters the boards store; None: the design."""
        chosen = options or LiveOptions()
        if design.joint_visits is not None and not chosen.together:
            alone = replace(design.joint_visits, first=0)
            design = replace(design, joint_visits=alone)
        self.design, self.clock = design, clock
        self.world = World(stored or design, clock, chosen.world())
        ports = self.world.ports(
            audit=audit, disk=disk, records=records, assigned=assigned, facts=extra
        )
        ports = replace(ports, pictures=pictures, marks=marks, file=file, learner=learner)
        self.assembly = PlantAssembly(design, ports, chosen.settings())
        self.plant, self.operations = self.assembly.plant, self.assembly.operations
        self.names, self.cameras, self.field = (
            self.world.names,
            self.world.cameras,
            self.world.field,
        )
        self.truth, self.links = self.world.truth, self.world.links

    def errors(self) -> FloatArray:
        """True tracking errors, rad, (N,)."""
        return self.world.errors()

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator["LivePlant"]:
        """Run it for the time of a block."""
        async with self.assembly.running():
            yield self

    async def end(self) -> None:
        """End it."""
        await self.assembly.end()

    async def stowed(self, limit: float = 300.0) -> bool:
        """Stow the field."""
        return await self.assembly.stowed(limit)


def play(
    work: Callable[[LivePlant], Awaitable[None]],
    design: Plant,
    options: LiveOptions,
    records: Records | None = None,
    start: datetime = START,
) -> None:
    """Run a plant in virtual time beside some work."""

    async def main(clock: VirtualClock) -> None:
        async with LivePlant(design, clock, options, records=records).running() as plant:
            await work(plant)
            await plant.end()

    run_virtual(main, start=start)


def live(
    work: Callable[[LivePlant], Awaitable[None]],
    settings: AutomaticSettings,
    count: int = 4,
    records: Records | None = None,
    plant: PlantSettings | None = None,
    start: datetime = START,
    surface: MirrorSurface | None = None,
) -> None:
    """Run some heliostats on two clusters in virtual time."""
    design = lay_out("radial", count)
    (group,) = design.groups.values()
    group = replace(group, cluster=("C1",) * (count // 2) + ("C2",) * (count // 2))
    group = replace(group, surface=surface)
    plant = plant or PlantSettings()
    options = LiveOptions(rendered=False, threads=0, work=settings, plant=plant)

    async def later(made: LivePlant) -> None:
        await asyncio.sleep(4.0)
        await work(made)

    play(later, replace(design, groups={"azel": group}), options, records, start)
