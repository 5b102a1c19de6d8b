"""The weather station of a simulated plant."""

import numpy as np
import pytest

from heliotrope.links.clock import VirtualClock
from heliotrope.safety import CONDITIONS
from heliotrope.sun import clear_sky
from heliotrope.twin.weather import WeatherStation


def test_the_clear_sky_is_as_published() -> None:
    """Meinel's formula at air masses 1 and 1.5: 1.353 x 0.7^(AM^0.678) kW/m2."""
    assert clear_sky(np.radians(90.0), 0.0) == pytest.approx(947.0, abs=1.0)
    assert clear_sky(np.radians(41.8), 0.0) == pytest.approx(846.0, abs=3.0)
    high = 0.86 * 947.0 + 0.14 * 1353.0
    assert clear_sky(np.radians(90.0), 1000.0) == pytest.approx(high, abs=1.0)


def test_there_is_no_direct_sunlight_at_night() -> None:
    assert clear_sky(-0.1, 0.0) == clear_sky(0.0, 0.0) == 0.0
    low = [clear_sky(np.radians(degrees), 0.0) for degrees in (0.5, 5.0, 20.0, 60.0)]
    assert 0.0 < low[0] < low[1] < low[2] < low[3]


@pytest.mark.parametrize("seed", range(3))
def test_the_wind_of_a_day_trips_no_row(seed: int) -> None:
    now = 1000.0
    station = WeatherStation(
        0.0, VirtualClock(lambda: now), lambda: np.array([0.0, 0.6, 0.8]), seed
    )
    rows = [row for row in CONDITIONS if row.reading in station.names]
    assert {row.reading for row in rows} == {"wind_gust", "wind_mean"}
    worst = dict.fromkeys(station.names, 0.0)
    for now in np.arange(1000.0, 1000.0 + 12 * 3600.0, 61.0):  # noqa: B007 - the clock reads it
        for name, value in station.readings().items():
            worst[name] = max(worst[name], value)
    assert all(worst[row.reading] < row.releases for row in rows)
    assert worst["wind_gust"] > worst["wind_mean"] > 2.0
