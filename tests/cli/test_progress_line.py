"""The printed line of a plant at work: what it does, what comes next, and at what pace."""

import asyncio
from dataclasses import dataclass, replace

import pytest

from heliotrope.cli.run._shared import line, pace
from heliotrope.field.layouts import malan_plant
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.orders.authority import Person, Role
from support.live import LiveOptions, LivePlant

PERSON = Person("engineer", Role.ENGINEER)


@dataclass(frozen=True)
class Said:
    """What the plant says at moments of its work; of its plan, and of its results, what it has."""

    coming: str
    at_work: str
    done: int
    today: str
    yesterday: str
    emergency: str


@pytest.fixture(scope="module")
def said() -> Said:
    """Return lines of a plant of four, in virtual time: at work, with results, in an emergency."""
    found = list[Said]()

    async def main(clock: VirtualClock) -> None:
        work = AutomaticSettings(wanted=True, calibrate=True)
        made = LivePlant(malan_plant(4), clock, LiveOptions(rendered=False, threads=0, work=work))
        automatic, viewer = made.operations.automatic, made.operations.viewer
        async with made.running():
            await asyncio.sleep(90.0)
            assert automatic.view().running
            coming = automatic.plan(20)[0]
            next_ = f"next: {coming.heliostat} on target {coming.target}"
            at_work = line(made.assembly)
            until = clock.monotonic() + 330.0
            while not automatic.view().done and clock.monotonic() < until:
                await asyncio.sleep(10.0)
            done, today, frame = automatic.view().done, line(made.assembly), viewer.frame
            aged = replace(frame(), calibrated_at=frame().calibrated_at - 86_400.0)
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(viewer, "frame", lambda: aged)
                yesterday = line(made.assembly)
            made.operations.emergency(PERSON, "DEFOCUS", "smoke")
            found.append(Said(next_, at_work, done, today, yesterday, line(made.assembly)))
            await made.end()

    run_virtual(main)
    return found[0]


def test_it_names_what_is_done_and_what_comes_next(said: Said) -> None:
    text = said.at_work
    assert " of 4 track" in text
    assert "calibrated today" in text
    assert said.coming in text
    assert " on target " in text.partition("next:")[0], "the visit under way"
    assert " late" not in text


def test_it_counts_today_and_names_the_true_error(said: Said) -> None:
    assert said.done > 0
    assert f"{said.done} calibrated today (median true error 0." in said.today
    assert "0 calibrated today (median true error 0." in said.yesterday


def test_it_gives_the_reason_why_nothing_is_calibrated(said: Said) -> None:
    assert "EMERGENCY" not in said.yesterday
    assert "UTC: EMERGENCY; " in said.emergency
    assert "; no calibration: an emergency is active" in said.emergency
    assert "next:" not in said.emergency


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
