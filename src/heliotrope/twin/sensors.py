"""Sensors of a simulated plant."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.field.target import Receiver
from heliotrope.geometry import FloatArray
from heliotrope.links.clock import Clock
from heliotrope.plant.io.sensors import Readings
from heliotrope.safety import FLUX_READING

#: Time between two readings, s.
_EVERY = 1.0


class FluxSensor:
    """The flux on the receivers, computed from the true mirrors; a `plant.ports.Sensors`.

    Parameters
    ----------
    receivers
        Receivers of the plant, at least one.
    clock
        Clock of the event loop.
    stand
        Function that returns the true normals and vertices, each (N, 3).
    sun
        Function that returns the true direction to the sun, (3,).

    Attributes
    ----------
    names
        Name of the only reading.
    """

    def __init__(
        self,
        receivers: Sequence[Receiver],
        clock: Clock,
        stand: Callable[[], tuple[FloatArray, FloatArray]],
        sun: Callable[[], FloatArray],
    ) -> None:
        self.names = frozenset({FLUX_READING})
        self._apertures = [
            (receiver.center, 0.5 * math.hypot(receiver.width, receiver.height))
            for receiver in receivers
        ]
        self._clock, self._stand, self._sun = clock, stand, sun
        self._read_at = -math.inf

    def share(self) -> float:
        """Return the present flux as a fraction of the flux with every heliostat on a receiver."""
        light = self._sun()
        if light[2] <= 0.0:
            return 0.0
        stand = self._stand()
        return sum(light_share(*stand, light, *aperture) for aperture in self._apertures)

    async def news(self) -> Readings:
        """Yield a reading every second."""
        now = self._clock.monotonic()
        if now - self._read_at < _EVERY:
            return Readings()
        self._read_at = now
        return Readings({FLUX_READING: self.share()})


def light_share(
    normal: FloatArray, vertex: FloatArray, sun: npt.ArrayLike, middle: npt.ArrayLike, radius: float
) -> float:
    """Return the fraction of a field's light that reaches a receiver, 0 to 1.

    Parameters
    ----------
    normal, vertex
        Normals and vertices of the mirrors, (N, 3).
    sun
        Direction to the sun, (3,).
    middle
        Middle of the receiver, (3,), m.
    radius
        Beams whose axis passes closer than this count as on the receiver, m. Each beam is weighted
        by its cosine of incidence, and the sum is divided by its value with all beams aimed at the
        middle.
    """
    s, point = np.asarray(sun, dtype=np.float64), np.asarray(middle, dtype=np.float64)
    cosine = normal @ s
    rays = 2.0 * cosine[:, None] * normal - s
    offset = point - vertex
    along = np.einsum("ij,ij->i", offset, rays)
    off = np.sqrt(np.maximum(0.0, np.einsum("ij,ij->i", offset, offset) - along**2))
    unit = offset / np.linalg.norm(offset, axis=1)[:, None]
    nominal = np.sqrt(np.maximum(0.0, 0.5 * (1.0 + unit @ s)))
    on = (along > 0.0) & (off <= radius)
    return float(np.maximum(cosine, 0.0)[on].sum() / nominal.sum())
