"""The page in German, chosen by the person or the browser, without a fixed text in English."""

import json
import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from heliotrope.console._files import KEPT, STATIC
from support.live_console import PASSWORD, LiveConsole
from support.pages import NEEDS_BROWSER, menu, until

pytestmark = NEEDS_BROWSER
GERMAN = json.loads((STATIC / "languages" / "de.json").read_text("utf-8"))
TABS = (
    "plant", "heliostat", "heliostats", "targets", "calibration", "clusters", "alarms", "logs",
    "schedule", "shift",
)  # fmt: skip
#: Names of people here, which are those of their roles; a receiver's; words of the plant's own.
NAMES = {"viewer", "operator", "engineer", "automatic control", "plant", "safety", "receiver"}
#: What people read: the texts that are not hidden, and the attributes.
READ = """() => {
    const found = [document.title];
    const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    while (walk.nextNode()) if (!walk.currentNode.parentElement.closest("script, style"))
        found.push(walk.currentNode.data.trim().replace(/\\s+/g, " "));
    for (const name of ["title", "aria-label", "placeholder", "alt", "data-dead"])
        document.querySelectorAll(`[${name}]`).forEach((one) => found.push(one.getAttribute(name)));
    return found;
}"""
#: Whether a cell of the table shows metres as German writes them.
METRES = "(one) => /^-?\\d+,\\d$/.test(one.textContent)"


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveConsole]:
    """Twelve heliostats at eight times the speed of real time."""
    made = LiveConsole(tmp_path_factory.mktemp("languages"), 12, speed=8.0)
    yield made
    made.close()


def english_left(page: Any) -> list[str]:
    """Return the texts on a page that German has another text for."""
    fixed = {text for text, said in GERMAN.items() if said != text} - NAMES
    made = [
        re.compile(re.sub(r"\\\{\w+\\\}", ".+", re.escape(text)))
        for text in fixed
        if "{" in text and len(re.sub(r"\{\w+\}|\W", "", text)) >= 6
    ]
    shown = {text for text in page.evaluate(READ) if text not in GERMAN.values()}
    return [text for text in shown if text in fixed or any(one.fullmatch(text) for one in made)]


def test_german_is_chosen_at_the_sign_in_and_stays(
    field: LiveConsole, browser: Any, enter: Callable[..., Any]
) -> None:
    page = enter("engineer")  # the browser's own language: English
    assert page.get_attribute("html", "lang") == "en"
    assert len(english_left(page)) > 40
    assert page.locator("#language option").count() == 3
    menu(page, "Sign out")
    page.wait_for_url("**/login")
    page.select_option("#language", "de")
    page.wait_for_selector("button:has-text('Anmelden')")
    assert page.get_attribute("html", "lang") == "de"
    assert not english_left(page)
    page.fill("[name=name]", "engineer")
    page.fill("[name=password]", "not this one")
    page.click("button")
    page.wait_for_selector("#said:not(:empty)")
    page.fill("[name=password]", PASSWORD)
    page.click("button")
    page.wait_for_selector(".hx-legend b")
    until(page, "heliotrope.store.live")
    page.evaluate("heliotrope.store.select([1], 1)")
    left = {}
    for tab in TABS:
        page.click(f"[data-tab={tab}]")
        page.wait_for_selector(f".hx-panels .hx-{tab} >> css=*")
        page.wait_for_timeout(300)
        left[tab] = english_left(page)
    page.click(".hx-orders >> text=Außer Betrieb …")
    page.wait_for_selector("dialog")
    left["dialog"] = english_left(page)
    page.click("dialog >> text=Abbrechen")
    page.click("#emergency", trial=True)
    for path in ("report", "trends", "wall", "account", "emergency"):
        page.goto(f"{field.address}{path}")
        until(page, "document.documentElement.lang === 'de'")
        page.wait_for_timeout(500)
        left[path] = english_left(page)
    assert not {name: texts for name, texts in left.items() if texts}


def test_the_browser_s_language_counts_until_one_is_chosen(enter: Callable[..., Any]) -> None:
    page = enter("engineer", locale="de-AT")
    assert page.get_attribute("html", "lang") == "de"
    assert page.inner_text("#emergency") == "NOTFALL"
    page.click("[data-tab=heliostats]")
    until(page, f"[...document.querySelectorAll('.hx-grid-body .num')].some({METRES})")
    page.fill(".hx-map .hx-query", "state = GEPARKT or state != STOWED")
    page.keyboard.press("Enter")
    until(page, "heliotrope.store.selection.size === 12")
    page.click(".hx-menu summary")
    page.select_option("#language", "en")
    page.wait_for_selector("#emergency:has-text('EMERGENCY')")


def test_without_its_catalogue_the_page_is_english(enter: Callable[..., Any]) -> None:
    page = enter("viewer", locale="es-ES")
    assert page.get_attribute("html", "lang") == "es"
    page.route("**/languages/es.json", lambda route: route.abort())
    page.reload()
    page.wait_for_selector(".hx-legend b")
    assert page.get_attribute("html", "lang") == "en"
    assert page.inner_text("[data-tab=plant]") == "Plant"


def test_a_catalogue_is_kept_by_the_browser_as_the_other_files_are(
    field: LiveConsole, browser: Any
) -> None:
    page = browser.new_page()
    answer = page.request.get(f"{field.address}{KEPT[1:]}/languages/de.json")
    headers = answer.headers
    assert answer.json() == GERMAN
    assert headers["content-type"] == "application/json; charset=utf-8"
    assert "immutable" in headers["cache-control"]
    assert headers["x-content-type-options"] == "nosniff"
    assert "default-src 'none'" in headers["content-security-policy"]
    page.close()
