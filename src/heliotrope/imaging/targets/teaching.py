"""Define the marks of a target from known points that a user identifies in one picture.

If there is a mark of a known kind at a point, the point is refined to a fraction of a pixel.
Otherwise the part of the picture around the point is stored as a reference picture and becomes a
mark. The points also determine the position of the camera.
"""

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.errors import FormatError, InputError, UnknownNameError
from heliotrope.field.camera import Camera
from heliotrope.field.marks import Mark
from heliotrope.field.plant import Plant
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, as_float
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.pose import CameraFit, calibrate_marks, resection

CORNERS = ("upper_left", "upper_right", "lower_right", "lower_left")
#: Kinds of marks that can be defined in this way.
KINDS = ("corner", "tee", "square", "disc", "picture")
#: Default side of a reference picture, as a fraction of the target's shorter side.
SHARE = 0.12
#: Minimum and maximum side of a reference picture, px.
SMALLEST, LARGEST = 12, 512
#: Maximum error of a manually specified point, px.
REACH = 12.0
#: Minimum fraction of the variance that a drawing explains; maximum brightness relative to its
#: surroundings.
EXPLAINED, CONTRAST = 0.5, 0.93
#: A picture that can be located no better than this, px, shows only an edge or nothing.
VAGUE = 0.5

Pixel = tuple[float, float]


@dataclass(frozen=True)
class Wish:
    """The mark to be defined at a point.

    Attributes
    ----------
    kind
        One of `KINDS`; None for the target's present mark or, if there is none, a picture.
    size, stroke
        See `Mark`, m. None for the default: `SHARE` of the target for a picture, and a fifth of the
        size for strokes.
    """

    kind: str | None = None
    size: float | None = None
    stroke: float | None = None

    def __post_init__(self) -> None:
        if self.kind is not None and self.kind not in KINDS:
            raise InputError(f"kind {self.kind!r} cannot be taught; known: {', '.join(KINDS)}")
        if self.kind not in (None, "picture") and self.size is None:
            raise InputError(f"a {self.kind} needs its size in metres (--size)")
        for what, value in (("size", self.size), ("stroke", self.stroke)):
            if value is not None and not (np.isfinite(value) and value > 0.0):
                raise InputError(f"{what} must be above 0, not {value} m")


@dataclass(frozen=True)
class TaughtPoint:
    """One known point of the target in the picture.

    Attributes
    ----------
    name
        Name of the point.
    pixel, covariance
        Position, px, (2,), and its covariance, px², (2, 2).
    mark
        The new mark of the target at this point; None if nothing there could be recognised again.
    refined
        Whether the position was refined by the drawing of the mark; otherwise it is as specified.
    note
        Why the mark differs from the request; an empty string if it does not.
    """

    name: str
    pixel: FloatArray
    covariance: FloatArray
    mark: Mark | None
    refined: bool
    note: str = ""


@dataclass(frozen=True)
class Taught:
    """The result of `teach`.

    Attributes
    ----------
    plant
        The plant with the new marks and the camera.
    target, camera
        Names of the target and the camera.
    fit
        Fit of the camera.
    points
        Points in the order in which they were specified.
    pictures
        Reference pictures (N, N), uint8, keyed by file name, which is also their code.
    """

    plant: Plant
    target: str
    camera: str
    fit: CameraFit
    points: tuple[TaughtPoint, ...]
    pictures: Mapping[str, npt.NDArray[np.uint8]] = field(default_factory=dict)


def known_points(target: Target) -> dict[str, FloatArray]:
    """Return the named points of a target, ENU metres: marks, then markers, then corners.

    If several points have the same name, the first is used.
    """
    points = {mark.name: mark.point for mark in target.marks}
    for name, point in target.markers.items():
        points.setdefault(name, as_float(point))
    for name, point in zip(CORNERS, target.corners, strict=True):
        # A surveyed corner may be listed under its own name.
        if not any(np.linalg.norm(point - other) < 1e-3 for other in points.values()):
            points.setdefault(name, point)
    return points


def places_of(target: Target) -> tuple[dict[str, Pixel], float]:
    """Return the positions of `known_points` from the left and top, 0 to 1, and the aspect."""
    known = known_points(target)
    plane = target.plane_coordinates(np.array(list(known.values())))
    corners = target.plane_coordinates(target.corners)
    low, high = corners.min(axis=0), corners.max(axis=0)
    share = np.clip((plane - low) / (high - low), 0.0, 1.0)
    places = {name: (float(x), float(1.0 - y)) for name, (x, y) in zip(known, share, strict=True)}
    return places, float((high - low)[0] / (high - low)[1])


def shown_pixels(frame: Frame) -> npt.NDArray[np.uint8]:
    """Return the frame brightened, because points in a dark frame are hard to click."""
    pixels = frame.pixels.astype(np.float32)
    top = max(float(np.percentile(pixels, 99.9)), 1.0)
    return np.asarray(np.clip(pixels * (255.0 / top), 0.0, 255.0), dtype=np.uint8)


def teach(
    plant: Plant,
    target: str,
    frame: Frame,
    given: Mapping[str, Pixel],
    *,
    camera: str = "camera",
    wishes: Mapping[str, Wish] | None = None,
    wish: Wish | None = None,
    sigma: float = 1.0,
    anew: bool = False,
    prefix: str = "mark",
) -> Taught:
    """Return the plant with marks on a target and with the camera that took a picture of it.

    Parameters
    ----------
    plant
        The plant with the target.
    target
        Name of the target.
    frame
        The picture.
    given
        Pixels, keyed by the names in `known_points`. There must be four or more, each within
        `REACH` of its true position.
    camera
        Name of the camera. If the plant has a camera of that name, its lens is taken as known;
        otherwise the lens is estimated too (see `pose.calibrate_marks`).
    wishes, wish
        Marks to define, keyed by the name of the point, and the mark for all other points.
    sigma
        Standard deviation of a coordinate of a manually specified point, px.
    anew
        Whether to solve for the lens of a camera that is already in the plant.
    prefix
        Prefix of the file names of reference pictures.

    Raises
    ------
    InputError
        If names are unknown, or points are too few, outside the picture, or not arranged as on the
        target.
    """
    if not (np.isfinite(sigma) and sigma > 0.0):
        raise InputError(f"sigma must be above 0, not {sigma} px")
    surface = plant.target(target)
    named = _check_points(surface, frame, given)
    for name in set(wishes or {}) - set(named):
        raise UnknownNameError(f"point of target {target} among those given:", name, list(named))
    known = next((c for c in plant.cameras if c.name == camera), None)
    if known is not None and known.size != frame.size:
        raise InputError(
            f"camera {camera}: its frames have {known.size[0]} × {known.size[1]} px, the picture "
            f"{frame.size[0]} × {frame.size[1]} px; use an unscaled picture from that camera"
        )
    plane = surface.plane_coordinates(np.array(list(named.values())))
    pixels = np.array([given[name] for name in named], dtype=np.float64)
    H = _homography(surface, plane, pixels, list(named))
    old = {mark.name: mark for mark in surface.marks}
    asked = {n: (wishes or {}).get(n, wish or Wish()) for n in named}
    drawn = [_drawing(name, point, asked[name], old.get(name)) for name, point in named.items()]
    points = [
        TaughtPoint(n, x, sigma**2 * np.eye(2), None, False)
        for n, x in zip(named, pixels, strict=True)
    ]
    # A second pass uses the scale and rotation of the first, because manually specified points have
    # errors of some per cent.
    for search in (REACH, 0.25 * REACH):
        for k, mark in enumerate(drawn):
            if mark is not None:
                points[k] = _refine(frame, points[k], mark, (H, plane[k]), search)
        H = _homography(surface, plane, np.array([p.pixel for p in points]), list(named))
    pictures: dict[str, npt.NDArray[np.uint8]] = {}
    for k, (name, point) in enumerate(named.items()):
        if points[k].mark is None:
            size = SHARE * min(surface.width, surface.height)
            if asked[name].kind in (None, "picture"):
                size = asked[name].size or size
            points[k] = _picture(frame, points[k], point, size, (H, plane[k]), prefix, pictures)
    fit = _fit(frame, known, camera, anew, np.array(list(named.values())), points, H, plane)
    solved = _with_target(fit.camera, target, known)
    plant = _with_marks(plant, surface, [p.mark for p in points if p.mark is not None], solved)
    return Taught(plant, target, camera, fit, tuple(points), pictures)


def write_taught(taught: Taught, path: str | Path, folder: str | Path | None = None) -> None:
    """Write the new pictures beside a plant file, then write the file with `write_with_pictures`.

    File names depend on the contents of the pictures, so that an older plant file keeps its own
    pictures.
    """
    from heliotrope.imaging.files import write_image

    for name, picture in taught.pictures.items():
        write_image(picture, Path(path).with_name(name))
    write_with_pictures(taught.plant, path, folder)


def write_with_pictures(plant: Plant, path: str | Path, folder: str | Path | None = None) -> None:
    """Copy the reference pictures from ``folder``, then write the plant file.

    The plant's table remains in its format, CSV or Parquet.
    """
    from operator import methodcaller

    from heliotrope.field.formats.plant_file import write_plant
    from heliotrope.files.documents import read_toml
    from heliotrope.files.text import write_file

    place = Path(path)
    table = ""
    if place.exists():
        try:
            table = str(read_toml(place, "a plant file").get("heliostats", ""))
        except FormatError:
            raise FormatError(place, "not a plant file; choose another output file") from None
    codes = {m.code for t in plant.targets for m in t.marks if m.kind == "picture"}
    for code in codes if folder is not None else ():
        source = Path(folder or "") / code
        if source.is_file() and not place.with_name(code).exists():
            write_file(place.with_name(code), methodcaller("write", source.read_bytes()))
    write_plant(plant, place, "parquet" if table.endswith(".parquet") else "csv")


def read_pictures(folder: str | Path, targets: Sequence[Target]) -> dict[str, FloatArray]:
    """Return reference pictures (N, N), keyed by code, from the folder of the plant file.

    Raises
    ------
    FormatError
        If a picture is missing or not square.
    """
    from heliotrope.imaging.files import read_image

    pictures = {}
    for mark in (mark for target in targets for mark in target.marks if mark.kind == "picture"):
        file = Path(folder) / mark.code
        if not file.is_file():
            raise FormatError(
                file,
                f"the picture of mark {mark.name} is missing; copy it beside the plant file, or "
                "teach the mark again (heliotrope camera teach)",
            )
        grey = read_image(file).grey
        if grey.shape[0] != grey.shape[1]:
            raise FormatError(
                file, f"{grey.shape[1]} × {grey.shape[0]} px; a mark's picture is square"
            )
        pictures[mark.code] = as_float(grey)
    return pictures


# -- points ----------------------------------------------------------------------------


def _check_points(
    target: Target, frame: Frame, pixels: Mapping[str, Pixel]
) -> dict[str, FloatArray]:
    """Return the ENU points that belong to the pixels, in the order of the pixels."""
    known = known_points(target)
    width, height = frame.size
    for name, (x, y) in pixels.items():
        if name not in known:
            raise UnknownNameError(f"point of target {target.name}", name, list(known))
        if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
            raise InputError(
                f"point {name}: {x}, {y} is not in the picture of {width} × {height} px"
            )
    if len(pixels) < 4:
        raise InputError(
            f"target {target.name}: {len(pixels)} points given; four or more are needed to locate "
            f"the camera (it has {', '.join(known)})"
        )
    names = list(pixels)
    for k, name in enumerate(names):
        for other in names[:k]:
            if np.hypot(*np.subtract(pixels[name], pixels[other])) < 3.0:
                raise InputError(f"points {other} and {name} are in the same place, {pixels[name]}")
    return {name: known[name] for name in names}


def _homography(
    target: Target, plane: FloatArray, pixels: FloatArray, names: Sequence[str]
) -> FloatArray:
    """Return H_pixel_plane (3, 3); raise an error if points are not arranged as on the target."""
    import cv2

    what = f"target {target.name}: the points {', '.join(names)}"
    if np.linalg.svd(plane - plane.mean(axis=0), compute_uv=False)[1] < 0.02 * np.ptp(plane):
        raise InputError(f"{what} lie on one line; use points that span an area")
    # If there is no solution, None becomes NaN.
    H = as_float(cv2.findHomography(plane, pixels)[0])
    if not np.isfinite(H).all():
        raise InputError(f"{what} cannot be a view of this target; check for swapped names")
    depth = np.column_stack([plane, np.ones(len(plane))]) @ H[2]
    turned = [float(np.linalg.det(_scale(H, p))) for p in plane]
    # Rows run downwards, so the determinant of a front view is negative.
    if (depth * depth[0] > 0.0).all() and min(turned) > 0.0:
        raise InputError(
            f"{what} are mirrored in the picture; check whether left and right are swapped"
        )
    miss = _mapped(H, plane) - pixels
    if not ((depth * depth[0] > 0.0).all() and max(turned) < 0.0) or (
        np.sqrt(np.mean(miss**2)) > 0.05 * np.ptp(pixels, axis=0).max()
    ):
        raise InputError(f"{what} are not arranged as on the target; check for swapped names")
    return H


def _mapped(H: FloatArray, plane: FloatArray) -> FloatArray:
    homogeneous = np.column_stack([plane, np.ones(len(plane))]) @ H.T
    return as_float(homogeneous[:, :2] / homogeneous[:, 2:])


def _scale(H: FloatArray, place: FloatArray) -> FloatArray:
    """Return d(pixel)/d(plane), px/m (2, 2)."""
    x, y, w = H @ [place[0], place[1], 1.0]
    return as_float((H[:2, :2] - np.outer([x / w, y / w], H[2, :2])) / w)


def _per_metre(H: FloatArray, place: FloatArray) -> float:
    return float(np.sqrt(abs(np.linalg.det(_scale(H, place)))))


# -- marks -----------------------------------------------------------------------------


def _drawing(name: str, point: FloatArray, wish: Wish, old: Mark | None) -> Mark | None:
    """Return the drawn mark expected at a point; None if a picture is to be taken."""
    if wish.kind is None and old is not None and old.kind != "picture":
        return old
    if wish.kind in (None, "picture") or wish.size is None:
        return None
    stroke = 0.0
    if wish.kind in ("corner", "tee"):
        stroke = 0.2 * wish.size if wish.stroke is None else wish.stroke
    turn = old.turn if old is not None and old.kind == wish.kind else 0.0
    return Mark(name, wish.kind, point, wish.size, stroke, turn)


def _refine(
    frame: Frame, taught: TaughtPoint, mark: Mark, view: tuple[FloatArray, FloatArray], reach: float
) -> TaughtPoint:
    """Refine a point with the mark's drawing, rotated by the quarter turn that explains most."""
    from heliotrope.imaging.targets.refinement import Refined, refine

    scale = _scale(*view)
    search = reach / (mark.size * _per_metre(*view))
    turned = [mark]
    if mark.kind in ("corner", "tee"):
        turned += [replace(mark, turn=mark.turn + k * 0.5 * np.pi) for k in (1, -1, 2)]
    best: tuple[Refined, Mark] | None = None
    for trial in turned:
        refined = refine(frame.grey, trial, taught.pixel, scale, search)
        # A mark is darker than its surroundings.
        if (
            refined is not None
            and refined.contrast <= CONTRAST
            and (best is None or refined.explained > best[0].explained)
        ):
            best = refined, trial
    if best is None or best[0].explained < EXPLAINED:
        share = "nothing" if best is None else f"{100 * max(best[0].explained, 0.0):.0f} %"
        what = f"no {mark.kind} of {mark.size:g} m was recognised: its drawing explains {share}"
        return replace(taught, note=what)
    refined, trial = best
    return TaughtPoint(taught.name, refined.pixel, refined.covariance, trial, refined=True)


def _picture(
    frame: Frame,
    taught: TaughtPoint,
    point: FloatArray,
    size: float,
    view: tuple[FloatArray, FloatArray],
    prefix: str,
    pictures: dict[str, npt.NDArray[np.uint8]],
) -> TaughtPoint:
    """Use the part of the picture around a point, upright in the plane, as the point's mark."""
    import cv2

    (H, place), side = view, size * _per_metre(*view)
    if side < SMALLEST:
        return _nothing(taught, f"a picture of {size:.2f} m has {side:.0f} px, below {SMALLEST} px")
    # The number is odd, so that the centre of one pixel is the point.
    count = min(int(side), LARGEST) // 2 * 2 + 1
    offset = (np.arange(count) - count // 2) * (size / count)
    right, up = np.meshgrid(offset, -offset)
    grid = place + np.stack([right, up], axis=-1).reshape(-1, 2)
    # The point stays where the user placed it, and the view defines the plane around it.
    spots = _mapped(H, grid) + taught.pixel - _mapped(H, place[None])[0]
    width, height = frame.size
    if (spots.min(axis=0) < -0.5).any() or (spots.max(axis=0) > [width - 0.5, height - 0.5]).any():
        return _nothing(
            taught, f"a picture of {size:.2f} m about it leaves the frame; reduce --size"
        )
    maps = spots.reshape(count, count, 2).astype(np.float32)
    grey: Any = _eight_bit(frame)
    patch = cv2.remap(grey, maps[..., 0], maps[..., 1], cv2.INTER_CUBIC)
    picture = np.asarray(patch, dtype=np.uint8)
    vague = _vagueness(picture) * side / count
    if not vague < VAGUE:
        return _nothing(taught, "only an edge, or nothing, is visible there")
    code = _file_name(prefix, taught.name, picture)
    pictures[code] = picture
    return replace(taught, mark=Mark(taught.name, "picture", point, size, code=code))


def _nothing(taught: TaughtPoint, why: str) -> TaughtPoint:
    before = f"{taught.note}; " if taught.note else ""
    return replace(taught, note=f"{before}{why}; the point is used only to locate the camera")


def _vagueness(picture: npt.NDArray[np.uint8]) -> float:
    """Return how accurately a picture can be located in its worst direction, px.

    The standard deviation follows from the structure tensor and the noise of the picture (Förstner
    and Gülch 1987).
    """
    p = picture.astype(np.float64)
    # The noise is estimated from second differences along both axes (Immerkær 1996).
    rough = p[:-2] - 2.0 * p[1:-1] + p[2:]
    rough = rough[:, :-2] - 2.0 * rough[:, 1:-1] + rough[:, 2:]
    noise = max(1.4826 * float(np.median(np.abs(rough))) / 6.0, 1.0)
    right = 0.5 * (p[1:-1, 2:] - p[1:-1, :-2])
    down = 0.5 * (p[2:, 1:-1] - p[:-2, 1:-1])
    tensor = np.array([[np.sum(a * b) for b in (right, down)] for a in (right, down)])
    least = float(np.linalg.eigvalsh(tensor)[0])
    # Subtract the slopes that noise alone would have.
    return noise / np.sqrt(least) if least > 2.0 * right.size * noise**2 else float("inf")


def _eight_bit(frame: Frame) -> npt.NDArray[np.uint8]:
    grey = np.asarray(frame.grey)
    if grey.dtype == np.uint8:
        return np.asarray(grey, dtype=np.uint8)
    # Sensors with 10 or 12 bits leave the upper bits empty.
    top = max(float(grey.max()), 1.0)
    return np.asarray(np.round(grey * (255.0 / top)), dtype=np.uint8)


def _file_name(prefix: str, name: str, picture: npt.NDArray[np.uint8]) -> str:
    word = hashlib.sha256(picture.tobytes()).hexdigest()[:8]
    plain = [re.sub(r"[^\w.-]+", "_", part) for part in (prefix, name)]
    return f"{plain[0]}-{plain[1]}-{word}.png"


# -- camera and plant ------------------------------------------------------------------


def _fit(
    frame: Frame,
    known: Camera | None,
    name: str,
    anew: bool,
    points: FloatArray,
    taught: Sequence[TaughtPoint],
    H: FloatArray,
    plane: FloatArray,
) -> CameraFit:
    from heliotrope.imaging.targets.attempt import SURVEY

    pixels = np.array([p.pixel for p in taught])
    survey = np.array([(SURVEY * _per_metre(H, place)) ** 2 for place in plane])
    covariance = np.array([p.covariance for p in taught]) + survey[:, None, None] * np.eye(2)
    if known is not None and not anew:
        return resection(known, points, pixels, covariance)
    return calibrate_marks(frame.size, [points], [pixels], [covariance], name)


def _with_target(camera: Camera, target: str, known: Camera | None) -> Camera:
    """Return the camera with the target added to its targets."""
    if known is None:
        return replace(camera, targets=(target,))
    targets = known.targets
    if targets and target not in targets:
        targets = (*targets, target)
    return replace(camera, targets=targets, source=known.source)


def _with_marks(plant: Plant, target: Target, marks: Sequence[Mark], camera: Camera) -> Plant:
    new = {mark.name: mark for mark in marks}
    kept = [new.pop(mark.name, mark) for mark in target.marks]
    taught = replace(target, marks=(*kept, *new.values()))
    targets = tuple(taught if t.name == target.name else t for t in plant.targets)
    return with_camera(replace(plant, targets=targets), camera)


def with_camera(plant: Plant, camera: Camera) -> Plant:
    """Return the plant with a camera added, replacing any camera of the same name."""
    names = [c.name for c in plant.cameras]
    if camera.name not in names:
        return replace(plant, cameras=(*plant.cameras, camera))
    return replace(
        plant, cameras=tuple(camera if c.name == camera.name else c for c in plant.cameras)
    )


# -- cameras and marks already known ---------------------------------------------------


@dataclass(frozen=True)
class SeenMarks:
    """Marks found in frames.

    Attributes
    ----------
    points, pixels, covariances
        For each frame with marks: points, ENU metres, (N, 3), pixels, (N, 2), and covariances
        including the survey, px², (N, 2, 2).
    targets
        Names of the targets that were found.
    reasons
        Why targets were not found, as sentences.
    """

    points: tuple[FloatArray, ...]
    pixels: tuple[FloatArray, ...]
    covariances: tuple[FloatArray, ...]
    targets: tuple[str, ...]
    reasons: tuple[str, ...]


def see_marks(
    plant: Plant, folder: str | Path, frames: Sequence[Frame], camera: Camera | None
) -> SeenMarks:
    """Find the marks of a plant's targets in frames; ``folder`` has the reference pictures.

    Raises
    ------
    InputError
        If no target has marks, or no target is found.
    """
    from heliotrope.imaging.targets.attempt import SURVEY
    from heliotrope.imaging.targets.finding import FoundMark, find_targets

    targets = [t for t in plant.targets if t.marks]
    if camera is not None and camera.targets:
        targets = [t for t in targets if t.name in camera.targets]
    if not targets:
        raise InputError(
            "no target of this camera has marks; teach them first (heliotrope camera teach), or "
            "use a chessboard"
        )
    pictures = read_pictures(folder, targets)
    points, pixels, covariances, names, reasons = [], [], [], [], []
    for frame in frames:
        marks: list[tuple[FoundMark, FloatArray]] = []
        for result in find_targets(frame, targets, camera, pictures=pictures):
            if not result.found or result.view is None:
                reasons.append(f"{frame.name}: target {result.target.name}: {result.reason}")
                continue
            names.append(result.target.name)
            for found_mark in result.marks:
                if found_mark.used and not any(found_mark.mark == other.mark for other, _ in marks):
                    place = result.view.face.plane(found_mark.mark.point)
                    per_metre = abs(np.linalg.det(result.view.scale(place)))
                    marks.append(
                        (found_mark, found_mark.covariance + per_metre * SURVEY**2 * np.eye(2))
                    )
        if marks:
            points.append(np.array([found_mark.mark.point for found_mark, _ in marks]))
            pixels.append(np.array([found_mark.pixel for found_mark, _ in marks]))
            covariances.append(np.array([covariance for _, covariance in marks]))
    if not points:
        raise InputError("no target was found: " + "; ".join(reasons))
    return SeenMarks(
        tuple(points),
        tuple(pixels),
        tuple(covariances),
        tuple(dict.fromkeys(names)),
        tuple(reasons),
    )


def fit_marks(
    size: tuple[int, int], marks: SeenMarks, known: Camera | None, name: str, anew: bool
) -> CameraFit:
    """Return a camera fitted to marks; a known lens is kept unless ``anew`` is true."""
    if known is None or anew:
        return calibrate_marks(size, marks.points, marks.pixels, marks.covariances, name)
    parts = marks.points, marks.pixels, marks.covariances
    points, pixels, covariances = (np.concatenate(part) for part in parts)
    return resection(known, points, pixels, covariances)
