"""The plant file by API, by `ctl` and on the page."""

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from typer.testing import CliRunner

from heliotrope.cli import app
from heliotrope.console import _secrets
from heliotrope.field.approval import ApprovalSettings
from heliotrope.field.formats.plant_edit import versions
from heliotrope.field.formats.plant_file import read_plant
from support.live_console import PASSWORD, LiveConsole
from support.pages import NEEDS_BROWSER, task, until

Ask = Callable[..., httpx.Response]
Ctl = Callable[..., str]
TARGET, SECOND = "left", "edda"
AUTHORITY = "take command first"


@pytest.fixture(scope="module")
def console(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveConsole]:
    """A small plant with a plant file and cameras that take pictures; no visits disturb it."""
    folder = tmp_path_factory.mktemp("plant-file")
    made = LiveConsole(folder, 8, rendered=True, file=folder / "plant.toml")
    made.call(lambda: made.live.operations.automatic.switch(False))
    yield made
    made.close()


@pytest.fixture(scope="module")
def field(console: LiveConsole) -> LiveConsole:
    return console


@pytest.fixture
def ctl(console: LiveConsole, tokens: dict[str, str], tmp_path: Path) -> Ctl:
    """Run `heliotrope ctl` as somebody; ``code`` is the exit code that is expected."""

    def run(who: str, *words: str, code: int = 0, data: bool = False) -> str:
        secret = tmp_path / who
        secret.write_text(tokens[who])
        where = ["--data", str(console.folder)] if data else ["--url", console.address]
        found = CliRunner().invoke(app, ["ctl", *where, "--token-file", str(secret), *words])
        assert found.exit_code == code, (found.output, found.exception)
        return f"{found.output}{found.exception or ''}"

    return run


def camera_moved(text: str, by: float) -> str:
    """Return the text of a plant file with its first camera further east."""

    def further(found: re.Match[str]) -> str:
        return f"{found[1]}{float(found[2]) + by!r}"

    new, count = re.subn(r"(position_m = \[\s*)([-\d.e]+)", further, text, count=1)
    assert count == 1
    return new


def rounded(text: str, to: str) -> str:
    """Return the text with another radius of its receiver."""
    new, count = re.subn(r"(?m)^radius_m = .*$", f"radius_m = {to}", text, count=1)
    assert count == 1
    return new


def test_engineers_check_and_store_by_the_api(console: LiveConsole, ask: Ask) -> None:
    file = console.folder / "plant.toml"
    text = file.read_text()
    view = ask("engineer", "GET", "plant-file").json()
    assert (view["text"], view["file"], view["differs"], view["writable"]) == (
        text,
        "plant.toml",
        [],
        True,
    )
    receiver = rounded(text, "5.5")
    checked = ask("engineer", "POST", "plant-file/check", {"text": receiver}).json()
    assert checked["good"]
    assert not checked["at_once"]
    assert [(d["table"], d["keys"]) for d in checked["differs"]] == [("receivers", ["radius_m"])]
    order = {"text": receiver, "version": view["version"], "reason": "panel replaced"}
    for role in ("viewer", "operator"):
        for method, path, body in (
            ("GET", "", None),
            ("POST", "/check", {"text": receiver}),
            ("PUT", "", order),
        ):
            assert ask(role, method, f"plant-file{path}", body).status_code == 403
    wrong = ask("engineer", "PUT", "plant-file", {**order, "text": rounded(text, "-1")})
    assert wrong.status_code == 422
    assert re.search(r"line \d+: .*-1: input should be greater than or", wrong.json()["detail"])
    assert file.read_text() == text
    # No command authority: nothing of it is used before the restart.
    done = ask("engineer", "PUT", "plant-file", order).json()
    assert "takes effect when the plant restarts: receivers" in done["text"]
    assert read_plant(file).receivers[0].radius == 5.5
    late = ask("engineer", "PUT", "plant-file", {**order, "text": text})
    assert "has changed since you opened it" in late.json()["detail"]
    view = ask("engineer", "GET", "plant-file").json()
    assert [d["table"] for d in view["differs"]] == ["receivers"]
    old = view["versions"][0]
    assert old["name"] == done["version"]
    assert "panel replaced" in old["note"]
    assert ask("engineer", "GET", f"plant-file/versions/{old['name']}").json() == text
    assert ask("engineer", "GET", "plant-file/versions/..%2F..").status_code == 404
    again = {"text": text, "version": view["version"], "reason": "not yet delivered"}
    assert "already uses these values" in ask("engineer", "PUT", "plant-file", again).json()["text"]
    assert '"PLANT FILE"' in (console.folder / "audit.jsonl").read_text()


def test_a_camera_is_used_at_once_by_who_has_command(console: LiveConsole, ask: Ask) -> None:
    cameras, file = console.live.cameras, console.folder / "plant.toml"
    view = ask("engineer", "GET", "plant-file").json()
    name = console.live.design.cameras[0].name
    text = camera_moved(view["text"], 0.25)
    before = console.call(lambda: cameras.eye(TARGET))
    order = {"text": text, "version": view["version"], "reason": "surveyed"}
    refused = ask("engineer", "PUT", "plant-file", order)
    assert (refused.status_code, AUTHORITY in refused.json()["detail"]) == (409, True)
    assert console.call(lambda: cameras.eye(TARGET)) is before
    assert ask("engineer", "POST", "authority").is_success
    done = ask("engineer", "PUT", "plant-file", order).json()
    ask("engineer", "DELETE", "authority")
    assert f"takes effect immediately: cameras {name}" in done["text"]
    after = console.call(lambda: cameras.eye(TARGET))
    assert after.position[0] == pytest.approx(before.position[0] + 0.25)
    assert read_plant(file).camera(name).position[0] == pytest.approx(after.position[0])
    assert ask("engineer", "GET", "plant-file").json()["differs"] == []
    events = ask("viewer", "GET", "events").json()
    assert any("plant file stored, takes effect immediately" in row["text"] for row in events)


def test_ctl_prints_checks_and_stores(console: LiveConsole, ctl: Ctl, tmp_path: Path) -> None:
    file, mine = console.folder / "plant.toml", tmp_path / "new.toml"
    text = file.read_text()
    assert ctl("engineer", "plant-file") == text
    assert "needs engineer" in ctl("viewer", "plant-file", code=1)
    mine.write_text(rounded(text, "-1"))
    found = ctl("engineer", "plant-file", "--check", str(mine), code=1)
    assert re.search(r"error: line \d+: .*-1", found)
    mine.write_text(rounded(text, "6.5"))
    assert "takes effect when" in ctl("engineer", "plant-file", "--check", str(mine), data=True)
    assert "add --reason" in ctl("engineer", "plant-file", "--store", str(mine), code=1)
    words = ("plant-file", "--store", str(mine), "--reason", "new panel")
    assert "receivers" in ctl("engineer", *words, data=True)
    assert read_plant(file).receivers[0].radius == 6.5
    assert "new panel" in ctl("engineer", "plant-file", "--versions")
    name = versions(file)[-1].name
    assert ctl("engineer", "plant-file", "--version", name) == text
    assert "no file is waiting" in ctl("engineer", "plant-file", "--waiting")
    assert "only one option" in ctl("engineer", "plant-file", "--versions", "--waiting", code=1)
    mine.write_text(text)
    ctl("engineer", *words)


def paste(page: Any, text: str) -> None:
    """Replace the text in the editor; `fill` would insert each of its lines by itself."""
    page.locator("dialog .hx-toml").evaluate(
        "(box, text) => { box.value = text; box.dispatchEvent(new Event('input')); }", text
    )


@NEEDS_BROWSER
@pytest.mark.parametrize("width", [1440, 820])
def test_a_camera_is_changed_on_the_page(
    console: LiveConsole, ask: Ask, enter: Callable[..., Any], width: int
) -> None:
    console.release()
    file = console.folder / "plant.toml"
    text, name = file.read_text(), console.live.design.cameras[0].name
    kept = len(versions(file))
    page = enter("engineer", viewport={"width": width, "height": 1000})
    with task(page, f"a camera's view changed in the plant file, {width} px"):
        page.click("text=Plant file…")
        editor = page.locator("dialog .hx-toml")
        assert editor.input_value() == text
        # The keys of the table where the caret stands.
        place = text.index("focal_px")
        editor.evaluate("(box, at) => { box.focus(); box.setSelectionRange(at, at); }", place)
        editor.press("ArrowRight")
        page.wait_for_selector("dialog .hx-keys-of b:has-text('[cameras]')")
        page.wait_for_selector("dialog .hx-keys-of dt.now:has-text('focal_px required')")
        # A wrong value is told in one line, at its line, and nothing typed is lost.
        wrong = re.sub(r"deviation_px = .*", "deviation_px = -1.0", text, count=1)
        paste(page, wrong)
        page.fill("dialog [name=reason]", "surveyed")
        page.click("dialog >> text='Store'")
        page.wait_for_selector("dialog .hx-found .bad:has-text('deviation_px: -1.0: input should')")
        assert page.locator("dialog .hx-found li").count() == 1
        line = wrong[: wrong.index("deviation_px = -1.0")].count("\n") + 1
        page.wait_for_selector(f"dialog .hx-gutter .bad:has-text('{line}')")
        assert editor.evaluate("b => b.value.slice(b.selectionStart, b.selectionEnd)") == (
            "deviation_px = -1.0"
        )
        assert (editor.input_value(), file.read_text()) == (wrong, text)
        # Closed to take command and opened again: what was typed is still there.
        page.click("dialog >> text='Close'")
        page.click(".hx-authority >> text=Take command")
        page.wait_for_selector(".hx-authority >> text=You have command")
        page.click("text=Plant file…")
        page.wait_for_selector("dialog .hx-told:has-text('typed before')")
        assert editor.input_value() == wrong
        assert page.input_value("dialog [name=reason]") == "surveyed"
        paste(page, camera_moved(text, 0.5))
        page.click("dialog >> text='Check'")
        page.wait_for_selector("dialog .hx-told:has-text('Used at once when stored')")
        assert name in page.inner_text("dialog .hx-told")
        assert page.locator("dialog .hx-changes .good").count() == 1
        page.screenshot(path=f"{console.folder}/plant-file-{width}.png")
        page.click("dialog >> text='Store'")
        page.wait_for_selector(
            "dialog .hx-told:has-text('plant file stored, takes effect immediately')"
        )
    assert file.read_text() == camera_moved(text, 0.5)
    # Its version, who, when and why; the old text can be brought back.
    page.click("dialog summary:has-text('Stored versions')")
    first = page.locator("dialog .hx-kept li").first
    assert "engineer" in first.inner_text()
    assert "surveyed" in first.inner_text()
    assert len(versions(file)) == kept + 1
    assert '"PLANT FILE"' in (console.folder / "audit.jsonl").read_text()
    first.locator("button").click()
    page.wait_for_selector("dialog .hx-told:has-text('store it to bring it back')")
    assert editor.input_value() == text
    page.fill("dialog [name=reason]", "back")
    page.click("dialog >> text='Store'")
    until(page, "text => document.querySelector('dialog .hx-told').textContent.includes(text)",
          "takes effect immediately")  # fmt: skip
    assert file.read_text() == text
    # Nothing of the dialog is cut.
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


@NEEDS_BROWSER
def test_a_moved_receiver_waits_for_the_restart(
    console: LiveConsole, enter: Callable[..., Any]
) -> None:
    console.release()
    file = console.folder / "plant.toml"
    text = file.read_text()
    page = enter("engineer", viewport={"width": 820, "height": 1180}, has_touch=True)
    page.tap("text=Plant file…")
    paste(page, rounded(text, "7.5"))
    page.fill("dialog [name=reason]", "panel")
    page.tap("dialog >> text='Store'")
    page.wait_for_selector("dialog .hx-pending:has-text('when the plant restarts: receivers')")
    assert read_plant(file).receivers[0].radius == 7.5
    paste(page, text)
    page.fill("dialog [name=reason]", "back")
    page.tap("dialog >> text='Store'")
    page.wait_for_selector("dialog .hx-pending", state="detached")


@NEEDS_BROWSER
def test_an_operator_is_not_shown_the_plant_file(enter: Callable[..., Any]) -> None:
    page = enter("operator")
    page.wait_for_selector(".hx-plant h3")
    assert not page.locator("text=Plant file…").count()


@NEEDS_BROWSER
def test_two_engineers_on_the_page(tmp_path: Path, browser: Any) -> None:
    from support.pages import entering

    made = LiveConsole(
        tmp_path, 8, file=tmp_path / "plant.toml", approval=ApprovalSettings(parameters=True)
    )
    pages = None
    try:
        made.keeper.people.add(SECOND, _secrets.hash_password(PASSWORD), "engineer", time.time())
        pages = entering(made.address, browser)
        enter = next(pages)
        text = (tmp_path / "plant.toml").read_text()
        first = enter("engineer")
        first.click("text=Plant file…")
        paste(first, rounded(text, "7.5"))
        first.fill("dialog [name=reason]", "panel")
        first.click("dialog >> text='Ask for a second engineer'")
        first.wait_for_selector("dialog .hx-waiting >> text=Withdraw")
        assert (tmp_path / "plant.toml").read_text() == text
        second = enter(SECOND)
        second.click("text=Plant file…")
        second.wait_for_selector("dialog .hx-waiting:has-text('Asked for by engineer')")
        second.wait_for_selector("dialog .hx-waiting .good:has-text('radius_m = 7.5')")
        second.click("dialog >> text='Approve'")
        second.wait_for_selector("dialog .hx-waiting", state="detached")
        assert read_plant(tmp_path / "plant.toml").receivers[0].radius == 7.5
    finally:
        if pages is not None:
            next(pages, None)
        made.close()
