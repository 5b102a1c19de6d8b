"""The printed line of a plant at work: what it does, what comes next, and at what pace."""

import asyncio
import dataclasses
from collections.abc import Callable

import pytest

from heliotrope.cli.run._shared import line, pace
from heliotrope.field.layouts import malan_plant
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.orders.authority import Person, Role
from support.live import LiveOptions, LivePlant

PERSON = Person("engineer", Role.ENGINEER)


def said(scene: Callable[[LivePlant], list[str]], seconds: float = 90.0) -> list[str]:
    """Return lines of a scene after some seconds of a plant of four, in virtual time."""
    found = list[str]()

    async def main(clock: VirtualClock) -> None:
        work = AutomaticSettings(wanted=True, calibrate=True)
        made = LivePlant(malan_plant(4), clock, LiveOptions(rendered=False, threads=0, work=work))
        async with made.running():
            await asyncio.sleep(seconds)
            found.extend(scene(made))
            await made.end()

    run_virtual(main)
    return found


def test_it_names_what_is_done_and_what_comes_next() -> None:
    def scene(plant: LivePlant) -> list[str]:
        coming = plant.operations.automatic.plan(20)[0]
        assert plant.operations.automatic.view().running
        return [line(plant.assembly), f"next: {coming.heliostat} on target {coming.target}"]

    text, coming = said(scene)
    assert " of 4 track" in text
    assert "calibrated today" in text
    assert coming in text
    assert " on target " in text.partition("next:")[0], "the visit under way"
    assert " late" not in text


def test_it_counts_today_and_names_the_true_error() -> None:
    def scene(plant: LivePlant) -> list[str]:
        done = plant.operations.automatic.view().done
        assert done > 0
        today = line(plant.assembly)
        frame = plant.operations.viewer.frame
        aged = dataclasses.replace(frame(), calibrated_at=frame().calibrated_at - 86_400.0)
        plant.operations.viewer.frame = lambda: aged  # type: ignore[method-assign]
        return [f"{done} calibrated today (median true error 0.", today, line(plant.assembly)]

    words, today, yesterday = said(scene, 420.0)
    assert words in today
    assert "0 calibrated today (median true error 0." in yesterday


def test_it_gives_the_reason_why_nothing_is_calibrated() -> None:
    def scene(plant: LivePlant) -> list[str]:
        idle = line(plant.assembly)
        plant.operations.emergency(PERSON, "DEFOCUS", "smoke")
        return [idle, line(plant.assembly)]

    before, after = said(scene)
    assert "EMERGENCY" not in before
    assert "UTC: EMERGENCY; " in after
    assert "; no calibration: an emergency is active" in after
    assert "next:" not in after


@pytest.mark.parametrize(
    ("rate", "words"),
    [
        (1.0, ""),
        (0.97, ""),
        (0.8, "simulated at 0.8 × real time"),
        (8.0, "simulated at 8 × real time"),
        (0.1, "simulated at 0.1 × real time"),
    ],
)
def test_the_pace_is_said_where_it_is_not_that_of_real_time(rate: float, words: str) -> None:
    assert pace(rate) == words


def test_every_state_has_words() -> None:
    from heliotrope.cli.run._shared import _WORDS

    assert set(_WORDS) == {*states.STATES, "stale"} - {"TRACKING"}
