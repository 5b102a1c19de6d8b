"""The table of leap seconds, by the leap-seconds.list of the IERS."""

from datetime import UTC, datetime, timedelta

import pytest

from heliotrope.errors import InputError
from heliotrope.links.clock import GPS_EPOCH, LEAP_SECONDS, gps_seconds, gps_week, utc_of_week

#: NTP seconds (since 1900) of the leaps since GPS began, and TAI minus UTC from then on, as the
#: list has them.
LIST = """
2571782400 20
2603318400 21
2634854400 22
2698012800 23
2776982400 24
2840140800 25
2871676800 26
2918937600 27
2950473600 28
2982009600 29
3029443200 30
3076704000 31
3124137600 32
3345062400 33
3439756800 34
3550089600 35
3644697600 36
3692217600 37
"""
NTP_EPOCH = datetime(1900, 1, 1, tzinfo=UTC)
#: TAI minus GPS, s.
TAI_GPS = 19
LEAPS = [tuple(map(int, line.split())) for line in LIST.split("\n") if line]


def test_the_table_is_that_of_the_iers() -> None:
    found = [(NTP_EPOCH + timedelta(seconds=at), tai - TAI_GPS) for at, tai in LEAPS]
    assert ((GPS_EPOCH, 0), *found) == LEAP_SECONDS


@pytest.mark.parametrize(("at", "tai"), LEAPS)
def test_gps_goes_on_where_utc_has_a_leap_second(at: int, tai: int) -> None:
    begin = NTP_EPOCH + timedelta(seconds=at)
    assert gps_seconds(begin) == (begin - GPS_EPOCH).total_seconds() + tai - TAI_GPS
    assert gps_seconds(begin) - gps_seconds(begin - timedelta(seconds=1)) == 2


@pytest.mark.parametrize("years", [0.0, 5.0, 19.0, 21.5, 38.0, 46.9])
def test_a_week_of_ten_bits_is_the_first_that_is_not_before_a_known_time(years: float) -> None:
    utc = datetime(1980, 1, 9, 3, 4, 5, 678_000, tzinfo=UTC) + timedelta(days=365.25 * years)
    week, ms = gps_week(utc)
    at = timedelta(weeks=week, milliseconds=ms).total_seconds()
    assert at == pytest.approx(gps_seconds(utc), abs=1e-3)
    assert utc_of_week(week, ms, GPS_EPOCH) == utc
    for before in (timedelta(0), timedelta(days=1), timedelta(weeks=1023)):
        assert utc_of_week(week % 1024, ms, max(GPS_EPOCH, utc - before)) == utc
    later = utc_of_week(week % 1024, ms, utc + timedelta(seconds=1))
    assert gps_seconds(later) - gps_seconds(utc) == 1024 * 7 * 86_400


@pytest.mark.parametrize(("week", "ms"), [(-1, 0), (0, -1), (0, 604_800_000)])
def test_a_time_outside_its_week_is_refused(week: int, ms: int) -> None:
    with pytest.raises(InputError, match=f"GPS week {week}, {ms} ms"):
        utc_of_week(week, ms, GPS_EPOCH)


def test_a_week_ends_a_millisecond_before_the_next() -> None:
    assert utc_of_week(0, 0, GPS_EPOCH) == GPS_EPOCH
    end = GPS_EPOCH + timedelta(weeks=1)
    assert utc_of_week(0, 604_799_999, GPS_EPOCH) == end - timedelta(milliseconds=1)
