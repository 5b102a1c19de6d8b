"""A flight evaluated: photographs read, many at once; laid over each other; reflections out.

1. Each photograph is read by itself (`reading`), on as many processes
   as there are, or on a dask scheduler. What was read is kept in a folder, so that a campaign
   that was interrupted goes on where it stopped.
2. All together give the exterior orientation of each and RTK's common offset
   (`bundle`).
3. The ray of each spot is cut with its mirror's surface: the rows of the reflections.

In a night without moon no corner is seen: `_dark` takes the place of 2.
"""

import hashlib
import zipfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.evaluate._dark import BESIDE, turn_together
from heliotrope.airborne.evaluate.bundle import Adjusted, Corners, Priors, State, adjust, residuals
from heliotrope.airborne.evaluate.reading import Seen, read_photo
from heliotrope.airborne.evaluate.reflections import Reflections, join, reflections
from heliotrope.airborne.mirror import MirrorShape
from heliotrope.airborne.photo import LedCamera, Photo
from heliotrope.airborne.standing import Standing
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float

if TYPE_CHECKING:
    from distributed import Client

Progress = Callable[[int, int], None]
ShapeOf = Callable[[int], MirrorShape]

#: Below this number of photographs another process costs more than it gains.
FEWEST_FOR_PROCESSES = 4
#: A spot's place on the mirror is not known better than this share of a pixel.
SPOT_FLOOR = 0.15
#: What lies beside a mirror moves its edges alike in all photographs, px. Where shadows touch the
#: lower edges, rendered mirrors stand 0.03 px off, alike in a row of eight: as much as 0.06 px
#: would make of mirrors that are independent.
EDGE_BIAS = 0.06
#: Deviations of the corners are taken as stated if the residuals agree within this factor.
_AGREE = 1.15


@dataclass(frozen=True)
class Evaluation:
    """What the photographs of a flight give.

    Attributes
    ----------
    photos
        Those that were used, with their exterior orientation as found.
    told
        The same as the drone told them.
    seen
        What each shows.
    adjusted
        The bundle adjustment.
    stand
        The mirrors as their corners show them.
    place_covariance
        Of where each mirror stands as seen from the drone, m², (N, 3, 3): what all its
        reflections share.
    reflections
        One row for each spot on a mirror; ``photo`` counts those that were used.
    problems
        A line for each photograph that was not used.
    """

    photos: tuple[Photo, ...]
    told: tuple[Photo, ...]
    seen: tuple[Seen, ...]
    adjusted: Adjusted
    stand: Standing
    place_covariance: FloatArray
    reflections: Reflections
    problems: tuple[str, ...]


# -- reading many ----------------------------------------------------------------------


def read_many(
    photos: Sequence[Photo],
    camera: LedCamera,
    stand: Standing,
    *,
    processes: int = 1,
    client: "Client | None" = None,
    keep: Path | None = None,
    progress: Progress | None = None,
) -> tuple[Seen, ...]:
    """Return what photographs show, in their order.

    Parameters
    ----------
    photos
        As the drone tells them.
    camera
        Lens.
    stand
        All mirrors as they are believed to stand.
    processes
        On this machine.
    client
        Of a dask scheduler, which takes them instead.
    keep
        Folder in which what each shows is kept; what is there for the same file, camera and
        field is not read again.
    progress
        Is told how many are done, of how many.
    """
    found: dict[int, Seen] = {}
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
        base = _digest(camera, stand)
        marks = [_mark(photo, base) for photo in photos]
        for k, mark in enumerate(marks):
            seen = _kept(keep / f"{mark}.npz")
            if seen is not None:
                found[k] = seen
    if progress is not None:
        progress(len(found), len(photos))
    missing = [k for k in range(len(photos)) if k not in found]
    tasks = [photos[k] for k in missing]
    for j, seen in _read(tasks, camera, stand, processes, client):
        k = missing[j]
        found[k] = seen
        if keep is not None:
            seen.save(keep / f"{marks[k]}.npz")
        if progress is not None:
            progress(len(found), len(photos))
    return tuple(found[k] for k in range(len(photos)))


def _read(
    photos: Sequence[Photo],
    camera: LedCamera,
    stand: Standing,
    processes: int,
    client: "Client | None",
) -> Iterator[tuple[int, Seen]]:
    if client is not None:
        from distributed import as_completed as completed

        # The field travels once.
        shared = client.scatter((camera, stand), broadcast=True)  # type: ignore[no-untyped-call]
        tasks = {
            client.submit(_read_shared, p, shared, pure=False): k for k, p in enumerate(photos)
        }
        for future in completed(list(tasks)):  # type: ignore[no-untyped-call]
            yield tasks[future], future.result()
    elif processes > 1 and len(photos) >= FEWEST_FOR_PROCESSES:
        # A forked child would inherit the locks of this one's threads.
        with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
            futures = {pool.submit(read_photo, p, camera, stand): k for k, p in enumerate(photos)}
            try:
                for done in as_completed(futures):
                    yield futures[done], done.result()
            finally:
                pool.shutdown(cancel_futures=True)
    else:
        for k, photo in enumerate(photos):
            yield k, read_photo(photo, camera, stand)


def _read_shared(photo: Photo, shared: tuple[LedCamera, Standing]) -> Seen:
    return read_photo(photo, *shared)


def _digest(camera: LedCamera, stand: Standing) -> bytes:
    parts = (
        np.array(camera.size), camera.matrix, camera.distortion, stand.vertex, stand.rotation,
        stand.outline,
    )  # fmt: skip
    return b"".join(np.ascontiguousarray(p, dtype=np.float64).tobytes() for p in parts)


def _mark(photo: Photo, base: bytes) -> str:
    """Return a name for a photograph's file, place and attitude with this camera and field."""
    state = photo.path.stat() if photo.path is not None and photo.path.exists() else None
    told = photo.position.tobytes() + photo.rotation.tobytes()
    file = "" if state is None else f"{photo.name} {state.st_size} {state.st_mtime_ns}"
    return hashlib.sha256(base + told + file.encode()).hexdigest()[:32]


def _kept(path: Path) -> Seen | None:
    if not path.exists():
        return None
    try:
        return Seen.load(path)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        # Written by another version, or damaged: read again.
        return None


# -- all together ----------------------------------------------------------------------


def evaluate(
    photos: Sequence[Photo],
    seen: Sequence[Seen],
    camera: LedCamera,
    stand: Standing,
    shape: ShapeOf,
    *,
    priors: Priors | None = None,
    owner: npt.ArrayLike | None = None,
) -> Evaluation:
    """Return the reflections of a flight, with what the photographs say of themselves.

    Parameters
    ----------
    photos, seen
        As told, and what each shows.
    camera
        With its lamp.
    stand
        The mirrors as they are believed to stand.
    shape
        Gives the surface of a mirror's row; slopes do not matter here.
    priors
        Of the bundle adjustment.
    owner
        Row of the heliostat that each mirror is of, if some stand in several poses
        (:func:`heliotrope.airborne.evaluate.bundle.adjust`).

    Raises
    ------
    InputError
        If no photograph can be used, or none shows a reflection.
    """
    good = [k for k, s in enumerate(seen) if not s.problem and np.isfinite(s.corners).any()]
    problems = [f"{s.name}: {s.problem}" for s in seen if s.problem]
    problems += [
        f"{s.name}: outline: no mirror's edges could be measured"
        for s in seen
        if not s.problem and not np.isfinite(s.corners).any()
    ]
    if not good:
        dark = [k for k, s in enumerate(seen) if not s.problem and len(s.spot)]
        if dark and owner is None:
            own = [photos[k] for k in dark], [seen[k] for k in dark]
            lines = tuple(f"{s.name}: {s.problem}" for s in seen if s.problem)
            return _evaluate_dark(*own, camera, stand, shape, priors or Priors(), lines)
        first = f"; the first: {problems[0]}" if problems else ""
        raise InputError(f"no photograph of {len(seen)} can be used{first}")
    told, used = [photos[k] for k in good], [seen[k] for k in good]
    corners = corners_of(used)
    known = _with_edges(priors or Priors(), told, stand, camera)
    adjusted = _adjusted(told, used, stand, corners, known, owner)
    state = adjusted.state
    places = [
        photo.moved(place, turned)
        for photo, place, turned in zip(told, state.position, state.rotation, strict=True)
    ]
    shifts = _local_shifts(adjusted, corners, len(used), len(stand))
    found = _reflections(places, used, camera, state.stand, shape, shifts)
    if not len(found):
        raise InputError(
            f"no reflection on the mirrors of {len(used)} photographs; is the lamp on, and do the "
            "mirrors look at the drone (commands.csv)?"
        )
    return Evaluation(
        tuple(places),
        tuple(told),
        tuple(used),
        adjusted,
        state.stand,
        adjusted.place_covariance,
        found,
        tuple(problems),
    )


def _evaluate_dark(
    told: Sequence[Photo],
    seen: Sequence[Seen],
    camera: LedCamera,
    stand: Standing,
    shape: ShapeOf,
    priors: Priors,
    problems: tuple[str, ...],
) -> Evaluation:
    """Evaluate a flight at night: attitudes from the lights alone, positions as RTK has them."""
    shifts = np.zeros((len(told), len(stand), 2))

    def cut(photos: Sequence[Photo], mirrors: Standing) -> Reflections:
        # The turn that all share moves lights beside the mirrors that they are on.
        return _reflections(photos, seen, camera, mirrors, shape, shifts, BESIDE)

    start = [p.moved(p.position, s.rotation) for p, s in zip(told, seen, strict=True)]
    found = turn_together(start, stand, shape, cut)
    position = as_float([p.position for p in told])
    state = State(
        position,
        as_float([p.rotation for p in found.photos]),
        np.zeros_like(position),
        np.zeros(3),
        found.stand,
        np.zeros((len(stand), 3)),
    )
    place = float(np.linalg.norm([priors.offset, priors.position, priors.kinematics]))
    places = found.place_covariance(place)
    adjusted = Adjusted(
        state,
        priors.offset**2 * np.eye(3),
        np.full(position.shape, np.nan),
        places,
        np.empty((0, 2)),
        float("nan"),
        np.empty(0, np.bool_),
        0,
        True,
    )
    rows = cut(found.photos, found.stand)
    return Evaluation(
        found.photos, tuple(told), tuple(seen), adjusted, found.stand, places, rows, problems
    )


def corners_of(seen: Sequence[Seen]) -> Corners:
    """Return the corners that were found in photographs, as marks for the adjustment."""
    parts = []
    for k, one in enumerate(seen):
        row, corner = np.nonzero(np.isfinite(one.corners).all(axis=-1))
        parts.append(
            (
                np.full(len(row), k),
                one.mirror[row],
                corner,
                one.corners[row, corner],
                one.corner_sigma[row],
            )
        )
    joined = [np.concatenate(p) for p in zip(*parts, strict=True)]
    return Corners(
        joined[0].astype(np.intp),
        joined[1].astype(np.intp),
        joined[2].astype(np.intp),
        as_float(joined[3]),
        as_float(joined[4]),
    )


def _with_edges(
    priors: Priors, told: Sequence[Photo], stand: Standing, camera: LedCamera
) -> Priors:
    """Return the priors with what the edges of mirrors add to where they seem to stand."""
    middle = as_float([p.position for p in told]).mean(axis=0)
    distance = float(np.median(np.linalg.norm(stand.vertex - middle, axis=-1)))
    bias = EDGE_BIAS * distance / camera.focal
    return replace(priors, kinematics=float(np.hypot(priors.kinematics, bias)))


def _adjusted(
    told: Sequence[Photo],
    seen: Sequence[Seen],
    stand: Standing,
    corners: Corners,
    priors: Priors | None,
    owner: npt.ArrayLike | None = None,
) -> Adjusted:
    """Adjust; once more if the corners scatter more or less than they say."""
    places = as_float([p.position for p in told])
    spreads = as_float([p.sigma_position for p in told])
    turns = as_float([s.rotation for s in seen])
    found = adjust(places, spreads, turns, stand, corners, priors, owner=owner)
    factor = found.deviation
    if np.isfinite(factor) and not 1.0 / _AGREE < factor < _AGREE:
        scaled = Corners(
            corners.photo, corners.mirror, corners.corner, corners.place, corners.sigma * factor
        )
        found = adjust(places, spreads, found.state.rotation, stand, scaled, priors, owner=owner)
    return found


def _local_shifts(adjusted: Adjusted, corners: Corners, photos: int, mirrors: int) -> FloatArray:
    """Return by how much each mirror's corners stand off in each photograph, (P, N, 2).

    What the lens model leaves over moves a mirror and the spots on it alike.
    """
    kept = ~adjusted.outlier
    gap, _ = residuals(adjusted.state, corners, derivative=False)
    where = corners.photo * mirrors + corners.mirror
    count = np.bincount(where[kept], minlength=photos * mirrors)
    shift = np.stack(
        [
            np.bincount(where[kept], weights=gap[kept, i], minlength=photos * mirrors)
            for i in (0, 1)
        ],
        axis=-1,
    )
    mean = shift / np.maximum(count, 1)[:, None]
    return as_float(np.where((count >= 3)[:, None], mean, 0.0).reshape(photos, mirrors, 2))


def _reflections(
    photos: Sequence[Photo],
    seen: Sequence[Seen],
    camera: LedCamera,
    stand: Standing,
    shape: ShapeOf,
    shifts: FloatArray,
    beside: float = 0.0,
) -> Reflections:
    """Return the reflections of all spots, by the ray of each and its mirror.

    Rays that pass ``beside`` m and a little beside all facets are left out.
    """
    number = np.concatenate([np.full(len(s.spot_mirror), k) for k, s in enumerate(seen)])
    mirror = np.concatenate([s.spot_mirror for s in seen])
    place = np.concatenate([s.spot for s in seen]) - shifts[number, mirror]
    spread = np.hypot(np.concatenate([s.spot_sigma for s in seen]), SPOT_FLOOR / camera.focal)
    turns = as_float([p.rotation for p in photos])
    position = as_float([p.position for p in photos])
    lamp = as_float([p.led_position(camera) for p in photos])
    ways = np.concatenate([place, np.ones((len(place), 1))], axis=-1)
    ways = np.einsum("kij,kj->ki", turns[number], ways)
    parts = []
    for row in np.unique(mirror).tolist():
        mine = np.flatnonzero(mirror == row)
        turned = stand.rotation[row]
        start = (position[number[mine]] - stand.vertex[row]) @ turned
        facet, xy = _cut(shape(int(row)), start, ways[mine] @ turned, beside)
        kept = facet >= 0
        distance = np.linalg.norm(start, axis=-1)
        # Seen from aside, a spot's place along the mirror is less sharp.
        slant = np.maximum(np.abs(start[:, 2]) / distance, 0.2)
        sigma = np.maximum(spread[mine] * distance / slant, 1e-4)
        at = number[mine[kept]]
        parts.append(
            reflections(at, row, facet[kept], xy[kept], position[at], lamp[at], sigma[kept])
        )
    found = join([p for p in parts if len(p)])
    return found.take(np.lexsort((found.heliostat, found.photo)))


def _cut(
    shape: MirrorShape, start: FloatArray, ways: FloatArray, beside: float
) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """Return facet (-1 beside the mirror) and place (S, 2) where rays meet the surface."""
    height = np.zeros(len(ways))
    facet = np.full(len(ways), -1, dtype=np.intp)
    xy = np.zeros((len(ways), 2))
    for _ in range(3):
        length = (height - start[:, 2]) / ways[:, 2]
        xy = start[:, :2] + length[:, None] * ways[:, :2]
        facet = _nearest_facet(shape, xy, beside)
        kept = facet >= 0
        height[kept] = shape.point_at(facet[kept], xy[kept])[:, 2]
    return facet, xy


def _nearest_facet(shape: MirrorShape, xy: FloatArray, beside: float) -> npt.NDArray[np.intp]:
    """Return the facet at each place; between two, the one that is nearer; -1 beside them."""
    facet = shape.facet_at(xy)
    left = np.flatnonzero(facet < 0)
    if len(left):
        every = np.tile(np.arange(len(shape)), len(left))
        uv = shape.along_facet(every, np.repeat(xy[left], len(shape), axis=0))
        beyond = np.maximum(np.abs(uv) - shape.half_size[every], 0.0)
        off = np.hypot(beyond[:, 0], beyond[:, 1]).reshape(len(left), len(shape))
        nearest = np.argmin(off, axis=1)
        limit = 0.05 * shape.half_size.max(axis=1) + 0.02 + beside
        near = off[np.arange(len(left)), nearest] < limit[nearest]
        facet[left[near]] = nearest[near]
    return facet


# -- appendix A ------------------------------------------------------------------------


@dataclass(frozen=True)
class RtkCheck:
    """Positions from photogrammetry against those of RTK.

    Attributes
    ----------
    names
        Of the photographs.
    difference
        Told less photogrammetric, east, north, up, m, (P, 3).
    mean
        What all share, m, (3,), and its standard deviation from the adjustment, (3,).
    mean_sigma
        See ``mean``.
    covariance
        Of a single position about the mean, m², (3, 3): RTK's and photogrammetry's together.
    photogrammetry
        Mean standard deviation of the photogrammetric positions against each other, m, (3,).
    """

    names: tuple[str, ...]
    difference: FloatArray
    mean: FloatArray
    mean_sigma: FloatArray
    covariance: FloatArray
    photogrammetry: FloatArray

    @property
    def sigma(self) -> FloatArray:
        """Standard deviation of a single position per axis, m, (3,)."""
        return as_float(np.sqrt(np.diag(self.covariance)))


def check_rtk(
    photos: Sequence[Photo],
    seen: Sequence[Seen],
    camera: LedCamera,
    stand: Standing,
    priors: Priors | None = None,
) -> tuple[RtkCheck, tuple[str, ...]]:
    """Return how positions by RTK scatter about those that the images alone give.

    The adjustment runs twice: as always, for the common offset, and with positions that are
    free to a metre, for each photograph's own.

    Raises
    ------
    InputError
        If fewer than three photographs can be used.
    """
    good = [k for k, s in enumerate(seen) if not s.problem and np.isfinite(s.corners).any()]
    problems = tuple(f"{s.name}: {s.problem}" for s in seen if s.problem)
    if len(good) < 3:
        first = f"; the first: {problems[0]}" if problems else ""
        raise InputError(f"{len(good)} photographs can be used, three are needed{first}")
    told, used = [photos[k] for k in good], [seen[k] for k in good]
    corners = corners_of(used)
    known = _with_edges(priors or Priors(), told, stand, camera)
    usual = _adjusted(told, used, stand, corners, known)
    places = as_float([p.position for p in told])
    scaled = corners.sigma * max(usual.deviation, 0.1) if _rescaled(usual) else corners.sigma
    free = adjust(
        places,
        np.ones_like(places),
        usual.state.rotation,
        usual.state.stand,
        Corners(corners.photo, corners.mirror, corners.corner, corners.place, scaled),
        # The mirrors stand where both together put them: their errors are not RTK's.
        Priors(offset=1e-6, position=1e-6, turn=1e-6),
    )
    gap = places - free.state.position
    return RtkCheck(
        tuple(p.name for p in told),
        gap,
        usual.state.offset,
        np.sqrt(np.diag(usual.offset_covariance)),
        np.atleast_2d(np.cov(gap.T)),
        free.position_sigma.mean(axis=0),
    ), problems


def _rescaled(found: Adjusted) -> bool:
    return bool(np.isfinite(found.deviation) and not 1.0 / _AGREE < found.deviation < _AGREE)
