"""Sentences of a receiver, whole, cut, damaged and made up."""

from datetime import UTC, datetime, timedelta

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from heliotrope.cluster.nmea import NmeaReader, Report
from heliotrope.cluster.timekeeping import NOT_BEFORE
from support.nmea_talk import gga, rmc, sentence, zda

T = datetime(2026, 6, 21, 10, 0, 0, 250000, tzinfo=UTC)
TIMES = st.integers(0, 44 * 365 * 86400 * 100).map(
    lambda hundredths: NOT_BEFORE + timedelta(milliseconds=10 * hundredths)
)


def read(data: bytes, reader: NmeaReader | None = None) -> list[Report]:
    return [report for report, _ in (reader or NmeaReader()).feed(data, 0.0)]


@given(TIMES)
@settings(max_examples=50, deadline=None)
def test_a_time_comes_out_as_it_went_in(utc: datetime) -> None:
    assert read(rmc(utc)) == [Report(utc, fix=True)]
    assert read(gga(utc) + zda(utc)) == [Report(None, fix=True), Report(utc, fix=True)]


def test_sentences_of_the_standard_as_receivers_send_them() -> None:
    # The examples that the manuals of u-blox (M8, 31.2.18 and 31.2.24) and of SiRF print.
    (report,) = read(
        b"$GPRMC,083559.00,A,4717.11437,N,00833.91522,E,0.004,77.52,091202,,,A,V*2D\r\n"
    )
    # 2002 in a receiver of today: a rollover of 1024 weeks later it is July 2022, then 2042.
    assert report.rolled
    assert report.utc == datetime(2002, 12, 9, 8, 35, 59, tzinfo=UTC) + 2 * timedelta(weeks=1024)
    (report,) = read(b"$GPZDA,082710.00,16,09,2002,00,00*64\r\n")
    assert not report.fix


@pytest.mark.parametrize(
    "data",
    [
        rmc(T, "V"),
        rmc(T, mode="E"),
        rmc(T, mode="S"),
        rmc(T, mode="M"),
        rmc(T, "V", "N"),
        zda(T),
        gga(T, 0) + zda(T),
        gga(T, 6) + zda(T),
        gga(T, 8) + rmc(T),
        rmc(T, "V") + zda(T),
        rmc(T) + zda(T + timedelta(seconds=3)),
        gga(T) + rmc(T, "V") + zda(T),
        sentence("GPRMC,,V,,,,,,,,,,N"),
        sentence("GPGGA,100000.00,,,,,0,00,,,M,,M,,"),
    ],
)
def test_without_a_fix_there_is_no_time(data: bytes) -> None:
    assert not any(report.fix for report in read(data)[-1:])


@pytest.mark.parametrize(
    "body",
    [
        "GPRMC,100000.00,A,,,,,,,,,,A",  # no date
        "GPRMC,100000.00,A,,,,,,,310226,,,A",  # 31 February
        "GPRMC,235960.00,A,,,,,,,310626,,,A",  # a leap second
        "GPRMC,250000.00,A,,,,,,,210626,,,A",
        "GPRMC,10000.00,A,,,,,,,210626,,,A",
        "GPRMC,100000.0000000,A,,,,,,,210626,,,A",
        "GPRMC",
        "GPZDA,100000.00,00,00,0000,00,00",
        "GPZDA,100000.00,21,06",
        "GPZDA,100000.00,21,06,1979,00,00",
        "GPZDA,100000.00,21,06,2100,00,00",
        "GPZDA,100000.00,31,12,9999,00,00",
        "GPZDA,100000.00,21,06,20260,00,00",
    ],
)
def test_values_that_are_no_time_are_none(body: str) -> None:
    reader = NmeaReader()
    assert not any(report.fix or report.utc for report in read(gga(T) + sentence(body), reader)[1:])


def test_the_time_of_midnight_is_that_of_the_new_day() -> None:
    late = datetime(2026, 12, 31, 23, 59, 59, tzinfo=UTC)
    reports = read(gga(late) + zda(late) + zda(late + timedelta(seconds=1)))
    assert [report.utc for report in reports[1:]] == [late, late + timedelta(seconds=1)]
    assert all(report.fix for report in reports)


@pytest.mark.parametrize("rolls", [1, 2])
def test_a_date_from_before_a_rollover_is_carried_over(rolls: int) -> None:
    sent = T - rolls * timedelta(weeks=1024)
    if sent.year >= 2000:  # two digits of a year tell no century
        assert read(rmc(sent)) == [Report(T, fix=True, rolled=True)]
    assert read(gga(sent) + zda(sent))[1] == Report(T, fix=True, rolled=True)
    assert read(rmc(NOT_BEFORE)) == [Report(NOT_BEFORE, fix=True)]


@given(st.lists(st.integers(1, 60), max_size=20), st.binary(max_size=40))
@settings(max_examples=50, deadline=None)
def test_the_cuts_do_not_matter_and_rubbish_before_costs_nothing(
    cuts: list[int], rubbish: bytes
) -> None:
    rubbish = rubbish.replace(b"$", b"")
    data = rubbish + gga(T) + sentence("GPGSV,1,1,00") + zda(T) + rmc(T + timedelta(seconds=1))
    reader, reports, place = NmeaReader(), [], 0
    for cut in [*cuts, len(data)]:
        reports += read(data[place : place + cut], reader)
        place += cut
    assert [report.utc for report in reports if report.fix] == [None, T, T + timedelta(seconds=1)]
    assert (reader.damaged, reader.sentences, reader.received) == (0, 3, len(data))


@given(st.binary(max_size=300))
@settings(max_examples=300, deadline=None)
def test_rubbish_is_no_time_and_no_error(data: bytes) -> None:
    assert not read(data)


_BODY = st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=60)


@given(st.sampled_from(["GPRMC", "GNZDA", "GPGGA", "QQGGA"]), _BODY)
@settings(max_examples=300, deadline=None)
def test_any_values_under_a_good_checksum_are_no_error(kind: str, values: str) -> None:
    for report in read(sentence(f"{kind},{values}")):
        assert report.utc is None or report.utc >= NOT_BEFORE


@given(st.sampled_from([rmc(T), gga(T), zda(T)]), st.data())
@settings(max_examples=300, deadline=None)
def test_one_damaged_byte_never_makes_another_time(good: bytes, draw: st.DataObject) -> None:
    place = draw.draw(st.integers(0, len(good) - 3))
    byte = draw.draw(st.integers(0, 255).filter(lambda value: value != good[place]))
    bad = good[:place] + bytes([byte]) + good[place + 1 :]
    expected = read(good)
    # A small letter in the checksum is the same checksum.
    assert read(bad) in ([], expected)


def test_a_sentence_without_an_end_is_not_kept_for_ever() -> None:
    reader = NmeaReader()
    for _ in range(1000):
        assert not read(b"$GPRMC" + b"9" * 50, reader)
        assert not read(b"9" * 100, reader)
    assert len(reader._line) < 200
    assert reader.damaged == 1000
    assert read(b"\r\n" + rmc(T), reader) == [Report(T, fix=True)]


def test_the_instant_is_that_of_the_first_byte() -> None:
    reader, data = NmeaReader(), rmc(T)
    assert reader.feed(b"rest\r\n" + data[:5], 7.0) == []
    assert reader.feed(data[5:20], 7.5) == []
    assert reader.feed(data[20:-1], 8.0) == [(Report(T, fix=True), 7.0)]
    assert reader.feed(data[-1:] + data, 9.0) == [(Report(T, fix=True), 9.0)]
