"""Direct irradiance under a clear sky."""

import numpy as np

#: Irradiance above the atmosphere for which the formula was fitted, W/m².
_OUTSIDE = 1353.0


def clear_sky(elevation: float, altitude: float) -> float:
    """Return the direct normal irradiance under a clear sky, W/m²; 0 if the sun is down.

    The result is Meinel's fit to measurements, including its term for altitude, with Kasten and
    Young's air mass. Both are as stated on https://www.pveducation.org (Air Mass; Calculation of
    Solar Insolation).

    Parameters
    ----------
    elevation
        Elevation of the sun, rad.
    altitude
        Altitude of the site, m; clipped to 0 to 3,000 m.
    """
    if elevation <= 0.0:
        return 0.0
    degrees = np.degrees(elevation)
    mass = 1.0 / (np.sin(elevation) + 0.50572 * (degrees + 6.07995) ** -1.6364)
    height = 0.14 * np.clip(1e-3 * altitude, 0.0, 3.0)
    return float(_OUTSIDE * ((1.0 - height) * 0.7 ** (mass**0.678) + height))
