"""Beams on a face: which pixels belong to which, and where each one's centroid is."""

from dataclasses import dataclass

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.imaging.background import Background, smooth
from heliotrope.imaging.frame import Image
from heliotrope.imaging.rectify import Mask, Rectified

#: A beam rises by this many deviations of the background's remains, and this much of it.
_SEED, _SEED_PART = 8.0, 0.06
#: It reaches to where it falls below this many deviations.
_FOOT = 5.0
#: And, however faint the paint's structure, below this part of its peak.
_FOOT_PART = 0.03
#: A neck is narrower than this part of a beam's breadth at half its height, either side.
_NECK = 0.3
#: Beyond its foot it has tails: grown by this part of its radius.
_TAIL = 0.15
#: Two tops are two beams if between them brightness falls by this part of the lower one.
_DIP = 0.4
#: The smallest beam, m²; the sun's image at 20 m is 0.03.
_SMALLEST = 0.03
#: A centroid over the foot and one over the tails differ by what the tails may hide.
_TAIL_SHARE = 0.5
#: Light below the foot is not seen. With the foot at the part φ of the peak it moves the
#: centroid by about this times φ^1.5 deviations of the beam: measured on 400 simulated
#: beams over photographs of empty targets, where it holds for peaks of 0.25 to 2 times
#: the background.
_HIDDEN = 0.75
#: Of the radius: what clipping the brightest part may move a centroid by.
_CLIP_SHARE = 0.15


@dataclass(frozen=True)
class Spot:
    """One beam on a face.

    Attributes
    ----------
    centroid
        Of its light, plane coordinates of the face, m, (2,).
    covariance
        Of the centroid, m², (2, 2): background, noise, tails and clipping.
    second_moments
        Of its light about the centroid, m², (2, 2).
    power
        Sum of its brightness over the background's, m².
    peak
        Its greatest brightness, of full scale, background not included.
    contrast
        That over the background's there.
    deviation
        Of the background's remains, of full scale: what the peak stands out of.
    clipped
        Part of its light that lies in clipped pixels.
    edge
        Brightness where it meets the border of the seen target, over its peak.
    covered
        Part of its area that marks cover.
    area
        m².
    sharpness
        Steepest slope of its flank, peaks per metre.
    region
        Its pixels, (H, W), tails included.
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
    sharpness: float
    region: Mask

    @property
    def axes(self) -> tuple[float, float, float]:
        """Standard deviations along its major and minor axis, m, and the major one's angle.

        The angle is counterclockwise from the right, rad.
        """
        values, vectors = np.linalg.eigh(self.second_moments)
        major = vectors[:, 1]
        angle = float(np.arctan2(major[1], major[0]) % np.pi)
        small, large = np.sqrt(np.maximum(values, 0.0))
        return float(large), float(small), angle


def find_spots(picture: Rectified, background: Background) -> list[Spot]:
    """Return the beams of a face, the most powerful first.

    Every pixel that stands out of the background belongs to the top that it descends
    from. A top counts as a beam of its own where brightness falls in between.
    """
    light = _light(picture, background)
    soft = smooth(picture, light, max(0.07 / picture.step, 1.0))
    foot = _FOOT * background.deviation
    level = float(np.median(background.values[picture.paint]))
    seed = max(_SEED * background.deviation, _SEED_PART * level)
    # Tops are broad: every third pixel shows them.
    coarse = _tops(soft[::3, ::3], picture.surface[::3, ::3], foot, seed)
    if coarse is None:
        return []
    tops = np.repeat(np.repeat(coarse, 3, axis=0), 3, axis=1)[: soft.shape[0], : soft.shape[1]]
    spots = []
    for number in range(1, int(tops.max()) + 1):
        core = _core(soft, tops == number, foot)
        if core.sum() * picture.step**2 < _SMALLEST:
            continue
        spots.append(_measure(picture, background, light, soft, core, tops))
    return sorted(spots, key=lambda s: -s.power)


def _core(soft: Image, owned: Mask, foot: float) -> Mask:
    """What hangs together with a beam's top above its foot."""
    import cv2

    height = float(soft[owned].max())
    top = np.unravel_index(int(np.argmax(np.where(owned, soft, -1.0))), soft.shape)
    above = owned & (soft > max(foot, _FOOT_PART * height))
    _, labels = cv2.connectedComponents(above.astype(np.uint8), connectivity=4)
    core = labels == labels[top]
    # A beam is bounded by what its upper half says of its breadth: through a neck that is
    # narrower something else hangs on to it.
    _, labels = cv2.connectedComponents((core & (soft > 0.5 * height)).astype(np.uint8))
    half = labels == labels[top]
    breadth = min(cv2.minAreaRect(np.argwhere(half).astype(np.float32))[1])
    neck = int(_NECK * breadth)
    if neck < 2:
        return np.asarray(core)
    # Opened by a disc: what is farther from the rim than its radius, and what is near that.
    inner = cv2.distanceTransform(core.astype(np.uint8), cv2.DIST_L2, 5) <= neck
    opened = cv2.distanceTransform(inner.astype(np.uint8), cv2.DIST_L2, 5) <= neck
    _, labels = cv2.connectedComponents((core & opened | half).astype(np.uint8), connectivity=4)
    return np.asarray(labels == labels[top])


def _light(picture: Rectified, background: Background) -> Image:
    """What beams add; where a mark covers the paint, what is around it says."""
    added = picture.values - background.values
    if not picture.marks.any():
        return added
    around = smooth(picture, added, max(0.1 / picture.step, 1.5))
    return np.where(picture.marks, around, added).astype(np.float32)


def _tops(soft: Image, inside: Mask, foot: float, seed: float) -> Image | None:
    """Number the beams: falling levels show tops appear, grow and meet."""
    import cv2

    highest = float(soft[inside].max(initial=0.0))
    if highest < seed:
        return None
    levels = np.geomspace(max(0.97 * highest, foot), foot, 24)
    peaks: dict[int, float] = {}
    owner = np.zeros(soft.shape, dtype=np.int32)
    # A pixel of each top stands for it: where its light is greatest.
    places: dict[int, tuple[int, int]] = {}
    for level in levels:
        _, labels = cv2.connectedComponents(((soft > level) & inside).astype(np.uint8))
        held: dict[int, list[int]] = {}
        for top, (row, column) in places.items():
            held.setdefault(int(labels[row, column]), []).append(top)
        for top, other in _meeting(held, peaks, float(level)):
            owner[owner == other] = top
            del peaks[other], places[other]
        fresh = np.unique(labels[(labels > 0) & (owner == 0)])
        for label in fresh:
            if label in held:
                continue
            part = labels == label
            height = float(soft[part].max())
            if height < seed:
                continue
            number = max(peaks, default=0) + 1
            while number in peaks or (owner == number).any():
                number += 1
            at = int(np.argmax(np.where(part, soft, -1.0)))
            peaks[number] = height
            places[number] = (at // soft.shape[1], at % soft.shape[1])
            held[int(label)] = [number]
        owner = _spread(owner, labels, held, places)
    return _renumbered(owner, peaks)


def _meeting(
    held: dict[int, list[int]], peaks: dict[int, float], level: float
) -> list[tuple[int, int]]:
    """Tops that have met without a dip between them: (the higher one, the lower one)."""
    gone = []
    for label, tops in held.items():
        if label == 0 or len(tops) < 2:
            continue
        highest = max(tops, key=lambda t: peaks[t])
        gone += [
            (highest, top) for top in tops if top != highest and level > (1.0 - _DIP) * peaks[top]
        ]
        held[label] = [t for t in tops if t == highest or level <= (1.0 - _DIP) * peaks[t]]
    return gone


def _spread(
    owner: Image, labels: Image, held: dict[int, list[int]],
    places: dict[int, tuple[int, int]],
) -> Image:  # fmt: skip
    """Give the pixels of this level to their tops; where several share, to the nearest."""
    from scipy.ndimage import distance_transform_edt

    grown = owner.copy()
    for label, tops in held.items():
        if label == 0:
            continue
        part = (labels == label) & (owner == 0)
        if len(tops) == 1:
            grown[part] = tops[0]
        elif part.any():
            mine = np.isin(owner, tops)
            for top in tops:
                mine[places[top]] = True
                if owner[places[top]] == 0:
                    owner[places[top]] = top
            nearest = distance_transform_edt(~mine, return_distances=False, return_indices=True)
            grown[part] = owner[nearest[0], nearest[1]][part]
    return grown


def _renumbered(owner: Image, peaks: dict[int, float]) -> Image | None:
    if not peaks:
        return None
    table = np.zeros(int(owner.max()) + 1, dtype=np.int32)
    for k, number in enumerate(sorted(peaks), start=1):
        if number < len(table):
            table[number] = k
    return np.asarray(table[owner], dtype=np.int32)


def _measure(
    picture: Rectified, background: Background, light: Image,
    soft: Image, core: Mask, tops: Image,
) -> Spot:  # fmt: skip
    """Return the moments of one beam and how certain they are."""
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
    top = np.unravel_index(int(np.argmax(np.where(core, soft, -1.0))), soft.shape)
    under = float(background.values[top])
    clipped = float(np.sum(weight * picture.clipped[box])) / max(total, 1e-12)
    slopes = np.hypot(*np.gradient(soft[box].astype(np.float64), step))
    covariance = _from_background(picture, background, region, box, dx, dy, total)
    hidden = min(max(_FOOT * background.deviation / max(peak, 1e-9), _FOOT_PART), 1.0)
    covariance = covariance + _HIDDEN**2 * hidden**3 * moments
    shift = narrow - centroid
    covariance = covariance + _TAIL_SHARE**2 * np.outer(shift, shift)
    covariance = covariance + max(clipped, 0.0) * _CLIP_SHARE**2 * moments
    return Spot(
        centroid=centroid,
        covariance=covariance,
        second_moments=moments,
        power=total * step**2 / max(under, 1e-6),
        peak=peak,
        contrast=peak / max(under, 1e-6),
        deviation=background.deviation,
        clipped=max(clipped, 0.0),
        edge=_edge(picture, soft, region) / max(peak, 1e-9),
        covered=float((picture.marks & core).sum() / core.sum()),
        area=float(core.sum()) * step**2,
        sharpness=float(slopes[core[box]].max(initial=0.0)) / max(peak, 1e-9),
        region=region,
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


def _from_background(
    picture: Rectified, background: Background, region: Mask, box: tuple[slice, slice],
    dx: FloatArray, dy: FloatArray, total: float,
) -> FloatArray:  # fmt: skip
    """Covariance of a centroid by the background's: of its fit, its remains, and noise.

    With light w = value − b, the centroid moves by −Σ (x − c) δb / Σ w.
    """
    inside = region[box].astype(np.float64)
    arms = np.stack([inside * dx[None, :], inside * dy[:, None]]) / max(total, 1e-12)
    spread = np.einsum("iyx,jyx->ij", arms, arms)
    # The fit: its derivatives are known on a coarser grid.
    stride = background.stride
    rows = np.arange(stride // 2, picture.shape[0], stride)
    columns = np.arange(stride // 2, picture.shape[1], stride)
    in_rows = (rows >= box[0].start) & (rows < box[0].stop)
    in_columns = (columns >= box[1].start) & (columns < box[1].stop)
    part = arms[:, rows[in_rows] - box[0].start][:, :, columns[in_columns] - box[1].start]
    basis = background.basis[in_rows][:, in_columns]
    moved = stride**2 * np.einsum("iyx,yxk->ik", part, basis)
    fit = moved @ background.covariance @ moved.T
    # What the fit leaves hangs together over patches of this many pixels.
    patch = max(background.patch / picture.step**2, 1.0)
    return np.asarray(fit + (patch * background.deviation**2 + background.noise**2) * spread)


def _edge(picture: Rectified, soft: Image, region: Mask) -> float:
    """Greatest brightness of a beam at the border of what is seen of the target."""
    import cv2

    seen = picture.surface.astype(np.uint8)
    inner = cv2.erode(seen, np.ones((5, 5), np.uint8), borderValue=0)
    rim = region & (inner == 0) & picture.surface
    return float(soft[rim].max(initial=0.0))
