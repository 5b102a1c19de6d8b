"""The table of leap seconds, by the leap-seconds.list of the IERS."""

from datetime import UTC, datetime, timedelta

import pytest

from heliotrope.links.clock import GPS_EPOCH, LEAP_SECONDS, gps_seconds

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
