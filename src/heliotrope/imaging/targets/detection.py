"""Find candidates for marks: dark drawings on a light background, anywhere in a frame.

Seen from a distance, a flat drawing appears as an affine image of itself. Before a part of a frame
is compared with a drawing, both are transformed so that their second moments are circular. What
remains is a rotation, which follows from the brightness around the centre. Each candidate therefore
yields a complete affine map, whatever the roll of the camera and however oblique its view.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from heliotrope.field.marks import Mark
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Image
from heliotrope.imaging.targets.marks import polygons, tag_dictionary
from heliotrope.optics.coverage import coverage

#: Minimum correlation of a candidate's shape with a drawing.
_ALIKE = 0.72
#: Rotations whose correlation is within this of the best are kept too.
_NEARLY = 0.08
#: Radii of profiles, in standard deviations, and number of directions.
_RADII = np.linspace(0.3, 2.7, 9)
_TURNS = 32
#: A square seen at 75° off its normal is this many times as long as it is wide.
_OBLIQUE = 4.0
#: Strokes narrower than this are removed by the closing, reduced pixels.
_BROAD = 17
#: Maximum number of parts of a frame examined, and of candidates kept.
_PARTS, _KEPT = 300, 60


@dataclass(frozen=True)
class Drawing:
    """A shape that one or more marks have, without rotation.

    Attributes
    ----------
    middle
        Centre of area of the drawing, m right of and above its point, (2,).
    covariance
        Second moments of the drawing over its area, m², (2, 2).
    profile
        Fourier transform of the brightness around the middle, (9, 17).
    size
        Size of the mark, m.
    turning
        Whether rotation changes its appearance; false for a disc.
    """

    middle: FloatArray
    covariance: FloatArray
    profile: npt.NDArray[np.complex128]
    size: float
    turning: bool


@dataclass(frozen=True)
class Candidates:
    """Shapes in a frame that look like a drawing of a known mark.

    Attributes
    ----------
    middle
        Centre of area, pixels of the frame, (P, 2).
    covariance
        Second moments, pixels², (P, 2, 2).
    likeness
        Correlation with each drawing, (P, D).
    part, drawing
        Index pairs of a shape and a drawing that it may show, (K,) each.
    linear
        d(pixel)/d(drawing's metres) of each pair, (K, 2, 2).
    """

    middle: FloatArray
    covariance: FloatArray
    likeness: FloatArray
    part: npt.NDArray[np.intp]
    drawing: npt.NDArray[np.intp]
    linear: FloatArray


@dataclass(frozen=True)
class DarkParts:
    """Parts of a frame that are darker than their surroundings.

    Attributes
    ----------
    middle
        Centre of area, pixels of the frame, (N, 2).
    covariance
        Second moments, pixels², (N, 2, 2).
    profile
        As in `Drawing`, (N, 9, 17).
    """

    middle: FloatArray
    covariance: FloatArray
    profile: npt.NDArray[np.complex128]


def drawings(marks: Sequence[Mark]) -> tuple[list[Drawing], npt.NDArray[np.intp]]:
    """Return the distinct drawings of marks (no tags or pictures), and each mark's index (M,)."""
    known: dict[tuple[str, float, float], int] = {}
    distinct: list[Drawing] = []
    which = []
    for mark in marks:
        key = (mark.kind, mark.size, mark.stroke)
        if key not in known:
            known[key] = len(distinct)
            distinct.append(_drawing(*key))
        which.append(known[key])
    return distinct, np.array(which, dtype=np.intp)


@lru_cache(maxsize=256)
def _drawing(kind: str, size: float, stroke: float) -> Drawing:
    shapes = polygons(Mark("drawing", kind, np.zeros(3), size, stroke))
    low = np.concatenate(shapes).min(axis=0) - 0.5 * size
    high = np.concatenate(shapes).max(axis=0) + 0.5 * size
    step = size / 48
    columns, rows = np.ceil((high - low) / step).astype(int).tolist()
    cells = [np.column_stack([p[:, 0] - low[0], high[1] - p[:, 1]]) / step - 0.5 for p in shapes]
    raster = coverage(cells, (rows, columns))
    y, x = np.mgrid[0:rows, 0:columns]
    spots = np.stack([x.ravel(), y.ravel()], axis=-1).astype(np.float64)
    share = raster.ravel() / raster.sum()
    middle = share @ spots
    spread = (spots - middle).T @ ((spots - middle) * share[:, None])
    profile = _profiles((255.0 * raster).astype(np.uint8), middle[None], spread[None])[0]
    place = np.array([low[0] + (middle[0] + 0.5) * step, high[1] - (middle[1] + 0.5) * step])
    flip = np.diag([1.0, -1.0])
    return Drawing(place, step**2 * flip @ spread @ flip, profile, size, kind != "disc")


def _roots(covariance: FloatArray) -> FloatArray:
    """Return symmetric square roots of symmetric matrices (N, 2, 2)."""
    values, vectors = np.linalg.eigh(covariance)
    lengths = np.sqrt(np.maximum(values, 1e-12))
    return np.asarray((vectors * lengths[:, None, :]) @ np.swapaxes(vectors, 1, 2))


def _profiles(
    mask: Image, middle: FloatArray, covariance: FloatArray
) -> npt.NDArray[np.complex128]:
    """Return Fourier transforms of a mask along circles around positions (N, 2), (N, 9, 17)."""
    import cv2

    if len(middle) == 0:
        return np.empty((0, len(_RADII), _TURNS // 2 + 1), dtype=np.complex128)
    angle = np.arange(_TURNS) * (2.0 * np.pi / _TURNS)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    rays = (_RADII[:, None, None] * circle[None]).transpose(1, 0, 2).reshape(2, -1)
    places = (middle[:, :, None] + _roots(covariance) @ rays).astype(np.float32)
    sampled = cv2.remap(
        mask,
        np.ascontiguousarray(places[:, 0]),
        np.ascontiguousarray(places[:, 1]),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
    # Weight a ring by its area.
    weight = np.repeat(np.sqrt(_RADII), _TURNS)
    values = np.asarray(sampled, dtype=np.float64).reshape(len(middle), -1)
    values = (values - values @ weight[:, None] ** 2 / np.sum(weight**2)) * weight
    values /= np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-9)
    return np.asarray(np.fft.rfft(values.reshape(-1, len(_RADII), _TURNS), axis=2))


@dataclass(frozen=True)
class Lightened:
    """A reduced frame, and the same frame without narrow dark strokes.

    Attributes
    ----------
    small, closed
        The reduced frame, and its closing, (h, w).
    reduction
        Factor of the frame's reduction.
    """

    small: Image
    closed: Image
    reduction: int


def lighten(grey: Image, reduction: int) -> Lightened:
    """Return an 8-bit or 16-bit frame (H, W), reduced, and its morphological closing.

    The closing contains no marks. The frame divided by the closing is the reflectance of a mark
    relative to that of the paint, whatever the light, in the shade as well as in a beam.

    Parameters
    ----------
    grey
        The frame.
    reduction
        Factor of the frame's reduction.
    """
    import cv2

    height, width = grey.shape
    small = grey
    if reduction > 1:
        whole = grey[: height // reduction * reduction, : width // reduction * reduction]
        size = (width // reduction, height // reduction)
        small = cv2.resize(whole, size, interpolation=cv2.INTER_AREA)
    if small.dtype != np.uint8:
        small = small.astype(np.float32)
    closed = cv2.morphologyEx(small, cv2.MORPH_CLOSE, np.ones((_BROAD, _BROAD), np.uint8))
    return Lightened(small, closed, reduction)


def outlines(light: Lightened, ratio: float) -> DarkParts:
    """Return the parts of a frame that are darker than ``ratio`` of their surroundings."""
    import cv2

    small, closed, reduction = light.small, light.closed, light.reduction
    if small.dtype == np.uint8:
        # A difference of one count means nothing.
        limit = cv2.convertScaleAbs(closed, alpha=ratio, beta=-1.0)
    else:
        # Use the same fraction of the maximum for 16 bits, because sensors leave bits empty.
        limit = ratio * closed - 0.01 * float(small.mean())
    mask = cv2.compare(small, limit, cv2.CMP_LT)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    wide, high, area = stats[:, 2], stats[:, 3], stats[:, 4]
    most = max(mask.shape) // 3
    keep = (
        (np.maximum(wide, high) >= 5)
        & (np.minimum(wide, high) >= 3)
        & (area >= 10)
        & (wide <= most)
        & (high <= most)
    )
    keep[0] = False
    # Clutter has thousands of parts, and marks are among the larger ones.
    numbers = np.flatnonzero(keep)
    numbers = numbers[np.argsort(-area[numbers], kind="stable")][:_PARTS]
    renamed = np.full(count, -1)
    renamed[numbers] = np.arange(len(numbers))
    middle, covariance = _moments(labels, mask, renamed, len(numbers))
    profile = _profiles(mask, middle, covariance)
    # Pixel centres are at whole numbers in both the reduced and the full frame.
    middle = reduction * (middle + 0.5) - 0.5
    return DarkParts(middle, reduction**2 * covariance, profile)


def _moments(
    labels: Image, mask: Image, renamed: npt.NDArray[np.intp], count: int
) -> tuple[FloatArray, FloatArray]:
    """Return centres (N, 2) and covariances (N, 2, 2) of labelled parts, reduced pixels."""
    import cv2

    spots = cv2.findNonZero(mask)
    if count == 0 or spots is None:
        return np.empty((0, 2)), np.empty((0, 2, 2))
    x, y = spots.reshape(-1, 2).T
    part = renamed[labels[y, x]]
    held = part >= 0
    x, y, part = x[held].astype(np.float64), y[held].astype(np.float64), part[held]

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(part, values, count) / number)

    number = np.bincount(part, minlength=count)
    center = np.stack([mean(x), mean(y)], axis=-1)
    x, y = x - center[part, 0], y - center[part, 1]
    xy = mean(x * y)
    # Add the second moment of a pixel itself.
    rows = [np.stack([mean(x * x) + 1 / 12, xy], -1), np.stack([xy, mean(y * y) + 1 / 12], -1)]
    return center, np.stack(rows, axis=-2)


def candidates(parts: DarkParts, drawn: Sequence[Drawing]) -> Candidates:
    """Return at most 60 outlines that look like one of the drawings, the best first."""
    profiles = np.stack([d.profile for d in drawn])
    spectrum = np.einsum("prk,drk->pdk", parts.profile, profiles.conj())
    alike = np.fft.irfft(spectrum, n=_TURNS, axis=2)
    best = alike.max(axis=2, initial=-1.0)
    order = np.argsort(-best.max(axis=1, initial=-1.0), kind="stable")[:_KEPT]
    order = order[best[order].max(axis=1, initial=-1.0) > _ALIKE]
    alike, best = alike[order], best[order]
    middle, covariance = parts.middle[order], parts.covariance[order]
    peaks = (alike >= np.roll(alike, 1, axis=2)) & (alike > np.roll(alike, -1, axis=2))
    turning = np.array([d.turning for d in drawn], dtype=bool)
    peaks[:, ~turning] = True
    level = np.maximum(np.maximum(best, best.max(axis=1, keepdims=True) - 0.1) - _NEARLY, _ALIKE)
    part, which, turn = np.nonzero(peaks & (alike > level[..., None]))
    roots = _roots(covariance)
    flip = np.diag([1.0, -1.0])
    inverse = np.stack(
        [np.linalg.inv(_roots((flip @ d.covariance @ flip)[None])[0]) for d in drawn]
    )
    before, after = (alike[part, which, (turn + k) % _TURNS] for k in (-1, 1))
    bend = before - 2.0 * alike[part, which, turn] + after
    fine = np.where(bend < -1e-6, 0.5 * (before - after) / np.minimum(bend, -1e-6), 0.0)
    angle = (turn + fine) * (2.0 * np.pi / _TURNS)
    cos, sin = np.cos(angle), np.sin(angle)
    turned = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], axis=-2)
    linear = roots[part] @ turned @ inverse[which] @ flip
    lengths = np.linalg.svd(linear, compute_uv=False)
    plain = lengths[:, 0] < _OBLIQUE * lengths[:, 1]
    return Candidates(middle, covariance, best, part[plain], which[plain], linear[plain])


# -- tags and pictures -----------------------------------------------------------------


def find_tags(grey: Image, numbers: Sequence[int]) -> dict[tuple[int, int], list[FloatArray]]:
    """Return the corners (4, 2), px, of all tags of some OpenCV dictionaries.

    The keys are dictionary and number. Corners run clockwise from the upper left corner of the
    upright tag.
    """
    import cv2

    tags: dict[tuple[int, int], list[FloatArray]] = {}
    for number in numbers:
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        dictionary = cv2.aruco.getPredefinedDictionary(number)
        detector = cv2.aruco.ArucoDetector(dictionary, parameters)
        corners, identities, _ = detector.detectMarkers(grey)
        labels = [] if len(corners) == 0 else np.ravel(np.asarray(identities)).tolist()
        for place, identity in zip(corners, labels, strict=True):
            corner = np.asarray(place).reshape(4, 2).astype(np.float64)
            tags.setdefault((number, int(identity)), []).append(corner)
    return tags


def tag_number(mark: Mark) -> tuple[int, int]:
    """Return the OpenCV dictionary of a tag, and the tag's number in that dictionary."""
    return tag_dictionary(mark)


def find_pictures(
    grey: Image, marks: Sequence[Mark], pictures: Mapping[str, FloatArray]
) -> Candidates:
    """Search an upright frame for reference pictures of marks at fourteen scales.

    Parameters
    ----------
    grey
        Frame with 8 bits, (H, W).
    marks
        Marks, all of kind "picture"; entry k of the result belongs to mark k.
    pictures
        Reference pictures, keyed by the codes of the marks.
    """
    import cv2

    reduction = max(1, round(max(grey.shape) / 480))
    size = (grey.shape[1] // reduction, grey.shape[0] // reduction)
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    rows = []
    for k, mark in enumerate(marks):
        if mark.code not in pictures:
            continue
        picture = np.asarray(pictures[mark.code], dtype=np.float32)
        for side in np.unique(np.round(9.0 * 1.2 ** np.arange(14)).astype(int)).tolist():
            if side >= min(size) // 2:
                break
            drawn = cv2.resize(picture, (side, side), interpolation=cv2.INTER_AREA)
            alike = cv2.matchTemplate(
                small, np.clip(drawn, 0.0, 255.0).astype(np.uint8), cv2.TM_CCOEFF_NORMED
            )
            for _ in range(4):
                _, value, _, at = cv2.minMaxLoc(alike)
                if value < 0.6:
                    break
                rows.append((k, side, at[0], at[1], value))
                x, y = max(at[0] - side // 2, 0), max(at[1] - side // 2, 0)
                alike[y : at[1] + side // 2 + 1, x : at[0] + side // 2 + 1] = -1.0
    rows = sorted(rows, key=lambda row: -row[4])[:_KEPT]
    table = np.array(rows, dtype=np.float64).reshape(-1, 5)
    which = table[:, 0].astype(np.intp)
    side = reduction * table[:, 1]
    middle = reduction * (table[:, 2:4] + 0.5 * table[:, 1:2]) - 0.5
    likeness = np.zeros((len(table), len(marks)))
    likeness[np.arange(len(table)), which] = table[:, 4]
    lengths = np.array([mark.size for mark in marks])[which]
    linear = (side / lengths)[:, None, None] * np.diag([1.0, -1.0])
    return Candidates(
        middle,
        (side**2 / 12.0)[:, None, None] * np.eye(2),
        likeness,
        np.arange(len(table)),
        which,
        linear,
    )


def picture_drawings(marks: Sequence[Mark]) -> list[Drawing]:
    """Return filled squares in place of pictures, with only their position and size."""
    none = np.zeros((len(_RADII), _TURNS // 2 + 1), dtype=np.complex128)
    return [
        Drawing(np.zeros(2), mark.size**2 / 12.0 * np.eye(2), none, mark.size, True)
        for mark in marks
    ]
