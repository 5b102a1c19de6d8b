r"""A mirror surface in concentrator coordinates, and where it reflects a lamp to a camera.

Concentrator coordinates (HelioPoint's CCS): origin at the mirror vertex, x to the right and y up
along the mirror as seen from the front, z along its normal, m. The *rotation* of a mirror
transforms them into ENU.

A facet is a rectangle with its own axes u (right) and v (up). Its surface lies

$$ w(u, v) = (u^2 + v^2) / 4 f $$

above its plane, and a slope map adds measured deviations $∂z/∂u, ∂z/∂v$ of the slope. The
corresponding height changes are neglected: over half a metre 1 mrad is 0.5 mm, which deflects a ray
to a drone at 100 m by 5 µrad.

A reflection lies where the surface normal bisects the directions to the lamp and the camera, that
is, where

$$ g = (p + b_u / b_w, \; q + b_v / b_w) = 0 $$

with the slopes p, q and the bisector b in the facet axes. Within a cell of the slope map g is
bilinear except for the change of the directions; its (at most two) roots are the starting points
for Newton's method.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.heliostats import Facets, Heliostats
from heliotrope.geometry import FloatArray, as_float, as_vectors, bisector, normalize, rotation

IntArray = npt.NDArray[np.intp]

# Cells along an edge of a facet without slope map.
_CELLS = 4
# Number of nodes processed together, which takes tens of megabytes.
_BLOCK = 400_000
# Allowed difference of g from its bilinear form, as a fraction of its range in the cell.
_MARGIN = 0.05
_ITERATIONS = 30


@dataclass(frozen=True)
class MirrorShape:
    """The surface of one mirror with F facets, in concentrator coordinates.

    Attributes
    ----------
    center
        Centres of the facets, m, (F, 3).
    half_width, half_height
        Vectors from the centre of a facet to the midpoints of its right and upper edges, m, (F, 3).
    focal
        Focal lengths of the facets, m, (F,); inf for flat facets.
    slope
        Deviations ∂z/∂u and ∂z/∂v from the slopes of that surface along each facet's own right and
        upward edges, rad, (F, H, W, 2); None if there is no slope map. Row 0 is at the lower edge
        and column 0 at the left edge; values are at the centres of the H × W cells, with bilinear
        interpolation. A positive ∂z/∂u tilts the normal to the left.
    """

    center: FloatArray
    half_width: FloatArray
    half_height: FloatArray
    focal: FloatArray
    slope: FloatArray | None = None

    def __post_init__(self) -> None:
        for name in ("center", "half_width", "half_height"):
            object.__setattr__(self, name, as_vectors(getattr(self, name), f"mirror: {name}"))
        shape = self.center.shape
        if self.center.ndim != 2 or {self.half_width.shape, self.half_height.shape} != {shape}:
            raise InputError(f"mirror: facets of shape {shape}; expected centres and edges (F, 3)")
        focal = np.array(np.broadcast_to(as_float(self.focal), shape[:1]))
        if not (focal != 0.0).all():
            raise InputError(
                "mirror: a focal length is 0 m or not a number; use inf for a flat facet"
            )
        object.__setattr__(self, "focal", focal)
        area = np.linalg.norm(np.cross(self.half_width, self.half_height), axis=-1)
        if not (area > 0.0).all():
            k = int(np.argmin(area))
            raise InputError(f"mirror: facet {k} has no area; its edges must not be parallel")
        if self.slope is None:
            return
        slope = as_float(self.slope)
        if slope.ndim != 4 or slope.shape[0] != shape[0] or slope.shape[3] != 2 or not slope.size:
            raise InputError(
                f"mirror: the slope map has the shape {slope.shape}; expected ({shape[0]}, H, W, 2)"
            )
        if not np.isfinite(slope).all():
            k = int(np.argwhere(~np.isfinite(slope))[0, 0])
            raise InputError(f"mirror: the slope map of facet {k} has holes; fill them first")
        object.__setattr__(self, "slope", slope)

    def __len__(self) -> int:
        return len(self.center)

    @property
    def facets(self) -> Facets:
        """The facets of this mirror, in the form used in a plant."""
        return Facets(self.center[None], self.half_width[None], self.half_height[None])

    @cached_property
    def axes(self) -> FloatArray:
        """Unit axes of each facet to the right, up and outwards, as rows, (F, 3, 3)."""
        return as_float(self.facets.axes[0])

    @cached_property
    def half_size(self) -> FloatArray:
        """Half the width and the height of each facet, m, (F, 2)."""
        return as_float(self.facets.half_size[0])

    @cached_property
    def corners(self) -> FloatArray:
        """Corners of each facet: lower left, lower right, upper right, upper left, m, (F, 4, 3)."""
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        return self.on_facet(
            np.repeat(np.arange(len(self)), 4), (signs * self.half_size[:, None]).reshape(-1, 2)
        ).reshape(-1, 4, 3)

    def with_slopes(self, slope: npt.ArrayLike) -> "MirrorShape":
        """Return the mirror with slope deviations (F, H, W, 2), rad."""
        return replace(self, slope=as_float(slope))

    def canted(self, turns: npt.ArrayLike) -> "MirrorShape":
        """Return the mirror with each facet rotated about its own right and upward axes.

        Parameters
        ----------
        turns
            rad, (F, 2) or broadcastable to it.
        """
        angles = np.broadcast_to(as_float(turns), (len(self), 2))
        turn = rotation(self.axes[:, 0], angles[:, 0]) @ rotation(self.axes[:, 1], angles[:, 1])
        return replace(
            self,
            half_width=(turn @ self.half_width[..., None])[..., 0],
            half_height=(turn @ self.half_height[..., None])[..., 0],
        )

    def on_facet(self, facet: npt.ArrayLike, uv: npt.ArrayLike) -> FloatArray:
        """Return the surface points (K, 3) at ``uv`` (K, 2), m, on the axes of ``facet`` (K,)."""
        k, own = np.asarray(facet, dtype=np.intp), as_float(uv)
        high = np.sum(own**2, axis=-1) / (4.0 * self.focal[k])
        return as_float(
            self.center[k]
            + np.einsum("ki,kij->kj", np.concatenate([own, high[:, None]], -1), self.axes[k])
        )

    def along_facet(self, facet: npt.ArrayLike, xy: npt.ArrayLike) -> FloatArray:
        """Convert concentrator positions ``xy`` (K, 2), m, to positions on ``facet`` (K,), m."""
        k, target = np.asarray(facet, dtype=np.intp), as_float(xy)
        inverse = np.linalg.inv(np.swapaxes(self.axes[k][:, :2, :2], -1, -2))
        uv = np.zeros((len(k), 2))
        for _ in range(8):
            # Because the height is along the normal, it changes x and y only on a canted facet.
            gap = target - self.on_facet(k, uv)[:, :2]
            uv = uv + (inverse @ gap[..., None])[..., 0]
            if np.abs(gap).max(initial=0.0) < 1e-12:
                break
        return uv

    def facet_at(self, xy: npt.ArrayLike) -> IntArray:
        """Return the facet at each concentrator position, m, (K, 2); -1 if there is none."""
        points = as_float(xy).reshape(-1, 2)
        facets = np.full(len(points), -1, dtype=np.intp)
        for k in range(len(self)):
            uv = self.along_facet(np.full(len(points), k), points)
            facets[(np.abs(uv) <= self.half_size[k] + 1e-9).all(axis=-1) & (facets < 0)] = k
        return facets

    def point_at(self, facet: npt.ArrayLike, xy: npt.ArrayLike) -> FloatArray:
        """Return the surface points (K, 3) at concentrator positions, m, (K, 2)."""
        return self.on_facet(facet, self.along_facet(facet, xy))

    def normal_at(
        self, facet: npt.ArrayLike, xy: npt.ArrayLike, *, slopes: bool = True
    ) -> FloatArray:
        """Return unit normals in concentrator coordinates, (K, 3).

        Parameters
        ----------
        facet
            (K,).
        xy
            m in concentrator coordinates, (K, 2).
        slopes
            Whether to include the slope map, if there is one.
        """
        k = np.asarray(facet, dtype=np.intp)
        uv = self.along_facet(k, xy)
        slope = uv / (2.0 * self.focal[k, None])
        if slopes and self.slope is not None:
            slope = slope + self.slope_at(k, uv)
        own = np.concatenate([-slope, np.ones((len(k), 1))], axis=-1)
        return normalize(np.einsum("ki,kij->kj", own, self.axes[k]))

    def slope_at(self, facet: IntArray, uv: FloatArray) -> FloatArray:
        """Return the slope map, rad, (K, 2), at ``uv`` (K, 2), m, on the axes of facets (K,)."""
        cell, st = self._cell(facet, uv)
        return self.patch(facet, cell).at(st)[0]

    @cached_property
    def nodes(self) -> FloatArray:
        """Slope deviations at the cell corners, rad, (F, I, J, 2); constant towards the edges."""
        if self.slope is None:
            return np.zeros((len(self), _CELLS + 1, _CELLS + 1, 2))
        return np.pad(self.slope, ((0, 0), (1, 1), (1, 1), (0, 0)), mode="edge")

    @cached_property
    def lines(self) -> tuple[FloatArray, FloatArray]:
        """Positions of the cell corners, as fractions of the half width and half height."""
        rows, columns = self.nodes.shape[1:3]
        if self.slope is None:
            return np.linspace(-1.0, 1.0, columns), np.linspace(-1.0, 1.0, rows)
        across = [(2.0 * np.arange(n - 2) + 1.0) / (n - 2) - 1.0 for n in (columns, rows)]
        first, second = (np.concatenate([[-1.0], line, [1.0]]) for line in across)
        return first, second

    def _cell(self, facet: IntArray, uv: FloatArray) -> tuple[IntArray, FloatArray]:
        share = uv / self.half_size[facet]
        at, st = np.empty((len(uv), 2), dtype=np.intp), np.empty((len(uv), 2))
        for axis, line in enumerate(self.lines):
            place = np.clip(share[:, axis], -1.0, 1.0)
            k = np.clip(np.searchsorted(line, place, side="right") - 1, 0, len(line) - 2)
            at[:, axis], st[:, axis] = k, (place - line[k]) / (line[k + 1] - line[k])
        return at, st

    def patch(self, facet: IntArray, cell: IntArray) -> "Patch":
        """Return the slope map on cells, given as (column, row), (K, 2), of facets (K,)."""
        j, i = cell[:, 0], cell[:, 1]
        lines = self.lines
        low = np.stack([lines[0][j], lines[1][i]], axis=-1) * self.half_size[facet]
        high = np.stack([lines[0][j + 1], lines[1][i + 1]], axis=-1) * self.half_size[facet]
        n = self.nodes
        return Patch(
            low,
            high - low,
            n[facet, i, j],
            n[facet, i, j + 1],
            n[facet, i + 1, j],
            n[facet, i + 1, j + 1],
        )


@dataclass(frozen=True)
class Patch:
    """K cells: origin and size, m, (K, 2), and values of a bilinear function at the corners."""

    low: FloatArray
    size: FloatArray
    corner_00: FloatArray
    corner_10: FloatArray
    corner_01: FloatArray
    corner_11: FloatArray

    def at(self, st: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the function at fractional cell positions (K, 2), and its slopes per metre."""
        s, t = st[:, :1], st[:, 1:]
        by_s = self.corner_10 - self.corner_00
        by_t = self.corner_01 - self.corner_00
        twist = self.corner_11 - self.corner_10 - by_t
        value = self.corner_00 + s * by_s + t * by_t + s * t * twist
        slope = np.stack([by_s + t * twist, by_t + s * twist], axis=-1) / self.size[:, None, :]
        return value, slope


@dataclass(frozen=True)
class ReflectionPoints:
    """K reflections of a lamp in one mirror.

    Attributes
    ----------
    position
        Index of the camera position, (K,), ascending.
    facet
        (K,).
    xy
        Concentrator coordinates, m, (K, 2).
    point
        ENU, m, (K, 3).
    """

    position: IntArray
    facet: IntArray
    xy: FloatArray
    point: FloatArray

    def __len__(self) -> int:
        return len(self.position)


def ideal(heliostats: Heliostats, row: int, focal: npt.ArrayLike = np.inf) -> MirrorShape:
    """Return the mirror of the heliostat at index ``row`` as designed.

    Parameters
    ----------
    heliostats, row
        Heliostats, and an index. A mirror without facets is one facet with the width and height of
        the mirror.
    focal
        Focal length of the facets, m, () or (F,); inf for flat facets.
    """
    if heliostats.facets is None:
        return rectangle(heliostats.width[row], heliostats.height[row], focal)
    f = heliostats.facets
    return MirrorShape(f.center[row], f.half_width[row], f.half_height[row], as_float(focal))


def rectangle(width: float, height: float, focal: npt.ArrayLike = np.inf) -> MirrorShape:
    """Return a mirror of one facet, ``width`` by ``height`` metres."""
    return MirrorShape(
        np.zeros((1, 3)),
        np.array([[0.5 * width, 0.0, 0.0]]),
        np.array([[0.0, 0.5 * height, 0.0]]),
        as_float(focal),
    )


def tiled(
    columns: int,
    rows: int,
    width: float,
    height: float,
    *,
    gap: float = 0.0,
    focal: float = np.inf,
) -> MirrorShape:
    """Return a mirror of ``columns`` by ``rows`` facets, canted onto one focus.

    Parameters
    ----------
    columns, rows
        Numbers of columns and rows; facets are counted from the lower left, row by row.
    width, height
        Size of a facet, m.
    gap
        Gap between facets, m.
    focal
        Focal length of the whole mirror and of each facet, m; inf for a flat mirror.
    """
    x = (np.arange(columns) - 0.5 * (columns - 1)) * (width + gap)
    y = (np.arange(rows) - 0.5 * (rows - 1)) * (height + gap)
    center = np.zeros((rows * columns, 3))
    center[:, 0], center[:, 1] = np.tile(x, rows), np.repeat(y, columns)
    center[:, 2] = np.sum(center[:, :2] ** 2, axis=-1) / (4.0 * focal)
    out = normalize(
        np.stack(
            [-center[:, 0] / (2.0 * focal), -center[:, 1] / (2.0 * focal), np.ones(len(center))], -1
        )
    )
    right = normalize(np.cross((0.0, 1.0, 0.0), out))
    half = 0.5 * width * right, 0.5 * height * np.cross(out, right)
    return MirrorShape(center, *half, as_float(focal))


def measured_normal(point: npt.ArrayLike, camera: npt.ArrayLike, led: npt.ArrayLike) -> FloatArray:
    """Return the normals at points (..., 3) that reflect a lamp to a camera.

    Raises
    ------
    InputError
        If the lamp and the camera are on opposite sides of a point, or coincide with it.
    """
    m = as_vectors(point, "point")
    return bisector(
        normalize(as_vectors(led, "led") - m, "led from the mirror"),
        normalize(as_vectors(camera, "camera") - m, "camera from the mirror"),
    )


def reflection_points(
    shape: MirrorShape,
    rotation: npt.ArrayLike,
    vertex: npt.ArrayLike,
    camera: npt.ArrayLike,
    led: npt.ArrayLike,
) -> ReflectionPoints:
    """Return all points of a mirror that show the lamp to the camera, for P positions.

    A facet may show the lamp nowhere, once or several times. The points are exact to 1e-9 m. If the
    lamp and the camera are at a patch's centre of curvature, the whole patch lights up and there is
    no single point, so the patch is left out. Obstruction by other mirrors and facets is not
    considered.

    Parameters
    ----------
    shape
        Shape of the mirror, with its slope map if it has one.
    rotation
        Rotation from concentrator coordinates to ENU, (3, 3).
    vertex
        ENU metres, (3,).
    camera, led
        ENU metres, (P, 3) or broadcastable together.

    Raises
    ------
    InputError
        If a number is not finite.
    """
    R, v = as_float(rotation), as_vectors(vertex, "vertex")
    ends = np.broadcast_arrays(
        np.atleast_2d(as_vectors(camera, "camera")), np.atleast_2d(as_vectors(led, "led"))
    )
    own = [(e - v) @ R for e in ends]
    parts = [_within(shape, own[0], own[1], a, b) for a, b in _blocks(shape, len(own[0]))]
    position = np.concatenate([f[0] for f in parts]) if parts else np.empty(0, dtype=np.intp)
    facet = np.concatenate([f[1] for f in parts]) if parts else np.empty(0, dtype=np.intp)
    uv = np.concatenate([f[2] for f in parts]) if parts else np.empty((0, 2))
    point = shape.on_facet(facet, uv)
    return ReflectionPoints(position, facet, point[:, :2], v + point @ R.T)


def _blocks(shape: MirrorShape, positions: int) -> Iterator[tuple[int, int]]:
    step = max(1, _BLOCK // max(1, shape.nodes[..., 0].size))
    for a in range(0, positions, step):
        yield a, min(a + step, positions)


def _within(
    shape: MirrorShape, camera: FloatArray, led: FloatArray, start: int, stop: int
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return the position index, facet, and facet coordinates of the reflections in a block."""
    position, facet, cell, values = _candidates(shape, camera[start:stop], led[start:stop])
    position += start
    starts = _bilinear_roots(values)
    # Two starting points for each cell.
    position, facet = np.repeat(position, 2), np.repeat(facet, 2)
    patch = shape.patch(facet, np.repeat(cell, 2, axis=0))
    st = starts.reshape(-1, 2)
    ends = camera[position], led[position]
    st, good = _newton(shape, facet, patch, ends, st)
    good &= (st > -1e-9).all(axis=-1) & (st < 1.0 + 1e-9).all(axis=-1)
    position, facet = position[good], facet[good]
    uv = (patch.low + st * patch.size)[good]
    kept = _distinct(position, facet, uv)
    return position[kept], facet[kept], uv[kept]


def _candidates(
    shape: MirrorShape, camera: FloatArray, led: FloatArray
) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
    """Return position and facet indices, cells (K, 2), and g at the cell corners (K, 4, 2)."""
    nodes = shape.nodes
    facets, rows, columns = nodes.shape[:3]
    line_u, line_v = shape.lines
    share = np.stack(np.broadcast_arrays(line_u[None, :], line_v[:, None]), axis=-1)
    uv = shape.half_size[:, None, None] * share
    which = np.repeat(np.arange(facets), rows * columns)
    points = shape.on_facet(which, uv.reshape(-1, 2))
    slope = (uv / (2.0 * shape.focal[:, None, None, None]) + nodes).reshape(-1, 2)
    # Components are kept in separate arrays, because sums over a last axis of 3 are slow.
    total = [np.zeros((len(camera), len(points))) for _ in range(3)]
    for end in (camera, led):
        path = [end[:, k, None] - points[:, k] for k in range(3)]
        scale = 1.0 / np.sqrt(path[0] ** 2 + path[1] ** 2 + path[2] ** 2)
        for k in range(3):
            total[k] += path[k] * scale
    axes = shape.axes[which]
    u, v, w = (sum(total[i] * axes[:, k, i] for i in range(3)) for k in range(3))
    # Nothing is visible from behind the facet; NaN compares as false below.
    ahead = np.where(w > 0.0, w, np.nan)
    maybe = np.ones((len(camera), facets, rows - 1, columns - 1), dtype=np.bool_)
    corners = []
    for along, own in ((u, 0), (v, 1)):
        g = (slope[:, own] + along / ahead).reshape(-1, facets, rows, columns)
        four = [g[:, :, :-1, :-1], g[:, :, :-1, 1:], g[:, :, 1:, :-1], g[:, :, 1:, 1:]]
        low = np.minimum(np.minimum(four[0], four[1]), np.minimum(four[2], four[3]))
        high = np.maximum(np.maximum(four[0], four[1]), np.maximum(four[2], four[3]))
        margin = _MARGIN * (high - low) + 1e-12
        maybe &= (low <= margin) & (high >= -margin)
        corners.append(four)
    position, facet, row, column = np.nonzero(maybe)
    values = np.stack([np.stack([c[maybe] for c in four], -1) for four in corners], axis=-1)
    return position, facet, np.stack([column, row], axis=-1), values


def _bilinear_roots(corners: FloatArray) -> FloatArray:
    """Return both (s, t), (K, 2, 2), at which a + b s + c t + d s t is closest to 0.

    Eliminating s leaves (c × d) t² + (a × d + c × b) t + a × b = 0, with × the cross product in the
    plane. The positions are relative to the cell. For complex roots, their common real part is
    returned.
    """
    a = corners[:, 0]
    b, c = corners[:, 1] - a, corners[:, 2] - a
    d = corners[:, 3] - corners[:, 1] - c

    def cross(p: FloatArray, q: FloatArray) -> FloatArray:
        return as_float(p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0])

    quadratic, linear, constant = cross(c, d), cross(a, d) + cross(c, b), cross(a, b)
    root = np.sqrt(np.maximum(linear**2 - 4.0 * quadratic * constant, 0.0))
    # This is the numerically stable pair of roots, q / quadratic and constant / q.
    q = -0.5 * (linear + np.where(linear < 0.0, -root, root))
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.stack([constant / q, q / quadratic], axis=-1)
    t = np.clip(np.where(np.isfinite(t), t, 0.5), -0.5, 1.5)
    along = b[:, None] + d[:, None] * t[..., None]
    rest = a[:, None] + c[:, None] * t[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        s = -np.sum(rest * along, axis=-1) / np.sum(along**2, axis=-1)
    s = np.clip(np.where(np.isfinite(s), s, 0.5), -0.5, 1.5)
    return np.stack([s, t], axis=-1)


def _newton(
    shape: MirrorShape,
    facet: IntArray,
    patch: Patch,
    ends: tuple[FloatArray, FloatArray],
    st: FloatArray,
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Return fractional cell positions (K, 2) at which g is 0, and a mask of convergence."""
    good = np.zeros(len(st), dtype=np.bool_)
    for _ in range(_ITERATIONS):
        g, slope = _law(shape, facet, patch, ends, st)
        determinant = slope[:, 0, 0] * slope[:, 1, 1] - slope[:, 0, 1] * slope[:, 1, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            step = (
                np.stack(
                    [
                        slope[:, 0, 1] * g[:, 1] - slope[:, 1, 1] * g[:, 0],
                        slope[:, 1, 0] * g[:, 0] - slope[:, 0, 0] * g[:, 1],
                    ],
                    axis=-1,
                )
                / determinant[:, None]
            )
        usable = np.asarray(np.isfinite(step).all(axis=-1))
        step = np.where(usable[:, None], step, 0.0)
        good = usable & (np.abs(step) < 1e-10).all(axis=-1)
        share = step / patch.size
        # Beyond the next cell a different function applies.
        share /= np.maximum(1.0, np.abs(share).max(axis=-1, keepdims=True, initial=0.0))
        st = st + share
        if good.all():
            break
    return st, good


def _law(
    shape: MirrorShape,
    facet: IntArray,
    patch: Patch,
    ends: tuple[FloatArray, FloatArray],
    st: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return g (K, 2) and its derivatives along the facet's axes, per metre, (K, 2, 2)."""
    uv = patch.low + st * patch.size
    point, axes = shape.on_facet(facet, uv), shape.axes[facet]
    curve = 1.0 / (2.0 * shape.focal[facet])
    tangents = axes[:, :2] + (uv * curve[:, None])[..., None] * axes[:, 2:]
    total, change = np.zeros_like(point), np.zeros_like(tangents)
    for end in ends:
        direction = end - point
        distance = np.linalg.norm(direction, axis=-1)[:, None]
        direction = direction / distance
        along = np.einsum("kaj,kj->ka", tangents, direction)
        total += direction
        change -= (tangents - along[..., None] * direction[:, None]) / distance[..., None]
    own = np.einsum("kj,kij->ki", total, axes)
    turned = np.einsum("kaj,kij->kia", change, axes)
    tilt = own[:, :2] / own[:, 2:]
    value, slope = patch.at(st)
    by = (turned[:, :2] - tilt[..., None] * turned[:, 2:]) / own[:, 2:, None]
    by = by + slope + curve[:, None, None] * np.eye(2)
    return value + uv * curve[:, None] + tilt, by


def _distinct(position: IntArray, facet: IntArray, uv: FloatArray) -> IntArray:
    """Return reflections ordered by position, without duplicates within 1e-7 m."""
    order = np.lexsort((uv[:, 1], uv[:, 0], facet, position))
    kept: list[int] = []
    for row in order:
        again = False
        for other in reversed(kept):
            if position[other] != position[row] or facet[other] != facet[row]:
                break
            again |= bool(np.abs(uv[other] - uv[row]).max() < 1e-7)
        if not again:
            kept.append(int(row))
    return np.array(kept, dtype=np.intp)
