"""Calibration points of a flight: the directions from which clusters of heliostats are measured.

Each direction requires one pose of every heliostat in the cluster. Directions are chosen like
sightings on a target, as the set that is most informative about the mechanism. HelioPoint takes the
calibration points from the plant operator; this selection is our own.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.plan.airspace import Airspace
from heliotrope.airborne.plan.clusters import tour
from heliotrope.airborne.plan.hover import Facing, HoverMirrors, Sampling, face
from heliotrope.airborne.plan.prospect import Prospect, prospect
from heliotrope.airborne.visibility import SMALLEST
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.plan.planning import (
    CandidateSightings,
    Criterion,
    SightingPlan,
    plan_sightings,
)
from heliotrope.calibration.sightings import drone
from heliotrope.calibration.uncertainty import error_form, precision
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, direction, tangent_axes
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import Drive

#: Approximate angle between candidates, rad.
_STEP = float(np.radians(12.0))
#: Number of mirrors of a cluster on which candidates are tried.
_SOME = 24


@dataclass(frozen=True)
class PointSelection:
    """How calibration points are chosen.

    Attributes
    ----------
    points
        Number of points per heliostat, which must exceed the number of unknowns of the model.
    criterion
        "d" for the most information, or "v" for the smallest beam error over the year.
    sigma
        Standard deviation of a measured normal that is common to all its reflections, per
        direction, rad.
    scatter
        Standard deviation of the normal measured by one reflection, rad, which is due to the slope
        deviations.
    least
        Minimum number of reflections on the median mirror for a direction to be flown.
    min_elevation, max_elevation
        Minimum and maximum elevation of the drone as seen from the cluster, rad. At low elevations
        mirrors hide each other.
    share
        Minimum fraction of a cluster's heliostats that must be able to face the drone.
    priors
        Standard deviations, by name, that replace those of the parameter table.
    """

    points: int = 20
    criterion: Criterion = "d"
    sigma: float = 2e-4
    min_elevation: float = float(np.radians(20.0))
    max_elevation: float = float(np.radians(85.0))
    share: float = 0.95
    priors: Mapping[str, float] | None = None
    scatter: float = 8e-4
    least: float = 3.0

    def __post_init__(self) -> None:
        if self.points < 1:
            raise InputError(
                f"the number of calibration points must be 1 or more, not {self.points}"
            )
        if not (np.isfinite(self.sigma) and self.sigma > 0.0):
            raise InputError(f"sigma of a normal must be above 0, not {self.sigma} rad")
        if not (np.isfinite(self.scatter) and self.scatter >= 0.0):
            raise InputError(f"scatter of a reflection must be 0 or more, not {self.scatter} rad")
        if not 0.0 <= self.min_elevation < self.max_elevation <= 0.5 * np.pi:
            raise InputError(
                "elevations must be between 0° and 90°, the lower first, not "
                f"{np.degrees(self.min_elevation):g}° to {np.degrees(self.max_elevation):g}°"
            )
        if not 0.0 < self.share <= 1.0:
            raise InputError(f"share must be above 0 and at most 1, not {self.share}")

    def check(self, names: tuple[str, ...], model: str) -> None:
        """Raise an error unless the points outnumber the unknowns of a model."""
        if self.points <= len(names):
            raise InputError(
                f"{self.points} calibration points: the model {model} has {len(names)} unknowns; "
                f"use {len(names) + 1} points or more"
            )


@dataclass(frozen=True)
class CalibrationPoints:
    """The K calibration points of one cluster of n mirrors, in the order of flight.

    Attributes
    ----------
    direction
        Unit vectors from the cluster's middle to the drone, (K, 3).
    point
        Point that all mirrors face, ENU metres, (K, 3).
    facing
        Poses, batch shape (K, n).
    plan
        The sightings selected for the central heliostat, with the expected errors.
    prospect
        What the photographs will show, (K, n).
    """

    direction: FloatArray
    point: FloatArray
    facing: Facing
    plan: SightingPlan
    prospect: Prospect

    def __len__(self) -> int:
        return len(self.direction)


def directions(selection: PointSelection) -> FloatArray:
    """Return unit vectors about 12° apart, within the elevation limits, (M, 3)."""
    low, high = selection.min_elevation, selection.max_elevation
    rings = max(2, int(np.ceil((high - low) / _STEP)) + 1)
    parts = []
    for k, elevation in enumerate(np.linspace(low, high, rings)):
        count = max(1, int(np.ceil(2.0 * np.pi * np.cos(elevation) / _STEP)))
        # Rings are staggered, so that columns do not line up.
        azimuth = 2.0 * np.pi * (np.arange(count) + 0.5 * (k % 2)) / count
        parts.append(direction(azimuth, np.full(count, elevation)))
    return np.concatenate(parts)


def calibration_points(
    mirrors: HoverMirrors,
    rows: npt.NDArray[np.intp],
    middle: Mechanism,
    aim: npt.ArrayLike,
    names: tuple[str, ...],
    suns: FloatArray,
    airspace: Airspace,
    sampling: Sampling,
    selection: PointSelection,
    label: str = "cluster",
) -> CalibrationPoints:
    """Return the calibration points of one cluster.

    Parameters
    ----------
    mirrors, rows
        Mirrors of the plant, and the indices of those in the cluster, (n,).
    middle
        Mechanism for which the points are chosen, batch shape (1,).
    aim
        Aim point of that mechanism in operation, (3,).
    names
        P parameters of the model.
    suns
        Directions to the sun over the year, (K, 3); see `information.suns_of_year`.
    airspace, sampling, selection
        Limits and settings.
    label
        Name of the cluster, for error messages.

    Raises
    ------
    InputError
        If fewer directions are possible than points are requested.
    """
    armature, drives = Armature(mirrors.armature.table[rows]), Drive(mirrors.drives.table[rows])
    centre = armature.origin_1.mean(axis=0)
    towards = directions(selection)
    points = centre + sampling.distance * towards
    free = _free(airspace, points, towards, mirrors, rows, sampling)
    if not free.any():
        raise InputError(
            f"{label}: heights, fence or keep-outs allow no position at {sampling.distance:g} m; "
            "lower the distance or the elevations, or raise the upper height limit"
        )
    towards, points = towards[free], points[free]
    # Neighbours can face almost the same directions, so some of the mirrors represent all of them.
    some = np.unique(np.linspace(0, len(rows) - 1, _SOME).astype(np.intp))
    facing = face(Armature(armature.table[some]), Drive(drives.table[some]), points[:, None])
    able = facing.able.mean(axis=1) >= selection.share
    possible, possible_points = towards[able], points[able]
    shown = prospect(
        mirrors, rows, face(armature, drives, possible_points[:, None]), possible_points, sampling
    )
    typical, side = (np.median(v, axis=1) for v in (shown.reflections, shown.side))
    sharp = (side >= SMALLEST) & (typical >= selection.least)
    candidates = _candidates(
        middle,
        possible[sharp],
        possible_points[sharp],
        names,
        np.hypot(selection.sigma, selection.scatter / np.sqrt(np.maximum(typical[sharp], 1.0))),
    )
    if len(candidates) < selection.points:
        raise InputError(
            f"{label}: {len(candidates)} directions are possible for {selection.points} "
            f"calibration points; {len(towards)} of {len(free)} lie in free air, "
            f"{int(able.sum())} of them within the stops, and {int(sharp.sum())} of these show "
            f"{selection.least:g} reflections on the median mirror, {SMALLEST:.0f} px or larger "
            f"(at best {typical.max(initial=0.0):.1f}, {side.max(initial=0.0):.0f} px); lower the "
            "distance, widen the elevations, sample more densely or ask for fewer points"
        )
    possible, possible_points = possible[sharp], possible_points[sharp]
    information = precision(middle, names, priors=selection.priors)[0]
    form = error_form(middle, aim, suns, names)[0]
    chosen = plan_sightings(
        candidates, selection.points, information, form, criterion=selection.criterion
    )
    index = chosen.chosen.time.astype(np.intp)
    # A short tour of the directions means short slews for the mirrors and short legs for the drone.
    south = np.array([0.0, -1.0, 0.0])
    index = index[tour(possible[index], south)]
    # Start from the previous pose, so that mirrors stay on their branch.
    counts, normal, vertex, ok = [], [], [], []
    current = None
    for point in possible_points[index]:
        step = face(armature, drives, point, current)
        current = step.counts
        counts.append(step.counts)
        normal.append(step.normal)
        vertex.append(step.vertex)
        ok.append(step.able)
    flown = Facing(np.stack(counts), np.stack(normal), np.stack(vertex), np.stack(ok))
    prospects = shown.take(np.flatnonzero(sharp)[index])
    return CalibrationPoints(possible[index], possible_points[index], flown, chosen, prospects)


def _free(
    airspace: Airspace,
    points: FloatArray,
    towards: FloatArray,
    mirrors: HoverMirrors,
    rows: npt.NDArray[np.intp],
    sampling: Sampling,
) -> npt.NDArray[np.bool_]:
    """Return the points with enough room for a pattern around them."""
    corners, distance = mirrors.corners[rows], sampling.distance
    middle = corners.mean(axis=2, keepdims=True)
    slope = mirrors.slopes[rows][:, :, None] - (corners - middle) / (2.0 * sampling.focal)
    wide = float(np.nanmax(np.linalg.norm(corners + distance * slope, axis=-1)))
    # Patterns are slightly larger where the optical axes are oblique to the plane of the pattern.
    half = 1.2 * (wide + distance * sampling.pointing) + sampling.least_spacing
    plane = half * tangent_axes(towards)
    free = airspace.free(points)
    for i, j in ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)):
        free &= airspace.free(points + i * plane[:, 0] + j * plane[:, 1])
    return free


def _candidates(
    middle: Mechanism,
    towards: FloatArray,
    points: FloatArray,
    names: tuple[str, ...],
    sigma: FloatArray,
) -> CandidateSightings:
    """Return one mirror's sightings of the drone; their "time" is the index of the direction."""
    facing = face(middle.armature, middle.drives, points[:, None])
    rows = np.flatnonzero(facing.able[:, 0])
    counts = facing.counts[rows, 0]
    # A normal that is off by σ rotates the ray by 2 σ.
    zero = np.zeros(len(rows), dtype=np.intp)
    if len(rows):
        observed = drone(zero, counts, points[rows], points[rows], sigma=2.0 * sigma[rows])
        jacobian = linearise(middle[zero], observed, names).jacobian
    else:
        jacobian = np.empty((0, 2, len(names)))
    angle = np.zeros(len(rows))
    return CandidateSightings(
        names,
        ("drone",),
        zero,
        zero,
        as_float(rows),
        towards[rows],
        counts,
        facing.normal[rows, 0],
        angle,
        angle,
        jacobian,
    )
