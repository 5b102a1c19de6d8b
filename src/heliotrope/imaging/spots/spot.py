"""Find spots on a face: which pixels belong to each spot, and where its centroid is."""

from dataclasses import dataclass

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Image
from heliotrope.imaging.spots._border import NOTHING, beyond
from heliotrope.imaging.spots._top_kernels import number_tops
from heliotrope.imaging.spots.background import Background, smooth
from heliotrope.imaging.targets.rectify import Mask, Rectified

#: Minimum peak of a beam, in standard deviations of the background residuals, and relative to the
#: background.
_SEED, _SEED_PART = 8.0, 0.06
#: A beam ends where it falls below this many standard deviations,
_FOOT = 5.0
#: and below this fraction of its peak, however faint the structure of the paint.
_FOOT_PART = 0.03
#: A neck is narrower, on either side, than this fraction of a beam's width at half its height.
_NECK = 0.3
#: A beam is extended beyond its foot by this fraction of its radius, to include its tails.
_TAIL = 0.15
#: Paint darker than this fraction of the usual paint is not used to measure light.
_DARKEST = 0.4
#: Two tops are two beams if the brightness between them falls by this fraction of the lower top (on
#: a hundred measured beams at Jülich, facets of one heliostat reach at most 0.16),
_DIP = 0.18
#: and by this many standard deviations of the background residuals.
_DIP_LEAST = 4.0
#: Skewness is measured where a beam is brighter than this fraction of its peak.
_BODY = 0.1
#: Smallest area of a beam, m²; the sun's image at 20 m has 0.03 m².
_SMALLEST = 0.03
#: Fraction of the difference between the centroids with and without the tails that counts as error.
_TAIL_SHARE = 0.5
#: Light below the foot is not measured. With the foot at the fraction φ of the peak, that light
#: moves the centroid by about this factor times φ^1.5 times the beam's standard deviation. The
#: factor was measured on 400 simulated beams over photographs of empty targets, for peaks of 0.25
#: to 2 times the background.
_HIDDEN = 0.6
#: Error from the estimated light beyond the border, as a fraction of the largest shift that this
#: light can cause.
_CUT_SHARE = 0.4
#: Shift of a centroid when the brightest part is clipped, as a fraction of the beam radius.
_CLIP_SHARE = 0.15


@dataclass(frozen=True)
class Spot:
    """One beam on a face.

    Attributes
    ----------
    centroid
        Centroid of the beam's light, including the estimated light beyond the target border, in
        plane coordinates of the face, m, (2,).
    covariance
        Covariance of the centroid, m², (2, 2), due to background, noise, tails, border and
        clipping.
    second_moments
        Second moments of the light on the target about its own centre, m², (2, 2).
    power
        Sum of the beam's brightness relative to that of the background, m².
    peak
        Largest brightness above the background, as a fraction of full scale.
    contrast
        Peak relative to the background at that point.
    deviation
        Standard deviation of the background residuals, as a fraction of full scale.
    clipped
        Fraction of the light that is in clipped pixels.
    edge
        Brightness at the border of the visible target, relative to the peak.
    covered
        Fraction of the spot's area that marks cover.
    area
        m².
    region
        Mask of the spot's pixels, including tails, (H, W).
    cut
        Shift of ``centroid`` due to the light beyond the border, m.
    light
        Sum of the beam's brightness, in full scales times m².
    skewness
        Norm of the third moments of the beam's core, in units of its standard deviations; 0 if
        symmetric.
    """

    centroid: FloatArray
    covariance: FloatArray
    second_moments: FloatArray
    power: float
    peak: float
    contrast: float
    deviation: float
    clipped: float
    edge: float
    covered: float
    area: float
    region: Mask
    cut: float = 0.0
    light: float = float("nan")
    skewness: float = 0.0

    @property
    def axes(self) -> tuple[float, float, float]:
        """Standard deviations along the major and minor axes, m, and angle of the major axis, rad.

        The angle is counterclockwise from the right.
        """
        values, vectors = np.linalg.eigh(self.second_moments)
        major = vectors[:, 1]
        angle = float(np.arctan2(major[1], major[0]) % np.pi)
        small, large = np.sqrt(np.maximum(values, 0.0))
        return float(large), float(small), angle


def find_spots(picture: Rectified, background: Background) -> list[Spot]:
    """Return the spots on a face, the most powerful first.

    Every pixel above the background belongs to the local maximum from which it descends. Maxima are
    separate beams if the brightness drops between them.
    """
    light = beam_light(picture, background)
    soft = smooth(picture, light, max(0.07 / picture.step, 1.0))
    foot = _FOOT * background.deviation
    level = float(np.median(background.values[picture.paint]))
    seed = max(_SEED * background.deviation, _SEED_PART * level)
    # Tops are broad, so every third pixel suffices to find them.
    small = np.ascontiguousarray(soft[::3, ::3])
    coarse = np.zeros(small.shape, dtype=np.int32)
    least = _DIP_LEAST * background.deviation
    count = number_tops(
        small, np.ascontiguousarray(picture.surface[::3, ::3]), foot, seed, _DIP, least, coarse
    )
    tops = np.repeat(np.repeat(coarse, 3, axis=0), 3, axis=1)[: soft.shape[0], : soft.shape[1]]
    spots = []
    for number in range(1, count + 1):
        core = _core(soft, tops == number, foot)
        if core.sum() * picture.step**2 < _SMALLEST:
            continue
        spots.append(_measure(picture, background, light, soft, core, tops))
    return sorted(spots, key=lambda s: -s.power)


def _core(soft: Image, owned: Mask, foot: float) -> Mask:
    """Return a mask of the pixels above the foot that are connected to a beam's top."""
    import cv2

    height = float(soft[owned].max())
    top = np.unravel_index(int(np.argmax(np.where(owned, soft, -1.0))), soft.shape)
    above = owned & (soft > max(foot, _FOOT_PART * height))
    _, labels = cv2.connectedComponents(above.astype(np.uint8), connectivity=4)
    core = labels == labels[top]
    # The upper half defines the width of the beam; anything connected through a narrower neck is a
    # separate object.
    _, labels = cv2.connectedComponents((core & (soft > 0.5 * height)).astype(np.uint8))
    half = labels == labels[top]
    breadth = min(cv2.minAreaRect(np.argwhere(half).astype(np.float32))[1])
    neck = int(_NECK * breadth)
    if neck < 2:
        return np.asarray(core)
    # Morphological opening by a disc keeps the pixels farther from the rim than the disc's radius,
    # and pixels near these.
    inner = cv2.distanceTransform(core.astype(np.uint8), cv2.DIST_L2, 5) <= neck
    opened = cv2.distanceTransform(inner.astype(np.uint8), cv2.DIST_L2, 5) <= neck
    _, labels = cv2.connectedComponents((core & opened | half).astype(np.uint8), connectivity=4)
    return np.asarray(labels == labels[top])


def beam_light(picture: Rectified, background: Background) -> Image:
    """Return the light of beams, as paint with the usual reflectance would show it.

    On marks the light is interpolated from their surroundings.
    """
    added = picture.values - background.values
    if background.reflectance is not None:
        added = added / np.maximum(background.reflectance, _DARKEST)
    if not picture.marks.any():
        return added
    around = smooth(picture, added, max(0.1 / picture.step, 1.5))
    return np.where(picture.marks, around, added).astype(np.float32)


def _measure(
    picture: Rectified,
    background: Background,
    light: Image,
    soft: Image,
    core: Mask,
    tops: Image,
) -> Spot:
    """Return one beam, with its moments and the covariance of its centroid."""
    import cv2

    step = picture.step
    radius = np.sqrt(core.sum() / np.pi)
    grow = max(round(float(_TAIL * radius)), 2)
    size = (2 * grow + 1, 2 * grow + 1)
    wide = cv2.dilate(core.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, size))
    region = (wide > 0) & picture.surface & ((tops == 0) | core)
    box = _box(region)
    inside = region[box]
    x, y = picture.axes[0][box[1]].astype(np.float64), picture.axes[1][box[0]].astype(np.float64)
    weight = np.where(inside, light[box], 0.0).astype(np.float64)
    total, centroid = _centroid(weight, x, y)
    _, narrow = _centroid(np.where(core[box], weight, 0.0), x, y)
    dx, dy = x - centroid[0], y - centroid[1]
    moments = _second(np.maximum(weight, 0.0), dx, dy)
    peak = float(soft[core].max())
    edge = _edge(picture, soft, region)
    outside = NOTHING
    if edge > 0.0:
        outside = beyond(picture, soft, region, total * step**2, peak, centroid, moments)
    top = np.unravel_index(int(np.argmax(np.where(core, soft, -1.0))), soft.shape)
    under = float(background.values[top])
    clipped = max(float(np.sum(weight * picture.clipped[box])) / max(total, 1e-12), 0.0)
    covariance = _from_background(picture, background, region, box, dx, dy, total)
    hidden = min(max(_FOOT * background.deviation / max(peak, 1e-9), _FOOT_PART), 1.0)
    shift = narrow - centroid
    covariance = (
        covariance
        + _HIDDEN**2 * hidden**3 * moments
        + _TAIL_SHARE**2 * np.outer(shift, shift)
        + _CUT_SHARE**2 * np.outer(outside.most, outside.most)
        + clipped * _CLIP_SHARE**2 * moments
    )
    return Spot(
        centroid=centroid + outside.shift,
        covariance=covariance,
        second_moments=moments,
        power=total * step**2 / max(under, 1e-6),
        peak=peak,
        contrast=peak / max(under, 1e-6),
        deviation=background.deviation,
        clipped=clipped,
        edge=edge / max(peak, 1e-9),
        covered=float((picture.marks & core).sum() / core.sum()),
        area=float(core.sum()) * step**2,
        region=region,
        cut=float(np.hypot(*outside.shift)),
        light=total * step**2,
        skewness=_skewness(np.where(core[box] & (soft[box] > _BODY * peak), soft[box], 0.0), x, y),
    )


def _box(region: Mask) -> tuple[slice, slice]:
    rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def _centroid(weight: FloatArray, x: FloatArray, y: FloatArray) -> tuple[float, FloatArray]:
    total = float(weight.sum())
    safe = total if abs(total) > 1e-12 else 1e-12
    return total, np.array([weight.sum(axis=0) @ x, weight.sum(axis=1) @ y]) / safe


def _second(weight: FloatArray, dx: FloatArray, dy: FloatArray) -> FloatArray:
    total = max(float(weight.sum()), 1e-12)
    xx, yy = weight.sum(axis=0) @ dx**2, weight.sum(axis=1) @ dy**2
    xy = dy @ weight @ dx
    return np.array([[xx, xy], [xy, yy]]) / total


def _skewness(weight: FloatArray, x: FloatArray, y: FloatArray) -> float:
    """Return the norm of the third moments of light scaled to unit second moments."""
    total, centre = _centroid(weight, x, y)
    dx, dy = x - centre[0], y - centre[1]
    moments = _second(weight, dx, dy)
    if total <= 0.0 or np.linalg.det(moments) <= 0.0:
        return 0.0
    xx, yy = weight @ dx**2, (dy**2) @ weight
    third = np.empty((2, 2, 2))
    third[0, 0, 0] = weight.sum(axis=0) @ dx**3
    third[0, 0, 1] = third[0, 1, 0] = third[1, 0, 0] = dy @ xx
    third[0, 1, 1] = third[1, 0, 1] = third[1, 1, 0] = yy @ dx
    third[1, 1, 1] = weight.sum(axis=1) @ dy**3
    white = np.linalg.inv(np.linalg.cholesky(moments))
    return float(np.linalg.norm(np.einsum("ijk,ai,bj,ck->abc", third / total, white, white, white)))


def _from_background(
    picture: Rectified,
    background: Background,
    region: Mask,
    box: tuple[slice, slice],
    dx: FloatArray,
    dy: FloatArray,
    total: float,
) -> FloatArray:
    """Return a centroid's covariance due to the background fit, its residuals, and noise.

    With light w = value − b, the centroid moves by −Σ (x − c) δb / Σ w.
    """
    inside = region[box].astype(np.float64)
    arms = np.stack([inside * dx[None, :], inside * dy[:, None]]) / max(total, 1e-12)
    spread = np.einsum("iyx,jyx->ij", arms, arms)
    # The derivatives of the fit are known only on a coarser grid.
    stride = background.stride
    rows = np.arange(stride // 2, picture.shape[0], stride)
    columns = np.arange(stride // 2, picture.shape[1], stride)
    in_rows = (rows >= box[0].start) & (rows < box[0].stop)
    in_columns = (columns >= box[1].start) & (columns < box[1].stop)
    part = arms[:, rows[in_rows] - box[0].start][:, :, columns[in_columns] - box[1].start]
    basis = background.basis[in_rows][:, in_columns]
    moved = stride**2 * np.einsum("iyx,yxk->ik", part, basis)
    fit = moved @ background.covariance @ moved.T
    return np.asarray(fit + pixel_variance(picture, background) * spread)


def pixel_variance(picture: Rectified, background: Background) -> float:
    """Return the variance of a pixel's light, as if pixels were independent of each other.

    Residuals of the background fit are correlated over patches, so each residual counts for all
    pixels of a patch.
    """
    patch = max(background.patch / picture.step**2, 1.0)
    return patch * background.deviation**2 + background.noise**2


def _edge(picture: Rectified, soft: Image, region: Mask) -> float:
    """Return the greatest brightness of a beam at the border of the visible target."""
    import cv2

    visible = picture.surface.astype(np.uint8)
    inner = cv2.erode(visible, np.ones((5, 5), np.uint8), borderValue=0)
    rim = region & (inner == 0) & picture.surface
    return float(soft[rim].max(initial=0.0))
