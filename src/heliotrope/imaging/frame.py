"""A frame: the pixels of a photograph, with the time and its uncertainty."""

from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError

#: Pixels of a frame: grey (H, W) or blue-green-red (H, W, 3), 8 or 16 bit.
Pixels = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
#: Values on a grid of pixels, of any type that OpenCV handles.
Image = npt.NDArray[Any]

#: Pixels above this fraction of a channel's white level may be clipped; tone curves end below it.
CLIPPED = 0.985
#: Weights of blue, green and red in the brightness (Rec. 601), in 255ths.
_SHARES = (29, 150, 76)
_SQUARED = np.round(np.arange(256) ** 2 / 255.0).astype(np.uint8)
#: Criteria for a plateau below full scale. The band between CLIPPED and 1 times the highest value
#: must have this many times more pixels than an equal band below it; for the smooth peak of a beam
#: this ratio is 1. The second number is how many pixels may be brighter (hot pixels). The third is
#: the minimum number of values between _NEAR and 1, below which the bands say nothing.
_PLATEAU, _HOT, _VALUES, _NEAR = 8.0, 16, 4, 0.94


@dataclass(frozen=True)
class Frame:
    """One photograph.

    Attributes
    ----------
    pixels
        Grey (H, W) or blue-green-red (H, W, 3), uint8 or uint16.
    name
        Path of the file, or a source and a frame number.
    time
        Middle of the exposure, with a time zone; None if unknown.
    time_deviation
        Standard deviation of the time, s; NaN if unknown.
    exposure
        Exposure time, s; NaN if unknown.
    gain
        Relative sensor gain; NaN if unknown.
    count
        Number of frames averaged.
    """

    pixels: Pixels
    name: str = ""
    time: datetime | None = None
    time_deviation: float = float("nan")
    exposure: float = float("nan")
    gain: float = float("nan")
    count: int = 1

    def __post_init__(self) -> None:
        shape = self.pixels.shape
        if not (len(shape) == 2 or (len(shape) == 3 and shape[2] == 3)) or min(shape) < 1:
            raise InputError(f"{self.name or 'frame'}: pixels {shape} must be (H, W) or (H, W, 3)")
        if self.pixels.dtype not in (np.uint8, np.uint16):
            raise InputError(
                f"{self.name or 'frame'}: pixels of {self.pixels.dtype}; use uint8 or uint16"
            )
        if self.time is not None and self.time.tzinfo is None:
            raise InputError(f"{self.name or 'frame'}: time {self.time} has no time zone; add one")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.pixels.shape[1], self.pixels.shape[0]

    @property
    def full_scale(self) -> float:
        """Largest possible pixel value."""
        return float(np.iinfo(self.pixels.dtype).max)

    @cached_property
    def clipped(self) -> npt.NDArray[np.uint8]:
        """Degree to which each pixel is clipped, 0 to 255, (H, W).

        This is the square of the fraction of the brightness that comes from channels at their white
        level. Clipping shifts a centroid in proportion to that fraction, and therefore increases
        its variance with the square. The white level is full scale, or the plateau below it at
        which a channel saturates: video levels end at 235, and a 12-bit sensor at 4095 of 65535.
        """
        import cv2

        grey = self.pixels.ndim == 2
        channels = [self.pixels] if grey else cv2.split(self.pixels)
        out = np.zeros(self.pixels.shape[:2], dtype=np.uint8)
        for channel, share in zip(channels, (255,) if grey else _SHARES, strict=True):
            limit = float(np.ceil(CLIPPED * _white(channel, self.full_scale)))
            out += np.uint8(share) * (channel >= limit)
        return _SQUARED[out]

    def linear(self, gamma: float) -> "Frame":
        """Return a 16-bit frame with pixels proportional to light; this frame if gamma is 1.

        Parameters
        ----------
        gamma
            Exponent of the camera response: pixel values are light to the power 1/gamma.

        Raises
        ------
        InputError
            If gamma is not from 0.2 to 5.
        """
        if gamma == 1.0:
            return self
        if not 0.2 <= gamma <= 5.0:
            raise InputError(
                f"gamma must be between 0.2 and 5 (1 is linear, 2.2 is usual), not {gamma}"
            )
        top = int(self.full_scale)
        table = np.round(65535.0 * (np.arange(top + 1) / top) ** gamma).astype(np.uint16)
        return replace(self, pixels=table[self.pixels])

    @cached_property
    def grey(self) -> Image:
        """Brightness (H, W) in the frame's own type, with the weights of Rec. 601."""
        import cv2

        if self.pixels.ndim == 2:
            return np.ascontiguousarray(self.pixels)
        return cv2.cvtColor(self.pixels, cv2.COLOR_BGR2GRAY)


def _white(channel: Image, full_scale: float) -> float:
    """Return the value at which a channel (H, W) clips: a plateau if any, else full scale."""
    import cv2

    levels = int(full_scale) + 1
    counts = cv2.calcHist([np.ascontiguousarray(channel)], [0], None, [levels], [0, levels]).ravel()
    above = np.cumsum(counts[::-1], dtype=np.float64)[::-1]
    high = above >= _HOT
    if not high.any():
        return full_scale
    top = int(np.flatnonzero(high)[-1])
    # Both bands are wide enough to hold several of 256 values.
    upper, lower = (int(np.ceil(share * top)) for share in (CLIPPED, 3.0 * CLIPPED - 2.0))
    below = 0.5 * (above[lower] - above[upper])
    values = np.count_nonzero(counts[int(_NEAR * top) : top + 1])
    plateau = above[upper] > _PLATEAU * max(below, 1.0)
    return float(top) if plateau and values >= _VALUES else full_scale
