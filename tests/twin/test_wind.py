"""Wind: its statistics, that it passes over the field, and what it does to mirrors."""

import numpy as np
import pytest

from heliotrope.errors import InputError
from heliotrope.geometry import normalize
from heliotrope.safety import CONDITIONS
from heliotrope.twin.wind import DENSITY, GUST_S, MEAN_S, Wind

HERE = (0.0, 0.0, 2.0)
TIMES = np.arange(0.0, 20_000.0, 0.25)


@pytest.mark.parametrize("seed", range(3))
def test_turbulence_has_its_spread_and_spectrum(seed: int) -> None:
    wind = Wind(speed=8.0, gust=0.0, seed=seed)
    speed = wind.at(HERE, TIMES)
    assert speed.mean() == pytest.approx(8.0, abs=0.1)
    # What lies outside the band of the waves is left out: a few per cent.
    assert speed.std() == pytest.approx(0.18 * 8.0, rel=0.08)
    # In the inertial range the spectrum falls by the power -5/3: from 0.05 to 0.8 Hz.
    power = np.abs(np.fft.rfft(speed - speed.mean())) ** 2
    rate = np.fft.rfftfreq(len(speed), 0.25)
    low, high = (power[(rate > f / 2) & (rate < f * 2)].sum() / f for f in (0.05, 0.8))
    assert np.log(high / low) / np.log(16.0) == pytest.approx(-5.0 / 3.0, abs=0.25)


def test_the_wind_is_the_same_for_the_same_seed_and_no_other() -> None:
    one, again, other = (Wind(seed=s).at(HERE, TIMES[:400]) for s in (5, 5, 6))
    assert np.array_equal(one, again)
    assert np.abs(one - other).max() > 0.5


def test_it_passes_over_the_field() -> None:
    wind = Wind(speed=6.0, towards=0.5 * np.pi, seed=2)
    # 60 m to the east everything comes 10 s later.
    east = wind.at((60.0, 0.0, 2.0), TIMES[:2000] + 10.0)
    assert np.allclose(east, wind.at(HERE, TIMES[:2000]), atol=1e-9)
    # Across the wind eddies differ the more, the further.
    here = wind.at(HERE, TIMES)
    near, far = (np.corrcoef(here, wind.at((0.0, y, 2.0), TIMES))[0, 1] for y in (3.0, 300.0))
    assert near > 0.9
    assert far < 0.6
    # Places and times broadcast: a field at once is the places one by one.
    places = np.array([HERE, (40.0, -30.0, 2.0), (-200.0, 90.0, 2.0)])
    assert np.allclose(wind.at(places, 77.0), [wind.at(p, 77.0) for p in places], atol=1e-12)


def test_gusts_come_one_in_each_window_and_go() -> None:
    wind = Wind(speed=5.0, turbulence=0.0, gust=3.0, seed=1)
    over = wind.at(HERE, TIMES) - 5.0
    blows = over > 1e-9
    begins = np.flatnonzero(blows[1:] & ~blows[:-1])
    assert 0.9 * len(TIMES) / 480 < len(begins) <= len(TIMES) / 480 + 2
    # Exponential heights: their mean is 3 m/s, of 166 within 4 standard errors.
    tops = [over[i : i + int(4 * GUST_S) + 2].max() for i in begins]
    assert np.mean(tops) == pytest.approx(3.0, abs=4.0 * 3.0 / np.sqrt(len(tops)))
    assert over.min() >= 0.0


def test_a_mirror_turns_broadside_in_proportion_to_the_pressure() -> None:
    wind = Wind(speed=10.0, turbulence=0.0, gust=0.0, compliance=1e-5)
    pressure = 0.5 * DENSITY * 100.0
    north, up = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    slant = normalize(north + up)
    turned = wind.turned(np.stack([slant, -slant, north, up]), np.zeros((4, 3)), 3.0)
    assert np.linalg.norm(turned[0] - slant) == pytest.approx(1e-5 * pressure, rel=1e-6)
    assert turned[0] @ north > slant @ north
    # The back of a plate is as the front, and edge on or broadside nothing turns it.
    assert np.allclose(turned[1], -turned[0])
    assert np.allclose(turned[2:], [north, up], atol=1e-15)
    calm = Wind(speed=0.0, gust=0.0).turned(slant, HERE, 0.0)
    assert np.allclose(calm, slant, atol=1e-15)


def test_readings_are_those_that_the_safety_table_names() -> None:
    wind = Wind(speed=9.0, gust=8.0, seed=4)
    times = np.arange(0.0, 3600.0, 5.0)
    told = [wind.readings(HERE, t) for t in times]
    assert set(told[0]) == {"wind_gust", "wind_mean"}
    assert set(told[0]) <= {condition.reading for condition in CONDITIONS}
    gusts, means = (np.array([r[name] for r in told]) for name in ("wind_gust", "wind_mean"))
    assert gusts.max() > 15.0 > means.max()
    assert gusts.std() > 3.0 * means.std()
    # The mean reading trails the wind by the time it is taken over.
    whole = wind.at(HERE, np.arange(3000.0, 3000.0 + MEAN_S, 0.25)).mean()
    assert wind.readings(HERE, 3000.0 + MEAN_S)["wind_mean"] == pytest.approx(whole, abs=0.1)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"speed": -1.0}, "wind: speed must be between 0 and 60, not -1.0"),
        ({"turbulence": float("nan")}, "wind: turbulence must be between 0 and 1, not nan"),
        ({"length": 0.0}, "wind: length must be above 0"),
        ({"towards": float("inf")}, "towards finite, not .* and inf"),
    ],
)
def test_winds_that_are_none(given: dict[str, float], text: str) -> None:
    with pytest.raises(InputError, match=text):
        Wind(**given)  # type: ignore[arg-type]
