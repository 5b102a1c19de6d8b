"""What is known of mechanisms, and how far their beams will miss because of what is not.

The information of priors and sightings is the inverse covariance of the parameters. The
expected squared error of the beam over a set of suns and aims is a quadratic form of
that covariance, so both are all that planning needs of a heliostat.
"""

from collections.abc import Mapping
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
from heliotrope.sun import Site

#: Poses that are worked on at a time: some 20 MB of derivatives.
CHUNK = 40_000
#: Lowest sun that counts in a year, rad.
LOWEST = float(np.radians(10.0))


def precision(
    mechanism: Mechanism,
    names: tuple[str, ...],
    made: Sightings | None = None,
    *,
    priors: Mapping[str, npt.ArrayLike] | None = None,
) -> FloatArray:
    """Return the information of priors and sightings on the parameters, (N, P, P).

    Parameters
    ----------
    mechanism
        Best estimates, batch shape (N,); the derivatives are taken there.
    names
        P parameters of the table.
    made
        Sightings that exist already, believed to their sigma.
    priors
        Standard deviations that replace the table's, by name, (N,) or scalars.

    Returns
    -------
    Inverse covariances in 1/(unit · unit) of the parameters.

    Raises
    ------
    InputError
        If a sighting is of a heliostat that is not there, or a prior is not above 0.
    UnknownNameError
        If a parameter is not in the table.
    """
    count = _batch(mechanism)
    given = priors or {}
    found = np.zeros((count, len(names), len(names)))
    for p, name in enumerate(names):
        sigma = as_float(given.get(name, mechanism.parameter(name).prior))
        if not (np.isfinite(sigma) & (sigma > 0)).all():
            raise InputError(f"prior of {name}: {sigma} must be above 0 and finite")
        found[:, p, p] = 1.0 / sigma**2
    if made is not None and len(made):
        if int(made.heliostat.max()) >= count:
            raise InputError(
                f"a sighting is of heliostat row {int(made.heliostat.max())}; there are "
                f"{count} heliostats"
            )
        slope = linearise(mechanism[made.heliostat], made, names).jacobian
        np.add.at(found, made.heliostat, np.swapaxes(slope, -1, -2) @ slope)
    return found


@dataclass(frozen=True)
class Expectation:
    """The mean squared beam error of N heliostats as a form of their P parameters' errors.

    Attributes
    ----------
    names
        The parameters.
    form
        Mean over the poses of BᵀB, B (2, P) being the beam's change by the parameters,
        rad² over the parameters' units, (N, P, P).
    poses
        How many of the suns the heliostat can serve, (N,); where it is 0 the form is 0.
    """

    names: tuple[str, ...]
    form: FloatArray
    poses: npt.NDArray[np.int64]

    def rms(self, covariance: npt.ArrayLike) -> FloatArray:
        """Return the expected RMS of the beam's error (two-dimensional), rad, (N,).

        Parameters
        ----------
        covariance
            Of the parameters, (N, P, P).
        """
        square = np.einsum("...pq,...qp->...", self.form, as_float(covariance))
        return np.asarray(np.sqrt(np.maximum(square, 0.0)))


def expectation(
    mechanism: Mechanism, aim: npt.ArrayLike, suns: npt.ArrayLike, names: tuple[str, ...]
) -> Expectation:
    """Return what errors of the parameters do to the beams from ``suns`` to ``aim``.

    Parameters
    ----------
    mechanism
        Best estimates, batch shape (N,).
    aim
        Where the beams go in operation, ENU metres, (3,) or (N, 3).
    suns
        K unit vectors, (K, 3), of equal weight; those that a heliostat cannot serve do
        not count for it. See :func:`suns_of_year`.
    names
        P parameters of the table.

    Notes
    -----
    First order in the parameters: exact to 1 % for errors of 10 mrad.
    """
    count = _batch(mechanism)
    goals = np.broadcast_to(as_vectors(aim, "aim"), (count, 3))
    sky = as_vectors(suns, "suns").reshape(-1, 3)
    form = np.zeros((count, len(names), len(names)))
    poses = np.zeros(count, dtype=np.int64)
    step = max(1, CHUNK // max(1, len(sky)))
    for first in range(0, count, step):
        part = slice(first, min(first + step, count))
        some = mechanism[part]
        solved = track(some, sky[:, None], goals[part])
        able = solved.chosen(solved.reachable).T
        row, which = np.nonzero(able)
        if not row.size:
            continue
        counts = solved.chosen(solved.counts)[which, row]
        seen = sightings(row, counts, sky[which], goals[part][row])
        found = linearise(some[row], seen, names)
        slope = found.beam @ found.jacobian
        poses[part] = able.sum(axis=1)
        # Rows of one heliostat stand together.
        edges = np.concatenate([[0], np.cumsum(poses[part])])
        for i in np.flatnonzero(poses[part]):
            flat = slope[edges[i] : edges[i + 1]].reshape(-1, len(names))
            form[first + i] = flat.T @ flat / poses[first + i]
    return Expectation(names, form, poses)


def suns_of_year(
    site: Site, year: int, *, days: int = 12, hours: float = 1.5, min_elevation: float = LOWEST
) -> FloatArray:
    """Return unit vectors to the sun on days spread evenly over a year, (K, 3).

    Parameters
    ----------
    site
        Place and air.
    year
        Calendar year (UTC).
    days
        How many days.
    hours
        Step within a day, h.
    min_elevation
        Lowest apparent elevation, rad.

    Raises
    ------
    InputError
        If the sun is never so high.
    """
    if days < 1 or not 0.0 < hours <= 24.0:
        raise InputError(f"{days} days at {hours} h: give a day or more and a step up to 24 h")
    begin = datetime(year, 1, 1, tzinfo=UTC).timestamp()
    noon = begin + (np.arange(days) + 0.5) * 365.25 * 86400.0 / days
    # A shift from day to day, or all days would show the same hours.
    shift = np.modf(np.arange(days) * 0.618034)[0]
    offsets = np.arange(0.0, 24.0, hours)
    times = noon[:, None] + 3600.0 * (offsets + hours * shift[:, None])
    found = solar.position(times.ravel(), site)
    suns = found.vector[found.elevation >= min_elevation]
    if not len(suns):
        raise InputError(
            f"site {site.name!r}: the sun is never {np.degrees(min_elevation):g}° high in {year}; "
            "lower the least elevation"
        )
    return suns


def _batch(mechanism: Mechanism) -> int:
    if len(mechanism.shape) != 1:
        raise InputError(f"mechanisms of shape {mechanism.shape}; give one batch axis (N,)")
    return len(mechanism)
