"""An operator's tasks on a tablet, by touch: each with its clicks and seconds."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from support.live_console import LiveConsole
from support.pages import NEEDS_BROWSER, said, task, until

pytestmark = NEEDS_BROWSER


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveConsole]:
    """Twelve heliostats at eight times the speed of real time."""
    made = LiveConsole(tmp_path_factory.mktemp("tablet"), 12, speed=8.0)
    yield made
    made.close()


@pytest.fixture
def tablet(enter: Callable[..., Any]) -> Callable[[str], Any]:
    """Sign in on a tablet as somebody of a role."""
    screen = {"width": 820, "height": 1180}
    return lambda role: enter(role, viewport=screen, has_touch=True)


def _select(page: Any, *names: str) -> None:
    page.fill(".hx-map .hx-query", " ".join(names))
    page.tap(".hx-tools >> text='Select'")
    until(page, f"heliotrope.store.selection.size === {len(names)}")


def test_why_a_heliostat_does_not_track(field: LiveConsole, tablet: Callable[[str], Any]) -> None:
    page, name = tablet("operator"), field.live.names[0]
    _select(page, name)
    page.tap(".hx-orders >> text=Stow")
    said(page, "STOW: 1 done")
    with task(page, "why does it not track, and its remedy"):
        page.tap("[data-tab=heliostat]")
        page.wait_for_selector(f".hx-why:has-text('{name} is STOWED: it is not under automatic')")
        assert "Last order: STOW by operator" in page.inner_text(".hx-why")
        page.tap(".hx-why >> text=Give to automatic control")
        page.wait_for_selector(".hx-why:not(:has-text('it is not under automatic'))")


def test_the_worst_are_found_in_the_table(field: LiveConsole, tablet: Callable[[str], Any]) -> None:
    page = tablet("viewer")
    with task(page, "the worst heliostats"):
        page.tap("[data-tab=heliostats]")
        page.tap(".hx-grid-body .hx-grid-row >> nth=0")
        page.tap(".hx-heliostats >> text=Show the selection")
        until(page, "document.querySelectorAll('.hx-grid-body .hx-grid-row').length === 1")
    errors = page.evaluate("[...heliotrope.store.error].map((one) => one || 0)")
    (chosen,) = page.evaluate("[...heliotrope.store.selection]")
    assert errors[chosen] == pytest.approx(max(errors), rel=0.2)


def test_a_part_of_the_field_is_stowed(field: LiveConsole, tablet: Callable[[str], Any]) -> None:
    page = tablet("operator")
    places = np.asarray(field.live.operations.viewer.positions)[:, :2]
    box = page.locator(".hx-map-field").bounding_box()
    corner = "([x, y]) => heliotropeMap.toScreen(x, y)"
    # From corner to corner of the whole field, which the map shows.
    (x, y), (u, v) = [
        page.evaluate(corner, place.tolist())
        for place in (places.min(axis=0) - 0.5, places.max(axis=0) + 0.5)
    ]
    with task(page, "stow a part of the field"):
        page.select_option("[aria-label='Select by']", "rectangle")
        page.mouse.move(box["x"] + x, box["y"] + y)
        page.mouse.down()
        page.mouse.move(box["x"] + u, box["y"] + v, steps=5)
        page.mouse.up()
        page.tap(".hx-orders >> text=Stow")
        said(page, "STOW")
    chosen = page.evaluate("heliotrope.store.selected()")
    assert len(chosen) > 1
    viewer = field.live.operations.viewer
    field.until(lambda: all(viewer.heliostat(n).state in ("STOWED", "STOWING") for n in chosen))
    page.tap(".hx-orders >> text=Automatic")
    page.tap("dialog >> text='Give to automatic control'")
    said(page, "AUTOMATIC")


def test_out_of_service_and_back(field: LiveConsole, tablet: Callable[[str], Any]) -> None:
    page, name = tablet("operator"), field.live.names[2]
    _select(page, name)
    with task(page, "out of service, until it is parked and locked"):
        page.tap(".hx-orders >> text=Out of service")
        page.fill("dialog [name=reason]", "washing")
        page.tap("dialog >> text='Out of service'")
        said(page, f"OUT_OF_SERVICE: 1 done ({name}: parked in stow and locked out")
    with task(page, "back in service"):
        page.tap("[data-tab=schedule]")
        page.tap(f".hx-schedule tr:has-text('{name}') >> text=Return lock")
        page.tap("dialog >> text='Return lock'")
        until(page, "heliotrope.store.out.every((one) => !one)")


def test_a_group_is_sent_to_a_place(field: LiveConsole, tablet: Callable[[str], Any]) -> None:
    page, names = tablet("operator"), field.live.names[4:6]
    operations = field.live.operations
    page.tap(".hx-authority >> text=Take command")
    page.wait_for_selector(".hx-authority >> text=You have command")
    field.until(lambda: not operations.automatic.view().running)
    _select(page, *names)
    with task(page, "aim of a group"):
        page.tap(".hx-orders >> text=Aim…")
        page.select_option("dialog [name=where]", "standby")
        page.tap("dialog button >> text='Aim'")
        said(page, "IDLE: 2")
    page.tap(".hx-authority >> text=Release")
    page.wait_for_selector(".hx-authority >> text=Take command")


def test_versions_stand_side_by_side(field: LiveConsole, tablet: Callable[[str], Any]) -> None:
    page = tablet("viewer")
    _select(page, field.live.names[0])
    with task(page, "versions side by side"):
        page.tap("[data-tab=heliostat]")
        page.tap("text=Versions…")
        page.wait_for_selector("dialog tr:has-text('tilt_east')")
    box = page.locator("dialog").bounding_box()
    assert 0 <= box["x"] <= 820 - box["width"]
    page.tap("dialog >> text='Close'")


def test_emergency_withdraw_and_resume(field: LiveConsole, tablet: Callable[[str], Any]) -> None:
    page = tablet("operator")
    with task(page, "EMERGENCY"):
        page.tap("#emergency")
        page.wait_for_selector(".hx-alert.on:has-text('done 12')")
    with task(page, "withdraw and resume"):
        page.tap(".hx-alert >> text=Withdraw")
        page.tap("dialog >> text='Withdraw'")
        field.calm()
        page.tap(".hx-alert button >> text=Resume")
        page.tap("dialog >> text='Resume'")
        until(page, "!document.querySelector('.hx-alert.on')")


def test_the_journal_names_who_did_it(field: LiveConsole, tablet: Callable[[str], Any]) -> None:
    page = tablet("operator")
    with task(page, "what a person did"):
        page.tap("[data-tab=logs]")
        page.tap(".hx-logs >> text=journal")
        page.fill("label:has-text('Person') input", "operator")
        page.fill("label:has-text('Text') input", "emergency")
        page.tap(".hx-search >> text=Search")
        page.wait_for_selector(".hx-logs p:has-text('entries')")
    assert page.locator(".hx-logs tbody tr").count() > 0
