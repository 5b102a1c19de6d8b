"""The sun: its position as angles and as a vector, and sunrise and sunset.

Begin with `vector` (or `position` for the angles); `events` returns the sunrise and sunset of a
day, and `daylight` the times at which the sun is up. These functions accept any number of times, in
any form that `unix_seconds` reads. `vector_and_rate`, `fast_vector` and `broadcast_values` return
the sun vector at one site second by second, as cluster controllers broadcast it. `clear_sky`
estimates the direct irradiance.
"""

from heliotrope.sun.broadcast import (
    LOWEST_BROADCAST,
    broadcast_values,
    fast_vector,
    vector_and_rate,
)
from heliotrope.sun.ephemeris import (
    UPPER_LIMB,
    Site,
    SunEvents,
    SunPosition,
    Times,
    check_site,
    daylight,
    events,
    position,
    solar_day,
    unix_seconds,
    vector,
)
from heliotrope.sun.sky import clear_sky

__all__ = [
    "LOWEST_BROADCAST",
    "UPPER_LIMB",
    "Site",
    "SunEvents",
    "SunPosition",
    "Times",
    "broadcast_values",
    "check_site",
    "clear_sky",
    "daylight",
    "events",
    "fast_vector",
    "position",
    "solar_day",
    "unix_seconds",
    "vector",
    "vector_and_rate",
]
