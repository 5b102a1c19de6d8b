r"""Hover patterns: drone positions from which the whole of every mirror is sampled.

The lamp and the camera are side by side, so a mirror shows the lamp where its normal points at the
drone. Consider a point of the mirror at height x above its vertex (in either direction of the
mirror plane), whose normal is tilted by the slope s(x) from the optical axis. The normal meets a
plane perpendicular to the axis at distance D in

$$ q(x) = x + D \, s(x) + D \, e $$

for a mirror with a pointing error e. The drone sees the whole mirror if the pattern covers the
range of x + D s(x), widened by D e on all sides. Within a facet of focal length f, s = -x / 2f, so
a step g of the drone moves the reflection by

$$ g / |1 - D / 2f| $$

and n samples on a facet of size w by h require $g = \sqrt{w h / n} \, |1 - D / 2f|$. A pointing
error thus moves the reflection on a flat facet by D e, which is 0.75 m at 150 m and 5 mrad.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray, as_float, normalize, tangent_axes
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.tracking import track

#: Number of rounds of the fixed-point iteration on the vertex; each reduces the error by the factor
#: offset over distance.
_ROUNDS = 4
#: If a step of the drone moves a reflection by 20 steps or more, the position of the reflection is
#: undefined.
_BLURRED = 0.05


@dataclass(frozen=True)
class Sampling:
    """How reflections are to be sampled.

    Attributes
    ----------
    distance
        Distance from the middle of a cluster to its hover plane, m.
    pointing
        Pointing error that the pattern covers, rad. For newly installed heliostats use a few times
        their standard deviation, later less.
    samples
        Number of samples on each facet.
    focal
        Focal length of the facets, m; infinite for flat facets.
    led_offset
        Position of the lamp relative to the camera, in camera axes (right, down, forward), m, (3,).
    least_spacing
        Minimum distance between points of the pattern, m; Litchi rejects less than 0.6 m.
    camera
        Focal length of the camera, px.
    """

    distance: float = 150.0
    pointing: float = 5e-3
    samples: float = 9.0
    focal: float = np.inf
    led_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    least_spacing: float = 0.6
    camera: float = 3000.0

    def __post_init__(self) -> None:
        units = {"distance": " m", "samples": "", "least_spacing": " m", "camera": " px"}
        for name, unit in units.items():
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise InputError(f"{name} must be above 0, not {value:g}{unit}")
        if not 0.0 <= self.pointing <= 0.1:
            raise InputError(
                f"pointing error must be between 0 and 100 mrad, not {1e3 * self.pointing:g} "
                "mrad; roughly align mirrors with larger errors first"
            )
        if not abs(self.focal) > 0.0:
            raise InputError("the focal length must not be 0 m; use infinity for flat facets")
        if np.shape(self.led_offset) != (3,) or not np.isfinite(self.led_offset).all():
            raise InputError("led_offset: use three numbers (right, down, forward) in metres")


@dataclass(frozen=True)
class HoverMirrors:
    """Properties of a plant's N heliostats on which hover patterns depend.

    Attributes
    ----------
    names
        Names of the heliostats.
    armature, drives
        Calibrated armatures and drives, batch shapes (N,) and (N, 2).
    corners
        Corners of the facets in the mirror's plane (x to the right as seen from the front, y up),
        m, (N, F, 4, 2); NaN for facets that a heliostat lacks.
    slopes
        Slopes of the facet normals relative to the mirror normal, rad, (N, F, 2).
    facet_area
        Area of the smallest facet, m², (N,).
    """

    names: tuple[str, ...]
    armature: Armature
    drives: Drive
    corners: FloatArray
    slopes: FloatArray
    facet_area: FloatArray

    def __len__(self) -> int:
        return len(self.names)


def mirrors(plant: Plant) -> HoverMirrors:
    """Return the mirrors of a plant, group by group.

    Raises
    ------
    InputError
        If the plant has no heliostats, or a mechanism does not have two drives.
    """
    if not len(plant):
        raise InputError("the plant has no heliostats; there is nothing to measure")
    for name, group in plant.groups.items():
        if len(group.mechanism.driven) != 2:
            raise InputError(
                f"group {name}: its mechanism has {len(group.mechanism.driven)} drive; a flight "
                "needs heliostats with two axes"
            )
    parts = []
    for group in plant.groups.values():
        if group.facets is None:
            centre = np.zeros((len(group), 1, 3))
            right, up = np.zeros_like(centre), np.zeros_like(centre)
            right[:, 0, 0], up[:, 0, 1] = 0.5 * group.width, 0.5 * group.height
        else:
            centre, right, up = (
                group.facets.center,
                group.facets.half_width,
                group.facets.half_height,
            )
        parts.append((centre, right, up))
    facets = max(part[0].shape[1] for part in parts)
    corners, slopes, areas = [], [], []
    for centre, right, up in parts:
        normal = np.cross(right, up)
        signs = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
        four = np.stack([centre + i * right + j * up for i, j in signs], axis=-2)[..., :2]
        missing = ((0, 0), (0, facets - centre.shape[1]))
        corners.append(np.pad(four, (*missing, (0, 0), (0, 0)), constant_values=np.nan))
        slope = normal[..., :2] / normal[..., 2:]
        slopes.append(np.pad(slope, (*missing, (0, 0)), constant_values=np.nan))
        areas.append(4.0 * np.linalg.norm(normal, axis=-1).min(axis=1))
    return HoverMirrors(
        plant.names,
        plant.armature,
        plant.drives,
        np.concatenate(corners),
        np.concatenate(slopes),
        np.concatenate(areas),
    )


@dataclass(frozen=True)
class Facing:
    """Mirrors facing a point; batch shape (...).

    Attributes
    ----------
    counts
        Drive counts, (..., 2).
    normal, vertex
        ENU, (..., 3).
    able
        Whether the pose is within the stops, (...).
    """

    counts: FloatArray
    normal: FloatArray
    vertex: FloatArray
    able: npt.NDArray[np.bool_]


def face(
    armature: Armature, drives: Drive, point: npt.ArrayLike, current: FloatArray | None = None
) -> Facing:
    """Return the poses in which optical axes pass through points.

    Parameters
    ----------
    armature, drives
        Batch shapes (N,) and (N, 2).
    point
        ENU metres, (..., 1, 3) or (..., N, 3).
    current
        Present drive counts, used to choose the nearer branch.

    Notes
    -----
    Lamp and camera are treated as one point, so the normal must satisfy n ∥ p − m. The vertex m
    moves with the pose. The direction to p is taken from the previous vertex, and its error shrinks
    by the factor offset / distance in each of four rounds. At 100 m and an offset of 0.5 m, the
    final error is less than a nanometre.
    """
    goal = as_float(point)
    start = armature.origin_1
    sun = normalize(goal - start, "direction to the look point")
    for _ in range(_ROUNDS):
        solved = track(armature, sun, goal, drives=drives, current=current)
        vertex = solved.chosen(solved.vertex)
        sun = normalize(goal - vertex, "direction to the look point")
    return Facing(
        solved.best_counts,
        solved.chosen(solved.normal),
        vertex,
        solved.reachable,
    )


@dataclass(frozen=True)
class Pattern:
    """A grid of hover points in a plane.

    Attributes
    ----------
    center
        Middle of the pattern, ENU metres, (3,).
    direction
        Unit vector from the field to the drone, normal to the plane, (3,).
    columns, rows
        Numbers of points across and upwards.
    spacing
        Spacing between neighbours, m.
    samples
        Expected number of samples per facet; fewer than requested if the minimum spacing does not
        allow more.
    camera
        Positions of the camera, row by row back and forth, ENU metres, (H, 3).
    """

    center: FloatArray
    direction: FloatArray
    columns: int
    rows: int
    spacing: float
    samples: float
    camera: FloatArray

    def __len__(self) -> int:
        return len(self.camera)


def reach(
    corners: FloatArray,
    slopes: FloatArray,
    vertex: FloatArray,
    point: FloatArray,
    direction: FloatArray,
    sampling: Sampling,
) -> tuple[FloatArray, FloatArray]:
    """Return the lower and upper bounds of the drone positions that mirrors require.

    Parameters
    ----------
    corners, slopes
        Corners and slopes of n mirrors, (n, F, 4, 2) and (n, F, 2).
    vertex
        Vertices of the mirrors, ENU metres, (n, 3); their axes pass through ``point``.
    point, direction
        A point of the hover plane, and its normal, (3,).
    sampling
        Focal length and pointing error.

    Returns
    -------
    Bounds along the plane's axes (`geometry.tangent_axes` of
    ``direction``), from ``point``, m, (2,) each. The mirrors' x axis is taken as horizontal.
    """
    away = point - vertex
    slant = np.linalg.norm(away, axis=-1)
    normal = away / slant[:, None]
    axes = tangent_axes(normal)
    right, up = -axes[:, 0, None, None], axes[:, 1, None, None]
    middle = corners.mean(axis=2, keepdims=True)
    # Within a curved facet the slope decreases with the distance from the middle of the facet.
    slope = slopes[:, :, None] - (corners - middle) / (2.0 * sampling.focal)
    place = vertex[:, None, None] + corners[..., :1] * right + corners[..., 1:] * up
    ray = normal[:, None, None] + slope[..., :1] * right + slope[..., 1:] * up
    along = (point - place) @ direction / (ray @ direction)
    plane = tangent_axes(direction)
    met = (place + along[..., None] * ray - point) @ plane.T
    tilt = normal @ direction
    widen = float((sampling.pointing * slant / tilt).max())
    flat = met.reshape(-1, 2)
    return np.nanmin(flat, axis=0) - widen, np.nanmax(flat, axis=0) + widen


def spacing(facet_area: FloatArray, slant: FloatArray, sampling: Sampling) -> tuple[float, float]:
    """Return the spacing of a pattern, m, and the number of samples on the worst facet.

    Parameters
    ----------
    facet_area, slant
        Area of the smallest facet, m², and distance to the drone, m, of n mirrors, (n,).
    sampling
        Requested sampling.

    Raises
    ------
    InputError
        If the drone is at the centre of curvature of curved facets.
    """
    scale = np.abs(1.0 - slant / (2.0 * sampling.focal))
    if scale.min() < _BLURRED:
        raise InputError(
            f"facets of {sampling.focal:g} m focal length, seen from "
            f"{float(slant[scale.argmin()]):.0f} m: close to twice the focal length the whole "
            "facet lights up; change the distance"
        )
    # Drone spacing that yields the requested number of samples.
    required = float((np.sqrt(facet_area / sampling.samples) * scale).min())
    step = max(required, sampling.least_spacing)
    return step, sampling.samples * (required / step) ** 2


def pattern(
    facing_vertex: FloatArray,
    corners: FloatArray,
    slopes: FloatArray,
    facet_area: FloatArray,
    point: npt.ArrayLike,
    direction: npt.ArrayLike,
    sampling: Sampling,
) -> Pattern:
    """Return the hover points from which the whole of n mirrors is sampled.

    Parameters
    ----------
    facing_vertex
        Vertices of the mirrors facing ``point``, ENU metres, (n, 3).
    corners, slopes, facet_area
        See `HoverMirrors`, for the n mirrors.
    point, direction
        Point that the mirrors face, and the normal of the plane, (3,).
    sampling
        Requested sampling.
    """
    p, d = as_float(point), as_float(direction)
    low, high = reach(corners, slopes, facing_vertex, p, d, sampling)
    step, samples = spacing(facet_area, np.linalg.norm(p - facing_vertex, axis=-1), sampling)
    columns, rows = (max(1, int(np.ceil(v - 1e-9))) for v in (high - low) / step)
    plane = tangent_axes(d)
    middle = p + 0.5 * (low + high) @ plane
    across = step * (np.arange(columns) - 0.5 * (columns - 1))
    upwards = step * (np.arange(rows) - 0.5 * (rows - 1))
    grid = np.stack(np.meshgrid(across, upwards), axis=-1)
    grid[1::2] = grid[1::2, ::-1].copy()
    # The mirror's normal points half-way between lamp and camera. Seen along −d, the plane's first
    # axis points to the left.
    right, down, ahead = sampling.led_offset
    lamp = -right * plane[0] - down * plane[1] - ahead * d
    camera = middle + grid.reshape(-1, 2) @ plane - 0.5 * lamp
    return Pattern(middle, d, columns, rows, step, samples, camera)
