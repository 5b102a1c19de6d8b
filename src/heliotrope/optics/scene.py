"""The input of the flux engine and the ray tracer: mirrors, surfaces, towers and a sun vector.

All data are plain, immutable arrays in ENU metres and radians. `scene_of` creates a `Scene` from a
plant, a sun vector and aims. A `Scene` contains neither the sun shape nor the atmosphere; the
functions that compute flux take these as separate arguments.

A mirror is a flat rectangle about its centre with a unit normal and two unit axes in its plane,
``right`` (as seen from its front) and ``up``. Its surface deviates only slightly from the plane: at
(x, y) along the axes the normal is tilted by −(x, y) / 2f, where f is the focal length. Facets are
rectangles in this plane, each with its own tilt (canting) and focal length; the mirror's own focal
length is then used only for casting shadows of its neighbours.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Self

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.heliostats import Facets
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver, Target
from heliotrope.geometry import FloatArray, as_float, as_vectors, normalize, tangent_axes
from heliotrope.mechanism.tracking import track
from heliotrope.optics.surfaces import Surface, surface_of

#: Direction and size of a mirror's axes agree to this.
_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class FacetTable:
    """F facets of each of K kinds of mirror (K may be the number of mirrors, or 1).

    Attributes
    ----------
    center
        Right and up in the mirror's plane, m, (K, F, 2).
    tilt
        Canting: x and y of the facet's normal in the mirror's axes, whose z is near 1, rad,
        (K, F, 2).
    half
        Half width and half height, m, (K, F, 2); 0 where a mirror has fewer facets.
    focal
        Focal length of the facet's own curvature, m; infinite if flat, (K, F).
    """

    center: FloatArray
    tilt: FloatArray
    half: FloatArray
    focal: FloatArray

    def __post_init__(self) -> None:
        shape = self.center.shape
        if len(shape) != 3 or not (
            shape[-1] == 2
            and self.tilt.shape == self.half.shape == shape
            and self.focal.shape == shape[:2]
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
        Middle, ENU m, unit normal and axes in the plane, (H, 3); right × up = normal.
    width, height
        Along the axes, m, (H,).
    focal
        Focal length of the whole mirror, from curvature and canting, m, (H,); infinite if flat.
    aim
        Where each is meant to send its beam, ENU m, (H, 3). The beam goes where the normal
        sends it: the aim only sets the casting of shadows and the distance for the air.
    slope
        Standard deviation of the surface's normal per axis, rad, (H,).
    reflectivity, clean
        Reflectivity of the clean mirror and the share that soiling leaves, 0 to 1, (H,).
    pointing
        Covariance of the beam right of and above the aim as seen from the mirror (see
        `ExpectedError`), rad², (H, 2, 2).
    facets
        Facets; None: each mirror is one surface.
    kind
        Row of ``facets`` of each mirror, (H,).
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
            As the attributes.
        size
            Width and height, m.
        right
            Horizontal axes in the planes; None: level.
        **more
            Any of ``focal`` (default: the distance to the aim), ``slope`` (1e-3),
            ``reflectivity`` (0.9), ``clean`` (1) and ``pointing`` (0).

        Raises
        ------
        InputError
            If shapes do not fit or a number is out of range.
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
        """Area that reflects, m², (H,): of the facets where there are any."""
        if self.facets is None:
            return as_float(self.width * self.height)
        return as_float((4.0 * self.facets.half.prod(axis=-1)).sum(axis=-1)[self.kind])

    @property
    def slant(self) -> FloatArray:
        """Distance to the aim, m, (H,)."""
        return as_float(np.linalg.norm(self.aim - self.center, axis=-1))

    def toward(self, sun: FloatArray, aim: npt.ArrayLike) -> "Mirrors":
        """Return the mirrors turned about their centres so that they send the sun to other aims.

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
        """Return the mirrors with facets; ``kind`` may be left out if K is 1 or H.

        Raises
        ------
        InputError
            If the numbers do not fit, or a facet lies outside its mirror.
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
                f"mirror is {self.width[k]:.3f} × {self.height[k]:.3f} m; correct either"
            )
        return replace(self, facets=facets, kind=np.asarray(kind, dtype=np.int64))


@dataclass(frozen=True)
class Tower:
    """An upright cylinder that shades and blocks.

    Attributes
    ----------
    east, north
        Place of its axis, m.
    radius
        m.
    bottom, top
        Heights of its ends, ENU m.
    """

    east: float
    north: float
    radius: float
    bottom: float
    top: float

    def __post_init__(self) -> None:
        if not (self.radius > 0.0 and self.top > self.bottom):
            raise InputError(
                f"tower: radius {self.radius} m must be above 0, and its top {self.top} m above "
                f"its bottom {self.bottom} m"
            )


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
        In their poses. Mirrors in ``dark`` shade and block, but send no light.
    surfaces
        Receivers and targets; a beam is caught by the first that it meets.
    towers
        Obstacles, except those that belong to a surface.
    dark
        Mirrors whose beams do not count, (H,).
    """

    sun: FloatArray
    dni: float
    mirrors: Mirrors
    surfaces: tuple[Surface, ...]
    towers: tuple[Tower, ...] = ()
    dark: npt.NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.dni) and self.dni >= 0.0):
            raise InputError(f"scene: DNI {self.dni} W/m² must be 0 or more and finite")
        object.__setattr__(self, "sun", normalize(self.sun, "scene: sun"))
        for tower in self.towers:
            center = self.mirrors.center
            away = np.hypot(center[:, 0] - tower.east, center[:, 1] - tower.north)
            height = center[:, 2]
            inside = (away < tower.radius) & (height > tower.bottom) & (height < tower.top)
            if inside.any():
                k = int(np.flatnonzero(inside)[0])
                raise InputError(
                    f"scene: mirror {k} stands inside a tower of radius {tower.radius} m; move it"
                )

    def with_mirrors(self, mirrors: Mirrors) -> "Scene":
        """Return the scene with its mirrors in other poses."""
        return replace(self, mirrors=mirrors)

    @property
    def incidence(self) -> FloatArray:
        """Cosine of the angle of incidence of each mirror, (H,); 0 if the sun is behind it."""
        return as_float(np.maximum(self.mirrors.normal @ self.sun, 0.0))


def scene_of(
    plant: Plant,
    sun: npt.ArrayLike,
    aim: npt.ArrayLike | None = None,
    *,
    receivers: Sequence[str | Receiver | Target | Surface] = (),
    dni: float = 900.0,
    focus: Literal["slant"] | float = "slant",
    towers: Sequence[Tower] = (),
    cells: tuple[int, int] | None = None,
    **mirrors: npt.ArrayLike,
) -> Scene:
    """Return the scene of a plant whose calibrated heliostats track the sun.

    Parameters
    ----------
    plant
        As calibrated. Heliostats that cannot reach their aim shade and block, and are dark.
    sun
        Unit vector, (3,).
    aim
        Aim points, ENU m, (3,) or (N, 3); None: each heliostat's own, else the middle of the
        first receiver.
    receivers
        Names in the plant, or surfaces; none: the plant's receivers.
    dni
        W/m².
    focus
        Focal length of the mirrors, m; "slant": each its distance to the aim, infinity: flat.
        Facets of the plant keep their tilt; this is the focal length of each facet then.
    towers
        Obstacles.
    cells
        Rows and columns on each receiver; None: as `surface_of` chooses.
    **mirrors
        Further arguments of `Mirrors.of`: ``slope``, ``reflectivity``, ``clean``, ``pointing``.

    Raises
    ------
    InputError
        If the plant has no receiver, or shapes do not fit.
    UnknownNameError
        If there is no receiver of a name.
    """
    light = as_vectors(sun, "sun")
    if light.shape != (3,):
        raise InputError(f"scene: a sun of shape {light.shape}; pass one sun vector, (3,)")
    chosen = tuple(receivers) or plant.receivers
    if not chosen:
        raise InputError(f"scene: plant {plant.name} has no receiver; add one to the plant file")
    surfaces = tuple(_surface(plant, item, cells) for item in chosen)
    ends = _aims(plant, surfaces[0].center, aim)
    tracking = track(plant, light, ends)
    vertex, normal = tracking.chosen(tracking.vertex), tracking.chosen(tracking.normal)
    slant = np.linalg.norm(ends - vertex, axis=-1)
    focal = slant if isinstance(focus, str) else np.broadcast_to(as_float(focus), slant.shape)
    size = [np.concatenate([getattr(g, s) for g in plant.groups.values()]) for s in _SIZES]
    built = Mirrors.of(vertex, normal, (size[0], size[1]), ends, focal=focal, **mirrors)
    table = facets_of(plant, focal)
    if table is not None:
        built = built.with_facets(*table)
    dark = ~np.asarray(tracking.reachable)
    return Scene(light, dni, built, surfaces, tuple(towers), dark)


_SIZES = ("width", "height")


def _surface(
    plant: Plant, item: str | Receiver | Target | Surface, cells: tuple[int, int] | None
) -> Surface:
    if isinstance(item, str):
        item = plant.receiver(item)
    return surface_of(item, cells) if isinstance(item, Receiver | Target) else item


def _aims(plant: Plant, middle: FloatArray, aim: npt.ArrayLike | None) -> FloatArray:
    count = len(plant)
    if aim is not None:
        return _vectors(as_vectors(aim, "aim"), count, "aim")
    own = [np.full((len(g), 3), np.nan) if g.aim is None else g.aim for g in plant.groups.values()]
    ends = np.concatenate(own)
    return np.where(np.isfinite(ends).all(axis=-1, keepdims=True), ends, middle)


def facets_of(plant: Plant, focal: FloatArray) -> tuple[FacetTable, npt.NDArray[np.int64]] | None:
    """Return the facets of a plant's heliostats and the row of each; None if none has facets.

    Parameters
    ----------
    plant
        Facets of groups with fewer are padded with empty ones.
    focal
        Focal length of the facets of each heliostat, m, (N,).
    """
    groups = list(plant.groups.values())
    most = max((g.facets.center.shape[1] for g in groups if g.facets is not None), default=0)
    if most == 0:
        return None
    tables, start = [], 0
    for group in groups:
        lengths = focal[start : start + len(group)]
        start += len(group)
        facets = group.facets
        if facets is None:
            side = np.stack([group.width, group.height], axis=-1)[:, None, :]
            tables.append(_padded(0.0 * side, 0.0 * side, 0.5 * side, lengths, most))
        else:
            tables.append(_padded(*_flat(facets), lengths, most))
    parts = [np.concatenate(column) for column in zip(*tables, strict=True)]
    return FacetTable(*parts), np.arange(len(plant))


def _flat(facets: Facets) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return centres, tilts and half sizes, (N, F, 2)."""
    normal = normalize(np.cross(facets.half_width, facets.half_height), "facets: normal")
    sides = (facets.half_width, facets.half_height)
    half = np.stack([np.linalg.norm(side, axis=-1) for side in sides], axis=-1)
    return facets.center[..., :2], normal[..., :2] / normal[..., 2:], half


def _padded(
    center: FloatArray, tilt: FloatArray, half: FloatArray, focal: FloatArray, most: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    room = ((0, 0), (0, most - center.shape[1]), (0, 0))
    lengths = np.broadcast_to(focal[:, None], (len(focal), most))
    return np.pad(center, room), np.pad(tilt, room), np.pad(half, room), lengths


def _vectors(value: FloatArray, count: int, name: str) -> FloatArray:
    if value.shape not in ((3,), (1, 3), (count, 3)):
        raise InputError(f"mirrors: {name} of shape {value.shape}; expected (3,) or ({count}, 3)")
    return np.ascontiguousarray(np.broadcast_to(value, (count, 3)))


#: Limits of the numbers of a mirror: lowest (excluded if the flag is set), highest, unit.
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
        limit = f"above {low:g}" if excluded else f"from {low:g} to {high:g}"
        raise InputError(f"mirrors: {name} {numbers[wrong].flat[0]:g} {unit} must be {limit}")
    return np.ascontiguousarray(np.broadcast_to(numbers, (count,)))
