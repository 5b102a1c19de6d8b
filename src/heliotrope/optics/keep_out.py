"""Finds which beams enter keep-out volumes, at rest and in motion, and safe paths from stow.

A beam is modelled as a solid of revolution about its axis that is guaranteed to contain the beam:
as wide as the mirror diagonal, widening by the sun's radius and a stated error, and further beyond
the focus of the mirror (see `_keep_out_kernels`). A result of "clear" is therefore certain, whereas
"enters" means only that this solid comes within a millimetre of the volume. The solid is made of
spheres, so it extends half a mirror diagonal beyond both ends, and a volume within the swing of a
mirror counts as entered. Nothing shades a beam in this model, neither the ground nor other mirrors
nor the tower.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.volumes import Box, Cylinder, Prism, Sphere, Volume
from heliotrope.geometry import FloatArray, as_float, as_vectors, direction, normalize
from heliotrope.jit import as_input
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.tracking import TrackingStatus, track
from heliotrope.optics import _keep_out_kernels as kernels
from heliotrope.optics.beam import (
    NOMINAL_DNI,
    REACH,
    SUN_RADIUS,
    Beams,
    MirrorOptics,
    concentration,
    reaches,
)

#: Smallest rotation of a beam that `sweep` resolves, rad: half of the sun's disk.
RESOLUTION = SUN_RADIUS
#: Rotation of the line of sight between two waypoints of a safe path, rad.
WAY_STEP = 0.02


def clearance(points: npt.ArrayLike, volumes: Sequence[Volume]) -> FloatArray:
    """Return signed distances of points (..., 3) from V volumes, m, (..., V); negative inside."""
    p = as_vectors(points, "points")
    table, corners = _packed(volumes)
    flat = p.reshape(-1, 3)
    out = np.empty((len(flat), len(volumes)))
    kernels.distances(*map(as_input, (table, corners, flat)), out)
    return out.reshape(*p.shape[:-1], len(volumes))


def bounds(volumes: Sequence[Volume]) -> tuple[FloatArray, FloatArray]:
    """Return bounding spheres of volumes: centres, ENU, m, (V, 3), and radii, m, (V,)."""
    table, _ = _packed(volumes)
    return table[:, 1:4].copy(), table[:, 4].copy()


@dataclass(frozen=True)
class Entries:
    """Where N beams enter V volumes; NaN where they are clear.

    Attributes
    ----------
    volumes
        Names of the V volumes.
    first, last
        Distances along the beam of the first and last contact, m, (N, V).
    point
        Point on the axis at the first contact, ENU, (N, V, 3).
    irradiance
        Largest value on the axis from the first to the last contact, W/m², (N, V); 0 where
        clear.
    """

    volumes: tuple[str, ...]
    first: FloatArray
    last: FloatArray
    point: FloatArray
    irradiance: FloatArray

    @property
    def entered(self) -> npt.NDArray[np.bool_]:
        """Whether each beam enters each volume, (N, V)."""
        return np.asarray(np.isfinite(self.first))


def find_entries(given: Beams, volumes: Sequence[Volume], *, dni: float = NOMINAL_DNI) -> Entries:
    """Return where beams at rest enter volumes, and the irradiance there.

    Parameters
    ----------
    given
        N beams.
    volumes
        V volumes.
    dni
        Direct normal irradiance, W/m².
    """
    table, corners = _packed(volumes)
    shape = (len(given), len(volumes))
    first, last = np.empty(shape), np.empty(shape)
    inputs = (table, corners, given.origin, given.direction, given.reach, *given.mirrors.arrays())
    kernels.enter(*map(as_input, inputs), first, last)
    strongest = _strongest(given.mirrors, first, last, dni)
    names = tuple(v.name for v in volumes)
    return Entries(names, first, last, given.point(first), strongest)


def _strongest(
    mirrors: MirrorOptics, first: FloatArray, last: FloatArray, dni: float
) -> FloatArray:
    """Return the largest irradiance on the axis between two distances (N, V), W/m²."""
    area, focus = mirrors.area[:, None], mirrors.focus[:, None]
    radius = np.sqrt(area / np.pi)
    # 1 / (1 − x/b) grows up to this point; beyond it, all factors fall.
    peak = radius / (SUN_RADIUS + radius / focus)
    at = np.maximum(np.clip(peak, first, np.fmax(first, last)), 1e-6)
    strength = dni * mirrors.reflectivity[:, None] * concentration(at, area, focus)
    return as_float(np.where(np.isfinite(first), strength, 0.0))


@dataclass(frozen=True)
class Sweep:
    """Where the beams of N moving heliostats first enter V volumes; NaN where they are clear.

    Attributes
    ----------
    volumes
        Names of the V volumes.
    at
        End of the clear part of the path: index of its corner plus fraction of the next leg, (N,
        V).
    distance
        Distance along the beam to the contact, m, (N, V).
    point
        Point on the axis at the contact, ENU, (N, V, 3).
    irradiance
        Largest value on the axis within the volume in that pose, W/m², (N, V); 0 where
        clear.
    poses
        Number of poses tested for all pairs together.
    """

    volumes: tuple[str, ...]
    at: FloatArray
    distance: FloatArray
    point: FloatArray
    irradiance: FloatArray
    poses: int

    @property
    def entered(self) -> npt.NDArray[np.bool_]:
        """Whether each beam enters each volume, or may enter it, (N, V)."""
        return np.asarray(np.isfinite(self.at))


def sweep(
    armatures: Armature,
    path: npt.ArrayLike,
    sun: npt.ArrayLike,
    mirrors: MirrorOptics,
    volumes: Sequence[Volume],
    *,
    reach: npt.ArrayLike = REACH,
    resolution: float = RESOLUTION,
    dni: float = NOMINAL_DNI,
) -> Sweep:
    """Return where beams enter volumes while the joints move along a path.

    The check covers the whole path, not samples of it; see `_keep_out_kernels`. If the path cannot
    be proven clear at the given resolution, the beam counts as entering.

    Parameters
    ----------
    armatures
        Mechanisms, (N,) or ().
    path
        Joint angles of the corners, rad, (N, K, 2) or (K, 2). On each leg both joints move in
        proportion; if one joint arrives before the other, add a corner at that point.
    sun
        Unit vector to the sun, (3,) or (N, 3); the sun's motion during the sweep must be included
        in the mirrors' ``error``.
    mirrors, volumes
        N mirrors or one; V volumes.
    reach
        Distance up to which beams are followed, m.
    resolution
        Rotation of the beam below which a span of the path is not split further, rad.
    dni
        W/m².

    Raises
    ------
    InputError
        If shapes do not fit or a number is not finite.
    """
    rows = armatures.table.reshape(-1, 18)
    joints = as_float(path)
    if joints.ndim < 2 or joints.shape[-1] != 2 or not np.isfinite(joints).all():
        raise InputError(f"path: shape {joints.shape}; pass finite joint angles, (N, K, 2)")
    joints = joints if joints.ndim == 3 else joints[None]
    count = max(len(rows), len(joints))
    if {len(rows), len(joints)} - {1, count}:
        raise InputError(f"path: got {len(joints)} paths for {len(rows)} heliostats")
    if not (np.isfinite(resolution) and resolution > 0.0):
        raise InputError(f"resolution must be above 0, not {resolution} rad")
    s = np.broadcast_to(normalize(sun, "sun"), (count, 3))
    table, corners = _packed(volumes)
    every = mirrors.broadcast(count)
    entries = np.empty((count, len(volumes), 8))
    far = reaches(reach, count)
    inputs = (table, corners, _rows(rows, count), _rows(joints, count), s, far, *every.arrays())
    poses = kernels.move(*map(as_input, inputs), resolution, entries)
    first = entries[..., 1]
    last = _leaving(entries, table, corners, every, far)
    return Sweep(
        tuple(v.name for v in volumes),
        entries[..., 0],
        first,
        entries[..., 2:5] + first[..., None] * entries[..., 5:8],
        _strongest(every, first, last, dni),
        int(poses),
    )


def _leaving(
    entries: FloatArray,
    table: FloatArray,
    corners: FloatArray,
    mirrors: MirrorOptics,
    reach: FloatArray,
) -> FloatArray:
    """Return the last contact in the pose of the entry, m, (N, V); at least the first contact."""
    last = entries[..., 1].copy()
    radius, near, spread = mirrors.arrays()
    for v in range(len(table)):
        hit = np.flatnonzero(np.isfinite(last[:, v]))
        end = np.empty((2, len(hit), 1))
        pose = entries[hit, v]
        beams = (pose[:, 2:5], pose[:, 5:8], reach[hit], radius[hit], near[hit], spread[hit])
        kernels.enter(*map(as_input, (table[v : v + 1], corners, *beams)), end[0], end[1])
        last[hit, v] = np.fmax(last[hit, v], end[1, :, 0])
    return last


@dataclass(frozen=True)
class Way:
    """The path of one heliostat from stow to its standby point.

    Attributes
    ----------
    aims
        Aim points along the ground to the foot of the tower and up, ENU, m, (K, 3).
    path
        Joint angles, rad, (M, 2): stow; azimuth at its goal; elevation at the first aim; then the
        aims.
    clear
        Whether every beam on the path is proven to stay out of every volume, and every aim is
        reachable.
    motion
        Result of the keep-out check.
    text
        Result for the operator, in one line.
    """

    aims: FloatArray
    path: FloatArray
    clear: bool
    motion: Sweep
    text: str

    @property
    def back(self) -> FloatArray:
        """The path back to stow, rad, (M, 2): down, outwards, elevation, then azimuth.

        These are the poses of `path` in reverse. They are clear only for the sun position of the
        check; hours later a new path is needed.
        """
        return self.path[::-1]


def ground_way(
    vertex: npt.ArrayLike, first: npt.ArrayLike, foot: npt.ArrayLike, standby: npt.ArrayLike
) -> FloatArray:
    """Return aims (K, 3) along straight lines from ``first`` to ``foot`` and on to ``standby``.

    Successive aims are at most 20 mrad apart as seen from the vertex; all points are (3,), ENU, m.
    """
    m = as_vectors(vertex, "vertex")
    corners = [as_vectors(p, "aim") for p in (first, foot, standby)]
    aims = [corners[0]]
    for begin, end in pairwise(corners):
        share = np.linspace(0.0, 1.0, 2001)[:, None]
        sight = normalize(begin + share * (end - begin) - m, "aim - vertex")
        turned = np.cumsum(np.linalg.norm(np.diff(sight, axis=0), axis=1))
        pieces = max(1, int(np.ceil(turned[-1] / WAY_STEP)))
        angles = turned[-1] * np.arange(1, pieces + 1) / pieces
        at = np.interp(angles, np.concatenate([[0.0], turned]), share[:, 0])
        aims += list(begin + at[:, None] * (end - begin))
    aims[-1] = corners[2]
    return np.stack(aims)


def safe_way(
    armature: Armature,
    stow: npt.ArrayLike,
    sun: npt.ArrayLike,
    foot: npt.ArrayLike,
    standby: npt.ArrayLike,
    mirrors: MirrorOptics,
    volumes: Sequence[Volume],
    *,
    drives: Drive | None = None,
    first_distance: float = 10.0,
    reach: float = REACH,
) -> Way:
    """Return the verified path of one heliostat from stow to its standby point.

    From stow the azimuth moves first, then the elevation, until the beam meets the ground
    ``first_distance`` away; the beam then travels along the ground to the foot of the tower and up.
    The first ground point is tried in the direction of the foot, then at increasing angles to both
    sides. As the elevation moves, the beam sweeps the vertical plane through that point, which
    misses the tower if the point is to one side of it. The first clear path is returned; if there
    is none, the path that gets furthest is returned with the obstacle.

    Parameters
    ----------
    armature
        Batch shape ().
    stow
        Joint angles, rad, (2,).
    sun
        Unit vector to the sun, (3,).
    foot, standby
        Point on the ground where beams begin to rise, and the standby point where they end, ENU, m,
        (3,).
    mirrors
        One mirror.
    volumes
        Volumes that no beam may enter.
    drives
        Drives of the two joints, whose stops apply; default: no stops.
    first_distance
        m.
    reach
        Distance up to which beams are followed, m.
    """
    if armature.shape:
        raise InputError(f"safe_way: armature of shape {armature.shape}; pass one heliostat")
    begin, foot_ = as_float(stow), as_vectors(foot, "foot")
    if begin.shape != (2,) or not np.isfinite(begin).all():
        raise InputError(f"stow: {stow!r}; pass the 2 joint angles in rad")
    if not (np.isfinite(first_distance) and first_distance > 0.0):
        raise InputError(f"first_distance must be above 0, not {first_distance} m")
    vertex = armature.pose(begin)[1]
    away = foot_ - vertex
    towards = float(np.arctan2(away[0], away[1]))
    tried: list[Way] = []
    for side in (0, 30, -30, 60, -60, 90, -90, 120, -120, 150, -150, 180):
        flat = first_distance * direction(towards + np.radians(side), 0.0)
        first = np.array([vertex[0] + flat[0], vertex[1] + flat[1], foot_[2]])
        aims = ground_way(vertex, first, foot_, standby)
        candidate = _verified(armature, begin, aims, sun, mirrors, volumes, drives, reach)
        if candidate.clear:
            return candidate
        tried.append(candidate)
    return max(tried, key=lambda candidate: np.nanmin(candidate.motion.at, initial=np.inf))


def _verified(
    armature: Armature,
    stow: FloatArray,
    aims: FloatArray,
    sun: npt.ArrayLike,
    mirrors: MirrorOptics,
    volumes: Sequence[Volume],
    drives: Drive | None,
    reach: float,
) -> Way:
    """Return the path over the given aims, with its keep-out check."""
    poses, status = _angles(armature, stow, aims, sun, drives)
    path = np.stack([stow, np.array([poses[0, 0], stow[1]]), *poses])
    motion = sweep(armature, path, sun, mirrors, volumes, reach=reach)
    blocked = np.flatnonzero(motion.entered[0])
    lost = np.flatnonzero(status != TrackingStatus.OK)
    text = "every beam along the path is proven to stay outside every volume"
    if blocked.size:
        v = blocked[np.argmin(motion.at[0, blocked])]
        k = int(motion.at[0, v])
        leg = ("turning the azimuth", "turning the elevation")[k] if k < 2 else f"at aim {k - 1}"
        text = (
            f"the beam enters {motion.volumes[v]} {motion.distance[0, v]:.0f} m from the mirror "
            f"while {leg}; choose another first point of the path, standby point or time"
        )
    if lost.size:
        k = int(lost[0])
        text = f"aim {k + 1} of {len(aims)}: {TrackingStatus(int(status[k])).text}"
    return Way(aims, path, not blocked.size and not lost.size, motion, text)


def _angles(
    armature: Armature,
    stow: FloatArray,
    aims: FloatArray,
    sun: npt.ArrayLike,
    drives: Drive | None,
) -> tuple[FloatArray, npt.NDArray[np.int8]]:
    """Return joint angles (K, 2) for the aims, and the status.

    Of the possible poses for an aim, the one nearest to the previous pose is chosen.
    """
    s = normalize(sun, "sun")
    tracking = track(armature, s, aims, drives=drives)
    angles, status, before = np.empty((len(aims), 2)), np.empty(len(aims), np.int8), stow
    for k in range(len(aims)):
        # A full revolution of a joint results in the same pose; without drives, no stop prevents
        # it.
        options = tracking.angles[k]
        if drives is None:
            options = before + (options - before + np.pi) % (2.0 * np.pi) - np.pi
        ok = tracking.status[k] == TrackingStatus.OK
        cost = np.abs(options - before).max(axis=1) + np.where(ok, 0.0, 1e3)
        best = int(np.argmin(cost))
        before = angles[k] = options[best]
        status[k] = tracking.status[k, best]
    return angles, status


def _packed(volumes: Sequence[Volume]) -> tuple[FloatArray, FloatArray]:
    """Return the volumes in the form for the kernels: rows (V, SIZE) and corners (C, 2)."""
    table = np.zeros((len(volumes), kernels.SIZE))
    corners: list[FloatArray] = []
    count = 0
    for row, volume in zip(table, volumes, strict=True):
        match volume:
            case Sphere():
                _head(row, kernels.SPHERE, as_float(volume.center), volume.radius)
            case Box():
                half = 0.5 * as_float(volume.size)
                _head(row, kernels.BOX, as_float(volume.center), float(np.linalg.norm(half)))
                row[5:8] = half
                # To the right is (cos, −sin) of the azimuth, forwards (sin, cos).
                row[8:10] = np.cos(volume.azimuth), -np.sin(volume.azimuth)
            case Cylinder():
                start, end = as_float(volume.start), as_float(volume.end)
                length = float(np.linalg.norm(end - start))
                bound = float(np.hypot(0.5 * length, volume.radius))
                _head(row, kernels.CYLINDER, 0.5 * (start + end), bound)
                row[5:8] = (end - start) / length
                row[8:10] = 0.5 * length, volume.radius
            case Prism():
                outline = as_float(volume.corners)
                middle = 0.5 * (outline.min(axis=0) + outline.max(axis=0))
                half_height = 0.5 * (volume.top - volume.bottom)
                wide = float(np.linalg.norm(outline - middle, axis=1).max())
                center = np.array([*middle, 0.5 * (volume.top + volume.bottom)])
                _head(row, kernels.PRISM, center, float(np.hypot(wide, half_height)))
                row[5:8] = half_height, count, len(outline)
                corners.append(outline)
                count += len(outline)
    return table, np.concatenate(corners) if corners else np.empty((0, 2))


def _head(row: FloatArray, kind: int, center: FloatArray, bound: float) -> None:
    row[0], row[1:4], row[4] = kind, center, bound


def _rows(array: FloatArray, count: int) -> FloatArray:
    return as_float(np.broadcast_to(array, (count, *array.shape[1:])))
