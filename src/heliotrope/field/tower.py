"""Towers and masts that shade and block heliostats."""

from dataclasses import dataclass

import numpy as np

from heliotrope.errors import InputError


@dataclass(frozen=True)
class Tower:
    """An upright cylinder that shades and blocks.

    Attributes
    ----------
    east, north
        Position of the axis, ENU, m.
    radius
        m.
    bottom, top
        Heights of its two ends, ENU, m.
    """

    east: float
    north: float
    radius: float
    bottom: float
    top: float

    def __post_init__(self) -> None:
        places = (self.east, self.north, self.bottom, self.top)
        if not (np.isfinite(places).all() and self.radius > 0.0 and self.top > self.bottom):
            raise InputError(
                f"tower: radius must be above 0, and top above bottom; radius is {self.radius} m, "
                f"top {self.top} m and bottom {self.bottom} m"
            )
