"""Many photographs: read one by one or many at once, and turned into sightings."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from heliotrope.calibration.sightings import Sightings, camera_target
from heliotrope.errors import HeliotropeError, InputError, UnknownNameError
from heliotrope.field.camera import Camera
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, enu_to_geodetic
from heliotrope.imaging.annotate import annotate
from heliotrope.imaging.files import read_image, write_image
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.log import Entry, Log, beside
from heliotrope.imaging.photograph import (
    LookedAt,
    Photograph,
    PlacedSpot,
    Reading,
    Settings,
    read_crop,
    read_photograph,
)
from heliotrope.imaging.targets.view import View
from heliotrope.sun import Site, vector

if TYPE_CHECKING:
    from distributed import Client

Progress = Callable[[int, int], None]
Origin = tuple[float, float, float]

#: Below this number of photographs another process costs more than it gains.
FEWEST_FOR_PROCESSES = 8
#: The sun moves by at most this, rad/s.
_SUN_RATE = 7.292e-5
#: Air and mirror between the law and a spot: deviation of a beam, rad. What cannot be seen
#: in one photograph; repeated sightings show how large it is.
BEAM_SIGMA = 1e-4


@dataclass(frozen=True)
class Job:
    """How the photographs of a campaign are read.

    Attributes
    ----------
    targets
        That may be seen.
    origin
        Latitude, longitude (degrees) and height (m) of ENU's origin.
    camera
        What is known of the camera.
    settings
        How to read.
    crop
        Each picture shows exactly one target: that of its log entry, or this one.
    target
        Whose reading counts where the log names none; "" takes any that is good.
    annotated
        Folder for annotated pictures; None for none.
    without
        The camera's frame without beams.
    """

    targets: tuple[Target, ...]
    origin: Origin
    camera: Camera | None = None
    settings: Settings = field(default_factory=Settings)
    crop: bool = False
    target: str = ""
    annotated: Path | None = None
    without: Frame | None = None


@dataclass(frozen=True)
class Outcome:
    """What became of one photograph.

    Attributes
    ----------
    path
        The file.
    document
        All that was found, ready for JSON; empty if it could not be read.
    problem
        Why it could not be read; "" if it could.
    point, covariance
        Of the spot that counts, ENU, (3,) and (3, 3); None if none may be believed.
    target
        On which it is.
    refusal
        Why none may be believed.
    time, time_deviation
        Of the photograph.
    annotated
        The annotated picture, if one was written.
    views
        How the faces lie in the frame, for the next one.
    faces
        What was seen on each face: the models of the empty targets learn from it.
    """

    path: Path
    document: Mapping[str, Any] = field(default_factory=dict)
    problem: str = ""
    point: FloatArray | None = None
    covariance: FloatArray | None = None
    target: str = ""
    refusal: str = ""
    time: datetime | None = None
    time_deviation: float = float("nan")
    annotated: Path | None = None
    views: tuple[View, ...] = ()
    faces: tuple[LookedAt, ...] = ()


def process(path: Path, job: Job, entry: Entry | None = None) -> Outcome:
    """Return what one file shows; what is wrong with it is said, not raised.

    Parameters
    ----------
    path
        An image.
    job
        How to read it.
    entry
        What is known of it: its target above all.
    """
    try:
        frame = read_image(path)
        if entry is not None and entry.empty is not None:
            job = replace(job, without=read_image(entry.empty))
        return replace(look(frame, path, job, entry), views=(), faces=())
    except HeliotropeError as error:
        return Outcome(path, problem=str(error))


def look(
    frame: Frame,
    path: Path,
    job: Job,
    entry: Entry | None = None,
    previous: Sequence[View] = (),
) -> Outcome:
    """Return what a frame shows.

    Parameters
    ----------
    frame, path
        The photograph and what to call it.
    job
        How to read it.
    entry
        What is known of it.
    previous
        Views of an earlier frame of the same camera.

    Raises
    ------
    InputError
        If its target is not known where it must be, or the annotated picture cannot be
        written.
    """
    name = entry.target if entry is not None and entry.target else job.target
    if job.crop:
        photograph = read_crop(frame, _target(job, name, path), job.settings)
    else:
        if name:
            _target(job, name, path)
        photograph = read_photograph(
            frame,
            job.targets,
            job.camera,
            settings=job.settings,
            previous=previous,
            without=job.without,
        )
    reading, refusal = meant(photograph, name)
    drawn = None
    if job.annotated is not None:
        drawn = job.annotated / f"{path.stem}-seen.png"
        write_image(annotate(photograph), drawn)
    spot = reading.spots[0] if reading is not None and reading.good else None
    return Outcome(
        path=path,
        document=document(photograph, job.origin, drawn),
        point=None if spot is None else spot.point,
        covariance=None if spot is None else spot.covariance_enu,
        target="" if reading is None else reading.found.target.name,
        refusal=refusal,
        time=frame.time,
        time_deviation=frame.time_deviation,
        annotated=drawn,
        views=photograph.views,
        faces=photograph.faces,
    )


def _target(job: Job, name: str, path: Path) -> Target:
    if not name:
        known = ", ".join(t.name for t in job.targets)
        raise InputError(
            f"{path}: a crop shows one target, but which? Give --target (one of {known}) or a log"
        )
    for target in job.targets:
        if target.name == name:
            return target
    raise UnknownNameError("target", name, [t.name for t in job.targets])


def meant(photograph: Photograph, target: str) -> tuple[Reading | None, str]:
    """Return the reading that counts and why it may not be believed, "" if it may.

    Parameters
    ----------
    photograph
        What was seen.
    target
        The target that the beam was sent to; "" if nobody knows: then there must be just
        one with a spot.
    """
    if target:
        reading = photograph.reading(target)
        return reading, _why(reading)
    lit = [r for r in photograph.readings if r.spots]
    if len(lit) > 1:
        names = ", ".join(r.found.target.name for r in lit)
        return None, f"several targets have spots ({names}), and nobody says which is meant"
    if lit:
        return lit[0], _why(lit[0])
    found = [r for r in photograph.readings if r.found.found]
    if found:
        return found[0], _why(found[0])
    texts = {r.found.reason for r in photograph.readings}
    return None, "no target was found: " + "; ".join(sorted(texts))


def _why(reading: Reading) -> str:
    return "; ".join(f"{r.name}: {r.text}" for r in reading.reasons)


def document(photograph: Photograph, origin: Origin, annotated: Path | None) -> dict[str, Any]:
    """Return all that was found in a photograph, ready for JSON; units stand in the names."""
    frame = photograph.frame
    return {
        "file": frame.name,
        "time": None if frame.time is None else frame.time.isoformat(),
        "size_px": list(frame.size),
        "targets": [_reading(r, origin) for r in photograph.readings],
        "beside_the_targets": [_spot(s, origin) for s in photograph.beside],
        "annotated": None if annotated is None else str(annotated),
    }


def _reading(reading: Reading, origin: Origin) -> dict[str, Any]:
    found = reading.found
    entry: dict[str, Any] = {
        "target": found.target.name,
        "found": found.found,
        "good": reading.good,
        "reasons": [
            {"name": r.name, "value": r.value, "limit": r.limit, "text": r.text}
            for r in reading.reasons
        ],
        "spots": [_spot(s, origin) for s in reading.spots],
        "marks": [
            {"name": m.mark.name, "pixel": m.pixel.tolist(), "used": m.used, "reason": m.reason}
            for m in found.marks
        ],
    }
    if found.view is not None:
        entry["marks_residual_px"] = found.view.residual
    return entry


def _spot(placed: PlacedSpot, origin: Origin) -> dict[str, Any]:
    latitude, longitude, altitude = enu_to_geodetic(placed.point, origin)
    spot = placed.spot
    major, minor, angle = spot.axes
    return {
        "east_m": float(placed.point[0]),
        "north_m": float(placed.point[1]),
        "up_m": float(placed.point[2]),
        "latitude_deg": float(latitude),
        "longitude_deg": float(longitude),
        "altitude_m": float(altitude),
        "right_of_centre_m": float(placed.plane[0]),
        "above_centre_m": float(placed.plane[1]),
        "covariance_right_up_m2": placed.covariance.tolist(),
        "covariance_enu_m2": placed.covariance_enu.tolist(),
        "pixel": placed.pixel.tolist(),
        "sigma_major_m": major,
        "sigma_minor_m": minor,
        "angle_deg": float(np.degrees(angle)),
        "area_m2": spot.area,
        "power_m2": spot.power,
        "peak": spot.peak,
        "contrast": spot.contrast,
        "clipped": spot.clipped,
        "edge": spot.edge,
    }


def process_many(
    paths: Sequence[Path],
    job: Job,
    entries: Sequence[Entry | None],
    *,
    processes: int = 1,
    client: "Client | None" = None,
    progress: Progress | None = None,
) -> list[Outcome]:
    """Return what many files show, in their order.

    Parameters
    ----------
    paths, entries
        Files, and what is known of each.
    job
        How to read them.
    processes
        On this machine; a few photographs are read in this process whatever it is.
    client
        Of a dask scheduler, which takes them instead.
    progress
        Is told how many are done, of how many.
    """
    tasks = list(zip(paths, entries, strict=True))
    found: list[Outcome | None] = [None] * len(tasks)
    for done, (k, outcome) in enumerate(_outcomes(tasks, job, processes, client), start=1):
        found[k] = outcome
        if progress is not None:
            progress(done, len(tasks))
    return [outcome for outcome in found if outcome is not None]


def _outcomes(
    tasks: Sequence[tuple[Path, Entry | None]], job: Job, processes: int, client: "Client | None"
) -> Iterator[tuple[int, Outcome]]:
    """Give the number of each task and its outcome as they are done."""
    if client is not None:
        yield from _on_cluster(tasks, job, client)
    elif processes > 1 and len(tasks) >= FEWEST_FOR_PROCESSES:
        # A forked child would inherit the locks of this one's threads.
        with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
            futures = {pool.submit(process, path, job, e): k for k, (path, e) in enumerate(tasks)}
            try:
                for future in as_completed(futures):
                    yield futures[future], future.result()
            finally:
                pool.shutdown(cancel_futures=True)
    else:
        for k, (path, entry) in enumerate(tasks):
            yield k, process(path, job, entry)


def _on_cluster(
    tasks: Sequence[tuple[Path, Entry | None]], job: Job, client: "Client"
) -> Iterator[tuple[int, Outcome]]:
    from distributed import as_completed as completed

    # The job holds the targets and may hold an empty frame: it travels once.
    shared = client.scatter(job, broadcast=True)  # type: ignore[no-untyped-call]
    futures = {
        client.submit(process, path.resolve(), shared, entry, pure=False): k
        for k, (path, entry) in enumerate(tasks)
    }
    for future in completed(list(futures)):  # type: ignore[no-untyped-call]
        yield futures[future], future.result()


def known_of(paths: Sequence[Path], log: Log | None, heliostat: str = "") -> list[Entry | None]:
    """Return what the log or the files beside say of each photograph.

    Parameters
    ----------
    paths
        Photographs.
    log
        Goes first.
    heliostat
        Whose beams they show, where nothing else says it.

    Raises
    ------
    FormatError
        If a file beside cannot be read.
    """
    found: list[Entry | None] = []
    for path in paths:
        entry = None if log is None else log.find(path)
        if entry is None:
            entry = beside(path, heliostat)
        found.append(entry)
    return found


def to_sightings(
    outcomes: Sequence[Outcome],
    entries: Sequence[Entry | None],
    names: Sequence[str],
    site: Site,
    sigma: float = BEAM_SIGMA,
) -> tuple[Sightings | None, list[str]]:
    """Return the sightings of photographs, and a line for each that gives none.

    Parameters
    ----------
    outcomes, entries
        Of :func:`process_many` and :func:`known_of`.
    names
        Of the heliostats, in the plant's order.
    site
        For the sun, where the log does not give it.
    sigma
        Standard deviation of a beam beside that of its centroid, rad.

    Returns
    -------
    None in place of the sightings if there is none.
    """
    rows: list[tuple[int, FloatArray, FloatArray, Outcome, float, float]] = []
    left_out: list[str] = []
    index = {name: k for k, name in enumerate(names)}
    for outcome, entry in zip(outcomes, entries, strict=True):
        problem = _unusable(outcome, entry, index)
        sun, seconds, spread = None, float("nan"), 0.0
        if not problem and entry is not None:
            sun, seconds, spread, problem = _sun(outcome, entry, site)
        if problem or entry is None or entry.counts is None or sun is None:
            left_out.append(f"{outcome.path.name}: {problem}")
            continue
        rows.append((index[entry.heliostat], entry.counts, sun, outcome, seconds, spread))
    if not rows:
        return None, left_out
    seen = camera_target(
        np.array([r[0] for r in rows]),
        np.array([r[1] for r in rows]),
        np.array([r[2] for r in rows]),
        np.array([r[3].point for r in rows]),
        time=np.array([r[4] for r in rows]),
        sigma=sigma,
        sun_covariance=np.array([r[5] for r in rows]),
        centroid_covariance=np.array([r[3].covariance for r in rows]),
    )
    return seen, left_out


def _unusable(outcome: Outcome, entry: Entry | None, index: Mapping[str, int]) -> str:
    if outcome.problem:
        return outcome.problem.removeprefix(f"{outcome.path}: ")
    if entry is None:
        return "nothing is known of it: no row of the log, no file beside"
    if outcome.point is None:
        return outcome.refusal
    if not entry.heliostat:
        return "nobody says whose beam it shows; give --heliostat or a log"
    if entry.heliostat not in index:
        return f"the plant has no heliostat {entry.heliostat}"
    if entry.counts is None:
        return "the motor counts are missing"
    return ""


def _sun(outcome: Outcome, entry: Entry, site: Site) -> tuple[FloatArray | None, float, float, str]:
    """Direction, Unix seconds, variance (rad²) of the sun, and what is wrong."""
    time = entry.time or outcome.time
    seconds = float("nan") if time is None else time.astimezone(UTC).timestamp()
    if entry.sun is not None:
        return entry.sun, seconds, 0.0, ""
    if time is None:
        return None, seconds, 0.0, "neither its time nor the sun's angles are known"
    with suppress(HeliotropeError):
        deviation = outcome.time_deviation if entry.time is None else 0.0
        spread = (_SUN_RATE * deviation) ** 2 if np.isfinite(deviation) else 0.0
        return vector(time, site), seconds, spread, ""
    return None, seconds, 0.0, f"the sun at {time.isoformat()} cannot be computed"
