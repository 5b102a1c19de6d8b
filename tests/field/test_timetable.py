"""The timetable of calibrations: when entries are due, what cannot be, and the plant file."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from heliotrope.errors import FormatError, HeliotropeError, InputError, UnknownNameError
from heliotrope.field.formats.plant_file import check_plant, read_plant, write_plant
from heliotrope.field.layouts import malan_plant
from heliotrope.field.plant import Plant
from heliotrope.field.timetable import MOST, TimetableEntry, check_timetable

NOON = datetime(2026, 6, 21, 12, tzinfo=UTC).timestamp()
HOUR = 3600.0


def at(*times: str, every: float | None = None) -> TimetableEntry:
    return TimetableEntry("e", ("A",), "", times, every)


def test_times_of_day_are_those_of_their_zone() -> None:
    entry = at("08:30Z", "14:00+02:00", "23:30-01:00")
    # 23:30 an hour west of Greenwich is half past midnight UTC.
    assert entry.seconds.tolist() == [0.5 * HOUR, 8.5 * HOUR, 12.0 * HOUR]
    assert entry.next(NOON) == NOON + 12.5 * HOUR
    assert entry.next(NOON - 1.0) == NOON


def test_an_interval_counts_from_midnight() -> None:
    entry = at(every=5.0 * HOUR)
    assert entry.next(NOON) == NOON + 3.0 * HOUR
    # 20:00 is the last of the day: the next is midnight, not 01:00.
    assert entry.next(NOON + 8.0 * HOUR) == NOON + 12.0 * HOUR


def test_both_are_due_and_a_common_time_is_due_once() -> None:
    entry = at("12:00Z", "12:20Z", every=HOUR)
    times, time = [], NOON - 1.0
    while time < NOON + HOUR:
        time = entry.next(time)
        times.append(time - NOON)
    assert times == [0.0, 20.0 * 60.0, HOUR]


@given(
    every=st.integers(60, 86_400),
    minutes=st.lists(st.integers(0, 1439), max_size=4),
    beat=st.floats(0.5, 50_000.0),
    begin=st.floats(0.0, 86_400.0),
)
def test_no_time_is_missed_or_taken_twice(
    every: int, minutes: list[int], beat: float, begin: float
) -> None:
    """However often it is asked, each time is due in exactly one of the steps."""
    entry = at(*(f"{m // 60:02d}:{m % 60:02d}Z" for m in minutes), every=float(every))
    since, due = NOON + begin, []
    for _ in range(20):
        expected, after = 0, since
        while (after := entry.next(after)) <= since + beat:
            expected += 1
        due.append(entry.due(since, since + beat))
        assert due[-1] == (expected > 0)
        since += beat


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"heliostats": ()}, "needs a name and at least one heliostat"),
        ({"name": ""}, "needs a name"),
        ({"heliostats": ("A", "B", "A")}, "heliostat A is listed twice"),
        ({"at": ()}, "no time is set; specify times of day"),
        ({"at": ("8:30",)}, "'8:30' is not a time of day; write 08:30Z"),
        ({"at": ("25:00Z",)}, "'25:00Z' is not a time of day"),
        ({"at": ("08:30",)}, "'08:30' has no time zone; write 08:30Z for UTC"),
        ({"at": ("08:30Z",) * 97}, "97 times of day; at most 96"),
        ({"every": 30.0}, "interval must be between 60 and 86400 s, not 30 s"),
        ({"every": float("nan")}, "interval must be between 60 and 86400 s, not nan s"),
    ],
)
def test_entries_that_cannot_be(values: dict[str, Any], text: str) -> None:
    usual: dict[str, Any] = {"name": "e", "heliostats": ("A",), "at": ("08:30Z",)}
    with pytest.raises(InputError, match=text.replace("(", r"\(")):
        TimetableEntry(**{**usual, **values})


def test_a_timetable_names_what_the_plant_has() -> None:
    entry = at("12:00Z")
    check_timetable([entry, replace(entry, name="f", target="left")], ["A"], ["left"])
    wrong: list[tuple[list[TimetableEntry], type[HeliotropeError], str]] = [
        ([replace(entry, heliostats=("B",))], UnknownNameError, "there is no heliostat 'B'"),
        ([replace(entry, target="lefd")], UnknownNameError, "did you mean left"),
        ([entry, replace(entry, name="E")], InputError, "timetable entry"),
        ([replace(entry, name=f"e{k}") for k in range(MOST + 1)], InputError, "at most 100"),
    ]
    for entries, kind, text in wrong:
        with pytest.raises(kind, match=text):
            check_timetable(entries, ["A"], ["left"])


# --- the plant file -------------------------------------------------------------------


def timed() -> Plant:
    entries = (
        TimetableEntry("noon", ("P0001B", "P0001A"), "left", ("12:00Z", "13:30+02:00")),
        TimetableEntry("hourly", ("P0001C",), every=3600.0),
    )
    return replace(malan_plant(6), timetable=entries)


def test_a_timetable_is_written_and_read(tmp_path: Path) -> None:
    write_plant(timed(), tmp_path / "plant.toml")
    assert read_plant(tmp_path / "plant.toml").timetable == timed().timetable
    assert "timetable" not in (tmp_path / "plant.toml").read_text().split("[[timetable]]")[0]
    write_plant(malan_plant(6), tmp_path / "none.toml")
    assert "timetable" not in (tmp_path / "none.toml").read_text()


@pytest.mark.parametrize(
    ("before", "after", "text"),
    [
        ('"12:00Z"', '"12:00"', "timetable[0]: timetable entry 'noon': '12:00' has no time zone"),
        ("P0001C", "P0009C", "there is no heliostat 'P0009C'"),
        ("every_s = 3600.0", "every = 3600.0", "timetable.1.every"),
        ("every_s = 3600.0", "every_s = 1", "interval must be between 60 and 86400 s, not 1 s"),
    ],
)
def test_a_file_with_a_wrong_timetable_is_one_line(
    before: str, after: str, text: str, tmp_path: Path
) -> None:
    path = tmp_path / "plant.toml"
    write_plant(timed(), path)
    written = path.read_text(encoding="utf-8")
    assert written.count(before) == 1
    path.write_text(written.replace(before, after), encoding="utf-8")
    with pytest.raises(FormatError) as caught:
        read_plant(path)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)
    assert [f.text for f in check_plant(path)] == [str(caught.value)]
