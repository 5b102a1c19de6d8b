"""A frame: the pixels of a photograph, its time and the time's uncertainty."""

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


@dataclass(frozen=True)
class Frame:
    """One photograph.

    Attributes
    ----------
    pixels
        Grey (H, W) or blue-green-red (H, W, 3), uint8 or uint16.
    name
        Path of a file, or a source and a number.
    time
        Middle of the exposure, with a zone; None if unknown.
    time_deviation
        Standard deviation of the time, s; NaN if unknown.
    exposure
        s; NaN if unknown.
    gain
        Relative, of the sensor; NaN if unknown.
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
                f"{self.name or 'frame'}: pixels of {self.pixels.dtype}; give uint8 or uint16"
            )
        if self.time is not None and self.time.tzinfo is None:
            raise InputError(f"{self.name or 'frame'}: time {self.time} has no zone; add one")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.pixels.shape[1], self.pixels.shape[0]

    @property
    def full_scale(self) -> float:
        """Greatest possible value of a pixel."""
        return float(np.iinfo(self.pixels.dtype).max)

    def linear(self, gamma: float) -> "Frame":
        """Return a 16-bit frame whose pixels are proportional to light; itself if gamma is 1.

        Parameters
        ----------
        gamma
            The frame's pixels are light to the power 1/gamma.

        Raises
        ------
        InputError
            If gamma is not from 0.2 to 5.
        """
        if gamma == 1.0:
            return self
        if not 0.2 <= gamma <= 5.0:
            raise InputError(f"gamma {gamma} must be from 0.2 to 5; 1 is linear, 2.2 is usual")
        top = int(self.full_scale)
        table = np.round(65535.0 * (np.arange(top + 1) / top) ** gamma).astype(np.uint16)
        return replace(self, pixels=table[self.pixels])

    @cached_property
    def grey(self) -> Image:
        """Brightness (H, W) in the frame's own type: the weights of Rec. 601."""
        import cv2

        if self.pixels.ndim == 2:
            return np.ascontiguousarray(self.pixels)
        return cv2.cvtColor(self.pixels, cv2.COLOR_BGR2GRAY)
