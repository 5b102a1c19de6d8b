"""Cost and accuracy of a receiver visit: heliostats measured while they track the receiver."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.coded_visits import ReceiverSettings
from heliotrope.field.plant import Plant
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray

#: Time of a movement or a frame, excluding the time to settle, s; 128 photographs took 254 s.
_PHOTOGRAPH = 1.0
#: Time of a visit excluding photographs and new parameters, s. It covers sun checks, the return to
#: the aim, and the separation of the beams.
_BESIDE = 15.0
#: Time for which a heliostat leaves the receiver to receive new parameters, s; 47 heliostats, one
#: by one, took 9.5 min.
_AWAY = 12.0
#: Fraction of its power that a heliostat loses by its movements, per rad². Movements of 1 mrad by
#: 50 of 150 heliostats cost 0.44 %.
_COST = 0.0044 * 150 / 50 / 1e-3**2
#: Standard deviation of a centroid found from a whole stack, rad.
_CENTROID = 1e-4
#: Largest expected error of a participant, as a fraction of the largest that automatic control
#: allows.
_SURE = 0.75
#: Minimum number of photographs in a stack.
_FEWEST = 8
#: The four ends of a movement along both axes.
_ENDS = np.array([(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)])


@dataclass(frozen=True)
class ReceiverTerms:
    """Visits of heliostats that track a receiver, distinguished by coded movements.

    Attributes
    ----------
    settings
        Receiver-visit settings from the plant file.
    face
        Surface of the receiver.
    sigma
        Standard deviation of a beam position from all photographs of a stack, per direction, rad;
        measured in the simulated plant: 0.32 mrad RMS in both directions together.
    pace
        Duration of a visit divided by its duration in the simulated plant.
    """

    settings: ReceiverSettings
    face: Target
    sigma: float = 2.2e-4
    pace: float = 1.0

    def __post_init__(self) -> None:
        for name in ("sigma", "pace"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise InputError(
                    f"receiver visits: {name} must be above 0, not {getattr(self, name)}"
                )

    @classmethod
    def of(cls, plant: Plant, sigma: float) -> "ReceiverTerms | None":
        """Return the receiver-visit terms of a plant; None if its file defines none.

        Parameters
        ----------
        plant
            The plant.
        sigma
            Standard deviation of a beam excluding that of its centroid, rad.
        """
        settings = plant.receiver_visits
        if settings is None:
            return None
        face = plant.receiver(settings.receiver).face
        return cls(settings, face, float(np.hypot(sigma, _CENTROID)))

    @property
    def known(self) -> float:
        """Largest expected beam error of a participant, at the visit's sun position, rad RMS."""
        known, again = self.settings.known, 2.0 * self.settings.visit**2
        return float(np.sqrt(max(0.0, min((_SURE * known) ** 2, known**2 - again))))

    def at_once(self, shining: int) -> int:
        """Return how many of the heliostats on the receiver may move at once."""
        cost = _COST * self.settings.movement**2
        return min(self.settings.most, int(self.settings.power * shining / cost))

    def photographs(self, mirrors: int) -> int:
        """Return the number of photographs in a visit.

        Each heliostat has its own code per axis.
        """
        return max(_FEWEST, 1 << (2 * mirrors).bit_length())

    def span(self, mirrors: int, shining: int) -> float:
        """Return the time of a visit, s, until all heliostats have their new parameters.

        Parameters
        ----------
        mirrors, shining
            Number of heliostats that take part, and number of heliostats on the receiver. As in the
            plant, only a fraction of the heliostats on the receiver, but at least one, is away for
            new parameters at any time.
        """
        settings = self.settings
        step = settings.settle + settings.exposures * _PHOTOGRAPH
        turns = -(-mirrors // max(1, int(settings.power * shining)))
        return self.pace * (_BESIDE + step * self.photographs(mirrors) + _AWAY * turns)

    def shining(self, position: FloatArray, aim: FloatArray) -> npt.NDArray[np.bool_]:
        """Return a mask of heliostats that stay on the receiver throughout their movements, (N,).

        Parameters
        ----------
        position, aim
            Heliostat positions and their aims in operation, ENU, m, (N, 3).
        """
        path = aim - position
        size = self.settings.movement * np.linalg.norm(path, axis=1)
        ends = aim[:, None] + size[:, None, None] * (_ENDS @ self.face.axes)
        return np.asarray((path @ self.face.normal < 0.0) & self.face.holds(ends).all(axis=1))
