"""The timetable on the operator page: an entry is added and removed."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from support.live_console import LiveConsole
from support.pages import NEEDS_BROWSER

pytestmark = NEEDS_BROWSER


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveConsole]:
    """Six heliostats at eight times the speed of real time."""
    made = LiveConsole(tmp_path_factory.mktemp("page"), 6, speed=8.0)
    yield made
    made.close()


def test_an_entry_is_added_and_removed(field: LiveConsole, enter: Callable[..., Any]) -> None:
    names = field.live.names
    page = enter("operator")
    page.click(".hx-tabs >> text=Schedule")
    page.click("text=Calibrate at times, first or never…")
    page.fill("dialog [name=name]", "noon")
    page.fill("dialog [name=heliostats]", f"{names[0]}, {names[1]}")
    page.fill("dialog [name=at]", "12:00Z, 14:30+02:00")
    page.fill("dialog [name=every]", "90")
    page.click("dialog >> text='Put in force'")
    page.wait_for_selector("td:has-text('12:00Z, 14:30+02:00, every 90 min')")
    (row,) = field.live.operations.automatic.timetable.rows()
    assert (row.name, row.heliostats, row.every_s) == ("noon", tuple(names[:2]), 5400.0)
    page.click("text=Calibrate at times, first or never…")
    page.fill("dialog [name=name]", "leave alone")
    page.fill("dialog [name=heliostats]", names[2])
    page.select_option("dialog [name=rule]", label="never: only persons calibrate them")
    page.fill("dialog [name=at]", "12:00Z")
    page.click("dialog >> text='Put in force'")
    page.wait_for_selector("dialog [role=alert]:has-text('remove times and target')")
    page.fill("dialog [name=at]", "")
    page.click("dialog >> text='Put in force'")
    page.wait_for_selector("td:text-is('never')")
    assert field.live.operations.automatic.timetable.ruled("never").tolist().count(True) == 1
    page.click("tr:has-text('leave alone') >> text=Remove…")
    page.click("dialog >> text='Remove'")
    page.wait_for_selector("td:text-is('never')", state="detached")
    page.click("text=Remove…")
    page.click("dialog >> text='Remove'")
    field.until(lambda: not field.live.operations.automatic.timetable.rows())
    page.wait_for_selector("text=Empty.")


def test_a_viewer_sees_it_and_changes_nothing(
    field: LiveConsole, enter: Callable[..., Any]
) -> None:
    page = enter("viewer")
    page.click(".hx-tabs >> text=Schedule")
    page.wait_for_selector("h3:has-text('Timetable')")
    assert not page.locator("text=Calibrate at times, first or never…").count()
