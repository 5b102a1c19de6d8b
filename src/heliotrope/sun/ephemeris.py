"""The position of the sun, as angles and as a vector, and the times of sunrise and sunset.

Positions come from NREL's solar position algorithm (Reda & Andreas 2004, "SPA") as implemented in
pvlib, with the pressure and temperature of the site. *True* means without the atmosphere,
*apparent* with atmospheric refraction, that is, the sun as a mirror sees it. Refraction lifts the
sun by 1.5 mrad at 10° of elevation and by 0.3 mrad at 45°, so heliostats track the apparent sun.

Times must carry a time zone; internally they are Unix seconds (UTC).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, timedelta
from numbers import Real
from typing import TYPE_CHECKING, Any, Literal, Self, TypeAlias

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError, TimeError, UnknownNameError, kind_of
from heliotrope.files.times import moment
from heliotrope.frames import ENU, LATEST, Framed, Labelled, Variable, batched
from heliotrope.frames import times as frame_times
from heliotrope.geometry import FloatArray, as_float, direction, wrap_positive
from heliotrope.parallel import run_blocks
from heliotrope.sun import grena
from heliotrope.values import Card, Value, span

if TYPE_CHECKING:
    import pandas as pd
    from pvlib.location import Location

#: Accepted forms of time: an aware datetime, an ISO 8601 text with an offset or Z, Unix seconds
#: (UTC), a list or an array of these, or a time-zone-aware pandas index or column.
Times: TypeAlias = datetime | Sequence[datetime] | npt.ArrayLike

#: True elevation of the sun's centre at sunrise and sunset by convention: 34′ of refraction and 16′
#: of solar radius below the horizon, so that the upper limb touches the horizon.
UPPER_LIMB = float(np.radians(-0.8333))

# SPA omits refraction if the sun's centre is lower than this, in degrees.
_HORIZON_REFRACTION_DEG = 0.5667
_LOWEST_REFRACTED_DEG = -(0.26667 + _HORIZON_REFRACTION_DEG)

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_DAY = 86400.0
_FIRST_YEAR, _LAST_YEAR = -2000, 6000  # Years in which SPA is valid.
#: Times from here on are outside SPA's validity, Unix seconds.
END_OF_TIMES = float(np.datetime64(f"{_LAST_YEAR + 1}", "s").astype(np.int64))
_FIRST_DELTA_T, _LAST_DELTA_T = -1999, 3000  # Years in which pvlib's ΔT polynomials are valid.
# pvlib keeps some twenty intermediate arrays at a time; with 3 MB per chunk they stay in the cache.
_CHUNK = 16384


@dataclass(frozen=True)
class Site:
    """A location on Earth and its atmosphere.

    Parameters
    ----------
    latitude_deg
        Latitude, positive north, −90 to 90 (WGS84).
    longitude_deg
        Longitude, positive east, −180 to 180.
    height
        Height above the ellipsoid in m, −500 to 9000.
    pressure
        Air pressure at the site (not reduced to sea level) in Pa, 30,000 to 120,000;
        None for the standard atmosphere at ``height``.
    temperature_c
        Air temperature in °C, −90 to 60.
    name
        Display name; nothing depends on it.
    delta_t
        TT − UT1 in s, −8000 to 8000; None for pvlib's polynomials by year and month (Espenak &
        Meeus). These were 5 s too high in 2025, which causes an error of 1 µrad in sun position.

    Raises
    ------
    InputError
        If a number is missing, not finite or out of range.
    """

    latitude_deg: float
    longitude_deg: float
    height: float
    pressure: float | None = None
    temperature_c: float = 12.0
    name: str = ""
    delta_t: float | None = None

    def __post_init__(self) -> None:
        for field, low, high, unit, advice in _SITE_LIMITS:
            value = getattr(self, field)
            if value is None and field in {"pressure", "delta_t"}:
                continue
            if not low <= _number(value) <= high:
                raise InputError(
                    f"{self.label}: {field} = {value} {unit} is not a number from "
                    f"{low:g} to {high:g} {unit}; {advice}"
                )

    @classmethod
    def from_pvlib(cls, location: "Location") -> Self:
        """Return the site of a pvlib ``Location``: its latitude, longitude, altitude and name."""
        return cls(
            float(location.latitude),
            float(location.longitude),
            float(location.altitude or 0.0),
            name=location.name or "",
        )

    @property
    def label(self) -> str:
        """The site as named in messages."""
        return f"site {self.name!r}" if self.name else "site"

    @property
    def origin(self) -> tuple[float, float, float]:
        """Latitude and longitude in degrees, and height in m, of the origin of ENU frames."""
        return self.latitude_deg, self.longitude_deg, self.height

    @property
    def air_pressure(self) -> float:
        """``pressure``, or the pressure of the standard atmosphere at ``height``, in Pa."""
        if self.pressure is not None:
            return self.pressure
        from pvlib.atmosphere import alt2pres

        return float(alt2pres(self.height))

    @property
    def numbers(self) -> tuple[float, ...]:
        """Latitude and longitude, °; height, m; pressure, Pa (−1 if unset); air temperature, °C."""
        pressure = -1.0 if self.pressure is None else self.pressure
        return (self.latitude_deg, self.longitude_deg, self.height, pressure, self.temperature_c)


#: Algorithm names that `position` accepts.
ALGORITHMS = ("spa", "grena2008")

_SITE_LIMITS = (
    ("latitude_deg", -90.0, 90.0, "°", "north is positive"),
    ("longitude_deg", -180.0, 180.0, "°", "east is positive"),
    ("height", -500.0, 9000.0, "m", "use metres above the ellipsoid"),
    ("pressure", 3e4, 1.2e5, "Pa", "use pascals (1 hPa is 100 Pa)"),
    ("temperature_c", -90.0, 60.0, "°C", "use degrees Celsius (0 °C is 273.15 K)"),
    ("delta_t", -8000.0, 8000.0, "s", "use TT − UT1 in seconds, about 69 in 2025"),
)


@dataclass(frozen=True, eq=False, repr=False)
class SunPosition(Value, Framed):
    """The position of the sun; (...) is the shape of the times.

    Attributes
    ----------
    time
        Times, Unix seconds, shape (...).
    azimuth
        Clockwise from north in [0, 2π), shape (...), rad.
    elevation
        Apparent (refracted) elevation of the sun's centre, shape (...), rad. Below a true elevation
        of −0.8334° it equals the true elevation, because SPA switches refraction off there; the
        elevation jumps by 0.6° at that point.
    true_elevation
        Elevation without the atmosphere, shape (...), rad.
    vector
        Unit vectors to the apparent sun, ENU, shape (..., 3).
    true_vector
        Unit vectors to the true sun, ENU, shape (..., 3).
    """

    time: FloatArray
    azimuth: FloatArray
    elevation: FloatArray
    true_elevation: FloatArray
    vector: FloatArray
    true_vector: FloatArray

    def _card(self) -> Card:
        turn = float(np.degrees(1.0))
        rows = [
            ("azimuth", span(self.azimuth, turn, "°")),
            ("apparent elevation", span(self.elevation, turn, "°")),
            ("true elevation", span(self.true_elevation, turn, "°")),
        ]
        size = " × ".join(map(str, self.azimuth.shape)) or "one"
        line = ", ".join(f"{name} {value}" for name, value in rows[:2])
        return Card(f"{size}, {line}", ("angle", "range"), rows)

    def _labelled(self) -> Labelled:
        own = {
            name: Variable((), getattr(self, name), "rad")
            for name in ("azimuth", "elevation", "true_elevation")
        }
        own |= {
            name: Variable(("axis",), getattr(self, name)) for name in ("vector", "true_vector")
        }
        if not bool((np.abs(self.time) < LATEST).all()):
            return batched(np.shape(self.time), own, {"axis": ENU})
        if np.ndim(self.time) != 1:
            own["time"] = Variable((), frame_times(self.time))
            return batched(np.shape(self.time), own, {"axis": ENU})
        rows = {
            name: replace(variable, axes=("time", *variable.axes)) for name, variable in own.items()
        }
        return Labelled(("time",), {"time": frame_times(self.time), "axis": ENU}, rows)


@dataclass(frozen=True)
class SunEvents:
    """Sunrise, culmination and sunset of one solar day, in UTC.

    Attributes
    ----------
    sunrise, sunset
        Times of sunrise and sunset; None if the sun does not cross the given elevation. In a polar
        night both are None. On a polar day at least one is None (the first and the last polar day
        of the season have one crossing).
    culmination
        Time of the sun's upper transit of the meridian.
    culmination_elevation
        Apparent elevation at culmination, rad.
    kind
        "polar night" if the sun culminates below the given elevation, "normal" if it rises and
        sets, or "polar day" in any other case.
    """

    sunrise: datetime | None
    sunset: datetime | None
    culmination: datetime
    culmination_elevation: float
    kind: Literal["normal", "polar day", "polar night"]


def position(times: Times, site: Site, *, algorithm: str = "spa") -> SunPosition:
    """Return the position of the sun.

    Parameters
    ----------
    times
        Times of any shape (...); see `Times`. Numbers are unix seconds (UTC).
    site
        Location, pressure and temperature.
    algorithm
        "spa", or "grena2008" for the algorithm that Malan used, as a cross-check for the years 2003
        to 2022. The accuracy of the latter is ±0.0027° (47 µrad) according to its author, which was
        confirmed against SPA.

    Raises
    ------
    TimeError
        If a time has no time zone, is not a time, or lies outside the years −2000 to 6000 (−1999 to
        3000 without ``Site.delta_t``).
    InputError
        If ``algorithm`` is "grena2008" and a time lies outside its years.
    UnknownNameError
        If ``algorithm`` is unknown.

    Notes
    -----
    The source is Reda & Andreas (2004), equations 4 to 47; refraction follows their equation 42
    with the pressure and temperature of the site. The accuracy is ±5 µrad (0.0003°) according to
    the authors. Compared with IAU 2006/2000A (ERFA) for 2020 to 2035 it is also ±5 µrad, excluding
    refraction and UT1 − UTC (below 0.9 s, 65 µrad). Refraction close to the horizon varies with the
    weather by more than 1 mrad.
    """
    if algorithm not in ALGORITHMS:
        raise UnknownNameError("sun algorithm", str(algorithm), ALGORITHMS)
    check_site(site)
    seconds = unix_seconds(times)
    _check_years(seconds, site)
    if algorithm == "grena2008":
        angles = _grena(seconds.ravel(), site)
    else:
        angles = np.radians(_spa(seconds.ravel(), site))
    azimuth, elevation, true_elevation = angles.reshape(3, *seconds.shape)
    azimuth = wrap_positive(azimuth)
    return SunPosition(
        time=seconds,
        azimuth=azimuth,
        elevation=as_float(elevation),
        true_elevation=as_float(true_elevation),
        vector=direction(azimuth, elevation),
        true_vector=direction(azimuth, true_elevation),
    )


def vector(times: Times, site: Site, *, apparent: bool = True) -> FloatArray:
    """Return unit vectors to the sun, ENU, shape (..., 3).

    Parameters
    ----------
    times, site
        As for `position`, which also states the errors and the accuracy.
    apparent
        Whether to include refraction, as mirrors see the sun.
    """
    sun = position(times, site)
    return sun.vector if apparent else sun.true_vector


def events(
    day: date | str, site: Site, *, elevation: float = UPPER_LIMB, apparent: bool = False
) -> SunEvents:
    """Return sunrise, culmination and sunset of a solar day.

    Parameters
    ----------
    day
        Date in local mean solar time, which follows the longitude and not a civil time zone; a date
        or an ISO text. The day is the 12 hours before and after the culmination.
    site
        Location, pressure and temperature.
    elevation
        Elevation of the sun's centre at sunrise and sunset, rad. The default is the convention for
        the upper limb, −0.8333° of true elevation.
    apparent
        Whether ``elevation`` is apparent. An apparent elevation must not be negative, because the
        apparent elevation jumps below the horizon (see `SunPosition`).

    Raises
    ------
    TimeError
        If ``day`` is not a date, or lies outside the years of `position`.
    InputError
        If ``elevation`` is not within −π/2 to π/2, or is apparent and negative.

    Notes
    -----
    At sunrise and sunset `position` returns the requested elevation to 0.1 µrad, which corresponds
    to 2 ms where the sun climbs by 11° per hour. Because refraction varies with the weather, the
    time of a real sunrise is uncertain by a minute.
    """
    from scipy.interpolate import CubicSpline

    noon = _mean_noon(day, site)
    level = float(np.sin(_true_level(elevation, site) if apparent else _checked(elevation)))
    # The components of the true vector are nearly sinusoids with a period of one day. A cubic
    # spline through 10-minute nodes reproduces them to (ωh)⁴/384 = 1e-8.
    offsets = np.arange(-13 * 3600.0, 13 * 3600.0 + 1.0, 600.0)
    sun = vector(noon + offsets, site, apparent=False)
    meridian = CubicSpline(offsets, sun[:, 0]).roots(extrapolate=False)
    # The equation of time stays within 20 minutes.
    culmination = float(meridian[np.abs(meridian).argmin()])
    height = CubicSpline(offsets, sun[:, 2])
    crossings = height.solve(level, extrapolate=False)
    up = height(crossings, 1) > 0
    half_day = np.abs(crossings - culmination) <= 0.5 * _DAY
    rises = crossings[half_day & up & (crossings < culmination)]
    sets = crossings[half_day & ~up & (crossings > culmination)]
    night = float(height(culmination)) < level
    sunrise = None if night or not rises.size else _utc(noon + rises[-1])
    sunset = None if night or not sets.size else _utc(noon + sets[0])
    kind: Literal["normal", "polar day"] = "normal" if sunrise and sunset else "polar day"
    return SunEvents(
        sunrise=sunrise,
        sunset=sunset,
        culmination=_utc(noon + culmination),
        culmination_elevation=float(position(noon + culmination, site).elevation),
        kind="polar night" if night else kind,
    )


def solar_day(time: datetime, site: Site) -> date:
    """Return the day, in local mean solar time, on which an aware time falls.

    This is the day that is called today at the site, whatever the zone of ``time``. For example, an
    afternoon in California may already be tomorrow in UTC.

    Raises
    ------
    TimeError
        If ``time`` has no time zone.
    """
    if time.tzinfo is None:
        raise _no_time(time, ())
    check_site(site)
    return (time.astimezone(UTC) + timedelta(hours=site.longitude_deg / 15.0)).date()


def daylight(
    day: date | str,
    site: Site,
    *,
    every: timedelta = timedelta(minutes=1),
    min_elevation: float = 0.0,
) -> "pd.DatetimeIndex":
    """Return the times of a solar day at which the sun is up, in UTC.

    Parameters
    ----------
    day
        Date in local mean solar time. The day is the 12 hours before and after mean noon, so that
        days follow each other without gap or overlap.
    site
        Location, pressure and temperature.
    every
        Step, 0.1 s to a day. Times are whole multiples of the step since 1970, so that two sites or
        two days share one grid.
    min_elevation
        Lowest apparent elevation to keep, rad.

    Returns
    -------
    Index of aware times, empty in a polar night; it can be passed to `position` directly.

    Raises
    ------
    TimeError
        If ``day`` is not a date, or lies outside the years of `position`.
    InputError
        If ``every`` or ``min_elevation`` is out of its range.
    """
    import pandas as pd

    limit = _checked(min_elevation, "min_elevation")
    if not timedelta(seconds=0.1) <= every <= timedelta(days=1):
        raise InputError(f"every must be between 0.1 s and 1 day, not {every}")
    step = every.total_seconds()
    noon = _mean_noon(day, site)
    first, last = np.ceil((noon + np.array([-0.5, 0.5]) * _DAY) / step)
    seconds = np.arange(first, last) * step
    seconds = seconds[position(seconds, site).elevation >= limit]
    stamps = np.round(seconds * 1e6).astype(np.int64).astype("datetime64[us]")
    return pd.DatetimeIndex(stamps).tz_localize("UTC")


def _spa(seconds: FloatArray, site: Site) -> FloatArray:
    """Return azimuth, apparent and true elevation in degrees, (3, n), at n Unix times.

    The times are processed in chunks with fixed borders. This limits memory (a million times at
    once would take 340 MB) and makes the result independent of the number of threads.
    """
    from pvlib import spa

    result = np.empty((3, seconds.size))
    pressure_hpa = site.air_pressure / 100.0

    def run(start: int, stop: int) -> None:
        for chunk in range(start, stop):
            rows = slice(chunk * _CHUNK, (chunk + 1) * _CHUNK)
            _, _, apparent, true, azimuth, _ = spa.solar_position(
                seconds[rows],
                *site.origin,
                pressure_hpa,
                site.temperature_c,
                _delta_t(seconds[rows], site),
                _HORIZON_REFRACTION_DEG,
                numthreads=1,
            )
            result[:, rows] = azimuth, apparent, true

    run_blocks(run, -(-seconds.size // _CHUNK), minimum_rows=2)
    return result


def _grena(seconds: FloatArray, site: Site) -> FloatArray:
    """Return Grena's azimuth, apparent and true elevation, rad, (3, n), at n Unix times."""
    out = (seconds < grena.FIRST) | (seconds >= grena.LAST)
    if out.any():
        raise InputError(
            f"algorithm 'grena2008': {_utc(seconds[out][0]):%Y-%m-%d} lies outside its validity, "
            "2003 to 2022 (1.2 mrad wrong in 2029); use 'spa'"
        )
    return grena.grena2008(
        seconds,
        np.radians(site.latitude_deg),
        np.radians(site.longitude_deg),
        site.air_pressure / 101325.0,
        site.temperature_c,
        _delta_t(seconds, site),
    )


def _delta_t(seconds: FloatArray, site: Site) -> FloatArray:
    from pvlib import spa

    if site.delta_t is not None:
        return np.full(seconds.shape, site.delta_t)
    months = np.floor(seconds).astype("datetime64[s]").astype("datetime64[M]").astype(np.int64)
    return as_float(spa.calculate_deltat(1970 + months // 12, months % 12 + 1))


def check_site(site: object) -> None:
    """Reject anything but a `Site`.

    Raises
    ------
    InputError
        If ``site`` is something else, such as a pvlib Location.
    """
    if not isinstance(site, Site):
        raise InputError(
            f"site: {kind_of(site)} is not a Site; pass Site(latitude_deg, longitude_deg, height), "
            "in degrees and metres, or Site.from_pvlib(location)"
        )


def _true_level(apparent: float, site: Site) -> float:
    """Return the true elevation at which SPA's refraction gives ``apparent``."""
    from pvlib import spa
    from scipy.optimize import brentq

    if _checked(apparent) < 0.0:
        raise InputError(
            f"elevation: {apparent:g} rad is below the horizon, where the apparent elevation "
            "jumps; pass at least 0, or the true elevation with apparent=False"
        )
    target = float(np.degrees(apparent))

    def excess(true: float) -> float:
        refraction = spa.atmospheric_refraction_correction(
            site.air_pressure / 100.0, site.temperature_c, true, _HORIZON_REFRACTION_DEG
        )
        return true + float(refraction) - target

    # In dense, cold air the apparent elevation jumps past 0 where refraction begins.
    if excess(_LOWEST_REFRACTED_DEG) >= 0.0:
        return float(np.radians(_LOWEST_REFRACTED_DEG))
    # The margin is needed because SPA's refraction is slightly negative at the zenith.
    return float(np.radians(brentq(excess, _LOWEST_REFRACTED_DEG, target + 0.001)))


def _number(value: object) -> float:
    """Return a number as a float; anything else becomes NaN, which is outside every range."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return np.nan
    return float(value)


def _checked(elevation: float, name: str = "elevation") -> float:
    if not -np.pi / 2 <= _number(elevation) <= np.pi / 2:
        raise InputError(
            f"{name}: {elevation} rad is not within −π/2 to π/2; convert degrees with numpy.radians"
        )
    return float(elevation)


def _mean_noon(day: Any, site: Site) -> float:
    """Return local mean solar noon in Unix seconds, which is 4 min later per degree west."""
    if isinstance(day, str):
        try:
            day = date.fromisoformat(day)
        except ValueError:
            raise TimeError(f"day: {day!r} is not an ISO 8601 date like 2024-06-21") from None
    if isinstance(day, datetime) or not isinstance(day, date):
        raise TimeError(f"day: {day!r} is not a date; pass a datetime.date or an ISO date")
    if day == date.min:
        raise TimeError(f"day: {day} begins before the range of datetime; choose a later day")
    check_site(site)
    midnight = (day - _EPOCH.date()).days * _DAY
    return midnight + _DAY * (0.5 - site.longitude_deg / 360.0)


def _utc(seconds: float) -> datetime:
    return _EPOCH + timedelta(seconds=float(seconds))


def unix_seconds(times: Times, *, unknown: bool = False) -> FloatArray:
    """Return times as Unix seconds (UTC) of the same shape; all functions read times with this.

    Parameters
    ----------
    times
        Times of any shape (...); see `Times`. Numbers are Unix seconds (UTC).
    unknown
        Whether NaN may stand for an unknown time; NaT is never accepted.

    Raises
    ------
    TimeError
        If a value is not a time, or has no time zone; the message states the position of the value.
    """
    if isinstance(times, np.ndarray) and times.dtype.kind == "f":
        seconds = as_float(times)  # without loading pandas
    else:
        seconds = _seconds_of(times)
    invalid = np.isinf(seconds) if unknown else ~np.isfinite(seconds)
    for index in np.argwhere(invalid)[:1]:
        value = np.asarray(times, dtype=object)[tuple(index)]
        raise _no_time(value, index)
    # Times in milliseconds, taken for seconds, would be tens of thousands of years away.
    _refuse_outside(
        seconds, _FIRST_YEAR, _LAST_YEAR, "the validity of SPA; numbers are unix seconds"
    )
    return seconds


def _no_time(value: Any, index: Sequence[int]) -> TimeError:
    return TimeError(
        f"{_label(index)}: {value} is not a time; pass an aware datetime, an ISO 8601 text with an "
        "offset, or unix seconds"
    )


def _seconds_of(times: Times) -> FloatArray:
    """Return Unix seconds; NaN for a value that is missing or not finite."""
    import pandas as pd

    if isinstance(times, pd.Series | pd.Index) and isinstance(times.dtype, pd.DatetimeTZDtype):
        for index in np.argwhere(np.asarray(times.isna()))[:1]:
            raise _no_time(pd.NaT, index)
        return as_float((pd.DatetimeIndex(times) - _EPOCH) / pd.Timedelta(seconds=1))
    try:
        array = np.asarray(times)
    except ValueError:
        raise TimeError("times: its lists differ in length") from None
    if array.dtype.kind == "M":
        raise TimeError(
            f"times: {array.dtype} has no time zone; specify one, for example "
            "pandas.DatetimeIndex(times).tz_localize('UTC')"
        )
    if array.dtype.kind in "iuf":
        return as_float(array)
    seconds = np.empty(array.shape)
    for index, value in np.ndenumerate(array):
        seconds[index] = _one_time(value, index)
    return seconds


def _one_time(value: Any, index: Sequence[int]) -> float:
    """Return Unix seconds; NaN only if the value is NaN."""
    import pandas as pd

    time = value
    if isinstance(value, str):
        try:
            time = moment(value)
        except ValueError:
            raise TimeError(
                f"{_label(index)}: '{value}' is not an ISO 8601 time; "
                "write it like 2024-06-21T12:00:00+02:00"
            ) from None
    if time is pd.NaT or not isinstance(time, datetime):
        number = _number(time)
        if np.isnan(number) and not (isinstance(time, Real) and time != time):  # noqa: PLR0124
            raise _no_time(value, index)
        return number
    if time.utcoffset() is None:
        raise TimeError(
            f"{_label(index)}: {time} has no time zone; add one, for example "
            "tzinfo=datetime.UTC, or an offset such as +02:00 or Z in a text"
        )
    return time.timestamp()


def _label(index: Sequence[int]) -> str:
    return f"times[{', '.join(str(i) for i in index)}]" if len(index) else "times"


def _check_years(seconds: FloatArray, site: Site) -> None:
    """Reject times for which ΔT is unknown, unless the site states its own ΔT."""
    if site.delta_t is None:
        _refuse_outside(
            seconds, _FIRST_DELTA_T, _LAST_DELTA_T, "the known ΔT; pass Site(delta_t=...) in s"
        )


def _refuse_outside(seconds: FloatArray, first: int, last: int, advice: str) -> None:
    low, high = (
        float(np.datetime64(year - 1970, "Y").astype("datetime64[s]").astype(np.int64))
        for year in (first, last + 1)
    )
    for index in np.argwhere((seconds < low) | (seconds >= high))[:1]:
        raise TimeError(
            f"{_label(index)}: {seconds[tuple(index)]:.17g} s since 1970 is outside "
            f"the years {first} to {last}, {advice}"
        )
