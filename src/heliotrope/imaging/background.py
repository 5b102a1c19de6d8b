"""What the target would look like without a beam."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Image
from heliotrope.imaging.rectify import Mask, Rectified

#: The fit looks at every so-many-th pixel.
_STRIDE = 6
#: Order of the polynomial across a target; more along a longer face.
_ORDER = 6
#: Light on a target is smooth: standard deviation of the terms of order n, over the mean,
#: is this over n^1.5. Photographs of empty targets have 0.06 at the first order and 0.005
#: at the sixth.
_UNEVEN = 0.1
#: Joints and stains hang together over about this area, m², until it is measured.
_PATCH = 0.4
#: Brighter than the background by this many deviations: a beam.
_HOT = 3.0
#: What is near a beam holds its tails: pixels of the fit's grid.
_NEAR = 3


@dataclass(frozen=True)
class Background:
    """A face without its beams, and how certain that is.

    Attributes
    ----------
    values
        Brightness over full scale, (H, W).
    deviation
        Standard deviation of what is left of the paint after smoothing, of full scale.
    noise
        Standard deviation of a pixel, of full scale.
    patch
        Area over which what is left hangs together, m².
    basis
        Derivatives of the values by the numbers of the fit at the fit's grid, (h, w, K).
    covariance
        Of those numbers, (K, K).
    stride
        Grid pixels from one row of the fit's grid to the next.
    method
        "frame", "difference" or "model".
    seen
        Part of the paint that was free of beams.
    """

    values: Image
    deviation: float
    noise: float
    patch: float
    basis: FloatArray
    covariance: FloatArray
    stride: int
    method: str
    seen: float


def from_frame(picture: Rectified) -> Background:
    """Return the background of one frame alone: smooth light on even paint.

    A polynomial is fitted to what no beam lights. Beams are bright, so they are what
    stands out above the fit; their surroundings are left out with them, and the fit is
    made again until nothing changes.
    """
    return _fit(picture, np.ones(picture.shape, dtype=np.float32), _orders(picture), "frame")


def from_difference(picture: Rectified, without: Rectified) -> Background:
    """Return the background from a second frame that shows the target without the beam.

    The light may have changed from frame to frame: a plane of ratios is fitted.

    Raises
    ------
    InputError
        If the two do not show the same face on the same grid.
    """
    if without.shape != picture.shape or not np.allclose(without.first, picture.first):
        raise InputError(
            f"the empty frame shows {without.shape} pixels of another face than the frame with "
            f"the beam, {picture.shape}; give two frames of the same target"
        )
    return _fit(picture, without.values, (1, 1), "difference")


@dataclass(frozen=True)
class EmptyTarget:
    """A running model of an empty face: how bright its paint is, pixel by pixel.

    Attributes
    ----------
    reflectance
        Brightness over that of the smooth light, (H, W).
    weight
        Frames that each pixel stands on, forgotten ones less, (H, W).
    memory
        Frames after which a frame counts a third.
    """

    reflectance: Image
    weight: Image
    memory: float = 50.0

    @staticmethod
    def of(picture: Rectified, memory: float = 50.0) -> "EmptyTarget":
        """Return a model that has seen nothing yet."""
        ones = np.ones(picture.shape, dtype=np.float32)
        return EmptyTarget(ones, np.zeros_like(ones), memory)

    def learn(self, picture: Rectified, spots: Mask | None = None) -> "EmptyTarget":
        """Return the model after another frame.

        Parameters
        ----------
        picture
            A frame, with or without beams.
        spots
            Where beams are in it, (H, W): nothing is learnt there. By default they are
            looked for.
        """
        if picture.shape != self.reflectance.shape:
            raise InputError(
                f"the model is of {self.reflectance.shape} pixels, the frame of {picture.shape}"
            )
        light = from_frame(picture)
        lit = beams(picture, light) if spots is None else spots
        good = picture.surface & ~lit & (light.values > 0.02)
        ratio = np.where(good, picture.values / np.maximum(light.values, 0.02), 1.0)
        kept = self.weight * np.float32(np.exp(-1.0 / self.memory))
        weight = np.where(good, kept + 1.0, self.weight)
        change = (ratio - self.reflectance) / np.maximum(weight, 1.0)
        reflectance = np.where(good, self.reflectance + change, self.reflectance)
        return replace(
            self, reflectance=reflectance.astype(np.float32), weight=weight.astype(np.float32)
        )


def from_model(picture: Rectified, model: EmptyTarget) -> Background:
    """Return the background of a frame from what the empty target is known to look like.

    Raises
    ------
    InputError
        If the model is of another grid.
    """
    if picture.shape != model.reflectance.shape:
        raise InputError(
            f"the model is of {model.reflectance.shape} pixels, the frame of {picture.shape}"
        )
    columns, rows = _orders(picture)
    return _fit(picture, model.reflectance, (max(columns // 3, 1), max(rows // 3, 1)), "model")


def beams(picture: Rectified, background: Background) -> Mask:
    """Return what a beam lights, tails included, (H, W)."""
    import cv2

    above = smooth(picture, picture.values - background.values, 2.0)
    hot = (above > _HOT * background.deviation) & picture.paint
    reach = 2 * _NEAR * _STRIDE + 1
    return cv2.dilate(hot.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0


def smooth(picture: Rectified, values: Image, sigma: float) -> Image:
    """Return values smoothed over bare paint; on a mark what its surroundings say.

    Parameters
    ----------
    picture
        Whose marks and edges are left out.
    values
        (H, W).
    sigma
        Grid pixels.
    """
    import cv2

    paint = picture.paint.astype(np.float32)
    top = cv2.GaussianBlur(np.asarray(values, dtype=np.float32) * paint, (0, 0), sigma)
    bottom = cv2.GaussianBlur(paint, (0, 0), sigma)
    return np.asarray(top / np.maximum(bottom, 1e-3), dtype=np.float32)


def _orders(picture: Rectified) -> tuple[int, int]:
    rows, columns = picture.shape
    short = min(rows, columns)
    return (
        min(round(_ORDER * columns / short), 12),
        min(round(_ORDER * rows / short), 12),
    )


def _terms(orders: tuple[int, int]) -> list[tuple[int, int, float]]:
    """Which products of polynomials are fitted: order across, order up, and order in all."""
    top = min(order for order in orders if order > 0)
    found = []
    for i in range(orders[0] + 1):
        for j in range(orders[1] + 1):
            share = i / max(orders[0], 1) + j / max(orders[1], 1)
            if share <= 1.0 + 1e-9:
                found.append((i, j, share * top))
    return found


@lru_cache(maxsize=16)
def _polynomials(shape: tuple[int, int], orders: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Legendre polynomials over a grid, (H, W, K), and their orders across a target, (K,)."""
    along_x = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, shape[1]), orders[0])
    along_y = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, shape[0]), orders[1])
    terms = _terms(orders)
    table = np.stack([np.outer(along_y[:, j], along_x[:, i]) for i, j, _ in terms], axis=-1)
    return np.asarray(table, dtype=np.float64), np.array([order for _, _, order in terms])


def _ridge(
    A: FloatArray, b: FloatArray, variance: float, prior: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Numbers of greatest posterior probability and their covariance."""
    information = A.T @ A / variance + np.diag(prior)
    covariance = np.linalg.inv(information)
    numbers = np.asarray(covariance @ (A.T @ b) / variance, dtype=np.float64)
    return numbers, np.asarray(covariance, dtype=np.float64)


def _fit(
    picture: Rectified,
    pattern: Image,
    orders: tuple[int, int],
    method: str,
) -> Background:
    """Fit pattern × polynomial to the paint that no beam lights."""
    import cv2

    part = np.s_[_STRIDE // 2 :: _STRIDE, _STRIDE // 2 :: _STRIDE]
    soft = smooth(picture, picture.values, 2.0)[part].astype(np.float64)
    paint = picture.paint[part]
    multiplier = smooth(picture, pattern, 2.0)[part].astype(np.float64)
    table, order = _polynomials((soft.shape[0], soft.shape[1]), orders)
    small = table * multiplier[..., None]
    A, b = small[paint], soft[paint]
    if len(b) < 4 * A.shape[1]:
        raise InputError(
            f"only {len(b)} places of bare paint are seen: too few for a background; the target "
            "is too small in the frame or covered"
        )
    level = float(np.median(b))
    prior = np.full(A.shape[1], (0.1 / max(level, 0.01)) ** 2)
    prior[order > 0.0] = (order[order > 0.0] ** 1.5 / (_UNEVEN * max(level, 0.01))) ** 2
    area = (picture.step * _STRIDE) ** 2
    patch, free = max(_PATCH / area, 1.0), b <= np.percentile(b, 60.0)
    numbers, spread = np.zeros(A.shape[1]), 1.0 / 255.0
    cross = np.ones((3, 3), np.uint8)
    reach = np.ones((2 * _NEAR + 1, 2 * _NEAR + 1), np.uint8)
    for _ in range(15):
        numbers = _ridge(A[free], b[free], patch * spread**2, prior)[0]
        left = b - A @ numbers
        middle = np.median(left[free])
        spread = 1.4826 * float(np.median(np.abs(left[free] - middle))) + 0.15 / 255.0
        hot: Image = np.zeros(paint.shape, dtype=np.uint8)
        hot[paint] = left > _HOT * spread
        hot = cv2.dilate(cv2.morphologyEx(hot, cv2.MORPH_OPEN, cross), reach)
        now = hot[paint] == 0
        if now.sum() < 0.1 * len(b) or (now == free).all():
            break
        free = now
    held = np.zeros(paint.shape, dtype=bool)
    held[paint] = free
    patch = _patch(np.where(paint, soft - small @ numbers, 0.0), held)
    deviation = max(spread, float(np.sqrt(np.mean((b - A @ numbers)[free] ** 2))))
    numbers, covariance = _ridge(A[free], b[free], patch * deviation**2, prior)
    values = _upscaled(picture.shape, orders, numbers) * pattern
    rough = picture.values - smooth(picture, picture.values, 1.0)
    noise = 1.4826 * float(np.median(np.abs(rough[picture.paint]))) * 1.05
    return Background(
        values.astype(np.float32), deviation, noise, patch * area, small, covariance, _STRIDE,
        method, float(free.mean()),
    )  # fmt: skip


def _upscaled(shape: tuple[int, int], orders: tuple[int, int], numbers: FloatArray) -> FloatArray:
    """The polynomial on the whole grid; the fit's grid lies evenly in it."""
    rows = len(np.arange(_STRIDE // 2, shape[0], _STRIDE))
    columns = len(np.arange(_STRIDE // 2, shape[1], _STRIDE))

    def place(count: int, small: int) -> FloatArray:
        at = (np.arange(count) - _STRIDE // 2) / _STRIDE
        return np.asarray(2.0 * at / max(small - 1, 1) - 1.0)

    x = np.polynomial.legendre.legvander(place(shape[1], columns), orders[0])
    y = np.polynomial.legendre.legvander(place(shape[0], rows), orders[1])
    table = np.zeros((orders[1] + 1, orders[0] + 1))
    for (i, j, _), number in zip(_terms(orders), numbers, strict=True):
        table[j, i] = number
    return np.asarray(y @ table @ x.T)


def _patch(left: FloatArray, held: Mask) -> float:
    """Over how many grid places what is left hangs together: the integral of its correlation.

    The correlation of an irregular region is that of its values over that of its mask, both
    by Fourier transforms; it is summed outwards until it first falls to nothing.
    """
    count = float(held.sum())
    if count < 10.0:
        return 1.0
    rows, columns = held.shape
    shape = (2 * rows, 2 * columns)
    value = np.abs(np.fft.rfft2(np.where(held, left - left[held].mean(), 0.0), shape)) ** 2
    mask = np.abs(np.fft.rfft2(held.astype(np.float64), shape)) ** 2
    covered = np.fft.irfft2(mask, shape)
    product = np.fft.irfft2(value, shape) / np.maximum(covered, 1.0)
    y = np.minimum(np.arange(shape[0]), shape[0] - np.arange(shape[0]))[:, None]
    x = np.minimum(np.arange(shape[1]), shape[1] - np.arange(shape[1]))[None, :]
    ring = np.hypot(x, y).astype(int)
    known = covered > 0.05 * count
    rings = np.bincount(ring[known], minlength=2)
    mean = np.bincount(ring[known], weights=product[known]) / np.maximum(rings, 1)
    if mean[0] <= 0.0:
        return 1.0
    end = int(np.argmax(mean <= 0.0)) if (mean <= 0.0).any() else len(mean)
    full = 2.0 * np.pi * np.arange(1, end)
    return float(max(1.0 + full @ mean[1:end] / mean[0], 1.0))
