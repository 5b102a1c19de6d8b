"""What an operator does all day, in a browser: each task with its clicks and seconds."""

import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from support.live_console import LiveConsole
from support.pages import NEEDS_BROWSER, orders_counted, said, task, until

pytestmark = NEEDS_BROWSER


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveConsole]:
    """Twelve heliostats at eight times the speed of real time."""
    made = LiveConsole(tmp_path_factory.mktemp("day"), 12, speed=8.0)
    yield made
    made.close()


def produced(field: LiveConsole) -> bool:
    """Whether figures are kept in which a receiver gets power."""
    rows = field.keeper.figures(0.0, 1e11)
    return any(value > 0.0 for row in rows for name, value in row.values.items() if "power" in name)


def test_a_note_and_the_report_of_the_shift(field: LiveConsole, enter: Callable[..., Any]) -> None:
    field.until(lambda: produced(field))
    page = enter("operator", viewport={"width": 820, "height": 1180})
    with task(page, "hand-over note"):
        page.click(".hx-tabs >> text=Shift")
        page.fill("[name=note]", "Mirror 7 is dirty,\nwash it tomorrow")
        page.click("text=Save note")
        page.wait_for_selector("td:has-text('operator: Mirror 7 is dirty, wash it tomorrow')")
    said(page, "note: done")
    assert not page.input_value("[name=note]")
    with task(page, "shift report"), page.context.expect_page() as opened:
        page.click(".hx-shift >> text=Last 8 hours")
    report = opened.value
    report.wait_for_selector("h1:has-text('Shift report')")
    text = report.inner_text("article")
    assert "operator: Mirror 7 is dirty" in text
    for title in ("Production", "Availability", "Calibrations", "Alarms", "Work done", "Notes (1)"):
        assert title in text
    found = report.request.get(f"{field.address}api/v1/report").json()
    assert found["production"][0]["energy"] > 0
    assert 0 < found["availability"] <= 1
    assert f"{found['production'][0]['energy'] / 3.6e9:.1f}"[:3] in text
    report.emulate_media(media="print")
    assert not report.locator("form").is_visible()


def test_a_viewer_writes_no_note(field: LiveConsole, enter: Callable[..., Any]) -> None:
    page = enter("viewer")
    page.click(".hx-tabs >> text=Shift")
    page.wait_for_selector("text=Hand-over notes")
    assert not page.locator("[name=note]").count()


def test_versions_side_by_side_and_one_brought_back(
    field: LiveConsole, enter: Callable[..., Any]
) -> None:
    name, operations = field.live.names[0], field.live.operations
    page = enter("engineer")
    page.fill(".hx-query", name)
    page.keyboard.press("Enter")
    page.click(".hx-orders >> text=Stow")
    field.until(lambda: operations.viewer.heliostat(name).state == "STOWED")
    page.click(".hx-authority >> text=Take command")
    page.wait_for_selector(".hx-authority >> text=You have command")
    page.click(".hx-tabs >> text=Heliostat")
    page.click("text=Versions…")
    page.wait_for_selector("dialog th:has-text('version 0')")
    page.focus("dialog [name=tilt_east]")
    page.evaluate(
        "document.activeElement.dataset.old = 1;"
        "document.querySelector('dialog select').dispatchEvent(new Event('change'))"
    )
    page.wait_for_selector("dialog [data-old]", state="detached")
    page.keyboard.insert_text("2.5")  # the table was drawn anew under the typing hand
    assert page.input_value("dialog [name=tilt_east]") == "2.5"
    for value in ("0.5", "1.5"):
        page.fill("dialog [name=tilt_east]", value)
        page.click("dialog >> text=Store new values")
        page.wait_for_selector("dialog .hx-told.bad:has-text('give the reason')")
        assert page.input_value("dialog [name=tilt_east]") == value
        page.fill("dialog [name=reason]", "levelled")
        page.click("dialog >> text=Store new values")
        page.wait_for_selector("dialog .hx-told:not(.bad):has-text('done')")
        until(page, "document.querySelector('dialog [name=reason]').value === ''")
    page.click("dialog >> text='Close'")
    last = field.call(lambda: field.live.plant.beliefs.record(name))
    assert last.parameters["tilt_east"] == pytest.approx(1.5e-3)
    with task(page, "versions side by side and one brought back"):
        page.click("text=Versions…")
        page.wait_for_selector("dialog >> text=/The beam moves by [0-9.]+ mm RMS/")
        (row,) = page.locator("dialog tr:has-text('tilt_east')").all_inner_texts()
        assert row.split()[1:6:2][:2] == ["0.500", "1.500"]
        page.fill("dialog [name=reason]", "the level was wrong")
        page.click(f"dialog >> text=Bring back version {last.version - 1}")
        page.wait_for_selector("dialog .hx-told:not(.bad):has-text('done')")
    again = field.call(lambda: field.live.plant.beliefs.record(name))
    assert again.version == last.version + 1
    assert again.parameters["tilt_east"] == pytest.approx(0.5e-3)
    page.click("dialog >> text='Close'")
    page.click(".hx-authority >> text=Release")


def test_calibrate_now_shows_its_progress_and_its_result(
    field: LiveConsole, enter: Callable[..., Any]
) -> None:
    name = field.live.names[3]
    page = enter("operator", viewport={"width": 820, "height": 1180})
    page.fill(".hx-query", name)
    page.keyboard.press("Enter")
    with task(page, "calibrate one now, to its result"):
        page.click(".hx-tabs >> text=Heliostat")
        page.click("text=Calibrate now")
        page.wait_for_selector("h3:has-text('Calibration under way')")
        page.wait_for_selector("h3:has-text('Last calibration')")
        page.wait_for_selector(".hx-result dt:has-text('Beam error before')")

    def results() -> Any:
        return field.call(lambda: field.live.operations.viewer.heliostat(name)).results

    # Automatic control may have calibrated it once more; the page shows that with its next look.
    page.wait_for_selector(f".hx-result p:has-text('{results()[-1].text}')")
    (last,) = [one for one in results() if one.text in page.inner_text(".hx-result")][-1:]
    assert f"{1e3 * last.after:.2f} mrad" in page.inner_text(".hx-result dl")

    # The plant of these tests keeps no photographs.
    def rows() -> list[dict[str, Any]]:
        newest = results()[-1]
        row = {"heliostat": name, "target": newest.target, "used": True, "reading": []}
        row |= {"text": newest.text, "outcome": "calibrated"}
        return [{**row, "identity": k, "at": newest.at - 0.1 * k} for k in (1, 2, 3)]

    page.route("**/api/v1/photographs?*", lambda route: route.fulfill(json=rows()))
    dot = "<svg xmlns='http://www.w3.org/2000/svg' width='4' height='3'/>"
    page.route(
        re.compile(r"/api/v1/photographs/\d"),
        lambda route: route.fulfill(body=dot, content_type="image/svg+xml"),
    )
    page.wait_for_selector(".hx-two img")
    shown = page.locator(".hx-two img").evaluate_all("all => all.map((one) => one.src.slice(-1))")
    assert shown == ["3", "1"]


def test_aim_a_group_at_a_point_of_the_flux_picture(
    field: LiveConsole, enter: Callable[..., Any]
) -> None:
    names, operations = field.live.names[6:8], field.live.operations
    receiver = operations.plant.design.receivers[0]
    page = enter("operator")

    def calibrated(route: Any) -> None:
        """As if all heliostats were calibrated: only then have cells an uncertainty."""
        view = route.fetch().json()
        sigma = [
            [0.1 * abs(value) + 1e3 * k for value in row] for k, row in enumerate(view["flux"])
        ]
        route.fulfill(json={**view, "sigma": sigma, "peak_sigma": 0.1 * view["peak"]})

    page.route(f"**/receivers/{receiver.name}/flux", calibrated)
    page.click(".hx-authority >> text=Take command")
    page.wait_for_selector(".hx-authority >> text=You have command")
    # Visits under way go on to their ends.
    field.until(lambda: not operations.automatic.view().running)
    page.fill(".hx-query", " ".join(names))
    page.keyboard.press("Enter")
    page.wait_for_selector("dt:has-text('Intercept')")
    page.get_by_text(re.compile(r"^\d+ ± \d+ kW/m²$")).wait_for()
    picture = "document.querySelector('.hx-flux').toDataURL()"
    expected = page.evaluate(picture)
    page.check("label:has-text('Standard deviation') input")
    assert page.evaluate(picture) != expected
    page.uncheck("label:has-text('Standard deviation') input")
    with task(page, "aim a group at a point of the receiver"):
        flux = page.locator(".hx-flux")
        box = flux.bounding_box()
        # A quarter of the picture right of its middle, which ends 84 px before the canvas.
        flux.click(position={"x": 0.75 * (box["width"] - 84), "y": 0.5 * (box["height"] - 22)})
        page.wait_for_selector("dialog h2:has-text('Aim: 2 heliostats')")
        page.click("dialog button >> text='Aim'")
        said(page, "AIM")
    wanted = receiver.point(0.25 * receiver.width, 0.0)
    field.until(
        lambda: all(
            abs(operations.viewer.heliostat(name).aim - wanted).max() < 0.05 for name in names
        )
    )
    page.click(".hx-orders >> text=Aim…")
    page.select_option("dialog [name=where]", receiver.name)
    page.fill("dialog [name=right]", "99")
    page.click("dialog button >> text='Aim'")
    page.wait_for_selector(
        "dialog [role=alert]:has-text('99 m right of its centre is outside its surface')"
    )
    assert page.input_value("dialog [name=right]") == "99"
    page.select_option("dialog [name=where]", "standby")
    page.click("dialog button >> text='Aim'")
    said(page, "IDLE")
    page.click(".hx-authority >> text=Release")


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
    field.until(lambda: produced(field))
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
