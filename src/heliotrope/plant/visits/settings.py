"""Settings of a visit: its photographs, the search for a beam, and the limits of a fit."""

from dataclasses import dataclass

from heliotrope.errors import InputError

#: The model for a heliostat with few sightings if the model is "auto".
SIMPLE = "malan8+canting"


@dataclass(frozen=True)
class CycleSettings:
    """Settings of a calibration cycle.

    Attributes
    ----------
    shots, interval
        Number of photographs per visit, and the interval between them, s.
    arrival
        Maximum time to reach an aim, s.
    model
        Parameters to fit; see `calibration.fit.estimator.fit`. "auto": `SIMPLE` at first, then the
        simplest candidate that explains the heliostat's own sightings.
    least
        Number of sightings that a fit needs, over all visits.
    sigma
        Standard deviation of a beam, rad, without the error of its centroid but with motion within
        hours. Until it is learnt, half of it is assumed to vary from photograph to photograph.
    most
        Maximum credible deviation of a parameter, in standard deviations of its prior.
    gain
        Maximum accepted error after the fit, as a fraction of the error before (RMS over all
        sightings).
    left
        Maximum accepted beam error after the fit, rad RMS, because a robust fit also converges on
        wrong data.
    large
        Change of the beam by new parameters, rad, above which a photograph must confirm them. A
        first calibration is always confirmed.
    agreement
        Maximum distance of the beam from its predicted position in that photograph, in standard
        deviations of the distance.
    """

    shots: int = 3
    interval: float = 20.0
    arrival: float = 300.0
    model: str | tuple[str, ...] = "malan8"
    least: int = 3
    sigma: float = 5e-4
    most: float = 6.0
    gain: float = 1.0
    left: float = 3e-3
    large: float = 3e-3
    agreement: float = 4.0

    def __post_init__(self) -> None:
        if self.shots < 1 or self.least < 1 or not self.interval >= 0.0:
            raise InputError(
                "calibration cycle: shots must be 1 or more, interval 0 or more and sightings 1 "
                f"or more, not {self.shots}, {self.interval} s and {self.least}"
            )

    @property
    def first_model(self) -> str | tuple[str, ...]:
        """The model for a heliostat with few sightings; every later model has its parameters."""
        return SIMPLE if self.model == "auto" else self.model


@dataclass(frozen=True)
class Centring:
    """Settings for the search for a beam that misses its target, and for centring the beam.

    Attributes
    ----------
    pitch
        Distance between neighbouring search aims, as a fraction of the shorter side of the target.
        Malan's value is 0.5, which finds the same number of beams of any size but takes longer
        (``examples/malan_search.py``).
    most
        Number of aims to try in addition to the middle.
    near
        Distance from the middle within which a beam is not moved, as a fraction of the shorter
        side.
    spread
        How far off the middle later photographs are taken, as a fraction of the margin that the
        beam leaves on the target, because sightings that are further apart are more informative. 0:
        all photographs are taken in the middle.
    slope
        Half the divergence of a beam, rad, in addition to the size of its mirror.
    astray
        Distance from the expected position beyond which light belongs to another heliostat, as a
        fraction of the shorter side.
    looks
        Number of searches, if the first light belongs to another heliostat.
    """

    pitch: float = 0.7
    most: int = 24
    near: float = 0.15
    spread: float = 0.8
    slope: float = 8e-3
    astray: float = 0.06
    looks: int = 3

    def __post_init__(self) -> None:
        if not (0.0 < self.pitch <= 2.0 and self.most >= 0 and 0.0 < self.near <= 0.5):
            raise InputError(
                "centring: pitch must be above 0 and at most 2, aims 0 or more, and near above 0 "
                f"and at most 0.5, not {self.pitch}, {self.most} and {self.near}"
            )
