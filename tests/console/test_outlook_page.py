"""The predicted errors of the field on the page, beside what comes true, in a plant at work."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from heliotrope.plant.operations.automatic import AutomaticSettings
from support.live_console import LiveConsole
from support.pages import NEEDS_BROWSER, until

pytestmark = NEEDS_BROWSER


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveConsole]:
    """A few heliostats that calibrate themselves, at twenty times the speed of real time."""
    work = AutomaticSettings(wanted=True, foresee=60.0)
    made = LiveConsole(tmp_path_factory.mktemp("outlook"), 6, speed=20.0, work=work)
    yield made
    made.close()


#: Whether a colour, [red, green, blue], is somewhere in the picture of a canvas.
_DRAWN = """colour => {
  const canvas = document.querySelector('.hx-outlook canvas');
  if (!canvas || !canvas.width) return false;
  const seen = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
  for (let i = 0; i < seen.length; i += 4)
    if (seen[i + 3] > 200 && colour.every((c, k) => Math.abs(seen[i + k] - c) < 12)) return true;
  return false;
}"""
#: Colours of `palette.js`, on dark and on light: the first prediction, the last, what came true.
_COLOURS = {
    True: [[0xCC, 0x79, 0xA7], [0xE6, 0x9F, 0x00], [0x56, 0xB4, 0xE9]],
    False: [[0xB0, 0x56, 0x8A], [0xC9, 0x85, 0x00], [0x1F, 0x8F, 0xD0]],
}


def test_the_page_tells_what_is_predicted(field: LiveConsole, enter: Callable[..., Any]) -> None:
    def two() -> bool:
        return len(field.live.operations.automatic.view().outlooks) == 2

    field.until(two, 240.0)
    page = enter("viewer")
    page.click(".hx-tabs >> text=Calibration")
    page.wait_for_selector(".hx-outlook .hx-keys")
    keys = page.inner_text(".hx-outlook .hx-keys")
    assert keys.count("90th percentile") == 3
    assert "came true, median" in keys
    assert keys.count("predicted at ") == 2
    assert "90 % of the heliostats are within" in page.inner_text(".hx-outlook .hx-hint")


def _curve(begin: float, level: float) -> list[dict[str, float]]:
    """Percentiles that fall to a quarter within an hour, rad."""
    steps = [begin + 600.0 * k for k in range(7)]
    fall = [level * 4.0 ** (-k / 6.0) for k in range(7)]
    return [
        {"at": at, "median": value, "percentile_90": 2.0 * value}
        for at, value in zip(steps, fall, strict=True)
    ]


def _outlook(made: float, level: float) -> dict[str, Any]:
    rest = {"heliostats": 6, "goal": 3.5e-4, "reached": None, "text": "not today"}
    return {"made": made, "points": _curve(made, level), **rest}


#: Answers of the API in which no curve lies on another one.
_CURVES = {
    "outlooks": [_outlook(1.75e9, 2e-3), _outlook(1.75e9 + 1800.0, 7e-4)],
    "field": _curve(1.75e9, 8e-3),
}


def test_the_page_draws_the_prediction_beside_what_comes_true(
    enter: Callable[..., Any],
) -> None:
    page = enter("viewer", viewport={"width": 800, "height": 900})
    _answering(page, _CURVES)
    page.click(".hx-tabs >> text=Calibration")
    page.wait_for_selector(".hx-outlook .hx-keys")
    assert page.evaluate("document.documentElement.scrollWidth") <= 800
    assert page.locator(".hx-outlook canvas").bounding_box()["width"] > 600
    for dark in (True, False):
        if not dark:
            page.click("[aria-label='Dark or light']")
        for colour in _COLOURS[dark]:
            until(page, _DRAWN, colour)
    page.unroute_all(behavior="wait")


def _answering(page: Any, fields: dict[str, Any]) -> None:
    """Let the progress of calibration have these fields, whatever the plant says."""

    def answer(route: Any) -> None:
        told = route.fetch()
        route.fulfill(response=told, json={**told.json(), **fields})

    page.route("**/api/v1/calibration", answer)


def test_a_joint_visit_shows_its_first_heliostats_and_all_on_a_click(
    enter: Callable[..., Any],
) -> None:
    names = [f"P{k:04d}A" for k in range(1, 61)]
    visit = {"heliostat": names[0], "others": names[1:], "target": "left", "stage": "photograph 7"}
    page = enter("viewer", viewport={"width": 800, "height": 900})
    _answering(page, {"running": [visit | {"since": 1.75e9}], "asked": names[:4]})
    page.click(".hx-tabs >> text=Calibration")
    line = page.locator(".hx-list li", has_text="on left: photograph 7")
    line.wait_for()
    shown = " ".join(line.inner_text().split())
    assert shown.startswith("P0001A, P0002A, P0003A and 57 more on left: photograph 7"), shown
    assert page.locator(".hx-several summary").get_attribute("title") == ", ".join(names)
    # Four names need no summary.
    assert "asked for next: P0001A, P0002A, P0003A, P0004A" in page.inner_text(".hx-list")
    line.locator("summary").click()
    line.get_by_text("P0060A").wait_for()
    # The list is drawn anew, and stays open.
    page.evaluate("heliotrope.store.emit('theme')")
    line.get_by_text("P0060A").wait_for()
    assert page.evaluate("document.documentElement.scrollWidth") <= 800
    page.unroute_all(behavior="wait")


def test_the_curve_is_in_the_answer_of_the_api_and_in_the_store(
    field: LiveConsole, enter: Callable[..., Any]
) -> None:
    field.until(lambda: field.live.operations.automatic.view().outlooks, 240.0)
    page = enter("viewer")
    told = page.evaluate("async () => (await fetch('/api/v1/calibration')).json()")
    first = told["outlooks"][0]
    assert set(first) == {"made", "heliostats", "goal", "reached", "points", "text"}
    assert first["heliostats"] == 6
    assert first["points"][0]["at"] == first["made"]
    assert first["points"][0]["percentile_90"] > first["points"][-1]["percentile_90"] > 0.0
    assert told["field"][0]["at"] <= first["made"]

    def kept() -> bool:
        return first["made"] in [outlook.made for outlook in field.keeper.outlooks(0.0)]

    field.until(kept)


_RESULT = {
    "at": 1.75e9,
    "heliostat": "P0012F",
    "target": "right",
    "outcome": "calibrated",
    "before": 0.0221,
    "after": 0.00045,
    "measured": 0.0221,
    "predicted": 0.00123,
    "truth_before": 0.01871,
    "truth_after": 0.00123,
    "sightings": 8,
    "new": 4,
    "text": "calibrated",
    "version": 2,
}


def test_the_last_measurements_fit_into_every_window(
    field: LiveConsole, enter: Callable[..., Any]
) -> None:
    field.until(lambda: field.live.operations.automatic.view().quality, 240.0)
    page = enter("viewer")

    _answering(page, {"results": [_RESULT] * 3})
    page.click(".hx-tabs >> text=Calibration")
    page.wait_for_selector(".hx-calibration td:has-text('P0012F')")
    for width in (800, 1100, 1400, 1900):
        page.set_viewport_size({"width": width, "height": 900})
        until(
            page,
            """() => { const table = document.querySelector('.hx-calibration .hx-scroll');
            return table && table.scrollWidth <= table.clientWidth; }""",
        )
        assert page.locator(".hx-calibration td:last-child").first.inner_text() == "✓"
    page.unroute_all(behavior="wait")
