"""The operator page in a browser: hand-over notes, wall screen, trends, times and logs."""

import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from support.live_console import LiveConsole
from support.pages import NEEDS_BROWSER, orders_counted, task, until

pytestmark = NEEDS_BROWSER


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveConsole]:
    """Twelve heliostats at eight times the speed of real time."""
    made = LiveConsole(tmp_path_factory.mktemp("day"), 12, speed=8.0)
    yield made
    made.close()


def test_a_viewer_writes_no_note(field: LiveConsole, enter: Callable[..., Any]) -> None:
    page = enter("viewer")
    page.click(".hx-tabs >> text=Shift")
    page.wait_for_selector("text=Hand-over notes")
    assert not page.locator("[name=note]").count()


def test_the_wall_screen_has_nothing_to_click_but_emergency(
    field: LiveConsole, enter: Callable[..., Any]
) -> None:
    page = enter("viewer", viewport={"width": 1920, "height": 1080})
    page.goto(f"{field.address}wall")
    page.wait_for_selector(".hx-large dd:has-text('MW')")
    until(page, "heliotrope.store.live")
    page.wait_for_selector(".hx-side >> text=/No alarms|▲|○/")
    page.mouse.click(600, 500)
    assert not page.evaluate("heliotrope.store.selection.size")
    focused = []
    for _ in range(3):
        page.keyboard.press("Tab")
        focused.append(page.evaluate("document.activeElement.id || 'none'"))
    assert set(focused) <= {"emergency", "none"}
    words = orders_counted(page)
    page.click("#emergency")
    page.wait_for_selector("#emergency-said:has-text('ordered: DEFOCUS')")
    assert len(words) == 1


def test_trends_are_zoomed_moved_and_saved(field: LiveConsole, enter: Callable[..., Any]) -> None:
    field.until(field.produced)
    page = enter("viewer", viewport={"width": 1440, "height": 900})
    page.goto(f"{field.address}trends")
    page.wait_for_selector(".hx-trend .u-over")
    with page.expect_download() as saved:
        page.click("text=Save as CSV")
    lines = saved.value.path().read_text().splitlines()
    assert lines[0].startswith("time,power.receiver low (MW)")
    assert len(lines) > 2
    with task(page, "a second quantity, zoomed by a drag"):
        page.select_option("[aria-label=Quantity]", "available")
        page.click("text='Add'")
        page.wait_for_selector(".hx-trend h2:has-text('available')")
        asked = "new URLSearchParams(location.search).get('{}')"
        width = f"{asked.format('until')} - {asked.format('since')}"
        before = page.evaluate(width)
        box = page.locator(".hx-trend .u-over").first.bounding_box()
        y = box["y"] + 0.5 * box["height"]
        page.mouse.move(box["x"] + 0.9 * box["width"], y)
        page.mouse.down()
        page.mouse.move(box["x"] + 0.999 * box["width"], y, steps=4)
        page.mouse.up()
        until(page, f"{width} < {0.2 * before}")
    page.click("[aria-label=Earlier]")
    page.click("[aria-label='Remove Available']")
    page.wait_for_selector(".hx-trend h2:has-text('available')", state="detached")


def test_local_time_stands_beside_utc(field: LiveConsole, enter: Callable[..., Any]) -> None:
    page = enter("viewer", timezone_id="Asia/Kolkata", viewport={"width": 1440, "height": 900})
    until(page, "document.querySelector('.hx-head').textContent.includes('local')")
    utc, here = re.findall(r"(\d\d:\d\d)(?::\d\d UTC| local)", page.inner_text(".hx-head"))
    minutes = [int(text[:2]) * 60 + int(text[3:]) for text in (utc, here)]
    assert (minutes[1] - minutes[0]) % 1440 == 330
    page.click(".hx-tabs >> text=Logs")
    page.wait_for_selector("td >> text=/[0-9:]{8} \\([0-9]{2}:[0-9]{2}\\)/")


def test_a_command_to_many_is_one_line_that_unfolds(
    field: LiveConsole, enter: Callable[..., Any]
) -> None:
    page = enter("operator")
    names = field.live.names
    entry = {"at": 1.8e9, "kind": "command", "what": "DEFOCUS", "severity": "", "heliostats": names}
    entry["text"] = "operator (operator): 12 heliostats: done"
    page.route("**/api/v1/journal?*", lambda route: route.fulfill(json=[entry]))
    page.click(".hx-tabs >> text=Logs")
    page.click(".hx-logs button >> text=journal")
    page.select_option("[aria-label=Kind]", "command")
    page.click("text='Search'")
    line = page.locator(".hx-logs tr:has-text('DEFOCUS')").first
    assert "12 heliostats" in line.inner_text()
    assert names[11] not in line.inner_text()
    line.locator("summary").click()
    line.locator(f"text={names[11]}").wait_for()
