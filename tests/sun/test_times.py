"""One reader of times: every kind is taken with its zone or refused, wherever times are given."""

import functools
import types
from collections.abc import Callable
from datetime import UTC, date, datetime, timedelta, timezone
from typing import Any

import numpy as np
import pandas as pd
import pytest

from heliotrope import sun
from heliotrope.airborne.evaluate.sightings import to_sightings
from heliotrope.calibration.learn.learned import Learned
from heliotrope.calibration.sightings import camera_target, sightings
from heliotrope.errors import TimeError

NOON = datetime(2024, 6, 21, 12, tzinfo=UTC)
SECONDS = 1718971200.0
SITE = sun.Site(50.9, 6.4, 87.0)

GOOD: list[Any] = [
    NOON,
    NOON.astimezone(timezone(timedelta(hours=2))),
    "2024-06-21T12:00:00Z",
    "2024-06-21T14:00:00+02:00",
    SECONDS,
    int(SECONDS),
    np.float64(SECONDS),
    np.int64(SECONDS),
    pd.Timestamp(NOON),
    [NOON, NOON],
    ["2024-06-21T12:00:00Z", NOON, SECONDS],
    np.array([SECONDS, SECONDS]),
    np.array([NOON, NOON]),
    pd.DatetimeIndex([NOON, NOON]),
    pd.Series([NOON, NOON]),
    pd.Series([SECONDS, SECONDS]),
]
BAD: list[tuple[Any, str]] = [
    (NOON.replace(tzinfo=None), "has no time zone"),
    ("2024-06-21T12:00:00", "has no time zone"),
    ("noon", "is not an ISO 8601 time"),
    (date(2024, 6, 21), "is not a time"),
    (None, "is not a time"),
    (pd.NaT, "is not a time"),
    (np.datetime64("NaT"), "has no time zone"),
    (np.array(["2024-06-21T12"], "datetime64[ms]"), r"datetime64\[ms\] has no time zone"),
    (pd.DatetimeIndex(["2024-06-21"]), "has no time zone"),
    (pd.DatetimeIndex([NOON, pd.NaT]), r"times\[1\]: NaT is not a time"),
    (pd.Series([NOON, None]), r"times\[1\]: NaT is not a time"),
    ([NOON, None], r"times\[1\]: None is not a time"),
    (np.inf, "inf is not a time"),
    ([NOON, timedelta(hours=1)], r"times\[1\]: 1:00:00 is not a time"),
    (True, "is not a time"),
]


def of_sightings(time: Any) -> np.ndarray:
    rows = np.size(time) if np.ndim(time) else 1
    return sightings(
        heliostat=np.zeros(rows, int),
        counts=np.zeros((rows, 2)),
        source=np.tile([0.0, 0.0, 1.0], (rows, 1)),
        destination=np.tile([0.0, -50.0, 30.0], (rows, 1)),
        source_at_infinity=True,
        destination_at_infinity=False,
        time=time,
    ).time


def of_learned(time: Any) -> np.ndarray:
    """The times at which a learner is asked."""
    asked: list[np.ndarray] = []

    def at(days: np.ndarray, label: object) -> tuple[np.ndarray, np.ndarray]:
        asked.append(86400.0 * days)
        return np.zeros((len(days), 1)), np.zeros((len(days), 1, 1))

    fake = types.SimpleNamespace(
        names=("x",),
        regimes=lambda row, when: np.zeros(len(when), int),
        members=[types.SimpleNamespace(at=at)],
    )
    rows = np.size(time) if np.ndim(time) else 1
    Learned.parameters_at(fake, np.zeros(rows, int), time)  # type: ignore[arg-type]
    return np.concatenate(asked)


def of_sun(time: Any) -> np.ndarray:
    sun.vector(time, SITE)
    return sun.unix_seconds(time)


READERS: list[Callable[[Any], np.ndarray]] = [of_sun, of_sightings, of_learned]


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("time", GOOD, ids=lambda time: f"{type(time).__name__}")
def test_a_time_means_the_same_everywhere(reader: Callable[[Any], np.ndarray], time: Any) -> None:
    assert np.allclose(reader(time), SECONDS, rtol=0.0, atol=1e-3)


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize(("time", "text"), BAD, ids=lambda case: f"{type(case).__name__}")
def test_what_is_no_time_is_refused_everywhere(
    reader: Callable[[Any], np.ndarray], time: Any, text: str
) -> None:
    with pytest.raises(TimeError, match=text):
        reader(time)


@pytest.mark.parametrize("unknown", [np.nan, [SECONDS, np.nan], np.array([np.nan, SECONDS])])
def test_an_unknown_time_is_nan_where_it_may_be(unknown: Any) -> None:
    with pytest.raises(TimeError, match="nan is not a time"):
        sun.unix_seconds(unknown)
    for reader in (functools.partial(sun.unix_seconds, unknown=True), of_sightings):
        assert np.array_equal(reader(unknown), np.atleast_1d(unknown), equal_nan=True) or (
            np.ndim(unknown) == 0 and np.isnan(reader(unknown)).all()
        )


def test_daylight_goes_into_sightings_as_it_comes() -> None:
    times = sun.daylight("2024-06-21", SITE, every=timedelta(hours=1))
    rows = len(times)
    made = camera_target(
        heliostat=np.zeros(rows, int),
        counts=np.zeros((rows, 2)),
        sun=sun.vector(times, SITE),
        centroid=[0.0, -50.0, 30.0],
        time=times,
        sigma=1e-3,
    )
    assert np.array_equal(made.time, sun.unix_seconds(times))
    assert made.time.min() > SECONDS - 86400.0
    assert made.time.max() < SECONDS + 86400.0


def test_the_drones_sightings_read_times_too() -> None:
    with pytest.raises(TimeError, match="has no time zone"):
        to_sightings(
            types.SimpleNamespace(found=[None], names=("A",)),  # type: ignore[arg-type]
            np.zeros((1, 2)),
            time=NOON.replace(tzinfo=None),
        )
