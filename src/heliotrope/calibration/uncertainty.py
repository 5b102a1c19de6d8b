"""Uncertainty of mechanism parameters, and the expected error of the beams.

Priors and sightings determine `precision`, the information on the parameters; its inverse is their
covariance C. Let B be the derivative of the beam direction with respect to the parameters. The beam
from one sun position to one aim has the covariance B C Bᵀ (`expected_error`); over many sun
positions the mean squared error is tr(F C) with F the mean of BᵀB (`error_form`). `unobservable`
names the combinations of parameters that the sightings leave to the prior, and `year_map` shows the
error for every sun position in the year.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
import numpy.typing as npt

from heliotrope import sun as solar
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.sightings import Sightings, sightings
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, as_vectors
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.tracking import track
from heliotrope.optics.beam import ExpectedError
from heliotrope.sun import Site

#: Number of poses evaluated at a time, which takes about 20 MB for derivatives.
CHUNK = 40_000
#: Default lowest elevation of the sun, rad.
MIN_ELEVATION = float(np.radians(10.0))
#: If the sightings leave more than this fraction of its prior variance, a combination of parameters
#: is known only from the prior.
PRIOR_ONLY = 0.9


def precision(
    mechanism: Mechanism,
    names: tuple[str, ...],
    made: Sightings | None = None,
    *,
    priors: Mapping[str, npt.ArrayLike] | None = None,
) -> FloatArray:
    """Return the information on the parameters from priors and sightings, (N, P, P).

    Parameters
    ----------
    mechanism
        Best estimates, batch shape (N,), at which the derivatives are taken.
    names
        P parameters of the table.
    made
        Sightings made so far, with their stated standard deviations.
    priors
        Standard deviations that replace those of the table, by name, (N,) or scalars.

    Returns
    -------
    Inverse covariances, 1/unit².

    Raises
    ------
    InputError
        If a sighting refers to a heliostat that does not exist, or a prior is not above 0.
    UnknownNameError
        If a parameter is not in the table.
    """
    count = _batch(mechanism)
    sigmas = priors or {}
    information = np.zeros((count, len(names), len(names)))
    for p, name in enumerate(names):
        sigma = as_float(sigmas.get(name, mechanism.parameter(name).prior))
        if not (np.isfinite(sigma) & (sigma > 0)).all():
            raise InputError(f"prior of {name} must be above 0 and finite, not {sigma}")
        information[:, p, p] = 1.0 / sigma**2
    if made is not None and len(made):
        if int(made.heliostat.max()) >= count:
            raise InputError(
                f"a sighting has heliostat index {int(made.heliostat.max())}, but there are "
                f"{count} heliostats"
            )
        slope = linearise(mechanism[made.heliostat], made, names).jacobian
        np.add.at(information, made.heliostat, np.swapaxes(slope, -1, -2) @ slope)
    return information


def expected_error(
    mechanism: Mechanism,
    names: tuple[str, ...],
    covariance: npt.ArrayLike,
    sun: npt.ArrayLike,
    aim: npt.ArrayLike,
    noise: float = 0.0,
    *,
    current: npt.ArrayLike | None = None,
) -> ExpectedError:
    """Return the expected beam errors of mechanisms that track with their calibration.

    Parameters
    ----------
    mechanism
        One calibrated mechanism, or M of them.
    names
        The P parameters of ``covariance``.
    covariance
        Covariance of the parameters, (P, P) or (M, P, P).
    sun, aim
        Unit vectors to the sun and aim points (m), ENU, (3,) or (M, 3).
    noise
        Additional standard deviation in each direction, rad of beam.
    current
        Present step counts, (D,) or (M, D). A mechanism without stops reaches most aims in two
        poses and takes the nearer one, whose error differs from that of the other pose; see
        `track`.

    Notes
    -----
    The result is first order in the parameters, which is exact to 1 % for errors of 10 mrad.
    """
    suns, aims = np.atleast_2d(as_float(sun)), np.atleast_2d(as_float(aim))
    count = max(len(suns), len(aims))
    suns = np.broadcast_to(suns, (count, 3))
    aims = np.broadcast_to(aims, (count, 3))
    mechanisms = mechanism if mechanism.shape else mechanism[None]
    mechanisms = mechanisms[np.zeros(count, dtype=np.intp)] if len(mechanisms) == 1 else mechanisms
    tracking = track(mechanisms, suns, aims, current=current)
    reachable = tracking.reachable
    counts = np.where(reachable[:, None], tracking.best_counts, 0.0)
    slope = _beam_slope(mechanisms, counts, suns, aims, names)
    spread = slope @ as_float(covariance) @ np.swapaxes(slope, -1, -2)
    spread = spread + noise**2 * np.eye(2)
    return ExpectedError(np.where(reachable[:, None, None], spread, np.nan), reachable)


def error_form(
    mechanism: Mechanism, aim: npt.ArrayLike, suns: npt.ArrayLike, names: tuple[str, ...]
) -> FloatArray:
    """Return the mean squared beam error over ``suns`` as a quadratic form, (N, P, P).

    With F the form and C the covariance of the parameters, the expected two-dimensional RMS error
    of the beam is √tr(F C), rad.

    Parameters
    ----------
    mechanism
        Best estimates, batch shape (N,).
    aim
        Aim points in operation, ENU metres, (3,) or (N, 3).
    suns
        K unit vectors of equal weight, (K, 3), for example from `suns_of_year`. Sun vectors for
        which a heliostat cannot reach its aim do not count for that heliostat. If it cannot reach
        its aim for any of them, its form is 0.
    names
        P parameters of the table.

    Notes
    -----
    The result is first order in the parameters, which is exact to 1 % for errors of 10 mrad.
    """
    count = _batch(mechanism)
    aims = np.broadcast_to(as_vectors(aim, "aim"), (count, 3))
    sky = as_vectors(suns, "suns").reshape(-1, 3)
    form = np.zeros((count, len(names), len(names)))
    step = max(1, CHUNK // max(1, len(sky)))
    for first in range(0, count, step):
        part = slice(first, min(first + step, count))
        some = mechanism[part]
        solved = track(some, sky[:, None], aims[part])
        able = solved.reachable.T
        row, which = np.nonzero(able)
        if not row.size:
            continue
        counts = solved.best_counts[which, row]
        slope = _beam_slope(some[row], counts, sky[which], aims[part][row], names)
        poses = able.sum(axis=1)
        # `nonzero` lists the poses sorted by heliostat.
        edges = np.concatenate([[0], np.cumsum(poses)])
        for i in np.flatnonzero(poses):
            flat = slope[edges[i] : edges[i + 1]].reshape(-1, len(names))
            form[first + i] = flat.T @ flat / poses[i]
    return form


def _beam_slope(
    mechanism: Mechanism,
    counts: FloatArray,
    suns: FloatArray,
    aims: FloatArray,
    names: tuple[str, ...],
) -> FloatArray:
    """Return the derivative of beam direction with respect to parameters at M poses, (M, 2, P)."""
    observed = sightings(np.arange(len(counts)), counts, suns, aims)
    line = linearise(mechanism, observed, names)
    return np.asarray(line.beam @ line.jacobian)


def suns_of_year(
    site: Site,
    year: int,
    *,
    days: int = 12,
    hours: float = 1.5,
    min_elevation: float = MIN_ELEVATION,
) -> FloatArray:
    """Return unit vectors to the sun on days spread evenly over a year, (K, 3).

    Parameters
    ----------
    site
        Location and atmosphere.
    year
        Calendar year (UTC).
    days
        Number of days.
    hours
        Step within a day, h.
    min_elevation
        Lowest apparent elevation, rad.

    Raises
    ------
    InputError
        If the sun never rises above ``min_elevation``.
    """
    if days < 1 or not 0.0 < hours <= 24.0:
        raise InputError(
            f"{days} days at {hours} h: use at least one day and a step of at most 24 h"
        )
    begin = datetime(year, 1, 1, tzinfo=UTC).timestamp()
    noon = begin + (np.arange(days) + 0.5) * 365.25 * 86400.0 / days
    # The golden ratio shifts the hours from day to day; otherwise all days would have the same
    # hours.
    shift = np.modf(np.arange(days) * 0.618034)[0]
    offsets = np.arange(0.0, 24.0, hours)
    times = noon[:, None] + 3600.0 * (offsets + hours * shift[:, None])
    position = solar.position(times.ravel(), site)
    suns = position.vector[position.elevation >= min_elevation]
    if not len(suns):
        raise InputError(
            f"{site.label}: the sun never reaches {np.degrees(min_elevation):g}° in {year}; lower "
            "the minimum elevation"
        )
    return suns


@dataclass(frozen=True)
class BlindSpot:
    """A combination of parameters about which the sightings contain no information.

    Attributes
    ----------
    text
        Description in one clause, for display.
    loadings
        Parameters with their contributions, in units of their priors, largest first.
    remaining
        Remaining fraction of the prior variance, 0 to 1.
    beam
        RMS beam error that the combination causes, rad; NaN if no ``slope`` was passed.
    """

    text: str
    loadings: tuple[tuple[str, float], ...]
    remaining: float
    beam: float


def unobservable(
    names: Sequence[str],
    covariance: npt.ArrayLike,
    prior: npt.ArrayLike,
    line_of_sight: npt.ArrayLike | None = None,
    slope: npt.ArrayLike | None = None,
) -> tuple[BlindSpot, ...]:
    """Return the combinations of parameters that are known only from the prior.

    Parameters
    ----------
    names
        The P parameters.
    covariance
        Covariance after the sightings, (P, P).
    prior
        Standard deviations before the sightings, (P,); parameters with 0 are skipped.
    line_of_sight
        Vector from the heliostat to its target, (3,), used to recognise a position error along it.
    slope
        Derivatives of beams with respect to the parameters, (M, 2, P), to compute the beam error
        that each combination causes.
    """
    before = as_float(prior)
    used = np.flatnonzero(before > 0)
    scaled = as_float(covariance)[np.ix_(used, used)] / np.outer(before[used], before[used])
    values, vectors = np.linalg.eigh(scaled)
    spots = []
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        if value < PRIOR_ONLY:
            break
        order = np.argsort(-np.abs(vector), kind="stable")
        sign = np.sign(vector[order[0]])
        loadings = tuple(
            (names[used[k]], float(sign * vector[k])) for k in order if abs(vector[k]) > 0.2
        )
        beam = np.nan
        if slope is not None:
            shift = as_float(slope)[:, :, used] @ (vector * before[used]) * np.sqrt(value)
            beam = float(np.sqrt(np.mean(np.sum(shift**2, axis=-1))))
        text = _in_words(loadings, line_of_sight)
        spots.append(BlindSpot(text, loadings, float(min(value, 1.0)), beam))
    return tuple(spots)


def _in_words(loadings: tuple[tuple[str, float], ...], line: npt.ArrayLike | None) -> str:
    places = ("position_east", "position_north", "position_up")
    parts = dict(loadings)
    if line is not None and parts and all(name in places for name in parts):
        shift = np.array([parts.get(name, 0.0) for name in places])
        direction = as_float(line)
        along = abs(shift @ direction) / (np.linalg.norm(shift) * np.linalg.norm(direction))
        if along > 0.9:
            return "the position along the line of sight is known only from the prior"
    if len(loadings) == 1:
        return f"{loadings[0][0]} is known only from the prior"
    mixed = " ".join(f"{share:+.2f} {name}" for name, share in loadings)
    return f"the combination {mixed} (in units of the priors) is known only from the prior"


@dataclass(frozen=True)
class YearMap:
    """Expected RMS error of a beam over the year.

    Attributes
    ----------
    declination, hour
        Centres of the grid cells, rad: declination of the sun (D,), and hour angle from true noon,
        west positive (H,).
    rms
        Expected RMS error, rad, (D, H); NaN where the sun is below the horizon or the pose is out
        of reach.
    """

    declination: FloatArray
    hour: FloatArray
    rms: FloatArray


def year_map(
    mechanism: Mechanism,
    names: tuple[str, ...],
    covariance: npt.ArrayLike,
    aim: npt.ArrayLike,
    latitude_deg: float,
    noise: float = 0.0,
    size: tuple[int, int] = (25, 49),
) -> YearMap:
    """Return the expected error for every sun position in a year.

    Parameters
    ----------
    mechanism
        One calibrated mechanism.
    names, covariance, noise
        As for `expected_error`.
    aim
        Aim point, (3,).
    latitude_deg
        Latitude of the site, °.
    size
        Numbers of grid cells in declination and in hour angle.
    """
    declination = np.radians(np.linspace(-23.43, 23.43, size[0]))
    hour = np.radians(np.linspace(-120.0, 120.0, size[1]))
    d, h = np.meshgrid(declination, hour, indexing="ij")
    latitude = np.radians(latitude_deg)
    up = np.sin(latitude) * np.sin(d) + np.cos(latitude) * np.cos(d) * np.cos(h)
    north = np.cos(latitude) * np.sin(d) - np.sin(latitude) * np.cos(d) * np.cos(h)
    suns = np.stack([-np.cos(d) * np.sin(h), north, up], axis=-1).reshape(-1, 3)
    shown = suns[:, 2] > np.sin(np.radians(5.0))
    rms = np.full(len(suns), np.nan)
    if shown.any():
        rms[shown] = expected_error(mechanism, names, covariance, suns[shown], aim, noise).rms
    return YearMap(declination, hour, rms.reshape(size))


def _batch(mechanism: Mechanism) -> int:
    if len(mechanism.shape) != 1:
        raise InputError(
            f"mechanisms must have one batch axis (N,), not the shape {mechanism.shape}"
        )
    return len(mechanism)
