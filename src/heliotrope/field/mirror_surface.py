"""The known properties of mirror surfaces apart from size: curvature, errors, facet grid."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, normalize
from heliotrope.values import Card, Value, card_of_arrays

#: Largest slope error per axis, rad.
LARGEST_ERROR = 0.1


@dataclass(frozen=True, eq=False)
class Canting:
    """How the facets of N mirrors are canted.

    Attributes
    ----------
    kind
        "none"; "slant": on axis, each mirror for its distance to its aim; "focal": on axis, for a
        focal length; "off_axis": for one sun position, at which every facet sends the sunlight to
        the aim.
    focal
        Focal length of kind "focal", m, (N,).
    sun
        Unit vector to the sun of kind "off_axis", ENU, (3,).
    """

    kind: Literal["none", "slant", "focal", "off_axis"] = "slant"
    focal: FloatArray | None = None
    sun: FloatArray | None = None

    def __post_init__(self) -> None:
        needed = {"focal": self.focal, "off_axis": self.sun}
        for kind, value in needed.items():
            if (self.kind == kind) != (value is not None):
                what = "focal length" if kind == "focal" else "time or sun vector"
                text = "needs a" if self.kind == kind else "takes no"
                raise InputError(f"canting {self.kind} {text} {what}")
        if self.focal is not None and not (self.focal > 0.0).all():
            raise InputError(
                f"canting: the focal length must be above 0, got {self.focal.min():g} m; for no "
                "canting, specify the kind none"
            )
        if self.sun is not None:
            object.__setattr__(self, "sun", normalize(self.sun, "canting: sun"))
            if self.sun[2] <= 0.0:
                raise InputError(
                    "canting: the sun is below the horizon at that time; choose a time in daylight"
                )

    def take(self, index: npt.NDArray[np.intp]) -> "Canting":
        """Return the canting of some of the mirrors."""
        return self if self.focal is None else replace(self, focal=self.focal[index])


@dataclass(frozen=True, eq=False)
class FacetGrid:
    """Equal facets in columns and rows, edge to edge or with gaps, and their canting.

    Attributes
    ----------
    columns, rows
        1 to 50 each; facets are counted from the lower left, row by row.
    gap
        Gap between neighbouring facets, m.
    canting
        Canting of the facets.
    """

    columns: int
    rows: int
    gap: float
    canting: Canting

    def places(self, width: FloatArray, height: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return centres and half sizes of the facets of N mirrors, m, (N, F, 2).

        Raises
        ------
        InputError
            If there are too many facets, or the gaps leave no room for facets.
        """
        counts = np.array([self.columns, self.rows])
        if not ((counts >= 1) & (counts <= 50)).all():
            raise InputError(
                f"mirrors must have 1 to 50 facets in each direction, not {self.columns} × "
                f"{self.rows}"
            )
        size = np.stack([width, height], axis=-1)
        whole = (size - self.gap * (counts - 1)) / counts
        if self.gap < 0.0 or not (whole > 0.0).all():
            raise InputError(
                f"gaps of {self.gap:g} m between {self.columns} × {self.rows} facets leave no room "
                f"on a mirror of {size.min(axis=0)[0]:g} × {size.min(axis=0)[1]:g} m; make the "
                "gaps smaller"
            )
        step = whole + self.gap
        x, y = (np.arange(n) - 0.5 * (n - 1) for n in counts)
        grid = np.stack([a.ravel() for a in np.meshgrid(x, y)], axis=-1)
        center = step[:, None] * grid
        return as_float(center), as_float(np.broadcast_to(0.5 * whole[:, None], center.shape))


@dataclass(frozen=True, eq=False, repr=False)
class MirrorSurface(Value):
    """Curvature and errors of the surfaces of N mirrors; None: unknown.

    Attributes
    ----------
    focal
        Focal length of the curvature, m, per mirror, (N,), or per facet, (N, F). If a mirror has
        facets, a focal length per mirror applies to each of its facets. Infinity: flat.
    slope
        Standard deviation of the surface's normal per axis, rad, (N,) or (N, F).
    reflectivity
        Reflectivity of the clean mirrors, (N,).
    maps
        For each mirror, the measured deviations of the slope from this surface, (F, H, W, 2), rad,
        or None; see `heliotrope.field.formats.slopes`. ``()``: no maps are known.
    """

    focal: FloatArray | None = None
    slope: FloatArray | None = None
    reflectivity: FloatArray | None = None
    maps: tuple[FloatArray | None, ...] = ()

    def _card(self) -> Card:
        return card_of_arrays(self)

    def check(self, names: Sequence[str], facets: int) -> None:
        """Check that shapes and numbers fit the named mirrors, which have F facets.

        Raises
        ------
        InputError
            If they do not fit; the message names the heliostat, the value and the limit.
        """
        count = len(names)
        limits = {
            "focal": (0.0, np.inf, "focal length", " m", "above 0"),
            "slope": (-1e-300, LARGEST_ERROR, "slope error", " rad", f"0 to {LARGEST_ERROR:g}"),
            "reflectivity": (-1e-300, 1.0, "reflectivity", "", "0 to 1"),
        }
        for key, (low, high, what, unit, text) in limits.items():
            value = getattr(self, key)
            if value is None:
                continue
            if value.shape not in ((count,), (count, facets)):
                raise InputError(
                    f"mirrors: {what} of shape {value.shape} for {count} mirrors of {facets} facets"
                )
            outside = ~((value > low) & (value <= high))
            if outside.any():
                place = tuple(np.argwhere(outside)[0])
                facet = f", facet {place[1]}" if len(place) > 1 else ""
                raise InputError(
                    f"heliostat {names[place[0]]}{facet}: {what} must be {text}{unit}, not "
                    f"{value[place]:g}{unit}"
                )
        if self.maps and len(self.maps) != count:
            raise InputError(f"mirrors: {len(self.maps)} slope maps for {count} mirrors")
        for name, slopes in zip(names, self.maps, strict=bool(self.maps)):
            if slopes is not None and (slopes.ndim != 4 or slopes.shape[::3] != (facets, 2)):
                raise InputError(
                    f"heliostat {name}: the slope map has shape {slopes.shape}, but the mirror has "
                    f"{facets} facets; expected ({facets}, rows, columns, 2)"
                )

    def take(self, index: npt.NDArray[np.intp]) -> "MirrorSurface":
        """Return the surfaces of some of the mirrors."""
        arrays = {key: getattr(self, key) for key in ("focal", "slope", "reflectivity")}
        return MirrorSurface(
            **{key: None if value is None else value[index] for key, value in arrays.items()},
            maps=tuple(self.maps[i] for i in index) if self.maps else (),
        )
