"""Which parts of the mirrors an airborne camera sees when nearer mirrors hide others.

Seen from a low drone, the mirrors of a dense field overlap. Planning and detection use this same
model, so a flight is planned only where its photographs can be evaluated.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.standing import MirrorPoses
from heliotrope.geometry import FloatArray, as_float, tangent_axes

Labels = npt.NDArray[np.int16]
Mask = npt.NDArray[np.bool_]

#: Mirrors with a shorter side are not measured, px.
SMALLEST = 12.0
#: With fewer reflections of a mirror, the standard deviation is meaningless.
FEWEST = 5
#: Spots closer to an edge than this are not searched for, px. The margin is half the spot width
#: plus the error of the edge.
MARGIN = 2
#: If more than this fraction of the mirrors is hidden by more than `_TOUCHED`, their images merge.
_MERGED, _TOUCHED = 0.1, 0.02
#: Number of fractional bits of polygon corners.
_BITS = 4


def draw_labels(
    outlines: FloatArray, distance: FloatArray, size: tuple[int, int], scale: float = 1.0
) -> Labels:
    """Return the index, plus 1, of the mirror that each pixel shows, (height, width); 0 for none.

    Parameters
    ----------
    outlines
        Corners of M mirrors, px, (M, 4, 2); mirrors with NaN corners are left out.
    distance
        Distances of the mirrors from the camera, m, (M,).
    size
        Width and height of the picture, px.
    scale
        Number of pixels in the result per pixel of the picture.
    """
    import cv2

    width, height = (max(1, round(n * scale)) for n in size)
    labels = np.zeros((height, width), np.int16)
    # The centre of the first pixel is (0, 0) at every scale.
    small = (outlines + 0.5) * scale - 0.5
    low, high = small.min(axis=1), small.max(axis=1)
    with np.errstate(invalid="ignore"):
        in_frame = (high > 0.0).all(axis=1) & (low < [width, height]).all(axis=1)
    rows = np.flatnonzero(in_frame)
    for row in rows[np.argsort(-distance[rows], kind="stable")].tolist():
        corners = np.round(small[row] * 2**_BITS).astype(np.int32)
        cv2.fillConvexPoly(labels, corners, row + 1, shift=_BITS)
    return labels


@dataclass(frozen=True)
class Visibility:
    """How well a camera sees N mirrors from one position.

    Attributes
    ----------
    share
        Fraction of each mirror's area where a reflection can be found, (N,). This area is not
        hidden by a nearer mirror and not closer to an edge than `MARGIN`.
    hidden
        Fraction of each mirror's area hidden by nearer mirrors, (N,).
    side
        Square root of each mirror's area in the picture, px, (N,).
    """

    share: FloatArray
    hidden: FloatArray
    side: FloatArray

    @property
    def overlapping(self) -> bool:
        """Whether mirrors merge into shapes in which single mirrors cannot be distinguished."""
        return bool(np.mean(self.hidden > _TOUCHED) > _MERGED)


def seen_from(stand: MirrorPoses, place: npt.ArrayLike, focal: float) -> Visibility:
    """Return how well a camera of focal length ``focal`` (px) at ``place`` (3,) sees mirrors.

    The camera is aimed at the centre of the mirrors. Mirrors seen from behind hide other mirrors
    but show nothing.
    """
    import cv2

    spot = as_float(place)
    middle = stand.vertex.mean(axis=0)
    ahead = (middle - spot) / np.linalg.norm(middle - spot)
    axes = np.concatenate([tangent_axes(ahead), ahead[None]])
    local = (stand.corners - spot) @ axes.T
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = np.where(local[..., 2:] > 0.1, local[..., :2] / local[..., 2:], np.nan) * focal
    low = np.nanmin(plane, axis=(0, 1)) - 4.0
    size = np.ceil(np.nanmax(plane, axis=(0, 1)) - low + 4.0).astype(int)
    away = np.linalg.norm(stand.vertex - spot, axis=-1)
    labels = draw_labels(plane - low, away, (int(size[0]), int(size[1])))
    area = np.abs(_signed_area(plane))
    square = np.ones((3, 3), np.uint8)
    share, whole = np.zeros((2, len(stand)))
    front = np.sum((spot - stand.vertex) * stand.rotation[:, :, 2], axis=-1) > 0.0
    for row in np.flatnonzero(front & np.isfinite(area)).tolist():
        a, b = plane[row].min(axis=0) - low, plane[row].max(axis=0) - low
        (left, top), (right, bottom) = (a.astype(int) - 2), (b.astype(int) + 4)
        own = (labels[max(top, 0) : bottom, max(left, 0) : right] == row + 1).astype(np.uint8)
        usable = cv2.erode(own, square, iterations=MARGIN)
        share[row] = np.count_nonzero(usable) / max(area[row], 1.0)
        whole[row] = np.count_nonzero(own) / max(area[row], 1.0)
    # The edge of a drawn mirror covers whole pixels.
    return Visibility(share, np.clip(1.0 - whole, 0.0, 1.0), np.sqrt(np.nan_to_num(area)))


def _signed_area(corners: FloatArray) -> FloatArray:
    ahead = np.roll(corners, -1, axis=1)
    cross = corners[..., 0] * ahead[..., 1] - corners[..., 1] * ahead[..., 0]
    return as_float(0.5 * cross.sum(axis=1))
