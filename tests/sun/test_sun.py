import math
import subprocess
import sys
from datetime import UTC, date, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pvlib import solarposition

from heliotrope import sun
from heliotrope.errors import InputError, TimeError, UnknownNameError
from heliotrope.geometry import MRAD, angle_between, direction
from heliotrope.lcu import wire
from heliotrope.sun import ephemeris, grena
from support import data

URAD = 1e-6
NOON = datetime(2024, 6, 21, 12, 0, tzinfo=UTC)
JUELICH = sun.Site(50.913421122592574, 6.387824755874856, 87.0, name="Jülich")
STELLENBOSCH = sun.Site(-33.93, 18.87, 120.0, name="Stellenbosch")
GOLDEN = sun.Site(39.742476, -105.1786, 1830.14, 82000.0, 11.0, "Golden", delta_t=67.0)
SEVILLE = sun.Site(37.44, -6.25, 60.0, name="Seville")
SOUTH = sun.Site(-35.0, 0.0, 0.0, delta_t=67.0)
SVALBARD = sun.Site(78.22, 15.65, 10.0, name="Longyearbyen")

DAYS = st.dates(date(1950, 1, 1), date(2100, 12, 31))
SITES = st.builds(
    sun.Site, st.floats(-60.0, 60.0), st.floats(-180.0, 180.0), st.floats(0.0, 4000.0)
)


def limb(moment: datetime | None, site: sun.Site) -> float:
    assert moment is not None
    return float(sun.position(moment, site).true_elevation)


# Positions


def test_example_of_the_spa_report() -> None:
    """Reda & Andreas, NREL/TP-560-34302, table A5.1, given to 1e-5 or 1e-6 degrees."""
    position = sun.position("2003-10-17T12:30:30-07:00", GOLDEN)
    assert np.degrees(position.azimuth) == pytest.approx(194.340241, abs=1e-6)
    assert np.degrees(position.elevation) == pytest.approx(90.0 - 50.111622, abs=1e-6)
    assert np.degrees(position.true_elevation) == pytest.approx(39.872046, abs=1e-6)


def test_vectors_point_along_the_angles() -> None:
    position = sun.position(NOON, JUELICH)
    assert position.vector == pytest.approx(direction(position.azimuth, position.elevation))
    assert np.array_equal(sun.vector(NOON, JUELICH), position.vector)
    assert np.array_equal(sun.vector(NOON, JUELICH, apparent=False), position.true_vector)
    # Half an hour after culmination the sun of the north stands high in the south-west.
    east, north, up = position.vector
    assert east < 0
    assert north < 0
    assert up > 0.8


def test_every_form_of_a_time_is_the_same_time() -> None:
    cest = timezone(timedelta(hours=2))
    index = pd.DatetimeIndex([NOON]).tz_convert("Africa/Johannesburg")
    expected = sun.position(NOON, JUELICH)
    scalars: list[Any] = [
        NOON.astimezone(cest),
        pd.Timestamp(NOON),
        "2024-06-21T14:00:00+02:00",
        "2024-06-21 12:00:00Z",
        NOON.timestamp(),
        int(NOON.timestamp()),
        np.float64(NOON.timestamp()),
    ]
    for times in scalars:
        position = sun.position(times, JUELICH)
        assert position.azimuth.shape == ()
        assert position.vector.shape == (3,)
        assert np.array_equal(position.vector, expected.vector), times
    lists: list[Any] = [
        [NOON],
        ["2024-06-21T12:00:00Z"],
        [NOON.timestamp()],
        index,
        index.to_series(),
        pd.Series(["2024-06-21T12:00:00Z"]),
        pd.Series([NOON.timestamp()]),
        np.array([NOON]),
    ]
    for times in lists:
        position = sun.position(times, JUELICH)
        assert position.elevation.shape == (1,)
        assert np.array_equal(position.vector, expected.vector[None]), times


def test_shape_follows_the_times() -> None:
    grid = NOON.timestamp() + 60.0 * np.arange(6.0).reshape(2, 3)
    position = sun.position(grid, JUELICH)
    assert position.azimuth.shape == position.elevation.shape == (2, 3)
    assert position.true_vector.shape == (2, 3, 3)
    nested: Any = [[datetime.fromtimestamp(t, UTC) for t in row] for row in grid.tolist()]
    assert np.array_equal(sun.vector(nested, JUELICH), position.vector)
    assert sun.vector(np.empty(0), JUELICH).shape == (0, 3)


def test_neither_chunks_nor_threads_change_a_digit(monkeypatch: pytest.MonkeyPatch) -> None:
    times = NOON.timestamp() + 1234.5 * np.arange(1000)
    whole = sun.position(times, JUELICH)
    monkeypatch.setattr(ephemeris, "_CHUNK", 96)
    for threads in ("1", "2", "5"):
        monkeypatch.setenv("HELIOTROPE_THREADS", threads)
        parts = sun.position(times, JUELICH)
        assert parts.vector == pytest.approx(whole.vector, abs=1e-15)
        if threads == "1":
            single = parts
        assert np.array_equal(parts.vector, single.vector)
        assert np.array_equal(parts.true_elevation, single.true_elevation)


# Refraction


@pytest.mark.parametrize(
    ("apparent_deg", "refraction_arcmin"), [(5, 9.9), (10, 5.3), (20, 2.6), (45, 1.0)]
)
def test_refraction_of_the_nautical_almanac(apparent_deg: float, refraction_arcmin: float) -> None:
    """Mean refraction at 1010 hPa and 10 °C; SPA's formula is within 0.2′ of the table."""
    site = sun.Site(40.0, 0.0, 0.0, pressure=101000.0, temperature_c=10.0)
    elevation = np.radians(apparent_deg)
    rising = sun.events("2024-06-21", site, elevation=elevation, apparent=True).sunrise
    assert rising is not None
    position = sun.position(rising, site)
    assert position.elevation == pytest.approx(elevation, abs=1e-7)
    refraction = np.degrees(position.elevation - position.true_elevation) * 60.0
    assert refraction == pytest.approx(refraction_arcmin, abs=0.2)


def test_ignored_refraction_costs_1_5_mrad_at_10_degrees() -> None:
    elevation = np.radians(10.0)
    rising = sun.events("2024-06-21", JUELICH, elevation=elevation, apparent=True).sunrise
    assert rising is not None
    position = sun.position(rising, JUELICH)
    error = angle_between(position.vector, position.true_vector)
    assert error == pytest.approx(1.5 * MRAD, abs=0.1 * MRAD)


@given(st.floats(5e4, 1.1e5), st.floats(-30.0, 45.0))
@settings(max_examples=20, deadline=None)
def test_refraction_grows_with_the_density_of_the_air(pressure: float, celsius: float) -> None:
    """Equation 42 of Reda & Andreas: proportional to P / (273 + T)."""
    norm = sun.Site(50.0, 6.0, 0.0, pressure=101000.0, temperature_c=10.0)
    site = sun.Site(50.0, 6.0, 0.0, pressure=pressure, temperature_c=celsius)
    low_sun = "2024-06-21T04:30:00Z"

    def refraction(place: sun.Site) -> float:
        position = sun.position(low_sun, place)
        return float(position.elevation - position.true_elevation)

    density = pressure / 101000.0 * 283.0 / (273.0 + celsius)
    assert refraction(site) == pytest.approx(density * refraction(norm), rel=1e-9)


def test_refraction_ends_below_the_horizon() -> None:
    night = sun.position(NOON.timestamp() + 60.0 * np.arange(1440), JUELICH)
    below = night.true_elevation < np.radians(-0.8334)
    assert 400 < below.sum() < 600
    assert np.array_equal(night.elevation[below], night.true_elevation[below])
    assert (night.elevation[~below] > night.true_elevation[~below]).all()


def test_pressure_of_a_site_follows_its_height() -> None:
    """ISO 2533, standard atmosphere: 898.76 hPa at 1,000 m of (geopotential) height."""
    assert sun.Site(0.0, 0.0, 0.0).air_pressure == pytest.approx(101325.0, rel=1e-4)
    assert sun.Site(0.0, 0.0, 1000.0).air_pressure == pytest.approx(89876.0, rel=1e-4)
    assert sun.Site(0.0, 0.0, 1000.0, pressure=90000.0).air_pressure == 90000.0


# Rise, culmination, set


@pytest.mark.parametrize(
    ("site", "day", "event", "published"),
    [
        (GOLDEN, "2003-10-17", "sunrise", "2003-10-17T13:12:43Z"),
        (GOLDEN, "2003-10-17", "culmination", "2003-10-17T18:46:05Z"),
        (GOLDEN, "2003-10-16", "sunset", "2003-10-17T00:20:19Z"),
        (GOLDEN, "2015-01-02", "sunrise", "2015-01-02T14:21:55Z"),
        (GOLDEN, "2015-01-02", "culmination", "2015-01-02T19:04:45Z"),
        (GOLDEN, "2015-01-02", "sunset", "2015-01-02T23:47:43Z"),
        (GOLDEN, "2015-08-02", "sunrise", "2015-08-02T12:00:27Z"),
        (GOLDEN, "2015-08-02", "culmination", "2015-08-02T19:06:58Z"),
        (GOLDEN, "2015-08-01", "sunset", "2015-08-02T02:13:58Z"),
        (SOUTH, "1996-07-05", "sunrise", "1996-07-05T07:08:15Z"),
        (SOUTH, "1996-07-05", "culmination", "1996-07-05T12:04:36Z"),
        (SOUTH, "1996-07-05", "sunset", "1996-07-05T17:01:04Z"),
        (SOUTH, "2004-12-04", "sunrise", "2004-12-04T04:38:57Z"),
        (SOUTH, "2004-12-04", "culmination", "2004-12-04T11:50:22Z"),
        (SOUTH, "2004-12-04", "sunset", "2004-12-04T19:02:03Z"),
    ],
)
def test_published_events(site: sun.Site, day: str, event: str, published: str) -> None:
    """The report of SPA (2003) and NREL's calculator, given to 1 s.

    They list the sunset that falls into the UTC day: at Golden that of the day before.
    """
    moment: datetime = getattr(sun.events(day, site), event)
    assert abs((moment - datetime.fromisoformat(published)).total_seconds()) < 2.0


# The solar days of these sites lie within UTC days, as pvlib's method asks.
@pytest.mark.parametrize("site", [JUELICH, STELLENBOSCH, SEVILLE], ids=lambda site: site.name)
def test_events_beside_pvlib(site: sun.Site) -> None:
    days = pd.date_range("2023-01-15", periods=12, freq="30D", tz="UTC")
    theirs = solarposition.sun_rise_set_transit_spa(
        days, site.latitude_deg, site.longitude_deg, delta_t=None
    )
    for day, row in zip(days, theirs.itertuples(), strict=True):
        ours = sun.events(day.date(), site)
        assert ours.sunrise is not None
        assert ours.sunset is not None
        assert abs((ours.sunrise - row.sunrise).total_seconds()) < 2.0, day
        assert abs((ours.sunset - row.sunset).total_seconds()) < 2.0, day
        assert abs((ours.culmination - row.transit).total_seconds()) < 0.5, day


@given(DAYS, SITES)
@settings(max_examples=40, deadline=None)
def test_a_day_between_the_polar_circles(day: date, site: sun.Site) -> None:
    found = sun.events(day, site)
    assert found.kind == "normal"
    assert found.sunrise is not None
    assert found.sunset is not None
    assert found.sunrise < found.culmination < found.sunset
    assert found.sunset - found.sunrise < timedelta(days=1)
    assert limb(found.sunrise, site) == pytest.approx(sun.UPPER_LIMB, abs=1e-7)
    assert limb(found.sunset, site) == pytest.approx(sun.UPPER_LIMB, abs=1e-7)

    # The declination changes by δ' < 0.4° a day, so the highest point lies beside the
    # meridian, by δ'²/2k above it, with k = ω² cos φ cos δ / cos e: 1.5 µrad at most.
    hours = found.culmination.timestamp() + np.linspace(-12.0, 12.0, 193) * 3600.0
    around = found.culmination.timestamp() + np.linspace(-200.0, 200.0, 101)
    elevations = sun.position(np.concatenate([hours, around]), site).elevation
    assert elevations.max() <= found.culmination_elevation + 1.5e-6

    at_culmination = sun.vector(found.culmination, site)
    assert abs(at_culmination[0]) < 1e-7


@given(DAYS, SITES, st.floats(0.0, 0.35))
@settings(max_examples=25, deadline=None)
def test_daylight_lies_between_the_events(day: date, site: sun.Site, lowest: float) -> None:
    every = timedelta(minutes=7)
    index = sun.daylight(day, site, every=every, min_elevation=lowest)
    found = sun.events(day, site, elevation=lowest, apparent=True)
    if found.kind == "polar night":
        assert len(index) == 0
        return
    assert found.sunrise is not None
    assert found.sunset is not None
    assert index.tz is UTC or str(index.tz) == "UTC"
    assert timedelta(0) <= index[0] - found.sunrise <= every
    assert timedelta(0) <= found.sunset - index[-1] <= every
    assert (np.diff(index) == np.timedelta64(every)).all()
    assert (sun.position(index, site).elevation >= lowest).all()
    assert all(stamp.timestamp() % every.total_seconds() == 0 for stamp in index)


def test_days_follow_each_other_without_gap() -> None:
    days = [date(2024, 6, 19) + timedelta(days=k) for k in range(4)]
    parts = [sun.daylight(day, SVALBARD, every=timedelta(minutes=10)) for day in days]
    assert [len(part) for part in parts] == [144] * 4
    joined = parts[0].append(parts[1:])
    assert (np.diff(joined) == np.timedelta64(10, "m")).all()


def test_a_solar_day_at_the_date_line() -> None:
    east = sun.events("2024-03-02", sun.Site(-17.0, 180.0, 0.0))
    west = sun.events("2024-03-01", sun.Site(-17.0, -180.0, 0.0))
    assert east.sunrise is not None
    assert west.sunrise is not None
    assert abs(east.sunrise - west.sunrise) < timedelta(milliseconds=5)
    assert abs(east.culmination - west.culmination) < timedelta(milliseconds=5)
    assert east.culmination.date() == date(2024, 3, 2)
    assert east.sunrise.date() == date(2024, 3, 1)


def test_polar_day_and_night() -> None:
    summer = sun.events("2024-06-21", SVALBARD)
    assert (summer.kind, summer.sunrise, summer.sunset) == ("polar day", None, None)
    assert np.degrees(summer.culmination_elevation) == pytest.approx(90 - 78.22 + 23.44, abs=0.05)
    winter = sun.events("2024-12-21", SVALBARD)
    assert (winter.kind, winter.sunrise, winter.sunset) == ("polar night", None, None)
    assert len(sun.daylight("2024-12-21", SVALBARD)) == 0
    for pole, kind in [(90.0, "polar day"), (-90.0, "polar night")]:
        assert sun.events("2024-06-21", sun.Site(pole, 0.0, 0.0)).kind == kind


def test_the_first_polar_day_has_a_sunrise_only() -> None:
    april = [sun.events(date(2024, 4, d), SVALBARD) for d in range(10, 26)]
    kinds = [found.kind for found in april]
    first = kinds.index("polar day")
    assert kinds == ["normal"] * first + ["polar day"] * (len(kinds) - first)
    assert april[first].sunrise is not None
    assert april[first].sunset is None
    assert all(found.sunrise is None for found in april[first + 1 :])


def test_sunrise_in_air_that_skips_the_horizon() -> None:
    """At 1,080 hPa and −60 °C refraction sets in with more than the sun lacks to 0."""
    siberia = sun.Site(62.0, 130.0, 100.0, pressure=108000.0, temperature_c=-60.0)
    found = sun.events("2024-02-10", siberia, elevation=0.0, apparent=True)
    assert found.sunrise is not None
    before, after = sun.position(
        [found.sunrise - timedelta(seconds=1), found.sunrise + timedelta(seconds=1)], siberia
    ).elevation
    assert before < 0.0 < after


# Refusals


@pytest.mark.parametrize(
    ("times", "text"),
    [
        (NOON.replace(tzinfo=None), r"times: 2024-06-21 12:00:00 has no time zone; add one"),
        ([NOON, NOON.replace(tzinfo=None)], r"times\[1\]: 2024-06-21 12:00:00 has no time zone"),
        ("2024-06-21T12:00:00", "has no time zone; add one, for example tzinfo=datetime.UTC"),
        ("2024-06-21", "times: 2024-06-21 00:00:00 has no time zone"),
        (np.array(["2024-06-21T12"], "datetime64[s]"), r"datetime64\[s\] has no time zone"),
        (pd.DatetimeIndex(["2024-06-21"]), r"has no time zone; specify one.*tz_localize"),
        (pd.Series(pd.to_datetime(["2024-06-21"])), r"has no time zone; specify one"),
        ([NOON, pd.NaT], r"times\[1\]: NaT is not a time"),
        (pd.DatetimeIndex([NOON, pd.NaT]), r"times\[1\]: NaT is not a time"),
        (np.datetime64("NaT"), "datetime64 has no time zone"),
        ([[0.0, np.nan]], r"times\[0, 1\]: nan is not a time"),
        (np.inf, "times: inf is not a time"),
        (None, "times: None is not a time; pass an aware datetime"),
        ([True], r"times\[0\]: True is not a time"),
        (date(2024, 6, 21), "times: 2024-06-21 is not a time"),
        ("noon", "times: 'noon' is not an ISO 8601 time; write it like 2024-06-21T12:00"),
        ([[1.0, 2.0], [3.0]], "times: its lists differ in length"),
        (1.7e12, "times: 1700000000000 s since 1970 is outside the years -2000 to 6000"),
        ([0.0, -1.3e11], r"times\[1\]: -130000000000 s since 1970 is outside .* validity of SPA"),
        (6.4e10, r"outside the years -1999 to 3000, the known ΔT; pass Site\(delta_t=...\)"),
    ],
)
def test_refused_times(times: Any, text: str) -> None:
    with pytest.raises(TimeError, match=text):
        sun.position(times, JUELICH)


def test_a_given_delta_t_opens_the_years_of_spa() -> None:
    site = sun.Site(30.0, 0.0, 0.0, delta_t=4000.0)
    first, last = (
        float(np.datetime64(text, "s").astype(np.int64))
        for text in ("-2000-01-01", "6000-12-31T23:59:59")
    )
    assert np.isfinite(sun.vector([first, last], site)).all()
    for outside in (first - 1.0, last + 1.0):
        with pytest.raises(TimeError, match="outside the years -2000 to 6000"):
            sun.position(outside, site)


def test_delta_t_is_espenak_and_meeus() -> None:
    """Their polynomial for 2005 to 2050, given for 2010: 66.7 s (observed: 66.07 s)."""
    moment = "2010-01-15T12:00:00Z"
    given = sun.Site(50.0, 6.0, 0.0, delta_t=66.7)
    assert sun.vector(moment, sun.Site(50.0, 6.0, 0.0)) == pytest.approx(
        sun.vector(moment, given), abs=1e-8
    )
    other = sun.Site(50.0, 6.0, 0.0, delta_t=66.7 + 30.0)
    assert angle_between(sun.vector(moment, given), sun.vector(moment, other)) > 1e-6


@pytest.mark.parametrize("site", [STELLENBOSCH, JUELICH, sun.Site(0.0, -120.0, 0.0)])
def test_grena_keeps_his_accuracy_over_his_twenty_years(site: sun.Site) -> None:
    """Grena 2008: ±0.0027°, 2003 to 2022; SPA's own error is a ninth of that."""
    rng = np.random.default_rng(2008)
    seconds = rng.uniform(grena.FIRST, grena.LAST, 20_000)
    his = sun.position(seconds, site, algorithm="grena2008")
    spa = sun.position(seconds, site)
    up = spa.true_elevation > 0.0
    apart = np.degrees(angle_between(his.true_vector, spa.true_vector))
    assert apart[up].max() < 0.0027
    # A wrong coefficient would show: his errors are of this size, not smaller.
    assert apart[up].max() > 0.0015
    # His refraction is within his accuracy of SPA's from 1° upwards.
    high = spa.elevation > np.radians(1.0)
    assert np.degrees(angle_between(his.vector, spa.vector))[high].max() < 0.0027


@pytest.mark.parametrize("time", ["2002-12-31T23:59:59Z", "2023-01-01T00:00:00Z", NOON])
def test_grena_is_refused_outside_his_years(time: Any) -> None:
    with pytest.raises(InputError, match="outside its validity, 2003 to 2022"):
        sun.position(time, JUELICH, algorithm="grena2008")


def test_grena_agrees_on_malans_days() -> None:
    times = [
        datetime(2012, 9, day, hour, tzinfo=UTC) for day in (2, 6, 7, 8) for hour in range(5, 16)
    ]
    his = sun.position(times, STELLENBOSCH, algorithm="grena2008").vector
    assert angle_between(his, sun.vector(times, STELLENBOSCH)).max() < 0.047 * MRAD


def test_unknown_algorithm_is_refused() -> None:
    with pytest.raises(UnknownNameError, match="no sun algorithm 'psa'; did you mean spa"):
        sun.position(NOON, JUELICH, algorithm="psa")


@pytest.mark.parametrize(
    ("field", "value", "text"),
    [
        ("latitude_deg", 90.1, "latitude_deg = 90.1 ° is not a number from -90 to 90 °"),
        ("latitude_deg", float("nan"), "latitude_deg = nan °"),
        ("latitude_deg", "50N", "latitude_deg = 50N ° is not a number"),
        ("longitude_deg", 186.4, "longitude_deg = 186.4 ° .* east is positive"),
        ("longitude_deg", True, "longitude_deg = True °"),
        ("height", float("inf"), "height = inf m"),
        ("height", 87000, "height = 87000 m is not a number from -500 to 9000 m"),
        ("height", None, "height = None m"),
        ("pressure", 1013.25, r"pressure = 1013.25 Pa .* use pascals \(1 hPa is 100 Pa\)"),
        ("temperature_c", 285.0, "temperature_c = 285.0 °C .* use degrees Celsius"),
        ("delta_t", 1e5, "delta_t = 100000.0 s .* TT − UT1 in seconds"),
    ],
)
def test_refused_sites(field: str, value: Any, text: str) -> None:
    arguments: dict[str, Any] = {
        "latitude_deg": 50.9,
        "longitude_deg": 6.4,
        "height": 87.0,
        "name": "Jülich",
    }
    with pytest.raises(InputError, match=f"site 'Jülich': {text}"):
        sun.Site(**{**arguments, field: value})


def test_origin_of_a_site() -> None:
    assert STELLENBOSCH.origin == (-33.93, 18.87, 120.0)


@pytest.mark.parametrize(
    ("day", "text"),
    [
        (NOON, "is not a date; pass a datetime.date or an ISO date"),
        (20240621, "day: 20240621 is not a date"),
        ("21.6.2024", "day: '21.6.2024' is not an ISO 8601 date like 2024-06-21"),
        (date.min, "day: 0001-01-01 begins before the range"),
        (date(3001, 1, 2), "outside the years -1999 to 3000"),
    ],
)
def test_refused_days(day: Any, text: str) -> None:
    with pytest.raises(TimeError, match=text):
        sun.events(day, JUELICH)
    with pytest.raises(TimeError, match=text):
        sun.daylight(day, JUELICH)


def test_refused_elevations() -> None:
    with pytest.raises(InputError, match=r"elevation: 5\.0 rad is not within .* numpy.radians"):
        sun.events("2024-06-21", JUELICH, elevation=5.0)
    with pytest.raises(InputError, match="elevation: nan rad is not within"):
        sun.events("2024-06-21", JUELICH, elevation=float("nan"), apparent=True)
    with pytest.raises(InputError, match=r"-0\.01 rad is below the horizon, where the apparent"):
        sun.events("2024-06-21", JUELICH, elevation=-0.01, apparent=True)
    with pytest.raises(InputError, match=r"min_elevation: -5\.0 rad is not within"):
        sun.daylight("2024-06-21", JUELICH, min_elevation=-5.0)


@pytest.mark.parametrize("every", [timedelta(0), timedelta(seconds=-60), timedelta(days=2)])
def test_refused_steps(every: timedelta) -> None:
    with pytest.raises(InputError, match=r"every must be between 0\.1 s and 1 day"):
        sun.daylight("2024-06-21", JUELICH, every=every)


def test_the_import_is_light() -> None:
    code = "import sys, heliotrope.sun; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    modules = loaded.stdout.split()
    assert "heliotrope.sun" in modules
    assert not {"pandas", "pvlib", "scipy", "matplotlib", "pymap3d"} & set(modules)


# Measurements


def test_stored_sun_of_the_juelich_measurements() -> None:
    """Every stored sun stands where we put it at the stored time, within 0.1 mrad.

    The times are whole seconds and the sun moves 0.07 mrad a second. Ten rows have no
    time; the time of one is 7 s beside its sun.
    """
    table = pd.read_csv(data.juelich() / "measurements.csv")
    table = table[table["timestamp"].notna()]
    azimuth = np.pi - np.radians(table["sun_azimuth_deg_south0_east"].to_numpy())
    elevation = np.radians(table["sun_elevation_deg_apparent"].to_numpy())
    position = sun.position(table["timestamp"], JUELICH)
    error = angle_between(position.vector, direction(azimuth, elevation))

    assert len(table) == 1862
    assert table["id"][error > 0.1 * MRAD].tolist() == [239257]
    assert np.median(error) < 0.04 * MRAD
    lifted = elevation - position.elevation
    assert abs(np.median(lifted)) < 0.005 * MRAD
    assert np.abs(np.percentile(lifted, [5, 95])).max() < 0.03 * MRAD


def test_measurements_are_skipped_or_asked_for(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(data, "_REPOSITORY", tmp_path / "repository")
    monkeypatch.delenv("HELIOTROPE_DATA", raising=False)
    with pytest.raises(pytest.skip.Exception, match="set HELIOTROPE_DATA to their folder"):
        data.juelich()
    monkeypatch.setenv("HELIOTROPE_DATA", str(tmp_path))
    with pytest.raises(pytest.fail.Exception, match=r"there is no measurements\.csv in it"):
        data.juelich()
    (tmp_path / "measurements.csv").touch()
    assert data.juelich() == tmp_path


# The sun as clusters broadcast it


@pytest.mark.parametrize("begin", [1782036000.0, 1798000000.0])  # a day of June, one of December
def test_the_sun_between_its_knots_is_that_of_spa(begin: float) -> None:
    times = begin + np.random.default_rng(7).uniform(0.0, 86400.0, 120)
    exact = sun.vector(times, SEVILLE)
    up = exact[:, 2] > sun.LOWEST_BROADCAST + 1e-3
    assert 30 < up.sum() < 110
    later = sun.vector(times + 1.0, SEVILLE)
    for time, vector, there in zip(times[up], exact[up], later[up], strict=True):
        here, rate = sun.vector_and_rate(float(time), SEVILLE)
        assert np.linalg.norm(np.subtract(here, vector)) < 0.01 * URAD
        assert abs(math.hypot(*here) - 1.0) < 1e-9
        assert np.linalg.norm(np.add(here, rate) - there) < 0.1 * URAD
        assert sun.fast_vector(float(time), SEVILLE) == pytest.approx(vector, abs=1e-8)
    night = float(times[np.argmin(exact[:, 2])])
    assert (sun.fast_vector(night, SEVILLE) == sun.vector(night, SEVILLE)).all()


def test_sun_on_the_wire_is_within_a_nanoradian_and_none_is_sent_at_night() -> None:
    noon = 1782043200.0
    values = sun.broadcast_values(1_466_078_418, noon, SEVILLE)
    assert values is not None
    assert values[0] == 1_466_078_418
    vector = np.array(values[1:4]) / 2**30
    assert np.linalg.norm(vector - sun.vector(noon, SEVILLE)) < 2e-9
    ahead = vector + np.array(values[4:7]) / 2**28
    assert np.linalg.norm(ahead - sun.vector(noon + 1.0, SEVILLE)) < 1e-8
    assert wire.pack("SUN", *values)
    assert sun.broadcast_values(1, noon + 43200.0, SEVILLE) is None
    assert sun.broadcast_values(1, noon, sun.Site(-89.0, 0.0, 2800.0)) is None  # the polar night
