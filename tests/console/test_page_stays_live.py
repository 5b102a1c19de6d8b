"""The page of a real program in a browser: it is live whatever the plant computes."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from support.live_console import PASSWORD
from support.one_time_link import set_password
from support.pages import NEEDS_BROWSER, entering, until
from support.program import MAIN, Program

pytestmark = NEEDS_BROWSER

#: Notes each time at which the page says NOT LIVE, by its own rule.
WATCH = """() => {
    window.dead = [];
    heliotrope.store.on("live", (live) => live || window.dead.push(Date()));
}"""
#: Whether a visit has all its photographs, or has ended.
ENOUGH = """() => [...document.querySelectorAll(".hx-calibration li")].some(
    (line) => /taking|learning|confirm|writing/.test(line.textContent)
) || !document.querySelector(".hx-calibration").textContent.includes("photograph ")"""


@pytest.fixture
def address(tmp_path: Path) -> Iterator[str]:
    """Twelve new heliostats that go to the targets together, at eight times real time."""
    words = "--heliostats", "12", "--speed", "8", "--port", "0", "--no-browser", "--from", "new"
    plant = Program(MAIN, "run", *words, "--data", str(tmp_path / "data"))
    try:
        link = plant.says(r"console: (\S+)")[1]
        set_password(link, PASSWORD)
        yield link.partition("enter")[0]
    finally:
        plant.close()


def test_the_page_is_live_through_a_joint_visit_and_an_emergency(
    address: str, browser: Any
) -> None:
    signing_in = entering(address, browser)
    page = next(signing_in)("engineer")
    page.evaluate(WATCH)
    page.click(".hx-tabs >> text=Calibration")
    page.wait_for_selector(".hx-calibration li:has-text('photograph')", timeout=300_000)
    # The beams of one of the targets are taken apart.
    until(page, ENOUGH)
    page.click("#emergency")
    page.wait_for_selector(".hx-alert.on:has-text('EMERGENCY')")
    page.wait_for_selector(".hx-alert.on:has-text('done 12')")
    assert page.evaluate("window.dead") == []
    assert page.evaluate("heliotrope.store.live")
    next(signing_in, None)
