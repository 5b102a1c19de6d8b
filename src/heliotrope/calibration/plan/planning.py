"""Plan the sightings of one heliostat: the most informative sun positions and targets.

A camera-target sighting adds JᵀJ to the information on the parameters, with J the whitened
derivative of normal minus bisector. The *D-optimal* choice maximises the determinant of the
information, and the *V-optimal* choice minimises the expected squared error of the beam over the
year (Atkinson, Donev & Tobias 2007, chapters 10 and 12: greedy choice and Fedorov's exchange).
"""

from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from heliotrope import sun as solar
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.plan import gain as _gain
from heliotrope.calibration.sightings import sightings
from heliotrope.calibration.uncertainty import CHUNK, MIN_ELEVATION
from heliotrope.errors import InputError
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, angle_between, as_float
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.tracking import track
from heliotrope.sun import Site, Times

Criterion = Literal["d", "v"]
#: Maximum number of exchange rounds; usually two or three are needed.
SWEEPS = 50


@dataclass(frozen=True)
class SightingLimits:
    """Limits that a sighting must satisfy.

    Attributes
    ----------
    min_elevation
        Lowest apparent elevation of the sun, rad.
    max_incidence
        Largest angle between the sun and the mirror normal, rad.
    max_obliquity
        Largest angle between the beam and the target normal, rad.
    """

    min_elevation: float = MIN_ELEVATION
    max_incidence: float = float(np.radians(75.0))
    max_obliquity: float = float(np.radians(70.0))

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0.0 <= value < 0.5 * np.pi:
                raise InputError(
                    f"{field.name} must be between 0° and 90°, not {np.degrees(value):g}°"
                )


@dataclass(frozen=True)
class CandidateSightings:
    """M possible camera-target sightings.

    Attributes
    ----------
    names
        P parameters.
    targets
        Names of the targets.
    heliostat, target
        Heliostat indices, (M,).
    time
        Unix seconds (UTC), (M,).
    sun
        Unit vectors to the apparent sun, ENU, (M, 3).
    counts
        Drive counts, (M, D).
    normal
        Mirror normals, ENU, (M, 3).
    incidence, obliquity
        Angle between the sun and the mirror normal, and between the beam and the target normal,
        rad, (M,).
    jacobian
        Whitened derivative of normal minus bisector with respect to the parameters, (M, 2, P).
    """

    names: tuple[str, ...]
    targets: tuple[str, ...]
    heliostat: npt.NDArray[np.intp]
    target: npt.NDArray[np.intp]
    time: FloatArray
    sun: FloatArray
    counts: FloatArray
    normal: FloatArray
    incidence: FloatArray
    obliquity: FloatArray
    jacobian: FloatArray

    def __len__(self) -> int:
        return len(self.time)

    def take(self, rows: npt.ArrayLike) -> "CandidateSightings":
        """Return the sightings at indices ``rows`` (or a mask), in that order."""
        index = np.asarray(rows)
        if not index.size:
            index = index.astype(np.intp)
        whole = ("names", "targets")
        return replace(
            self,
            **{f.name: getattr(self, f.name)[index] for f in fields(self) if f.name not in whole},
        )

    def of(self, heliostat: int) -> "CandidateSightings":
        """Return the sightings of one heliostat."""
        return self.take(np.flatnonzero(self.heliostat == heliostat))


@dataclass(frozen=True)
class Aimed:
    """Heliostats aimed at a target; batch shape (...).

    Attributes
    ----------
    counts, normal
        Drive counts (..., D) and mirror normals (..., 3).
    incidence, obliquity
        rad, (...).
    able
        Whether the stops and limits allow the pose, (...).
    """

    counts: FloatArray
    normal: FloatArray
    incidence: FloatArray
    obliquity: FloatArray
    able: npt.NDArray[np.bool_]


def aim_at(
    mechanism: Mechanism,
    sun: FloatArray,
    target: Target,
    limits: SightingLimits,
    current: FloatArray | None = None,
) -> Aimed:
    """Return the poses that reflect the sun to the centre of a target.

    Parameters
    ----------
    mechanism, sun
        Mechanisms, and unit vectors to the sun, ENU, (..., 3); their batch shapes broadcast. The
        elevation of the sun is not checked.
    target, limits
        The target, and the limits that decide `Aimed.able`.
    current
        Present drive counts, (..., D), used to choose the nearer branch.
    """
    solved = track(mechanism, sun, target.center, current=current)
    normal, vertex = solved.chosen(solved.normal), solved.chosen(solved.vertex)
    with np.errstate(invalid="ignore"):
        incidence = angle_between(np.broadcast_to(sun, normal.shape), normal)
        back = vertex - target.center
        back = back / np.linalg.norm(back, axis=-1, keepdims=True)
        obliquity = angle_between(back, np.broadcast_to(target.normal, back.shape))
        able = (
            solved.reachable
            & (incidence <= limits.max_incidence)
            & (obliquity <= limits.max_obliquity)
        )
    return Aimed(solved.best_counts, normal, incidence, obliquity, able)


def candidate_sightings(
    mechanism: Mechanism,
    site: Site,
    targets: tuple[Target, ...],
    times: Times,
    names: tuple[str, ...],
    *,
    sigma: npt.ArrayLike = 5e-4,
    limits: SightingLimits | None = None,
) -> CandidateSightings:
    """Return all sightings that the sun position, the targets and the stops allow.

    Parameters
    ----------
    mechanism
        Best estimates, batch shape (N,).
    site
        Location and atmosphere.
    targets
        Targets with cameras; beams are sent to their centres.
    times
        T times; see `heliotrope.sun.Times`. `time_grid` creates them.
    names
        P parameters of the table.
    sigma
        Standard deviation of the beam direction as the camera measures it, rad, () or (N,).
    limits
        Default: `SightingLimits()`.

    Returns
    -------
    Candidates sorted by heliostat, then by target, then by time; there may be none.

    Raises
    ------
    InputError
        If there is no target, or the mechanisms do not have exactly one batch axis.
    """
    if not targets:
        raise InputError("planning: there is no target; a camera-target sighting needs one")
    if len(mechanism.shape) != 1:
        raise InputError(
            f"mechanisms must have one batch axis (N,), not the shape {mechanism.shape}"
        )
    bounds = limits or SightingLimits()
    moments = np.atleast_1d(solar.unix_seconds(times))
    above = solar.position(moments, site)
    up = above.elevation >= bounds.min_elevation
    moments, suns = moments[up], above.vector[up]
    spread = np.broadcast_to(as_float(sigma), (len(mechanism),))
    step = max(1, CHUNK // max(1, len(moments)))
    parts = [
        _part(
            mechanism,
            first,
            min(first + step, len(mechanism)),
            k,
            target,
            moments,
            suns,
            names,
            spread,
            bounds,
        )
        for first in range(0, len(mechanism), step)
        for k, target in enumerate(targets)
    ]
    joined = [np.concatenate(arrays) for arrays in zip(*parts, strict=True)]
    order = np.lexsort((joined[2], joined[1], joined[0]))
    labels = tuple(t.name for t in targets)
    return CandidateSightings(names, labels, *(array[order] for array in joined))


def _part(
    mechanism: Mechanism,
    first: int,
    last: int,
    k: int,
    target: Target,
    moments: FloatArray,
    suns: FloatArray,
    names: tuple[str, ...],
    sigma: FloatArray,
    limits: SightingLimits,
) -> tuple[np.ndarray, ...]:
    """Return the arrays of `CandidateSightings` for some heliostats and one target."""
    some = mechanism[first:last]
    aimed = aim_at(some, suns[:, None], target, limits)
    row, which = np.nonzero(aimed.able.T)
    counts = aimed.counts[which, row]
    slope = sighting_jacobian(some[row], counts, suns[which], target, names, sigma[first + row])
    return (
        (first + row).astype(np.intp),
        np.full(len(row), k, dtype=np.intp),
        moments[which],
        suns[which],
        counts,
        aimed.normal[which, row],
        aimed.incidence[which, row],
        aimed.obliquity[which, row],
        slope,
    )


def sighting_jacobian(
    mechanism: Mechanism,
    counts: FloatArray,
    sun: FloatArray,
    target: Target,
    names: tuple[str, ...],
    sigma: npt.ArrayLike,
) -> FloatArray:
    """Return the whitened derivative of normal minus bisector, (M, 2, P).

    Parameters
    ----------
    mechanism
        One mechanism per sighting, batch shape (M,).
    counts, sun
        Drive counts (M, D) and unit vectors (M, 3).
    target
        Target; the beam is at its centre.
    names
        P parameters.
    sigma
        Standard deviation of the beam direction, rad, () or (M,).
    """
    rows = len(counts)
    if not rows:
        return np.empty((0, 2, len(names)))
    observed = sightings(np.arange(rows), counts, sun, target.center, sigma=sigma)
    return linearise(mechanism, observed, names).jacobian


def time_grid(start: float, stop: float, every: float) -> FloatArray:
    """Return the multiples of ``every`` s from ``start`` to ``stop``, unix seconds, (T,).

    Raises
    ------
    InputError
        If the span is empty or holds more than 200,000 steps.
    """
    if not (np.isfinite([start, stop, every]).all() and every > 0.0 and stop > start):
        raise InputError(
            f"times from {start:.0f} to {stop:.0f} s every {every:g} s: the end must be after "
            "the start"
        )
    if (stop - start) / every > 200_000:
        raise InputError(
            f"{(stop - start) / every:.0f} times in the period exceed 200,000; use a longer step "
            "or a shorter period"
        )
    return np.arange(np.ceil(start / every), np.floor(stop / every) + 1.0) * every


@dataclass(frozen=True)
class SightingPlan:
    """K planned sightings of one heliostat, in order of time.

    Attributes
    ----------
    chosen
        The sightings.
    rank
        Rank by usefulness, 1 to K, (K,).
    gain
        Increase in the log determinant of the information, nats, (K,).
    before
        Expected RMS beam error over the year before the first sighting, rad.
    error
        Expected RMS beam error after each sighting, rad, (K,).
    best_first
        Expected RMS beam error after each sighting if sightings are made in order of rank, rad,
        (K,).
    covariance
        Covariance of the parameters after all sightings, (P, P).
    """

    chosen: CandidateSightings
    rank: npt.NDArray[np.intp]
    gain: FloatArray
    before: float
    error: FloatArray
    best_first: FloatArray
    covariance: FloatArray

    def __len__(self) -> int:
        return len(self.chosen)

    @property
    def log_det(self) -> float:
        """Increase in the log determinant from all sightings, nats."""
        return float(self.gain.sum())


def plan_sightings(
    candidates: CandidateSightings,
    count: int,
    information: npt.ArrayLike,
    form: npt.ArrayLike,
    *,
    criterion: Criterion = "d",
    exchange: bool = True,
    gap: float = 0.0,
) -> SightingPlan:
    """Return the most informative set of sightings of one heliostat.

    Parameters
    ----------
    candidates
        Candidates of the heliostat, (M,).
    count
        Number of sightings to choose; fewer are chosen if there are not enough candidates.
    information
        Information matrix of the parameters so far, (P, P); see `precision`.
    form
        Quadratic form of the squared beam error, (P, P); see `error_form`.
    criterion
        "d" for the largest determinant of the information, or "v" for the smallest expected squared
        beam error.
    exchange
        Whether to improve the greedy choice by exchanging one sighting at a time.
    gap
        Minimum time between two sightings, s; at 0 the times need only differ.

    Raises
    ------
    InputError
        If there are no candidates, the count is below 1 or the criterion is unknown.

    Notes
    -----
    The increase in log det is submodular, so the greedy choice reaches at least 63 % of the largest
    possible increase (Nemhauser et al. 1978); in the tests, the choice after exchange reaches 98 %
    or more.
    """
    if criterion not in ("d", "v"):
        raise InputError(
            f"unknown criterion {criterion!r}; use d (determinant) or v (beam variance)"
        )
    if count < 1:
        raise InputError(f"count must be 1 sighting or more, not {count}")
    if not len(candidates):
        raise InputError(
            "planning: no candidate, because sun, end stops or limits allow no sighting at these "
            "times; lengthen the period"
        )
    matrix = as_float(information)
    scale = 1.0 / np.sqrt(np.diagonal(matrix))
    slope = candidates.jacobian * scale
    # After scaling, metres and radians have equal weight, and the prior is close to the unit
    # matrix.
    known = matrix * scale[:, None] * scale
    weights = as_float(form) * scale[:, None] * scale
    choice = _Choice(slope, candidates.time, known, weights, criterion, gap)
    rows = choice.greedy(count, np.arange(len(candidates)))
    if exchange:
        rows = choice.exchange(rows)
    rows = sorted(rows, key=lambda r: (candidates.time[r], r))
    best = choice.greedy(len(rows), np.array(rows), apart=False)
    gain, error, covariance = choice.walk(rows)
    return SightingPlan(
        chosen=candidates.take(rows),
        rank=np.array([best.index(r) + 1 for r in rows], dtype=np.intp),
        gain=gain,
        before=float(np.sqrt(max(0.0, np.trace(weights @ np.linalg.inv(known))))),
        error=error,
        best_first=choice.walk(best)[1],
        covariance=covariance * scale[:, None] * scale,
    )


@dataclass(frozen=True)
class _Choice:
    """Greedy choice and exchange, in scaled parameters."""

    slope: FloatArray
    time: FloatArray
    known: FloatArray
    weights: FloatArray
    criterion: Criterion
    gap: float

    def scores(self, covariance: FloatArray, rows: npt.NDArray[np.intp]) -> FloatArray:
        if self.criterion == "d":
            return _gain.information_gain(covariance, self.slope[rows])
        return _gain.variance_gain(covariance, self.slope[rows], self.weights)

    def greedy(self, count: int, rows: npt.NDArray[np.intp], apart: bool = True) -> list[int]:
        """Return the indices of the best sightings, the best first."""
        covariance, chosen = as_float(np.linalg.inv(self.known)), list[int]()
        free = np.ones(len(rows), dtype=np.bool_)
        while len(chosen) < count and free.any():
            score = np.where(free, self.scores(covariance, rows), -np.inf)
            place = int(np.argmax(score))
            row = int(rows[place])
            chosen.append(row)
            covariance = _gain.updated(covariance, self.slope[row])
            free[place] = False
            if apart:
                free &= np.abs(self.time[rows] - self.time[row]) > self.gap
        return chosen

    def exchange(self, chosen: list[int]) -> list[int]:
        """Replace one sighting at a time by a better sighting until there is none."""
        rows, everything = list(chosen), np.arange(len(self.time))
        total = self.known + sum(self.slope[r].T @ self.slope[r] for r in rows)
        for _ in range(SWEEPS):
            improved = False
            for k, row in enumerate(rows):
                rest = total - self.slope[row].T @ self.slope[row]
                others = self.time[[r for i, r in enumerate(rows) if i != k]]
                apart = np.abs(self.time[:, None] - others) > self.gap
                score = self.scores(as_float(np.linalg.inv(rest)), everything)
                best = int(np.argmax(np.where(apart.all(axis=1), score, -np.inf)))
                if score[best] > score[row] * (1.0 + 1e-9):
                    rows[k], improved = best, True
                    total = rest + self.slope[best].T @ self.slope[best]
            if not improved:
                break
        return rows

    def walk(self, rows: list[int]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the gain and expected error after each of ``rows``, and the final covariance."""
        covariance = as_float(np.linalg.inv(self.known))
        gain, error = np.empty(len(rows)), np.empty(len(rows))
        for k, row in enumerate(rows):
            gain[k] = _gain.information_gain(covariance, self.slope[row])
            covariance = _gain.updated(covariance, self.slope[row])
            error[k] = np.sqrt(max(0.0, float(np.trace(self.weights @ covariance))))
        return gain, error, covariance
