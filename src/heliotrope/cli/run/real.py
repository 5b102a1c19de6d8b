"""A real plant with its store and its console, in one event loop."""

import asyncio
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from heliotrope.cli.run._shared import (
    Shown,
    archive,
    console,
    console_of,
    ending_at_signals,
    load_console,
    one_error,
    store,
    stow,
    watch,
)
from heliotrope.errors import InputError
from heliotrope.field.plant import Plant
from heliotrope.links.clock import SystemClock
from heliotrope.plant.assembly import RealPlant
from heliotrope.plant.cameras import RealCameras
from heliotrope.plant.kept_audit import KeptAudit, KeptPoints
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.settings import clusters_of

if TYPE_CHECKING:
    from heliotrope.mechanism.board_items import Machine
    from heliotrope.plant.links_file import PlantLinks


@dataclass(frozen=True)
class RealChoice:
    """What was asked for of a real plant on the command line; see `cli.run`."""

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
        Files that do not fit together, or no place for records.
    """
    clock = SystemClock()
    homes = clusters_of(design)
    links = _links(choice, homes, clock)
    machine = _machine(design) if choice.configure else None
    if choice.check:
        cameras = _cameras(design, choice, shown, clock)
        seen = 0 if cameras is None else len(design.targets) - len(cameras.unseen)
        print(
            f"{design.name}: {len(design):,} heliostats on {len(homes)} clusters, "
            f"{seen} of {len(design.targets)} targets with a camera"
        )
        return
    if shown.data is None and shown.database is None:
        raise InputError(
            "run: a real plant keeps its records; give --data FOLDER, or --database URL"
        )
    with one_error(), asyncio.Runner() as runner:
        runner.run(_run(design, choice, shown, links, machine))


def _links(
    choice: RealChoice, homes: dict[str, tuple[str, ...]], clock: SystemClock
) -> "PlantLinks":
    try:
        from heliotrope.plant.links_file import read_links
    except ImportError as error:
        raise InputError(
            f"run: {error.name} is not installed; say pip install 'heliotrope[control]'"
        ) from None
    return read_links(choice.clusters).build(homes, clock)


def _cameras(
    design: Plant, choice: RealChoice, shown: Shown, clock: SystemClock
) -> RealCameras | None:
    """Return the cameras, None if the plant has none that can work."""
    if not design.targets or not design.cameras:
        return None
    memory = None if shown.data is None else shown.data / "targets"
    return RealCameras(design, choice.folder, clock, memory=memory)


def _machine(design: Plant) -> "Machine":
    from heliotrope.twin.live.live import machine_of

    if len(design.groups) != 1:
        raise InputError(
            f"run: --configure takes heliostats of one kind, the plant has {len(design.groups)} "
            "groups; store their limits group by group"
        )
    return machine_of(design)


async def _run(
    design: Plant,
    choice: RealChoice,
    shown: Shown,
    links: "PlantLinks",
    machine: "Machine | None",
) -> None:
    ending = ending_at_signals()
    print(f"{design.name}: {len(design):,} heliostats", flush=True)
    load_console(shown)
    with store(shown) as keeper:
        clock = SystemClock()
        live = RealPlant(
            design,
            links,
            clock,
            KeptAudit(keeper, clock, clock.utc()),
            records=keeper,
            assigned=KeptPoints(keeper),
            machine=machine,
            cameras=_cameras(design, choice, shown, clock),
            # What a person gives to the automatic work is calibrated too.
            work=AutomaticSettings(wanted=not choice.idle),
        )
        if live.plant.unwatched:
            print(f"no readings for: {', '.join(live.plant.unwatched)}", flush=True)
        server = console_of(live, keeper, shown)
        async with (
            live.running(),
            archive(live, shown),
            console(server, live, keeper, shown) as seen,
        ):
            await watch(live, shown, ending, seen=seen)
            if not await stow(live, ending):
                print(live.left(), flush=True)
            await live.end()
    print("ended", flush=True)
