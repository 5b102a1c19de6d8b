"""Settings of the schedule, and the weather limits for photographs."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from heliotrope.calibration.learn.drift import DAY
from heliotrope.calibration.plan.planning import SightingLimits
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray


@dataclass(frozen=True)
class Weather:
    """Weather that may prevent photographs; NaN where it is not measured.

    Attributes
    ----------
    dni
        Direct normal irradiance, W/m².
    wind
        Wind speed, m/s.
    """

    dni: float = float("nan")
    wind: float = float("nan")


def _default_limits() -> SightingLimits:
    return SightingLimits(min_elevation=float(np.radians(15.0)))


@dataclass(frozen=True)
class Settings:
    """Settings of the schedule.

    Attributes
    ----------
    model, priors
        Parameters that are learnt, and standard deviations that replace the values in the table.
    limits
        Limits on the sun elevation, the incidence and the obliquity.
    shots, interval, sigma
        Number of photographs per visit, the time between them, s, and the standard deviation of a
        beam, rad.
    settle
        Additional time of a visit, s: for the heliostat to become steady, for replies, and for
        writing parameters.
    look
        Time of a further attempt for a beam that is not on the target, s; None: there is no search.
    goal
        Expected beam error, rad RMS, below which a heliostat is not visited until it is overdue.
    worth
        Minimum fraction of the expected squared error that a visit must remove.
    most_age
        Age of a calibration above which its heliostat takes precedence over all gains, s.
    retry
        Wait after a failed visit, s; doubled each time, until the heliostat is given up (`VISITS`).
    glare
        Minimum angle between the sun and a camera's line of sight to its target, rad.
    most_hidden
        Maximum fraction of a mirror that neighbours may shade or block.
    least_dni, most_wind
        Minimum irradiance and maximum wind, W/m² and m/s.
    """

    model: str | tuple[str, ...] = "malan8"
    priors: Mapping[str, float] = field(default_factory=dict)
    limits: SightingLimits = field(default_factory=_default_limits)
    shots: int = 3
    interval: float = 20.0
    sigma: float = 5e-4
    settle: float = 20.0
    look: float | None = 20.0
    goal: float = 7e-4
    worth: float = 0.1
    most_age: float = 30.0 * DAY
    retry: float = 900.0
    glare: float = float(np.radians(10.0))
    most_hidden: float = 0.35
    least_dni: float = 300.0
    most_wind: float = 12.0

    def __post_init__(self) -> None:
        if self.shots < 1 or not self.interval >= 0.0 or not self.settle >= 0.0:
            raise InputError(
                "schedule: shots must be 1 or more, and interval and settle 0 or more, not "
                f"{self.shots}, {self.interval} s and {self.settle} s"
            )
        for name in ("sigma", "goal", "most_age", "retry", "glare", "most_wind"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise InputError(f"schedule: {name} must be above 0, not {getattr(self, name)}")
        for name in ("worth", "most_hidden"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise InputError(
                    f"schedule: {name} must be 0 or more and below 1, not {getattr(self, name)}"
                )
        if self.look is not None and not self.look > 0.0:
            raise InputError(f"schedule: look must be above 0, or None, not {self.look} s")

    @property
    def visit(self) -> float:
        """Duration of a visit without slewing and searching, s."""
        return self.settle + self.shots * self.interval

    def closed(self, sun: FloatArray, weather: Weather) -> str | None:
        """Return why no photograph is possible in this sun and weather; None if one is."""
        elevation = float(np.arcsin(np.clip(sun[2], -1.0, 1.0)))
        if elevation < self.limits.min_elevation:
            lowest = np.degrees(self.limits.min_elevation)
            return f"the sun is at {np.degrees(elevation):.1f}°, below {lowest:.0f}°"
        if weather.dni < self.least_dni:
            return f"clouds: {weather.dni:.0f} W/m², below {self.least_dni:.0f} W/m²"
        if weather.wind > self.most_wind:
            return f"wind: {weather.wind:.1f} m/s, above {self.most_wind:.1f} m/s"
        return None
