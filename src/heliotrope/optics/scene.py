"""The input of the flux engine and the ray tracer: mirrors, surfaces, towers and a sun vector.

All data are plain, immutable arrays in ENU metres and radians. `plant_scene` creates a `Scene` from
a plant, a sun vector and aims. A `Scene` contains neither the sun shape nor the atmosphere; the
functions that compute flux take these as separate arguments.

A mirror is a flat rectangle about its centre with a unit normal and two unit axes in its plane,
``right`` (as seen from its front) and ``up``. Its surface deviates only slightly from the plane: at
(x, y) along the axes the normal is tilted by −(x, y) / 2f, where f is the focal length. Facets are
rectangles in this plane, each with its own tilt (canting) and focal length; the mirror's own focal
length is then used only for casting shadows of its neighbours.
"""

from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.tower import Tower
from heliotrope.geometry import FloatArray, as_float, as_vectors, normalize, tangent_axes
from heliotrope.optics.surfaces import Surface

#: Tolerance for the direction and length of a mirror's axes.
_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class FacetTable:
    """F facets of each of K kinds of mirror (K may be the number of mirrors, or 1).

    Attributes
    ----------
    center
        Centre, right and up in the mirror's plane, m, (K, F, 2).
    tilt
        Canting: x and y components of the facet's normal in the mirror's axes (z is near 1), rad,
        (K, F, 2).
    half
        Half width and half height, m, (K, F, 2); 0 where a mirror has fewer facets.
    focal
        Focal length of the facet's own curvature, m; infinite if flat, negative if convex, (K, F).
    slope
        Standard deviation of the facet's normal per axis, rad, (K, F). It comes in addition to the
        mirror's own value (the variances add); None: 0.
    """

    center: FloatArray
    tilt: FloatArray
    half: FloatArray
    focal: FloatArray
    slope: FloatArray | None = None

    def __post_init__(self) -> None:
        shape = self.center.shape
        if len(shape) != 3 or not (
            shape[-1] == 2
            and self.tilt.shape == self.half.shape == shape
            and self.focal.shape == shape[:2]
            and (self.slope is None or self.slope.shape == shape[:2])
        ):
            raise InputError(
                f"facets: centre {self.center.shape}, tilt {self.tilt.shape}, half "
                f"{self.half.shape} and focal {self.focal.shape}; expected (K, F, 2) and (K, F)"
            )


@dataclass(frozen=True, eq=False)
class Mirrors:
    """H mirrors in their poses.

    Attributes
    ----------
    center, normal, right, up
        Centre, ENU m, unit normal and axes in the plane, (H, 3); right × up = normal.
    width, height
        Size along the axes, m, (H,).
    focal
        Focal length of the whole mirror, from curvature and canting, m, (H,); infinite if flat.
    aim
        Intended aim of each beam, ENU m, (H, 3). The normal determines the actual direction of the
        beam; the aim only sets the distance for blocking and attenuation.
    slope
        Standard deviation of the surface's normal per axis, rad, (H,).
    reflectivity, clean
        Reflectivity of the clean mirror and cleanliness, 0 to 1, (H,).
    pointing
        Covariance of the beam right of and above the aim as seen from the mirror (see
        `ExpectedError`), rad², (H, 2, 2).
    facets
        Facets; None: each mirror is one surface.
    kind
        Index in ``facets`` of each mirror's kind, (H,).
    """

    center: FloatArray
    normal: FloatArray
    right: FloatArray
    up: FloatArray
    width: FloatArray
    height: FloatArray
    focal: FloatArray
    aim: FloatArray
    slope: FloatArray
    reflectivity: FloatArray
    clean: FloatArray
    pointing: FloatArray
    facets: FacetTable | None = None
    kind: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @classmethod
    def of(
        cls,
        center: npt.ArrayLike,
        normal: npt.ArrayLike,
        size: tuple[npt.ArrayLike, npt.ArrayLike],
        aim: npt.ArrayLike,
        *,
        right: npt.ArrayLike | None = None,
        **more: npt.ArrayLike,
    ) -> Self:
        """Return mirrors from arrays or numbers that broadcast to (H,) or (H, 3).

        Parameters
        ----------
        center, normal, aim
            As for the attributes.
        size
            Width and height, m.
        right
            The axes ``right`` in the mirror planes; None: horizontal.
        **more
            Any of ``focal`` (default: the distance to the aim), ``slope`` (1e-3),
            ``reflectivity`` (0.9), ``clean`` (1) and ``pointing`` (0).

        Raises
        ------
        InputError
            If shapes do not match or a number is out of range.
        """
        middle = np.atleast_2d(as_vectors(center, "mirrors: centre"))
        count = len(middle)
        n = _vectors(normalize(normal, "mirrors: normal"), count, "normal")
        ends = _vectors(as_vectors(aim, "mirrors: aim"), count, "aim")
        if right is None:
            x = -tangent_axes(n)[:, 0]
        else:
            x = _vectors(normalize(right, "mirrors: right"), count, "right")
            if np.abs(np.sum(x * n, axis=-1)).max(initial=0.0) > _TOLERANCE:
                raise InputError("mirrors: an axis is not in the mirror's plane")
        slant = np.linalg.norm(ends - middle, axis=-1)
        values = {"focal": slant, "slope": 1e-3, "reflectivity": 0.9, "clean": 1.0, **more}
        spread = np.broadcast_to(as_float(values.pop("pointing", 0.0)), (count, 2, 2))
        values |= {"width": size[0], "height": size[1]}
        numbers = {name: _numbers(name, value, count) for name, value in values.items()}
        width, height, focal = (numbers[name] for name in ("width", "height", "focal"))
        slope, mirror, clean = (numbers[name] for name in ("slope", "reflectivity", "clean"))
        y = as_float(np.cross(n, x))
        return cls(middle, n, x, y, width, height, focal, ends, slope, mirror, clean, spread)

    def __len__(self) -> int:
        return len(self.center)

    @property
    def area(self) -> FloatArray:
        """Reflecting area, m², (H,): the area of the facets if there are any."""
        if self.facets is None:
            return as_float(self.width * self.height)
        return as_float((4.0 * self.facets.half.prod(axis=-1)).sum(axis=-1)[self.kind])

    @property
    def slant(self) -> FloatArray:
        """Distance to the aim, m, (H,)."""
        return as_float(np.linalg.norm(self.aim - self.center, axis=-1))

    def with_numbers(self, **numbers: npt.ArrayLike) -> "Mirrors":
        """Return the mirrors with some numbers replaced, each () or (H,).

        Parameters
        ----------
        **numbers
            Any of ``width``, ``height``, ``focal``, ``slope``, ``reflectivity`` and ``clean``.

        Raises
        ------
        InputError
            If a number is unknown, out of range, or of the wrong shape.
        """
        count = len(self)
        changes: dict[str, Any] = {k: _numbers(k, value, count) for k, value in numbers.items()}
        return replace(self, **changes)

    def take(self, rows: npt.NDArray[np.intp]) -> "Mirrors":
        """Return some of the mirrors, in the order of ``rows`` (M,)."""
        own = {k: v[rows] for k, v in vars(self).items() if k != "facets" and len(v) == len(self)}
        return replace(self, **own)

    def toward(self, sun: FloatArray, aim: npt.ArrayLike) -> "Mirrors":
        """Return the mirrors rotated about their centres so that they reflect the sun to new aims.

        Parameters
        ----------
        sun
            Unit vector, (3,).
        aim
            ENU m, (3,) or (H, 3). Focal lengths stay as they are.
        """
        ends = _vectors(as_vectors(aim, "mirrors: aim"), len(self), "aim")
        normal = normalize(normalize(ends - self.center) + sun)
        right = self.right - np.sum(self.right * normal, axis=-1, keepdims=True) * normal
        right = normalize(right)
        up = as_float(np.cross(normal, right))
        return replace(self, normal=normal, right=right, up=up, aim=ends)

    def with_facets(
        self, facets: FacetTable, kind: npt.NDArray[np.int64] | None = None
    ) -> "Mirrors":
        """Return the mirrors with given facets; ``kind`` may be omitted if K is 1 or H.

        Raises
        ------
        InputError
            If the numbers do not match, or a facet lies outside its mirror.
        """
        rows, count = len(facets.center), len(self)
        if kind is None:
            if rows not in (1, count):
                raise InputError(
                    f"facets: {rows} kinds for {count} mirrors; specify the kind of each mirror"
                )
            kind = np.arange(count) if rows == count else np.zeros(count, dtype=np.int64)
        if len(kind) != count or not ((kind >= 0) & (kind < rows)).all():
            raise InputError(f"facets: assign each of {count} mirrors a row from 0 to {rows - 1}")
        reach = (np.abs(facets.center) + facets.half).max(axis=1)[kind]
        half = 0.5 * np.stack([self.width, self.height], axis=-1)
        outside = (reach > half * 1.001 + 1e-3).any(axis=-1)
        if outside.any():
            k = int(np.flatnonzero(outside)[0])
            raise InputError(
                f"mirror {k}: a facet reaches {reach[k].max():.3f} m from the centre, but the "
                f"mirror is {self.width[k]:.3f} × {self.height[k]:.3f} m; correct one of them"
            )
        return replace(self, facets=facets, kind=np.asarray(kind, dtype=np.int64))


@dataclass(frozen=True, eq=False)
class Scene:
    """One instant of a field.

    Attributes
    ----------
    sun
        Unit vector to the sun, ENU, (3,).
    dni
        Direct normal irradiance, W/m².
    mirrors
        Mirrors in their poses. Mirrors in ``dark`` shade and block, but send no light.
    surfaces
        Receivers and targets; a beam is caught by the first surface that it meets.
    towers
        Obstacles, except those that belong to a surface.
    dark
        Mask of the mirrors whose beams are ignored, (H,).
    """

    sun: FloatArray
    dni: float
    mirrors: Mirrors
    surfaces: tuple[Surface, ...]
    towers: tuple[Tower, ...] = ()
    dark: npt.NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.dni) and self.dni >= 0.0):
            raise InputError(f"scene: DNI must be 0 or more and finite, not {self.dni} W/m²")
        object.__setattr__(self, "sun", normalize(self.sun, "scene: sun"))
        for tower in self.towers:
            center = self.mirrors.center
            away = np.hypot(center[:, 0] - tower.east, center[:, 1] - tower.north)
            height = center[:, 2]
            inside = (away < tower.radius) & (height > tower.bottom) & (height < tower.top)
            if inside.any():
                k = int(np.flatnonzero(inside)[0])
                raise InputError(
                    f"scene: mirror {k} is inside a tower of radius {tower.radius} m; move it"
                )

    def with_mirrors(self, mirrors: Mirrors) -> "Scene":
        """Return the scene with its mirrors in other poses."""
        return replace(self, mirrors=mirrors)

    @property
    def incidence(self) -> FloatArray:
        """Cosine of the angle of incidence of each mirror, (H,); 0 if the sun is behind it."""
        return as_float(np.maximum(self.mirrors.normal @ self.sun, 0.0))


def _vectors(value: FloatArray, count: int, name: str) -> FloatArray:
    if value.shape not in ((3,), (1, 3), (count, 3)):
        raise InputError(f"mirrors: {name} of shape {value.shape}; expected (3,) or ({count}, 3)")
    return np.ascontiguousarray(np.broadcast_to(value, (count, 3)))


#: Limits of the numbers of a mirror: minimum (excluded if the flag is set), maximum, unit.
_LIMITS = {
    "width": (0.0, True, np.inf, "m"),
    "height": (0.0, True, np.inf, "m"),
    "focal": (0.0, True, np.inf, "m"),
    "slope": (0.0, False, 0.1, "rad"),
    "reflectivity": (0.0, False, 1.0, ""),
    "clean": (0.0, False, 1.0, ""),
}


def _numbers(name: str, value: npt.ArrayLike, count: int) -> FloatArray:
    if name not in _LIMITS:
        raise InputError(f"mirrors: unknown {name!r}; known: {', '.join(_LIMITS)}, pointing")
    numbers = as_float(value)
    if numbers.shape not in ((), (1,), (count,)):
        raise InputError(f"mirrors: {name} of shape {numbers.shape}; pass 1 or {count} numbers")
    low, excluded, high, unit = _LIMITS[name]
    wrong = ~((numbers > low if excluded else numbers >= low) & (numbers <= high))
    if wrong.any():
        limit = f"above {low:g}" if excluded else f"between {low:g} and {high:g}"
        value = f"{numbers[wrong].flat[0]:g} {unit}".rstrip()
        raise InputError(f"mirrors: {name} must be {limit}, not {value}")
    return np.ascontiguousarray(np.broadcast_to(numbers, (count,)))
