"""Grena's 2008 algorithm, which Malan used, as a cross-check of the sun position, 2003 to 2022.

The source is R. Grena, "An algorithm for the computation of the solar position", Solar Energy 82
(2008) 462-470. The paper itself was not available. The constants are those of the program printed
in it, which two public reprints reproduce identically. A test confirms the author's accuracy,
0.0027°, against SPA over all twenty years.
"""

import numpy as np

from heliotrope.geometry import FloatArray, as_float

#: Start (2003-01-01) and end (2023-01-01, excluded) of the algorithm's validity, Unix seconds.
FIRST, LAST = 1_041_379_200.0, 1_672_531_200.0

#: Unix time of Grena's epoch, Julian day 2452640 (2002-12-31, noon), s.
_EPOCH = 1_041_336_000.0
_DAY = 86400.0
#: Below this true elevation Grena omits refraction, rad.
_LOWEST_REFRACTED = -0.01
#: The sun's parallax as rounded by Grena, rad.
_PARALLAX = 4.26e-5


def grena2008(
    seconds: FloatArray,
    latitude: float,
    longitude: float,
    pressure_atm: float,
    temperature_c: float,
    delta_t: FloatArray,
) -> FloatArray:
    """Return azimuth from north, apparent and true elevation, rad, shape (3, n).

    Parameters
    ----------
    seconds
        Unix times from `FIRST` to `LAST`, (n,).
    latitude, longitude
        Latitude and longitude, rad, positive to the north and to the east.
    pressure_atm, temperature_c
        Pressure, atmospheres, and temperature, °C, of the air.
    delta_t
        TT − UT1, s, (n,).
    """
    universal = (seconds - _EPOCH) / _DAY
    t = universal + delta_t / _DAY
    nutation = 8.33e-5 * np.sin(9.252e-4 * t - 1.173)
    obliquity = -6.21e-9 * t + 0.409086 + 4.46e-5 * np.sin(9.252e-4 * t + 0.397)
    ecliptic = _heliocentric_longitude(t) + np.pi + nutation - 9.932e-5
    ascension = np.arctan2(np.sin(ecliptic) * np.cos(obliquity), np.cos(ecliptic))
    declination = np.arcsin(np.sin(obliquity) * np.sin(ecliptic))
    hour = 6.30038809903 * universal + 4.8824623 + 0.9174 * nutation + longitude - ascension
    across, along = np.cos(latitude), np.sin(latitude)
    # Convert from the earth's centre to the site (parallax).
    shift = -_PARALLAX * across * np.sin(hour)
    declination = declination - _PARALLAX * (along - declination * across)
    cosine = np.cos(hour) + shift * np.sin(hour)
    sine = np.sin(hour) - shift * np.cos(hour)
    true = np.arcsin(along * np.sin(declination) + across * np.cos(declination) * cosine)
    azimuth = np.pi + np.arctan2(sine, cosine * along - np.tan(declination) * across)
    refracted = true > _LOWEST_REFRACTED
    # The elevation is held at the limit below it, where the tangent may pass through 0.
    e = np.maximum(true, _LOWEST_REFRACTED)
    refraction = 0.084217 * pressure_atm / (273.0 + temperature_c)
    refraction = refraction / np.tan(e + 0.0031376 / (e + 0.089186))
    return as_float(np.stack([azimuth, true + np.where(refracted, refraction, 0.0), true]))


def _heliocentric_longitude(t: FloatArray) -> FloatArray:
    """Return the sum of all terms of the earth's heliocentric longitude, rad."""
    year = 1.72019e-2 * t - 0.0563
    longitude = 1.740940 + 1.7202768683e-2 * t + 3.34118e-2 * np.sin(year)
    longitude = longitude + 3.488e-4 * np.sin(2.0 * year)
    for size, rate, phase in (
        (3.13e-5, 2.127730e-1, -0.585),
        (1.26e-5, 4.243e-3, 1.46),
        (2.35e-5, 1.0727e-2, 0.72),
        (2.76e-5, 1.5799e-2, 2.35),
        (2.75e-5, 2.1551e-2, -1.98),
        (1.26e-5, 3.1490e-2, -0.80),
    ):
        longitude = longitude + size * np.sin(rate * t + phase)
    k = 1e-3 * t
    remainder = ((-2.30796e-7 * k + 3.7976e-6) * k - 2.0458e-5) * k + 3.976e-5
    return as_float(longitude + remainder * k * k)
