"""The operator page in a browser: what people's safety rests on."""

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest

from heliotrope.plant.field.drive_checks import PHOTOGRAPH
from support.live_console import LiveConsole
from support.pages import NEEDS_BROWSER, menu, orders_counted, said, until

pytestmark = NEEDS_BROWSER


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveConsole]:
    """Sixty-four heliostats with the page, at four times the speed of real time."""
    made = LiveConsole(tmp_path_factory.mktemp("safety"), 64, speed=4.0)
    yield made
    made.close()


# -- EMERGENCY above everything ----------------------------------------------------------------


def _open_order(page: Any) -> None:
    page.evaluate("heliotrope.store.select([3], 3)")
    page.click(".hx-orders >> text=Out of service")
    page.wait_for_selector("dialog[open]")


def _open_people(page: Any) -> None:
    menu(page, "People")
    page.click("dialog >> text=Add…")
    page.wait_for_selector("dialog[open] >> nth=1")


def _open_menu(page: Any) -> None:
    page.click(".hx-menu summary")
    page.wait_for_selector(".hx-menu button")


def _by_mouse(page: Any) -> None:
    page.click("#emergency", timeout=30_000)


def _by_touch(page: Any) -> None:
    page.tap("#emergency", timeout=30_000)


def _by_key(page: Any) -> None:
    page.keyboard.press("Alt+e")


@pytest.mark.parametrize("width", [1600, 800])
@pytest.mark.parametrize("give", [_by_mouse, _by_touch, _by_key])
@pytest.mark.parametrize("lay_over", [_open_order, _open_people, _open_menu])
def test_emergency_works_above_everything(
    enter: Callable[..., Any],
    lay_over: Callable[[Any], None],
    give: Callable[[Any], None],
    width: int,
) -> None:
    page = enter("engineer", viewport={"width": width, "height": 700}, has_touch=True)
    calls = orders_counted(page)
    lay_over(page)
    give(page)
    page.wait_for_selector("#emergency-said:has-text('ordered')", timeout=60_000)
    assert len(calls) == 1


def test_emergency_is_reached_by_tab_from_a_dialog(enter: Callable[..., Any]) -> None:
    """The rest of the page cannot be reached while a dialog is open; EMERGENCY can."""
    page = enter("engineer")
    calls = orders_counted(page)
    _open_order(page)
    reached = set()
    for _ in range(12):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.id || document.activeElement.tagName"))
        if "emergency" in reached:
            break
    assert "emergency" in reached, reached
    page.keyboard.press("Enter")
    page.wait_for_selector("#emergency-said:has-text('ordered')")
    assert len(calls) == 1
    # Nothing behind the dialog can be clicked, and the dialog is still there.
    assert page.locator(".hx-orders button").first.evaluate("b => Boolean(b.closest('[inert]'))")
    page.keyboard.press("Escape")
    page.wait_for_selector("dialog", state="detached")
    assert not page.locator("[inert]").count()


def test_every_layer_of_the_page_lies_below_emergency(enter: Callable[..., Any]) -> None:
    page = enter("engineer")
    page.evaluate(
        """() => { const veil = document.createElement('div'); veil.id = 'veil';
        veil.style = 'position:fixed;inset:0;z-index:2147483646'; document.body.append(veil); }"""
    )
    calls = orders_counted(page)
    _by_mouse(page)
    page.wait_for_selector("#emergency-said:has-text('ordered')")
    assert len(calls) == 1


# -- after a loss, and after an emergency ------------------------------------------------------


def test_after_a_loss_of_many_a_person_presses_resume(
    field: LiveConsole, enter: Callable[..., Any]
) -> None:
    page, viewer = enter("operator"), enter("viewer")
    live = field.live

    def up() -> bool:
        found = live.operations.summary().states
        return found.get("IDLE", 0) + found.get("TRACKING", 0) > 40

    field.until(up)
    link = live.links[live.operations.plant.field.clusters[0]]
    field.call(lambda: setattr(link, "plugged", False))
    until(page, "heliotrope.store.state.filter(s => s === 255).length === 32")
    page.wait_for_timeout(3000)
    field.call(lambda: setattr(link, "plugged", True))
    page.wait_for_selector(".hx-alert.on:has-text('left the receiver without an order')")
    viewer.wait_for_selector(".hx-alert.on:has-text('left the receiver')")
    assert not viewer.locator(".hx-alert button").count()
    page.click(".hx-alert button >> text=Resume")
    page.click("dialog >> text=Cancel")
    page.wait_for_timeout(1500)
    assert field.call(lambda: live.operations.summary().resume)
    page.click(".hx-alert button >> text=Resume")
    page.click("dialog >> text='Resume'")
    until(page, "!document.querySelector('.hx-alert.on')")
    assert not field.call(lambda: live.operations.summary().resume)


def test_an_emergency_is_withdrawn_after_one_question_and_its_text_ends(
    field: LiveConsole, enter: Callable[..., Any]
) -> None:
    page = enter("operator")
    page.click("#emergency")
    page.wait_for_selector(".hx-plant p:has-text('ordered by operator')")
    page.click(".hx-alert button >> text=Withdraw")
    page.wait_for_selector("dialog[open] h2:has-text('Withdraw')")
    page.click("dialog >> text=Cancel")
    page.wait_for_timeout(1000)
    assert field.call(lambda: field.live.plant.sentinel.on)
    page.click(".hx-alert button >> text=Withdraw")
    page.click("dialog >> text='Withdraw'")
    field.calm()
    page.wait_for_selector('.hx-alert.on:has-text("wait until an operator presses Resume")')
    page.wait_for_selector(".hx-plant p:has-text('ordered by')", state="detached")
    # Automatic control goes on when nobody else has command, and the page says so.
    page.click(".hx-authority >> text=Take command")
    page.wait_for_selector(".hx-authority >> text=You have command")
    page.click(".hx-alert button >> text=Resume")
    page.wait_for_selector("dialog h2:has-text('as soon as operator releases command')")
    page.click("dialog >> text='Resume'")
    until(page, "!document.querySelector('.hx-alert.on')")
    said(page, "Automatic control goes on as soon as operator releases command.")
    page.click(".hx-authority >> text=Release")
    page.wait_for_selector(".hx-authority >> text=automatic control has command")


def test_the_page_says_what_a_proof_has_measured_and_what_it_believes(
    field: LiveConsole, enter: Callable[..., Any]
) -> None:
    page, name = enter("operator"), field.live.names[3]
    field.call(lambda: field.live.plant.drive_checks.observed(name, PHOTOGRAPH))
    page.click("#emergency")
    page.wait_for_selector(
        ".hx-alert:has-text('measured: the flux is below its limit (10% of nominal, where single')"
        ":has-text('acknowledged 64 of 64 · done 64')"
    )
    # Visits before this test may have photographed others too.
    text = page.inner_text(".hx-alert")
    counts = re.search(r"(\d+) seen to move today by photograph; (\d+) by reports alone: ", text)
    assert counts, text
    followed, believed = (int(count) for count in counts.groups())
    assert followed >= 1
    assert followed + believed == 64
    page.wait_for_selector(".hx-plant dd:has-text('the flux, below its limit')")
    page.wait_for_selector(f".hx-plant dd:has-text('{followed} by photograph')")
    folded = ".hx-plant dt:has-text('Believed by reports alone') + dd details"
    assert page.inner_text(folded).endswith(f"and {believed - 3} more")
    # A frame names twenty of them; unfolded, the list has all, on the tab and in the banner.
    for place in (folded, ".hx-alert details"):  # the banner has first those that are not done
        page.click(f"{place} summary")
        page.wait_for_selector(f"{place}:not(:has-text('…'))")
        first, rest = page.inner_text(place).replace("\n", " ").split(f" and {believed - 3} more")
        names = {*first.split(", "), *rest.strip().split(", ")}
        assert len(names) == believed
        assert names <= set(field.live.names) - {name}
    page.wait_for_timeout(2500)  # two frames
    assert page.locator(".hx-alert details[open]").count() == 1
    stop = page.locator("#emergency").bounding_box()
    assert page.locator(".hx-alert").bounding_box()["y"] >= stop["y"] + stop["height"]
    page.click(".hx-alert button >> text=Withdraw")
    page.click("dialog >> text='Withdraw'")
    field.calm()


def test_a_refused_acknowledgement_is_not_shown_as_done(enter: Callable[..., Any]) -> None:
    page = enter("operator")
    row = {"at": 1.0, "condition": "wind_gust_stow", "subject": "", "severity": "alarm"}
    row |= {"text": "gusts", "active": True, "acknowledged_by": "", "count": 1}
    page.route("**/api/v1/alarms", lambda route: route.fulfill(json=[row]))
    refusal = {"detail": "wind_gust_stow: its cause has not gone"}
    page.route(
        "**/api/v1/alarms/acknowledge", lambda route: route.fulfill(status=409, json=refusal)
    )
    page.click(".hx-tabs >> text=Alarms")
    page.click(".hx-alarms >> text=Acknowledge all")
    said(page, "wind_gust_stow: its cause has not gone")


def test_alarms_that_say_the_same_of_many_are_one_line(enter: Callable[..., Any]) -> None:
    page, asked = enter("operator"), list[str]()
    alarm = {"at": 1.0, "condition": "node_silent", "severity": "alarm", "active": True}
    alarm |= {"acknowledged_by": "", "count": 1}
    rows = [
        {**alarm, "subject": f"P{k:04d}", "text": f"P{k:04d}: no answer for 10 s"}
        for k in range(57)
    ]
    rows.append({**alarm, "subject": "P0900", "text": "P0900: no answer for 20 s"})
    page.route("**/api/v1/alarms", lambda route: route.fulfill(json=rows))

    def acknowledge(route: Any) -> None:
        asked.append(route.request.post_data_json["subject"])
        route.fulfill(json={})

    page.route("**/api/v1/alarms/acknowledge", acknowledge)
    page.click(".hx-tabs >> text=Alarms")
    page.wait_for_selector(".hx-alarms >> text=58 not acknowledged, 58 active")
    assert page.locator(".hx-alarms tbody tr").count() == 2
    line = page.locator(".hx-alarms tbody tr").first
    assert "P0000, P0001, P0002 and 54 more" in line.inner_text()
    assert "each: no answer for 10 s" in line.inner_text()
    line.locator("text=Acknowledge").click()
    said(page, "acknowledge: done")
    assert sorted(asked) == [row["subject"] for row in rows[:57]]


# -- out of service ----------------------------------------------------------------------------


def test_a_heliostat_out_of_service_is_shown_and_given_back_by_name(
    field: LiveConsole, enter: Callable[..., Any]
) -> None:
    page, viewer = enter("operator"), enter("viewer")
    # One that is not in stow: from there it would be parked at once.
    row = page.evaluate(
        "heliotrope.store.field.names.findIndex("
        "(_, row) => !['STOWED', 'stale'].includes(heliotrope.store.stateName(row)))"
    )
    assert row >= 0
    name = field.live.names[row]
    page.evaluate("row => heliotrope.store.select([row], row)", row)
    page.click(".hx-orders >> text=Out of service")
    page.fill("dialog [name=reason]", "washing")
    page.fill("dialog [name=hours]", "2")
    page.click("dialog >> text='Out of service'")
    for each in (page, viewer):
        each.wait_for_selector(".hx-legend .hx-out:has-text('out of service 1')")
        assert each.evaluate("[...heliotrope.store.out].indexOf(1)") == row
    said(page, f"OUT_OF_SERVICE: 1 acknowledged ({name}: on its way to stow: ")
    said(page, f"OUT_OF_SERVICE: 1 done ({name}: parked in stow and locked out")
    assert field.live.operations.viewer.heliostat(name).state == "STOWED"
    page.click(".hx-tabs >> text=Heliostat")
    page.wait_for_selector(".hx-heliostat dd:has-text('washing (operator, since')")
    page.wait_for_selector(".hx-heliostat dd:has-text('expected back'):has-text('in stow')")
    # The switch at the mirror confirms it.
    operations = field.live.operations
    with pytest.MonkeyPatch.context() as patch:
        shown = replace(
            operations.viewer.heliostat(name), state="LOCKED", flags=("AT_STOW", "LOCAL_SWITCH")
        )
        patch.setattr(operations.viewer, "heliostat", lambda _: shown)
        page.wait_for_selector(".hx-heliostat dd:has-text('in stow; confirmed at the mirror')")
        page.wait_for_selector(".hx-heliostat dd:has-text('drives off: nothing moves it')")
    # The whole field is given to automatic control: it stays where it is.
    page.select_option(".hx-to select", "field")
    page.click(".hx-orders >> text=Automatic")
    page.click("dialog >> text='Give to automatic control'")
    said(page, f"{name}: out of service: washing")
    assert field.call(lambda: field.live.operations.viewer.heliostat(name).state) == "STOWED"
    page.click(".hx-tabs >> text=Schedule")
    shown_row = page.locator(f".hx-schedule tr:has-text('{name}'):has-text('washing')")
    assert "STOWED" in shown_row.inner_text()
    shown_row.locator("text=Return lock").click()
    page.click("dialog >> text='Return lock'")
    until(page, "heliotrope.store.out.every((one) => !one)")
    until(page, "!document.querySelector('.hx-legend .hx-out')")


def test_a_target_is_locked_and_the_lock_returned(
    field: LiveConsole, enter: Callable[..., Any]
) -> None:
    page, other = enter("operator"), enter("engineer")
    target = field.live.operations.targets[0]
    for each in (page, other):
        each.click(".hx-tabs >> text=Schedule")
    page.click(".hx-schedule >> text=Lock a target, receiver or the tower")
    page.select_option("dialog [name=place]", f"target {target}")
    page.fill("dialog [name=reason]", "marks are repainted")
    page.click("dialog >> text='Lock'")
    row = f".hx-schedule tr:has-text('target {target}'):has-text('marks are repainted')"
    for each in (page, other):
        each.wait_for_selector(row)
    # Another person removes it by the owner's name, with a reason.
    other.locator(row).locator("text=Remove lock").click()
    other.wait_for_selector("dialog:has-text('Remove the lock of operator')")
    other.keyboard.press("Escape")
    page.locator(row).locator("text=Return lock").click()
    page.click("dialog >> text='Return lock'")
    page.wait_for_selector(row, state="detached")
    assert target not in {one.name for one in field.live.operations.automatic.service.out}


# -- scope -------------------------------------------------------------------------------------


def _take_command(page: Any) -> None:
    page.click(".hx-authority >> text=Take command")
    page.wait_for_selector(".hx-authority:has-text('You have command')")


def _release(page: Any) -> None:
    """Release it, and wait until that has arrived: a page that closes takes its request along."""
    page.click(".hx-authority >> text=Release")
    page.wait_for_selector(".hx-authority >> text=Take command")


def _sent(page: Any, *paths: str) -> list[Any]:
    """Answer some requests in place of the plant; return the list of them."""
    bodies: list[Any] = []

    def take(route: Any) -> None:
        bodies.append(route.request.post_data_json)
        route.fulfill(status=204)

    for path in paths:
        page.route(f"**/api/v1/{path}", take)
    return bodies


def test_the_scope_follows_the_selection(field: LiveConsole, enter: Callable[..., Any]) -> None:
    page, name = enter("engineer"), field.live.names[5]
    sent = _sent(page, "commands", "aim")
    _take_command(page)
    scope = page.locator(".hx-to select")
    for wide in ("field", "cluster"):
        for button in ("Aim…", "Search…", "Jog…"):
            page.evaluate("heliotrope.store.select([1, 2], -1)")
            scope.select_option(wide)
            page.evaluate("heliotrope.store.select([5], 5)")
            assert scope.input_value() == "selection"
            page.click(f".hx-orders >> text={button}")
            page.wait_for_selector(f"dialog h2:has-text('{name}')")
            page.click(f"dialog button >> text={button[:-1] if wide == 'field' else 'Cancel'}")
            page.wait_for_selector("dialog", state="detached")
    page.wait_for_timeout(500)
    assert [one["heliostats"] for one in sent] == [[name]] * 3
    _release(page)


def test_motion_of_the_whole_field_asks_once_and_safe_orders_never(
    enter: Callable[..., Any],
) -> None:
    page = enter("engineer")
    sent = _sent(page, "commands", "stow", "defocus", "automatic")
    _take_command(page)
    page.select_option(".hx-to select", "field")
    for button in ("Approach", "Track", "Standby", "Refocus", "Unlock", "Clear fault", "Automatic"):
        page.locator(".hx-orders button", has_text=button).first.click()
        page.wait_for_selector("dialog h2:has-text('all 64 heliostats')")
        page.keyboard.press("Escape")
        page.wait_for_selector("dialog", state="detached")
    assert not sent
    for button in ("Stow", "Defocus"):
        page.click(f".hx-orders >> text={button}")
        page.wait_for_timeout(300)
        assert not page.locator("dialog").count()
    assert sent == [{"heliostats": []}] * 2
    _release(page)
