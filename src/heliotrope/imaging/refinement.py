"""A mark to a fraction of a pixel: its drawing laid over the frame by least squares."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from heliotrope.field.marks import Mark
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Image
from heliotrope.imaging.marks import polygons

#: Samples are this many pixels apart.
_STEP = 2.0
#: Neighbouring samples share light by lens and interpolation: so many count as one.
_SHARED = 4.0
#: What no fit of a drawing can see: print, relief and blur of a mark, pixels.
_FLOOR = 0.15


@dataclass(frozen=True)
class Refined:
    """Where a mark is.

    Attributes
    ----------
    pixel
        Of its point, (2,).
    covariance
        pixels², (2, 2), of the image alone; the survey's is not in it.
    contrast
        Brightness of the drawing over that of its surroundings, 1 for nothing there.
    explained
        Part of the variance that the drawing explains, at most 1.
    blur
        Standard deviation of what softens its edges, across upright and level ones, m,
        (2,); it cannot be told below two pixels.
    """

    pixel: FloatArray
    covariance: FloatArray
    contrast: float
    explained: float
    blur: FloatArray


@lru_cache(maxsize=256)
def _drawn(kind: str, key: tuple[float, ...], code: str, step: float) -> tuple[FloatArray, ...]:
    """Return a drawing's coverage on a grid, and the plane coordinates of its first sample."""
    import cv2

    size, stroke, turn = key
    mark = Mark("drawing", kind, np.zeros(3), size, stroke, turn, code)
    shapes = polygons(mark)
    points = np.concatenate(shapes)
    margin = max(0.3 * float(np.ptp(points, axis=0).max()), 3.0 * step)
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    count = np.ceil((high - low) / step).astype(int)
    fine = 8
    raster = np.zeros((count[1] * fine, count[0] * fine), dtype=np.uint8)
    for shape in shapes:
        spot = np.stack([shape[:, 0] - low[0], high[1] - shape[:, 1]], axis=-1) / step * fine
        # A polygon's edge lies half a fine pixel off its outermost pixel centres.
        cv2.fillPoly(raster, [np.round((spot - 0.5) * 16).astype(np.int32)], 255, shift=4)
    small = cv2.resize(raster, (count[0], count[1]), interpolation=cv2.INTER_AREA)
    soft = cv2.GaussianBlur(small.astype(np.float32) / 255.0, (0, 0), 0.8)
    first = np.array([low[0] + 0.5 * step, high[1] - 0.5 * step])
    return soft.astype(np.float64), first


def refine(
    grey: Image,
    mark: Mark,
    pixel: FloatArray,
    scale: FloatArray,
    search: float = 0.5,
    picture: FloatArray | None = None,
) -> Refined | None:
    """Return where a mark is, given where about.

    Parameters
    ----------
    grey
        The frame, (H, W).
    mark
        What to look for.
    pixel
        About where its point is, (2,).
    scale
        d(pixel)/d(plane) there, pixels per metre, (2, 2).
    search
        How far off it may be, in sizes of the mark.
    picture
        Of a taught mark: its picture, upright in the plane, (N, N).

    Returns
    -------
    None if it lies beyond the frame's edge, or nothing like it is there.
    """
    import cv2

    per_metre = float(np.sqrt(abs(np.linalg.det(scale))))
    step = _STEP / per_metre
    if mark.size / step < 4.0:
        return None
    template, first = _template(mark, step, picture)
    reach = int(np.ceil(search * mark.size / step))
    shape = np.array(template.shape)
    samples = _sample(grey, pixel, scale, first + [-reach * step, reach * step], step,
                      shape + 2 * reach)  # fmt: skip
    if samples is None:
        return None
    alike = cv2.matchTemplate(
        samples.astype(np.float32), template.astype(np.float32), cv2.TM_CCOEFF_NORMED
    )
    if picture is None:
        alike = -alike  # a drawing's coverage is bright where the mark is dark
    row, column = np.unravel_index(int(np.argmax(alike)), alike.shape)
    shift = np.array([column - reach, reach - row]) * step
    return _adjust(grey, template, first, step, pixel, scale, shift)


def _template(mark: Mark, step: float, picture: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    if picture is None:
        key = (mark.size, mark.stroke, mark.turn)
        drawn, first = _drawn(mark.kind, key, mark.code, step)
        return drawn, first
    import cv2

    count = max(round(float(mark.size / step)), 4)
    small = cv2.resize(picture.astype(np.float32), (count, count), interpolation=cv2.INTER_AREA)
    offset = 0.5 * mark.size * (1.0 - 1.0 / count)
    return small.astype(np.float64) / max(float(small.max()), 1.0), np.array([-offset, offset])


def _sample(
    grey: Image, pixel: FloatArray, scale: FloatArray, first: FloatArray,
    step: float, shape: npt.NDArray[np.intp],
) -> FloatArray | None:  # fmt: skip
    """Return the frame on a grid of the plane; None if less than most of it is in the frame."""
    import cv2

    # Row and column to plane, to pixel: one affine map.
    A = scale @ np.array([[step, 0.0], [0.0, -step]])
    b = pixel + scale @ first
    rows, columns = int(shape[0]), int(shape[1])
    corners = b + np.array([[0, 0], [columns, 0], [0, rows], [columns, rows]]) @ A.T
    height, width = grey.shape
    if not np.isfinite(corners).all():
        return None
    beyond = 0.2 * np.ptp(corners, axis=0)
    if (corners < -beyond).any() or (corners > [width, height] + beyond).any():
        return None
    warped = cv2.warpAffine(
        grey, np.column_stack([A, b]), (columns, rows),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    return np.asarray(warped, dtype=np.float64)


def _adjust(
    grey: Image, template: FloatArray, first: FloatArray, step: float,
    pixel: FloatArray, scale: FloatArray, shift: FloatArray,
) -> Refined | None:  # fmt: skip
    """Gauss-Newton on the shift, with brightness a + b·x + c·y + d·drawing at each step."""
    rows, columns = template.shape
    y, x = np.mgrid[0:rows, 0:columns]
    x, y = x.ravel() - x.mean(), y.mean() - y.ravel()
    down, right = np.gradient(template)
    shape = np.array(template.shape)
    slope = np.column_stack([right.ravel(), -down.ravel()]) / step
    even = np.column_stack([np.ones(x.size), x / x.max(), y / y.max()])
    basis = np.column_stack([even, template.ravel(), slope])
    numbers, weight = np.zeros(6), np.ones(x.size)
    flat = residual = np.empty(0)
    information = np.eye(6)
    for _ in range(6):
        samples = _sample(grey, pixel + scale @ shift, scale, first, step, shape)
        if samples is None:
            return None
        flat = samples.ravel()
        weighted = basis * weight[:, None]
        information = weighted.T @ basis
        numbers = np.linalg.lstsq(information, weighted.T @ flat, rcond=None)[0]
        residual = flat - basis @ numbers
        spread = max(1.4826 * float(np.median(np.abs(residual))), 0.3)
        weight = 1.0 / np.maximum(np.abs(residual) / (2.0 * spread), 1.0)
        # A drawing moved by δ is the drawing less δ times its slope.
        depth = numbers[3] if abs(numbers[3]) > 1e-9 else 1e-9
        move = np.clip(-numbers[4:] / depth, -3.0 * step, 3.0 * step)
        shift = shift + move
        if float(np.abs(move).max()) < 0.01 * step:
            break
    variance = float(np.sum(weight * residual**2) / weight.sum())
    covariance = _SHARED * variance * np.linalg.pinv(information, hermitian=True)
    plane = covariance[4:, 4:] / max(float(numbers[3] ** 2), 1e-12)
    plain = flat - even @ np.linalg.solve(even.T @ even, even.T @ flat)
    # A soft step of height d has the slope d/(√2π σ) at its middle.
    down, right = np.gradient(flat.reshape(template.shape))
    steepest = np.array([np.percentile(np.abs(right), 98.5), np.percentile(np.abs(down), 98.5)])
    blur = step * abs(numbers[3]) / (np.sqrt(2.0 * np.pi) * np.maximum(steepest, 1e-9))
    return Refined(
        pixel=pixel + scale @ shift,
        covariance=scale @ plane @ scale.T + _FLOOR**2 * np.eye(2),
        contrast=float((numbers[0] + numbers[3]) / max(float(numbers[0]), 1e-9)),
        explained=1.0 - float(np.var(residual)) / max(float(np.var(plain)), 1e-9),
        blur=blur,
    )
