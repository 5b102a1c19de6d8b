r"""Measure the orientation of mirrors from reflections of the drone's lamp.

Each reflection measures one normal, the bisector of the directions to the lamp and the camera. The
shape of the mirror determines the normal expected at that point. The small rotation ω, about the
concentrator's own x and y axes, from the expected normal n to the measured normal v is

$$ ω = \frac{n × v}{|n × v|} \arcsin |n × v| $$

The orientation is corrected by the mean of all ω, over the points or over the mirror area. Because
the points move on the mirror when the orientation changes, the correction is made twice. Then
outliers are rejected (Rosner's test of each component), and the final mean is the result. The
remaining ω at each point, its *angular difference*, contains all information on accuracy and on the
facets.

The two rounds, the test and the final mean are HelioPoint's procedure; the mean over the area is
our own addition.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.evaluate.budget import Budget
from heliotrope.airborne.evaluate.reflections import Reflections
from heliotrope.airborne.evaluate.statistics import (
    ALPHA,
    FIELD,
    SCATTER,
    SCATTER_WITH_MAP,
    normality,
    plain_sigma,
    rosner,
    spread_mean,
)
from heliotrope.airborne.mirror import MirrorShape, measured_normal
from heliotrope.airborne.visibility import FEWEST
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, azimuth_elevation, rotation

#: Kinds of mean over the points: with equal weights, or with weights that represent the whole area.
Mean = Literal["plain", "area"]

#: Number of rounds of mean and correction before the test for outliers.
ROUNDS = 2
# If at least this many mirrors are well measured, the rest are assumed to scatter like them.
_ENOUGH_MIRRORS = 5
# Distance between the centres of the points and of the mirror that causes a warning, in half
# widths.
_OFF_CENTRE = 0.25
# The canting of a facet is off if its mean differs by this many standard errors, and by this angle,
# rad.
_CANTED_SIGMA, _CANTED = 4.0, 0.5e-3
# Below this p-value (HelioPoint's threshold) the differences are reported as not normal. One good
# mirror in ten fails the test in one of its two components.
_NORMAL = 0.05


@dataclass(frozen=True)
class FacetMean:
    """The points on one facet.

    Attributes
    ----------
    facet, count
        Facet index, and its number of points without outliers, unless most points are outliers.
    mean
        Mean of the differences, rotX and rotY, rad, (2,), which is the facet's canting error
        relative to the mean of all facets; NaN if the facet has no points.
    sigma
        Standard error of the mean, σ/√n, rad, (2,).
    """

    facet: int
    count: int
    mean: FloatArray
    sigma: FloatArray


@dataclass(frozen=True)
class Orientation:
    """The orientation of one heliostat in one pose, from n reflections.

    Attributes
    ----------
    heliostat
        Row.
    rotation
        Rotation from concentrator coordinates to ENU, (3, 3).
    vertex
        ENU metres, (3,).
    correction
        rotX and rotY, rad: rotation from the expected to the measured orientation about the
        mirror's own axes, (2,).
    reflections
        The n reflections, outliers included.
    point
        Positions of the camera for each reflection, ENU metres, (n, 3).
    outlier
        (n,).
    weight
        Weight of each point in the mean, with sum 1; 0 for outliers, (n,).
    difference
        Angular difference between each point and the result, rotX and rotY, rad, (n, 2).
    sigma
        Standard deviation of the differences without outliers, rad, (2,).
    sigma_plain
        σ_mean as σ/√n, rad, (2,).
    sigma_mean
        σ_mean with the slope deviations treated as a fixed field, rad, (2,); for fewer than 8
        points see `heliotrope.airborne.evaluate.statistics.few_sigma`.
    systematic
        Error common to all points, rad, (2,).
    normality
        p-value of the Shapiro-Wilk test, (2,).
    facets
        Results for each facet.
    distance
        Mean distance from mirror to camera, m.
    mean
        Kind of mean that was used.
    warnings
        Warnings, one line each.
    """

    heliostat: int
    rotation: FloatArray
    vertex: FloatArray
    correction: FloatArray
    reflections: Reflections
    point: FloatArray
    outlier: npt.NDArray[np.bool_]
    weight: FloatArray
    difference: FloatArray
    sigma: FloatArray
    sigma_plain: FloatArray
    sigma_mean: FloatArray
    systematic: FloatArray
    normality: FloatArray
    facets: tuple[FacetMean, ...]
    distance: float
    mean: Mean
    warnings: tuple[str, ...] = ()

    @property
    def count(self) -> int:
        """Number of points without outliers."""
        return int((~self.outlier).sum())

    @property
    def normal(self) -> FloatArray:
        """Unit normal, ENU, (3,)."""
        return self.rotation[:, 2]

    @property
    def azimuth(self) -> float:
        """Azimuth of the normal, clockwise from north, rad."""
        return float(azimuth_elevation(self.normal)[0])

    @property
    def elevation(self) -> float:
        """Elevation of the normal, rad."""
        return float(azimuth_elevation(self.normal)[1])

    @property
    def sigma_total(self) -> FloatArray:
        """σ_tot of rotX and rotY: σ_mean and the systematic part combined, rad, (2,)."""
        return np.hypot(self.sigma_mean, self.systematic)


@dataclass(frozen=True)
class Orientations:
    """The orientations of a field.

    Attributes
    ----------
    names
        Names of all N heliostats.
    found
        Orientations that could be measured, in the order of the heliostats.
    left_out
        Name and reason for each requested heliostat that could not be measured.
    """

    names: tuple[str, ...]
    found: tuple[Orientation, ...]
    left_out: Mapping[str, str]

    def of(self, name: str) -> Orientation | None:
        """Return the orientation of heliostat ``name``; None if the heliostat was not measured."""
        return next((o for o in self.found if self.names[o.heliostat] == name), None)


def differences(
    reflections: Reflections,
    shape: MirrorShape,
    rotation: npt.ArrayLike,
    vertex: npt.ArrayLike,
    *,
    slopes: bool = True,
) -> FloatArray:
    """Return the rotations about x and y from expected to measured normals, rad, (n, 2).

    Parameters
    ----------
    reflections
        Reflections of one heliostat, n rows.
    shape
        Shape of its mirror.
    rotation, vertex
        Orientation, (3, 3), and vertex, ENU metres, (3,), of the mirror.
    slopes
        Whether expected normals include the slope map, if there is one.
    """
    R, v = as_float(rotation), as_float(vertex)
    point = v + shape.point_at(reflections.facet, reflections.xy) @ R.T
    measured = measured_normal(point, reflections.camera, reflections.led) @ R
    expected = shape.normal_at(reflections.facet, reflections.xy, slopes=slopes)
    turn = np.cross(expected, measured)
    sine = np.linalg.norm(turn, axis=-1, keepdims=True)
    angle = np.arctan2(sine[:, 0], np.sum(expected * measured, axis=-1))[:, None]
    return as_float(turn[:, :2] * np.where(sine > 0.0, angle / np.maximum(sine, 1e-300), 1.0))


def turned(R: npt.ArrayLike, rot: npt.ArrayLike) -> FloatArray:
    """Return orientation ``R`` rotated by rotX and rotY, rad, about its own axes, (3, 3)."""
    x, y = as_float(rot)
    axis = np.array([x, y, 0.0])
    return as_float(R) @ rotation(axis, float(np.hypot(x, y)))


def rotation_between(R: npt.ArrayLike, other: npt.ArrayLike) -> FloatArray:
    """Return rotX, rotY and rotZ, rad, (3,), that rotate orientation ``R`` into ``other``.

    The three angles are the components of a single rotation vector along the axes of R.
    """
    from scipy.spatial.transform import Rotation

    return as_float(Rotation.from_matrix(as_float(R).T @ as_float(other)).as_rotvec())


def measure(
    reflections: Reflections,
    shape: MirrorShape,
    rotation: npt.ArrayLike,
    vertex: npt.ArrayLike,
    *,
    pivot: npt.ArrayLike = (0.0, 0.0, 0.0),
    slopes: bool = True,
    budget: Budget | None = None,
    place: npt.ArrayLike | None = None,
    mean: Mean = "area",
    scatter: float | None = None,
    alpha: float = ALPHA,
    rounds: int = ROUNDS,
) -> Orientation:
    """Return the orientation of one heliostat.

    Parameters
    ----------
    reflections
        Reflections of this heliostat in this pose.
    shape
        Shape of its mirror.
    rotation, vertex
        Expected orientation (3, 3) and vertex, ENU metres, (3,).
    pivot
        Point about which the mirror rotates, relative to the vertex in concentrator coordinates, m,
        (3,).
    slopes
        Whether to use the slope map, if available.
    budget
        Errors common to all points; None for the default budget.
    place
        Covariance of the mirror's position relative to the drone, m², (3, 3); see
        `Budget.covariance`.
    mean
        "area" for weights that represent the whole mirror, or "plain" for equal weights, as in
        HelioPoint. Without a slope map the plain mean is worse, because points cluster where the
        surface is flat.
    scatter
        Prior standard deviation of one difference, rad, which stabilises σ if there are few
        reflections. The default is HelioPoint's value, which depends on whether there is a slope
        map.
    alpha, rounds
        False-alarm probability of the outlier test, and number of corrections before it.

    Raises
    ------
    InputError
        If there are no reflections, or they belong to several heliostats or to facets that the
        mirror does not have.
    """
    own = _checked(reflections, shape)
    start, foot, lever = as_float(rotation), as_float(vertex), as_float(pivot)
    R, keep = start, np.ones(len(own), dtype=np.bool_)

    def where(R: FloatArray) -> FloatArray:
        return as_float(foot + (start - R) @ lever)

    def update(R: FloatArray, mean: Mean) -> FloatArray:
        omega = differences(own, shape, R, where(R), slopes=slopes)
        return turned(R, _mean(omega, own, shape, keep, mean))

    for _ in range(rounds):
        # Any kind of mean moves the points to their positions.
        R = update(R, "plain")
    omega = differences(own, shape, R, where(R), slopes=slopes)
    keep = ~(rosner(omega[:, 0], alpha=alpha) | rosner(omega[:, 1], alpha=alpha))
    R = update(R, mean)
    difference = differences(own, shape, R, where(R), slopes=slopes)
    known = budget or Budget()
    usual = SCATTER_WITH_MAP if slopes and shape.slope is not None else SCATTER
    prior = usual if scatter is None else scatter
    return _result(own, shape, R, where(R), start, difference, keep, known, mean, place, prior)


def measure_field(
    reflections: Reflections,
    names: Sequence[str],
    shape: Callable[[int], MirrorShape],
    rotation: npt.ArrayLike,
    vertex: npt.ArrayLike,
    *,
    slopes: bool = True,
    budget: Budget | None = None,
    places: npt.ArrayLike | None = None,
    mean: Mean = "area",
) -> Orientations:
    """Return the orientations of all heliostats of a table of reflections.

    Parameters
    ----------
    reflections
        Reflections in one pose of the field.
    names
        Names of the N heliostats.
    shape
        Function that returns the mirror at an index.
    rotation, vertex
        Expected orientations (N, 3, 3) and vertices (N, 3).
    slopes, budget, mean
        See `measure`.
    places
        Covariances of the mirror positions relative to the drone, m², (N, 3, 3).

    Notes
    -----
    A heliostat that cannot be measured is listed with the reason, and the other heliostats are
    still measured. For mirrors with few reflections, σ is stabilised by the scatter of the
    well-measured mirrors.
    """
    turns, feet = as_float(rotation), as_float(vertex)
    covariances = None if places is None else as_float(places)

    def measure_one(row: int, mine: Reflections, scatter: float | None) -> Orientation:
        return measure(
            mine,
            shape(row),
            turns[row],
            feet[row],
            slopes=slopes,
            budget=budget,
            mean=mean,
            place=None if covariances is None else covariances[row],
            scatter=scatter,
        )

    orientations, left_out = [], {}
    for row in range(len(names)):
        mine = reflections.of(row)
        if not len(mine):
            left_out[names[row]] = "no reflection in any photograph"
            continue
        try:
            orientations.append(measure_one(row, mine, None))
        except InputError as error:
            left_out[names[row]] = str(error)
    common = _common_scatter(orientations)
    if common is not None:
        orientations = [
            o if o.count >= FIELD else measure_one(o.heliostat, o.reflections, common)
            for o in orientations
        ]
    return Orientations(tuple(names), tuple(orientations), left_out)


def _common_scatter(orientations: Sequence[Orientation]) -> float | None:
    """Return the typical scatter of a flight's mirrors, rad; None if too few are well measured."""
    known = [float(np.mean(o.sigma**2)) for o in orientations if o.count >= FEWEST]
    return float(np.sqrt(np.median(known))) if len(known) >= _ENOUGH_MIRRORS else None


def _checked(reflections: Reflections, shape: MirrorShape) -> Reflections:
    if not len(reflections):
        raise InputError("orientation: no reflections; at least one is needed")
    if (reflections.heliostat != reflections.heliostat[0]).any():
        raise InputError(
            "orientation: got reflections of several heliostats; pass the reflections of one "
            "heliostat"
        )
    highest = int(reflections.facet.max())
    if highest >= len(shape):
        raise InputError(
            f"orientation: a reflection on facet {highest}, but the mirror has {len(shape)} "
            "facets, counted from 0; check the heliostat type"
        )
    return reflections


def _mean(
    omega: FloatArray,
    own: Reflections,
    shape: MirrorShape,
    keep: npt.NDArray[np.bool_],
    mean: Mean,
) -> FloatArray:
    if mean == "plain":
        return as_float(omega[keep].mean(axis=0))
    if mean != "area":
        raise InputError(f"orientation: unknown mean {mean!r}; use 'plain' or 'area'")
    part = own.take(keep)
    uv = shape.along_facet(part.facet, part.xy)
    return as_float(spread_mean(omega[keep], shape, part.facet, uv).weights @ omega[keep])


def _result(
    own: Reflections,
    shape: MirrorShape,
    R: FloatArray,
    vertex: FloatArray,
    start: FloatArray,
    difference: FloatArray,
    keep: npt.NDArray[np.bool_],
    budget: Budget,
    mean: Mean,
    place: npt.ArrayLike | None,
    prior: float,
) -> Orientation:
    part, kept = own.take(keep), difference[keep]
    uv = shape.along_facet(part.facet, part.xy)
    known = spread_mean(kept, shape, part.facet, uv, prior)
    every = vertex + shape.point_at(own.facet, own.xy) @ R.T
    point = every[keep]
    # A rotation about x moves the normal towards −y, and a rotation about y towards x.
    axes = np.stack([-R[:, 1], R[:, 0]])
    weight = np.zeros(len(own))
    weight[keep] = known.weights if mean == "area" else 1.0 / len(kept)
    shared = budget.covariance(point, part.camera, part.led, axes, place)
    result = Orientation(
        heliostat=int(own.heliostat[0]),
        rotation=R,
        vertex=vertex,
        correction=rotation_between(start, R)[:2],
        reflections=own,
        point=every,
        outlier=~keep,
        weight=weight,
        difference=difference,
        sigma=kept.std(axis=0, ddof=1) if len(kept) > 1 else np.full(2, np.nan),
        sigma_plain=plain_sigma(kept),
        sigma_mean=known.sigma_weighted if mean == "area" else known.sigma,
        systematic=np.sqrt(np.diag(shared)),
        normality=np.array([normality(column) for column in kept.T]),
        facets=_facet_means(shape, own.facet, difference, keep),
        distance=float(np.linalg.norm(part.camera - point, axis=-1).mean()),
        mean=mean,
    )
    return replace(result, warnings=tuple(_warnings(result, shape, part.xy)))


def _facet_means(
    shape: MirrorShape,
    facet: npt.NDArray[np.intp],
    difference: FloatArray,
    keep: npt.NDArray[np.bool_],
) -> tuple[FacetMean, ...]:
    means = []
    for k in range(len(shape)):
        on = facet == k
        used = on & keep
        # On a wrongly canted facet most points are outliers of the mirror, but valid for the facet.
        mine = difference[used if 2 * used.sum() >= on.sum() else on]
        mean = mine.mean(axis=0) if len(mine) else np.full(2, np.nan)
        means.append(FacetMean(k, len(mine), mean, plain_sigma(mine)))
    return tuple(means)


def _warnings(o: Orientation, shape: MirrorShape, xy: FloatArray) -> list[str]:
    lines = []
    if o.count < FEWEST:
        lines.append(
            f"only {o.count} reflections: its σ relies on the typical scatter of mirrors; fly at "
            f"least {FEWEST} points"
        )
    area = np.prod(shape.half_size, axis=-1)
    share = area / area.sum()
    corners = shape.corners[..., :2].reshape(-1, 2)
    half = 0.5 * np.ptp(corners, axis=0)
    off = (xy.mean(axis=0) - share @ shape.center[:, :2]) / half
    if o.count >= FEWEST and (np.abs(off) > _OFF_CENTRE).any():
        effect = " and ".join(
            f"{1e3 * value:+.2f} mrad {name}"
            for value, name in zip(
                _tilt_by_gradient(o, xy, off * half), ("rotX", "rotY"), strict=True
            )
        )
        lines.append(
            f"asymmetric sampling: the centre of the points is {off[0]:+.2f} half widths to the "
            f"right of and {off[1]:+.2f} half heights above that of the mirror; if the "
            f"differences change linearly across it, the error is {effect}"
        )
    total = sum(f.count for f in o.facets)
    for f in o.facets:
        if f.count < 0.4 * share[f.facet] * total and len(o.facets) > 1:
            lines.append(
                f"facet {f.facet} has {f.count} of {total} reflections; it may be canted off, "
                "dirty or shaded"
            )
        away = _off_the_others(o, f)
        if away is not None:
            lines.append(
                f"facet {f.facet} is canted off by {1e3 * away[0]:+.2f} mrad rotX and "
                f"{1e3 * away[1]:+.2f} mrad rotY from the others"
            )
    for name, p in zip(("rotX", "rotY"), o.normality, strict=True):
        if p < _NORMAL:
            lines.append(
                f"the differences in {name} are not normally distributed (p = {p:.1e}); treat its "
                "standard deviation as an order of magnitude"
            )
    return lines


def _tilt_by_gradient(o: Orientation, xy: FloatArray, offset: FloatArray) -> FloatArray:
    """Return a plane through the differences at ``offset`` from their centre, (2,)."""
    centred = xy - xy.mean(axis=0)
    plane, *_ = np.linalg.lstsq(centred, o.difference[~o.outlier], rcond=None)
    return as_float(offset @ plane)


def _off_the_others(o: Orientation, f: FacetMean) -> FloatArray | None:
    """Return a facet's mean minus the median of the other facets' means, if significant."""
    others = [g for g in o.facets if g.facet != f.facet and g.count >= 3]
    if f.count < 3 or not others:
        return None
    # Use the median, so that the deviating facet is reported rather than all the other facets.
    away = f.mean - np.median([g.mean for g in others], axis=0)
    error = np.sqrt(f.sigma**2 + np.mean([g.sigma**2 for g in others], axis=0))
    if ((np.abs(away) > _CANTED_SIGMA * error) & (np.abs(away) > _CANTED)).any():
        return as_float(away)
    return None
