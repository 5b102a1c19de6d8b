"""The operator page in a browser: what people do while heliostats are visited jointly."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from support.live_console import LiveConsole
from support.pages import NEEDS_BROWSER, until

pytestmark = NEEDS_BROWSER


@pytest.fixture
def field(tmp_path: Path) -> Iterator[LiveConsole]:
    """Twelve new heliostats that go to the targets together, at eight times real time."""
    made = LiveConsole(tmp_path, 12, speed=8.0, together=True)
    yield made
    made.close()


def photographed(field: LiveConsole) -> Any:
    """Return a joint visit whose photographs are being taken, None if there is none."""
    running = field.live.operations.automatic.view().running
    return next((run for run in running if run.others and "photograph" in run.stage), None)


def away(field: LiveConsole) -> bool:
    """Whether a heliostat has turned away, or is on its way to stow."""
    return bool(field.live.operations.summary().states.keys() & {"DEFOCUSED", "STOWING", "FAULT"})


def test_taking_command_lets_a_joint_visit_end(
    field: LiveConsole, enter: Callable[..., Any]
) -> None:
    page = enter("engineer")
    page.click(".hx-tabs >> text=Calibration")
    run = field.until(lambda: photographed(field))
    page.wait_for_selector(".hx-calibration li:has-text('photograph')")
    page.click(".hx-authority >> text=Take command")
    page.wait_for_selector(".hx-authority >> text=You have command")
    page.wait_for_selector(".hx-calibration >> text=Off: engineer has the command authority")
    lost = list[str]()

    def ended() -> bool:
        lost.extend(["turned away"] if away(field) else [])
        return not field.live.operations.automatic.view().running

    field.until(ended)
    assert not lost
    assert not page.locator(".hx-alert.on").count()
    results = field.call(lambda: field.live.operations.automatic.view().results)
    mine = [entry for entry in results if entry.heliostat in run.heliostats]
    assert len(mine) == len(run.heliostats)
    assert sum(entry.good for entry in mine) >= len(mine) - 1, [entry.text for entry in mine]
    page.click(".hx-authority >> text=Release")
    page.wait_for_selector(".hx-calibration >> text=Running")
    assert not page.locator(".hx-alert.on").count()


def test_an_emergency_in_a_joint_visit_leaves_nothing_locked(
    field: LiveConsole, enter: Callable[..., Any]
) -> None:
    page = enter("engineer")
    # Parameters are being written.
    field.until(lambda: field.live.operations.summary().states.get("LOCKED"))
    page.click("#emergency")
    page.wait_for_selector(".hx-alert.on:has-text('EMERGENCY')")
    page.wait_for_selector(".hx-alert.on:has-text('done 12')")
    page.click(".hx-alert >> text=Withdraw")
    page.click("dialog >> text='Withdraw'")
    page.wait_for_selector(".hx-alert >> text=Resume ends it")
    field.calm()
    page.wait_for_selector(".hx-alert >> text=wait until an operator presses Resume")
    page.click(".hx-tabs >> text=Calibration")
    page.wait_for_selector(".hx-calibration >> text=no heliostat is under automatic control")
    page.click(".hx-alert button >> text=Resume")
    page.click("dialog >> text='Resume'")
    until(page, "!document.querySelector('.hx-alert.on')")

    def up() -> bool:
        states = field.live.operations.summary().states
        return states.get("IDLE", 0) + states.get("TRACKING", 0) == 12

    field.until(up)
    assert not field.call(lambda: field.live.operations.summary().resume)
