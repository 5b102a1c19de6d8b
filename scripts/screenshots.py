"""Make the pictures of the console for the documentation, from a simulated plant at work.

python scripts/screenshots.py [--heliostats 320] [--learnt 8] [--speed 4] [--into docs/images]

console-field.png is console-light.png made with ``--heliostats 10000 --learnt 0 --speed 1``.
"""

import argparse
import asyncio
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from heliotrope.console import _secrets
from heliotrope.console.beside import ConsoleProcesses
from heliotrope.console.settings import ConsoleSettings
from heliotrope.field.layouts import malan_plant
from heliotrope.links.clock import VirtualClock
from heliotrope.plant.assembly import AssemblySettings, MachineTables, PlantAssembly
from heliotrope.plant.interface import PlantInterface
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.store.keeper import Keeper
from heliotrope.twin.live import CYCLE, PacedLoop, World

NAME = "engineer"
CHROMIUM = "/usr/bin/chromium"
ARGS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
#: What the tab of the plant has once the flux is predicted.
LIT = ".hx-plant dt:has-text('Intercept')"
WIDE, TABLET = {"width": 1600, "height": 900}, {"width": 1024, "height": 768}


class Shown:
    """A plant in a thread of its own, with its console."""

    def __init__(self, folder: Path, heliostats: int, speed: float) -> None:
        self.password, self.address = _secrets.new_password(), ""
        self._of, self._over = (folder, heliostats, speed), threading.Event()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        self._ready.wait(120.0)

    def _run(self) -> None:
        try:
            with asyncio.Runner(loop_factory=lambda: PacedLoop(self._of[2])) as runner:
                runner.run(self._main())
        finally:
            self._ready.set()

    async def _main(self) -> None:
        folder, heliostats, speed = self._of
        clock = VirtualClock(asyncio.get_running_loop().time)
        keeper = Keeper(folder / "store.sqlite")
        kept = _secrets.hash_password(self.password)
        now = time.time()
        keeper.people.add(NAME, kept, "engineer", now)
        for name, role in (("desk-1", "operator"), ("desk-2", "operator"), ("visitors", "viewer")):
            keeper.people.add(name, kept, role, now)
        design = malan_plant(heliostats)
        ports = World(design, clock).ports(records=keeper, facts=lambda: {"speed": speed})
        settings = AssemblySettings(
            AutomaticSettings(wanted=True), cycle=CYCLE, machines=MachineTables.HELD
        )
        live = PlantAssembly(design, ports, settings)
        interface = PlantInterface(live.operations, keeper.people, folder)

        def tell(address: str) -> None:
            self.address = address
            self._ready.set()

        console = ConsoleProcesses(
            interface, ConsoleSettings(port=0), live.logbook.take_alarm, tell
        )
        async with live.running(), interface.running(console.run):
            while not self._over.is_set():
                await asyncio.sleep(0.2)
        keeper.close()

    def close(self) -> None:
        """End the plant and its console."""
        self._over.set()
        self._thread.join()


def take(page: Any, into: Path) -> None:
    """Take all pictures."""

    def shot(name: str, has: str = "body") -> None:
        page.wait_for_selector(has)
        page.wait_for_timeout(1500)
        page.wait_for_function("heliotrope.store.live")
        page.screenshot(path=into / f"console-{name}.png")
        print(into / f"console-{name}.png")

    def tab(title: str) -> None:
        page.click(f".hx-tabs >> text={title}")

    tab("Plant")
    shot("plant", LIT)
    tab("Calibration")
    page.select_option(".hx-tools select", "error")
    shot("calibration", ".hx-calibration td span.good")
    tab("Targets")
    shot("targets", ".hx-photo img[src]")
    page.fill(".hx-query", "sightings > 0")
    page.keyboard.press("Enter")
    page.evaluate("heliotrope.store.select([...heliotrope.store.selection].slice(0, 1))")
    tab("Heliostat")
    page.select_option(".hx-tools select", "state")
    shot("heliostat", ".hx-why")
    page.click(".hx-menu summary")
    page.click(".hx-menu >> text=People")
    page.wait_for_selector("dialog.wide tr")
    shot("people")
    page.click("dialog >> text=Close")
    page.set_viewport_size(TABLET)
    tab("Plant")
    shot("tablet-dark", LIT)
    page.click("[aria-label='Dark or light']")
    tab("Clusters")
    shot("tablet", ".hx-clusters tbody tr")
    page.set_viewport_size(WIDE)
    tab("Plant")
    shot("light", LIT)
    page.click("#emergency")
    shot("emergency", ".hx-alert.on:has-text('reports alone')")


def main() -> None:
    """Make the pictures."""
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description="Pictures of the console.")
    parser.add_argument("--heliostats", type=int, default=320)
    parser.add_argument("--learnt", type=int, default=8, help="heliostats to wait for")
    parser.add_argument("--speed", type=float, default=4.0)
    parser.add_argument("--into", type=Path, default=Path("docs/images"))
    given = parser.parse_args()
    given.into.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        shown = Shown(Path(folder), given.heliostats, given.speed)
        try:
            browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGS)
            page = browser.new_page(viewport=WIDE, bypass_csp=True)
            page.set_default_timeout(600_000)
            page.goto(f"{shown.address}login")
            page.fill("[name=name]", NAME)
            page.fill("[name=password]", shown.password)
            page.click("button")
            page.wait_for_selector(".hx-legend b")
            found = "heliotrope.store.head?.calibration"
            # Beams that are identified count as done before their calibrations are verified.
            done = f"{found}?.done >= {given.learnt} && ({found}.quality || !{given.learnt})"
            page.wait_for_function(done, timeout=1_800_000)
            take(page, given.into)
            browser.close()
        finally:
            shown.close()


if __name__ == "__main__":
    main()
