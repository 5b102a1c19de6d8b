"""Cost and accuracy of a joint visit (several heliostats on one target), as a plant performs it.

A later visit needs only a few codes, since beams that do not overlap share a code. In a first visit
the beam positions are unknown, so each heliostat has its own code along one axis, and a second
stack of photographs verifies all heliostats with their new parameters.
"""

from dataclasses import dataclass

import numpy as np

from heliotrope.calibration.plan.on_target import LOOKS
from heliotrope.errors import InputError
from heliotrope.field.coded_visits import JointSettings
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.optics.beam import beam_sigma

#: Time for the movement and the exposure of a photograph, excluding the time to settle, s.
_PHOTOGRAPH = 1.2
#: Standard deviation of a centroid found from a whole stack, rad.
_CENTROID = 1e-4
#: Number of beams that share a code: on a 12 m target, 36 heliostats need 7 codes and 49 need 15.
#: The second number applies to the verification, when heliostats are known less well: 54 need 15
#: codes and 57 need 31.
_SHARING, _VERIFYING = 5.2, 3.6
#: Possible numbers of codes.
_CODES = (3, 7, 15, 31, 63, 127)
#: Largest expected error in a later visit, as a fraction of the largest that automatic control
#: allows.
_SURE = 0.95
#: Reflected fraction of the light, and slope error of the mirror surface, rad.
_REFLECTED, _SLOPE = 0.8, 1e-3
#: A beam keeps a distance of this many standard deviations of its width and of its position from
#: the border.
_BORDER = 1.5
#: The light may exceed its expectation by this many standard deviations.
_ABOVE = 2.0


@dataclass(frozen=True)
class JointTerms:
    """Visits of several heliostats at once, distinguished by coded movements.

    Attributes
    ----------
    most, least
        Maximum number of heliostats in a later visit, and the minimum number for a joint visit.
    first
        Maximum number of heliostats in a first visit; if 0, each heliostat has its first visit
        alone.
    known
        Expected beam error on the target above which a heliostat joins the first visits, rad RMS.
    tries
        Number of joint first visits that a beam may miss before its heliostat is visited alone.
    step
        Time per photograph, including the preceding movement, s.
    beside
        Time of a visit excluding photographs and slews, s. It covers fits, parameter transfer and
        waiting for the last heliostat.
    sigma
        Standard deviation of a beam position from all photographs of a stack, per direction, rad.
    brightest
        Maximum irradiance on a target, suns.
    """

    most: int = 49
    least: int = 4
    first: int = 63
    known: float = 3.7e-3
    tries: int = LOOKS
    step: float = 2.2
    beside: float = 25.0
    sigma: float = 2.2e-4
    brightest: float = 10.0

    def __post_init__(self) -> None:
        if not 2 <= self.least <= self.most or not (self.first == 0 or self.first >= self.least):
            raise InputError(
                f"joint visits: {self.least} to {self.most} mirrors, {self.first} in a first "
                "visit; use 2 or more, the smaller number first, and in a first visit 0 or at "
                "least the smaller number"
            )
        for name in ("known", "step", "sigma", "brightest"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"joint visits: {name} must be above 0, not {getattr(self, name)}")
        if not self.beside >= 0.0 or self.tries < 1:
            raise InputError(
                "joint visits: the time excluding the photographs must be 0 or more and the number "
                f"of tries 1 or more, not {self.beside} s and {self.tries}"
            )

    @classmethod
    def of(cls, settings: JointSettings, sigma: float) -> "JointTerms":
        """Return the joint-visit terms of a plant.

        Parameters
        ----------
        settings
            Joint-visit settings from the plant file.
        sigma
            Standard deviation of a beam excluding that of its centroid, rad.
        """
        return cls(
            most=settings.most,
            least=settings.least,
            first=settings.first,
            known=float(
                np.sqrt(max(1e-9, (_SURE * settings.known) ** 2 - 2.0 * settings.visit**2))
            ),
            step=settings.settle + _PHOTOGRAPH,
            sigma=float(np.hypot(sigma, _CENTROID)),
            brightest=settings.brightest,
        )

    def photographs(self, mirrors: int, *, own: bool) -> int:
        """Return the number of photographs in a visit.

        Parameters
        ----------
        mirrors
            Number of heliostats.
        own
            Whether each heliostat has its own code; a second stack then verifies the new
            parameters.
        """
        if not own:
            return 2 * (_codes(mirrors / _SHARING) + 1)
        # Movements along one axis need half as many photographs per code.
        return _codes(mirrors) + 1 + max(_codes(mirrors / _VERIFYING), _CODES[1]) + 1

    def span(self, mirrors: int, *, own: bool) -> float:
        """Return the time of a visit excluding slews, s; for the arguments see `photographs`."""
        return self.beside + self.step * self.photographs(mirrors, own=own)

    def fitting(
        self, target: Target, size: FloatArray, slant: FloatArray, spread: FloatArray
    ) -> int:
        """Return how many heliostats, counted from the first, a target can take within its limit.

        Parameters
        ----------
        target
            The target.
        size, slant
            Longer sides of the mirrors and their distances from the target, m, (M,).
        spread
            Expected squared beam error in both directions together, rad², (M,).

        Notes
        -----
        The smaller the expected error of a heliostat, the farther from the middle its position may
        be. While beam positions are unknown, the irradiance is random; its expectation plus twice
        its standard deviation is compared with the limit.
        """
        power = _REFLECTED * size**2
        beam = beam_sigma(slant, slope=_SLOPE) ** 2 + (0.5 * size) ** 2 / 12.0
        lost = 0.5 * spread * slant**2
        half = 0.5 * min(target.width, target.height)
        room = np.maximum(half - _BORDER * (np.sqrt(beam) + np.sqrt(lost)), 0.0)
        # Positions are spread evenly over the available space.
        wide = lost + room**2 / 3.0
        mean = np.cumsum(power / (2.0 * np.pi * (beam + wide)))
        chance = np.cumsum(power**2 / (8.0 * np.pi**2 * beam * (0.5 * beam + wide)))
        good = mean + _ABOVE * np.sqrt(chance) <= self.brightest
        return max(int(np.argmin(good)) if not good.all() else len(good), 1)


def _codes(needed: float) -> int:
    """Return the number of codes in the shortest stack that has at least as many as needed."""
    return next((codes for codes in _CODES if codes >= needed), _CODES[-1])
