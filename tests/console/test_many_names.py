"""Events of many heliostats: their names by API, by `ctl` and on the page."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from typer.testing import CliRunner

from heliotrope.cli import app
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.orders.authority import Person, Role
from support.live_console import LiveConsole
from support.pages import NEEDS_BROWSER, until

FOLDED = ".hx-logs details"


@pytest.fixture(scope="module")
def console(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveConsole]:
    """A field that somebody has given to automatic control, and of which nothing else is told."""
    made = LiveConsole(
        tmp_path_factory.mktemp("names"), 12, speed=8.0, work=AutomaticSettings(wanted=False)
    )
    operations = made.live.operations
    made.call(lambda: operations.give_back(Person("operator", Role.OPERATOR)))
    yield made
    made.close()


@pytest.fixture(scope="module")
def field(console: LiveConsole) -> LiveConsole:
    return console


def test_api_and_ctl_name_them(
    console: LiveConsole, ask: Callable[..., httpx.Response], tokens: dict[str, str], tmp_path: Path
) -> None:
    names = console.live.names
    found = ask("viewer", "GET", "events").json()
    (event,) = (one for one in found if "under automatic control" in one["text"])
    assert event["heliostats"] == len(names) == 12
    path = f"events/{event['number']}/heliostats"
    assert ask("viewer", "GET", path).json() == list(names)
    assert ask("viewer", "GET", "events/999999/heliostats").status_code == 404
    secret = tmp_path / "token"
    secret.write_text(tokens["viewer"])
    for where in (["--url", console.address], ["--data", str(console.folder)]):
        run = ["ctl", *where, "--token-file", str(secret), "events"]
        plain = CliRunner().invoke(app, run).output
        assert "put 12 heliostats under automatic control" in plain
        assert names[7] not in plain
        assert ", ".join(names) in CliRunner().invoke(app, [*run, "--all-names"]).output
        listed = json.loads(CliRunner().invoke(app, [*run, "--all-names", "--json"]).output)
        assert list(names) in [one.get("names") for one in listed]


@NEEDS_BROWSER
def test_an_event_unfolds_and_stays_so(console: LiveConsole, enter: Callable[..., Any]) -> None:
    page, names = enter("viewer"), console.live.names
    page.click(".hx-tabs >> text=Logs")
    event = f"{FOLDED}:has-text('12 heliostats under automatic control')"
    page.click(f"{event} summary")
    page.wait_for_selector(f"{event} >> text={names[7]}")
    console.call(lambda: console.live.operations.logbook.event("plant", "", "drawn anew"))
    page.wait_for_selector("td:has-text('drawn anew')")
    page.wait_for_selector(f"{event}[open] >> text={', '.join(names)}")
    page.click(f"{event} summary")
    until(page, f"!document.querySelector('{FOLDED}').open")


@NEEDS_BROWSER
def test_a_command_unfolds_to_its_heliostats(enter: Callable[..., Any]) -> None:
    refusals = {f"P{k}": "it is locked" if k % 2 else "it is in stow" for k in range(6)}
    row = {"identity": "a-1", "command": "TRACK", "heliostats": 6, "counted": {}, "finished": True}
    row |= {"good": False, "text": "TRACK: 6 refused (6 heliostats: why)"}
    row |= {"refusals": refusals, "steps": {"P1": "waits"}}
    page = enter("viewer")
    page.route("**/api/v1/commands", lambda route: route.fulfill(json=[row]))
    page.click(".hx-tabs >> text=Logs")
    page.click(".hx-logs button[value=commands]")
    page.click(f"{FOLDED} summary:has-text('6 refused')")
    page.wait_for_selector(f"{FOLDED} >> text='P1, P3, P5: it is locked'")
    page.wait_for_selector(f"{FOLDED} >> text='P0, P2, P4: it is in stow'")
    # Drawn anew after some seconds, it stays unfolded.
    page.evaluate("document.querySelector('.hx-logs details').remove()")
    page.wait_for_selector(f"{FOLDED}[open] >> text='P1, P3, P5: it is locked'")


@NEEDS_BROWSER
def test_an_entry_of_the_timetable_unfolds(
    console: LiveConsole, ask: Callable[..., httpx.Response], enter: Callable[..., Any]
) -> None:
    names = list(console.live.names[:7])
    entry = {"name": "never", "heliostats": names, "rule": "never"}
    assert ask("operator", "PUT", "timetable", {"entries": [entry]}).status_code == 200
    page = enter("viewer")
    page.click(".hx-tabs >> text=Schedule")
    page.click(".hx-schedule summary:has-text('and 4 more')")
    page.wait_for_selector(f".hx-schedule details[open] >> text={', '.join(names[3:])}")
