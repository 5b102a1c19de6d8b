"""The three walks of the page on the architecture, followed in a plant that runs."""

import asyncio
import re
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import httpx
import pytest

from heliotrope.field.layouts import malan_plant
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.twin.world import RunPlan, run
from support.live import LiveOptions, LivePlant
from support.live_console import LiveConsole
from support.walks import Recorder, unreached

PAGE = Path(__file__).parents[1] / "docs" / "explanation" / "architecture.md"
START = datetime(2026, 10, 21, 9, tzinfo=UTC)
#: Functions named in a walk that stand beside its last stay: what hears of the new record.
BESIDE = re.compile(r"^    `([\w.]+)`", re.MULTILINE)


def section(title: str) -> str:
    """Return the text of one walk."""
    text = PAGE.read_text(encoding="utf-8")
    return text.partition(f"### {title}\n")[2].partition("\n#")[0]


def stays_of(title: str) -> list[str]:
    """Return the numbered functions of one walk."""
    stays = re.findall(r"^\d+\. `([\w.]+)`", section(title), re.MULTILINE)
    assert len(stays) > 10
    return stays


@pytest.fixture(autouse=True)
def not_recording() -> Iterator[None]:
    """Put back the profile function of whoever measures this test."""
    before = sys.getprofile()
    yield
    sys.setprofile(before)


def test_unreached_wants_the_order() -> None:
    assert unreached(["a", "b", "c"], ["a", "c", "b", "a", "c"]) == []
    assert unreached(["a", "b", "c"], ["b", "a", "c"]) == ["b", "c"]


def test_from_the_sun_to_a_motor() -> None:
    stays = stays_of("The sun to a motor")
    recorder = Recorder(stays)
    recorder.start()
    result = run(RunPlan(3, seconds=80.0, heliostats=1, faults=()))
    recorder.stop()
    assert result.violation is None
    assert result.problem == ""
    assert unreached(stays, recorder.calls) == []


def test_from_a_photograph_to_a_better_mirror() -> None:
    title = "A photograph to a better mirror"
    stays, subscribers = stays_of(title), BESIDE.findall(section(title))
    assert len(subscribers) == 3
    recorder = Recorder([*stays, *subscribers])
    options = LiveOptions(rendered=True, threads=0, boards=True, seed=3)

    async def main(clock: VirtualClock) -> None:
        async with LivePlant(malan_plant(1), clock, options).running() as live:
            begun = clock.monotonic()
            (name,) = live.names
            recorder.start()
            while live.plant.beliefs.record(name) is None:
                assert clock.monotonic() - begun < 600.0, "no calibration within ten minutes"
                await asyncio.sleep(1.0)
            recorder.stop()
            await live.end()

    run_virtual(main, start=START)
    assert unreached(stays, recorder.calls) == []
    assert set(subscribers) <= set(recorder.calls)


def test_from_the_emergency_button_to_the_last_mirror(tmp_path: Path) -> None:
    stays = stays_of("A click on EMERGENCY to the last mirror")
    recorder = Recorder(stays)
    console = LiveConsole(tmp_path, 2, speed=8.0, boards=True)
    try:
        token = console.keeper.people.add_token("viewer", "test", "viewer", time.time())[1]
        operations = console.live.operations
        console.until(lambda: operations.summary().states.get("TRACKING") == 2)
        console.call(recorder.start)
        console.console_call(recorder.start)
        with httpx.Client(
            base_url=console.address,
            headers={"Authorization": f"Bearer {token}"},
            trust_env=False,
        ) as client:
            order = {"act": "DEFOCUS", "reason": "test"}
            assert client.post("api/v1/emergency", json=order).status_code == 200
            end = time.monotonic() + 120.0
            while unreached(stays, recorder.calls):
                assert time.monotonic() < end, f"not reached: {unreached(stays, recorder.calls)}"
                time.sleep(0.2)
                # The page asks again and again.
                assert client.get("api/v1/emergency").status_code == 200
    finally:
        console.close()
