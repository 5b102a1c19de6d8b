"""The sun: where it stands, as angles and as a vector, and when it rises and sets.

`position`, `vector`, `events` and `daylight` take any number of times; `sun_at`, `sun_now` and
`sun_values` follow the sun of one site second by second, as controllers broadcast it.
"""

from heliotrope.sun.ephemeris import (
    UPPER_LIMB,
    Site,
    SunEvents,
    SunPosition,
    Times,
    daylight,
    events,
    position,
    vector,
)
from heliotrope.sun.line import HORIZON, sun_at, sun_now, sun_values

__all__ = [
    "HORIZON",
    "UPPER_LIMB",
    "Site",
    "SunEvents",
    "SunPosition",
    "Times",
    "daylight",
    "events",
    "position",
    "sun_at",
    "sun_now",
    "sun_values",
    "vector",
]
