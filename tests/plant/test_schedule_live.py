"""The schedule in a plant at work: simulated mirrors under real clusters."""

import asyncio
from datetime import UTC, datetime

import numpy as np
import pytest

from heliotrope.field.layouts import malan_plant
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.plant.schedule import PlantSchedule, Scheduler, Settings, settings_for
from heliotrope.plant.settings import PlantSettings
from heliotrope.plant.visits import CycleSettings
from support.live import LiveOptions, LivePlant

START = datetime(2026, 10, 21, 7, tzinfo=UTC)
DESIGN = malan_plant(12)


def test_the_settings_are_those_of_the_cycle() -> None:
    cycle = CycleSettings(shots=5, interval=7.0, sigma=1e-4, model=("tilt_north", "tilt_east"))
    made = settings_for(cycle, Settings(goal=1e-3))
    assert (made.shots, made.interval, made.sigma) == (5, 7.0, 1e-4)
    assert made.model == ("tilt_north", "tilt_east")
    assert made.goal == 1e-3


def test_a_plant_at_work_asks_its_schedule_and_tells_what_became_of_it() -> None:
    async def main(clock: VirtualClock) -> None:
        sensors = PlantSettings(sensors=frozenset({"dni"}))
        options = LiveOptions(rendered=False, threads=0, plant=sensors)
        async with LivePlant(DESIGN, clock, options).running() as live:
            try:
                schedule = live.assembly.schedule
                assert isinstance(schedule, PlantSchedule)
                await _visits(live, schedule)
                _what_came_of_it(live, schedule)
                _what_was_chosen(live, schedule)
                _what_is_to_come(live, schedule)
                _under_clouds(live, schedule)
                _after_a_restart(live, schedule)
            finally:
                # As an exit does: what is on its way is given up first.
                await live.operations.automatic.halt()
                await live.end()

    run_virtual(main, start=START)


def _under_clouds(live: LivePlant, schedule: PlantSchedule) -> None:
    ready = np.ones(len(live.plant.field), dtype=np.bool_)
    live.plant.put("dni", 120.0)
    assert schedule.weather.dni == 120.0
    assert schedule.next("left", ready) is None
    assert schedule.reason == "clouds: 120 W/m², below 300 W/m²"
    live.plant.put("dni", 850.0)


async def _visits(live: LivePlant, schedule: PlantSchedule) -> None:
    until = live.clock.monotonic() + 300.0
    while len(schedule.scheduler.finished) < 4 and live.clock.monotonic() < until:
        await asyncio.sleep(1.0)


def _what_came_of_it(live: LivePlant, schedule: PlantSchedule) -> None:
    chosen, now = schedule.scheduler, live.clock.utc()
    good = {f.visited.heliostat for f in chosen.finished if f.visited.calibrated}
    assert len(good) >= 3
    assert {f.planned.target for f in chosen.finished} == {"left", "right"}
    # What is calibrated is expected to be better, and is.
    rows = np.isin(chosen.names, sorted(good))
    expected, true = chosen.expected(now), live.errors()
    assert expected[rows].max() < 0.8 * expected[~rows].min()
    assert np.median(true[rows]) < 1e-3 < np.median(true[~rows])
    found = chosen.compared()
    assert found.visits == len(chosen.finished)
    assert 0.1 < found.ratio < 2.0


def _what_was_chosen(live: LivePlant, schedule: PlantSchedule) -> None:
    """The page says why the last visit was chosen."""
    shown = live.operations.automatic.view().choice
    assert shown
    assert shown == schedule.reason


def _what_is_to_come(live: LivePlant, schedule: PlantSchedule) -> None:
    """The plan is made a little at each look, and names nobody who is under way."""
    for _ in range(60):
        coming = live.operations.automatic.plan(6)
        if len(coming) == 6:
            break
    assert len(coming) == 6
    assert all(p.gain > 0.0 and p.reason for p in coming)
    assert not {p.heliostat for p in coming} & set(schedule.scheduler.running)


def _after_a_restart(live: LivePlant, before: PlantSchedule) -> None:
    """A new schedule knows what the plant believes, and forgets what ended without a result."""
    names, now = live.plant.field.names, live.clock.utc()
    fresh = Scheduler(DESIGN, before.scheduler.settings, now=now, names=names)
    again = PlantSchedule(live.plant, fresh)
    ready = np.full(12, fill_value=True)
    first = again.next("left", ready)
    assert first is not None
    np.testing.assert_allclose(fresh.expected(now), before.scheduler.expected(now), rtol=0.05)
    assert list(fresh.running) == [first.heliostat]
    second = again.next("left", ready)
    assert second is not None
    assert list(fresh.running) == [second.heliostat]
    nobody = again.next("right", np.zeros(12, dtype=np.bool_))
    assert nobody is None
    assert fresh.reason == "no heliostat is ready"


@pytest.mark.parametrize("hour", [0, 22])
def test_the_scheduler_is_quiet_at_night(hour: int) -> None:
    chosen = Scheduler(DESIGN, now=START)
    night = START.replace(hour=hour)

    class Field:
        state = np.full(12, states.IDLE, dtype=np.uint8)
        counts = np.zeros((12, 2), dtype=np.int32)

    from heliotrope.sun import vector

    assert chosen.next(night, vector(night, DESIGN.site), Field(), ("left",)) is None
    assert chosen.reason.startswith("the sun is at -")
