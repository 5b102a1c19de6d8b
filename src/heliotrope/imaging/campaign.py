"""Evaluate many photographs, in parallel or one by one, and turn them into sightings."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.plausibility import judge
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
    PhotographSettings,
    TargetReading,
    read_crop,
    read_photograph,
)
from heliotrope.imaging.spots.placed import PlacedSpot
from heliotrope.imaging.targets.finding import without_orientation
from heliotrope.imaging.targets.view import FaceView
from heliotrope.mechanism.chain import Mechanism
from heliotrope.processes import pool
from heliotrope.sun import Site, Times, vector

if TYPE_CHECKING:
    from distributed import Client

Progress = Callable[[int, int], None]
Origin = tuple[float, float, float]

#: With fewer photographs per process, another process costs more time than it saves.
FEWEST_FOR_PROCESSES = 8
#: Maximum angular speed of the sun, rad/s.
_SUN_RATE = 7.292e-5
#: Standard deviation of a beam due to atmosphere and heliostat, rad. A single photograph cannot
#: reveal it, but repeated sightings do.
BEAM_SIGMA = 1e-4


@dataclass(frozen=True)
class Job:
    """How the photographs of a campaign are evaluated.

    Attributes
    ----------
    targets
        Targets that may be in view.
    origin
        Latitude, longitude (degrees) and height (m) of the ENU origin.
    camera
        The camera, as far as it is known.
    settings
        Evaluation settings.
    crop
        Whether each picture shows exactly one target, which is that of its log entry or ``target``.
    target
        Target whose reading is used if the log names no target; "" accepts any valid reading.
    annotated
        Folder for annotated pictures; None for no such pictures.
    without
        A frame from the camera without beams.
    """

    targets: tuple[Target, ...]
    origin: Origin
    camera: Camera | None = None
    settings: PhotographSettings = field(default_factory=PhotographSettings)
    crop: bool = False
    target: str = ""
    annotated: Path | None = None
    without: Frame | None = None

    @property
    def trust(self) -> str:
        """One-line warning if frames cannot show whether they are mirrored; otherwise empty."""
        if self.crop:
            cause = "a crop shows one target without its surroundings"
        elif self.camera is not None and self.camera.position is not None:
            return ""
        elif names := without_orientation(self.targets):
            cause = f"the marks of {', '.join(names)} look the same turned or mirrored, and no pose"
            cause += " of the camera is known"
        else:
            return ""
        return (
            f"the orientation of the frames cannot be checked: {cause}; a mark that differs from "
            "the others, or the camera's pose in the plant file, would reveal a mirrored frame"
        )


@dataclass(frozen=True)
class Outcome:
    """The result of one photograph.

    Attributes
    ----------
    path
        The file.
    document
        Everything found, as a JSON object; empty if the file could not be read.
    problem
        Why the file could not be read; an empty string if it was read.
    point, covariance
        Position of the accepted spot, and its covariance, ENU, (3,) and (3, 3); None if no spot can
        be trusted.
    target
        Target of the accepted spot.
    refusal
        Why no spot can be trusted.
    time, time_deviation
        Time of the photograph, and its standard deviation, s.
    annotated
        The annotated picture, if one was written.
    views
        How the faces lie in the frame, as a starting point for the next frame.
    faces
        The faces found, from which models of empty targets are updated.
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
    views: tuple[FaceView, ...] = ()
    faces: tuple[LookedAt, ...] = ()


def process(path: Path, job: Job, entry: Entry | None = None) -> Outcome:
    """Evaluate one file. A problem with the file is returned rather than raised.

    Parameters
    ----------
    path
        An image.
    job
        How to evaluate it.
    entry
        Log entry of the photograph, in particular its target.
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
    previous: Sequence[FaceView] = (),
) -> Outcome:
    """Evaluate one frame.

    Parameters
    ----------
    frame, path
        The photograph and its name.
    job
        How to evaluate it.
    entry
        Log entry of the photograph.
    previous
        Views from an earlier frame by the same camera.

    Raises
    ------
    InputError
        If the target is needed but unknown, if two targets are named, or if the annotated picture
        cannot be written.
    """
    recorded = "" if entry is None else entry.target
    if recorded and job.target and recorded != job.target:
        raise InputError(
            f"{path}: its record names target {recorded}, and --target {job.target}; specify only "
            "the correct one"
        )
    name = recorded or job.target
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
            f"{path}: a crop shows one target; name it by --target (one of {known}) or a log"
        )
    for target in job.targets:
        if target.name == name:
            return target
    raise UnknownNameError("target", name, [t.name for t in job.targets])


def meant(photograph: Photograph, target: str) -> tuple[TargetReading | None, str]:
    """Return the reading to use, and the reasons not to trust it (empty if it is good).

    Parameters
    ----------
    photograph
        The photograph, already read.
    target
        Target to which the beam was sent; if empty, exactly one target must have a spot.
    """
    if target:
        reading = photograph.reading(target)
        return reading, _why(reading)
    with_spots = [r for r in photograph.readings if r.spots]
    if len(with_spots) > 1:
        names = ", ".join(r.found.target.name for r in with_spots)
        return (
            None,
            f"several targets have spots ({names}) and none is specified as the intended one",
        )
    if with_spots:
        return with_spots[0], _why(with_spots[0])
    present = [r for r in photograph.readings if r.found.found]
    if present:
        return present[0], _why(present[0])
    texts = {r.found.reason for r in photograph.readings}
    return None, "no target was found: " + "; ".join(sorted(texts))


def _why(reading: TargetReading) -> str:
    return "; ".join(f"{r.name}: {r.text}" for r in reading.reasons)


def document(photograph: Photograph, origin: Origin, annotated: Path | None) -> dict[str, Any]:
    """Return everything found in a photograph as a JSON object, with units in the names."""
    frame = photograph.frame
    return {
        "file": frame.name,
        "time": None if frame.time is None else frame.time.isoformat(),
        "size_px": list(frame.size),
        "targets": [_reading(r, origin) for r in photograph.readings],
        "beside_the_targets": [_spot(s, origin) for s in photograph.beside],
        "annotated": None if annotated is None else str(annotated),
    }


def _reading(reading: TargetReading, origin: Origin) -> dict[str, Any]:
    result = reading.found
    entry: dict[str, Any] = {
        "target": result.target.name,
        "found": result.found,
        "good": reading.good,
        "reasons": [
            {"name": r.name, "value": r.value, "limit": r.limit, "text": r.text}
            for r in reading.reasons
        ],
        "spots": [_spot(s, origin) for s in reading.spots],
        "marks": [
            {"name": m.mark.name, "pixel": m.pixel.tolist(), "used": m.used, "reason": m.reason}
            for m in result.marks
        ],
    }
    if result.view is not None:
        entry["marks_residual_px"] = result.view.residual
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
    """Evaluate many files, and return their results in the same order.

    Parameters
    ----------
    paths, entries
        Files, and their entries in the log.
    job
        How to evaluate them.
    processes
        Number of processes on this computer; a few photographs are always evaluated in this
        process.
    client
        Client of a dask scheduler, used instead of local processes.
    progress
        Called with the numbers of photographs (done, total).
    """
    tasks = list(zip(paths, entries, strict=True))
    outcomes: list[Outcome | None] = [None] * len(tasks)
    for done, (k, outcome) in enumerate(_outcomes(tasks, job, processes, client), start=1):
        outcomes[k] = outcome
        if progress is not None:
            progress(done, len(tasks))
    return [outcome for outcome in outcomes if outcome is not None]


def _outcomes(
    tasks: Sequence[tuple[Path, Entry | None]], job: Job, processes: int, client: "Client | None"
) -> Iterator[tuple[int, Outcome]]:
    """Yield the index and the outcome of each task as it finishes."""
    if client is not None:
        yield from _on_cluster(tasks, job, client)
    elif processes > 1 and len(tasks) >= FEWEST_FOR_PROCESSES:
        with pool(processes) as workers:
            futures = {
                workers.submit(process, path, job, e): k for k, (path, e) in enumerate(tasks)
            }
            try:
                for future in as_completed(futures):
                    yield futures[future], future.result()
            finally:
                workers.shutdown(cancel_futures=True)
    else:
        for k, (path, entry) in enumerate(tasks):
            yield k, process(path, job, entry)


def _on_cluster(
    tasks: Sequence[tuple[Path, Entry | None]], job: Job, client: "Client"
) -> Iterator[tuple[int, Outcome]]:
    from distributed import as_completed as completed

    # The job may contain an empty frame, so send it only once.
    shared = client.scatter(job, broadcast=True)  # type: ignore[no-untyped-call]
    futures = {
        client.submit(process, path.resolve(), shared, entry, pure=False): k
        for k, (path, entry) in enumerate(tasks)
    }
    for future in completed(list(futures)):  # type: ignore[no-untyped-call]
        yield futures[future], future.result()


def entries_of(paths: Sequence[Path], log: Log | None, heliostat: str = "") -> list[Entry | None]:
    """Return the entry of each photograph, from the log or from a file beside it.

    Parameters
    ----------
    paths
        Photographs.
    log
        The log, which is searched first.
    heliostat
        Heliostat whose beams the photographs show, if no entry specifies the heliostat.

    Raises
    ------
    FormatError
        If a file beside a photograph cannot be read.
    """
    entries: list[Entry | None] = []
    for path in paths:
        entry = None if log is None else log.find(path)
        if entry is None:
            entry = beside(path, heliostat)
        entries.append(entry)
    return entries


def to_sightings(
    outcomes: Sequence[Outcome],
    entries: Sequence[Entry | None],
    names: Sequence[str],
    site: Site,
    sigma: float = BEAM_SIGMA,
    *,
    mechanism: Mechanism | None = None,
    now: float | None = None,
) -> tuple[Sightings | None, list[str]]:
    """Return the plausible sightings from photographs, and a message for each photograph left out.

    Parameters
    ----------
    outcomes, entries
        Results of `process_many` and `entries_of`.
    names
        Names of the heliostats, in the plant's order.
    site
        Site, used to compute the sun's direction where the log does not specify it.
    sigma
        Standard deviation of a beam excluding that of its centroid, rad.
    mechanism, now
        Mechanisms of the named heliostats, and the time by the computer's clock, used to detect
        impossible sightings; see `heliotrope.calibration.plausibility.judge`.

    Returns
    -------
    The sightings, which are None if no photograph yields a sighting, and the messages.
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
    sightings = camera_target(
        np.array([r[0] for r in rows]),
        np.array([r[1] for r in rows]),
        np.array([r[2] for r in rows]),
        np.array([r[3].point for r in rows]),
        time=np.array([r[4] for r in rows]),
        sigma=sigma,
        sun_covariance=np.array([r[5] for r in rows]),
        centroid_covariance=np.array([r[3].covariance for r in rows]),
    )
    judged = judge(sightings, mechanism=mechanism, site=site, now=now)
    left_out += [f"{rows[k][3].path.name}: {text}" for k, text in sorted(judged.reasons.items())]
    left_out += judged.notes
    kept = np.flatnonzero(~np.isin(np.arange(len(sightings)), list(judged.reasons)))
    return sightings.take(kept) if len(kept) else None, left_out


def sighting_of(
    photograph: Photograph,
    heliostat: str,
    counts: npt.ArrayLike,
    site: Site,
    *,
    target: str = "",
    time: Times | None = None,
    sun: npt.ArrayLike | None = None,
    sigma: float = BEAM_SIGMA,
) -> Sightings:
    """Return the sighting from one photograph, with its time and the sun vector at that time.

    Parameters
    ----------
    photograph
        A photograph that has been evaluated.
    heliostat, counts
        Name of the heliostat that sends the beam, and its motor counts, (D,).
    site
        Site, for the sun's direction.
    target
        Target to which the beam was sent; may be empty if exactly one target has a spot.
    time
        See `heliotrope.sun.Times`; by default the time of the frame.
    sun
        Direction to the apparent sun, ENU, (3,); default: computed for the time of the frame.
    sigma
        Standard deviation of a beam excluding that of its centroid, rad.

    Raises
    ------
    InputError
        If no spot can be trusted, or neither the time nor the sun vector is known.
    """
    frame = photograph.frame
    name = frame.name or "photograph"
    reading, refusal = meant(photograph, target)
    if reading is None or not reading.good:
        raise InputError(f"{name}: {refusal}; a sighting needs a reliable spot")
    moment = frame.time if time is None else time
    spread = 0.0
    if sun is None:
        if moment is None:
            raise InputError(f"{name}: its time is unknown; pass time=, or the sun's direction")
        if time is None and np.isfinite(frame.time_deviation):
            spread = (_SUN_RATE * frame.time_deviation) ** 2
        sun = vector(moment, site)
    spot = reading.spots[0]
    return camera_target(
        heliostat,
        counts,
        sun,
        spot.point,
        time=np.nan if moment is None else moment,
        sigma=sigma,
        sun_covariance=spread,
        centroid_covariance=spot.covariance_enu,
    )


def _unusable(outcome: Outcome, entry: Entry | None, index: Mapping[str, int]) -> str:
    if outcome.problem:
        return outcome.problem.removeprefix(f"{outcome.path}: ")
    if entry is None:
        return "no metadata: there is no row in the log and no file beside it"
    if outcome.point is None:
        return outcome.refusal
    if not entry.heliostat:
        return "its heliostat is unknown; specify --heliostat or a log"
    if entry.heliostat not in index:
        return f"the plant has no heliostat {entry.heliostat}"
    if entry.counts is None:
        return "the motor counts are missing"
    return ""


def _sun(outcome: Outcome, entry: Entry, site: Site) -> tuple[FloatArray | None, float, float, str]:
    """Return the sun's direction, the Unix time, s, the variance, rad², and any problem."""
    time = entry.time or outcome.time
    seconds = float("nan") if time is None else time.astimezone(UTC).timestamp()
    if entry.sun is not None:
        return entry.sun, seconds, 0.0, ""
    if time is None:
        return None, seconds, 0.0, "neither its time nor the sun angles are known"
    with suppress(HeliotropeError):
        deviation = outcome.time_deviation if entry.time is None else 0.0
        spread = (_SUN_RATE * deviation) ** 2 if np.isfinite(deviation) else 0.0
        return vector(time, site), seconds, spread, ""
    return None, seconds, 0.0, f"the sun at {time.isoformat()} cannot be computed"
