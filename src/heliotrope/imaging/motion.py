"""Detect motion between frames: whether and where a beam moved, and how significantly.

Two frames from a fixed camera differ not only by a beam but also by noise, exposure, clouds, and
wind on the mast. Each of these effects is modelled and removed before differences are examined:

1. Frames are reduced to at most 400 × 300 px, which also averages noise.
2. Gain (with a slope across the frame) and offset are fitted robustly to cell means.
3. A camera shift is measured by least squares in 8 × 6 tiles (Lucas and Kanade 1981), starting from
   phase correlation if it is large. It is accepted only if tiles all over the frame agree, because
   a single beam in the dark must not be mistaken for a shaken camera.
4. The difference is examined at three scales. Its standard deviation is measured for each level of
   brightness (photon noise) and per gradient (residuals of a shift at edges). Of the two frames'
   values the smaller one is used, so that a beam does not raise the noise at its new position.
5. The threshold follows from the number of independent positions and the false-alarm rate.
"""

import math
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.imaging.frame import Frame, Pixels

_WIDTH, _HEIGHT = 400, 300  # size of reduced frames
_CELL = 8  # side, reduced px, of a cell whose mean enters the fit of gain and offset
_TILES, _SCALES, _LEVELS = (8, 6), 3, 8
_SATURATED = 0.98  # of full scale; brighter pixels do not show gain
_PARTLY = 0.88  # of full scale; brighter means may contain saturated pixels
#: Residuals of a shift at edges: median per standard deviation; bounds in reduced pixels; and upper
#: bound in frame pixels if no shift was accepted.
_EDGE, _LEAST_EDGE, _MOST_EDGE, _UNSURE = 2.0, 0.02, 0.1, 0.75
_APART = 4  # pixels between samples of noise; more than smoothing correlates
#: Factor on the threshold for normal noise, because its standard deviation is only estimated and
#: edges have heavy tails.
_MARGIN = 1.2
#: For white noise, smoothed as for the shift: mean squared gradient of the mean of two frames,
#: divided by the mean square of their difference; and pixels per independent value.
_NOISE_GRADIENT, _JOINED = 0.064, 4.3
_NORMAL = 1.4826  # standard deviation over the median absolute value of a normal distribution
_Image = npt.NDArray[Any]  # (H, W), float32 unless stated
_Pair = tuple[float, float]  # to the right and down, pixels


@dataclass(frozen=True)
class Region:
    """A connected part of a frame where light appeared or vanished.

    Attributes
    ----------
    appeared
        Whether the region became brighter rather than darker.
    area_px
        Area, pixels of the frame.
    centroid_px
        Centroid of the difference, pixels right and down.
    significance
        Greatest difference, in standard deviations of the noise.
    """

    appeared: bool
    area_px: float
    centroid_px: _Pair
    significance: float


@dataclass(frozen=True)
class FrameMotion:
    """The change between two frames.

    Attributes
    ----------
    moved
        Whether anything changed significantly.
    significance, threshold
        Largest difference anywhere, and the threshold, in standard deviations of the noise.
    area_px
        Total area of all regions, pixels of the frame.
    appeared_px, vanished_px
        Centroids of added and of removed light, pixels to the right and down; NaN if there is none.
    shift_px
        Shift of the scene to the right and down in the second frame; 0 if no shift was accepted.
    brightness_ratio
        Brightness of the static scene in the second frame divided by that in the first, in the
        middle of the frame.
    regions
        Regions, the most significant first.
    problem
        Why the frames cannot be compared, in which case ``moved`` is false; an empty string if they
        can.
    """

    moved: bool = False
    significance: float = 0.0
    threshold: float = math.nan
    area_px: float = 0.0
    appeared_px: _Pair = (math.nan, math.nan)
    vanished_px: _Pair = (math.nan, math.nan)
    shift_px: _Pair = (0.0, 0.0)
    brightness_ratio: float = math.nan
    regions: tuple[Region, ...] = ()
    problem: str = ""


@dataclass(frozen=True)
class MotionSettings:
    """Thresholds for motion detection.

    Attributes
    ----------
    false_alarms
        Accepted probability that a static pair of frames is reported as moved.
    min_area_px
        Smallest region that counts, pixels of the frame.
    max_shift_px, max_ratio
        Largest camera shift, pixels of the frame, and largest change of brightness, up or down,
        that are corrected; beyond these, the frames cannot be compared.
    """

    false_alarms: float = 1e-3
    min_area_px: float = 16.0
    max_shift_px: float = 16.0
    max_ratio: float = 3.0

    def __post_init__(self) -> None:
        if not 0.0 < self.false_alarms < 0.5:
            raise InputError(f"false alarms must be above 0 and below 0.5, not {self.false_alarms}")
        if not (self.min_area_px >= 0.0 and 0.0 <= self.max_shift_px < math.inf):
            text = f"not {self.min_area_px} px and {self.max_shift_px} px"
            raise InputError(f"least area and greatest shift must be 0 or more, {text}")
        if not 1.0 < self.max_ratio < math.inf:
            raise InputError(f"greatest ratio of brightness must be above 1, not {self.max_ratio}")


DEFAULT = MotionSettings()


@dataclass(frozen=True)
class _View:
    """A frame prepared for comparison: grey, with full scale 1, reduced by ``factor``."""

    image: _Image
    cells: _Image  # float64, cell means of ``image``
    factor: int
    step: float  # one digit, as a fraction of full scale
    size: tuple[int, int]


def detect_motion(
    before: Frame | Pixels,
    after: Frame | Pixels,
    mask: npt.ArrayLike | None = None,
    settings: MotionSettings = DEFAULT,
) -> FrameMotion:
    """Detect the motion between two frames from a fixed camera.

    Parameters
    ----------
    before, after
        Frames, or pixels (H, W) or (H, W, 3) of uint8 or uint16, of the same size.
    mask
        Mask of where motion counts, (H, W), true or not 0; None for everywhere. The rest of the
        frame is still used to measure shift and brightness.
    settings
        Thresholds.

    Raises
    ------
    InputError
        If the sizes differ, or the mask has a different size or excludes everything.
    """
    first, second = _view(before), _view(after)
    return _compare(first, second, _mask(mask, first), settings)


def find_shift(before: Frame | Pixels, after: Frame | Pixels) -> _Pair | None:
    """Return the shift of the scene to the right and down in ``after``, pixels.

    The result is None if no shift explains tiles all over the frames, because they lack texture or
    show different scenes. A shift below 1 px is accurate to about 0.05 px where there is texture.
    Raises InputError if the sizes differ.
    """
    first, second = _view(before), _view(after)
    shift = _register(_expected(first, second)[0], second.image)
    return (shift[0] * first.factor, shift[1] * first.factor) if shift else None


# -- preparation -----------------------------------------------------------------------


def _view(picture: Frame | Pixels) -> _View:
    import cv2

    frame = picture if isinstance(picture, Frame) else Frame(picture)
    width, height = frame.size
    if min(width, height) < 16:
        raise InputError(
            f"a frame of {width} × {height} px; motion detection needs 16 × 16 px or more"
        )
    factor = max(1, math.ceil(width / _WIDTH), math.ceil(height / _HEIGHT))
    grey = frame.grey
    if factor > 1:
        # Reduce by whole blocks, because the weights of a fractional reduction vary over the frame.
        size = (width // factor, height // factor)
        grey = grey[: size[1] * factor, : size[0] * factor]
        grey = cv2.resize(grey.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    image = grey.astype(np.float32) * np.float32(1.0 / frame.full_scale)
    return _View(image, _cells(image), factor, 1.0 / frame.full_scale, frame.size)


def _mask(mask: npt.ArrayLike | None, view: _View) -> _Image | None:
    import cv2

    if mask is None:
        return None
    counting = np.asarray(mask) != 0
    if counting.shape != (view.size[1], view.size[0]):
        raise InputError(
            f"a mask of {counting.shape} does not match frames of {view.size[::-1]} px"
        )
    if not counting.any():
        raise InputError("the mask excludes the whole frame; unmask a part of it")
    size = view.image.shape[1::-1]
    share = cv2.resize(counting.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.asarray(share > 0.0, dtype=np.uint8)


# -- brightness ------------------------------------------------------------------------


def _cells(image: _Image) -> _Image:
    import cv2

    h, w = image.shape
    size = (max(1, w // _CELL), max(1, h // _CELL))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float64)


def _expected(first: _View, second: _View) -> tuple[_Image, float]:
    """Return the first frame at the brightness of the second, and the brightness ratio.

    The gain, its slopes across the frame and the offset are fitted with Tukey's weights. Without
    contrast, offset and gain cannot be separated, so the offset is left out.
    """
    if first.size != second.size:
        raise InputError(
            f"frames of {first.size[0]} × {first.size[1]} and {second.size[0]} × {second.size[1]} "
            "px cannot be compared; use two frames from the same camera"
        )
    a, b = first.cells, second.cells
    y, x = np.mgrid[-1.0 : 1.0 : a.shape[0] * 1j, -1.0 : 1.0 : a.shape[1] * 1j]
    dark = first.step + second.step
    good = (a < _PARTLY) & (b < _PARTLY) & (a > dark)
    good |= good.sum() < 32
    a, b, x, y = a[good], b[good], x[good], y[good]
    start = max(float(_median(b)), first.step) / max(float(_median(a)), first.step)
    spread = _NORMAL * float(_median(np.abs(a - _median(a))))
    design = np.stack([a, a * x, a * y, np.ones_like(a)], axis=-1)
    p, rest = _fitted(design, b, start, first.step)
    if spread < 10.0 * rest + dark:
        p, _ = _fitted(design[:, :3], b, start, first.step)
    h, w = first.image.shape
    u = np.linspace(-1.0, 1.0, w, dtype=np.float32)
    v = np.linspace(-1.0, 1.0, h, dtype=np.float32)[:, None]
    gain = (np.float32(p[0]) + np.float32(p[1]) * u) + np.float32(p[2]) * v
    offset = np.float32(p[3] if len(p) > 3 else 0.0)
    return first.image * gain + offset, float(p[0])


def _fitted(design: _Image, b: _Image, start: float, step: float) -> tuple[_Image, float]:
    """Return the parameters of a robust fit, and the standard deviation of its residuals."""
    p = np.zeros(design.shape[1])
    p[0] = start
    scale = step
    for _ in range(8):
        rest = b - design @ p
        scale = max(_NORMAL * float(_median(np.abs(rest))), 0.1 * step)
        weight = np.square(np.clip(1.0 - np.square(rest / (4.685 * scale)), 0.0, None))
        normal = design.T @ (weight[:, None] * design)
        normal[np.diag_indices_from(normal)] += 1e-9 * max(1.0, float(np.trace(normal)))
        p = p + np.linalg.solve(normal, design.T @ (weight * rest))
    return p, scale


# -- shift -----------------------------------------------------------------------------


def _register(a: _Image, b: _Image) -> _Pair | None:
    """Return the shift of b relative to a, pixels; None if no shift is accepted."""
    import cv2

    if min(a.shape) < 32:
        return None
    near = _refine(a, b, (0.0, 0.0))
    if near is not None and math.hypot(*near[1]) < 0.5:
        return near[1]
    # Half the size is four times as fast, and accurate enough as a starting value.
    size = (a.shape[1] // 2, a.shape[0] // 2)
    halves = [cv2.resize(i, size, interpolation=cv2.INTER_AREA) for i in (a, b)]
    (x, y), _ = cv2.phaseCorrelate(halves[0], halves[1], cv2.createHanningWindow(size, cv2.CV_32F))
    far = _refine(a, b, (2.0 * x, 2.0 * y)) if math.hypot(x, y) < 0.25 * min(size) else None
    accepted = [refined for refined in (near, far) if refined is not None]
    return max(accepted)[1] if accepted else None


def _refine(a: _Image, b: _Image, start: _Pair) -> tuple[int, _Pair] | None:
    """Return the number of tiles that agree and their shift."""
    import cv2

    # Central differences are gradients only of a smooth image.
    a, b = (cv2.GaussianBlur(i, (5, 5), 1.0) for i in (a, b))
    x, y = start
    agreed = 0
    for _ in range(3):
        step = _tile_shift(_moved(a, x, y), b)
        if step is None:
            return None
        agreed, dx, dy = step
        x, y = x + dx, y + dy
        if math.hypot(dx, dy) < 0.01:
            break
    return agreed, (x, y)


def _moved(image: _Image, x: float, y: float) -> _Image:
    """Return the image shifted by x pixels to the right and y pixels down."""
    import cv2

    if x == 0.0 and y == 0.0:
        return image
    # Use the cubic kernel of Keys (1981, a = -0.5) at the exact position. OpenCV's warp would round
    # the position to 1/32 px, an error of 3 digits at an edge of 200 digits.
    whole = [math.floor(x), math.floor(y)]
    kernels = []
    for part in (x - whole[0], y - whole[1]):
        d = np.abs(part + np.arange(-2.0, 2.0))  # from the place to its four neighbours
        near = 1.5 * d**3 - 2.5 * d**2 + 1.0
        kernels.append(np.where(d <= 1.0, near, -0.5 * d**3 + 2.5 * d**2 - 4.0 * d + 2.0))
    edge = cv2.BORDER_REPLICATE
    out = cv2.sepFilter2D(image, cv2.CV_32F, kernels[0], kernels[1], anchor=(2, 2), borderType=edge)
    if whole != [0, 0]:
        matrix = np.array([[1.0, 0.0, whole[0]], [0.0, 1.0, whole[1]]])
        size, how = (image.shape[1], image.shape[0]), cv2.INTER_NEAREST
        out = cv2.warpAffine(out, matrix, size, flags=how, borderMode=edge)
    return out


def _tile_shift(a: _Image, b: _Image) -> tuple[int, float, float] | None:
    """Return the number of tiles that agree on a small shift, and the shift, pixels."""
    import cv2

    # The noise of the gradient of the mean is independent of that of the difference.
    both, d = cv2.addWeighted(a, 0.5, b, 0.5, 0.0), a - b
    gx = cv2.Sobel(both, cv2.CV_32F, 1, 0, scale=0.125)
    gy = cv2.Sobel(both, cv2.CV_32F, 0, 1, scale=0.125)
    xx, xy, yy, xd, yd, dd = (
        cv2.resize(p, _TILES, interpolation=cv2.INTER_AREA).ravel().astype(np.float64)
        for p in (gx * gx, gx * gy, gy * gy, gx * d, gy * d, d * d)
    )
    # Noise has gradients too, and the gradients of the quietest tile are not texture.
    quiet = min(float(np.partition(dd, 4)[4]) * _NOISE_GRADIENT, float(min(xx.min(), yy.min())))
    xx, yy = xx - quiet, yy - quiet
    trace, determinant = xx + yy, xx * yy - xy * xy
    weaker = 0.5 * trace - np.sqrt(np.maximum(0.25 * trace * trace - determinant, 0.0))
    safe = np.where(determinant > 0.0, determinant, 1.0)
    dx, dy = (yy * xd - xy * yd) / safe, (xx * yd - xy * xd) / safe
    # Standard deviation of a tile's shift in its weaker direction, from the residuals.
    pixels = a.size / len(xx) / _JOINED
    residual = np.maximum(dd - xd * dx - yd * dy, 1e-12)
    deviation = np.sqrt(residual / np.maximum(pixels * weaker, 1e-30))
    good = (determinant > 0.0) & (deviation < 0.1) & (weaker > 2.0 * residual * _NOISE_GRADIENT)
    if good.sum() < 4:
        return None
    mx, my = _median(dx[good]), _median(dy[good])
    near = good & (np.hypot(dx - mx, dy - my) < np.maximum(4.0 * deviation, 0.05))
    rows, columns = np.divmod(np.flatnonzero(near), _TILES[0])
    spread = max(np.ptp(columns) / _TILES[0], np.ptp(rows) / _TILES[1]) if len(rows) else 0.0
    if len(rows) < max(4.0, 0.5 * good.sum()) or spread < 0.4:
        return None
    # Solve for all tiles that agree at once, including tiles with edges in only one direction.
    s = [v[near].sum() for v in (xx, xy, yy, xd, yd)]
    whole = s[0] * s[2] - s[1] * s[1]
    x, y = (s[2] * s[3] - s[1] * s[4]) / whole, (s[0] * s[4] - s[1] * s[3]) / whole
    return int(near.sum()), float(x), float(y)


# -- difference ------------------------------------------------------------------------


def _compare(
    first: _View, second: _View, mask: _Image | None, settings: MotionSettings
) -> FrameMotion:
    if problem := _exposed(first, "first") or _exposed(second, "second"):
        return FrameMotion(problem=problem)
    expected, ratio = _expected(first, second)
    if not 1.0 / settings.max_ratio <= ratio <= settings.max_ratio:
        text = (
            f"the brightness changed by a factor of {ratio:.3g}; the limit is "
            f"{settings.max_ratio:g}"
        )
        return FrameMotion(brightness_ratio=ratio, problem=text)
    believed = _register(expected, second.image)
    reduced = believed or (0.0, 0.0)
    edge = max(_MOST_EDGE, 0.0 if believed else _UNSURE / first.factor)
    shift = (reduced[0] * first.factor, reduced[1] * first.factor)
    if math.hypot(*shift) > settings.max_shift_px:
        text = (
            f"the camera moved by {math.hypot(*shift):.1f} px; the limit is "
            f"{settings.max_shift_px:g} px"
        )
        return FrameMotion(shift_px=shift, brightness_ratio=ratio, problem=text)
    parts = _difference(first, second, expected, reduced, ratio)
    counts = np.ones(expected.shape, np.uint8) if mask is None else mask
    threshold = _threshold(places := int(np.count_nonzero(counts)), settings)
    high, low, weight = _significance(parts, counts, second.step, edge)
    unit = 2 * first.factor
    regions = [
        *_regions(high, weight, threshold, True, unit, settings.min_area_px),
        *_regions(-low, weight, threshold, False, unit, settings.min_area_px),
    ]
    regions.sort(key=lambda pair: -pair[0].significance)
    area = sum(region.area_px for region, _ in regions)
    if area > 0.5 * places * first.factor**2:
        problem = "more than half of the frame changed: a different scene or different lighting"
    return FrameMotion(
        moved=bool(regions) and not problem,
        significance=float(max(high.max(), -low.min())),
        threshold=threshold,
        area_px=area,
        appeared_px=_centroid(regions, True),
        vanished_px=_centroid(regions, False),
        shift_px=shift,
        brightness_ratio=ratio,
        regions=tuple(region for region, _ in regions),
        problem=problem,
    )


def _exposed(view: _View, which: str) -> str:
    most, full = float(view.cells.max()), float((view.cells >= _SATURATED).mean())
    if most < 4.0 * view.step:
        return (
            f"the {which} frame is dark: its brightest pixel has {most / view.step:.1f} digital "
            "counts"
        )
    if full > 0.5:
        return f"the {which} frame is overexposed: {100 * full:.0f} % of it is saturated"
    return ""


def _difference(
    first: _View, second: _View, expected: _Image, shift: _Pair, ratio: float
) -> list[_Image]:
    """Return the difference, the smaller brightness and gradient, and the valid pixels."""
    import cv2

    bright = np.maximum(first.image, expected)
    if math.hypot(*shift) > 0.005:
        expected, bright = _moved(expected, *shift), _moved(bright, *shift)
    expected = np.minimum(expected, np.float32(1.0))
    d = second.image - expected
    # Partly saturated pixels only show that they are bright.
    level = np.minimum(expected, second.image)
    blind = np.maximum(bright, second.image) > _PARTLY
    blind &= level > (_PARTLY - 0.1) * min(1.0, ratio)
    x, y = (math.ceil(abs(s)) + 1 for s in shift)  # a shifted frame is unknown at its edges
    blind[:y], blind[-y:], blind[:, :x], blind[:, -x:] = True, True, True, True
    d[blind] = 0.0
    slopes = [
        cv2.magnitude(*(cv2.Sobel(i, cv2.CV_32F, k, 1 - k, scale=0.125) for k in (0, 1)))
        for i in (expected, second.image)
    ]
    gradient = cv2.dilate(np.minimum(*slopes), np.ones((3, 3), np.uint8))
    return [d, level, gradient, 1.0 - blind.astype(np.float32)]


def _deviation(parts: list[_Image], step: float, edge: float) -> _Image:
    """Return the standard deviation of the noise, from nearby pixels without beams."""
    import cv2

    d, level, gradient, _ = parts
    n = max(1, math.isqrt(d.size // 5_000))
    every = np.s_[n // 2 :: n, n // 2 : -_APART : n]
    samples = [i[every].ravel() for i in parts]
    beside = [i[n // 2 :: n, n // 2 + _APART :: n].ravel() for i in (d, parts[3])]
    known = np.minimum(samples[3], beside[1]) > 0.99
    if np.count_nonzero(known) < 8 * _LEVELS:
        return np.full_like(d, step)
    samples[3] = samples[0] - beside[0]
    rest, light, slope, apart = (np.abs(sample[known]) for sample in samples)
    order = np.argsort(light)[: len(light) // _LEVELS * _LEVELS]
    # In each brightness bin, the half with the smaller gradients shows the noise.
    bins = order.reshape(_LEVELS, -1)
    flat = np.argpartition(slope[bins], bins.shape[1] // 2, axis=1)[:, : bins.shape[1] // 2]
    flat = np.take_along_axis(bins, flat, axis=1)
    noise = np.maximum(_NORMAL / math.sqrt(2.0) * _median(apart[flat]), step)
    places = _median(light[flat])
    digits = np.arange(256) / 255.0
    table = np.interp(digits, places, noise)
    # Above the brightest bin, photon noise grows with the square root of the brightness.
    table *= np.sqrt(np.maximum(digits / max(float(places[-1]), 1e-3), 1.0))
    quiet = cv2.LUT(cv2.convertScaleAbs(level, alpha=255.0), table.astype(np.float32))
    # These are the residuals of a shift per gradient, where the gradient is greatest.
    sharp = np.argpartition(slope, -(len(slope) // 32))[-(len(slope) // 32) :]
    excess = np.square(rest[sharp]) - np.square(quiet[every].ravel()[known][sharp])
    ratio = np.sqrt(np.maximum(excess, 0.0)) / np.maximum(slope[sharp], 1e-9)
    share = min(max(_EDGE * float(_median(ratio)), _LEAST_EDGE), edge)
    return cv2.magnitude(quiet, np.float32(share) * gradient)


def _median(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the median of each row; np.median is slower because of its checks."""
    half = values.shape[-1] // 2
    return np.asarray(np.partition(values, half, axis=-1)[..., half])


def _significance(
    parts: list[_Image], counts: _Image, step: float, edge: float
) -> tuple[_Image, _Image, _Image]:
    """Return the largest and smallest significance over all scales, and half the difference."""
    import cv2

    area = cv2.INTER_AREA
    middle = (counts.shape[1] // 2, counts.shape[0] // 2)
    high = low = np.zeros(middle[::-1], np.float32)
    weight = cv2.resize(parts[0], middle, interpolation=area)
    for scale in range(_SCALES):
        if scale and min(counts.shape) < 32:
            break
        if scale:
            size = (counts.shape[1] // 2, counts.shape[0] // 2)
            parts = [cv2.resize(i, size, interpolation=area) for i in parts]
            counts = cv2.resize(counts, size, interpolation=cv2.INTER_NEAREST)
        smooth = cv2.GaussianBlur(parts[0], (3, 3), 0.85, borderType=cv2.BORDER_CONSTANT)
        part = 0.5**scale
        z = smooth / _deviation([smooth, *parts[1:]], 0.3 * step * part, edge * part) * counts
        if scale == 0:
            quads = [z[i::2, j::2][: middle[1], : middle[0]] for i in (0, 1) for j in (0, 1)]
            most, least = np.maximum.reduce(quads), np.minimum.reduce(quads)
        else:
            most = least = cv2.resize(z, middle, interpolation=cv2.INTER_NEAREST)
        high, low = np.maximum(high, most), np.minimum(low, least)
    return high, low, weight


def _threshold(places: float, settings: MotionSettings) -> float:
    """Return the two-sided significance that noise exceeds at the accepted false-alarm rate."""
    from scipy.special import ndtri

    # Smoothing leaves about one independent position per four pixels of a scale.
    independent = sum(max(1.0, places / 4.0**scale / 4.0) for scale in range(_SCALES))
    return _MARGIN * float(-ndtri(settings.false_alarms / (2.0 * independent)))


def _regions(
    z: _Image, weight: _Image, threshold: float, appeared: bool, unit: int, least: float
) -> list[tuple[Region, float]]:
    """Return regions above 0.6 times the threshold that exceed it somewhere, and weights."""
    import cv2

    grown = (z > 0.6 * threshold).astype(np.uint8)
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(grown, connectivity=8)
    regions = []
    for label in np.unique(labels[z > threshold]):
        x, y, w, h, n = (int(v) for v in boxes[label])
        cut = (slice(y, y + h), slice(x, x + w))
        inside = labels[cut] == label
        light = np.abs(weight[cut]) * inside
        total = float(light.sum())
        if n * unit * unit < least or total <= 0.0:
            continue
        middle = (
            float((light.sum(axis=0) @ np.arange(x, x + w)) / total + 0.5) * unit - 0.5,
            float((light.sum(axis=1) @ np.arange(y, y + h)) / total + 0.5) * unit - 0.5,
        )
        peak = float((z[cut] * inside).max())
        regions.append((Region(appeared, float(n * unit * unit), middle, peak), total))
    return regions


def _centroid(regions: list[tuple[Region, float]], appeared: bool) -> _Pair:
    own = [
        (region.centroid_px, weight) for region, weight in regions if region.appeared == appeared
    ]
    total = sum(weight for _, weight in own) or math.nan
    x, y = (sum(place[i] * weight for place, weight in own) / total for i in (0, 1))
    return x, y


# -- a stream --------------------------------------------------------------------------


class MotionState(Enum):
    """The verdict of a `MotionDetector` on a frame."""

    WARMING_UP = "warming up"
    STILL = "still"
    MOVING = "moving"
    UNUSABLE = "unusable"


class MotionDetector:
    """Compares each frame of a stream with a background from earlier frames.

    The background is a running mean. Light that appears and stays counts as moving until it is
    absorbed into the background, after about ``memory · ln(significance / threshold)`` frames.
    Frames that cannot be compared do not update the background; after ``memory`` of them in a row
    the detector restarts.

    Parameters
    ----------
    mask, settings
        See `detect_motion`.
    memory
        Number of frames after which the weight of a frame falls to 1/e.
    warm_up
        Number of frames before the first verdict.
    """

    def __init__(
        self,
        mask: npt.ArrayLike | None = None,
        settings: MotionSettings = DEFAULT,
        memory: float = 20.0,
        warm_up: int = 5,
    ) -> None:
        if not 1.0 <= memory < math.inf or warm_up < 1:
            raise InputError(
                f"memory and warm-up must be 1 frame or more, not {memory} and {warm_up} frames"
            )
        self._mask, self._settings = mask, settings
        self._memory, self._warm_up = memory, warm_up
        self._background: _View | None = None
        self._averaged = self._refused = 0

    def update(self, frame: Frame | Pixels) -> tuple[MotionState, FrameMotion]:
        """Compare the next frame with the background.

        It raises InputError if the mask does not fit, or if the frame size changed.
        """
        view = _view(frame)
        mask = _mask(self._mask, view)
        if self._background is None:
            if problem := _exposed(view, "first"):
                return MotionState.UNUSABLE, FrameMotion(problem=problem)
            self._background, self._averaged, self._refused = view, 1, 0
            return MotionState.WARMING_UP, FrameMotion(brightness_ratio=1.0)
        motion = _compare(self._background, view, mask, self._settings)
        if motion.problem:
            self._refused += 1
            self._background = None if self._refused >= self._memory else self._background
            return MotionState.UNUSABLE, motion
        self._learn(view, motion)
        if self._averaged <= self._warm_up:
            return MotionState.WARMING_UP, motion
        return MotionState.MOVING if motion.moved else MotionState.STILL, motion

    def _learn(self, view: _View, motion: FrameMotion) -> None:
        """Adjust the background to the frame's light, then add the frame."""
        assert self._background is not None
        old, _ = _expected(self._background, view)
        x, y = (-s / view.factor for s in motion.shift_px)
        new = _moved(view.image, x, y) if math.hypot(x, y) > 0.005 else view.image
        self._averaged, self._refused = self._averaged + 1, 0
        share = np.float32(max(1.0 / self._averaged, 1.0 - math.exp(-1.0 / self._memory)))
        image = old + share * (new - old)
        self._background = replace(view, image=image, cells=_cells(image))
