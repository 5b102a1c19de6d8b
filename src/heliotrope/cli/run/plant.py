"""A plant with its store, its local interface and its console.

Real and simulated fields are treated alike: both are reached through a links file. The links file
of a simulated field contains the field's address; the plant then follows the field's clock, and
requests the true errors from it.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from heliotrope import warm
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
from heliotrope.errors import FetchError, InputError
from heliotrope.field.plant import Plant
from heliotrope.files.disk import DiskThread
from heliotrope.geometry import FloatArray
from heliotrope.links.clock import Clock, SystemClock
from heliotrope.links.link import running
from heliotrope.local import log_lines
from heliotrope.plant.assembly import CYCLE, AssemblySettings, MachineTables, PlantAssembly
from heliotrope.plant.field.learner import LearnerProcess
from heliotrope.plant.io.cameras import RealCameras
from heliotrope.plant.io.followed_clock import ClockReader, FollowedLoop
from heliotrope.plant.io.receiver_flux import check_reference, flux_by
from heliotrope.plant.io.sensors import AllSensors, Sensors
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.operations.security import SecurityEvent
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
    from heliotrope.plant.io.links_file import LinksFile, PlantLinks

#: Calibration of a simulated field: how well its beams are known, rad.
_SIMULATED = replace(CYCLE, sigma=2e-4)
#: Time between requests for the true errors of a simulated field, s.
_TRUE_EVERY = 5.0


#: Function that prepares the store and the simulated field.
Prepare = Callable[[Keeper, Plant, datetime], Awaitable[None]]


@dataclass(frozen=True)
class PlantChoice:
    """Options of a plant on the command line; see `cli.run.command`.

    ``file`` is the file or folder with which the plant was started. ``aimed`` means that the
    heliostats of a simulated field track the design's aims when the plant starts.
    """

    folder: Path
    clusters: Path
    idle: bool
    configure: bool = False
    check: bool = False
    aimed: bool = False
    file: Path | None = None

    @property
    def plant_file(self) -> Path | None:
        """The plant's file, if it is in our own format."""
        return self.file if self.file is not None and self.file.suffix == ".toml" else None


def run_plant(
    design: Plant, choice: PlantChoice, shown: Shown, prepare: Prepare | None = None
) -> None:
    """Run a plant until Ctrl-C or until its time has passed; stow a real field at the end.

    ``prepare`` is called with the store, the plant and the present time before a simulated field
    starts.

    Raises
    ------
    InputError
        If files contradict each other, a group lacks the machine table that ``--configure`` needs,
        or there is no place for records.
    FetchError
        If the simulated field does not respond.
    """
    log_lines.install()
    file = _links_file(choice)
    if not file.document.twin:
        _begin(_outside(design, file, SystemClock()), design, choice, shown)
        return
    warm.controlling()  # while the simulated field does the same
    with contextlib.closing(ClockReader(file.document.twin)) as reader:
        loop = FollowedLoop(reader)
        outside = _outside(design, file, reader.clock(loop), reader)
        _begin(outside, design, choice, shown, loop, prepare)


def _begin(
    outside: "_Outside",
    design: Plant,
    choice: PlantChoice,
    shown: Shown,
    loop: FollowedLoop | None = None,
    prepare: Prepare | None = None,
) -> None:
    """Check all options, and run the plant in its loop."""
    if outside.links.light is not None:
        check_reference(design, outside.links.light)
    if choice.configure:
        for name in design.names:
            design.machine(name)
    if choice.check:
        settings = _settings(design, choice, shown, outside)
        _check(design, settings, outside, _cameras(design, choice, shown, outside))
        for text in _papers(outside, shown).lines():
            print(text)
        return
    if loop is None and shown.data is None and shown.database is None:
        raise InputError(
            "run: a real plant must keep its records; use --data FOLDER or --database URL"
        )
    factory = None if loop is None else lambda: loop
    with one_error(), asyncio.Runner(loop_factory=factory) as runner:
        runner.run(_run(design, choice, shown, outside, prepare))


def _papers(outside: "_Outside", shown: Shown) -> "Papers":
    """Return the keys and certificates of the links, and the console's certificate."""
    papers = outside.links.papers
    if shown.console and shown.certificate is not None:
        papers.watch_end(shown.certificate)
    return papers


def _settings(
    design: Plant, choice: PlantChoice, shown: Shown, outside: "_Outside"
) -> AssemblySettings:
    common = replace(outside.links.common, delta_t=design.site.delta_t, limits=design.safety)
    held = MachineTables.UNKNOWN if outside.reader is None else MachineTables.HELD
    return AssemblySettings(
        plant=replace(
            shown.plant,
            given=outside.links.given,
            common=common,
            witnesses=outside.links.witnessed,
            firmware=outside.links.firmware,
        ),
        # A heliostat that an operator hands to automatic control is calibrated too.
        work=AutomaticSettings(wanted=not choice.idle, foresee=FORESEE),
        cycle=CYCLE if outside.reader is None else _SIMULATED,
        machines=MachineTables.WRITTEN if choice.configure else held,
    )


def _check(
    design: Plant, settings: AssemblySettings, outside: "_Outside", cameras: RealCameras | None
) -> None:
    """Assemble the whole plant without starting it, and print a summary of its parts."""
    sensors = outside.sensors(cameras, design)
    ports = Ports(outside.all_links, outside.clock, Forgetful(), cameras, sensors)
    PlantAssembly(design, ports, settings)
    watched = 0 if cameras is None else sum(cameras.sees(t.name) for t in design.targets)
    print(
        f"{design.name}: {len(design):,} heliostats on {len(clusters_of(design))} clusters, "
        f"{watched} of {len(design.targets)} targets with a camera"
    )
    bare = [name for name, group in design.groups.items() if not group.machines]
    if bare:
        print(
            "--configure needs a machine table; add it to the plant file for group "
            f"{', '.join(bare)}"
        )


@dataclass(frozen=True)
class _Outside:
    """A plant's links and clock, and the clusters that run in its process.

    Attributes
    ----------
    reader
        Reader of a simulated field's clock; None for a real field.
    """

    links: "PlantLinks"
    local: "list[LocalCluster]"
    clock: Clock
    reader: ClockReader | None

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Run servers, links and local clusters during a block."""
        parts = [
            *self.links.parts,
            *(part for local in self.local for part in local.parts),
        ]
        async with running(*parts), running(*(local.cluster for local in self.local)):
            if self.reader is not None:
                await self.reader.begin()
            yield

    @property
    def all_links(self) -> "dict[str, Link]":
        """The links to all clusters, by name."""
        return {
            **self.links.links,
            **{local.cluster.config.name: local.link for local in self.local},
        }

    def sensors(self, cameras: RealCameras | None, design: Plant) -> Sensors:
        """Return the sensors of the plant."""
        files, light = self.links.sensors, self.links.light
        if light is None or cameras is None:
            return files
        receiver = design.receiver(light.sight.receiver)
        return AllSensors([files, flux_by(cameras, self.clock, light, receiver)])

    def ports(
        self, design: Plant, choice: PlantChoice, shown: Shown, keeper: Keeper, worker: Worker
    ) -> Ports:
        """Return the ports of the plant."""
        cameras = _cameras(design, choice, shown, self, worker)
        return Ports(
            self.all_links,
            self.clock,
            KeptAudit(keeper, SystemClock(), self.clock.utc()),
            cameras,
            self.sensors(cameras, design),
            witnesses=self.links.witnesses,
            # If time runs faster, a record takes long in that time, so the loop waits for it.
            disk=None if self.fast else DiskThread(),
            records=keeper,
            assigned=KeptPoints(keeper),
            beside=self.running,
            ready=None if self.reader is None else self.reader.led,
            truth=None if self.reader is None else _TrueErrors(self.reader, design),
            learner=LearnerProcess(),
            worker=worker,
            facts=self.facts,
        )

    @property
    def fast(self) -> bool:
        """Whether a simulated field's time runs faster than this computer's time."""
        return self.reader is not None and self.reader.state.asked > 1.0

    def facts(self) -> dict[str, Any]:
        """Return summary rows about the links and the clock of a simulated field."""
        found: dict[str, Any] = dict(self.links.facts())
        if self.reader is not None:
            found |= {"speed": self.reader.state.asked, "pace": self.reader.pace}
        return found


class _TrueErrors:
    """The true tracking errors of a simulated field, which are requested outside the loop.

    A call returns the last errors, rad, (N,); NaN before the first reply.
    """

    def __init__(self, reader: ClockReader, design: Plant) -> None:
        self._reader = reader
        self._errors: FloatArray = np.full(len(design), np.nan)
        self._asking: asyncio.Task[None] | None = None
        self._asked_at = -np.inf

    def __call__(self) -> FloatArray:
        """Return the last errors, and request new errors if these are old."""
        loop = asyncio.get_running_loop()
        if self._asking is None and loop.time() - self._asked_at > _TRUE_EVERY:
            self._asked_at = loop.time()
            self._asking = loop.create_task(self._ask())
        return self._errors

    async def _ask(self) -> None:
        with contextlib.suppress(FetchError):
            data = await asyncio.to_thread(self._reader.fetch, "errors")
            self._errors = np.frombuffer(data, dtype=np.float64)
        self._asking = None


def _links_file(choice: PlantChoice) -> "LinksFile":
    try:
        from heliotrope.plant.io.links_file import read_links
    except ImportError as error:
        raise InputError(
            f"run: {error.name} is not installed; run pip install 'heliotrope[control]'"
        ) from None
    return read_links(choice.clusters)


def _outside(
    design: Plant, file: "LinksFile", clock: Clock, reader: ClockReader | None = None
) -> _Outside:
    from heliotrope.cluster.program import LocalCluster

    homes = clusters_of(design)
    links = file.build(homes, clock)
    local = [LocalCluster(file, name, homes[name], clock) for name, file in links.local.items()]
    return _Outside(links, local, clock, reader)


def _cameras(
    design: Plant, choice: PlantChoice, shown: Shown, outside: _Outside, worker: Worker = at_once
) -> RealCameras | None:
    """Return the cameras; None if the plant has no camera that can work."""
    light: ReceiverReference | None = outside.links.light
    watched = {} if light is None else {light.sight.receiver: light.sight.camera}
    if not design.cameras or not (design.targets or watched):
        return None
    memory = None if shown.data is None else shown.data / "targets"
    return RealCameras(
        design, choice.folder, outside.clock, watched=watched, memory=memory, worker=worker
    )


async def _run(
    design: Plant, choice: PlantChoice, shown: Shown, outside: _Outside, prepare: Prepare | None
) -> None:
    ending = begin(design, shown)
    if outside.reader is not None:
        print(
            "starting the simulated field; the first start compiles code and takes longer",
            flush=True,
        )
    with computing() as worker, store(shown) as (keeper, folder):
        if prepare is not None:
            await prepare(keeper, design, outside.clock.utc())
        ports = outside.ports(design, choice, shown, keeper, worker)
        kept = pictures(shown, folder, waits=outside.fast)
        ports = replace(ports, pictures=kept, marks=shown.marks, file=choice.plant_file)
        live = PlantAssembly(design, ports, _settings(design, choice, shown, outside))
        if choice.aimed:
            live.aim_as_designed()
        real = outside.reader is None
        if real and live.plant.sentinel.table.unwatched:
            print(
                f"no readings for: {', '.join(live.plant.sentinel.table.unwatched)}",
                flush=True,
            )
        papers = _papers(outside, shown)
        for local in outside.local:
            file = local.installation.bus_key_file
            if file is not None:
                name = f"bus key of {local.installation.config.name}"
                papers.renew(name, [file], local.installation.take_bus_keys)
        speed = 1.0 if outside.reader is None else outside.reader.state.asked
        if shown.console and shown.certificate is not None:
            # The console loads the certificate; here only its change is recorded.
            papers.renew("certificate of the console", [shown.certificate], lambda: None)

        def note(name: str) -> None:
            live.operations.security.note(SecurityEvent.KEYS_RENEWED, detail=name)

        async with papers.watched(live.logbook.take_alarm, note):
            await at_work(live, keeper, shown, folder, ending, stows=real, speed=speed)
