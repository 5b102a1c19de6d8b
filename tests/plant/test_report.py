"""The report of a shift, and the figures that it is made of."""

import math
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.plant.operations.report import period, report
from heliotrope.plant.operations.trends import quantities, trend
from heliotrope.safety import Alarm, Severity
from heliotrope.store.keeper import Keeper
from heliotrope.store.records import NOTE, Event, PlantFigures, VisitEntry
from heliotrope.store.telemetry import Look, Telemetry

START = datetime(2026, 6, 21, 6, tzinfo=UTC).timestamp()


@pytest.fixture
def keeper(tmp_path: Path) -> Iterator[Keeper]:
    made = Keeper(tmp_path / "data", inline=True)
    yield made
    made.close()


def test_energy_and_availability_are_integrals_over_the_time(keeper: Keeper) -> None:
    for minute in range(60):
        night = minute < 30
        keeper.record(
            PlantFigures(
                START + 60.0 * minute,
                {
                    "power.R": 0.0 if night else 6e6,
                    "sun_elevation": -0.1 if night else 0.5,
                    "available": 0.0 if night else 8.0,
                    "faulty": 2.0,
                    "unheard": 0.0,
                    "out_of_service": 0.0,
                    "reading.dni": math.nan if night else 800.0,
                },
            )
        )
    made = report("plant", keeper, START, START + 7200.0, START + 7200.0, "automatic control")
    # Half an hour of 6 MW: 3 MWh. The last row stands for a minute and a half, no longer.
    (one,) = made.production
    assert one.energy == pytest.approx(6e6 * 1830.0)
    assert (one.peak, one.peak_at) == (6e6, START + 1800.0)
    assert made.recorded == pytest.approx(3630.0)
    assert made.daylight == pytest.approx(1830.0)
    assert made.availability == pytest.approx(0.8)
    assert made.lacks["fault or no parameters"] == pytest.approx(2 * 1830.0)
    assert made.sunshine == pytest.approx(800.0 * 1830.0)


def test_what_happened_in_the_time(keeper: Keeper) -> None:
    for at, outcome in ((5.0, CalibrationOutcome.CALIBRATED), (9.0, CalibrationOutcome.NO_BEAM)):
        keeper.record(VisitEntry("A", "west", START, START + at, outcome))
    keeper.record_event(Event(START + 1.0, "command", "Olga: STOW A"))
    keeper.record_event(Event(START + 2.0, "command", "automatic control: STOW A"))
    keeper.record_event(Event(START + 3.0, NOTE, "Olga: wash A"))
    keeper.record_alarm(Alarm("wind", "", Severity.ALARM, "gust"), START - 5.0)
    made = report("plant", keeper, START, START + 10.0, START + 10.0, "automatic control")
    assert made.outcomes == {"calibrated": 1, "no_beam": 1}
    assert [visit.outcome.name for visit in made.failed] == ["NO_BEAM"]
    assert [entry.text for entry in made.work] == ["Olga: STOW A"]
    assert [entry.text for entry in made.notes] == ["Olga: wash A"]
    assert [alarm.condition for alarm in made.alarms] == ["wind"]
    assert not made.production
    assert math.isnan(made.availability)


def test_a_time_ends_after_it_begins_and_is_at_most_a_month() -> None:
    assert period(0.0, 0.0, START) == (START - 8 * 3600.0, START)
    assert period(START - 60.0, START + 60.0, START) == (START - 60.0, START)
    for since, until in ((START, START), (START - 32 * 86_400.0, 0.0)):
        with pytest.raises(InputError, match="at most 31 days"):
            period(since, until, START)


def test_a_trend_is_thinned_to_intervals_with_their_extremes(
    keeper: Keeper, tmp_path: Path
) -> None:
    for minute in range(600):
        keeper.record(PlantFigures(START + 60.0 * minute, {"power.R": float(minute)}))
    found = trend(keeper, None, "power.R", "", START, START + 36_000.0, 10)
    assert (found.unit, len(found.at)) == ("W", 10)
    assert found.low[0] == 0.0
    assert found.high[0] == 59.0
    assert found.mean[0] == pytest.approx(29.5)
    assert found.high[-1] == 599.0
    whole = trend(keeper, None, "power.R", "", START, START + 300.0, 10)
    assert whole.mean.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert [one.name for one in quantities(keeper, START + 600.0)][:1] == ["power.R"]


def test_a_trend_of_one_heliostat_comes_from_its_visits_and_its_telemetry(
    keeper: Keeper, tmp_path: Path
) -> None:
    keeper.record(
        VisitEntry("A", "west", START, START + 9.0, CalibrationOutcome.CALIBRATED, error_after=1e-3)
    )
    found = trend(keeper, None, "error_after", "A", START, START + 60.0, 10)
    assert (found.at.tolist(), found.mean.tolist()) == ([START + 9.0], [1e-3])
    kept = Telemetry(tmp_path / "telemetry", ["A", "B"], ["STOWED"], inline=True)
    zeros = np.zeros(2, np.uint8)
    for minute in range(3):
        counts = np.array([[100 + minute, 7], [0, 0]], np.int32)
        look = Look(zeros, zeros, zeros.astype(np.uint16), counts, np.zeros(2))
        kept.take(START + 60.0 * minute, look)
    kept.close()
    found = trend(keeper, kept.folder, "primary", "A", START, START + 120.0, 10)
    assert (found.at - START).tolist() == [0.0, 60.0]
    assert found.mean.tolist() == [100.0, 101.0]
    with pytest.raises(InputError, match="does not archive telemetry"):
        trend(keeper, None, "primary", "A", START, START + 120.0, 10)
    with pytest.raises(UnknownNameError, match="quantity of a heliostat 'mood'"):
        trend(keeper, None, "mood", "A", START, START + 120.0, 10)
    with pytest.raises(InputError, match="at most 400 days"):
        trend(keeper, None, "power.R", "", START, START, 10)
