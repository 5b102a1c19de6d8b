"""``heliotrope image``: find beams on targets, in photographs or live."""

import json
import os
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from heliotrope.cli import _calibration as shared
from heliotrope.cli._common import open_plant, print_json

if TYPE_CHECKING:
    from heliotrope.field.camera import Camera
    from heliotrope.field.target import Target
    from heliotrope.imaging.campaign import Job, Outcome
    from heliotrope.imaging.frame import Frame
    from heliotrope.imaging.log import Entry, Log
    from heliotrope.imaging.memory import Memory
    from heliotrope.imaging.sources import Source
    from heliotrope.mechanism.chain import Mechanism
    from heliotrope.sun import Site

#: Number of frames after which models of empty targets are saved.
_OFTEN = 20


def image(
    paths: Annotated[
        list[str],
        typer.Argument(help="Photographs or folders of photographs; with --live, a single source."),
    ],
    plant: Annotated[
        Path, typer.Option(help="Plant file or folder, or PAINT's tower-measurements.json.")
    ],
    target: Annotated[str, typer.Option(help="Target to which the beam was sent.")] = "",
    crop: Annotated[
        bool, typer.Option("--crop", help="Each picture shows exactly one target.")
    ] = False,
    camera: Annotated[str, typer.Option(help="Camera that took the photographs.")] = "",
    empty: Annotated[
        Path | None, typer.Option(help="Photograph from the same camera without the beam.")
    ] = None,
    memory: Annotated[
        Path | None,
        typer.Option(help="Folder with models of the empty targets; --live updates them."),
    ] = None,
    annotated: Annotated[Path | None, typer.Option(help="Folder for annotated pictures.")] = Path(
        "out/image"
    ),
    pictures: Annotated[
        bool, typer.Option("--pictures/--no-pictures", help="Write annotated pictures.")
    ] = True,
    to_sightings: Annotated[
        Path | None, typer.Option(help="Write the sightings to this CSV or Parquet table.")
    ] = None,
    log: Annotated[
        Path | None, typer.Option(help="CSV log: file or id, heliostat, motor positions, time.")
    ] = None,
    heliostat: Annotated[
        str, typer.Option(help="Heliostat whose beam is shown, if there is no log.")
    ] = "",
    processes: Annotated[
        int, typer.Option(min=0, max=1024, help="Processes on this computer; 0: one per core.")
    ] = 0,
    scheduler: shared.SchedulerOption = None,
    live: Annotated[
        bool,
        typer.Option(
            "--live",
            help="Follow a live source: a watched folder, a video, rtsp://, http:// or usb:0.",
        ),
    ] = False,
    limit: Annotated[
        int | None,
        typer.Option(min=1, max=1_000_000_000, help="With --live: stop after this many frames."),
    ] = None,
    burst: Annotated[
        int, typer.Option(min=1, max=1000, help="With --live: number of frames to average.")
    ] = 1,
    archive: Annotated[
        Path | None, typer.Option("--keep", help="With --live: folder for frames and results.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Find spots on targets: positions in m with covariance, or the reason for failure."""
    from heliotrope.imaging import campaign
    from heliotrope.imaging.log import read_log
    from heliotrope.values import amount

    place = open_place(plant)
    if live:
        job = _job(place, target, crop, camera, empty, None, None)
        if job.trust:
            print(f"heliotrope: {job.trust}", file=sys.stderr)
        _follow(paths, place, job, limit, burst, archive, memory, as_json)
        return
    files, others = _files([Path(path) for path in paths])
    table: Log | None = None if log is None else read_log(log)
    entries = campaign.entries_of(files, table, heliostat)
    job = _job(place, target, crop, camera, empty, memory, annotated if pictures else None)
    with shared.connected(scheduler) as client, shared.progress("reading", as_json) as advance:
        outcomes = campaign.process_many(
            files,
            job,
            entries,
            processes=processes or len(os.sched_getaffinity(0)),
            client=client,
            progress=advance,
        )
    left_out = [o.problem for o in outcomes if o.problem and o.path in others]
    count = 0
    if to_sightings is not None:
        count, left_out = _write(to_sightings, outcomes, entries, place)
    outcomes = [o for o in outcomes if not (o.problem and o.path in others)]
    _show(outcomes, as_json, to_sightings, count, left_out, job.trust)
    broken = [o.problem for o in outcomes if o.problem]
    if not broken and not any(_shows_a_target(o) for o in outcomes):
        broken = [f"no target was found in {amount(len(files), 'photograph')}: none could be read"]
    for problem in broken:
        print(f"heliotrope: {problem}", file=sys.stderr)
    if broken or (to_sightings is not None and not count):
        raise typer.Exit(2)


def _shows_a_target(outcome: "Outcome") -> bool:
    return any(reading["found"] for reading in outcome.document["targets"])


def _follow(
    paths: list[str],
    place: "Place",
    job: "Job",
    limit: int | None,
    burst: int,
    archive: Path | None,
    memory: Path | None,
    as_json: bool,
) -> None:
    from heliotrope.errors import InputError
    from heliotrope.imaging.sources import open_source

    if len(paths) != 1:
        raise InputError(
            f"--live follows a single source, but {len(paths)} were specified; specify one"
        )
    # A plant camera may be specified by its name.
    named = next((c for c in place.cameras if c.name == paths[0]), None)
    text = named.source if named is not None else paths[0]
    folder = place.folder if named is not None else Path()
    frames = None if limit is None else limit * burst
    source = open_source(text, folder=folder, watch=Path(text).is_dir(), limit=frames)
    follow(source, job, burst=burst, archive=archive, memory=memory, as_json=as_json)


@dataclass(frozen=True)
class Place:
    """The parts of a plant that photographs need.

    Attributes
    ----------
    targets, cameras
        Targets and cameras of the plant.
    site
        Reference point of the plant.
    names
        Names of the plant's heliostats; empty if the file has none.
    folder
        Folder of the plant file, which contains the reference pictures.
    mechanism
        Nominal mechanisms of the heliostats named; None if the file has none, or several kinds.
    """

    targets: "tuple[Target, ...]"
    cameras: "tuple[Camera, ...]"
    site: "Site"
    names: tuple[str, ...]
    folder: Path
    mechanism: "Mechanism | None" = None


def open_place(path: Path) -> Place:
    """Return the targets, cameras and site of a plant, or of PAINT's tower file alone."""
    from heliotrope.errors import InputError
    from heliotrope.sun import Site

    if path.suffix.lower() == ".json":
        from heliotrope.field.formats.paint import read_tower

        tower = read_tower(path)
        place = Place(tower.targets, (), Site(*tower.origin), (), path.parent)
    else:
        plant = open_plant(path)
        folder = path if path.is_dir() else path.parent
        machines = plant.nominal if len(plant.groups) == 1 else None
        place = Place(plant.targets, plant.cameras, plant.site, plant.names, folder, machines)
    if not place.targets:
        raise InputError(f"{path}: the plant has no targets; add [[targets]] with their marks")
    return place


def _files(paths: Sequence[Path]) -> tuple[list[Path], set[Path]]:
    """Return the photographs, and the files in folders that have other suffixes."""
    from heliotrope.errors import FormatError
    from heliotrope.imaging.files import IMAGE_SUFFIXES, OTHER_SUFFIXES, find_images

    files: list[Path] = []
    others: set[Path] = set()
    for path in paths:
        if path.is_dir():
            images = find_images(path, suffixes=IMAGE_SUFFIXES + OTHER_SUFFIXES)
            if not images:
                raise FormatError(path, "no image in this folder; use PNG, JPEG or TIFF")
            files += images
            others |= {item for item in images if item.suffix.lower() in OTHER_SUFFIXES}
        else:
            files.append(path)
    return files, others


def _job(
    place: Place,
    target: str,
    crop: bool,
    camera: str,
    empty: Path | None,
    memory: Path | None,
    annotated: Path | None,
) -> "Job":
    from heliotrope.errors import InputError, UnknownNameError
    from heliotrope.imaging.campaign import Job
    from heliotrope.imaging.files import read_image
    from heliotrope.imaging.memory import Memory
    from heliotrope.imaging.photograph import PhotographSettings
    from heliotrope.imaging.targets.teaching import read_pictures

    names = [t.name for t in place.targets]
    if target and target not in names:
        raise UnknownNameError("target", target, names)
    cameras = [c.name for c in place.cameras]
    if camera and camera not in cameras:
        raise UnknownNameError("camera", camera, cameras)
    # The only camera of a plant took them; its frame size is checked on use.
    known = next((c for c in place.cameras if c.name == camera), None)
    if not camera and len(place.cameras) == 1:
        known = place.cameras[0]
    if annotated is not None:
        annotated.mkdir(parents=True, exist_ok=True)
    taught = read_pictures(place.folder, place.targets)
    known_empty = Memory() if memory is None else Memory.load(memory)
    if memory is not None and not known_empty:
        raise InputError(
            f"{memory}: no model of an empty target (*.npz) in this folder; learn one with --live "
            "and --memory"
        )
    return Job(
        targets=place.targets,
        origin=(place.site.latitude_deg, place.site.longitude_deg, place.site.height),
        camera=known,
        settings=PhotographSettings(pictures=taught, empty=known_empty.models),
        crop=crop,
        target=target,
        annotated=annotated,
        without=None if empty is None else read_image(empty),
    )


def _write(
    path: Path, outcomes: "Sequence[Outcome]", entries: "Sequence[Entry | None]", place: Place
) -> tuple[int, list[str]]:
    """Write the table of sightings; return their number and one line per omitted photograph."""
    import time

    from heliotrope.calibration.sighting_table import write_sightings
    from heliotrope.imaging.campaign import to_sightings

    # A tower file names no heliostats; use those of the log.
    names = place.names or tuple(sorted({e.heliostat for e in entries if e and e.heliostat}))
    sightings, left_out = to_sightings(
        outcomes, entries, names, place.site, mechanism=place.mechanism, now=time.time()
    )
    if sightings is None:
        return 0, left_out
    write_sightings(path, sightings, names, ["camera_target"] * len(sightings))
    return len(sightings), left_out


def _show(
    outcomes: "Sequence[Outcome]",
    as_json: bool,
    table: Path | None,
    count: int,
    left_out: list[str],
    trust: str,
) -> None:
    read = [o for o in outcomes if not o.problem]
    if as_json:
        print_json(
            {
                "images": [o.document for o in read],
                "unreadable": [
                    {"file": str(o.path), "problem": o.problem} for o in outcomes if o.problem
                ],
                "sightings": None if table is None else {"file": str(table), "count": count},
                "left_out": left_out,
                "notes": [trust] if trust else [],
            }
        )
        return
    if len(read) <= 40:
        print_spots(read)
    if table is not None and count:
        noun = "sighting" if count == 1 else "sightings"
        print(f"{count} {noun} of {len(outcomes)} photographs: {table}")
    elif table is not None:
        print(f"no sighting in {len(outcomes)} photographs: {table} was not written")
    for line in left_out[:12]:
        print(f"left out: {line}")
    if len(left_out) > 12:
        reasons = Counter(line.split(": ", 1)[-1].split(":")[0] for line in left_out[12:])
        listed = ", ".join(f"{count} × {reason}" for reason, count in reasons.most_common())
        print(f"left out: {len(left_out) - 12} more ({listed}); all with --json")
    if trust:
        print(trust)
    drawn = [o.annotated for o in read if o.annotated is not None]
    if drawn:
        print(f"annotated pictures: {drawn[0] if len(drawn) == 1 else drawn[0].parent}")


def print_spots(outcomes: "Sequence[Outcome]") -> None:
    """Print the spots in photographs, target by target."""
    for outcome in outcomes:
        print(outcome.path.name)
        readings = outcome.document["targets"]
        for reading in readings:
            if not reading["found"]:
                # A camera observes few of a plant's targets, so absent targets matter only if all
                # are absent.
                if not any(r["found"] for r in readings):
                    print(f"  {reading['target']}: {reading['reasons'][0]['text']}")
                continue
            print(f"  {reading['target']}: {'good' if reading['good'] else 'not good'}")
            for reason in reading["reasons"]:
                print(f"    {reason['name']}: {reason['text']}")
            for k, spot in enumerate(reading["spots"], start=1):
                print(f"    spot {k}{_numbers(spot)}")
        for spot in outcome.document["beside_the_targets"]:
            print(f"  outside the targets\n    spot  {_numbers(spot)}")


def _numbers(spot: "dict[str, Any]") -> str:
    import numpy as np

    covariance = np.asarray(spot["covariance_right_up_m2"], dtype=np.float64)
    right, up = np.sqrt(np.diag(covariance))
    correlation = covariance[0, 1] / (right * up) if right * up > 0.0 else 0.0
    return (
        f"  E {spot['east_m']:.3f}  N {spot['north_m']:.3f}  U {spot['up_m']:.3f} m"
        f"   {spot['latitude_deg']:.8f}° {spot['longitude_deg']:.8f}° {spot['altitude_m']:.3f} m"
        f"   ± {1e3 * right:.0f} right, {1e3 * up:.0f} up mm, correlation {correlation:+.2f}"
    )


# -- live ------------------------------------------------------------------------------


def follow(
    source: "Source",
    job: "Job",
    *,
    burst: int = 1,
    archive: Path | None = None,
    memory: Path | None = None,
    as_json: bool = False,
) -> int:
    """Read every frame of a source and print the frame's spots; return the number of frames.

    Parameters
    ----------
    source
        Source of the frames.
    job
        Settings for evaluating the frames.
    burst
        Number of frames averaged into one.
    archive
        Folder for frames and their results.
    memory
        Folder of models of the empty targets. The models are used, are updated with every frame,
        and are saved for the next time.
    as_json
        Whether to print one JSON document per frame, each on its own line.
    """
    from heliotrope.errors import HeliotropeError
    from heliotrope.imaging.campaign import look
    from heliotrope.imaging.memory import Memory
    from heliotrope.imaging.sources import keep

    count = 0
    known = Memory() if memory is None else Memory.load(memory)
    with source, _kept(known, memory):
        views: tuple[object, ...] = ()
        for frame in _averaged(source, burst):
            count += 1
            place = Path(frame.name or f"frame-{count}")
            if memory is not None:
                job = replace(job, settings=replace(job.settings, empty=known.models))
            try:
                # The camera barely moves from one frame to the next.
                outcome = look(frame, place, job, previous=views)  # type: ignore[arg-type]
            except HeliotropeError as error:
                print(f"heliotrope: {error}", file=sys.stderr)
                continue
            views = outcome.views or views
            if memory is not None:
                known.learn(outcome.faces)
                if count % _OFTEN == 0:
                    known.save(memory)
            kept = keep(frame, dict(outcome.document), archive) if archive is not None else None
            _print_live(outcome, kept, as_json)
    for problem in getattr(source, "skipped", ()):
        print(f"heliotrope: {problem}", file=sys.stderr)
    return count


@contextmanager
def _kept(known: "Memory", folder: Path | None) -> "Iterator[None]":
    """Save the models at the end of a block, even after Ctrl-C."""
    try:
        yield
    finally:
        if folder is not None:
            known.save(folder)


def _averaged(source: "Source", burst: int) -> "Iterator[Frame]":
    from heliotrope.imaging.sources import average

    frames = iter(source)
    while together := list(islice(frames, burst)):
        yield together[0] if burst == 1 else average(together)


def _print_live(outcome: "Outcome", kept: Path | None, as_json: bool) -> None:
    from heliotrope.cli._common import plain

    if as_json:
        document = {**outcome.document, "kept": None if kept is None else str(kept)}
        print(json.dumps(plain(document), ensure_ascii=False), flush=True)
        return
    print_spots([outcome])
    if kept is not None:
        print(f"  kept: {kept}")
    sys.stdout.flush()
