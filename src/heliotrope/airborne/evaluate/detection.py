"""Detect mirrors (as bright patches), their outlines and lamp reflections in a photograph.

Pixel values are converted to light by the inverse of the sRGB curve before anything is measured;
otherwise edges and spots would be displaced.
"""

from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from heliotrope.airborne._photo_metadata import read_metadata
from heliotrope.airborne.evaluate.edges import cross_edges
from heliotrope.airborne.visibility import MARGIN, Labels
from heliotrope.errors import FormatError
from heliotrope.files.text import read_bytes
from heliotrope.geometry import FloatArray, as_float

Picture = npt.NDArray[np.uint8]
Rows = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]
Light = npt.NDArray[np.float32]

#: Readings of this value or more are clipped.
CLIPPED = 253
#: Quantiles of brightness that are taken as the brightness of a mirror.
_FILLED = (0.995, 0.9995, 0.97)
#: Fraction of an edge left out at each end, number of profiles across the edge, and number of
#: points measured on it.
_ENDS, _PROFILES, _GROUPS = 0.1, 32, 8
#: A drawn edge may be this far from its true position, px.
_UNSURE = 1.5
#: At least this many of the three groups nearest to a corner must be seen.
_NEAR_CORNER = 2
#: A spot exceeds its mirror by this many standard deviations of the noise, and by this fraction of
#: full scale.
_SPOT_SIGMAS, _SPOT_LEAST = 7.0, 0.02
#: The lamp exceeds its mirror by this fraction of the mirror's light. Where gaps of 0.4 px between
#: facets cross, a tenth of the surrounding light is missing.
_LAMP = 0.15
#: Most of a spot's light lies this close to its centre, px.
_REACH = 3.0
#: Brighter light is searched for up to this far beside a mirror, px.
_BESIDE = 4
#: Half the side of the window in which a spot is measured, and the width of the Gaussian weight,
#: px.
_WINDOW, _WEIGHT = 5, 1.8


@dataclass(frozen=True)
class Patches:
    """K bright patches that may be mirrors: centres (K, 2) and areas (K,), px."""

    center: FloatArray
    area: FloatArray

    def __len__(self) -> int:
        return len(self.area)


@dataclass(frozen=True)
class Outlines:
    """Outlines of M mirrors.

    Attributes
    ----------
    corners
        Pixels, in the order of the expected outline, (M, 4, 2).
    sigma
        Standard deviation of a corner in each direction, px, (M,).
    contrast
        Contrast of the weakest edge, as a fraction of full scale, (M,).
    known
        Whether both edges of a corner were found, (M, 4).
    """

    corners: FloatArray
    sigma: FloatArray
    contrast: FloatArray
    known: Mask

    @property
    def found(self) -> Mask:
        """Whether all four edges were found, (M,)."""
        return np.asarray(self.known.all(axis=1))


@dataclass(frozen=True)
class Overlap:
    """Which of M overlapping mirrors each pixel of a photograph shows.

    Attributes
    ----------
    labels
        See `heliotrope.airborne.visibility.draw_labels`, (H, W).
    own
        Label of each of the M mirrors, (M,).
    """

    labels: Labels
    own: Rows

    def clear(self, places: FloatArray, steps: FloatArray) -> Mask:
        """Return a mask of the edge profiles, (M, 4, P), that run from their mirror to the ground.

        ``places`` are pixel positions, (M, 4, P, S, 2), and ``steps`` the S distances from the
        edge, px.
        """
        height, width = self.labels.shape
        x = np.clip(np.round(places[..., 0]), 0, width - 1).astype(np.intp)
        y = np.clip(np.round(places[..., 1]), 0, height - 1).astype(np.intp)
        label = self.labels[y, x]
        own = label == self.own[:, None, None, None]
        good = np.where(steps < 0.0, own, label == 0) | (np.abs(steps) < _UNSURE)
        return np.asarray(good.all(axis=-1))


@dataclass(frozen=True)
class Spots:
    """S spots on mirrors.

    Attributes
    ----------
    mirror
        Index of the outline, (S,).
    pixel
        Centre, (S, 2).
    sigma
        Standard deviation of the centre in each direction, px, (S,).
    flux
        Light in excess of the mirror's, full scale times pixels, (S,).
    clipped
        Number of clipped pixels, (S,).
    """

    mirror: Rows
    pixel: FloatArray
    sigma: FloatArray
    flux: FloatArray
    clipped: Rows

    def __len__(self) -> int:
        return len(self.mirror)


def decode(path: str | Path) -> Picture:
    """Return a photograph in the rows and columns of the sensor, blue-green-red, (H, W, 3).

    Raises
    ------
    FormatError
        If there is no such file, or it is truncated, damaged, or above the limits of
        `heliotrope.files.limits`.
    """
    import cv2

    file = Path(path)
    try:
        data = read_bytes(file)
    except OSError as error:
        raise FormatError(
            file, f"cannot be read ({error.strerror}); specify another photograph"
        ) from None
    if data[:2] == b"\xff\xd8" and b"\xff\xd9" not in data[-4096:]:
        raise FormatError(file, f"the file ends after {len(data)} bytes; copy it again")
    # The header says how much memory the decoded picture takes.
    read_metadata(file)
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    if picture is None:
        raise FormatError(file, "not a readable image; copy it again")
    return np.asarray(picture, np.uint8)


@lru_cache(maxsize=1)
def _linear() -> npt.NDArray[np.float32]:
    share = np.arange(256) / 255.0
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return light.astype(np.float32)


# -- patches ---------------------------------------------------------------------------


def brightness(picture: Picture, scale: float) -> tuple[Light, Light]:
    """Return the light of a picture reduced by the factor ``scale``, and its fraction of blue."""
    import cv2

    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    light = _linear()[small]
    total = light[..., 0] + light[..., 1] + light[..., 2]
    blue = light[..., 0] / np.maximum(total, np.float32(1e-4))
    return np.asarray(total / np.float32(3.0)), np.asarray(blue)


def find_patches(picture: Picture, expected: float) -> tuple[Patches, ...]:
    """Return patches of about ``expected`` px² that differ from their surroundings.

    Mirrors show the sky, so they are brighter than the ground, or at least bluer. The fraction of
    the frame that they fill is unknown, so several sets are returned, the most likely first. They
    contain brighter patches for mirrors that fill more than 0.5 %, 0.05 % and 3 %, then bluer
    patches. Darker patches are not searched for, because they are shadows, which are arranged like
    the mirrors.
    """
    import cv2

    scale = float(np.clip(12.0 / np.sqrt(expected), 0.05, 1.0))
    side = max(3, int(10.0 * np.sqrt(expected) * scale)) | 1
    answers = []
    for feature in brightness(picture, scale):
        above = np.clip(feature - cv2.blur(feature, (side, side)), 0.0, None)
        # A quantile is used rather than the maximum, because the lamp is brighter than any mirror,
        # but small.
        for top in np.quantile(above, _FILLED):
            levels = np.clip(above * (255.0 / max(float(top), 1e-6)), 0.0, 255.0)
            _, mask = cv2.threshold(
                levels.astype(np.uint8), 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU
            )
            closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
            patches = _whole_patches(np.asarray(closed, np.uint8), expected * scale**2)
            # The centre of a reduced pixel is the centre of the pixels that it represents.
            center = (patches.center + 0.5) / scale - 0.5
            answers.append(Patches(center, patches.area / scale**2))
    return tuple(answers)


def _whole_patches(mask: npt.NDArray[np.uint8], expected: float) -> Patches:
    import cv2

    count, _, stats, centers = cv2.connectedComponentsWithStats(mask, connectivity=4)
    if count < 2:
        return Patches(np.empty((0, 2)), np.empty(0))
    area = stats[1:, cv2.CC_STAT_AREA].astype(np.float64)
    left, top = stats[1:, cv2.CC_STAT_LEFT], stats[1:, cv2.CC_STAT_TOP]
    width, height = stats[1:, cv2.CC_STAT_WIDTH], stats[1:, cv2.CC_STAT_HEIGHT]
    inside = (left > 0) & (top > 0)
    inside &= (left + width < mask.shape[1]) & (top + height < mask.shape[0])
    full = area > 0.45 * width * height
    good = inside & full & (area > 0.4 * expected) & (area < 2.2 * expected)
    return Patches(as_float(centers[1:][good]), area[good])


# -- outlines --------------------------------------------------------------------------


def sample(picture: Picture, places: FloatArray) -> FloatArray:
    """Interpolate the light at pixels (..., 2) bilinearly; outside the picture, use its border."""
    height, width = picture.shape[:2]
    x = np.clip(places[..., 0], 0.0, width - 1.001).ravel()
    y = np.clip(places[..., 1], 0.0, height - 1.001).ravel()
    j, i = x.astype(np.intp), y.astype(np.intp)
    a, b = (x - j).astype(np.float32)[:, None], (y - i).astype(np.float32)[:, None]
    curve, pixels, at = _linear(), picture.reshape(-1, 3), i * width + j
    corner = [curve[pixels[at + beside]] for beside in (0, 1, width, width + 1)]
    upper = corner[0] + a * (corner[1] - corner[0])
    lower = corner[2] + a * (corner[3] - corner[2])
    return as_float(upper + b * (lower - upper)).reshape(*places.shape[:-1], 3)


def find_outlines(
    picture: Picture,
    expected: FloatArray,
    reach: float,
    profiles: int = _PROFILES,
    shown: Overlap | None = None,
    *,
    printed: bool = False,
) -> Outlines:
    """Return the outlines of mirrors near the expected outlines.

    Profiles across each edge are projected onto the colour in which the two sides differ most, and
    averaged in eight groups, each of which yields a position on the edge
    (`heliotrope.airborne.evaluate.edges`). A straight line is fitted through these positions with
    weights that reject outliers, such as a neighbour or a shadow.

    Parameters
    ----------
    picture
        Blue-green-red.
    expected
        Corners in order, px, (M, 4, 2).
    reach
        Largest distance of an edge from the expected one, px.
    profiles
        Number of profiles across each edge, a multiple of eight; a smaller number is faster.
    shown
        What each pixel shows, if mirrors overlap. Only edges against the ground are then measured.
    printed
        Whether the outlines are squares printed on paper, which have no shadow beside them.
    """
    count = len(expected)
    if count == 0:
        none = np.empty(0)
        return Outlines(np.empty((0, 4, 2)), none, none, np.empty((0, 4), np.bool_))
    start, end = expected, np.roll(expected, -1, axis=1)
    along = end - start
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    unit = along / np.maximum(length, 1e-9)
    outward = np.stack([unit[..., 1], -unit[..., 0]], axis=-1)
    # Corners may run clockwise or anticlockwise, so outward means away from the middle.
    middle = expected.mean(axis=1, keepdims=True)
    side = np.sum((0.5 * (start + end) - middle) * outward, axis=-1, keepdims=True)
    outward = outward * np.sign(side)
    part = _ENDS + (1.0 - 2.0 * _ENDS) * (np.arange(profiles) + 0.5) / profiles
    steps = np.arange(-reach - 3.0, reach + 3.01, 0.5)
    places = (
        start[:, :, None, None]
        + part[None, None, :, None, None] * along[:, :, None, None]
        + steps[None, None, None, :, None] * outward[:, :, None, None]
    )
    colour = sample(picture, places)
    clear = np.ones(colour.shape[:3], np.bool_) if shown is None else shown.clear(places, steps)
    offset, contrast, known = cross_edges(colour, steps, reach, clear, _GROUPS, fitted=not printed)
    middles = part.reshape(_GROUPS, -1).mean(axis=1)
    points = start[:, :, None] + middles[:, None] * along[:, :, None]
    points = points + offset[..., None] * outward[:, :, None]
    lines, spread, enough = _lines(points, known, outward)
    corners = _crossings(lines)
    # At the ends of a line, the error is about twice that in its middle.
    count = np.maximum(enough.sum(axis=1), 1)
    sigma = np.sqrt(np.sum(np.where(enough, spread**2, 0.0), axis=1) / count) * 2.0
    # A corner is the end of the previous edge and the start of this edge.
    start_seen = known[..., :3].sum(axis=-1) >= _NEAR_CORNER
    end_seen = np.roll(known[..., -3:].sum(axis=-1) >= _NEAR_CORNER, 1, axis=1)
    both = enough & np.roll(enough, 1, axis=1) & np.isfinite(corners).all(axis=-1)
    of_corner: Mask = np.asarray(both if shown is None else both & start_seen & end_seen)
    return Outlines(np.where(of_corner[..., None], corners, np.nan), sigma, contrast, of_corner)


def _lines(
    points: FloatArray, known: Mask, outward: FloatArray
) -> tuple[FloatArray, FloatArray, Mask]:
    """Return lines a x + b y = c, (M, 4, 3), their errors, and a mask of the valid lines."""
    weight = known.astype(np.float64)
    enough = weight.sum(axis=-1) >= 4
    weight = np.where(enough[..., None], weight, 1.0)
    lines, residual = np.empty((*points.shape[:2], 3)), np.zeros(points.shape[:3])
    base = weight
    for _ in range(6):
        total = weight.sum(axis=-1)
        center = np.sum(weight[..., None] * points, axis=2) / total[..., None]
        gap = points - center[:, :, None]
        spread = np.einsum("mek,meki,mekj->meij", weight, gap, gap)
        normal = np.linalg.eigh(spread)[1][..., 0]
        normal = normal * np.sign(np.sum(normal * outward, axis=-1, keepdims=True))
        lines = np.concatenate([normal, np.sum(normal * center, axis=-1, keepdims=True)], axis=-1)
        residual = np.sum(gap * normal[:, :, None], axis=-1)
        typical = 1.4826 * np.median(np.abs(residual), axis=-1, keepdims=True)
        weight = base / (1.0 + (residual / (2.0 * np.maximum(typical, 0.03))) ** 2) ** 2
        weight = np.maximum(weight, 1e-9)
    deviation = np.sqrt(
        np.sum(weight * residual**2, axis=-1)
        / weight.sum(axis=-1)
        / np.maximum(base.sum(axis=-1) - 2.0, 1.0)
    )
    return lines, np.hypot(deviation, 0.01), enough


def _crossings(lines: FloatArray) -> FloatArray:
    """Return the intersection of each edge's line with that of the previous edge, (M, 4, 2)."""
    before = np.roll(lines, 1, axis=1)
    det = before[..., 0] * lines[..., 1] - before[..., 1] * lines[..., 0]
    det = np.where(np.abs(det) < 0.05, np.nan, det)
    x = (before[..., 2] * lines[..., 1] - before[..., 1] * lines[..., 2]) / det
    y = (before[..., 0] * lines[..., 2] - before[..., 2] * lines[..., 0]) / det
    return np.stack([x, y], axis=-1)


# -- spots -----------------------------------------------------------------------------


def find_spots(
    picture: Picture, corners: FloatArray, most: int = 12, shown: Overlap | None = None
) -> tuple[Spots, tuple[str, ...]]:
    """Return the lamp's spots on mirrors, and for each mirror why it has none ("" if it has some).

    Parameters
    ----------
    picture
        Blue-green-red.
    corners
        Corners of the mirrors, px, (M, 4, 2).
    most
        A mirror with more spots than this is skipped as "cluttered", because the spots are not the
        lamp's.
    shown
        What each pixel shows, if mirrors overlap; hidden parts are not searched.
    """
    spots: list[tuple[int, FloatArray, float, float, int]] = []
    reasons = []
    for k, outline in enumerate(corners):
        own, reason = _spots_of(picture, outline, shown, k)
        if len(own) > most:
            own, reason = [], f"cluttered: {len(own)} bright spots"
        reasons.append(reason)
        spots += [(k, *spot) for spot in own]
    return Spots(
        np.array([f[0] for f in spots], dtype=np.intp),
        as_float([f[1] for f in spots]).reshape(-1, 2),
        as_float([f[2] for f in spots]),
        as_float([f[3] for f in spots]),
        np.array([f[4] for f in spots], dtype=np.intp),
    ), tuple(reasons)


def _spots_of(
    picture: Picture, outline: FloatArray, shown: Overlap | None, k: int
) -> tuple[list[tuple[FloatArray, float, float, int]], str]:
    """Return the centre, sigma, flux and clipped pixels of a mirror's spots, or why it has none."""
    import cv2

    tall, width = picture.shape[:2]
    if (np.ptp(np.clip(outline, 0, [width, tall]), axis=0) < 5.0).any():
        return [], "too small: fewer than 5 pixels across"
    low = np.maximum(np.floor(outline.min(axis=0)).astype(int) - _BESIDE, 0)
    high = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + _BESIDE + 1, [width, tall])
    raw = picture[low[1] : high[1], low[0] : high[0]]
    inside = np.zeros(raw.shape[:2], np.uint8)
    cv2.fillConvexPoly(inside, np.round((outline - low) * 16).astype(np.int32), 1, shift=4)
    other = np.zeros_like(inside)
    if shown is not None:
        label = shown.labels[low[1] : high[1], low[0] : high[0]]
        inside &= label == shown.own[k]
        other = ((label > 0) & (label != shown.own[k])).astype(np.uint8)
    # Beside another mirror, a spot at the edge may belong to that mirror; beside the ground it
    # cannot.
    free = np.where(cv2.dilate(other, _disc(MARGIN + 1)) > 0, np.uint8(0), inside)
    narrower = MARGIN if shown is not None else 1
    square = np.ones((3, 3), np.uint8)
    inside = np.asarray(cv2.erode(inside, square, iterations=narrower), np.uint8)
    whole = np.asarray(inside | free, np.uint8)
    # For three colours, operators are faster than NumPy's reductions.
    bright = np.minimum(np.minimum(raw[..., 0], raw[..., 1]), raw[..., 2]) >= CLIPPED
    area = int(inside.sum())
    if area < 30:
        return [], "hidden: " * (shown is not None) + "too small: fewer than 30 pixels"
    if int((bright & (inside > 0)).sum()) > max(60, 0.3 * area):
        return [], "overexposed: the mirror is clipped"
    colour = _linear()[raw]
    light = as_float((colour[..., 0] + colour[..., 1] + colour[..., 2]) / 3.0)
    share = inside.astype(np.float32)
    fine = _mean(light, share, 0.9)
    coarse = _mean(light, share, 3.5)
    raised = np.where(inside > 0, fine - coarse, 0.0).astype(np.float32)
    values = raised[inside > 0]
    noise = 1.4826 * float(np.median(np.abs(values - np.median(values))))
    limit = max(_SPOT_SIGMAS * noise, _SPOT_LEAST)
    top = cv2.dilate(raised, np.ones((7, 7), np.uint8))
    spots = []
    peaks = (raised >= top) & (raised > limit)
    own = _own_peaks(light, raised, peaks, inside, whole)
    # Facet corners at a gap are brighter by less than this, and are not light beside another light.
    least = _LAMP * float(np.median(light[inside > 0]))
    places = [(a, b) for a, b, height, _ in own if height > least]
    for i, j, excess, held in own:
        alone = _without(held, (i, j), places)
        spot = _centroid(light, bright, alone, i, j, noise, excess)
        if spot is not None:
            spots.append((spot[0] + low, *spot[1:]))
    return spots, ""


def _own_peaks(
    light: FloatArray,
    raised: npt.NDArray[np.float32],
    peaks: Mask,
    inside: npt.NDArray[np.uint8],
    whole: npt.NDArray[np.uint8],
) -> list[tuple[int, int, float, npt.NDArray[np.uint8]]]:
    """Return the row, column, height and mask of each peak that belongs to a mirror.

    The blurred edge of a brighter neighbour brightens this mirror's corner, most of all beside dark
    ground, and half of a spot on the mirror behind is visible over this mirror's edge. A true spot
    is the brightest point of its surroundings in the whole picture, and that point is on this
    mirror, either in the searched part, ``inside``, or in ``whole`` beside the ground.
    """
    import cv2

    if not peaks.any():
        return []
    smooth = cv2.GaussianBlur(light.astype(np.float32), (0, 0), 0.9)
    around = cv2.dilate(smooth, _disc(_BESIDE - 1))
    tops: dict[tuple[int, int], tuple[float, npt.NDArray[np.uint8]]] = {}
    for i, j in np.argwhere(peaks).tolist():
        first = max(i - 2, 0), max(j - 2, 0)
        part = smooth[first[0] : i + 3, first[1] : j + 3]
        a, b = np.unravel_index(int(np.argmax(part)), part.shape)
        top = first[0] + int(a), first[1] + int(b)
        if whole[top] and smooth[top] >= around[top]:
            # The rest of the mirror is needed only for a peak beside the searched part.
            tops.setdefault(top, (float(raised[i, j]), inside if inside[top] else whole))
    return [(*place, *peak) for place, peak in tops.items()]


def _without(
    held: npt.NDArray[np.uint8], place: tuple[int, int], others: list[tuple[int, int]]
) -> npt.NDArray[np.uint8]:
    """Remove the light of other spots near ``place`` from a mask."""
    rows, columns = np.arange(held.shape[0])[:, None], np.arange(held.shape[1])
    mine = (rows - place[0]) ** 2 + (columns - place[1]) ** 2
    for a, b in others:
        if max(abs(a - place[0]), abs(b - place[1])) <= 2 * _WINDOW:
            its = (rows - a) ** 2 + (columns - b) ** 2
            held = np.where((its < mine) & (its < _REACH**2), np.uint8(0), held)
    return held


@cache
def _disc(radius: int) -> Picture:
    """Return a disc of ones in a square array with sides of 2 radius + 1."""
    x = np.arange(-radius, radius + 1)
    return np.asarray(np.hypot(x, x[:, None]) < radius + 0.5, np.uint8)


def _mean(light: FloatArray, share: npt.NDArray[np.float32], sigma: float) -> FloatArray:
    """Return the Gaussian mean of the light inside the mirror."""
    import cv2

    weight = cv2.GaussianBlur(share, (0, 0), sigma)
    total = cv2.GaussianBlur((light * share).astype(np.float32), (0, 0), sigma)
    return as_float(total / np.maximum(weight, 1e-6))


def _centroid(
    light: FloatArray,
    bright: Mask,
    inside: npt.NDArray[np.uint8],
    i: int,
    j: int,
    noise: float,
    raised: float,
) -> tuple[FloatArray, float, float, int] | None:
    """Return the centre (x, y), sigma, flux and clipped pixels of the spot at row i, column j.

    The centre is the mean of the light in excess of the mirror's, with a Gaussian weight that is
    moved to the centre. For a clipped spot it is the unweighted mean of the light above half of the
    peak.
    """
    rows = np.arange(max(i - _WINDOW, 0), min(i + _WINDOW + 1, light.shape[0]))
    columns = np.arange(max(j - _WINDOW, 0), min(j + _WINDOW + 1, light.shape[1]))
    part = light[np.ix_(rows, columns)]
    held = inside[np.ix_(rows, columns)] > 0
    far = np.hypot(rows[:, None] - i, columns[None] - j)
    ring = held & (far >= 3.5)
    if int(ring.sum()) < 6:
        return None
    above = np.where(held, part - np.median(part[ring]), 0.0)
    # Where gaps between facets cross, or beside a hidden part, the surrounding mean is low. A true
    # spot is therefore also required to be brighter than the bright part of its surroundings.
    if float(part[far < 1.2].mean() - np.quantile(part[ring], 0.97)) < 0.8 * raised:
        return None
    clipped = int(np.sum(bright[np.ix_(rows, columns)] & (far <= _WINDOW)))
    peak = float(above.max())
    center = np.array([float(j), float(i)])
    if clipped > 3:
        weight = np.where((above > 0.5 * peak) & (far <= _WINDOW), above, 0.0)
        center = (
            np.array([np.sum(weight * columns[None]), np.sum(weight * rows[:, None])])
            / weight.sum()
        )
    else:
        for _ in range(12):
            away = np.hypot(rows[:, None] - center[1], columns[None] - center[0])
            weight = above * np.exp(-0.5 * (away / _WEIGHT) ** 2)
            total = float(weight.sum())
            if total <= 0.0:
                return None
            mean = np.array([np.sum(weight * columns[None]), np.sum(weight * rows[:, None])])
            step = mean / total - center
            center = center + step
            if np.abs(center - [j, i]).max() > 2.5:
                return None
            if np.abs(step).max() < 1e-4:
                break
    flux = float(above[far <= 3.5].sum())
    if flux <= 0.0:
        return None
    # The noise of a centroid is the pixel noise times its lever, divided by the light.
    sigma = float(np.hypot(noise * 1.2 * np.sqrt(20.0) * 1.5 / flux, 0.03 + 0.02 * (clipped > 3)))
    return center, sigma, flux, clipped
