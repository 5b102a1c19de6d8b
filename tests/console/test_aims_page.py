"""How aims hold the flux limit: on the page, and by ``heliotrope ctl aims``."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from heliotrope.cli import app
from heliotrope.plant.operations.aiming import Aiming, AimsView
from heliotrope.plant.operations.automatic import AutomaticSettings
from support.live_console import LiveConsole
from support.pages import NEEDS_BROWSER

VIEW = AimsView(
    "limit", "last good aims", "desk-1 has the command authority", 42.0, 570e3, 551e3, 0.033, 17,
    161e3, 166e3, 0.002, 5, 1, 4, 2, ("P0004A",), ("P0003A",), ("P0001A", "P0002A"), 12.0,
    "no answer within 60 s",
)  # fmt: skip


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveConsole]:
    """A plant whose aims nobody has limited."""
    work = AutomaticSettings(wanted=True, calibrate=False)
    made = LiveConsole(tmp_path_factory.mktemp("aims"), 6, speed=20.0, work=work)
    yield made
    made.close()


@pytest.fixture
def limited(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the plant's aiming tell what it would under a limit."""
    monkeypatch.setattr(Aiming, "view", lambda _: VIEW)


@NEEDS_BROWSER
def test_the_page_shows_limit_flux_and_who_moved(limited: None, enter: Callable[..., Any]) -> None:
    page = enter("viewer", viewport={"width": 820, "height": 900})
    page.click(".hx-tabs >> text=Plant")
    page.get_by_text("Flux limit", exact=True).wait_for()
    shown = " ".join(page.locator("body").inner_text().split())
    for text in (
        "no answer within 60 s", "last good aims", "570, 551 kW/m²", "3.3 %", "17",
        "161, 166 kW", "5, 1, 2", "Reach no cell 1: P0003A", "P0001A, P0002A",
        "Nothing is moved: desk-1 has the command authority", "Computed 42 s ago",
        "Waiting for the ramp 4", "Aimed by an operator 1: P0004A", "Left of the limit",
    ):  # fmt: skip
        assert text in shown, text
    assert page.evaluate("document.documentElement.scrollWidth") <= 820


@NEEDS_BROWSER
def test_the_page_says_that_the_flux_is_above_the_limit(
    monkeypatch: pytest.MonkeyPatch, enter: Callable[..., Any]
) -> None:
    nan = float("nan")
    over = replace(VIEW, reserve=-0.12, problem="", planned=nan, by_hand=(), limit=47.5)
    over = replace(over, at=float("inf"))
    monkeypatch.setattr(Aiming, "view", lambda _: over)
    page = enter("viewer", viewport={"width": 400, "height": 900})
    page.click(".hx-tabs >> text=Plant")
    page.get_by_text("Flux limit", exact=True).wait_for()
    shown = " ".join(page.locator("body").inner_text().split())
    assert "Above the limit 12.0 %" in shown
    assert "Left of the limit" not in shown
    assert "161, – kW" in shown
    assert "Computed –" in shown
    assert "0.05, 551 kW/m²" in shown
    assert page.evaluate("document.documentElement.scrollWidth") <= 400


@NEEDS_BROWSER
def test_without_a_limit_the_page_says_nothing(enter: Callable[..., Any]) -> None:
    page = enter("viewer")
    page.click(".hx-tabs >> text=Plant")
    page.wait_for_timeout(1500)
    assert page.get_by_text("Flux limit", exact=True).count() == 0


@pytest.fixture
def ctl(field: LiveConsole, tmp_path: Path) -> Callable[..., str]:
    """Run `heliotrope ctl aims` at the plant."""

    def run(*words: str) -> str:
        found = CliRunner().invoke(app, ["ctl", "--data", str(field.folder), "aims", *words])
        assert found.exit_code == 0, (found.output, found.exception)
        return found.output

    return run


def test_ctl_says_that_there_is_no_limit(ctl: Callable[..., str]) -> None:
    assert ctl() == "aims from the plant file; no flux limit is set\n"
    assert json.loads(ctl("--json"))["strategy"] == "spread"


def test_ctl_prints_what_the_page_shows(limited: None, ctl: Callable[..., str]) -> None:
    lines = ctl().splitlines()
    assert lines == [
        "no answer within 60 s",
        "nothing is moved: desk-1 has the command authority",
        "source of the aims: last good aims",
        (
            "limit 570 kW/m², flux including errors up to 551 kW/m², 3.3 % left, "
            "17 cells at the limit, 42 s ago"
        ),
        "161 kW of 166 kW with the best aims",
        (
            "heliostats: 5 with an aim, 1 at standby without one, 4 waiting for the ramp, "
            "2 still to move"
        ),
        "1 aimed by an operator and kept: P0004A",
        "1 reaching no cell of the receiver: P0003A",
        "2 moved 12 s ago: P0001A, P0002A",
    ]
    told = json.loads(ctl("--json"))
    assert told["problem"] == "no answer within 60 s"
    assert told["peak"] == 551e3
