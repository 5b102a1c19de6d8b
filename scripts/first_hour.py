"""Make the pictures of the tutorial of the first hour by `heliotrope run`.

python scripts/first_hour.py [--heliostats 320] [--into docs/images]

It prints the time that each step took, and the lines of the plant.
"""

import argparse
import re
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

from screenshots import ARGS, CHROMIUM, LIT, WIDE

COMMAND = [sys.executable, "-c", "from heliotrope.cli import main; main()", "run"]


class Plant:
    """`heliotrope run` as a process; its lines are kept and printed."""

    def __init__(self, *options: str) -> None:
        self.begun, self.lines = time.monotonic(), list[str]()
        self._process = subprocess.Popen(  # noqa: S603 - this program itself
            [*COMMAND, *options, "--port", "0", "--no-browser", "--every", "20"],
            stdout=subprocess.PIPE,
            text=True,
        )
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.lines.append(line)
            self.say(re.sub(r"once=\S+", "once=…", line.rstrip()))

    def say(self, text: str) -> None:
        """Print a line with the seconds since the start."""
        print(f"{time.monotonic() - self.begun:6.1f} s  {text}", flush=True)

    def told(self, pattern: str, within: float = 120.0) -> str:
        """Wait for a line that matches, and return its group."""
        until = time.monotonic() + within
        while time.monotonic() < until:
            for line in self.lines:
                if found := re.search(pattern, line):
                    return found[1]
            time.sleep(0.1)
        raise SystemExit(f"no line with {pattern!r} within {within:g} s")

    def end(self) -> None:
        """End the process as Ctrl-C does."""
        self._process.terminate()
        self._process.wait(400.0)


def take(page: Any, plant: Plant, into: Path) -> None:
    """Follow the steps of the tutorial: 10 s, a minute and five minutes after the page."""
    opened = time.monotonic()

    def shot(name: str, after: float = 0.0) -> None:
        page.wait_for_timeout(max(1000.0, 1e3 * (opened + after - time.monotonic())))
        page.screenshot(path=into / f"first-hour-{name}.png")
        plant.say(f"picture {name}")

    page.wait_for_selector(".hx-legend b")
    page.wait_for_selector(LIT, timeout=300_000)
    shot("start", 10.0)
    page.click(".hx-tabs >> text=Targets")
    shot("target", 60.0)
    page.click(".hx-tabs >> text=Calibration")
    shot("calibration", 300.0)
    # The newest row of the table.
    page.click(".hx-table tbody tr.can >> nth=0", timeout=300_000)
    page.click(".hx-tabs >> text=Heliostat")
    page.wait_for_selector(".hx-why")
    shot("heliostat")


def main() -> None:
    """Make the pictures."""
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description="Pictures of the first hour.")
    parser.add_argument("--heliostats", type=int, default=320)
    parser.add_argument("--into", type=Path, default=Path("docs/images"))
    given = parser.parse_args()
    plant = Plant("--heliostats", str(given.heliostats))
    try:
        link = plant.told(r"console: (\S+)")
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGS)
            page = browser.new_page(viewport=WIDE)
            page.set_default_timeout(60_000)
            page.goto(link)
            take(page, plant, given.into)
            browser.close()
    finally:
        plant.end()


if __name__ == "__main__":
    main()
