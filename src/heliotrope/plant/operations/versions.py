"""Comparison of two versions of a heliostat's error parameters and their effect on its beam."""

from dataclasses import dataclass

import numpy as np

from heliotrope import sun
from heliotrope.geometry import FloatArray, as_float, reflect
from heliotrope.mechanism import track
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.tracking import TrackingStatus
from heliotrope.sun import Site

#: Sun positions of a day for comparing beams: interval, s, and lowest elevation, rad.
_STEP, _LOWEST = 1800.0, np.radians(10.0)
_DAY = 86_400.0


@dataclass(frozen=True)
class ParameterVersion:
    """A version: number (0: the plant file), time (POSIX s), person, note, number of sightings."""

    version: int
    at: float
    person: str
    note: str
    sightings: int


@dataclass(frozen=True)
class ComparedParameter:
    """A parameter in two versions, with standard deviations; NaN where it is not fitted."""

    name: str
    unit: str
    first: float
    first_sigma: float
    second: float
    second_sigma: float


@dataclass(frozen=True)
class ParameterComparison:
    """Two versions of a heliostat's parameters.

    Attributes
    ----------
    heliostat
        Name.
    in_use
        Version in use; 0 before the first.
    first, second
        The versions.
    parameters
        Each parameter in both versions.
    beam_rms, beam_most
        How far a beam that the first version puts on its aim misses the aim under the second
        version, m: RMS and maximum over this day's sun positions above 10°; NaN if the heliostat
        can track at none of these positions.
    """

    heliostat: str
    in_use: int
    first: ParameterVersion
    second: ParameterVersion
    parameters: tuple[ComparedParameter, ...]
    beam_rms: float
    beam_most: float


def suns_of_day(at: float, site: Site) -> FloatArray:
    """Return sun vectors above 10° of elevation for the UTC day that contains a time, POSIX s."""
    times = at // _DAY * _DAY + np.arange(0.0, _DAY, _STEP)
    found = sun.vector(times, site)
    return as_float(found[found[:, 2] > np.sin(_LOWEST)])


def beam_change(
    first: Mechanism, second: Mechanism, suns: FloatArray, aim: FloatArray
) -> FloatArray:
    """Return how far a beam misses its aim, m, (T,); NaN where the first mechanism cannot track.

    Parameters
    ----------
    first
        The mechanism from which the counts are computed, batch shape (1,).
    second
        The mechanism that actually moves the mirror, batch shape (1,).
    suns, aim
        Sun vectors, (T, 3), and the aim, m, (3,), ENU.
    """
    if not len(suns):
        return np.zeros(0)
    found = track(first, suns, aim)
    pose = second.pose(found.best_counts)
    path, away = reflect(suns, pose.normal), aim - pose.vertex
    missed = np.linalg.norm(np.cross(path, away), axis=-1)
    tracks = found.chosen(found.status) == TrackingStatus.OK.value
    return as_float(np.where(tracks, missed, np.nan))
