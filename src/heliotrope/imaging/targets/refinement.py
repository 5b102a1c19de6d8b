"""Locate a mark to a fraction of a pixel by fitting its drawing to the frame.

The pixel values at a mark follow a + b·x + c·y + (d + e·x + f·y)·drawing, which accounts for light
that varies linearly over paint and print, and for stray light. Second derivatives of the drawing
account for blur that differs from that of the drawing, so blur does not shift the mark.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from heliotrope.field.marks import Mark
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Image
from heliotrope.imaging.targets.marks import polygons
from heliotrope.optics.coverage import coverage

Values = npt.NDArray[np.float32]

#: Samples across a mark: pixels per sample, maximum number, maximum number while searching, and
#: minimum number.
_PIXELS, _MOST, _COARSE, _FEWEST = 1.5, 32, 20, 6
#: This many samples count as one, because lens and interpolation correlate neighbours.
_SHARED = 4.0
#: A mark is pale if it is brighter than this fraction of the paint around it; blurs of the drawing
#: that are then tried, in stroke widths.
_PALE, _SOFTNESS = 0.6, (0.0, 0.4, 0.6, 0.8, 1.0, 1.3, 1.7)
#: Error due to print, relief and blur of a mark, which no fit reveals, px.
_FLOOR = 0.1
#: Blur of a drawing, samples, which is about that of pixels and a lens.
_SOFT = 0.8
#: Blur of the samples, so that they can be interpolated.
_SMOOTH = 0.7
#: Maximum number of Gauss-Newton steps (two or three suffice from a tenth of a stroke), and the
#: step, in samples, below which the fit has converged.
_STEPS, _STILL = 6, 0.01
#: Margin around a drawing, in its own size.
_MARGIN = 0.3
#: If a model with even light explains less than this fraction, the fit is repeated with the light
#: divided out.
_CLEAR = 0.8


@dataclass(frozen=True)
class Refined:
    """The refined position of a mark.

    Attributes
    ----------
    pixel
        Pixel of the mark's point, (2,).
    covariance
        Covariance of the pixel from the image alone, without the survey, px², (2, 2).
    contrast
        Brightness of the drawing divided by that of its surroundings; 1 if there is no mark.
    explained
        Fraction of the variance that the drawing explains, at most 1.
    blur
        Standard deviation of the blur across upright and level edges, m, (2,); not
        measurable below two pixels.
    shape
        Distortion relative to the drawing, (2, 2): the position d of the drawing is seen where ``d
        + shape @ d`` should be.
    """

    pixel: FloatArray
    covariance: FloatArray
    contrast: float
    explained: float
    blur: FloatArray
    shape: FloatArray


@dataclass(frozen=True)
class _Template:
    """A drawing on a grid of its plane.

    Attributes
    ----------
    values
        Fraction of each cell that is drawn, softened, (H, W).
    first
        Centre of the first cell relative to the mark's point, m, (2,).
    step
        Size of a cell, m.
    basis
        Columns: even light (3), drawing, its slopes (2) and second slopes (2), light over
        the print (2), then its shape (4), (H · W, 14).
    sign
        −1 for a drawing, which is darker than its surroundings; 1 for a picture.
    stroke
        Width of the drawing's strokes, cells.
    """

    values: FloatArray
    first: FloatArray
    step: float
    basis: Values
    sign: float
    stroke: float


def refine(
    grey: Image,
    mark: Mark,
    pixel: FloatArray,
    scale: FloatArray,
    search: float = 0.5,
    picture: FloatArray | None = None,
    within: FloatArray | None = None,
) -> Refined | None:
    """Return the exact position of a mark near an approximate position.

    Parameters
    ----------
    grey
        The frame, (H, W).
    mark
        The mark.
    pixel
        Approximate pixel of the mark's point, (2,).
    scale
        d(pixel)/d(plane) there, px/m, (2, 2). Its errors, over half the size of the mark,
        are errors of the point.
    search
        Search radius, in sizes of the mark; with 0 the search is limited to a stroke width.
    picture
        Reference picture of the mark, upright in the plane, (N, N).
    within
        Bounds of the target's paint relative to the mark's point, m, (2, 2); pixels outside
        are ignored.

    Returns
    -------
    The refined position; None if the mark lies outside the frame, is smaller than nine pixels, or
    nothing similar is there.
    """
    start = pixel
    if search > 0.0:
        about = locate(grey, mark, pixel, scale, search, picture)
        if about is None:
            return None
        start = about[0]
    count = _count(mark, scale, _MOST)
    if count < _FEWEST or not np.isfinite(start).all():
        return None
    template = _template(mark, count, picture)
    paint = _paint(template, within)
    best = _adjust(grey, template, start, scale, paint, relit=False)
    if best is not None and best.explained < _CLEAR and picture is None:
        other = _adjust(grey, template, start, scale, paint, relit=True)
        if other is not None and other.explained > best.explained:
            return other
    return best


def locate(
    grey: Image,
    mark: Mark,
    pixel: FloatArray,
    scale: FloatArray,
    search: float,
    picture: FloatArray | None = None,
) -> tuple[FloatArray, float, float] | None:
    """Return a mark's approximate position, px, (2,), its sigma, px, and its correlation.

    The parameters are those of `refine`; the result is None if the mark is not found.
    """
    import cv2

    count = _count(mark, scale, _COARSE)
    if count < _FEWEST or not np.isfinite(pixel).all():
        return None
    template = _template(mark, count, picture)
    step = template.step
    reach = int(np.ceil(search * count))
    shape = (template.values.shape[0] + 2 * reach, template.values.shape[1] + 2 * reach)
    first = template.first + [-reach * step, reach * step]
    sampled = _sample(grey, pixel, scale, first, step, shape)
    if sampled is None:
        return None
    samples = sampled[0]
    drawn = template.values.astype(np.float32)
    alike = template.sign * cv2.matchTemplate(samples, drawn, cv2.TM_CCOEFF_NORMED)
    if picture is None and float(alike.max()) < _CLEAR:
        even = _relit(samples, template.stroke)
        other = template.sign * cv2.matchTemplate(even, drawn, cv2.TM_CCOEFF_NORMED)
        alike = other if other.max() > alike.max() else alike
    row, column = (int(k) for k in np.unravel_index(int(np.argmax(alike)), alike.shape))
    right = column - reach + _peak(alike[row], column)
    up = reach - row - _peak(alike[:, column], row)
    deviation = 0.25 * step * float(np.sqrt(abs(np.linalg.det(scale))))
    place = pixel + scale @ np.array([right, up]) * step
    return place, max(deviation, _FLOOR), float(alike[row, column])


def _peak(values: Image, at: int) -> float:
    """Return the peak of the parabola through a maximum and its neighbours."""
    if not 0 < at < len(values) - 1:
        return 0.0
    before, middle, after = (float(v) for v in values[at - 1 : at + 2])
    bend = before - 2.0 * middle + after
    return 0.5 * (before - after) / bend if bend < 0.0 else 0.0


def _count(mark: Mark, scale: FloatArray, most: int) -> int:
    """Return the number of samples across a mark."""
    if not np.isfinite(scale).all():
        return 0
    return min(most, int(mark.size * np.sqrt(abs(np.linalg.det(scale))) / _PIXELS))


# -- drawings --------------------------------------------------------------------------


def _template(mark: Mark, count: int, picture: FloatArray | None) -> _Template:
    if picture is None:
        return _drawn(mark.kind, (mark.size, mark.stroke, mark.turn), mark.code, count)
    import cv2

    small = cv2.resize(picture.astype(np.float32), (count, count), interpolation=cv2.INTER_AREA)
    step = mark.size / count
    first = np.array([-0.5, 0.5]) * (mark.size - step)
    values = np.asarray(small, dtype=np.float64) / max(float(small.max()), 1.0)
    return _Template(values, first, step, _basis(values, first, step), 1.0, count)


@lru_cache(maxsize=512)
def _drawn(kind: str, key: tuple[float, float, float], code: str, count: int) -> _Template:
    import cv2

    size, stroke, turn = key
    step = size / count
    shapes = polygons(Mark("drawing", kind, np.zeros(3), size, stroke, turn, code))
    points = np.concatenate(shapes)
    margin = max(_MARGIN * float(np.ptp(points, axis=0).max()), 3.0 * step)
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    columns, rows = np.ceil((high - low) / step).astype(int).tolist()
    # The centre of the first cell is half a step inside the grid.
    cells = [np.column_stack([p[:, 0] - low[0], high[1] - p[:, 1]]) / step - 0.5 for p in shapes]
    soft = cv2.GaussianBlur(coverage(cells, (rows, columns)), (0, 0), _SOFT)
    values = np.asarray(soft, dtype=np.float64)
    first = np.array([low[0] + 0.5 * step, high[1] - 0.5 * step])
    broad = (stroke or size) / step
    return _Template(values, first, step, _basis(values, first, step), -1.0, broad)


def _basis(values: FloatArray, first: FloatArray, step: float) -> Values:
    rows, columns = values.shape
    down, right = np.gradient(values)
    slope_x, slope_y = right / step, -down / step
    x = np.broadcast_to(first[0] + step * np.arange(columns), values.shape)
    y = np.broadcast_to((first[1] - step * np.arange(rows))[:, None], values.shape)
    half = 0.5 * step * max(rows, columns)
    even_x, even_y = (x - x.mean()) / half, (y - y.mean()) / half
    bend_x = np.gradient(right, axis=1) / step**2
    bend_y = np.gradient(down, axis=0) / step**2
    parts = [
        np.ones_like(values), even_x, even_y, values, slope_x, slope_y, bend_x, bend_y,
        even_x * values, even_y * values, x * slope_x, y * slope_x, x * slope_y, y * slope_y,
    ]  # fmt: skip
    return np.ascontiguousarray(np.stack([part.ravel() for part in parts], axis=-1), np.float32)


# -- frames ----------------------------------------------------------------------------


def _sample(
    grey: Image,
    pixel: FloatArray,
    scale: FloatArray,
    first: FloatArray,
    step: float,
    shape: tuple[int, int],
) -> tuple[Values, npt.NDArray[np.bool_] | None] | None:
    """Return a frame sampled on a grid of the plane, and a mask of the cells in the frame.

    The mask is None if all cells are in the frame, and the result is None if most of the grid is
    outside. Pixels finer than the grid are averaged first.
    """
    import cv2

    # A single affine map leads from column and row to the plane and to pixels.
    A = scale @ np.array([[step, 0.0], [0.0, -step]])
    b = pixel + scale @ first
    rows, columns = shape
    corners = b + np.array([[0, 0], [columns, 0], [0, rows], [columns, rows]]) @ A.T
    height, width = grey.shape
    if not np.isfinite(corners).all():
        return None
    low, high = corners.min(axis=0), corners.max(axis=0)
    beyond = 0.25 * (high - low)
    if (low < -beyond).any() or (high > [width - 1, height - 1] + beyond).any():
        return None
    k = max(1, int(float(np.linalg.norm(A, axis=0).min()) + 1e-9))
    left, top = np.maximum(np.floor(low).astype(int) - 2 * k, 0).tolist()
    right, bottom = np.minimum(np.ceil(high).astype(int) + 2 * k + 1, [width, height]).tolist()
    right, bottom = left + (right - left) // k * k, top + (bottom - top) // k * k
    if right - left < 2 * k or bottom - top < 2 * k:
        return None
    part = grey[top:bottom, left:right].astype(np.float32)
    if k > 1:
        size = ((right - left) // k, (bottom - top) // k)
        part = np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA), np.float32)
    # Pixel centres of a part reduced by k: (p − left + 0.5)/k − 0.5.
    at = (b - [left, top] + 0.5) / k - 0.5
    warped = cv2.warpAffine(
        part,
        np.column_stack([A / k, at]),
        (columns, rows),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    inside = None
    if (low < 0.0).any() or (high > [width - 1, height - 1]).any():
        x = b[0] + A[0, 0] * np.arange(columns) + A[0, 1] * np.arange(rows)[:, None]
        y = b[1] + A[1, 0] * np.arange(columns) + A[1, 1] * np.arange(rows)[:, None]
        inside = (x >= -0.5) & (y >= -0.5) & (x <= width - 0.5) & (y <= height - 0.5)
    return np.asarray(warped, dtype=np.float32), inside


def _paint(template: _Template, within: FloatArray | None) -> Values:
    """Return 1 for cells of a template within bounds, and 0 for the other cells, (H · W,)."""
    rows, columns = template.values.shape
    if within is None:
        return np.ones(rows * columns, dtype=np.float32)
    # Softened light reaches across the bound.
    low, high = within + 1.5 * template.step * np.array([[1.0], [-1.0]])
    x = template.first[0] + template.step * np.arange(columns)
    y = template.first[1] - template.step * np.arange(rows)
    across, along = (x >= low[0]) & (x <= high[0]), (y >= low[1]) & (y <= high[1])
    return np.asarray(np.outer(along, across), dtype=np.float32).ravel()


def _relit(samples: Image, stroke: float) -> Image:
    """Return samples divided by the light on them, which is estimated by a closing."""
    import cv2

    broad = 2 * int(0.65 * stroke + 1.5) + 1
    light = cv2.morphologyEx(samples, cv2.MORPH_CLOSE, np.ones((broad, broad), np.uint8))
    return np.asarray(100.0 * samples / np.maximum(light, 1.0), dtype=np.float32)


def _adjust(
    grey: Image,
    template: _Template,
    pixel: FloatArray,
    scale: FloatArray,
    paint: Values,
    relit: bool,
) -> Refined | None:
    """Fit the position by Gauss-Newton iteration, solving for all other unknowns at each step."""
    import cv2

    basis, step, shape = template.basis, template.step, template.values.shape
    shift = np.zeros(2)
    numbers, weight = np.zeros(10), paint
    samples = shown = residual = inside = paint
    for _ in range(_STEPS):
        taken = _sample(grey, pixel + scale @ shift, scale, template.first, step, shape)
        if taken is None:
            return None
        smooth = np.asarray(cv2.GaussianBlur(taken[0], (0, 0), _SMOOTH), dtype=np.float32)
        shown = smooth.ravel()
        samples = _relit(smooth, template.stroke).ravel() if relit else shown
        inside = paint if taken[1] is None else paint * taken[1].ravel()
        _, numbers = _solve(basis[:, :10], weight * inside, samples)
        residual = samples - basis[:, :10] @ numbers.astype(np.float32)
        off = np.abs(residual)
        spread = max(1.4826 * _quantile(off, 0.5), 0.1)
        weight = (1.0 / np.maximum(off / (2.0 * spread), 1.0)).astype(np.float32)
        # To first order, a drawing moved by δ is the drawing minus δ times its slope.
        depth = numbers[3] if abs(numbers[3]) > 1e-9 else 1e-9
        move = np.clip(-numbers[4:6] / depth, -2.0 * step, 2.0 * step)
        shift = shift + move
        if float(np.abs(move).max()) < _STILL * step:
            break
    place = pixel + scale @ shift
    refined = _judged(template, samples, weight, inside, residual, numbers, place, scale)
    if refined.contrast > _PALE:
        contrast, blur = _softer(template, shown, inside, refined.contrast, refined.blur)
        refined = replace(refined, contrast=contrast, blur=blur)
    return refined


def _quantile(values: Values, share: float) -> float:
    at = int(share * (values.size - 1))
    return float(np.partition(values, at, axis=None)[at])


def _solve(basis: Values, weight: Values, samples: Values) -> tuple[FloatArray, FloatArray]:
    """Return the normal matrix and the solution of weighted least squares."""
    weighted = basis * weight[:, None]
    information = (weighted.T @ basis).astype(np.float64)
    aim = (weighted.T @ samples).astype(np.float64)
    size = np.sqrt(np.maximum(np.diag(information), 1e-12))
    # The columns for the rotation of a disc or for a broad blur vanish, and a ridge keeps their
    # coefficients at 0. The ridge also exceeds the rounding errors of sums in single precision.
    ridge = information / np.outer(size, size) + 1e-6 * np.eye(len(size))
    return information, np.linalg.solve(ridge, aim / size) / size


def _judged(
    template: _Template,
    samples: Values,
    weight: Values,
    inside: Values,
    residual: Values,
    numbers: FloatArray,
    place: FloatArray,
    scale: FloatArray,
) -> Refined:
    """Return the covariance, contrast and other measures of a mark that was found."""
    step, depth = template.step, float(numbers[3])
    weight = weight * inside
    information, full = _solve(template.basis, weight, samples)
    information = information[:10, :10]
    variance = float(np.sum(weight * residual**2) / max(float(weight.sum()), 1e-9))
    size = np.sqrt(np.maximum(np.diag(information), 1e-12))
    inverse = np.linalg.inv(information / np.outer(size, size) + 1e-6 * np.eye(10))
    covariance = _SHARED * variance * inverse[4:6, 4:6] / np.outer(size[4:6], size[4:6])
    plane = covariance / max(depth**2, 1e-12)
    even = template.basis[:, :3]
    plain = samples - even @ _solve(even, inside, samples)[1].astype(np.float32)
    shown = inside > 0.0
    unexplained = float(np.var(residual[shown])) / max(float(np.var(plain[shown])), 1e-9)
    # A soft step of height d has the slope d/(√2π σ) at its middle.
    down, right = np.gradient(samples.reshape(template.values.shape))
    steepest = np.array([_quantile(np.abs(slope), 0.985) for slope in (right, down)])
    blur = step * abs(depth) / (np.sqrt(2.0 * np.pi) * np.maximum(steepest, 1e-9))
    # To first order, a drawing stretched by 1 + s is the drawing minus s times the position times
    # its slope.
    shape = -full[10:].reshape(2, 2) / (full[3] if abs(full[3]) > 1e-9 else 1e-9)
    return Refined(
        pixel=place,
        covariance=scale @ plane @ scale.T + _FLOOR**2 * np.eye(2),
        contrast=float((numbers[0] + depth) / max(float(numbers[0]), 1e-9)),
        explained=1.0 - unexplained,
        blur=blur,
        shape=shape,
    )


def _softer(
    template: _Template, samples: Values, weight: Values, contrast: float, blur: FloatArray
) -> tuple[float, FloatArray]:
    """Return the contrast and blur of a mark that is pale due to stray light or defocus.

    The blur terms of the model are valid while the blur is small compared with the stroke. For
    larger blur, drawings with several blurs along each axis are compared, and the best fit is used.
    """
    import cv2

    even, root = template.basis[:, :3], np.sqrt(weight)[:, None]
    widest = 0.5 * max(template.values.shape)
    blurs = [(a, b) for a in _SOFTNESS for b in _SOFTNESS]
    best, least = (contrast, blur), np.inf
    for pair in blurs:
        wide = np.maximum(template.stroke * np.array(pair), 1e-3)
        if wide.max() > widest:
            continue
        drawn = cv2.GaussianBlur(template.values, (0, 0), wide[0], sigmaY=wide[1])
        parts = np.column_stack([even, drawn.ravel().astype(np.float32)])
        numbers, rest, _, _ = np.linalg.lstsq(parts * root, samples * root[:, 0], rcond=None)
        if not rest.size or float(rest[0]) >= least:
            continue
        least = float(rest[0])
        if any(pair):
            pale = float((numbers[0] + numbers[3]) / max(float(numbers[0]), 1e-9))
            best = pale, np.maximum(blur, template.step * wide)
    return best
