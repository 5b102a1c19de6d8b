"""The operator page in a browser without a screen."""

import contextlib
import os
import shutil
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from support.live_console import PASSWORD

CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"
ARGS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
#: A desktop with a mouse, and a tablet that is touched: options of the browser's context.
SCREENS: dict[str, dict[str, Any]] = {
    "desktop": {"viewport": {"width": 1440, "height": 900}},
    "tablet": {"viewport": {"width": 820, "height": 1180}, "has_touch": True},
}
#: Mark of modules that need the browser.
NEEDS_BROWSER = pytest.mark.skipif(
    not os.path.exists(CHROMIUM) and not os.environ.get("CI"),  # noqa: PTH110 - a word of skipif
    reason=f"{CHROMIUM} is not there: the page is not tested",
)


def browsers() -> Iterator[Any]:
    """Start a browser for one module: its loop would stand in others' way."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        made = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGS)
        yield made
        made.close()


def entering(address: str, browser: Any) -> Iterator[Callable[..., Any]]:
    """Sign in as somebody of a role; what goes wrong in the page fails the test.

    The function takes the role, and options of the browser's context such as ``has_touch``. What
    the page showed at the end is printed, so that a failed test shows it.
    """
    opened, wrong = [], []

    def go(role: str, **options: Any) -> Any:
        context = browser.new_context(**{"viewport": {"width": 1600, "height": 900}, **options})
        context.set_default_timeout(90_000)
        opened.append(context)
        page = context.new_page()
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("requestfailed", lambda asked: print(f"failed: {asked.method} {asked.url}"))
        page.on("response", lambda a: a.status >= 400 and print(f"{a.status}: {a.url}"))
        page.on("console", lambda line: "Security Policy" in line.text and wrong.append(line.text))
        page.goto(address)
        page.wait_for_url("**/login")
        page.fill("[name=name]", role)
        page.fill("[name=password]", PASSWORD)
        page.click("button")
        page.wait_for_selector(".hx-legend b")
        until(page, "heliotrope.store.live")
        return page

    yield go
    for context in opened:
        for page in context.pages:
            with contextlib.suppress(Exception):  # a page that is gone shows nothing
                print(f"{page.url}: {page.evaluate('document.body.innerText')[:4000]!r}")
        context.close()
    assert not wrong


def _touched(page: Any) -> bool:
    return bool(page.evaluate("navigator.maxTouchPoints"))


def press(page: Any, what: str, **options: Any) -> None:
    """Click with the mouse; on a screen for touch, tap."""
    (page.tap if _touched(page) else page.click)(what, **options)


def drag(page: Any, *places: tuple[float, float]) -> None:
    """Draw a line through places of the window, px, with the mouse or a finger."""
    if not _touched(page):
        page.mouse.move(*places[0])
        page.mouse.down()
        for place in places[1:]:
            page.mouse.move(*place, steps=5)
        page.mouse.up()
        return
    session = page.context.new_cdp_session(page)
    for k, (x, y) in enumerate(places):
        points = {"type": "touchMove" if k else "touchStart", "touchPoints": [{"x": x, "y": y}]}
        session.send("Input.dispatchTouchEvent", points)
        page.wait_for_timeout(50)  # moves within one frame would be one; a quick lift is a fling
    session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    session.detach()


def until(page: Any, holds: str, arg: Any = None, within: float = 90.0) -> None:
    """Wait until an expression holds in the page.

    The page's policy forbids `eval`, with which Playwright's own wait tries an expression again.
    """
    end = time.monotonic() + within
    while not page.evaluate(holds, arg):
        assert time.monotonic() < end, f"not within {within:g} s: {holds}"
        page.wait_for_timeout(100)


def said(page: Any, text: str) -> None:
    """Wait until the command bar says a text."""
    until(
        page, "text => document.querySelector('.hx-bar .hx-said').textContent.includes(text)", text
    )


def menu(page: Any, title: str) -> None:
    """Choose an item of the person's menu."""
    page.click(".hx-menu summary")
    page.click(f".hx-menu >> text={title}")


def orders_counted(page: Any) -> set[str]:
    """Answer orders of an emergency in place of the plant; return their words.

    Each order is sent two ways, with one word.
    """
    calls: set[str] = set()

    def take(route: Any) -> None:
        assert route.request.method == "POST"
        calls.add(route.request.post_data_json["call"])
        route.fulfill(json={"act": "DEFOCUS", "heliostats": 64})

    page.route("**/api/v1/emergency", take)
    return calls


@contextlib.contextmanager
def task(page: Any, name: str) -> Iterator[None]:
    """Print how many clicks or taps, and seconds, a person's task takes on a screen."""
    page.evaluate(
        "() => { if (window.clicks === undefined) addEventListener('click', (e) => { "
        "window.clicks += e.isTrusted && e.detail > 0; }, true); window.clicks = 0; }"
    )
    begun = time.monotonic()
    yield
    took = time.monotonic() - begun
    wide, clicks = page.viewport_size["width"], page.evaluate("window.clicks")
    print(f"{name}, {wide} px wide: {clicks} clicks, {took:.1f} s")
