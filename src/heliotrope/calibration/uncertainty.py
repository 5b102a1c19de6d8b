"""How well a mirror is known: the ellipse of its beam for any sun and aim, and what is not seen.

The parameters' covariance C goes through the same derivatives as everything else: the
normal tracks the bisector but for J δx, and the beam moves by about twice that.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.learn.drift import NINETY
from heliotrope.calibration.sightings import sightings
from heliotrope.geometry import FloatArray, as_float
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.tracking import track

#: A combination of parameters whose variance the data have reduced by less than this is
#: known by the prior only.
PRIOR_ONLY = 0.9


@dataclass(frozen=True)
class Expected:
    """The beam's expected error at M pairs of sun and aim.

    Attributes
    ----------
    covariance
        To the right of and above the aim as seen from the mirror, rad², (M, 2, 2).
    reachable
        Whether the mechanism reaches the pose, (M,).
    """

    covariance: FloatArray
    reachable: npt.NDArray[np.bool_]

    @property
    def rms(self) -> FloatArray:
        """Root of the mean square in two dimensions, rad, (M,)."""
        return np.asarray(np.sqrt(np.trace(self.covariance, axis1=-2, axis2=-1)))

    @property
    def ellipse(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Semi-axes of the 90 % ellipse (rad, the longer first) and the longer's angle, (M,).

        The angle is counter-clockwise from the right, rad.
        """
        values, vectors = np.linalg.eigh(self.covariance)
        axes = np.sqrt(NINETY * np.maximum(values, 0.0))
        angle = np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])
        return axes[:, 1], axes[:, 0], np.asarray(np.mod(angle, np.pi))


def expected(
    mechanism: Mechanism,
    names: tuple[str, ...],
    covariance: npt.ArrayLike,
    sun: npt.ArrayLike,
    aim: npt.ArrayLike,
    noise: float = 0.0,
) -> Expected:
    """Return the expected error of a beam when the mechanism tracks by its calibration.

    Parameters
    ----------
    mechanism
        Calibrated: one, or M.
    names
        The P parameters of ``covariance``.
    covariance
        Of their deviations, (P, P) or (M, P, P).
    sun, aim
        Unit vectors to the sun and aim points (m), ENU, (M, 3).
    noise
        Standard deviation of the beam in each direction on top, rad.
    """
    suns, aims = np.atleast_2d(as_float(sun)), np.atleast_2d(as_float(aim))
    count = max(len(suns), len(aims))
    suns = np.broadcast_to(suns, (count, 3))
    aims = np.broadcast_to(aims, (count, 3))
    each = mechanism if mechanism.shape else mechanism[None]
    each = each[np.zeros(count, dtype=np.intp)] if len(each) == 1 else each
    found = track(each, suns, aims)
    reachable = found.chosen(found.reachable)
    safe = np.where(reachable[:, None], found.chosen(found.counts), 0.0)
    seen = sightings(np.arange(count), safe, suns, aims)
    line = linearise(each, seen, names)
    slope = line.beam @ line.jacobian
    spread = slope @ as_float(covariance) @ np.swapaxes(slope, -1, -2)
    spread = spread + noise**2 * np.eye(2)
    return Expected(np.where(reachable[:, None, None], spread, np.nan), reachable)


@dataclass(frozen=True)
class Blind:
    """A combination of parameters that the sightings say nothing about.

    Attributes
    ----------
    text
        What it is, in words.
    loadings
        Parameters with their share, the largest first, in units of their priors.
    remaining
        Share of the prior's variance that is left, 0 … 1.
    beam
        RMS beam error that it causes where it was asked for, rad; NaN if it was not.
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
) -> tuple[Blind, ...]:
    """Return the combinations of parameters that are known by the prior only.

    Parameters
    ----------
    names
        The P parameters.
    covariance
        After the sightings, (P, P).
    prior
        Standard deviations before, (P,); parameters with 0 are passed over.
    line_of_sight
        Vector from the heliostat to its target, to recognise it, (3,).
    slope
        Derivatives of beams by the parameters, (M, 2, P), to weigh what it matters.
    """
    before = as_float(prior)
    used = np.flatnonzero(before > 0)
    scaled = as_float(covariance)[np.ix_(used, used)] / np.outer(before[used], before[used])
    values, vectors = np.linalg.eigh(scaled)
    found = []
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
        found.append(Blind(text, loadings, float(min(value, 1.0)), beam))
    return tuple(found)


def _in_words(loadings: tuple[tuple[str, float], ...], line: npt.ArrayLike | None) -> str:
    places = ("position_east", "position_north", "position_up")
    parts = dict(loadings)
    if line is not None and parts and all(name in places for name in parts):
        shift = np.array([parts.get(name, 0.0) for name in places])
        way = as_float(line)
        along = abs(shift @ way) / (np.linalg.norm(shift) * np.linalg.norm(way))
        if along > 0.9:
            return "position along the line of sight is known by the prior only"
    if len(loadings) == 1:
        return f"{loadings[0][0]} is known by the prior only"
    mixed = " ".join(f"{share:+.2f} {name}" for name, share in loadings)
    return f"the combination {mixed} (in units of the priors) is known by the prior only"


@dataclass(frozen=True)
class YearMap:
    """Expected RMS of the beam over a year.

    Attributes
    ----------
    declination, hour
        Centres of the grid, rad: (D,) of the sun's declination, (H,) of the hour angle
        from true noon, west positive.
    rms
        Rad, (D, H); NaN where the sun is down or the pose out of reach.
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
    """Return the expected error for every place of the sun that a year brings.

    Parameters
    ----------
    mechanism
        One, calibrated.
    names, covariance, noise
        As of :func:`expected`.
    aim
        Aim point, (3,).
    latitude_deg
        Of the site.
    size
        Steps of declination and of hour angle.
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
        goal = np.broadcast_to(as_float(aim), (int(shown.sum()), 3))
        rms[shown] = expected(mechanism, names, covariance, suns[shown], goal, noise).rms
    return YearMap(declination, hour, rms.reshape(size))
