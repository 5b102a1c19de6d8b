"""Weather stations of a simulated plant: an anemometer, and a pyrheliometer under a clear sky."""

from collections.abc import Callable

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.links.clock import Clock
from heliotrope.plant.emergency import DNI_READING
from heliotrope.sun import clear_sky
from heliotrope.twin.wind import Wind

#: Wind on a day without alarms: mean speed, and mean height of the gusts, m/s.
_MEAN, _GUST = 3.0, 0.5


class WeatherStation:
    """Wind and direct irradiance at a simulated plant.

    This wind does not deflect the mirrors.

    Parameters
    ----------
    altitude
        Altitude of the site, m.
    clock
        Clock of the event loop.
    sun
        Function that returns the true direction to the sun, (3,).
    seed
        Seed of the wind.

    Attributes
    ----------
    names
        Names of the readings.
    """

    names = frozenset({"wind_gust", "wind_mean", DNI_READING})

    def __init__(
        self, altitude: float, clock: Clock, sun: Callable[[], FloatArray], seed: int
    ) -> None:
        self._altitude, self._clock, self._sun = altitude, clock, sun
        self._wind = Wind(_MEAN, gust=_GUST, compliance=0.0, seed=seed)

    def readings(self) -> dict[str, float]:
        """Return the present readings: wind, m/s, and irradiance, W/m²."""
        elevation = float(np.arcsin(np.clip(self._sun()[2], -1.0, 1.0)))
        wind = self._wind.readings(np.zeros(3), self._clock.monotonic())
        return wind | {DNI_READING: clear_sky(elevation, self._altitude)}
