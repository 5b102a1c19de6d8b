"""Photographs of empty targets with simulated beams on them: real paint, exact truth."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Frame


@dataclass(frozen=True)
class Hybrid:
    """A composed picture.

    Attributes
    ----------
    frame
        Grey, 8 bit.
    truth
        The beam's centroid, pixels (column, row), (2,).
    """

    frame: Frame
    truth: FloatArray


def compose(
    empty: npt.ArrayLike,
    beam: npt.ArrayLike,
    shift: tuple[int, int],
    contrast: float,
    peak: float,
    name: str = "",
) -> Hybrid:
    """Return empty + contrast · beam · (mean of empty / maximum of beam), scaled to a peak.

    Parameters
    ----------
    empty
        Photograph of the empty target, grey, (H, W).
    beam
        Flux of the beam, any unit, (H, W).
    shift
        Moves the beam to the right and down, pixels; what leaves the picture is lost, and
        the truth still counts it.
    contrast
        Of the beam's peak to the mean background.
    peak
        Brightest pixel, of full scale.
    name
        Of the frame.

    Raises
    ------
    InputError
        If the shapes differ, or the beam is nothing.
    """
    paint, light = np.asarray(empty, dtype=np.float64), np.asarray(beam, dtype=np.float64)
    if paint.ndim != 2 or paint.shape != light.shape:
        raise InputError(
            f"empty {paint.shape} and beam {light.shape} must be two pictures of one size"
        )
    if not light.max() > 0.0:
        raise InputError("the beam has no light")
    rows, columns = light.shape
    right, down = shift
    moved = np.zeros_like(light)
    rows_to = slice(max(down, 0), rows + min(down, 0))
    rows_from = slice(max(-down, 0), rows + min(-down, 0))
    columns_to = slice(max(right, 0), columns + min(right, 0))
    columns_from = slice(max(-right, 0), columns + min(-right, 0))
    moved[rows_to, columns_to] = light[rows_from, columns_from]
    picture = paint + contrast * moved * (paint.mean() / light.max())
    picture = picture * (peak * 255.0 / picture.max())
    total = light.sum()
    truth = np.array(
        [light.sum(axis=0) @ np.arange(columns), light.sum(axis=1) @ np.arange(rows)]
    ) / total + np.array([right, down], dtype=np.float64)
    pixels = np.clip(np.round(picture), 0.0, 255.0).astype(np.uint8)
    return Hybrid(Frame(pixels, name), truth)
