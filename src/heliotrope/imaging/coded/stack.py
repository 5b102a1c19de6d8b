"""Photographs of one surface on which several beams move, and the light in each photograph."""

from dataclasses import dataclass

import numpy as np

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray
from heliotrope.imaging.targets.rectify import Mask

#: A photograph whose light is below this fraction of the usual light is left out.
DARK = 0.5
#: Number of pixels across the longer side that decimetre-sized beams need.
_ACROSS = 96


@dataclass(frozen=True)
class Stack:
    """K photographs of one surface, as seen from its front.

    Attributes
    ----------
    values
        Brightness, proportional to the light, (K, H, W); row 0 at the top.
    step
        Size of a pixel, m.
    first
        Position of the first pixel's centre, metres to the right of and above the surface centre,
        (2,).
    seen
        Mask of the pixels that measure light, (H, W): on the surface, not on a mark, and never at
        full scale.
    exposures
        Exposure times gain of each photograph, (K,); None if equal for all.
    empty
        Brightness without beams at an exposure of 1 (or at that of the photographs, if it is equal
        for all), (H, W). None if the surface also carries light other than that of the coded beams,
        as a receiver does.
    """

    values: FloatArray
    step: float
    first: FloatArray
    seen: Mask
    exposures: FloatArray | None = None
    empty: FloatArray | None = None

    def __post_init__(self) -> None:
        shape = self.values.shape
        if len(shape) != 3 or min(shape) < 2:
            raise InputError(
                f"stack: values of shape {shape}; expected (photographs, rows, columns)"
            )
        for name, array, expected in (
            ("seen", self.seen, shape[1:]),
            ("empty", self.empty, shape[1:]),
            ("exposures", self.exposures, shape[:1]),
            ("first", self.first, (2,)),
        ):
            if array is not None and np.shape(array) != expected:
                raise InputError(f"stack: {name} has shape {np.shape(array)}; expected {expected}")
        if not (np.isfinite(self.step) and self.step > 0.0):
            raise InputError(f"stack: step must be above 0, not {self.step} m")
        if not np.isfinite(self.values[:, self.seen]).all():
            raise InputError("stack: brightness is not finite at a seen pixel; mask such pixels")
        if self.exposures is not None and not (np.asarray(self.exposures) > 0.0).all():
            raise InputError("stack: an exposure must be above 0")

    @property
    def axes(self) -> tuple[FloatArray, FloatArray]:
        """Column positions right of the centre, m, (W,), and row positions above it, m, (H,)."""
        _, rows, columns = self.values.shape
        return (
            self.first[0] + self.step * np.arange(columns),
            self.first[1] - self.step * np.arange(rows),
        )

    def prepared(self) -> "Stack":
        """Return the stack scaled to one exposure, on a grid just fine enough for the beams."""
        values = np.asarray(self.values, dtype=np.float64)
        if self.exposures is not None:
            values = values / np.asarray(self.exposures)[:, None, None]
        factor = max(1, max(values.shape[1:]) // _ACROSS)
        rows, columns = (n // factor for n in values.shape[1:])
        weight = self.seen[: rows * factor, : columns * factor].astype(np.float64)
        known = _binned(weight, factor)

        def shrunk(pictures: FloatArray) -> FloatArray:
            cut = pictures[..., : rows * factor, : columns * factor]
            total = _binned(np.where(weight > 0.0, cut, 0.0), factor)
            return np.asarray(total / np.maximum(known, 1e-12))

        shift = 0.5 * (factor - 1) * self.step
        return Stack(
            shrunk(values),
            self.step * factor,
            np.asarray(self.first) + np.array([shift, -shift]),
            # For pixels that are half masked, the centre of the unmasked part is unknown.
            known > 0.999,
            None,
            None if self.empty is None else shrunk(np.asarray(self.empty, dtype=np.float64)),
        )


def _binned(pictures: FloatArray, factor: int) -> FloatArray:
    *more, rows, columns = pictures.shape
    return np.asarray(
        pictures.reshape(*more, rows // factor, factor, columns // factor, factor).mean(
            axis=(-3, -1)
        )
    )


@dataclass(frozen=True)
class Light:
    """Light of the coded beams in K photographs, scaled to the usual sunlight.

    Attributes
    ----------
    pictures
        Brightness due to beams divided by ``factors``, N seen pixels, (K, N).
    factors
        Light of the beams in each photograph, divided by its median, (K,).
    weights
        Weight of each photograph, (K,); 0 if the photograph is left out.
    """

    pictures: FloatArray
    factors: FloatArray
    weights: FloatArray

    @property
    def mean(self) -> FloatArray:
        """The mean picture, (N,)."""
        return np.asarray(self.weights @ self.pictures / self.weights.sum())


def light_of(values: FloatArray, empty: FloatArray | None, moved: FloatArray | None) -> Light:
    """Return the relative light of the beams in each photograph.

    Each photograph is modelled as the empty surface times a daylight factor plus the beams times a
    light factor; the two factors are fitted by least squares.

    Parameters
    ----------
    values
        Brightness of seen pixels, (K, N).
    empty
        Brightness without beams, (N,).
    moved
        Change of brightness due to the movements known so far, (K, N).
    """
    count = len(values)
    change = np.zeros_like(values) if moved is None else moved
    mean = np.median(values, axis=0) if empty is None else np.median(values - empty, axis=0)
    day = np.ones(count)
    pictures = values
    for _ in range(3):
        beams = mean + change
        own, with_beams = (beams**2).sum(axis=1), (beams * values).sum(axis=1)
        if empty is None:
            factors = with_beams / own
        else:
            # These are the normal equations for the two unknowns.
            cross, plain, with_empty = beams @ empty, empty @ empty, values @ empty
            determinant = own * plain - cross**2
            factors = (plain * with_beams - cross * with_empty) / determinant
            day = (own * with_empty - cross * with_beams) / determinant
        usual = float(np.median(factors))
        factors = factors / (usual if usual > 0.0 else 1.0)
        weights = np.where(factors > DARK, factors**2, 0.0)
        if not weights.any():
            weights = np.ones(count)
        safe = np.where(weights > 0.0, factors, 1.0)
        excess = values if empty is None else values - day[:, None] * empty
        pictures = excess / safe[:, None]
        mean = weights @ (pictures - change) / weights.sum()
    return Light(pictures, factors, weights)
