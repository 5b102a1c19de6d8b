"""Cost and yield of a visit of several mirrors to one target, as a plant makes it.

A later visit takes few codes, since beams that do not overlap share one. In a first visit nobody
knows where a beam is: each mirror has a code of its own along one axis, and a second stack of
photographs verifies all of them with their new parameters.
"""

from dataclasses import dataclass

import numpy as np

from heliotrope.calibration.plan.on_target import LOOKS
from heliotrope.errors import InputError
from heliotrope.field.coded_visits import JointSettings
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.optics.beam import beam_sigma

#: Time of a photograph beside the settling of the mirrors: the movement and the exposure, s.
_PHOTOGRAPH = 1.2
#: Standard deviation of a centroid by a whole stack, rad.
_CENTROID = 1e-4
#: Beams that share a code: 36 mirrors on a target of 12 m take 7 codes, 49 take 15; and when they
#: are verified, known less well: 54 take 15, 57 take 31.
_SHARING, _VERIFYING = 5.2, 3.6
#: Numbers of codes.
_CODES = (3, 7, 15, 31, 63, 127)
#: Share of the largest expected error that automatic control allows in a later visit.
_SURE = 0.95
#: Share of the light that a mirror sends, and slope error of its surface, rad.
_REFLECTED, _SLOPE = 0.8, 1e-3
#: A beam keeps this many of its standard deviations from the border, and those of its place.
_BORDER = 1.5
#: Standard deviations by which the light may exceed its expectation.
_ABOVE = 2.0


@dataclass(frozen=True)
class JointTerms:
    """Visits of several mirrors at once, told apart by coded movements.

    Attributes
    ----------
    most, least
        Mirrors of a later visit, at most; and how many a visit needs to be a joint one.
    first
        Mirrors of a first visit, at most; 0: each has its first visit alone.
    known
        Expected beam error on the target above which a mirror goes with the new ones, rad RMS.
    tries
        Joint first visits that a beam may miss before its mirror goes alone.
    step
        Time of each photograph, with the movement before it, s.
    beside
        Time of a visit beside photographs and slews, s: fits, parameters, waiting for the last.
    sigma
        Standard deviation of a beam in each direction by all photographs of a stack, rad.
    brightest
        Most light on a target, suns.
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
                f"joint visits: {self.least} to {self.most} mirrors, {self.first} in a first visit;"
                " give 2 or more, the smaller number first, and 0 or no fewer in a first visit"
            )
        for name in ("known", "step", "sigma", "brightest"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"joint visits: {name} {getattr(self, name)} must be above 0")
        if not self.beside >= 0.0 or self.tries < 1:
            raise InputError(
                f"joint visits: {self.beside} s beside the photographs, {self.tries} tries; give "
                "0 s or more, and 1 or more"
            )

    @classmethod
    def of(cls, settings: JointSettings, sigma: float) -> "JointTerms":
        """Return the joint visits of a plant.

        Parameters
        ----------
        settings
            Of the plant file.
        sigma
            Standard deviation of a beam beside that of its centroid, rad.
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
        """Return the photographs of a visit.

        Parameters
        ----------
        mirrors
            Their number.
        own
            Whether each mirror has a code of its own; a second stack verifies them then.
        """
        if not own:
            return 2 * (_codes(mirrors / _SHARING) + 1)
        # Movements along one axis take half as many photographs for a code.
        return _codes(mirrors) + 1 + max(_codes(mirrors / _VERIFYING), _CODES[1]) + 1

    def span(self, mirrors: int, *, own: bool) -> float:
        """Return the time of a visit without slews, s; see `photographs`."""
        return self.beside + self.step * self.photographs(mirrors, own=own)

    def fitting(
        self, target: Target, size: FloatArray, slant: FloatArray, spread: FloatArray
    ) -> int:
        """Return how many of some mirrors, from the first on, do not make a target too bright.

        Parameters
        ----------
        target
            The target.
        size, slant
            Larger sides of the mirrors and their distances from the target, m, (M,).
        spread
            Expected squared beam error of both directions together, rad², (M,).

        Notes
        -----
        The surer a mirror is, the farther from the middle its place may be. The light is random
        while the places of beams are unknown: its expectation and twice its standard deviation
        count.
        """
        power = _REFLECTED * size**2
        beam = beam_sigma(slant, slope=_SLOPE) ** 2 + (0.5 * size) ** 2 / 12.0
        lost = 0.5 * spread * slant**2
        half = 0.5 * min(target.width, target.height)
        room = np.maximum(half - _BORDER * (np.sqrt(beam) + np.sqrt(lost)), 0.0)
        # Places are spread evenly over the room.
        wide = lost + room**2 / 3.0
        mean = np.cumsum(power / (2.0 * np.pi * (beam + wide)))
        chance = np.cumsum(power**2 / (8.0 * np.pi**2 * beam * (0.5 * beam + wide)))
        good = mean + _ABOVE * np.sqrt(chance) <= self.brightest
        return max(int(np.argmin(good)) if not good.all() else len(good), 1)


def _codes(needed: float) -> int:
    """Return the number of codes of the shortest stack that has as many as needed."""
    return next((codes for codes in _CODES if codes >= needed), _CODES[-1])
