"""The pages by axe-core: no serious finding, dark and light, on a desktop and on a tablet.

``data/axe.min.js`` is axe-core 4.14.1 as npm has it (MPL-2.0).
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from support.live_console import LiveConsole
from support.pages import NEEDS_BROWSER

pytestmark = NEEDS_BROWSER
AXE = (Path(__file__).parent / "data" / "axe.min.js").read_text(encoding="utf-8")
TABS = (
    "plant", "heliostat", "heliostats", "targets", "calibration", "clusters", "alarms", "logs",
    "schedule", "shift",
)  # fmt: skip
RUN = """async () => (await axe.run(document, { resultTypes: ["violations"] })).violations
    .filter((one) => ["serious", "critical"].includes(one.impact))
    .flatMap((one) => one.nodes.slice(0, 3).map((node) => `${one.id}: ${node.html.slice(0, 160)}
      ${node.failureSummary.split("\\n").slice(1, 2)}`))"""


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveConsole]:
    """Twelve heliostats at eight times the speed of real time."""
    made = LiveConsole(tmp_path_factory.mktemp("axe"), 12, speed=8.0)
    yield made
    made.close()


@pytest.mark.parametrize(("width", "light"), [(1440, False), (820, True)])
def test_no_serious_finding(
    field: LiveConsole, enter: Callable[..., Any], width: int, light: bool
) -> None:
    page = enter("engineer", viewport={"width": width, "height": 1000})
    if light:
        page.click(".hx-theme")
    found = {}
    page.evaluate("heliotrope.store.select([1], 1)")
    page.evaluate(AXE)
    for tab in TABS:
        page.click(f"[data-tab={tab}]")
        page.wait_for_selector(f".hx-panels .hx-{tab} >> css=*")
        page.wait_for_timeout(300)
        if wrong := page.evaluate(RUN):
            found[tab] = wrong
    page.click(".hx-orders >> text=Out of service…")
    if wrong := page.evaluate(RUN):
        found["dialog"] = wrong
    for path in ("report", "trends", "wall"):
        page.goto(f"{field.address}{path}")
        page.wait_for_selector({"report": "h1", "trends": "h1", "wall": ".hx-large dd"}[path])
        page.evaluate(AXE)
        if wrong := page.evaluate(RUN):
            found[path] = wrong
    assert not found, "\n".join(f"{name}: {one}" for name, each in found.items() for one in each)
