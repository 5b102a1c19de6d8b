"""The operator page in a browser."""

import json
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from heliotrope.console._secrets import verify_password
from heliotrope.console.people import FIRST, first_start
from heliotrope.store.keeper import Keeper
from heliotrope.store.people import UNSET, ApiToken, Session
from support.live_console import PASSWORD, LiveConsole
from support.pages import NEEDS_BROWSER, SCREENS, drag, menu, press, said, until

pytestmark = NEEDS_BROWSER


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveConsole]:
    """Three hundred and twenty heliostats with the page, at four times the speed of real time."""
    made = LiveConsole(tmp_path_factory.mktemp("page"), 320, speed=4.0)
    yield made
    made.close()


def test_log_in_and_look(field: LiveConsole, enter: Callable[[str], Any]) -> None:
    page = enter("viewer")
    assert page.inner_text(".hx-name")
    assert "View only" in page.inner_text(".hx-bar")
    assert page.locator(".hx-bar button:visible").count() == 0
    for title in ("Heliostat", "Targets", "Calibration", "Clusters", "Alarms", "Logs", "Schedule"):
        page.click(f".hx-tabs >> text={title}")
        page.wait_for_selector(f".hx-panels .hx-{title.lower()} >> css=*")
    # A viewer who asks the API by hand is refused too.
    status = page.evaluate(
        """async () => (await fetch('/api/v1/stow', {method: 'POST', body: '{}', headers: {
        'Content-Type': 'application/json', 'X-CSRF-Token':
        document.querySelector('meta[name=heliotrope-csrf]').content}})).status"""
    )
    assert status == 403


def test_a_one_time_link_opens_the_page_once(field: LiveConsole, browser: Any) -> None:
    """A link that was used shows what to do; the person who used it goes on."""
    people, name = field.keeper.people, "by link"
    people.add(name, UNSET, "engineer", time.time())
    link = field.interface.one_time_link(name, field.address)
    first, other = browser.new_context(), browser.new_context()
    try:
        page = first.new_page()
        page.goto(link)
        page.wait_for_selector(".hx-legend b")
        assert page.url == field.address
        late = other.new_page()
        answer = late.goto(link)
        assert answer.status == 410
        assert "This link is not valid" in late.inner_text("h1")
        assert "it prints a new link" in late.inner_text("main")
        late.click("a >> text=Sign in")
        late.wait_for_url("**/login")
        again = first.new_page()
        assert again.goto(link).status == 410
        again.click("text=open the console")
        again.wait_for_selector(".hx-legend b")
    finally:
        first.close()
        other.close()
        people.remove(name)


def test_first_start(field: LiveConsole, browser: Any, tmp_path: Path) -> None:
    """What the first start prints signs in once, to change it; it is not printed again."""
    keeper = Keeper(tmp_path / "store.sqlite", inline=True)
    password = first_start(keeper.people, time.time())
    console = field.server.app.state.console
    before = field.call(lambda: console.people)

    async def valid(used: list[str]) -> dict[tuple[str, str], Session | ApiToken]:
        found = keeper.people.valid(time.time(), used)
        return {("session", one.key): one for one in found.sessions}

    field.call(lambda: setattr(console, "people", keeper.people))
    field.call(lambda: setattr(console.plant, "valid", valid))
    page = browser.new_page()
    try:
        page.goto(f"{field.address}login")
        page.fill("[name=name]", FIRST)
        page.fill("[name=password]", password)
        page.click("button")
        page.wait_for_url("**/account")
        page.wait_for_selector("#due:has-text('Change it before you go on')")
        page.fill("[name=old]", password)
        for name in ("new", "again"):
            page.fill(f"[name={name}]", "a password of my own")
        page.click("button")
        page.wait_for_url("**/login")
        page.fill("[name=name]", FIRST)
        page.fill("[name=password]", "a password of my own")
        page.click("button")
        page.wait_for_selector(".hx-legend b")
        assert first_start(keeper.people, time.time()) is None
    finally:
        page.close()
        field.call(lambda: setattr(console, "people", before))
        field.call(lambda: delattr(console.plant, "valid"))
        keeper.close()


def test_wrong_password(field: LiveConsole, browser: Any) -> None:
    page = browser.new_page()
    page.goto(f"{field.address}login")
    page.fill("[name=name]", "operator")
    page.fill("[name=password]", "not the password")
    page.click("button")
    page.wait_for_selector("#said:has-text('wrong')")
    page.close()


def test_select_by_lasso_and_stow(field: LiveConsole, enter: Callable[[str], Any]) -> None:
    field.until(lambda: field.live.operations.summary().states.get("STOWED", 0) < 160)
    page = enter("operator")
    page.select_option("[aria-label='Select by']", "lasso")
    box = page.locator(".hx-map-field").bounding_box()
    left, top = box["x"] + 4, box["y"] + 0.1 * box["height"]
    right, bottom = box["x"] + 0.78 * box["width"], box["y"] + 0.97 * box["height"]
    page.mouse.move(left, top)
    page.mouse.down()
    for x, y in ((right, top), (right, bottom), (left, bottom), (left, top + 5)):
        page.mouse.move(x, y, steps=5)
    page.mouse.up()
    chosen = page.evaluate("heliotrope.store.selected()")
    assert 200 <= len(chosen) < 320
    page.click(".hx-orders >> text=Stow")
    said(page, "STOW")
    kept = set(field.live.names) - set(chosen)

    def now_() -> float:
        return field.live.operations.plant.now()

    def elsewhere() -> dict[str, str]:
        state, now = field.live.operations.plant.field.of, now_()
        states = {name: state(name, now).state for name in chosen}
        return {name: s for name, s in states.items() if s not in ("STOWED", "STOWING")}

    began = time.monotonic()
    while left := field.call(elsewhere):
        assert time.monotonic() < began + 120.0, left
        time.sleep(0.2)
    others = field.call(
        lambda: {field.live.operations.plant.field.of(name, now_()).state for name in kept}
    )
    assert others - {"STOWED", "STOWING"}
    page.keyboard.press("Escape")


def _drag(page: Any, start: tuple[float, float], end: tuple[float, float]) -> None:
    """Drag over the map between two places of the field, ENU, m, with Shift."""
    box = page.locator(".hx-map-field").bounding_box()
    at = [
        page.evaluate("([x, y]) => heliotropeMap.toScreen(x, y)", place) for place in (start, end)
    ]
    page.keyboard.down("Shift")
    drag(page, *((box["x"] + x, box["y"] + y) for x, y in at))
    page.keyboard.up("Shift")


@pytest.mark.parametrize("screen", SCREENS)
def test_shapes_rows_and_clusters_select(
    field: LiveConsole, enter: Callable[..., Any], screen: str
) -> None:
    page = enter("viewer", **SCREENS[screen])
    places = np.asarray(field.live.operations.viewer.positions)[:, :2]
    tower = page.evaluate("heliotrope.store.field.tower.slice(0, 2)")
    away = np.hypot(*(places - tower).T)
    azimuth = np.arctan2(*(places - tower).T)
    middle = int(np.argsort(away)[len(away) // 2])
    (east, north), step = places[middle], 12.0

    def selected() -> set[int]:
        return set(page.evaluate("[...heliotrope.store.selection]"))

    page.select_option("[aria-label='Select by']", "rectangle")
    corners = (east - step, north - step), (east + step, north + step)
    _drag(page, *corners)
    inside = (np.abs(places - places[middle]) < step).all(axis=-1)
    assert selected() == set(np.flatnonzero(inside).tolist())
    # A straight line of the lasso is the diagonal of the same rectangle.
    page.keyboard.press("Escape")
    page.select_option("[aria-label='Select by']", "lasso")
    _drag(page, *corners)
    assert selected() == set(np.flatnonzero(inside).tolist())
    said(page, f"{inside.sum()} heliostats in the lasso")
    page.select_option("[aria-label='Select by']", "sector")
    _drag(page, *corners)
    (near, first), (far, last) = [
        (np.hypot(x - tower[0], y - tower[1]), np.arctan2(x - tower[0], y - tower[1]))
        for x, y in corners
    ]
    turn = (azimuth - first + np.pi) % (2 * np.pi) - np.pi
    wide = (last - first + np.pi) % (2 * np.pi) - np.pi
    ring = (away > min(near, far)) & (away < max(near, far))
    expected = ring & (turn * np.sign(wide) > 0.0) & (np.abs(turn) < abs(wide))
    # The arcs are drawn with corners, and pixels are not metres.
    assert len(selected() ^ set(np.flatnonzero(expected).tolist())) <= 0.05 * expected.sum() + 1
    page.select_option("[aria-label='Select by']", "cluster")
    spot = page.evaluate(
        f"heliotropeMap.toScreen(heliotropeMap.x[{middle}], heliotropeMap.y[{middle}])"
    )
    press(page, ".hx-map-field", position={"x": spot[0], "y": spot[1]})
    cluster = field.live.operations.plant.field.cluster
    assert selected() == set(np.flatnonzero(cluster == cluster[middle]).tolist())
    page.select_option("[aria-label='Select by']", "row")
    press(page, ".hx-map-field", position={"x": spot[0], "y": spot[1]})
    assert middle in selected()
    assert len(selected()) > 3
    page.select_option("[aria-label='Select by']", "pan")
    page.keyboard.press("Escape")


def test_the_worst_heliostats_are_found_and_kept(
    field: LiveConsole, enter: Callable[[str], Any]
) -> None:
    page = enter("viewer")
    page.click("[data-tab=heliostats]")
    page.wait_for_selector(".hx-grid-body .hx-grid-row")
    # Of 320 rows only those in view are there.
    assert page.locator(".hx-grid-body .hx-grid-row").count() < 100
    page.click("[role=columnheader]:has-text('North')")
    rows = page.locator(".hx-grid-body .hx-grid-row")
    north = np.asarray(field.live.operations.viewer.positions)[:, 1]
    names = np.asarray(field.live.names)
    page.wait_for_selector(
        f".hx-grid-body .hx-grid-row:first-child:has-text('{names[np.argmax(north)]}')"
    )
    rows.nth(0).click()
    rows.nth(4).click(modifiers=["Shift"])
    best = set(page.evaluate("heliotrope.store.selected()"))
    assert best == set(names[np.argsort(-north, kind="stable")[:5]].tolist())
    page.click("text=Save selection…")
    page.fill(".hx-dialog input", "far five")
    page.click(".hx-dialog button:has-text('Save')")
    page.wait_for_selector(
        "[aria-label='Saved selections'] option[value='far five']", state="attached"
    )
    page.evaluate("heliotrope.store.select([], -1)")
    page.select_option("[aria-label='Saved selections']", "far five")
    assert set(page.evaluate("heliotrope.store.selected()")) == best
    with page.expect_download() as saving:
        page.click(".hx-heliostats >> text=Save as CSV")
    lines = Path(saving.value.path()).read_text("utf-8").splitlines()
    assert lines[0].startswith("Name,State,On,Predicted error (mrad)")
    assert len(lines) == 321
    page.fill(".hx-heliostats .hx-query", f"name = {names[3]}")
    page.click(".hx-heliostats >> text=Show >> nth=0")
    until(page, "document.querySelectorAll('.hx-grid-body .hx-grid-row').length === 1")
    page.evaluate("localStorage.clear()")
    page.keyboard.press("Escape")


def test_the_journal_finds_what_a_person_did(
    field: LiveConsole, enter: Callable[[str], Any]
) -> None:
    page = enter("operator")
    name = field.live.names[7]
    page.evaluate("heliotrope.store.select([7], 7)")
    page.click(".hx-orders >> text=Stow")
    said(page, "STOW: 1 done")
    page.click("[data-tab=logs]")
    page.click(".hx-logs >> text=journal")
    page.fill("label:has-text('Heliostat') input", name)
    page.fill("label:has-text('Text') input", "stow")
    page.click(".hx-search >> text=Search")
    page.wait_for_selector(f".hx-logs td:has-text('operator: STOW {name}')")
    page.click("[data-tab=heliostat]")
    page.wait_for_selector(f".hx-why:has-text('{name} is STOWED: it is not under automatic')")
    page.click(".hx-why >> text=Give to automatic control")
    page.wait_for_selector(".hx-why:has-text('it is under automatic control')")


def test_query_and_detail(field: LiveConsole, enter: Callable[[str], Any]) -> None:
    page = enter("viewer")
    name = field.live.names[20]
    page.keyboard.press("/")
    page.keyboard.type(name.lower())
    page.keyboard.press("Enter")
    said(page, f"{name} is selected")
    page.click(".hx-tabs >> text=Heliostat")
    page.wait_for_selector(f".hx-heliostat h2:has-text('{name}')")
    page.fill(".hx-query", "speed > 3")
    page.keyboard.press("Enter")
    said(page, 'no field "speed"')
    page.fill(".hx-query", f"{name}B")
    page.keyboard.press("Enter")
    said(page, f'there is no heliostat "{name}B"; did you mean ')
    said(page, name)
    said(page, "?; write its name, or: state = TRACKING and error > 1")
    page.fill(".hx-query", f"{name}, {field.live.names[21]}")
    page.keyboard.press("Enter")
    until(page, "heliotrope.store.selection.size === 2")
    page.fill(".hx-query", f"name = {name}")
    page.keyboard.press("Enter")
    until(page, "heliotrope.store.selection.size === 1")
    page.fill(".hx-query", "cluster = C001 or cluster = C002 and east < 1e9")
    page.keyboard.press("Enter")
    until(page, "heliotrope.store.selection.size === 64")


def test_calibrate_now_is_for_operators(field: LiveConsole, enter: Callable[[str], Any]) -> None:
    name = field.live.names[20]
    for role in ("viewer", "operator"):
        page = enter(role)
        page.evaluate("heliotrope.store.select([20], 20)")
        page.click(".hx-tabs >> text=Heliostat")
        page.wait_for_selector(".hx-heliostat >> text=Kept photographs")
        button = page.locator(".hx-heliostat >> text=Calibrate now")
        assert button.count() == (role == "operator")
    # The bar says how far it is, and at last the result.
    matches = "text => RegExp(text).test(document.querySelector('.hx-bar .hx-said').textContent)"
    control = field.live.operations.automatic
    field.call(lambda: control.want([name], wanted=True))
    button.click()
    until(page, matches, f"CALIBRATE: 1 (waiting|acknowledged) .{name}: (it is waiting: |at )")
    # In a field that other tests command its turn may never come: it ends when it is withdrawn.
    field.call(lambda: control.want([name], wanted=False))
    until(page, matches, f"CALIBRATE: 1 (done|failed|refused) .{name}: (at .*: |withdrawn: )")


def test_a_tablet_has_all_of_it(field: LiveConsole, enter: Callable[[str], Any]) -> None:
    page = enter("engineer")
    page.set_viewport_size({"width": 1024, "height": 768})
    page.wait_for_timeout(300)
    assert page.evaluate("document.documentElement.scrollWidth") <= 1024
    for what in (
        "#emergency",
        ".hx-map-field",
        ".hx-side",
        ".hx-orders >> text=Stow",
        ".hx-orders >> text=Zero",
        ".hx-authority button",
    ):
        box = page.locator(what).first.bounding_box()
        assert 0 <= box["x"] <= 1024 - box["width"], what
        assert 0 <= box["y"] <= 768 - box["height"], what
    map_, foot = (page.locator(x).bounding_box() for x in (".hx-map", ".hx-footer"))
    assert map_["y"] + map_["height"] <= foot["y"] + 1


def test_an_engineer_keeps_the_accounts(field: LiveConsole, enter: Callable[[str], Any]) -> None:
    page, people = enter("engineer"), field.keeper.people
    menu(page, "People")
    dialog = page.locator("dialog.wide")
    dialog.locator("tr:has-text('operator')").first.wait_for()
    dialog.locator("text=Add…").click()
    page.fill("dialog:last-of-type [name=name]", "desk-1")
    page.fill("dialog:last-of-type [name=password]", "long enough for it")
    page.fill("dialog:last-of-type [name=own_password]", PASSWORD)
    page.click("dialog:last-of-type >> text='Create account'")
    row = dialog.locator("tr:has-text('desk-1')")
    row.wait_for()
    row.locator("select").select_option("operator")
    page.fill("dialog:last-of-type [name=own_password]", PASSWORD)
    page.click("dialog:last-of-type >> text='Change'")
    dialog.locator(".hx-told:has-text('desk-1: operator')").wait_for()
    assert people.account("desk-1").role == "operator"
    row.locator("text=New password").click()
    page.fill("dialog:last-of-type [name=own_password]", PASSWORD)
    late: list[Any] = []
    page.route("**/accounts", lambda route: late.append(route))  # noqa: PLW0108 - it wants a function
    page.click("dialog:last-of-type >> text='Create'")
    word = dialog.locator(".hx-secret").inner_text()
    assert verify_password(people.account("desk-1").password_hash, word)
    # Until the rows are those of now, nothing in them takes a click that would be lost.
    dialog.locator("[inert]").wait_for(state="attached")
    late[0].continue_()
    page.unroute("**/accounts")
    dialog.locator("[inert]").wait_for(state="detached")
    row.locator("text=Disable").click()
    page.fill("dialog:last-of-type [name=own_password]", PASSWORD)
    page.click("dialog:last-of-type >> text='Disable'")
    row.locator("text=disabled").wait_for()
    assert people.account("desk-1").disabled
    # Told once: it is gone with whatever is done next.
    assert word not in page.content()
    assert dialog.locator("tr:has-text('engineer') >> text=you").count() == 1


def test_tokens_are_made_and_revoked(field: LiveConsole, enter: Callable[[str], Any]) -> None:
    page, people = enter("viewer"), field.keeper.people
    menu(page, "API tokens")
    assert page.locator(".hx-menu >> text=People").count() == 0
    dialog = page.locator("dialog.wide")
    dialog.locator("text=Create…").click()
    page.fill("dialog:last-of-type [name=label]", "nightly")
    assert page.locator("dialog:last-of-type [name=role] option").all_inner_texts() == ["viewer"]
    page.fill("dialog:last-of-type [name=own_password]", PASSWORD)
    page.click("dialog:last-of-type >> text='Create'")
    secret = dialog.locator(".hx-secret").inner_text()
    assert people.token(secret, time.time()).label == "nightly"
    dialog.locator("tr:has-text('nightly') >> text=Revoke").click()
    page.fill("dialog:last-of-type [name=own_password]", PASSWORD)
    page.click("dialog:last-of-type >> text='Revoke'")
    dialog.locator("text=No token").wait_for()
    assert people.token(secret, time.time()) is None


def test_the_own_password_is_changed(field: LiveConsole, enter: Callable[[str], Any]) -> None:
    page, people = enter("viewer"), field.keeper.people
    kept = people.account("viewer").password_hash
    for again, text in (("a different one", "differ"), ("one long enough", "")):
        menu(page, "Change password")
        for name, value in (("old", PASSWORD), ("new", "one long enough"), ("again", again)):
            page.fill(f"dialog [name={name}]", value)
        page.click("dialog >> text='Change'")
        if text:
            said(page, text)
    page.wait_for_url("**/login")
    assert verify_password(people.account("viewer").password_hash, "one long enough")
    people.change("viewer", time.time(), password_hash=kept)


def test_dark_and_light(enter: Callable[[str], Any]) -> None:
    page = enter("viewer")
    ground = "getComputedStyle(document.body).backgroundColor"
    night = page.evaluate(ground)
    page.click("[aria-label='Dark or light']")
    until(page, f"{ground} !== '{night}'")
    page.reload()
    page.wait_for_selector(".hx-legend b")
    assert page.evaluate(ground) != night


def test_the_tabs_are_reached_by_keys(enter: Callable[[str], Any]) -> None:
    page = enter("viewer")
    page.focus(".hx-tabs [aria-selected=true]")
    for key, kind in (("ArrowRight", "heliostat"), ("ArrowLeft", "plant"), ("End", "shift")):
        page.keyboard.press(key)
        page.wait_for_selector(f".hx-tabs [data-tab={kind}][aria-selected=true]:focus")
        page.wait_for_selector(f".hx-panels > .hx-{kind}")
        assert page.locator(".hx-panels > *").count() == 1


def test_the_menu_closes(enter: Callable[[str], Any]) -> None:
    page = enter("viewer")
    for close in (lambda: page.keyboard.press("Escape"), lambda: page.click(".hx-map-field")):
        page.click(".hx-menu summary")
        page.wait_for_selector(".hx-menu button >> text=Sign out")
        close()
        page.wait_for_selector(".hx-menu button >> nth=0", state="hidden")


def test_the_head_fits_into_every_width(enter: Callable[[str], Any]) -> None:
    """Each part of the head is whole, and none lies below EMERGENCY."""
    page = enter("engineer")
    for width in (1440, 1280, 1024, 900, 820, 600):
        page.set_viewport_size({"width": width, "height": 900})
        stop = page.locator("#emergency").bounding_box()
        for part in (".hx-live", ".hx-authority button", ".hx-theme", ".hx-menu"):
            box = page.locator(part).bounding_box()
            beside = box["x"] + box["width"] <= stop["x"]
            assert beside or box["y"] >= stop["y"] + stop["height"], (width, part)
        for part in (".hx-head", ".hx-name", ".hx-tabs"):
            assert page.locator(part).evaluate("e => e.scrollWidth <= e.clientWidth"), (width, part)
        # Of all parts, the speed of a simulation gives way first.
        assert page.evaluate("""() => {
            const name = document.querySelector(".hx-name");
            const hint = document.querySelector(".hx-head .hx-hint");
            hint.textContent = "simulated at 2.0 × real time";
            return name.scrollWidth <= name.clientWidth;
        }"""), width
        assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_no_button_moves_when_the_bar_says_something(enter: Callable[[str], Any]) -> None:
    page = enter("engineer")
    places = "[...document.querySelectorAll('.hx-bar button')].map((b) => b.offsetTop)"
    for width in (1600, 1440, 1280, 820):
        page.set_viewport_size({"width": width, "height": 900})
        page.evaluate("heliotrope.store.emit('said', {text: ''})")
        before = page.evaluate(places)
        page.evaluate("heliotrope.store.emit('said', {text: 'Stow: done'})")
        assert page.evaluate(places) == before, width


@pytest.mark.parametrize("width", [1440, 820])
def test_a_long_text_of_the_bar_is_unfolded_by_touch_and_by_key(
    enter: Callable[..., Any], width: int
) -> None:
    page = enter("operator", has_touch=True, viewport={"width": width, "height": 900})
    say = "text => heliotrope.store.emit('said', {text})"
    text, button = page.locator(".hx-bar .hx-said"), page.locator(".hx-unfold")
    cut = "e => e.scrollWidth > e.clientWidth"
    page.evaluate(say, "STOW: " + "; ".join(f"P{k:04d}A: it is out of service" for k in range(40)))
    assert text.evaluate(cut)
    for unfold in (button.tap, text.tap, lambda: button.press("Enter")):
        unfold()
        assert not text.evaluate(cut)
        box = text.bounding_box()
        assert 0 <= box["x"] <= width - box["width"]
        assert 0 <= box["y"] <= 900 - box["height"]
        # The progress of a command does not fold what is being read.
        page.evaluate(say, "STOW: " + "; ".join(f"P{k:04d}A: it is on its way" for k in range(50)))
        assert not text.evaluate(cut)
        button.press("Escape")
        assert text.evaluate(cut)
    page.evaluate(say, "STOW: 1 done")
    assert not button.is_visible()


@pytest.mark.parametrize("width", [1440, 1280, 820])
def test_the_legend_covers_no_heliostat(enter: Callable[..., Any], width: int) -> None:
    page = enter("viewer", viewport={"width": width, "height": 900})
    for view in ("state", "error", "cluster"):
        page.select_option("[aria-label='Colour by']", view)
        map_, legend = (page.locator(x).bounding_box() for x in (".hx-map-field", ".hx-legend"))
        assert legend["height"] > 10
        assert map_["y"] + map_["height"] <= legend["y"] + 0.5
        assert map_["height"] > 250, view


def test_what_is_drawn_anew_takes_no_click_and_no_focus_away(enter: Callable[..., Any]) -> None:
    page = enter("operator")
    row = {"at": 1.0, "condition": "wind_gust_stow", "subject": "", "severity": "alarm"}
    row |= {"text": "gusts", "active": True, "acknowledged_by": "", "count": 1}
    page.route("**/api/v1/alarms", lambda route: route.fulfill(json=[row]))
    page.click(".hx-tabs >> text=Alarms")
    page.focus(".hx-alarms td button")
    held = page.evaluate(
        """async () => {
        const wait = (ms) => new Promise((wake) => setTimeout(wake, ms));
        const press = (name) => old.dispatchEvent(new PointerEvent(name, {bubbles: true}));
        const old = document.querySelector('.hx-alarms td button');
        press('pointerdown');
        heliotrope.store.head.alarms = -1;
        heliotrope.store.emit('frame', heliotrope.store.head);
        await wait(400);
        const held = old.isConnected;
        press('pointerup');
        for (let i = 0; old.isConnected && i < 100; i++) await wait(100);
        return [held, old.isConnected];
        }"""
    )
    assert held == [True, False]
    assert page.evaluate("document.activeElement.matches('.hx-alarms td button')")


def test_a_row_of_the_table_takes_a_press_longer_than_a_frame(enter: Callable[..., Any]) -> None:
    page = enter("viewer")
    page.click("[data-tab=heliostats]")
    page.locator(".hx-grid-body .hx-grid-row").nth(2).hover()
    frames = "heliotrope.store.received"
    page.mouse.down()
    for _ in range(2):
        until(page, f"{frames} > {page.evaluate(frames)}")
    page.mouse.up()
    until(page, "heliotrope.store.selection.size === 1")
    # The column's button stays, and with it the keyboard's focus.
    page.focus("[role=columnheader] >> nth=0")
    page.keyboard.press("Enter")
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.textContent") == "Name ↓"


@pytest.mark.parametrize("width", [1440, 820])
def test_the_table_draws_only_rows_in_view(enter: Callable[..., Any], width: int) -> None:
    page = enter("viewer", viewport={"width": width, "height": 1000})
    page.click("[data-tab=heliostats]")
    rows = page.locator(".hx-grid-body .hx-grid-row")
    page.wait_for_selector(".hx-grid-body .hx-grid-row")
    page.evaluate("document.querySelector('.hx-grid').scrollTop = 1e6")
    until(page, "document.querySelector('.hx-grid-body .hx-grid-row').offsetTop > 1000")
    assert rows.count() < 100
    # By small steps, up and down, each row is there once, in order.
    for step in (-90, -50, 60, 30):
        page.evaluate("step => { document.querySelector('.hx-grid').scrollTop += step; }", step)
        page.wait_for_timeout(50)
        tops = rows.evaluate_all("all => all.map((one) => one.offsetTop)")
        assert tops == list(range(tops[0], tops[0] + 27 * len(tops), 27))


def test_the_page_waits_for_a_plant_that_does_not_answer_yet(enter: Callable[[str], Any]) -> None:
    page = enter("operator")
    away = {"detail": "the plant does not answer"}
    page.route("**/api/v1/field", lambda route: route.fulfill(status=503, json=away))
    page.reload()
    said(page, "no data from the plant, asking again: the plant does not answer")
    page.unroute("**/api/v1/field")
    page.wait_for_selector(".hx-legend b")
    until(page, "document.querySelector('.hx-bar .hx-said').textContent === ''")


def test_calibration_is_seen(field: LiveConsole, enter: Callable[[str], Any]) -> None:
    page = enter("viewer")
    page.click(".hx-tabs >> text=Calibration")
    page.wait_for_selector(".hx-calibration td span.good:has-text('✓')", timeout=180_000)
    row = page.inner_text(".hx-calibration tbody tr:has(span.good:has-text('✓')) >> nth=0")
    assert any(target in row for target in field.live.operations.targets)
    page.select_option(".hx-tools select", "error")
    until(page, "heliotrope.store.error.some(e => e > 0 && e < 3e-3)")


def test_emergency_is_one_click(field: LiveConsole, enter: Callable[[str], Any]) -> None:
    page = enter("engineer")
    page.click("#emergency")
    order = field.until(lambda: field.live.operations.plant.sentinel.order)
    assert order.who == "engineer"
    page.wait_for_selector(".hx-alert.on")
    until(
        page, "document.querySelector('.hx-alert').textContent.includes('acknowledged 320 of 320')"
    )
    page.click(".hx-alert >> text=Withdraw")
    page.click("dialog >> text='Withdraw'")
    # Resume acknowledges the order; a row of the table that still holds is named, and acknowledged.
    page.click(".hx-tabs >> text=Alarms")
    end = time.monotonic() + 120.0
    while page.locator(".hx-alert.on").count():
        assert time.monotonic() < end, page.inner_text(".hx-alarms")
        if page.locator(".hx-alert >> text='Resume'").is_visible():
            page.click(".hx-alert >> text='Resume'")
            page.click("dialog >> text='Resume'")
            page.wait_for_timeout(3000)
        others = page.locator(".hx-alarms >> text=Acknowledge all")
        if (
            "the emergency is still active" in page.inner_text(".hx-said >> nth=0")
            and others.count()
        ):
            others.click(force=True)
        page.wait_for_timeout(1000)
    assert not field.call(lambda: field.live.operations.plant.sentinel.on)


@pytest.mark.parametrize("path", ["", "emergency"])
def test_emergency_needs_its_own_script_only(
    field: LiveConsole, enter: Callable[[str], Any], path: str
) -> None:
    page = enter("viewer")
    before = field.call(lambda: field.live.operations.plant.sentinel.order)
    page.route("**/live.js", lambda route: route.abort())
    page.goto(f"{field.address}{path}")
    page.click("#emergency")
    page.wait_for_selector("#emergency-said:has-text('ordered')")
    assert not page.evaluate("window.heliotrope")
    order = field.call(lambda: field.live.operations.plant.sentinel.order)
    assert order is not before
    field.calm()


def test_a_page_that_hears_nothing_says_so(field: LiveConsole, enter: Callable[[str], Any]) -> None:
    page = enter("viewer")
    page.evaluate("heliotrope.store.take = () => {}")
    until(page, "document.body.classList.contains('hx-dead')")
    assert "NOT LIVE" in page.inner_text(".hx-live")
    assert page.evaluate("heliotrope.store.stateName(0)") == "stale"


# The last one: nodes that failed are counted for ten minutes, and commands refused meanwhile.
def test_a_dead_cluster_is_shown_as_stale(field: LiveConsole, enter: Callable[[str], Any]) -> None:
    page = enter("viewer")
    buses = field.call(lambda: list(field.live.world.buses.values()))
    page.click(".hx-tabs >> text=Clusters")
    page.wait_for_selector(".hx-clusters tbody tr")
    field.call(lambda: setattr(buses[3], "plugged", False))
    try:
        until(page, "heliotrope.store.state.filter(s => s === 255).length === 32")
        page.wait_for_selector(".hx-clusters tbody tr:has-text('degraded')")
        until(page, "document.querySelector('.hx-legend').textContent.includes('stale 32')")
    finally:
        field.call(lambda: setattr(buses[3], "plugged", True))
    until(page, "heliotrope.store.state.every(s => s !== 255)")


def test_a_flight_is_taken_and_shown(
    field: LiveConsole, enter: Callable[[str], Any], tmp_path: Path
) -> None:
    name = field.live.operations.names[-1]
    mechanism = field.live.operations.plant.beliefs.nominal(name)
    counts = np.array([[1000.0 * k, 500.0 * k] for k in (1, 2, 3)])
    pose = mechanism[[0, 0, 0]].pose(counts)
    row = {"heliostat": name, "time": 1.7e9, "sigma_rad": 1e-4, "turn_rad": 1e-4}
    flight = {
        "format": "heliotrope-flight",
        "version": 1,
        "name": "from the page",
        "shared": ["position east, m", "position north, m", "position up, m"],
        "covariance": (1e-4 * np.eye(3)).tolist(),
        "rows": [
            {**row, "counts": c, "place_m": p, "covariance_m2": [[0.0] * 3] * 3,
             "shift": np.eye(3).tolist()}
            for c, p in zip(
                counts.tolist(), (pose.vertex + 100.0 * pose.normal).tolist(), strict=True
            )
        ],
    }  # fmt: skip
    place = tmp_path / "flight.json"
    place.write_text(json.dumps(flight))
    page = enter("engineer")
    page.click(".hx-tabs >> text=Calibration")
    page.wait_for_selector(".hx-calibration >> text=Take a flight", timeout=60_000)
    page.set_input_files(".hx-calibration input[type=file]", place)
    shown = page.wait_for_selector(
        ".hx-calibration tr:has-text('from the page')", timeout=60_000
    ).inner_text()
    assert re.search(r"engineer\s+1\s+\d\s+\d\s+\d\s+\d\s+position east", shown), shown
