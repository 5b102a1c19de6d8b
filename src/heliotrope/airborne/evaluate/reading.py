"""Read photographs: which mirrors each shows, their corners, and the lamp spots on them.

Results are undistorted image coordinates, X/Z and Y/Z in camera axes, so that later steps do not
need the image. A photograph that cannot be used is reported with the reason; no exception is
raised.
"""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.evaluate.detection import (
    Outlines,
    Overlap,
    Picture,
    decode,
    find_outlines,
    find_patches,
    find_spots,
)
from heliotrope.airborne.evaluate.identification import (
    FEWEST,
    Identified,
    expected_size,
    find_lights,
    identify,
    is_dark,
    nearest_rotation,
    quad_area,
)
from heliotrope.airborne.evaluate.projection import outlines, overlay
from heliotrope.airborne.photo import LedCamera, Photo
from heliotrope.airborne.standing import MirrorPoses
from heliotrope.airborne.visibility import SMALLEST, draw_labels, seen_from
from heliotrope.errors import HeliotropeError, InputError
from heliotrope.field.camera import undistort
from heliotrope.files.archives import read_arrays
from heliotrope.geometry import FloatArray
from heliotrope.processes import pool

if TYPE_CHECKING:
    from distributed import Client

Progress = Callable[[int, int], None]
Rows = npt.NDArray[np.intp]

#: Corner error due to texture beside the mirror, in addition to that of the edges, px.
CORNER_FLOOR = 0.07
#: Corners this far from a common shift of the outline belong to another edge; px, and fraction of
#: the mirror's side.
_SKEW, _SKEW_SHARE = 1.5, 0.03
#: Largest distance of edges from the mirror edges of an overlaid drawing, px.
_OVERLAID = 3.0
#: The same distance if a user has identified mirrors: fraction of a mirror's side, and limits, px.
_BY_HAND, _BY_HAND_PX = 0.15, (3.0, 12.0)
#: Problems that a user can solve by identifying mirrors, and how to do so.
_NAMEABLE = ("nothing", "wrong_field", "ambiguous")
BY_HAND = "name mirrors in it by hand (heliotrope drone match, then drone evaluate --matches)"
#: With fewer photographs, starting processes costs more time than it saves.
FEWEST_FOR_PROCESSES = 4


def _empty(*shape: int) -> FloatArray:
    return np.empty((0, *shape))


def _no_rows() -> Rows:
    return np.empty(0, dtype=np.intp)


@dataclass(frozen=True)
class PhotoReading:
    """What one photograph shows: M mirrors and S spots.

    Attributes
    ----------
    name
        Name of the photograph.
    problem
        Why the photograph cannot be used; an empty string if it can. The text begins with a
        keyword: nothing, wrong_field, ambiguous, overexposed, small, unreadable.
    rotation
        Rotation from camera axes to ENU, estimated from the mirrors alone, (3, 3).
    mirror
        Indices of the visible mirrors, (M,).
    corners
        Undistorted corner coordinates in the order of the outline, NaN if not found, (M, 4, 2).
    corner_sigma
        Standard deviation of a corner per direction, (M,).
    spot_mirror
        Mirror index of each spot, (S,).
    spot, spot_sigma
        Undistorted coordinates of each spot, (S, 2), and their standard deviation per direction,
        (S,).
    flux
        Flux of each spot, full scale times pixels, (S,).
    clipped
        Number of clipped pixels of each spot, (S,).
    notes
        For each mirror, why it yields no spot or no outline; an empty string if it yields both,
        (M,).
    """

    name: str
    problem: str = ""
    rotation: FloatArray = field(default_factory=lambda: np.eye(3))
    mirror: Rows = field(default_factory=_no_rows)
    corners: FloatArray = field(default_factory=lambda: _empty(4, 2))
    corner_sigma: FloatArray = field(default_factory=_empty)
    spot_mirror: Rows = field(default_factory=_no_rows)
    spot: FloatArray = field(default_factory=lambda: _empty(2))
    spot_sigma: FloatArray = field(default_factory=_empty)
    flux: FloatArray = field(default_factory=_empty)
    clipped: Rows = field(default_factory=_no_rows)
    notes: tuple[str, ...] = ()

    @property
    def has_corners(self) -> bool:
        """Whether the photograph shows a corner of a mirror."""
        return not self.problem and bool(np.isfinite(self.corners).any())

    @property
    def has_lights(self) -> bool:
        """Whether the photograph shows the lamp."""
        return not self.problem and len(self.spot) > 0

    @property
    def nameable(self) -> bool:
        """Whether the photograph may show mirrors that only a user could identify."""
        return self.problem.startswith(_NAMEABLE)

    def why_unused(self) -> str:
        """Return the reason why the corners cannot be used; an empty string if they can."""
        if self.has_corners:
            return ""
        if self.nameable:
            return f"{self.name}: {self.problem}; or {BY_HAND}"
        return f"{self.name}: {self.problem or 'outline: no mirror edges could be measured'}"

    def save(self, path: Path) -> None:
        """Write the reading as ``.npz``, completely or not at all."""
        from heliotrope.files.text import write_file

        values = {f.name: np.asarray(getattr(self, f.name)) for f in fields(self)}
        write_file(path, lambda stream: np.savez_compressed(stream, allow_pickle=False, **values))

    @classmethod
    def load(cls, path: Path) -> "PhotoReading":
        """Return a reading from a file written by `save`."""
        values: dict[str, Any] = dict(
            read_arrays(path, "a stored reading", [f.name for f in fields(cls)])
        )
        return cls(
            **{
                **values,
                "name": str(values["name"]),
                "problem": str(values["problem"]),
                "notes": tuple(str(n) for n in values["notes"]),
            }
        )


# -- one photograph --------------------------------------------------------------------


def read_photo(photo: Photo, camera: LedCamera, stand: MirrorPoses) -> PhotoReading:
    """Return the reading of a photograph file.

    Parameters
    ----------
    photo
        The photograph as recorded by the drone, with its path.
    camera
        Lens.
    stand
        All mirrors in their expected poses.
    """
    if photo.path is None:
        return PhotoReading(photo.name, "unreadable: no such file")
    try:
        picture = decode(photo.path)
    except HeliotropeError as error:
        return PhotoReading(photo.name, f"unreadable: {error}")
    height, width = picture.shape[:2]
    if (width, height) != camera.size:
        return PhotoReading(
            photo.name,
            f"unreadable: {width} × {height} px, but the camera file says {camera.size[0]} × "
            f"{camera.size[1]} px; use the file of this camera",
        )
    return look(picture, photo, camera, stand)


def look(picture: Picture, photo: Photo, camera: LedCamera, stand: MirrorPoses) -> PhotoReading:
    """Return the reading of a decoded picture; see `read_photo`."""
    side, near = expected_size(camera, photo, stand)
    if not near.any():
        return PhotoReading(photo.name, "wrong_field: no mirror of the field can be in view")
    typical = float(np.median(side[near]))
    if typical < SMALLEST:
        return PhotoReading(
            photo.name,
            f"small: mirrors are {typical:.0f} px across, less than {SMALLEST:.0f}; "
            "fly closer or use a longer lens",
        )
    clipped = float((picture[::8, ::8] >= 254).all(axis=2).mean())
    if clipped > 0.5:
        return PhotoReading(
            photo.name,
            (
                f"overexposed: {100 * clipped:.0f} % of the photograph is clipped; shorten the "
                "exposure"
            ),
        )
    if photo.by_hand:
        if is_dark(picture):
            return _lights(picture, photo, camera, stand)
        wide = float(np.clip(_BY_HAND * typical, *_BY_HAND_PX))
        return _look_along(picture, photo, camera, stand, (wide, _OVERLAID, 2.0))
    if seen_from(stand, photo.position, camera.focal).overlapping:
        return _look_overlapping(picture, photo, camera, stand)
    identified = Identified(photo.rotation, _no_rows(), _no_rows(), "nothing: no patches")
    for patches in find_patches(picture, typical**2):
        attempt = identify(camera, photo, stand, patches.center)
        # Report the attempt that got farthest, because any reason other than "nothing" says more.
        if not attempt.reason or identified.reason.startswith("nothing"):
            identified = attempt
        if not identified.reason:
            break
    if identified.reason:
        if is_dark(picture):
            return _lights(picture, photo, camera, stand)
        if identified.shifted:
            return PhotoReading(photo.name, identified.reason)
        # Clouds in mirrors, or a few mirrors that touch, spoil patches but not the field as a
        # whole.
        laid = _look_overlapping(picture, photo, camera, stand)
        return PhotoReading(photo.name, identified.reason) if laid.problem else laid
    turned = photo.moved(photo.position, identified.rotation)
    rows, expected = _in_frame(turned, camera, stand)
    if not len(rows):
        return _nothing_in_frame(photo)
    reach = float(np.clip(0.12 * np.median(np.sqrt(quad_area(expected))), 2.0, 6.0))
    first = find_outlines(picture, expected, reach, profiles=16)
    better = np.where(first.found[:, None, None], first.corners, expected)
    lines = find_outlines(picture, better, 2.0)
    lines = replace(lines, known=np.repeat(lines.found[:, None], 4, axis=1))
    return _measure(picture, turned, camera, stand, rows, expected, lines)


def _look_overlapping(
    picture: Picture, photo: Photo, camera: LedCamera, stand: MirrorPoses
) -> PhotoReading:
    """Return the reading of a picture in which mirrors partly hide each other."""
    if is_dark(picture):
        return _lights(picture, photo, camera, stand)
    identified = overlay(picture, camera, photo, stand)
    if identified.reason:
        return PhotoReading(photo.name, identified.reason)
    turned = photo.moved(photo.position, identified.rotation)
    return _look_along(picture, turned, camera, stand, (_OVERLAID, 2.0))


def _look_along(
    picture: Picture,
    photo: Photo,
    camera: LedCamera,
    stand: MirrorPoses,
    reaches: Sequence[float],
) -> PhotoReading:
    """Read a picture whose attitude is accurate to the first of ``reaches``, px."""
    turned = photo
    # Edges against the ground correct the attitude, and are then measured at their new positions.
    for reach in reaches:
        rows, expected = _in_frame(turned, camera, stand)
        if not len(rows):
            return _nothing_in_frame(photo)
        shown = Overlap(draw_labels(*outlines(turned, camera, stand), camera.size), rows + 1)
        lines = find_outlines(picture, expected, reach, shown=shown)
        good = _consistent(lines, expected)
        if int(good.sum()) < FEWEST:
            return PhotoReading(
                photo.name,
                f"nothing: {int(good.sum())} mirror corners are clear of other mirrors; {FEWEST} "
                "are needed: fly higher",
            )
        corners = np.full(lines.corners.shape, np.nan)
        corners[good] = undistort(camera, lines.corners[good])
        turned = turned.moved(
            photo.position, _attitude(turned.rotation, photo, stand, rows, corners)
        )
    return _measure(picture, turned, camera, stand, rows, expected, lines, shown)


def _nothing_in_frame(photo: Photo) -> PhotoReading:
    return PhotoReading(photo.name, "nothing: no mirror is completely in the frame")


def _consistent(lines: Outlines, expected: FloatArray) -> npt.NDArray[np.bool_]:
    """Return a mask of the corners (M, 4) that were found and do not belong to another edge."""
    size = np.sqrt(quad_area(expected))
    shift = np.where(lines.known[..., None], lines.corners - expected, np.nan)
    if not lines.known.any():
        return lines.known
    # A rotation of the camera moves all corners of a mirror together. The median of only one or two
    # corners says nothing, so the median of the photograph is used instead.
    common = np.broadcast_to(np.nanmedian(shift, axis=(0, 1)), (len(shift), 1, 2)).copy()
    enough = lines.known.sum(axis=1) >= 3
    common[enough] = np.nanmedian(shift[enough], axis=1, keepdims=True)
    limit = np.maximum(_SKEW, _SKEW_SHARE * size)[:, None]
    with np.errstate(invalid="ignore"):
        return np.asarray(np.linalg.norm(shift - common, axis=-1) < limit)


def _measure(
    picture: Picture,
    photo: Photo,
    camera: LedCamera,
    stand: MirrorPoses,
    rows: Rows,
    expected: FloatArray,
    lines: Outlines,
    shown: Overlap | None = None,
) -> PhotoReading:
    """Return the corners and spots of the mirrors ``rows``, expected at corners (M, 4, 2)."""
    good = _consistent(lines, expected)
    if shown is None:
        good = np.repeat(np.asarray(good.all(axis=1))[:, None], 4, axis=1)
    whole, some = np.asarray(good.all(axis=1)), np.asarray(good.any(axis=1))
    outline = np.where(whole[:, None, None], lines.corners, expected)
    spots, reasons = find_spots(picture, outline, shown=shown)
    if all(r.startswith("overexposed") for r in reasons):
        return PhotoReading(
            photo.name,
            f"overexposed: all {len(rows)} mirrors are clipped; shorten the exposure",
        )
    notes = [
        reason or ("" if known else "outline: hidden, or no straight edges")
        for reason, known in zip(reasons, some, strict=True)
    ]
    corners = np.full(lines.corners.shape, np.nan)
    corners[good] = undistort(camera, lines.corners[good])
    sigma = np.where(some & np.isfinite(lines.sigma), lines.sigma, 1.0)
    return PhotoReading(
        name=photo.name,
        rotation=_attitude(photo.rotation, photo, stand, rows, corners),
        mirror=rows,
        corners=corners,
        corner_sigma=np.hypot(sigma, CORNER_FLOOR) / camera.focal,
        spot_mirror=rows[spots.mirror],
        spot=undistort(camera, spots.pixel),
        spot_sigma=spots.sigma / camera.focal,
        flux=spots.flux,
        clipped=spots.clipped,
        notes=tuple(notes),
    )


def _lights(picture: Picture, photo: Photo, camera: LedCamera, stand: MirrorPoses) -> PhotoReading:
    """Return the lamp's spots in a photograph too dark to show the mirrors."""
    identified, spots = find_lights(picture, photo, camera, stand)
    if identified.reason:
        return PhotoReading(photo.name, identified.reason)
    rows = np.unique(spots.mirror)
    return PhotoReading(
        name=photo.name,
        rotation=identified.rotation,
        mirror=rows,
        corners=np.full((len(rows), 4, 2), np.nan),
        corner_sigma=np.ones(len(rows)),
        spot_mirror=spots.mirror,
        spot=undistort(camera, spots.pixel),
        spot_sigma=spots.sigma / camera.focal,
        flux=spots.flux,
        clipped=spots.clipped,
        notes=("dark: its edges cannot be seen",) * len(rows),
    )


def _in_frame(photo: Photo, camera: LedCamera, stand: MirrorPoses) -> tuple[Rows, FloatArray]:
    """Return the mirrors whose corners are all in the frame, and these corners, px."""
    pixels = photo.pixels(camera, stand.corners)
    width, height = camera.size
    with np.errstate(invalid="ignore"):
        inside = (pixels > 3.0) & (pixels < np.array([width, height]) - 4.0)
    front = np.sum((photo.position - stand.vertex) * stand.rotation[:, :, 2], axis=-1) > 0.0
    whole = inside.all(axis=(1, 2)) & front
    whole[whole] &= quad_area(pixels[whole]) > SMALLEST**2 / 2.0
    rows = np.flatnonzero(whole)
    return rows, pixels[rows]


def _attitude(
    start: FloatArray, photo: Photo, stand: MirrorPoses, rows: Rows, corners: FloatArray
) -> FloatArray:
    """Return the rotation that fits all corners best."""
    known = np.isfinite(corners).all(axis=-1)
    if int(known.sum()) < 4:
        return start
    directions = (stand.corners[rows] - photo.position)[known]
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    rays = np.concatenate([corners[known], np.ones((int(known.sum()), 1))], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return nearest_rotation(directions, rays)


# -- many photographs ------------------------------------------------------------------


def read_many(
    photos: Sequence[Photo],
    camera: LedCamera,
    stand: MirrorPoses,
    *,
    processes: int = 1,
    client: "Client | None" = None,
    keep: Path | None = None,
    progress: Progress | None = None,
) -> tuple[PhotoReading, ...]:
    """Return the readings of photographs, in the order of the photographs.

    Parameters
    ----------
    photos
        Photographs as recorded by the drone.
    camera
        Lens.
    stand
        All mirrors in their expected poses.
    processes
        Number of processes on this computer.
    client
        Client of a dask scheduler, used instead of local processes.
    keep
        Folder that stores the result for each photograph. A photograph whose file, camera and field
        are unchanged is not evaluated again, so an interrupted run continues where it stopped.
    progress
        Called with the numbers of photographs (done, total).
    """
    readings: dict[int, PhotoReading] = {}
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
        base = _digest(camera, stand)
        marks = [_mark(photo, base) for photo in photos]
        for k, mark in enumerate(marks):
            reading = _kept(keep / f"{mark}.npz")
            if reading is not None:
                readings[k] = reading
    if progress is not None:
        progress(len(readings), len(photos))
    missing = [k for k in range(len(photos)) if k not in readings]
    tasks = [photos[k] for k in missing]
    for j, reading in _read(tasks, camera, stand, processes, client):
        k = missing[j]
        readings[k] = reading
        if keep is not None:
            reading.save(keep / f"{marks[k]}.npz")
        if progress is not None:
            progress(len(readings), len(photos))
    return tuple(readings[k] for k in range(len(photos)))


def _read(
    photos: Sequence[Photo],
    camera: LedCamera,
    stand: MirrorPoses,
    processes: int,
    client: "Client | None",
) -> Iterator[tuple[int, PhotoReading]]:
    if client is not None:
        from distributed import as_completed as completed

        # Send the field once.
        shared = client.scatter((camera, stand), broadcast=True)  # type: ignore[no-untyped-call]
        tasks = {
            client.submit(_read_shared, p, shared, pure=False): k for k, p in enumerate(photos)
        }
        for future in completed(list(tasks)):  # type: ignore[no-untyped-call]
            yield tasks[future], future.result()
    elif processes > 1 and len(photos) >= FEWEST_FOR_PROCESSES:
        with pool(processes) as workers:
            futures = {
                workers.submit(read_photo, p, camera, stand): k for k, p in enumerate(photos)
            }
            try:
                for done in as_completed(futures):
                    yield futures[done], done.result()
            finally:
                workers.shutdown(cancel_futures=True)
    else:
        for k, photo in enumerate(photos):
            yield k, read_photo(photo, camera, stand)


def _read_shared(photo: Photo, shared: tuple[LedCamera, MirrorPoses]) -> PhotoReading:
    return read_photo(photo, *shared)


def _digest(camera: LedCamera, stand: MirrorPoses) -> bytes:
    size, lens = np.array(camera.size), (camera.matrix, camera.distortion)
    parts = (size, *lens, stand.vertex, stand.rotation, stand.outline)
    return b"".join(np.ascontiguousarray(p, dtype=np.float64).tobytes() for p in parts)


def _mark(photo: Photo, base: bytes) -> str:
    """Return a key that identifies a photograph's file, position, attitude, camera and field."""
    state = photo.path.stat() if photo.path is not None and photo.path.exists() else None
    recorded = photo.position.tobytes() + photo.rotation.tobytes() + bytes([photo.by_hand])
    file = "" if state is None else f"{photo.name} {state.st_size} {state.st_mtime_ns}"
    return hashlib.sha256(base + recorded + file.encode()).hexdigest()[:32]


def _kept(path: Path) -> PhotoReading | None:
    if not path.exists():
        return None
    try:
        return PhotoReading.load(path)
    except (InputError, ValueError):
        # The file was written by another version, or is damaged, so read the photograph again.
        return None
