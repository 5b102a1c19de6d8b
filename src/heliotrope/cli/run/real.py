"""A real plant with its store, its local interface and its console."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from heliotrope.cli.run._shared import (
    FORESEE,
    Shown,
    at_work,
    begin,
    computing,
    one_error,
    pictures,
    store,
)
from heliotrope.errors import InputError
from heliotrope.field.plant import Plant
from heliotrope.files.disk import DiskThread
from heliotrope.links.clock import SystemClock
from heliotrope.links.link import running
from heliotrope.plant.assembly import AssemblySettings, MachineTables, PlantAssembly
from heliotrope.plant.field.learner import LearnerProcess
from heliotrope.plant.io.cameras import RealCameras
from heliotrope.plant.io.receiver_flux import check_reference, flux_by
from heliotrope.plant.io.sensors import AllSensors, Sensors
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.orders.audit import Forgetful
from heliotrope.plant.orders.kept_audit import KeptAudit, KeptPoints
from heliotrope.plant.ports import Ports
from heliotrope.plant.settings import clusters_of
from heliotrope.plant.workers import Worker, at_once
from heliotrope.store.keeper import Keeper

if TYPE_CHECKING:
    from heliotrope.cluster.program import LocalCluster
    from heliotrope.imaging.receiver_light import ReceiverReference
    from heliotrope.links.link import Link
    from heliotrope.links.papers import Papers
    from heliotrope.plant.io.links_file import PlantLinks


@dataclass(frozen=True)
class RealChoice:
    """Options of a real plant on the command line; see `cli.run.command`."""

    folder: Path
    clusters: Path
    idle: bool
    configure: bool
    check: bool


def run_real(design: Plant, choice: RealChoice, shown: Shown) -> None:
    """Run until Ctrl-C, or until the time is over; the field is stowed at the end.

    Raises
    ------
    InputError
        If files do not fit together, a group lacks the machine table that ``--configure``
        needs, or there is no place for records.
    """
    clock = SystemClock()
    outside = _outside(design, choice, clock)
    if outside.links.light is not None:
        check_reference(design, outside.links.light)
    if choice.configure:
        for name in design.names:
            design.machine(name)
    if choice.check:
        _check(
            design,
            _settings(design, choice, shown, outside),
            outside,
            _cameras(design, choice, shown, outside.links.light, clock),
            clock,
        )
        for text in _papers(outside, shown).lines():
            print(text)
        return
    if shown.data is None and shown.database is None:
        raise InputError(
            "run: a real plant keeps its records; give --data FOLDER, or --database URL"
        )
    with one_error(), asyncio.Runner() as runner:
        runner.run(_run(design, choice, shown, outside))


def _papers(outside: "_Outside", shown: Shown) -> "Papers":
    """Return keys and certificates of the links, and the certificate of the console."""
    papers = outside.links.papers
    if shown.console and shown.certificate is not None:
        papers.watch_end(shown.certificate)
    return papers


def _settings(
    design: Plant, choice: RealChoice, shown: Shown, outside: "_Outside"
) -> AssemblySettings:
    common = replace(outside.links.common, delta_t=design.site.delta_t, limits=design.safety)
    return AssemblySettings(
        plant=replace(
            shown.plant,
            given=outside.links.given,
            common=common,
            witnesses=outside.links.witnessed,
            firmware=outside.links.firmware,
        ),
        # A heliostat that a person gives to automatic control is calibrated too.
        work=AutomaticSettings(wanted=not choice.idle, foresee=FORESEE),
        machines=MachineTables.WRITTEN if choice.configure else MachineTables.UNKNOWN,
    )


def _check(
    design: Plant,
    settings: AssemblySettings,
    outside: "_Outside",
    cameras: RealCameras | None,
    clock: SystemClock,
) -> None:
    """Build the whole plant without starting it, and print what it consists of."""
    sensors = outside.sensors(cameras, clock)
    ports = Ports(outside.all_links, clock, Forgetful(), cameras, sensors)
    PlantAssembly(design, ports, settings)
    watched = 0 if cameras is None else sum(cameras.sees(t.name) for t in design.targets)
    print(
        f"{design.name}: {len(design):,} heliostats on {len(clusters_of(design))} clusters, "
        f"{watched} of {len(design.targets)} targets with a camera"
    )
    bare = [name for name, group in design.groups.items() if not group.machines]
    if bare:
        print(f"no machine table, which --configure needs: group {', '.join(bare)}")


@dataclass(frozen=True)
class _Outside:
    """Links of a plant, and the clusters that run in its process."""

    links: "PlantLinks"
    local: "list[LocalCluster]"

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Run servers, links and local clusters for the time of a block."""
        parts = [
            *self.links.parts,
            *(part for local in self.local for part in local.parts),
        ]
        async with running(*parts), running(*(local.cluster for local in self.local)):
            yield

    @property
    def all_links(self) -> "dict[str, Link]":
        """The links to all clusters, by name."""
        return {
            **self.links.links,
            **{local.cluster.config.name: local.link for local in self.local},
        }

    def sensors(self, cameras: RealCameras | None, clock: SystemClock) -> Sensors:
        """Return the sensors of the plant."""
        files, light = self.links.sensors, self.links.light
        if light is None or cameras is None:
            return files
        return AllSensors([files, flux_by(cameras, clock, light)])

    def ports(
        self,
        design: Plant,
        choice: RealChoice,
        shown: Shown,
        clock: SystemClock,
        keeper: Keeper,
        worker: Worker,
    ) -> Ports:
        """Return the ports of the plant."""
        cameras = _cameras(design, choice, shown, self.links.light, clock, worker)
        return Ports(
            self.all_links,
            clock,
            KeptAudit(keeper, clock, clock.utc()),
            cameras,
            self.sensors(cameras, clock),
            witnesses=self.links.witnesses,
            disk=DiskThread(),
            records=keeper,
            assigned=KeptPoints(keeper),
            beside=self.running,
            learner=LearnerProcess(),
            worker=worker,
            facts=self.links.facts,
        )


def _outside(design: Plant, choice: RealChoice, clock: SystemClock) -> _Outside:
    try:
        from heliotrope.cluster.program import LocalCluster
        from heliotrope.plant.io.links_file import read_links
    except ImportError as error:
        raise InputError(
            f"run: {error.name} is not installed; say pip install 'heliotrope[control]'"
        ) from None
    homes = clusters_of(design)
    links = read_links(choice.clusters).build(homes, clock)
    local = [LocalCluster(file, name, homes[name], clock) for name, file in links.local.items()]
    return _Outside(links, local)


def _cameras(
    design: Plant,
    choice: RealChoice,
    shown: Shown,
    light: "ReceiverReference | None",
    clock: SystemClock,
    worker: Worker = at_once,
) -> RealCameras | None:
    """Return the cameras; None if the plant has no camera that can work."""
    watched = {} if light is None else {light.sight.receiver: light.sight.camera}
    if not design.cameras or not (design.targets or watched):
        return None
    memory = None if shown.data is None else shown.data / "targets"
    return RealCameras(design, choice.folder, clock, watched=watched, memory=memory, worker=worker)


async def _run(design: Plant, choice: RealChoice, shown: Shown, outside: _Outside) -> None:
    ending = begin(design, shown)
    with computing() as worker, store(shown) as (keeper, folder):
        clock = SystemClock()
        ports = outside.ports(design, choice, shown, clock, keeper, worker)
        kept = pictures(shown, folder)
        ports = replace(ports, pictures=kept, marks=shown.marks)
        live = PlantAssembly(design, ports, _settings(design, choice, shown, outside))
        if live.plant.sentinel.table.unwatched:
            print(f"no readings for: {', '.join(live.plant.sentinel.table.unwatched)}", flush=True)
        papers = _papers(outside, shown)
        for local in outside.local:
            file = local.installation.bus_key_file
            if file is not None:
                name = f"key of the bus of {local.installation.config.name}"
                papers.renew(name, [file], local.installation.take_bus_keys)
        async with papers.watched(live.logbook.take_alarm):
            await at_work(live, keeper, shown, folder, ending, stows=True)
