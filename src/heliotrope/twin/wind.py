"""Wind over a field: turbulence and passing gusts, and how they deflect the mirrors.

The wind is a function of position and time, so single boards and a vectorised field experience the
same wind. Turbulence is frozen and carried along by the mean wind (Taylor): a sum of waves whose
spectrum at one point is von Kármán's. Gusts are fronts of the shape (1 − cos)/2; one gust is drawn
for each time window. A mirror rotates in proportion to the dynamic pressure, as a flat plate does,
towards the position broadside to the wind.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, as_vectors

#: Density of air, kg/m³.
DENSITY = 1.2
#: Number of waves, and their band, Hz: from a quarter of an hour to half a second, below which a
#: mirror of some metres averages over them.
WAVES, SLOWEST, FASTEST = 48, 1e-3, 2.0
#: Duration of a gust (IEC 61400-1, extreme operating gust), and the window that holds one, s.
GUST_S, WINDOW_S = 10.5, 120.0
#: Averaging times of readings, s: 3 s for a gust, 600 s for the mean wind.
GUST_MEAN_S, MEAN_S = 3.0, 600.0


@dataclass(frozen=True)
class Wind:
    """A wind with a constant mean speed and direction.

    Attributes
    ----------
    speed
        Mean speed, m/s.
    towards
        Direction in which the wind blows: azimuth clockwise from north, rad.
    turbulence
        Turbulence intensity: standard deviation over mean speed.
    length
        Length scale of the turbulence along the wind, m.
    gust
        Mean height of a gust above the mean wind, m/s; heights are exponentially distributed.
    compliance
        Rotation of a mirror by dynamic pressure at 45° to the wind, rad/Pa; 1e-5 is 0.6 mrad at 10
        m/s.
    seed
        Seed of turbulence and gusts.

    Raises
    ------
    InputError
        If a value is out of range.
    """

    speed: float = 5.0
    towards: float = 0.0
    turbulence: float = 0.18
    length: float = 100.0
    gust: float = 2.0
    compliance: float = 1e-5
    seed: int = 0

    def __post_init__(self) -> None:
        limits = {"speed": 60.0, "turbulence": 1.0, "gust": 40.0, "compliance": 1e-2}
        for name, most in limits.items():
            value = getattr(self, name)
            if not 0.0 <= value <= most:
                raise InputError(f"wind: {name} must be between 0 and {most:g}, not {value}")
        if not (self.length > 0.0 and np.isfinite([self.length, self.towards]).all()):
            raise InputError(
                f"wind: length must be above 0 and towards finite, not {self.length} m and "
                f"{self.towards}"
            )

    @property
    def direction(self) -> FloatArray:
        """Direction in which the wind blows, ENU, (3,)."""
        return np.array([np.sin(self.towards), np.cos(self.towards), 0.0])

    @cached_property
    def _waves(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return frequencies (Hz), lateral wave numbers (1/m), phases and amplitudes (m/s).

        Each has shape (W,).
        """
        rng = np.random.default_rng((self.seed, 1))
        edges = np.geomspace(SLOWEST, FASTEST, WAVES + 1)
        # Random within the band, because equally spaced frequencies would repeat.
        rate = edges[:-1] + rng.random(WAVES) * np.diff(edges)
        pace = max(self.speed, 0.1)
        scaled = rate * self.length / pace
        # Von Kármán's longitudinal spectrum, with variance 1.
        spectrum = 4.0 * self.length / pace / (1.0 + 70.8 * scaled**2) ** (5.0 / 6.0)
        height = self.turbulence * self.speed * np.sqrt(2.0 * spectrum * np.diff(edges))
        # Eddies are as wide as they are long.
        across = rng.standard_normal(WAVES) * 2.0 * np.pi * rate / pace
        return rate, across, rng.uniform(0.0, 2.0 * np.pi, WAVES), height

    def at(self, place: npt.ArrayLike, time: npt.ArrayLike) -> FloatArray:
        """Return the wind speed at positions and times, m/s.

        Positions (..., 3), m, and times (...), s, are broadcast. The direction does not change;
        turbulence never reverses the wind.
        """
        x = as_vectors(place, "wind: place")
        along = x @ self.direction
        across = x @ np.array([np.cos(self.towards), -np.sin(self.towards), 0.0])
        # The eddy that is here now was upwind before.
        passed = as_float(time) - along / max(self.speed, 0.1)
        rate, lateral, phase, height = self._waves
        turns = 2.0 * np.pi * rate * passed[..., None] + lateral * across[..., None] + phase
        speed = self.speed + np.cos(turns) @ height + self._gusts(passed)
        return as_float(np.maximum(0.0, speed))

    def _gusts(self, passed: FloatArray) -> FloatArray:
        out = np.zeros_like(passed)
        if self.gust == 0.0 or not passed.size:
            return out
        # A gust may extend into the next window.
        first = int(np.floor(passed.min() / WINDOW_S)) - 1
        for window in range(first, int(np.floor(passed.max() / WINDOW_S)) + 1):
            begin, height = _gust(self.seed, window)
            share = np.clip((passed - begin) / GUST_S, 0.0, 1.0)
            out += self.gust * height * 0.5 * (1.0 - np.cos(2.0 * np.pi * share))
        return out

    def turned(self, normal: npt.ArrayLike, place: npt.ArrayLike, time: float) -> FloatArray:
        """Return the wind-deflected normals (..., 3) of mirrors at positions (..., 3), m.

        The moment on a flat plate is proportional to sin 2β, where β is the angle between the
        normal and the wind: it is zero broadside and edge on (as at stow). The moment turns the
        plate broadside.
        """
        n, w = as_float(normal), self.direction
        pressure = 0.5 * DENSITY * self.at(place, time) ** 2
        along = n @ w
        aside = w - along[..., None] * n
        moved = n + (2.0 * self.compliance * pressure * along)[..., None] * aside
        return as_float(moved / np.linalg.norm(moved, axis=-1, keepdims=True))

    def readings(self, place: npt.ArrayLike, time: float) -> dict[str, float]:
        """Return an anemometer's readings at a place (3,), m/s, by sensor of the safety table."""
        short = time - np.linspace(0.0, GUST_MEAN_S, 13)
        long = time - np.linspace(0.0, MEAN_S, 601)
        return {
            "wind_gust": float(self.at(place, short).mean()),
            "wind_mean": float(self.at(place, long).mean()),
        }


@lru_cache(maxsize=1024)
def _gust(seed: int, window: int) -> tuple[float, float]:
    """Return a window's gust: its start, s, and its height relative to the mean height."""
    # Windows before time 0 have gusts too, but a seed may not be negative.
    rng = np.random.default_rng((seed, 2, window & 0xFFFFFFFF))
    return WINDOW_S * (window + float(rng.random())), float(rng.exponential())
