"""Expected beams and found beams of a stack."""

from dataclasses import dataclass
from enum import Enum

from heliotrope.geometry import FloatArray


class Verdict(Enum):
    """The result of a stack for one heliostat."""

    PROVEN = "follows its own code at its expected position"
    STUCK = "its light does not move"
    EXCHANGED = "the beam at its expected position follows another heliostat's code"
    ELSEWHERE = "its beam is far from its expected position"
    JOINED = "its beam merges with other light"
    FAINT = "no light follows its code"
    CLOUD = "too few photographs in sunlight"


@dataclass(frozen=True)
class ExpectedBeam:
    """The beam that is expected of a heliostat before a stack is taken.

    Attributes
    ----------
    heliostat
        Name.
    place
        Position without movement, metres to the right of and above the surface centre, (2,).
    covariance
        Covariance of the position, m², (2, 2).
    second_moments
        Second moments of the light, m², (2, 2).
    power
        Power in brightness m², at the exposure of the stack; NaN if unknown. It is needed if there
        is other, static light on the surface.
    power_sigma
        Relative standard deviation of ``power``.
    """

    heliostat: str
    place: FloatArray
    covariance: FloatArray
    second_moments: FloatArray
    power: float = float("nan")
    power_sigma: float = 0.1


@dataclass(frozen=True)
class SeparatedBeam:
    """The beam of one heliostat in a stack.

    Attributes
    ----------
    heliostat
        Name of the heliostat to which the code was assigned.
    verdict
        Verdict on the beam; only a beam with the verdict ``PROVEN`` becomes a sighting.
    centroid
        Position of the heliostat's light without movement, m, (2,); NaN if no light follows the
        code.
    covariance
        Covariance of the centroid, m², (2, 2).
    second_moments
        Second moments of the light, m², (2, 2).
    power
        Light that follows the code, brightness m².
    gain, gain_sigma
        Ratio of the light that follows the code to all light at that position (1 if the light
        follows its own code, 0 if it does not move), and its standard deviation. NaN if the light
        at that position is unknown.
    other
        The heliostat with which this heliostat is swapped; empty if it is not swapped.
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
