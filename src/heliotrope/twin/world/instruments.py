"""Instruments of a simulated plant: sensors that may report false values, and the sky.

The sensors show wind and flux on the receiver; a pyrheliometer shows the irradiance under passing
clouds.
"""

import math
import random
from collections.abc import Callable

from heliotrope.links.clock import Clock, sleep_until
from heliotrope.plant.controller import PlantController
from heliotrope.plant.emergency import DNI_READING
from heliotrope.safety import FLUX_READING
from heliotrope.twin.invariants.sensors import SensorObserver

#: Readings that the sensors of the world "sensors" supply.
READINGS = ("wind_gust", "wind_mean", "receiver_flux", FLUX_READING)
#: Interval between readings, s.
_EVERY = 1.0
#: Mean time between two clouds, shortest and longest cloud, s, and the fractions of the irradiance
#: that they leave.
_CLEAR, _CLOUD, _LEFT = 100.0, (10.0, 200.0), (0.02, 0.5)


class Instruments:
    """The sensors of a run.

    Parameters
    ----------
    clock
        Clock that shows true time.
    seed
        Seed of the weather and of the false readings.
    flux
        Function that returns the true fraction of beams on the receiver.
    observer
        Observer that is informed of each reading that the plant receives.

    Attributes
    ----------
    plant
        The plant that receives the readings; None while it does not run.
    lies
        Present falsification of each reading: a kind of fault, "" for none.
    """

    def __init__(
        self, clock: Clock, seed: int, flux: Callable[[], float], observer: SensorObserver
    ) -> None:
        self.plant: PlantController | None = None
        self.lies = dict.fromkeys(READINGS, "")
        self._clock, self._flux, self._observer = clock, flux, observer
        self._begin = clock.monotonic()
        self._chance = random.Random(f"sensors {seed}")
        self._mean = self._chance.uniform(2.0, 8.0)
        self._last: dict[str, float] = {}
        self._gust: tuple[float, float] = (-math.inf, 0.0)

    def gust(self, size: float) -> None:
        """Start a gust of 10 m/s (``size`` 0) to 25 m/s (``size`` 1)."""
        self._gust = self._clock.monotonic(), 10.0 + 15.0 * size

    def _true(self, name: str) -> float:
        now = self._clock.monotonic()
        if name == FLUX_READING:
            return self._flux()
        if name == "receiver_flux":
            return 0.8 * self._flux()
        mean = self._mean + 0.5 * math.sin((now - self._begin) / 97.0)
        at, peak = self._gust
        # The shape is (1 - cos)/2 over 10.5 s, as in `twin.wind`.
        passed = (now - at) / 10.5
        gust = 0.5 * peak * (1.0 - math.cos(2.0 * math.pi * passed)) if 0.0 <= passed < 1.0 else 0.0
        return mean if name == "wind_mean" else max(1.2 * mean, gust)

    def _shown(self, name: str) -> float | None:
        """Return the reading of a sensor; None if the sensor supplies no reading."""
        lie, true = self.lies[name], self._true(name)
        if lie == "sensor_silent":
            return None
        if lie == "sensor_nan":
            return self._chance.choice([math.nan, math.inf, -math.inf])
        if lie == "sensor_jumps" and self._chance.random() < 0.3:
            return true * self._chance.choice([-1.0, 0.0, 3.0, 100.0])
        if lie == "sensor_stuck":
            return self._last.get(name, true)
        return true

    async def run(self) -> None:
        """Send readings to the plant every second, until cancelled."""
        while True:
            due = self._clock.monotonic() + _EVERY
            for name in READINGS if self.plant is not None else ():
                value = self._shown(name)
                if value is not None and self.plant is not None:
                    self._last[name] = value
                    self.plant.put(name, value)
                    self._observer.fed(name, value, self._clock.monotonic())
            await sleep_until(self._clock, due)


class Sky:
    """The direct irradiance under clouds that cover the whole field, and its pyrheliometer.

    Parameters
    ----------
    clock
        Clock that shows true time.
    seed
        Seed of the clouds.
    seconds
        Length of the run, s.
    clear
        Irradiance without clouds, W/m².

    Attributes
    ----------
    plant
        The plant that receives the readings; None while it does not run.
    """

    def __init__(self, clock: Clock, seed: int, seconds: float, clear: float) -> None:
        self.plant: PlantController | None = None
        self.clear, self._clock = clear, clock
        chance = random.Random(f"clouds {seed}")
        self._clouds: list[tuple[float, float, float]] = []
        at = clock.monotonic()
        end = at + seconds
        while (at := at + chance.expovariate(1.0 / _CLEAR)) < end:
            over = at + chance.uniform(*_CLOUD)
            self._clouds.append((at, over, chance.uniform(*_LEFT)))
            at = over

    def dni(self) -> float:
        """Return the present irradiance, W/m²."""
        now = self._clock.monotonic()
        shares = [share for begin, end, share in self._clouds if begin <= now < end]
        return self.clear * min(shares, default=1.0)

    async def run(self) -> None:
        """Send the irradiance to the plant every second, until cancelled."""
        while True:
            due = self._clock.monotonic() + _EVERY
            if self.plant is not None:
                self.plant.put(DNI_READING, self.dni())
            await sleep_until(self._clock, due)
