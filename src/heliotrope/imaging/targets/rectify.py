"""Show a face from the front: the brightness of the frame on a metric grid."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Frame, Image
from heliotrope.imaging.targets.attempt import face_marks
from heliotrope.imaging.targets.finding import FoundTarget
from heliotrope.imaging.targets.marks import polygons
from heliotrope.imaging.targets.view import Face, FaceView, faces

Mask = npt.NDArray[np.bool_]

#: Number of pixels across the narrower side of a target. A beam is tens of pixels wide, and a
#: centroid is accurate to a twentieth of a pixel.
ACROSS = 256
#: Rim of a target, where pixels partly show what lies beyond it: minimum width, multiple of the
#: softness of the mark edges, and maximum width, px.
LEAST_RIM, _SOFT_RIM, _MOST_RIM = 2, 1.5, 8
#: Width of the rim masked around marks, m.
_RIM = 0.06


@dataclass(frozen=True)
class Rectified:
    """A face on a grid.

    Attributes
    ----------
    face
        The plane.
    values
        Brightness relative to full scale, (H, W) of float32, row 0 at the top.
    step
        Size of a pixel, m.
    first
        Plane coordinates of the first pixel's centre, m, (2,).
    surface
        Mask of where the surface of a target is visible, (H, W).
    marks
        Mask of where marks are painted, (H, W).
    clipped
        Degree to which each pixel is clipped, 0 to 1, (H, W); see `Frame.clipped`.
    view
        How the face lies in the frame; None for a crop.
    """

    face: Face
    values: Image
    step: float
    first: FloatArray
    surface: Mask
    marks: Mask
    clipped: Image
    view: FaceView | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.values.shape[0], self.values.shape[1]

    @cached_property
    def paint(self) -> Mask:
        """Mask of where bare paint is visible, that is, on a target but not on a mark."""
        return np.asarray(self.surface & ~self.marks)

    @cached_property
    def _shares(self) -> dict[float, Image]:
        return {}

    def share(self, sigma: float) -> Image:
        """Return the fraction of bare paint around each pixel, (H, W), smoothed by ``sigma`` px."""
        import cv2

        if sigma not in self._shares:
            soft = cv2.GaussianBlur(self.paint.astype(np.float32), (0, 0), sigma)
            self._shares[sigma] = np.maximum(soft, np.float32(1e-3))
        return self._shares[sigma]

    def plane(self, pixels: FloatArray) -> FloatArray:
        """Return plane coordinates, m, of grid pixels (column, row), (..., 2)."""
        return np.asarray(self.first + self.step * np.asarray(pixels) * [1.0, -1.0])

    def pixels(self, plane: FloatArray) -> FloatArray:
        """Return grid pixels (column, row), (..., 2), of plane coordinates, m."""
        return np.asarray((np.asarray(plane) - self.first) / self.step * [1.0, -1.0])

    @cached_property
    def axes(self) -> tuple[Image, Image]:
        """Plane coordinates of the columns (W,) and rows (H,), m."""
        rows, columns = self.shape
        x = self.first[0] + self.step * np.arange(columns)
        y = self.first[1] - self.step * np.arange(rows)
        return x.astype(np.float32), y.astype(np.float32)


def rim_of(results: Sequence[FoundTarget]) -> int:
    """Return the width of the rim that partly shows what lies beyond the targets, pixels."""
    soft = [m.blur.max() for f in results for m in f.marks if m.used and np.isfinite(m.blur).all()]
    if not soft:
        return LEAST_RIM
    side = min(min(f.target.width, f.target.height) for f in results)
    return int(np.clip(np.ceil(_SOFT_RIM * np.median(soft) / side * ACROSS), LEAST_RIM, _MOST_RIM))


def rectify(frame: Frame, view: FaceView, grey: Image | None = None, *, rim: int = 0) -> Rectified:
    """Return a face in a frame on a metric grid.

    Parameters
    ----------
    frame
        The photograph.
    view
        How the face lies in the frame.
    grey
        Brightness of the frame, if already computed.
    rim
        Width of the rim that is excluded from the surface, pixels of the grid; see `rim_of`.
    """
    import cv2

    face = view.face
    low, high = face.span
    narrow = min(min(t.width, t.height) for t in face.targets)
    step = narrow / ACROSS
    columns, rows = np.ceil((high - low) / step).astype(int)
    first = np.array([low[0] + 0.5 * step, high[1] - 0.5 * step])
    brightness = np.ascontiguousarray(frame.grey) if grey is None else grey
    middle = 0.5 * (low + high)
    per_metre = float(np.sqrt(abs(np.linalg.det(view.scale(middle)))))
    reduction = max(1, int(step * per_metre))
    places = _places(view, first, step, (int(rows), int(columns)))
    # Pixel centres of a frame reduced by k: (p + 0.5)/k − 0.5.
    corner, part = _around(brightness, places, reduction)
    at = (places - corner + np.float32(0.5)) / np.float32(reduction) - np.float32(0.5)
    values = _resample(part, reduction, at, frame.full_scale)
    clipped = _resample(_around(frame.clipped, places, reduction)[1], reduction, at, 255.0)
    height, width = brightness.shape
    inside = (
        (places[..., 0] >= 0)
        & (places[..., 1] >= 0)
        & (places[..., 0] <= width - 1)
        & (places[..., 1] <= height - 1)
    )
    surface = _drawn((int(rows), int(columns)), first, step, _outlines(face)) & inside
    surface = _trimmed(surface, rim)
    marks = _drawn((int(rows), int(columns)), first, step, _prints(face))
    if marks.any():
        wide = 2 * int(np.ceil(_RIM / step)) + 1
        marks = cv2.dilate(marks.astype(np.uint8), np.ones((wide, wide), np.uint8)) > 0
    return Rectified(face, values, step, first, surface, marks, clipped, view)


def from_crop(frame: Frame, target: Target, *, rim: int = 0) -> Rectified:
    """Return the grid of a picture whose corners are those of its only target.

    Parameters
    ----------
    frame
        The crop, of any size.
    target
        The target that the crop shows.
    rim
        Width of the rim that is excluded from the surface, pixels of the grid.
    """
    import cv2

    face = faces((target,))[0]
    grey = frame.grey
    step = target.width / grey.shape[1]
    rows = max(1, round(target.height / step))
    values = np.asarray(grey, dtype=np.float32) / np.float32(frame.full_scale)
    top = frame.clipped.astype(np.float32) / np.float32(255.0)
    if rows != grey.shape[0]:
        size = (grey.shape[1], rows)
        values = np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_LINEAR), np.float32)
        top = np.asarray(cv2.resize(top, size, interpolation=cv2.INTER_LINEAR), np.float32)
    middle = face.plane(target.corners.mean(axis=0))
    shape = (values.shape[0], values.shape[1])
    first = middle + 0.5 * step * np.array([1 - shape[1], shape[0] - 1])
    printed = np.zeros(shape, dtype=bool)
    if target.marks:
        printed = _drawn(shape, first, step, _prints(face))
        wide = 2 * int(np.ceil(_RIM / step)) + 1
        printed = cv2.dilate(printed.astype(np.uint8), np.ones((wide, wide), np.uint8)) > 0
    surface = _trimmed(np.ones(shape, dtype=bool), rim)
    return Rectified(face, values, step, first, surface, printed, top)


def _trimmed(surface: Mask, rim: int) -> Mask:
    """Return a surface without its rim."""
    import cv2

    if rim == 0:
        return surface
    side = 2 * rim + 1
    inner = cv2.erode(
        surface.astype(np.uint8),
        np.ones((side, side), np.uint8),
        borderType=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
    return inner > 0


def _places(view: FaceView, first: FloatArray, step: float, shape: tuple[int, int]) -> Image:
    """Return the frame pixels (H, W, 2) that correspond to a grid.

    They are computed at every eighth pixel and interpolated, with an error of some thousandths of a
    pixel.
    """
    import cv2

    apart = 8
    rows, columns = shape
    x = first[0] + step * apart * np.arange(columns // apart + 2)
    y = first[1] - step * apart * np.arange(rows // apart + 2)
    nodes = view.to_pixels(np.stack(np.meshgrid(x, y), axis=-1)).astype(np.float32)
    # OpenCV interpolates in steps of 1/32, which include eighths.
    scale = np.array([[1.0 / apart, 0.0, 0.0], [0.0, 1.0 / apart, 0.0]])
    spread = cv2.warpAffine(
        nodes, scale, (columns, rows), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    )
    return np.asarray(spread)


def _around(grey: Image, places: Image, reduction: int) -> tuple[Image, Image]:
    """Return the part of a frame that contains some pixels, and its corner (column, row)."""
    margin = 2 * reduction
    sides = []
    for k, length in ((0, grey.shape[1]), (1, grey.shape[0])):
        low, high = float(places[..., k].min()) - margin, float(places[..., k].max()) + margin + 1
        begin = int(np.clip(low, 0, length - 1)) // reduction * reduction
        sides.append((begin, int(np.clip(np.ceil(high), begin + 1, length))))
    (left, right), (top, bottom) = sides
    if right - left < 2 * reduction or bottom - top < 2 * reduction:
        return np.zeros(2, dtype=np.float32), grey
    return np.array([left, top], dtype=np.float32), grey[top:bottom, left:right]


def _resample(grey: Image, reduction: int, at: Image, full: float) -> Image:
    import cv2

    small = grey
    if reduction > 1:
        height, width = grey.shape
        # Use whole blocks, so that their centres are exact.
        whole = grey[: height // reduction * reduction, : width // reduction * reduction]
        size = (width // reduction, height // reduction)
        small = cv2.resize(whole, size, interpolation=cv2.INTER_AREA)
    out = cv2.remap(
        small, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(out, dtype=np.float32) / np.float32(full)


def _outlines(face: Face) -> list[FloatArray]:
    return [face.plane(target.corners) for target in face.targets]


def _prints(face: Face) -> list[FloatArray]:
    marks, places = face_marks(face)
    shapes = []
    for mark, place in zip(marks, places, strict=True):
        if mark.kind == "picture":
            half = 0.5 * mark.size
            box = half * np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
            shapes.append(place + box)
        else:
            shapes += [place + shape for shape in polygons(mark)]
    return shapes


def _drawn(
    shape: tuple[int, int], first: FloatArray, step: float, shapes: list[FloatArray]
) -> Mask:
    import cv2

    raster = np.zeros(shape, dtype=np.uint8)
    for polygon in shapes:
        spot = (polygon - first) / step * [1.0, -1.0]
        cv2.fillPoly(raster, [np.round(16.0 * spot).astype(np.int32)], 1, shift=4)
    return raster > 0
