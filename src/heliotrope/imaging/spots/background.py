"""Estimate what a target would look like without beams."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np

from heliotrope.errors import FormatError, InputError
from heliotrope.files.archives import read_arrays
from heliotrope.files.text import write_file
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Image
from heliotrope.imaging.spots._shadow import Edge, border, find_edges, places
from heliotrope.imaging.spots._shadow import prior as edge_prior
from heliotrope.imaging.targets.rectify import Mask, Rectified

#: Methods to estimate a background; "auto" uses the best available method.
Method = Literal["auto", "frame", "model", "difference"]
#: The fit uses every sixth pixel in each direction.
_STRIDE = 6
#: Order of the polynomial across a target; it is higher along a longer face.
_ORDER = 6
#: Because the light on a target is smooth, terms of order n have a prior standard deviation of this
#: value over n^1.5, relative to the mean. Photographs of empty targets show 0.06 at order 1 and
#: 0.005 at order 6.
_UNEVEN = 0.1
#: Initial value of the area over which joints and stains are correlated, m², before it is measured.
_PATCH = 0.4
#: Beams are brighter than the background by this many standard deviations,
_HOT = 3.0
#: and by at least this fraction of the background.
_HOT_PART = 0.002
#: Number of frames from which on a model describes the paint better than a single frame.
_KNOWN = 3.0
#: Unevenness of a frame's light relative to the prior: weight of the prior, and limits.
_EVEN = (0.01, 0.05, 1.5)
#: Blur of the face before the fit, grid pixels.
_SOFT = 2.0
#: A shadow is searched for if at least this many places at a face's border are unexplained.
_BORDER = 4
#: A place is unexplained beyond three standard deviations, which are limited to these fractions of
#: the brightness.
_ODD = (0.015, 0.03)
#: Minimum gain in explained paint through an edge, and minimum height of the edge in its standard
#: deviations.
_GAIN, _CERTAIN = 0.02, 4.5
#: Paint is as expected if it is within this many standard deviations, or this fraction of the
#: brightness.
_PLAIN, _PLAIN_PART = 4.0, 0.02
#: Deviations that extend over less than this, m, belong to the paint.
BROAD = 0.3
#: Minimum fraction of the paint that the fit keeps.
_FEWEST = 0.06
#: Iterations of the fit in which the edge of a shadow is moved.
_SETTLING = 6
#: Margin around a beam for its tails, pixels of the fit's grid.
_NEAR = 3


@dataclass(frozen=True)
class Background:
    """A face without its beams, with covariance.

    Attributes
    ----------
    values
        Brightness as a fraction of full scale, (H, W).
    deviation
        Standard deviation of the residuals of the smoothed paint, as a fraction of full scale.
    noise
        Standard deviation of a pixel, as a fraction of full scale.
    patch
        Area over which the residuals are correlated, m².
    basis
        Derivatives of the values with respect to the fit parameters, on the grid of the fit, (h, w,
        K).
    covariance
        Covariance of the parameters, (K, K).
    stride
        Pixels between rows of the fit grid.
    method
        "frame", "difference" or "model".
    seen
        Fraction of the paint that was free of beams.
    reflectance
        Reflectance of the paint relative to the usual value, (H, W); None if unknown. Dividing the
        reflected light by this reflectance yields the light that falls on the face.
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
    reflectance: Image | None = None


def from_frame(picture: Rectified) -> Background:
    """Return the background from one frame alone, assuming smooth light on uniform paint.

    A polynomial is fitted to the paint that no beam illuminates. Beams stand out above the fit.
    They are excluded together with their surroundings, and the fit is repeated until nothing
    changes.
    """
    return _fit(picture, np.ones(picture.shape, dtype=np.float32), _orders(picture), "frame")


def from_difference(picture: Rectified, without: Rectified) -> Background:
    """Return the background from a second frame that shows the target without the beam.

    A plane is fitted to the brightness ratios, because the light may have changed between the
    frames.

    Raises
    ------
    InputError
        If the two frames do not show the same face on the same grid.
    """
    if without.shape != picture.shape or not np.allclose(without.first, picture.first):
        raise InputError(
            f"the empty frame shows a target area of {without.shape} px, the frame with the beam "
            f"one of {picture.shape} px; use two frames of the same target"
        )
    return _fit(picture, without.values, (1, 1), "difference")


@dataclass(frozen=True)
class EmptyTarget:
    """A running model of an empty face: the reflectance of its paint, pixel by pixel.

    Attributes
    ----------
    reflectance
        Brightness relative to that of the smooth light, (H, W).
    weight
        Number of frames that contributed to each pixel, with lower weight for old frames, (H, W).
    memory
        Number of frames after which the weight of a frame falls to 1/e.
    targets
        Names of the face's targets.
    """

    reflectance: Image
    weight: Image
    memory: float = 50.0
    targets: tuple[str, ...] = ()

    @staticmethod
    def of(picture: Rectified, memory: float = 50.0) -> "EmptyTarget":
        """Return a model that contains no frame yet."""
        ones = np.ones(picture.shape, dtype=np.float32)
        names = tuple(target.name for target in picture.face.targets)
        return EmptyTarget(ones, np.zeros_like(ones), memory, names)

    def learn(self, picture: Rectified, spots: Mask | None = None) -> "EmptyTarget":
        """Return the model updated with another frame.

        Parameters
        ----------
        picture
            A frame, with or without beams.
        spots
            Mask of the beams in the frame, (H, W), where the model is not updated. By default the
            beams are searched for.
        """
        self._check(picture)
        known = self.ready
        background = from_model(picture, self) if known else from_frame(picture)
        light = background.values / self.reflectance if known else background.values
        covered = beams(picture, background) if spots is None else spots
        good = picture.surface & ~covered & (light > 0.02)
        ratio = np.where(good, picture.values / np.maximum(light, 0.02), 1.0)
        kept = self.weight * np.float32(np.exp(-1.0 / self.memory))
        weight = np.where(good, kept + 1.0, self.weight)
        change = (ratio - self.reflectance) / np.maximum(weight, 1.0)
        reflectance = np.where(good, self.reflectance + change, self.reflectance)
        return replace(
            self, reflectance=reflectance.astype(np.float32), weight=weight.astype(np.float32)
        )

    def save(self, path: str | Path) -> None:
        """Write the model to a file (.npz), completely or not at all.

        Raises
        ------
        InputError
            If the file cannot be written.
        """
        write_file(
            path,
            lambda stream: np.savez_compressed(
                stream,
                reflectance=self.reflectance,
                weight=self.weight,
                memory=np.float64(self.memory),
                targets=np.array(self.targets, dtype=np.str_),
            ),
        )

    @staticmethod
    def load(path: str | Path) -> "EmptyTarget":
        """Return a model from a file written by `save`.

        Raises
        ------
        InputError
            If there is no such file.
        FormatError
            If the file is not a model of an empty target.
        """
        file = Path(path)
        held = read_arrays(
            file, "a model of an empty target", ["reflectance", "weight", "memory", "targets"]
        )
        try:
            reflectance, weight = held["reflectance"] + 0.0, held["weight"] + 0.0
            memory, names = float(held["memory"]), tuple(str(n) for n in held["targets"])
        except (ValueError, TypeError) as error:
            raise FormatError(
                file, f"no model of an empty target ({error}); learn a new one from empty frames"
            ) from None
        good = reflectance.ndim == 2 and reflectance.shape == weight.shape and memory > 0.0
        if not good or not (np.isfinite(reflectance).all() and np.isfinite(weight).all()):
            raise FormatError(
                file,
                f"reflectance {reflectance.shape} and weight {weight.shape} must be finite, and "
                f"memory {memory} above 0; learn a new model from empty frames",
            )
        return EmptyTarget(reflectance.astype(np.float32), weight.astype(np.float32), memory, names)

    @property
    def ready(self) -> bool:
        """Whether the model describes the paint better than a single frame does."""
        return float(np.median(self.weight)) >= _KNOWN

    def fits(self, picture: Rectified) -> bool:
        """Return whether the model has exactly the targets and the grid of a picture."""
        names = {target.name for target in picture.face.targets}
        same = not self.targets or set(self.targets) == names
        return same and picture.shape == self.reflectance.shape

    def _check(self, picture: Rectified) -> None:
        names = tuple(target.name for target in picture.face.targets)
        if self.targets and set(self.targets) != set(names):
            raise InputError(
                f"the model is for {', '.join(self.targets)}, but the frame shows "
                f"{', '.join(names)}; use the model of this target"
            )
        if picture.shape != self.reflectance.shape:
            raise InputError(
                f"the model has {self.reflectance.shape} px, but the frame has {picture.shape} px; "
                "learn a new model of this target"
            )


def from_model(picture: Rectified, model: EmptyTarget) -> Background:
    """Return the background of a frame from a model of the empty target.

    The light on stained paint is later divided by its reflectance.

    Raises
    ------
    InputError
        If the model has a different grid or target.
    """
    model._check(picture)  # noqa: SLF001 (its own module)
    columns, rows = _orders(picture)
    orders = (max(columns // 3, 1), max(rows // 3, 1))
    # Assume usual paint where a beam has always been.
    known = np.where(model.weight > 0.0, model.reflectance, np.float32(1.0))
    return _fit(picture, known, orders, "model", known)


def of_face(
    picture: Rectified,
    method: Method,
    models: Iterable[EmptyTarget] = (),
    empty: Rectified | None = None,
) -> Background:
    """Estimate the background of a face with the chosen method.

    Parameters
    ----------
    picture
        The face with its beams.
    method
        "frame", "model", "difference", or "auto" for the best that is available.
    models
        Models of empty faces; the model that matches the face is used.
    empty
        Picture of the same face without beams.

    Raises
    ------
    InputError
        If the method needs a model or an empty face that is missing.
    """
    model = next((m for m in models if m.fits(picture)), None)
    if method == "auto":
        ready = model is not None and model.ready
        method = "difference" if empty is not None else "model" if ready else "frame"
    if method == "difference":
        if empty is None:
            raise InputError("background by difference needs a frame without the beam; pass one")
        return from_difference(picture, empty)
    if method == "model":
        if model is None:
            raise InputError(
                f"background by model: target {picture.face.targets[0].name} has no model; learn "
                "one from empty frames, or use the frame alone"
            )
        return from_model(picture, model)
    return from_frame(picture)


def beams(picture: Rectified, background: Background) -> Mask:
    """Return a mask of the pixels that a beam illuminates, including its tails, (H, W)."""
    import cv2

    above = smooth(picture, picture.values - background.values, 2.0)
    hot = (above > _HOT * background.deviation) & picture.paint
    reach = 2 * _NEAR * _STRIDE + 1
    return cv2.dilate(hot.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0


def unexplained(picture: Rectified, background: Background, spots: Sequence[Mask]) -> float:
    """Return the fraction of paint beside the spots that is brighter or darker than expected.

    Causes are shadows, stray light and obstacles. Only areas broader than `BROAD` metres count, so
    that single pixels, joints and stains are ignored.
    """
    import cv2

    beside = picture.paint.copy()
    reach = 2 * _NEAR * _STRIDE + 1
    for region in spots:
        beside &= cv2.dilate(region.astype(np.uint8), np.ones((reach, reach), np.uint8)) == 0
    if not beside.any():
        return 0.0
    residual = np.abs(smooth(picture, picture.values - background.values, 2.0))
    level = float(np.median(background.values[picture.paint]))
    odd = beside & (residual > max(_PLAIN * background.deviation, _PLAIN_PART * level))
    size = max(round(BROAD / picture.step), 1)
    broad = cv2.morphologyEx(odd.astype(np.uint8), cv2.MORPH_OPEN, np.ones((size, size), np.uint8))
    return float((broad[beside] > 0).sum() / picture.paint.sum())


def smooth(picture: Rectified, values: Image, sigma: float) -> Image:
    """Return values smoothed over bare paint and interpolated on marks.

    Parameters
    ----------
    picture
        The face; its marks and edges are excluded.
    values
        (H, W).
    sigma
        Grid pixels.
    """
    import cv2

    paint = picture.paint.astype(np.float32)
    top = cv2.GaussianBlur(np.asarray(values, dtype=np.float32) * paint, (0, 0), sigma)
    return np.asarray(top / picture.share(sigma), dtype=np.float32)


def _orders(picture: Rectified) -> tuple[int, int]:
    rows, columns = picture.shape
    short = min(rows, columns)
    return (
        min(round(_ORDER * columns / short), 12),
        min(round(_ORDER * rows / short), 12),
    )


def _terms(orders: tuple[int, int]) -> list[tuple[int, int, float]]:
    """Return the orders of the fitted polynomial terms: across, up, and in total."""
    top = min(order for order in orders if order > 0)
    terms = []
    for i in range(orders[0] + 1):
        for j in range(orders[1] + 1):
            share = i / max(orders[0], 1) + j / max(orders[1], 1)
            if share <= 1.0 + 1e-9:
                terms.append((i, j, share * top))
    return terms


@lru_cache(maxsize=16)
def _polynomials(shape: tuple[int, int], orders: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Return Legendre polynomials over a grid, (H, W, K), and orders across a target, (K,)."""
    along_x = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, shape[1]), orders[0])
    along_y = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, shape[0]), orders[1])
    terms = _terms(orders)
    table = np.stack([np.outer(along_y[:, j], along_x[:, i]) for i, j, _ in terms], axis=-1)
    return np.asarray(table, dtype=np.float64), np.array([order for _, _, order in terms])


def _ridge(
    A: FloatArray,
    b: FloatArray,
    variance: float,
    prior: FloatArray,
    evenness: int,
    scale: float = 1.0,
    turns: int = 8,
) -> tuple[FloatArray, FloatArray, float]:
    """Return the parameters of maximum posterior probability and their covariance.

    The first ``evenness`` parameters describe smooth light. The smoothness differs from frame to
    frame, so the prior standard deviations of these parameters are scaled to fit their values
    (expectation maximisation of a variance, with a weak prior that favours a small variance).
    """
    G, r = A.T @ A / variance, A.T @ b / variance
    numbers, covariance = np.zeros(len(prior)), np.zeros((len(prior), len(prior)))
    for _ in range(turns):
        held = prior.copy()
        held[1:evenness] /= scale
        covariance = np.asarray(np.linalg.inv(G + np.diag(held)))
        numbers = covariance @ r
        spread = (numbers**2 + np.diag(covariance))[1:evenness]
        total = float(prior[1:evenness] @ spread) + _EVEN[0]
        new = float(np.clip(total / evenness, _EVEN[1] ** 2, _EVEN[2] ** 2))
        if abs(np.log(new / scale)) < 0.05:
            break
        scale = new
    return numbers, covariance, scale


@dataclass(frozen=True)
class _Grid:
    """The data of a fit: paint on the fit grid, and the functions of smooth light there."""

    soft: FloatArray
    paint: Mask
    multiplier: FloatArray
    basis: FloatArray
    prior: FloatArray
    patch: float

    @property
    def level(self) -> float:
        return float(np.median(self.soft[self.paint]))


@dataclass(frozen=True)
class _Fit:
    """The result of a fit."""

    basis: FloatArray
    prior: FloatArray
    numbers: FloatArray
    spread: float
    free: Mask
    edge: Edge | None

    def residuals(self, grid: _Grid) -> FloatArray:
        return np.asarray(grid.soft - self.basis @ self.numbers)


def _fit(
    picture: Rectified,
    pattern: Image,
    orders: tuple[int, int],
    method: str,
    reflectance: Image | None = None,
) -> Background:
    """Fit pattern × polynomial, plus a shadow edge if there is one, to paint without beams."""
    grid = _grid(picture, pattern, orders)
    fit = _converged(grid, None)
    even, odd = grid.soft / np.maximum(grid.multiplier, 0.05), _odd(fit, grid)
    # The edge of a shadow leaves unexplained places where it meets the face's border.
    for edge in find_edges(even, grid.paint) if odd[border(grid.paint)].sum() > _BORDER else []:
        if not edge.crosses(odd, grid.paint):
            continue
        other = _converged(grid, edge)
        if _better(other, fit, grid):
            fit = other
    residuals = fit.residuals(grid)
    area = (picture.step * _STRIDE) ** 2
    patch = _patch(np.where(grid.paint, residuals, 0.0), fit.free)
    deviation = max(fit.spread, float(np.sqrt(np.mean(residuals[fit.free] ** 2))))
    numbers, covariance, _ = _ridge(
        fit.basis[fit.free],
        grid.soft[fit.free],
        patch * deviation**2,
        fit.prior,
        grid.basis.shape[-1],
    )
    values = _upscaled(picture.shape, orders, numbers, fit.edge) * pattern
    rough = picture.values - smooth(picture, picture.values, 1.0)
    noise = 1.4826 * float(np.median(np.abs(rough[picture.paint]))) * 1.05
    return Background(
        values.astype(np.float32),
        deviation,
        noise,
        patch * area,
        fit.basis,
        covariance,
        _STRIDE,
        method,
        float(fit.free.sum() / grid.paint.sum()),
        reflectance,
    )


def _grid(picture: Rectified, pattern: Image, orders: tuple[int, int]) -> _Grid:
    part = np.s_[_STRIDE // 2 :: _STRIDE, _STRIDE // 2 :: _STRIDE]
    soft = smooth(picture, picture.values, _SOFT)[part].astype(np.float64)
    paint = picture.paint[part]
    multiplier = smooth(picture, pattern, _SOFT)[part].astype(np.float64)
    table, order = _polynomials((soft.shape[0], soft.shape[1]), orders)
    count = int(paint.sum())
    if count < 4 * table.shape[-1]:
        raise InputError(
            f"bare paint is visible in only {count} places, too few for a background: the target "
            "is too small in the frame or covered"
        )
    level = float(np.median(soft[paint]))
    prior = np.full(len(order), (0.1 / max(level, 0.01)) ** 2)
    prior[order > 0.0] = (order[order > 0.0] ** 1.5 / (_UNEVEN * max(level, 0.01))) ** 2
    patch = max(_PATCH / (picture.step * _STRIDE) ** 2, 1.0)
    return _Grid(soft, paint, multiplier, table * multiplier[..., None], prior, patch)


def _better(other: _Fit, fit: _Fit, grid: _Grid) -> bool:
    """Return whether a fit with an edge is better than one without it or with another edge.

    The better fit must explain more of the paint to the same accuracy, and the height of its edge
    must be significant in paint without beams.
    """
    limit = _HOT * min(fit.spread, other.spread)
    explained = [
        float((np.abs(f.residuals(grid))[grid.paint] < limit).mean()) for f in (fit, other)
    ]
    if other.edge is None or explained[1] < explained[0] + _GAIN:
        return False
    variance = 3.0 * other.spread**2
    size = grid.basis.shape[-1]
    _, covariance, _ = _ridge(
        other.basis[other.free], grid.soft[other.free], variance, other.prior, size
    )
    return bool(abs(other.numbers[size]) > _CERTAIN * np.sqrt(covariance[size, size]))


def _odd(fit: _Fit, grid: _Grid) -> Mask:
    """Return a mask of paint that smooth light does not explain, ignoring single pixels."""
    import cv2

    limit = float(np.clip(_HOT * fit.spread, _ODD[0] * grid.level, _ODD[1] * grid.level))
    odd = (np.abs(fit.residuals(grid)) > limit) & grid.paint
    return cv2.morphologyEx(odd.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8)) > 0


def _converged(grid: _Grid, edge: Edge | None) -> _Fit:
    """Fit, exclude outliers and their surroundings, and repeat until convergence."""
    import cv2

    paint, soft, basis, prior = grid.paint, grid.soft, grid.basis, grid.prior
    x, y = places((soft.shape[0], soft.shape[1]))
    even = soft
    if edge is not None:
        even = soft - edge.height * grid.multiplier * edge.step(x, y)
        prior = np.concatenate([prior, edge_prior(grid.level)])
    free = paint & (even <= np.percentile(even[paint], 60.0))
    numbers, spread, scale = np.zeros(len(prior)), 1.0 / 255.0, 1.0
    cross = np.ones((3, 3), np.uint8)
    reach = np.ones((2 * _NEAR + 1, 2 * _NEAR + 1), np.uint8)
    for turn in range(15):
        if edge is not None:
            columns = edge.columns(x, y) * grid.multiplier[..., None]
            basis = np.concatenate([grid.basis, columns], axis=-1)
        numbers, _, scale = _ridge(
            basis[free], soft[free], grid.patch * spread**2, prior, grid.basis.shape[-1], scale, 1
        )
        residuals = soft - basis @ numbers
        middle = np.median(residuals[free])
        spread = 1.4826 * float(np.median(np.abs(residuals[free] - middle))) + 0.15 / 255.0
        hot = paint & (residuals > max(_HOT * spread, _HOT_PART * grid.level))
        if edge is not None and turn < _SETTLING:
            # Until the edge has settled, residuals near it are not taken for a beam.
            hot &= np.abs(edge.distance(x, y)) > 2.0 * edge.breadth + 2.0
        grown = cv2.dilate(cv2.morphologyEx(hot.astype(np.uint8), cv2.MORPH_OPEN, cross), reach)
        now = paint & (grown == 0)
        if edge is not None and turn < _SETTLING:
            edge = edge.moved(numbers[-6:])
        elif now.sum() < _FEWEST * paint.sum() or (now == free).all():
            break
        free = now if now.sum() >= _FEWEST * paint.sum() else free
    return _Fit(basis, prior, numbers, spread, free, edge)


def _upscaled(
    shape: tuple[int, int], orders: tuple[int, int], numbers: FloatArray, edge: Edge | None
) -> FloatArray:
    """Evaluate the fitted light on the whole grid; the fit grid is a regular subset of it."""
    rows = len(np.arange(_STRIDE // 2, shape[0], _STRIDE))
    columns = len(np.arange(_STRIDE // 2, shape[1], _STRIDE))

    def place(count: int, small: int) -> FloatArray:
        at = (np.arange(count) - _STRIDE // 2) / _STRIDE
        return np.asarray(2.0 * at / max(small - 1, 1) - 1.0)

    x = np.polynomial.legendre.legvander(place(shape[1], columns), orders[0])
    y = np.polynomial.legendre.legvander(place(shape[0], rows), orders[1])
    table = np.zeros((orders[1] + 1, orders[0] + 1))
    terms = _terms(orders)
    for (i, j, _), number in zip(terms, numbers, strict=False):
        table[j, i] = number
    light = np.asarray(y @ table @ x.T)
    if edge is None:
        return light
    u = (np.arange(shape[1]) - _STRIDE // 2) / _STRIDE - 0.5 * (columns - 1)
    v = (np.arange(shape[0]) - _STRIDE // 2) / _STRIDE - 0.5 * (rows - 1)
    # The fit used a blurred face.
    sharp = float(np.sqrt(max(edge.breadth**2 - (_SOFT / _STRIDE) ** 2, 0.1**2)))
    step = edge.step(u[None, :], v[:, None], sharp)
    height, right, down = numbers[len(terms) : len(terms) + 3]
    half = 0.5 * max(columns - 1, 1)
    return np.asarray(light + step * (height + (right * u[None, :] + down * v[:, None]) / half))


def _patch(residuals: FloatArray, held: Mask) -> float:
    """Return the number of grid points over which residuals are correlated.

    This is the integral of the autocorrelation up to its first zero. For an irregular region, the
    autocorrelation of the values is divided by that of the mask; both are computed with Fourier
    transforms.
    """
    count = float(held.sum())
    if count < 10.0:
        return 1.0
    rows, columns = held.shape
    shape = (2 * rows, 2 * columns)
    value = (
        np.abs(np.fft.rfft2(np.where(held, residuals - residuals[held].mean(), 0.0), shape)) ** 2
    )
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
