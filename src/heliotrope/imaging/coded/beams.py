"""Beams of a stack, as they are expected and as they are found."""

from dataclasses import dataclass
from enum import Enum

from heliotrope.geometry import FloatArray


class Verdict(Enum):
    """The verdict of a stack about a mirror."""

    PROVEN = "follows its own code at its place"
    STUCK = "its light does not move"
    EXCHANGED = "the beam at its place follows another mirror's code"
    ELSEWHERE = "its beam is far from where it is expected"
    JOINED = "other light is joined with its beam"
    FAINT = "no light follows its code"
    CLOUD = "too few photographs in the sun"


@dataclass(frozen=True)
class ExpectedBeam:
    """The beam of a mirror before a stack is taken.

    Attributes
    ----------
    heliostat
        Name.
    place
        Its place without movement, metres right of and above the surface's centre, (2,).
    covariance
        Of the place, m², (2, 2).
    second_moments
        Of its light, m², (2, 2).
    power
        Brightness m² at the stack's exposure; NaN if unknown. Needed where other light rests
        on the surface.
    power_sigma
        Standard deviation of ``power``, relative.
    """

    heliostat: str
    place: FloatArray
    covariance: FloatArray
    second_moments: FloatArray
    power: float = float("nan")
    power_sigma: float = 0.1


@dataclass(frozen=True)
class SeparatedBeam:
    """The beam of one mirror in a stack.

    Attributes
    ----------
    heliostat
        Name of the mirror that had the code.
    verdict
        Only a proven beam is a sighting.
    centroid
        Place of its light without movement, m, (2,); NaN if nothing follows its code.
    covariance
        Of the centroid, m², (2, 2).
    second_moments
        Of its light, m², (2, 2).
    power
        Light that follows its code, brightness m².
    gain, gain_sigma
        Light that follows its code over light at its place: 1 if it follows its own code, 0 if it
        does not move; and standard deviation. NaN if the light at its place is unknown.
    other
        The heliostat that it is exchanged with; empty otherwise.
    """

    heliostat: str
    verdict: Verdict
    centroid: FloatArray
    covariance: FloatArray
    second_moments: FloatArray
    power: float
    gain: float
    gain_sigma: float
    other: str = ""
