"""Dark drawings on something light, wherever they are in a frame: candidates for marks."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.field.marks import Mark
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Image
from heliotrope.imaging.marks import polygons, tag_dictionary

#: Side of the raster that shapes are compared on.
_RASTER = 20
#: Least correlation of a candidate's shape with a drawing.
_ALIKE = 0.7


@dataclass(frozen=True)
class Candidates:
    """Shapes in a frame that look like a drawing of a known mark.

    Attributes
    ----------
    drawing
        Which of the drawings, (N,).
    point
        Where the drawing's point is, pixels of the frame, (N, 2).
    extent
        Width and height, pixels, (N, 2).
    likeness
        Correlation with the drawing, (N,).
    """

    drawing: npt.NDArray[np.intp]
    point: FloatArray
    extent: FloatArray
    likeness: FloatArray


@dataclass(frozen=True)
class Drawing:
    """A shape that one or more marks have.

    Attributes
    ----------
    raster
        What it looks like in its bounding box, zero mean and unit norm, (20 · 20,).
    anchor
        Where its point is in the bounding box: 0 to 1 to the right and downwards, (2,).
    size
        Width and height, m, (2,).
    """

    raster: FloatArray
    anchor: FloatArray
    size: FloatArray


def drawings(marks: Sequence[Mark], roll: float = 0.0) -> tuple[list[Drawing], list[int]]:
    """Return the different drawings of marks, and for each mark which one it is.

    Parameters
    ----------
    marks
        Without tags and pictures, which are not found by their outline.
    roll
        The whole target is turned by this, counterclockwise, rad.
    """
    import cv2

    found: list[Drawing] = []
    which = []
    cos, sin = np.cos(roll), np.sin(roll)
    turn = np.array([[cos, sin], [-sin, cos]])
    for mark in marks:
        shapes = [shape @ turn for shape in polygons(mark)]
        points = np.concatenate(shapes)
        low, high = points.min(axis=0), points.max(axis=0)
        size = high - low
        fine = 8 * _RASTER
        raster = np.zeros((fine, fine), dtype=np.uint8)
        for shape in shapes:
            spot = np.stack([shape[:, 0] - low[0], high[1] - shape[:, 1]], axis=-1) / size
            cv2.fillPoly(raster, [np.round(spot * fine).astype(np.int32)], 255)
        small = cv2.resize(raster, (_RASTER, _RASTER), interpolation=cv2.INTER_AREA)
        anchor = np.array([-low[0], high[1]]) / size
        drawing = Drawing(_standard(small), anchor, size)
        for k, other in enumerate(found):
            if np.allclose(other.anchor, anchor, atol=0.02) and (
                float(other.raster @ drawing.raster) > 0.97
            ):
                which.append(k)
                break
        else:
            which.append(len(found))
            found.append(drawing)
    return found, which


def _standard(raster: Image) -> FloatArray:
    """Zero mean and unit norm; a filled square keeps its constant, or it would be nothing."""
    flat = raster.astype(np.float64).ravel() / 255.0 - 0.35
    return np.asarray(flat / max(float(np.linalg.norm(flat)), 1e-9))


@dataclass(frozen=True)
class Outlines:
    """What is darker than its surroundings.

    Attributes
    ----------
    boxes
        Left, top, width and height, reduced pixels, (N, 4).
    rasters
        Each part in its box, as :class:`Drawing` has it, (N, 20 · 20).
    reduction
        Of the frame.
    """

    boxes: FloatArray
    rasters: FloatArray
    reduction: int


def outlines(grey: Image, reduction: int, ratio: float) -> Outlines:
    """Return the parts of a frame that are darker than their surroundings.

    A mark's reflectance is a fraction of the paint's, whatever the light: the frame over its
    closing, which has no marks any more, is that fraction, in the shade and in a beam.

    Parameters
    ----------
    grey
        A frame, (H, W).
    reduction
        It is looked at at this fraction of its size.
    ratio
        Darker than this fraction of the surroundings.
    """
    import cv2

    height, width = grey.shape
    small = grey
    if reduction > 1:
        small = cv2.resize(
            grey, (width // reduction, height // reduction), interpolation=cv2.INTER_AREA
        )
    # Strokes up to 16 reduced pixels broad are closed.
    closed = cv2.morphologyEx(small, cv2.MORPH_CLOSE, np.ones((17, 17), np.uint8))
    mask = cv2.compare(small, cv2.convertScaleAbs(closed, alpha=ratio, beta=-1.0), cv2.CMP_LT)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    left, top, wide, high, area = (stats[:, k] for k in range(5))
    limit = max(mask.shape) // 4
    keep = (
        (wide >= 5) & (high >= 5) & (area >= 12) & (wide <= limit) & (high <= limit)
        & (wide < 5 * high) & (high < 5 * wide)
    )  # fmt: skip
    keep[0] = False
    # Clutter has thousands of parts; marks are among the larger ones.
    numbers = np.flatnonzero(keep)
    numbers = numbers[np.argsort(-area[numbers], kind="stable")][:400]
    rasters = np.empty((len(numbers), _RASTER * _RASTER))
    for k, n in enumerate(numbers):
        part = labels[top[n] : top[n] + high[n], left[n] : left[n] + wide[n]] == n
        scaled = cv2.resize(
            part.astype(np.uint8) * 255, (_RASTER, _RASTER), interpolation=cv2.INTER_AREA
        )
        rasters[k] = _standard(scaled)
    return Outlines(stats[numbers, :4].astype(np.float64), rasters, reduction)


def candidates(seen: Outlines, drawn: Sequence[Drawing]) -> Candidates:
    """Return the outlines that look like one of the drawings, the likest first, at most 80."""
    alike = seen.rasters @ np.stack([d.raster for d in drawn]).T
    best = alike.max(axis=1, initial=-1.0)
    part, which = np.nonzero(alike > np.maximum(_ALIKE, best - 0.1)[:, None])
    order = np.argsort(-alike[part, which], kind="stable")[:80]
    part, which = part[order], which[order]
    anchors = np.array([d.anchor for d in drawn]).reshape(-1, 2)[which]
    boxes = seen.boxes[part]
    # Pixel centres are at whole numbers, in the reduced frame and in the full one.
    points = seen.reduction * (boxes[:, :2] + anchors * boxes[:, 2:]) - 0.5
    return Candidates(which, points, seen.reduction * boxes[:, 2:], alike[part, which])


def find_tags(grey: Image, marks: Sequence[Mark]) -> dict[str, FloatArray]:
    """Return the corners (4, 2), pixels, of the tags among marks that a frame shows, by name.

    From the upper left as seen, clockwise, of the upright tag.
    """
    import cv2

    found: dict[str, FloatArray] = {}
    tags = [mark for mark in marks if mark.kind == "tag"]
    wanted: dict[int, dict[int, str]] = {}
    for mark in tags:
        number, identity = tag_dictionary(mark)
        wanted.setdefault(number, {})[identity] = mark.name
    for number, names in wanted.items():
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        dictionary = cv2.aruco.getPredefinedDictionary(number)
        detector = cv2.aruco.ArucoDetector(dictionary, parameters)
        corners, identities, _ = detector.detectMarkers(grey)
        seen = [] if len(corners) == 0 else np.ravel(np.asarray(identities)).tolist()
        for place, name in zip(corners, seen, strict=True):
            if name in names:
                found[names[name]] = np.asarray(place).reshape(4, 2).astype(np.float64)
    return found
